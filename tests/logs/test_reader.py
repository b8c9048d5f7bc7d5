"""Whatever a file does to the process that reads it ends in one line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import openers
import pytest

from torchid import reader
from torchid.errors import InputError, LogError, TorchidWarning, UnknownNameError, about_file
from torchid.reader import LIMITS, RemoteObject, open_apart

linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits are those of Linux")


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv(LIMITS, raising=False)
    path = tmp_path / "log.npz"
    path.write_bytes(b"x")
    return path


@pytest.fixture
def opened(file: Path) -> Iterator[RemoteObject]:
    with about_file("log.npz"), open_apart(openers.serve, file) as remote:
        yield remote


def test_values_and_arrays_come_back_as_they_are(opened: RemoteObject) -> None:
    for value in (None, True, 3, 2.5, "text ä", b"bytes", [1, [2.0, None]], {"a": 1}):
        if not isinstance(value, bytes):
            assert opened.call("back", value) == value
    found, expected = opened.call("arrays"), openers.arrays()
    assert found.keys() == expected.keys()
    for name, array in expected.items():
        assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape), name
        np.testing.assert_array_equal(found[name], array)


def test_values_of_any_size_come_one_by_one(opened: RemoteObject) -> None:
    for count, size in ((0, 0), (5, 0), (3000, 1000), (3, 3_000_000)):
        records = list(opened.stream("many", count, size))
        assert [number for number, _ in records] == list(range(count))
        assert all(data == bytes([number % 256]) * size for number, data in records)


def test_errors_and_warnings_are_those_of_the_other_process(opened: RemoteObject) -> None:
    with pytest.raises(LogError, match=r"^log.npz: time: this; accepted: that$"):
        opened.call("refuse")
    with pytest.raises(UnknownNameError, match="joint_names: unknown name 'hop'; accepted: hip"):
        opened.call("not_know")
    with pytest.raises(Exception, match="of something") as caught:
        opened.call("fail")
    assert type(caught.value).__name__ == "ZeroDivisionError"
    with pytest.warns(TorchidWarning) as warned:
        assert opened.call("warn") == "value"
    assert [str(one.message) for one in warned] == ["log.npz: odd", "of no file"]


@linux
@pytest.mark.parametrize(
    ("method", "found"),
    [
        ("loop", "reading it takes more than 1 s of CPU time"),
        ("crash", r"its reader crashed \(SIGSEGV\)"),
        ("end", r"its reader crashed \(status 3\)"),
    ],
)
def test_a_file_that_ends_its_reader_is_refused_in_a_line(
    file: Path, method: str, found: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(LIMITS, "0.1")
    line = f"log.npz: file: {found}; accepted: a smaller file, or"
    with open_apart(openers.serve, file) as remote, pytest.raises(LogError, match=line):
        remote.call(method)
    with open_apart(openers.serve, file) as remote:
        assert remote.call("back", 1) == 1


@linux
def test_a_file_that_takes_too_much_memory_is_refused_unless_more_is_allowed(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_apart(openers.serve, file) as remote:
        assert remote.call("fill", 0.5) == 2**29
        with pytest.raises(LogError, match=f"exceeds the memory limit; accepted: .*{LIMITS}=4 in the environment"):
            remote.call("fill", 1.25)
    monkeypatch.setenv(LIMITS, "2")
    with open_apart(openers.serve, file) as remote:
        assert remote.call("fill", 1.25) == 5 * 2**28


@pytest.mark.parametrize("text", ["much", "-1", "nan", "inf", ""])
def test_a_factor_of_the_limits_that_is_none_is_refused(file: Path, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LIMITS, text)
    line = f"environment: {LIMITS}: '{text}'; accepted: a number above 0"
    with pytest.raises(InputError, match=line), open_apart(openers.serve, file):
        pass


def test_a_reader_that_says_nothing_is_ended(opened: RemoteObject, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "_ANSWER_SECONDS", 0.05)
    with pytest.raises(LogError, match="its reader did not answer for 0.5 s"):
        opened.call("wait")


def test_what_is_no_regular_file_is_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for name in ("fifo", "zero", "."):
        with pytest.raises(LogError, match="accepted: a regular file"), open_apart(openers.serve, tmp_path / name):
            pass


def test_a_process_takes_one_file_after_the_other(file: Path) -> None:
    with pytest.raises(LogError, match="something else"), open_apart(openers.refuse, file):
        pass
    numbers = set()
    for _ in range(3):
        with open_apart(openers.serve, file) as remote:
            numbers.add(remote.call("number"))
    assert len(numbers) == 1
    with open_apart(openers.serve, file) as one, open_apart(openers.serve, file) as other:
        assert one.call("number") != other.call("number")
    with open_apart(openers.serve, file) as remote:
        next(remote.stream("many", 100_000, 1000))  # not all of them are taken
    with open_apart(openers.serve, file) as remote:
        assert remote.call("back", 1) == 1


@linux
@pytest.mark.parametrize("method", ["back", "loop"])
def test_no_reader_outlives_who_asks_it(file: Path, method: str) -> None:
    code = (
        f"import sys; sys.path[:] = {sys.path!r}\n"
        "import openers, threading\nfrom pathlib import Path\nfrom torchid.reader import open_apart\n"
        f"with open_apart(openers.serve, Path({str(file)!r})) as remote:\n"
        "    print(remote.call('number'), flush=True)\n"
        f"    remote.call({method!r}, *{[1] if method == 'back' else []!r})\n"
        "    threading.Event().wait()\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        number = int(process.stdout.readline())
        process.send_signal(signal.SIGTERM)
    deadline = time.monotonic() + 10.0
    while Path(f"/proc/{number}").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not Path(f"/proc/{number}").exists()
