"""Lines with a label, and what several commands print."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from textwrap import fill

from rich.table import Table
from rich.text import Text

from torchid.fitting.noise import NoiseSummary
from torchid.report.tables import WIDTH, noise_advice, noise_table, print_tables, table_text

LABEL = 14
"""Columns of the words before what they are about."""


def print_labelled(label: str, text: str) -> None:
    """Print what a word is about, broken into lines below each other."""
    print(fill(f"{label:{LABEL}}{text}", WIDTH, subsequent_indent=" " * LABEL))


def table_lines(table: Table, width: int) -> list[str]:
    """Lines of a table, not wider than so many columns."""
    return [line.rstrip() for line in table_text(table, width).splitlines()]


def error_lines(errors: Sequence[tuple[str, float, float, float | None]], width: int) -> list[str]:
    """A small table of the errors of a `Judged`, not wider than so many columns; none without errors."""
    table = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0))
    table.add_column("rms error of", no_wrap=True)
    for heading in ("URDF", "identified", "noise alone"):
        table.add_column(heading, justify="right", no_wrap=True)
    for group, before, after, floor in errors:
        table.add_row(Text(group), f"{before:.4g}", f"{after:.4g}", "-" if floor is None else f"{floor:.4g}")
    return table_lines(table, width) if table.row_count else []


def print_rolling(rolling: str) -> None:
    """Print which feet roll on which radius, if any do."""
    if rolling:
        print_labelled("rolling", rolling)


def print_noise(noise: NoiseSummary) -> None:
    """Print the noise that rows were weighed with, and what should be stated where residuals contradict it."""
    print_tables(noise_table([asdict(group) for group in noise.groups]))
    if noise.suggested:
        print_labelled("noise", noise_advice(noise.suggested))
