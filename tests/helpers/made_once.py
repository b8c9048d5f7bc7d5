"""Folders that are made once for all workers of a test run."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A folder that the first worker that asks for it makes, and all others wait for and read.

    Args:
        factory: of this worker.
        name: of the folder's parent, which holds nothing else.
        make: makes the folder, which is not there yet.
    """
    folders = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folders = folders.parent  # of the run
    folder = folders / name / name
    with (folders / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.parent.exists():
            folder.parent.mkdir()
            make(folder)
    return folder
