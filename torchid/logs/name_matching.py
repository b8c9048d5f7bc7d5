"""What names in recordings mean: joints and limbs of a robot, and fields of a log."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from unicodedata import combining, normalize

from torchid.errors import LogError, excerpt
from torchid.logs.arrays import TRANSPOSED
from torchid.logs.log import NAME_FIELDS, POINTS, SHAPES, VARIANTS, WRENCHES
from torchid.logs.units import quantities_with, split_unit

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
        simulated: whether numbers are those of simulators side by side, which know the robot's file and no manual.
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
    simulated: bool = False


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


# ------------------------------------------------------------------------------------------------------ names of fields

_FIELDS = tuple(name for name in (*SHAPES, *VARIANTS) if name not in NAME_FIELDS)
_LISTED, _LONGEST = 12, 60
#: What force plates read; under which foot each lies, no name of a column says.
OF_PLATES = (WRENCHES[1], POINTS)
#: Words for the base in recordings, and how names of columns begin with one.
BASES = "base|root|trunk|torso|pelvis|body|rumpf|mocap|odom|odometry"
OF_BASE = rf"\b({BASES}|floating base)"
_STAMPS = r"(times?|datetime|timestamps?|stamps?|tstamps?|duration)"
_NOT_ANGULAR = r"(?<!ang )(?<!angular )"
#: Words that recordings have for a field, by what the name of a column contains; the first that fits counts.
_FIELD_WORDS = (
    ("time", rf"\b{_STAMPS}$"),  # of positions/timestamps
    (POINTS, r"\b(cop[xyz]?|ground force p[xyz])\b"),
    (WRENCHES[1], r"\b(ground (force|torque|moment)s?|force ?plates?|fp)\b"),
    ("base_position_world", rf"{OF_BASE} (pose )*(pos|position|xyz)\b"),
    ("base_linear_velocity_base", rf"{_NOT_ANGULAR}\b(v|vel|velocity) (body|base)$|\bodom\w* twist (twist )?linear\b"),
    (
        "base_linear_velocity_world",
        rf"{OF_BASE} (twist )*(lin ?vel|linear|lin|vel|velocity|v)\b",
    ),
    ("base_angular_velocity_base", rf"{OF_BASE} (twist )*(ang ?vel|angular|ang|omega)\b"),
    ("base_quat_wxyz", rf"({OF_BASE}|\bimu) (q|rot|rotation)\b"),
    (
        "joint_acceleration",
        r"\b(ddqj?|qdd|qpp|thdd|qacc|(joints?|dof|q|motor) (ang\w* )?acc\w*|acc\w* joints?)\b",
    ),
    (
        "joint_velocity",
        r"\b((joints?|dof|motor) (ang vel|angular velocit\w+|omega)|(ang vel|angular velocit\w+|omega) (joints?|j))\b",
    ),
    ("imu_angular_velocity", r"\b(gyr|gyro\w*|giroscop\w*|omega|ang vel|angular velocity|drehraten?|imu g)\b"),
    ("imu_specific_force", r"\b(acc|acc?el\w*|linear acceleration|specific force|beschleunigung|imu a|a body)\b"),
    ("base_quat_wxyz", r"\b(quat\w*|orienta\w*)\b"),
    ("contact_wrench_local", r"\b(wrench|wrenches)\b"),
    ("contact_force_normal", r"\b(foot forces?|feet forces?|contact forces?|grf|fsr)\b"),
    ("contact_active", r"\b(contacts?|touch|touches|stance)\b"),
    (
        "joint_torque",
        r"\b(taus?|torques?|efforts?|eff|trq|torq|load|qfrc|gf|drehmoment|couples?|par|pares|copp\w+)\b"
        r"|\b((generalized|actuator|joints?) forces?|joints? moments?)\b"
        r"|^us$",  # of optimal control, beside states called xs
    ),
    (
        "joint_velocity",
        r"\b(dqs?|dqj|d q|qd|qp|qdot|thd|dphi|phid|gv|v|qvel|vels?|jvel|veloc\w+|speeds?|spd|rates?|vitesses?|geschw)\b"
        r"|geschwindigkeit\b",
    ),
    (
        "joint_position",
        r"\b(observation state|gc|qs?|qj|th|theta|phi|qpos|pos|posi[ctz]\w+|angles?|winkel|gelenkwinkel)\b"
        r"|\bang[ou]l[io]s?\b|^j$",
    ),
    ("time", rf"\b(t|ts|tout|{_STAMPS}|ticks?|clock|millis|micros|sec|secs|seconds|zeit|temp[os]|tiempo)\b"),
)
#: Fields that a unit alone tells: of `LF_HAA [deg]`, `LF_HAA [deg/s]`.
_BY_QUANTITY = {
    "angle": "joint_position", "angular velocity": "joint_velocity", "angular acceleration": "joint_acceleration",
    "torque": "joint_torque",
}  # fmt: skip
_APART = (
    ("linear", "angular"),
    ("position", "velocity", "acceleration", "torque"),
    ("world", "base", "local"),
    ("joint", "imu"),
)
_SYMBOL = "(?:qs?|qj|th|thetas?|phi)"
_TURN = f"(?:{_SYMBOL}|pos|positions?|angles?)"
#: How names say the derivative of positions, once and twice: `q_dot`, `thetaDot`, `dpos`, `dq/dt`, `q_ddot`.
_DERIVATIVES = (
    ("joint_acceleration", re.compile(rf"\b(dd{_TURN}|{_TURN} ?(ddots?|dd|d ?dot|dot ?dot))\b")),
    (
        "joint_velocity",
        re.compile(rf"\b(d{_TURN}|d {_SYMBOL}|{_TURN} ?dots?|dots? ?{_TURN}|{_TURN} d t|d{_TURN} ?dt)\b"),
    ),
)
_DESIRED = re.compile(
    r"\b(des|desired|cmd|command(ed)?|ref|target|goal|setpoint|ff|cons|consigne|soll\w*)\b"
    r"|\b(taus?|torques?|j|q|dq|qd|pos) d\b"  # tau_d, tau_J_d
    r"|\b(taus?|torques?) (ext|external|gravity|grav|friction|fric|coriolis|residual)\b"
    r"|\b(ext|external|gravity|friction|coriolis|residual) (joint )?(taus?|torques?)\b"  # that a model gave
)
_ANGLES = re.compile(r"\b(rpy|euler)\b")  # of the base, three: see `orientation_proposals`
_OF_MOTOR = re.compile(r"\b(kp|kd)\b|temp|volt|err|status|state|mode|flag|count|fault|limit", re.IGNORECASE)
_CURRENT = re.compile(r"(?i:current(?!.*limit)|(?<![a-z])(amps?|iq|i|cur)(?![a-z]))|[_ ]m?A$")
_OTHER_UNITS = ("V", "°C", "C", "K", "%")
_SPLIT = re.compile(r"[^A-Za-z]+|(?<=[a-z])(?=[A-Z])|(?<=(?<![A-Z])[A-Z])(?=[A-Z][a-z])")  # also axisQMsr
#: What headers without letters of ours say, the longest first.
_WRITTEN = {
    "関節角速度": "joint velocity", "関節角度": "joint position", "角速度": "gyro", "加速度": "acc", "トルク": "torque",
    "角度": "angle", "時刻": "time", "時間": "time", "关节角速度": "joint velocity", "关节速度": "joint velocity",
    "关节角度": "joint position", "关节位置": "joint position", "力矩": "torque", "扭矩": "torque", "时间": "time",
}  # fmt: skip


def is_desired(column: str) -> bool:
    """Whether a column holds what a controller wants or a model gives, not what was measured."""
    return bool(_DESIRED.search(" ".join(words_of(column))))


def is_no_torque(words: str, unit: str) -> bool:
    """Whether a column of a joint says that it is no torque: desired, or a state of its motor."""
    return is_desired(words) or _OF_MOTOR.search(words) is not None or unit in _OTHER_UNITS


def is_current(words: str, unit: str = "") -> bool:
    """Whether columns may be currents of motors."""
    return "current" in quantities_with(unit) or (not unit and _CURRENT.search(words) is not None)


def propose_field(column: str, desired: bool = False) -> str:
    """The field of a log that a column probably holds, "" if nothing is plausible.

    Args:
        column: its name.
        desired: whether a desired value counts as one that was measured.
    """
    column, unit = split_unit(column.removesuffix(TRANSPOSED))
    words = " ".join(words_of(column))
    if (derived := next((field for field, regex in _DERIVATIVES if regex.search(words)), "")) and (
        desired or not _DESIRED.search(words)
    ):
        return "" if re.search(OF_BASE, words) else derived
    close = difflib.get_close_matches(column.partition(".")[0], _FIELDS, n=1, cutoff=0.8)
    of_base = bool(close) and "imu" in words.split() and not close[0].startswith("imu")
    if close and not of_base and not _contradicts(words, " ".join(words_of(close[0]))):
        return close[0]
    if (not desired and _DESIRED.search(words)) or _ANGLES.search(words):
        return ""
    named = next((field for field, pattern in _FIELD_WORDS if re.search(pattern, words)), "")
    if named == "joint_torque" and ("current" in quantities_with(unit) or words.endswith((" current", " iq"))):
        return ""
    return named or next((_BY_QUANTITY[x] for x in quantities_with(unit) if x in _BY_QUANTITY), "")


def _contradicts(words: str, others: str) -> bool:
    """Whether two names differ in a word that makes them different quantities, such as linear and angular."""
    pairs = ((set(group) & set(words.split()), set(group) & set(others.split())) for group in _APART)
    return any(one and other and one != other for one, other in pairs)


def words_of(column: str) -> list[str]:
    """Words of a column's name, in lower case, what its letters say in other scripts among them."""
    for written, words in _WRITTEN.items():
        column = column.replace(written, f" {words} ")
    column = re.sub(r"(?<![A-Za-z])d2(?=[A-Za-z])", "dd", column)  # of d2q
    column = "".join(letter for letter in normalize("NFKD", column) if not combining(letter))  # posicao for posição
    return [word.lower() for word in _SPLIT.split(column) if word]


def name_unknown(columns: Sequence[str]) -> str:
    """Columns, with what each may be, in one line: `'timestamp' (time?), 'q_0' and 11 like it (joint_position?)`."""
    alike: dict[tuple[str, ...], list[str]] = {}
    for column in columns:
        proposed, words = propose_field(column), words_of(split_unit(column)[0]) or [column]
        if proposed and len(words) > 1 and words[-1] in ("w", "x", "y", "z"):
            words.pop()
        alike.setdefault((proposed, words[-1], "" if proposed else words[0]), []).append(column)
    named = []
    for (proposed, *_), group in list(alike.items())[:_LISTED]:
        more = f" and {len(group) - 1} like it" if len(group) > 1 else ""
        named.append(f"'{excerpt(group[0], _LONGEST)}'{more}" + (f" ({proposed}?)" if proposed else ""))
    rest = sum(map(len, list(alike.values())[_LISTED:]))
    return ", ".join(named) + (f" and {rest} more" if rest else "")


def is_foreign(column: str) -> bool:
    """Whether an unknown column has another name for a field of the format, rather than a misspelt one."""
    return bool(propose_field(column)) and not difflib.get_close_matches(column.partition(".")[0], _FIELDS, cutoff=0.5)


def unknown_columns(columns: Sequence[str]) -> LogError:
    """The error of columns or arrays that the log format does not know, all in one line."""
    accepted = "names of the log format, or logs.columns of an experiment file, which says what they hold"
    accepted += "; torchid init writes one"
    return LogError.at_field("columns", f"{len(columns)} unknown: {name_unknown(columns)}", accepted)
