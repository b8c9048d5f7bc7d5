"""Motions of many robots as laboratories record them: bags, tables and arrays with names and units of their own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pinocchio as pin
import pyarrow as pa
import pyarrow.parquet as pq
from bags import FLAG, IMU, JOINT_STATE, ODOMETRY, Entry, imu, joint_state, odometry, write_bag
from dialects import save_csv, struct
from low_states import FEET, GO2
from motions import value
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from torchid.logs import Log
from torchid.logs.log import FloatArray
from torchid.logs.unitree import JOINT_ORDERS, MOTORS
from torchid.robot import Robot

Array = NDArray[Any]
STEP, SAMPLES, START = 0.005, 240, 1_700_000_000_000_000_000
COUNT = 12.0  # readings of foot sensors in the air


@dataclass(frozen=True)
class Motion:
    """A robot's smooth motion with all that is ever recorded; contact flags are those of its feet.

    Attributes:
        log: in the format, joints in the order of the URDF.
        counts: (N, C) raw readings of foot sensors.
    """

    log: Log
    counts: Array


def wave(rng: np.random.Generator, time: Array, width: int, size: float) -> tuple[Array, Array]:
    """Sums of sines (N, width) and their slopes."""
    rate, phase = rng.uniform(1.5, 6.0, (2, width)), rng.uniform(0.0, 6.0, (2, width))
    height = size * rng.uniform(0.4, 1.0, (2, width))
    turn = [np.outer(time, rate[k]) + phase[k] for k in range(2)]
    return (
        sum(height[k] * np.sin(turn[k]) for k in range(2)),  # type: ignore[return-value]
        sum(height[k] * rate[k] * np.cos(turn[k]) for k in range(2)),
    )


def moved(robot: Robot, feet: tuple[str, ...], imu_frame: str, seed: int) -> Motion:
    """A motion; torques are those that hold the robot in its mid-air motion, by Pinocchio."""
    rng, time = np.random.default_rng(seed), STEP * np.arange(SAMPLES)
    names = robot.joint_names
    position, velocity = wave(rng, time, len(names), 0.25)
    model = pin.buildModelFromUrdf(str(robot.path), pin.JointModelFreeFlyer())
    data, torque = model.createData(), np.zeros_like(position)
    slow, turn_rate = wave(rng, time, 3, 0.08)
    attitude = Rotation.from_rotvec(slow)
    place, _ = wave(rng, time, 3, 0.05)
    acceleration = np.gradient(velocity, STEP, axis=0)
    for i in range(SAMPLES):
        q, v, a = pin.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
        q[3:7], v[3:6] = attitude[i].as_quat(), turn_rate[i]
        for k, name in enumerate(names):
            joint = model.joints[model.getJointId(name)]
            v[joint.idx_v], a[joint.idx_v] = velocity[i, k], acceleration[i, k]
            if joint.nq == 1:
                q[joint.idx_q] = position[i, k]
            else:
                q[joint.idx_q : joint.idx_q + 2] = np.cos(position[i, k]), np.sin(position[i, k])
        force = pin.rnea(model, data, q, v, a)
        torque[i] = [force[model.joints[model.getJointId(name)].idx_v] for name in names]
    active = np.array([np.sin(2.5 * time + np.pi * k) > -0.5 for k in range(len(feet))]).T.reshape(SAMPLES, -1)
    counts = np.where(active, 180.0, COUNT) + rng.integers(0, 9, active.shape)
    log = Log(
        "x",
        time,
        names,
        position,
        joint_velocity=velocity,
        joint_torque=torque,
        base_quat_xyzw=attitude.as_quat() if feet else None,
        base_position_world=place + [0.0, 0.0, 0.6] if feet else None,
        contact_names=feet,
        contact_active=active if feet else None,
        imu_frame=imu_frame if feet else "",
        imu_specific_force=attitude.inv().apply([0.0, 0.0, 9.81]) + 0.1 * slow if feet else None,
        imu_angular_velocity=turn_rate if feet else None,
    )
    return Motion(log, counts)


# ---------------------------------------------------------------------------------------------------------- dialects


def shuffled(log: Log) -> list[int]:
    """Joints in an order that nobody could guess."""
    return [int(k) for k in np.random.default_rng(7).permutation(len(log.joint_names))]


def ros_bag(path: Path, motion: Motion) -> Path:
    """Messages of a well-kept ROS robot, all with stamps, flags by the feet's names."""
    log, order, entries = motion.log, shuffled(motion.log), list[Entry]()
    names = [log.joint_names[k] for k in order]
    for i, time in enumerate(log.time):
        stamp = START + round(time * 1e9)
        parts = {
            "position": log.joint_position,
            "velocity": value(log.joint_velocity),
            "effort": value(log.joint_torque),
        }
        joints = {name: x[i, order] for name, x in parts.items()}
        entries.append(("/joint_states", stamp, JOINT_STATE, joint_state(stamp, names, **joints)))
        desired = {"position": 0.9 * joints["position"]}
        entries.append(("/joint_states_command", stamp, JOINT_STATE, joint_state(stamp, names, **desired)))
        entries.append(("/diagnostics_level", stamp, "std_msgs/msg/Float64", {"data": 3.0}))
        if log.contact_names:
            quat, place = value(log.base_quat_xyzw)[i], value(log.base_position_world)[i]
            entries.append(("/odom", stamp, ODOMETRY, odometry(stamp, place, quat)))
            readings = value(log.imu_specific_force)[i], value(log.imu_angular_velocity)[i]
            entries.append(("/imu/data", stamp, IMU, imu(stamp, *readings, log.imu_frame)))
            for k, name in enumerate(log.contact_names):
                flag = {"data": bool(value(log.contact_active)[i, k])}
                entries.append((f"/contacts/{name.lower()}", stamp, FLAG, flag))
    return write_bag(path, entries)


def sensor_bag(path: Path, motion: Motion) -> Path:
    """Joints without suffixes' help, an IMU of an unknown frame, and a number for each foot."""
    log, entries = motion.log, list[Entry]()
    for i, time in enumerate(log.time):
        stamp = START + round(time * 1e9)
        parts = {"position": log.joint_position[i], "effort": value(log.joint_torque)[i]}
        entries.append(("/robot/joints", stamp, JOINT_STATE, joint_state(stamp, log.joint_names, **parts)))
        if log.contact_names:
            readings = value(log.imu_specific_force)[i], value(log.imu_angular_velocity)[i]
            entries.append(("/sensors/imu", stamp, IMU, imu(stamp, *readings, "microstrain")))
            for k, name in enumerate(log.contact_names):
                entries.append((f"/sensors/{name}/force", stamp, "std_msgs/msg/Float32", {"data": motion.counts[i, k]}))
    return write_bag(path, entries)


def stem(name: str) -> str:
    """What a laboratory calls a joint or a foot."""
    for suffix in ("_ankle_roll_link", "_joint", "_foot", "_sole", "_link"):
        if name.endswith(suffix):
            return name.removesuffix(suffix)
    return name


SLIDES = ("panda_finger_joint1",)


def shown(joint: str, values: FloatArray, of_hinges: float) -> FloatArray:
    """Positions or velocities of a joint as its driver shows them: times a factor, those of slides in mm."""
    return values * (1e3 if joint in SLIDES else of_hinges)


def numbered_csv(path: Path, motion: Motion) -> Path:
    """Motors by number from 1 on, in degrees, rpm and ms (slides in mm and mm/s), feet by number from 0 on.

    Numbers are in the order of the URDF, those of a Go2 as its maker has them.
    """
    log = motion.log
    columns: dict[str, Any] = {"timestamp_ms": 1e3 * log.time}
    is_go2 = set(log.joint_names) == set(GO2)
    order = [log.joint_names.index(name) for name in (GO2 if is_go2 else log.joint_names)]
    for number, k in enumerate(order, 1):
        joint = log.joint_names[k]
        columns[f"motor{number}_position"] = shown(joint, log.joint_position[:, k], 180.0 / np.pi)
        columns[f"motor{number}_speed"] = shown(joint, value(log.joint_velocity)[:, k], 30.0 / np.pi)
        columns[f"motor{number}_torque"] = value(log.joint_torque)[:, k]
        columns[f"motor{number}_temperature"] = np.full(SAMPLES, 40)
    feet = FEET if is_go2 else log.contact_names
    for number, name in enumerate(feet):
        columns[f"foot_force_{number}"] = motion.counts[:, log.contact_names.index(name)]
    return save_csv(path, columns | _base_columns(log, "quat_{}", "pos_{}"))


def named_csv(path: Path, motion: Motion) -> Path:
    """Joints by shortened names in an order of their own, in degrees; flags by shortened names of feet."""
    log, columns = motion.log, dict[str, Any]()
    columns["time_s"] = log.time
    for k in shuffled(log):
        name = stem(log.joint_names[k])
        columns[f"{name}_angle_deg"] = np.degrees(log.joint_position[:, k])
        columns[f"{name}_velocity_deg_s"] = np.degrees(value(log.joint_velocity)[:, k])
        columns[f"{name}_effort_Nm"] = value(log.joint_torque)[:, k]
    columns |= {f"acc_{axis}": x for axis, x in zip("xyz", _parts(log.imu_specific_force, 1 / 9.80665), strict=False)}
    columns |= {f"gyro_{axis}": x for axis, x in zip("xyz", _parts(log.imu_angular_velocity), strict=False)}
    for k, name in enumerate(log.contact_names):
        columns[f"contact_{stem(name)}"] = value(log.contact_active)[:, k].astype(int)
    return save_csv(path, columns)


def lower_csv(path: Path, motion: Motion) -> Path:
    """Lower-case names behind what they are of, in an order of their own; readings of feet by name."""
    log, columns = motion.log, {"t": motion.log.time}
    for what, x in (("q", log.joint_position), ("qd", log.joint_velocity), ("tau", log.joint_torque)):
        columns |= {f"{what}_{stem(log.joint_names[k]).lower()}": value(x)[:, k] for k in shuffled(log)}
    columns |= {f"grf_{name.lower()}": motion.counts[:, k] for k, name in enumerate(log.contact_names)}
    return save_csv(path, columns | _base_columns(log, "base_quat_{}", "base_pos_{}"))


def camel(name: str) -> str:
    return "".join(part[:1].upper() + part[1:] for part in stem(name).split("_"))


def camel_csv(path: Path, motion: Motion) -> Path:
    """Names in capitals without separators, as of a controller in C++ or of a spreadsheet, in an order of their own."""
    log, columns = motion.log, {"Time": motion.log.time}
    for k in shuffled(log):
        joint, name = log.joint_names[k], camel(log.joint_names[k])
        columns[f"{name}.Position"] = shown(joint, log.joint_position[:, k], 180.0 / np.pi)
        columns[f"{name}.Velocity"] = shown(joint, value(log.joint_velocity)[:, k], 180.0 / np.pi)
        columns[f"{name}.Torque"] = value(log.joint_torque)[:, k]
    columns |= {f"Gyro.{axis}": x for axis, x in zip("XYZ", _parts(log.imu_angular_velocity), strict=False)}
    columns |= {f"Accelerometer.{axis}": x for axis, x in zip("XYZ", _parts(log.imu_specific_force), strict=False)}
    return save_csv(path, columns)


def plotted_csv(path: Path, motion: Motion) -> Path:
    """Fields of ROS messages as a plotting tool exports them: topic and field, with slashes."""
    log, columns = motion.log, {"__time": motion.log.time + 1.7e9}
    for k in shuffled(log):
        for what, x in (
            ("position", log.joint_position),
            ("velocity", log.joint_velocity),
            ("effort", log.joint_torque),
        ):
            columns[f"/joint_states/{log.joint_names[k]}/{what}"] = value(x)[:, k]
    for name, values, axes in (
        ("/imu/data/angular_velocity", log.imu_angular_velocity, "xyz"),
        ("/imu/data/linear_acceleration", log.imu_specific_force, "xyz"),
        ("/odom/pose/pose/position", log.base_position_world, "xyz"),
        ("/odom/pose/pose/orientation", log.base_quat_xyzw, "xyzw"),
    ):
        columns |= {f"{name}/{axis}": x for axis, x in zip(axes, _parts(values), strict=False)}
    for k, name in enumerate(log.contact_names):
        columns[f"/contacts/{name}/data"] = value(log.contact_active)[:, k].astype(float)
    return save_csv(path, columns)


def grouped_h5(path: Path, motion: Motion) -> Path:
    """Arrays in groups, the names of joints in one of them."""
    log, order = motion.log, shuffled(motion.log)
    with h5py.File(path, "w") as file:
        file["time"] = log.time
        file["joint/names"] = [log.joint_names[k] for k in order]
        file["joint/position"] = log.joint_position[:, order]
        file["joint/velocity"] = value(log.joint_velocity)[:, order]
        file["joint/torque"] = value(log.joint_torque)[:, order]
        if log.contact_names:
            file["imu/linear_acceleration"], file["imu/angular_velocity"] = (
                log.imu_specific_force,
                log.imu_angular_velocity,
            )
            file["base/orientation"] = np.roll(value(log.base_quat_xyzw), 1, axis=1)
            file["base/position"] = log.base_position_world
            file["feet/names"] = list(log.contact_names[::-1])
            file["feet/contact"] = value(log.contact_active)[:, ::-1].astype(np.int8)
    return path


def motor_state_csv(path: Path, motion: Motion) -> Path:
    """All motors, used or not, as a LowState has them, of robots whose order is known by name; else of the URDF's."""
    log = motion.log
    robot = next((x for x in JOINT_ORDERS.values() if set(x.names) == set(log.joint_names)), None)
    order = log.joint_names if robot is None else robot.joints
    columns: dict[str, Any] = {"tick": (1e3 * log.time).round().astype(int)}
    for number in range(35 if robot is None else MOTORS[robot.message]):
        name = order[number] if number < len(order) else None
        k = None if name is None else log.joint_names.index(name)
        for what, x in (("q", log.joint_position), ("dq", log.joint_velocity), ("tau_est", log.joint_torque)):
            columns[f"motor_state[{number}].{what}"] = np.zeros(SAMPLES) if k is None else value(x)[:, k]
        columns[f"motor_state[{number}].temperature"] = np.full(SAMPLES, 33)
    for name, values in (("accelerometer", log.imu_specific_force), ("gyroscope", log.imu_angular_velocity)):
        columns |= {f"imu_state.{name}[{k}]": x for k, x in enumerate(_parts(values))}
    for number, name in enumerate(FEET if robot is not None and robot.feet else log.contact_names):
        columns[f"foot_force[{number}]"] = motion.counts[:, log.contact_names.index(name)]
    return save_csv(path, columns)


def controller_npz(path: Path, motion: Motion) -> Path:
    """Arrays of a controller, with the names of its joints, desired values beside what was measured."""
    log, order = motion.log, shuffled(motion.log)
    arrays = {
        "timestamps": (1e6 * log.time).round().astype(np.int64),
        "joint_names": np.array([log.joint_names[k] for k in order]),
        "q": log.joint_position[:, order],
        "dq": value(log.joint_velocity)[:, order],
        "tau_measured": value(log.joint_torque)[:, order],
        "q_des": 1.1 * log.joint_position[:, order],
        "tau_cmd": np.zeros_like(log.joint_position),
    }
    if log.contact_names:
        arrays |= {"base_orientation": log.base_quat_xyzw, "base_pos": log.base_position_world}
        arrays |= {
            "imu_acc": log.imu_specific_force,
            "imu_gyro": log.imu_angular_velocity,
            "contacts": log.contact_active,
        }
    np.savez(path, **arrays)
    return path


def nested_parquet(path: Path, motion: Motion) -> Path:
    """Structs by joint and by foot, the latter in words for the limbs."""
    log = motion.log
    quantities = {"pos": log.joint_position, "vel": value(log.joint_velocity), "trq": 1e3 * value(log.joint_torque)}
    joints = {log.joint_names[k]: {name: x[:, k] for name, x in quantities.items()} for k in shuffled(log)}
    tree: dict[str, Any] = {"stamp": (1e9 * log.time).round().astype(np.int64), "joints": joints}
    if log.contact_names:
        parts = dict(zip("xyz", _parts(log.base_position_world, 1e3), strict=True))
        turn = dict(zip("xyzw", _parts(log.base_quat_xyzw), strict=True))
        tree["base"] = {"position": parts, "orientation": turn}
        tree["grf"] = {name: motion.counts[:, k] for k, name in enumerate(log.contact_names)}
    pq.write_table(pa.table({name: struct(inner) for name, inner in tree.items()}), path)
    return path


def _parts(values: Array | None, scale: float = 1.0) -> list[Array]:
    return [] if values is None else list(scale * values.T)


def _base_columns(log: Log, quaternion: str, position: str) -> dict[str, Array]:
    out = {quaternion.format(axis): x for axis, x in zip("xyzw", _parts(log.base_quat_xyzw), strict=False)}
    return out | {
        position.format(axis): x for axis, x in zip("xyz", _parts(log.base_position_world, 1e3), strict=False)
    }


DIALECTS: dict[str, tuple[str, Callable[[Path, Motion], Path], tuple[str, ...]]] = {
    "ros bag": ("x.mcap", ros_bag, ("joint_velocity", "base", "imu", "contact_active")),
    "sensor bag": ("x.db3", sensor_bag, ("imu", "contact_active")),
    "numbered csv": ("x.csv", numbered_csv, ("joint_velocity", "base", "contact_active")),
    "named csv": ("x.csv", named_csv, ("joint_velocity", "imu", "contact_active")),
    "lower csv": ("x.csv", lower_csv, ("joint_velocity", "base", "contact_active")),
    "camel csv": ("x.csv", camel_csv, ("joint_velocity", "imu")),
    "plotted csv": ("x.csv", plotted_csv, ("joint_velocity", "base", "imu", "contact_active")),
    "motor_state csv": ("x.csv", motor_state_csv, ("joint_velocity", "imu", "contact_active")),
    "grouped h5": ("x.h5", grouped_h5, ("joint_velocity", "base", "imu", "contact_active")),
    "npz": ("x.npz", controller_npz, ("joint_velocity", "base", "imu", "contact_active")),
    "parquet": ("x.parquet", nested_parquet, ("joint_velocity", "base", "contact_active")),
}
"""File name and writer of each, and what it has beside time, positions and torques of joints."""


def recorded_fields(log: Log, dialect: str) -> dict[str, Array]:
    """The fields of a motion that a dialect has."""
    groups = {
        "base": ("base_quat_xyzw", "base_position_world"),
        "imu": ("imu_specific_force", "imu_angular_velocity"),
    }
    has = [field for name in DIALECTS[dialect][2] for field in groups.get(name, (name,))]
    fields = ("time", "joint_position", "joint_torque", *has)
    return {name: value(getattr(log, name)) for name in fields if getattr(log, name) is not None}


def compared(truth: Mapping[str, Array], motion: Log, found: Log) -> dict[str, str]:
    """Of every field that was recorded: right, wrong or missed."""
    out = {}
    for name, expected in truth.items():
        got = getattr(found, name)
        if got is None:
            out[name] = "missed"
            continue
        if name.startswith("joint_") and set(found.joint_names) == set(motion.joint_names):
            got = got[:, [found.joint_names.index(x) for x in motion.joint_names]]
        if name.startswith("contact_") and set(found.contact_names) == set(motion.contact_names):
            got = got[:, [found.contact_names.index(x) for x in motion.contact_names]]
        if "quat" in name:
            got = got * np.sign(np.sum(got * expected, axis=1, keepdims=True))
        if name == "time":
            got = got - got[0]
        same = got.shape == expected.shape and np.allclose(got, expected, rtol=1e-6, atol=1e-6)
        out[name] = "right" if same else "wrong"
    return out
