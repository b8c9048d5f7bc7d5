"""Checkpoints that are whole or not there, whatever stops the machine."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import torch

from torchid.errors import InputError

CHECKPOINT = "checkpoint.pt"


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
        InputError: the file is none of ours.
    """
    path = folder / CHECKPOINT
    try:
        state = torch.load(path, weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        found = f"not readable ({str(error).splitlines()[0]})"
        raise InputError(path, "file", found, "a checkpoint that torchid wrote") from error
    if not isinstance(state, dict):
        raise InputError(path, "file", f"holds a {type(state).__name__}", "a checkpoint that torchid wrote")
    return state
