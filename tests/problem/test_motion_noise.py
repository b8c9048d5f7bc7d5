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
        (off.T @ off / len(off)).numpy() for off in (apart(noise.perturbed(clean, size), clean), apart(noisy, clean))
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
    up, down = noise.perturbed(samples, size), noise.perturbed(samples, -size)
    for name in FIELDS:
        a, b, middle = (getattr(x, name) for x in (up, down, samples))
        assert torch.allclose(a + b, 2.0 * middle, rtol=0.0, atol=1e-9)
    piece = noise.perturbed(samples[100:200], size[100:200])
    assert torch.equal(piece.joint_acceleration, up.joint_acceleration[100:200])
    assert torch.equal(piece.base.specific_force, up.base.specific_force[100:200])
    assert torch.equal(noise.perturbed(samples, 0.0 * size).joint_position, samples.joint_position)


def test_sides_look_random(robot: Robot) -> None:
    from torchid.problem.motion_noise import _sides

    sides = _sides(torch.from_numpy(TIME), 200)
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
    perturbed = noise.perturbed(samples, torch.ones(len(samples), 1, dtype=torch.float64))
    off = (perturbed.joint_position - samples.joint_position).std(0).numpy()
    assert off[0] / off[1] == pytest.approx(0.25, rel=0.1), "in the robot's order"
