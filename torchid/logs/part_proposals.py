"""Arrays of a file that probably hold several fields side by side."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.logs.column_proposals import propose_field
from torchid.logs.column_samples import Columns

_UNIT = 1e-3  # of the length of quaternions from 1


def split_arrays(sample: Columns, names: Sequence[str], joints: Collection[int]) -> list[tuple[str, str, str]]:
    """Arrays that hold several fields side by side: their name, the columns and the field that these are.

    Those of simulators and of libraries for dynamics: a position of the base and a quaternion, whose length is 1
    throughout, with or without positions of joints behind; beside them velocities and forces, six of the base first.

    Args:
        sample: from `read_sample`.
        names: of arrays that may be.
        joints: how many there may be.
    """
    out, width = list[tuple[str, str, str]](), 0
    for name in names:
        array = np.asarray(sample[name])
        if not _has_pose(array):
            continue
        out += [(name, "[0:3]", "base_position_world"), (name, "[3:7]", "base_quat_wxyz")]
        if array.shape[1] - 7 in joints:
            out.append((name, "[7:]", "joint_position"))
            width = array.shape[1] - 7
        break
    for name in names if width else ():
        shape, field = np.asarray(sample[name]).shape, propose_field(name)
        if shape[1:] == (6 + width,) and field in ("joint_velocity", "joint_torque"):
            out.append((name, "[6:]", field))
    return out


def _has_pose(array: NDArray[Any]) -> bool:
    """Whether columns 3 to 6 of an array (N, k) are a quaternion."""
    if array.ndim != 2 or array.shape[1] < 7 or array.dtype.kind != "f" or len(array) < 3:
        return False
    length = np.linalg.norm(array[:, 3:7], axis=1)
    known = length[np.isfinite(length)]
    return bool(len(known)) and float(np.abs(known - 1.0).max()) < _UNIT
