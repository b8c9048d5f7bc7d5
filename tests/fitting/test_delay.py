"""Torques that act later than the log says: the delay is found to a part of a step, with an interval that holds it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from delays import DELAY, NOISE, STEP, arm, motion, recorded
from motions import value

from torchid.errors import LogError, TorchidWarning
from torchid.estimators import Conditions, Consistent, LeastSquares
from torchid.fitting.fit import LogFitter
from torchid.fitting.profile import EARLIEST_DELAY, LATEST_DELAY, Profile, choose_delay
from torchid.logs import Log
from torchid.logs.preprocess import preprocess
from torchid.logs.segments import with_delayed_torques
from torchid.problem import ExtraTerms, RowBuilder, bind_log
from torchid.sensing import SensorNoise, named_sensors


def chosen(
    *logs: Log, estimator: LeastSquares | Consistent | None = None, terms: ExtraTerms | None = None, std: float = NOISE
) -> Profile:
    """What is found in logs of the arm."""
    robot, terms = arm()[0], terms or ExtraTerms()
    builder = RowBuilder(robot, (), named_sensors("joints", robot.n, 0, SensorNoise(joint_torque=std)), terms)
    fitter = LogFitter(robot=robot, builder=builder, estimator=estimator or LeastSquares())
    return choose_delay([bind_log(log, robot, ()) for log in logs], fitter, terms)


@pytest.mark.parametrize("delay", [DELAY, -0.0042, 0.0231, 0.05])
@pytest.mark.parametrize(
    "estimator", [LeastSquares(), Consistent(conditions=Conditions())], ids=["plain", "consistent"]
)
def test_a_delay_of_a_part_of_a_step_is_found_to_a_microsecond(
    delay: float, estimator: LeastSquares | Consistent
) -> None:
    found = chosen(recorded(delay), estimator=estimator)
    assert found.best == pytest.approx(delay, abs=1e-6)
    assert found.value == pytest.approx(delay, abs=1e-6)
    assert found.share < 1e-2
    assert str(found).startswith(f"{1e3 * delay:.3g} ms (95 %: ")


def test_it_is_found_beside_armatures_springs_offsets_and_scales() -> None:
    """A reading s y - o of a torque: scales go with the torques of the delay that is found."""
    robot, _ = arm()
    terms = ExtraTerms(
        {"joint_torque": "log"}, {"joint_torque": [[robot.joint_names[1]]]}, armature=True, stiffness=True
    )
    log = recorded()
    q, _, a = motion(log.time + DELAY)
    torque = value(log.joint_torque) + 0.05 * a + 0.3 * q
    torque = (torque + np.array([0.4, -0.2])) / np.array([1.0, 1.3])
    found = chosen(replace(log, joint_torque=torque), terms=terms)
    assert found.best == pytest.approx(DELAY, abs=2e-6)


@pytest.mark.parametrize(
    "estimator", [LeastSquares(), pytest.param(Consistent(), marks=pytest.mark.study)], ids=["plain", "consistent"]
)
def test_intervals_of_95_percent_hold_the_delay_of_noisy_logs(estimator: LeastSquares | Consistent) -> None:
    logs = [preprocess(recorded(noise=NOISE, seed=seed), cutoff_hz=30.0) for seed in range(40)]
    found = [chosen(log, estimator=estimator) for log in logs]
    held = sum(one.interval[0] <= DELAY <= one.interval[1] for one in found)
    assert held >= 35  # of 40; 38 expected, fewer than 35 of every 21st draw
    scatter = np.std([one.best for one in found])
    assert 0.8 < np.median([(one.interval[1] - one.best) / 1.96 for one in found]) / scatter < 1.4
    assert np.mean([one.best for one in found]) == pytest.approx(DELAY, abs=0.4 * scatter)


def test_no_delay_is_none_and_one_that_a_single_sine_cannot_tell_is_named() -> None:
    """A sine of one rate fits any delay with some inertia and damping."""
    none = chosen(preprocess(recorded(0.0, NOISE, seed=5), cutoff_hz=15.0))
    assert none.value == 0.0
    assert abs(none.best) < 1e-3
    assert "not significantly different from 0" in str(none)
    log = preprocess(recorded(DELAY, 1e-3, shape=(1, 0.02)), cutoff_hz=15.0)
    single = chosen(log, terms=ExtraTerms(armature=True, stiffness=True), std=1e-3)
    assert single.value == 0.0
    assert single.confounded_with
    assert "confounded with" in str(single)


def test_logs_that_are_too_short_for_the_delays_that_are_tried_are_refused() -> None:
    with pytest.raises(LogError, match=f"no log is longer than the {LATEST_DELAY - EARLIEST_DELAY:g} s"):
        chosen(recorded(seconds=0.07))


@pytest.mark.parametrize("delay", [DELAY, -DELAY, 0.011])
def test_a_log_with_its_delay_has_the_torques_that_act_at_its_stamps(delay: float) -> None:
    log = recorded(delay)
    acting = with_delayed_torques(log, delay)
    lost = int(np.ceil(abs(delay) / STEP))
    np.testing.assert_array_equal(acting.time, log.time[lost:] if delay > 0.0 else log.time[:-lost])
    expected = arm()[1].forces(*motion(acting.time))
    np.testing.assert_allclose(acting.joint_torque[10:-10], expected[10:-10], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(acting.joint_torque, expected, rtol=0.0, atol=1e-3)  # not-a-knot ends
    assert with_delayed_torques(log, 0.0) is log


def test_a_delay_reaches_across_no_break_of_a_log_and_knows_nothing_beside_what_was_not_recorded() -> None:
    log = recorded()
    broken = log.select(np.r_[0:600, 1000:1600])
    acting = with_delayed_torques(broken, DELAY)
    assert len(acting) == 1198, "the first sample of each part has no torque of before"
    assert set(broken.time[[0, 600]]).isdisjoint(acting.time)
    torque = value(log.joint_torque).copy()
    torque[700, 0] = np.nan
    lacking = with_delayed_torques(replace(log, joint_torque=torque), DELAY)
    known = np.isfinite(lacking.joint_torque)
    assert (~known).sum() == 2
    assert known[:, 1].all()
    with pytest.raises(LogError, match=r"not longer than actuators.delay \(9 s\)"):
        with_delayed_torques(log, 9.0)


@pytest.mark.parametrize("beyond", [EARLIEST_DELAY - 0.003, LATEST_DELAY + 0.003])
def test_a_delay_beyond_those_that_are_tried_is_said_to_be_at_their_end(beyond: float) -> None:
    end = min(max(beyond, EARLIEST_DELAY), LATEST_DELAY)
    with pytest.warns(TorchidWarning, match=f"{end:g} s, the end of the search range. Check that torques and pos"):
        found = chosen(recorded(beyond))
    assert found.best == end
    assert "; the end of the search range" in str(found)
