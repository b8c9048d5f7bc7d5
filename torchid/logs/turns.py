"""Angles that jump by a whole turn, of encoders that count within one: nothing can be derived of them."""

from __future__ import annotations

import numpy as np

from torchid.errors import LogError, format_count, join_names
from torchid.logs.log import Log

_TOLERANCE_TURNS = 0.05  # of a jump, which contains a step of the motion
_LARGEST_STEP = 0.5  # [rad] of the motion on either side


def require_no_turns(log: Log) -> None:
    """Refuse joint positions [rad] that jump by a turn from one sample to the next, between small steps.

    Raises:
        LogError: names the joints.
    """
    steps = np.diff(log.joint_position, axis=0)
    with np.errstate(invalid="ignore"):
        jumps = np.abs(np.abs(steps) / (2.0 * np.pi) - 1.0) < _TOLERANCE_TURNS
        if not jumps.any():
            return
        is_small = np.abs(steps) < _LARGEST_STEP
    around = np.pad(is_small, ((1, 1), (0, 0)), constant_values=True)
    jumps &= around[:-2] & around[2:]
    jumps &= (jumps | is_small).all(axis=1, keepdims=True)  # where others jump by other amounts, all is another unit's
    joints = np.flatnonzero(jumps.any(axis=0))
    if not len(joints):
        return
    first = log.time[1 + int(jumps.any(axis=1).argmax())]
    names = join_names([log.joint_names[joint] for joint in joints])
    found = f"{names} jumps by a whole turn, {format_count(int(jumps.sum()), 'time')}, first at {first:.6g} s"
    accepted = "angles without jumps: logs.columns.joint_position.turn_from, or unwrap them"
    raise LogError(log.source, "joint_position", found, accepted)
