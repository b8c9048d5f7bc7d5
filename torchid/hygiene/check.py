"""All checks of one log, in the order in which each can rely on those before it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from torchid.hygiene.angles import angles
from torchid.hygiene.channels import groups
from torchid.hygiene.derivatives import derivatives
from torchid.hygiene.finding import SEVERITIES, Finding, Skipped
from torchid.hygiene.forces import forces
from torchid.hygiene.frozen import frozen
from torchid.hygiene.limb_sensors import limb_sensors
from torchid.hygiene.missing import absurd, missing
from torchid.hygiene.repair import condemned, repaired
from torchid.hygiene.spikes import spikes
from torchid.hygiene.stamps import stamps
from torchid.hygiene.standing import standing
from torchid.hygiene.touching import touching, without_offsets
from torchid.hygiene.turning import turning
from torchid.hygiene.weight import accelerometer, weight
from torchid.logs import Log
from torchid.logs.fields import BoolArray
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
        return condemned(self.findings, len(self.log))

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
    found: list[Finding | Skipped] = list(absurd(log))
    if (lost := _lost(found)) is not None:
        return _concluded(log, log, [*found, _unchecked(lost)])
    found += stamps(log)
    found += (gaps := list(missing(log)))
    if (lost := _lost(gaps)) is not None:
        return _concluded(log, log, [*found, _unchecked(lost)])
    mended = repaired(log, _findings(found))
    found += frozen(groups(mended))
    mended = repaired(log, _findings(found))
    found += spikes(mended, groups(mended))
    mended = repaired(log, _findings(found))
    if units := list(angles(mended, robot)):  # what a step of a position is worth is told in radians
        found = [one for one in found if not (isinstance(one, Finding) and one.name == "step" and one.whole)]
    found += [*units, *touching(mended)]
    mended = repaired(log, _findings(found))
    if (lost := _lost(found)) is None or lost.field != "time":
        found += [*derivatives(mended), *turning(mended, robot), *accelerometer(mended, robot)]
    if _lost(found) is None:
        found += standing(mended, robot, contacts)
    lost = _lost(found)
    if lost is None:
        found += forces(without_offsets(mended), robot, contacts, cutoff_hz)
        found += limb_sensors(mended, robot, contacts, cutoff_hz)
        lost = _lost(found)
    if lost is None or lost.name == "sign":
        found += weight(without_offsets(mended), robot)
    else:
        found.append(_unchecked(lost))
    return _concluded(log, mended, found)


def _concluded(log: Log, mended: Log, found: Sequence[Finding | Skipped]) -> Checked:
    findings = sorted(_merged(_findings(found)), key=lambda finding: SEVERITIES.index(finding.severity))
    return Checked(log, mended, tuple(findings), tuple(skip for skip in found if isinstance(skip, Skipped)))


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
    """A finding that condemns the whole log, after which nothing can be told from what relies on the field."""
    return next((one for one in _findings(found) if one.condemns_all), None)
