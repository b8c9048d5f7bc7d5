"""Atomic writing of results: hidden staging folders, files replaced at once, interrupts deferred meanwhile."""

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

#: Signals that end a command; Windows lacks some.
_TERMINATION = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
_written: list[str] = []


@contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Defer Ctrl-C to the end of a short block that must not be interrupted.

    Raises:
        KeyboardInterrupt: at the end of a block during which Ctrl-C was pressed, unless it is ignored.
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
    """Let SIGTERM and SIGHUP (a closed terminal) end a command as Ctrl-C does, with all cleanup.

    Ignored signals stay ignored, such as SIGHUP after `nohup`.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in _TERMINATION}
    changed = {number: handler for number, handler in before.items() if handler not in (signal.SIG_IGN, None)}
    for number in changed:
        signal.signal(number, _as_interrupt)
    try:
        yield
    finally:
        for number, handler in changed.items():
            signal.signal(number, handler)


def _as_interrupt(number: int, frame: FrameType | None) -> None:
    """Act as Ctrl-C, even where it is ignored because a shell started the command in the background."""
    handler = signal.getsignal(signal.SIGINT)
    if callable(handler):
        handler(number, frame)
    else:
        raise KeyboardInterrupt


def reset_written() -> None:
    """Clear the list of results that a command has written."""
    _written.clear()


def note_written(result: object) -> None:
    """Add a file or folder to the list of results that the command has written."""
    _written.append(str(result))


def list_written() -> str:
    """The results that the command has written so far, as text."""
    return ", ".join(_written) or "nothing"


try:
    import fcntl
except ImportError:  # Windows: leftovers of killed processes are not removed
    fcntl = None  # type: ignore[assignment]

CAN_LOCK = fcntl is not None

NEW, OLD = "new", "old"  # names in a staging folder: the result, and the one that it replaces
_LOCK = "lock"
_NAME = re.compile(r"\..+-[0-9a-f]{8}\.torchid", re.DOTALL)
_TRIES = 100


@contextmanager
def staging_folder(target: Path) -> Iterator[Path]:
    """A hidden folder beside `target`, locked by this process and removed after the block, except an `old` in it.

    Raises:
        OSError: the folder cannot be made.
    """
    folder, lock, there = target, -1, False
    try:
        with interrupts_deferred():
            folder, lock = _make_staging_folder(target)
            there = True
        yield folder
    finally:
        try:
            with interrupts_deferred():
                if there:
                    there = False
                    _discard(folder, lock)
        finally:
            if there:  # Ctrl-C before it was deferred
                _discard(folder, lock)


@contextmanager
def atomic_file(path: Path, result: bool = True) -> Iterator[Path]:
    """A temporary name that becomes `path` when the block ends without an error; a link at `path` is not followed.

    Args:
        path: the file.
        result: whether it is a result of the command, for `list_written`.

    Raises:
        OSError: the file cannot be written.
    """
    for _ in leftovers(path):
        pass
    with staging_folder(path) as folder:
        yield folder / NEW
        with interrupts_deferred():
            (folder / NEW).replace(path)
            if result:
                note_written(path)


def leftovers(target: Path) -> Iterator[Path]:
    """Staging folders beside `target` whose process has ended; each is removed before the next, except an `old`."""
    prefix = f".{target.name}-"
    with suppress(OSError):
        for path in sorted(target.parent.iterdir()):
            if path.name.startswith(prefix) and len(path.name) == len(prefix) + 16 and _NAME.fullmatch(path.name):
                yield from _take_over(path)


def is_leftover(path: Path) -> bool:
    """Whether a path is a staging folder whose process has ended, without an `old` in it."""
    if not _NAME.fullmatch(path.name):
        return False
    return any(not os.path.lexists(folder / OLD) for folder in _take_over(path, keep=True))


def remove_leftover(folder: Path) -> None:
    """Remove a staging folder whose process has ended, except an `old` in it."""
    for _ in _take_over(folder):
        pass


def _make_staging_folder(target: Path) -> tuple[Path, int]:
    """A new staging folder and the descriptor of its lock; until locked, another process may remove it."""
    for _ in range(_TRIES):
        folder = target.with_name(f".{target.name}-{secrets.token_hex(4)}.torchid")
        folder.mkdir()
        if not CAN_LOCK:
            return folder, -1
        with suppress(FileNotFoundError):
            lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
            if try_lock(lock, folder / _LOCK) is not False:
                return folder, lock
            os.close(lock)
    raise FileNotFoundError(f"{target.parent}: another process removes every new folder")


def try_lock(handle: int, path: Path) -> bool | None:
    """Whether a descriptor now locks the file at its path; None where the file system has no locks."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return os.path.samestat(os.fstat(handle), os.lstat(path))
    except (BlockingIOError, FileNotFoundError):
        return False
    except OSError:
        return None


def _take_over(folder: Path, keep: bool = False) -> Iterator[Path]:
    """The folder if its process has ended; removed afterwards unless `keep`."""
    if not CAN_LOCK or folder.is_symlink() or not folder.is_dir():
        return
    lock = -1
    try:
        names = set(os.listdir(folder))
        if not names <= {_LOCK, NEW, OLD}:
            return
        if _LOCK in names:
            lock = os.open(folder / _LOCK, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
            if not try_lock(lock, folder / _LOCK):
                return
        yield folder
        if not keep:
            _discard(folder, lock)
            lock = -1
    except OSError:  # of another user, or taken over by another process
        return
    finally:
        if lock >= 0:
            os.close(lock)


def _discard(folder: Path, lock: int) -> None:
    """Remove a staging folder except `old`; the lock is held to the end."""
    new = folder / NEW
    with suppress(OSError):
        shutil.rmtree(new, ignore_errors=True) if new.is_dir() and not new.is_symlink() else new.unlink(missing_ok=True)
    with suppress(OSError):
        (folder / _LOCK).unlink(missing_ok=True)
        folder.rmdir()
    if lock >= 0:
        os.close(lock)
