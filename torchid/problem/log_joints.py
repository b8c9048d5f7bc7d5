"""A log's joints as the robot has them: torques in its order, with passive joints and without welded ones."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchid.errors import LogError, warn
from torchid.logs import Log
from torchid.logs.log import SHAPES, FloatArray
from torchid.logs.time_range import log_title
from torchid.robot import Robot
from torchid.sensing import SensorSet

_NO_TORQUE = 1e-9  # N m or N: what a simulator's log may have of a joint without a motor


def recorded_torques(log: Log, robot: Robot, order: list[int]) -> Tensor | None:
    """Joint torques and wrenches in limbs, (N, n + 6 F); None if neither was recorded nor follows from the robot."""
    if log.joint_torque is None and not (robot.ft_names and log.ft_wrench is not None) and not robot.passive:
        return None
    not_recorded = np.full((len(log), robot.n), np.nan)
    torque = not_recorded if log.joint_torque is None else columns_in_order(log.joint_torque, order)
    parts = [_with_passive(torque, log, robot) if robot.passive else torque]
    for name in robot.ft_names:
        if log.ft_wrench is None or name not in log.ft_names:
            parts.append(np.full((len(log), 6), np.nan))
        else:
            parts.append(log.ft_wrench[:, log.ft_names.index(name)])
    return torch.from_numpy(parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1))


def _with_passive(torque: FloatArray, log: Log, robot: Robot) -> FloatArray:
    """Joint torques (N, n) with zeros for joints without a motor; LogError if one of these was recorded as another."""
    passive = robot.is_passive[: robot.n]
    size = np.nanmax(np.abs(torque), axis=0, initial=0.0, where=np.isfinite(torque))
    for joint in np.flatnonzero(passive & (size > _NO_TORQUE)):
        name = robot.joint_names[joint]
        found = f"up to {size[joint]:.3g} N m of a joint without a motor"
        raise LogError(log.source, f"joint_torque '{name}'", found, f"0, NaN or none, or robot.passive without {name}")
    return np.where(passive, 0.0, torque)


def require_limb_sensors(log: Log, robot: Robot, required: SensorSet) -> None:
    """Refuse a log without the required force/torque sensors in limbs."""
    needed = required.torque[robot.n :].reshape(-1, 6)
    names = [name for name, axes in zip(robot.ft_names, needed, strict=True) if axes.any()]
    if names and log.ft_wrench is None:
        raise LogError(log.source, "ft_wrench", "missing", "the field, or sensors without ft_sensors")
    if missing := [name for name in names if name not in log.ft_names]:
        accepted = f"every name in sensors.ft_sensors; the log has {', '.join(log.ft_names)}"
        raise LogError(log.source, "ft_names", f"{', '.join(missing)} missing", accepted)


def columns_in_order(x: np.ndarray, order: list[int]) -> np.ndarray:
    """Some columns of an array, without a copy where they are all of them in order."""
    return x if order == list(range(x.shape[1])) else x[:, order]


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
