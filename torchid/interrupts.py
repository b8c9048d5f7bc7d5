"""When Ctrl-C and other calls to end may act, and what they came too late for."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))  # not all on Windows
_written: list[str] = []


@contextmanager
def interrupt_held_back() -> Iterator[None]:
    """Let Ctrl-C act when the block is done: what stands in it is short, and must happen as a whole.

    Raises:
        KeyboardInterrupt: after a block that Ctrl-C fell into, unless it is ignored.
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
    if any(number != signal.SIGINT or before != signal.SIG_IGN for number in caught):
        raise KeyboardInterrupt


@contextmanager
def ending_interrupts() -> Iterator[None]:
    """Let SIGTERM, and SIGHUP of a terminal that closes, end a command as Ctrl-C does, which leaves nothing behind.

    One that is ignored stays so: SIGHUP after `nohup`.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in _ENDING}
    changed = {number: handler for number, handler in before.items() if handler not in (signal.SIG_IGN, None)}
    for number in changed:
        signal.signal(number, _as_interrupt)
    try:
        yield
    finally:
        for number, handler in changed.items():
            signal.signal(number, handler)


def _as_interrupt(number: int, frame: FrameType | None) -> None:
    """What Ctrl-C would do, even where a shell that started the command in the background has it ignored."""
    handler = signal.getsignal(signal.SIGINT)
    if callable(handler):
        handler(number, frame)
    else:
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
