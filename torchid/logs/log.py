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
    """A recording of N samples of n joints and C contacts; None marks a quantity that was not recorded.

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
    noise_bandwidth_hz: float | None = None

    def __post_init__(self) -> None:
        """Check shapes and types."""
        check_shape(self.source, "time", self.time, SHAPES["time"], {})
        sizes = {"N": len(self.time), "n": len(self.joint_names), "C": len(self.contact_names)}
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

    def arrays(self) -> dict[str, FloatArray | BoolArray]:
        """Every array that is present and has the sample axis first, by field name."""
        present = {name: getattr(self, name) for name in SHAPES if name not in NAMES}
        return {name: array for name, array in present.items() if array is not None}

    def select(self, index: slice | NDArray[np.intp] | BoolArray) -> Log:
        """The log of the chosen samples: a slice (no data is copied), sample numbers (M,) or a mask (N,)."""
        chosen: dict[str, Any] = {name: array[index] for name, array in self.arrays().items()}
        return dataclasses.replace(self, **chosen)
