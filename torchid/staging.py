"""Results that appear whole or not at all: folders made in hiding, files replaced at once, interruptions held back."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

_ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))  # not all on Windows
_written: list[str] = []


@contextmanager
def interrupts_deferred() -> Iterator[None]:
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
def termination_as_interrupt() -> Iterator[None]:
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


def forget_written() -> None:
    """A command begins: it has written nothing yet."""
    _written.clear()


def note_written(result: object) -> None:
    """A command has written a file or folder that stays."""
    _written.append(str(result))


def list_written() -> str:
    """What a command has written, in words."""
    return ", ".join(_written) or "nothing"


try:
    import fcntl
except ImportError:  # not on Windows, where what a killed process left stays
    fcntl = None  # type: ignore[assignment]

CAN_LOCK = fcntl is not None

NEW, OLD = "new", "old"  # what is being made, and what it replaces
_LOCK = "lock"
_NAME = re.compile(r"\..+-[0-9a-f]{8}\.torchid", re.DOTALL)
_TRIES = 100


@contextmanager
def staging_folder(target: Path) -> Iterator[Path]:
    """A hidden folder beside `target`, locked by this process, that goes with the block, but for an `old` in it.

    Raises:
        OSError: none can be made.
    """
    folder, lock = target, -1
    try:
        with interrupts_deferred():
            folder, lock = _made(target)
        yield folder
    finally:
        with interrupts_deferred():
            if folder != target:
                _discard(folder, lock)


@contextmanager
def atomic_file(path: Path, result: bool = True) -> Iterator[Path]:
    """A temporary name that becomes `path` when the block ends without an error; a link at `path` is not followed.

    Args:
        path: the file.
        result: whether it is one that a command answers with.

    Raises:
        OSError: the file cannot be written.
    """
    clear_leftovers(path)
    with staging_folder(path) as folder:
        yield folder / NEW
        with interrupts_deferred():
            (folder / NEW).replace(path)
            if result:
                note_written(path)


def leftovers(target: Path) -> Iterator[Path]:
    """Staging folders beside `target` whose process is gone, each removed when the next is asked for, but for `old`."""
    prefix = f".{target.name}-"
    with suppress(OSError):
        for path in sorted(target.parent.iterdir()):
            if path.name.startswith(prefix) and len(path.name) == len(prefix) + 16 and _NAME.fullmatch(path.name):
                yield from _taken_over(path)


def clear_leftovers(target: Path) -> None:
    """Remove what killed processes left of results that were to become `target`."""
    for _ in leftovers(target):
        pass


def is_leftover(path: Path) -> bool:
    """Whether a path is a staging folder whose process is gone, with nothing in it that was there before."""
    if not _NAME.fullmatch(path.name):
        return False
    return any(not os.path.lexists(folder / OLD) for folder in _taken_over(path, keep=True))


def remove_leftover(folder: Path) -> None:
    """Remove a staging folder whose process is gone, but for `old`."""
    for _ in _taken_over(folder):
        pass


def _made(target: Path) -> tuple[Path, int]:
    """A new staging folder and the descriptor of its lock; another process may take it for a leftover until locked."""
    for _ in range(_TRIES):
        folder = target.with_name(f".{target.name}-{secrets.token_hex(4)}.torchid")
        folder.mkdir()
        if not CAN_LOCK:
            return folder, -1
        with suppress(FileNotFoundError):
            lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
            if lock_file(lock, folder / _LOCK) is not False:
                return folder, lock
            os.close(lock)
    raise FileNotFoundError(f"{target.parent}: another process removes every folder that is made there")


def lock_file(handle: int, path: Path) -> bool | None:
    """Whether a descriptor of a file now locks what is at its path; None where the file system knows no locks."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return os.path.samestat(os.fstat(handle), os.lstat(path))
    except (BlockingIOError, FileNotFoundError):
        return False
    except OSError:
        return None


def _taken_over(folder: Path, keep: bool = False) -> Iterator[Path]:
    """The folder if it is of a process that is gone; removed afterwards, unless it is to be kept."""
    if not CAN_LOCK or folder.is_symlink() or not folder.is_dir():
        return
    lock = -1
    try:
        names = set(os.listdir(folder))
        if not names <= {_LOCK, NEW, OLD}:
            return
        if _LOCK in names:
            lock = os.open(folder / _LOCK, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
            if not lock_file(lock, folder / _LOCK):
                return
        yield folder
        if not keep:
            _discard(folder, lock)
            lock = -1
    except OSError:  # another user's, or another process is quicker
        return
    finally:
        if lock >= 0:
            os.close(lock)


def _discard(folder: Path, lock: int) -> None:
    """Remove a staging folder, but for what is in `old`; the lock is held to the end."""
    new = folder / NEW
    with suppress(OSError):
        shutil.rmtree(new, ignore_errors=True) if new.is_dir() and not new.is_symlink() else new.unlink(missing_ok=True)
    with suppress(OSError):
        (folder / _LOCK).unlink(missing_ok=True)
        folder.rmdir()
    if lock >= 0:
        os.close(lock)
