"""Read a bag: decode the messages of its topics, align them to common stamps, return the fields of a log."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, UnknownNameError, how_to_install, join_names, warn_about_file
from torchid.logs.alignment import Series
from torchid.logs.containers import list_bag_files, reader_errors_explained
from torchid.logs.log import FloatArray
from torchid.logs.ros_files import BagChannel, BagFile, serve_bag
from torchid.logs.ros_messages import (
    ContactFlag,
    Decoder,
    Imu,
    JointStates,
    NormalForce,
    Odometry,
    Stamps,
    TopicMessages,
    TopicSeries,
    Wrench,
    make_deserializer,
)
from torchid.logs.ros_topics import (
    AnyTopic,
    ForceTopic,
    ImuTopic,
    JointTopic,
    LowStateTopic,
    OdometryTopic,
    Topics,
    WrenchTopic,
    check_topics,
)
from torchid.logs.unitree import LowState
from torchid.reader import open_apart


@dataclass(frozen=True, eq=False)
class _CommonClock:
    """The stamps (N,) [ns] of a log: those of one topic in the interval that all topics cover."""

    stamps: Stamps

    @property
    def time(self) -> FloatArray:
        """Stamps (N,) [s] from the first on: float64 seconds since 1970 would have a resolution of 0.2 us."""
        return self.seconds(self.stamps)

    def seconds(self, stamps: Stamps) -> FloatArray:
        """Stamps (K,) [ns] of a topic in seconds of this clock."""
        return (stamps - self.stamps[0]) / 1e9

    def align(self, series: TopicSeries) -> dict[str, FloatArray]:
        """The fields of a topic at the log's stamps, see `Series.at`."""
        return self._series(series).at(self.time)

    def hold(self, series: TopicSeries, values: FloatArray) -> FloatArray:
        """The last values (K, ...) of a topic before each stamp, (N, ...)."""
        return self._series(series).hold(values, self.time)

    def _series(self, series: TopicSeries) -> Series:
        return Series(series.topic, self.seconds(series.stamps), series.fields, "bag")


def _make_common_clock(
    rate: TopicSeries, others: Mapping[str, TopicSeries], events: Mapping[str, TopicSeries]
) -> _CommonClock:
    """The stamps of the topic `rate` within the time that all topics cover.

    Args:
        rate: whose stamps the log takes.
        others: sampled topics, by role.
        events: topics of which a message holds until the next.

    Raises:
        LogError: there are none.
    """
    topics = {**others, **events}
    start = max(series.stamps[0] for series in topics.values())
    stop = min(series.stamps[-1] for series in others.values())
    stamps = rate.stamps[(rate.stamps >= start) & (rate.stamps <= stop)]
    if not len(stamps):
        late = max(topics.values(), key=lambda series: int(series.stamps[0]))
        early = min(others.values(), key=lambda series: int(series.stamps[-1]))
        found = (
            f"{late.topic} starts at {late.stamps[0] / 1e9:.3f} s, {early.topic} ends at {early.stamps[-1] / 1e9:.3f} s"
        )
        raise LogError.at_field("time", f"no stamp of {rate.topic} that all topics cover: {found}", "one common clock")
    return _CommonClock(stamps)


#: Packages that read bags.
_PACKAGES = ("rosbags", "mcap", "lz4", "zstandard")
_EVENT = "contact_active"
_FEET = "foot_force"
#: Messages between two reports of progress, and topics that a message lists.
_REPORT_EVERY, _LISTED = 1000, 30


@dataclass
class _Bag:
    """A bag with the roles of its topics; several roles may share a topic."""

    topics: Topics
    channels: Mapping[str, BagChannel]
    decoders: dict[str, Decoder] = field(default_factory=dict)
    rows: dict[str, TopicMessages] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that every topic exists and has a suitable type."""
        for role, topic in self.topics.by_role.items():
            if topic.topic is None:
                continue
            name, field = topic.topic, f"logs.topics.{role}"
            if name not in self.channels:
                raise UnknownNameError.at_field(field, name, self.channels)
            decoder, given = _decoder(topic), self.channels[name].type
            if given not in decoder.types:
                instead = ", or logs.topics.low_state" * (given in LowState.types)
                raise LogError.at_field(field, f"{name} carries {given}", " or ".join(decoder.types) + instead)
            if isinstance(decoder, (NormalForce, LowState)):
                decoder.check_options(field, given)
            self.decoders[role], self.rows[role] = decoder, TopicMessages(name, decoder)


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
        accepted = "what its topics hold, of which torchid init writes a first map"
        raise LogError.at_field("logs.topics", f"missing; the bag has {_listed(channels)}", accepted)
    bag = _Bag(topics, channels)
    _read(bag, files, progress or (lambda share: None))
    series = {role: rows.to_series() for role, rows in bag.rows.items()}
    unstamped = dict.fromkeys(x.topic for x in series.values() if not x.stamped)
    if unstamped:
        problem = "no stamps in the messages: the log takes the times of receipt, which are late and uneven"
        warn_about_file(f"{', '.join(unstamped)}: {problem}")
    sampled = {role: x for role, x in series.items() if not role.startswith(_EVENT)}
    events = {role: x for role, x in series.items() if role.startswith(_EVENT)}
    clock = _make_common_clock(sampled[topics.clock], sampled, events)
    return {
        "time": clock.time,
        **_motion(bag, clock, series),
        **_contacts(bag, clock, series),
        **_ft_sensors(bag, clock, series),
    }


def list_channels(files: list[Path]) -> dict[str, BagChannel]:
    """The topics of a bag. Raises LogError: it is damaged, or a topic has several types."""
    channels: dict[str, BagChannel] = {}
    for file in files:
        with open_bag_file(file) as opened:
            for channel in opened.channels():
                first = channels.setdefault(channel.topic, channel)
                if first != channel:
                    found = f"both {first.type} and {channel.type}"
                    raise LogError.at_field(channel.topic, found, "one type of message per topic")
    return channels


@contextmanager
def open_bag_file(path: Path) -> Iterator[BagFile]:
    """Open a .bag, .mcap or .db3 file.

    Raises:
        LogError: it is damaged, also where this shows in later reads; or its reader is not installed.
    """
    if absent := [name for name in _PACKAGES if find_spec(name) is None]:
        found = f"a bag, but {' and '.join(absent)} {'are' if len(absent) > 1 else 'is'} not installed"
        raise LogError(path, "file", found, how_to_install("ros"))
    accepted = f"a complete {path.suffix.lower()} file of ROS messages"
    with reader_errors_explained("file", accepted), open_apart(serve_bag, path) as opened:
        yield BagFile(path, opened)


def _listed(channels: Mapping[str, BagChannel]) -> str:
    return join_names([f"{name} ({channel.type})" for name, channel in channels.items()], _LISTED) or "no topics"


def _decoder(topic: AnyTopic) -> Decoder:
    if isinstance(topic, LowStateTopic):
        return LowState(topic)
    if isinstance(topic, JointTopic):
        return JointStates(topic.topic, topic.joints, topic.names)
    if isinstance(topic, ImuTopic):
        return Imu(topic.topic, topic.orientation)
    if isinstance(topic, OdometryTopic):
        return Odometry(topic.topic, topic.twist)
    if isinstance(topic, ForceTopic):
        return NormalForce(topic.topic, topic.index, topic.component, topic.sign)
    return Wrench(topic.topic, topic.sign) if isinstance(topic, WrenchTopic) else ContactFlag()


def _read(bag: _Bag, files: list[Path], progress: Callable[[float], None]) -> None:
    """Decode every message of the topics in use."""
    users: dict[str, list[TopicMessages]] = {}
    for rows in bag.rows.values():
        users.setdefault(rows.topic, []).append(rows)
    make = {topic: make_deserializer(topic, bag.channels[topic]) for topic in users}
    for i, file in enumerate(files):
        with open_bag_file(file) as opened:
            for n, record in enumerate(opened.records(users.keys())):
                message = make[record.topic](record.data)
                for rows in users[record.topic]:
                    rows.add(message, record.received)
                if n % _REPORT_EVERY == 0:
                    progress((i + record.share) / len(files))


def _motion(bag: _Bag, clock: _CommonClock, series: Mapping[str, TopicSeries]) -> dict[str, NDArray[Any]]:
    """Joints, base and IMU."""
    out: dict[str, NDArray[Any]] = {}
    for role in ("joint_states", "low_state", "imu", "odometry"):  # of two orientations the last counts
        if role in series:
            out |= clock.align(series[role])
        decoder = bag.decoders.get(role)
        if isinstance(decoder, (JointStates, LowState)):
            out["joint_names"] = np.array(decoder.names, dtype=np.str_)
            out |= _with_other_joints(bag, clock, series, out)
        elif isinstance(decoder, Odometry) and bag.topics.odometry is not None:
            _check_frame(bag, role, bag.topics.odometry.frame, "the robot's base link")
        elif isinstance(decoder, Imu) and bag.topics.imu is not None:
            frame = bag.topics.imu.frame or decoder.frame.value.removeprefix("/")
            if not frame:
                accepted = "logs.topics.imu.frame, the robot's frame it sits at"
                raise LogError.at_field(bag.topics.imu.topic, "no header.frame_id", accepted)
            out["imu_frame"] = np.array(frame)
    out.pop(_FEET, None)
    if bag.topics.low_state is not None and bag.topics.low_state.frame is not None:
        out["imu_frame"] = np.array(bag.topics.low_state.frame)
    return out


def _with_other_joints(
    bag: _Bag, clock: _CommonClock, series: Mapping[str, TopicSeries], first: dict[str, NDArray[Any]]
) -> dict[str, NDArray[Any]]:
    """The fields of joints of all topics; torques are NaN, and velocities left out, where some topic has none."""
    parts = [first]
    for role in bag.topics.joint_topics:
        decoder = bag.decoders[role]
        if role != "joint_states" and isinstance(decoder, JointStates):
            known = {name for part in parts for name in part["joint_names"].tolist()}
            if again := [name for name in decoder.names if name in known]:
                accepted = f"logs.topics.{role}.joints, those that no other topic has"
                raise LogError.at_field(bag.rows[role].topic, f"joint '{again[0]}', of another topic too", accepted)
            parts.append(clock.align(series[role]) | {"joint_names": np.array(decoder.names, dtype=np.str_)})
    if len(parts) == 1:
        return {}
    out = {name: np.concatenate([part[name] for part in parts], axis=-1) for name in ("joint_names", "joint_position")}
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


def _contacts(bag: _Bag, clock: _CommonClock, series: Mapping[str, TopicSeries]) -> dict[str, NDArray[Any]]:
    """Contacts in the order of `Topics.contacts`; NaN for the wrench, or force, of one without a topic."""
    names = bag.topics.contacts
    if not names:
        return {}
    active = np.stack([_active(bag, clock, series, name) for name in names], axis=1)
    out: dict[str, NDArray[Any]] = {"contact_names": np.array(names), "contact_active": active}
    if bag.topics.contact_wrenches:
        nothing = np.full((len(clock.stamps), 6), np.nan)
        wrenches = [_wrench(clock, series, f"contact_wrenches.{name}", nothing) for name in names]
        out["contact_wrench_local"] = np.stack(wrenches, axis=1)
        for name, topic in bag.topics.contact_wrenches.items():
            _check_frame(bag, f"contact_wrenches.{name}", topic.frame or name)
    if bag.topics.contacts_with_force:
        out["contact_force_normal"] = np.full(active.shape, np.nan)
        for name in bag.topics.contacts_with_force:
            measured, field, number = _force(bag, series, name)
            out["contact_force_normal"][:, names.index(name)] = clock.align(measured)[field][:, number]
    return out


def _force(bag: _Bag, series: Mapping[str, TopicSeries], name: str) -> tuple[TopicSeries, str, int]:
    """Topic, field and column of the force along the ground's normal, or of what a foot sensor reads."""
    if name in bag.topics.contact_force_normal:
        return series[f"contact_force_normal.{name}"], "force", 0
    return series["low_state"], _FEET, bag.topics.feet.index(name)


def _active(bag: _Bag, clock: _CommonClock, series: Mapping[str, TopicSeries], name: str) -> NDArray[np.bool_]:
    """Whether a contact is active, (N,), by its last flag or its last force."""
    if name in bag.topics.contact_active:
        flags = series.get(f"contact_active.{name}")
        if flags is None:
            return np.ones(len(clock.stamps), dtype=np.bool_)
        return clock.hold(flags, flags.fields["active"])[:, 0] != 0.0
    threshold, low_state = bag.topics.contact_force_threshold, bag.topics.low_state
    if name in bag.topics.feet and low_state is not None and low_state.above is not None:
        counts = series["low_state"].fields[_FEET][:, bag.topics.feet.index(name)]
        return clock.hold(series["low_state"], counts) > low_state.above
    if threshold is None or name in bag.topics.feet:  # flags are worked out later
        return np.ones(len(clock.stamps), dtype=np.bool_)
    if name in bag.topics.contact_wrenches:
        measured = series[f"contact_wrenches.{name}"]
        with np.errstate(over="ignore"):  # infinite is above any threshold
            force = np.linalg.norm(measured.fields["wrench"][:, :3], axis=1)
    else:
        measured = series[f"contact_force_normal.{name}"]
        force = measured.fields["force"][:, 0]
    if np.isnan(force).any():
        accepted = "forces to compare with contact_force_threshold, or contact_active"
        raise LogError.at_field(measured.topic, f"a force of NaN in message {np.argmax(np.isnan(force))}", accepted)
    return clock.hold(measured, force) > threshold


def _wrench(
    clock: _CommonClock, series: Mapping[str, TopicSeries], role: str, nothing: FloatArray | None = None
) -> FloatArray:
    return clock.align(series[role])["wrench"] if nothing is None or role in series else nothing


def _ft_sensors(bag: _Bag, clock: _CommonClock, series: Mapping[str, TopicSeries]) -> dict[str, NDArray[Any]]:
    names = tuple(bag.topics.ft_wrenches)
    if not names:
        return {}
    wrenches = [_wrench(clock, series, f"ft_wrenches.{name}") for name in names]
    for name, topic in bag.topics.ft_wrenches.items():
        _check_frame(bag, f"ft_wrenches.{name}", topic.frame, f"the child frame of joint '{name}'")
    return {"ft_names": np.array(names), "ft_wrench": np.stack(wrenches, axis=1)}


def _check_frame(bag: _Bag, role: str, expected: str | None, otherwise: str = "") -> None:
    """Warn of a pose or wrench whose frame is not confirmed; it is not transformed.

    The base link and the child links of fixed joints are defined by the URDF, which is not read here: without an
    expected frame, the warning names the assumed frame, `otherwise`.
    """
    decoder = bag.decoders[role]
    if not isinstance(decoder, (Odometry, Wrench)):
        return
    found = decoder.frame.value
    if found and (expected is None or found.removeprefix("/") != expected.removeprefix("/")):
        taken_for = otherwise if expected is None else f"'{expected}'"
        text = f"frame '{found}', taken to be {taken_for}; logs.topics.{role}.frame says that this is meant"
        warn_about_file(f"{bag.rows[role].topic}: {text}")
