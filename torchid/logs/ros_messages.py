"""Decoders of message types to rows of numbers, and time series of the messages of a topic."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, UnknownNameError, warn_about_file
from torchid.guards import MAX_ARRAYS, check_names, require_plain_name
from torchid.logs.log import FloatArray
from torchid.logs.quaternion import require_unit
from torchid.logs.unitree import LowState, register

if TYPE_CHECKING:
    from torchid.logs.ros_files import BagChannel

_IMU = "logs.topics.imu"
_ZSTD = b"\x28\xb5\x2f\xfd"
_JOINT_FIELDS = {"position": "joint_position", "velocity": "joint_velocity", "effort": "joint_torque"}


class Decoder(Protocol):
    """Turns the messages of one topic into rows of equal length, and the rows into fields of a log."""

    types: tuple[str, ...]

    def row(self, message: Any) -> FloatArray | None:
        """The numbers (k,) of a message; None for one to be skipped. LogError for one that does not fit."""

    def fields(self, rows: FloatArray) -> dict[str, FloatArray]:
        """The fields of a log in rows (N, k)."""


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


class _Constant:
    """A text that must be the same in all messages of a topic."""

    def __init__(self, topic: str, field: str) -> None:
        self._topic, self._field, self.value = topic, field, ""

    def check(self, value: str) -> None:
        self.value = self.value or require_plain_name(value)
        if value != self.value:
            raise LogError.at_field(
                self._topic, f"{self._field} '{self.value}', then '{require_plain_name(value)}'", f"one {self._field}"
            )


class JointStates:
    """`sensor_msgs/JointState`: joints by name, in any order that may change from message to message."""

    types: tuple[str, ...] = ("sensor_msgs/msg/JointState",)

    def __init__(self, topic: str, joints: list[str] | None, called: Mapping[str, str]) -> None:
        """Use the given joints, or those of the first message; names are those of the URDF by those of messages."""
        self.names, self._called = tuple(joints or ()), called
        self._given, self._topic = joints is not None, topic
        self._parts: tuple[str, ...] = ()
        self._orders: dict[tuple[str, ...], list[int] | slice | None] = {}

    @property
    def other_joints(self) -> tuple[str, ...]:
        """Joints of skipped messages."""
        left_out = (names for names, order in self._orders.items() if order is None)
        return tuple(dict.fromkeys(name for names in left_out for name in names))

    def check_names(self) -> None:
        """Refuse a name for a joint that no message has."""
        met = tuple(dict.fromkeys(name for names in self._orders for name in names))
        for name in self._called:
            if name not in met:
                raise UnknownNameError.at_field("logs.topics.joint_states.names", name, met)

    def row(self, message: Any) -> FloatArray | None:
        """Position, velocity and effort, as far as present, of every joint; None for messages of other joints."""
        names = tuple(message.name)
        if names not in self._orders:
            check_names([len(names)])
            for name in names:
                require_plain_name(name)
            self._orders[names] = self._order(names)
        order = self._orders[names]
        if order is None:
            return None
        parts = tuple(part for part in _JOINT_FIELDS if len(getattr(message, part)))
        self._parts = self._parts or parts
        if parts != self._parts or "position" not in parts:
            found = f"a message with {' and '.join(parts) or 'nothing'}"
            accepted = f"positions, and in every message {' and '.join(self._parts) or 'the same'}"
            raise LogError.at_field(self._topic, found, accepted)
        values = [getattr(message, part) for part in parts]
        if any(len(x) != len(names) for x in values):
            raise LogError.at_field(
                self._topic, f"{[len(x) for x in values]} values of {len(names)} names", "one per name"
            )
        return np.concatenate([x[order] for x in values])

    def _order(self, names: tuple[str, ...]) -> list[int] | slice | None:
        names = tuple(self._called.get(name, name) for name in names)
        if len(set(names)) != len(names):
            raise LogError.at_field(
                self._topic, f"names {', '.join(names[:4])}, ... that repeat", "joints of different names"
            )
        self.names = self.names or names
        known = {name: i for i, name in enumerate(names)}
        missing = [name for name in self.names if name not in known]
        if self._given and len(missing) == len(self.names):
            return None
        if missing or (not self._given and len(names) != len(self.names)):
            found = f"a message without {missing[0]}" if missing else f"a message with {len(names)} joints"
            accepted = f"all {len(self.names)} joints in every message, or joint_states.joints with those that are"
            raise LogError.at_field(self._topic, found, accepted)
        order = [known[name] for name in self.names]
        return slice(None) if order == list(range(len(names))) else order  # a slice avoids a copy

    def fields(self, rows: FloatArray) -> dict[str, FloatArray]:
        """Fields (N, n)."""
        parts = np.split(rows, max(len(self._parts), 1), axis=1)
        return {_JOINT_FIELDS[part]: values for part, values in zip(self._parts, parts, strict=False)}


class Imu:
    """`sensor_msgs/Imu`: its linear acceleration is a specific force, which reads +g upwards at rest.

    Its orientation, if it is wanted, is the base's; not of messages that are always the same, whose driver does not set
    it.
    """

    types: tuple[str, ...] = ("sensor_msgs/msg/Imu",)

    def __init__(self, topic: str, orientation: bool = False) -> None:
        """For the messages of a topic, whose orientation may be wanted."""
        self.frame, self._topic = _Constant(topic, "header.frame_id"), topic
        self._turning = ("orientation",) * orientation

    def row(self, message: Any) -> FloatArray:
        """Specific force, angular velocity and orientation (xyzw)."""
        self.frame.check(message.header.frame_id)
        for part in ("linear_acceleration", "angular_velocity", *self._turning):
            if getattr(message, f"{part}_covariance")[0] == -1.0:
                accepted = "an IMU with both" if part != "orientation" else f"{_IMU}.orientation: false"
                raise LogError.at_field(self._topic, f"no {part} (the first of its covariances is -1)", accepted)
        turn = message.orientation
        readings = *_vector(message.linear_acceleration), *_vector(message.angular_velocity)
        return np.array([*readings, turn.x, turn.y, turn.z, turn.w])

    def fields(self, rows: FloatArray) -> dict[str, FloatArray]:
        """Fields (N, 3), and the orientation (N, 4) if it is wanted.

        Raises:
            LogError: orientations that are wanted, but are none or always the same.
        """
        out = {"imu_specific_force": rows[:, :3], "imu_angular_velocity": rows[:, 3:6]}
        if self._turning:
            if len(rows) > 1 and not np.any(rows[:, 6:] != rows[0, 6:]):
                found = f"one orientation throughout, {np.round(rows[0, 6:], 3).tolist()}, as of a driver without any"
                raise LogError.at_field(self._topic, found, f"orientations, or {_IMU}.orientation: false")
            out["base_quat_xyzw"] = require_unit(self._topic, rows[:, 6:], _IMU)
        return out


class Odometry:
    """`nav_msgs/Odometry` of the base link: its twist is in the child frame unless its driver says otherwise."""

    types: tuple[str, ...] = ("nav_msgs/msg/Odometry",)

    def __init__(self, topic: str, twist: str) -> None:
        """With the twist in the frame `child` or `world`, or `none`."""
        self.frame, self._twist = _Constant(topic, "child_frame_id"), twist

    def row(self, message: Any) -> FloatArray:
        """Position, orientation (xyzw), linear and angular velocity."""
        self.frame.check(message.child_frame_id)
        pose, twist, turn = message.pose.pose, message.twist.twist, message.pose.pose.orientation
        quat = (turn.x, turn.y, turn.z, turn.w)
        return np.array([*_vector(pose.position), *quat, *_vector(twist.linear), *_vector(twist.angular)])

    def fields(self, rows: FloatArray) -> dict[str, FloatArray]:
        """Fields (N, 3) and (N, 4)."""
        out = {"base_position_world": rows[:, :3], "base_quat_xyzw": rows[:, 3:7]}
        if self._twist != "none":
            frame = "base" if self._twist == "child" else "world"
            out[f"base_linear_velocity_{frame}"] = rows[:, 7:10]
            out[f"base_angular_velocity_{frame}"] = rows[:, 10:]
        return out


class Wrench:
    """`geometry_msgs/WrenchStamped`, or `Wrench`, which has neither stamp nor frame."""

    types: tuple[str, ...] = ("geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/Wrench")

    def __init__(self, topic: str, sign: int) -> None:
        """With the sign that turns it into the action of the environment or of the parent side."""
        self.frame, self._sign = _Constant(topic, "header.frame_id"), sign

    def row(self, message: Any) -> FloatArray:
        """Force and moment."""
        stamped = hasattr(message, "header")
        if stamped:
            self.frame.check(message.header.frame_id)
        wrench = message.wrench if stamped else message
        return np.array([*_vector(wrench.force), *_vector(wrench.torque)])

    def fields(self, rows: FloatArray) -> dict[str, FloatArray]:
        """Wrenches (N, 6)."""
        return {"wrench": rows if self._sign == 1 else -rows}


class NormalForce:
    """A force along the ground's normal: a number, one of an array of numbers, or one component of a wrench."""

    numbers: tuple[str, ...] = ("std_msgs/msg/Float32", "std_msgs/msg/Float64")
    arrays: tuple[str, ...] = tuple(f"std_msgs/msg/{of}MultiArray" for of in ("Float32", "Float64", "Int16", "Int32"))
    types: tuple[str, ...] = (*numbers, *arrays, *Wrench.types)

    def __init__(self, topic: str, index: int | None, component: str | None, sign: int) -> None:
        """With the place of the number in an array, or the component of a wrench; `sign` turns it upwards."""
        self._topic, self._index, self._component, self._sign = topic, index, component, sign

    def check_options(self, field: str, kind: str) -> None:
        """Refuse an index or a component, of a field of the settings, that messages of a type do not have.

        Raises:
            LogError: either; an array without an index.
        """
        if kind in self.arrays and self._index is None:
            found = f"missing, though {self._topic} carries {kind}"
            raise LogError.at_field(f"{field}.index", found, "which of its numbers is this contact's, from 0 on")
        for option, value, fits in (
            ("index", self._index, kind in self.arrays),
            ("component", self._component, kind in Wrench.types),
        ):
            if value is not None and not fits:
                found = f"{value!r}, though {self._topic} carries {kind}"
                raise LogError.at_field(f"{field}.{option}", found, f"no {option} of such a message")

    def row(self, message: Any) -> FloatArray:
        """The force."""
        if not hasattr(message, "data"):
            wrench = message.wrench if hasattr(message, "header") else message
            return np.array([getattr(wrench.force, (self._component or "fz")[1:])])
        if self._index is None:
            return np.array([float(message.data)])
        if self._index >= len(message.data):
            found = f"an array of {len(message.data)} numbers, without index {self._index}"
            raise LogError.at_field(self._topic, found, "an index below that, from 0 on")
        return np.array([float(message.data[self._index])])

    def fields(self, rows: FloatArray) -> dict[str, FloatArray]:
        """Forces (N, 1)."""
        return {"force": rows if self._sign == 1 else -rows}


class ContactFlag:
    """`std_msgs/Bool`."""

    types: tuple[str, ...] = ("std_msgs/msg/Bool",)

    def row(self, message: Any) -> FloatArray:
        """1 or 0."""
        return np.array([float(message.data)])

    def fields(self, rows: FloatArray) -> dict[str, FloatArray]:
        """Flags (N, 1)."""
        return {"active": rows}


def _vector(value: Any) -> tuple[float, float, float]:
    return value.x, value.y, value.z


Stamps = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class TopicSeries:
    """The messages of one topic: stamps (N,) [ns], strictly increasing, and the fields of a log (N, ...).

    `stamped`: whether the stamps are those of the messages, not the times of receipt.
    """

    topic: str
    stamps: Stamps
    fields: dict[str, FloatArray]
    stamped: bool = True


class TopicMessages:
    """Messages of a topic in the order of receipt."""

    def __init__(self, topic: str, decoder: Decoder) -> None:
        self.topic, self._decoder = topic, decoder
        self._stamps, self._received, self._values = array("q"), array("q"), array("d")

    def add(self, message: Any, received: int) -> None:
        """Add a message with its time of receipt [ns]."""
        row = self._decoder.row(message)
        if row is None:
            return
        stamp = message.header.stamp if hasattr(message, "header") else None
        number = getattr(message, "tick", 0) if stamp is None else stamp.sec * 10**9 + stamp.nanosec
        self._stamps.append(number)
        self._received.append(received)
        self._values.frombytes(np.asarray(row, dtype=np.float64).tobytes())
        if 8 * len(self._values) > MAX_ARRAYS:
            raise LogError.at_field(self.topic, "more messages than fit", f"{MAX_ARRAYS} bytes")

    def to_series(self) -> TopicSeries:
        """All messages in the order of their stamps, without duplicates.

        Raises:
            LogError: there are no messages, or several with the same stamp and different content.
            UnknownNameError: no message has the joints of `logs.topics.joint_states.joints`, or of `names`.

        Warns:
            TorchidWarning: duplicate messages.
        """
        if not self._stamps and isinstance(self._decoder, JointStates) and self._decoder.other_joints:
            index, (name, *_) = "logs.topics.joint_states.joints", self._decoder.names
            raise UnknownNameError.at_field(index, name, self._decoder.other_joints)
        if not self._stamps:
            raise LogError.at_field(self.topic, "no messages", "at least one")
        if isinstance(self._decoder, JointStates):
            self._decoder.check_names()
        stamps: Stamps = np.array(self._stamps, dtype=np.int64)
        rows: FloatArray = np.array(self._values, dtype=np.float64).reshape(len(stamps), -1)
        received, stamped = np.array(self._received, dtype=np.int64), bool(stamps.any())
        if isinstance(self._decoder, LowState):
            stamps, stamped = self._decoder.stamps(stamps, received)
        elif not stamped:
            stamps = received
        if np.any(np.diff(stamps) < 0):
            order = np.argsort(stamps, kind="stable")
            stamps, rows = stamps[order], rows[order]
        again = np.flatnonzero(np.diff(stamps) == 0) + 1
        if len(again):
            differ = np.any(rows[again].view(np.int64) != rows[again - 1].view(np.int64), axis=1)
            if differ.any():
                at = stamps[again[np.argmax(differ)]] / 1e9
                found = f"messages of different content with one stamp, {at:.9f} s"
                by_tick = ", or logs.topics.low_state.stamps: receipt" * isinstance(self._decoder, LowState)
                raise LogError.at_field(self.topic, found, "every stamp once" + by_tick)
            warn_about_file(f"{self.topic}: {len(again)} messages come twice; each counts once")
            stamps, rows = np.delete(stamps, again), np.delete(rows, again, axis=0)
        return TopicSeries(self.topic, stamps, self._decoder.fields(rows), stamped)
