"""Bags of ROS 1 and ROS 2 with given messages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from refusals import refused
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from torchid.logs import Log, Topics, read_log

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
#: One message: topic, receipt [ns], type and content.
Entry = tuple[str, int, str, Mapping[str, Any]]
JOINT_STATE, IMU, ODOMETRY, WRENCH, PLAIN_WRENCH, FLAG, NUMBERS = (
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/Imu",
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/WrenchStamped",
    "geometry_msgs/msg/Wrench",
    "std_msgs/msg/Bool",
    "std_msgs/msg/Float64MultiArray",
)


def write_bag(path: Path, entries: Iterable[Entry]) -> Path:
    """A .bag file, or an .mcap or .db3 file without the folder it was recorded to."""
    if path.suffix == ".bag":
        _write(rosbag1.Writer(path), ROS1, entries)
        return path
    folder = path.with_suffix(".folder")
    write_folder(folder, path.suffix, entries).replace(path)
    (folder / "metadata.yaml").unlink()
    folder.rmdir()
    return path


def write_folder(folder: Path, suffix: str, entries: Iterable[Entry]) -> Path:
    """A folder as ROS 2 records it; returns the one file with messages in it."""
    plugin = rosbag2.StoragePlugin.MCAP if suffix == ".mcap" else rosbag2.StoragePlugin.SQLITE3
    _write(rosbag2.Writer(folder, version=9, storage_plugin=plugin), ROS2, entries)
    (file,) = folder.glob(f"*{suffix}")
    return file


def _write(writer: Any, store: Any, entries: Iterable[Entry]) -> None:
    serialize = store.serialize_ros1 if store is ROS1 else store.serialize_cdr
    with writer:
        connections: dict[str, Any] = {}
        for topic, received, kind, content in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], received, serialize(filled(store, kind, content), kind))


def filled(store: Any, kind: str, content: Mapping[str, Any]) -> Any:
    """A message of a type, zero where the content says nothing; a stamp is given in ns."""
    definition, values = store.fielddefs[kind][1], {}
    for name, (node, what) in definition:
        value = content.get(name)
        if name == "stamp":
            values[name] = store.types[what](sec=int(value or 0) // 10**9, nanosec=int(value or 0) % 10**9)
        elif int(node) == 2:  # a message
            values[name] = filled(store, what, value or {})
        elif int(node) == 1:  # a number or a text
            values[name] = value if value is not None else "" if what[0] == "string" else 0
        elif int(what[0][0]) == 2:  # messages
            values[name] = [filled(store, what[0][1], inner) for inner in value or [{}] * what[1]]
        else:
            empty = np.zeros(
                what[1] if int(node) == 3 else 0, dtype=None if what[0][1][0] == "string" else what[0][1][0]
            )
            values[name] = empty if value is None else value
    return store.types[kind](**values)


def vector(values: Iterable[float], names: str = "xyz") -> dict[str, float]:
    """A vector or quaternion."""
    return dict(zip(names, map(float, values), strict=True))


def header(stamp: int, frame: str = "") -> dict[str, Any]:
    return {"stamp": stamp, "frame_id": frame}


def joint_state(stamp: int, names: Iterable[str], **values: Any) -> dict[str, Any]:
    """Position, velocity and effort as given."""
    return {"header": header(stamp), "name": list(names), **{k: np.asarray(x, dtype=float) for k, x in values.items()}}


def wrench(stamp: int, values: Any, frame: str = "") -> dict[str, Any]:
    """A stamped wrench."""
    return {"header": header(stamp, frame), "wrench": {"force": vector(values[:3]), "torque": vector(values[3:])}}


def imu(stamp: int, force: Any, turn: Any, frame: str = "imu_link") -> dict[str, Any]:
    return {"header": header(stamp, frame), "linear_acceleration": vector(force), "angular_velocity": vector(turn)}


def odometry(stamp: int, position: Any, quat_xyzw: Any, linear: Any = (0, 0, 0), angular: Any = (0, 0, 0)) -> Any:
    """Pose of `base` in the world, twist in that child frame."""
    pose = {"position": vector(position), "orientation": vector(quat_xyzw, "xyzw")}
    twist = {"linear": vector(linear), "angular": vector(angular)}
    return {
        "header": header(stamp, "odom"),
        "child_frame_id": "base",
        "pose": {"pose": pose},
        "twist": {"twist": twist},
    }


def entries_of(log: Log, start: int = 1_700_000_000_000_000_000) -> list[Entry]:
    """A log as messages that all have its stamps, counted from a start [ns]."""
    out: list[Entry] = []
    for i, time in enumerate(log.time):
        stamp = start + round(time * 1e9)
        out += [(topic, stamp, kind, content) for topic, kind, content in _said(log, i, stamp)]
    return out


def _said(log: Log, i: int, stamp: int) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Topic, type and content of the messages of one sample."""
    values = {"position": log.joint_position, "velocity": log.joint_velocity, "effort": log.joint_torque}
    joints = {name: x[i] for name, x in values.items() if x is not None}
    yield "/joint_states", JOINT_STATE, joint_state(stamp, log.joint_names, **joints)
    if log.base_quat_xyzw is not None and log.base_position_world is not None:
        yield "/odom", ODOMETRY, odometry(stamp, log.base_position_world[i], log.base_quat_xyzw[i])
    if log.imu_specific_force is not None and log.imu_angular_velocity is not None:
        yield "/imu", IMU, imu(stamp, log.imu_specific_force[i], log.imu_angular_velocity[i], log.imu_frame)
    sensors = [(f"/wrench/{x}", log.contact_wrench_local, c, x) for c, x in enumerate(log.contact_names)]
    sensors += [(f"/ft/{x}", log.ft_wrench, f, "") for f, x in enumerate(log.ft_names)]
    for topic, wrenches, column, frame in sensors:
        if wrenches is not None:
            yield topic, WRENCH, wrench(stamp, wrenches[i, column], frame)
    if log.contact_force_normal is not None:
        yield "/foot_forces", NUMBERS, {"data": log.contact_force_normal[i]}
    if log.contact_active is not None:
        for name, active in zip(log.contact_names, log.contact_active[i], strict=True):
            yield f"/touch/{name}", FLAG, {"data": bool(active)}


def topics_of(log: Log) -> dict[str, Any]:
    """The topics of `entries_of`, as an experiment file would name them."""
    topics: dict[str, Any] = {"joint_states": "/joint_states"}
    if log.base_quat_xyzw is not None:
        topics["odometry"] = {"topic": "/odom", "twist": "none", "frame": "base"}
    if log.imu_frame:
        topics["imu"] = "/imu"
    if log.contact_wrench_local is not None:
        topics["contact_wrenches"] = {name: f"/wrench/{name}" for name in log.contact_names}
    if log.contact_force_normal is not None:
        forces = {name: {"topic": "/foot_forces", "index": index} for index, name in enumerate(log.contact_names)}
        topics["contact_force_normal"] = forces
    if log.contact_names:
        topics["contact_active"] = {name: f"/touch/{name}" for name in log.contact_names}
    if log.ft_names:
        topics["ft_wrenches"] = {name: f"/ft/{name}" for name in log.ft_names}
    return topics


def parsed(topics: Mapping[str, Any]) -> Topics:
    """As an experiment file gives them."""
    return Topics(**topics)


def recorded(samples: int = 40) -> Log:
    """A log with every sensor, NaN where efforts were not measured."""
    rng = np.random.default_rng(8)
    turn = np.outer(np.arange(samples), [0.03, -0.02, 0.05])
    torque = rng.standard_normal((samples, 3))
    torque[:, 1], torque[2, 0] = np.nan, np.nan
    return Log(
        "x",
        0.002 * np.arange(samples),
        ("hip", "knee", "ankle"),
        rng.standard_normal((samples, 3)),
        joint_velocity=rng.standard_normal((samples, 3)),
        joint_torque=torque,
        base_quat_xyzw=Rotation.from_rotvec(turn).as_quat(),
        base_position_world=rng.standard_normal((samples, 3)),
        contact_names=("l_sole", "r_sole"),
        contact_active=rng.random((samples, 2)) > 0.5,
        contact_wrench_local=rng.standard_normal((samples, 2, 6)),
        ft_names=("l_ankle_ft",),
        ft_wrench=rng.standard_normal((samples, 1, 6)),
        imu_frame="imu_link",
        imu_specific_force=rng.standard_normal((samples, 3)),
        imu_angular_velocity=rng.standard_normal((samples, 3)),
    )


STAMPS = 1_000_000_000 * np.array([100, 101, 102, 103])


def joints_at(stamps: Any, **values: Any) -> list[Entry]:
    """One joint's states, at rest unless said otherwise."""
    values = {"position": np.zeros(len(stamps)), **values}
    return [
        ("/joint_states", stamp, JOINT_STATE, joint_state(stamp, ["a"], **{k: [x[i]] for k, x in values.items()}))
        for i, stamp in enumerate(map(int, stamps))
    ]


def read_messages(path: Path, entries: list[Entry], **topics: Any) -> Log:
    """The log of a bag with these messages, by default of joint states alone."""
    path.unlink(missing_ok=True)
    return read_log(write_bag(path, entries), parsed({"joint_states": "/joint_states", **topics}))


def refusal(path: Path, entries: list[Entry], **topics: Any) -> str:
    """The one line that reading these messages fails with."""
    return refused(lambda: read_messages(path, entries, **topics), f"{path}: ")
