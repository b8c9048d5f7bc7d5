"""Tables as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

Rows = Iterable[Sequence[str]]
"""Cells of a table, its head first."""


def markdown_lines(rows: Rows) -> Iterable[str]:
    """Lines of a table, each as soon as its cells are there."""
    for number, cells in enumerate(rows):
        yield f"| {' | '.join(cells)} |"
        if number == 0:
            yield "|" + "---|" * len(cells)


def print_table(rows: Rows) -> None:
    """Print a table row by row."""
    for line in markdown_lines(rows):
        print(line, flush=True)
