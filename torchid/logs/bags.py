"""Bags of ROS 1 and 2: messages of topics as arrays with stamps, and these as the fields of a log at common stamps.

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
_POSE, _TWIST = "pose.pose", "twist.twist"
_PARTS: dict[str, tuple[str, ...]] = {
    IMUS[0]: ("linear_acceleration", "angular_velocity", "orientation"),
    ODOMETRIES[0]: (f"{_POSE}.position", f"{_POSE}.orientation", f"{_TWIST}.linear", f"{_TWIST}.angular"),
    WRENCHES[0]: ("wrench.force", "wrench.torque"),
    WRENCHES[1]: ("force", "torque"),
}
"""Vectors of messages, in the order of their numbers in a row."""

_JOINT_FIELDS = {"position": "joint_position", "velocity": "joint_velocity", "effort": "joint_torque"}
_IMU = "logs.topics.imu"
_ZSTD = b"\x28\xb5\x2f\xfd"
_PACKAGES = ("rosbags", "mcap", "lz4", "zstandard")
_FLAG_ROLE, _FEET = "contact_active", "foot_force"
_REPORT_EVERY, _LISTED = 1000, 30  # messages between reports of progress, topics in a message


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
        found = f"a bag, but {' and '.join(absent)} {'are' if len(absent) > 1 else 'is'} not installed"
        raise LogError(path, "file", found, how_to_install("ros"))
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
                    found = f"both {first.type} and {channel.type}"
                    raise LogError.at_field(channel.topic, found, "one type of message per topic")
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
            raise LogError.at_field(topic, "messages compressed one by one", "a bag without message compression")
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


@dataclass(eq=False)
class _Messages:
    """Messages of a topic as rows of numbers in the order of receipt, those of joints by their names.

    Attributes:
        topic, type: its name and type.
        frame: `header.frame_id`, of an odometry `child_frame_id`, that all have; None before the first.
        rows: by names of joints and the parts that messages have of each, or the length of an array, else ().
    """

    topic: str
    type: str
    frame: str | None = None
    rows: dict[tuple[Any, ...], _Rows] = field(default_factory=dict)

    def add(self, message: Any, received: int, row: Callable[[Any], FloatArray]) -> None:
        """Add a message with its time of receipt [ns]; `row`: its numbers."""
        self._check_frame(message)
        parts = tuple(x for x in _JOINT_FIELDS if self.type in JOINT_STATES and len(getattr(message, x)))
        key: tuple[Any, ...] = (tuple(message.name), parts) if self.type in JOINT_STATES else ()
        key = (len(message.data),) if self.type in NUMBER_ARRAYS else key
        if key not in self.rows:
            for name in key[0] if self.type in JOINT_STATES else ():
                check_names([len(key[0])])
                require_plain_name(name)
            self.rows[key] = _Rows()
        stamp = message.header.stamp if hasattr(message, "header") else None
        number = getattr(message, "tick", 0) if stamp is None else stamp.sec * 10**9 + stamp.nanosec
        self.rows[key].add(number, received, row(message))
        if 8 * sum(len(rows.values) for rows in self.rows.values()) > MAX_ARRAYS:
            raise LogError.at_field(self.topic, "more messages than fit", f"{MAX_ARRAYS} bytes")

    def _check_frame(self, message: Any) -> None:
        if self.type not in (*IMUS, *ODOMETRIES, WRENCHES[0]):
            return
        name = "child_frame_id" if self.type in ODOMETRIES else "header.frame_id"
        frame = str(attrgetter(name)(message))
        if self.frame is None or not self.frame:
            self.frame = require_plain_name(frame)
        if frame != self.frame:
            found = f"{name} '{self.frame}', then '{require_plain_name(frame)}'"
            raise LogError.at_field(self.topic, found, f"one {name}")


@dataclass(eq=False)
class _Rows:
    """Stamps [ns], or ticks, times of receipt [ns] and numbers of messages."""

    stamps: array[int] = field(default_factory=lambda: array("q"))
    received: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))

    def add(self, stamp: int, received: int, row: FloatArray) -> None:
        self.stamps.append(stamp)
        self.received.append(received)
        self.values.frombytes(np.asarray(row, dtype=np.float64).tobytes())

    def arrays(self) -> tuple[Stamps, Stamps, FloatArray]:
        """The stamps (N,), the times of receipt (N,) and the numbers (N, k)."""
        count = len(self.stamps)
        values = np.array(self.values, dtype=np.float64).reshape(count, -1) if count else np.zeros((0, 0))
        return np.array(self.stamps, dtype=np.int64), np.array(self.received, dtype=np.int64), values


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


def _vectors(message: Any, parts: Sequence[str]) -> FloatArray:
    """The numbers of the vectors and quaternions (xyzw) of a message."""
    vectors = [attrgetter(part)(message) for part in parts]
    return np.array([getattr(x, axis) for x in vectors for axis in ("x", "y", "z", "w") if hasattr(x, axis)])


def _row_maker(topic: AnyTopic, kind: str) -> Callable[[Any], FloatArray]:
    """The function that gives the numbers of a message of a type."""
    if isinstance(topic, LowStateTopic):
        return LowState(topic).row
    if kind in _PARTS:
        return lambda message: _vectors(message, _PARTS[kind])
    if kind in JOINT_STATES:
        return _joint_row
    return lambda message: np.atleast_1d(np.asarray(message.data, dtype=np.float64))


def _joint_row(message: Any) -> FloatArray:
    return np.concatenate([np.asarray(getattr(message, part), dtype=np.float64) for part in _JOINT_FIELDS])


def _series(topic: AnyTopic, messages: _Messages) -> _TopicSeries:
    """What a role has of a topic: its messages in the order of their stamps, without duplicates.

    Raises:
        LogError: there are no messages, several with the same stamp and different content, or such that do not fit.
        UnknownNameError: no message has the joints of `logs.topics.joint_states.joints`, or of `names`.

    Warns:
        TorchidWarning: duplicate messages.
    """
    names: tuple[str, ...] = ()
    parts: tuple[str, ...] = ()
    if isinstance(topic, JointTopic):
        names, parts, (stamps, received, rows) = _joint_rows(topic, messages)
    else:
        if len(messages.rows) > 1:
            found = f"arrays of {' and '.join(str(key[0]) for key in messages.rows)} numbers"
            raise LogError.at_field(messages.topic, found, "as many in every message")
        stamps, received, rows = next(iter(messages.rows.values()), _Rows()).arrays()
    if not len(stamps):
        raise LogError.at_field(messages.topic, "no messages", "at least one")
    if isinstance(topic, ImuTopic) and not topic.orientation:
        rows = rows[:, :6]
    stamped = bool(stamps.any())
    if isinstance(topic, LowStateTopic):
        stamps, stamped = LowState(topic).stamps(stamps, received)
    elif not stamped:
        stamps = received
    stamps, rows = _in_order(topic, stamps, rows)
    if isinstance(topic, JointTopic):
        fields = dict(zip([_JOINT_FIELDS[part] for part in parts], np.split(rows, len(parts), axis=1), strict=True))
    else:
        fields = _fields(topic, messages, rows)
        names = LowState(topic).names if isinstance(topic, LowStateTopic) else ()
    return _TopicSeries(messages.topic, stamps, fields, stamped, names)


def _in_order(topic: AnyTopic, stamps: Stamps, rows: FloatArray) -> tuple[Stamps, FloatArray]:
    """Messages in the order of their stamps, each stamp once."""
    if np.any(np.diff(stamps) < 0):
        order = np.argsort(stamps, kind="stable")
        stamps, rows = stamps[order], rows[order]
    again = np.flatnonzero(np.diff(stamps) == 0) + 1
    if len(again):
        differ = np.any(rows[again].view(np.int64) != rows[again - 1].view(np.int64), axis=1)
        if differ.any():
            at = stamps[again[np.argmax(differ)]] / 1e9
            found = f"messages of different content with one stamp, {at:.9f} s"
            by_tick = ", or logs.topics.low_state.stamps: receipt" * isinstance(topic, LowStateTopic)
            raise LogError.at_field(str(topic.topic), found, "every stamp once" + by_tick)
        warn_about_file(f"{topic.topic}: {len(again)} messages come twice; each counts once")
        stamps, rows = np.delete(stamps, again), np.delete(rows, again, axis=0)
    return stamps, rows


def _joint_rows(
    topic: JointTopic, messages: _Messages
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[Stamps, Stamps, FloatArray]]:
    """Joints, the parts that all messages with these have, and these messages in the order of the joints.

    Joints are those that are stated, else those of the first message; messages of other joints are skipped.
    """
    wanted = tuple(topic.joints or ())
    kept: list[tuple[Stamps, Stamps, FloatArray]] = []
    common: tuple[str, ...] = ()
    for (given, parts), rows in messages.rows.items():
        names = tuple(topic.names.get(name, name) for name in given)
        wanted = wanted or names
        if topic.joints and not set(names) & set(wanted):
            continue
        _check_joints(topic, names, wanted)
        common = common or parts
        if parts != common or "position" not in parts:
            found = f"a message with {' and '.join(parts) or 'nothing'}"
            accepted = f"positions, and in every message {' and '.join(common) or 'the same'}"
            raise LogError.at_field(messages.topic, found, accepted)
        if len(rows.values) != len(rows.stamps) * len(parts) * len(names):
            found = f"{len(rows.values)} values in {len(rows.stamps)} messages of {len(names)} names"
            raise LogError.at_field(messages.topic, found, f"one {' and one '.join(parts)} per name")
        stamps, received, values = rows.arrays()
        order = [names.index(name) for name in wanted]
        ordered = values.reshape(len(stamps), len(parts), len(names))[:, :, order]
        kept.append((stamps, received, ordered.reshape(len(stamps), -1)))
    every = tuple(dict.fromkeys(name for given, _ in messages.rows for name in given))
    if not kept and wanted and every:
        raise UnknownNameError.at_field("logs.topics.joint_states.joints", wanted[0], every)
    for name in topic.names if kept else ():
        if name not in every:
            raise UnknownNameError.at_field("logs.topics.joint_states.names", name, every)
    if not kept:
        return wanted, common, _Rows().arrays()
    stamps, received, values = (np.concatenate(arrays) for arrays in zip(*kept, strict=True))
    if len(kept) > 1:
        order_of_receipt = np.argsort(received, kind="stable")
        stamps, received, values = stamps[order_of_receipt], received[order_of_receipt], values[order_of_receipt]
    return wanted, common, (stamps, received, values)


def _check_joints(topic: JointTopic, names: Sequence[str], wanted: Sequence[str]) -> None:
    """Refuse a message in which joints repeat, or that does not have all that are wanted."""
    if len(set(names)) != len(names):
        found = f"names {', '.join(names[:4])}, ... that repeat"
        raise LogError.at_field(topic.topic, found, "joints of different names")
    missing = [name for name in wanted if name not in names]
    if missing or (not topic.joints and len(names) != len(wanted)):
        found = f"a message without {missing[0]}" if missing else f"a message with {len(names)} joints"
        accepted = f"all {len(wanted)} joints in every message, or joint_states.joints with those that are"
        raise LogError.at_field(topic.topic, found, accepted)


def _fields(topic: AnyTopic, messages: _Messages, rows: FloatArray) -> dict[str, FloatArray]:
    """The fields of a log, or of one contact, in the rows (N, k) of messages."""
    if isinstance(topic, LowStateTopic):
        return LowState(topic).fields(rows, messages.type)
    if isinstance(topic, ImuTopic):
        out = {"imu_specific_force": rows[:, :3], "imu_angular_velocity": rows[:, 3:6]}
        if topic.orientation:
            if len(rows) > 1 and not np.any(rows[:, 6:] != rows[0, 6:]):
                found = f"one orientation throughout, {np.round(rows[0, 6:], 3).tolist()}, as of a driver without any"
                raise LogError.at_field(messages.topic, found, f"orientations, or {_IMU}.orientation: false")
            out["base_quat_xyzw"] = require_unit(messages.topic, rows[:, 6:], _IMU)
        return out
    if isinstance(topic, OdometryTopic):
        out = {"base_position_world": rows[:, :3], "base_quat_xyzw": rows[:, 3:7]}
        frame = {"child": "base", "world": "world"}.get(topic.twist)
        if frame is not None:
            out[f"base_linear_velocity_{frame}"] = rows[:, 7:10]
            out[f"base_angular_velocity_{frame}"] = rows[:, 10:]
        return out
    if not isinstance(topic, (WrenchTopic, ForceTopic)):
        return {"active": rows}
    signed = rows if topic.sign == 1 else -rows
    if isinstance(topic, WrenchTopic):
        return {"wrench": signed}
    column = ("fx", "fy", "fz").index(topic.component or "fz") if messages.type in WRENCHES else topic.index or 0
    if column >= rows.shape[1]:
        found = f"an array of {rows.shape[1]} numbers, without index {column}"
        raise LogError.at_field(messages.topic, found, "an index below that, from 0 on")
    return {"force": signed[:, column : column + 1]}


def _check_message(topic: AnyTopic, name: str, message: Any) -> None:
    """Refuse a message of an IMU whose driver says that it does not have a reading."""
    if not isinstance(topic, ImuTopic):
        return
    for part in ("linear_acceleration", "angular_velocity", *["orientation"] * topic.orientation):
        if getattr(message, f"{part}_covariance")[0] == -1.0:
            accepted = "an IMU with both" if part != "orientation" else f"{_IMU}.orientation: false"
            raise LogError.at_field(name, f"no {part} (the first of its covariances is -1)", accepted)


# ----------------------------------------------------------------------------------------------------- fields of a log


# ---------------------------------------------------------------------------------------------- messages of Unitree

_LOW_STATE = "logs.topics.low_state"
#: Ticks may be off the times of receipt by this [ns], and by this share of the log: a network stalls, a clock drifts.
_MAX_TICK_ERROR_NS = 100_000_000
_MAX_TICK_ERROR_SHARE = 0.01
_MILLISECOND, _WRAP = 1_000_000, 1 << 32


class LowState:
    """`unitree_go/LowState` or `unitree_hg/LowState`; the accelerometer reads a specific force, +g upwards at rest."""

    types: tuple[str, ...] = tuple(MOTORS)

    def __init__(self, topic: LowStateTopic) -> None:
        """For the messages of a topic, with the motors of a robot or as they are listed."""
        self._topic, self._settings = topic.topic, topic
        self._order = list(topic.order)
        self.names = tuple(name for name in self._order if name is not None)

    def check_options(self, field: str, kind: str) -> None:
        """Refuse settings, of a field, that messages of a type do not fit.

        Raises:
            LogError: the robot has another type, there are fewer motors than joints, or no foot sensors.
        """
        robot, name = JOINT_ORDERS.get(self._settings.robot or ""), self._settings.robot
        if robot is not None and robot.message != kind:
            others = ", ".join(x for x, order in JOINT_ORDERS.items() if order.message == kind)
            found = f"'{name}', which sends {robot.message}, though {self._topic} carries {kind}"
            raise LogError.at_field(f"{field}.robot", found, others)
        if len(self._order) > MOTORS[kind]:
            found = f"{len(self._order)} names, though {kind} has {MOTORS[kind]} motors"
            raise LogError.at_field(f"{field}.joints", found, "at most that many, by number of the motor")
        if self._settings.reads_feet and kind != GO:
            key = "forces" if self._settings.forces else "above"
            raise LogError.at_field(f"{field}.{key}", f"set, though {kind} has no foot sensors", f"no {key}")

    def row(self, message: Any) -> FloatArray:
        """Position, velocity and torque of every motor, specific force, angular velocity, quaternion, foot sensors.

        Raises:
            LogError: ankles and waist by motor rather than by joint.
        """
        if getattr(message, "mode_pr", 0):
            found = f"mode_pr {message.mode_pr}: ankles and waist by their parallel motors (A, B), not by joint"
            raise LogError.at_field(self._topic, found, "messages with mode_pr 0: pitch and roll")
        motors, imu = message.motor_state, message.imu_state
        values = [*(x.q for x in motors), *(x.dq for x in motors), *(x.tau_est for x in motors)]
        arrays = imu.accelerometer, imu.gyroscope, imu.quaternion, getattr(message, "foot_force", np.array([]))
        return np.array([*values, *(x for array in arrays for x in array.tolist())], dtype=np.float64)

    def fields(self, rows: FloatArray, kind: str) -> dict[str, FloatArray]:
        """Fields (N, n) of the joints, (N, 3) and (N, 4) of the IMU, and the raw readings of feet (N, 4), if any.

        Raises:
            LogError: quaternions of no length.
        """
        count = MOTORS[kind]
        motors = rows[:, : 3 * count].reshape(len(rows), 3, count)
        joints = motors[:, :, [number for number, name in enumerate(self._order) if name is not None]]
        out = dict(zip(("joint_position", "joint_velocity", "joint_torque"), joints.transpose(1, 0, 2), strict=True))
        if self._settings.frame is not None:
            out["imu_specific_force"] = rows[:, 3 * count : 3 * count + 3]
            out["imu_angular_velocity"] = rows[:, 3 * count + 3 : 3 * count + 6]
            out |= self._orientation(rows[:, 3 * count + 6 : 3 * count + 10])
        if rows.shape[1] > 3 * count + 10:
            out["foot_force"] = rows[:, 3 * count + 10 :]
        return out

    def _orientation(self, wxyz: FloatArray) -> dict[str, FloatArray]:
        """The base's orientation; nothing where quaternions are always the same, as of a driver that does not set them.

        They are in the order in which others' come (xyzw), so that an odometry takes their place.
        """
        if not self._settings.orientation or not np.any(wxyz != wxyz[0]):
            return {}
        return {"base_quat_xyzw": np.roll(require_unit(self._topic, wxyz, _LOW_STATE), -1, axis=1)}

    # ------------------------------------------------------------------------------------------------------- stamps

    def stamps(self, ticks: NDArray[np.int64], received: NDArray[np.int64]) -> tuple[NDArray[np.int64], bool]:
        """Stamps (N,) [ns] of messages, on the clock of the recording computer, and whether they are the robot's.

        The robot counts milliseconds since it was switched on, on a clock of its own, from 2^32 on again from 0. What
        that clock is off by is the median difference to the times of receipt.

        Args:
            ticks: (N,) [ms] of the messages.
            received: (N,) [ns], times of receipt.

        Raises:
            LogError: ticks that are no milliseconds, where `stamps` does not say that they are meant.
        """
        wanted, constant = self._settings.stamps, not np.any(np.diff(ticks))
        if wanted == "receipt" or (wanted is None and constant and (len(ticks) > 1 or not ticks.any())):
            return received, False
        steps = (np.diff(ticks) + _WRAP // 2) % _WRAP - _WRAP // 2
        elapsed = np.concatenate([[0], np.cumsum(steps)]) * _MILLISECOND
        late = received - received[0] - elapsed
        usual = int(np.clip(np.median(late), -(1 << 62), 1 << 62))  # also for receipts that no clock would give
        off = np.abs(late - usual)
        if wanted is None and off.max() > _MAX_TICK_ERROR_NS + _MAX_TICK_ERROR_SHARE * np.ptp(received):
            found = (
                f"ticks that advance by {np.ptp(elapsed) / 1e9:.4g} s while messages come for "
                f"{np.ptp(received) / 1e9:.4g} s, and are off by up to {off.max() / 1e9:.3g} s"
            )
            accepted = f"ticks of 1 ms, or {_LOW_STATE}.stamps: receipt, or tick where these are right"
            raise LogError.at_field(self._topic, found, accepted)
        return np.asarray(received[:1] + usual + elapsed, dtype=np.int64), True


class _Recording:
    """The series of a bag by their roles, and the stamps (N,) [s] of the log.

    The stamps are those of one topic, within the time that all topics cover, from the first on: float64 seconds since
    1970 would have a resolution of 0.2 us.
    """

    def __init__(self, topics: Topics, series: Mapping[str, _TopicSeries], messages: Mapping[str, _Messages]) -> None:
        """Choose the stamps; LogError where there are none."""
        self.topics, self.series, self._messages = topics, series, messages
        sampled = [x for role, x in series.items() if not role.startswith(_FLAG_ROLE)]
        late = max(series.values(), key=lambda x: int(x.stamps[0]))
        early = min(sampled, key=lambda x: int(x.stamps[-1]))
        rate = series[topics.clock]
        stamps = rate.stamps[(rate.stamps >= late.stamps[0]) & (rate.stamps <= early.stamps[-1])]
        if not len(stamps):
            found = f"no stamp of {rate.topic} that all topics cover: {late.topic} starts at {late.stamps[0] / 1e9:.3f}"
            found += f" s, {early.topic} ends at {early.stamps[-1] / 1e9:.3f} s"
            raise LogError.at_field("time", found, "one common clock")
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
                accepted = f"{_IMU}.frame, the robot's frame it sits at"
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
                accepted = f"logs.topics.{role}.joints, those that no other topic has"
                raise LogError.at_field(self.series[role].topic, f"joint '{again[0]}', of another topic too", accepted)
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
            warn_about_file("velocities of some topics of joints alone: left out, and derived from positions")
            first.pop("joint_velocity", None)
        return out

    def contacts(self) -> dict[str, NDArray[Any]]:
        """Contacts in the order of `Topics.contacts`; NaN for the wrench, or force, of one without a topic."""
        names, topics = self.topics.contacts, self.topics
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
        flag, low_state = f"{_FLAG_ROLE}.{name}", topics.low_state
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
            found = f"a force of NaN in message {np.argmax(np.isnan(force))}"
            accepted = "forces to compare with contact_force_threshold, or contact_active"
            raise LogError.at_field(self.series[role].topic, found, accepted)
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
        found = self.frame(role)
        if found and (expected is None or found.removeprefix("/") != expected.removeprefix("/")):
            taken_for = otherwise if expected is None else f"'{expected}'"
            text = f"frame '{found}', taken to be {taken_for}; logs.topics.{role}.frame says that this is meant"
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
        found = f"missing; the bag has {join_names(listed, _LISTED) or 'no topics'}"
        raise LogError.at_field("logs.topics", found, "what its topics hold, of which torchid init writes a first map")
    roles = {role: topic for role, topic in topics.by_role.items() if topic.topic is not None}
    for role, topic in roles.items():
        _check_type(f"logs.topics.{role}", topic, channels)
    messages = _read(files, channels, list(roles.values()), progress)
    series = {role: _series(topic, messages[str(topic.topic)]) for role, topic in roles.items()}
    if unstamped := dict.fromkeys(x.topic for x in series.values() if not x.stamped):
        problem = "no stamps in the messages: the log takes the times of receipt, which are late and uneven"
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
        instead = ", or logs.topics.low_state" * (kind in LowState.types)
        raise LogError.at_field(field, f"{name} carries {kind}", " or ".join(_TYPES[type(topic)]) + instead)
    if isinstance(topic, LowStateTopic):
        LowState(topic).check_options(field, kind)
    if not isinstance(topic, ForceTopic):
        return
    if kind in NUMBER_ARRAYS and topic.index is None:
        found = f"missing, though {name} carries {kind}"
        raise LogError.at_field(f"{field}.index", found, "which of its numbers is this contact's, from 0 on")
    options = (("index", topic.index, NUMBER_ARRAYS), ("component", topic.component, WRENCHES))
    for option, value, kinds in options:
        if value is not None and kind not in kinds:
            found = f"{value!r}, though {name} carries {kind}"
            raise LogError.at_field(f"{field}.{option}", found, f"no {option} of such a message")


def _read(
    files: Sequence[Path],
    channels: Mapping[str, BagChannel],
    topics: Sequence[AnyTopic],
    progress: Callable[[float], None] | None,
) -> dict[str, _Messages]:
    """Every message of the topics in use."""
    users: dict[str, list[AnyTopic]] = {}
    for topic in topics:
        users.setdefault(str(topic.topic), []).append(topic)
    out = {name: _Messages(name, channels[name].type) for name in users}
    makers = {name: _row_maker(used[0], channels[name].type) for name, used in users.items()}
    decoders = {name: make_deserializer(name, channels[name]) for name in users}
    for number, (name, received, data, share) in enumerate(messages_of(files, users)):
        with reader_errors_explained("file", MESSAGES_ACCEPTED):
            message = decoders[name](data)
            for topic in users[name]:
                _check_message(topic, name, message)
            out[name].add(message, received, makers[name])
        if progress is not None and number % _REPORT_EVERY == 0:
            progress(share)
    return out
