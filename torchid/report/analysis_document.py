"""What `analysis.json` holds, and base parameters as a text to read."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from textwrap import wrap
from typing import Any

from torchid.analysis.base_check import PostureSummary, StateCheck
from torchid.analysis.base_parameters import BaseParameters
from torchid.analysis.candidates import Candidate
from torchid.analysis.planner import SensorPlan
from torchid.analysis.relations import relations, unseen

_WIDTH = 100


def plan_document(plan: SensorPlan) -> dict[str, Any]:
    """Everything the planner found, sensors by name."""
    ask = plan.question
    frames = [contact.frame for contact in ask.contacts]
    return {
        "contact_states": [[f for f, active in zip(frames, state, strict=True) if active] for state in ask.states],
        "criterion": ask.criterion,
        "candidates": [{"name": c.name, "channels": c.channels, "cost": c.cost} for c in ask.candidates],
        "keep": _names(c for c in ask.candidates if c in ask.keep),
        "exclude": _names(c for c in ask.candidates if c in ask.exclude),
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
            {"contacts": list(n.contacts), "joints": list(n.joints), "sensors": n.needed, "proven": n.proven}
            for n in plan.needs
        ],
        "checks": checks_document(plan.checks),
        "stack": {"rank": plan.stack_rank, "full": plan.stack_full},
        "without": [
            {"sensor": r.candidate.name, "base_rank": r.base_rank, "stack_rank": r.stack_rank} for r in plan.removals
        ],
    }


def checks_document(checks: Sequence[StateCheck]) -> list[dict[str, Any]]:
    """How a sensor set sees the base, state by state."""
    return [
        {
            "state": check.name,
            "random_postures": _values(check.generic),
            "zero_posture": _values(check.zero),
            "logs": None if check.recorded is None else _values(check.recorded),
            "lost": None
            if check.lost is None
            else {
                "directions": check.lost.directions.T.tolist(),
                "words": list(check.lost.words),
                "posture": check.lost.posture.tolist(),
                "lacking": [{"contacts": list(frames), "sensors": count} for frames, count in check.lost.culprits],
                "would_help": _names(check.lost.cures),
            },
            "alike_at_zero_posture": [list(names) for names in check.coincident],
        }
        for check in checks
    ]


def base_document(base: BaseParameters, body_names: Sequence[str]) -> dict[str, Any]:
    """Base parameters in numbers and words."""
    return {
        "rank": base.rank,
        "parameters": int(base.free.sum()),
        "gap": base.gap if base.rank else None,
        "relations": relations(base, body_names),
        "unseen": unseen(base, body_names),
    }


def base_text(title: str, base: BaseParameters, body_names: Sequence[str]) -> str:
    """Base parameters to read, in 100 columns."""
    seen = f"{base.rank} combinations of {int(base.free.sum())} parameters can be determined, SI units:"
    lines = [title, "=" * len(title), "", seen, ""]
    for relation in relations(base, body_names):
        lines += wrap(relation, _WIDTH, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False)
    lost = unseen(base, body_names)
    lines += ["", "In no combination, whatever the motion:", "", *(lost or ["none"])]
    return "\n".join(lines) + "\n"


def _names(chosen: Iterable[Candidate]) -> list[str]:
    return [candidate.name for candidate in chosen]


def _values(values: PostureSummary) -> dict[str, float | int]:
    return {"rank": values.rank, "median": values.median, "low": values.low, "least": values.least}
