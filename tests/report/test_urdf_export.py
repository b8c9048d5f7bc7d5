"""`identified.urdf` means the same parameters to Pinocchio, MuJoCo and yourdfpy as to torchid."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yourdfpy
from lxml import etree
from mujoco_oracle import INERTIA_ROUNDING, mujoco_forces, mujoco_model
from physical import random_bodies
from regressors import assert_close, regressor, without_shapes
from scipy.spatial.transform import Rotation
from synthetic import ANYMAL, G1, PANDA, ROBOTS, ROMEO, TALOS, Array, Oracle, load, make_log, random_states
from urdfs import words

from torchid import parameters
from torchid.errors import TorchidWarning
from torchid.estimators import Conditions, Consistent, violations
from torchid.problem import RowBuilder, bind_log, compress, linear_problem
from torchid.problem.linear import parameter_scale
from torchid.report import identified_urdf
from torchid.robot import Robot
from torchid.sensing import Contact, named_sensors

GO2 = ROBOTS / "go2_description/urdf/go2.urdf"
FLOATING = [("machine", False), ("G1", False), ("Talos", False), ("Go2", False), ("ANYmal", False), ("Panda", False)]
KINDS = pytest.mark.parametrize(("name", "fixed_base"), [*FLOATING, ("machine", True), ("Panda", True)])
READ = 1e-13  # of the largest force; 1.3e-15 measured on the robots
URDFS = {"G1": G1, "Talos": TALOS, "Go2": GO2, "ANYmal": ANYMAL, "Panda": PANDA}


def machine(folder: Path) -> Path:
    """Five bodies of seven links, nothing along x, y or z: a slide, two hinges, two welds; shapes to bump into."""
    rng, elements = np.random.default_rng(0), []
    for name in ("base", "slide", "arm", "hand", "finger", "camera", "tool"):
        R = Rotation.random(random_state=rng).as_matrix()
        inertia = R @ np.diag([0.3, 0.4, 0.5] * rng.uniform(0.8, 1.2, 3)) @ R.T
        numbers = {f"i{'xyz'[i]}{'xyz'[j]}": words([inertia[i, j]]) for i in range(3) for j in range(i, 3)}
        inertial = etree.Element("inertial")
        etree.SubElement(inertial, "origin", xyz=words(rng.normal(0.0, 0.2, 3)), rpy=words(rng.normal(size=3)))
        etree.SubElement(inertial, "mass", value=words([rng.uniform(1.0, 3.0)]))
        etree.SubElement(inertial, "inertia", numbers)
        shape = f'<visual><!-- a {name} --><geometry><sphere radius="0.1"/></geometry><material name="red"/></visual>'
        shape += '<collision><origin rpy="0 1 0"/><geometry><box size="0.1 0.2 0.3"/></geometry></collision>'
        matter = "" if name == "tool" else etree.tostring(inertial, encoding="unicode")
        elements.append(f'<link name="{name}">{shape}{matter}</link>')
    for name, kind, parent, child, inside in (
        ("rail", "prismatic", "base", "slide", '<axis xyz="1 2 3"/><dynamics damping="0.5"/>'),
        ("elbow", "revolute", "slide", "arm", '<axis xyz="0 1 -1"/><dynamics friction="0.3" damping="0.1"/>'),
        ("wrist", "continuous", "arm", "hand", '<axis xyz="-1 0.5 0"/>'),
        ("knuckle", "revolute", "arm", "finger", '<axis xyz="0 0 1"/>'),
        ("mount", "fixed", "arm", "camera", ""),
        ("grip", "fixed", "hand", "tool", ""),
    ):
        origin = f'<origin xyz="{words(rng.normal(0.0, 0.4, 3))}" rpy="{words(rng.normal(size=3))}"/>'
        limit = '<limit lower="-1" upper="1" effort="9" velocity="9"/>'
        ends = f'<parent link="{parent}"/><child link="{child}"/>'
        elements.append(f'<joint name="{name}" type="{kind}">{origin}{ends}{inside}{limit}</joint>')
    path = folder / "machine.urdf"
    path.write_text(f'<robot name="machine">{"".join(elements)}<transmission name="t"><type/></transmission></robot>')
    return path


def robot_of(name: str, folder: Path, fixed_base: bool = False) -> Robot:
    """The machine with its shapes; of real robots those are meshes that MuJoCo does not find."""
    path = machine(folder) if name == "machine" else without_shapes(URDFS[name], folder)
    return load(path, fixed_base=fixed_base)


def perturbed(robot: Robot, seed: int = 1) -> Array:
    """Other parameters, (L, 12), as possible as the URDF's, with friction at every joint."""
    rng = np.random.default_rng(seed)
    phi = parameters.perturb_parameters(robot.nominal, 0.2, rng)
    phi[1:, parameters.FRICTION] = rng.uniform(0.1, 2.0, (len(phi) - 1, 2))
    return phi


def exported(robot: Robot, phi: Array, folder: Path) -> Path:
    """The written file; no warning is expected."""
    path = folder / "identified.urdf"
    path.write_bytes(identified_urdf(robot, phi))
    return path


# ---------------------------------------------------------------------------------------------------------- oracles


def pinocchio_forces(path: Path, robot: Robot, q: Array, v: Array, a: Array) -> Array:
    """Inverse dynamics (B, nv) of the file, with the friction that Pinocchio reads from it."""
    oracle = Oracle(path, robot.joint_names, robot.fixed_base)
    model = oracle.model
    coulomb = getattr(model, "upperDryFrictionLimit", None)  # its name since Pinocchio 3.8
    coulomb = model.friction if coulomb is None else coulomb
    rows = [model.joints[model.getJointId(name)].idx_v for name in oracle.moving]
    oracle.friction = np.stack([coulomb[rows], model.damping[rows]], axis=1)
    return oracle.forces(q, v, a)


def torchid_forces(robot: Robot, phi: Array, q: Array, v: Array, a: Array) -> Array:
    return np.einsum("bilk,lk->bi", regressor(robot, q, v, a), phi)


def assert_means(robot: Robot, phi: Array, path: Path) -> None:
    """All three readers get these parameters out of the file."""
    states = random_states(np.random.default_rng(2), robot.n, 4, robot.fixed_base)
    expected = torchid_forces(robot, phi, *states)
    assert_close(pinocchio_forces(path, robot, *states), expected, READ)
    assert_close(mujoco_forces(mujoco_model(path, robot), robot, *states), expected, READ + INERTIA_ROUNDING)
    assert_close(torchid_forces(robot, load(path, robot.base_link).nominal, *states), expected, READ)
    assert_inertials(robot, phi, path)


def assert_inertials(robot: Robot, phi: Array, path: Path) -> None:
    """What yourdfpy parses: one inertial per body, none beside it, and the friction of every joint."""
    model = yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False)
    for body, values in zip(robot.bodies, phi, strict=True):
        for name in body.links:
            inertial = model.link_map[name].inertial
            if name != body.name:
                assert inertial is None or inertial.mass == 0.0
            elif not body.massless:
                com, about_com = inertial.origin[:3, 3], inertial.inertia
                np.testing.assert_array_equal(inertial.origin[:3, :3], np.eye(3))
                found = parameters.inertial_vector(inertial.mass, com, about_com)
                scale = np.abs(found).max()
                np.testing.assert_allclose(found, values[parameters.INERTIAL], rtol=1e-12, atol=1e-14 * scale)
        if body.joint is not None:
            dynamics = model.joint_map[body.joint.name].dynamics or yourdfpy.Dynamics(0.0, 0.0)
            np.testing.assert_array_equal([float(dynamics.friction), float(dynamics.damping)], values[10:])


# ------------------------------------------------------------------------------------------------------------ tests


@KINDS
def test_every_reader_gets_the_parameters_that_were_written(name: str, fixed_base: bool, tmp_path: Path) -> None:
    robot = robot_of(name, tmp_path, fixed_base)
    phi = perturbed(robot)
    assert_means(robot, phi, exported(robot, phi, tmp_path))


@pytest.mark.parametrize("seed", range(3))
def test_bodies_of_any_possible_kind_are_read_as_written(seed: int, tmp_path: Path) -> None:
    """Made of mass points at random, with second moments a hundred times apart."""
    robot = robot_of("machine", tmp_path)
    phi = random_bodies(np.random.default_rng(seed), len(robot.bodies))
    phi[0, parameters.FRICTION] = 0.0
    assert_means(robot, phi, exported(robot, phi, tmp_path))


def test_mimic_joints_keep_their_friction(tmp_path: Path) -> None:
    """Romeo's fingers follow one another; MuJoCo makes soft constraints of that."""
    robot = load(ROMEO)
    phi = perturbed(robot)
    path = exported(robot, phi, tmp_path)
    states = random_states(np.random.default_rng(3), robot.n, 3)
    assert_close(pinocchio_forces(path, robot, *states), torchid_forces(robot, phi, *states), READ)
    assert_inertials(robot, phi, path)


def test_a_robot_read_from_another_base_is_written_as_it_was_rooted(tmp_path: Path) -> None:
    path = machine(tmp_path)
    turned, straight = load(path, "hand"), load(path)
    phi = perturbed(turned)
    identified = exported(turned, phi, tmp_path)
    np.testing.assert_allclose(load(identified, "hand").nominal, phi, rtol=1e-12, atol=1e-13)
    as_rooted = load(identified)
    assert as_rooted.body_names == straight.body_names
    states = random_states(np.random.default_rng(4), straight.n, 3)
    forces = mujoco_forces(mujoco_model(identified, straight), straight, *states)
    assert_close(forces, torchid_forces(straight, as_rooted.nominal, *states), READ + INERTIA_ROUNDING)
    assert as_rooted.nominal[:, 0].sum() == pytest.approx(phi[:, 0].sum())


def test_shapes_of_welded_links_have_no_weight_in_a_simulator(tmp_path: Path) -> None:
    """MuJoCo would make 6 kg of the camera's collision box, and as much of the tool's, if their links said nothing."""
    robot = robot_of("machine", tmp_path)
    phi = perturbed(robot)
    model = mujoco_model(exported(robot, phi, tmp_path), robot)
    assert model.body_mass.sum() == pytest.approx(phi[:, 0].sum(), rel=1e-12)
    np.testing.assert_allclose(model.dof_frictionloss[6:], phi[1:, parameters.COULOMB])
    np.testing.assert_allclose(model.dof_damping[6:], phi[1:, parameters.VISCOUS])


def test_all_that_is_not_inertia_or_friction_stays_as_it_was(tmp_path: Path) -> None:
    robot = robot_of("machine", tmp_path)
    kept = []
    for path in (robot.path, exported(robot, perturbed(robot), tmp_path)):
        root = etree.parse(str(path)).getroot()
        for element in [*root.iter("inertial"), *root.iter("dynamics")]:
            element.getparent().remove(element)
        kept.append("".join(etree.tostring(root, encoding="unicode").split()))
    assert kept[0] == kept[1]


def test_impossible_bodies_and_driving_friction_are_warned_of_by_name(tmp_path: Path) -> None:
    robot = robot_of("machine", tmp_path)
    phi = perturbed(robot)
    phi[1, 4:10] = -phi[1, 4:10]
    phi[2, parameters.VISCOUS] = -0.1
    with pytest.warns(TorchidWarning) as caught:
        identified_urdf(robot, phi)
    impossible, driving = (str(warning.message) for warning in caught)
    assert f"not physically consistent, simulators refuse or misread them: {robot.body_names[1]}." in impossible
    assert f"refuse the negative friction of {robot.joint_names[1]}." in driving


# ------------------------------------------------------------------------------------------------- a consistent fit


@pytest.mark.parametrize(("name", "foot"), [("machine", "tool"), ("Go2", "FL_foot")])
def test_a_consistent_fit_of_poor_data_is_taken_by_every_reader(name: str, foot: str, tmp_path: Path) -> None:
    """Least squares on them gives bodies that MuJoCo refuses; the margin of the consistent ones is all used up."""
    robot = robot_of(name, tmp_path)
    contacts = [Contact(foot, "point")]
    builder = RowBuilder(robot, contacts, named_sensors("joints", robot.n, 1))
    rng = np.random.default_rng(5)
    log = make_log(Oracle.of(robot), [(foot, 3)], [[True], [False]], 60, rng)
    assert log.joint_torque is not None
    log = replace(log, joint_torque=log.joint_torque + 10.0 * rng.normal(size=log.joint_torque.shape))
    problem = linear_problem(compress([bind_log(log, robot, contacts)], builder), builder, robot)
    conditions = Conditions(1e-3)
    phi = Consistent(1e-4, conditions=conditions).solve(problem).phi.reshape(-1, parameters.PER_BODY)
    scale = parameter_scale(robot.nominal)
    eigenvalues = np.linalg.eigvalsh(parameters.pseudo_inertia(phi / scale))[:, 0]
    assert (eigenvalues < 1.01e-3).any()
    assert violations(phi, scale, conditions, 1e-7) == []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = exported(robot, phi, tmp_path)
    assert_means(robot, phi, path)
    impossible = phi.copy()
    impossible[1, 4] += 3.0 * (impossible[1, 7] + impossible[1, 9])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        path = exported(robot, impossible, tmp_path)
    with pytest.raises(ValueError, match="A \\+ B >= C"):
        mujoco_model(path, robot)


def test_friction_that_is_gone_is_written_and_friction_that_never_was_is_not(tmp_path: Path) -> None:
    robot = robot_of("machine", tmp_path)
    phi = robot.nominal.copy()
    phi[:, parameters.FRICTION] = 0.0
    root = etree.parse(str(exported(robot, phi, tmp_path))).getroot()
    found = {joint.get("name"): joint.find("dynamics") for joint in root.findall("joint")}
    assert dict(found["rail"].attrib) == dict(found["elbow"].attrib) == {"friction": "0.0", "damping": "0.0"}
    assert found["wrist"] is found["knuckle"] is found["mount"] is None
