"""The log format: every field's name, shape and place in a `Log`. Nothing else spells these."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, UnknownNameError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Shape = tuple[str | int, ...]

#: Shape of every field that a `Log` holds, in the letters N samples, n joints, C contacts, F force/torque sensors.
SHAPES: dict[str, Shape] = {
    "time": ("N",),
    "joint_names": ("n",),
    "joint_position": ("N", "n"),
    "joint_velocity": ("N", "n"),
    "joint_acceleration": ("N", "n"),
    "joint_torque": ("N", "n"),
    "base_quat_xyzw": ("N", 4),
    "base_position_world": ("N", 3),
    "base_linear_velocity_world": ("N", 3),
    "base_angular_velocity_base": ("N", 3),
    "base_linear_acceleration_world": ("N", 3),
    "base_angular_acceleration_base": ("N", 3),
    "contact_names": ("C",),
    "contact_active": ("N", "C"),
    "contact_wrench_local": ("N", "C", 6),
    "contact_wrench_world": ("N", "C", 6),
    "ft_names": ("F",),
    "ft_wrench": ("N", "F", 6),
    "imu_frame": (),
    "imu_specific_force": ("N", 3),
    "imu_angular_velocity": ("N", 3),
    "imu_angular_acceleration": ("N", 3),
}

#: Fields a file may hold in place of a `Log`'s own: another quaternion order or another frame.
VARIANTS: dict[str, str] = {
    "base_quat_wxyz": "base_quat_xyzw",
    "base_linear_velocity_base": "base_linear_velocity_world",
    "base_angular_velocity_world": "base_angular_velocity_base",
    "base_linear_acceleration_base": "base_linear_acceleration_world",
    "base_angular_acceleration_world": "base_angular_acceleration_base",
}

REQUIRED = ("time", "joint_names", "joint_position")

#: Fields that name columns, and the letter of their number.
NAMES = {"joint_names": "n", "contact_names": "C", "ft_names": "F"}
WRENCHES = ("contact_wrench_local", "contact_wrench_world")

#: NaN marks "not measured here" in these fields and is an error in all others.
NAN_ALLOWED = ("joint_torque", *WRENCHES, "ft_wrench")

IMU = ("imu_frame", "imu_specific_force", "imu_angular_velocity")

#: Fields that mean nothing without others.
NEEDED: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("contact_active", *WRENCHES), ("contact_names", "contact_active")),
    "ft_wrench": ("ft_names",),
    **dict.fromkeys((*IMU, "imu_angular_acceleration"), IMU),
}

#: Pairs that say the same thing twice: a file gives at most one of each.
EXCLUSIVE = (*VARIANTS.items(), WRENCHES)


class UnknownFieldError(LogError, UnknownNameError):
    """A field of a log file that the log format does not know; the message lists the nearest that it knows."""


def shape_of(name: str) -> Shape:
    """Shape of a field of a file, a `Log`'s own or one in its place."""
    return SHAPES[VARIANTS.get(name, name)]


def is_quaternion(name: str) -> bool:
    """Whether the field `name` holds unit quaternions."""
    return name.startswith("base_quat")


def labels_of(name: str, names: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    """The names of the columns of the field `name`, or nothing where they are plain components.

    Args:
        name: the field.
        names: by `NAMES`.
    """
    of = f"{name.partition('_')[0]}_names"
    return names[of] if of in NAMES else ()
