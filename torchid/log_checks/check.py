"""All checks of one log in their order, repair of the log, and exclusion of rejected samples."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

from torchid.errors import InputError, LogError, warn
from torchid.log_checks.contacts import (
    check_accelerometer,
    check_contact_flags,
    check_limb_sensors,
    check_scalar_wrenches,
    check_slip,
    check_weight,
    subtract_contact_offsets,
)
from torchid.log_checks.equations import Declared
from torchid.log_checks.findings import (
    REJECTED,
    SEVERITIES,
    Finding,
    Skipped,
    channel_groups,
    channel_names,
    explained,
    median_step,
    refused,
)
from torchid.log_checks.forces import check_forces_against_urdf
from torchid.log_checks.motion import (
    check_angle_unit,
    check_angular_velocity,
    check_derivatives,
    check_loops,
    check_still_velocities,
    completed,
)
from torchid.log_checks.readings import (
    check_excitation,
    check_magnitudes,
    check_missing_values,
    check_repeats,
    check_rest,
    check_still_base,
    check_time_stamps,
)
from torchid.log_checks.spikes import check_jumps
from torchid.log_checks.standing_feet import check_standing_feet
from torchid.logs import Log
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.low_pass import REACH_PERIODS
from torchid.logs.time_range import log_title
from torchid.logs.timeline import DROPPED_SAMPLES, JITTER
from torchid.problem import Samples
from torchid.problem.base_pose import longest_with_pose
from torchid.problem.log_joints import without_welded_joints
from torchid.reprs import short_repr
from torchid.robot import Robot
from torchid.sensing import Contact, SensorSet

#: Share of rejected samples above which a log is not usable.
MAX_REJECTED_SHARE = 0.5
#: Descriptions and spans that one line of text lists.
_MAX_LISTED_TEXTS = 3
_MAX_LISTED_SPANS = 4
_LONGEST_BRIDGED_S = 0.1  # half of the shortest period of a robot's motion, 5 Hz


@dataclass(frozen=True, eq=False)
class Checked:
    """A log and the results of its checks.

    Attributes:
        log: as it was read.
        repaired: with rejected values interpolated, so that a filter does not smear them.
        findings: the most severe first.
        skipped: checks that could not be made.
        rolling: which contacts were taken to roll, on what, "" if none was.
    """

    log: Log
    repaired: Log
    findings: tuple[Finding, ...]
    skipped: tuple[Skipped, ...]
    rolling: str = ""

    __repr__ = short_repr

    def _headline(self) -> str:
        counts = Counter(finding.severity for finding in self.findings)
        headline = (
            ", ".join(f"{counts[severity]} {severity}" for severity in SEVERITIES if counts[severity]) or "no finding"
        )
        return f"{log_title(self.log.source)}, {len(self.log)} samples, {self.verdict} ({headline})"

    @cached_property
    def rejected(self) -> BoolArray:
        """Samples (N,) that must not be fitted."""
        return rejected_samples(self.findings, len(self.log))

    @property
    def usable(self) -> bool:
        """Whether enough of the log may be fitted."""
        return not self.reasons

    @property
    def reasons(self) -> tuple[str, ...]:
        """Reasons why the log is not usable; empty if it is."""
        whole = tuple(f"{f.field}: {f.name}" for f in self.findings if f.rejects_all)
        share = float(self.rejected.mean()) if len(self.log) else 1.0
        if not whole and share > MAX_REJECTED_SHARE:
            return (f"{100 * share:.3g} % of its samples are rejected",)
        return tuple(dict.fromkeys(whole))

    @property
    def verdict(self) -> str:
        """Whether the log is usable, in one line."""
        count = int(self.rejected.sum())
        if self.reasons:
            return f"not usable: {'; '.join(self.reasons)}"
        return f"usable without {count} of {len(self.log)} samples" if count else "usable"


def check(
    log: Log,
    robot: Robot | None = None,
    contacts: Sequence[Contact] = (),
    cutoff_hz: float | None = None,
    derived: tuple[str, ...] = (),
    declared: Declared | None = None,
    required: SensorSet | None = None,
) -> Checked:
    """Check a log as it was read.

    Args:
        log: as `read_log` returns it, with or without gaps.
        robot: the robot; without one, checks against its URDF are skipped.
        contacts: of the robot.
        cutoff_hz: cutoff [Hz] of the filter for preprocessing; None for the default.
        derived: prefixes of fields that torchid computed; no finding blames them. contact_active: flags come from
            torques. base_: the base's motion comes from standing feet; forces are compared with the URDF in the longest
            segment in which enough feet stand.
        declared: noise, delay, and unknown scales and offsets of an experiment; None: nothing is declared.
        required: sensors of a fit, which must be in the log; None for any.
    """
    log, unclosed = completed(without_welded_joints(log, robot), robot)
    if any(contact.along_normal for contact in contacts):  # wrenches are what is checked
        contacts = [replace(contact, along_normal=False) for contact in contacts]
        required = None
    results: list[Finding | Skipped] = list(check_magnitudes(log))
    if (blocking := _blocking_finding(results)) is not None:
        return _collect(log, log, [*results, _skip_dependent(blocking)])
    results += check_time_stamps(log)
    results += (missing := list(check_missing_values(log)))
    if (blocking := _blocking_finding(missing)) is not None:
        return _collect(log, log, [*results, _skip_dependent(blocking)])
    repaired = repair_log(log, _findings(results))
    results += (x for x in check_repeats(channel_groups(repaired)) if not _was_interpolated(x, missing))
    repaired = repair_log(log, _findings(results))
    results += check_jumps(repaired, channel_groups(repaired))
    repaired = repair_log(log, _findings(results))
    if units := list(check_angle_unit(repaired, robot)):  # thresholds of position steps are in radians
        results = [x for x in results if not (isinstance(x, Finding) and x.name == "step" and x.whole)]
    results += [*units, *([] if "contact_active" in derived else check_contact_flags(repaired, robot))]
    results += [*check_scalar_wrenches(repaired), *check_still_base(repaired), *check_excitation(repaired)]
    repaired = repair_log(log, _findings(results))
    blocking = _blocking_finding(results)
    if blocking is None or blocking.field != "time":
        results += _check_motion(repaired, robot)
    compared = repaired
    if _blocking_finding(results) is None:
        filled = rejected_samples((x for x in _findings(results) if x.field != "contact_active"), len(log))
        compared = _between_holes(repaired, filled)
        results += unclosed or check_loops(compared, robot)
        results += check_standing_feet(compared, robot, contacts, derived)
        results += check_slip(_in_the_air(repaired, filled), robot, contacts, cutoff_hz, derived)
    if "base_" in derived and robot is not None and _blocking_finding(results) is None:
        compared, unfit = _longest_standing(compared, robot, contacts)
        results += unfit
    if _blocking_finding(results) is None:
        results += _check_forces(compared, robot, contacts, cutoff_hz, derived, declared, required)
    blocking = _blocking_finding(results)
    if blocking is None or blocking.name == "sign":
        scaled = declared is not None and "contact_force" in declared.terms.scales
        results += check_weight(subtract_contact_offsets(compared), robot, scaled)
    else:
        results.append(_skip_dependent(blocking))
    return _collect(log, repaired, results)


def _check_motion(log: Log, robot: Robot | None) -> Iterator[Finding | Skipped]:
    """Whether positions, velocities and accelerations of the joints and the base agree."""
    yield from check_rest(log)
    yield from check_still_velocities(log)
    yield from check_derivatives(log)
    yield from check_angular_velocity(log, robot)
    yield from check_accelerometer(log, robot)


def _check_forces(
    log: Log,
    robot: Robot | None,
    contacts: Sequence[Contact],
    cutoff_hz: float | None,
    derived: tuple[str, ...],
    declared: Declared | None,
    required: SensorSet | None,
) -> Iterator[Finding | Skipped]:
    """Whether forces agree with the robot's file; arguments as of `check`."""
    unbiased = subtract_contact_offsets(log)
    yield from check_forces_against_urdf(unbiased, robot, contacts, cutoff_hz, derived, declared, required)
    yield from check_limb_sensors(log, robot, contacts, cutoff_hz)


def _longest_standing(log: Log, robot: Robot, contacts: Sequence[Contact]) -> tuple[Log, list[Finding]]:
    """The longest segment in which enough feet stand; or the log, and why there is none."""
    try:
        return longest_with_pose(log, robot, contacts), []
    except InputError as error:
        return log, [refused(error)]


def _was_interpolated(finding: Finding | Skipped, missing: Sequence[Finding]) -> bool:
    """Whether the finding concerns interpolated values only: values filled in at the ends repeat."""
    if isinstance(finding, Skipped):
        return False
    holes = [span for x in missing if x.field == finding.field for span in x.spans]
    spans = [
        [x for x in holes if x.channel == one.channel and x.first <= one.first <= one.last <= x.last + 1]
        for one in finding.spans
    ]
    return bool(spans) and all(spans)


def _between_holes(log: Log, filled: BoolArray) -> Log:
    """The longest part of a repaired log without long holes; samples `filled` (N,) in long holes show no motion."""
    edges = np.flatnonzero(np.diff(filled, prepend=False, append=False))
    first = edges[::2]
    last = edges[1::2]
    long = log.time[last - 1] - log.time[first] > _LONGEST_BRIDGED_S
    starts = np.append(0, last[long])
    ends = np.append(first[long], len(log))
    best = int(np.argmax(ends - starts))
    return log.select(slice(starts[best], ends[best])) if starts[best] < ends[best] else log


def _in_the_air(log: Log, samples: BoolArray) -> Log:
    """The log without contacts in some samples (N,)."""
    if log.contact_active is None or not samples.any():
        return log
    return replace(log, contact_active=log.contact_active & ~samples[:, None])


def _findings(results: Iterable[Finding | Skipped]) -> Iterator[Finding]:
    return (result for result in results if isinstance(result, Finding))


def _blocking_finding(results: Iterable[Finding | Skipped]) -> Finding | None:
    """The first finding that rejects the whole log: later checks cannot rely on its field."""
    return next((finding for finding in _findings(results) if finding.rejects_all), None)


def _skip_dependent(blocking: Finding) -> Skipped:
    return Skipped("all further checks", f"all samples of {blocking.field} are rejected: {blocking.name}")


def _collect(log: Log, repaired: Log, results: Sequence[Finding | Skipped]) -> Checked:
    merged = explained(tuple(_merge_alike(_findings(results))), len(log))
    findings = sorted(merged, key=lambda finding: SEVERITIES.index(finding.severity))
    return Checked(log, repaired, tuple(findings), tuple(skip for skip in results if isinstance(skip, Skipped)))


def _merge_alike(findings: Iterable[Finding]) -> Iterator[Finding]:
    """One finding for all of one kind in one field."""
    groups: dict[tuple[str, str, str, str], list[Finding]] = {}
    for finding in findings:
        groups.setdefault((finding.name, finding.severity, finding.field, finding.advice), []).append(finding)
    for alike in groups.values():
        texts = [finding.found for finding in alike]
        more = f"; and {len(texts) - _MAX_LISTED_TEXTS} more" if len(texts) > _MAX_LISTED_TEXTS else ""
        yield replace(
            alike[0],
            found="; ".join(texts[:_MAX_LISTED_TEXTS]) + more,
            channels=tuple(dict.fromkeys(channel for finding in alike for channel in finding.channels)),
            spans=tuple(span for finding in alike for span in finding.spans),
        )


def rejected_samples(findings: Iterable[Finding], samples: int) -> BoolArray:
    """Which of `samples` samples are rejected by any finding, (N,)."""
    mask = np.zeros(samples, bool)
    for finding in findings:
        if finding.severity == REJECTED:
            mask |= finding.mask(samples)
    return mask


def repair_log(log: Log, findings: Iterable[Finding]) -> Log:
    """The log with rejected values interpolated and without jumps that are not motions.

    Only the channels of a finding change: its samples are left out of the fit, but not out of the filter. Contact flags
    that miss a force are set. Findings about the whole log change nothing.
    """
    local = [finding for finding in findings if finding.severity == REJECTED and not finding.whole]
    changed: dict[str, Any] = {}
    for field in dict.fromkeys(field for finding in local for field in _affected_fields(log, finding.field)):
        flat = np.array(getattr(log, field), dtype=np.float64).reshape(len(log), -1)
        bad = np.zeros(flat.shape, dtype=bool)
        for finding in local:
            if finding.field in (field, "time"):
                _mark_rejected(finding, channel_names(log, field), flat, bad)
        _interpolate(log.time, flat, bad)
        if field == "base_quat_xyzw":
            flat /= np.linalg.norm(flat, axis=1, keepdims=True)
        changed[field] = flat.reshape(getattr(log, field).shape)
    flags = [span for finding in local if finding.field == "contact_active" for span in finding.spans]
    if flags and log.contact_active is not None:
        changed["contact_active"] = log.contact_active.copy()
        for span in flags:
            changed["contact_active"][span.first : span.last + 1, log.contact_names.index(span.channel)] = True
    return dataclasses.replace(log, **changed) if changed else log


def _affected_fields(log: Log, field: str) -> list[str]:
    """Fields whose values a finding about `field` affects: all signals, if it is about time."""
    if field == "time":
        return [name for name, array in log.arrays().items() if name != "time" and array.dtype != np.bool_]
    return [] if field == "contact_active" else [field]


def _mark_rejected(finding: Finding, names: tuple[str, ...], flat: FloatArray, bad: BoolArray) -> None:
    """Mark the rejected values of the channels (N, c) in `bad`, and subtract the finding's shifts."""
    for span in finding.spans:
        columns = names.index(span.channel) if span.channel in names else slice(None)
        bad[span.first : span.last + 1, columns] = True
        if span.shift:
            flat[span.last :, columns] -= span.shift


def _interpolate(time: FloatArray, flat: FloatArray, bad: BoolArray) -> None:
    """Interpolate the bad values of each column in place; at the ends, repeat the nearest good value."""
    for column in np.flatnonzero(bad.any(axis=0)):
        good = ~bad[:, column] & np.isfinite(flat[:, column])
        if good.any():
            rows = bad[:, column]
            flat[rows, column] = np.interp(time[rows], time[good], flat[good, column])


def excluded_stamps(checked: Checked, time: FloatArray, cutoff_hz: float | None, derived: bool) -> BoolArray:
    """Which stamps (K,) [s] of a preprocessed log are affected by rejected samples.

    Args:
        checked: the log as recorded.
        time: of the preprocessed log.
        cutoff_hz: cutoff of the filter, which spreads a sample over `REACH_PERIODS` to either side; None without one.
        derived: whether the log was filtered, differentiated or resampled, which affects neighbouring samples.
    """
    step = median_step(checked.log)
    margin = JITTER * step + (DROPPED_SAMPLES * step if derived else 0.0)
    if cutoff_hz is not None:
        margin += REACH_PERIODS / cutoff_hz
    rejected = checked.log.time[checked.rejected]
    nearest = np.searchsorted(rejected, time)
    padded = np.concatenate([[-np.inf], rejected, [np.inf]])
    return np.asarray((time - padded[nearest] <= margin) | (padded[nearest + 1] - time <= margin))


def drop_rejected(samples: Samples, checked: Checked, cutoff_hz: float | None, derived: bool) -> Samples:
    """The samples without those near rejected samples; see `excluded_stamps`.

    Raises:
        LogError: the log is not usable, or no sample is left.

    Warns:
        TorchidWarning: number of excluded samples, with the reasons.
    """
    source = samples.source
    if not checked.usable:
        accepted = "a log that torchid check finds usable, or preprocessing.exclude_rejected: false"
        raise LogError(source, "preprocessing.exclude_rejected", checked.verdict, accepted)
    excluded = excluded_stamps(checked, samples.time.cpu().numpy(), cutoff_hz, derived)
    if not excluded.any():
        return samples
    reasons = _exclusion_reasons(checked)
    if excluded.all():
        raise LogError(source, "preprocessing.exclude_rejected", f"all samples are excluded: {reasons}", "a longer log")
    warn(f"{log_title(source)}: {excluded.sum()} of {len(samples)} samples excluded: {reasons}")
    return samples[torch.from_numpy(np.flatnonzero(~excluded))]


def _exclusion_reasons(checked: Checked) -> str:
    """Names of the rejecting findings with their samples."""
    reasons = []
    for finding in checked.findings:
        if finding.severity == REJECTED:
            spans = list(dict.fromkeys(str(span) for span in finding.spans))
            more = f" and {len(spans) - _MAX_LISTED_SPANS} more" if len(spans) > _MAX_LISTED_SPANS else ""
            reasons.append(f"{finding.field} {finding.name} at samples {', '.join(spans[:_MAX_LISTED_SPANS])}{more}")
    return "; ".join(reasons)
