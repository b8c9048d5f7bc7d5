"""When Ctrl-C may act."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interrupt_held_back(message: str = "") -> Iterator[None]:
    """Let Ctrl-C act when the block is done: what stands in it is short, and must happen as a whole.

    Raises:
        KeyboardInterrupt: with the message, after a block that Ctrl-C fell into.
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
        raise KeyboardInterrupt(message)
