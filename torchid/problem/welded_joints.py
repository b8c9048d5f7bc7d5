"""Columns of a log for joints that the experiment welds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from torchid.errors import warn
from torchid.logs import Log
from torchid.logs.log import SHAPES, FloatArray
from torchid.logs.time_range import log_title
from torchid.robot import Robot

_TOLERANCE = {"prismatic": (0.005, "m")}  # a joint that moves less is welded with small error
_TOLERANCE_OF_OTHERS = (0.05, "rad")


def without_welded_joints(log: Log, robot: Robot | None) -> Log:
    """The log without columns for welded joints.

    Warns:
        TorchidWarning: a joint that is not where it is welded.
    """
    if robot is None or robot.welded.keys().isdisjoint(log.joint_names):
        return log
    kept = [column for column, name in enumerate(log.joint_names) if name not in robot.welded]
    warn_of_moving_welds(log, robot, distances_from_welds(log, robot))
    arrays: dict[str, Any] = {
        name: array[:, kept] for name, array in log.arrays().items() if SHAPES[name] == ("N", "n")
    }
    return replace(log, joint_names=tuple(log.joint_names[column] for column in kept), **arrays)


def distances_from_welds(log: Log, robot: Robot) -> FloatArray:
    """Largest distance of the log's joints, (n,) [rad or m], from where they are welded; 0 for others."""
    held = np.array([robot.welded.get(name, np.nan) for name in log.joint_names])
    return np.nan_to_num(np.abs(log.joint_position - held)).max(axis=0, initial=0.0)


def warn_of_moving_welds(log: Log, robot: Robot, distances: FloatArray) -> None:
    """Warn, once, if joints of a log are not where they are welded, by `distances_from_welds`."""
    far = []
    for name, distance in zip(log.joint_names, distances, strict=True):
        limit, unit = _TOLERANCE.get(robot.kind_of_welded.get(name, ""), _TOLERANCE_OF_OTHERS)
        if distance > limit:
            far.append(f"'{name}' is up to {distance:.2g} {unit} away from {robot.welded[name]:g} {unit}")
    if far:
        text = "; ".join(far)
        warn(f"{log_title(log.source)}: joint {text}, where robot.weld holds it: welding is an approximation here")
