"""A robot driven by the torques of a log, against motion whose torques Pinocchio has worked out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from refusals import refused
from repository import DEMO
from scipy.spatial.transform import Rotation

from torchid.errors import InputError, LogError
from torchid.simulation.plant import point_foot
from torchid.simulation.replay import Model, ReplayedLog, replay_log

RATE, SECONDS = 1000.0, 1.2
TIMES = np.array([0.1, 0.2])
ARM = """<robot name="arm"><link name="base"/>
<link name="a"><inertial><mass value="1.2"/><origin xyz="0.1 0.02 0" rpy="0.3 0 0.2"/><inertia ixx="0.01" iyy="0.02"
izz="0.025" ixy="0.001" ixz="0" iyz="0.002"/></inertial></link><joint name="first" type="revolute"><parent link="base"/>
<child link="a"/><origin xyz="0 0 0.2" rpy="0.4 0 0"/><axis xyz="0 1 0"/><dynamics damping="0.3"/>
<limit lower="-9" upper="9" effort="9" velocity="9"/></joint>
<link name="b"><inertial><mass value="{mass}"/><origin xyz="0 0.15 0.03"/><inertia ixx="0.02" iyy="0.01" izz="0.02"
ixy="0" ixz="0.001" iyz="0"/></inertial></link><joint name="second" type="revolute"><parent link="a"/><child link="b"/>
<origin xyz="0.25 0 0"/><axis xyz="1 0 0"/><dynamics damping="0.1"/>
<limit lower="-9" upper="9" effort="9" velocity="9"/></joint></robot>"""


def arm(folder: Path, mass: float = 0.8) -> Path:
    path = folder / f"arm_{mass}.urdf"
    path.write_text(ARM.format(mass=mass))
    return path


def model_of(urdf: Path, armature: float = 0.0, offset: float = 0.0, stiffness: float = 0.0) -> Model:
    springs = np.array([stiffness, 0.5 * stiffness])
    return Model(urdf, ("first", "second"), np.full(2, armature), np.array([offset, -0.5 * offset]), springs)


def swinging(urdf: Path, armature: float = 0.0, tilt: Rotation | None = None) -> ReplayedLog:
    """Sines of the joints with the torques that they take, by Pinocchio, on a base turned by `tilt`."""
    robot = pin.buildModelFromUrdf(str(urdf))
    robot.armature[:] = armature
    if tilt is not None:
        robot.gravity.linear = tilt.inv().apply([0.0, 0.0, -9.81])
    data, time = robot.createData(), np.arange(0.0, SECONDS, 1.0 / RATE)
    phase, speed = np.array([0.3, 1.1]), 2.0 * np.pi * np.array([1.3, 0.9])
    angle = np.outer(time, speed) + phase
    q, v, a = 0.6 * np.sin(angle), 0.6 * speed * np.cos(angle), -0.6 * speed**2 * np.sin(angle)
    torque = np.array([pin.rnea(robot, data, *x) for x in zip(q, v, a, strict=True)]) + v * [0.3, 0.1]
    quat = None if tilt is None else np.tile(tilt.as_quat(), (len(time), 1))
    return ReplayedLog("swing", time, q, v, torque, quat, None, np.zeros((len(time), 0), dtype=bool))


def drift(model: Model, log: ReplayedLog) -> float:
    """The largest of all joints after `TIMES` [rad]."""
    return float(np.abs(replay_log(model, log, (), log.windows(TIMES[-1]), TIMES).joints).max())


def test_the_true_arm_follows_its_log_and_another_one_does_not(tmp_path: Path) -> None:
    true = arm(tmp_path)
    log = swinging(true)
    assert drift(model_of(true), log) < 2e-5
    assert drift(model_of(arm(tmp_path, mass=0.9)), log) > 1e-2


def test_armature_and_offsets_are_those_of_the_log(tmp_path: Path) -> None:
    true = arm(tmp_path)
    log = swinging(true, armature=0.05)
    off = replace(log, torque=log.torque + [0.7, -0.35])
    assert drift(model_of(true, armature=0.05), log) < 2e-5
    assert drift(model_of(true), log) > 1e-2
    assert drift(model_of(true, armature=0.05, offset=0.7), off) < 2e-5
    assert drift(model_of(true, armature=0.05, offset=-0.7), off) > 1e-2


def test_pd_targets_hold_a_wrong_arm_near_its_log_as_that_law_would(tmp_path: Path) -> None:
    true, heavy = arm(tmp_path), arm(tmp_path, mass=0.9)
    log, gains = swinging(true), np.array([[40.0, 20.0], [2.0, 1.0]])

    def end(model: Model, **driven: np.ndarray) -> np.ndarray:
        return replay_log(model, log, (), log.windows(TIMES[-1]), TIMES, **driven).joints

    assert np.abs(end(model_of(true), gains=gains)).max() < 2e-5
    held, free = (np.abs(x).max() for x in (end(model_of(heavy), gains=gains), end(model_of(heavy))))
    assert 1e-4 < held < 0.3 * free
    np.testing.assert_array_equal(end(model_of(heavy)), end(model_of(heavy), gains=np.zeros((2, 2))))


def test_a_base_of_equal_feet_falls_straight_where_nothing_drives_the_legs() -> None:
    """The demo's quadruped begins on the floor: at once its feet are still, so that its base does not turn."""
    joints = tuple(
        f"{end}_{side}_{part}"
        for end in ("front", "rear")
        for side in ("left", "right")
        for part in ("hip", "thigh", "knee")
    )
    feet = tuple(point_foot(f"{end}_{side}_foot", 0.02) for end in ("front", "rear") for side in ("left", "right"))
    time = np.arange(0.0, 0.3, 0.002)
    many = (len(time), 1)
    log = ReplayedLog(
        source="still",
        time=time,
        position=np.tile(np.array([0.0, 0.7, -1.4] * 4), many),
        velocity=np.zeros((len(time), 12)),
        torque=np.zeros((len(time), 12)),
        quat_xyzw=np.tile([0.0, 0.0, 0.0, 1.0], many),
        angular_velocity=np.zeros((len(time), 3)),
        active=np.ones((len(time), 4), dtype=bool),
    )
    model = Model(DEMO / "quadruped.urdf", joints, *np.zeros((3, 12)))
    found = replay_log(model, log, feet, log.windows(0.1), np.array([0.02, 0.1]))
    assert found.tilt is not None
    knees = found.joints[0, :, 2::3]
    assert np.abs(knees[1]).min() > 0.05  # it sags,
    assert found.tilt[0, 0] < 0.01  # and at first without turning over
    moving = replace(log, angular_velocity=np.tile([0.0, 1.0, 0.0], many))
    assert replay_log(model, moving, feet, log.windows(0.1), np.array([0.02])).tilt[0, 0] == pytest.approx(
        0.02, rel=0.3
    )


@pytest.mark.parametrize(("length", "windows"), [(0.2, 5), (0.3, 3)])
def test_windows_follow_each_other_and_none_has_a_gap(tmp_path: Path, length: float, windows: int) -> None:
    log = swinging(arm(tmp_path))
    whole = log.windows(length)
    assert np.all(whole[1:, 0] == whole[:-1, 1])
    np.testing.assert_allclose(log.time[whole[:, 1]] - log.time[whole[:, 0]], length, atol=0.51 / RATE)
    cut = replace(log, time=np.where(log.time > 0.5, log.time + 0.1, log.time))
    assert len(cut.windows(length)) == windows
    assert not any(cut.time[begin] < 0.55 < cut.time[end] for begin, end in cut.windows(length))


def test_what_cannot_be_replayed_is_named(tmp_path: Path) -> None:
    true = arm(tmp_path)
    log = swinging(true)
    assert "no window of 2 s without a gap" in refused(lambda: log.windows(2.0), "swing", LogError)
    assert "2 sampling intervals" in refused(lambda: log.windows(1e-4), "swing", LogError)
    airborne = replace(log, angular_velocity=np.zeros((len(log.time), 3)))
    assert "with standing feet" in refused(lambda: airborne.windows(0.1), "swing", LogError)
    negative = model_of(true, armature=-0.01)
    assert "armature of first" in refused(
        lambda: replay_log(negative, log, (), log.windows(0.2), TIMES), str(tmp_path), InputError
    )


def test_springs_of_joints_pull_towards_position_zero(tmp_path: Path) -> None:
    true = arm(tmp_path)
    log = swinging(true)
    held = replace(log, torque=log.torque + log.position * [3.0, 1.5])
    assert drift(model_of(true, stiffness=3.0), held) < 2e-5
    assert drift(model_of(true), held) > 1e-2
    assert drift(model_of(true, stiffness=-3.0), replace(log, torque=log.torque - log.position * [3.0, 1.5])) < 2e-5


def test_an_arm_on_a_turned_base_feels_gravity_as_the_log_says(tmp_path: Path) -> None:
    true, tilt = arm(tmp_path), Rotation.from_euler("xyz", [0.4, -0.8, 0.3])
    log = swinging(true, tilt=tilt)
    assert drift(model_of(true), log) < 2e-5
    assert drift(model_of(true), replace(log, quat_xyzw=None)) > 1e-2


def test_friction_that_drops_with_speed_is_that_of_the_log(tmp_path: Path) -> None:
    """For a joint that swings, but for what MuJoCo's soft constraint creeps where it turns."""
    true = arm(tmp_path)
    log = swinging(true)
    at_rest, velocity = np.array([0.5, 0.2]), 2.0
    dry = np.sign(log.velocity) * at_rest * np.exp(-np.square(log.velocity / velocity))
    log = replace(log, torque=log.torque + dry)
    with_it, without = replace(model_of(true), stribeck=at_rest, stribeck_velocity=velocity), model_of(true)
    assert drift(with_it, log) < 2.5e-3
    assert drift(without, log) > 3e-2
