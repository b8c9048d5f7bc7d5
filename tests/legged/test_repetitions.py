"""Coverage is counted rightly: tallies with known answers, and standard errors that are torchid's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from interval_coverage import coverage_table
from legged.errors import structural_base
from legged.repetitions import (
    SITUATIONS,
    Repetitions,
    Tally,
    combination_errors,
    summarize,
)
from legged.robots import GO2, QUADRUPED
from legged_accuracy import accuracy_table
from script_calls import call

from torchid.identifiability.confounding import combination_standard_error
from torchid.parameters import FRICTION, PER_BODY

SITUATION = {one.name: one for one in SITUATIONS}
SECONDS = 3.0


@pytest.fixture(scope="module")
def exact() -> Repetitions:
    """Torques without noise."""
    quiet = Repetitions("quadruped", SITUATION["exact motion, torque noise"], SECONDS)
    quiet.noise = replace(quiet.noise, joint_torque=0.0)
    return quiet


def drawn(rng: np.random.Generator, count: int, stated: float = 1.0) -> Tally:
    """Estimates with noise of 1 whose standard errors are as stated."""
    tally = Tally(np.arange(5.0), 20.0)
    for _ in range(count):
        tally.estimates.append(np.arange(5.0) + rng.normal(size=5))
        tally.errors.append(np.array([stated, stated, stated, stated, np.nan]))
        tally.mass.append((20.0 + 0.5 * rng.normal(), 0.5))
        tally.parameters.append(np.array([1.0, np.nan]))
        tally.residual.append(1.0)
        tally.misfit.append(False)
    return tally


@pytest.mark.parametrize(("stated", "average"), [(1.0, 0.95), (0.5, 0.673)])
def test_intervals_hold_the_truth_as_often_as_their_size_says(stated: float, average: float) -> None:
    tally = drawn(np.random.default_rng(0), 2000, stated)
    found = summarize(tally)
    assert found["combinations"] == 4, "what is not determined does not count"
    assert found["average"] == pytest.approx(average, abs=0.012)
    assert found["worst"] <= found["average"]
    assert found["ratio"] == pytest.approx(stated, abs=0.03)
    assert found["bias"] < 0.04
    assert found["mass"] == pytest.approx(0.95, abs=0.015)
    tally.truth[1] += 3.0
    assert summarize(tally)["worst"] == pytest.approx(0.149 if stated == 1.0 else 0.03, abs=0.04), "a bias is seen"


def test_a_mass_that_is_not_determined_has_no_coverage() -> None:
    tally = drawn(np.random.default_rng(3), 2)
    tally.mass[0] = (20.0, np.inf)
    assert np.isnan(summarize(tally)["mass"])


def test_without_noise_the_truth_is_found(exact: Repetitions) -> None:
    tally = exact.run(1)
    base = structural_base(exact.true.legged)
    scale = np.abs(tally.truth).max()
    assert np.isfinite(tally.errors[0]).sum() > 80
    known = np.isfinite(tally.errors[0])
    assert np.abs(tally.estimates[0] - tally.truth)[known].max() < 1e-6 * scale
    assert len(base.kept) == len(tally.truth)
    if np.isfinite(tally.mass[0][1]):
        assert tally.mass[0][0] == pytest.approx(tally.true_mass, abs=1e-5)


def test_errors_of_combinations_are_those_of_torchid(exact: Repetitions) -> None:
    fit = exact._fit(exact._samples(np.random.default_rng(0)))
    base = structural_base(exact.true.legged)
    found = combination_errors(fit, base.combination)
    for number in range(0, len(found), 17):
        expected = combination_standard_error(fit.assembly.problem, fit.estimate, base.combination[number])
        assert np.isnan(found[number]) == np.isinf(expected)
        if np.isfinite(expected):
            assert fit.jackknife is not None
            larger = max(expected, fit.jackknife.error_along(base.combination[number]))
            assert found[number] == pytest.approx(larger, rel=1e-9)


@pytest.mark.parametrize(
    "name", ["filtered at 20 Hz", "exact motion, torque offsets", "friction not in the model, 20 Hz"]
)
def test_situations_are_what_their_names_say(name: str) -> None:
    situation = SITUATION[name]
    one = Repetitions("quadruped", situation, SECONDS)
    samples = one._samples(np.random.default_rng(0))
    assert (samples.oversampling > 1.0) == (situation.cutoff is not None)
    assert not samples.active.all()
    tally = one.run(1)
    friction = structural_base(one.true.legged).kept % PER_BODY >= FRICTION.start
    assert np.isnan(tally.errors[0][friction]).all() == (not situation.friction)
    assert len(one.fitter.builder.extras) == (24 if situation.offsets else 12)


def test_scripts_refuse_what_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    status, _, err = call("interval_coverage", "--situations", "filtered at 20 hz")
    assert status == 2
    assert "filtered at 20 Hz" in err
    monkeypatch.setattr(type(GO2), "available", property(lambda self: self == QUADRUPED))
    for script in ("interval_coverage", "legged_accuracy"):
        status, _, err = call(script, "--robots", "Go2")
        assert status == 2
        assert "example-robot-data" in err


@pytest.mark.study
@pytest.mark.slow("many fits")
def test_intervals_hold_the_truth_with_torque_noise_and_behind_a_filter() -> None:
    head, *rows = coverage_table(10, ["quadruped"], ["exact motion, torque noise", "filtered at 20 Hz"])
    assert [float(row[1].split(" / ")[0]) > 90.0 for row in rows] == [True, True]


@pytest.mark.study
@pytest.mark.slow("simulations and whole fits")
@pytest.mark.skipif(not GO2.available, reason="the package example-robot-data is not installed")
def test_the_accuracy_of_go2_is_measured() -> None:
    _, points, balls, _, _ = accuracy_table(["Go2"], ["exact"], seeds=[0], seconds=8.0)
    assert points[0] == "Go2, point feet"
    assert float(points[1]) < 0.1
    assert float(balls[1]) < 0.1
