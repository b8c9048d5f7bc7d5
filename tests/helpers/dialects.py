"""Recordings as laboratories have them: one motion in other names, units, signs, orders and files, with its map."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml
from numpy.typing import NDArray

from torchid.logs import Columns, Log
from torchid.logs.columns import check_columns

Array = NDArray[Any]
LEGS = ("front_right", "front_left", "rear_right", "rear_left")
ORDER = [f"{leg}_{joint}" for leg in LEGS for joint in ("hip", "thigh", "knee")]
"""Joints of the demo's quadruped as motors count them, which is not the order of its log."""

FEET = [f"{leg}_foot" for leg in LEGS]


def parsed_map(text: str) -> Columns:
    """A map as an experiment file has it, at most 15 lines."""
    assert len(text.strip().splitlines()) <= 15
    columns = Columns(**yaml.safe_load(text))
    check_columns(columns)
    return columns


def with_velocity(log: Log) -> Log:
    """The log with joint velocities, and an IMU at the base link."""
    from dataclasses import replace

    rng = np.random.default_rng(5)
    return replace(
        log,
        joint_velocity=np.gradient(log.joint_position, log.time, axis=0),
        imu_frame="trunk",
        imu_specific_force=rng.standard_normal((len(log), 3)) + [0.0, 0.0, 9.8],
        imu_angular_velocity=rng.standard_normal((len(log), 3)),
    )


def in_order(log: Log, values: Array | None) -> Array:
    """Columns of joints in the order of `ORDER`."""
    assert values is not None
    return values[:, [log.joint_names.index(name) for name in ORDER]]


def feet_in_order(log: Log, values: Array | None) -> Array:
    """Columns of contacts in the order of `FEET`."""
    assert values is not None
    return values[:, [log.contact_names.index(name) for name in FEET]]


def wxyz(log: Log) -> Array:
    """Quaternions (N, 4) of the base, w first."""
    assert log.base_quat_xyzw is not None
    return np.roll(log.base_quat_xyzw, 1, axis=1)


def save_csv(path: Path, columns: Mapping[str, Any], separator: str = ",", mark: str = ".") -> Path:
    """A CSV file with the shortest exact text of each number."""
    rows = zip(*(np.asarray(x).tolist() for x in columns.values()), strict=True)
    lines = [separator.join(columns), *(separator.join(str(x).replace(".", mark) for x in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


# ------------------------------------------------------------------------------------------------------- five dialects

MOTORS_MAP = """
time: {column: timestamp, unit: ms}
joint_order: [front_right_hip, front_right_thigh, front_right_knee, front_left_hip, front_left_thigh, front_left_knee,
              rear_right_hip, rear_right_thigh, rear_right_knee, rear_left_hip, rear_left_thigh, rear_left_knee]
contact_order: [front_right_foot, front_left_foot, rear_right_foot, rear_left_foot]
joint_position: {column: "motor_{index:02}_angle", first_index: 1, unit: deg}
joint_velocity: {column: "motor_{index:02}_speed", first_index: 1, unit: rpm}
joint_torque: {column: "motor_{index:02}_torque", first_index: 1, unit: "N mm", scale: {"*": 1, "*_right_*": -1}}
base_quat_wxyz: "quat_{axis}"
base_position_world: {column: "pos{AXIS}", unit: mm}
contact_active: {column: "foot_{index}", above: 20.0}
ignore: ["motor_*_temperature", note]
"""


def motors_csv(path: Path, log: Log) -> Path:
    """Motors by number from 1 on, in degrees, rpm and N mm, those of the right legs mounted the other way round."""
    right = np.array([-1.0 if "_right_" in name else 1.0 for name in ORDER])
    quantities = {
        "angle": np.degrees(in_order(log, log.joint_position)),
        "speed": in_order(log, log.joint_velocity) * 30.0 / np.pi,
        "torque": in_order(log, log.joint_torque) * 1e3 * right,
        "temperature": np.full((len(log), 12), 41),
    }
    columns: dict[str, Any] = {"timestamp": log.time * 1e3}
    for index in range(12):
        columns |= {f"motor_{index + 1:02}_{name}": x[:, index] for name, x in quantities.items()}
    columns |= {f"quat_{axis}": wxyz(log)[:, k] for k, axis in enumerate("wxyz")}
    assert log.base_position_world is not None
    columns |= {f"pos{axis}": 1e3 * log.base_position_world[:, k] for k, axis in enumerate("XYZ")}
    columns |= {f"foot_{k}": np.where(x, 55.5, 3.25) for k, x in enumerate(feet_in_order(log, log.contact_active).T)}
    return save_csv(path, columns | {"note": ["ok"] * len(log)}, ";", ",")


PD_MAP = """
time: t
joint_position: dof_pos
joint_velocity: dof_vel
joint_torque:
  pd: {kp: kp, kd: kd, position: des_dof_pos, velocity: {column: des_dof_vel, unit: deg/s}, feed_forward: tau_ff}
base_quat_wxyz: base_quat
base_position_world: base_pos
contact_active: {column: stance, order: [front_right_foot, front_left_foot, rear_right_foot, rear_left_foot]}
ignore: [episode]
"""


def pd_arrays(log: Log, kp: Array, kd: Array) -> dict[str, Any]:
    """What a joint controller knows: desired motion, gains and a feed-forward torque, that make up the torque."""
    q, dq, torque = (in_order(log, x) for x in (log.joint_position, log.joint_velocity, log.joint_torque))
    rng = np.random.default_rng(6)
    feed_forward, wanted = rng.standard_normal(q.shape), rng.standard_normal(q.shape)
    return {
        "t": log.time,
        "joint_names": np.array(ORDER),
        "dof_pos": q,
        "dof_vel": dq,
        "des_dof_pos": q + (torque - feed_forward - kd * (wanted - dq)) / kp,
        "des_dof_vel": np.degrees(wanted),
        "tau_ff": feed_forward,
        "kp": kp,
        "kd": kd,
        "base_quat": wxyz(log),
        "base_pos": log.base_position_world,
        "stance": feet_in_order(log, log.contact_active),
        "episode": np.array(3),
    }


def pd_npz(path: Path, log: Log) -> Path:
    """A controller's arrays, without a torque."""
    np.savez(path, **pd_arrays(log, np.linspace(20.0, 60.0, 12), np.linspace(0.5, 2.0, 12)))
    return path


LOW_STATE_MAP = """
time: {column: tick, unit: ms}
joint_order: [front_right_hip, front_right_thigh, front_right_knee, front_left_hip, front_left_thigh, front_left_knee,
              rear_right_hip, rear_right_thigh, rear_right_knee, rear_left_hip, rear_left_thigh, rear_left_knee]
contact_order: [front_right_foot, front_left_foot, rear_right_foot, rear_left_foot]
joint_position: "motor_state[{index}].q"
joint_velocity: "motor_state[{index}].dq"
joint_torque: "motor_state[{index}].tau_est"
imu_frame: trunk
imu_angular_velocity: "imu_state.gyroscope[{index}]"
imu_specific_force: {column: "imu_state.accelerometer[{index}]", unit: g}
contact_active: {column: "foot_force[{index}]", above: 20}
ignore: ["motor_state*", "imu_state*", "bms_state*"]
"""


def low_state_csv(path: Path, log: Log) -> Path:
    """A Unitree recording: 20 motors, of which 12 are there, an IMU, foot forces as numbers."""
    columns: dict[str, Any] = {"tick": np.round(log.time * 1e3).astype(int)}
    quantities = {"q": log.joint_position, "dq": log.joint_velocity, "tau_est": log.joint_torque}
    for index in range(20):
        for name, x in quantities.items():
            used = in_order(log, x)[:, index] if index < 12 else np.zeros(len(log))
            columns[f"motor_state[{index}].{name}"] = used
        columns[f"motor_state[{index}].temperature"] = np.full(len(log), 30)
    assert log.imu_specific_force is not None
    assert log.imu_angular_velocity is not None
    columns |= {f"imu_state.quaternion[{k}]": wxyz(log)[:, k] for k in range(4)}
    columns |= {f"imu_state.gyroscope[{k}]": log.imu_angular_velocity[:, k] for k in range(3)}
    columns |= {f"imu_state.accelerometer[{k}]": log.imu_specific_force[:, k] / 9.80665 for k in range(3)}
    feet = feet_in_order(log, log.contact_active)
    columns |= {f"foot_force[{k}]": np.where(feet[:, k], 57, 4) for k in range(4)}
    return save_csv(path, columns | {"bms_state.soc": np.full(len(log), 80)})


NESTED_MAP = """
time: {column: header.stamp, unit: ns}
joint_position: "state.joints.{joint}.q"
joint_velocity: "state.joints.{joint}.dq"
joint_torque: {column: "state.joints.{joint}.tau", unit: kg cm}
base_quat_xyzw: "state.base.orientation.{axis}"
base_position_world: "state.base.position.{axis}"
contact_name: "{contact}_foot"
contact_active: "feet.{contact}.touches"
contact_wrench_local:
  force: {column: "feet.{contact}.force.{axis}", unit: kN}
  moment: {column: "feet.{contact}.moment.{axis}", scale: -1}
ignore: ["state.joints.*.temperature"]
"""


def nested_parquet(path: Path, log: Log) -> Path:
    """Columns inside of columns, with names of joints."""
    quantities = {"q": log.joint_position, "dq": log.joint_velocity, "tau": log.joint_torque}
    scales = {"q": 1.0, "dq": 1.0, "tau": 100.0 / 9.80665}
    joints = {
        name: {what: in_order(log, x)[:, k] * scales[what] for what, x in quantities.items()}
        | {"temperature": np.full(len(log), 30)}
        for k, name in enumerate(ORDER)
    }
    quat, position, wrench = log.base_quat_xyzw, log.base_position_world, feet_in_order(log, log.contact_wrench)
    assert quat is not None
    assert position is not None
    feet = {
        leg: {
            "touches": feet_in_order(log, log.contact_active)[:, k],
            "force": {axis: 1e-3 * wrench[:, k, j] for j, axis in enumerate("xyz")},
            "moment": {axis: -wrench[:, k, 3 + j] for j, axis in enumerate("xyz")},
        }
        for k, leg in enumerate(LEGS)
    }
    base = {
        "orientation": {axis: quat[:, k] for k, axis in enumerate("xyzw")},
        "position": {axis: position[:, k] for k, axis in enumerate("xyz")},
    }
    tree = {
        "header": {"stamp": np.round(log.time * 1e9).astype(np.int64)},
        "state": {"joints": joints, "base": base},
        "feet": feet,
    }
    pq.write_table(pa.table({name: struct(inner) for name, inner in tree.items()}), path)
    return path


def struct(tree: Any) -> Any:
    """Nested mappings as a nested column."""
    if not isinstance(tree, Mapping):
        return pa.array(tree)
    return pa.StructArray.from_arrays([struct(inner) for inner in tree.values()], list(tree))


GROUPS_MAP = """
time: {column: clock/t, unit: us}
joint_position: "arms_and_legs/{joint}/angle"
joint_velocity: "arms_and_legs/{joint}/rate"
joint_torque: "arms_and_legs/{joint}/effort"
base_quat_xyzw: base/quaternion
base_position_world: base/position
contact_order: [front_right_foot, front_left_foot, rear_right_foot, rear_left_foot]
contact_active: ground/contact
contact_wrench_local: {column: ground/wrench, unit: {"*.m?": N cm}}
"""


def groups_h5(path: Path, log: Log) -> Path:
    """HDF5 with groups: an array for each joint, all feet in one."""
    quantities = {"angle": log.joint_position, "rate": log.joint_velocity, "effort": log.joint_torque}
    wrench = feet_in_order(log, log.contact_wrench).copy()
    wrench[:, :, 3:] *= 100.0
    with h5py.File(path, "w") as file:
        file["clock/t"] = np.round(log.time * 1e6).astype(np.int64)
        for name, x in quantities.items():
            for k, joint in enumerate(ORDER):
                file[f"arms_and_legs/{joint}/{name}"] = in_order(log, x)[:, k]
        file["base/quaternion"], file["base/position"] = log.base_quat_xyzw, log.base_position_world
        file["ground/contact"], file["ground/wrench"] = feet_in_order(log, log.contact_active), wrench
    return path


ROWS_MAP = """
rows_of: joint
time: {column: t_ms, unit: ms}
joint_position: {column: "angle.{joint}", unit: deg}
joint_velocity: "speed.{joint}"
joint_torque: "effort.{joint}"
base_quat_wxyz: "base_q{axis}"
base_position_world: "base_p{axis}"
contact_active: "{contact}_state"
"""


def rows_csv(path: Path, log: Log) -> Path:
    """A row for each joint and stamp, joints last to first, with the base's pose and words for feet in each."""
    quantities = {
        "angle": np.degrees(in_order(log, log.joint_position)),
        "speed": in_order(log, log.joint_velocity),
        "effort": in_order(log, log.joint_torque),
    }
    assert log.base_position_world is not None
    shared: dict[str, Any] = {f"base_q{axis}": wxyz(log)[:, k] for k, axis in enumerate("wxyz")}
    shared |= {f"base_p{axis}": log.base_position_world[:, k] for k, axis in enumerate("xyz")}
    flags = zip(log.contact_names, log.contact_active.T, strict=True)
    shared |= {f"{foot}_state": np.where(x, "STANCE", "SWING") for foot, x in flags}
    columns = {"t_ms": np.repeat(log.time * 1e3, 12), "joint": np.tile(ORDER[::-1], len(log))}
    columns |= {name: x[:, ::-1].ravel() for name, x in quantities.items()}
    return save_csv(path, columns | {name: np.repeat(x, 12) for name, x in shared.items()})


LINES_MAP = """
time: stamp
joint_position: "joints.{joint}.pos"
joint_velocity: "joints.{joint}.vel"
joint_torque: "joints.{joint}.moment"
base_quat_xyzw: "base.quat[{component}]"
base_position_world: "base.position.{axis}"
contact_active: "touch.{contact}"
"""


def json_lines(path: Path, log: Log) -> Path:
    """An object a line, of a stamp, joints by name, the pose of the base, and words for the feet."""
    given = zip(("pos", "vel", "moment"), (log.joint_position, log.joint_velocity, log.joint_torque), strict=True)
    series = {name: in_order(log, x) for name, x in given}
    quat, position = log.base_quat_xyzw, log.base_position_world
    feet = dict(zip(log.contact_names, log.contact_active.T, strict=True))
    assert quat is not None
    assert position is not None
    lines = [
        {
            "stamp": float(stamp),
            "joints": {joint: {name: float(x[n, k]) for name, x in series.items()} for k, joint in enumerate(ORDER)},
            "base": {"quat": quat[n].tolist(), "position": dict(zip("xyz", position[n].tolist(), strict=True))},
            "touch": {foot: "on" if x[n] else "off" for foot, x in feet.items()},
        }
        for n, stamp in enumerate(log.time)
    ]
    path.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    return path


DIALECTS: dict[str, tuple[str, str, Callable[[Path, Log], Path]]] = {
    "motor numbers in degrees": ("motors.csv", MOTORS_MAP, motors_csv),
    "PD law": ("controller.npz", PD_MAP, pd_npz),
    "LowState": ("low_state.csv", LOW_STATE_MAP, low_state_csv),
    "nested names": ("nested.parquet", NESTED_MAP, nested_parquet),
    "groups": ("groups.h5", GROUPS_MAP, groups_h5),
    "rows of joints": ("rows.csv", ROWS_MAP, rows_csv),
    "JSON lines": ("lines.jsonl", LINES_MAP, json_lines),
}
"""File name, map and writer of each dialect, of a log with velocities and an IMU."""
