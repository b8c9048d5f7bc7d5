"""Filter, differentiate and resample a log, all channels alike."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from torchid.errors import InputError
from torchid.logs.checks import check_finite
from torchid.logs.fields import NAN_ALLOWED, FloatArray, labels_of
from torchid.logs.log import Log
from torchid.logs.measured import Coverage, carry_measured, check_coverage, coverage_of
from torchid.logs.plan import plan
from torchid.logs.quaternion import angular_acceleration_base, angular_velocity_base, sign_continuous
from torchid.logs.timeline import Timeline
from torchid.logs.transitions import unloaded_readings

#: Quantities of which each is the derivative of the one before. The first angular one would be the orientation.
CHAINS = (
    ("joint_position", "joint_velocity", "joint_acceleration"),
    ("base_position_world", "base_linear_velocity_world", "base_linear_acceleration_world"),
    ("base_angular_velocity_base", "base_angular_acceleration_base"),
    ("imu_specific_force",),
    ("imu_angular_velocity", "imu_angular_acceleration"),
)
ANGULAR = CHAINS[2]
#: A filtered quaternion whose norm falls below this turns faster than the filter lets pass.
LEAST_NORM = 0.5


def preprocess(log: Log, cutoff_hz: float | None = None, sample_rate_hz: float | None = None) -> Log:
    """Fill in velocities and accelerations, after a zero-phase low-pass filter and before resampling if asked to.

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
    In a filtered log a contact is active from 1/cutoff_hz before it truly is until 1/cutoff_hz after, for the filter
    spreads its force that far: to project out a force that is 0 costs data, to overlook one that is not costs truth.
    What a contact's sensor reads while nothing touches, its offset, is kept as recorded (`contact_unloaded`).

    Args:
        log: the log.
        cutoff_hz: cutoff [Hz] of the filter, below half the median sample rate; None for no filter.
        sample_rate_hz: sample rate [Hz] of the result, at most ten times the median one; None for the log's own.

    Returns:
        The preprocessed log, sharing the memory of what did not change: `log` itself where nothing has to be done.

    Raises:
        InputError: `cutoff_hz` or `sample_rate_hz` does not suit the log.
        LogError: the log has too few samples or too wide gaps, or a value that is not finite.

    Warns:
        TorchidWarning: a torque or wrench channel is NaN in some samples, or time stamps nearly coincide.
    """
    timeline = timeline_of(log.source, log.time, differentiates(log), cutoff_hz, sample_rate_hz)
    if timeline is None:
        return log
    coverage = {name: coverage_of(log, name) for name in gapless_fields(log, timeline)}
    for name, found in coverage.items():
        check_coverage(log, name, found)
    return on_timeline(log, timeline, coverage)


def timeline_of(
    source: str, time: FloatArray, differentiates: bool, cutoff_hz: float | None, sample_rate_hz: float | None
) -> Timeline | None:
    """How samples move in `preprocess`; None where nothing has to be done. Raises and warns as `plan`."""
    if cutoff_hz is None and sample_rate_hz is None and not differentiates:
        return None
    return plan(source, time, cutoff_hz, sample_rate_hz, differentiates)


def gapless_fields(log: Log, timeline: Timeline) -> list[str]:
    """Fields whose channels are to be without a gap, for they are filtered or resampled."""
    if timeline.low_pass is None and timeline.output is None:
        return []
    return [name for name in NAN_ALLOWED if getattr(log, name) is not None]


def on_timeline(log: Log, timeline: Timeline, coverage: Mapping[str, Coverage]) -> Log:
    """What `preprocess` makes of a log, or of a part of one.

    Args:
        log: the log.
        timeline: stamps of it and of the result.
        coverage: by field, of those that have to be gapless.
    """
    fields: dict[str, Any] = {
        "time": log.time[timeline.kept] if timeline.keeps_stamps else timeline.origin + timeline.at,
    }
    for chain in CHAINS:
        fields |= _chain(log, chain, timeline)
    if log.base_quat_xyzw is not None:
        fields |= _orientation(log, sign_continuous(log.base_quat_xyzw), timeline)
    for name in NAN_ALLOWED:
        if getattr(log, name) is not None:
            fields[name] = carry_measured(log, name, timeline, coverage.get(name))
    if log.contact_active is not None:
        fields["contact_active"] = timeline.active(log.contact_active)
        if timeline.low_pass is not None or timeline.output is not None:
            share = log.contact_active if log.contact_share is None else log.contact_share
            fields["contact_share"] = timeline.evaluate(timeline.smooth(share.astype(np.float64)), (0,))[0]
    if (readings := unloaded_readings(log)) is not None:
        fields["contact_unloaded"] = timeline.held(readings)
    if timeline.bandwidth_hz is not None:
        fields["noise_bandwidth_hz"] = min(timeline.bandwidth_hz, log.noise_bandwidth_hz or np.inf)
    return dataclasses.replace(log, **fields)


def differentiates(log: Log) -> bool:
    """Whether any velocity or acceleration that can be derived is missing."""
    if log.base_quat_xyzw is not None and any(getattr(log, name) is None for name in ANGULAR):
        return True
    for chain in CHAINS:
        given = [getattr(log, name) is not None for name in chain]
        if any(before and not after for before, after in zip(given, given[1:], strict=False)):
            return True
    return False


def _chain(log: Log, chain: tuple[str, ...], timeline: Timeline) -> dict[str, FloatArray]:
    """The quantities of a chain at the output's stamps: those given, and the derivatives that fill the gaps above."""
    out: dict[str, FloatArray] = {}
    for i, name in enumerate(chain):
        values = getattr(log, name)
        if values is None:
            continue
        check_finite(log.source, name, values, labels=labels_of(name, log.names))
        missing = [name]
        while i + len(missing) < len(chain) and getattr(log, chain[i + len(missing)]) is None:
            missing.append(chain[i + len(missing)])
        derivatives = timeline.evaluate(timeline.smooth(values), range(len(missing)))
        out |= dict(zip(missing, derivatives, strict=True))
    return out


def _orientation(log: Log, quat: FloatArray, timeline: Timeline) -> dict[str, FloatArray]:
    """The orientation at the output's stamps, and the angular rates that the log does not give."""
    check_finite(log.source, "base_quat_xyzw", quat)
    smoothed = timeline.smooth(quat)
    if log.base_angular_velocity_base is not None:
        orders = [0]
    else:
        orders = [0, 1, 2] if log.base_angular_acceleration_base is None else [0, 1]
    q, *rates = timeline.evaluate(smoothed, orders)
    norm = np.linalg.norm(q, axis=1, keepdims=True)
    if timeline.low_pass is not None and np.min(norm) < LEAST_NORM:
        found = f"a cutoff that removes the base's rotation (norm of the filtered quaternion {np.min(norm):.2g})"
        raise InputError(log.source, "preprocessing.cutoff_hz", found, "a cutoff above the rate of that rotation")
    out = {"base_quat_xyzw": q / norm}
    if rates:
        out["base_angular_velocity_base"] = angular_velocity_base(q, rates[0])
    if len(rates) > 1:
        out["base_angular_acceleration_base"] = angular_acceleration_base(q, rates[0], rates[1])
    return out
