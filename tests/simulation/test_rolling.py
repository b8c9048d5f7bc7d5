"""A simulated quadruped on balls: it rolls, a fit that knows of the balls is exact, one on their centres is not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from lxml import etree
from motions import value
from simulated import QUADRUPED, feet_of, quadruped
from synthetic import Array, load

from torchid import parameters
from torchid.config import FootConfig, MotionConfig
from torchid.config.robot import ContactConfig
from torchid.config.simulation import SimulatedRobotConfig, WaveConfig
from torchid.estimators import LeastSquares
from torchid.fitting.experiment import resolve_contacts
from torchid.logs import Log
from torchid.problem import RowBuilder, bind_log, compress, linear_problem
from torchid.problem.base_pose import rolled_distance
from torchid.robot import Robot
from torchid.sensing import Contact, named_sensors
from torchid.simulation import Stability, set_up_simulation

RADIUS = 0.03
UP = np.array([0.0, 0.0, 1.0])
WAVES = (
    *(("com_z", 1.0, 0.03), ("com_x", 0.7, 0.03), ("com_y", 0.9, 0.02)),
    *(("base_roll", 1.3, 0.1), ("base_pitch", 1.1, 0.1), ("base_yaw", 0.8, 0.15)),
)


@dataclass(frozen=True)
class OnBalls:
    """The robot, the exact log of a sway, and how it stood."""

    robot: Robot
    log: Log
    stability: Stability


@pytest.fixture(scope="module")
def on_balls(tmp_path_factory: pytest.TempPathFactory) -> OnBalls:
    standing = quadruped(MotionConfig("sway", 3.0, [WaveConfig(*wave) for wave in WAVES]))
    document = etree.parse(str(QUADRUPED))
    for foot in standing.feet:
        (link,) = document.findall(f"link[@name='{foot.frame}']")
        etree.SubElement(
            etree.SubElement(etree.SubElement(link, "collision"), "geometry"), "sphere", radius=str(RADIUS)
        )
    urdf = tmp_path_factory.mktemp("balls") / "balls.urdf"
    document.write(str(urdf))
    feet = [FootConfig(foot.frame) for foot in standing.feet]
    config = replace(standing, robot=SimulatedRobotConfig(urdf), feet=feet)
    recording, stability = set_up_simulation(config).run(config.motions[0])
    return OnBalls(load(urdf), recording.log, stability)


def contacts_of(log: Log, radius: float) -> list[Contact]:
    return [Contact(frame, "point", radius=radius) for frame in log.contact_names]


def test_what_is_on_the_floor_stays_while_the_centres_move(on_balls: OnBalls) -> None:
    log = on_balls.log
    positions, rotations = feet_of(log, on_balls.robot.path)
    step = np.diff(log.time)[:, None]
    for foot in range(len(log.contact_names)):
        stands = value(log.contact_wrench_local)[:, foot]
        loaded = np.linalg.norm(stands[:, :3], axis=1) > 20.0
        centre = np.diff(positions[:, foot], axis=0) / step
        rolling = np.diff(rolled_distance(rotations[:, foot], RADIUS, UP), axis=0) / step
        both = loaded[1:] & loaded[:-1]
        rms = [float(np.sqrt(np.square(x[both, :2]).sum(axis=1).mean())) for x in (centre, centre - rolling)]
        assert rms[0] > 5e-3
        assert rms[1] < 0.1 * rms[0]
    assert on_balls.stability.slip < 2e-3


def test_the_floor_acts_below_the_centre(on_balls: OnBalls) -> None:
    """Its moment about the centre, in the world, is that of a force at -radius."""
    log = on_balls.log
    _, rotations = feet_of(log, on_balls.robot.path)
    force, moment = (
        (rotations @ part[..., None])[..., 0] for part in np.split(value(log.contact_wrench_local), 2, axis=2)
    )
    loaded = np.linalg.norm(force, axis=2) > 20.0
    expected = np.cross([0.0, 0.0, -RADIUS], force)
    off = np.linalg.norm((moment - expected)[loaded], axis=1) / np.linalg.norm(expected[loaded], axis=1).max()
    assert off.max() < 0.1  # torsional friction and the softness of the floor
    assert np.median(off) < 0.01


def prediction_error(on_balls: OnBalls, sensors: str, radius: float) -> float:
    """Error of a fit's rows over that of the parameters it began with, in the rows of the true contacts."""
    robot, log = on_balls.robot, on_balls.log
    true = robot.nominal.copy()
    true[:, parameters.FRICTION] = 0.0
    began = replace(robot, nominal=parameters.perturb_parameters(true, 0.2, np.random.default_rng(0)))

    def problem(r: float) -> tuple[Array, Array]:
        contacts = contacts_of(log, r)
        builder = RowBuilder(began, contacts, named_sensors(sensors, robot.n, len(contacts)))
        posed = linear_problem(compress([bind_log(log, began, contacts)[::4]], builder), builder, began, friction=False)
        return posed.A, LeastSquares(ridge=0.0).solve(posed).phi.flatten()

    A, phi = problem(RADIUS)[0], problem(radius)[1]
    found, nominal = (np.linalg.norm(A @ (x - true.flatten())) for x in (phi, began.nominal.flatten()))
    return float(found / nominal)


@pytest.mark.parametrize("sensors", ["full", "contacts", "joints"])
def test_a_fit_of_balls_is_exact_and_one_of_their_centres_is_not(on_balls: OnBalls, sensors: str) -> None:
    exact, of_centres = (prediction_error(on_balls, sensors, radius) for radius in (RADIUS, 0.0))
    assert exact < 0.005
    assert of_centres > 0.2


def test_the_radius_is_found_in_the_urdf(on_balls: OnBalls) -> None:
    contacts, text = resolve_contacts(
        [ContactConfig(frame, "point") for frame in on_balls.log.contact_names], on_balls.robot
    )
    assert {contact.radius for contact in contacts} == {RADIUS}
    assert text == f"{', '.join(on_balls.log.contact_names)}: ball of radius 30 mm, from the collision sphere"
