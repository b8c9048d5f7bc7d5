"""What names of foreign columns mean: one short list of words and abbreviations for what a robot records."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence

from torchid.errors import LogError, excerpt
from torchid.logs.arrays import TRANSPOSED
from torchid.logs.log import NAME_FIELDS, SHAPES, VARIANTS, WRENCHES
from torchid.logs.units import quantities_with, split_unit

_FIELDS = tuple(name for name in (*SHAPES, *VARIANTS) if name not in NAME_FIELDS)
_MAX_NAMES, _MAX_LETTERS = 12, 60  # in a message about unknown columns
UNNAMED = re.compile(r"column_\d+")
"""Columns of a table of text that has no line of names, by their place."""


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
    """The words of a name in lower case, parted by anything but letters and by capitals: q and joint of `qJoint_1`."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", text)]


def join_pairs(words: Sequence[str]) -> list[str]:
    """Words of which some pairs mean one quantity, such as angular velocity, as one word each."""
    out: list[str] = []
    for word in words:
        pair = _PAIRS.get((out[-1], word)) if out else None
        out[-1:] = [pair] if pair else [*out[-1:], word]
    return out


def is_measured(words: Sequence[str]) -> bool:
    """Whether no word of a column says that it holds what a controller wants, or a model gives."""
    return not _NOT_MEASURED & set(words)


def quantity_of(words: Sequence[str], unit: str = "") -> str:
    """The one quantity that words, from `join_pairs`, name, else that of a unit of hinges; "" for none or several."""
    found = {QUANTITIES[word] for word in words if word in QUANTITIES}
    found = found - {"wrench", "flag"} or found  # of contact/force, wrench.torque
    if not found:
        return next((_OF_UNITS[x] for x in quantities_with(unit) if x in _OF_UNITS), "")
    return found.pop() if len(found) == 1 else ""


def propose_field(column: str) -> str:
    """The field of a log that a column may hold by its name, "" if nothing is plausible."""
    stem, unit = split_unit(column.removesuffix(TRANSPOSED))
    if close := difflib.get_close_matches(column.partition(".")[0], _FIELDS, n=1, cutoff=0.9):
        return close[0]
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


def name_unknown(columns: Sequence[str]) -> str:
    """Columns, with what each may be, in one line: `'timestamp' (time?), 'q_0' and 11 like it (joint_position?)`."""
    alike: dict[tuple[str, ...], list[str]] = {}
    for column in columns:
        proposed, words = propose_field(column), words_of(split_unit(column)[0]) or [column]
        if proposed and len(words) > 1 and words[-1] in ("w", "x", "y", "z"):
            words.pop()
        alike.setdefault((proposed, words[-1], "" if proposed else words[0]), []).append(column)
    named = []
    for (proposed, *_), group in list(alike.items())[:_MAX_NAMES]:
        more = f" and {len(group) - 1} like it" if len(group) > 1 else ""
        named.append(f"'{excerpt(group[0], _MAX_LETTERS)}'{more}" + (f" ({proposed}?)" if proposed else ""))
    others = sum(map(len, list(alike.values())[_MAX_NAMES:]))
    return ", ".join(named) + (f" and {others} more" if others else "")


def is_foreign(column: str) -> bool:
    """Whether an unknown column has another name for a field of the format, rather than a misspelt one."""
    return bool(propose_field(column)) and not difflib.get_close_matches(column.partition(".")[0], _FIELDS, cutoff=0.5)


def unknown_columns(columns: Sequence[str]) -> LogError:
    """The error of columns or arrays that the log format does not know, all in one line."""
    found = f"{len(columns)} unknown: {name_unknown(columns)}"
    if all(map(UNNAMED.fullmatch, columns)):
        found = f"{len(columns)} of numbers without a line of names"
    accepted = "names of the log format, or logs.columns of an experiment file, which says what they hold"
    accepted += "; torchid init writes one"
    return LogError.at_field("columns", found, accepted)
