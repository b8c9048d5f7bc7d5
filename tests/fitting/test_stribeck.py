"""Friction that drops with speed: its velocity is found with an interval that holds it, or said not to be known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from delays import arm
from stribeck import AT_REST, NOISE, recorded

from torchid.estimators import Conditions, Consistent, LeastSquares
from torchid.fitting.fit import LogFitter
from torchid.fitting.profile import Profile, choose_stribeck
from torchid.logs import Log
from torchid.logs.dry_friction import mean_stribeck
from torchid.logs.preprocess import preprocess
from torchid.problem import ExtraTerms, RowBuilder, Samples, bind_log
from torchid.problem.compression import compress_in_blocks
from torchid.sensing import SensorNoise, named_sensors


def fitter_of(terms: ExtraTerms, estimator: LeastSquares | Consistent) -> LogFitter:
    robot = arm()[0]
    sensors = named_sensors("joints", robot.n, 0, SensorNoise(joint_torque=NOISE))
    return LogFitter(robot=robot, builder=RowBuilder(robot, (), sensors, terms), estimator=estimator)


def chosen(
    log: Log,
    cutoff_hz: float | None = None,
    terms: ExtraTerms | None = None,
    estimator: LeastSquares | Consistent | None = None,
) -> Profile:
    terms = terms or ExtraTerms()

    def logs_and_fitter(velocity: float | None) -> tuple[Sequence[Samples], LogFitter]:
        filtered = preprocess(log, cutoff_hz, stribeck=velocity)
        own = fitter_of(replace(terms, stribeck=velocity), estimator or LeastSquares())
        return [bind_log(filtered, arm()[0], ())], own

    return choose_stribeck(logs_and_fitter, terms)


@pytest.mark.parametrize(
    "estimator", [LeastSquares(), Consistent(conditions=Conditions())], ids=["plain", "consistent"]
)
def test_friction_at_rest_is_found_beside_friction_that_differs_by_direction(
    estimator: LeastSquares | Consistent,
) -> None:
    terms = ExtraTerms(asymmetric_coulomb=True, stribeck=0.13)
    fitter = fitter_of(terms, estimator)
    fit = fitter.fit(compress_in_blocks([bind_log(recorded(0.13, half=0.2), arm()[0], ())], fitter.builder))
    found = {(x.extra.what, x.extra.dof): x.value for x in fit.extras}
    for dof in range(2):
        assert found["stribeck", dof] == pytest.approx(AT_REST[dof], rel=1e-6)
        assert found["asymmetric_coulomb", dof] == pytest.approx(0.2, rel=1e-6)


@pytest.mark.parametrize("velocity", [0.03, 0.13, 0.5])
def test_the_velocity_of_exact_torques_is_found(velocity: float) -> None:
    found = chosen(recorded(velocity))
    assert found.best == pytest.approx(velocity, rel=1e-3)
    assert found.value == pytest.approx(velocity, rel=1e-3)
    assert found.share < 1e-2
    assert f"{found.value:.3g} rad/s (m/s) (95 %: " in str(found)


def _held(count: int, cutoff_hz: float | None) -> tuple[int, float]:
    """How many of so many intervals hold the velocity, and the median standard error over the scatter."""
    found = [chosen(recorded(0.2, NOISE, seed), cutoff_hz) for seed in range(count)]
    spans = [one.interval for one in found if one.value is not None and one.interval is not None]
    assert len(spans) == count
    errors = np.log([high / low for low, high in spans]) / (2.0 * 1.96)
    scatter = np.std(np.log([one.best for one in found]))
    return sum(low <= 0.2 <= high for low, high in spans), float(np.median(errors) / scatter)


def test_intervals_hold_the_velocity_of_noisy_logs() -> None:
    held, _ = _held(12, 10.0)
    assert held >= 10  # 11.4 expected, fewer than 10 in one of 50 cases


@pytest.mark.parametrize("estimator", [LeastSquares(), Consistent()], ids=["plain", "consistent"])
def test_coulomb_friction_alone_has_no_velocity(estimator: LeastSquares | Consistent) -> None:
    found = chosen(recorded(0.1, NOISE, at_rest=np.zeros(2)), 10.0, estimator=estimator)
    assert found.value is None
    assert str(found).startswith("none: friction at rest is not significantly larger than Coulomb friction")


def test_friction_at_rest_is_never_less_than_coulomb_friction_of_a_consistent_fit() -> None:
    log = bind_log(recorded(0.13, at_rest=-0.5 * AT_REST), arm()[0], ())
    at_rest = []
    for estimator in (LeastSquares(), Consistent(conditions=Conditions())):
        fitter = fitter_of(ExtraTerms(stribeck=0.13), estimator)
        at_rest.append([x.value for x in fitter.fit(compress_in_blocks([log], fitter.builder)).extras])
    np.testing.assert_allclose(at_rest[0], -0.5 * AT_REST, rtol=1e-6)
    np.testing.assert_allclose(at_rest[1], 0.0, atol=1e-6)


@pytest.mark.parametrize(("width", "off"), [(None, 1.5e-4), (0.02, 2e-6)])
def test_the_mean_over_a_step_is_that_of_many_velocities_between(width: float | None, off: float) -> None:
    rng, velocity = np.random.default_rng(0), 0.1
    before = rng.uniform(-0.2, 0.2, 200)
    after = before + rng.uniform(-0.1, 0.1, 200)
    between = before + (after - before) * ((np.arange(20000) + 0.5) / 20000)[:, None]
    sign = np.sign(between) if width is None else np.tanh(between / width)
    expected = (sign * np.exp(-np.square(between / velocity))).mean(axis=0)
    found = mean_stribeck(np.stack([before, after]), width, velocity)[0]
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=off)
