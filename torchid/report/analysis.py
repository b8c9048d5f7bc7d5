"""Results of `torchid analyze`: tables, text and `analysis.json`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap
from typing import Any

import numpy as np
from rich.table import Table

from torchid.errors import format_count, format_percent
from torchid.fitting.left_out import Evidence
from torchid.identifiability.base_parameters import BaseParameters, format_base_parameters, unobservable_parameters
from torchid.problem import Metrics
from torchid.problem.metrics import ROW_GROUPS
from torchid.report.tables import make_table
from torchid.rounding import BASE_RANK_TOLERANCE
from torchid.sensor_planning.observability import BaseObservability, Candidate, LostBase, PostureSummary
from torchid.sensor_planning.planner import PartPlan, SensorPlan

#: Columns of text.
_WIDTH = 100
_LONGEST_NAME = 20  # of a sensor set that a table does not break
_MAX_SETS = 5  # that are listed
_MAX_REMEDIES = 8
_BASE_DIRECTIONS = 6
#: Smallest singular value of S_b V_x: below, the noise of the base's rows is a thousand times that of the sensors.
_MIN_SINGULAR_VALUE = 1e-3


def sensor_plan_document(plan: SensorPlan) -> dict[str, Any]:
    """The sensor plan for `analysis.json`, sensors by name."""
    problem = plan.problem
    frames = [contact.frame for contact in problem.contacts]
    return {
        "contact_states": [[f for f, active in zip(frames, state, strict=True) if active] for state in problem.states],
        "criterion": problem.criterion,
        "candidates": [{"name": c.name, "channels": c.channels, "cost": c.cost} for c in problem.candidates],
        "keep": _names(c for c in problem.candidates if c in problem.keep),
        "exclude": _names(c for c in problem.candidates if c in problem.exclude),
        "sensors": _names(plan.chosen),
        "cost": plan.cost,
        "lower_bound": plan.lower_bound,
        "proven": plan.proven,
        "parts": [
            {
                "contacts": list(part.frames),
                "candidates": _names(part.candidates),
                "minimal_sets": None if part.sets is None else [_names(chosen) for chosen in part.sets],
                "cheapest": [{"bits": bits, "sensors": _names(chosen)} for bits, chosen in part.ranked],
            }
            for part in plan.parts
        ],
        "branches": [
            {"joints": list(b.joints), "contacts": list(b.contacts), "constrained": b.constrained}
            for b in plan.branches
        ],
        "needs": [
            {"contacts": list(n.contacts), "joints": list(n.joints), "sensors": n.fewest_readings, "proven": n.proven}
            for n in plan.requirements
        ],
        "checks": observability_document(plan.observability),
        "stack": {"rank": plan.stack_rank, "full": plan.stack_full},
        "without": [
            {"sensor": r.candidate.name, "base_rank": r.base_rank, "stack_rank": r.stack_rank} for r in plan.removals
        ],
    }


def observability_document(states: Sequence[BaseObservability]) -> list[dict[str, Any]]:
    """Observability of the base, state by state."""
    return [
        {
            "state": state.name,
            "random_postures": _values(state.generic),
            "zero_posture": _values(state.zero),
            "logs": None if state.recorded is None else _values(state.recorded),
            "lost": None
            if state.lost is None
            else {
                "directions": state.lost.directions.T.tolist(),
                "words": list(state.lost.descriptions),
                "posture": state.lost.posture.tolist(),
                "lacking": [{"contacts": list(frames), "sensors": count} for frames, count in state.lost.unmet_groups],
                "would_help": _names(state.lost.remedies),
            },
            "alike_at_zero_posture": [list(names) for names in state.dependent],
        }
        for state in states
    ]


def _names(chosen: Iterable[Candidate]) -> list[str]:
    return [candidate.name for candidate in chosen]


def _values(values: PostureSummary) -> dict[str, float | int]:
    return {"rank": values.rank, "median": values.median, "low": values.low, "least": values.least}


def base_parameters_document(base: BaseParameters, body_names: Sequence[str]) -> dict[str, Any]:
    """Base parameters: rank, formulas, and unobservable parameters."""
    return {
        "rank": base.rank,
        "parameters": int(base.free.sum()),
        "gap": base.gap if base.rank else None,
        "relations": format_base_parameters(base, body_names),
        "unobservable": unobservable_parameters(base, body_names),
    }


def base_parameters_text(title: str, base: BaseParameters, body_names: Sequence[str]) -> str:
    """Base parameters as text of 100 columns."""
    count = f"{base.rank} base parameters (combinations of {int(base.free.sum())} parameters) in SI units:"
    lines = [title, "=" * len(title), "", count, ""]
    for formula in format_base_parameters(base, body_names):
        lines += wrap(formula, _WIDTH, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False)
    unobservable = unobservable_parameters(base, body_names)
    lines += ["", "Unobservable with any motion:", "", *(unobservable or ["none"])]
    return "\n".join(lines) + "\n"


def candidate_names(chosen: Sequence[Candidate]) -> str:
    """Names of sensors, joined by commas."""
    return ", ".join(candidate.name for candidate in chosen) or "none"


def branch_table(plan: SensorPlan) -> Table:
    """Branches of the robot, the contacts that constrain them, and the sensors that each group of contacts needs."""
    no_sensors = "" if plan.problem.robot.fixed_base else "none"
    rows = []
    for branch in plan.branches:
        groups = [group for group in plan.requirements if branch.name in group.branches]
        needed = "; ".join(f"{group.fewest_readings} for {' + '.join(group.contacts)}" for group in groups)
        rows.append((branch.name, ", ".join(branch.contacts) or "free", needed or no_sensors))
    of_base = [group for group in plan.requirements if not group.branches]
    rows += [("(base)", ", ".join(group.contacts), str(group.fewest_readings)) for group in of_base]
    return make_table("Branches", ("branch", "contacts", "sensors needed"), rows)


def sets_table(parts: Sequence[PartPlan]) -> Table:
    """The cheapest sets of every part of the robot, most informative first."""
    rows = []
    for part in parts:
        begins = ", ".join(part.frames), "not counted" if part.sets is None else str(len(part.sets))
        for bits, chosen in part.ranked[:_MAX_SETS]:
            rows.append((*begins, f"{bits:.1f}", candidate_names(chosen)))
            begins = "", ""
        if len(part.ranked) > _MAX_SETS:
            rows.append(("", "", "", f"({len(part.ranked) - _MAX_SETS} more in analysis.json)"))
    headings = ("contacts", "minimal sets", "bits", "sensors")
    return make_table("Smallest sets, most informative first", headings, rows, left=("sensors",))


def observability_table(title: str, states: Sequence[BaseObservability]) -> Table:
    """rank(S_b V_x) and its smallest singular value over random postures, at position zero and over the logs."""

    def row(state: BaseObservability) -> Sequence[str]:
        zero = f"rank {state.zero.rank}" if state.zero.rank < state.generic.rank else f"{state.zero.least:.2g}"
        logs = ("-", "-") if state.recorded is None else (f"{state.recorded.median:.2g}", f"{state.recorded.least:.2g}")
        random = (f"{state.generic.rank} of 6", f"{state.generic.median:.2g}", f"{state.generic.low:.2g}")
        return (state.name, *random, zero, *logs)

    headings = ("in contact", "rank", "median", "5 %", "zero\nposture", "logs\nmedian", "logs\nleast")
    table = make_table(f"{title}: rank(S_b V_x), its smallest singular value", headings, map(row, states))
    table.columns[0].ratio = 1
    for column in table.columns[1:]:
        column.no_wrap = True
    return table


def resting_message(share: float) -> str:
    """That some torques, of joints at rest, are left out, which ranks of the base ignore."""
    what = f"actuators.stiction leaves out {format_percent(share)} % of the torques, as joints rest"
    return f"{what}. Observability of the base is judged as if all joints moved."


def describe_losses(states: Sequence[BaseObservability]) -> list[str]:
    """Unobservable directions of the base with remedies, a message for each different loss."""
    messages = []
    by_loss: dict[tuple[object, ...], list[LostBase]] = {}
    for lost in (state.lost for state in states if state.lost is not None):
        by_loss.setdefault((lost.descriptions, lost.unmet_groups, lost.remedies), []).append(lost)
    for alike in by_loss.values():
        lost = alike[0]
        count = f"{len(alike)} of {format_count(len(states), 'contact state')}"
        lacking = [
            f"{' + '.join(frames)} needs {format_count(number, 'more sensor')}" for frames, number in lost.unmet_groups
        ]
        remedies = candidate_names(lost.remedies[:_MAX_REMEDIES]) if lost.remedies else "more than one sensor"
        whole = len(lost.descriptions) == _BASE_DIRECTIONS
        directions = "whole base" if whole else f"base's {' and '.join(lost.descriptions)}"
        messages.append(f"{' and '.join(lacking)} in {count}. Add one of: {remedies}. Unobservable: the {directions}")
    return messages


def describe_singular_postures(states: Sequence[BaseObservability], beyond_logs: bool = True) -> list[str]:
    """Postures at which the base is unobservable, or almost, with sensors that determine it elsewhere.

    `beyond_logs`: whether postures count that are not in the logs.
    """
    messages = []
    kept = [state for state in states if state.lost is None]
    near = [state.recorded.least for state in kept if state.recorded and state.recorded.least < _MIN_SINGULAR_VALUE]
    if near:
        where = f"At some postures of the logs the base is almost unobservable (singular value {min(near):.2g})"
        messages.append(f"{where}. Use other postures, or more sensors.")
    kept = [state for state in kept if beyond_logs or state.recorded is None]
    rare = sum(state.generic.low < BASE_RANK_TOLERANCE for state in kept)
    if rare:
        where = f"{rare} of {format_count(len(states), 'contact state')}"
        messages.append(f"In {where} the base is almost unobservable at 5 % or more of random postures.")
    singular = [state for state in kept if state.zero.rank < state.generic.rank]
    if singular:
        dependent = dict.fromkeys(names for state in singular for names in state.dependent)
        cause = "; ".join(" = ".join(names) for names in dependent)
        messages.append(
            "The base is unobservable with all joints at zero. Move away from there."
            + (f" Dependent readings there: {cause}." if cause else "")
        )
    return messages


def removal_table(plan: SensorPlan) -> Table:
    """Ranks without one sensor, of each sample and of the stack of all samples."""
    title = (
        f"Without one sensor (inertial base parameters: {plan.stack_rank} with this set, "
        f"{plan.stack_full} with all candidates)"
    )
    rows = (
        (x.candidate.name, "fixed base" if x.base_rank is None else f"{x.base_rank} of 6", str(x.stack_rank))
        for x in plan.removals
    )
    return make_table(title, ("without", "rank(S_b V_x) of each sample", "base parameters, all samples"), rows)


@dataclass(frozen=True)
class SetAccuracy:
    """Errors of a fit with one sensor set, measured on the test logs, if any.

    `confounded`: what the set does not separate, in words. `advice`: what not to trust and to do about each.
    """

    channels: int
    rank: int
    measured: Metrics | None
    confounded: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, object]:
        """Rms by group of rows."""
        return {
            "channels": self.channels,
            "rank": self.rank,
            "confounded": list(self.confounded),
            "measured": None if self.measured is None else self.measured.rms,
        }


def accuracy_table(sets: Mapping[str, SetAccuracy]) -> Table:
    """Rms error by group of rows, where it was measured."""

    def row(name: str, accuracy: SetAccuracy) -> Sequence[str]:
        errors = {} if accuracy.measured is None else accuracy.measured.rms
        numbers = ("-" if (x := errors.get(group)) is None else f"{x:.3g}" for group in ROW_GROUPS)
        return name, str(accuracy.channels), str(accuracy.rank), *numbers

    headings = ("sensors", "channels", "rank", *(label.replace(" [", "\n[") for label in ROW_GROUPS.values()))
    table = make_table("Accuracy of sensor sets, rms error on the test logs", headings, (row(*x) for x in sets.items()))
    table.columns[0].min_width = min(max(map(len, sets), default=0), _LONGEST_NAME)
    return table


def confounded_messages(sets: Mapping[str, SetAccuracy], in_short: bool = False) -> list[str]:
    """What some sets do not separate, with their names; `in_short`: what to do about it alone."""
    names: dict[str, list[str]] = {}
    for name, accuracy in sets.items():
        for message in accuracy.advice if in_short else accuracy.confounded:
            names.setdefault(message, []).append(name)
    return [f"{', '.join(set_names)}: {message}" for message, set_names in names.items()]


ALL_OF = "all sensors of kind "
"""What names of all sensors of a kind begin with."""


def left_out_table(without: Mapping[str, Evidence]) -> Table:
    """Change of the error of the other sensors on held-out blocks without each sensor, the best first."""
    rows = (
        (name, str(evidence), "yes" if evidence.certain else "no")
        for name, evidence in sorted(without.items(), key=lambda pair: -pair[1].gain)
    )
    title = "Without one sensor: change of the error of the others on held-out blocks"
    return make_table(title, ("without", "change", "certain"), rows)


def contradicting_messages(without: Mapping[str, Evidence]) -> list[str]:
    """Sensors that make the predictions of others worse, the worst first, then whole kinds of sensors."""
    worse = sorted(
        (name.startswith(ALL_OF), -evidence.gain, name) for name, evidence in without.items() if evidence.adopted
    )
    smaller = [(name, format_percent(-np.expm1(0.5 * loss))) for _, loss, name in worse]
    advice = "Check its gain, axes and offset: torchid check."
    return [f"Without {name} the error of the other sensors is {share} % smaller. {advice}" for name, share in smaller]
