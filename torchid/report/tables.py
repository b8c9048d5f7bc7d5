"""Tables, labelled lines and progress bars for the terminal, readable in 100 columns."""

from __future__ import annotations

import io
import math
import os
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from textwrap import wrap
from typing import Any

import numpy as np
from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from torchid.errors import escape, one_line, raw_stream
from torchid.estimators import Estimate
from torchid.estimators.least_squares import COMBINED, FIXED, IDENTIFIED, PRIOR, UNOBSERVABLE
from torchid.fitting.fit import Comparison
from torchid.fitting.noise import GroupNoise, NoiseSummary
from torchid.identifiability.confounding import ExtraEstimate
from torchid.identifiability.information import Contribution, Contributions, PartContribution
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
    console = terminal_console()
    stated = os.environ.get("COLUMNS", "").isdigit()
    return min(console.width, WIDTH) if console.is_terminal or stated else WIDTH


def table_text(table: Table, width: int = WIDTH) -> str:
    """A table as plain text, so many columns wide."""
    console = PlainConsole(width=width, file=io.StringIO(), force_terminal=False)
    with console.capture() as captured:
        console.print(table)
    return captured.get()


def make_table(
    title: str,
    headings: Sequence[str],
    rows: Iterable[Sequence[str] | None],
    left: Collection[str] = (),
) -> Table:
    """A table of texts.

    Args:
        title: above it.
        headings: of the columns.
        rows: as many texts each as there are headings, or fewer; None is a line between them.
        left: headings of columns that are not aligned to the right, beside the first.
    """
    table = Table(title=title, title_justify="left")
    for number, heading in enumerate(headings):
        is_left = number == 0 or heading in left
        table.add_column(Text(heading), justify="left" if is_left else "right", overflow="fold")
    for row in rows:
        if row is None:
            table.add_section()
        else:
            table.add_row(*map(Text, row))
    return table


def error_tables(columns: Mapping[str, Comparison[Metrics]], nominal_label: str) -> list[Table]:
    """Errors of predicted forces, nominal (of a URDF or MJCF) against identified, two sets to a table."""
    sets = list(columns.items())
    return [_error_table(dict(sets[i : i + 2]), nominal_label) for i in range(0, len(sets), 2)]


def _error_table(columns: Mapping[str, Comparison[Metrics]], nominal_label: str) -> Table:
    headings = [
        "",
        *(f"{name}\n{parameter_set}" for name in columns for parameter_set in (nominal_label, "identified")),
    ]
    identified = [pair.identified for pair in columns.values()]
    groups = ERROR_GROUPS | (LIMB_GROUPS if any("ft_force" in x.rms for x in identified) else {})
    groups |= PRESSURE_GROUP if any(PRESSURE in x.rms for x in identified) else {}
    rows: list[list[str]] = []
    for group, label in groups.items():
        rows.append([label, *(_error_cell(m, group) for pair in columns.values() for m in pair)])
        if group == "joint_torque" and any(x.limbs_in_air for x in identified):
            rows.append([f"  {IN_AIR}", *(y for x in identified for y in ("", "only" if x.limbs_in_air else ""))])
        if group == "base_force":
            shares = [m.base_force_of_variation for pair in columns.values() for m in pair]
            rows.append(["  of its variation", *("-" if x is None else f"({100 * x:.3g} %)" for x in shares)])
        floors = [x.noise.get(group) for x in identified]
        if any(floor is not None for floor in floors):
            texts = ("-" if floor is None else f"{floor:.4g}" for floor in floors)
            rows.append(["  noise floor", *(y for text in texts for y in ("", text))])
    title = "Error of predicted forces: rms (relative to the rms of the measured force); -: not measured"
    table = make_table(title, headings, rows)
    table.columns[0].no_wrap = True
    return table


def _error_cell(metrics: Metrics, group: str) -> str:
    rms = metrics.rms_of(group)
    relative = metrics.relative_of(group)
    if rms is None:
        return "-"
    return f"{rms:.4g}" + ("" if relative is None else f" ({100 * relative:.3g} %)")


def state_table(states: Sequence[Mapping[str, Any]]) -> Table:
    """Contact states with sample counts, rows per sample, and the rank of the base."""

    def row(state: Mapping[str, Any]) -> Sequence[str]:
        rank = state["base_rank"]
        smallest = state["base_singular_value"]
        rows = str(state["rows"])
        return (
            str(state["name"]),
            str(state["samples"]),
            rows if state["mean_rows"] is None else f"{state['mean_rows']:.2g} of {rows}",
            "fixed base" if rank is None else f"{rank} of 6",
            _rank_share_cell(state),
            "" if smallest is None else f"{smallest:.2g}",
        )

    headings = ("in contact", "samples", "rows each", "rank(S_b V_x)", "at full rank", "smallest s.v.")
    return make_table("Contact states", headings, map(row, states))


def _rank_share_cell(state: Mapping[str, Any]) -> str:
    """Share of the samples with the base at full rank, and the least rank of the others."""
    full = state["base_full_share"]
    ranks = state["base_rank_shares"]
    if full is None:
        return ""
    lowest = min(ranks, default=6)
    return f"{100 * full:.3g} %" + (f" (least: {lowest})" if lowest < 6 else "")


def noise_table(groups: Sequence[GroupNoise]) -> Table:
    """Standard deviations that weight the rows, by group."""
    title = "Noise that weights the rows: standard deviations; residuals are filtered"
    rows = (
        (
            x.group,
            f"{x.used:.3g} {x.unit}",
            x.origin,
            "-" if x.residual is None else f"{x.residual:.3g} {x.unit}",
        )
        for x in groups
    )
    return make_table(title, ("", "used", "origin", "residuals show"), rows, left=("origin",))


def noise_advice(suggested: Mapping[str, Any]) -> str:
    """A line with the noise that should replace the stated noise, where residuals contradict it."""

    def text(x: float | Sequence[float] | Mapping[str, float]) -> str:
        if isinstance(x, Mapping):
            shown = [f"{name}: {value:g}" for name, value in x.items()]
            more = [f"and {len(shown) - _JOINTS} more"] if len(shown) > _JOINTS else []
            return "{" + ", ".join([*shown[:_JOINTS], *more]) + "}"
        return f"{x:g}" if isinstance(x, float) else "[" + ", ".join(f"{value:g}" for value in x) + "]"

    keys = ", ".join(f"{key}: {text(x)}" for key, x in suggested.items())
    return f"The stated noise contradicts the residuals. Set sensors.noise {{{keys}}}, or state none of these."


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

    def row(name: str, estimate: Estimate) -> Sequence[str]:
        condition = f"{estimate.condition_number:.2g}" if estimate.rank else "-"
        counts = (str(count) for verdict, count in estimate.verdict_counts().items() if MARKS[verdict])
        return name, str(estimate.rank), condition, *counts

    headings = ("in contact", "rank", "condition", *filter(None, MARKS.values()))
    rows = [*(row(*pair) for pair in by_state.items()), None, row("together", together)]
    return make_table("Parameters by verdict, of each contact state and of all together", headings, rows)


def contribution_table(contributions: Contributions) -> Table:
    """Information that each log, contact state and sensor (if known) contributes, the largest of each kind."""
    of_sensors = ", contact state and sensor" if contributions.sensors else " and contact state"
    kinds: dict[str, Sequence[Contribution]] = {
        "logs": contributions.logs, "contact states": contributions.states, "sensors": contributions.sensors
    }  # fmt: skip
    rows: list[Sequence[str] | None] = []
    for kind, members in kinds.items():
        for member in sorted(members, key=lambda x: -x.bits)[:_MOST_ROWS]:
            counts = ("", "", "")
            if isinstance(member, PartContribution):
                counts = (str(member.samples), str(member.rank), str(member.rank_lost))
            name = log_title(member.name) if kind == "logs" else member.name
            rows.append((name, *counts, f"{member.determined:.1f}", f"{member.bits:.1f}"))
        if len(members) > _MOST_ROWS:
            rows.append((f"and {len(members) - _MOST_ROWS} more {kind}",))
        rows.append(None)
    total = contributions.total
    rows.append(("everything", "", "", "", f"{total.determined:.1f}", f"{total.bits:.1f}"))
    headings = ("", "samples", "rank alone", "rank lost", "combinations lost", "bits lost")
    return make_table(f"Information lost without each log{of_sensors}", headings, rows)


def violation_table(violations: Sequence[Mapping[str, Any]]) -> Table:
    """The first of the conditions that parameters break, by body."""
    title = "Conditions that the identified parameters break"
    if len(violations) > _MOST_ROWS:
        title += f", the first {_MOST_ROWS} of {len(violations)}"
    rows = (
        (str(x["body"] or x["term"] or "all"), str(x["condition"]), f"{x['amount']:.3g} {x['unit']}")
        for x in violations[:_MOST_ROWS]
    )
    return make_table(title, ("body", "condition", "off by"), rows, left=("condition",))


_MAX_COLUMNS = 4
_MAX_ROWS = 30


def extra_table(extras: Sequence[ExtraEstimate]) -> Table:
    """Extra parameters with standard errors, a row for each, a column for each log; `parameters.json` has them all."""
    title = "Offsets, scales and actuator terms ± standard errors; ?: confounded with other parameters"
    title += "; |: at a physical limit" if any(x.at_bound for x in extras) else ""
    logs = sorted(dict.fromkeys(x.log for x in extras), key=bool)  # terms common to all logs come first
    units = {x.extra.label: x.extra.unit for x in reversed(extras)}
    labels = list(dict.fromkeys(x.extra.label for x in extras))
    cells = {(x.extra.label, x.log): _extra_cell(x) for x in extras}
    shown = logs[:_MAX_COLUMNS]
    rows = [[name, units[name], *(cells.get((name, log), "") for log in shown)] for name in labels[:_MAX_ROWS]]
    hidden = {"row": len(labels) - _MAX_ROWS, "log": len(logs) - _MAX_COLUMNS}
    others = " and ".join(f"{count} {noun}{'s' * (count > 1)}" for noun, count in hidden.items() if count > 0)
    if others:
        rows.append([f"and {others} more: parameters.json"])
    headings = ["", "unit", *(log_title(log) or "all logs" for log in shown)]
    table = make_table(title, headings, rows, left=("unit",))
    table.columns[1].no_wrap = True
    return table


def _extra_cell(extra: ExtraEstimate) -> str:
    mark = ("" if extra.separable else " ?") + (" |" if extra.at_bound else "")
    if not math.isfinite(extra.standard_error):
        return f"{extra.value:.4g}{mark}"
    size = float(f"{extra.standard_error:.1e}")  # rounded first: 0.0998 becomes 0.10, with two decimals
    digits = max(0, 1 - math.floor(math.log10(size))) if size > 0.0 else 6
    return f"{extra.value:.{digits}f} ± {size:.{digits}f}{mark}"


def progress_bars() -> Progress:
    """Progress bars that vanish at the end and are not shown where standard error is not a terminal."""
    console = terminal_console(stderr=True)
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description:<28}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


LABEL = 14
"""Columns of the words before what they are about."""
LINES = 20
"""Of an answer, at most."""
CUT = " ..."
_ANY_WIDTH = 10_000


def wrap_words(text: str, width: int, indent: str = "", most: int | None = None) -> list[str]:
    """Lines of at most so many columns, but no word is broken: a longer name has a line of its own.

    Args:
        text: to be broken.
        width: of the lines.
        indent: of all lines but the first.
        most: lines; the last of them ends in `CUT` if there are words beyond, which begin a clause where one does in
            the second half of what there is room for.
    """
    room = max(width, 1)
    options: dict[str, Any] = {"subsequent_indent": indent, "break_long_words": False, "break_on_hyphens": False}
    lines = wrap(text, room, **options) or [""]
    if most is None or len(lines) <= most:
        return lines
    *before, last = lines[:most]
    while " " in last.strip() and len(last) > width - len(CUT):
        last = last[: last.rindex(" ")]
    kept = " ".join(line.strip() for line in (*before, last))
    for end in ". ", "; ", ", ":
        clause = kept.rfind(end)
        shorter = wrap(kept[: clause + 1] + CUT, room, **options)
        if clause >= len(kept) / 2 and len(shorter) <= most:
            return shorter
    return [*before, last + CUT]


def labelled(label: str, text: str, width: int, most: int | None = None) -> list[str]:
    """What a word is about, in at most so many lines below each other; see `wrap_words`."""
    lines = wrap_words(text, width - LABEL, most=most)
    return [f"{name:{LABEL}}{line}" for name, line in zip((label, *[""] * len(lines)), lines, strict=False)]


def column_lines(
    names: tuple[str, Sequence[str]], columns: Sequence[tuple[str, Sequence[str]]], width: int
) -> list[str]:
    """Lines of a table without borders: whole names, the first column, and as many others as there is room for.

    Args:
        names: their heading and what the rows are of.
        columns: heading and cells of each, the most important first; one without any text is left out.
        width: of the lines; only names can be wider.
    """
    shown = [column for column in columns if any(cell.strip() for cell in column[1])]
    while True:
        table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
        table.add_column(Text(names[0]), no_wrap=True)
        for heading, _ in shown:
            table.add_column(Text(heading), justify="right", no_wrap=True)
        for name, *cells in zip(names[1], *(cells for _, cells in shown), strict=True):
            table.add_row(Text(one_line(name)), *(Text(cell) for cell in cells))
        lines = [line.rstrip() for line in table_text(table, _ANY_WIDTH).splitlines()]
        if len(shown) <= 1 or max(map(len, lines)) <= width:
            return lines
        shown.pop()


def rows_within(
    names: tuple[str, Sequence[str]], columns: Sequence[tuple[str, Sequence[str]]], width: int, room: int, others: str
) -> list[str]:
    """As `column_lines`, of the first rows that fit in so many lines, the last of which counts the others.

    Args:
        names: heading and names of the rows.
        columns: heading and cells of each.
        width: of the lines.
        room: lines, at least a heading, a row and a count.
        others: what the rows are that are not shown, and where they are.
    """
    count = len(names[1])
    most = max(room - 1 if count < room else room - 2, 1)
    shown = [(heading, cells[:most]) for heading, cells in columns]
    lines = column_lines((names[0], names[1][:most]), shown, width)
    return lines if count <= most else [*lines, f"and {count - most} {others}"]


def error_lines(errors: Sequence[tuple[str, float, float, float | None]], width: int, nominal_label: str) -> list[str]:
    """A small table of the errors of an `ErrorComparison`, not wider than so many columns; none without errors.

    `nominal_label`: what the nominal parameters are those of.
    """
    columns = [
        (nominal_label, [f"{before:.4g}" for _, before, _, _ in errors]),
        ("identified", [f"{after:.4g}" for _, _, after, _ in errors]),
        ("noise floor", ["" if floor is None else f"{floor:.4g}" for *_, floor in errors]),
    ]
    return column_lines(("rms error of", [group for group, *_ in errors]), columns, width) if errors else []


def rolling_lines(rolling: str, width: int, most: int | None = None) -> list[str]:
    """Which feet roll on what, and from where that is known, in at most so many lines; none where none rolls."""
    return labelled("contacts", rolling, width, most) if rolling else []


def written_line(output: object) -> str:
    """Where results have been written."""
    return f"{'written to':{LABEL}}{output}"


def noise_parts(noise: NoiseSummary, width: int) -> list[str | Table]:
    """The noise that rows were weighted with, and what should be stated where residuals contradict it."""
    advice = labelled("noise", noise_advice(noise.suggested), width) if noise.suggested else []
    return [noise_table(noise.groups), *advice]
