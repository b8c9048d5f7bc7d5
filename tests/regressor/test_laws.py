"""The regressor and the laws of mechanics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import given
from regressors import assert_close, few, of_robots, regressor, seeds, tensors
from scipy.spatial.transform import Rotation
from synthetic import PANDA, SOLO12, UR5, Oracle, load, random_states

from torchid import parameters
from torchid.regressor import Regressor
from torchid.robot import Robot


@few
@given(seed=seeds)
@of_robots(SOLO12, PANDA)
def test_the_forces_power_is_the_rate_of_change_of_energy(urdf: Path, seed: int) -> None:
    robot, rng = load(urdf), np.random.default_rng(seed)
    oracle = Oracle.of(robot)
    oracle.perturb(rng, 0.5)
    state = random_states(rng, robot.n, 2)
    K = regressor(robot, *state)[..., parameters.INERTIAL]
    power = np.einsum("bi,bilk,lk->b", state[1], K, oracle.inertial_parameters(robot))
    size = np.einsum("bi,bilk,lk->b", np.abs(state[1]), np.abs(K), np.abs(oracle.inertial_parameters(robot)))
    expected = oracle.power(*state)
    np.testing.assert_array_less(np.abs(power - expected), 1e-9 * size)  # energies are differenced over 1e-4 s


@few
@given(seed=seeds)
def test_neither_place_nor_heading_matters(small: Robot, seed: int) -> None:
    rng = np.random.default_rng(seed)
    q, v, a = random_states(rng, small.n, 3)
    K = regressor(small, q, v, a)
    elsewhere = q.copy()
    elsewhere[:, :3] += rng.normal(size=3)
    np.testing.assert_array_equal(regressor(small, elsewhere, v, a), K)
    heading = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi))
    elsewhere[:, 3:7] = (heading * Rotation.from_quat(q[:, 3:7])).as_quat()
    assert_close(regressor(small, elsewhere, v, a), K)


def test_a_tilted_bolted_base_feels_gravity_along_its_own_axes() -> None:
    floating, bolted = load(UR5), load(UR5, fixed_base=True)
    q, v, a = random_states(np.random.default_rng(12), bolted.n, 4, fixed_base=True)
    tilt = Rotation.from_rotvec([0.4, -0.7, 0.2])
    resting = np.zeros((4, 6))
    standing = np.hstack([np.zeros((4, 3)), np.tile(tilt.as_quat(), (4, 1)), q])
    K = Regressor(floating)(*tensors(standing, np.hstack([resting, v]), np.hstack([resting, a])))
    g_base = tuple(tilt.inv().apply([0.0, 0.0, -9.81]).tolist())
    assert_close(Regressor(bolted, g_base)(*tensors(q, v, a)).numpy(), K[:, 6:].numpy())
