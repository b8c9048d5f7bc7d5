"""Bags of Unitree's LowState, as the robots send it, from the samples of a log."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from bags import ROS2, Entry, write_bag
from motions import value
from numpy.typing import NDArray
from rosbags.typesys import get_types_from_msg

from torchid.logs import Log
from torchid.logs.unitree import GO, MOTORS, register

register(ROS2, get_types_from_msg)
TOPIC = "/lowstate"
START = 1_700_000_000_000_000_000
LEGS = ("FR", "FL", "RR", "RL")
FEET = tuple(f"{leg}_foot" for leg in LEGS)
GO2 = tuple(f"{leg}_{joint}_joint" for leg in LEGS for joint in ("hip", "thigh", "calf"))


def float32(log: Log) -> Log:
    """The log with numbers that float32 holds exactly."""
    rounded = {
        name: x.astype(np.float32).astype(np.float64) for name, x in log.arrays().items() if x.dtype == np.float64
    }
    return replace(log, **{name: x for name, x in rounded.items() if name not in ("time", "contact_wrench_local")})


def moving(joints: Sequence[str], samples: int = 40, step: float = 0.002) -> Log:
    """A log in which every joint and the IMU read something, in numbers of float32."""
    rng = np.random.default_rng(len(joints))
    shape = (samples, len(joints))
    log = Log(
        "x",
        np.round(step * np.arange(samples), 9),
        tuple(joints),
        rng.standard_normal(shape),
        joint_velocity=rng.standard_normal(shape),
        joint_torque=10.0 * rng.standard_normal(shape),
        imu_frame="imu",
        imu_specific_force=rng.standard_normal((samples, 3)) + [0.0, 0.0, 9.8],
        imu_angular_velocity=rng.standard_normal((samples, 3)),
    )
    return float32(log)


def low_states(
    log: Log,
    order: Sequence[str | None],
    kind: str = GO,
    ticks: NDArray[np.int64] | None = None,
    feet: NDArray[np.int64] | None = None,
    late: NDArray[np.int64] | None = None,
    turns: NDArray[np.float64] | None = None,
    **fields: Any,
) -> Iterator[Entry]:
    """A message for each sample.

    Args:
        log: with velocities, torques and an IMU.
        order: its joints by number of the motor.
        kind: of the messages.
        ticks: (N,) [ms]; those of the log from a million on if not given.
        feet: (N, 4) readings of the foot sensors.
        turns: (N, 4) quaternions of the IMU, wxyz; all of no rotation if not given.
        late: (N,) [ns] that messages come late.
        fields: other content of all messages.
    """
    stamps = np.round(log.time * 1e9).astype(np.int64)
    ticks = stamps // 10**6 + 10**6 if ticks is None else ticks
    late = np.zeros(len(log), dtype=np.int64) if late is None else late
    columns = [None if name is None else log.joint_names.index(name) for name in order]
    columns += [None] * (MOTORS[kind] - len(columns))
    parts = {"q": log.joint_position, "dq": value(log.joint_velocity), "tau_est": value(log.joint_torque)}
    force, turn = value(log.imu_specific_force), value(log.imu_angular_velocity)
    for i in range(len(log)):
        motors = [
            {} if k is None else {"mode": 1, "ddq": 7.0} | {n: x[i, k] for n, x in parts.items()} for k in columns
        ]
        quaternion = np.array([1, 0, 0, 0]) if turns is None else turns[i]
        imu = {"quaternion": quaternion.astype(np.float32), "gyroscope": turn[i].astype(np.float32)}
        imu |= {"accelerometer": force[i].astype(np.float32)}
        content = {"motor_state": motors, "imu_state": imu, "tick": int(ticks[i]) % 2**32, **fields}
        if feet is not None:
            content["foot_force"] = feet[i].astype(np.int16)
        yield TOPIC, START + int(stamps[i] + late[i]), kind, content


def write_low_states(path: Path, log: Log, order: Sequence[str | None], kind: str = GO, **options: Any) -> Path:
    """A bag of `low_states`."""
    path.unlink(missing_ok=True)
    return write_bag(path, low_states(log, order, kind, **options))
