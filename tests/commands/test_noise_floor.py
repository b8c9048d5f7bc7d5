"""Errors of a run against the noise that its sensors leave: in the table, metrics.json and the figure of forces."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from demo import shortened_demo

from torchid.cli import main
from torchid.parameters import Array
from torchid.report.forces import ForceSeries, force_figure

UNPHYSICAL = pytest.mark.filterwarnings("ignore:identified.urdf:torchid.errors.TorchidWarning")


def floors(run: Path) -> dict[str, dict[str, float]]:
    found: dict[str, dict[str, float]] = json.loads((run / "metrics.json").read_text())["noise_floor"]
    return found


@UNPHYSICAL
def test_a_run_gives_the_noise_beside_its_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    demo, run = shortened_demo(tmp_path / "demo", 400), tmp_path / "run"
    assert main(["identify", "--verbose", str(demo / "quadruped.yaml"), f"output={run}"]) == 0
    found, printed = floors(run), capsys.readouterr().out
    assert 0.06 < found["test"]["joint_torque"] < 0.08  # 0.1 N m and 0.5 N at 0.3 m, of which the filter leaves 0.38
    assert found["train"]["projected_residual"] == pytest.approx(0.38, abs=0.01)
    for value in (found["train"]["base_force"], found["test"]["base_moment"]):
        assert f"{value:.4g}" in printed
    assert printed.count("│   noise alone") == 4
    assert main(["evaluate", str(run), "--log", str(demo / "sway_test.npz")]) == 0
    evaluated = json.loads((run / "evaluation/sway_test/metrics.json").read_text())["sway_test"]
    assert evaluated["noise_floor"] == pytest.approx(found["test"], rel=1e-9)


@UNPHYSICAL
def test_noise_that_residuals_show_is_no_measure_of_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    demo, run = shortened_demo(tmp_path / "demo", 400), tmp_path / "run"
    text = (demo / "quadruped.yaml").read_text()
    stated = "noise: {joint_torque: 0.1, contact_force: 0.5, contact_moment: 0.05}"
    assert stated in text
    (demo / "quadruped.yaml").write_text(text.replace(stated, "noise: {}"))
    assert main(["identify", "--verbose", str(demo / "quadruped.yaml"), f"output={run}"]) == 0
    assert floors(run) == {"train": {}, "test": {}}
    assert main(["evaluate", str(run), "--log", str(demo / "sway_test.npz")]) == 0
    assert "│   noise alone" not in capsys.readouterr().out


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
        assert errors.get_title(loc="left") == "identified: rms 0.1, noise alone 0.2 [N m]"
    for noise in (None, np.full((50, 2), np.nan)):
        for errors in force_figure(series(noise), ["knee", "hip"], 0).axes[1::2]:
            assert not errors.collections
            assert errors.get_title(loc="left") == "identified: rms 0.1 [N m]"


def test_the_figure_has_forces_of_slides_in_newtons_and_seconds_since_the_first_sample() -> None:
    as_recorded = force_figure(series(None), ["knee", "rail"], 0, ["rail"])
    assert [axis.get_ylabel() for axis in as_recorded.axes[::2]] == ["[N m]", "[N]"]
    since_1970 = force_figure(replace(series(None), time=1.7e9 + series(None).time), ["knee", "rail"], 0)
    for figure, label in ((as_recorded, "time [s]"), (since_1970, "time since the first sample [s]")):
        np.testing.assert_allclose(figure.axes[0].get_lines()[0].get_xdata(), series(None).time, atol=1e-6)
        assert {axis.get_xlabel() for axis in figure.axes} == {"", label}
