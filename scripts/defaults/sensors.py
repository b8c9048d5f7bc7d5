"""What an engineer's log has of what happened: noise, steps, gains, offsets, delays, a structure that rings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import butter, lfilter, sosfilt, sosfiltfilt
from scipy.spatial.transform import Rotation

from torchid.logs import Log
from torchid.parameters import Array

_GRAVITY = np.array([0.0, 0.0, -9.81])
RINGING = {"none": 0.0, "mild": 0.25, "strong": 1.0}
"""Accelerations of the structure that rings, as shares of those of the joints below 10 Hz, rms."""
_MOTION_HZ = 10.0


@dataclass(frozen=True)
class Flaws:
    """Ranges and sizes of what is wrong with a log.

    Attributes:
        gain: standard deviation of the torques' gains from 1.
        torque_noise: standard deviation, of a joint's torque, as a share of its rms.
        offset: of each torque, constant, up to this share of its rms.
        delay: torques are stamped this much before they act, ranges [s].
        ringing: a key of `RINGING`, and the band of the modes [Hz].
        encoder: step of positions [rad]; noise is half as much.
        velocity: noise of the recorded velocities [rad/s]; None: none are recorded.
        lag: of the recorded velocities' filter [s].
        angular_velocity, specific_force: noise of the IMU.
        tilt: error of the orientation [rad].
    """

    gain: float = 0.02
    torque_noise: float = 0.02
    offset: float = 0.0
    delay: tuple[float, float] = (0.0, 0.0)
    ringing: str = "none"
    band: tuple[float, float] = (15.0, 60.0)
    encoder: float = 1e-4
    velocity: float | None = 0.01
    lag: float = 0.0
    angular_velocity: float = 0.008
    specific_force: float = 0.06
    tilt: float = 2e-3


@dataclass(frozen=True)
class Drawn:
    """Flaws that both logs of a robot share, by joint (n,): gains, offsets [N m], modes; and the delay [s].

    `mode`: frequencies [Hz], damping ratios, sizes of accelerations [rad/s^2], and torques over these [kg m^2].
    """

    gain: Array
    offset: Array
    delay: float
    mode: Array

    @classmethod
    def of(cls, flaws: Flaws, log: Log, inertia: Array, rng: np.random.Generator) -> Drawn:
        """Draw them for a robot whose log has torques and accelerations of such sizes."""
        torque, acceleration = log.joint_torque, log.joint_acceleration
        assert torque is not None
        assert acceleration is not None
        n = torque.shape[1]
        low_pass = butter(2, 2.0 * _MOTION_HZ * (log.time[1] - log.time[0]), output="sos")
        moved = np.sqrt(np.mean(sosfiltfilt(low_pass, acceleration, axis=0) ** 2, axis=0))
        size = RINGING[flaws.ringing] * rng.uniform(0.6, 1.4, n) * moved
        ratio = inertia * rng.uniform(0.3, 2.0, n) * rng.choice([-1.0, 1.0], n)
        mode = np.stack([rng.uniform(*flaws.band, n), rng.uniform(0.01, 0.05, n), size, ratio])
        return cls(
            gain=np.ones(n) + flaws.gain * rng.normal(size=n),
            offset=flaws.offset * rng.uniform(-1.0, 1.0, n) * np.sqrt(np.mean(torque**2, axis=0)),
            delay=float(rng.uniform(*flaws.delay)),
            mode=mode,
        )

    def readings(self, torque: Array) -> Array:
        """Torques (N, n) as sensors without noise, delay or ringing read them."""
        return self.gain * torque + self.offset

    def ringing(self, torque: Array, step: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
        """Positions, velocities (N, n) and torques that ring, struck by changes of torque and by gears."""
        strokes = np.gradient(torque, step, axis=0)
        strokes = strokes / np.maximum(strokes.std(axis=0), 1e-9) + rng.normal(size=torque.shape)
        out = np.zeros((3, *torque.shape))
        for j, (hz, damping, size, ratio) in enumerate(self.mode.T):
            pole = np.exp((-damping + 1j * np.sqrt(1.0 - damping**2)) * 2.0 * np.pi * hz * step)
            shape = [1.0, -2.0 * pole.real, abs(pole) ** 2]
            fast = sosfilt(butter(2, 2.0 * hz * step / 3.0, "high", output="sos"), strokes[:, j])
            place = lfilter([0.0, 1.0], shape, fast)  # it rings, but does not yield to slow forces
            place *= size / (place.std() * (2.0 * np.pi * hz) ** 2)
            out[:, :, j] = place, np.gradient(place, step), ratio * (2.0 * np.pi * hz) ** 2 * place
        return out[0], out[1], out[2]


def record(
    log: Log, flaws: Flaws, drawn: Drawn, rate: float, imu: tuple[str, Array] | None, rng: np.random.Generator
) -> dict[str, Array]:
    """Columns of a table, at a rate that divides that of the log; `imu`: its frame and the frame's pose in the base."""
    q, v, torque = log.joint_position, log.joint_velocity, log.joint_torque
    assert q is not None
    assert v is not None
    assert torque is not None
    step = float(log.time[1] - log.time[0])
    shaken, shaking, rung = drawn.ringing(torque, step, rng)
    ahead = np.stack([np.interp(log.time + drawn.delay, log.time, x) for x in drawn.readings(torque).T], axis=1)
    if flaws.lag > 0.0:
        share = 1.0 - np.exp(-step / flaws.lag)
        v = lfilter([share], [1.0, share - 1.0], v, axis=0)
    keep = slice(round(0.02 / step), len(q) - round(0.02 / step), round(1.0 / (rate * step)))
    sampled = [x[keep] for x in (q + shaken, v + shaking, ahead + rung)]
    noise = flaws.torque_noise * np.sqrt(np.mean(torque**2, axis=0))
    position = sampled[0] + 0.5 * flaws.encoder * rng.normal(size=sampled[0].shape)
    position = flaws.encoder * np.round(position / flaws.encoder)
    columns = {"time": log.time[keep] - log.time[keep][0]}
    columns |= _named("q", log.joint_names, position)
    if flaws.velocity is not None:
        columns |= _named("dq", log.joint_names, sampled[1] + flaws.velocity * rng.normal(size=sampled[1].shape))
    columns |= _named("tau", log.joint_names, sampled[2] + noise * rng.normal(size=sampled[2].shape))
    if imu is not None:
        columns |= _base(log, flaws, imu[1], keep, rng)
        assert log.contact_active is not None
        columns |= _named("contact", log.contact_names, log.contact_active[keep].astype(float))
    return columns


def _named(prefix: str, names: Sequence[str], values: Array) -> dict[str, Array]:
    return {f"{prefix}_{name}": values[:, k] for k, name in enumerate(names)}


def _base(log: Log, flaws: Flaws, pose: Array, keep: slice, rng: np.random.Generator) -> dict[str, Array]:
    """Orientation of the base, and an IMU in a frame of it."""
    assert log.base_quat_xyzw is not None
    assert log.base_linear_acceleration_world is not None
    assert log.base_angular_velocity_base is not None
    assert log.base_angular_acceleration_base is not None
    turn, place = pose[:3, :3], pose[:3, 3]
    world = Rotation.from_quat(log.base_quat_xyzw[keep])
    omega, alpha = log.base_angular_velocity_base[keep], log.base_angular_acceleration_base[keep]
    force = world.inv().apply(log.base_linear_acceleration_world[keep] - _GRAVITY)
    force = (force + np.cross(alpha, place) + np.cross(omega, np.cross(omega, place))) @ turn
    bias = rng.normal(size=3) * [0.5, 0.5, 0.0] * flaws.tilt
    slow = Rotation.from_rotvec(bias + 0.3 * flaws.tilt * rng.normal(size=(len(force), 3)))
    quat = (slow * world).as_quat()
    quat *= np.sign(np.cumprod(np.sign(np.sum(quat * np.roll(quat, 1, axis=0), axis=1, keepdims=True)), axis=0))
    columns = dict(zip(("quat_x", "quat_y", "quat_z", "quat_w"), quat.T, strict=True))
    gyro = omega @ turn + flaws.angular_velocity * rng.normal(size=force.shape)
    acceleration = force + flaws.specific_force * rng.normal(size=force.shape) + 0.02 * rng.normal(size=3)
    columns |= dict(zip(("gyro_x", "gyro_y", "gyro_z"), gyro.T, strict=True))
    return columns | dict(zip(("acc_x", "acc_y", "acc_z"), acceleration.T, strict=True))


def write_table(path: Path, columns: dict[str, Array]) -> None:
    """A CSV with six digits behind the point, as recorders write."""
    header, values = ",".join(columns), np.column_stack(list(columns.values()))
    flags = {name for name in columns if name.startswith("contact_")}
    formats = ["%d" if name in flags else "%.6f" if name.startswith(("time", "q")) else "%.5f" for name in columns]
    np.savetxt(path, values, formats, ",", header=header, comments="")
