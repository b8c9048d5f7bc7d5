"""Checkpoints that are whole or not there, whatever stops the machine."""

from __future__ import annotations

import os
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from torchid.config.scan import check_yaml
from torchid.errors import InputError
from torchid.guards import MAX_STATE, check_regular
from torchid.text import shown

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
        InputError: the file is damaged or none of ours.
    """
    path = folder / CHECKPOINT
    with damage_refused(folder):
        _check_archive(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of pickles that are not torch's, which it then refuses
            state = torch.load(path, weights_only=True)
        _check_values(state)
    if not isinstance(state, dict):
        raise InputError(path, "file", f"holds a {type(state).__name__}", "a checkpoint that torchid wrote")
    return state


def check_alike(found: Any, expected: Any, place: str = "state") -> None:
    """Compare the state of a checkpoint with that of a trainer that has not begun: what it is made of, not its values.

    A mapping that is empty in `expected`, an optimizer's state before its first step, may hold mappings.

    Raises:
        ValueError: something else stands in some place.
    """
    if isinstance(expected, torch.Tensor):
        alike = isinstance(found, torch.Tensor) and (found.shape, found.dtype) == (expected.shape, expected.dtype)
    elif isinstance(expected, (int, float)):
        alike = isinstance(found, (int, float)) and found == found
    else:
        alike = isinstance(found, type(expected))
    if alike and expected == {}:
        alike = all(isinstance(value, dict) for value in found.values())
    if not alike:
        raise ValueError(f"{place} is of another kind")
    if isinstance(expected, dict) and expected:
        for key in expected:
            check_alike(found.get(key), expected[key], f"{place}.{key}")
    elif isinstance(expected, (list, tuple)) and expected:
        if len(found) != len(expected):
            raise ValueError(f"{place} is of another length")
        for index, (one, other) in enumerate(zip(found, expected, strict=True)):
            check_alike(one, other, f"{place}.{index}")


@contextmanager
def damage_refused(folder: Path) -> Iterator[None]:
    """Turn whatever reading a checkpoint or taking up its state raises into one line that names the file.

    Raises:
        InputError: a checkpoint whose parts are not what they should be.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # noqa: B902 - an unpickler, torch and its optimizers raise what they like
        found = f"not readable ({shown(str(error) or type(error).__name__, 200)})"
        raise InputError(folder / CHECKPOINT, "file", found, "a checkpoint that torchid wrote") from error


def _check_archive(path: Path) -> None:
    """Compare what was written with its checksums, which `torch.load` does not look at; nothing may have to unfold."""
    check_regular(path)
    with zipfile.ZipFile(path) as file:
        entries = file.infolist()
        if len(entries) > MAX_STATE or any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise zipfile.BadZipFile("compressed, or of too many parts")
        if any(entry.filename.endswith("constants.pkl") for entry in entries):
            raise zipfile.BadZipFile("a programme of torch.jit")
        damaged = file.testzip()
    if damaged is not None:
        raise zipfile.BadZipFile(f"damaged in {damaged}")


def _check_values(state: object) -> None:
    """Refuse tensors that are larger than what is stored of them, settings that would unfold, and endless nesting."""
    left, seen = [state], 0
    while left:
        value, seen = left.pop(), seen + 1
        if seen > MAX_STATE:
            raise ValueError(f"more than {MAX_STATE} values")
        if isinstance(value, dict):
            left += [*value.keys(), *value.values()]
        elif isinstance(value, (list, tuple)):
            left += value
        elif isinstance(value, torch.Tensor) and not _is_stored(value):
            raise ValueError(f"a tensor of shape {tuple(value.shape)} that is not stored as such")
    if isinstance(state, dict) and isinstance(state.get("config"), str):
        check_yaml(state["config"])


def _is_stored(tensor: torch.Tensor) -> bool:
    """Whether every number of it is in the file."""
    size = tensor.numel() * tensor.element_size()
    return tensor.layout == torch.strided and not tensor.is_meta and size <= tensor.untyped_storage().nbytes()
