"""Tables and progress bars for the terminal, readable in 100 columns."""

from __future__ import annotations

import io
import math
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from torchid.errors import escape, raw_stream
from torchid.estimators import Estimate
from torchid.estimators.least_squares import COMBINED, FIXED, IDENTIFIED, PRIOR, UNOBSERVABLE
from torchid.fitting.calibration import Comparison
from torchid.identifiability.confounding import ExtraEstimate
from torchid.identifiability.information import Contribution, Contributions, PartContribution
from torchid.kernels import compiling_announced
from torchid.logs.time_range import log_title
from torchid.parameters import PARAMETERS, PER_BODY
from torchid.problem import Metrics
from torchid.problem.metrics import ERROR_GROUPS, IN_AIR, LIMB_GROUPS, PRESSURE, PRESSURE_GROUP

WIDTH = 100
"""Columns of what is printed, at most."""

_MOST_ROWS = 12  # of contributions of a kind, and of conditions
_JOINTS = 6  # whose noise an advice spells out
MARKS = {IDENTIFIED: "*", PRIOR: "p", COMBINED: "+", UNOBSERVABLE: ".", FIXED: ""}


class PlainConsole(Console):
    """A console that escapes control characters in texts; its own control codes pass."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """The segments of a renderable, with plain text."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text, style, control) if control else Segment(escape(text, "\n"), style)


def terminal_console(stderr: bool = False) -> Console:
    """A console on standard output or error without the escaping of `boundary`, which would remove its colors."""
    return PlainConsole(file=raw_stream(sys.stderr if stderr else sys.stdout))


def print_tables(*tables: Table) -> None:
    """Print to standard output, as wide as `terminal_width` says."""
    console = terminal_console()
    console.width = terminal_width()
    for table in tables:
        console.print(table)


def terminal_width() -> int:
    """Columns to print in: those of the terminal, at most 100; a file or pipe gets 100, or as many as COLUMNS says."""
    console, stated = terminal_console(), os.environ.get("COLUMNS", "").isdigit()
    return min(console.width, WIDTH) if console.is_terminal or stated else WIDTH


def table_text(table: Table, width: int = WIDTH) -> str:
    """A table as plain text, so many columns wide."""
    console = PlainConsole(width=width, file=io.StringIO(), force_terminal=False)
    with console.capture() as captured:
        console.print(table)
    return captured.get()


def error_tables(columns: Mapping[str, Comparison[Metrics]], of: str) -> list[Table]:
    """Errors of predicted forces, nominal (`of` a URDF or MJCF) against identified, two sets of logs to a table."""
    sets = list(columns.items())
    return [_error_table(dict(sets[i : i + 2]), of) for i in range(0, len(sets), 2)]


def _error_table(columns: Mapping[str, Comparison[Metrics]], of: str) -> Table:
    table = Table(
        title="Error of predicted forces: rms, and share of the rms of the measured; -: not measured",
        title_justify="left",
    )
    table.add_column("", no_wrap=True)
    for name in columns:
        for parameter_set in (of, "identified"):
            table.add_column(Text(f"{name}\n{parameter_set}"), justify="right", overflow="fold")
    limbs = dict(LIMB_GROUPS) if any(pair.identified.limb_rms for pair in columns.values()) else {}
    limbs |= PRESSURE_GROUP if any(PRESSURE in pair.identified.rms for pair in columns.values()) else {}
    for group, label in (ERROR_GROUPS | limbs).items():
        errors = [_error_cell(m, group) for pair in columns.values() for m in pair]
        table.add_row(Text(label), *errors)
        if group == "joint_torque" and any(pair.identified.limbs_in_air for pair in columns.values()):
            limited = ("only" if pair.identified.limbs_in_air else "" for pair in columns.values())
            table.add_row(f"  {IN_AIR}", *(cell for text in limited for cell in ("", text)))
        if group == "base_force":
            shares = [m.base_force_of_variation for pair in columns.values() for m in pair]
            table.add_row("  of its variation", *("-" if x is None else f"({100 * x:.3g} %)" for x in shares))
        floors = [pair.identified.noise.get(group) for pair in columns.values()]
        if any(floor is not None for floor in floors):
            cells = (("", "-" if floor is None else f"{floor:.4g}") for floor in floors)
            table.add_row("  noise alone", *(cell for pair in cells for cell in pair))
    return table


def _error_cell(metrics: Metrics, group: str) -> str:
    rms, relative = metrics.rms_of(group), metrics.relative_of(group)
    if rms is None:
        return "-"
    return f"{rms:.4g}" + ("" if relative is None else f" ({100 * relative:.3g} %)")


def state_table(states: Sequence[Mapping[str, Any]]) -> Table:
    """Contact states with sample counts, rows per sample, and the rank of the base."""
    table = Table(title="Contact states", title_justify="left")
    for heading in ("in contact", "samples", "rows each", "rank(S_b V_x)", "at full rank", "smallest s.v."):
        table.add_column(heading, justify="left" if heading == "in contact" else "right")
    for state in states:
        rank, smallest = state["base_rank"], state["base_singular_value"]
        table.add_row(
            Text(str(state["name"])),
            str(state["samples"]),
            str(state["rows"]) if state["mean_rows"] is None else f"{state['mean_rows']:.2g} of {state['rows']}",
            "fixed base" if rank is None else f"{rank} of 6",
            _rank_share_cell(state),
            "" if smallest is None else f"{smallest:.2g}",
        )
    return table


def _rank_share_cell(state: Mapping[str, Any]) -> str:
    """Share of the samples with the base at full rank, and the least rank of the others."""
    full, ranks = state["base_full_share"], state["base_rank_shares"]
    if full is None:
        return ""
    lowest = min(ranks, default=6)
    return f"{100 * full:.3g} %" + (f" (least: {lowest})" if lowest < 6 else "")


def noise_table(groups: Sequence[Mapping[str, Any]]) -> Table:
    """Standard deviations that weight the rows, by group: fields of `GroupNoise`."""
    title = "Noise that weights the rows: standard deviations; residuals show what a filter leaves of it"
    table = Table(title=title, title_justify="left")
    for heading in ("", "used", "origin", "residuals show"):
        table.add_column(heading, justify="left" if heading in ("", "origin") else "right")
    for group in groups:
        residual = "-" if group["residual"] is None else f"{group['residual']:.3g} {group['unit']}"
        table.add_row(group["group"], f"{group['used']:.3g} {group['unit']}", group["origin"], residual)
    return table


def noise_advice(suggested: Mapping[str, Any]) -> str:
    """A line with the noise that should replace stated values, where residuals contradict them."""

    def text(x: float | Sequence[float] | Mapping[str, float]) -> str:
        if isinstance(x, Mapping):
            shown = [f"{name}: {value:g}" for name, value in x.items()]
            more = [f"and {len(shown) - _JOINTS} more"] if len(shown) > _JOINTS else []
            return "{" + ", ".join([*shown[:_JOINTS], *more]) + "}"
        return f"{x:g}" if isinstance(x, float) else "[" + ", ".join(f"{value:g}" for value in x) + "]"

    keys = ", ".join(f"{key}: {text(x)}" for key, x in suggested.items())
    return f"stated values contradict the residuals: state sensors.noise {{{keys}}}, or none of these"


def marks_legend() -> str:
    """The meaning of the marks of verdicts."""
    return ", ".join(f"{mark} {verdict}" for verdict, mark in MARKS.items() if mark)


def verdict_table(body_names: Sequence[str], verdicts: np.ndarray) -> Table:
    """Marks of the verdicts (12 L,) on the parameters, of bodies with a free parameter."""
    table = Table(title=f"Parameters: {marks_legend()}", title_justify="left", box=box.SIMPLE_HEAD)
    table.add_column("body", overflow="fold")
    for name in PARAMETERS:
        table.add_column(name, justify="center")
    for name, body_verdicts in zip(body_names, verdicts.reshape(-1, PER_BODY), strict=True):
        if (body_verdicts != FIXED).any():
            table.add_row(Text(name), *(MARKS[verdict] for verdict in body_verdicts))
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


def contribution_table(contributions: Contributions) -> Table:
    """Information that each log, contact state and sensor (if known) contributes, the largest of each kind."""
    of_sensors = "contact state and sensor" if contributions.sensors else "and contact state"
    comma = "," if contributions.sensors else ""
    table = Table(title=f"What each log{comma} {of_sensors} adds: lost without it", title_justify="left")
    for heading in ("", "samples", "rank alone", "rank lost", "combinations lost", "bits lost"):
        table.add_column(heading, justify="right" if heading else "left", overflow="fold")
    kinds: dict[str, Sequence[Contribution]] = {
        "logs": contributions.logs, "contact states": contributions.states, "sensors": contributions.sensors
    }  # fmt: skip
    for kind, members in kinds.items():
        for member in sorted(members, key=lambda x: -x.bits)[:_MOST_ROWS]:
            counts = ("", "", "")
            if isinstance(member, PartContribution):
                counts = (str(member.samples), str(member.rank), str(member.rank_lost))
            name = log_title(member.name) if kind == "logs" else member.name
            table.add_row(Text(name), *counts, f"{member.determined:.1f}", f"{member.bits:.1f}")
        if len(members) > _MOST_ROWS:
            table.add_row(f"and {len(members) - _MOST_ROWS} more {kind}")
        table.add_section()
    total = contributions.total
    table.add_row("everything", "", "", "", f"{total.determined:.1f}", f"{total.bits:.1f}")
    return table


def violation_table(violations: Sequence[Mapping[str, Any]]) -> Table:
    """The first of the conditions that parameters break, by body."""
    title = "Conditions that the identified parameters break"
    if len(violations) > _MOST_ROWS:
        title += f", the first {_MOST_ROWS} of {len(violations)}"
    table = Table(title=title, title_justify="left")
    for heading in ("body", "condition", "off by"):
        table.add_column(heading, justify="right" if heading == "off by" else "left")
    for violation in violations[:_MOST_ROWS]:
        amount = Text(f"{violation['amount']:.3g} {violation['unit']}")
        table.add_row(Text(violation["body"] or violation["term"] or "all"), Text(str(violation["condition"])), amount)
    return table


def stability_table(motions: Mapping[str, Mapping[str, Any]]) -> Table:
    """Stability of a simulated robot: fields of `Stability` by motion."""
    table = Table(title="Standing", title_justify="left")
    for heading in (
        "motion",
        "base height [m]",
        "slip [mm]",
        "zero-moment point inside by [mm]",
        "effort [%]",
        "feet up [%]",
    ):
        table.add_column(
            Text(heading), justify="left" if heading == "motion" else "right"
        )  # as Text: [m] is not markup
    for name, stability in motions.items():
        low, high = stability["base_height"]
        table.add_row(
            Text(name),
            f"{low:.3f} to {high:.3f}",
            f"{1e3 * stability['slip']:.1f}",
            f"{1e3 * stability['zmp_margin']:.0f}",
            f"{100 * stability['effort']:.0f}",
            ", ".join(f"{100 * share:.0f}" for share in stability["unloaded"]),
        )
    return table


_MAX_COLUMNS, _MAX_ROWS = 4, 30


def extra_table(extras: Sequence[ExtraEstimate]) -> Table:
    """Extra parameters with standard errors, a row for each, a column for each log; `parameters.json` has them all."""
    title = "Offsets, scales and actuators, with standard errors; ?: confounded with other parameters"
    title += "; |: at a physical bound" if any(x.at_bound for x in extras) else ""
    table = Table(title=title, title_justify="left")
    logs = sorted(dict.fromkeys(x.log for x in extras), key=bool)  # terms common to all logs come first
    labels = list(dict.fromkeys(x.extra.label for x in extras))
    by_label = {(x.extra.label, x.log): x for x in extras}
    table.add_column("", overflow="fold")
    table.add_column("unit", no_wrap=True)
    shown = logs[:_MAX_COLUMNS]
    for log in shown:
        table.add_column(Text(log_title(log) or "all logs"), justify="right", overflow="fold")
    for label in labels[:_MAX_ROWS]:
        unit = next(x.extra.unit for x in extras if x.extra.label == label)
        cells = (by_label.get((label, log)) for log in shown)
        table.add_row(Text(label), unit, *("" if x is None else _extra_cell(x) for x in cells))
    hidden = {"row": len(labels) - _MAX_ROWS, "log": len(logs) - _MAX_COLUMNS}
    rest = " and ".join(f"{count} {noun}{'s' * (count > 1)}" for noun, count in hidden.items() if count > 0)
    if rest:
        table.add_row(f"and {rest} more: parameters.json")
    return table


def _extra_cell(extra: ExtraEstimate) -> str:
    mark = ("" if extra.separable else " ?") + (" |" if extra.at_bound else "")
    if not math.isfinite(extra.standard_error):
        return f"{extra.value:.4g}{mark}"
    size = float(f"{extra.standard_error:.1e}")  # rounded first: 0.0998 becomes 0.10, with two decimals
    digits = max(0, 1 - math.floor(math.log10(size))) if size > 0.0 else 6
    return f"{extra.value:.{digits}f} ± {size:.{digits}f}{mark}"


COMPILING = "compiling kernels, once on this machine (about 20 s)"


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """Progress bars that vanish at the end and are not shown where standard error is not a terminal."""
    console = terminal_console(stderr=True)
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description:<28}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bars:

        @contextmanager
        def compiling() -> Iterator[None]:
            task = bars.add_task(COMPILING, total=None)
            try:
                yield
            finally:
                bars.remove_task(task)

        with compiling_announced(compiling):
            yield bars
