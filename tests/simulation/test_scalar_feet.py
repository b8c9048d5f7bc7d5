"""Simulated feet that read the force along the floor's normal alone, from the simulation to identified parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from forked import forked_simulations
from motions import value
from refusals import refusal
from simulated import QUADRUPED, feet_of, quadruped
from synthetic import Array, load

from torchid import parameters
from torchid.cli import main
from torchid.config import MotionConfig, SensorImperfectionsConfig, SimulationConfig, dump_config
from torchid.config.simulation import WaveConfig, WhiteNoiseConfig
from torchid.estimators import LeastSquares
from torchid.logs import Log, read_log
from torchid.problem import RowBuilder, bind_log, compress, linear_problem
from torchid.sensing import Contact, chosen_sensors

WAVES = (
    *(("com_z", 1.0, 0.03), ("com_x", 0.7, 0.03), ("com_y", 0.9, 0.02)),
    *(("base_roll", 1.3, 0.1), ("base_pitch", 1.1, 0.1), ("base_yaw", 0.8, 0.15)),
)
NOISE = WhiteNoiseConfig(True, 1e-5, 1e-5, 1e-5, joint_torque=0.1, contact_force=0.5, contact_moment=0.1)
SCALAR = ("front_left_foot", "rear_right_foot")
"""The feet that read along the normal; the two others read a wrench."""


@dataclass(frozen=True)
class Walked:
    """What `torchid simulate` has written."""

    config: SimulationConfig

    @property
    def feet(self) -> tuple[str, ...]:
        return tuple(foot.frame for foot in self.config.feet)

    def log(self, kind: str, motion: str) -> Log:
        return read_log(self.config.output / kind / f"{motion}.npz")


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Walked:
    folder = tmp_path_factory.mktemp("scalar_feet")
    motions = [
        MotionConfig(name, seconds, [WaveConfig(what, speed * hz, size) for what, hz, size in WAVES])
        for name, seconds, speed in (("train", 4.0, 1.0), ("test", 1.5, 1.2))
    ]
    config = quadruped(*motions, sensors=SensorImperfectionsConfig(noise=NOISE, contact_threshold=3.0))
    feet = [replace(foot, sensor="fn" if foot.frame in SCALAR else "wrench") for foot in config.feet]
    config = replace(config, feet=feet, output=folder / "simulation")
    (folder / "simulation.yaml").write_text(dump_config(config))
    with forked_simulations():
        assert main(["simulate", str(folder / "simulation.yaml")]) == 0
    return Walked(config)


@pytest.mark.parametrize("torques", [False, True])
def test_exact_readings_give_the_parameters_back(walked: Walked, torques: bool) -> None:
    """All feet are read along the normal; joint torques have the soft floor's creep in them."""
    exact, robot = walked.log("exact", "train"), load(QUADRUPED)
    _, rotations = feet_of(exact, QUADRUPED)
    up = np.einsum("nfi,nfi->nf", rotations[:, :, 2], value(exact.contact_wrench_local)[..., :3])
    log = replace(exact, contact_wrench_local=None, contact_force_normal=up)
    contacts = [Contact(foot, "point", along_normal=True) for foot in walked.feet]
    joints = robot.joint_names if torques else ()
    true = robot.nominal.copy()
    true[:, parameters.FRICTION] = 0.0
    began = replace(robot, nominal=parameters.perturb_parameters(true, 0.2, np.random.default_rng(0)))
    sensors = chosen_sensors(robot.joint_names, contacts, joints, {foot: ["fn"] for foot in walked.feet})
    builder = RowBuilder(began, contacts, sensors)
    problem = linear_problem(compress([bind_log(log, began, contacts, sensors)], builder), builder, began, False)
    found = LeastSquares().solve(problem)

    def off(phi: Array) -> float:
        return float(np.linalg.norm(problem.A @ (phi.ravel() - true.ravel())))

    assert found.rank == (94 if torques else 28)
    assert off(found.phi) < (2e-3 if torques else 1e-10) * off(began.nominal)
    assert found.phi.reshape(true.shape)[:, 0].sum() == pytest.approx(true[:, 0].sum(), rel=1e-6 if torques else 1e-12)


def test_a_foot_has_one_of_two_sensors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = quadruped()
    (tmp_path / "sim.yaml").write_text(dump_config(config).replace("sensor: wrench", "sensor: fz", 1))
    message = refusal(["simulate", str(tmp_path / "sim.yaml"), f"output={tmp_path / 'out'}"], tmp_path, capsys)
    assert "feet.0.sensor: found 'fz'; accepted: 'wrench' or 'fn'" in message
