"""Evaluations, wherever they are written, and the noise that sensors leave beside the errors of a run."""

from __future__ import annotations

import json
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from demo import shortened_demo
from refusals import files_in

import torchid
from torchid.cli import main
from torchid.commands.folder import EVALUATION, read_manifest
from torchid.parameters import Array
from torchid.report.forces import ForceSeries, force_figure

UNPHYSICAL = pytest.mark.filterwarnings("ignore:identified.urdf:torchid.errors.TorchidWarning")


def floors(run: Path) -> dict[str, dict[str, float]]:
    found: dict[str, dict[str, float]] = json.loads((run / "metrics.json").read_text())["noise_floor"]
    return found


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder with the shortened demo and its run, and what that printed."""
    folder = shortened_demo(tmp_path_factory.mktemp("evaluated") / "demo", 400)
    with redirect_stdout(StringIO()) as printed:
        assert main(["identify", "--verbose", str(folder / "quadruped.yaml"), f"output={folder / 'run'}"]) == 0
    return folder, printed.getvalue()


@UNPHYSICAL
def test_an_evaluation_elsewhere_is_the_same_and_leaves_the_run_as_it_was(
    demo: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = demo[0] / "run"
    before = files_in(run)
    evaluating = ["evaluate", str(run), "--log", str(demo[0] / "sway_test.npz")]
    assert main([*evaluating, "--output", str(tmp_path / "evaluated")]) == 0
    assert f"written to    {tmp_path / 'evaluated'}" in capsys.readouterr().out
    assert files_in(run) == before
    kind = read_manifest(tmp_path / "evaluated")
    assert kind is not None
    assert kind.kind == EVALUATION.name
    assert main(evaluating) == 0
    usual = run / "evaluation" / "sway_test"
    assert {file.name for file in usual.iterdir()} == {file.name for file in (tmp_path / "evaluated").iterdir()}
    evaluated = json.loads((usual / "metrics.json").read_text())
    assert json.loads((tmp_path / "evaluated" / "metrics.json").read_text()) == evaluated
    assert evaluated["sway_test"]["noise_floor"] == pytest.approx(floors(run)["test"], rel=1e-9)


def test_a_run_gives_the_noise_beside_its_errors(demo: tuple[Path, str]) -> None:
    folder, printed = demo
    found = floors(folder / "run")
    assert 0.06 < found["test"]["joint_torque"] < 0.08  # 0.1 N m and 0.5 N at 0.3 m, of which the filter leaves 0.38
    assert found["train"]["projected_residual"] == pytest.approx(0.38, abs=0.01)
    for value in (found["train"]["base_force"], found["test"]["base_moment"]):
        assert f"{value:.4g}" in printed
    assert printed.count("│   noise floor") == 4


@UNPHYSICAL
def test_noise_that_residuals_show_is_no_measure_of_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    demo, run = shortened_demo(tmp_path / "demo", 150), tmp_path / "run"
    text = (demo / "quadruped.yaml").read_text()
    stated = "noise: {joint_torque: 0.1, contact_force: 0.5, contact_moment: 0.05}"
    assert stated in text
    (demo / "quadruped.yaml").write_text(text.replace(stated, "noise: {}"))
    assert main(["identify", "--verbose", str(demo / "quadruped.yaml"), f"output={run}"]) == 0
    assert floors(run) == {"train": {}, "test": {}}
    assert "│   noise floor" not in capsys.readouterr().out


def series(noise: Array | None) -> ForceSeries:
    time, rng = np.arange(50) / 10.0, np.random.default_rng(0)
    measured = rng.normal(size=(50, 2))
    measured[:5, 1] = np.nan
    return ForceSeries("walk.npz[0:5]", time, measured, measured + 1.0, measured + 0.1, noise)


def test_the_figure_shows_errors_in_a_band_of_two_standard_deviations() -> None:
    figure = force_figure(series(np.full((50, 2), 0.2)), ["knee", "hip"], 0)
    assert len(figure.axes) == 4
    for errors in figure.axes[1::2]:
        (band,) = errors.collections
        heights = band.get_paths()[0].vertices[:, 1]
        assert (heights.min(), heights.max()) == pytest.approx((-0.4, 0.4))
        nominal, identified = errors.get_lines()
        np.testing.assert_allclose(np.nanmax(np.asarray(nominal.get_ydata(), dtype=float)), 1.0)
        np.testing.assert_allclose(np.nanmax(np.asarray(identified.get_ydata(), dtype=float)), 0.1)
        assert errors.get_title(loc="left") == "rms error: URDF 1, identified 0.1, noise 0.2 N m"
    for noise in (None, np.full((50, 2), np.nan)):
        for errors in force_figure(series(noise), ["knee", "hip"], 0).axes[1::2]:
            assert not errors.collections
            assert errors.get_title(loc="left") == "rms error: URDF 1, identified 0.1 N m"


def test_the_figure_has_forces_of_slides_in_newtons_and_seconds_since_the_first_sample() -> None:
    as_recorded = force_figure(series(None), ["knee", "rail"], 0, ["rail"])
    assert [axis.get_ylabel() for axis in as_recorded.axes[::2]] == ["[N m]", "[N]"]
    since_1970 = force_figure(replace(series(None), time=1.7e9 + series(None).time), ["knee", "rail"], 0)
    for figure, label in ((as_recorded, "time [s]"), (since_1970, "time since the first sample [s]")):
        np.testing.assert_allclose(figure.axes[0].get_lines()[0].get_xdata(), series(None).time, atol=1e-6)
        assert {axis.get_xlabel() for axis in figure.axes} == {"", label}


@UNPHYSICAL
def test_without_contact_forces_the_figure_has_joint_torques_of_the_whole_log(
    demo: tuple[Path, str], tmp_path: Path
) -> None:
    with np.load(demo[0] / "sway_test.npz") as arrays:
        np.savez(tmp_path / "torques.npz", **{name: x for name, x in arrays.items() if "wrench" not in name})
    forces = torchid.evaluate(demo[0] / "run", [tmp_path / "torques.npz"]).forces
    assert forces.recovered
    assert np.isnan(forces.measured[:, :6]).all()
    assert np.isfinite(forces.measured[:, 6:]).all()
    assert forces.noise is not None
    error, before = (x[:, 6:] - forces.measured[:, 6:] for x in (forces.identified, forces.nominal))
    rms = np.sqrt(np.mean(np.square(error), axis=0))
    ratio = rms / np.sqrt(np.mean(np.square(forces.noise[:, 6:]), axis=0))
    assert ((ratio > 0.8) & (ratio < 2.0)).all(), "noise, and errors of a fit of 400 samples"
    assert (rms < 0.2 * np.sqrt(np.mean(np.square(before), axis=0))).all()
