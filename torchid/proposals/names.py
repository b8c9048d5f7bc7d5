"""Words of columns and what they mean; names of a robot in recordings, with one prefix or suffix for another."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

from torchid.logs.arrays import TRANSPOSED
from torchid.logs.columns import COLUMN_FIELDS
from torchid.logs.log import WRENCHES
from torchid.logs.unitree import JOINT_ORDERS, suitable_orders
from torchid.logs.units import quantities_with, split_unit

# --------------------------------------------------------------------------------------------------- words of columns


def _set(words: str) -> frozenset[str]:
    return frozenset(words.split())


_WORDS = {
    "time": "t time times stamp stamps timestamp timestamps tick ticks clock",
    "position": "q qs qpos pos position positions angle angles theta px py pz",
    "velocity": "dq qd qdot qvel vel velocity velocities speed speeds",
    "acceleration": "ddq qdd qddot qacc acc acceleration accelerations ax ay az",
    "torque": "tau taus torque torques effort efforts eff trq",
    "force": "force forces fx fy fz",
    "moment": "moment moments mx my mz",
    "wrench": "wrench wrenches",
    "quaternion": "quat quaternion orientation qw qx qy qz",
    "angular velocity": "gyro gyroscope omega wx wy wz",
    "specific force": "accelerometer accel",
    "flag": "contact contacts touch stance",
    "current": "current currents",
    "kp": "kp",
    "kd": "kd",
}
#: What a word in the name of a column says that it has.
QUANTITIES: dict[str, str] = {word: quantity for quantity, words in _WORDS.items() for word in words.split()}
_PAIRS = {
    **dict.fromkeys((("angular", "velocity"), ("angular", "vel"), ("ang", "vel")), "omega"),
    **dict.fromkeys((("linear", "acceleration"), ("lin", "acc"), ("specific", "force")), "accel"),
    ("q", "dot"): "qdot",
    ("q", "ddot"): "qddot",
    ("contact", "force"): "force",
    ("contact", "forces"): "force",
    ("contact", "wrench"): "wrench",
}
#: Words that change nothing of what a column has.
NEUTRAL = _set(
    "joint joints jnt j state states motor motors dof actuator actuators robot obs observation data sensor "
    "sensors enc encoder feedback fb actual act meas measured measurement est estimate estimated raw value "
    "values low lowstate generalized header log logs recording wxyz xyzw"
)
#: Words for the base of a robot.
BASES = _set("base root pelvis trunk torso body floating")
#: Words of what a controller wants, a model gives, or a limit is: not measured.
_NOT_MEASURED = _set(
    "des desired cmd command commanded commands ref reference target goal setpoint action actions d ff error "
    "err limit limits min max ext external gravity grav friction coriolis residual temp temperature cov "
    "covariance"
)
_OF_UNITS = {
    "angle": "position", "angular velocity": "velocity", "angular acceleration": "acceleration", "torque": "torque",
}  # fmt: skip
_FIELD_OF = {
    "time": "time", "position": "joint_position", "velocity": "joint_velocity", "acceleration": "joint_acceleration",
    "torque": "joint_torque", "force": WRENCHES[0], "moment": WRENCHES[0], "wrench": WRENCHES[0],
    "quaternion": "base_quat_wxyz", "angular velocity": "imu_angular_velocity", "specific force": "imu_specific_force",
    "flag": "contact_active",
}  # fmt: skip


def words_of(text: str) -> list[str]:
    """The words of a name in lower case, split at capitals and other characters: q and joint of `qJoint_1`."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", text)]


def join_pairs(words: Sequence[str]) -> list[str]:
    """Words of which some pairs mean one quantity, such as angular velocity, as one word each."""
    out: list[str] = []
    for word in words:
        pair = _PAIRS.get((out[-1], word)) if out else None
        out[-1:] = [pair] if pair else [*out[-1:], word]
    return out


def is_measured(words: Sequence[str]) -> bool:
    """Whether no word of a column marks it as a command or a model's value."""
    return not _NOT_MEASURED & set(words)


def quantity_of(words: Sequence[str], unit: str = "") -> str:
    """The one quantity that words, from `join_pairs`, name, else that of a unit of hinges; "" for none or several."""
    quantities = {QUANTITIES[word] for word in words if word in QUANTITIES}
    quantities = quantities - {"wrench", "flag"} or quantities  # of contact/force, wrench.torque
    if not quantities:
        return next((_OF_UNITS[x] for x in quantities_with(unit) if x in _OF_UNITS), "")
    return quantities.pop() if len(quantities) == 1 else ""


def propose_field(column: str) -> str:
    """The field of a log that a column may hold by its name, "" if nothing is plausible."""
    stem, unit = split_unit(column.removesuffix(TRANSPOSED))
    if column.partition(".")[0] in COLUMN_FIELDS:
        return column.partition(".")[0]
    words = join_pairs(words_of(stem))
    quantity = quantity_of(words, unit)
    if not is_measured(words):
        return ""
    if "ground" in words and quantity in ("force", "torque", "moment"):
        return WRENCHES[1]
    if quantity == "position" and BASES & set(words):
        return "base_position_world"
    if quantity == "acceleration" and "imu" in words:
        return "imu_specific_force"
    return _FIELD_OF.get(quantity, "")


# ---------------------------------------------------------------------------------------------------- names of a robot


@dataclass(frozen=True)
class RobotNames:
    """Names and properties of a robot for the proposal of a map.

    Attributes:
        joints: of the robot.
        feet: frames of its contacts.
        name: what it may be called.
        weight: [N].
        base_link: its base.
        on_base: links of its base; `along_base`: those with its axes.
        elsewhere: all other links.
        slides: joints that are prismatic.
        limb_sensors: children of the fixed joints in limbs that are called force or torque sensors, by joint.
    """

    joints: Sequence[str]
    feet: Sequence[str] = ()
    name: str = ""
    weight: float = 0.0
    base_link: str = "base"
    on_base: Sequence[str] = ()
    elsewhere: Sequence[str] = ()
    along_base: Sequence[str] = ()
    slides: Sequence[str] = ()
    limb_sensors: Mapping[str, str] = field(default_factory=dict)

    def imu_frame(self) -> tuple[str, str]:
        """The link of the base that is called IMU, else the base link, and the reason."""
        named = [name for name in self.on_base if "imu" in name.lower()]
        others = [name for name in self.elsewhere if "imu" in name.lower()]
        beyond = f"; {others[0]} is beyond a joint" if others else ""
        return min(named, key=len, default=self.base_link), (
            "the link's name" if named else f"no link of the base is called imu{beyond}"
        )


@dataclass(frozen=True)
class Spelling:
    """The names that a recording uses for the names of a robot.

    Attributes:
        names: of the robot, by what stands for each.
        prefix, suffix: that the robot's names have around these.
    """

    names: Mapping[str, str] = field(default_factory=dict)
    prefix: str = ""
    suffix: str = ""


def within(text: str) -> re.Pattern[str]:
    """A name as a part of another, between letters and numbers that are none of it."""
    return re.compile(rf"(?<![A-Za-z0-9]){re.escape(text)}(?![A-Za-z0-9])")


def spellings(names: Sequence[str]) -> list[Spelling]:
    """Names as they are, and without a prefix or a suffix that all have, up to a separator; the shortest first."""
    if len(names) < 2:
        return [Spelling({name: name for name in names})]
    prefixes = _common_starts(names)
    suffixes = [x[::-1] for x in _common_starts([name[::-1] for name in names])]
    out = []
    for prefix, suffix in product(prefixes, suffixes):
        stems = {name[len(prefix) : len(name) - len(suffix)]: name for name in names}
        if len(stems) == len(names) and all(re.search(r"[A-Za-z]", stem) for stem in stems):
            out.append(Spelling(stems, prefix, suffix))
    return sorted(out, key=lambda spelling: len(spelling.prefix) + len(spelling.suffix))


def _common_starts(names: Sequence[str]) -> list[str]:
    """What all names begin with, up to a separator: nothing, then longer ones."""
    common = os.path.commonprefix(list(names))
    return ["", *(common[: mark.end()] for mark in re.finditer("[_./-]", common))]


def find_spelling(texts: Sequence[str], names: Sequence[str]) -> Spelling:
    """The spelling that finds most of a robot's names in texts; the exact one comes first."""
    best = Spelling()
    for spelling in spellings(names):
        seen = {stem: name for stem, name in spelling.names.items() if any(map(within(stem).search, texts))}
        if len(seen) > len(best.names):
            best = Spelling(seen, spelling.prefix, spelling.suffix)
    return best


def exchange_affixes(texts: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """A robot's names by equal texts; if none is equal, by texts that differ only in a prefix or suffix.

    `fer_joint1` is `panda_joint1`, `l_knee` is `l_knee_joint`. Texts may be more than names, or at least half of these.
    """
    if exact := {text: text for text in texts if text in names}:
        return exact
    for ours in spellings(names):
        for theirs in spellings(texts) if len(texts) > 1 else []:
            matched = {text: ours.names[stem] for stem, text in theirs.names.items() if stem in ours.names}
            if len(matched) == min(len(texts), len(names)) and 2 * len(matched) >= len(names):
                return matched
    return {}


def usual_order(kind: str, robot: RobotNames, count: int) -> tuple[list[str] | str, str] | None:
    """The assumed order of this many numbers of joints or contacts, or the robot that has it, and the reason."""
    names = robot.joints if kind == "joint" else robot.feet
    for maker in suitable_orders(robot.joints, robot.name):
        order = JOINT_ORDERS[maker]
        if set(order.names) != set(robot.joints):
            continue
        if kind == "joint" and count >= len(order.joints):
            return maker, f"the motor order of {maker}, which has the same joints"
        if kind == "contact" and set(order.feet) == set(robot.feet) and count == len(order.feet):
            return list(order.feet), f"the order of the feet of {maker}, which has the same joints"
    if count == len(names) > 0:
        return list(names), "the order of the robot's file: the log does not name them"
    return None
