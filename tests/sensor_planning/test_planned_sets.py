"""With every sensor set that the planner finds, noise-free logs give all inertial forces of motion no fit has seen."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from synthetic import Array
from thinned import study_but
from true_robots import KINDS, Kind, World, driving, fit, predicted, stepping, unseen, world, worst

from torchid import parameters
from torchid.identifiability.base_parameters import standing_samples, standing_states, structural_problem
from torchid.problem import Samples
from torchid.regressor import FrameJacobian
from torchid.sensor_planning.observability import Candidate, assess_sensors, candidates, sensor_set
from torchid.sensor_planning.planner import MotionStack, PlanningProblem, SensorPlan, irredundant_set, plan_sensors

EXACT = 1e-8
PER_STATE = 250


def steps(kind: Kind) -> tuple[tuple[bool, ...], ...]:
    return tuple(map(tuple, stepping(len(kind.feet))))


@cache
def plan(name: str, per: str) -> SensorPlan:
    w = world(name)
    offered = candidates(w.robot, w.kind.contacts, per=per)
    everything = structural_problem(
        w.robot, w.kind.contacts, sensor_set(w.robot, w.kind.contacts, offered), steps(w.kind)
    )
    prior = everything.scale * everything.free
    return plan_sensors(PlanningProblem(w.robot, w.kind.contacts, steps(w.kind), offered, prior))


def sets(name: str, per: str) -> list[tuple[Candidate, ...]]:
    """The recommended set, and unions of minimal sets of the parts: the least informative, and some at random."""
    found, rng = plan(name, per), np.random.default_rng(4)
    unions = [found.chosen, tuple(c for part in found.parts for c in part.ranked[-1][1])]
    for _ in range(1):
        unions.append(tuple(c for part in found.parts if part.sets for c in part.sets[rng.integers(len(part.sets))]))
    return unions


def frictionless(phi: Array) -> Array:
    out = phi.reshape(-1, parameters.PER_BODY).copy()
    out[:, parameters.FRICTION] = 0.0
    return out.flatten()


@cache
def standing_log(name: str, state: tuple[bool, ...], seed: int, count: int = PER_STATE) -> Samples:
    """A robot whose feet are still while they touch, with forces that close its dynamics."""
    w = world(name)
    samples = standing_samples(w.robot, w.kind.contacts, state, count, np.random.default_rng(seed))
    q, v, a = standing_states(w.robot, w.kind.contacts, state, count, np.random.default_rng(seed))
    needed = w.oracle.forces(q.numpy(), v.numpy(), a.numpy())
    torque, wrench = closing_forces(w, q, state, needed, np.random.default_rng([8, seed]))
    return replace(samples, source=f"standing {seed}", torque=torque, wrench=wrench)


def stepping_logs(name: str) -> list[Samples]:
    """The same robot with every foot down, and with each lifted in turn."""
    return [standing_log(name, state, seed) for seed, state in enumerate(steps(world(name).kind))]


def closing_forces(
    w: World, q: torch.Tensor, state: tuple[bool, ...], needed: Array, rng: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Torques (B, n) and wrenches (B, C, 6) with S^T tau + J^T lambda = needed (B, nv), internal forces at random."""
    rows = [(c, k) for c, active in enumerate(state) if active for k in w.kind.contacts[c].components]
    J_all = [FrameJacobian(w.robot, contact.frame)(q).numpy() for contact in w.kind.contacts]
    J = np.stack([J_all[c][:, k] for c, k in rows], axis=1)
    force = 50.0 * rng.normal(size=(len(J), len(rows)))
    left = needed[:, :6] - np.einsum("bkv,bk->bv", J[:, :, :6], force)
    force += (np.linalg.pinv(J[:, :, :6].transpose(0, 2, 1)) @ left[..., None])[..., 0]
    torque = needed - np.einsum("bkv,bk->bv", J, force)
    np.testing.assert_allclose(torque[:, :6], 0.0, atol=1e-7)
    wrench = np.zeros((len(J), len(w.kind.contacts), 6))
    for (c, k), column in zip(rows, force.T, strict=True):
        wrench[:, c, k] = column
    return torch.from_numpy(torque[:, 6:].copy()), torch.from_numpy(wrench)


cases = pytest.mark.parametrize(
    ("name", "per"),
    [
        ("Talos", "device"),
        *(pytest.param(name, "device", marks=pytest.mark.study) for name in ("G1", "ANYmal")),
        ("ANYmal", "axis"),
        *(pytest.param(name, "axis", marks=pytest.mark.study) for name in ("G1", "Talos")),
    ],
)


def error(w: World, phi: Array) -> float:
    """Largest error of forces without friction; mimic fingers that turn against each other never reach the base."""
    seen = np.array([True] * 6 + [joint not in driving(w.robot) for joint in w.robot.joint_names])
    motion = unseen(next(name for name, kind in KINDS.items() if kind is w.kind))
    return worst(
        predicted(w.robot, frictionless(phi), *motion)[:, seen], w.oracle.frictionless_forces(*motion)[:, seen]
    )


@cases
def test_any_minimal_set_recovers_motion_that_no_fit_has_seen(name: str, per: str) -> None:
    w = world(name)
    for chosen in sets(name, per):
        phi = fit(w, sensor_set(w.robot, w.kind.contacts, chosen)).phi
        assert error(w, phi) < EXACT


@cases
def test_one_sensor_less_loses_the_base_in_some_state_but_not_what_the_stack_of_all_samples_shows(
    name: str, per: str
) -> None:
    """The criterion of each sample is sufficient; for a robot that moves and steps it is not necessary."""
    found = plan(name, per)
    assert all(removal.base_rank is not None and removal.base_rank < 6 for removal in found.removals)
    assert {removal.stack_rank for removal in found.removals} == {found.stack_rank}
    if not driving(world(name).robot):
        assert found.stack_rank == found.stack_full == 10 + 7 * world(name).robot.n


@pytest.mark.parametrize("name", study_but(["ANYmal"], ["ANYmal", "G1"]))
def test_fewer_sensors_than_every_sample_needs_recover_unseen_motion_too(name: str) -> None:
    """A handful of channels, with which no sample of double support sees the base, where the criterion asks for 12."""
    w = world(name)
    offered = candidates(w.robot, w.kind.contacts, per="axis")
    stack = MotionStack(w.robot, w.kind.contacts, steps(w.kind), offered)
    chosen = irredundant_set(stack)
    assert len(chosen) <= 4
    assert stack.rank(chosen) == stack.full == 10 + 7 * w.robot.n
    for spared in chosen:
        assert stack.rank([c for c in chosen if c is not spared]) < stack.full
    sensors = sensor_set(w.robot, w.kind.contacts, chosen)
    checks = assess_sensors(w.robot, w.kind.contacts, steps(w.kind)[:1], sensors, offered, samples=8)
    assert checks[0].generic.rank < 6
    phi = fit(w, sensors, stepping_logs(name)).phi
    assert error(w, phi) < EXACT
