"""What unknown columns probably hold, for messages that name them."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence

from torchid.errors import LogError, excerpt
from torchid.logs.log import SHAPES, VARIANTS

_LISTED = 30
_LONGEST = 60
#: Words that recordings have for a field, by what the name of a column must contain; the first that fits counts.
_WORDS = (
    ("joint_acceleration", r"\b(ddq|qdd|qacc|joint acc(eleration)?s?)\b"),
    ("imu_angular_velocity", r"\b(gyro\w*|omega|ang(ular)? vel(ocity)?)\b"),
    ("imu_specific_force", r"\b(acc|accel\w*|linear acceleration|specific force)\b"),
    ("base_quat_wxyz", r"\b(quat\w*|orientation|rot)\b"),
    ("contact_active", r"\b(contacts?|touch|stance|in contact)\b"),
    ("contact_force_normal", r"\b(foot forces?|feet forces?|grf)\b"),
    ("joint_torque", r"\b(taus?|torques?|efforts?|trq|tor)\b"),
    ("joint_velocity", r"\b(dqs?|qd|qvel|vels?|velocity|velocities|speeds?|dof vel)\b"),
    ("joint_position", r"\b(qs?|qpos|pos|positions?|angles?|dof pos)\b"),
    ("time", r"\b(t|ts|time|timestamps?|stamps?|clock|sec|seconds|millis|micros|nanos)\b"),
)
_DESIRED = re.compile(r"\b(des|desired|cmd|command|ref|target|goal|set ?point)\b")
_SPLIT = re.compile(r"[^A-Za-z]+|(?<=[a-z])(?=[A-Z])")


def propose_field(column: str) -> str:
    """The field of a log that a column probably holds, "" if nothing is plausible."""
    close = difflib.get_close_matches(column.partition(".")[0], (*SHAPES, *VARIANTS), n=1, cutoff=0.8)
    if close:
        return close[0]
    words = " ".join(_SPLIT.split(column)).lower()
    if _DESIRED.search(words):
        return ""
    return next((field for field, pattern in _WORDS if re.search(pattern, words)), "")


def name_unknown(columns: Sequence[str]) -> str:
    """Columns, with what each may be, in one line: `'timestamp' (time?), 'note'`."""
    named = []
    for column in columns[:_LISTED]:
        proposed = propose_field(column)
        named.append(f"'{excerpt(column, _LONGEST)}'" + (f" ({proposed}?)" if proposed else ""))
    return ", ".join(named) + (f" and {len(columns) - _LISTED} more" if len(columns) > _LISTED else "")


def unknown_columns(columns: Sequence[str]) -> LogError:
    """The error of several columns or arrays that the log format does not know, all in one line."""
    accepted = "names of the log format, or logs.columns of an experiment file, which says what they hold"
    return LogError.at_field("columns", f"{len(columns)} unknown: {name_unknown(columns)}", accepted)
