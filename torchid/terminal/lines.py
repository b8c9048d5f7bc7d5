"""Lines with a label, texts and tables within a screen, and what several commands print."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from textwrap import wrap
from typing import Any

from rich.table import Table
from rich.text import Text

from torchid.errors import one_line
from torchid.fitting.noise import NoiseSummary
from torchid.report.tables import noise_advice, noise_table, print_tables, table_text

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
    for end in "; ", ", ":
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


def error_lines(errors: Sequence[tuple[str, float, float, float | None]], width: int, of: str) -> list[str]:
    """A small table of the errors of an `ErrorComparison`, not wider than so many columns; none without errors.

    `of`: what the nominal parameters are those of.
    """
    columns = [
        (of, [f"{before:.4g}" for _, before, _, _ in errors]),
        ("identified", [f"{after:.4g}" for _, _, after, _ in errors]),
        ("noise alone", ["" if floor is None else f"{floor:.4g}" for *_, floor in errors]),
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


def show(parts: Iterable[str | Table]) -> None:
    """Print lines, and tables as wide as `terminal_width` says."""
    for part in parts:
        if isinstance(part, Table):
            print_tables(part)
        else:
            print(part)
