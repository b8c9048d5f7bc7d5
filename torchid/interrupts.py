"""When Ctrl-C may act, and what it came too late for."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_written: list[str] = []


@contextmanager
def interrupt_held_back() -> Iterator[None]:
    """Let Ctrl-C act when the block is done: what stands in it is short, and must happen as a whole.

    Raises:
        KeyboardInterrupt: after a block that Ctrl-C fell into.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    caught: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: caught.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if caught:
        raise KeyboardInterrupt


def begin() -> None:
    """A command begins: it has written nothing yet."""
    _written.clear()


def note_written(result: object) -> None:
    """A command has written a file or folder that stays."""
    _written.append(str(result))


def written() -> str:
    """What a command has written, in words."""
    return ", ".join(_written) or "nothing"
