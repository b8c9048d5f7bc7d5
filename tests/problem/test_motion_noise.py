"""Noise of the motion of bound samples, against that of samples of noisy logs."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from arms import ARMS
from scipy.spatial.transform import Rotation
from torch import Tensor

import torchid
from torchid.errors import TorchidWarning
from torchid.logs import Log
from torchid.logs.preprocess import preprocess
from torchid.problem import Samples, bind_log
from torchid.problem.motion import MIN_MOTION, MIN_TURN_DEG, MotionNoise
from torchid.problem.samples import is_at_rest
from torchid.robot import Robot

RATE, COUNT = 500.0, 20_000
TIME = np.arange(COUNT) / RATE
ENCODERS, GYRO, ACCELEROMETER, TILT = np.array([2e-3, 5e-4]), [0.01, 0.02, 0.005], [0.05, 0.1, 0.02], 3e-3


def recorded(kind: str, noise: float, seed: int = 0) -> Log:
    """A swinging robot by an IMU, or by the pose of its base; joints in another order than the robot's."""
    rng = np.random.default_rng(seed)

    def read(values: np.ndarray, deviation: object) -> np.ndarray:
        return values + noise * np.asarray(deviation) * rng.normal(size=values.shape)

    swing = 0.3 * np.sin(2.0 * np.pi * TIME[:, None] * [0.5, 0.8, 1.1] + [0.0, 1.0, 2.0])
    turn = Rotation.from_rotvec(swing) * Rotation.from_rotvec(noise * TILT * rng.normal(size=(COUNT, 3)))
    log = Log("swing.npz", TIME, ("second", "first"), read(swing[:, :2], ENCODERS), base_quat_xyzw=turn.as_quat())
    if kind == "pose":
        return replace(log, base_position_world=read(0.1 * swing[:, ::-1], 1e-3))
    force = 9.0 + swing
    return replace(
        log,
        imu_frame="imu",
        imu_angular_velocity=read(swing, GYRO),
        imu_specific_force=read(force, ACCELEROMETER),
    )


def bound(kind: str, noise: float, robot: Robot) -> Samples:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        return bind_log(preprocess(recorded(kind, noise), 20.0), robot, [])


def apart(one: Samples, other: Samples) -> Tensor:
    """What two motions differ by, (B, 3 n + 12), in the order of `MotionNoise`."""
    joints = [getattr(one, name) - getattr(other, name) for name in FIELDS]
    base = [
        getattr(one.base, name) - getattr(other.base, name) for name in ("angular_velocity", "angular_acceleration")
    ]
    turn = Rotation.from_quat(other.base.quat_xyzw).inv() * Rotation.from_quat(one.base.quat_xyzw)
    force = one.base.specific_force - other.base.specific_force
    return torch.cat([*joints, torch.from_numpy(turn.as_rotvec()), *base, force], dim=1)


FIELDS = ("joint_position", "joint_velocity", "joint_acceleration")


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    path: Path = tmp_path_factory.mktemp("robot") / "arms.urdf"
    path.write_text(ARMS)
    return torchid.load_robot(path)


@pytest.mark.parametrize("kind", ["imu", "pose"])
def test_samples_with_more_noise_are_off_as_much_as_those_of_noisy_logs(kind: str, robot: Robot) -> None:
    noisy, clean = bound(kind, 1.0, robot), bound(kind, 0.0, robot)
    assert clean.motion_noise is None
    noise = noisy.motion_noise
    assert noise is not None
    assert noise.turns_force is (kind == "pose")
    size = torch.ones(len(clean), 1, dtype=torch.float64)
    found, expected = (
        (off.T @ off / len(off)).numpy() for off in (apart(clean.perturbed(noise, size), clean), apart(noisy, clean))
    )
    deviation = np.sqrt(np.diag(expected))
    assert (deviation > 0.0).all()
    np.testing.assert_allclose(np.sqrt(np.diag(found)) / deviation, 1.0, atol=0.08)
    np.testing.assert_allclose(
        found / np.outer(deviation, deviation), expected / np.outer(deviation, deviation), atol=0.15
    )


def test_pairs_are_opposite_and_a_piece_gets_what_the_whole_gets(robot: Robot) -> None:
    samples = bound("imu", 1.0, robot)
    noise = samples.motion_noise
    assert noise is not None
    size = torch.ones(len(samples), 1, dtype=torch.float64)
    up, down = samples.perturbed(noise, size), samples.perturbed(noise, -size)
    for name in FIELDS:
        a, b, middle = (getattr(x, name) for x in (up, down, samples))
        assert torch.allclose(a + b, 2.0 * middle, rtol=0.0, atol=1e-9)
    piece = samples[100:200].perturbed(noise, size[100:200])
    assert torch.equal(piece.joint_acceleration, up.joint_acceleration[100:200])
    assert torch.equal(piece.base.specific_force, up.base.specific_force[100:200])
    assert torch.equal(samples.perturbed(noise, 0.0 * size).joint_position, samples.joint_position)


def test_an_orientation_that_is_off_turns_what_came_from_the_world_and_no_reading_of_an_imu(robot: Robot) -> None:
    """The specific force in the world stays as it is, up to third order of the angle."""
    size, angle = torch.ones(COUNT, 1, dtype=torch.float64), 0.01
    base = torch.zeros(12, 12, dtype=torch.float64)
    base[:3, :3] = angle * torch.eye(3, dtype=torch.float64)
    for kind in ("pose", "imu"):
        samples = bound(kind, 0.0, robot)[:200]
        noise = MotionNoise(torch.zeros(robot.n, 3, 3, dtype=torch.float64), base, turns_force=kind == "pose")
        found = samples.perturbed(noise, size[:200])
        before, after = (Rotation.from_quat(x.base.quat_xyzw) for x in (samples, found))
        np.testing.assert_allclose(np.abs((before.inv() * after).as_rotvec()), angle, rtol=0.0, atol=angle**3)
        force, moved = samples.base.specific_force.numpy(), found.base.specific_force.numpy()
        if kind == "imu":
            np.testing.assert_array_equal(moved, force)
        else:
            third = (np.sqrt(3.0) * angle) ** 3 * np.linalg.norm(force, axis=1).max()
            np.testing.assert_allclose(after.apply(moved), before.apply(force), rtol=0.0, atol=0.5 * third)


def test_a_robot_is_at_rest_unless_a_joint_travels_or_its_base_turns_or_is_shaken(robot: Robot) -> None:
    """An accelerometer at rest reads gravity, whatever its direction."""
    samples = bound("imu", 0.0, robot)[:100]
    swing = torch.linspace(-1.0, 1.0, 100, dtype=torch.float64)[:, None]
    side = torch.where(torch.arange(100) % 2 == 0, 1.0, -1.0).double()[:, None] * torch.tensor([0.6, 0.0, 0.8])

    def log(travel: float = 0.0, turn_deg: float = 0.0, shake: float = 0.0) -> Samples:
        turned = Rotation.from_rotvec([0.3, 0.2, 0.1]) * Rotation.from_rotvec(
            np.radians(turn_deg) * 0.5 * swing.numpy() * [[0.0, 1.0, 0.0]]
        )
        force = torch.tensor([5.0, -3.0, 8.0], dtype=torch.float64) + shake * side
        moved = replace(samples.base, quat_xyzw=torch.from_numpy(turned.as_quat()), specific_force=force)
        return replace(samples, joint_position=0.7 + 0.5 * travel * swing * torch.tensor([0.0, 1.0]), base=moved)

    rests = [log(), log(travel=0.9 * MIN_MOTION), log(turn_deg=0.9 * MIN_TURN_DEG), log(shake=0.09 * 9.81)]
    assert is_at_rest(rests)
    for moves in (log(travel=1.1 * MIN_MOTION), log(turn_deg=1.1 * MIN_TURN_DEG), log(shake=0.11 * 9.81)):
        assert not is_at_rest([*rests, moves])
    assert not is_at_rest([]), "nothing is known then"


def test_sides_look_random(robot: Robot) -> None:
    from torchid.problem.motion import random_sides

    sides = random_sides(torch.from_numpy(TIME), 200)
    assert set(sides.unique().tolist()) == {-1.0, 1.0}
    correlation = (sides.T @ sides / len(sides)).numpy()
    assert np.abs(correlation - np.eye(200)).max() < 6.0 / np.sqrt(COUNT)
    assert np.abs(sides.mean(0).numpy()).max() < 5.0 / np.sqrt(COUNT)
    assert np.abs((sides[1:] * sides[:-1]).mean(0).numpy()).max() < 5.0 / np.sqrt(COUNT), "neighbours in time"


def test_a_bolted_base_has_noise_of_joints_alone(robot: Robot, tmp_path: Path) -> None:
    path = tmp_path / "bolted.urdf"
    path.write_text(ARMS)
    fixed = torchid.load_robot(path, fixed_base=True)
    log = replace(recorded("pose", 1.0), base_quat_xyzw=None, base_position_world=None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        samples = bind_log(preprocess(log, 20.0), fixed, [])
    noise = samples.motion_noise
    assert noise is not None
    assert not noise.base.any()
    perturbed = samples.perturbed(noise, torch.ones(len(samples), 1, dtype=torch.float64))
    off = (perturbed.joint_position - samples.joint_position).std(0).numpy()
    assert off[0] / off[1] == pytest.approx(0.25, rel=0.1), "in the robot's order"
