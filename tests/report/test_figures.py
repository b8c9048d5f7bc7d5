"""Figures show what tells something, beside what noise leaves, with numbers that can be read."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from torchid.fitting.calibration import Comparison
from torchid.problem import Metrics
from torchid.report.figure_style import label_decades
from torchid.report.figures import error_figure


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
    assert [text.get_text() for text in legend.get_texts()] == ["URDF", "identified", "noise of the readings alone"]
    (without,) = error_figure({"test": Comparison(metrics(4.0, None), metrics(1.0, None))}).axes
    assert not without.collections


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
