"""A simulated robot of an MJCF file is that of its URDF, with armatures; what a simulation would lose is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from forked import forked_simulations
from simulated import QUADRUPED, quadruped, squat

from torchid.cli import main
from torchid.config import SimulationConfig, dump_config
from torchid.config.simulation import SimulatedRobotConfig
from torchid.errors import InputError
from torchid.logs import read_log
from torchid.problem import Evaluation, bind_log
from torchid.problem.metrics import force_series
from torchid.report.mjcf_files import mjcf_of_urdf
from torchid.robot import load_robot
from torchid.sensing import Contact
from torchid.simulation import set_up_simulation

ROBOT = load_robot(QUADRUPED)
MOTION = squat(0.03, seconds=0.3)


def of_mjcf(folder: Path, armature: float = 0.0, **replaced: str) -> SimulationConfig:
    """The quadruped as MJCF, with armatures and texts in place of others."""
    text = mjcf_of_urdf(ROBOT, ROBOT.nominal, dict.fromkeys(ROBOT.joint_names, armature)).decode()
    for old, new in replaced.items():
        text = text.replace(f"<{old}", new)
    (folder / "robot.xml").write_text(text)
    return replace(quadruped(MOTION), robot=SimulatedRobotConfig(mjcf=folder / "robot.xml"), output=folder / "out")


def test_the_model_and_its_stance_are_those_of_the_urdf(tmp_path: Path) -> None:
    one, other = (set_up_simulation(config) for config in (of_mjcf(tmp_path), quadruped(MOTION)))
    assert one.plant.joint_names == other.plant.joint_names
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat", "jnt_axis"):
        np.testing.assert_allclose(*(getattr(x.plant.model, name) for x in (one, other)), atol=1e-12)
    for name in ("dof_damping", "dof_frictionloss", "jnt_range", "site_pos", "geom_size"):
        np.testing.assert_allclose(*(getattr(x.plant.model, name) for x in (one, other)), atol=1e-12)
    np.testing.assert_allclose(one.stance.position, other.stance.position, atol=1e-12)


def test_armatures_are_in_the_torques_and_the_nominal_robot_keeps_them(tmp_path: Path) -> None:
    config = of_mjcf(tmp_path, 0.05)
    simulation = set_up_simulation(config)
    plant = simulation.plant
    light = set_up_simulation(quadruped(MOTION)).plant
    np.testing.assert_allclose(plant.model.dof_armature[6:], 0.05)
    np.testing.assert_allclose(light.model.dof_armature[6:], 0.0)
    (tmp_path / "sim.yaml").write_text(dump_config(config))
    with forked_simulations():
        assert main(["simulate", str(tmp_path / "sim.yaml"), f"output={tmp_path / 'out'}"]) == 0
    nominal = load_robot(tmp_path / "out" / "nominal.xml")
    np.testing.assert_allclose(nominal.armature, 0.05)
    assert np.abs(nominal.nominal[:, 0] / ROBOT.nominal[:, 0] - 1.0).max() > 0.05
    robot, log = load_robot(tmp_path / "robot.xml"), read_log(tmp_path / "out" / "exact" / "squat.npz")
    contacts = [Contact(foot.frame, "point") for foot in config.feet]
    samples, builder = bind_log(log, robot, contacts), Evaluation(robot, contacts).builder
    measured, (predicted,) = force_series(builder, samples, robot.nominal.flatten()[None])
    joints = slice(robot.base_rows, None)
    assert np.abs(predicted - measured).max() < 1e-5 * np.abs(measured).max()
    assert np.abs(0.05 * log.joint_acceleration).max() > 1e-3 * np.abs(measured[:, joints]).max()


def test_springs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has a spring of stiffness 3; accepted: joints without springs"):
        set_up_simulation(of_mjcf(tmp_path, **{"joint ": '<joint stiffness="3" '}))


def test_the_wrong_key_and_two_files_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = of_mjcf(tmp_path)
    (tmp_path / "sim.yaml").write_text(dump_config(config))
    for change, message in (
        ([f"robot.mjcf={QUADRUPED}"], "robot.mjcf: '"),
        ([f"robot.urdf={QUADRUPED}"], "robot.urdf: set together with robot.mjcf"),
    ):
        assert main(["simulate", str(tmp_path / "sim.yaml"), f"output={tmp_path / 'out'}", *change]) == 2
        assert message in capsys.readouterr().err
