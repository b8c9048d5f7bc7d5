"""Robots in MuJoCo whose joints are constrained: held, following others, or closing loops."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import torch
from closed_loops import MODELS
from motions import value
from simulated import BIPED, SOLES, forces, only, robot_on, short

from torchid.config import FootConfig, MotionConfig
from torchid.config.robot import ConstrainedRobot, LoopConfig
from torchid.config.simulation import SimulatedRobotConfig, WaveConfig
from torchid.errors import UnknownNameError
from torchid.problem import RowBuilder, bind_log, compress, linear_problem
from torchid.regressor.loops import LoopClosures
from torchid.robot import load_robot
from torchid.robot.urdf import read_urdf
from torchid.sensing import Contact, named_sensors
from torchid.simulation import set_up_simulation
from torchid.simulation.plant import JointConstraints, Plant
from torchid.simulation.replay import Model, ReplayedLog, replay_log

TIMES = np.array([0.1, 0.2])
LINK = """<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="0.1 0.12 0.03" rpy="0.3 0 0.2"/>
<inertia ixx="0.01" iyy="0.02" izz="0.025" ixy="0.001" ixz="0" iyz="0.002"/></inertial></link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="0.25 0 0.1" rpy="0.4 0.2 0"/><axis xyz="{axis}"/>{more}<dynamics damping="0.2"/>
<limit lower="-9" upper="9" effort="9" velocity="9"/></joint>"""


def arm(folder: Path, kind: str = "revolute", more: str = "") -> Path:
    """Three links in a row; the second joint is of a kind, or follows the first."""
    joints = [("first", "revolute", "base", "a", "0 1 0", ""), ("second", kind, "a", "b", "1 0 0", more)]
    joints.append(("third", "revolute", "b", "c", "0 1 1", ""))
    keys = ("name", "kind", "parent", "child", "axis", "more")
    links = "".join(LINK.format(name=name, mass=mass) for name, mass in (("a", 1.2), ("b", 0.8), ("c", 0.5)))
    text = "".join(JOINT.format(**dict(zip(keys, joint, strict=True))) for joint in joints)
    path = folder / "arm.urdf"
    path.write_text(f'<robot name="arm"><link name="base"/>{links}{text}</robot>')
    return path


def swinging(urdf: Path, second: tuple[float, float]) -> ReplayedLog:
    """Sines of the first and third joint, the second at ratio * first + offset, with the torques of motors at two.

    By Pinocchio, which takes the three joints as independent: a following joint's torque does its work at the first.
    """
    time, (ratio, offset) = np.arange(0.0, 1.2, 0.001), second
    phase, speed = np.array([0.3, 1.1]), 2.0 * np.pi * np.array([1.3, 0.9])
    angle = np.outer(time, speed) + phase
    motion = 0.6 * np.sin(angle), 0.6 * speed * np.cos(angle), -0.6 * speed**2 * np.sin(angle)
    robot = pin.buildModelFromUrdf(str(urdf))
    data = robot.createData()
    q, v, a = (np.insert(x, 1, ratio * x[:, 0], axis=1) for x in motion)
    q[:, 1] += offset
    torque = np.array([pin.rnea(robot, data, *x) for x in zip(q, v, a, strict=True)]) + 0.2 * v
    at_two = np.stack([torque[:, 0] + ratio * torque[:, 1], torque[:, 2]], axis=1)
    return ReplayedLog("swing", time, *motion[:2], at_two, None, None, np.zeros((len(time), 0), dtype=bool))


def drift(urdf: Path, constraints: JointConstraints, log: ReplayedLog) -> float:
    """The largest of both joints with motors after `TIMES` [rad]."""
    model = Model(urdf, ("first", "third"), np.zeros(2), np.zeros(2), np.zeros(2), constraints)
    return float(np.abs(replay_log(model, log, (), log.windows(TIMES[-1]), TIMES).joints).max())


def test_a_joint_that_mimics_another_follows_it_and_loads_its_motor(tmp_path: Path) -> None:
    urdf = arm(tmp_path, more='<mimic joint="first" multiplier="-0.7" offset="0.2"/>')
    constraints = JointConstraints.of(urdf, read_urdf(urdf)[1])
    log = swinging(urdf, (-0.7, 0.2))
    assert drift(urdf, constraints, log) < 2e-5
    assert drift(urdf, constraints, replace(log, torque=1.02 * log.torque)) > 1e-3


def test_a_biped_with_parallel_ankles_stands_on_its_motors_alone(tmp_path: Path) -> None:
    """Its exact log fulfils the equations of motion without the forces of its rods, which nobody measures."""
    path = tmp_path / "biped.xml"
    path.write_text(MODELS["biped"])
    sole = [[x, y, 0.0] for x in (-0.1, 0.1) for y in (-0.04, 0.04)]
    posture = {}
    for side in ("left", "right"):
        bent = {"hip": -0.6, "knee": 1.2, "pitch": -0.6}
        bent |= {f"{rod}_motor": -0.6 for rod in ("front", "back")} | {f"{rod}_rod_y": 0.6 for rod in ("front", "back")}
        posture |= {f"{side}_{name}": angle for name, angle in bent.items()}
    motion = MotionConfig("squat", 0.6, [WaveConfig("com_z", 1.0, 0.01)])
    config = robot_on(path, [FootConfig(f"{side}_sole", sole) for side in ("left", "right")], posture, motion)
    simulation = set_up_simulation(replace(config, robot=SimulatedRobotConfig(mjcf=path)))
    log = simulation.run(motion)[0].log
    robot = load_robot(path)
    contacts = [Contact(f"{side}_sole", "flat") for side in ("left", "right")]
    passive = [log.joint_names.index(name) for name in robot.passive]
    assert len(passive) == 12
    np.testing.assert_array_equal(value(log.joint_torque)[:, passive], 0.0)
    builder = RowBuilder(robot, contacts, named_sensors("full", robot.n, 2))
    samples = bind_log(log, robot, contacts, builder.sensors)
    gaps = [gap for gap, _ in LoopClosures(robot).gaps(samples.joint_position)]
    assert float(torch.stack(gaps).max()) < 1e-6  # m
    problem = linear_problem(compress([samples], builder), builder, robot)
    left = problem.A @ robot.nominal.flatten() - problem.b
    assert np.sqrt((left @ left + problem.residual) / (problem.b @ problem.b)) < 1e-6
    assert np.ptp(log.joint_position[:, passive], axis=0).max() > 0.02, "the loops move"


def test_a_simulated_joint_that_mimics_another_obeys_the_equations_of_the_robot_without_it(tmp_path: Path) -> None:
    urdf = tmp_path / "biped.urdf"
    mimic = '<mimic joint="torso_roll" multiplier="0.5"/><limit lower="-0.6" upper="1.2"'
    text = BIPED.read_text()
    assert text.count('<limit lower="-0.6" upper="1.2"') == 1
    urdf.write_text(text.replace('<limit lower="-0.6" upper="1.2"', mimic))
    config = only(short(tmp_path / "out", f"robot.urdf={urdf}", "friction.enabled=false"), "squat_1.0hz")
    motion = replace(config.motions[0], waves=[*config.motions[0].waves, WaveConfig("torso_roll", 1.0, 0.1)])
    log = set_up_simulation(config).run(motion)[0].log
    roll, pitch = (log.joint_names.index(name) for name in ("torso_roll", "torso_pitch"))
    assert np.ptp(log.joint_position[:, roll]) > 0.05
    np.testing.assert_allclose(log.joint_position[:, pitch], 0.5 * log.joint_position[:, roll], atol=1e-6)
    measured, predicted = forces(log, urdf, SOLES)
    assert measured.shape[1] == load_robot(urdf).nv
    assert np.abs(predicted - measured).max() < 1e-5 * np.abs(measured).max()


def test_a_simulated_robot_can_have_held_joints_loops_and_joints_without_motors(tmp_path: Path) -> None:
    loop = LoopConfig(["base", "c"])  # type: ignore[arg-type]
    urdf = arm(tmp_path)
    urdf.write_text(urdf.read_text().replace('<link name="base"/>', LINK.format(name="base", mass=2.0)))
    plant = Plant(urdf, (), 1000.0, stated=ConstrainedRobot(weld={"second": 0.2}, loops=[loop], passive=["thi*"]))
    assert plant.joint_names == ("first", "third")
    np.testing.assert_array_equal(plant.has_motor, [True, False])
    assert plant.constraints[0].shape == (3, plant.nv)
    with pytest.raises(UnknownNameError, match=r"robot\.weld"):
        Plant(urdf, (), 1000.0, stated=ConstrainedRobot(weld={"fourth": 0.0}))


def test_the_log_of_a_robot_with_a_held_joint_is_that_of_the_robot_with_a_weld(tmp_path: Path) -> None:
    held = {"torso_pitch": 0.1}
    config = only(short(tmp_path / "out", "robot.weld={torso_pitch: 0.1}", "friction.enabled=false"), "squat_1.0hz")
    motion = replace(config.motions[0], waves=[WaveConfig("com_z", 1.0, 0.03)])
    log = set_up_simulation(config).run(motion)[0].log
    assert "torso_pitch" not in log.joint_names
    measured, predicted = forces(log, BIPED, SOLES, held)
    assert np.abs(predicted - measured).max() < 1e-5 * np.abs(measured).max()
