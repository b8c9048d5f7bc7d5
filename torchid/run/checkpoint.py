"""Checkpoints that are whole or not there, whatever stops the machine."""

from __future__ import annotations

import os
import pickle
import zlib
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import torch

from torchid.errors import InputError

CHECKPOINT = "checkpoint.pt"

_DAMAGED = (BadZipFile, EOFError, LookupError, OSError, RuntimeError, ValueError, zlib.error, pickle.UnpicklingError)
"""What files with random bytes changed have been seen to raise."""


def save_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Write a state of plain types and tensors, under a temporary name first."""
    temporary = folder / f".{CHECKPOINT}"
    with temporary.open("wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(folder / CHECKPOINT)


def load_checkpoint(folder: Path) -> dict[str, Any]:
    """The state that `save_checkpoint` wrote; no code in the file is run.

    Raises:
        InputError: the file is damaged or none of ours.
    """
    path = folder / CHECKPOINT
    try:
        _check_sums(path)
        state = torch.load(path, weights_only=True)
    except _DAMAGED as error:
        found = f"not readable ({(str(error).splitlines() or [type(error).__name__])[0]})"
        raise InputError(path, "file", found, "a checkpoint that torchid wrote") from error
    if not isinstance(state, dict):
        raise InputError(path, "file", f"holds a {type(state).__name__}", "a checkpoint that torchid wrote")
    return state


def _check_sums(path: Path) -> None:
    """Compare what was written with its checksums, which `torch.load` does not look at."""
    with ZipFile(path) as file:
        damaged = file.testzip()
    if damaged is not None:
        raise BadZipFile(f"damaged in {damaged}")
