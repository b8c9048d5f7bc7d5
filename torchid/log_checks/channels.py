"""A log as groups of channels that one sensor, or one sort of sensor, gives."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchid.logs import Log
from torchid.logs.log import WRENCHES, BoolArray, FloatArray, column_labels
from torchid.parameters import WRENCH_COMPONENTS

#: Steps longer than this, in median steps, lack a sample.
LONG_STEP = 1.5

AXES = "xyzw"
UNITS = {
    "joint_position": "rad",
    "joint_velocity": "rad/s",
    "joint_acceleration": "rad/s^2",
    "joint_torque": "N m",
    "base_position_world": "m",
    "base_linear_velocity_world": "m/s",
    "base_angular_velocity_base": "rad/s",
    "base_linear_acceleration_world": "m/s^2",
    "base_angular_acceleration_base": "rad/s^2",
    "imu_specific_force": "m/s^2",
    "imu_angular_velocity": "rad/s",
    "imu_angular_acceleration": "rad/s^2",
}
#: Fields that are no signals of a sensor.
NO_SIGNALS = ("time", "contact_active")


def median_step(log: Log) -> float:
    """Median time between samples [s]; 1 where there is but one."""
    return float(np.median(np.diff(log.time))) if len(log) > 1 else 1.0


@dataclass(frozen=True, eq=False)
class ChannelGroup:
    """Channels of one field, of all joints, of the base, or of one contact, where they were measured.

    Attributes:
        field: of the log.
        name: of the contact or force/torque sensor; "" elsewhere.
        names: of the c channels within the field.
        samples: (M,) numbers of the samples at which all channels were measured; of a contact, while it is active and
            reads anything.
        values: (M, c).
        elapsed: (M,) time since the first in median steps of the log.
        piece: (M,) which successive samples without a gap between them each belongs to.
    """

    field: str
    name: str
    names: tuple[str, ...]
    samples: NDArray[np.intp]
    values: FloatArray
    elapsed: FloatArray
    piece: NDArray[np.intp]

    @property
    def unit(self) -> str:
        """Unit of the values, without one for quaternions."""
        return UNITS.get(self.field, "" if self.field.startswith("base_quat") else "N, N m")

    @property
    def joined(self) -> BoolArray:
        """Whether neighbours are neighbours in the log, (M - 1,)."""
        return np.asarray(np.diff(self.piece) == 0)


def channel_names(log: Log, field: str) -> tuple[str, ...]:
    """Names of a field's channels, in the order in which its array is flattened."""
    labels = column_labels(field, log.names)
    array = log.arrays()[field]
    if array.ndim == 3:
        return tuple(f"{label} {component}" for label in labels for component in WRENCH_COMPONENTS)
    return labels or tuple(AXES[: array.shape[1]] if array.ndim == 2 else ("",))


def channel_unit(field: str, name: str) -> str:
    """Unit of a channel, "" for a number without one."""
    component = name.rpartition(" ")[2]
    if field in UNITS or component not in WRENCH_COMPONENTS:
        return UNITS.get(field, "")
    return "N" if component.startswith("f") else "N m"


def channel_groups(log: Log) -> Iterator[ChannelGroup]:
    """All groups of a log that hold anything."""
    for field in log.arrays():
        if field in NO_SIGNALS:
            continue
        values: FloatArray = getattr(log, field)
        names = channel_names(log, field)
        if values.ndim == 2:
            yield from _group(log, field, "", names, values, np.ones(len(log), dtype=bool))
            continue
        for index, label in enumerate(column_labels(field, log.names)):
            measured = np.ones(len(log), dtype=bool)
            if field in WRENCHES and log.contact_active is not None:
                measured = log.contact_active[:, index] & (values[:, index] != 0.0).any(axis=1)
            yield from _group(log, field, label, names[6 * index : 6 * index + 6], values[:, index], measured)


def _group(
    log: Log, field: str, name: str, names: tuple[str, ...], values: FloatArray, measured: BoolArray
) -> Iterator[ChannelGroup]:
    some = ~np.isnan(values[measured]).all(axis=0) if measured.any() else np.zeros(values.shape[1], dtype=bool)
    if not some.any():
        return
    chosen = values if some.all() else values[:, some]
    samples = np.flatnonzero(measured & ~np.isnan(chosen).any(axis=1))
    if len(samples) < 2:
        return
    elapsed = (log.time[samples] - log.time[samples[0]]) / median_step(log)
    apart = (np.diff(samples) > 1) | (np.diff(elapsed) > LONG_STEP)
    kept = chosen if len(samples) == len(log) else chosen[samples]
    piece = np.append(0, np.cumsum(apart))
    yield ChannelGroup(field, name, tuple(np.array(names)[some].tolist()), samples, kept, elapsed, piece)
