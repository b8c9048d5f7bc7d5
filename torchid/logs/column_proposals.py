"""What unknown columns probably hold, for messages that name them."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence

from torchid.errors import LogError, excerpt
from torchid.logs.arrays import TRANSPOSED
from torchid.logs.log import NAME_FIELDS, POINTS, SHAPES, VARIANTS, WRENCHES
from torchid.logs.units import quantities_with, split_unit

_FIELDS = tuple(name for name in (*SHAPES, *VARIANTS) if name not in NAME_FIELDS)
_LISTED, _LONGEST = 12, 60
#: What force plates read; under which foot each lies, no name of a column says.
OF_PLATES = (WRENCHES[1], POINTS)
#: Words for the base in recordings, and how names of columns begin with one.
BASES = "base|root|trunk|torso|pelvis|body|mocap|odom|odometry"
OF_BASE = rf"\b({BASES}|floating base)"
_STAMPS = r"(time|datetime|timestamps?|stamps?|tstamps?)"
#: Words that recordings have for a field, by what the name of a column contains; the first that fits counts.
_WORDS = (
    ("time", rf"\b{_STAMPS}$"),  # of positions/timestamps
    (POINTS, r"\b(cop[xyz]?|ground force p[xyz])\b"),
    (WRENCHES[1], r"\b(ground (force|torque|moment)s?|force ?plates?|fp)\b"),
    ("base_position_world", rf"{OF_BASE} (pose )*(pos|position|xyz)\b"),
    ("base_linear_velocity_base", r"\b(v|vel|velocity) (body|base)$|\bodom\w* twist (twist )?linear\b"),
    (
        "base_linear_velocity_world",
        rf"{OF_BASE} (twist )*(lin ?vel|linear|lin|vel|velocity)\b",
    ),
    ("base_angular_velocity_base", rf"{OF_BASE} (twist )*(ang ?vel|angular|ang|omega)\b"),
    ("base_quat_wxyz", rf"{OF_BASE} (q|rot|rotation)\b"),
    ("joint_acceleration", r"\b(ddqj?|qdd|qpp|thdd|qacc|joints? acc|joints? accelerations?)\b"),
    ("imu_angular_velocity", r"\b(gyr|gyro\w*|omega|ang vel|angular velocity|drehraten?|imu g)\b"),
    ("imu_specific_force", r"\b(acc|accel\w*|linear acceleration|specific force|beschleunigung|imu a|a body)\b"),
    ("base_quat_wxyz", r"\b(quat\w*|orientation)\b"),
    ("contact_wrench_local", r"\b(wrench|wrenches)\b"),
    ("contact_force_normal", r"\b(foot forces?|feet forces?|contact forces?|grf|fsr)\b"),
    ("contact_active", r"\b(contacts?|touch|touches|stance)\b"),
    (
        "joint_torque",
        r"\b(taus?|torques?|efforts?|eff|trq|load|qfrc|gf|generalized forces?|drehmoment|couples?|par|pares)\b",
    ),
    (
        "joint_velocity",
        r"\b(dqs?|dqj|d q|qd|qp|qdot|thd|gv|v|qvel|vels?|velocity|velocities|speeds?|rates?|vitesses?|geschw)\b"
        r"|\b(velocidad|velocidades)\b|geschwindigkeit\b",
    ),
    (
        "joint_position",
        r"\b(observation state|gc|qs?|qj|th|theta|qpos|pos|positions?|angles?|winkel|angulos?|posicion|gelenkwinkel)\b",
    ),
    ("time", rf"\b(t|ts|{_STAMPS}|ticks?|clock|millis|sec|secs|seconds|zeit|temps|tiempo)\b"),
)
#: Fields that a unit alone tells: of `LF_HAA [deg]`, `LF_HAA [deg/s]`.
_BY_QUANTITY = {
    "angle": "joint_position", "angular velocity": "joint_velocity", "angular acceleration": "joint_acceleration",
    "torque": "joint_torque",
}  # fmt: skip
_APART = (("linear", "angular"), ("position", "velocity", "acceleration", "torque"), ("world", "base", "local"))
_DESIRED = re.compile(
    r"\b(des|desired|cmd|command(ed)?|ref|target|goal|setpoint|ff|cons|consigne|soll)\b"
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
    close = difflib.get_close_matches(column.partition(".")[0], _FIELDS, n=1, cutoff=0.8)
    of_base = bool(close) and "imu" in words.split() and not close[0].startswith("imu")
    if close and not of_base and not _contradicts(words, " ".join(words_of(close[0]))):
        return close[0]
    if (not desired and _DESIRED.search(words)) or _ANGLES.search(words):
        return ""
    named = next((field for field, pattern in _WORDS if re.search(pattern, words)), "")
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
