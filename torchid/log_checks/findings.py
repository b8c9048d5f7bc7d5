"""Results of checks (findings, skipped checks), and their input: groups of channels and statistics of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from torchid.errors import InputError, join_names
from torchid.logs import Log
from torchid.logs.log import CONTACT_READINGS, NORMALS, BoolArray, FloatArray, column_labels
from torchid.parameters import WRENCH_COMPONENTS

#: The samples must not be fitted.
REJECTED = "rejected"
#: The user should inspect the samples; a fit may be right.
SUSPICIOUS = "suspicious"
#: Information; nothing has to be done.
NOTE = "note"

SEVERITIES = (REJECTED, SUSPICIOUS, NOTE)

_FEW_NAMED = 3
#: Steps on either side that a step or a run of repeats is compared with.
NEIGHBOUR_STEPS = 10


@dataclass(frozen=True)
class Span:
    """Samples `first` to `last` (included) of one channel of the finding's field, or of all channels ("").

    `shift`: error of the channel from `last` on, for a jump that is not a motion.
    """

    first: int
    last: int
    channel: str = ""
    shift: float = 0.0

    def __len__(self) -> int:
        return self.last - self.first + 1

    def __str__(self) -> str:
        return str(self.first) if self.first == self.last else f"{self.first}-{self.last}"


@dataclass(frozen=True)
class Finding:
    """One result of a check.

    Attributes:
        name: the kind of finding, such as "spike".
        severity: one of `SEVERITIES`.
        field: of the log.
        channels: names within the field; empty for all channels.
        spans: the samples; empty for the whole log.
        found: description with numbers.
        advice: what the user should do.
        everywhere: whether it concerns every sample although `spans` lists only some.
    """

    name: str
    severity: str
    field: str
    found: str
    advice: str
    channels: tuple[str, ...] = ()
    spans: tuple[Span, ...] = ()
    everywhere: bool = False

    @property
    def whole(self) -> bool:
        """Whether the finding concerns every sample."""
        return self.everywhere or not self.spans

    @property
    def rejects_all(self) -> bool:
        """Whether no sample of the log may be fitted."""
        return self.severity == REJECTED and self.whole

    def mask(self, samples: int) -> BoolArray:
        """Which of `samples` samples the finding concerns."""
        mask = np.full(samples, self.whole)
        for span in self.spans:
            mask[span.first : span.last + 1] = True
        return mask


EXCLUDE_ADVICE = "exclude these samples (preprocessing.exclude_rejected: true)"
UNEXPLAINED = "; no usual mistake explains it"
"""End of a finding that names no mistake."""
_EXPLAINING_SHARE = 0.05  # of the samples: a finding on more of them may explain a finding on all samples


def explained(findings: Sequence[Finding], samples: int) -> list[Finding]:
    """The findings; those without a known mistake refer to those with one."""
    named = [
        f"{finding.name} of {finding.field}"
        for finding in findings
        if finding.severity != NOTE
        and UNEXPLAINED not in finding.found
        and finding.mask(samples).mean() > _EXPLAINING_SHARE
    ]
    see = f"; see {join_names(named, _FEW_NAMED)}" if named else UNEXPLAINED
    return [replace(finding, found=finding.found.replace(UNEXPLAINED, see)) for finding in findings]


def refused(error: InputError) -> Finding:
    """The finding for an error with which a fit would refuse this log."""
    return Finding("does not fit", REJECTED, error.field, error.found, f"give {error.accepted}")


@dataclass(frozen=True)
class Skipped:
    """A check that could not be made, and the reason."""

    name: str
    reason: str


def find_spans(where: BoolArray | NDArray[np.intp], channel: str = "") -> Iterator[Span]:
    """Runs of successive samples in a mask (N,) or in ascending sample numbers (M,)."""
    numbers = np.flatnonzero(where) if where.dtype == np.bool_ else where
    for run in np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1):
        if len(run):
            yield Span(int(run[0]), int(run[-1]), channel)


def neighbours_of(series: FloatArray, at: NDArray[np.intp], direction: int, count: int) -> FloatArray:
    """The `count` items before (-1) or after (1) some indices `at` (P,) of a series (M, ...), nearest first.

    Returns:
        (P, count, ...), NaN beyond the ends.
    """
    index = at[:, None] + direction * np.arange(1, count + 1)
    inside = (index >= 0) & (index < len(series))
    neighbours = series[np.clip(index, 0, len(series) - 1)]
    neighbours[~inside] = np.nan
    return neighbours


def finite_median(values: FloatArray) -> FloatArray:
    """Median without NaN along the second axis of (P, k, ...), the upper of two; 0 where all values are NaN."""
    ordered = np.sort(values, axis=1)  # NaN last
    count = np.sum(~np.isnan(ordered), axis=1, keepdims=True)
    middle = np.take_along_axis(ordered, np.minimum(count // 2, values.shape[1] - 1), axis=1)[:, 0]
    return np.where(count[:, 0] > 0, middle, 0.0)


def widen_mask(where: BoolArray, distance: int) -> BoolArray:
    """Which samples are within `distance` samples of the mask (N,)."""
    distance = min(distance, len(where))
    padded = np.concatenate([np.zeros(distance + 1, np.intp), np.cumsum(where)])
    padded = np.concatenate([padded, np.full(distance, padded[-1])])
    return np.asarray(padded[2 * distance + 1 :] > padded[: -2 * distance - 1])


#: A longer step is a gap: a sample is missing.
MIN_GAP_STEPS = 1.5

FIELD_UNITS = {
    "joint_position": "rad",
    "joint_velocity": "rad/s",
    "joint_acceleration": "rad/s^2",
    "joint_torque": "N m",
    "contact_force_normal": "N",
    "base_position_world": "m",
    "base_linear_velocity_world": "m/s",
    "base_angular_velocity_base": "rad/s",
    "base_linear_acceleration_world": "m/s^2",
    "base_angular_acceleration_base": "rad/s^2",
    "imu_specific_force": "m/s^2",
    "imu_angular_velocity": "rad/s",
    "imu_angular_acceleration": "rad/s^2",
}
#: Fields that are not sensor signals.
NON_SIGNAL_FIELDS = ("time", "contact_active", NORMALS)


def median_step(log: Log) -> float:
    """Median time between samples [s]; 1 for a single sample."""
    return float(np.median(np.diff(log.time))) if len(log) > 1 else 1.0


@dataclass(frozen=True, eq=False)
class ChannelGroup:
    """The measured channels of all joints, of the base, or of one contact, in one field.

    Attributes:
        field: of the log.
        name: of the contact or force/torque sensor; "" elsewhere.
        names: of the c channels within the field.
        samples: (M,) numbers of the samples at which all channels were measured; of a contact, those while it is
            active and its reading is not zero.
        values: (M, c).
        elapsed: (M,) time since the first in median steps of the log.
        piece: (M,) number of the run of samples without a gap that each sample belongs to.
    """

    field: str
    name: str
    names: tuple[str, ...]
    samples: NDArray[np.intp]
    values: FloatArray
    elapsed: FloatArray
    piece: NDArray[np.intp]

    @property
    def joined(self) -> BoolArray:
        """Whether successive samples have no gap between them, (M - 1,)."""
        return np.asarray(np.diff(self.piece) == 0)


def channel_names(log: Log, field: str) -> tuple[str, ...]:
    """Names of a field's channels, in the order in which its array is flattened."""
    labels = column_labels(field, log.names)
    array = log.arrays()[field]
    if array.ndim == 3:
        components = "xyz" if field == NORMALS else WRENCH_COMPONENTS
        return tuple(f"{label} {component}" for label in labels for component in components)
    return labels or tuple("xyzw"[: array.shape[1]] if array.ndim == 2 else ("",))


def channel_unit(field: str, name: str) -> str:
    """Unit of a channel; "" for dimensionless channels."""
    component = name.rpartition(" ")[2]
    if field in FIELD_UNITS or component not in WRENCH_COMPONENTS:
        return FIELD_UNITS.get(field, "")
    return "N" if component.startswith("f") else "N m"


def channel_groups(log: Log, fields: Sequence[str] | None = None) -> Iterator[ChannelGroup]:
    """All groups of a log that are not empty; `fields`: only of these fields."""
    for field in log.arrays():
        if field in NON_SIGNAL_FIELDS or not (fields is None or field in fields):
            continue
        values: FloatArray = getattr(log, field)
        names = channel_names(log, field)
        if values.ndim == 2 and field not in CONTACT_READINGS:
            yield from _group(log, field, "", names, values, np.ones(len(log), dtype=bool))
            continue
        for index, label in enumerate(column_labels(field, log.names)):
            measured = np.ones(len(log), dtype=bool)
            channel = values[:, index].reshape(len(log), -1)
            if field in CONTACT_READINGS and log.contact_active is not None:
                measured = log.contact_active[:, index] & (channel != 0.0).any(axis=1)
            width = channel.shape[1]
            yield from _group(log, field, label, names[width * index : width * (index + 1)], channel, measured)


def _group(
    log: Log, field: str, name: str, names: tuple[str, ...], values: FloatArray, measured: BoolArray
) -> Iterator[ChannelGroup]:
    columns = ~np.isnan(values[measured]).all(axis=0) if measured.any() else np.zeros(values.shape[1], dtype=bool)
    if not columns.any():
        return
    values = values if columns.all() else values[:, columns]
    samples = np.flatnonzero(measured & ~np.isnan(values).any(axis=1))
    if len(samples) < 2:
        return
    elapsed = (log.time[samples] - log.time[samples[0]]) / median_step(log)
    gaps = (np.diff(samples) > 1) | (np.diff(elapsed) > MIN_GAP_STEPS)
    values = values if len(samples) == len(log) else values[samples]
    piece = np.append(0, np.cumsum(gaps))
    yield ChannelGroup(field, name, tuple(np.array(names)[columns].tolist()), samples, values, elapsed, piece)
