"""Parts that all prescribed walks have in common: velocities and rates are those of the path, swings are smooth."""

from __future__ import annotations

import numpy as np
import pytest
from legged.trajectories import BaseMotion, Swing, quintic, waves
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

TIME = np.linspace(0.5, 1.5, 40)


@pytest.mark.parametrize("in_base", [False, True])
def test_velocities_and_rates_of_a_base_are_those_of_its_path(in_base: bool) -> None:
    knots = np.linspace(0.0, 2.0, 101)
    path = make_interp_spline(knots, waves(np.random.default_rng(0), knots, 6, 0.3, 1.5), k=5)
    motion, h = BaseMotion.along(path, TIME, in_base), 1e-4
    after, before = (BaseMotion.along(path, TIME + step, in_base) for step in (h, -h))
    np.testing.assert_array_equal(
        motion.rotation.as_matrix(), Rotation.from_euler("ZYX", path(TIME)[:, 3:]).as_matrix()
    )
    linear = motion.rotation.apply(motion.linear) if in_base else motion.linear
    np.testing.assert_allclose(linear, (path(TIME + h) - path(TIME - h))[:, :3] / (2 * h), rtol=0.0, atol=1e-5)
    turned = (before.rotation.inv() * after.rotation).as_rotvec() / (2 * h)
    np.testing.assert_allclose(motion.angular, turned, rtol=0.0, atol=1e-4)
    for rate, late, early in (
        (motion.linear_rate, after.linear, before.linear),
        (motion.angular_rate, after.angular, before.angular),
    ):
        np.testing.assert_allclose(rate, (late - early) / (2 * h), rtol=0.0, atol=2e-3)
        assert np.abs(rate).max() > 1.0


def test_a_swing_goes_up_and_comes_down_at_rest_and_carries_nothing_in_between() -> None:
    time = np.linspace(0.0, 1.0, 1001)
    swing = Swing.at(time, 0.3, 0.4, 0.05, 0.1)
    assert swing.height.max() == pytest.approx(0.05)
    assert time[np.argmax(swing.height)] == pytest.approx(0.5)
    away = (time <= 0.3) | (time >= 0.7)
    assert np.abs(swing.height[away]).max() == 0.0
    assert np.abs(swing.ready[~away]).max() == 0.0
    np.testing.assert_array_equal(swing.ready[(time < 0.199) | (time > 0.801)], 1.0)
    np.testing.assert_allclose([swing.progress[0], swing.progress[500], swing.progress[-1]], [0.0, 0.5, 1.0])
    assert np.abs(np.diff(swing.height, 2)).max() < 1e-5
    np.testing.assert_allclose(quintic(np.array([-1.0, 0.0, 0.5, 1.0, 2.0])), [0.0, 0.0, 0.5, 1.0, 1.0])
