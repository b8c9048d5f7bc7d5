"""What `torchid init` proposes for a run: its sensors, the parts of a log for training and test."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from torchid.errors import InputError
from torchid.logs import Log
from torchid.logs.column_groups import Family
from torchid.logs.cutoff import choose_cutoff
from torchid.logs.log import FORCE_NORMAL, WRENCHES
from torchid.logs.timeline import DROPPED_PERIODS
from torchid.problem.compression import LEAST_PER_FOLD
from torchid.robot import Robot, load_robot
from torchid.robot.urdf import fixed_joints

_SENSOR = r"(?<![a-z])(ft|force|torque|load_?cell)(?![a-z])"
_MOST_SENSORS = 16  # in limbs that are looked at


def limb_sensors(robot: Robot) -> dict[str, str]:
    """Children of fixed joints in limbs whose names say that a force/torque sensor is there, by joint."""
    found = fixed_joints(robot.path)
    named = {joint: child for joint, child in found.items() if re.search(_SENSOR, f"{joint} {child}", re.IGNORECASE)}
    in_limbs = {joint: child for joint, child in named.items() if child in robot.links and robot.links[child][0]}
    return {joint: child for joint, child in list(in_limbs.items())[:_MOST_SENSORS] if _can_be_split(robot, joint)}


def read_sensors(robot: Robot, log: Log | InputError) -> list[str]:
    """Sensors in limbs that a log has readings of, of those that the robot can be split at."""
    names = () if isinstance(log, InputError) else log.ft_names
    joints = fixed_joints(robot.path) if names else {}
    return [name for name in names[:_MOST_SENSORS] if name in joints and _can_be_split(robot, name)]


def _can_be_split(robot: Robot, joint: str) -> bool:
    """Whether both sides of a fixed joint have mass."""
    try:
        load_robot(robot.path, ft_joints=[joint])
    except InputError:
        return False
    return True


def proposed_sensors(fields: Collection[str], limbs: Sequence[str]) -> str | dict[str, object]:
    """The set of sensors of a run, with those in limbs at fixed joints."""
    wrench, torque = bool(set(WRENCHES) & set(fields)), "joint_torque" in fields
    of_contacts = wrench or FORCE_NORMAL in fields
    named = ("full" if wrench else "joints") if torque or not of_contacts else "contacts"
    if not limbs:
        return named
    return ({"set": named} if wrench or torque else {}) | {"ft_sensors": list(limbs)}


_LIKE_TORQUES = "of these no name says what they are; uncomment one of torques [N m]"
_LIKE_CURRENTS = (
    'currents of motors: put in N m/A for KT and gears for GEAR, numbers, or by joint {"*": 9, "*_knee": 12}'
)


def like_torques(families: Sequence[Family]) -> tuple[str, list[dict[str, object]]]:
    """What to do with columns that may be torques, or currents of motors, "" without any; and entries of these."""
    currents = any(family.is_current for family in families)
    entries = [family.counted_entry for family in families]
    if currents:
        for entry, family in zip(entries, families, strict=True):
            entry |= {"unit": family.unit} if family.unit not in ("", "A") else {}
            entry |= {"torque_constant": "KT", "gear_ratio": "GEAR"}
        entries = [{"current": entry} for entry in entries]
    return (_LIKE_CURRENTS if currents else _LIKE_TORQUES if families else ""), entries


_TESTED = 0.2  # of a log
_FEWEST_FOLDS = 2
_FOLD_MARGIN = 1.1  # more samples than folds need, as their number is known once they are filtered
_LEAST_TEST = 1.5  # of what a filter spoils at both ends: a third of a test is left
_RIDGE = 1e-3  # where nothing can be left out to choose it by


@dataclass(frozen=True)
class Split:
    """How a log is used.

    Attributes:
        has_test: whether its last fifth is held back.
        ridge: auto, where there are enough samples to leave some out.
        guessed, missing: why not, and what a filter leaves nothing of, in words; "" where all is as usual.
    """

    has_test: bool = True
    ridge: str | float = "auto"
    guessed: str = ""
    missing: str = ""


def split_log(log: Log | InputError, base_is_derived: bool = False) -> Split:
    """The split of a log, by the filter that `preprocessing.cutoff_hz: auto` chooses; as usual if it is not read.

    Args:
        log: as it is read, or why it is not.
        base_is_derived: whether the motion of the base is worked out of that of the joints.
    """
    if isinstance(log, InputError) or len(log) < 2:
        return Split()
    try:
        cutoff_hz = choose_cutoff([log], base_is_derived=base_is_derived).cutoff_hz
    except InputError:  # which a fit will say
        return Split()
    length = float(log.time[-1] - log.time[0])
    spoiled = 0.0 if cutoff_hz is None else 2.0 * DROPPED_PERIODS / cutoff_hz
    independent_hz = (len(log) - 1) / length if cutoff_hz is None else 2.0 * cutoff_hz
    folded = spoiled + _FOLD_MARGIN * _FEWEST_FOLDS * LEAST_PER_FOLD / independent_hz
    if _TESTED * length >= _LEAST_TEST * spoiled and (1.0 - _TESTED) * length >= folded:
        return Split()
    filtered = "" if cutoff_hz is None else f" (the filter of {cutoff_hz:g} Hz spoils {spoiled:.2g} s)"
    if length <= spoiled:
        return Split(False, _RIDGE, missing=f"motion: {length:.2g} s are too short for a fit{filtered}")
    guessed = f"logs.test: none, as {length:.2g} s are too short for a part to be held back{filtered}"
    if length >= folded:
        return Split(False, guessed=guessed)
    return Split(False, _RIDGE, f"{guessed}, or to choose the ridge by ({_RIDGE:g})")
