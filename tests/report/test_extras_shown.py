"""Offsets and terms of actuators, as the terminal and the figure show them: no log is left out without a word."""

from __future__ import annotations

import io
from dataclasses import replace

import pytest
from matplotlib.colors import to_rgba
from rich.console import Console

from torchid.identifiability.confounding import ExtraEstimate
from torchid.problem.extras import Extra
from torchid.report.figures import extra_figure
from torchid.report.tables import extra_table


def found(what: str, joint: str, log: str, unit: str = "N m") -> ExtraEstimate:
    """An unknown of one log, or of all if it has no name."""
    return ExtraEstimate(Extra(what, joint, "", unit, 1.0, bool(log), (0,)), log, 1.5, 1.4, 0.1, 1.0, ())


def of_logs(count: int, joints: int = 1) -> list[ExtraEstimate]:
    return [found("offset", f"j{j}", f"walks/{log}.npz") for j in range(joints) for log in range(count)]


def printed(extras: list[ExtraEstimate]) -> str:
    console = Console(file=io.StringIO(), width=200)
    console.print(extra_table(extras))
    return console.file.getvalue()  # type: ignore[attr-defined]


ARMATURE = found("armature", "j0", "", "kg m^2")


@pytest.mark.parametrize(
    ("extras", "columns", "rest"),
    [
        (of_logs(3), ["0.npz", "1.npz", "2.npz"], None),
        (of_logs(4), ["0.npz", "1.npz", "2.npz", "3.npz"], None),
        (of_logs(5), ["0.npz", "1.npz", "2.npz", "3.npz"], "and 1 log more: "),
        (of_logs(6), ["0.npz", "1.npz", "2.npz", "3.npz"], "and 2 logs more: "),
        ([*of_logs(3), ARMATURE], ["all logs", "0.npz", "1.npz", "2.npz"], None),
        ([*of_logs(4), ARMATURE], ["all logs", "0.npz", "1.npz", "2.npz"], "and 1 log more: "),
        ([*of_logs(5, 31)], ["0.npz", "1.npz", "2.npz", "3.npz"], "and 1 row and 1 log more: "),
        ([*of_logs(1, 32)], ["0.npz"], "and 2 rows more: "),
        ([ARMATURE], ["all logs"], None),
    ],
)
def test_the_table_shows_four_columns_and_counts_what_it_leaves_out(
    extras: list[ExtraEstimate], columns: list[str], rest: str | None
) -> None:
    assert [str(column.header) for column in extra_table(extras).columns][2:] == columns
    text = printed(extras)
    assert ("more" in text) == (rest is not None)
    assert rest is None or rest in text


@pytest.mark.parametrize(
    ("value", "error", "expected"),
    [
        (0.15, 0.1, "0.15 ± 0.10"), (-0.98, 0.28, "-0.98 ± 0.28"), (1.0, 0.0998, "1.00 ± 0.10"),
        (1234.4, 123.4, "1234 ± 120"), (2.0, 3e-4, "2.00000 ± 0.00030"), (2.0, 0.0, "2.000000 ± 0.000000"),
    ],
)  # fmt: skip
def test_a_value_has_as_many_decimals_as_its_error_and_that_two_digits(
    value: float, error: float, expected: str
) -> None:
    assert expected in printed([replace(ARMATURE, value=value, noise_error=error)])


def test_the_figures_legend_names_every_log_whichever_panel_it_is_in() -> None:
    """Offsets have a panel of their own in front of the armature, which is that of all logs."""
    figure = extra_figure([*of_logs(2, 3), ARMATURE, found("armature", "j1", "", "kg m^2")])
    assert len(figure.axes) == 2
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["0.npz", "1.npz", "all logs"]
    drawn = [
        {to_rgba(color) for points in axis.collections for color in points.get_edgecolor()} for axis in figure.axes
    ]
    keys = [to_rgba(key.get_color()) for key in legend.legend_handles]
    assert drawn == [set(keys[:2]), set(keys[2:])]
    assert len(set(keys)) == 3
