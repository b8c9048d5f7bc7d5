"""Tables of what the sensor planner found."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from torchid.analysis.base_check import LostBase, StateCheck
from torchid.analysis.candidates import Candidate
from torchid.analysis.demands import TOLERANCE
from torchid.analysis.planner import PartPlan, SensorPlan

_MOST, _CURES, _BASE = 5, 8, 6
_NEARLY = 1e-3  # of S_b V_x: the noise of the base's rows is a thousand times that of the sensors


def set_text(chosen: Sequence[Candidate]) -> str:
    """Names of sensors, joined by commas."""
    return ", ".join(candidate.name for candidate in chosen) or "none"


def branch_table(plan: SensorPlan) -> Table:
    """Branches of the robot, which contacts constrain them, and what each group of contacts needs."""
    table = _table("Branches", "branch", "contacts beyond it", "sensors needed")
    nothing = "" if plan.question.robot.fixed_base else "none"
    for branch in plan.branches:
        needed = [f"{n.needed} for {' + '.join(n.contacts)}" for n in plan.needs if branch.name in n.branches]
        contacts = ", ".join(branch.contacts) or "free"
        table.add_row(Text(branch.name), Text(contacts), Text("; ".join(needed) or nothing))
    for need in plan.needs:
        if not need.branches:
            table.add_row("(base)", Text(", ".join(need.contacts)), str(need.needed))
    return table


def sets_table(parts: Sequence[PartPlan]) -> Table:
    """The cheapest sets of every part of the robot, most informative first."""
    table = _table("Smallest sets, most informative first", "contacts", "minimal sets", "bits", "sensors")
    for part in parts:
        for place, (bits, chosen) in enumerate(part.ranked[:_MOST]):
            first = place == 0
            count = "" if not first else "not counted" if part.sets is None else str(len(part.sets))
            table.add_row(Text(", ".join(part.frames) if first else ""), count, f"{bits:.1f}", Text(set_text(chosen)))
        if len(part.ranked) > _MOST:
            table.add_row("", "", "", f"({len(part.ranked) - _MOST} more in analysis.json)")
    return table


def check_table(title: str, checks: Sequence[StateCheck]) -> Table:
    """rank(S_b V_x) and its smallest singular value over random postures, at position zero and over the logs'."""
    table = _table(f"{title}: rank(S_b V_x), its smallest singular value", "in contact")
    table.columns[0].ratio = 1
    for heading in ("rank", "median", "5 %", "zero\nposture", "logs\nmedian", "logs\nleast"):
        table.add_column(heading, justify="right", no_wrap=True)
    for check in checks:
        zero = f"rank {check.zero.rank}" if check.zero.rank < check.generic.rank else f"{check.zero.least:.2g}"
        logs = ("-", "-") if check.recorded is None else (f"{check.recorded.median:.2g}", f"{check.recorded.least:.2g}")
        random = (f"{check.generic.rank} of 6", f"{check.generic.median:.2g}", f"{check.generic.low:.2g}")
        table.add_row(Text(check.name), *random, zero, *logs)
    return table


def check_lines(checks: Sequence[StateCheck]) -> list[str]:
    """What is lost and what would cure it, and where a set is singular."""
    lines = []
    by_loss: dict[tuple[object, ...], list[StateCheck]] = {}
    for check in checks:
        if check.lost is not None:
            by_loss.setdefault((check.lost.words, check.lost.culprits, check.lost.cures), []).append(check)
    for same in by_loss.values():
        lost, where = same[0].lost, f"{len(same)} of {len(checks)} contact states"
        if lost is not None:
            short = " and ".join(f"{' + '.join(frames)} lacks {_count(count)}" for frames, count in lost.culprits)
            lines.append(f"{short} in {where}; lost is the {_words(lost)}")
            cures = set_text(lost.cures[:_CURES]) if lost.cures else "no single candidate"
            lines.append(f"  any of these would help: {cures}")
    near = [check for check in checks if check.lost is None and check.recorded and check.recorded.least < _NEARLY]
    if near:
        least = min(check.recorded.least for check in near if check.recorded)
        lines.append(
            f"warning: at some postures of the logs the base is all but lost (smallest singular value {least:.2g})"
        )
    rare = sum(check.lost is None and check.generic.low < TOLERANCE for check in checks)
    if rare:
        where = f"{rare} of {len(checks)} contact states"
        lines.append(f"warning: in {where} the base is as good as lost at one random posture in twenty or more")
    falling = [check for check in checks if check.lost is None and check.zero.rank < check.generic.rank]
    if falling:
        alike = dict.fromkeys(names for check in falling for names in check.coincident)
        cause = "; ".join(" = ".join(names) for names in alike)
        lines.append(
            "warning: the base is lost where all joints are at zero, and all but lost near it"
            + (f"; sensors that read alike there: {cause}" if cause else "")
        )
    return lines


def _words(lost: LostBase) -> str:
    return "whole base" if len(lost.words) == _BASE else f"base's {' and '.join(lost.words)}"


def _count(sensors: int) -> str:
    return "1 sensor" if sensors == 1 else f"{sensors} sensors"


def removal_table(plan: SensorPlan) -> Table:
    """What is left without one sensor, by the criterion of each sample and by the stack of all."""
    title = (
        f"Without one sensor (inertial combinations: {plan.stack_rank} with this set, "
        f"{plan.stack_full} with every candidate)"
    )
    table = _table(title, "without", "rank(S_b V_x) of each sample", "combinations, all samples together")
    for removal in plan.removals:
        rank = "fixed base" if removal.base_rank is None else f"{removal.base_rank} of 6"
        table.add_row(Text(removal.candidate.name), rank, str(removal.stack_rank))
    return table


def _table(title: str, *headings: str) -> Table:
    table = Table(title=title, title_justify="left")
    for place, heading in enumerate(headings):
        table.add_column(heading, overflow="fold", justify="left" if place == 0 or heading == "sensors" else "right")
    return table
