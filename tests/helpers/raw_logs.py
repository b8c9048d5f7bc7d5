"""Log files of raw arrays, valid or not, and refusals to read one."""

from __future__ import annotations

import builtins
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from refusals import refused

from torchid import reader
from torchid.errors import LogError
from torchid.logs import read_log


def write_arrays(path: Path, values: Mapping[str, Any]) -> Path:
    """An archive of arrays as they are, `.npz` or HDF5."""
    if path.suffix == ".npz":
        np.savez(path, **values)
        return path
    with h5py.File(path, "w") as file:
        for name, value in values.items():
            array = np.asarray(value)
            file[name] = np.char.encode(array) if array.dtype.kind == "U" else array
    return path


def log_refusal(path: Path) -> str:
    """The one line, of a length to be read, that reading a log fails with."""
    message = refused(lambda: read_log(path), f"{path}: ", LogError)
    assert len(message) < 600
    return message


def without_package(package: str, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """As if a package were not installed, here and in processes that read; `folder`: an empty one."""
    (folder / f"{package}.py").write_text(f"raise ImportError(name={package!r})")
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr(reader, "_idle", [])
    load = builtins.__import__

    def absent(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith(package):
            raise ImportError(name, name=package)
        return load(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", absent)
