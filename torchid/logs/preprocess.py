"""Preprocessing of a log: filter, differentiate and resample all channels; contact changes and missing data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import takewhile
from typing import Any

import numpy as np

from torchid.errors import InputError, about_file
from torchid.logs.dry_friction import channels_together, dry_friction, with_sign_filter
from torchid.logs.gaps import Coverage, measure_coverage, require_no_turns, warn_of_gaps
from torchid.logs.log import (
    CONTACT_READINGS,
    NAN_ALLOWED,
    NORMALS,
    BoolArray,
    FloatArray,
    Log,
    check_finite,
    column_labels,
)
from torchid.logs.quaternion import angular_acceleration_base, angular_velocity_base, make_sign_continuous
from torchid.logs.signal_noise import signal_noise, warn_of_noisy_accelerations
from torchid.logs.timeline import JITTER, SampleRate, Timeline, lay_out_timeline, nearest_known
from torchid.settings import AUTO

#: Quantities of which each is the derivative of the one before. The first angular one would be the orientation.
DERIVATIVE_CHAINS = (
    ("joint_position", "joint_velocity", "joint_acceleration"),
    ("base_position_world", "base_linear_velocity_world", "base_linear_acceleration_world"),
    ("base_angular_velocity_base", "base_angular_acceleration_base"),
    ("imu_specific_force",),
    ("imu_angular_velocity", "imu_angular_acceleration"),
)
_ANGULAR = DERIVATIVE_CHAINS[2]
#: Norm of a filtered quaternion: below, the filter removes the rotation of the base.
_MIN_QUATERNION_NORM = 0.5


def preprocess(
    log: Log,
    cutoff_hz: float | None = None,
    sample_rate_hz: SampleRate = None,
    motion_noise: Mapping[str, float] | None = None,
    sign_width: float | None = None,
    stribeck: float | None = None,
    finds_rest: bool = False,
) -> Log:
    """Fill in velocities and accelerations, after a zero-phase low-pass filter and before resampling, both optional.

    Derivatives that the log gives are used. A missing one is that of the nearest quantity before it that the log
    gives, by a quintic spline: joints from `joint_position`, the base's linear ones from `base_position_world`, its
    angular ones from the quaternion's components (never through Euler angles). `base_linear_velocity_world` stays
    None where the log gives neither it nor a position: nothing but the acceleration enters the equations of motion.

    The filter is a Butterworth low-pass of order 4 run forward and backward (no lag, gain 1/2 at the cutoff) on every
    channel, on a uniform grid: jittered time stamps are first interpolated to their median rate. Filtered logs lose
    2/cutoff_hz seconds at each end; logs differentiated without a filter lose 2 samples at each end, where the
    spline multiplies noise. `noise_bandwidth_hz` of a filtered log is the filter's equivalent noise bandwidth.

    Where a log is filtered or resampled, `contact_active` is held from the previous sample, a wrench counts as 0
    while its contact is inactive, and a torque or wrench channel that is NaN in some samples becomes NaN throughout.
    In a filtered log a contact is active from 1/cutoff_hz before its recorded start until 1/cutoff_hz after its end, as
    the filter spreads its force over that time: an ignored force would bias the fit, a projected force of 0 would not.
    Readings of contact sensors without contact, their offsets, are kept as recorded (`contact_unloaded`). The sign of
    the joint velocities, which dry friction goes with, is filtered as its torque is (`joint_direction`), and what
    Stribeck friction goes with alike (`joint_stribeck`). The noise of the recorded motion, which makes parameters too
    small, comes with the log (`motion_noise`).

    Args:
        log: the log.
        cutoff_hz: cutoff [Hz] of the filter, below half the median sample rate; None for no filter.
        sample_rate_hz: sample rate [Hz] of the result, at most ten times the median one; auto, every k-th sample, see
            `lay_out_timeline`; None for the log's own.
        motion_noise: standard deviations of the recorded motion by the keys of `STATED_FIELDS`, as far as they are
            known; others are estimated, see `signal_noise`.
        sign_width: over which the sign of a joint's velocity changes, as tanh(velocity / width) [rad/s or m/s]; None
            for at once.
        stribeck: velocity over which friction at rest drops to Coulomb friction [rad/s or m/s]; None: there is no such
            friction.
        finds_rest: whether joints at rest are to be marked, whose torques then count as unmeasured (`joint_rests`).

    Returns:
        The preprocessed log, which shares the memory of unchanged fields; `log` itself where nothing has to be done.

    Raises:
        InputError: `cutoff_hz` or `sample_rate_hz` does not suit the log.
        LogError: the log has too few samples or too wide gaps, or a value that is not finite.

    Warns:
        TorchidWarning: a torque or wrench channel is NaN in some samples, time stamps nearly coincide, joints move
            faster than the filter lets through, or accelerations are largely noise.
    """
    with about_file(log.source):
        dry = sign_width, stribeck, finds_rest
        timeline = make_timeline(log.time, lacks_derivatives(log), cutoff_hz, sample_rate_hz, *dry)
    noise = log.motion_noise or signal_noise(log, timeline, motion_noise)
    if timeline is None:
        return replace(log, motion_noise=noise) if noise.found else log
    require_no_turns(log)  # which would pass for fast motion
    timeline = with_sign_filter(timeline, log, noise)
    out = move_to_timeline(log, timeline, measured_coverage(log, timeline))
    with about_file(log.source):
        warn_of_noisy_accelerations(log, out, timeline, noise)
    return replace(out, motion_noise=noise)


def make_timeline(
    time: FloatArray,
    differentiates: bool,
    cutoff_hz: float | None,
    sample_rate_hz: SampleRate,
    sign_width: float | None = None,
    stribeck: float | None = None,
    finds_rest: bool = False,
) -> Timeline | None:
    """The timeline of `preprocess`; None where nothing has to be done. Raises and warns as `lay_out_timeline`."""
    if cutoff_hz is None and sample_rate_hz in (None, AUTO) and not (differentiates or finds_rest):
        return None
    timeline = lay_out_timeline(time, cutoff_hz, sample_rate_hz, differentiates)
    return replace(timeline, sign_width=sign_width, stribeck=stribeck, finds_rest=finds_rest)


def measured_coverage(log: Log, timeline: Timeline) -> dict[str, Coverage]:
    """Coverage of fields that are filtered or resampled (their channels must have no gap); warns of gaps."""
    if timeline.low_pass is None and timeline.output is None:
        return {}
    coverage = {name: measure_coverage(log, name) for name in NAN_ALLOWED if getattr(log, name) is not None}
    for name, share in coverage.items():
        warn_of_gaps(log, name, share)
    return coverage


def move_to_timeline(log: Log, timeline: Timeline, coverage: Mapping[str, Coverage]) -> Log:
    """A log, or a segment of one, preprocessed to a timeline.

    Args:
        log: the log.
        timeline: stamps of it and of the result.
        coverage: of fields that must have no gap.

    Raises:
        LogError: a joint's position jumps by a whole turn, or is not finite.
    """
    require_no_turns(log)
    with about_file(log.source):
        fields = _fields_on_timeline(log, timeline, coverage)
        readings = unloaded_readings(log)
        return replace(log, **fields, contact_unloaded=None if readings is None else timeline.hold(readings))


def _fields_on_timeline(log: Log, timeline: Timeline, coverage: Mapping[str, Coverage]) -> dict[str, Any]:
    """Fields that change in the preprocessed log."""
    stamps = log.time[timeline.kept] if timeline.keeps_stamps else timeline.origin + timeline.output_stamps
    fields: dict[str, Any] = {"time": stamps}
    fields |= _motion(log, timeline)
    for name in NAN_ALLOWED:
        if getattr(log, name) is not None:
            fields[name] = _resample_measured(log, name, timeline, coverage.get(name))
    if log.contact_active is not None:
        fields["contact_active"] = timeline.widen_flags(log.contact_active)
        if timeline.low_pass is not None or timeline.output is not None:
            share = log.contact_active if log.contact_share is None else log.contact_share
            fields["contact_share"] = timeline.evaluate(timeline.smooth(share.astype(np.float64)), (0,))[0]
    if log.contact_normal_world is not None:
        normals = timeline.hold(nearest_known(log.contact_normal_world))
        fields[NORMALS] = np.where(fields["contact_active"][..., None], normals, np.nan)
    if timeline.bandwidth_hz is not None:
        fields["noise_bandwidth_hz"] = min(timeline.bandwidth_hz, log.noise_bandwidth_hz or np.inf)
        fields["noise_share"] = 2.0 * fields["noise_bandwidth_hz"] * float(np.median(np.diff(timeline.grid)))
    return fields


def lacks_derivatives(log: Log) -> bool:
    """Whether any velocity or acceleration that can be derived is missing."""
    if log.base_quat_xyzw is not None and any(getattr(log, name) is None for name in _ANGULAR):
        return True
    for chain in DERIVATIVE_CHAINS:
        given = [getattr(log, name) is not None for name in chain]
        if any(before and not after for before, after in zip(given, given[1:], strict=False)):
            return True
    return False


def _motion(log: Log, timeline: Timeline) -> dict[str, FloatArray]:
    """Quantities of motion at the output's stamps: the recorded ones, and derivatives for missing ones."""

    def underived(names: tuple[str, ...]) -> tuple[str, ...]:
        """A quantity with its derivatives that no other field gives."""
        return names[:1] + tuple(takewhile(lambda name: getattr(log, name) is None, names[1:]))

    given = [chain[i:] for chain in DERIVATIVE_CHAINS for i in range(len(chain)) if getattr(log, chain[i]) is not None]
    if log.base_quat_xyzw is not None:
        given.append(("base_quat_xyzw", *_ANGULAR))
    for name, *_ in given:
        check_finite(name, getattr(log, name), labels=column_labels(name, log.names))
    wanted = [underived(names) for names in given]
    out: dict[str, FloatArray] = {}
    joints: dict[str, FloatArray] = {}
    for count in dict.fromkeys(map(len, wanted)):
        same = [names for names in wanted if len(names) == count]
        smoothed = [timeline.smooth(_continuous(log, name)) for name, *_ in same]
        for names, derivatives in zip(same, timeline.evaluate_jointly(smoothed, range(count)), strict=True):
            is_turned = names[0] == "base_quat_xyzw"
            out |= _orientation(log, derivatives, timeline) if is_turned else dict(zip(names, derivatives, strict=True))
        joints |= {names[0]: x for names, x in zip(same, smoothed, strict=True) if names[0] in DERIVATIVE_CHAINS[0]}
    return out | dry_friction(log, joints, timeline)


def _continuous(log: Log, name: str) -> FloatArray:
    """The field `name` without jumps that are no motion."""
    values: FloatArray = getattr(log, name)
    return make_sign_continuous(values) if name == "base_quat_xyzw" else values


def _orientation(log: Log, derivatives: list[FloatArray], timeline: Timeline) -> dict[str, FloatArray]:
    """The orientation at the output's stamps, from the quaternion, and angular rates from its derivatives."""
    q, *rates = derivatives
    norm = np.linalg.norm(q, axis=1, keepdims=True)
    if timeline.low_pass is not None and np.min(norm) < _MIN_QUATERNION_NORM:
        reason = f"the filter removes the base's rotation (norm of the filtered quaternion {np.min(norm):.2g})"
        raise InputError(log.source, "preprocessing.cutoff_hz", reason, "a cutoff above the frequency of this rotation")
    out = {"base_quat_xyzw": q / norm}
    if rates:
        out["base_angular_velocity_base"] = angular_velocity_base(q, rates[0])
    if len(rates) > 1:
        out["base_angular_acceleration_base"] = angular_acceleration_base(q, rates[0], rates[1])
    return out


# -------------------------------------------------------------------------------------------- fields that may have gaps


def _resample_measured(log: Log, name: str, timeline: Timeline, coverage: Coverage | None) -> FloatArray:
    """The field `name` (N, ...) at the output's stamps (K, ...), filtered like all others.

    A channel that is NaN throughout stays so. A reading of an inactive contact is 0, whatever was recorded. A channel
    with NaN among other values can be neither filtered nor resampled: it becomes NaN throughout.

    Args:
        log: the log, or a part of one.
        name: of the field.
        timeline: stamps of the log and of the result.
        coverage: of the field in the whole log; None where nothing is filtered or resampled.
    """
    values: FloatArray = getattr(log, name)
    check_finite(name, values, allow_nan=True, labels=column_labels(name, log.names))
    if coverage is None:
        return values[timeline.kept]
    flags = log.contact_active if name in CONTACT_READINGS else None
    complete = np.argwhere(coverage.complete)
    out = np.full((len(timeline.output_stamps), *values.shape[1:]), np.nan)
    together = channels_together(len(values))
    for start in range(0, len(complete), together):
        columns = (slice(None), *complete[start : start + together].T)
        clean = values[columns]
        if flags is not None:
            clean[~flags[:, columns[1]]] = 0.0
        if clean.any():
            out[columns] = timeline.evaluate(timeline.smooth(clean), (0,))[0]
        else:  # such as moments of points
            out[columns] = 0.0
    return out


# --------------------------------------------------------------------- contacts that change, and sensors without a load

#: How far from its contact [s] a sensor counts as unloaded. Flags come from thresholds of 20 to 50 N: a foot carries
#: that much for some 10 ms before and after, and a sensor rings about as long when it lands.
UNLOADED_MARGIN_S = 0.05


def near_contact_changes(log: Log, time: FloatArray, margin: float) -> BoolArray:
    """Which stamps lie within a margin of a change of contact.

    Args:
        log: as recorded; a change lies between two of its samples.
        time: (K,) [s].
        margin: [s] before the last sample of the old and after the first of the new contact state.
    """
    near = np.zeros(len(time), dtype=bool)
    if log.contact_active is None:
        return near
    changes = np.flatnonzero((log.contact_active[1:] != log.contact_active[:-1]).any(axis=1))
    if len(changes):
        margin += JITTER * float(np.median(np.diff(log.time)))  # a stamp at the margin is within, however it rounds
    first = np.searchsorted(time, log.time[changes] - margin)
    last = np.searchsorted(time, log.time[changes + 1] + margin, side="right")
    for start, stop in zip(first, last, strict=True):
        near[start:stop] = True
    return near


def find_unloaded(time: FloatArray, active: BoolArray, margin: float = UNLOADED_MARGIN_S) -> BoolArray:
    """Which contacts are further than a margin from every sample in which they touch, (N, C).

    Args:
        time: (N,) [s].
        active: (N, C).
        margin: [s].
    """
    out = np.ones(active.shape, dtype=bool)
    for contact in range(active.shape[1]):
        out[:, contact] = away_from_stamps(time, time[active[:, contact]], margin)
    return out


def away_from_stamps(time: FloatArray, stamps: FloatArray, margin: float) -> BoolArray:
    """Which times (K,) [s] are further than a margin [s] from each of some stamps (M,) [s] in order, (K,)."""
    if not len(stamps):
        return np.ones(len(time), dtype=bool)
    after = np.searchsorted(stamps, time)
    since = np.abs(time - stamps[np.maximum(after - 1, 0)])
    until = np.abs(stamps[np.minimum(after, len(stamps) - 1)] - time)
    return np.asarray(np.minimum(since, until) > margin)


def unloaded_readings(log: Log, where: BoolArray | None = None) -> FloatArray | None:
    """Readings of contact sensors without contact, (N, C, 6), NaN elsewhere; None if there are none.

    The force along the normal is a seventh component where a log has it.

    Args:
        log: as recorded.
        where: (N, C), from `find_unloaded`, of a part of a log; the result is an array then, whatever it holds.
    """
    if log.contact_unloaded is not None:
        return log.contact_unloaded
    wrench = log.contact_wrench
    scalar = log.contact_force_normal
    if (wrench is None and scalar is None) or log.contact_active is None:
        return None
    chosen = find_unloaded(log.time, log.contact_active) if where is None else where
    if where is None and not chosen.any():
        return None
    readings = np.full((*chosen.shape, 6), np.nan) if wrench is None else wrench
    if scalar is not None:
        readings = np.concatenate([readings, scalar[..., None]], axis=2)
    return np.where(chosen[..., None], readings, np.nan)
