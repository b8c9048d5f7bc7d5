"""Angles that jump by a whole turn, of encoders that count within one: nothing can be derived of them."""

from __future__ import annotations

import numpy as np

from torchid.errors import LogError, format_count, join_names
from torchid.logs.log import Log

_TOLERANCE_TURNS = 0.05  # of a jump, which contains a step of the motion
_LARGEST_STEP = 0.5  # [rad] of the motion on either side


def require_no_turns(log: Log) -> None:
    """Refuse joint positions [rad] that jump by whole turns from one sample to the next, between small steps.

    Raises:
        LogError: names the joints.
    """
    steps = np.diff(log.joint_position, axis=0)
    turns = np.rint(steps / (2.0 * np.pi))
    with np.errstate(invalid="ignore"):
        jumps = (turns != 0.0) & (np.abs(steps / (2.0 * np.pi) - turns) < _TOLERANCE_TURNS)
    if not jumps.any():
        return
    small = np.pad(np.abs(steps) < _LARGEST_STEP, ((1, 1), (0, 0)), constant_values=True)
    jumps &= small[:-2] & small[2:]
    joints = np.flatnonzero(jumps.any(axis=0))
    if not len(joints):
        return
    first = log.time[1 + int(jumps.any(axis=1).argmax())]
    names = join_names([log.joint_names[joint] for joint in joints])
    found = f"{names} jumps by a whole turn, {format_count(int(jumps.sum()), 'time')}, first at {first:.6g} s"
    accepted = "angles without jumps: logs.columns.joint_position.turn_from, or unwrap them"
    raise LogError(log.source, "joint_position", found, accepted)
