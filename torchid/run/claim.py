"""One run at a time in one folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

from torchid.errors import ConfigError
from torchid.interrupts import interrupt_held_back
from torchid.run.folder import creating, parents_of


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Keep other processes that claim it from a folder that need not be there yet, until the block or this one ends.

    Raises:
        ConfigError: another process is at work there.
    """
    if fcntl is None:
        yield
        return
    lock, handle = folder.with_name(f".{folder.name}.lock"), -1
    with parents_of(folder):
        try:
            with interrupt_held_back():
                handle = _locked(lock, folder)
            yield
        finally:
            with interrupt_held_back():
                if handle >= 0:
                    lock.unlink(missing_ok=True)
                    os.close(handle)


def _locked(lock: Path, folder: Path) -> int:
    """Descriptor of a file that no other process has locked; the system unlocks it when this one ends or is killed."""
    while True:
        with creating(folder):
            handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(handle)
            found, accepted = "another run is at work there", "another output, or patience"
            raise ConfigError(folder, "output", found, accepted) from error
        except OSError:  # a file system without locks: one run at a time is then the user's affair
            return handle
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(handle), lock.stat()):
                return handle
        os.close(handle)  # who had it has just removed it
