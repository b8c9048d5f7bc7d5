"""Parameters found on noise-free logs of a Pinocchio robot predict every force of motions that no fit has seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from thinned import each_once
from true_robots import (
    EXACT,
    KINDS,
    World,
    driving,
    fit,
    hide,
    predicted,
    true_parameters,
    unseen,
    world,
    worst,
)

from torchid import parameters
from torchid.estimators import Estimate, LeastSquares
from torchid.problem import RowBuilder, Samples, compress, linear_problem
from torchid.problem.linear import parameter_scale
from torchid.problem.metrics import force_series
from torchid.sensing import SensorSet, chosen_sensors, named_sensors


def sensors_of(w: World, name: str) -> SensorSet:
    """A named set; or the first foot's wrench and every torque but those of the leg above it."""
    if name != "mixed":
        return named_sensors(name, w.robot.n, len(w.kind.feet))
    torques = [joint for joint in w.robot.joint_names if joint not in w.kind.leg]
    contact = w.kind.contacts[0]
    return chosen_sensors(w.robot.joint_names, w.kind.contacts, torques, {contact.frame: contact.component_names})


@cache
def found(name: str, sensors: str) -> Estimate:
    return fit(world(name), sensors_of(world(name), sensors))


robots = pytest.mark.parametrize("name", KINDS)


@robots
def test_the_recorded_forces_close_the_dynamics_in_every_contact_state_and_in_flight(name: str) -> None:
    w = world(name)
    builder = RowBuilder(w.robot, w.kind.contacts, sensors_of(w, "full"))
    nominal = w.robot.nominal.flatten()
    phi = found(name, "full").phi
    measured, forces = force_series(builder, w.logs[0], np.stack([nominal, phi]))
    assert worst(forces[1], measured) < EXACT
    assert worst(forces[0], measured) > 0.02, "the URDF must be wrong for the test to mean anything"
    states = {tuple(state) for samples in w.logs for state in samples.active.tolist()}
    assert {tuple(state) for state in w.kind.states} == states


@robots
@pytest.mark.parametrize("sensors", ["full", "joints"])
def test_torque_sensors_find_all_that_moves_the_robot(name: str, sensors: str) -> None:
    w = world(name)
    true = w.oracle.forces(*unseen(name))
    assert worst(predicted(w.robot, found(name, sensors).phi, *unseen(name)), true) < EXACT


@robots
def test_contact_sensors_alone_find_all_inertial_forces_and_leave_friction_at_the_urdf(name: str) -> None:
    w = world(name)
    phi = found(name, "contacts").phi.reshape(-1, parameters.PER_BODY).copy()
    np.testing.assert_allclose(
        phi[:, parameters.FRICTION], w.robot.nominal[:, parameters.FRICTION], rtol=0.0, atol=1e-12
    )
    phi[:, parameters.FRICTION] = 0.0
    forces = predicted(w.robot, phi.flatten(), *unseen(name))
    true = w.oracle.frictionless_forces(*unseen(name))
    seen = np.array([True] * 6 + [joint not in driving(w.robot) for joint in w.robot.joint_names])
    assert worst(forces[:, seen], true[:, seen]) < EXACT
    if not seen.all():  # mimic fingers that turn against each other: their common inertia never reaches the base
        assert worst(forces, true) > 1e-7


@robots
def test_base_parameters_are_the_true_ones_and_the_identifiable_among_all_too(name: str) -> None:
    w = world(name)
    estimate = found(name, "joints")
    true = true_parameters(w.oracle, w.robot)
    scale = parameter_scale(w.robot.nominal).flatten()
    known = estimate.identifiable
    assert known.sum() > 2 * w.robot.n
    np.testing.assert_allclose((estimate.phi - true.flatten())[known] / scale[known], 0.0, rtol=0, atol=1e-10)
    nominal = w.robot.nominal.flatten()
    bounds = np.linalg.norm((true.flatten() - nominal) / scale)
    assert np.linalg.norm((estimate.phi - nominal) / scale) <= bounds, "of all exact answers, the nearest to the URDF"


# ---------------------------------------------------------------------------------------------- how it is computed


@cache
def noisy_logs() -> tuple[Samples, ...]:
    """ANYmal's logs with noise: an inconsistent system hides nothing."""
    generator = torch.Generator().manual_seed(5)
    logs = []
    for samples in world("ANYmal").logs:
        assert samples.torque is not None
        assert samples.wrench is not None
        torque = samples.torque + 0.5 * torch.randn(samples.torque.shape, generator=generator, dtype=torch.float64)
        wrench = samples.wrench + 2.0 * torch.randn(samples.wrench.shape, generator=generator, dtype=torch.float64)
        logs.append(replace(samples, torque=torque, wrench=wrench))
    return tuple(logs)


def merged(w: World, sensors: SensorSet, logs: Sequence[Samples]) -> Estimate:
    """Each log in a factor of its own."""
    builder = RowBuilder(w.robot, w.kind.contacts, sensors)
    total, *others = [compress([hide(samples, sensors)], builder) for samples in logs]
    for other in others:
        total.merge(other)
    return LeastSquares().solve(linear_problem(total, builder, w.robot))


def pieces(logs: Sequence[Samples]) -> list[Samples]:
    """The logs in pieces of unequal length, one of a single sample."""
    cuts = (0, 1, 100, 250, None)
    return [samples[slice(*ends)] for samples in logs for ends in zip(cuts, cuts[1:], strict=False)]


def shuffled(logs: Sequence[Samples]) -> list[Samples]:
    generator = torch.Generator().manual_seed(6)
    return [samples[torch.randperm(len(samples), generator=generator)] for samples in logs]


Way = Callable[[World, SensorSet], Estimate]
WAYS: dict[str, Way] = {
    "chunks of 7": lambda w, s: fit(w, s, noisy_logs(), chunk=7),
    "chunks of 64": lambda w, s: fit(w, s, noisy_logs(), chunk=64),
    "chunks of 300": lambda w, s: fit(w, s, noisy_logs(), chunk=300),
    "one thread": lambda w, s: fit(w, s, noisy_logs(), threads=1),
    "two threads": lambda w, s: fit(w, s, noisy_logs(), threads=2),
    "five threads": lambda w, s: fit(w, s, noisy_logs(), threads=5, chunk=64),
    "logs reversed": lambda w, s: fit(w, s, noisy_logs()[::-1]),
    "samples shuffled": lambda w, s: fit(w, s, shuffled(noisy_logs())),
    "logs cut in pieces": lambda w, s: fit(w, s, pieces(noisy_logs())),
    "factors merged": lambda w, s: merged(w, s, pieces(noisy_logs())),
}


@cache
def usual(sensors: str) -> Estimate:
    return fit(world("ANYmal"), sensors_of(world("ANYmal"), sensors), noisy_logs(), chunk=2048)


@pytest.mark.parametrize(("way", "sensors"), each_once([*WAYS], ["joints", "mixed"]))
def test_how_samples_are_cut_ordered_and_shared_out_does_not_change_the_result(way: str, sensors: str) -> None:
    w = world("ANYmal")
    expected, estimate = usual(sensors), WAYS[way](w, sensors_of(w, sensors))
    scale = parameter_scale(w.robot.nominal).flatten()
    assert np.linalg.norm((estimate.phi - expected.phi) / scale) < 1e-9 * np.linalg.norm(expected.phi / scale)
    forces = predicted(w.robot, expected.phi, *unseen("ANYmal"))
    assert worst(predicted(w.robot, estimate.phi, *unseen("ANYmal")), forces) < 1e-9
    assert (estimate.rows, estimate.rank) == (expected.rows, expected.rank)
    assert estimate.cost == pytest.approx(expected.cost, rel=1e-10)
    np.testing.assert_array_equal(estimate.identifiable, expected.identifiable)
    known = expected.identifiable
    np.testing.assert_allclose(estimate.standard_error[known], expected.standard_error[known], rtol=1e-8)
