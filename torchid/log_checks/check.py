"""All checks of one log, each relying on those before it, and a log without what they condemned."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchid.errors import LogError, warn
from torchid.log_checks.contacts import (
    check_contact_flags,
    check_limb_sensors,
    check_standing_feet,
    subtract_contact_offsets,
)
from torchid.log_checks.findings import (
    CONDEMNED,
    SEVERITIES,
    Finding,
    Skipped,
    channel_groups,
    channel_names,
    median_step,
)
from torchid.log_checks.forces import check_forces_against_urdf
from torchid.log_checks.frozen import check_repeats
from torchid.log_checks.motion import check_angle_unit, check_angular_velocity, check_derivatives
from torchid.log_checks.spikes import check_jumps
from torchid.log_checks.stamps import check_magnitudes, check_missing_values, check_time_stamps
from torchid.log_checks.weight import check_accelerometer, check_weight
from torchid.logs import Log
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.timeline import DROPPED_SAMPLES, JITTER, REACH_PERIODS
from torchid.problem import Samples
from torchid.robot import Robot
from torchid.sensing import Contact

#: Share of a log's samples that may be condemned before nothing worth a fit is left.
MOST_CONDEMNED = 0.5
_SPELLED_OUT = 3


@dataclass(frozen=True, eq=False)
class Checked:
    """A log with what was found in it.

    Attributes:
        log: as it was read.
        repaired: with condemned values interpolated, so that a filter has nothing to smear.
        findings: the gravest first.
        skipped: checks that could not be made.
    """

    log: Log
    repaired: Log
    findings: tuple[Finding, ...]
    skipped: tuple[Skipped, ...]

    @cached_property
    def condemned(self) -> BoolArray:
        """Which samples (N,) must not be fitted."""
        return condemned_samples(self.findings, len(self.log))

    @property
    def usable(self) -> bool:
        """Whether enough of the log may be fitted."""
        return not self.reasons

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why the log cannot be used; empty if it can."""
        whole = tuple(f"{f.field}: {f.name}" for f in self.findings if f.condemns_all)
        share = float(self.condemned.mean()) if len(self.log) else 1.0
        if not whole and share > MOST_CONDEMNED:
            return (f"{100 * share:.3g} % of its samples are condemned",)
        return tuple(dict.fromkeys(whole))

    @property
    def verdict(self) -> str:
        """In one line."""
        count = int(self.condemned.sum())
        if self.reasons:
            return f"not usable: {'; '.join(self.reasons)}"
        return f"usable without {count} of {len(self.log)} samples" if count else "usable"


def check(
    log: Log, robot: Robot | None = None, contacts: Sequence[Contact] = (), cutoff_hz: float | None = None
) -> Checked:
    """Check a log as it was read.

    Args:
        log: as `read_log` gives it, if need be with gaps.
        robot: the robot; without one, what needs its URDF is skipped.
        contacts: of the robot.
        cutoff_hz: of the filter that the log will go through; None for a usual one.
    """
    found: list[Finding | Skipped] = list(check_magnitudes(log))
    if (lost := _lost(found)) is not None:
        return _concluded(log, log, [*found, _unchecked(lost)])
    found += check_time_stamps(log)
    found += (gaps := list(check_missing_values(log)))
    if (lost := _lost(gaps)) is not None:
        return _concluded(log, log, [*found, _unchecked(lost)])
    repaired = repair_log(log, _findings(found))
    found += check_repeats(channel_groups(repaired))
    repaired = repair_log(log, _findings(found))
    found += check_jumps(repaired, channel_groups(repaired))
    repaired = repair_log(log, _findings(found))
    if units := list(check_angle_unit(repaired, robot)):  # sizes of steps are meant in radians
        found = [one for one in found if not (isinstance(one, Finding) and one.name == "step" and one.whole)]
    found += [*units, *check_contact_flags(repaired)]
    repaired = repair_log(log, _findings(found))
    if (lost := _lost(found)) is None or lost.field != "time":
        found += [
            *check_derivatives(repaired),
            *check_angular_velocity(repaired, robot),
            *check_accelerometer(repaired, robot),
        ]
    if _lost(found) is None:
        found += check_standing_feet(repaired, robot, contacts)
    lost = _lost(found)
    if lost is None:
        found += check_forces_against_urdf(subtract_contact_offsets(repaired), robot, contacts, cutoff_hz)
        found += check_limb_sensors(repaired, robot, contacts, cutoff_hz)
        lost = _lost(found)
    if lost is None or lost.name == "sign":
        found += check_weight(subtract_contact_offsets(repaired), robot)
    else:
        found.append(_unchecked(lost))
    return _concluded(log, repaired, found)


def _concluded(log: Log, repaired: Log, found: Sequence[Finding | Skipped]) -> Checked:
    findings = sorted(_merged(_findings(found)), key=lambda finding: SEVERITIES.index(finding.severity))
    return Checked(log, repaired, tuple(findings), tuple(skip for skip in found if isinstance(skip, Skipped)))


def _unchecked(lost: Finding) -> Skipped:
    return Skipped("what relies on it", f"{lost.field} is condemned throughout: {lost.name}")


def _findings(found: Iterable[Finding | Skipped]) -> Iterator[Finding]:
    return (one for one in found if isinstance(one, Finding))


def _merged(found: Iterable[Finding]) -> Iterator[Finding]:
    """Findings of the same kind in one field as one."""
    alike: dict[tuple[str, str, str, str], list[Finding]] = {}
    for one in found:
        alike.setdefault((one.name, one.severity, one.field, one.advice), []).append(one)
    for same in alike.values():
        texts = [one.found for one in same]
        more = f"; and {len(texts) - _SPELLED_OUT} more" if len(texts) > _SPELLED_OUT else ""
        yield replace(
            same[0],
            found="; ".join(texts[:_SPELLED_OUT]) + more,
            channels=tuple(dict.fromkeys(channel for one in same for channel in one.channels)),
            spans=tuple(span for one in same for span in one.spans),
        )


def _lost(found: Iterable[Finding | Skipped]) -> Finding | None:
    """A finding that condemns the whole log: checks that rely on its field would be meaningless."""
    return next((one for one in _findings(found) if one.condemns_all), None)


def condemned_samples(findings: Iterable[Finding], samples: int) -> BoolArray:
    """Which of so many samples some finding condemns, (N,)."""
    mask = np.zeros(samples, bool)
    for finding in findings:
        if finding.severity == CONDEMNED:
            mask |= finding.mask(samples)
    return mask


def repair_log(log: Log, findings: Iterable[Finding]) -> Log:
    """The log with condemned values interpolated, and with jumps taken out that are no motion.

    Only the channels that a finding names are changed: the samples stay out of the fit, but not out of the filter. A
    flag that misses a contact is set. Findings that concern the whole log leave nothing to go by and change nothing.
    """
    local = [finding for finding in findings if finding.severity == CONDEMNED and not finding.whole]
    changed: dict[str, Any] = {}
    for field in dict.fromkeys(field for finding in local for field in _touched(log, finding.field)):
        flat = np.array(getattr(log, field), dtype=np.float64).reshape(len(log), -1)
        bad = np.zeros(flat.shape, dtype=bool)
        for finding in local:
            if finding.field in (field, "time"):
                _mark(finding, channel_names(log, field), flat, bad)
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


def _mark(finding: Finding, names: tuple[str, ...], flat: FloatArray, bad: BoolArray) -> None:
    """Mark what a finding condemns in the channels (N, c), and take its shifts out of them."""
    for span in finding.spans:
        columns = names.index(span.channel) if span.channel in names else slice(None)
        bad[span.first : span.last + 1, columns] = True
        if span.shift:
            flat[span.last :, columns] -= span.shift


def _touched(log: Log, field: str) -> list[str]:
    """Fields whose values a finding about `field` makes doubtful: all signals, if it is about time."""
    if field == "time":
        return [name for name, array in log.arrays().items() if name != "time" and array.dtype != np.bool_]
    return [] if field == "contact_active" else [field]


def _interpolate(time: FloatArray, flat: FloatArray, bad: BoolArray) -> None:
    """Replace the bad values of each column in place; at the ends they stay at the nearest good one."""
    for column in np.flatnonzero(bad.any(axis=0)):
        good = ~bad[:, column] & np.isfinite(flat[:, column])
        if good.any():
            here = bad[:, column]
            flat[here, column] = np.interp(time[here], time[good], flat[good, column])


_NAMED = 4


def excluded_stamps(checked: Checked, time: FloatArray, cutoff_hz: float | None, derived: bool) -> BoolArray:
    """Which stamps (K,) [s] of a preprocessed log condemned samples reach.

    Args:
        checked: the log as recorded.
        time: of the preprocessed log.
        cutoff_hz: of the filter, which smears a sample over its reach to either side; None without one.
        derived: whether anything was filtered, differentiated or resampled, which takes neighbours along.
    """
    step = median_step(checked.log)
    margin = JITTER * step + (DROPPED_SAMPLES * step if derived else 0.0)
    if cutoff_hz is not None:
        margin += REACH_PERIODS / cutoff_hz
    condemned = checked.log.time[checked.condemned]
    nearest = np.searchsorted(condemned, time)
    padded = np.concatenate([[-np.inf], condemned, [np.inf]])
    return np.asarray((time - padded[nearest] <= margin) | (padded[nearest + 1] - time <= margin))


def drop_condemned(samples: Samples, checked: Checked, cutoff_hz: float | None, derived: bool) -> Samples:
    """The samples that condemned ones do not reach; see `excluded_stamps`.

    Raises:
        LogError: the log is not usable, or nothing is left.

    Warns:
        TorchidWarning: how many samples were left out, and why.
    """
    source = samples.source
    if not checked.usable:
        accepted = "a log that torchid check finds usable, or preprocessing.exclude_condemned: false"
        raise LogError(source, "preprocessing.exclude_condemned", checked.verdict, accepted)
    gone = excluded_stamps(checked, samples.time.cpu().numpy(), cutoff_hz, derived)
    if not gone.any():
        return samples
    reasons = _reasons(checked)
    if gone.all():
        raise LogError(source, "preprocessing.exclude_condemned", f"no sample left: {reasons}", "a longer log")
    message = f"{Path(source).name}: {gone.sum()} of {len(samples)} samples excluded: {reasons}"
    warn(message)
    return samples[torch.from_numpy(np.flatnonzero(~gone))]


def _reasons(checked: Checked) -> str:
    """What condemns samples, and where."""
    found = []
    for finding in checked.findings:
        if finding.severity == CONDEMNED:
            spans = list(dict.fromkeys(str(span) for span in finding.spans))
            more = f" and {len(spans) - _NAMED} more" if len(spans) > _NAMED else ""
            found.append(f"{finding.field} {finding.name} at samples {', '.join(spans[:_NAMED])}{more}")
    return "; ".join(found)
