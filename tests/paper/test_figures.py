"""What the study's tables and figures show is what was computed, row for row."""

from __future__ import annotations

import numpy as np
import pytest
from paper.fits import Series
from paper.report import error_table, study_figures
from paper.results import NOMINAL, TRUE, Record, Results
from paper.settings import SHOWN
from simulated import BIPED
from synthetic import load

from torchid.problem import Metrics
from torchid.problem.metrics import BASE_ROWS, ROW_GROUPS
from torchid.report.tables import table_text

ROBOT = load(BIPED)


def numbered(start: int) -> Metrics:
    """Metrics in which every figure is another number."""
    rms = {group: float(start + i) for i, group in enumerate(ROW_GROUPS)}
    relative = {group: (start + 10.0 + i) / 100.0 for i, group in enumerate(ROW_GROUPS)}
    return Metrics(rms, relative, {}, {}, (start + 20.0) / 100.0)


RESULTS = Results(
    [
        Record(SHOWN[0], SHOWN[1], name, 0, 0, numbered(100 * k + 50), numbered(100 * k))
        for k, name in enumerate((NOMINAL, "full", "contacts", "joints", "reduced", TRUE), start=1)
    ],
    [],
)


@pytest.mark.parametrize(("against", "shift"), [("exact", 0), ("measured", 50)])
def test_every_cell_of_the_error_table_is_its_records_figure(against: str, shift: int) -> None:
    text = table_text(error_table(RESULTS, *SHOWN, against))
    assert ("the truth" in text) == (against == "exact")
    lines = [[cell.strip() for cell in line.split("│")[1:-1]] for line in text.splitlines() if "│" in line]
    for k, (first, second) in enumerate(zip(lines[::2], lines[1::2], strict=True), start=1):
        start = 100 * k + shift
        joint, force, moment, inside = range(start, start + 4)
        shares = [f"{x + 10:.2g} %" for x in (joint, force, moment, inside)]
        assert first[1:] == [str(joint), str(force), f"{start + 20:.2g} %", str(moment), str(inside)]
        assert second[1:] == [shares[0], shares[1], "", shares[2], shares[3]]


def test_every_panel_shows_the_row_it_names() -> None:
    rows = (*BASE_ROWS, *ROBOT.joint_names)
    time = np.linspace(0.0, 1.0, 5)
    true = np.arange(len(rows)) + np.zeros((5, 1))
    names = (NOMINAL, "full", "contacts", "joints", "reduced", TRUE)
    predicted = {name: true + 100.0 * (k + 1) for k, name in enumerate(names)}
    projected = {name: true + 1000.0 * (k + 1) for k, name in enumerate(names)}
    figures = study_figures(RESULTS, Series(time, rows, true, predicted, -true, projected))
    for figure, shown, sign, step in (
        ("forces", ("l_hip_flexion", "l_knee_flexion", "base force z", "base moment x"), 1.0, 100.0),
        ("projected", ("l_hip_flexion", "l_knee_flexion"), -1.0, 1000.0),
    ):
        axes = figures[figure].axes
        for left, right, row in zip(axes[::2], axes[1::2], shown, strict=True):
            number = rows.index(row)
            heights = [float(np.asarray(line.get_ydata())[0]) for line in left.lines]
            assert heights == [sign * number, *(number + step * (k + 1) for k in range(5))]  # the true one is no line
            errors = [float(np.asarray(line.get_ydata())[0]) for line in right.lines]
            assert errors == [height - heights[0] for height in heights[1:]]
