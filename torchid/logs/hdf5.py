"""HDF5 files (the only module that imports h5py): declared sizes and arrays."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, how_to_install
from torchid.guards import MAX_DATASETS, check_fields, check_names
from torchid.logs.lazy_arrays import LazyArray

_HEADER_BYTES = 4096  # of an array, in a file
_NUMBER = re.compile(r"\d+")
_DEPTH = 8  # of groups in groups
_OF_MATLAB = ("#refs#", "#subsystem#")  # what cells and objects of its files refer to


class Hdf5:
    """The datasets of an open file; links to other files are not followed."""

    def __init__(self, file: Any, h5py: Any) -> None:
        self._file, self._h5py = file, h5py

    def declared_bytes(self) -> dict[str, int]:
        """Declared bytes of each array, by name."""
        return {name: self._size(name) for name in self._names()}

    def _names(self) -> list[str]:
        """All names, `group/name` of what is in groups of the file itself; a group that holds nothing is a name too.

        ValueError where there are more than a log may have, as those of a group that contains itself; arrays of groups
        that differ in numbers, such as episodes, count once.
        """
        names, count, groups = list[str](), 0, [("", self._file)]
        for prefix, group in groups:
            count += len(group)
            if count > MAX_DATASETS:
                raise ValueError(f"{count} arrays and groups, more than the {MAX_DATASETS} that a log may have")
            for name in group if prefix else [name for name in group if name not in _OF_MATLAB]:
                inner = group[name] if isinstance(group.get(name, getlink=True), self._h5py.HardLink) else None
                if isinstance(inner, self._h5py.Group) and len(inner) and prefix.count("/") < _DEPTH:
                    groups.append((f"{prefix}{name}/", inner))
                else:
                    names.append(f"{prefix}{name}")
        check_fields(names, len({_NUMBER.sub("", os.path.dirname(name)) + os.path.basename(name) for name in names}))
        return names

    def load(self, name: str) -> NDArray[Any]:
        """The array `name`; text is an array of UTF-8 bytes."""
        item = self._stored_dataset(name)
        text = self._h5py.check_string_dtype(item.dtype)
        if text is not None:
            check_names(item.shape, text.length or 0)
            # as bytes: h5py decodes fixed-width text as ASCII
            return np.asarray(item[()]) if text.length else self._texts(item)
        if item.dtype.hasobject:  # references or ragged rows, which the checks of fields refuse
            return np.broadcast_to(np.array(None, dtype=object), item.shape)
        return np.asarray(item[()])

    def lazy(self, name: str, folder: Path | None) -> LazyArray:
        """The array `name`, read where it is sliced."""
        item = self._stored_dataset(name)
        return np.asarray(self.load(name)) if item.dtype.hasobject or not item.shape else item

    def _stored_dataset(self, name: str) -> Any:
        """The dataset `name`; TypeError where it has no values in this file."""
        item = self._dataset(name)
        if item is None or item.shape is None or item.is_virtual or item.external is not None:
            raise TypeError("not a dataset with values in this file")
        return item

    def _texts(self, item: Any) -> NDArray[Any]:
        """Texts of variable length, read one by one: many elements may refer to the same large text."""
        texts = []
        for index in np.ndindex(item.shape):
            texts.append(item[index])
            check_names((), len(texts[-1]))
        return np.array(texts, dtype=np.bytes_).reshape(item.shape)

    def _size(self, name: str) -> int:
        """Declared bytes of a dataset."""
        item = self._dataset(name)
        return 0 if item is None or item.shape is None else int(item.dtype.itemsize) * math.prod(item.shape)

    def _dataset(self, name: str) -> Any:
        """The dataset `name` of the file itself, None where there is none."""
        item = self._file[name] if isinstance(self._file.get(name, getlink=True), self._h5py.HardLink) else None
        return item if isinstance(item, self._h5py.Dataset) else None


def import_h5py(path: Path) -> Any:
    """The module h5py; LogError where it is not installed."""
    try:
        import h5py
    except ImportError as error:
        accepted = f"a .npz file, or {how_to_install('hdf5')}"
        raise LogError(path, "file", "HDF5, but h5py is not installed", accepted) from error
    return h5py


def save_hdf5(h5py: Any, path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays to a new file.

    Raises:
        OSError: the disk is full. The room is taken up first: the HDF5 library crashes where a disk fills up.
    """
    size = sum(array.nbytes for array in arrays.values()) + _HEADER_BYTES * len(arrays)
    with path.open("xb") as stream:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(stream.fileno(), 0, size)
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            if array.dtype.kind == "U":
                file.create_dataset(name, data=array.astype(object), dtype=h5py.string_dtype())
            else:
                file.create_dataset(name, data=array)
