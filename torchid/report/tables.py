"""Tables for the terminal, readable in 100 columns."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from torchid.analysis.contributions import Contributions
from torchid.analysis.left_out import Contribution, PartContribution
from torchid.estimators import Estimate
from torchid.estimators.result import COMBINED, FIXED, IDENTIFIED, PRIOR, UNSEEN
from torchid.parameters import PARAMETERS, PER_BODY
from torchid.report.metrics import GROUPS, Metrics

MARKS = {IDENTIFIED: "*", PRIOR: "p", COMBINED: "+", UNSEEN: ".", FIXED: ""}


def print_tables(*tables: Table) -> None:
    """Print to standard output, at most 100 columns wide; a file or pipe gets the full 100."""
    console = Console()
    console.width = min(console.width, 100) if console.is_terminal else 100
    for table in tables:
        console.print(table)


def table_text(table: Table) -> str:
    """A table as plain text, 100 columns wide."""
    console = Console(width=100, file=io.StringIO(), force_terminal=False)
    with console.capture() as captured:
        console.print(table)
    return captured.get()


def error_tables(columns: Mapping[str, tuple[Metrics, Metrics]]) -> list[Table]:
    """Errors of predicted forces, nominal against identified, two named sets of logs to a table."""
    named = list(columns.items())
    return [_error_table(dict(named[i : i + 2])) for i in range(0, len(named), 2)]


def _error_table(columns: Mapping[str, tuple[Metrics, Metrics]]) -> Table:
    table = Table(
        title="Error of predicted forces: rms, and share of the rms of the measured; -: not measured",
        title_justify="left",
    )
    table.add_column("", no_wrap=True)
    for name in columns:
        for which in ("URDF", "identified"):
            table.add_column(Text(f"{name}\n{which}"), justify="right", overflow="fold")
    for group, label in GROUPS.items():
        cells = [_cell(m, group) for pair in columns.values() for m in pair]
        table.add_row(Text(label), *cells)
        if group == "base_force":
            shares = [m.base_force_of_variation for pair in columns.values() for m in pair]
            table.add_row("  of its variation", *("-" if x is None else f"({100 * x:.3g} %)" for x in shares))
    return table


def _cell(metrics: Metrics, group: str) -> str:
    rms, relative = metrics.rms[group], metrics.relative[group]
    if rms is None:
        return "-"
    return f"{rms:.4g}" + ("" if relative is None else f" ({100 * relative:.3g} %)")


def state_table(states: Sequence[Mapping[str, object]]) -> Table:
    """Contact states with sample counts, rows per sample, and what is left of the base."""
    table = Table(title="Contact states", title_justify="left")
    for heading in ("in contact", "samples", "rows each", "rank(S_b V_x)", "smallest s.v."):
        table.add_column(heading, justify="left" if heading == "in contact" else "right")
    for state in states:
        rank, smallest = state["base_rank"], state["base_singular_value"]
        table.add_row(
            Text(str(state["name"])),
            str(state["samples"]),
            str(state["rows"]),
            "fixed base" if rank is None else f"{rank} of 6",
            "" if smallest is None else f"{smallest:.2g}",
        )
    return table


def noise_table(groups: Sequence[Mapping[str, Any]]) -> Table:
    """Standard deviations that rows were weighed with, by group: fields of `GroupNoise`."""
    table = Table(title="Noise that rows are weighed with: standard deviations", title_justify="left")
    for heading in ("", "used", "", "residuals show"):
        table.add_column(heading, justify="left" if not heading else "right")
    for one in groups:
        shown = "-" if one["residual"] is None else f"{one['residual']:.3g}"
        table.add_row(one["group"], f"{one['used']:.3g} {one['unit']}", one["origin"], shown)
    return table


def noise_advice(suggested: Mapping[str, Any]) -> str:
    """What to state instead of noise that residuals contradict."""

    def text(x: float | Sequence[float]) -> str:
        return f"{x:g}" if isinstance(x, float) else "[" + ", ".join(f"{one:g}" for one in x) + "]"

    keys = ", ".join(f"{key}: {text(x)}" for key, x in suggested.items())
    return f"noise         stated values contradict the residuals: state sensors.noise {{{keys}}}, or none of these"


def legend_of_marks() -> str:
    """What the marks of verdicts stand for."""
    return ", ".join(f"{mark} {verdict}" for verdict, mark in MARKS.items() if mark)


def verdict_table(body_names: Sequence[str], verdicts: np.ndarray) -> Table:
    """A mark for the verdict, (12 L,), on every parameter of the bodies with any that is free."""
    table = Table(title=f"Parameters: {legend_of_marks()}", title_justify="left", box=box.SIMPLE_HEAD)
    table.add_column("body", overflow="fold")
    for name in PARAMETERS:
        table.add_column(name, justify="center")
    for name, found in zip(body_names, verdicts.reshape(-1, PER_BODY), strict=True):
        if (found != FIXED).any():
            table.add_row(Text(name), *(MARKS[verdict] for verdict in found))
    return table


def verdict_counts_table(by_state: Mapping[str, Estimate], together: Estimate) -> Table:
    """Rank, condition number and numbers of parameters by verdict, of each contact state alone and of all data."""
    table = Table(title="Parameters by verdict, of each contact state alone and together", title_justify="left")
    table.add_column("in contact", overflow="fold")
    for heading in ("rank", "condition", *filter(None, MARKS.values())):
        table.add_column(heading, justify="right")
    for name, estimate in [*by_state.items(), ("together", together)]:
        if name == "together":
            table.add_section()
        condition = f"{estimate.condition_number:.2g}" if estimate.rank else "-"
        counts = (str(count) for verdict, count in estimate.verdict_counts().items() if MARKS[verdict])
        table.add_row(Text(name), str(estimate.rank), condition, *counts)
    return table


def contribution_table(found: Contributions, most: int = 12) -> Table:
    """What the fit would lose without each log, contact state and sensor, the first of each kind."""
    table = Table(title="What each log, contact state and sensor adds: lost without it", title_justify="left")
    for heading in ("", "samples", "rank alone", "rank lost", "combinations lost", "bits lost"):
        table.add_column(heading, justify="right" if heading else "left", overflow="fold")
    kinds: dict[str, Sequence[Contribution]] = {
        "logs": found.logs, "contact states": found.states, "sensors": found.sensors
    }  # fmt: skip
    for kind, each in kinds.items():
        for one in sorted(each, key=lambda x: -x.bits)[:most]:
            counts = ("", "", "")
            if isinstance(one, PartContribution):
                counts = (str(one.samples), str(one.rank), str(one.rank_lost))
            name = Path(one.name).name if kind == "logs" else one.name
            table.add_row(Text(name), *counts, f"{one.determined:.1f}", f"{one.bits:.1f}")
        if len(each) > most:
            table.add_row(f"and {len(each) - most} more {kind}")
        table.add_section()
    known = found.known
    table.add_row("everything", "", "", "", f"{known.determined:.1f}", f"{known.bits:.1f}")
    return table


def violation_table(violations: Sequence[Mapping[str, Any]], most: int = 12) -> Table:
    """Conditions that parameters break, by body, the first of them."""
    title = "Conditions that the identified parameters break"
    if len(violations) > most:
        title += f", the first {most} of {len(violations)}"
    table = Table(title=title, title_justify="left")
    for heading in ("body", "condition", "off by"):
        table.add_column(heading, justify="right" if heading == "off by" else "left")
    for found in violations[:most]:
        amount = Text(f"{found['amount']:.3g} {found['unit']}")
        table.add_row(Text(found["body"] or "all"), Text(str(found["condition"])), amount)
    return table


def stability_table(motions: Mapping[str, Mapping[str, Any]]) -> Table:
    """How a simulated robot stood: fields of `Stability` by motion."""
    table = Table(title="Standing", title_justify="left")
    for heading in (
        "motion",
        "base height [m]",
        "slip [mm]",
        "zero-moment point inside by [mm]",
        "effort [%]",
        "feet up [%]",
    ):
        table.add_column(Text(heading), justify="left" if heading == "motion" else "right")  # [m] is no markup
    for name, found in motions.items():
        low, high = found["base_height"]
        table.add_row(
            Text(name),
            f"{low:.3f} to {high:.3f}",
            f"{1e3 * found['slip']:.1f}",
            f"{1e3 * found['zmp_margin']:.0f}",
            f"{100 * found['effort']:.0f}",
            ", ".join(f"{100 * share:.0f}" for share in found["unloaded"]),
        )
    return table
