"""The log format: name, shape and checks of every field; a recording in memory."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, UnknownNameError, about_file
from torchid.parameters import WRENCH_COMPONENTS
from torchid.reprs import short_repr

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
FieldShape = tuple[str | int, ...]

#: Shape of every field of a `Log`, and of `POINTS`: N samples, n joints, C contacts, F force/torque sensors.
SHAPES: dict[str, FieldShape] = {
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
    "contact_wrench_point_world": ("N", "C", 3),
    "contact_normal_world": ("N", "C", 3),
    "contact_force_normal": ("N", "C"),
    "ft_names": ("F",),
    "ft_wrench": ("N", "F", 6),
    "imu_frame": (),
    "imu_specific_force": ("N", 3),
    "imu_angular_velocity": ("N", 3),
    "imu_angular_acceleration": ("N", 3),
}

#: Fields of a file that are converted to those of a `Log`: another quaternion order or another frame.
VARIANTS: dict[str, str] = {
    "base_quat_wxyz": "base_quat_xyzw",
    "base_linear_velocity_base": "base_linear_velocity_world",
    "base_angular_velocity_world": "base_angular_velocity_base",
    "base_linear_acceleration_base": "base_linear_acceleration_world",
    "base_angular_acceleration_world": "base_angular_acceleration_base",
}

REQUIRED = ("time", "joint_names", "joint_position")

#: Fields that name columns, and the letter of their number.
NAME_FIELDS = {"joint_names": "n", "contact_names": "C", "ft_names": "F"}
WRENCHES = ("contact_wrench_local", "contact_wrench_world")
NORMALS = "contact_normal_world"
POINTS = "contact_wrench_point_world"  # of a file alone, see `about_world_origin`
FLAGS = "contact_active"
FORCE_NORMAL = "contact_force_normal"
TEXT_FIELD = "imu_frame"  # the one field that is text, the same in every row of a table

#: Readings of sensors at contacts: 0, whatever was recorded, where nothing touches.
CONTACT_READINGS = (*WRENCHES, FORCE_NORMAL)

#: NaN marks "not measured here" in these fields and is an error in all others.
NAN_ALLOWED = ("joint_torque", *CONTACT_READINGS, "ft_wrench")

IMU_FIELDS = ("imu_frame", "imu_specific_force", "imu_angular_velocity")

#: Fields that a field requires.
REQUIRED_WITH: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("contact_active", *CONTACT_READINGS, NORMALS), ("contact_names", "contact_active")),
    POINTS: (WRENCHES[1],),
    "ft_wrench": ("ft_names",),
    **dict.fromkeys((*IMU_FIELDS, "imu_angular_acceleration"), IMU_FIELDS),
}

#: Pairs with the same content: a file may have only one of each.
EXCLUSIVE = (*VARIANTS.items(), WRENCHES)


@dataclass(frozen=True)
class SignalNoise:
    """White noise of the recorded motion of a log, in every sample.

    Attributes:
        std: standard deviation of each channel of the recorded fields, (c,), 0 where it shows none; of the orientation
            along the base's axes, (3,) [rad].
        derivatives: (3, 3), covariance of a preprocessed channel of unit noise [1] and its first two derivatives [1/s,
            1/s^2] where they are derived from it.
    """

    std: Mapping[str, FloatArray]
    derivatives: FloatArray = field(default_factory=lambda: np.diag([1.0, 0.0, 0.0]))

    @property
    def found(self) -> bool:
        """Whether any noise was found."""
        return any(bool(x.any()) for x in self.std.values())


@dataclass(frozen=True, eq=False)
class Log:
    """A recording of N samples of n joints, C contacts and F force/torque sensors; None marks what was not recorded.

    Shapes and types are checked on construction, values are not (`read_log` does).

    Attributes:
        source: file name, for messages.
        time: (N,) [s], strictly increasing.
        joint_names: n names in the order of the file.
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
        moments_about_world_origin: whether moments of `contact_wrench_world` are about the world's origin instead of
            the contact frames' origins.
        contact_normal_world: (N, C, 3) unit vectors away from the ground under a contact that rolls or is read along
            them; any values, NaN too, while it is in the air.
        contact_force_normal: (N, C) [N] on the robot along the ground's normal, as a scalar sensor in a foot or an
            insole reads it; NaN where not measured.
        ft_names: F names of fixed joints with a force/torque sensor.
        ft_wrench: (N, F, 6) [N, N m] that the parent side exerts on the child side, in the joint's child frame; NaN
            where not measured.
        imu_frame: frame of the URDF, on the base body, whose specific force and angular velocity an IMU gives.
        imu_specific_force: (N, 3) [m/s^2], acceleration of the frame's origin minus gravity, in that frame.
        imu_angular_velocity: (N, 3) [rad/s], in that frame.
        imu_angular_acceleration: (N, 3) [rad/s^2], in that frame.
        joint_direction: (N, n), what the filter makes of the sign of the joint velocities; None in a log that was not
            filtered, where it is that sign. No part of a file.
        joint_stribeck: (N, n), what the filter makes of sign(v) exp(-(v / v_s)^2) of the joint velocities v with a
            Stribeck velocity v_s; None without one, and in a log that was not filtered. No part of a file.
        joint_rests: (N, n), whether a joint is at rest or a filter's reach from it, where friction is any that holds it
            (see `torchid.logs.rest`); None where `preprocess` was not asked for it. No part of a file.
        contact_share: (N, C), what the filter makes of a reading that is 1 while the contact is active and 0 else; None
            in a log that was not filtered, where it is `contact_active`. No part of a file.
        contact_unloaded: (N, C, 6), or (N, C, 7) with `contact_force_normal`, as recorded even in a filtered log: what
            the sensors read in the air, NaN elsewhere (see `unloaded_readings`); None where `preprocess` found no such
            sample. No part of a file.
        noise_bandwidth_hz: [Hz], up to where `preprocess` has left the sensors' noise white; None if it did not filter.
            No part of a file.
        noise_share: of the variance of white noise in the readings, which `preprocess` has left; None if it did not
            filter. No part of a file.
        motion_noise: noise of the recorded motion, as `preprocess` found it; None if there was nothing to preprocess
            and none. No part of a file.

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
    moments_about_world_origin: bool = False
    contact_normal_world: FloatArray | None = None
    contact_force_normal: FloatArray | None = None
    ft_names: tuple[str, ...] = ()
    ft_wrench: FloatArray | None = None
    imu_frame: str = ""
    imu_specific_force: FloatArray | None = None
    imu_angular_velocity: FloatArray | None = None
    imu_angular_acceleration: FloatArray | None = None
    joint_direction: FloatArray | None = None
    contact_share: FloatArray | None = None
    contact_unloaded: FloatArray | None = None
    noise_bandwidth_hz: float | None = None
    motion_noise: SignalNoise | None = None
    joint_stribeck: FloatArray | None = None
    noise_share: float | None = None
    joint_rests: BoolArray | None = None

    __repr__ = short_repr

    def _headline(self) -> str:
        seconds = float(self.time[-1] - self.time[0]) if len(self) else 0.0
        return f"{self.source}, {len(self)} samples in {seconds:.4g} s, in SI units"

    def __post_init__(self) -> None:
        with about_file(self.source):
            self._check()

    def _check(self) -> None:
        check_shape("time", self.time, SHAPES["time"], {})
        sizes = {"N": len(self.time)} | {NAME_FIELDS[name]: len(labels) for name, labels in self.names.items()}
        for name, array in self.arrays().items():
            check_shape(name, array, SHAPES[name], sizes)
            accepted = np.dtype(np.bool_ if name == "contact_active" else np.float64)
            if array.dtype != accepted:
                raise LogError.at_field(name, f"values of type {array.dtype}", str(accepted))
            if min(array.strides, default=0) < 0:
                object.__setattr__(self, name, array.copy())  # torch takes no reversed view
        if all(getattr(self, name) is not None for name in WRENCHES):
            raise LogError.at_field(WRENCHES[1], f"given together with {WRENCHES[0]}", "one of the two")

    def __len__(self) -> int:
        return len(self.time)

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """Names of joints, contacts and force/torque sensors, by field."""
        return {name: getattr(self, name) for name in NAME_FIELDS}

    @property
    def contact_wrench_field(self) -> str:
        """Name of the field that holds, or would hold, the contact wrenches."""
        return WRENCHES[0] if self.contact_wrench_world is None else WRENCHES[1]

    @property
    def contact_wrench(self) -> FloatArray | None:
        """Contact wrenches (N, C, 6) [N, N m] along their recorded axes; None if not recorded."""
        return self.contact_wrench_local if self.contact_wrench_world is None else self.contact_wrench_world

    def arrays(self) -> dict[str, FloatArray | BoolArray]:
        """Every array of the file format that is present and has the sample axis first, by field name."""
        of_samples = (name for name, shape in SHAPES.items() if shape[:1] == ("N",) and name != POINTS)
        present = {name: getattr(self, name) for name in of_samples}
        return {name: array for name, array in present.items() if array is not None}

    def select(self, index: slice | NDArray[np.intp] | BoolArray) -> Log:
        """The log of the chosen samples: a slice (no data is copied), sample numbers (M,) or a mask (N,)."""
        chosen: dict[str, Any] = {name: array[index] for name, array in self.arrays().items()}
        for name in ("joint_direction", "joint_stribeck", "joint_rests", "contact_share", "contact_unloaded"):
            if (array := getattr(self, name)) is not None:
                chosen[name] = array[index]
        return dataclasses.replace(self, **chosen)


# ----------------------------------------------------------------------------------------------------- checks of fields


class UnknownFieldError(LogError, UnknownNameError):
    """An unknown field of a log file; the message lists similar known fields."""


def field_shape(name: str) -> FieldShape:
    """Shape of a field of a file, variants included."""
    return SHAPES[VARIANTS.get(name, name)]


def is_quaternion(name: str) -> bool:
    """Whether the field `name` holds unit quaternions."""
    return name.startswith("base_quat")


def column_labels(name: str, names: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    """Names of the columns of the field `name`; empty for fields without named columns; `names`: by `NAME_FIELDS`."""
    names_field = f"{name.partition('_')[0]}_names"
    return names[names_field] if names_field in NAME_FIELDS else ()


#: Deviation of the norm of a quaternion or a normal from 1 up to which it is normalised.
NORM_TOLERANCE = 1e-3
#: Deviation of the norm of a normalised quaternion from 1.
ROUNDING = 4.0 * np.finfo(np.float64).eps
#: Size of a value in any unit: products of several stay within the range of float64.
LARGEST = 1e30


def check_shape(name: str, array: NDArray[Any], letters: FieldShape, sizes: Mapping[str, int]) -> None:
    """Raise LogError unless `array` has the shape `letters`, whose known sizes are `sizes`."""
    expected = [sizes.get(letter, letter) if isinstance(letter, str) else letter for letter in letters]
    fits = array.ndim == len(expected) and all(
        isinstance(size, str) or size == actual for size, actual in zip(expected, array.shape, strict=True)
    )
    if not fits:
        named, sized = (f"({', '.join(map(str, shape))})" for shape in (letters, expected))
        accepted = named if named == sized else f"{named} = {sized}"
        raise LogError.at_field(name, f"shape {array.shape}", f"shape {accepted}")


def to_float64(name: str, array: NDArray[Any]) -> FloatArray:
    """The array as float64 (itself where it is already), LogError unless it holds real numbers."""
    if array.dtype.kind not in "fiu":
        raise LogError.at_field(name, f"values of type {array.dtype}", "real numbers")
    with np.errstate(over="ignore"):  # a longdouble too large becomes inf, which check_finite reports
        return np.asarray(array, dtype=np.float64)


def describe_element(
    index: tuple[int, ...], labels: tuple[str, ...], components: Sequence[str] = WRENCH_COMPONENTS
) -> str:
    """An element of a field as text: sample and, if any, channel.

    Args:
        index: sample number, column, wrench component; as many as the field has axes.
        labels: names of the columns, empty where they have none.
        components: names of what the last of three axes has.
    """
    words = f"sample {index[0]}"
    if len(index) > 1:
        words += f", {labels[index[1]] if labels else f'component {index[1]}'}"
    return words + (f" {components[index[2]]}" if len(index) > 2 else "")


def check_finite(name: str, values: FloatArray, *, allow_nan: bool = False, labels: tuple[str, ...] = ()) -> None:
    """Raise LogError at the first value beyond `LARGEST`, infinite or, unless `allow_nan`, NaN."""
    bad = (values > LARGEST) | (values < -LARGEST)
    if not allow_nan:
        bad |= np.isnan(values)
    if bad.any():
        index = tuple(int(i) for i in np.unravel_index(np.argmax(bad), bad.shape))
        accepted = f"numbers of at most {LARGEST:g}" if np.isfinite(values[index]) else "finite numbers"
        accepted += ", or NaN for missing values" if allow_nan else ""
        where = describe_element(index, labels, "xyz" if name in (NORMALS, POINTS) else WRENCH_COMPONENTS)
        raise LogError.at_field(name, f"{values[index]} at {where}", accepted)


def check_time(time: FloatArray) -> None:
    """Raise LogError unless `time` (N,) [s] has samples, is finite and increases strictly."""
    if not len(time):
        raise LogError.at_field("time", "no samples", "at least one sample")
    check_finite("time", time)
    not_increasing = time[1:] <= time[:-1]
    if not_increasing.any():
        i = int(np.argmax(not_increasing))
        reason = f"{time[i + 1]} at sample {i + 1}, after {time[i]} at sample {i}"
        several = "; for several recordings (episodes) add [#0] or [#0:8] to the file name"
        coarse = "; for a constant step set logs.columns.time: {step: ...}"
        accepted = "strictly increasing seconds" + (several if time[i + 1] < time[i] else coarse)
        raise LogError.at_field("time", reason, accepted)


def parse_time(array: NDArray[Any]) -> FloatArray:
    """The array of stamps (N,) [s] as float64, LogError unless it holds numbers that increase strictly."""
    check_shape("time", array, SHAPES["time"], {})
    time = to_float64("time", array)
    check_time(time)
    return time


def normalize_quaternions(name: str, quat: FloatArray, allow_nan: bool = False) -> FloatArray:
    """The quaternions (N, 4) with a norm of exactly one, LogError at the first whose norm is not one.

    With `allow_nan`, quaternions with a NaN component become NaN.
    """
    check_finite(name, quat, allow_nan=allow_nan)
    with np.errstate(over="ignore"):  # an infinite norm is refused below
        norm = np.linalg.norm(quat, axis=1)
    bad = ~((np.abs(norm - 1.0) <= NORM_TOLERANCE) | np.isnan(norm))
    if bad.any():
        i = int(np.argmax(bad))
        reason = f"norm {norm[i]:.6g} at sample {i}"
        raise LogError.at_field(name, reason, f"unit quaternions, within {NORM_TOLERANCE:g}")
    norm[np.abs(norm - 1.0) <= ROUNDING] = 1.0  # normalised quaternions stay bit for bit
    return np.asarray(quat / norm[:, None], dtype=np.float64)


def normalize_normals(normals: FloatArray, active: BoolArray, labels: tuple[str, ...]) -> FloatArray:
    """Normals (N, C, 3) with a norm of exactly one; NaN for unknown normals in the air.

    LogError at the first active contact, (N, C) bool, whose normal has another norm.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        norm = np.linalg.norm(normals, axis=2)
        known = np.abs(norm - 1.0) <= NORM_TOLERANCE
    bad = active & ~known
    if bad.any():
        sample, contact = (int(i) for i in np.unravel_index(np.argmax(bad), bad.shape))
        reason = f"norm {norm[sample, contact]:.6g} at {describe_element((sample, contact), labels)}, while in contact"
        raise LogError.at_field(NORMALS, reason, f"unit vectors, within {NORM_TOLERANCE:g}")
    norm[np.abs(norm - 1.0) <= ROUNDING] = 1.0
    return np.where(known[..., None], normals / np.where(known, norm, 1.0)[..., None], np.nan)


FLAG_WORDS = {
    "true": 1, "false": 0, "yes": 1, "no": 0, "on": 1, "off": 0, "stance": 1, "swing": 0, "contact": 1, "air": 0,
}  # fmt: skip
"""What words mean whether a contact touches, in small letters."""
FLAG_ACCEPTED = "true and false, 1 and 0, yes and no, on and off, stance and swing, or contact and air"


def parse_flags(name: str, array: NDArray[Any], labels: tuple[str, ...]) -> BoolArray:
    """The array as booleans, LogError unless it holds booleans or the numbers 0 and 1."""
    if array.dtype.kind == "b":
        return np.asarray(array, dtype=np.bool_)
    values = to_float64(name, array)
    bad = (values != 0.0) & (values != 1.0)
    if bad.any():
        index = tuple(int(i) for i in np.unravel_index(np.argmax(bad), bad.shape))
        raise LogError.at_field(name, f"{values[index]:g} at {describe_element(index, labels)}", FLAG_ACCEPTED)
    return np.asarray(values, dtype=np.bool_)
