"""Write results completely or not at all: into a hidden folder, then rename it."""

from __future__ import annotations

import glob
import os
import re
import shutil
import signal
import tempfile
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

# names in a staging folder: the result, and the one that it replaces
NEW = "new"
OLD = "old"
_NAME = re.compile(r"\..+-[a-z0-9_]{8}\.torchid", re.DOTALL)


def lock(path: Path, flags: int = os.O_RDONLY) -> int:
    """Descriptor of a file or folder that no other process has locked, until it is closed or this process ends.

    Args:
        path: of the file or folder.
        flags: with which it is opened.

    Raises:
        BlockingIOError: another process has locked it.
        OSError: it cannot be opened, or another process has just removed it.
    """
    handle = os.open(path, flags | getattr(os, "O_CLOEXEC", 0), 0o644)
    try:
        if fcntl is not None:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not os.path.samestat(os.fstat(handle), os.lstat(path)):
            raise FileNotFoundError(path)
    except OSError:
        os.close(handle)
        raise
    return handle


@contextmanager
def staging_folder(target: Path) -> Iterator[Path]:
    """A hidden folder beside `target`, locked by this process and removed after the block, except an `old` in it.

    Raises:
        OSError: the folder cannot be created.
    """
    handle = -1
    folder = target
    try:
        with interrupts_deferred():
            while handle < 0:
                folder = Path(tempfile.mkdtemp(".torchid", f".{target.name}-", target.parent))
                with suppress(FileNotFoundError):  # another process took it for a leftover before it was locked
                    handle = lock(folder) if fcntl is not None else os.open(os.devnull, os.O_RDONLY)
        yield folder
    finally:
        try:
            with interrupts_deferred():
                if handle >= 0:
                    _discard(folder)
                    os.close(handle)
                    handle = -1
        finally:
            if handle >= 0:  # Ctrl-C before it was deferred
                _discard(folder)
                os.close(handle)


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """A temporary name that becomes `path` when the block ends without an error; a link at `path` is not followed.

    Raises:
        OSError: the file cannot be written.
    """
    for _ in leftovers(path):
        pass
    with staging_folder(path) as folder:
        yield folder / NEW
        with interrupts_deferred():
            (folder / NEW).replace(path)
            if not any(_NAME.fullmatch(above.name) for above in path.parents):  # a part of a result otherwise
                note_written(path)


def leftovers(target: Path) -> Iterator[Path]:
    """Staging folders beside `target` whose process has ended; each is removed before the next, except an `old`."""
    for path in sorted(target.parent.glob(f".{glob.escape(target.name)}-????????.torchid")):
        yield from take_over(path)


def take_over(folder: Path) -> Iterator[Path]:
    """The folder if it is a staging folder whose process has ended; it is removed afterwards, except an `old` in it."""
    if fcntl is None or not _NAME.fullmatch(folder.name) or folder.is_symlink() or not folder.is_dir():
        return
    with suppress(OSError):  # locked by its process, or of another user
        handle = lock(folder)
        try:
            if set(os.listdir(folder)) <= {NEW, OLD}:
                yield folder
                _discard(folder)
        finally:
            os.close(handle)


def _discard(folder: Path) -> None:
    """Remove a staging folder, except an `old` in it."""
    new = folder / NEW
    with suppress(OSError):
        shutil.rmtree(new, ignore_errors=True) if new.is_dir() and not new.is_symlink() else new.unlink(missing_ok=True)
    with suppress(OSError):
        folder.rmdir()
