"""Base parameters: how many there are, what is regrouped into them, and that nothing is lost by it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import ANYMAL, DRONE, G1, ROBOTS, SOLO12, TALOS, TIAGO, UR5, Array, Oracle, load, random_states
from urdfs import BASE, inertial, joint, link, write

from torchid import parameters
from torchid.errors import NumericalWarning
from torchid.estimators import LeastSquares
from torchid.identifiability.base_parameters import (
    BaseParameters,
    base_parameters,
    format_base_parameters,
    rank_and_gap,
    structural_problem,
    structural_rank,
    unobservable_parameters,
)
from torchid.parallel import one_thread
from torchid.problem import LinearProblem
from torchid.regressor import Regressor
from torchid.robot import Robot
from torchid.sensing import named_sensors

# None has mimic joints: a joint that drags others along shows some of their parameters in one sum only.
MACHINES = {
    "quadrotor": DRONE,
    "Bolt": ROBOTS / "bolt_description/robots/bolt.urdf",
    "UR5": UR5,
    "xArm7": ROBOTS / "xarm_description/urdf/xarm7.urdf",
    "Solo12": SOLO12,
    "ANYmal": ANYMAL,
    "HyQ": ROBOTS / "hyq_description/robots/hyq_no_sensors.urdf",
    "B1 with an arm": ROBOTS / "b1_description/urdf/b1-z1.urdf",
    "TIAGo": TIAGO,
    "Talos": TALOS,
    "Romeo": ROBOTS / "romeo_description/urdf/romeo_small.urdf",
    "G1": G1,
    "iCub": ROBOTS / "icub_description/robots/icub.urdf",
    "human": ROBOTS / "human_description/robots/human.urdf",
    "Centauro": ROBOTS / "centauro_description/urdf/centauro.urdf",
}
CLEAR = 1e12  # 5e13 measured at worst, with the base rows of the human
machines = pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in ("UR5", "Solo12", "human") else pytest.mark.every_robot)
        for name in MACHINES
    ],
)


@cache
def machine_named(name: str) -> Robot:
    return load(MACHINES[name])


def textbook_count(robot: Robot) -> int:
    """Ten for the floating base, seven per hinge, four per slide."""
    slides = int(robot.geometry.prismatic[1:].sum())
    return 10 + 7 * (robot.n - slides) + 4 * slides


def regressor(robot: Robot, samples: int, seed: int = 1) -> Array:
    """Of unrelated random states, (B, nv, 12 L)."""
    states = random_states(np.random.default_rng(seed), robot.n, samples, robot.fixed_base)
    return Regressor(robot)(*map(torch.from_numpy, states)).contiguous().numpy()


@one_thread()
def column_rank(rows: Array) -> tuple[int, float]:
    """Of (M, columns), each column scaled to norm 1."""
    triangle = np.linalg.qr(rows, mode="r")
    return rank_and_gap(np.linalg.svd(triangle / np.linalg.norm(triangle, axis=0), compute_uv=False))


def flying(robot: Robot, friction: bool = True) -> LinearProblem:
    """All that free motion with every sensor shows."""
    return structural_problem(robot, [], named_sensors("full", robot.n, 0), [()], friction)


@pytest.mark.parametrize("name", ["UR5", "TIAGo", "Solo12", "Talos"])
def test_pinocchio_counts_the_same(name: str) -> None:
    robot = machine_named(name)
    oracle = Oracle.of(robot)
    states = random_states(np.random.default_rng(2), robot.n, 3 * len(robot.bodies) + 20)
    K = oracle.regressor(robot, *states)
    for rows in (K, K[:, :6]):
        rank, gap = column_rank(rows.reshape(-1, 10 * len(robot.bodies)))
        assert rank == textbook_count(robot)
        assert gap > CLEAR


@machines
def test_the_structural_problem_of_a_flying_robot_counts_the_same_and_two_of_friction_per_joint(name: str) -> None:
    robot = machine_named(name)
    problem = flying(robot)
    inertial = np.arange(len(problem.free)) % parameters.PER_BODY < parameters.INERTIAL.stop
    rank, gap = structural_rank(replace(problem, free=problem.free & inertial))
    if robot.massless:  # 19 bodies of the human have no inertia and stay out
        assert 0 < rank < textbook_count(robot)
    else:
        assert rank == textbook_count(robot)
    assert gap > CLEAR
    assert structural_rank(problem).rank == rank + 2 * robot.n


# ------------------------------------------------------------------------------------------------------ regrouping


@st.composite
def machine(draw: st.DrawFn) -> Robot:
    """A tree of up to five bodies with skew axes and offsets."""
    number = st.floats(-1.0, 1.0).map(lambda x: round(x, 2))
    size, elements = draw(st.integers(1, 4)), [BASE]
    for body in range(1, size + 1):
        x, y, z = draw(st.tuples(number, number, number))
        axis = draw(st.sampled_from(["1 0 0", "0 1 0", "0 0 -1", "1 2 3", "-0.3 0.5 0.2"]))
        origin = f'<origin xyz="{x} {y} {z}" rpy="{y} {z} {x}"/><axis xyz="{axis}"/>'
        parent = draw(st.integers(0, body - 1))
        kind = draw(st.sampled_from(["revolute", "prismatic", "continuous"]))
        mass = inertial(str(draw(st.sampled_from([0.05, 1.0, 8.0]))), f'<origin xyz="{z} {x} {y}"/>')
        elements += [link(f"body{body}", mass), joint(f"joint{body}", f"body{parent}" if parent else "base",
                                                     f"body{body}", kind, origin)]  # fmt: skip
    with TemporaryDirectory() as folder:
        return load(write(Path(folder), *elements), fixed_base=draw(st.booleans()))


@settings(max_examples=25, deadline=None, derandomize=True)
@given(machine(), st.booleans(), st.integers(0, 10_000))
def test_base_parameters_cause_all_forces_and_hidden_directions_none(robot: Robot, friction: bool, seed: int) -> None:
    base = base_parameters(flying(robot, friction))
    K, rng = regressor(robot, 30, seed), np.random.default_rng(seed)
    size = np.abs(K * base.scale).max()
    phi = base.scale * rng.normal(size=(7, len(base.scale)))
    constant = np.where(base.free, 0.0, phi)
    forces = K @ phi.T
    K_B = base(torch.from_numpy(K)).numpy()
    assert K_B.shape == (*K.shape[:2], base.rank)
    np.testing.assert_allclose(K_B @ base.reduce(phi).T + K @ constant.T, forces, rtol=0, atol=1e-10 * size)
    np.testing.assert_allclose(K @ base.null_space.T, 0.0, atol=1e-12 * size)
    directions = base.null_space / base.scale
    np.testing.assert_allclose(directions @ directions.T, np.eye(len(directions)), rtol=0.0, atol=1e-12)
    assert len(directions) + base.rank == base.free.sum()
    if not robot.fixed_base:
        assert base.rank == textbook_count(robot) + (2 * robot.n if friction else 0)
    assert base.gap > CLEAR


@cache
def arm() -> tuple[Robot, LinearProblem, BaseParameters]:
    """A flying Solo12."""
    robot = load(SOLO12)
    problem = flying(robot)
    return robot, problem, base_parameters(problem)


@pytest.mark.parametrize("frozen", ["nothing", "friction", "a body", "odd ones"])
def test_least_squares_finds_the_same_forces_in_base_parameters(frozen: str) -> None:
    _, problem, _ = arm()
    rng, free = np.random.default_rng(6), problem.free.copy().reshape(-1, parameters.PER_BODY)
    if frozen == "friction":
        free[:, parameters.FRICTION] = False
    if frozen == "a body":
        free[3] = False
    if frozen == "odd ones":
        free &= rng.random(free.shape) > 0.3
    nominal = problem.nominal + problem.scale * rng.normal(size=problem.scale.shape)  # friction too
    b = problem.A @ (nominal + problem.scale * rng.normal(size=nominal.shape)) + rng.normal(size=problem.b.shape)
    problem = replace(problem, free=free.flatten(), nominal=nominal, b=b, oversampling=1.7)
    base = base_parameters(problem)
    whole, reduced = LeastSquares().solve(problem), LeastSquares().solve(base.reduce_problem(problem))
    constant = np.where(problem.free, 0.0, nominal)
    forces = problem.A @ whole.phi
    found = problem.A[:, base.kept] @ reduced.phi + problem.A @ constant
    np.testing.assert_allclose(found, forces, rtol=0, atol=1e-9 * np.abs(forces).max())
    assert reduced.rank == whole.rank == base.rank == len(base.kept)
    assert reduced.identifiable.all()
    assert reduced.oversampling == whole.oversampling
    assert reduced.residual_std == pytest.approx(whole.residual_std, rel=1e-9)
    assert reduced.cost == pytest.approx(whole.cost, rel=1e-9)
    lifted = base.lift(reduced.phi, nominal)
    np.testing.assert_allclose((lifted - whole.phi) / problem.scale, 0.0, atol=1e-6)  # both are the nearest


# ----------------------------------------------------------------------------------------------------------- words


def hinge(folder: Path) -> Robot:
    """A base and a body whose hinge along z stands 0.5 m ahead of the base."""
    elements = [BASE, link("arm"), joint("elbow", "base", "arm", extra='<origin xyz="0.5 0 0"/><axis xyz="0 0 1"/>')]
    return load(write(folder, *elements))


def test_a_hinge_hides_mass_first_moment_along_it_and_one_inertia_as_textbooks_say(tmp_path: Path) -> None:
    robot = hinge(tmp_path)
    base = base_parameters(flying(robot))
    assert format_base_parameters(base, robot.body_names) == [
        "m[base] + m[arm]",
        "mcx[base] + 0.5 m[arm]",
        "mcy[base]",
        "mcz[base] + mcz[arm]",
        "Ixx[base] + Ixx[arm]",
        "Ixy[base]",
        "Ixz[base] - 0.5 mcz[arm]",
        "Iyy[base] + 0.25 m[arm] + Ixx[arm]",
        "Iyz[base]",
        "Izz[base] + 0.25 m[arm]",
        "mcx[arm]",
        "mcy[arm]",
        "Ixy[arm]",
        "Ixz[arm]",
        "Iyy[arm] - Ixx[arm]",
        "Iyz[arm]",
        "Izz[arm]",
        "fc[arm]",
        "fv[arm]",
    ]
    assert unobservable_parameters(base, robot.body_names) == []  # the base's friction is no parameter of the fit


# ------------------------------------------------------------------------------------------------------- how clear


def test_values_that_fall_without_a_step_are_told() -> None:
    with pytest.warns(NumericalWarning, match="rank 5 is not clear: the next singular value is only 100 times smaller"):
        assert rank_and_gap(np.geomspace(1.0, 1e-20, 11), tolerance=1e-9) == (5, pytest.approx(100.0))


def test_of_a_bolted_hinge_across_gravity_four_numbers_are_seen(tmp_path: Path) -> None:
    elements = [BASE, link("arm"), joint("elbow", "base", "arm", extra='<axis xyz="0 1 0"/>')]
    robot = load(write(tmp_path, *elements), fixed_base=True)
    base = base_parameters(flying(robot))
    assert format_base_parameters(base, robot.body_names) == ["mcx[arm]", "mcz[arm]", "Iyy[arm]", "fc[arm]", "fv[arm]"]
    assert unobservable_parameters(base, robot.body_names) == [
        "base: m, mcx, mcy, mcz, Ixx, Ixy, Ixz, Iyy, Iyz, Izz",
        "arm: m, mcy, Ixx, Ixy, Ixz, Iyz, Izz",
    ]
