"""Roles of the topics of a bag: `logs.topics` of an experiment file."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field
from pydantic.dataclasses import dataclass

from torchid.errors import ConfigError, UnknownNameError, excerpt
from torchid.logs.unitree import GO, JOINT_ORDERS, require_joints_of
from torchid.settings import STRICT, Name, Number

_Force = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


@dataclass(config=STRICT, frozen=True)
class JointTopic:
    """`sensor_msgs/JointState`: `joints` are the joints to read, by default all of the first message.

    `names` are the URDF's names of those that the messages call otherwise, by what they call them.
    """

    topic: Name
    joints: Annotated[list[Name], Field(min_length=1)] | None = None
    names: dict[Name, Name] = dataclasses.field(default_factory=dict)


@dataclass(config=STRICT, frozen=True)
class ImuTopic:
    """`sensor_msgs/Imu`.

    Attributes:
        topic: its name.
        frame: where it is in the URDF, by default the `header.frame_id` of the messages.
        orientation: whether its orientation is that of the base, along whose axes `frame`, stated, has to be.
    """

    topic: Name
    frame: Name | None = None
    orientation: bool = False


@dataclass(config=STRICT, frozen=True)
class OdometryTopic:
    """`nav_msgs/Odometry` of the base link.

    `twist` is the frame in which its twist is expressed, `none` to derive it from the pose. `frame` is the expected
    `child_frame_id`, that of the base link.
    """

    topic: Name
    twist: Literal["child", "world", "none"] = "child"
    frame: Name | None = None


@dataclass(config=STRICT, frozen=True)
class WrenchTopic:
    """`geometry_msgs/WrenchStamped` or `Wrench`.

    `sign` is -1 where it is the robot's action on the environment, or the child side's on the parent side. `frame` is
    the expected `header.frame_id`, by default the contact's frame; in a limb, the name of the joint's child frame.
    """

    topic: Name
    sign: Literal[1, -1] = 1
    frame: Name | None = None


@dataclass(config=STRICT, frozen=True)
class ForceTopic:
    """A force along the ground's normal: a number of `std_msgs`, one of an array, or one component of a wrench.

    `index`, from 0 on, is that of the contact in an array such as `std_msgs/Float32MultiArray`; `component` that of a
    `geometry_msgs/WrenchStamped` or `Wrench` whose others the sensor does not read, fz by default. `sign` is -1 where
    a foot that is pressed on the ground reads less than 0.
    """

    topic: Name
    index: Annotated[int, Field(ge=0, strict=True)] | None = None
    component: Literal["fx", "fy", "fz"] | None = None
    sign: Literal[1, -1] = 1


@dataclass(config=STRICT, frozen=True)
class ContactTopic:
    """`std_msgs/Bool`, or a contact that is `always` active."""

    topic: Name | None = None
    always: bool = False


@dataclass(config=STRICT, frozen=True)
class LowStateTopic:
    """`LowState` of `unitree_go` or `unitree_hg`: all motors, the IMU, and of the first four foot sensors.

    Attributes:
        topic: its name.
        robot: whose motors they are: go2, g1, ...; see `JOINT_ORDERS`.
        joints: in its place, joints by number of the motor, null for one that is to be left out.
        frame: of the IMU in the URDF; without it the IMU is not read.
        orientation: whether the IMU's quaternion, as the robot estimates it, is the base's orientation.
        feet: contacts by number in `foot_force`, null for one to be left out; by default the robot's.
        above: [counts] a foot touches while its sensor reads more.
        forces: whether what the sensors read is the force along the ground's normal, in counts.
        stamps: `tick` for the robot's clock, `receipt` for that of the recording computer; by default the tick, which
            has to fit the times of receipt.
    """

    topic: Name
    robot: Name | None = None
    joints: Annotated[list[Name | None], Field(min_length=1)] | None = None
    frame: Name | None = None
    orientation: bool = True
    feet: Annotated[list[Name | None], Field(min_length=1, max_length=4)] | None = None
    above: Number | None = None
    forces: bool = False
    stamps: Literal["tick", "receipt"] | None = None

    @property
    def order(self) -> tuple[str | None, ...]:
        """Joints by number of the motor."""
        return tuple(self.joints or (JOINT_ORDERS[self.robot].joints if self.robot in JOINT_ORDERS else ()))

    @property
    def reads_feet(self) -> bool:
        """Whether the foot sensors are read."""
        return self.forces or self.above is not None

    @property
    def feet_by_number(self) -> tuple[str | None, ...]:
        """Contacts by number in `foot_force`; none where these are not read."""
        of_robot = JOINT_ORDERS[self.robot].feet if self.robot in JOINT_ORDERS else ()
        return tuple(self.feet or of_robot) if self.reads_feet else ()


def _topic(value: object) -> object:
    return {"topic": value} if isinstance(value, str) else value


def _contact(value: object) -> object:
    return {"always": True} if value is True else _topic(value)


AnyTopic = JointTopic | LowStateTopic | ImuTopic | OdometryTopic | WrenchTopic | ForceTopic | ContactTopic
_Wrenches = dict[str, Annotated[WrenchTopic, BeforeValidator(_topic)]]
_Forces = dict[str, Annotated[ForceTopic, BeforeValidator(_topic)]]
_Contacts = dict[str, Annotated[ContactTopic, BeforeValidator(_contact)]]


@dataclass(config=STRICT, frozen=True, kw_only=True)
class Topics:
    """The topics of a bag; a name alone is a topic with default settings.

    Attributes:
        joint_states: positions, velocities and efforts.
        low_state: in its place, the state of a robot of Unitree.
        imu: specific force and angular velocity.
        odometry: pose and twist of the base link.
        contact_wrenches: by contact, the environment's action on the robot at the contact frame, along its axes.
        contact_force_normal: by contact, the force along the ground's normal, of scalar sensors.
        contact_active: by contact, its flag; optional for contacts with a wrench or such a force.
        contact_force_threshold: [N], force above which a contact that is not in `contact_active` is active.
        ft_wrenches: by fixed joint, the wrench of the parent side on the child side, in the joint's child frame.
        other_joint_states: those of joints that the messages of `joint_states` lack.
        rate_topic: topic whose stamps the log takes: `contact_wrenches.l_sole`, ...; by default that of the joints.
    """

    joint_states: Annotated[JointTopic, BeforeValidator(_topic)] | None = None
    low_state: LowStateTopic | None = None
    imu: Annotated[ImuTopic, BeforeValidator(_topic)] | None = None
    odometry: Annotated[OdometryTopic, BeforeValidator(_topic)] | None = None
    contact_wrenches: _Wrenches = dataclasses.field(default_factory=dict)
    contact_force_normal: _Forces = dataclasses.field(default_factory=dict)
    contact_active: _Contacts = dataclasses.field(default_factory=dict)
    contact_force_threshold: _Force | None = None
    ft_wrenches: _Wrenches = dataclasses.field(default_factory=dict)
    rate_topic: str | None = None
    other_joint_states: list[Annotated[JointTopic, BeforeValidator(_topic)]] = dataclasses.field(default_factory=list)

    @property
    def joint_topics(self) -> dict[str, JointTopic]:
        """Topics of joint states by their role."""
        several = {f"other_joint_states.{number}": topic for number, topic in enumerate(self.other_joint_states)}
        return ({} if self.joint_states is None else {"joint_states": self.joint_states}) | several

    @property
    def by_role(self) -> dict[str, AnyTopic]:
        """The topics by their role, such as `imu` or `ft_wrenches.l_ankle_ft`."""
        single = {name: getattr(self, name) for name in ("joint_states", "low_state", "imu", "odometry")}
        several = {
            f"{key}.{name}": topic
            for key in ("contact_wrenches", "contact_force_normal", "contact_active", "ft_wrenches")
            for name, topic in getattr(self, key).items()
        }
        every = {**single, **self.joint_topics, **several}
        return {role: topic for role, topic in every.items() if topic is not None}

    @property
    def clock(self) -> str:
        """Role of the topic whose stamps the log takes."""
        return self.rate_topic or ("joint_states" if self.low_state is None else "low_state")

    @property
    def feet(self) -> tuple[str | None, ...]:
        """Contacts by number in `foot_force` of the low state."""
        return () if self.low_state is None else self.low_state.feet_by_number

    @property
    def contacts(self) -> tuple[str, ...]:
        """Names of all contacts."""
        given = (*self.contact_wrenches, *self.contact_force_normal, *self.contact_active, *self.feet)
        return tuple(dict.fromkeys(name for name in given if name is not None))

    @property
    def contacts_with_force(self) -> tuple[str, ...]:
        """Names of the contacts that have a force along the ground's normal."""
        counted = self.feet if self.low_state is not None and self.low_state.forces else ()
        return tuple(name for name in (*self.contact_force_normal, *counted) if name is not None)


def check_topics(topics: Topics, needs_flags: bool = True) -> None:
    """Check that a map of topics is complete; `needs_flags` as in `read_log`.

    Raises:
        ConfigError: no joints or these twice, two names for one joint, a contact without a flag, a threshold or
            `always`, a low state that does not fit itself.
        UnknownNameError: a robot that is not known by name; the rate topic is not one of the topics.
    """
    if (topics.joint_states is None) == (topics.low_state is None):
        reason = "neither joint_states nor low_state" if topics.low_state is None else "joint_states and low_state"
        accepted = "joint_states: the name of a topic, or low_state: a mapping with topic and robot"
        raise ConfigError.at_field("logs.topics", reason, f"one of the two, {accepted}")
    if topics.low_state is not None:
        _check_low_state(topics, topics.low_state)
    if topics.other_joint_states and topics.joint_states is None:
        raise ConfigError.at_field("logs.topics.other_joint_states", "given without joint_states", "both, or neither")
    given = [name for topic in topics.joint_topics.values() for name in topic.names.values()]
    if again := [name for name in given if given.count(name) > 1]:
        reason = f"two names for '{excerpt(again[0])}'"
        raise ConfigError.at_field("logs.topics.joint_states.names", reason, "each joint of the robot at most once")
    for name, contact in topics.contact_active.items():
        if (contact.topic is None) != contact.always:
            accepted = "a topic of std_msgs/Bool, or true for a contact that is always active"
            raise ConfigError.at_field(f"logs.topics.contact_active.{name}", "needs either topic or always", accepted)
    if needs_flags:
        _check_flags(topics)
    stamped = [role for role in topics.by_role if not role.startswith("contact_active.")]
    if topics.clock not in stamped:
        raise UnknownNameError.at_field("logs.topics.rate_topic", topics.clock, stamped)


_OTHER_FLAGS = "contact_active, or preprocessing.contact_threshold"


def _check_flags(topics: Topics) -> None:
    """Refuse contacts of which nothing says when they touch."""
    by_count = topics.feet if topics.low_state is not None and topics.low_state.above is not None else ()
    unflagged = [name for name in topics.contacts if name not in topics.contact_active and name not in by_count]
    counted = [name for name in unflagged if name in topics.feet]
    if counted:
        reason = f"missing: no contact flags for {counted[0]}"
        accepted = f"a reading [counts], {_OTHER_FLAGS}"
        raise ConfigError.at_field("logs.topics.low_state.above", reason, accepted)
    if unflagged and topics.contact_force_threshold is None:
        reason = f"missing: no contact flags for {unflagged[0]}"
        accepted = f"a force [N], {_OTHER_FLAGS}"
        raise ConfigError.at_field("logs.topics.contact_force_threshold", reason, accepted)


def _check_low_state(topics: Topics, low_state: LowStateTopic) -> None:
    """Refuse a low state that does not fit itself or the other topics."""
    key = "logs.topics.low_state"
    if (low_state.robot is None) == (low_state.joints is None):
        reason = "neither robot nor joints" if low_state.robot is None else "robot and joints together"
        accepted = f"one of the two: robot ({', '.join(JOINT_ORDERS)}), or joints by motor number"
        raise ConfigError.at_field(key, reason, accepted)
    if low_state.robot is not None and low_state.robot not in JOINT_ORDERS:
        raise UnknownNameError.at_field(f"{key}.robot", low_state.robot, JOINT_ORDERS)
    for name, given in (("joints", low_state.order), ("feet", low_state.feet or ())):
        names = [name for name in given if name is not None]
        again = [name for name in names if names.count(name) > 1]
        if again or (given and not names):
            reason = f"'{excerpt(again[0])}' twice" if again else "no name"
            raise ConfigError.at_field(f"{key}.{name}", reason, "every name once; null for an unused motor")
    if low_state.feet is not None and not low_state.reads_feet:
        accepted = "above (the reading at which a foot touches) or forces: true"
        raise ConfigError.at_field(f"{key}.feet", "given, but above and forces are missing", accepted)
    robot = JOINT_ORDERS.get(low_state.robot or "")
    if low_state.reads_feet and robot is not None and robot.message != GO:
        reading = "forces" if low_state.forces else "above"
        reason = f"'{low_state.robot}' sends {robot.message} without foot sensors, but {reading} is set"
        others = ", ".join(name for name, order in JOINT_ORDERS.items() if order.message == GO)
        accepted = f"a robot that sends {GO} ({others}), or no {reading}"
        raise ConfigError.at_field(f"{key}.robot", reason, accepted)
    if low_state.reads_feet and not low_state.feet_by_number:
        reason = "missing, but foot sensors are read"
        raise ConfigError.at_field(f"{key}.feet", reason, "contacts by number in foot_force; null for an unused sensor")
    if topics.imu is not None and low_state.frame is not None:
        raise ConfigError.at_field("logs.topics.imu", f"set together with {key}.frame", "one IMU, on the base")
    twice = [name for name in topics.contact_force_normal if low_state.forces and name in topics.feet]
    if twice:
        reason = f"set together with {key}.forces"
        raise ConfigError.at_field(f"logs.topics.contact_force_normal.{twice[0]}", reason, "one of the two")


def require_joints(topics: Topics | None, joints: Collection[str]) -> None:
    """Make sure that the motors of a low state, and what joints of messages are called, are joints of a robot.

    Args:
        topics: the map; None for logs without bags.
        joints: of the URDF.

    Raises:
        InputError: one is not; the message names the robots that it could be.
    """
    called = (
        [] if topics is None else [(key, x) for key, topic in topics.joint_topics.items() for x in topic.names.values()]
    )
    for role, joint in called:
        if joint not in joints:
            raise UnknownNameError.at_field(f"logs.topics.{role}.names", joint, joints)
    if topics is None or topics.low_state is None:
        return
    low_state = topics.low_state
    key = "logs.topics.low_state"
    if low_state.robot is not None:
        require_joints_of(f"{key}.robot", low_state.robot, joints)
    for name in low_state.order:
        if name is not None and name not in joints:
            raise UnknownNameError.at_field(f"{key}.joints", name, joints)
