"""The log format: every field's name, shape and place in a `Log`. Nothing else spells these."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Shape = tuple[str | int, ...]

#: Shape of every field that a `Log` holds, in the letters N samples, n joints, C contacts.
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
NAMES = ("joint_names", "contact_names")
WRENCHES = ("contact_wrench_local", "contact_wrench_world")

#: NaN marks "not measured here" in these fields and is an error in all others.
NAN_ALLOWED = ("joint_torque", *WRENCHES)

#: Pairs that say the same thing twice: a file gives at most one of each.
EXCLUSIVE = (*VARIANTS.items(), WRENCHES)

#: Names of the format that are not read yet.
UNSUPPORTED = ("imu_specific_force", "imu_angular_velocity", "imu_frame", "ft_names", "ft_wrench")


def is_quaternion(name: str) -> bool:
    """Whether the field `name` holds unit quaternions."""
    return name.startswith("base_quat")


def labels_of(name: str, joint_names: tuple[str, ...], contact_names: tuple[str, ...]) -> tuple[str, ...]:
    """The names of the columns of the field `name`, or nothing where they are plain components."""
    if name.startswith("joint_"):
        return joint_names
    return contact_names if name.startswith("contact_") else ()
