"""Gaps in recorded signals: short ones are bridged by splines, long ones and jumps of whole turns refused; coverage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from torchid.errors import LogError, format_count, join_names, warn, warn_about_file
from torchid.logs.flags import runs
from torchid.logs.log import (
    CONTACT_READINGS,
    FLAGS,
    LARGEST,
    NORMALS,
    BoolArray,
    FloatArray,
    Log,
    column_labels,
    describe_element,
    field_shape,
    is_quaternion,
    parse_time,
    to_float64,
)
from torchid.logs.quaternion import make_sign_continuous

_KEY = "preprocessing.bridge_gaps_s"
#: Share of a gap's longest length by which rounded stamps may exceed it.
_SLACK = 1e-6


def bridge_gaps(raw: Mapping[str, NDArray[Any]], longest_s: float | None) -> dict[str, NDArray[Any]]:
    """Fill short gaps in the fields of a file: NaN between two values at most this far apart.

    A cubic spline through the channel's other samples fills them: it passes 2 times the noise of the samples in the
    middle of a gap of five steps, a quintic one 5 times. Quaternions are filled as a whole and normalised, contact
    flags hold. A contact's reading is filled only where the contact touches all the while. Channels that are NaN
    throughout, gaps at the ends of a log and normals of the ground stay as they are.

    Args:
        raw: arrays by field, those with samples (N, ...).
        longest_s: from the value before a gap to that after it [s]; None leaves all as it is.

    Raises:
        LogError: stamps that are none.

    Warns:
        TorchidWarning: how many samples were filled.
    """
    out = dict(raw)
    filled = dict[str, BoolArray]()  # samples (N,) in which something was filled
    if longest_s is None:
        return out
    time = parse_time(raw["time"])
    for name in sorted(_with_gaps(raw), key=lambda name: name != FLAGS):  # readings depend on flags
        missing = _missing(name, raw[name])
        usable = _touching(out, missing.shape) if name in CONTACT_READINGS else None
        short = _short_gaps(time, missing, longest_s, usable)
        if short.any():
            out[name] = _held(raw[name], short) if name == FLAGS else _filled(time, name, raw[name], short)
            filled[name] = np.asarray(short.reshape(len(time), -1).any(axis=1))
    if filled:
        count = int(np.any(list(filled.values()), axis=0).sum())
        what = f"gaps of up to {longest_s:g} s were bridged in {count} of {len(time)} samples"
        warn_about_file(f"{', '.join(filled)}: {what}")
    return out


def refuse_gaps(name: str, values: FloatArray, time: FloatArray, labels: tuple[str, ...] = ()) -> None:
    """Raise LogError for a field (N, ...) that is NaN in some samples; `labels`: names of its columns."""
    where = describe_element(tuple(map(int, np.argwhere(np.isnan(values))[0])), labels)
    lengths = [
        time[stop] - time[start - 1]
        for column in _missing(name, values).reshape(len(time), -1).T
        for start, stop in runs(column)
        if start > 0 and stop < len(time)
    ]
    longest = f"the longest is {max(lengths):.3g} s" if lengths else "no gap has values on both sides"
    raise LogError.at_field(name, f"nan at {where}", f"finite numbers, or {_KEY} to bridge gaps ({longest})")


def _with_gaps(raw: Mapping[str, NDArray[Any]]) -> Iterator[str]:
    """Fields of which some but not all samples of a channel may be bridged."""
    samples = len(raw["time"])
    for name, array in raw.items():
        has_samples = field_shape(name)[:1] == ("N",) and array.shape[:1] == (samples,)
        is_usual = array.dtype.kind == "f" and array.ndim == len(field_shape(name))
        if not has_samples or not is_usual or name in ("time", NORMALS):
            continue
        if np.isnan(array).any() and not (np.abs(array) > LARGEST).any():  # which is refused as it is
            yield name


def _missing(name: str, values: NDArray[Any]) -> BoolArray:
    """Which elements (N, ...) are missing; of quaternions all or none."""
    nan = np.isnan(values)
    return np.asarray(np.broadcast_to(nan.any(axis=1, keepdims=True), nan.shape) if is_quaternion(name) else nan)


def _touching(raw: Mapping[str, NDArray[Any]], shape: tuple[int, ...]) -> BoolArray | None:
    """Whether the contact of each element (N, C, ...) touches; None where its file does not say."""
    flags = raw.get(FLAGS)
    if flags is None or flags.shape != shape[:2]:
        return None
    return np.asarray(np.broadcast_to((flags == 1.0).reshape(*shape[:2], *[1] * (len(shape) - 2)), shape))


def _short_gaps(time: FloatArray, missing: BoolArray, longest_s: float, usable: BoolArray | None) -> BoolArray:
    """Those elements (N, ...) that are missing between two values not further apart than a length [s].

    Where it matters which samples are `usable` (N, ...), these are all in the gap and beside it.
    """
    short = np.zeros(missing.shape, dtype=np.bool_)
    for channel in np.ndindex(*missing.shape[1:]):
        for start, stop in runs(missing[(slice(None), *channel)]):
            inside = start and stop < len(time) and time[stop] - time[start - 1] <= longest_s * (1.0 + _SLACK)
            if inside and (usable is None or usable[(slice(start - 1, stop + 1), *channel)].all()):
                short[(slice(start, stop), *channel)] = True
    return short


def _filled(time: FloatArray, name: str, array: NDArray[Any], short: BoolArray) -> FloatArray:
    """A field (N, ...) with a spline through each channel where its gaps are short.

    No spline crosses a long gap, beside which it would swing.
    """
    values = to_float64(name, array).copy()
    if is_quaternion(name):
        values[short.any(axis=1)] = np.nan
        values = make_sign_continuous(values)
    for channel in np.ndindex(*values.shape[1:]):
        column = values[(slice(None), *channel)]
        of_channel = short[(slice(None), *channel)]
        for start, stop in runs(~np.isnan(column) | of_channel):
            gaps = of_channel[start:stop]
            since = time[start:stop] - time[start]
            if gaps.any():
                column[start:stop][gaps] = CubicSpline(since[~gaps], column[start:stop][~gaps])(since[gaps])
    if is_quaternion(name):
        rows = short.any(axis=1)
        values[rows] /= np.linalg.norm(values[rows], axis=1, keepdims=True)
    return values


def _held(flags: NDArray[Any], short: BoolArray) -> NDArray[Any]:
    """Flags (N, C), where they are missing those before."""
    out = flags.copy()
    for column, gaps in zip(out.T, short.T, strict=True):
        for start, stop in runs(gaps):
            column[start:stop] = column[start - 1]
    return out


_TURN = 2.0 * np.pi  # [rad]
_TOLERANCE_TURNS = 0.05  # of a jump, which contains a step of the motion
_LARGEST_STEP_TURNS = 0.5 / _TURN  # of the motion on either side


def turn_jumps(position: FloatArray, turn: float = _TURN) -> BoolArray:
    """Which steps (N - 1, n) of positions (N, n) are jumps by a whole turn, between small steps of the motion.

    Where other joints jump at the same sample by other amounts, none is: the positions have another unit.
    """
    steps = np.abs(np.diff(position, axis=0)) / turn
    with np.errstate(invalid="ignore"):
        jumps = np.abs(steps - 1.0) < _TOLERANCE_TURNS
        is_small = ~(steps >= _LARGEST_STEP_TURNS)
    around = np.pad(is_small, ((1, 1), (0, 0)), constant_values=True)
    jumps &= around[:-2] & around[2:]
    return np.asarray(jumps & (jumps | is_small).all(axis=1, keepdims=True))


def require_no_turns(log: Log) -> None:
    """Refuse joint positions [rad] that jump by a turn from one sample to the next, between small steps.

    Raises:
        LogError: names the joints.
    """
    jumps = turn_jumps(log.joint_position)
    joints = np.flatnonzero(jumps.any(axis=0))
    if not len(joints):
        return
    first = log.time[1 + int(jumps.any(axis=1).argmax())]
    names = join_names([log.joint_names[joint] for joint in joints])
    reason = f"{names} jumps by a whole turn, {format_count(int(jumps.sum()), 'time')}, first at {first:.6g} s"
    accepted = "unwrapped angles, or logs.columns.joint_position.turn_from"
    raise LogError(log.source, "joint_position", reason, accepted)


@dataclass(frozen=True)
class Coverage:
    """Which channels of a field were measured in all samples.

    Attributes:
        missing: samples (N, ...) in which there is something to measure (all, or those in contact) and no value.
        complete: channels with a value in all measurable samples, and in at least one sample.
        broken: channels with a value in some samples and NaN in others.
    """

    missing: BoolArray
    complete: BoolArray
    broken: BoolArray


def warn_of_gaps(log: Log, name: str, coverage: Coverage) -> None:
    """Warn about channels that become NaN in all samples because they are NaN in some.

    Warns:
        TorchidWarning: names them.
    """
    labels = column_labels(name, log.names)
    broken = list[str]()
    channel: tuple[int, ...]
    for channel in map(tuple, np.argwhere(coverage.broken).tolist()):
        samples = np.flatnonzero(np.moveaxis(coverage.missing, 0, -1)[channel])
        label = describe_element((0, *channel), labels).partition(", ")[2]
        broken.append(f"{label} (samples {samples[0]} to {samples[-1]})")
    if broken:
        message = f"{log.source}: {name}: NaN in part of {', '.join(broken)}: preprocessing makes all samples NaN"
        message += f". Set {_KEY} to bridge the gaps, or preprocessing.exclude_rejected: true"
        warn(message)


def measure_coverage(log: Log, name: str) -> Coverage:
    """Coverage of the field `name` of a log."""
    values: FloatArray = getattr(log, name)
    missing = np.isnan(values)
    measurable: BoolArray = np.ones(len(values), dtype=np.bool_)
    has_values: BoolArray = np.asarray(~missing.all(axis=0))
    if name in CONTACT_READINGS and log.contact_active is not None:
        measurable = log.contact_active.reshape(log.contact_active.shape + (1,) * (values.ndim - 2))
        missing &= measurable
    lost = missing.sum(axis=0)
    complete = has_values & (lost == 0)
    return Coverage(missing, complete, has_values & ~complete & (lost < measurable.sum(axis=0)))
