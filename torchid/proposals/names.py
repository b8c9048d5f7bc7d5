"""Names of a robot's joints and contacts in recordings: exact, or with one prefix or suffix in place of another."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

from torchid.logs.unitree import JOINT_ORDERS, suitable_orders


@dataclass(frozen=True)
class RobotNames:
    """What the proposal of a map knows of a robot.

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
        """The link of the base that is called IMU, else the base link, and why."""
        named = [name for name in self.on_base if "imu" in name.lower()]
        others = [name for name in self.elsewhere if "imu" in name.lower()]
        beyond = f"; {others[0]} is beyond a joint" if others else ""
        return min(named, key=len, default=self.base_link), (
            "from its name" if named else f"the base link, as no link of it is called imu{beyond}"
        )


@dataclass(frozen=True)
class Spelling:
    """What a recording calls names of a robot.

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
    prefixes, suffixes = _common_starts(names), [x[::-1] for x in _common_starts([name[::-1] for name in names])]
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
    """That spelling of a robot's names by which most of them are within texts, the exact one first."""
    best = Spelling()
    for spelling in spellings(names):
        seen = {stem: name for stem, name in spelling.names.items() if any(map(within(stem).search, texts))}
        if len(seen) > len(best.names):
            best = Spelling(seen, spelling.prefix, spelling.suffix)
    return best


def exchange_affixes(texts: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """A robot's names by texts that are exactly these; if none are, that are all of them with another prefix or suffix.

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
    """The order that so many numbers of joints or contacts are assumed to have, or the robot whose it is, and why."""
    names = robot.joints if kind == "joint" else robot.feet
    for maker in suitable_orders(robot.joints, robot.name):
        order = JOINT_ORDERS[maker]
        if set(order.names) != set(robot.joints):
            continue
        if kind == "joint" and count >= len(order.joints):
            return maker, f"the order of motors of {maker}, whose joints the robot has"
        if kind == "contact" and set(order.feet) == set(robot.feet) and count == len(order.feet):
            return list(order.feet), f"the order of feet of {maker}, whose joints the robot has"
    if count == len(names) > 0:
        return list(names), "the order of the robot's file, as nothing in the log names them"
    return None
