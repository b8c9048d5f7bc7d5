"""Write a log to a file in the log format."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.logs.container import save_arrays
from torchid.logs.kinds import Kind, kind_to_write
from torchid.logs.log import Log
from torchid.logs.table import save_table


def write_log(log: Log, path: str | os.PathLike[str]) -> None:
    """Write `log` to a .npz, .h5, .hdf5, .csv or .parquet file that `read_log` gives back unchanged.

    The file appears complete or not at all: it is written under a temporary name in its folder, then renamed.

    Raises:
        LogError: the extension is unknown or the file cannot be written.
    """
    save = save_table if kind_to_write(Path(path)) is Kind.TABLE else save_arrays
    arrays: dict[str, NDArray[Any]] = {
        name: array
        for name, array in log.arrays().items()
        if 0 not in array.shape[1:] or name == "joint_position"  # what there is none of needs no field
    }
    for name, names in log.names.items():
        if names or name == "joint_names":
            arrays[name] = np.array(names, dtype=np.str_)
    if log.imu_frame:
        arrays["imu_frame"] = np.array(log.imu_frame)
    save(Path(path), arrays)
