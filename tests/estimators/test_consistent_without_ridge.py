"""Ridge 0: what the data do not determine stays nominal, as an independent conic solution has it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from conic_reference import least_misfit, least_objective, least_prior
from contact_states import BOTH, FLIGHT, LEFT, RIGHT, biped
from physical import (
    PRIORS,
    active_case,
    as_good_as_none,
    data,
    prior_value,
    random_bodies,
    random_case,
)
from synthetic import Array

from torchid import parameters
from torchid.errors import InputError
from torchid.estimators import Conditions, Consistent, Enclosure, LeastSquares, violations
from torchid.estimators.conic_problem import Prior
from torchid.identifiability.base_parameters import structural_problem
from torchid.problem import LinearProblem
from torchid.problem.linear import parameter_scale
from torchid.sensing import named_sensors

RANK = 1e-10  # what counts as determined
all_priors = pytest.mark.parametrize("prior", PRIORS)


def check(problem: LinearProblem, conditions: Conditions, prior: Prior, accuracy: float) -> None:
    """Least misfit, least prior among all that predict the same, conditions met, and nothing out of bounds."""
    estimate = Consistent(0.0, prior, conditions).solve(problem)
    phi, scale, nominal = (x.reshape(-1, 12) for x in (estimate.phi, problem.scale, problem.nominal))
    assert violations(phi, scale, conditions, 1e-7) == []
    floor = as_good_as_none(0.0, problem)
    misfit = problem.cost(estimate.phi) / problem.rows
    assert estimate.objective == pytest.approx(misfit, rel=1e-5, abs=1e-3 * floor)  # and the part of the least ridge
    least = least_misfit(problem, conditions)
    assert (misfit - least) / max(least, floor) < 1e-6
    bodies = problem.free.reshape(-1, 12)[:, 0]
    value = prior_value(prior, phi[bodies], nominal[bodies], scale[bodies])
    alike = least_prior(problem, conditions, prior, estimate.phi, RANK)
    assert value <= alike * (1.0 + accuracy) + accuracy
    assert np.abs((phi - nominal) / scale).max() < 1e3  # what data determine may be far away


# ---------------------------------------------------------------------------------------------- random and structural


@pytest.mark.parametrize("seed", [1, 3, 10])
@all_priors
def test_random_problems_have_the_least_misfit_and_of_all_with_it_the_least_prior(prior: Prior, seed: int) -> None:
    case = random_case(np.random.default_rng(seed))
    check(case.problem, case.conditions, prior, 1e-6)


STATES = ([BOTH], [LEFT], [RIGHT], [FLIGHT], [LEFT, RIGHT], [BOTH, LEFT], [BOTH, LEFT, RIGHT])


@cache
def structural(name: str, states: int, sensors: str, friction: bool) -> LinearProblem:
    """All that sensors can see in some contact states, of bodies 20 % off their URDF."""
    robot, contacts = biped(name)
    problem = structural_problem(robot, contacts, named_sensors(sensors, robot.n, 2), STATES[states], friction)
    rng = np.random.default_rng(states)
    truth = parameters.perturb_parameters(robot.nominal, 0.2, rng)
    truth[:, parameters.FRICTION] = rng.uniform(0.0, 0.5, (len(truth), 2)) if friction else 0.0
    phi = np.where(problem.free, truth.ravel(), problem.nominal)
    return replace(problem, b=problem.A @ phi, residual=0.0)


def check_structural(problem: LinearProblem, prior: Prior) -> None:
    """Bodies whose truth is a fifth of a scale from nominal: no mass is absurd, and no parameter is beyond belief."""
    estimate = Consistent(0.0, prior).solve(problem)
    phi, scale = (x.reshape(-1, 12) for x in (estimate.phi, problem.scale))
    assert violations(phi, scale, Conditions(), 1e-7) == []
    assert np.abs((estimate.phi - problem.nominal) / problem.scale).max() < 1.0
    total, nominal = (float(x[::12].sum()) for x in (estimate.phi, problem.nominal))
    assert total == pytest.approx(nominal, rel=0.5)
    assert estimate.objective <= 1e-6 * problem.cost(problem.nominal) / problem.rows


def test_joint_torques_of_a_standing_biped() -> None:
    problem = structural("biped", 0, "joints", False)
    assert LeastSquares().solve(problem).rank < problem.free.sum()
    check_structural(problem, "euclidean")


@pytest.mark.slow
@pytest.mark.parametrize("friction", [False, True])
@pytest.mark.parametrize("sensors", ["full", "joints"])
@pytest.mark.parametrize("states", range(len(STATES)))
@pytest.mark.parametrize("name", ["biped", "G1"])
@all_priors
def test_fifty_six_structural_problems(prior: Prior, name: str, states: int, sensors: str, friction: bool) -> None:
    check_structural(structural(name, states, sensors, friction), prior)


# ------------------------------------------------------------------------------------------------------- known answers


def mass_alone(mass: float) -> tuple[LinearProblem, Array]:
    """Two bodies, and one row that says their total mass."""
    nominal = random_bodies(np.random.default_rng(1), 2)
    scale = parameter_scale(nominal)
    row = np.zeros((1, 24))
    row[0, [0, 12]] = 1.0
    free = np.ones(24, dtype=bool)
    return LinearProblem(row, np.array([mass]), 0.0, 1, nominal.ravel(), scale.ravel(), free), nominal


def test_without_active_conditions_it_is_least_squares_of_least_norm() -> None:
    problem, nominal = mass_alone(1.0)
    problem = replace(problem, b=np.array([1.01 * nominal[:, 0].sum()]))
    estimate = Consistent(0.0, conditions=Conditions(1e-6)).solve(problem)
    plain = LeastSquares().solve(problem)
    off = (estimate.phi - plain.phi) / problem.scale
    np.testing.assert_allclose(off, 0.0, atol=1e-6)
    assert estimate.increase == pytest.approx(0.0, abs=1e-12)


@all_priors
def test_a_total_mass_that_no_body_can_have_brings_the_least_mass(prior: Prior) -> None:
    """Data of mass 0: each body's least mass is the margin, where its first moments must vanish: no room is left."""
    problem, nominal = mass_alone(0.0)
    estimate = Consistent(0.0, prior, Conditions(1e-2)).solve(problem)
    least = 1e-2 * nominal[:, 0].sum()
    assert estimate.phi[::12].sum() == pytest.approx(least, rel=1e-3)
    assert np.abs((estimate.phi - problem.nominal) / problem.scale).max() < 2.0


@all_priors
def test_exact_data_of_bodies_without_friction_are_explained(prior: Prior) -> None:
    """Friction at its bound: what the data determine leaves the conditions no room."""
    rng = np.random.default_rng(4)
    nominal = random_bodies(rng, 2)
    nominal[:, 10:] = 0.2
    truth = parameters.perturb_parameters(nominal, 0.1, rng)
    truth[:, 10:] = 0.0
    problem = data(rng, nominal, truth, parameter_scale(nominal), 40, 10.0, 0.0)
    estimate = Consistent(0.0, prior, Conditions(1e-5)).solve(problem)
    np.testing.assert_allclose((estimate.phi - truth.ravel()) / problem.scale, 0.0, atol=1e-5)


@all_priors
def test_a_total_mass_and_a_box_are_kept(prior: Prior) -> None:
    """What is predicted alike has no inside there: the reference's tolerance moves its least prior by 5e-4."""
    problem, scale = active_case(5, bodies=2, rows=9)
    nominal = problem.nominal.reshape(scale.shape)
    box = Enclosure(0, "box", nominal[0, 1:4] / nominal[0, 0], np.eye(3), np.full(3, 0.05))
    conditions = Conditions(total_mass=float(nominal[:, 0].sum()), enclosures=(box,))
    check(problem, conditions, prior, 1e-3)


# ------------------------------------------------------------------------------------------------ flat bodies, rounding


@pytest.mark.parametrize("prior", ["pullback", "entropic"])
def test_priors_of_matter_from_bodies_that_are_nearly_flat(prior: Prior) -> None:
    """A least eigenvalue of 5e-11: across the plate the prior is 1e20 times stiffer than along it."""
    rng = np.random.default_rng(6)
    nominal = random_bodies(rng, 2)
    values, vectors = np.linalg.eigh(parameters.pseudo_inertia(nominal[0]))
    flat = (vectors * [5e-11, *values[1:]]) @ vectors.T
    second = flat[:3, :3]
    inertia = np.trace(second) * np.eye(3) - second
    nominal[0, :10] = [flat[3, 3], *flat[:3, 3], *(inertia[i, j] for i, j in parameters.INERTIA_AXES)]
    nominal[:, 10:] = 0.2
    truth = parameters.perturb_parameters(nominal, 0.2, rng)
    problem = data(rng, nominal, truth, parameter_scale(nominal), 18, 30.0, 1e-2)
    fast = Consistent(1e-2, prior, Conditions(0.0)).solve(problem)
    assert fast.objective == pytest.approx(least_objective(problem, Conditions(0.0), prior, 1e-2), rel=1e-6)
    assert fast.gap <= 1e-6 * fast.objective
    without = Consistent(0.0, prior, Conditions(0.0)).solve(problem)
    assert without.objective <= fast.objective
    assert np.abs((without.phi - problem.nominal) / problem.scale).max() < 100.0


@pytest.mark.parametrize("estimator", [LeastSquares(), Consistent(), Consistent(1e-3)])
def test_linear_algebra_that_fails_is_one_line(
    estimator: LeastSquares | Consistent, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, _ = active_case(0)

    def fails(*arguments: object) -> None:
        raise np.linalg.LinAlgError("SVD did not converge")

    where = "least_squares._Inverse.of" if isinstance(estimator, LeastSquares) else "consistent._solve"
    monkeypatch.setattr(f"torchid.estimators.{where}", fails)
    with pytest.raises(InputError, match="^estimator: name: .*failed numerically .SVD did not converge.; accepted: "):
        estimator.solve(problem)
