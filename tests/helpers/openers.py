"""What another process opens in tests of `torchid.reader`: objects that answer, and some that do not."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from torchid.errors import LogError, TorchidWarning, UnknownNameError, warn, warn_about_file


class Opened:
    """Methods by what they do to the process."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def back(self, value: Any) -> Any:
        return value

    def arrays(self) -> dict[str, Any]:
        return arrays()

    def many(self, count: int, size: int) -> Iterator[tuple[int, bytes]]:
        return ((number, bytes([number % 256]) * size) for number in range(count))

    def fill(self, gigabytes: float) -> int:
        return len(bytearray(int(gigabytes * 2**30)))

    def loop(self) -> None:
        while True:
            pass

    def wait(self) -> None:
        time.sleep(60.0)

    def crash(self) -> None:
        os.kill(os.getpid(), signal.SIGSEGV)

    def end(self) -> None:
        os._exit(3)

    def refuse(self) -> None:
        raise LogError.at_field("time", "this", "that")

    def not_know(self) -> None:
        raise UnknownNameError.at_field("joint_names", "hop", ["hip", "knee"])

    def fail(self) -> None:
        raise ZeroDivisionError("of something")

    def warn(self) -> str:
        sys.stdout.write("what a library prints")
        warn_about_file("odd")
        warn("of no file", TorchidWarning)
        return "value"

    def number(self) -> int:
        return os.getpid()


def arrays() -> dict[str, Any]:
    """Arrays of all kinds that files hold."""
    return {
        "number": np.array(1.5),
        "matrix": np.arange(6.0).reshape(2, 3),
        "fortran": np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)),
        "big": np.arange(3, dtype=">f4"),
        "empty": np.zeros((0, 4)),
        "flags": np.array([True, False]),
        "texts": np.array(["hip", "knee_ä"]),
        "bytes": np.array([b"a", b"bc"]),
        "pairs": np.array([(1, 2.0), (3, 4.0)], dtype=[("a", "i4"), ("b", "f8", (1,))]),
        "stamps": np.array(["2020-01-01"], dtype="datetime64[ns]"),
    }


@contextmanager
def serve(path: Path) -> Iterator[Opened]:
    """Open a file."""
    yield Opened(path)


@contextmanager
def refuse(path: Path) -> Iterator[Opened]:
    """Open none."""
    raise LogError(path, "file", "something else", "a file")
    yield
