"""The file of an unfinished training: written whole or not at all, and read without running any code in it."""

from __future__ import annotations

import hashlib
import io
import os
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch

from torchid.commands.folder import CHECKPOINT
from torchid.config.yaml_text import check_yaml
from torchid.errors import InputError, excerpt
from torchid.guards import MAX_STATE, check_regular

_ACCEPTED = "a checkpoint that torchid wrote"
_DIGEST = "digest"


def save_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Write a state of plain types and tensors, under a temporary name first, with a digest of its values.

    Raises:
        OSError: names the file, if the disk is full or cannot be written.
    """
    temporary, path, content = folder / f".{CHECKPOINT}", folder / CHECKPOINT, io.BytesIO()
    torch.save(state | {_DIGEST: _digest(state)}, content)  # not to the file: torch hides why that cannot be written
    try:
        with temporary.open("wb") as file:
            file.write(content.getbuffer())
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from error


def load_checkpoint(folder: Path) -> dict[str, Any]:
    """The state that `save_checkpoint` wrote; no code in the file is run.

    Raises:
        InputError: the file is damaged, was changed by others than `save_checkpoint`, or is none of ours.
    """
    path = folder / CHECKPOINT
    with refusing_damage(folder):
        _check_archive(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of pickles that are not torch's, which it then refuses
            state = torch.load(path, weights_only=True)
        _check_values(state)
    if not isinstance(state, dict):
        raise InputError(path, "file", f"holds a {type(state).__name__}", _ACCEPTED)
    if state.pop(_DIGEST, None) != _digest(state):
        raise InputError(path, "file", "not the values that were written, by their digest", _ACCEPTED)
    return state


@contextmanager
def refusing_damage(folder: Path) -> Iterator[None]:
    """Turn whatever reading a checkpoint or taking up its state raises into one line that names the file.

    Raises:
        InputError: a checkpoint whose parts are not what they should be.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # noqa: B902 - an unpickler, torch and its optimizers raise what they like
        found = f"not readable ({excerpt(str(error) or type(error).__name__, 200)})"
        raise InputError(folder / CHECKPOINT, "file", found, _ACCEPTED) from error


def _digest(value: Any) -> str:
    """Of all values in a state, with their types and their order."""
    digest, left = hashlib.sha256(), [value]
    while left:
        value = left.pop()
        digest.update(type(value).__name__.encode())
        if isinstance(value, torch.Tensor):
            digest.update(f"{value.dtype}{tuple(value.shape)}".encode())
            flat = value.detach().cpu().flatten().clone(memory_format=torch.contiguous_format)  # one number: stride 0
            digest.update(flat.view(torch.uint8).numpy().tobytes())
        elif isinstance(value, dict):
            digest.update(f"{len(value)}".encode())
            left += [x for pair in value.items() for x in pair]
        elif isinstance(value, (list, tuple)):
            digest.update(f"{len(value)}".encode())
            left += value
        else:
            digest.update(f"{value!r};".encode())
    return digest.hexdigest()


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
    left, count = [state], 0
    while left:
        value, count = left.pop(), count + 1
        if count > MAX_STATE:
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
