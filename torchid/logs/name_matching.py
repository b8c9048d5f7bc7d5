"""Match names of recordings to those of a robot: by what both contain, else by the limbs that both mean."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

SUFFIXES = {"joint": ("", "_joint"), "contact": ("", "_foot", "_sole", "_contact", "_link", "_ankle_roll_link")}
"""What names of a URDF may have more than those of a recording."""

_LETTER = "[A-Za-z0-9\u00c0-\u024f]"  # of words with accents, too: no l between those of accélération
_MOST_TEXTS = 1000  # that are compared with all joints
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z\u00df-\u00ff]+")
_PLACE = re.compile(r"(?<![A-Za-z0-9])(?i:[FRHL][FRHL])[_.]?[0-9](?![A-Za-z0-9])")
_LIMBS = {
    "left": "l", "right": "r", "front": "f", "fore": "f", "rear": "b", "hind": "b", "back": "b", "l": "l", "r": "r",
    "fl": "fl", "lf": "fl", "fr": "fr", "rf": "fr", "rl": "bl", "hl": "bl", "lh": "bl", "bl": "bl", "lb": "bl",
    "rr": "br", "hr": "br", "rh": "br", "br": "br", "rb": "br", "vl": "fl", "vr": "fr", "avg": "fl", "avd": "fr",
    "arg": "bl", "ard": "br", "gauche": "l", "droit": "r", "droite": "r", "avant": "f", "arriere": "b", "arrière": "b",
    "links": "l", "linker": "l", "linkes": "l", "rechts": "r", "rechter": "r", "rechtes": "r", "vorne": "f",
    "vorn": "f", "hinten": "b", "izquierda": "l", "izquierdo": "l", "derecha": "r", "derecho": "r", "izq": "l",
    "der": "r", "delantera": "f", "trasera": "b",
}  # fmt: skip


@dataclass(frozen=True)
class KnownRobot:
    """What the proposal of a map knows of a robot.

    Attributes:
        joints: of the robot.
        feet: frames of its contacts.
        name: what it may be called.
        weight: [N].
        base_link: its base.
        on_base: links of its base; `along_base`: those with its axes.
        elsewhere: all others.
        slides: joints that are prismatic.
        moving: all joints that move, those too that mimic others.
        limbs: its joints along each part of the tree without branches, from the base outwards.
        limb_sensors: children of the fixed joints in limbs that are called force or torque sensors, by joint.
    """

    joints: Sequence[str]
    feet: Sequence[str]
    name: str
    weight: float
    base_link: str
    on_base: Sequence[str]
    elsewhere: Sequence[str]
    limb_sensors: Mapping[str, str] = field(default_factory=dict)
    along_base: Sequence[str] = ()
    slides: Sequence[str] = ()
    moving: Sequence[str] = ()
    limbs: Sequence[Sequence[str]] = ()


def within(stem: str) -> re.Pattern[str]:
    """A name as a part of another, between letters and numbers that are none of it."""
    before = rf"(?:(?<!{_LETTER})|(?<=[a-z]))" if stem[:1].isupper() else rf"(?<!{_LETTER})"  # contactFlagLF_FOOT
    return re.compile(rf"{before}{re.escape(stem)}(?!{_LETTER})")


def spelled(stem: str) -> re.Pattern[str]:
    """A name as a part of another, whatever its capitals and separators: left_hip_pitch in `LeftHipPitch.Position`."""
    words = [re.escape(word) for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", stem)] or [re.escape(stem)]
    return re.compile(rf"(?<!{_LETTER})(?i:{'[ _./-]?'.join(words)})(?![a-z0-9\u00df-\u024f])")


def limbs(text: str) -> frozenset[str]:
    """Left or right (l, r) and front or back (f, b), as far as a name says it, in words or letters."""
    return frozenset("".join(_LIMBS.get(word.lower(), "") for word in _WORD.findall(text)))


def match_joints(texts: Sequence[str], joints: Sequence[str]) -> dict[str, str]:
    """Joints of a robot by texts that spell them, some in other capitals, with other prefixes, or without `_joint`.

    A text and a joint are of the same limb, and the other words of one are in the other, one after the other. Of
    several the nearest counts; where two are as near, none.
    """
    out = {text: text for text in texts if text in joints}
    of_texts = {text: limb_and_words(text) for text in texts[:_MOST_TEXTS] if text not in out}
    of_joints = {joint: limb_and_words(joint) for joint in joints if joint not in out}
    apart = {
        (text, joint): abs(len(words) - len(others))
        for text, (limb, words) in of_texts.items()
        for joint, (other, others) in of_joints.items()
        if limb == other and (_contains(words, others) or _contains(others, words))
    }
    nearest: dict[tuple[int, str], list[int]] = {}
    for pair, distance in apart.items():
        for which, name in enumerate(pair):
            nearest.setdefault((which, name), []).append(distance)
    for pair, distance in apart.items():
        rivals = [nearest[which, name] for which, name in enumerate(pair)]
        if all(min(others) == distance and others.count(distance) == 1 for others in rivals):
            out[pair[0]] = pair[1]
    return out


def limb_and_words(text: str) -> tuple[frozenset[str], tuple[str, ...]]:
    """The limb that a name of a joint means, and its other words."""
    words = [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", text)]
    return limbs(text), tuple(word for word in words if word not in _LIMBS and word != "joint")


_KINDS = {
    "leg": "hip|thigh|calf|knee|ankle|leg", "arm": "shoulder|elbow|wrist|arm", "torso": "torso|waist|spine|chest",
    "waist": "torso|waist|spine|chest", "head": "head|neck", "neck": "head|neck",
}  # fmt: skip


def limb_of(text: str, count: int, robot: KnownRobot) -> Sequence[str]:
    """The joints of the limb with so many that a text means, by its side or by what it is; none if none or several."""
    side, words = limb_and_words(text)
    found = [of for of in robot.limbs if len(of) == count and frozenset.intersection(*map(limbs, of)) == side]
    kinds = [_KINDS[word] for word in words if word in _KINDS]
    if kinds:
        found = [of for of in found if all(any(re.search(kind, name.lower()) for name in of) for kind in kinds)]
    return found[0] if len(found) == 1 and (side or kinds) else ()


def _contains(words: tuple[str, ...], others: tuple[str, ...]) -> bool:
    """Whether words contain others, at least one, one after the other."""
    return bool(others) and any(words[i : i + len(others)] == others for i in range(len(words)))


def joints_by_place(columns: Sequence[str], joints: Sequence[str]) -> dict[str, str]:
    """Joints by texts like `FR_0` in columns, the first joint of the front right limb; none if not all joints are."""
    found = dict.fromkeys(match[0] for column in columns if (match := _PLACE.search(column)))
    limbs_of = {text: limbs(text) for text in found}
    out = dict[str, str]()
    for limb in set(limbs_of.values()):
        texts = sorted((text for text, of in limbs_of.items() if of == limb), key=lambda text: int(text[-1]))
        names = [name for name in joints if limbs(name) == limb]
        if len(texts) == len(names):
            out |= dict(zip(texts, names, strict=True))
    return out if len(out) == len(joints) else {}


def match_names(texts: Sequence[str], names: Sequence[str], kind: str) -> dict[str, str]:
    """Names of a robot by texts that mean one each: they contain it, or all name the same limb.

    Args:
        texts: of a recording.
        names: of the robot.
        kind: of the names: joint, contact.
    """
    best: dict[str, str] = {}
    for suffix in SUFFIXES[kind]:
        stems = {name.removesuffix(suffix).lower(): name for name in names if name.endswith(suffix)}
        found: dict[str, str] = {}
        for text in texts:
            fitting = [stem for stem in stems if stem and within(stem).search(text.lower())]
            if fitting and stems[longest := max(fitting, key=len)] not in found.values():
                found[text] = stems[longest]
        if len(found) > len(best):
            best = found
    if len(best) == min(len(texts), len(names)):
        return best
    by_limbs = _by_limbs(texts, names)
    return by_limbs if len(by_limbs) > len(best) else best


def _by_limbs(texts: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Texts and names that alone mean the same limb."""
    of_names, of_texts = {name: limbs(name) for name in names}, {text: limbs(text) for text in texts}
    out = {}
    for text, limb in of_texts.items():
        fitting = [name for name, other in of_names.items() if other and other == limb]
        again = [other for other, same in of_texts.items() if same == limb]
        if len(fitting) == 1 and len(again) == 1:
            out[text] = fitting[0]
    return out
