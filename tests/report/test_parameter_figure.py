"""The figure of parameters: intervals are 95 % ones, and what cannot exist is marked."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from physical import random_bodies

from torchid.estimators.least_squares import COMBINED, FIXED, IDENTIFIED, UNOBSERVABLE
from torchid.parameters import PARAMETERS
from torchid.report.figures import parameter_figure

COULOMB, VISCOUS = PARAMETERS.index("fc"), PARAMETERS.index("fv")
NAMES = ["trunk", *(f"front_left_joint_number_{k}_link" for k in range(29))]


def drawn(change: Any = lambda phi: None) -> tuple[Figure, np.ndarray, np.ndarray]:
    """The figure, the identified parameters, their standard errors; masses in sums, the base without friction."""
    rng = np.random.default_rng(0)
    nominal = random_bodies(rng, len(NAMES))
    phi = nominal.copy()
    phi[:, [COULOMB, VISCOUS]] = rng.uniform(0.1, 0.5, (len(NAMES), 2))
    change(phi)
    verdict = np.full(phi.shape, COMBINED, dtype=object)
    verdict[:, [COULOMB, VISCOUS]] = IDENTIFIED
    verdict[0, [COULOMB, VISCOUS]] = FIXED
    errors = rng.uniform(0.01, 0.1, phi.shape)
    estimate: Any = SimpleNamespace(phi=phi.ravel(), standard_error=errors.ravel(), verdict=verdict.ravel())
    return parameter_figure(NAMES, nominal, estimate), phi, errors


def test_friction_has_the_unit_of_the_robot_s_joints() -> None:
    nominal = random_bodies(np.random.default_rng(0), 1)
    shape = np.full(nominal.size, IDENTIFIED, dtype=object)
    estimate: Any = SimpleNamespace(phi=nominal.ravel(), standard_error=np.ones(nominal.size), verdict=shape)
    for kinds, unit in (
        ({"revolute", "fixed"}, "[N m]"),
        ({"prismatic"}, "[N]"),
        ({"prismatic", "revolute"}, "[N m or N]"),
    ):
        labels = [axis.get_xlabel() for axis in parameter_figure(["body"], nominal, estimate, kinds).axes]
        assert f"Coulomb friction {unit}" in labels


def bars(figure: Figure, title: str) -> np.ndarray:
    """Ends of the error bars of a panel, (n, 2)."""
    (axis,) = (axis for axis in figure.axes if axis.get_xlabel().startswith(title))
    lines = [x for x in axis.collections if isinstance(x, LineCollection)]
    segments = [np.asarray(segment) for x in lines for segment in x.get_segments()]
    return np.array([segment[:, 0] for segment in segments if segment.size and np.isfinite(segment).all()])


def test_error_bars_are_95_percent_intervals_of_what_is_identified_alone() -> None:
    figure, phi, errors = drawn()
    assert len(bars(figure, "mass")) == 0
    for title, k in (("Coulomb", COULOMB), ("viscous", VISCOUS)):
        expected = phi[1:, k, None] + 1.96 * errors[1:, k, None] * [-1.0, 1.0]
        np.testing.assert_allclose(bars(figure, title), expected, rtol=1e-12)


def test_bodies_that_cannot_exist_and_negative_friction_have_a_cross() -> None:
    def broken(phi: np.ndarray) -> None:
        phi[3, 0] = -1.0
        phi[5, 4:10] = 0.0  # mass beside the origin without inertia about it
        phi[7, VISCOUS] = -0.1

    whole, figure = drawn()[0], drawn(broken)[0]
    labels = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    assert [k for k, label in enumerate(labels) if label.startswith("x ")] == [3, 5]
    assert not any(text.get_text().startswith("x ") for text in whole.axes[0].get_yticklabels())
    crosses = {
        axis.get_xlabel().split(" ")[0]: [
            x for line in axis.lines if line.get_marker() == "X" for x in line.get_xdata()
        ]
        for axis in figure.axes
    }
    assert crosses["mass"] == [-1.0]
    assert crosses["viscous"] == [-0.1]
    assert not crosses["Coulomb"]


def test_what_the_data_say_nothing_of_is_not_shown() -> None:
    """A massless body with friction that no sensor sees, and friction of all joints."""
    nominal = random_bodies(np.random.default_rng(0), 3)
    verdict = np.full(nominal.shape, COMBINED, dtype=object)
    verdict[:, [COULOMB, VISCOUS]] = UNOBSERVABLE
    verdict[1, :COULOMB] = FIXED
    estimate: Any = SimpleNamespace(phi=nominal.ravel(), standard_error=np.ones(nominal.size), verdict=verdict.ravel())
    figure = parameter_figure(["trunk", "massless", "leg"], nominal, estimate)
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == ["trunk", "leg"]
    assert not any("friction" in axis.get_xlabel() for axis in figure.axes)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "URDF",
        "known only in sums, or mostly the URDF's",
    ]
