"""A map of the topics of a bag, by their types, exact names and frames; what is not sure is listed for a person."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchid.errors import join_names
from torchid.logs.bags import FLAGS, IMUS, JOINT_STATES, NUMBER_ARRAYS, NUMBERS, ODOMETRIES, WRENCHES
from torchid.logs.columns import FILL_IN
from torchid.logs.log import NORM_TOLERANCE
from torchid.logs.unitree import JOINT_ORDERS, MOTORS, suitable_orders
from torchid.proposals.columns import TOUCH_WEIGHT, MapProposal
from torchid.proposals.names import RobotNames, exchange_affixes, find_spelling, is_measured, within, words_of
from torchid.proposals.samples import TopicSample

USED_TYPES = frozenset((*JOINT_STATES, *MOTORS, *IMUS, *ODOMETRIES, *WRENCHES, *NUMBERS, *NUMBER_ARRAYS, *FLAGS))
"""Types of messages that a map of topics may have."""

_LOW_RATE = "/lf/"
_TOUCH_READING = 0.1  # of the way from the lowest to the highest reading of foot sensors, where a foot touches


def propose_topics(sample: Mapping[str, TopicSample], robot: RobotNames) -> MapProposal:
    """Sort the topics of a bag into `logs.topics`.

    Args:
        sample: of the bag, with messages of `USED_TYPES`.
        robot: whose bag it is.
    """
    return _Proposer(sample, robot).propose()


class _Proposer:
    def __init__(self, topics: Mapping[str, TopicSample], robot: RobotNames) -> None:
        self.topics = topics
        self.robot = robot
        self.out = MapProposal(key="topics")
        self.used: set[str] = set()

    def propose(self) -> MapProposal:
        self._place_joints()
        self._place_imu()
        if "joint_states" not in self.out.columns:
            self._place_low_state()
        if not {"joint_states", "low_state"} & set(self.out.columns):
            self.out.columns = {"joint_states": FILL_IN, **self.out.columns}
            self.out.fields |= {"time", "joint_position", "joint_torque"}
            self.out.hint = f"joints of the robot: {', '.join(self.robot.joints)}"
            self.out.assumed["joint_states"] = "a topic below: {topic: /NAME, names: {its joint: the robot's, ...}}"
        self._place_odometry()
        self._place_orientation()
        self._place_limb_sensors()
        self._place_by_contact("contact_wrenches", WRENCHES, "contact_wrench_local")
        self._place_by_contact("contact_force_normal", NUMBERS, "contact_force_normal")
        self._place_by_contact("contact_active", FLAGS, "contact_active")
        self._complete_flags()
        self.out.listed = [self._line(name) for name in self.topics if name not in self.used]
        return self.out

    def _line(self, name: str) -> str:
        """A topic, its type and what its messages are of, in words."""
        topic = self.topics[name]
        more = ""
        if topic.type in JOINT_STATES and topic.messages:
            more = f": joints {join_names(list(topic.messages[0].name))}"
        elif frame := frame_of(topic):
            more = f": frame {frame}"
        return f"{name} ({topic.type}){more}"

    def _of(self, types: Sequence[str]) -> dict[str, TopicSample]:
        """Topics with messages of some types that hold what was measured, those with most messages first."""
        fitting = {
            name: topic
            for name, topic in self.topics.items()
            if topic.type in types and topic.messages and name not in self.used and is_measured(words_of(name))
        }
        return dict(sorted(fitting.items(), key=lambda pair: (_LOW_RATE in pair[0], -pair[1].count)))

    def _add(self, key: str, topic: str, entry: dict[str, Any], *fields: str) -> None:
        self.out.columns[key] = entry if len(entry) > 1 else topic
        self.used.add(topic)
        self.out.fields |= {"time", *fields}

    # --------------------------------------------------------------------------------------------------- joints, base

    def _place_joints(self) -> None:
        """Joint states with most of the robot's joints first, then those of others; the rest is welded."""
        placed = set[str]()
        entries = list[tuple[str, dict[str, Any]]]()
        sources = dict[tuple[str, tuple[str, ...]], Any]()
        for name, topic in self._of(JOINT_STATES).items():
            for message in topic.messages[:50]:
                sources.setdefault((name, tuple(message.name)), message)
        while sources:
            fresh = {
                key: {text: x for text, x in exchange_affixes(key[1], self.robot.joints).items() if x not in placed}
                for key in sources
            }
            best = max(fresh, key=lambda key: (len(fresh[key]), len(sources[key].effort)))
            if not fresh[best]:
                break
            several = len({names for name, names in sources if name == best[0]}) > 1 or bool(entries)
            entries.append((best[0], self._joint_entry(best, fresh[best], several)))
            placed |= set(fresh[best].values())
            message = sources.pop(best)
            self.out.fields |= {"joint_velocity"} if len(message.velocity) else set()
            self.out.fields |= {"joint_torque"} if len(message.effort) else set()
        if not entries:
            return
        self.out.lacking = [x for x in self.robot.joints if x not in placed]
        (chosen, first), *others = entries
        self._add("joint_states", chosen, first, "joint_position")
        if others:
            self.out.columns["other_joint_states"] = [entry if len(entry) > 1 else name for name, entry in others]
            self.out.assumed["other_joint_states"] = "joints that are not in joint_states"
            self.used |= {name for name, _ in others}

    def _joint_entry(
        self, source: tuple[str, tuple[str, ...]], matched: Mapping[str, str], several: bool
    ) -> dict[str, Any]:
        topic, named = source
        entry: dict[str, Any] = {"topic": topic}
        if len(named) > len(matched) or several:
            entry["joints"] = [joint for joint in self.robot.joints if joint in matched.values()]
        if called := {text: joint for text, joint in matched.items() if text != joint}:
            entry["names"] = called
            self.out.assumed.setdefault("joint_states", "names differ only in a prefix or suffix")
        return entry

    def _place_low_state(self) -> None:
        """The state of a robot of Unitree, if the URDF has its joints."""
        for name, topic in self._of(tuple(MOTORS)).items():
            if not (robot := self._robot_of(topic)):
                continue
            entry: dict[str, Any] = {"topic": name, "robot": robot}
            same = [x for x in JOINT_ORDERS if JOINT_ORDERS[x] == JOINT_ORDERS[robot]]
            alike = f"; {', '.join(same)} have the same order" if len(same) > 1 else ""
            self.out.assumed["low_state"] = f"{robot}: the robot's file has its joints{alike}"
            self._add("low_state", name, entry, "joint_position", "joint_velocity", "joint_torque")
            if "imu" not in self.out.columns:
                entry["frame"], _ = self.robot.imu_frame()
                self.out.fields |= {"imu_specific_force", "imu_angular_velocity"}
                self.out.assumed["low_state"] += f"; the IMU is at {entry['frame']}"
            feet = JOINT_ORDERS[robot].feet
            readings = np.array([message.foot_force for message in topic.messages]) if feet else np.zeros(1)
            low, high = np.percentile(readings, (2, 98))
            if set(feet) == set(self.robot.feet) and high > low:
                entry["above"] = float(f"{low + _TOUCH_READING * (high - low):.2g}")
                self.out.fields.add("contact_active")
                self.out.assumed["low_state"] += "; above: from the range of the readings"
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

    def _place_imu(self) -> None:
        """The IMU whose frame is on the base, else the first that is not said to be of something else."""
        frames = {name: frame_of(topic) for name, topic in self._of(IMUS).items()}
        frames = {name: frame for name, frame in frames.items() if frame not in self.robot.elsewhere}
        on_base = [name for name, frame in frames.items() if frame in self.robot.on_base]
        if not frames:
            return
        named = [name for name in on_base if "imu" in f"{name} {frames[name]}".lower()]
        name = (named or on_base or list(frames))[0]
        frame = frames[name]
        if not on_base:
            stated = f"'{frame}' in the messages is no link of the base" if frame else "the messages have no frame_id"
            self.out.assumed["imu"] = f"its frame: {stated}"
            frame, _ = self.robot.imu_frame()
        self._add("imu", name, {"topic": name, "frame": frame}, "imu_specific_force", "imu_angular_velocity")

    def _place_odometry(self) -> None:
        """The pose of the base link, or of what its frame is called."""
        frames = {name: frame_of(topic) for name, topic in self._of(ODOMETRIES).items()}
        if not frames:
            return
        ours = [name for name, frame in frames.items() if frame in (self.robot.base_link, "")]
        name = (ours or list(frames))[0]
        entry: dict[str, Any] = {"topic": name}
        if frames[name] == self.robot.base_link:
            entry["frame"] = frames[name]
        elif frames[name]:
            self.out.assumed["odometry"] = f"'{frames[name]}' is taken for the base link"
        twists = [message.twist.twist for message in self.topics[name].messages]
        if not any(getattr(part, axis) for twist in twists for part in (twist.linear, twist.angular) for axis in "xyz"):
            entry["twist"] = "none"
        self._add("odometry", name, entry, "base_position_world", "base_quat_xyzw")

    def _place_orientation(self) -> None:
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
            what = "orientation: the IMU's own estimate is taken for the base's"
            self.out.assumed["imu"] = "; ".join(filter(None, (self.out.assumed.get("imu"), what)))

    # ----------------------------------------------------------------------------------------------- limbs, contacts

    def _place_limb_sensors(self) -> None:
        """Wrenches of the child link of a fixed joint that is called a sensor, or that name joint or link."""
        entries: dict[str, Any] = {}
        for name, topic in self._of(WRENCHES).items():
            frame = frame_of(topic)
            if frame in self.robot.feet:
                continue
            sensors = {joint: child for joint, child in self.robot.limb_sensors.items() if joint not in entries}
            exact = [joint for joint, child in sensors.items() if child == frame]
            texts = {joint: (joint.removesuffix("_joint"), child) for joint, child in sensors.items()}
            named = [joint for joint in texts if any(within(x).search(name) for x in texts[joint])]
            if len(joints := exact or named) == 1:
                entries[joints[0]] = {"topic": name, "frame": frame} if exact else name
                self.used.add(name)
        if entries:
            self.out.columns["ft_wrenches"] = entries
            self.out.assumed["ft_wrenches"] = "what the parent side exerts on the child side; else add sign: -1"
            self.out.fields.add("ft_wrench")

    def _place_by_contact(self, key: str, types: Sequence[str], field: str) -> None:
        """Topics of some types whose frames are contacts, or that name these."""
        topics = self._of(types)
        spelling = find_spelling([f"{name} {frame_of(topic)}" for name, topic in topics.items()], self.robot.feet)
        entries = dict[str, str]()
        for name, topic in topics.items():
            frame = frame_of(topic)
            stems = [x for x in spelling.names if within(x).search(name)]
            foot = frame if frame in self.robot.feet else spelling.names[max(stems, key=len)] if stems else ""
            if not foot or foot in entries:
                continue
            entries[foot] = name
            self.used.add(name)
            if frame not in ("", foot):
                self.out.assumed[key] = "the messages' frames are taken for the contact frames"
        if entries:
            self.out.columns[key] = {foot: entries[foot] for foot in self.robot.feet if foot in entries}
            self.out.fields.add(field)

    def _complete_flags(self) -> None:
        """Say of every contact when it touches, if something is said of any."""
        columns = self.out.columns
        read = {foot for key in ("contact_wrenches", "contact_force_normal") for foot in columns.get(key, {})}
        flagged = set(columns.get("contact_active", {}))
        if isinstance(low_state := columns.get("low_state"), dict) and "above" in low_state:
            flagged |= set(self.robot.feet)
        if read - flagged:
            columns["contact_force_threshold"] = max(float(f"{TOUCH_WEIGHT * self.robot.weight:.2g}"), 1.0)
            self.out.assumed["contact_force_threshold"] = f"{TOUCH_WEIGHT:.0%} of the robot's weight [N]"
        unsaid = [foot for foot in self.robot.feet if foot not in read | flagged]
        if unsaid and (read or flagged):
            columns["contact_active"] = columns.get("contact_active", {}) | dict.fromkeys(unsaid, True)
            self.out.assumed["contact_active"] = f"{', '.join(unsaid)} always in contact: no topic has flags"
        if read or flagged:
            self.out.fields.add("contact_active")


def frame_of(topic: TopicSample) -> str:
    """The frame that the first message says it is of, "" for none."""
    message = topic.messages[0] if topic.messages else None
    frame = getattr(message, "child_frame_id", "") or getattr(getattr(message, "header", None), "frame_id", "")
    return str(frame).removeprefix("/")
