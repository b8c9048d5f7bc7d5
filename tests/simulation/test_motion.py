"""What a simulated robot is told to do: waves, steps, and the stance it starts from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from simulated import BIPED, SOLES, quadruped, robot_on, shipped, squat, stepping
from synthetic import Array

from torchid.config import FootConfig, MotionConfig, SimulationConfig
from torchid.config.simulation import WaveConfig
from torchid.errors import InputError, UnknownNameError
from torchid.simulation import LEAD_S, Simulation, set_up_simulation
from torchid.simulation.simulation import Setpoint

HZ = 500.0  # setpoints per second


@pytest.fixture(scope="module")
def biped() -> Simulation:
    return set_up_simulation(shipped(Path("nowhere")))


def setpoints(biped: Simulation, motion: MotionConfig) -> tuple[Array, list[Setpoint]]:
    found = biped.reference(motion)
    return found.time, list(found)


def wave(what: str, hz: float, amplitude: float, phase: float = 0.0) -> WaveConfig:
    return WaveConfig(what, hz, amplitude, phase)


# --------------------------------------------------------------------------------------------------------------- waves


def test_a_motion_starts_at_rest_in_the_stance_before_its_log(biped: Simulation) -> None:
    time, found = setpoints(biped, squat(0.05))
    assert time[0] == -LEAD_S
    assert len(found) == len(time) == round((LEAD_S + 2.0) * HZ)
    np.testing.assert_allclose(found[0].com[0], biped.stance.com, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found[0].joints[0], biped.stance.position[7:], rtol=0.0, atol=1e-12)
    assert np.abs(found[0].com[1:]).max() < 1e-3


def test_waves_are_sines_of_the_time_of_the_log_and_phases_are_in_turns(biped: Simulation) -> None:
    time, found = setpoints(biped, MotionConfig("m", 2.0, [wave("com_z", 0.7, 0.05, 0.2)]))
    after = time >= 0.0
    angle = 2 * np.pi * (0.7 * time + 0.2)
    moved = np.array([setpoint.com for setpoint in found]) - np.array([1, 0, 0])[:, None] * biped.stance.com
    rate = 2 * np.pi * 0.7
    expected = 0.05 * np.stack([np.sin(angle), rate * np.cos(angle), -(rate**2) * np.sin(angle)], axis=1)
    inside = slice(2, -2)  # differences are one-sided at the ends
    np.testing.assert_allclose(moved[after][inside, :, 2], expected[after][inside], rtol=0.0, atol=1e-4)
    np.testing.assert_array_equal(moved[..., :2], 0.0)


# --------------------------------------------------------------------------------------------------------------- steps


def heights_and_loads(biped: Simulation, motion: MotionConfig) -> tuple[Array, Array, Array]:
    time, found = setpoints(biped, motion)
    lift = np.array([setpoint.feet[:, 0, 2] - biped.stance.feet[:, 2] for setpoint in found])
    return time, lift, np.array([setpoint.load for setpoint in found])


def test_feet_are_lifted_in_turn_in_the_middle_of_their_part_of_the_period(biped: Simulation) -> None:
    time, lift, _ = heights_and_loads(biped, stepping("r_sole", "l_sole", swing_s=1.4, height_m=0.05))
    left, right = lift.T
    assert time[right.argmax()] == pytest.approx(1.5, abs=1.5 / HZ)
    assert time[left.argmax()] == pytest.approx(4.5, abs=1.5 / HZ)
    for foot in (left, right):
        assert foot.max() == pytest.approx(0.05, rel=1e-4)
        assert foot.min() == 0.0
        assert (foot > 0.0).sum() / HZ == pytest.approx(1.4, abs=3.0 / HZ)


# --------------------------------------------------------------------------------------------------------------- names


@pytest.mark.parametrize("what", ["com_w", "torso", "l_sole", ""])
def test_a_wave_of_something_the_robot_has_not_is_refused(biped: Simulation, what: str) -> None:
    with pytest.raises(UnknownNameError, match=r"motions.m.waves.1.what: unknown name"):
        biped.reference(MotionConfig("m", 1.0, [wave("com_x", 1.0, 0.0), wave(what, 1.0, 0.1)]))


def test_a_step_of_a_foot_the_robot_has_not_is_refused(biped: Simulation) -> None:
    with pytest.raises(UnknownNameError, match=r"motions.stepping.steps.order: .*'l_foot'; accepted: l_sole"):
        biped.reference(stepping("r_sole", "l_foot"))


# -------------------------------------------------------------------------------------------------------------- stance


@pytest.mark.parametrize("config", [shipped(Path("nowhere")), quadruped()], ids=["biped", "quadruped"])
def test_a_robot_stands_level_with_its_mass_above_the_middle_of_its_feet(config: SimulationConfig) -> None:
    simulation = set_up_simulation(config)
    plant, stance = simulation.plant, simulation.stance
    plant.place(stance.position)
    np.testing.assert_allclose(plant.base_rotation, np.eye(3), rtol=0.0, atol=1e-6)
    lowest, corners = [], []
    for i, foot in enumerate(simulation.feet):
        points = plant.feet_positions[i] + np.array(foot.points) @ plant.foot(i).rotation.T
        lowest.append(points[:, 2] - foot.radii)
        corners.append(points[:, :2].mean(axis=0))
    assert np.abs(np.concatenate(lowest)).max() < 1e-6  # every point of every foot touches the floor
    np.testing.assert_allclose(plant.com[:2], np.mean(corners, axis=0), rtol=0.0, atol=1e-6)


def test_a_posture_beyond_a_joints_range_is_refused() -> None:
    config = replace(shipped(Path("nowhere")), posture={"torso_pitch": 3.0})
    with pytest.raises(InputError, match=r"posture.torso_pitch: 3; accepted: -0.6 to 1.2"):
        set_up_simulation(config)


def test_a_wave_faster_than_half_the_control_rate_is_refused(biped: Simulation) -> None:
    with pytest.raises(InputError, match=r"motions.m.waves.0.hz: 499; accepted: below 250"):
        biped.reference(MotionConfig("m", 1.0, [wave("com_x", 499.0, 0.01)]))


def test_a_swing_longer_than_its_period_is_refused(biped: Simulation) -> None:
    with pytest.raises(InputError, match=r"motions.stepping.steps.swing_s: 3 s in the air and 2 x"):
        biped.reference(stepping("r_sole", "l_sole", hz=0.5, swing_s=3.0))


@pytest.mark.parametrize(
    ("posture", "found"),
    [
        ({"l_nee_flexion": 1.0}, "posture: unknown name 'l_nee_flexion'; accepted: l_knee_flexion"),
        ({"l_hip_flexion": -1.5}, "posture: l_sole is 86 deg off the horizontal"),
        ({"l_hip_abduction": 0.6, "r_hip_abduction": -0.6}, "posture: not near a stance .* \\(off by"),
    ],
    ids=["unknown joint", "sole upright", "legs spread"],
)
def test_a_posture_in_which_the_robot_does_not_nearly_stand_is_refused(posture: dict[str, float], found: str) -> None:
    with pytest.raises(InputError, match=found) as raised:
        set_up_simulation(robot_on(BIPED, [FootConfig(sole) for sole in SOLES], posture))
    assert "\n" not in str(raised.value)
