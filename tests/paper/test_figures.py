"""What the study's tables and figures show is what was computed, row for row."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from paper.fits import Series, predict_series
from paper.report import error_table, study_figures
from paper.results import NOMINAL, TRUE, Record, Results
from paper.settings import SHOWN
from simulated import BIPED, LIFTING, SOLES
from synthetic import load

from torchid.logs import read_log
from torchid.logs.preprocess import preprocess
from torchid.problem import Evaluation, Metrics, Samples, bind_log
from torchid.problem.metrics import BASE_ROWS, ROW_GROUPS, force_series, null_space_part
from torchid.report.tables import table_text
from torchid.sensing import Contact

ROBOT = load(BIPED)
EVALUATION = Evaluation(ROBOT, [Contact(frame, "flat") for frame in SOLES])


@pytest.fixture(scope="module")
def samples(biped_folder: Path) -> Samples:
    """Exact forces of a robot that stands on both feet and on each one."""
    log = preprocess(read_log(biped_folder / "exact" / f"{LIFTING}.npz"), 10.0, 200.0)
    return bind_log(log, ROBOT, EVALUATION.builder.contacts)


def test_the_null_space_of_the_contacts_passes_no_wrench_and_what_it_passes_it_passes_twice(samples: Samples) -> None:
    measured, _ = force_series(EVALUATION.builder, samples, ROBOT.nominal.flatten()[None])
    torque = torch.nn.functional.pad(EVALUATION.builder.recorded_torque(samples), (6, 0)).numpy()
    inside = null_space_part(EVALUATION.builder, samples, np.stack([measured, torque]))
    np.testing.assert_allclose(inside[0], inside[1], rtol=0.0, atol=1e-9)  # they differ by J_C^T lambda
    assert np.abs(measured - inside[0]).max() > 100.0
    np.testing.assert_allclose(null_space_part(EVALUATION.builder, samples, inside), inside, rtol=0.0, atol=1e-10)


def test_errors_of_the_base_force_are_given_relative_to_its_rms_about_its_mean(samples: Samples) -> None:
    phi = 1.1 * ROBOT.nominal.flatten()[None]
    measured, (predicted,) = force_series(EVALUATION.builder, samples, phi)
    (metrics,) = EVALUATION.metrics([samples], phi)
    error, about = (predicted - measured)[:, :3], measured[:, :3] - measured[:, :3].mean(0)
    expected = np.sqrt(np.mean(error**2) / np.mean(about**2))
    assert metrics.base_force_of_variation == pytest.approx(expected, rel=1e-10)
    assert metrics.relative["base_force"] is not None
    assert metrics.base_force_of_variation > 3.0 * metrics.relative["base_force"]  # gravity flatters it


def test_a_series_holds_predictions_of_every_vector_in_the_order_of_the_rows(samples: Samples) -> None:
    phi = {"one": ROBOT.nominal.flatten(), "two": 2.0 * ROBOT.nominal.flatten()}
    series = predict_series(EVALUATION, samples, phi)
    assert series.rows == (*BASE_ROWS, *ROBOT.joint_names)
    np.testing.assert_allclose(series.predicted["two"], 2.0 * series.predicted["one"], rtol=1e-12, atol=1e-9)
    measured, (one,) = force_series(EVALUATION.builder, samples, phi["one"][None])
    np.testing.assert_array_equal(series.true, measured)
    np.testing.assert_allclose(series.predicted["one"], one, rtol=0.0, atol=1e-10)
    inside = null_space_part(EVALUATION.builder, samples, np.stack([measured, one]))
    np.testing.assert_allclose(series.projected_true, inside[0], rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(series.projected["one"], inside[1], rtol=0.0, atol=1e-10)


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
