"""Orders that joints and contacts may be in instead of the given one: exchanged limbs, sides, ends, other programs'."""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Iterator, Sequence

from torchid.robot import Robot

#: Parts of names that differ between left and right, and between front and rear.
_SIDES = ("left right", "Left Right", "LEFT RIGHT", "l r", "L R", "FL FR", "RL RR", "HL HR", "LF RF", "LH RH")
_ENDS = (
    *("front rear", "front hind", "front back", "fore hind", "Front Rear", "FL RL", "FR RR", "LF LH", "RF RH"),
    *("fl rl", "fr rr", "lf lh", "rf rh"),
)
_ENDS_OF_ROBOTS = ("left and right", "front and rear")
_NAME_PARTS = re.compile(r"([A-Za-z0-9]+)")
_WORDS = re.compile(r"([A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+)")
#: Largest number of pairs of limbs that are tried.
_MAX_PAIRS = 28
#: Joints of a limb whose names may be exchanged: neighbours, and those with one between.
_MOST_APART = 2


def exchanged_names(names: Sequence[str], shortest: int = 2) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Possible true names of the columns, with a description: sides, ends, two limbs, or the order.

    `shortest`: number of names that a limb has at least.
    """
    known = {tuple(names)}
    for description, pairs in zip(_ENDS_OF_ROBOTS, (_SIDES, _ENDS), strict=True):
        permuted = _exchanged(names, pairs)
        if permuted is not None and permuted not in known:
            known.add(permuted)
            yield description, permuted
    for description, permuted in (
        *_exchanged_pairs(names, shortest),
        ("alphabetical order and this", tuple(sorted(names))),
        ("the order", tuple(names[::-1])),
    ):
        if permuted not in known and len(names) > 1:
            known.add(permuted)
            yield description, permuted


def _exchanged(names: Sequence[str], pairs: Sequence[str]) -> tuple[str, ...] | None:
    """Names with their parts exchanged within each pair; None unless that permutes the names."""
    for some in (pairs, *([pair] for pair in pairs)):  # all pairs at once, else one at a time: some share a part
        partner = {old: new for pair in some for old, new in (pair.split(), pair.split()[::-1])}
        exchanged = tuple("".join(partner.get(part, part) for part in _NAME_PARTS.split(name)) for name in names)
        if sorted(exchanged) == sorted(names) and exchanged != tuple(names):
            return exchanged
    return _by_first_letter(names) if pairs is _SIDES else None


def _exchanged_pairs(names: Sequence[str], shortest: int) -> list[tuple[str, tuple[str, ...]]]:
    """The names with two limbs exchanged, which differ in a word, or the first two: `lf_hip` and `rf_hip`.

    Of limbs with at least the `shortest` number of names; none of a robot with too many limbs to try all pairs.
    """
    limbs: dict[tuple[int, int], dict[str, dict[tuple[str, str], str]]] = {}  # by place, limb, and what is beside it
    for name in names:
        words = _WORDS.split(name)
        for first, last in ((1, 4), *((word, word + 1) for word in range(1, len(words), 2))):
            before, limb, after = ("".join(part) for part in (words[:first], words[first:last], words[last:]))
            limbs.setdefault((first, last), {}).setdefault(limb, {})[before, after] = name
    exchanged: dict[tuple[str, ...], str] = {}
    for of_place in limbs.values():
        for (one, its), (other, others) in itertools.combinations(of_place.items(), 2):
            if its.keys() == others.keys() and len(its) >= shortest:
                partner = {a: b for key in its for a, b in ((its[key], others[key]), (others[key], its[key]))}
                exchanged.setdefault(tuple(partner.get(name, name) for name in names), f"{one} and {other}")
    return [(text, permuted) for permuted, text in exchanged.items()] if len(exchanged) <= _MAX_PAIRS else []


def _by_first_letter(names: Sequence[str]) -> tuple[str, ...] | None:
    """Names with left and right exchanged by first letter: LAnkle and RAnkle, lfoot and rfoot."""
    swap = {"L": "R", "R": "L", "l": "r", "r": "l"}
    swapped = tuple(
        other if name[:1] in swap and (other := swap[name[0]] + name[1:]) in names else name for name in names
    )
    return swapped if swapped != tuple(names) else None


def joint_orders(robot: Robot) -> dict[str, tuple[str, ...]]:
    """Orders of a robot's joints that programs without names use, by description.

    Libraries for dynamics and MuJoCo go depth first, Isaac Lab breadth first; Isaac Gym, and what a USD file was made
    with, take the limbs of a body by name, others as they are listed.
    """
    names = {number: body.joint.name for number, body in enumerate(robot.bodies) if body.joint is not None}

    def listed(body: int, by_name: bool) -> list[int]:
        return sorted(robot.children[body], key=names.__getitem__) if by_name else list(robot.children[body])

    out = {}
    for by_name in (False, True):
        found: dict[str, list[int]] = {"depth": [], "breadth": []}
        for kind, order in found.items():
            waiting = [0]
            while waiting:
                body = waiting.pop(0)
                order.append(body)
                beyond = listed(body, by_name)
                waiting = beyond + waiting if kind == "depth" else waiting + beyond
            joints = tuple(names[body] for body in order[1:] if names[body] in robot.joint_names)
            out[f"{kind}-first order{', limbs by name' if by_name else ''}"] = joints
    return out


def other_orders(names: Sequence[str], robot: Robot | None) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Possible true names of the columns of joints, with a description, as of `exchanged_names`; `robot` if known.

    Beside these, orders of other programs, with left and right, or front and rear, exchanged, too.
    """
    known = {tuple(names)}
    for description, permuted in exchanged_names(names):
        known.add(permuted)
        yield f"{description} exchanged", permuted
    if robot is None or set(names) != set(robot.joint_names):
        return
    for description, order in joint_orders(robot).items():
        sides = [(f"{what} exchanged", one) for what, one in exchanged_names(order) if what in _ENDS_OF_ROBOTS]
        for exchanged, permuted in (("", order), *sides):
            if permuted not in known:
                known.add(permuted)
                yield f"columns in {description}" + f" with {exchanged}" * bool(exchanged), permuted


def joints_of_limb(robot: Robot, frame: str) -> list[str]:
    """The joints between the base and a link, from the base on."""
    joints = (robot.bodies[body].joint for body in robot.bodies_to(robot.links[frame][0]))
    return [joint.name for joint in joints if joint is not None]


def exchanged_pairs(names: Sequence[str], some: Collection[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """The names with any two exchanged, one of them at least among `some`."""
    for one, other in itertools.combinations(names, 2):
        if one in some or other in some:
            yield _with_exchanged(names, one, other)


def _with_exchanged(names: Sequence[str], one: str, other: str) -> tuple[str, tuple[str, ...]]:
    """The names with two exchanged, and what is."""
    partner = {one: other, other: one}
    return f"{one} and {other} exchanged", tuple(partner.get(name, name) for name in names)


def exchanged_in_limbs(names: Sequence[str], robot: Robot | None) -> Iterator[tuple[str, tuple[str, ...]]]:
    """The names with two joints of a limb exchanged that are neighbours, or have one joint between."""
    if robot is None or set(names) != set(robot.joint_names):
        return
    for body in robot.bodies:
        above, apart = body.parent, 0
        while body.joint is not None and body.joint.name in names and above > 0 and apart < _MOST_APART:
            joint = robot.bodies[above].joint
            if joint is not None and joint.name in names:
                apart += 1
                yield _with_exchanged(names, joint.name, body.joint.name)
            above = robot.bodies[above].parent
