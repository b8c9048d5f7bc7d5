"""Figures show what tells something, beside what noise leaves, with numbers that can be read."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from torchid.estimators.least_squares import COMBINED, FIXED, UNOBSERVABLE
from torchid.fitting.fit import Comparison
from torchid.parameters import PER_BODY
from torchid.problem import Metrics
from torchid.report.figure_style import decade, label_decades
from torchid.report.figures import contribution_figure, error_figure, identifiability_figure


def metrics(rms: float, noise: float | None) -> Metrics:
    """Errors of joint torques of 10 N m, and of base forces whose noise nobody knows."""
    both = {"joint_torque": rms, "base_force": rms}
    return Metrics(both, {name: x / 10.0 for name, x in both.items()}, {}, {}, None, noise={"joint_torque": noise})


def test_the_noise_of_the_readings_crosses_the_bars_of_the_errors_that_it_is_part_of() -> None:
    figure = error_figure({"test": Comparison(metrics(4.0, 0.5), metrics(1.0, 0.5))})
    (axis,) = figure.axes
    (line,) = (x for x in axis.collections if isinstance(x, LineCollection))
    (segment,) = line.get_segments()
    np.testing.assert_allclose(np.asarray(segment)[:, 1], 5.0)  # [%]
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["URDF", "identified", "noise of the readings"]
    (without,) = error_figure({"test": Comparison(metrics(4.0, None), metrics(1.0, None))}).axes
    assert not without.collections


def test_errors_beyond_what_was_measured_are_whole_percents() -> None:
    (axis,) = error_figure({"test": Comparison(metrics(15.04, None), metrics(0.0523, None))}).axes
    assert {text.get_text() for text in axis.texts} == {"150", "0.52"}


def test_a_log_that_is_alone_needs_no_bar_of_its_own() -> None:
    groups = {"logs": [("a.npz", 9.0)], "sensors": [("hip", 1.0), ("knee", 2.0)]}
    shown = [axis.get_title(loc="left") for axis in contribution_figure(groups).axes]
    assert shown == ["sensors"]
    assert len(contribution_figure({"logs": [("a.npz", 9.0)]}).axes) == 1, "unless there is nothing else"


def test_parameters_that_nothing_fits_have_no_column() -> None:
    verdict = np.full((2, PER_BODY), COMBINED, dtype=object)
    verdict[:, 10:] = FIXED
    verdict[1, 10] = UNOBSERVABLE
    estimate: Any = SimpleNamespace(verdict=verdict.ravel(), data_share=np.ones(2 * PER_BODY))
    labels = [text.get_text() for text in identifiability_figure(["trunk", "leg"], estimate).axes[0].get_xticklabels()]
    assert len(labels) == 10
    assert "fc" not in labels


@pytest.mark.parametrize(
    ("value", "text"), [(1e-7, "10⁻⁷"), (1e12, "10¹²"), (0.001, "0.001"), (1000.0, "1000"), (2e-5, "2e-05")]
)
def test_decades_are_read_as_they_are_spoken(value: float, text: str) -> None:
    assert decade(value) == text


@pytest.mark.parametrize(("low", "high", "said"), [(0.02, 0.4, {"0.02", "0.1", "0.2"}), (1e-12, 3.0, {"10⁻⁸", "1"})])
def test_logarithmic_axes_have_numbers_that_people_write(low: float, high: float, said: set[str]) -> None:
    figure = Figure()
    axes = figure.subplots()
    axes.plot([0, 1], [low, high])
    axes.set_yscale("log")
    label_decades(axes.yaxis)
    texts = {text.get_text() for text in axes.yaxis.get_ticklabels(which="both")}
    assert texts >= said
    assert not any("e" in text for text in texts)
