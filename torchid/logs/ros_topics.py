"""Roles of the topics of a bag: `logs.topics` of an experiment file."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Literal

from pydantic import BeforeValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass

from torchid.errors import ConfigError, UnknownNameError

_STRICT = ConfigDict(extra="forbid")
_Name = Annotated[str, Field(min_length=1)]
_Force = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


@dataclass(config=_STRICT, frozen=True)
class JointTopic:
    """`sensor_msgs/JointState`: `joints` are the joints to read, by default all of the first message."""

    topic: _Name
    joints: Annotated[list[_Name], Field(min_length=1)] | None = None


@dataclass(config=_STRICT, frozen=True)
class ImuTopic:
    """`sensor_msgs/Imu`: `frame` is its frame in the URDF, by default the `header.frame_id` of the messages."""

    topic: _Name
    frame: _Name | None = None


@dataclass(config=_STRICT, frozen=True)
class OdometryTopic:
    """`nav_msgs/Odometry` of the base link.

    `twist` is the frame in which its twist is expressed, `none` to derive it from the pose. `frame` is the expected
    `child_frame_id`, that of the base link.
    """

    topic: _Name
    twist: Literal["child", "world", "none"] = "child"
    frame: _Name | None = None


@dataclass(config=_STRICT, frozen=True)
class WrenchTopic:
    """`geometry_msgs/WrenchStamped` or `Wrench`.

    `sign` is -1 where it is the robot's action on the environment, or the child side's on the parent side. `frame` is
    the expected `header.frame_id`, by default the contact's frame; in a limb, the name of the joint's child frame.
    """

    topic: _Name
    sign: Literal[1, -1] = 1
    frame: _Name | None = None


@dataclass(config=_STRICT, frozen=True)
class ForceTopic:
    """A force along the ground's normal: a number of `std_msgs`, one of an array, or one component of a wrench.

    `index`, from 0 on, is that of the contact in an array such as `std_msgs/Float32MultiArray`; `component` that of a
    `geometry_msgs/WrenchStamped` or `Wrench` whose others the sensor does not read, fz by default. `sign` is -1 where
    a foot that is pressed on the ground reads less than 0.
    """

    topic: _Name
    index: Annotated[int, Field(ge=0, strict=True)] | None = None
    component: Literal["fx", "fy", "fz"] | None = None
    sign: Literal[1, -1] = 1


@dataclass(config=_STRICT, frozen=True)
class ContactTopic:
    """`std_msgs/Bool`, or a contact that is `always` active."""

    topic: _Name | None = None
    always: bool = False


def _topic(value: object) -> object:
    return {"topic": value} if isinstance(value, str) else value


def _contact(value: object) -> object:
    return {"always": True} if value is True else _topic(value)


_Wrenches = dict[str, Annotated[WrenchTopic, BeforeValidator(_topic)]]
_Forces = dict[str, Annotated[ForceTopic, BeforeValidator(_topic)]]
_Contacts = dict[str, Annotated[ContactTopic, BeforeValidator(_contact)]]


@dataclass(config=_STRICT, frozen=True, kw_only=True)
class Topics:
    """The topics of a bag; a name alone is a topic with default settings.

    Attributes:
        joint_states: positions, velocities and efforts.
        imu: specific force and angular velocity.
        odometry: pose and twist of the base link.
        contact_wrenches: by contact, the environment's action on the robot at the contact frame, along its axes.
        contact_force_normal: by contact, the force along the ground's normal, of scalar sensors.
        contact_active: by contact, its flag; optional for contacts with a wrench or such a force.
        contact_force_threshold: [N], force above which a contact that is not in `contact_active` is active.
        ft_wrenches: by fixed joint, the wrench of the parent side on the child side, in the joint's child frame.
        rate_topic: topic whose stamps the log takes: `joint_states`, `contact_wrenches.l_sole`, ...
    """

    joint_states: Annotated[JointTopic, BeforeValidator(_topic)]
    imu: Annotated[ImuTopic, BeforeValidator(_topic)] | None = None
    odometry: Annotated[OdometryTopic, BeforeValidator(_topic)] | None = None
    contact_wrenches: _Wrenches = dataclasses.field(default_factory=dict)
    contact_force_normal: _Forces = dataclasses.field(default_factory=dict)
    contact_active: _Contacts = dataclasses.field(default_factory=dict)
    contact_force_threshold: _Force | None = None
    ft_wrenches: _Wrenches = dataclasses.field(default_factory=dict)
    rate_topic: str = "joint_states"

    @property
    def by_role(self) -> dict[str, JointTopic | ImuTopic | OdometryTopic | WrenchTopic | ForceTopic | ContactTopic]:
        """The topics by their role, such as `imu` or `ft_wrenches.l_ankle_ft`."""
        single = {"joint_states": self.joint_states, "imu": self.imu, "odometry": self.odometry}
        several = {
            f"{key}.{name}": topic
            for key in ("contact_wrenches", "contact_force_normal", "contact_active", "ft_wrenches")
            for name, topic in getattr(self, key).items()
        }
        return {role: topic for role, topic in {**single, **several}.items() if topic is not None}

    @property
    def contacts(self) -> tuple[str, ...]:
        """Names of all contacts."""
        return tuple(dict.fromkeys((*self.contact_wrenches, *self.contact_force_normal, *self.contact_active)))


def check_topics(topics: Topics) -> None:
    """Check that a map of topics is complete.

    Raises:
        ConfigError: a contact without a flag, a threshold or `always`.
        UnknownNameError: the rate topic is not one of the topics.
    """
    for name, contact in topics.contact_active.items():
        if (contact.topic is None) != contact.always:
            accepted = "a topic of std_msgs/Bool, or true for a contact that always touches"
            raise ConfigError.at_field(f"logs.topics.contact_active.{name}", "not one of topic and always", accepted)
    unflagged = [name for name in topics.contacts if name not in topics.contact_active]
    if unflagged and topics.contact_force_threshold is None:
        found = f"missing, though nothing else says when {unflagged[0]} touches"
        raise ConfigError.at_field("logs.topics.contact_force_threshold", found, "a force [N], or contact_active")
    stamped = [role for role in topics.by_role if not role.startswith("contact_active.")]
    if topics.rate_topic not in stamped:
        raise UnknownNameError.at_field("logs.topics.rate_topic", topics.rate_topic, stamped)
