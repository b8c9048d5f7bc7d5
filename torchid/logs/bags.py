"""Bags of ROS 1 and 2: read messages as arrays with stamps, and align them as the fields of a log.

Another process reads the files; messages are decoded here, by definitions of ROS and Unitree.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, UnknownNameError, how_to_install, join_names, warn_about_file
from torchid.guards import MAX_ARRAYS, check_names, check_unpacked_size, require_plain_name
from torchid.logs.alignment import Series
from torchid.logs.bag_files import serve_bag
from torchid.logs.containers import list_bag_files, reader_errors_explained
from torchid.logs.log import FloatArray
from torchid.logs.quaternion import require_unit
from torchid.logs.ros_topics import (
    AnyTopic,
    ContactTopic,
    ForceTopic,
    ImuTopic,
    JointTopic,
    LowStateTopic,
    OdometryTopic,
    Topics,
    WrenchTopic,
    check_topics,
)
from torchid.logs.unitree import GO, JOINT_ORDERS, MOTORS, register
from torchid.reader import RemoteObject, open_apart

Stamps = NDArray[np.int64]

JOINT_STATES = ("sensor_msgs/msg/JointState",)
IMUS = ("sensor_msgs/msg/Imu",)
ODOMETRIES = ("nav_msgs/msg/Odometry",)
WRENCHES = ("geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/Wrench")
NUMBERS = ("std_msgs/msg/Float32", "std_msgs/msg/Float64")
NUMBER_ARRAYS = tuple(f"std_msgs/msg/{kind}MultiArray" for kind in ("Float32", "Float64", "Int16", "Int32"))
FLAGS = ("std_msgs/msg/Bool",)

_TYPES: dict[type[AnyTopic], tuple[str, ...]] = {
    JointTopic: JOINT_STATES,
    LowStateTopic: tuple(MOTORS),
    ImuTopic: IMUS,
    OdometryTopic: ODOMETRIES,
    WrenchTopic: WRENCHES,
    ForceTopic: (*NUMBERS, *NUMBER_ARRAYS, *WRENCHES),
    ContactTopic: FLAGS,
}
_JOINT_FIELDS = {"position": "joint_position", "velocity": "joint_velocity", "effort": "joint_torque"}
_IMU_PARTS = ("linear_acceleration", "angular_velocity", "orientation")
_PATHS: dict[str, tuple[str, ...]] = {
    JOINT_STATES[0]: tuple(_JOINT_FIELDS),
    IMUS[0]: (*_IMU_PARTS, *(f"{part}_covariance.0" for part in _IMU_PARTS)),
    ODOMETRIES[0]: ("pose.pose.position", "pose.pose.orientation", "twist.twist.linear", "twist.twist.angular"),
    WRENCHES[0]: ("wrench.force", "wrench.torque"),
    WRENCHES[1]: ("force", "torque"),
    **dict.fromkeys((*NUMBERS, *NUMBER_ARRAYS, *FLAGS), ("data",)),
    **dict.fromkeys(
        MOTORS,
        (
            *(f"motor_state.{part}" for part in ("q", "dq", "tau_est")),
            *(f"imu_state.{part}" for part in ("accelerometer", "gyroscope", "quaternion")),
            *("foot_force", "mode_pr"),
        ),
    ),
}
"""Parts of messages that are read, by their type."""

_IMU = "logs.topics.imu"
_ZSTD = b"\x28\xb5\x2f\xfd"
_PACKAGES = ("rosbags", "mcap", "lz4", "zstandard")
_FLAG_ROLE = "contact_active"
_FEET = "foot_force"
# messages between reports of progress, topics in a message
_REPORT_EVERY = 1000
_LISTED = 30


# --------------------------------------------------------------------------------------------------------------- files


@dataclass(frozen=True)
class BagChannel:
    """A topic with its message type, such as `sensor_msgs/msg/Imu`, and its serialization (cdr, ros1)."""

    topic: str
    type: str
    encoding: str

    def __post_init__(self) -> None:
        """Refuse unprintable and too long names."""
        for text in (self.topic, self.type, self.encoding):
            require_plain_name(text)


@contextmanager
def _open_file(path: Path) -> Iterator[RemoteObject]:
    """Open a file of a bag; LogError where it is damaged, also in later reads, or its reader is not installed."""
    if absent := [name for name in _PACKAGES if find_spec(name) is None]:
        reason = f"a bag, but {' and '.join(absent)} {'are' if len(absent) > 1 else 'is'} not installed"
        raise LogError(path, "file", reason, how_to_install("ros"))
    accepted = f"a complete {path.suffix.lower()} file of ROS messages"
    with reader_errors_explained("file", accepted), open_apart(serve_bag, path) as opened:
        yield opened


MESSAGES_ACCEPTED = "a complete file of ROS messages"
"""Accepted where a message cannot be decoded."""


def list_channels(files: list[Path]) -> dict[str, BagChannel]:
    """The topics of a bag. Raises LogError: it is damaged, or a topic has several types."""
    channels: dict[str, BagChannel] = {}
    for file in files:
        with _open_file(file) as opened:
            for channel in [BagChannel(*names) for names in opened.call("channels")]:
                first = channels.setdefault(channel.topic, channel)
                if first != channel:
                    reason = f"has messages of {first.type} and {channel.type}"
                    raise LogError.at_field(channel.topic, reason, "one message type per topic")
    return channels


def messages_of(files: Sequence[Path], topics: Collection[str]) -> Iterator[tuple[str, int, bytes, float]]:
    """Topic, time of receipt [ns] and bytes of each message of some topics, and the share of the bag that was read.

    Raises:
        LogError: the bag is damaged, or the caller's decoding fails.
    """
    for number, file in enumerate(files):
        with _open_file(file) as opened:
            size = 0
            for topic, received, data, share in opened.stream("records", list(topics)):
                size += len(data)
                check_unpacked_size(file, size)
                yield topic, received, data, (number + share) / len(files)


ENCODINGS = ("cdr", "ros1")
"""Serializations that are read."""


def make_deserializer(topic: str, channel: BagChannel) -> Callable[[bytes], Any]:
    """The function that deserializes the messages of a channel, by definitions of ROS and Unitree, not the bag's own.

    Raises:
        LogError: an unknown serialization.
    """
    store = _typestore(channel.encoding)
    if store is None:
        raise LogError.at_field(topic, f"messages serialized as '{channel.encoding}'", "cdr (ROS 2) or ros1")
    if channel.encoding == "ros1":
        return lambda data: store.deserialize_ros1(data, channel.type)

    def deserialize(data: bytes) -> Any:
        if data.startswith(_ZSTD):
            raise LogError.at_field(topic, "each message is compressed", "a bag without message compression")
        return store.deserialize_cdr(data, channel.type)

    return deserialize


@cache
def _typestore(encoding: str) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    stores = {"ros1": Stores.ROS1_NOETIC, "cdr": Stores.ROS2_HUMBLE}  # the types read here never changed within ROS 2
    if encoding not in stores:
        return None
    store = get_typestore(stores[encoding])
    register(store, get_types_from_msg)
    return store


# ------------------------------------------------------------------------------------------------ messages of one topic


def _numbers(message: Any, path: str) -> list[float]:
    """The numbers in a part of a message, of a list of parts those of all; none where there is no such part."""
    value = message
    for name in path.split("."):
        if isinstance(value, list):
            value = [getattr(item, name) for item in value]
        else:
            value = value[int(name)] if name.isdigit() else getattr(value, name, [])
    if hasattr(value, "x"):  # a vector or a quaternion
        return [getattr(value, axis) for axis in "xyzw" if hasattr(value, axis)]
    return value.tolist() if isinstance(value, np.ndarray) else value if isinstance(value, list) else [value]


@dataclass(eq=False)
class _Rows:
    """Stamps [ns], or ticks, times of receipt [ns] and numbers of messages."""

    stamps: array[int] = field(default_factory=lambda: array("q"))
    received: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))


@dataclass(eq=False)
class _Messages:
    """Messages of a topic as rows of numbers in the order of receipt.

    Attributes:
        topic, type: its name and type.
        frame: `header.frame_id`, of an odometry `child_frame_id`, that all have; None before the first.
        rows: by the names of joints in a message, and how many numbers it has of each part.
    """

    topic: str
    type: str
    frame: str | None = None
    rows: dict[tuple[tuple[str, ...], tuple[int, ...]], _Rows] = field(default_factory=dict)

    def add(self, message: Any, received: int) -> None:
        """Add a message with its time of receipt [ns]."""
        self._check_frame(message)
        numbers = [_numbers(message, path) for path in _PATHS[self.type]]
        layout = (tuple(getattr(message, "name", ())), tuple(map(len, numbers)))
        if layout not in self.rows:
            check_names([len(layout[0])])
            for name in layout[0]:
                require_plain_name(name)
            self.rows[layout] = _Rows()
        rows = self.rows[layout]
        stamp = message.header.stamp if hasattr(message, "header") else None
        rows.stamps.append(getattr(message, "tick", 0) if stamp is None else stamp.sec * 10**9 + stamp.nanosec)
        rows.received.append(received)
        for part in numbers:
            rows.values.extend(part)
        if 8 * sum(len(rows.values) for rows in self.rows.values()) > MAX_ARRAYS:
            raise LogError.at_field(self.topic, "too many messages", f"at most {MAX_ARRAYS} bytes")

    def _check_frame(self, message: Any) -> None:
        if self.type not in (*IMUS, *ODOMETRIES, WRENCHES[0]):
            return
        name = "child_frame_id" if self.type in ODOMETRIES else "header.frame_id"
        frame = str(attrgetter(name)(message))
        if self.frame is None or not self.frame:
            self.frame = require_plain_name(frame)
        if frame != self.frame:
            reason = f"{name} '{self.frame}', then '{require_plain_name(frame)}'"
            raise LogError.at_field(self.topic, reason, f"one {name}")

    def parts(self, layout: tuple[tuple[str, ...], tuple[int, ...]]) -> _Parts:
        """The messages with one layout of arrays."""
        rows = self.rows[layout]
        values = np.array(rows.values, dtype=np.float64).reshape(len(rows.stamps), -1)
        values[np.isnan(values)] = np.nan  # signalling ones warn in the first operation
        split = np.split(values, np.cumsum(layout[1])[:-1], axis=1)
        stamps, received = (np.array(x, dtype=np.int64) for x in (rows.stamps, rows.received))
        return _Parts(stamps, received, dict(zip(_PATHS[self.type], split, strict=True)))

    def parts_of_all(self) -> _Parts:
        """All messages; LogError if there are none, or if their arrays differ in length."""
        if not self.rows:
            raise LogError.at_field(self.topic, "no messages", "at least one")
        layout, *others = self.rows
        if others:
            reason = f"arrays of {' and '.join(str(sum(lengths)) for _, lengths in self.rows)} numbers"
            raise LogError.at_field(self.topic, reason, "equally many numbers in every message")
        return self.parts(layout)


@dataclass(frozen=True, eq=False)
class _Parts:
    """Stamps (N,) [ns], or ticks, times of receipt (N,) [ns] and numbers (N, k) by part of messages."""

    stamps: Stamps
    received: Stamps
    numbers: dict[str, FloatArray]


@dataclass(frozen=True, eq=False)
class _TopicSeries:
    """What one role has of a topic: stamps (N,) [ns], strictly increasing, and fields of a log (N, ...).

    `stamped`: whether the stamps are those of the messages, not the times of receipt. `names`: of joints.
    """

    topic: str
    stamps: Stamps
    fields: Mapping[str, FloatArray]
    stamped: bool
    names: tuple[str, ...] = ()


def _series(topic: AnyTopic, messages: _Messages) -> _TopicSeries:
    """What a role has of a topic: its messages in the order of their stamps, without duplicates.

    Raises:
        LogError: there are no messages, several with the same stamp and different content, or such that do not fit.
        UnknownNameError: no message has the joints of `logs.topics.joint_states.joints`, or of `names`.

    Warns:
        TorchidWarning: duplicate messages.
    """
    names: tuple[str, ...] = ()
    if isinstance(topic, JointTopic):
        names, parts = _joint_parts(topic, messages)
        fields = parts.numbers
    else:
        parts = messages.parts_of_all()
        fields = _fields(topic, messages, parts.numbers)
    stamps = parts.stamps
    stamped = bool(stamps.any())
    if isinstance(topic, LowStateTopic):
        names = tuple(name for name in topic.order if name is not None)
        stamps, stamped = _low_state_stamps(topic, parts.stamps, parts.received)
    elif not stamped:
        stamps = parts.received
    if np.any(np.diff(stamps) < 0):
        order = np.argsort(stamps, kind="stable")
        stamps = stamps[order]
        fields = {name: x[order] for name, x in fields.items()}
    again = np.flatnonzero(np.diff(stamps) == 0) + 1
    if len(again):
        rows = np.concatenate([x[again] for x in fields.values()], axis=1).view(np.int64)
        differ = np.any(rows != np.concatenate([x[again - 1] for x in fields.values()], axis=1).view(np.int64), axis=1)
        if differ.any():
            reason = f"different messages with the same stamp, {stamps[again[np.argmax(differ)]] / 1e9:.9f} s"
            by_tick = f", or {_LOW_STATE}.stamps: receipt" * isinstance(topic, LowStateTopic)
            raise LogError.at_field(str(topic.topic), reason, "different stamps" + by_tick)
        warn_about_file(f"{topic.topic}: {len(again)} duplicate messages are ignored")
        stamps = np.delete(stamps, again)
        fields = {name: np.delete(x, again, axis=0) for name, x in fields.items()}
    return _TopicSeries(messages.topic, stamps, fields, stamped, names)


def _joint_parts(topic: JointTopic, messages: _Messages) -> tuple[tuple[str, ...], _Parts]:
    """Joints, and of the messages with these the fields that all have, in the order of the joints.

    Joints are those that are stated, else those of the first message; messages of other joints are skipped.
    """
    wanted = tuple(topic.joints or ())
    kept: list[_Parts] = []
    for layout, rows in messages.rows.items():
        given, lengths = layout
        names = tuple(topic.names.get(name, name) for name in given)
        wanted = wanted or names
        if topic.joints and not set(names) & set(wanted):
            continue
        _check_joints(topic, names, wanted)
        of_layout = [path for path, length in zip(_JOINT_FIELDS, lengths, strict=True) if length]
        common = list(kept[0].numbers) if kept else [_JOINT_FIELDS[path] for path in of_layout]
        if [_JOINT_FIELDS[path] for path in of_layout] != common or "position" not in of_layout:
            in_all = " and ".join(path for path, name in _JOINT_FIELDS.items() if name in common)
            reason = f"a message with {' and '.join(of_layout) or 'nothing'}"
            raise LogError.at_field(messages.topic, reason, f"positions, and {in_all or 'the same'} in every message")
        if any(length != len(names) for length in lengths if length):
            reason = f"{len(rows.values)} values in {len(rows.stamps)} messages of {len(names)} names"
            raise LogError.at_field(messages.topic, reason, f"one {' and one '.join(of_layout)} per name")
        parts = messages.parts(layout)
        order = [names.index(name) for name in wanted]
        fields = {_JOINT_FIELDS[path]: parts.numbers[path][:, order] for path in of_layout}
        kept.append(_Parts(parts.stamps, parts.received, fields))
    every = tuple(dict.fromkeys(name for given, _ in messages.rows for name in given))
    if not every:
        raise LogError.at_field(messages.topic, "no messages", "at least one")
    if not kept:
        raise UnknownNameError.at_field("logs.topics.joint_states.joints", wanted[0], every)
    for name in topic.names:
        if name not in every:
            raise UnknownNameError.at_field("logs.topics.joint_states.names", name, every)
    received = np.concatenate([parts.received for parts in kept])
    by_receipt = np.argsort(received, kind="stable") if len(kept) > 1 else slice(None)
    fields = {name: np.concatenate([x.numbers[name] for x in kept])[by_receipt] for name in kept[0].numbers}
    stamps = np.concatenate([parts.stamps for parts in kept])
    return wanted, _Parts(stamps[by_receipt], received[by_receipt], fields)


def _check_joints(topic: JointTopic, names: Sequence[str], wanted: Sequence[str]) -> None:
    """Refuse a message in which joints repeat, or that does not have all that are wanted."""
    if len(set(names)) != len(names):
        reason = f"repeated names: {', '.join(names[:4])}, ..."
        raise LogError.at_field(topic.topic, reason, "different joint names")
    missing = [name for name in wanted if name not in names]
    if missing or (not topic.joints and len(names) != len(wanted)):
        reason = f"a message without {missing[0]}" if missing else f"a message with {len(names)} joints"
        accepted = f"all {len(wanted)} joints in every message, or joint_states.joints with the joints that are"
        raise LogError.at_field(topic.topic, reason, accepted)


def _fields(topic: AnyTopic, messages: _Messages, parts: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """The fields of a log, or of one contact, in the parts (N, k) of messages."""
    if isinstance(topic, LowStateTopic):
        return _low_state_fields(topic, parts)
    if isinstance(topic, ImuTopic):
        return _imu_fields(topic, parts)
    if isinstance(topic, OdometryTopic):
        position, quat, linear, angular = parts.values()
        frame = {"child": "base", "world": "world"}.get(topic.twist)
        twist = {f"base_linear_velocity_{frame}": linear, f"base_angular_velocity_{frame}": angular}
        return {"base_position_world": position, "base_quat_xyzw": quat} | (twist if frame is not None else {})
    rows = np.concatenate(list(parts.values()), axis=1)
    if isinstance(topic, WrenchTopic):
        return {"wrench": topic.sign * rows}
    if not isinstance(topic, ForceTopic):
        return {"active": rows}
    column = ("fx", "fy", "fz").index(topic.component or "fz") if messages.type in WRENCHES else topic.index or 0
    if column >= rows.shape[1]:
        reason = f"an array of {rows.shape[1]} numbers has no index {column}"
        raise LogError.at_field(messages.topic, reason, f"an index from 0 to {rows.shape[1] - 1}")
    return {"force": topic.sign * rows[:, column : column + 1]}


def _imu_fields(topic: ImuTopic, parts: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Readings of an IMU; LogError where its driver says that it does not have one."""
    fields = ("imu_specific_force", "imu_angular_velocity", *["base_quat_xyzw"] * topic.orientation)
    out = dict(zip(fields, (parts[part] for part in _IMU_PARTS), strict=False))
    for part in _IMU_PARTS[: len(fields)]:
        if (parts[f"{part}_covariance.0"] == -1.0).any():
            accepted = "an IMU with both readings" if part != "orientation" else f"{_IMU}.orientation: false"
            raise LogError.at_field(topic.topic, f"no {part} (the first of its covariances is -1)", accepted)
    if topic.orientation:
        quat = out["base_quat_xyzw"]
        if len(quat) > 1 and not np.any(quat != quat[0]):
            reason = f"always the same orientation {np.round(quat[0], 3).tolist()}: the driver does not measure it"
            raise LogError.at_field(topic.topic, reason, f"measured orientations, or {_IMU}.orientation: false")
        out["base_quat_xyzw"] = require_unit(topic.topic, quat, _IMU)
    return out


# ------------------------------------------------------------------------------------------------- messages of Unitree

_LOW_STATE = "logs.topics.low_state"
#: Ticks may be off the times of receipt by this [ns], and by this share of the log: a network stalls, a clock drifts.
_MAX_TICK_ERROR_NS = 100_000_000
_MAX_TICK_ERROR_SHARE = 0.01
_MILLISECOND = 1_000_000
_WRAP = 1 << 32


def _check_low_state(topic: LowStateTopic, field: str, kind: str) -> None:
    """Refuse settings, of a field, that messages of a type do not fit.

    Raises:
        LogError: the robot has another type, there are fewer motors than joints, or no foot sensors.
    """
    robot = JOINT_ORDERS.get(topic.robot or "")
    if robot is not None and robot.message != kind:
        others = ", ".join(x for x, order in JOINT_ORDERS.items() if order.message == kind)
        reason = f"'{topic.robot}' sends {robot.message}, but {topic.topic} has {kind}"
        raise LogError.at_field(f"{field}.robot", reason, others)
    if len(topic.order) > MOTORS[kind]:
        reason = f"{len(topic.order)} names, but {kind} has {MOTORS[kind]} motors"
        raise LogError.at_field(f"{field}.joints", reason, f"at most {MOTORS[kind]} names, by motor number")
    if topic.reads_feet and kind != GO:
        key = "forces" if topic.forces else "above"
        raise LogError.at_field(f"{field}.{key}", f"set, but {kind} has no foot sensors", f"no {key}")


def _low_state_fields(topic: LowStateTopic, parts: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Fields (N, n) of the joints, (N, 3) and (N, 4) of the IMU, and the raw readings of feet (N, 4), if any.

    The accelerometer reads a specific force, +g upwards at rest. A quaternion that is always the same, as of a driver
    that does not set it, is none; it is given as others are (xyzw), so that an odometry takes its place.

    Raises:
        LogError: ankles and waist by motor rather than by joint, or quaternions of no length.
    """
    if (modes := parts["mode_pr"]).any():
        reason = f"mode_pr {modes[modes != 0.0][0]:g}: ankles and waist by parallel motors (A, B), not by joint"
        raise LogError.at_field(topic.topic, reason, "messages with mode_pr 0 (pitch and roll)")
    numbers = [number for number, name in enumerate(topic.order) if name is not None]
    names = {"q": "joint_position", "dq": "joint_velocity", "tau_est": "joint_torque"}
    out = {name: parts[f"motor_state.{part}"][:, numbers] for part, name in names.items()}
    if topic.frame is not None:
        out["imu_specific_force"] = parts["imu_state.accelerometer"]
        out["imu_angular_velocity"] = parts["imu_state.gyroscope"]
        wxyz = parts["imu_state.quaternion"]
        if topic.orientation and np.any(wxyz != wxyz[0]):
            out["base_quat_xyzw"] = np.roll(require_unit(topic.topic, wxyz, _LOW_STATE), -1, axis=1)
    feet = parts["foot_force"]
    return out | ({_FEET: feet} if feet.shape[1] else {})


def _low_state_stamps(topic: LowStateTopic, ticks: Stamps, received: Stamps) -> tuple[Stamps, bool]:
    """Stamps (N,) [ns] of messages, on the clock of the recording computer, and whether they are the robot's.

    The robot counts milliseconds since it was switched on, on a clock of its own, from 2^32 on again from 0. What
    that clock is off by is the median difference to the times of receipt.

    Args:
        topic: its settings.
        ticks: (N,) [ms] of the messages.
        received: (N,) [ns], times of receipt.

    Raises:
        LogError: ticks that are no milliseconds, where `stamps` does not say that they are meant.
    """
    constant = not np.any(np.diff(ticks))
    if topic.stamps == "receipt" or (topic.stamps is None and constant and (len(ticks) > 1 or not ticks.any())):
        return received, False
    steps = (np.diff(ticks) + _WRAP // 2) % _WRAP - _WRAP // 2
    elapsed = np.concatenate([[0], np.cumsum(steps)]) * _MILLISECOND
    late = received - received[0] - elapsed
    usual = int(np.clip(np.median(late), -(1 << 62), 1 << 62))  # also for receipts that no clock would give
    off = np.abs(late - usual)
    if topic.stamps is None and off.max() > _MAX_TICK_ERROR_NS + _MAX_TICK_ERROR_SHARE * np.ptp(received):
        reason = (
            f"ticks advance by {np.ptp(elapsed) / 1e9:.4g} s, but messages arrive over "
            f"{np.ptp(received) / 1e9:.4g} s; the largest difference is {off.max() / 1e9:.3g} s"
        )
        accepted = f"ticks of 1 ms, or {_LOW_STATE}.stamps: receipt (or tick, to use them)"
        raise LogError.at_field(topic.topic, reason, accepted)
    return np.asarray(received[:1] + usual + elapsed, dtype=np.int64), True


class _Recording:
    """The series of a bag by their roles, and the stamps (N,) [s] of the log.

    The stamps are those of one topic, within the time that all topics cover, from the first on: float64 seconds since
    1970 would have a resolution of 0.2 us.
    """

    def __init__(self, topics: Topics, series: Mapping[str, _TopicSeries], messages: Mapping[str, _Messages]) -> None:
        """Choose the stamps; LogError where there are none."""
        self.topics = topics
        self.series = series
        self._messages = messages
        sampled = [x for role, x in series.items() if not role.startswith(_FLAG_ROLE)]
        late = max(series.values(), key=lambda x: int(x.stamps[0]))
        early = min(sampled, key=lambda x: int(x.stamps[-1]))
        rate = series[topics.clock]
        stamps = rate.stamps[(rate.stamps >= late.stamps[0]) & (rate.stamps <= early.stamps[-1])]
        if not len(stamps):
            reason = (
                f"no time that all topics share with {rate.topic}: {late.topic} starts at {late.stamps[0] / 1e9:.3f}"
            )
            reason += f" s, {early.topic} ends at {early.stamps[-1] / 1e9:.3f} s"
            raise LogError.at_field("time", reason, "one common clock")
        self._origin = stamps[0]
        self.time: FloatArray = (stamps - self._origin) / 1e9

    def _in_seconds(self, series: _TopicSeries) -> Series:
        return Series(series.topic, (series.stamps - self._origin) / 1e9, series.fields, "bag")

    def aligned(self, role: str) -> dict[str, FloatArray]:
        """The fields of a role at the log's stamps, see `Series.at`."""
        return self._in_seconds(self.series[role]).at(self.time)

    def held(self, role: str, values: FloatArray) -> FloatArray:
        """The last values (K, ...) of a role's messages before each stamp, (N, ...)."""
        return self._in_seconds(self.series[role]).hold(values, self.time)

    def frame(self, role: str) -> str:
        """The frame of the messages of a role."""
        return self._messages[self.series[role].topic].frame or ""

    def motion(self) -> dict[str, NDArray[Any]]:
        """Joints, base and IMU."""
        out: dict[str, NDArray[Any]] = {}
        for role in ("joint_states", "low_state", "imu", "odometry"):  # of two orientations the last counts
            if role in self.series:
                out |= self.aligned(role)
            if role in self.series and self.series[role].names:
                out["joint_names"] = np.array(self.series[role].names, dtype=np.str_)
                out |= self._with_other_joints(out)
        if self.topics.odometry is not None:
            self._check_frame("odometry", self.topics.odometry.frame, "the robot's base link")
        if self.topics.imu is not None:
            frame = self.topics.imu.frame or self.frame("imu").removeprefix("/")
            if not frame:
                accepted = f"{_IMU}.frame: the robot's frame of the IMU"
                raise LogError.at_field(self.topics.imu.topic, "no header.frame_id", accepted)
            out["imu_frame"] = np.array(frame)
        out.pop(_FEET, None)
        if self.topics.low_state is not None and self.topics.low_state.frame is not None:
            out["imu_frame"] = np.array(self.topics.low_state.frame)
        return out

    def _with_other_joints(self, first: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """The fields of joints of all topics; torques are NaN, and velocities left out, where some topic has none."""
        parts = [first]
        for role in [role for role in self.topics.joint_topics if role != "joint_states"]:
            known = {name for part in parts for name in part["joint_names"].tolist()}
            if again := [name for name in self.series[role].names if name in known]:
                accepted = f"logs.topics.{role}.joints with only the joints of this topic"
                raise LogError.at_field(self.series[role].topic, f"joint '{again[0]}' is in two topics", accepted)
            parts.append(self.aligned(role) | {"joint_names": np.array(self.series[role].names, dtype=np.str_)})
        if len(parts) == 1:
            return {}
        both = ("joint_names", "joint_position")
        out = {name: np.concatenate([part[name] for part in parts], axis=-1) for name in both}
        if any("joint_torque" in part for part in parts):
            torques = [part.get("joint_torque", np.full_like(part["joint_position"], np.nan)) for part in parts]
            out["joint_torque"] = np.concatenate(torques, axis=1)
        given = [part["joint_velocity"] for part in parts if "joint_velocity" in part]
        if len(given) == len(parts):
            out["joint_velocity"] = np.concatenate(given, axis=1)
        elif given:
            warn_about_file("only some joint topics have velocities; all are derived from positions")
            first.pop("joint_velocity", None)
        return out

    def contacts(self) -> dict[str, NDArray[Any]]:
        """Contacts in the order of `Topics.contacts`; NaN for the wrench, or force, of one without a topic."""
        names = self.topics.contacts
        topics = self.topics
        if not names:
            return {}
        active = np.stack([self._active(name) for name in names], axis=1)
        out: dict[str, NDArray[Any]] = {"contact_names": np.array(names), "contact_active": active}
        if topics.contact_wrenches:
            out["contact_wrench_local"] = np.full((*active.shape, 6), np.nan)
            for name, topic in topics.contact_wrenches.items():
                out["contact_wrench_local"][:, names.index(name)] = self.aligned(f"contact_wrenches.{name}")["wrench"]
                self._check_frame(f"contact_wrenches.{name}", topic.frame or name)
        if topics.contacts_with_force:
            out["contact_force_normal"] = np.full(active.shape, np.nan)
            for name in topics.contacts_with_force:
                is_counted = name not in topics.contact_force_normal
                fields = self.aligned("low_state" if is_counted else f"contact_force_normal.{name}")
                force = fields[_FEET][:, topics.feet.index(name)] if is_counted else fields["force"][:, 0]
                out["contact_force_normal"][:, names.index(name)] = force
        return out

    def _active(self, name: str) -> NDArray[np.bool_]:
        """Whether a contact is active, (N,), by its last flag or its last force."""
        topics = self.topics
        flag = f"{_FLAG_ROLE}.{name}"
        low_state = topics.low_state
        always = np.ones(len(self.time), dtype=np.bool_)
        if name in topics.contact_active:
            has_topic = flag in self.series
            return self.held(flag, self.series[flag].fields["active"])[:, 0] != 0.0 if has_topic else always
        if name in topics.feet and low_state is not None and low_state.above is not None:
            counts = self.series["low_state"].fields[_FEET][:, topics.feet.index(name)]
            return self.held("low_state", counts) > low_state.above
        if topics.contact_force_threshold is None or name in topics.feet:  # flags are worked out later
            return always
        role = f"{'contact_wrenches' if name in topics.contact_wrenches else 'contact_force_normal'}.{name}"
        fields = self.series[role].fields
        with np.errstate(over="ignore"):  # infinite is above any threshold
            force = np.linalg.norm(fields["wrench"][:, :3], axis=1) if "wrench" in fields else fields["force"][:, 0]
        if np.isnan(force).any():
            reason = f"the force is NaN in message {np.argmax(np.isnan(force))}"
            accepted = "forces to compare with contact_force_threshold, or contact_active"
            raise LogError.at_field(self.series[role].topic, reason, accepted)
        return self.held(role, force) > topics.contact_force_threshold

    def limb_sensors(self) -> dict[str, NDArray[Any]]:
        """Force/torque sensors in limbs."""
        topics = self.topics.ft_wrenches
        if not topics:
            return {}
        for name, topic in topics.items():
            self._check_frame(f"ft_wrenches.{name}", topic.frame, f"the child frame of joint '{name}'")
        wrenches = [self.aligned(f"ft_wrenches.{name}")["wrench"] for name in topics]
        return {"ft_names": np.array(tuple(topics)), "ft_wrench": np.stack(wrenches, axis=1)}

    def _check_frame(self, role: str, expected: str | None, otherwise: str = "") -> None:
        """Warn of a pose or wrench whose frame is not confirmed; it is not transformed.

        The base link and the child links of fixed joints are defined by the URDF, which is not read here: without an
        expected frame, the warning names the assumed frame, `otherwise`.
        """
        frame = self.frame(role)
        if frame and (expected is None or frame.removeprefix("/") != expected.removeprefix("/")):
            taken_for = otherwise if expected is None else f"'{expected}'"
            text = f"frame '{frame}' is taken for {taken_for}; set logs.topics.{role}.frame to confirm it"
            warn_about_file(f"{self.series[role].topic}: {text}")


def read_bag(
    path: Path,
    topics: Topics | None,
    progress: Callable[[float], None] | None = None,
    needs_flags: bool = True,
) -> dict[str, NDArray[Any]]:
    """The fields of a log file, from a bag.

    Args:
        path: a .bag, .mcap or .db3 file, or the folder of several.
        topics: roles of the topics.
        progress: called with the share that has been read.
        needs_flags: as in `read_log`; a contact of which nothing says when it touches has flags that are all true else.

    Raises:
        LogError: the bag is damaged, or its messages do not make up a log.
        UnknownNameError: it has no such topic.

    Warns:
        TorchidWarning: messages without stamps, duplicate messages, channels that are NaN in some messages, a frame
            that is not the expected one, or a frame without an expected one.
    """
    files = list_bag_files(path)
    if topics is not None:
        check_topics(topics, needs_flags)
    channels = list_channels(files)
    if topics is None:
        listed = [f"{name} ({channel.type})" for name, channel in channels.items()]
        reason = f"missing; the bag has {join_names(listed, _LISTED) or 'no topics'}"
        raise LogError.at_field("logs.topics", reason, "a map of the topics; torchid init writes a first one")
    roles = {role: topic for role, topic in topics.by_role.items() if topic.topic is not None}
    for role, topic in roles.items():
        _check_type(f"logs.topics.{role}", topic, channels)
    messages = _read(files, channels, list(roles.values()), progress)
    series = {role: _series(topic, messages[str(topic.topic)]) for role, topic in roles.items()}
    if unstamped := dict.fromkeys(x.topic for x in series.values() if not x.stamped):
        problem = "no stamps in the messages; the log uses times of receipt, which are late and uneven"
        warn_about_file(f"{', '.join(unstamped)}: {problem}")
    recording = _Recording(topics, series, messages)
    return {"time": recording.time} | recording.motion() | recording.contacts() | recording.limb_sensors()


def _check_type(field: str, topic: AnyTopic, channels: Mapping[str, BagChannel]) -> None:
    """Make sure that a topic is there and has messages of a suitable type."""
    name = str(topic.topic)
    if name not in channels:
        raise UnknownNameError.at_field(field, name, channels)
    kind = channels[name].type
    if kind not in _TYPES[type(topic)]:
        instead = ", or logs.topics.low_state" * (kind in MOTORS)
        raise LogError.at_field(field, f"{name} has messages of {kind}", " or ".join(_TYPES[type(topic)]) + instead)
    if isinstance(topic, LowStateTopic):
        _check_low_state(topic, field, kind)
    if not isinstance(topic, ForceTopic):
        return
    if kind in NUMBER_ARRAYS and topic.index is None:
        reason = f"missing, but {name} has {kind}"
        raise LogError.at_field(f"{field}.index", reason, "the index of this contact's number, from 0 on")
    options = (("index", topic.index, NUMBER_ARRAYS), ("component", topic.component, WRENCHES))
    for option, value, kinds in options:
        if value is not None and kind not in kinds:
            reason = f"{value!r}, but {name} has {kind}"
            raise LogError.at_field(f"{field}.{option}", reason, f"no {option} for such messages")


def _read(
    files: Sequence[Path],
    channels: Mapping[str, BagChannel],
    topics: Sequence[AnyTopic],
    progress: Callable[[float], None] | None,
) -> dict[str, _Messages]:
    """Every message of the topics in use."""
    users = dict.fromkeys(str(topic.topic) for topic in topics)
    out = {name: _Messages(name, channels[name].type) for name in users}
    decoders = {name: make_deserializer(name, channels[name]) for name in users}
    for number, (name, received, data, share) in enumerate(messages_of(files, users)):
        with reader_errors_explained("file", MESSAGES_ACCEPTED):
            message = decoders[name](data)
            out[name].add(message, received)
        if progress is not None and number % _REPORT_EVERY == 0:
            progress(share)
    return out
