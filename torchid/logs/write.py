"""Write a log to a file in the log format."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.logs.container import save_arrays
from torchid.logs.log import Log


def write_log(log: Log, path: str | os.PathLike[str]) -> None:
    """Write `log` to a .npz, .h5 or .hdf5 file that `read_log` gives back unchanged.

    The file appears complete or not at all: it is written under a temporary name in its folder, then renamed.

    Raises:
        LogError: the extension is unknown or the file cannot be written.
    """
    arrays: dict[str, NDArray[Any]] = dict(log.arrays())
    for name, names in log.names.items():
        if names or name == "joint_names":
            arrays[name] = np.array(names, dtype=np.str_)
    if log.imu_frame:
        arrays["imu_frame"] = np.array(log.imu_frame)
    save_arrays(Path(path), arrays)
