"""One recording in memory, in the frames and orders that the rest of torchid uses."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError
from torchid.logs.checks import check_shape
from torchid.logs.fields import NAMES, SHAPES, WRENCHES, BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class Log:
    """A recording of N samples of n joints, C contacts and F force/torque sensors; None marks what was not recorded.

    Shapes and types are checked on construction, values are not (`read_log` does).

    Attributes:
        source: file name, for messages.
        time: (N,) [s], strictly increasing.
        joint_names: n names; the joints' order is the file's.
        joint_position: (N, n) [rad or m].
        joint_velocity: (N, n) [rad/s or m/s].
        joint_acceleration: (N, n) [rad/s^2 or m/s^2].
        joint_torque: (N, n) [N m or N], NaN where not measured.
        base_quat_xyzw: (N, 4) unit quaternions without sign flips, rotating base to world.
        base_position_world: (N, 3) [m], the base link's origin.
        base_linear_velocity_world: (N, 3) [m/s] of the base origin.
        base_angular_velocity_base: (N, 3) [rad/s].
        base_linear_acceleration_world: (N, 3) [m/s^2], d/dt of the origin's world velocity, without gravity.
        base_angular_acceleration_base: (N, 3) [rad/s^2].
        contact_names: C frame names.
        contact_active: (N, C) bool.
        contact_wrench_local: (N, C, 6) [N, N m] on the robot at the contact frame's origin, in that frame's axes;
            NaN where not measured.
        contact_wrench_world: as `contact_wrench_local` but in world axes; at most one of the two is given.
        ft_names: F names of fixed joints with a force/torque sensor.
        ft_wrench: (N, F, 6) [N, N m] that the parent side exerts on the child side, in the joint's child frame; NaN
            where not measured.
        imu_frame: frame of the URDF, on the base body, whose specific force and angular velocity an IMU gives.
        imu_specific_force: (N, 3) [m/s^2], acceleration of the frame's origin minus gravity, in that frame.
        imu_angular_velocity: (N, 3) [rad/s], in that frame.
        imu_angular_acceleration: (N, 3) [rad/s^2], in that frame.
        contact_share: (N, C), what the filter makes of a reading that is 1 while the contact is active and 0 else; None
            in a log that was not filtered, where it is `contact_active`. No part of a file.
        contact_unloaded: (N, C, 6), as recorded even in a filtered log: what the sensors read in the air, NaN
            elsewhere (see `unloaded_readings`); None where `preprocess` found no such sample. No part of a file.
        noise_bandwidth_hz: [Hz], up to where `preprocess` has left the sensors' noise white; None if it did not filter.
            No part of a file.

    Raises:
        LogError: a field has a wrong shape or type, or both contact wrenches are given.
    """

    source: str
    time: FloatArray
    joint_names: tuple[str, ...]
    joint_position: FloatArray
    joint_velocity: FloatArray | None = None
    joint_acceleration: FloatArray | None = None
    joint_torque: FloatArray | None = None
    base_quat_xyzw: FloatArray | None = None
    base_position_world: FloatArray | None = None
    base_linear_velocity_world: FloatArray | None = None
    base_angular_velocity_base: FloatArray | None = None
    base_linear_acceleration_world: FloatArray | None = None
    base_angular_acceleration_base: FloatArray | None = None
    contact_names: tuple[str, ...] = ()
    contact_active: BoolArray | None = None
    contact_wrench_local: FloatArray | None = None
    contact_wrench_world: FloatArray | None = None
    ft_names: tuple[str, ...] = ()
    ft_wrench: FloatArray | None = None
    imu_frame: str = ""
    imu_specific_force: FloatArray | None = None
    imu_angular_velocity: FloatArray | None = None
    imu_angular_acceleration: FloatArray | None = None
    contact_share: FloatArray | None = None
    contact_unloaded: FloatArray | None = None
    noise_bandwidth_hz: float | None = None

    def __post_init__(self) -> None:
        """Check shapes and types."""
        check_shape(self.source, "time", self.time, SHAPES["time"], {})
        sizes = {"N": len(self.time)} | {NAMES[name]: len(labels) for name, labels in self.names.items()}
        for name, array in self.arrays().items():
            check_shape(self.source, name, array, SHAPES[name], sizes)
            wanted = np.dtype(np.bool_ if name == "contact_active" else np.float64)
            if array.dtype != wanted:
                raise LogError(self.source, name, f"values of type {array.dtype}", str(wanted))
        if all(getattr(self, name) is not None for name in WRENCHES):
            raise LogError(self.source, WRENCHES[1], f"given together with {WRENCHES[0]}", "one of the two")

    def __len__(self) -> int:
        """Number of samples N."""
        return len(self.time)

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """Names of joints, contacts and force/torque sensors, by field."""
        return {name: getattr(self, name) for name in NAMES}

    def arrays(self) -> dict[str, FloatArray | BoolArray]:
        """Every array of the file format that is present and has the sample axis first, by field name."""
        present = {name: getattr(self, name) for name, shape in SHAPES.items() if shape[:1] == ("N",)}
        return {name: array for name, array in present.items() if array is not None}

    def select(self, index: slice | NDArray[np.intp] | BoolArray) -> Log:
        """The log of the chosen samples: a slice (no data is copied), sample numbers (M,) or a mask (N,)."""
        chosen: dict[str, Any] = {name: array[index] for name, array in self.arrays().items()}
        for name in ("contact_share", "contact_unloaded"):
            if (array := getattr(self, name)) is not None:
                chosen[name] = array[index]
        return dataclasses.replace(self, **chosen)
