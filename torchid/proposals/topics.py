"""A proposed map of the topics of a bag, from their types, names and some of their messages."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from torchid.errors import format_count
from torchid.logs.log import NORM_TOLERANCE
from torchid.logs.name_matching import KnownRobot, is_desired, match_joints, match_names, spelled
from torchid.logs.ros_messages import ContactFlag, Imu, JointStates, NormalForce, Odometry, Wrench
from torchid.logs.unitree import JOINT_ORDERS, LowState, suitable_orders, usual_order
from torchid.proposals.column_groups import MapProposal
from torchid.proposals.file_samples import TopicSample
from torchid.proposals.numbers import threshold

_DECODERS = (JointStates, LowState, Imu, Odometry, Wrench, NormalForce, ContactFlag)
USED_TYPES: frozenset[str] = frozenset(name for decoder in _DECODERS for name in decoder.types)
"""Types of messages that a map of topics may have."""

_EFFORT = {"velocity": "joint_velocity", "effort": "joint_torque"}
_LOW_RATE = "/lf/"


def propose_topics(sample: Mapping[str, TopicSample], robot: KnownRobot) -> MapProposal:
    """Sort the topics of a bag into `logs.topics`.

    Args:
        sample: of the bag, with messages of `USED_TYPES`.
        robot: whose bag it is.
    """
    return _Proposer(sample, robot).propose()


_Joints = tuple[str, list[str], list[str]]
"""Topic, names of joints in some of its messages, and fields of a log that these give beside positions."""


class _Proposer:
    def __init__(self, topics: Mapping[str, TopicSample], robot: KnownRobot) -> None:
        self.topics, self.robot = topics, robot
        self.out = MapProposal(key="topics")
        self.used: set[str] = set()
        self.readings: list[Any] = []

    def propose(self) -> MapProposal:
        self._place_joints()
        self._place_imu()
        self._place_low_state()
        if not {"joint_states", "low_state"} & set(self.out.columns):
            self.out.columns = {"joint_states": "TOPIC", **self.out.columns}
            states = next(
                (f"; {name} is a LowState, but of another robot than the URDF" for name in self._of(LowState.types)), ""
            )
            self.out.notes["joint_states"] = (
                f"nothing, as no topic has the robot's joints{states}: name one in place of TOPIC"
            )
        self._place_odometry()
        self._add_orientation()
        self._place_limb_sensors()
        self._place_by_contact(Wrench, "contact_wrenches", frame_of, "contact_wrench_local")
        self._place_by_contact(NormalForce, "contact_force_normal", lambda _: "", "contact_force_normal")
        self._place_arrays()
        self._place_by_contact(ContactFlag, "contact_active", lambda _: "", "contact_active")
        self._complete_flags()
        self.out.left_out = [f"{name} ({topic.type})" for name, topic in self.topics.items() if name not in self.used]
        return self.out

    def _of(self, types: Sequence[str]) -> dict[str, TopicSample]:
        """Topics with messages of some types that hold what was measured, those with most messages first."""
        fitting = {
            name: topic
            for name, topic in self.topics.items()
            if topic.type in types and topic.messages and name not in self.used and not is_desired(name)
        }
        return dict(sorted(fitting.items(), key=lambda pair: (_LOW_RATE in pair[0], -pair[1].count)))

    def _add(self, key: str, topic: str, entry: dict[str, Any], *fields: str) -> None:
        self.out.columns[key] = entry if len(entry) > 1 else topic
        self.used.add(topic)
        self.out.fields |= {"time", *fields}

    # --------------------------------------------------------------------------------------------------- joints, base

    def _place_joints(self) -> None:
        """Joint states with most of the robot's joints, then most of their efforts, then others; the rest is welded."""
        sources, found = self._joint_sources(), list[tuple[str, dict[str, Any]]]()
        placed, fields = set[str](), set[str]()
        while (best := self._best_joints(sources, placed)) is not None:
            name, _, parts = source = best
            matched = self._joints_in(source, placed)
            found.append((name, self._joint_entry(source, matched, [x for x in sources if x[0] == name])))
            placed |= set(matched.values())
            fields |= set(parts)
        if not found:
            return
        complete = {"joint_position"} if self._has_most(placed) else set()
        self.out.lacking = [x for x in self.robot.joints if complete and x not in placed]
        (topic, first), *others = found
        self._add("joint_states", topic, first, *complete, *fields)
        if others:
            self.out.columns["other_joint_states"] = [entry if len(entry) > 1 else name for name, entry in others]
            self.out.notes["other_joint_states"] = "joints that the messages of joint_states lack"
            self.used |= {name for name, _ in others}

    def _joint_sources(self) -> list[_Joints]:
        """Topics of joint states with the joints of their messages, each set of these for itself, and their fields."""
        out = dict[tuple[str, tuple[str, ...]], _Joints]()
        for topic, sample in self._of(JointStates.types).items():
            for message in sample.messages[:50]:
                fields = [field for part, field in _EFFORT.items() if len(getattr(message, part))]
                out.setdefault((topic, tuple(sorted(message.name))), (topic, list(message.name), fields))
        return list(out.values())

    def _joints_in(self, source: _Joints, placed: Collection[str]) -> dict[str, str]:
        """Joints of the robot that no other source has, by their names in one."""
        every = match_joints(source[1], self.robot.joints)
        is_ours = set(self.robot.joints) & set(source[1]) or self._has_most(every.values())
        return {text: joint for text, joint in every.items() if is_ours and joint not in placed}

    def _best_joints(self, sources: Sequence[_Joints], placed: Collection[str]) -> _Joints | None:
        """The source with most joints that none has yet."""
        scores = [len(self._joints_in(x, placed)) + 0.1 * len(x[2]) for x in sources if self._joints_in(x, placed)]
        left = [x for x in sources if self._joints_in(x, placed)]
        return left[scores.index(max(scores))] if left else None

    def _joint_entry(self, source: _Joints, matched: Mapping[str, str], of_topic: Sequence[_Joints]) -> dict[str, Any]:
        """The entry of some joints by their names in the messages of a topic, with notes; `of_topic`: its sources."""
        topic, named, _ = source
        entry: dict[str, Any] = {"topic": topic}
        notes = list[str]()
        if len(named) > len(matched):
            notes.append(f"those of the robot among the {len(named)} joints of its messages")
        if len(named) > len(matched) or len(of_topic) > 1:
            entry["joints"] = [joint for joint in self.robot.joints if joint in matched.values()]
        if called := {text: joint for text, joint in matched.items() if text != joint}:
            entry["names"] = called
            notes.append(f"names of {format_count(len(called), 'joint')}, which the messages spell otherwise")
        if notes:
            self.out.notes.setdefault("joint_states", "; ".join(notes))
        return entry

    def _has_most(self, matched: Collection[str]) -> bool:
        """Whether most of the robot's joints are among some."""
        return 2 * len(matched) >= max(len(self.robot.joints), 1)

    def _place_low_state(self) -> None:
        """The state of a robot of Unitree, if the URDF has its joints."""
        if "joint_states" in self.out.columns:
            return
        for name, topic in self._of(LowState.types).items():
            robot = self._robot_of(topic)
            if not robot:
                continue
            entry: dict[str, Any] = {"topic": name, "robot": robot}
            same = [x for x in JOINT_ORDERS if JOINT_ORDERS[x] == JOINT_ORDERS[robot]]
            alike = f"; {', '.join(same)} have one order" if len(same) > 1 else ""
            self.out.notes["low_state"] = f"{robot}, as the robot's file has its joints{alike}"
            self._add("low_state", name, entry, "joint_position", "joint_velocity", "joint_torque")
            if "imu" not in self.out.columns:
                entry["frame"] = self._imu_frame()
                self.out.fields |= {"imu_specific_force", "imu_angular_velocity"}
                self.out.notes["low_state"] += f"; its IMU at {entry['frame']}"
            self._add_feet(robot, topic, entry)
            return

    def _robot_of(self, topic: TopicSample) -> str:
        """The robot known by name whose joints the URDF has and whose motors are alive, "" for none."""
        motors = np.array([[(x.q, x.dq, x.tau_est) for x in message.motor_state] for message in topic.messages])
        alive = set(np.flatnonzero((motors != 0.0).any(axis=(0, 2))).tolist())
        for robot in suitable_orders(self.robot.joints, self.robot.name):
            order = JOINT_ORDERS[robot]
            numbers = {number for number, joint in enumerate(order.joints) if joint is not None}
            if order.message == topic.type and numbers <= alive:
                return robot
        return ""

    def _add_feet(self, robot: str, topic: TopicSample, entry: dict[str, Any]) -> None:
        """A threshold of the foot sensors, where they read something."""
        feet = JOINT_ORDERS[robot].feet
        readings = np.array([message.foot_force for message in topic.messages]) if feet else np.zeros(1)
        if set(feet) == set(self.robot.feet) and np.ptp(readings) > 0:
            entry["above"] = threshold(readings)
            self.out.fields.add("contact_active")
            self.out.notes["low_state"] += "; above, from the range of the readings"

    def _imu_frame(self) -> str:
        """The link of the base that is called IMU, else the base link."""
        named = [name for name in self.robot.on_base if "imu" in name.lower()]
        return min(named, key=len, default=self.robot.base_link)

    def _place_imu(self) -> None:
        """The IMU whose frame is on the base, else the first that is not said to be of something else."""
        found = {name: frame_of(topic) for name, topic in self._of(Imu.types).items()}
        found = {name: frame for name, frame in found.items() if frame not in self.robot.elsewhere}
        on_base = [name for name, frame in found.items() if frame in self.robot.on_base]
        if on_base:
            named = [name for name in on_base if "imu" in name.lower() or "imu" in found[name].lower()]
            name = (named or on_base)[0]
            self._add("imu", name, {"topic": name, "frame": found[name]}, "imu_specific_force", "imu_angular_velocity")
        elif found:
            name, frame = next(iter(found)), self._imu_frame()
            stated = f"'{found[name]}', which is no link of the base" if found[name] else "no frame_id"
            self.out.notes["imu"] = f"its frame, as the messages have {stated}"
            self._add("imu", name, {"topic": name, "frame": frame}, "imu_specific_force", "imu_angular_velocity")

    def _place_odometry(self) -> None:
        """The pose of the base link, or of what its frame is called."""
        found = {name: frame_of(topic) for name, topic in self._of(Odometry.types).items()}
        ours = [name for name, frame in found.items() if frame in (self.robot.base_link, "")]
        if not found:
            return
        name = (ours or list(found))[0]
        entry: dict[str, Any] = {"topic": name}
        if found[name] == self.robot.base_link:
            entry["frame"] = found[name]
        elif found[name]:
            self.out.notes["odometry"] = f"of '{found[name]}', taken to be the base link"
        twists = np.array([_twist(message) for message in self.topics[name].messages])
        fields = ["base_position_world", "base_quat_xyzw"]
        if not twists.any():
            entry["twist"] = "none"
        self._add("odometry", name, entry, *fields)

    def _add_orientation(self) -> None:
        """That of the IMU, where nothing else says how the base is turned and messages do."""
        entry = self.out.columns.get("imu", {})
        if "base_quat_xyzw" in self.out.fields or entry.get("frame") not in self.robot.along_base:
            return
        messages = self.topics[entry["topic"]].messages
        turns = np.array([[getattr(message.orientation, axis) for axis in "xyzw"] for message in messages])
        known = all(message.orientation_covariance[0] != -1.0 for message in messages)
        if known and np.any(turns != turns[0]) and np.allclose(np.linalg.norm(turns, axis=1), 1.0, atol=NORM_TOLERANCE):
            entry["orientation"] = True
            self.out.fields.add("base_quat_xyzw")
            what = "orientation: the IMU's, an estimate of its own, is that of the base"
            self.out.notes["imu"] = "; ".join(filter(None, (self.out.notes.get("imu"), what)))

    # ----------------------------------------------------------------------------------------------- limbs, contacts

    def _place_limb_sensors(self) -> None:
        """Wrenches of the child link of a fixed joint that is called a sensor, or that name joint or link."""
        entries: dict[str, Any] = {}
        for name, topic in self._of(Wrench.types).items():
            frame = frame_of(topic)
            texts = {joint: (joint.removesuffix("_joint"), child) for joint, child in self.robot.limb_sensors.items()}
            exact = [joint for joint, child in self.robot.limb_sensors.items() if child == frame]
            named = [joint for joint in texts if any(spelled(x).search(f"{frame} {name}") for x in texts[joint])]
            found = [joint for joint in exact or named if joint not in entries]
            if frame in self.robot.feet or len(found) != 1:
                continue
            entries[found[0]] = {"topic": name, "frame": frame} if exact else name
            self.used.add(name)
        if entries:
            self.out.columns["ft_wrenches"] = entries
            self.out.notes["ft_wrenches"] = "by names; what the parent side exerts on the child side, else sign: -1"
            self.out.fields.add("ft_wrench")

    def _place_by_contact(self, decoder: Any, key: str, frame_of: Callable[[TopicSample], str], field: str) -> None:
        """Topics of a type that names of contacts stand in, or in their frames."""
        types = decoder.numbers if decoder is NormalForce else decoder.types
        topics = self._of(types)
        texts = {f"{frame_of(topic)} {name}".strip(): name for name, topic in topics.items()}
        matched = match_names(list(texts), self.robot.feet, "contact")
        if not matched:
            return
        entries = {}
        for text, foot in sorted(matched.items(), key=lambda pair: self.robot.feet.index(pair[1])):
            name = texts[text]
            frame = frame_of(topics[name])
            entries[foot] = name
            if frame not in ("", foot):
                self.out.notes[key] = "by names; frames of messages are others, taken to be those of the contacts"
            self.used.add(name)
            if decoder is not ContactFlag:
                self.readings += [_reading(message) for message in topics[name].messages]
        self.out.columns[key] = entries
        self.out.notes.setdefault(key, "by names" + "; in N" * (decoder is NormalForce))
        self.out.fields.add(field)

    def _place_arrays(self) -> None:
        """An array with a number for each foot."""
        feet = list(self.robot.feet)
        for name, topic in self._of(NormalForce.arrays).items():
            lengths = {len(message.data) for message in topic.messages}
            if lengths != {len(feet)} or not feet or "contact_force_normal" in self.out.columns:
                continue
            order, how = usual_order("contact", self.robot, len(feet))
            self.out.columns["contact_force_normal"] = {
                foot: {"topic": name, "index": index} for index, foot in enumerate(order)
            }
            self.out.notes["contact_force_normal"] = f"in N; order {how}; compare it with the manual of the robot"
            self.out.fields.add("contact_force_normal")
            self.used.add(name)
            self.readings += [float(x) for message in topic.messages for x in message.data]

    def _complete_flags(self) -> None:
        """Say of every contact when it touches, if something is said of any."""
        columns = self.out.columns
        read = {foot for key in ("contact_wrenches", "contact_force_normal") for foot in columns.get(key, {})}
        flagged = set(columns.get("contact_active", {}))
        if isinstance(low_state := columns.get("low_state"), dict) and "above" in low_state:
            flagged |= set(self.robot.feet)
        if read - flagged:
            columns["contact_force_threshold"] = max(threshold(np.abs(self.readings)), 1e-3)
            self.out.notes["contact_force_threshold"] = "from the range of the readings"
        unsaid = [foot for foot in self.robot.feet if foot not in read | flagged]
        if unsaid and (read or flagged):
            columns["contact_active"] = columns.get("contact_active", {}) | dict.fromkeys(unsaid, True)
            self.out.notes["contact_active"] = f"{', '.join(unsaid)} touching throughout, as no topic says otherwise"
        if read or flagged:
            self.out.fields.add("contact_active")


def frame_of(topic: TopicSample) -> str:
    """The frame that the first message says it is of, "" for none."""
    message = topic.messages[0] if topic.messages else None
    frame = getattr(message, "child_frame_id", "") or getattr(getattr(message, "header", None), "frame_id", "")
    return str(frame).removeprefix("/")


def _twist(message: Any) -> list[float]:
    twist = message.twist.twist
    return [getattr(part, axis) for part in (twist.linear, twist.angular) for axis in "xyz"]


def _reading(message: Any) -> float:
    """A force, or its length."""
    if hasattr(message, "data"):
        return float(message.data)
    force = message.wrench.force if hasattr(message, "wrench") else message.force
    return float(np.linalg.norm([force.x, force.y, force.z]))
