"""The tree of bodies against Pinocchio: poses, lumped inertias, any link as base, mimic joints; inertia algebra."""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ElementTree
from pathlib import Path

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
    PINOCCHIO_ORDER,
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

from torchid import parameters
from torchid.errors import TorchidWarning
from torchid.regressor import FrameJacobian, Regressor
from torchid.robot import Robot, load_robot

REAL = (
    *(ANYMAL, BAXTER, DRONE, G1, PANDA, SOLO12, TALOS, TIAGO, UR5),
    ROBOTS / "romeo_description/urdf/romeo.urdf",
    ROBOTS / "pr2_description/urdf/pr2.urdf",
    ROBOTS / "talos_data/robots/talos_full_v2.urdf",
    ROBOTS / "tiago_pro_description/robots/tiago_pro.urdf",
    ROBOTS / "icub_description/robots/icub.urdf",
)

every_real_robot = pytest.mark.parametrize("urdf", REAL, ids=lambda path: path.stem)


def write(folder: Path, *elements: str) -> Path:
    """A URDF of some elements."""
    path = folder / "machine.urdf"
    path.write_text(f'<robot name="machine">{"".join(elements)}</robot>')
    return path


def link(name: str) -> str:
    """A link with an inertia like no other's."""
    origin = '<origin xyz="0.1 -0.2 0.3" rpy="0.4 0.5 -0.6"/>'
    inertia = '<inertia ixx="0.3" ixy="0.01" ixz="-0.02" iyy="0.4" iyz="0.03" izz="0.5"/>'
    return f'<link name="{name}"><inertial>{origin}<mass value="2"/>{inertia}</inertial></link>'


def joint(name: str, parent: str, child: str, kind: str = "revolute", extra: str = "") -> str:
    """A joint element about or along z."""
    axis = "" if kind == "fixed" else '<axis xyz="0 0 1"/>'
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="1 0.5 0.2" rpy="0.3 -0.2 0.1"/>'
        f'<parent link="{parent}"/><child link="{child}"/>{axis}{extra}</joint>'
    )


def mimic(master: str, multiplier: float, offset: float) -> str:
    """A mimic element."""
    return f'<mimic joint="{master}" multiplier="{multiplier}" offset="{offset}"/>'


def transform(rotation: Array, position: Array) -> Array:
    """A pose, (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, position
    return T


ORIGIN = transform(Rotation.from_euler("xyz", [0.3, -0.2, 0.1]).as_matrix(), np.array([1.0, 0.5, 0.2]))


# ---------------------------------------------------------------------------------------------------- real robots


@every_real_robot
def test_the_bodies_weigh_what_the_links_weigh(urdf: Path) -> None:
    masses = [float(mass.get("value", "nan")) for mass in ElementTree.parse(urdf).findall("./link/inertial/mass")]
    np.testing.assert_allclose(load(urdf).nominal[:, parameters.MASS].sum(), sum(masses), rtol=1e-14)


@every_real_robot
def test_a_body_has_the_inertia_of_all_links_welded_to_it(urdf: Path) -> None:
    robot = load(urdf)
    expected = Oracle.of(robot).inertial_parameters(robot)
    np.testing.assert_allclose(robot.nominal[:, parameters.INERTIAL], expected, rtol=0.0, atol=1e-14 * expected.max())


@every_real_robot
def test_every_link_is_where_pinocchio_puts_it(urdf: Path) -> None:
    robot = load(urdf)
    q, _, _ = random_states(np.random.default_rng(0), robot.n, 4)
    q[:, :7] = [0.0] * 6 + [1.0]
    oracle = Oracle.of(robot)
    poses = robot.link_poses(torch.from_numpy(q[:, 7:]))
    assert set(poses) == set(robot.links)
    for name, T_base_link in poses.items():
        rotation, position = oracle.pose(q, name)
        np.testing.assert_allclose(T_base_link[:, :3, :3], rotation, rtol=0.0, atol=1e-14, err_msg=name)
        np.testing.assert_allclose(T_base_link[:, :3, 3], position, rtol=0.0, atol=1e-14, err_msg=name)


@every_real_robot
def test_the_chain_moves_every_joint_by_its_name_and_carries_every_link(urdf: Path) -> None:
    robot = load(urdf)
    names = robot.chain.get_joint_parameter_names()
    assert sorted(names) == sorted(body.joint.name for body in robot.bodies if body.joint is not None)
    matrix, offset = robot.joint_map
    in_order = [body.joint.name for body in robot.bodies if body.joint is not None]
    q = np.random.default_rng(1).uniform(-1.0, 1.0, (3, robot.n))
    positions = (q @ matrix.T + offset)[:, [in_order.index(name) for name in names]]
    transforms = robot.chain.forward_kinematics(torch.from_numpy(positions))
    for name, T_base_link in robot.link_poses(torch.from_numpy(q)).items():
        np.testing.assert_array_equal(transforms[name].get_matrix(), T_base_link)


@every_real_robot
def test_parents_come_before_their_children_and_subtrees_are_contiguous(urdf: Path) -> None:
    parents = [body.parent for body in load(urdf).bodies]
    assert parents[0] == -1
    for body, parent in enumerate(parents[1:], start=1):
        assert parent < body
        between = [parents[k] for k in range(parent + 1, body)]
        assert all(above >= parent for above in between)


# ------------------------------------------------------------------------------------------------ written by hand


def test_joints_are_in_the_depth_first_order_of_the_file(tmp_path: Path) -> None:
    names = ["base", "a", "a1", "a2", "b", "b1"]
    joints = [
        joint("to_b", "base", "b"),
        joint("to_a", "base", "a"),
        joint("to_a2", "a", "a2"),
        joint("to_b1", "b", "b1"),
        joint("to_a1", "a", "a1"),
    ]
    robot = load_robot(write(tmp_path, *map(link, names), *joints))
    assert robot.joint_names == ("to_b", "to_b1", "to_a", "to_a2", "to_a1")
    assert robot.body_names == ("base", "b", "b1", "a", "a2", "a1")


def test_a_welded_body_weighs_in_by_the_parallel_axes_of_its_turned_frame(tmp_path: Path) -> None:
    robot = load_robot(write(tmp_path, link("base"), link("tool"), joint("weld", "base", "tool", "fixed")))
    assert len(robot.bodies) == 1
    in_link = pin.SE3(Rotation.from_euler("xyz", [0.4, 0.5, -0.6]).as_matrix(), np.array([0.1, -0.2, 0.3]))
    at_com = pin.Inertia(2.0, np.zeros(3), np.array([[0.3, 0.01, -0.02], [0.01, 0.4, 0.03], [-0.02, 0.03, 0.5]]))
    one = in_link.act(at_com)
    both = (one + pin.SE3(ORIGIN).act(one)).toDynamicParameters()
    np.testing.assert_allclose(robot.nominal[0, PINOCCHIO_ORDER], both, rtol=0.0, atol=1e-14)
    body, T_body_link = robot.link("tool")
    assert body == 0
    np.testing.assert_allclose(T_body_link, ORIGIN, rtol=0.0, atol=1e-15)


def test_mimic_joints_that_follow_mimic_joints_end_at_the_one_that_is_free(tmp_path: Path) -> None:
    names = ["base", "a", "b", "c"]
    joints = (
        joint("last", "b", "c", extra=mimic("middle", 3.0, 0.5)),
        joint("middle", "a", "b", "prismatic", mimic("first", -2.0, 0.25)),
        joint("first", "base", "a"),
    )
    robot = load_robot(write(tmp_path, *map(link, names), *joints))
    assert robot.joint_names == ("first",)
    matrix, offset = robot.joint_map
    np.testing.assert_array_equal(matrix, [[1.0], [-2.0], [-6.0]])  # first, middle, last
    np.testing.assert_array_equal(offset, [0.0, 0.25, 3.0 * 0.25 + 0.5])


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("base_link", ["base", "tip"])
def test_a_joint_that_mimics_a_fixed_one_is_held_at_its_offset(kind: str, base_link: str, tmp_path: Path) -> None:
    weld = joint("weld", "base", "stand", "fixed")
    path = write(
        tmp_path,
        *map(link, ["base", "stand", "arm", "tip"]),
        weld,
        joint("held", "stand", "arm", kind, mimic("weld", 2.0, 0.7)),
        joint("held_too", "arm", "tip", kind, mimic("held", 3.0, -0.1)),
    )
    with pytest.warns(TorchidWarning, match="'weld' is fixed, so it is held still too") as caught:
        robot = load_robot(path, base_link)
    assert [f"joint '{name}'" in str(w.message) for w, name in zip(caught, ("held", "held_too"), strict=True)] == [
        True
    ] * 2
    assert robot.n == 0
    assert robot.body_names == (base_link,)
    moved = []
    for position in (0.7, 3.0 * 0.7 - 0.1):
        turn = Rotation.from_rotvec([0.0, 0.0, position]).as_matrix()
        still = transform(np.eye(3), np.array([0.0, 0.0, position]))
        moved.append(ORIGIN @ (still if kind == "prismatic" else transform(turn, np.zeros(3))))
    T_base_tip = ORIGIN @ moved[0] @ moved[1]
    expected = T_base_tip if base_link == "base" else np.linalg.inv(T_base_tip)
    _, found = robot.link("tip" if base_link == "base" else "base")
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-14)


def test_a_robot_without_joints_has_one_body_and_its_poses(tmp_path: Path) -> None:
    robot = load_robot(write(tmp_path, link("base"), link("tool"), joint("weld", "base", "tool", "fixed")))
    assert (robot.n, robot.nv, robot.joint_names, robot.body_names) == (0, 6, (), ("base",))
    assert all(x.shape[0] == 0 for x in robot.joint_map)
    poses = robot.link_poses(torch.zeros(3, 0, dtype=torch.float64))
    np.testing.assert_allclose(poses["tool"], np.tile(ORIGIN, (3, 1, 1)), rtol=0.0, atol=1e-15)


def test_a_bolted_base_has_no_rows(tmp_path: Path) -> None:
    path = write(tmp_path, link("base"), link("arm"), joint("elbow", "base", "arm"))
    assert (load_robot(path).nv, load_robot(path).base_rows) == (7, 6)
    bolted = load_robot(path, fixed_base=True)
    assert (bolted.nv, bolted.base_rows) == (1, 0)


# ------------------------------------------------------------------------------------------------- another base link


def turned_inertias(urdf: Path, folder: Path) -> Path:
    """The URDF with every inertia frame turned at random and friction in every joint."""
    rng = np.random.default_rng(7)
    tree = ElementTree.parse(urdf)
    for inertial in tree.findall("./link/inertial"):
        origin = inertial.find("origin")
        origin = ElementTree.SubElement(inertial, "origin") if origin is None else origin
        origin.set("rpy", " ".join(map(repr, rng.uniform(-1.5, 1.5, 3).tolist())))
    for element in tree.findall("joint"):
        for dynamics in element.findall("dynamics"):
            element.remove(dynamics)
        damping, friction = rng.uniform(0.5, 2.0, 2).tolist()
        ElementTree.SubElement(element, "dynamics", damping=repr(damping), friction=repr(friction))
    path = folder / urdf.name
    tree.write(path)
    return path


def seen_from(oracle: Oracle, frame: str, q: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
    """The same motion in coordinates whose base is another frame; joints as they were."""
    index = oracle.model.getFrameId(frame, pin.FrameType.BODY)
    moved = []
    for state in zip(q, v, a, strict=True):
        full, velocity, acceleration = oracle.coordinates(state[0]), oracle.expand @ state[1], oracle.expand @ state[2]
        pin.forwardKinematics(oracle.model, oracle.data, full, velocity, acceleration)
        pin.updateFramePlacements(oracle.model, oracle.data)
        pose = pin.SE3ToXYZQUAT(oracle.data.oMf[index])
        twist = pin.getFrameVelocity(oracle.model, oracle.data, index, pin.LOCAL).vector
        change = pin.getFrameAcceleration(oracle.model, oracle.data, index, pin.LOCAL).vector
        moved.append((pose, twist, change))
    pose, twist, change = map(np.array, zip(*moved, strict=True))
    return np.hstack([pose, q[:, 7:]]), np.hstack([twist, v[:, 6:]]), np.hstack([change, a[:, 6:]])


def by_joints_of(robot: Robot, other: Robot, base: int, x: Array) -> Array:
    """Joint columns in another robot's order."""
    order = [robot.joint_names.index(name) for name in other.joint_names]
    return np.hstack([x[:, :base], x[:, base:][:, order]])


def forces(robot: Robot, *state: Array) -> Array:
    """Nominal inverse dynamics with friction, (B, nv), by the regressor."""
    K = Regressor(robot)(*map(torch.from_numpy, state))
    return (K @ torch.from_numpy(robot.nominal.flatten())).numpy()


def standing_on(robot: Robot, foot: str, *state: Array) -> tuple[Array, Array]:
    """Wrench at a foot's frame that carries the robot alone, (B, 6), and the joint torques with it, (B, n)."""
    needed = forces(robot, *state)
    J = FrameJacobian(robot, foot)(torch.from_numpy(state[0])).numpy()
    wrench = np.linalg.solve(J[:, :, :6].transpose(0, 2, 1), needed[:, :6, None])[..., 0]
    return wrench, needed[:, 6:] - np.einsum("bki,bk->bi", J[:, :, 6:], wrench)


REROOTED = [
    (G1, "left_ankle_roll_link", "right_ankle_roll_link"),
    (G1, "torso_link", "right_ankle_roll_link"),
    (G1, "left_ankle_roll_link", "left_ankle_roll_link"),
    (PANDA, "panda_leftfinger", "panda_hand"),
    (BAXTER, "l_gripper_r_finger", "r_gripper_l_finger"),
    (TIAGO, "torso_lift_link", "arm_7_link"),
    (ROBOTS / "tiago_pro_description/robots/tiago_pro.urdf", "arm_left_tool_link", "base_link"),
]

every_pair_of_links = pytest.mark.parametrize(
    ("urdf", "base_link", "foot"), REROOTED, ids=lambda x: getattr(x, "stem", x)
)
every_other_base = pytest.mark.parametrize(
    ("urdf", "base_link"), [case[:2] for case in REROOTED], ids=lambda x: getattr(x, "stem", x)
)


@every_pair_of_links
def test_what_carries_a_robot_and_moves_its_joints_is_the_same_from_every_base_link(
    urdf: Path, base_link: str, foot: str, tmp_path: Path
) -> None:
    path = turned_inertias(urdf, tmp_path)
    from_root, from_other = load(path), load(path, base_link)
    assert sorted(from_root.joint_names) == sorted(from_other.joint_names)
    state = random_states(np.random.default_rng(3), from_root.n, 6)
    moved = seen_from(Oracle.of(from_root), base_link, *state)
    moved = tuple(by_joints_of(from_root, from_other, k, x) for k, x in zip((7, 6, 6), moved, strict=True))
    wrench, torque = standing_on(from_root, foot, *state)
    wrench_too, torque_too = standing_on(from_other, foot, *moved)
    size = max(np.abs(wrench).max(), np.abs(torque).max())
    np.testing.assert_allclose(wrench_too, wrench, rtol=0.0, atol=1e-12 * size)
    np.testing.assert_allclose(by_joints_of(from_other, from_root, 0, torque_too), torque, rtol=0.0, atol=1e-12 * size)


@every_other_base
def test_the_base_wrench_is_the_same_wrench_at_every_base_link(urdf: Path, base_link: str, tmp_path: Path) -> None:
    path = turned_inertias(urdf, tmp_path)
    from_root, from_other = load(path), load(path, base_link)
    oracle = Oracle.of(from_root)
    state = random_states(np.random.default_rng(4), from_root.n, 6)
    moved = seen_from(oracle, base_link, *state)
    there = forces(
        from_other, *(by_joints_of(from_root, from_other, k, x) for k, x in zip((7, 6, 6), moved, strict=True))
    )
    here = forces(from_root, *state)
    J = oracle.jacobian(state[0], base_link)
    carried = np.einsum("bki,bk->bi", J, there[:, :6])  # by virtual work: to the root and to the joints in between
    carried[:, 6:] += by_joints_of(from_other, from_root, 0, there[:, 6:])
    np.testing.assert_allclose(carried, here, rtol=0.0, atol=1e-12 * np.abs(here).max())


@every_other_base
def test_links_have_the_same_place_relative_to_one_another_from_every_base_link(urdf: Path, base_link: str) -> None:
    from_root, from_other = load(urdf), load(urdf, base_link)
    assert from_other.base_link == from_other.body_names[0] == base_link
    q = np.random.default_rng(5).uniform(-1.0, 1.0, (3, from_root.n))
    here = from_root.link_poses(torch.from_numpy(q))
    there = from_other.link_poses(torch.from_numpy(by_joints_of(from_root, from_other, 0, q)))
    assert set(here) == set(there)
    for name, T_other_link in there.items():
        T_root_link = here[base_link] @ T_other_link
        np.testing.assert_allclose(T_root_link, here[name], rtol=0.0, atol=1e-14, err_msg=name)
    np.testing.assert_allclose(there[base_link], np.tile(np.eye(4), (3, 1, 1)), rtol=0.0, atol=1e-15)


def test_mass_is_the_same_from_every_base_link() -> None:
    robot = load(G1)
    total = robot.nominal[:, parameters.MASS].sum()
    for base_link in list(robot.links)[::6]:
        np.testing.assert_allclose(load(G1, base_link).nominal[:, parameters.MASS].sum(), total, rtol=1e-14)


# ---------------------------------------------------------------------------------------------------- inertia algebra

finite = st.floats(-2.0, 2.0, allow_nan=False)
vectors = st.tuples(finite, finite, finite).map(np.array)
rotations = vectors.map(lambda x: Rotation.from_rotvec(1.5 * x).as_matrix())
poses = st.builds(transform, rotations, vectors)
positive = st.floats(0.05, 5.0)


@st.composite
def bodies(draw: st.DrawFn) -> tuple[float, Array, Array]:
    """Mass, centre of mass, and an inertia about it with three different principal values in turned axes."""
    second_moments = np.array(draw(st.tuples(positive, positive, positive)))
    R = draw(rotations)
    return draw(positive), draw(vectors), R @ np.diag(second_moments.sum() - second_moments) @ R.T


def test_the_parameters_are_in_the_papers_order() -> None:
    assert " ".join(parameters.PARAMETERS) == "m mcx mcy mcz Ixx Ixy Ixz Iyy Iyz Izz fc fv"
    assert parameters.PER_BODY == 12
    phi = np.arange(10.0)
    np.testing.assert_array_equal(parameters.inertia_matrix(phi), [[4, 5, 6], [5, 7, 8], [6, 8, 9]])
    assert list(parameters.PINOCCHIO_ORDER) == PINOCCHIO_ORDER
    assert len(parameters.UNITS) == 12


@settings(max_examples=50, deadline=None, derandomize=True)
@given(bodies())
def test_parameters_are_pinocchios_in_its_order(body: tuple[float, Array, Array]) -> None:
    expected = pin.Inertia(*body).toDynamicParameters()
    phi = parameters.inertial_vector(*body)
    np.testing.assert_allclose(phi[list(parameters.PINOCCHIO_ORDER)], expected, rtol=0.0, atol=1e-13)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(bodies())
def test_mass_centre_and_inertia_come_back(body: tuple[float, Array, Array]) -> None:
    mass, com, inertia = parameters.mass_com_inertia(parameters.inertial_vector(*body))
    assert mass == body[0]
    np.testing.assert_allclose(com, body[1], rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(inertia, body[2], rtol=0.0, atol=1e-13)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(bodies(), poses)
def test_a_body_seen_from_another_frame_is_pinocchios(body: tuple[float, Array, Array], T: Array) -> None:
    expected = pin.SE3(T).act(pin.Inertia(*body)).toDynamicParameters()
    phi = parameters.change_of_frame(T) @ parameters.inertial_vector(*body)
    np.testing.assert_allclose(phi[PINOCCHIO_ORDER], expected, rtol=0.0, atol=1e-12)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(poses, poses)
def test_changes_of_frame_compose_and_invert_as_poses_do(T: Array, U: Array) -> None:
    X, Y = parameters.change_of_frame(T), parameters.change_of_frame(U)
    np.testing.assert_allclose(parameters.change_of_frame(T @ U), X @ Y, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(parameters.change_of_frame(np.linalg.inv(T)) @ X, np.eye(10), rtol=0.0, atol=1e-12)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(st.lists(st.tuples(positive, vectors), min_size=1, max_size=6))
def test_the_pseudo_inertia_is_the_second_moment_of_the_mass_points(points: list[tuple[float, Array]]) -> None:
    phi = sum(parameters.inertial_vector(mass, place, np.zeros((3, 3))) for mass, place in points)
    moments = sum(mass * np.outer([*place, 1.0], [*place, 1.0]) for mass, place in points)
    np.testing.assert_allclose(parameters.pseudo_inertia(phi), moments, rtol=0.0, atol=1e-13)
    assert parameters.consistency_margin(phi) >= -1e-14


@settings(max_examples=50, deadline=None, derandomize=True)
@given(bodies())
def test_a_real_body_has_a_positive_pseudo_inertia(body: tuple[float, Array, Array]) -> None:
    phi = parameters.inertial_vector(*body)
    pseudo = parameters.pseudo_inertia(phi)
    np.testing.assert_allclose(pseudo, pin.Inertia(*body).toPseudoInertia().toMatrix(), rtol=0.0, atol=1e-13)
    values = np.linalg.eigvalsh(pseudo)
    assert values[0] > 0.0
    np.testing.assert_allclose(parameters.consistency_margin(phi), values[0] / values[-1], rtol=1e-9)


def test_a_body_that_breaks_the_triangle_inequality_has_a_negative_margin() -> None:
    phi = np.stack([parameters.inertial_vector(1.0, np.ones(3), np.diag(x)) for x in ([1, 1, 1.9], [1, 1, 2.1])])
    assert (parameters.consistency_margin(phi) > 0.0).tolist() == [True, False]
    assert (parameters.consistency_margin(np.pad(phi, ((0, 0), (0, 2)))) > 0.0).tolist() == [True, False]


def test_a_base_link_of_one_name_and_no_other_gives_no_warning(tmp_path: Path) -> None:
    path = write(tmp_path, link("base"), link("arm"), joint("elbow", "base", "arm"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_robot(path, "arm").body_names == ("arm", "base")
