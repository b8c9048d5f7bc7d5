"""The regressor and the Jacobians against Pinocchio and MuJoCo; friction."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import torch
from mujoco_oracle import joint_addresses, mujoco_forces, mujoco_model
from regressors import assert_close, base_kinds, of_every_robot, of_robots, regressor, without_shapes
from synthetic import (
    ANYMAL,
    BAXTER,
    DRONE,
    G1,
    PANDA,
    ROBOTS,
    ROMEO,
    SOLO12,
    TALOS,
    TALOS_FULL,
    TIAGO,
    TIAGO_PRO,
    UR5,
    Oracle,
    load,
    random_states,
)

from torchid import parameters
from torchid.regressor import FrameJacobian, Motion
from torchid.regressor.kinematics import joint_motion
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot

pytestmark = pytest.mark.usefixtures("both_ways")
REFUSED = ("ur3.urdf", "alex_psyonic_hands.urdf")
REAL = [path for path in sorted(ROBOTS.rglob("*.urdf")) if path.name not in REFUSED]


XARM = ROBOTS / "xarm_description/urdf/xarm7.urdf"


# ------------------------------------------------------------------------------------------------------- Pinocchio


@base_kinds
@of_every_robot([SOLO12, G1, PANDA], REAL)
def test_every_inertial_column_and_nominal_forces_are_pinocchios(urdf: Path, fixed_base: bool) -> None:
    robot = load(urdf, fixed_base=fixed_base)
    state = random_states(np.random.default_rng(0), robot.n, 3, fixed_base)
    oracle, columns = Oracle.of(robot), regressor(robot, *state)[..., parameters.INERTIAL]
    assert_close(columns, oracle.regressor(robot, *state))
    forces = np.einsum("bilk,lk->bi", columns, robot.nominal[:, parameters.INERTIAL])
    assert_close(forces, oracle.frictionless_forces(*state))


@base_kinds
@of_robots(PANDA, BAXTER, TIAGO_PRO)
def test_forces_of_a_robot_with_mimic_joints_are_those_of_pinocchios_own_mimic_joints(
    urdf: Path, fixed_base: bool
) -> None:
    robot = load(urdf, fixed_base=fixed_base)
    root = () if fixed_base else (pin.JointModelFreeFlyer(),)
    model = pin.buildModelFromUrdf(str(urdf), *root, mimic=True)
    data = model.createData()
    q, v, a = random_states(np.random.default_rng(2), robot.n, 4, fixed_base)
    places = [model.joints[model.getJointId(name)] for name in robot.joint_names]
    assert model.nv == robot.nv
    full, expected = pin.neutral(model), []
    rows = [*range(robot.base_rows), *(joint.idx_v for joint in places)]
    extra = 0 if fixed_base else 7
    for sample in range(4):
        full[:extra] = q[sample, :extra]
        for joint, value in zip(places, q[sample, extra:], strict=True):
            full[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else (np.cos(value), np.sin(value))
        velocity, acceleration = np.zeros(model.nv), np.zeros(model.nv)
        velocity[rows], acceleration[rows] = v[sample], a[sample]
        expected.append(pin.rnea(model, data, full, velocity, acceleration)[rows])
    found = np.einsum("bilk,lk->bi", regressor(robot, q, v, a)[..., :10], robot.nominal[:, :10])
    assert_close(found, np.array(expected))


@base_kinds
@of_robots(ANYMAL, BAXTER, DRONE, G1, PANDA, ROMEO, SOLO12, TALOS, TIAGO, TIAGO_PRO, UR5)
def test_frame_jacobians_are_pinocchios(urdf: Path, fixed_base: bool) -> None:
    robot = load(urdf, fixed_base=fixed_base)
    oracle = Oracle.of(robot)
    q, _, _ = random_states(np.random.default_rng(3), robot.n, 3, fixed_base)
    frames = list(robot.links)
    for frame in {frames[0], frames[-1], *frames[:: 1 + len(frames) // 8]}:
        J = FrameJacobian(robot, frame)(torch.from_numpy(q)).numpy()
        assert J.shape == (3, 6, robot.nv)
        np.testing.assert_allclose(J, oracle.jacobian(q, frame), rtol=0.0, atol=1e-14, err_msg=frame)


# ---------------------------------------------------------------------------------------------------------- MuJoCo


@pytest.mark.parametrize(
    ("urdf", "fixed_base"),
    [(G1, False), (PANDA, False), (PANDA, True), (XARM, True)],
    ids=["humanoid", "floating arm with slides", "arm with slides", "arm"],
)
def test_forces_are_mujocos(urdf: Path, fixed_base: bool, tmp_path: Path) -> None:
    path = without_shapes(urdf, tmp_path)
    robot = load(path, fixed_base=fixed_base)
    model = mujoco_model(path, robot)
    rng = np.random.default_rng(5)
    state = random_states(rng, robot.n, 5, fixed_base)
    phi = robot.nominal.copy()
    phi[:, parameters.COULOMB] = 0.0
    phi[1:, parameters.VISCOUS] = rng.uniform(0.5, 2.0, robot.n)
    model.dof_armature[:], model.dof_frictionloss[:], model.dof_damping[:] = 0.0, 0.0, 0.0
    model.dof_damping[joint_addresses(model, robot)[1]] = phi[1:, parameters.VISCOUS]
    found = np.einsum("bilk,lk->bi", regressor(robot, *state), phi)
    assert_close(
        found, mujoco_forces(model, robot, *state), 1e-12
    )  # MuJoCo turns every inertia into its principal axes


# -------------------------------------------------------------------------------------------------------- friction


def test_friction_takes_torque_in_the_direction_of_motion(small: Robot) -> None:
    q, v, a = random_states(np.random.default_rng(6), small.n, 8)
    K = regressor(small, q, v, a)
    hinge, branch = small.joint_names.index("hinge"), small.joint_names.index("branch")
    for name, joint in (("a", hinge), ("d", branch)):
        body, velocity = small.body_names.index(name), v[:, 6 + joint]
        np.testing.assert_array_equal(K[:, 6 + joint, body, parameters.COULOMB], np.where(velocity > 0.0, 1.0, -1.0))
        np.testing.assert_array_equal(K[:, 6 + joint, body, parameters.VISCOUS], velocity)


def test_a_direction_takes_the_place_of_the_sign_of_velocities() -> None:
    tree = KinematicTree(load(TALOS_FULL))  # whose mimic fingers turn both ways
    zero, v = torch.zeros(50, 3), torch.randn(50, tree.n, generator=torch.Generator().manual_seed(0))
    plain = Motion(*(x.double() for x in (v, v, v, zero, zero, zero)))
    expected = joint_motion(tree, plain).direction
    assert torch.equal(joint_motion(tree, replace(plain, joint_direction=torch.sign(v.double()))).direction, expected)
    assert (expected[1:] < 0).any(1).all()
    halved = joint_motion(tree, replace(plain, joint_direction=0.5 * torch.sign(v.double())))
    assert torch.equal(halved.direction, 0.5 * expected)
    assert torch.equal(halved.velocity, joint_motion(tree, plain).velocity)
    part = replace(plain, joint_direction=torch.sign(v.double()))[3:7]
    assert part.joint_direction is not None
    assert part.joint_direction.shape == (4, tree.n)


def test_friction_of_a_mimic_joint_reaches_its_master_through_the_ratio(small: Robot) -> None:
    q, v, a = random_states(np.random.default_rng(7), small.n, 8)
    K = regressor(small, q, v, a)
    slide, body = small.joint_names.index("slide"), small.body_names.index("c")
    speed = np.abs(v[:, 6 + slide])
    power = v[:, 6 + slide, None] * K[:, 6 + slide, body, parameters.FRICTION]
    np.testing.assert_allclose(power[:, 0], 1.5 * speed, rtol=1e-15)  # the follower runs at -1.5 times the speed
    np.testing.assert_allclose(power[:, 1], 1.5**2 * speed**2, rtol=1e-15)
