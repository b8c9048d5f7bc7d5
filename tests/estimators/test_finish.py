"""A descent takes what the closed form takes, and ends at its optimum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from descents import arm_log, true_arm
from physical import PRIORS, random_case
from synthetic import UR5, load
from thinned import study_but

from torchid.estimators import Conditions, Consistent, LeastSquares, PenaltyWeights, Sgd, Trainer, violations
from torchid.estimators.least_squares import Minimizer
from torchid.estimators.sgd import excess, least_penalized, nearest_allowed
from torchid.problem import ExtraTerms, MiniBatches, RowBuilder, assemble, compress_parts
from torchid.sensing import SensorNoise, named_sensors

RIDGE = 0.01


@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize("seed", study_but([2, 4, 5], range(6)))
def test_it_ends_at_the_optimum_of_the_closed_form_under_the_same_conditions(seed: int, prior: str) -> None:
    case = random_case(np.random.default_rng(seed))
    settings = Sgd(RIDGE, prior=prior, conditions=case.conditions)
    found = settings.consistent.minimize(case.problem)
    assert excess(settings, case.problem, found) < 1e-6
    shape = (-1, 12)
    assert not violations(found.phi.reshape(shape), case.problem.scale.reshape(shape), case.conditions, 1e-8)


def test_of_a_descent_that_ends_early_it_is_known_by_how_much() -> None:
    case = random_case(np.random.default_rng(0), plain=True)
    settings = Sgd(RIDGE, conditions=case.conditions)
    best = Consistent(RIDGE, conditions=case.conditions).solve(case.problem)
    there = excess(settings, case.problem, Minimizer(best.phi))
    assert abs(there) < 1e-6
    nominal = Consistent(1e9, conditions=case.conditions).solve(case.problem).phi
    cost = case.problem.cost(nominal) / case.problem.rows
    away = RIDGE * float(np.square((nominal - case.problem.nominal) / case.problem.scale).sum())
    assert excess(settings, case.problem, Minimizer(nominal)) == pytest.approx(
        (cost + away) / best.objective - 1.0, rel=1e-6
    )


@pytest.mark.parametrize("weight", [1.0, 100.0])
def test_with_penalties_the_bound_holds_and_vanishes_at_the_optimum(weight: float) -> None:
    case = random_case(np.random.default_rng(1), plain=True)
    weights = PenaltyWeights(eigenvalue=weight, mass=weight, friction=weight)
    settings = Sgd(RIDGE, consistency="penalties", penalties=weights, conditions=Conditions())
    before = Minimizer(case.problem.nominal)
    found = least_penalized(settings, case.problem, before)
    assert excess(settings, case.problem, found) < 1e-6 < excess(settings, case.problem, before)


def bolted_arm(terms: ExtraTerms) -> tuple[Trainer, MiniBatches, object]:
    """A UR5 whose torque sensors have offsets, in two logs, each with its own."""
    robot = load(UR5, fixed_base=True)
    builder = RowBuilder(robot, [], named_sensors("joints", robot.n, 0, SensorNoise(joint_torque=0.1)), terms)
    phi, logs = true_arm(robot), []
    for seed in (1, 2):
        log = arm_log(robot, phi, seed, 120)
        shift = torch.linspace(-1.0, 2.0, robot.n, dtype=torch.float64) * seed
        logs.append(replace(log, torque=log.torque + shift + 0.3 * log.joint_acceleration, motion_noise=None))
    assembly = assemble(compress_parts(logs, builder), builder, robot)
    batches = MiniBatches(logs, builder, 50, assembly=assembly)
    return Trainer(Sgd(RIDGE, epochs=2), assembly.problem, batches, data=assembly.problem), batches, assembly.problem


@pytest.mark.parametrize("armature", [False, True])
@pytest.mark.parametrize("scope", ["log", "all"])
def test_offsets_and_armatures_cost_a_batch_what_they_cost_the_closed_form(scope: str, armature: bool) -> None:
    trainer, batches, problem = bolted_arm(ExtraTerms(offsets={"joint_torque": scope}, armature=armature))
    found = trainer.settings.consistent.minimize(problem)
    values = torch.from_numpy(np.append(found.phi, [] if found.psi is None else found.psi))
    cost = problem.cost(found.phi, found.psi)
    assert trainer.loss.mean_square(batches, values) == pytest.approx(
        cost / sum(b.rows for b in batches.chunks()), rel=1e-9
    )
    estimate = trainer.run()
    assert estimate.converged
    assert estimate.objective == pytest.approx(Consistent(RIDGE).solve(problem).objective, rel=1e-5)
    if armature:
        np.testing.assert_allclose(estimate.psi[-4:], 0.3, atol=0.02)  # nearer the base rotors and links are alike


@pytest.mark.parametrize("seed", range(3))
def test_a_descent_that_is_not_finished_ends_within_all_conditions(seed: int) -> None:
    """What meets them stays; what does not moves by no more than a multiple of how far the nearest is away."""
    case = random_case(np.random.default_rng(seed))
    shape, settings = (-1, 12), Sgd(RIDGE, conditions=case.conditions)
    scale = case.problem.scale.reshape(shape)
    free = Minimizer(LeastSquares(RIDGE).solve(case.problem).phi)
    found = nearest_allowed(settings, case.problem, free)
    assert not violations(found.phi.reshape(shape), scale, case.conditions, 1e-8)
    assert nearest_allowed(settings, case.problem, found) is found
    best = Consistent(RIDGE, conditions=case.conditions).solve(case.problem)  # the same, from the least of all
    np.testing.assert_allclose(found.phi / case.problem.scale, best.phi / case.problem.scale, atol=1e-3)
