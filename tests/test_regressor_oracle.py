"""The regressor and the Jacobians against Pinocchio, MuJoCo and the laws of mechanics."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from synthetic import (
    ANYMAL,
    BAXTER,
    DRONE,
    G1,
    PANDA,
    ROBOTS,
    SOLO12,
    TALOS,
    TIAGO,
    UR5,
    Array,
    Oracle,
    load,
    random_states,
)
from torch import Tensor

from torchid import parameters
from torchid.errors import UnknownNameError
from torchid.regressor import FrameJacobian, Regressor, motion_from_state
from torchid.regressor.dynamics import all_wrench_columns, joint_directions, joint_row, joint_rows
from torchid.regressor.kinematics import body_states, joint_states
from torchid.regressor.reduction import reduced_layout, reduction_matrix
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot

REFUSED = ("ur3.urdf", "alex_psyonic_hands.urdf")
REAL = [path for path in sorted(ROBOTS.rglob("*.urdf")) if path.name not in REFUSED]
ROMEO = ROBOTS / "romeo_description/urdf/romeo.urdf"
TIAGO_PRO = ROBOTS / "tiago_pro_description/robots/tiago_pro.urdf"
XARM = ROBOTS / "xarm_description/urdf/xarm7.urdf"

base_kinds = pytest.mark.parametrize("fixed_base", [False, True], ids=["floating", "bolted"])
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=15, deadline=None, derandomize=True)


def of_robots(*urdfs: Path) -> pytest.MarkDecorator:
    """A test per robot."""
    return pytest.mark.parametrize("urdf", urdfs, ids=lambda path: path.stem)


def tensors(*arrays: Array) -> tuple[Tensor, ...]:
    """Arrays as tensors."""
    return tuple(map(torch.from_numpy, arrays))


def regressor(robot: Robot, *state: Array) -> Array:
    """K, (B, nv, L, 12)."""
    K = Regressor(robot)(*tensors(*state)).numpy()
    return K.reshape(len(state[0]), robot.nv, len(robot.bodies), parameters.PER_BODY)


def assert_close(found: Array, expected: Array, relative: float = 1e-14) -> None:
    """Equal to a share of the largest number."""
    size = np.abs(expected).max(initial=0.0)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=relative * size)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    """A floating base with a hinge, a slide, a hinge that mimics the slide, and a branch; no axis along x, y or z."""
    inertia = '<inertia ixx="0.3" ixy="0.01" ixz="-0.02" iyy="0.4" iyz="0.03" izz="0.5"/>'
    inertial = f'<inertial><origin xyz="0.1 -0.2 0.3" rpy="0.4 0.5 -0.6"/><mass value="2"/>{inertia}</inertial>'
    origin = '<origin xyz="0.3 0.1 -0.2" rpy="0.3 -0.2 0.1"/>'
    elements = [f'<link name="{name}">{inertial}</link>' for name in ("base", "a", "b", "c", "d")]
    mimic = '<mimic joint="slide" multiplier="-1.5" offset="0.2"/>'
    for name, kind, parent, child, axis, extra in (
        ("hinge", "revolute", "base", "a", "1 2 3", ""),
        ("slide", "prismatic", "a", "b", "-1 1 0.5", ""),
        ("follower", "revolute", "b", "c", "0 1 -1", mimic),
        ("branch", "continuous", "a", "d", "0 -1 0", ""),
    ):
        ends = f'<parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
        elements.append(f'<joint name="{name}" type="{kind}">{origin}{ends}{extra}</joint>')
    path = tmp_path_factory.mktemp("small") / "small.urdf"
    path.write_text(f'<robot name="small">{"".join(elements)}</robot>')
    return load(path)


# ------------------------------------------------------------------------------------------------------- Pinocchio


@base_kinds
@of_robots(*REAL)
def test_every_inertial_column_is_pinocchios(urdf: Path, fixed_base: bool) -> None:
    robot = load(urdf, fixed_base=fixed_base)
    state = random_states(np.random.default_rng(0), robot.n, 3, fixed_base)
    expected = Oracle.of(robot).regressor(robot, *state)
    assert_close(regressor(robot, *state)[..., parameters.INERTIAL], expected)


@base_kinds
@of_robots(*REAL)
def test_nominal_forces_are_pinocchios(urdf: Path, fixed_base: bool) -> None:
    robot = load(urdf, fixed_base=fixed_base)
    state = random_states(np.random.default_rng(1), robot.n, 3, fixed_base)
    found = np.einsum("bilk,lk->bi", regressor(robot, *state)[..., :10], robot.nominal[:, :10])
    assert_close(found, Oracle.of(robot).frictionless_forces(*state))


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


def test_the_derivative_of_force_by_acceleration_is_pinocchios_mass_matrix() -> None:
    robot = load(SOLO12)
    q, v, a = random_states(np.random.default_rng(4), robot.n, 1)
    phi = torch.from_numpy(robot.nominal).flatten()

    def force(acceleration: Tensor) -> Tensor:
        return (Regressor(robot)(*tensors(q, v), acceleration) @ phi)[0]

    (found,) = torch.autograd.functional.jacobian(force, (torch.from_numpy(a),))
    oracle = Oracle.of(robot)
    M = oracle.expand.T @ pin.crba(oracle.model, oracle.data, oracle.coordinates(q[0])) @ oracle.expand
    assert_close(found[:, 0].numpy(), M)


# ---------------------------------------------------------------------------------------------------------- MuJoCo


def without_shapes(urdf: Path, folder: Path) -> Path:
    """The URDF without meshes and mimic tags (MuJoCo makes soft constraints of these)."""
    tree = ElementTree.parse(urdf)
    for link in tree.findall("link"):
        for element in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(element)
    for joint in tree.findall("joint"):
        for element in joint.findall("mimic"):
            joint.remove(element)
    for tag in ("transmission", "gazebo", "material", "mujoco"):
        for element in tree.getroot().findall(tag):
            tree.getroot().remove(element)
    tree.write(folder / urdf.name)
    return folder / urdf.name


def mujoco_model(urdf: Path, base_link: str, fixed_base: bool) -> mujoco.MjModel:
    """The URDF as MuJoCo reads it, in free flight unless its base is fixed; viscous friction only."""
    root = ElementTree.parse(urdf).getroot()
    if not fixed_base:
        ElementTree.SubElement(root, "link", name="the ground")
        flight = ElementTree.SubElement(root, "joint", name="free flight", type="floating")
        ElementTree.SubElement(flight, "parent", link="the ground")
        ElementTree.SubElement(flight, "child", link=base_link)
    model = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode")).compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.dof_armature[:], model.dof_frictionloss[:], model.dof_damping[:] = 0.0, 0.0, 0.0
    return model


@pytest.mark.parametrize(
    ("urdf", "fixed_base"),
    [(G1, False), (PANDA, False), (PANDA, True), (XARM, True)],
    ids=["humanoid", "floating arm with slides", "arm with slides", "arm"],
)
def test_forces_are_mujocos(urdf: Path, fixed_base: bool, tmp_path: Path) -> None:
    path = without_shapes(urdf, tmp_path)
    robot = load(path, fixed_base=fixed_base)
    model = mujoco_model(path, robot.base_link, fixed_base)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(5)
    q, v, a = random_states(rng, robot.n, 5, fixed_base)
    phi = robot.nominal.copy()
    phi[:, parameters.COULOMB] = 0.0
    phi[1:, parameters.VISCOUS] = rng.uniform(0.5, 2.0, robot.n)
    ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in robot.joint_names]
    joint_q, joint_v = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
    model.dof_damping[joint_v] = phi[1:, parameters.VISCOUS]
    extra, base, expected = 0 if fixed_base else 7, robot.base_rows, []
    for sample in range(5):
        data.qpos[joint_q] = q[sample, extra:]
        data.qvel[joint_v], data.qacc[joint_v] = v[sample, base:], a[sample, base:]
        R = np.eye(3)
        if not fixed_base:  # MuJoCo: linear parts along world axes, angular along the body's, quaternion w x y z
            R = Rotation.from_quat(q[sample, 3:7]).as_matrix()
            linear, angular = v[sample, :3], v[sample, 3:6]
            data.qpos[:7] = [*q[sample, :3], q[sample, 6], *q[sample, 3:6]]
            data.qvel[:6] = [*(R @ linear), *angular]
            data.qacc[:6] = [*(R @ (a[sample, :3] + np.cross(angular, linear))), *a[sample, 3:6]]
        mujoco.mj_inverse(model, data)
        force = data.qfrc_inverse
        expected.append([*(R.T @ force[:3]), *force[3:6], *force[joint_v]][6 - base :])
    found = np.einsum("bilk,lk->bi", regressor(robot, q, v, a), phi)
    assert_close(found, np.array(expected), 1e-12)  # MuJoCo turns every inertia into its principal axes


# -------------------------------------------------------------------------------------------------------- friction


def test_friction_takes_torque_in_the_direction_of_motion(small: Robot) -> None:
    q, v, a = random_states(np.random.default_rng(6), small.n, 8)
    K = regressor(small, q, v, a)
    hinge, branch = small.joint_names.index("hinge"), small.joint_names.index("branch")
    for name, joint in (("a", hinge), ("d", branch)):
        body, velocity = small.body_names.index(name), v[:, 6 + joint]
        np.testing.assert_array_equal(K[:, 6 + joint, body, parameters.COULOMB], np.where(velocity > 0.0, 1.0, -1.0))
        np.testing.assert_array_equal(K[:, 6 + joint, body, parameters.VISCOUS], velocity)


def test_friction_of_a_mimic_joint_reaches_its_master_through_the_ratio(small: Robot) -> None:
    q, v, a = random_states(np.random.default_rng(7), small.n, 8)
    K = regressor(small, q, v, a)
    slide, body = small.joint_names.index("slide"), small.body_names.index("c")
    speed = np.abs(v[:, 6 + slide])
    power = v[:, 6 + slide, None] * K[:, 6 + slide, body, parameters.FRICTION]
    np.testing.assert_allclose(power[:, 0], 1.5 * speed, rtol=1e-15)  # the follower runs at -1.5 times the speed
    np.testing.assert_allclose(power[:, 1], 1.5**2 * speed**2, rtol=1e-15)


@base_kinds
@of_robots(ROMEO, BAXTER, SOLO12)
def test_friction_acts_on_its_own_joint_alone_and_never_on_the_base(urdf: Path, fixed_base: bool) -> None:
    robot = load(urdf, fixed_base=fixed_base)
    state = random_states(np.random.default_rng(8), robot.n, 4, fixed_base)
    K = regressor(robot, *state)[..., parameters.FRICTION]
    joints = [body.joint for body in robot.bodies]
    masters = [joint and (joint.mimic.master if joint.mimic else joint.name) for joint in joints]
    expected = np.zeros(K.shape, dtype=bool)
    for body, master in enumerate(masters[1:], start=1):
        expected[:, robot.base_rows + robot.joint_names.index(str(master)), body] = True
    np.testing.assert_array_equal(K != 0.0, expected)


def test_a_joint_at_rest_has_no_friction(small: Robot) -> None:
    q, v, a = random_states(np.random.default_rng(9), small.n, 2)
    assert not regressor(small, q, 0.0 * v, a)[..., parameters.FRICTION].any()


# ----------------------------------------------------------------------------------------------- laws of mechanics


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
@of_robots(SOLO12, PANDA)
def test_two_robots_in_one_need_the_sum_of_their_forces(urdf: Path, seed: int) -> None:
    robot, rng = load(urdf), np.random.default_rng(seed)
    one, other = Oracle.of(robot), Oracle.of(robot)
    one.perturb(rng, 0.5)
    other.perturb(rng, 0.5)
    state = random_states(rng, robot.n, 2)
    both = one.inertial_parameters(robot) + other.inertial_parameters(robot)
    found = np.einsum("bilk,lk->bi", regressor(robot, *state)[..., parameters.INERTIAL], both)
    assert_close(found, one.frictionless_forces(*state) + other.frictionless_forces(*state))


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


@few
@given(seed=seeds)
def test_a_robot_on_a_train_needs_the_same_forces(small: Robot, seed: int) -> None:
    rng = np.random.default_rng(seed)
    q, v, a = random_states(rng, small.n, 3)
    train_base = Rotation.from_quat(q[:, 3:7]).inv().apply(10.0 * rng.normal(size=3))
    boosted, changed = v.copy(), a.copy()
    boosted[:, :3] += train_base
    changed[:, :3] -= np.cross(v[:, 3:6], train_base)  # seen from the turning base, the train's velocity turns back
    assert_close(regressor(small, q, boosted, changed), regressor(small, q, v, a), 1e-13)  # the train is fast


@few
@given(seed=seeds)
def test_played_backwards_a_motion_needs_the_same_forces_but_for_friction(small: Robot, seed: int) -> None:
    q, v, a = random_states(np.random.default_rng(seed), small.n, 3)
    forth, back = regressor(small, q, v, a), regressor(small, q, -v, a)
    np.testing.assert_array_equal(back[..., parameters.INERTIAL], forth[..., parameters.INERTIAL])
    np.testing.assert_array_equal(back[..., parameters.FRICTION], -forth[..., parameters.FRICTION])


@few
@given(seed=seeds)
def test_falling_freely_and_floating_without_gravity_are_the_same(small: Robot, seed: int) -> None:
    q, v, a = random_states(np.random.default_rng(seed), small.n, 3)
    falling = a.copy()
    falling[:, :3] += Rotation.from_quat(q[:, 3:7]).inv().apply([0.0, 0.0, -9.81])
    weightless = Regressor(small, gravity=(0.0, 0.0, 0.0))(*tensors(q, v, a)).numpy()
    assert_close(regressor(small, q, v, falling).reshape(weightless.shape), weightless)


def test_a_resting_robot_feels_its_weight_only(small: Robot) -> None:
    q, v, _ = random_states(np.random.default_rng(10), small.n, 3)
    f = np.einsum("bilk,lk->bi", regressor(small, q, 0.0 * v, 0.0 * v), small.nominal)
    up = Rotation.from_quat(q[:, 3:7]).inv().apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(f[:, :3], 9.81 * 10.0 * up, rtol=1e-14)  # five bodies of 2 kg
    weightless = Regressor(small, gravity=(0.0, 0.0, 0.0))(*tensors(q, 0.0 * v, 0.0 * v))
    assert not weightless.any()


@of_robots(PANDA, UR5)
def test_a_bolted_base_is_a_floating_one_that_does_not_move(urdf: Path) -> None:
    floating, bolted = load(urdf), load(urdf, fixed_base=True)
    q, v, a = random_states(np.random.default_rng(11), bolted.n, 4, fixed_base=True)
    resting = np.zeros((4, 6))
    standing = np.hstack([resting, np.ones((4, 1)), q])
    K = regressor(floating, standing, np.hstack([resting, v]), np.hstack([resting, a]))
    np.testing.assert_array_equal(regressor(bolted, q, v, a), K[:, 6:])


def test_a_tilted_bolted_base_feels_gravity_along_its_own_axes() -> None:
    floating, bolted = load(UR5), load(UR5, fixed_base=True)
    q, v, a = random_states(np.random.default_rng(12), bolted.n, 4, fixed_base=True)
    tilt = Rotation.from_rotvec([0.4, -0.7, 0.2])
    resting = np.zeros((4, 6))
    standing = np.hstack([np.zeros((4, 3)), np.tile(tilt.as_quat(), (4, 1)), q])
    K = Regressor(floating)(*tensors(standing, np.hstack([resting, v]), np.hstack([resting, a])))
    g_base = tuple(tilt.inv().apply([0.0, 0.0, -9.81]).tolist())
    assert_close(Regressor(bolted, g_base)(*tensors(q, v, a)).numpy(), K[:, 6:].numpy())


# ----------------------------------------------------------------------------------------------------- the modules


@base_kinds
def test_a_robot_without_joints_has_the_base_rows_only(fixed_base: bool) -> None:
    robot = load(DRONE, fixed_base=fixed_base)
    state = tensors(*random_states(np.random.default_rng(13), 0, 4, fixed_base))
    rows = 0 if fixed_base else 6
    assert Regressor(robot)(*state).shape == (4, rows, 12)
    assert FrameJacobian(robot, robot.base_link)(state[0]).shape == (4, 6, rows)


@pytest.mark.parametrize("samples", [0, 1, 5])
def test_shapes_follow_the_batch(small: Robot, samples: int) -> None:
    q, v, a = tensors(*random_states(np.random.default_rng(14), small.n, samples))
    assert Regressor(small)(q, v, a).shape == (samples, 9, 60)
    assert FrameJacobian(small, "c")(q).shape == (samples, 6, 9)


@of_robots(TALOS, PANDA)
def test_a_sample_does_not_see_its_batch(urdf: Path) -> None:
    robot = load(urdf)
    state = tensors(*random_states(np.random.default_rng(15), robot.n, 37))
    jacobian, K = FrameJacobian(robot, list(robot.links)[-1]), Regressor(robot)
    whole, J = K(*state), jacobian(state[0])
    for part in (slice(0, 1), slice(11, 12), slice(20, 37)):
        piece = [x[part] for x in state]
        assert_close(K(*piece).numpy(), whole[part].numpy(), 1e-15)
        assert_close(jacobian(piece[0]).numpy(), J[part].numpy(), 1e-15)


def test_a_motion_knows_all_that_the_regressor_needs(small: Robot) -> None:
    state = tensors(*random_states(np.random.default_rng(16), small.n, 3))
    K = Regressor(small)
    torch.testing.assert_close(K.from_motion(motion_from_state(*state, n=small.n)), K(*state), rtol=0.0, atol=0.0)


@base_kinds
@of_robots(G1, PANDA)
def test_single_precision_stays_single_and_agrees_to_its_digits(urdf: Path, fixed_base: bool) -> None:
    robot = load(urdf, fixed_base=fixed_base)
    state = tensors(*random_states(np.random.default_rng(17), robot.n, 8, fixed_base))
    frame = list(robot.links)[-1]
    K, J = Regressor(robot), FrameJacobian(robot, frame)
    exact, exact_J = K(*state).numpy(), J(state[0]).numpy()
    single = [x.to(torch.float32) for x in state]
    found, found_J = K.to(torch.float32)(*single), J.to(torch.float32)(single[0])
    assert found.dtype == found_J.dtype == torch.float32
    for module in (K, J):
        assert all(x.dtype == torch.float32 for x in module.buffers() if x.is_floating_point())
    assert_close(found.numpy(), exact, 1e-5)
    assert_close(found_J.numpy(), exact_J, 1e-5)


def test_a_module_moved_to_single_precision_and_back_still_runs_in_double(small: Robot) -> None:
    state = tensors(*random_states(np.random.default_rng(18), small.n, 2))
    K = Regressor(small)
    exact = K(*state)
    back = K.to(torch.float32).to(torch.float64)(*state)
    assert back.dtype == torch.float64
    assert_close(back.numpy(), exact.numpy(), 1e-5)  # the constants have lost their digits


WRONG_SHAPES = {
    "q without the base": lambda q, v, a: (q[:, 7:], v, a),
    "q without a joint": lambda q, v, a: (q[:, :-1], v, a),
    "v without the base": lambda q, v, a: (q, v[:, 6:], a),
    "a without a joint": lambda q, v, a: (q, v, a[:, :-1]),
    "all without a joint": lambda q, v, a: (q[:, :-1], v[:, :-1], a[:, :-1]),
    "a joint too many": lambda q, v, a: tuple(torch.cat([x, x[:, -1:]], 1) for x in (q, v, a)),
    "more v than q": lambda q, v, a: (q[:2], v, a),
    "one v for all": lambda q, v, a: (q, v[:1], a[:1]),
    "one q for all": lambda q, v, a: (q[:1], v, a),
    "no batch": lambda q, v, a: (q[0], v[0], a[0]),
}


@pytest.mark.parametrize("spoil", WRONG_SHAPES.values(), ids=WRONG_SHAPES.keys())
def test_shapes_that_do_not_belong_together_are_refused(small: Robot, spoil: object) -> None:
    state = tensors(*random_states(np.random.default_rng(19), small.n, 3))
    assert callable(spoil)
    with pytest.raises(ValueError, match="accepted"):
        Regressor(small)(*spoil(*state))


@pytest.mark.parametrize("columns", [slice(1, None), slice(7, None), slice(0, 5)], ids=["narrow", "no base", "few"])
def test_a_jacobian_refuses_coordinates_of_another_robot(small: Robot, columns: slice) -> None:
    q, _, _ = tensors(*random_states(np.random.default_rng(20), small.n, 3))
    with pytest.raises(ValueError, match="accepted"):
        FrameJacobian(small, "c")(q[:, columns])


def test_a_jacobian_of_no_link_is_refused_by_the_nearest_names() -> None:
    with pytest.raises(UnknownNameError, match="unknown name 'left_anklle_roll_link'; accepted: left_ankle_roll_link"):
        FrameJacobian(load(G1), "left_anklle_roll_link")


def test_the_regressor_is_differentiable_by_motion(small: Robot) -> None:
    state = [x.requires_grad_() for x in tensors(*random_states(np.random.default_rng(21), small.n, 2))]
    K = Regressor(small)
    weights = torch.from_numpy(np.random.default_rng(22).normal(size=(12 * len(small.bodies), 3)))
    assert torch.autograd.gradcheck(lambda q, v, a: K(q, v, a) @ weights, state)
    assert torch.autograd.gradcheck(K, state, fast_mode=True)


def test_a_jacobian_is_differentiable_by_coordinates(small: Robot) -> None:
    q, _, _ = tensors(*random_states(np.random.default_rng(23), small.n, 2))
    assert torch.autograd.gradcheck(FrameJacobian(small, "c"), q.requires_grad_())


# ------------------------------------------------------------------------------------------------------- reduction


def reduced_regressor(robot: Robot, *state: Array) -> Array:
    """K's inertial part in the columns that are left after regrouping, (B, nv, columns)."""
    tree = KinematicTree(robot)
    layout = reduced_layout(tree)
    joints = joint_states(tree, motion := motion_from_state(*tensors(*state), robot.n, robot.fixed_base))
    states = body_states(tree, motion, joints)
    wrenches = all_wrench_columns(states, layout)
    directions = joint_directions(tree, states)
    rows = [wrenches] if tree.base_rows else []
    for row in joint_rows(tree, layout):
        full = wrenches.new_zeros(1, layout.count, wrenches.shape[-1])
        full[0, row.start : row.end] = joint_row(row, tree, layout, directions, wrenches)
        rows.append(full)
    return torch.cat(rows).permute(2, 0, 1).numpy()


@base_kinds
@of_robots(ANYMAL, BAXTER, DRONE, G1, PANDA, ROMEO, TALOS, TIAGO, TIAGO_PRO, UR5)
def test_all_columns_follow_from_the_regrouped_ones(urdf: Path, fixed_base: bool) -> None:
    robot = load(urdf, fixed_base=fixed_base)
    if not robot.nv:
        return
    state = random_states(np.random.default_rng(24), robot.n, 3, fixed_base)
    full = regressor(robot, *state)[..., parameters.INERTIAL]
    B = reduction_matrix(KinematicTree(robot))
    assert_close(reduced_regressor(robot, *state) @ B, full.reshape(*full.shape[:2], -1))


@of_robots(ANYMAL, DRONE, G1, SOLO12, TALOS, TIAGO, UR5)
def test_a_floating_base_has_10_columns_a_hinge_7_and_a_slide_4_all_independent(urdf: Path) -> None:
    robot = load(urdf)
    slides = int(robot.geometry.prismatic.sum())
    count = 10 + 7 * (robot.n - slides) + 4 * slides
    samples = 3 * count // robot.nv + 10
    K = reduced_regressor(robot, *random_states(np.random.default_rng(25), robot.n, samples))
    stacked = K.reshape(-1, K.shape[2])
    assert stacked.shape[1] == count == reduction_matrix(KinematicTree(robot)).shape[0]
    values = np.linalg.svd(stacked / np.linalg.norm(stacked, axis=0), compute_uv=False)
    assert values[-1] > 1e-6 * values[0]


def test_a_mimic_joint_keeps_the_columns_of_its_own_body() -> None:
    robot = load(BAXTER)
    slides = int(robot.geometry.prismatic.sum())
    assert len(robot.bodies) - 1 - robot.n == 2
    count = 10 + 7 * (len(robot.bodies) - 1 - slides) + 4 * slides
    assert reduction_matrix(KinematicTree(robot)).shape == (count, 10 * len(robot.bodies))
