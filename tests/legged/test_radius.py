"""The radius of feet, which a URDF need not have, by what left-out blocks of a log say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from legged.gait import Reference
from legged.recording import Noise, record
from legged.robots import QUADRUPED, TrueRobot
from legged.simulate import simulated
from rich.progress import Progress

from torchid.commands.chosen_settings import with_chosen_settings
from torchid.config import load_config
from torchid.fitting.experiment import set_up
from torchid.fitting.factor_files import row_model, with_choices_of
from torchid.logs import write_log

SECONDS = 8.0
RADIUS_M = 0.025


def experiment(folder: Path) -> Path:
    """A file for the log in a folder."""
    text = f"""
robot: {{urdf: {QUADRUPED.urdf}}}
contacts: [{", ".join(f"{{frame: {foot}, type: point}}" for foot in QUADRUPED.feet)}]
logs: {{train: [{folder / "log.npz"}]}}
sensors: joints
preprocessing: {{cutoff_hz: 15}}
output: run
"""
    (folder / "experiment.yaml").write_text(text)
    return folder / "experiment.yaml"


@pytest.mark.slow("8 s of a walk in MuJoCo")
def test_the_radius_of_feet_is_found_where_they_are_balls(tmp_path: Path) -> None:
    """Feet of the demo's robot, whose URDF has no shape for them; the recorded ones are balls or points."""
    true = TrueRobot.unlike_its_urdf(replace(QUADRUPED, radius=RADIUS_M))
    exact = simulated(true, Reference(true, SECONDS, seed=0), SECONDS)
    write_log(record(exact, true.robot.base_link, Noise(), np.random.default_rng(0)), tmp_path / "log.npz")
    setup, choices = with_chosen_settings(set_up(load_config(experiment(tmp_path))), Progress(disable=True))
    assert choices.radius is not None
    assert choices.radius.value == pytest.approx(RADIUS_M, abs=2e-3)
    assert {contact.radius for contact in setup.contacts} == {choices.radius.value}
    assert {contact.radius for contact in setup.config.contacts} == {choices.radius.value}
    assert f"ball of radius {1e3 * choices.radius.value:.3g} mm, chosen from the logs" in setup.rolling
    model = row_model(setup, setup.builder(setup.sensors))  # what a file of factors keeps of it
    again = with_choices_of(model, set_up(load_config(experiment(tmp_path))))
    assert again.contacts == setup.contacts
    assert row_model(again, again.builder(again.sensors)).settings == model.settings


@pytest.mark.slow("2 s of a walk in MuJoCo")
def test_a_log_that_does_not_say_where_the_ground_is_keeps_points(tmp_path: Path) -> None:
    """Balls need the base's orientation, which an IMU alone does not give."""
    true = TrueRobot.unlike_its_urdf(QUADRUPED)
    exact = simulated(true, Reference(true, 2.0, seed=0), 2.0)
    log = record(exact, true.robot.base_link, Noise(), np.random.default_rng(0))
    write_log(replace(log, base_quat_xyzw=None, contact_wrench_world=None), tmp_path / "log.npz")
    setup, choices = with_chosen_settings(set_up(load_config(experiment(tmp_path))), Progress(disable=True))
    assert choices.radius is not None
    assert choices.radius.value is None
    assert {contact.radius for contact in setup.contacts} == {0.0}
