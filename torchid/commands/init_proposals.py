"""What `torchid init` proposes for contacts and sensors, with hints at what it did not find."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from torchid.errors import InputError, TorchidWarning, excerpt, format_count, join_names
from torchid.logs import Log
from torchid.logs.log import FORCE_NORMAL, WRENCHES
from torchid.logs.name_matching import OF_PLATES, is_current, is_desired, propose_field, within
from torchid.parameters import WRENCH_COMPONENTS
from torchid.proposals.column_groups import Family
from torchid.proposals.file_samples import FileSample, stated_names
from torchid.robot import CollisionShapes, Robot, load_robot
from torchid.robot.urdf import fixed_joints, position_limits

_FEET = (r"foot|feet", r"sole", r"ankle_roll|ankle_flexion", r"toe|ankle|paw|hoof")
"""Words in names of links that touch the ground, the surest first."""

_ON_FEET = r"sensor|imu|camera|bumper|laser"
_IN_LIMBS = r"(?<![a-z])ft(?![a-z])"
_NAMED = r"foot|feet|sole"
_NO_FEET = r"finger|thumb|hand|palm|grip|wheel|caster"


@dataclass(frozen=True)
class GuessedContact:
    """A frame that touches the ground, and the type of its contact, as an experiment file has them."""

    frame: str
    type: Literal["point", "flat"]
    radius: float | None = None

    @property
    def entry(self) -> dict[str, object]:
        """As in the file."""
        return {key: value for key, value in vars(self).items() if value is not None}


def stated_contacts(sample: Any, robot: Robot) -> list[str]:
    """Contacts that a log in the format names, as far as the robot has them."""
    names = stated_names(sample, "contact_names")
    names += [name.split(".")[1] for name in sample if re.fullmatch(r"contact_active\.[^.]+", name)]
    return [name for name in dict.fromkeys(names) if name in robot.links]


def guess_contacts(robot: Robot, stated: Sequence[str], texts: Sequence[str]) -> list[GuessedContact]:
    """Feet: links of outermost bodies with the surest word in their names, one of each body, spheres first.

    Those that the log names, in one of its texts, count before all others.
    """
    shapes = CollisionShapes(robot)

    def is_ball(name: str) -> bool:
        return shapes.about(name, meshes=False) is not None

    inner = {body.parent for body in robot.bodies}
    texts = [text.lower() for text in texts if not re.search(_IN_LIMBS, text, re.IGNORECASE)]
    named = [name for name in robot.links if any(within(name.lower()).search(text) for text in texts)]
    frames = list(stated)
    for words, links in ((_NAMED, named), *((words, list(robot.links)) for words in _FEET)) if not frames else ():
        by_body: dict[int, list[str]] = {}
        for name in links:
            body, is_foot = robot.links[name][0], re.search(words, name, re.IGNORECASE)
            if body and body not in inner and is_foot and not re.search(_ON_FEET, name, re.IGNORECASE):
                by_body.setdefault(body, []).append(name)
        frames = [
            min(
                names,
                key=lambda name: (not is_ball(name), "sole" not in name.lower(), len(name)),
            )
            for names in by_body.values()
        ]
        if len(frames) > 1:
            break
        frames = []
    frames = frames or _balls_of_limbs(robot, shapes)
    flat = len(frames) < 3
    return [GuessedContact(x, "flat" if flat and shapes.about(x) is None else "point") for x in frames]


def without_rolling(contacts: Sequence[GuessedContact], robot: Robot) -> list[GuessedContact]:
    """The same with balls that do not roll, as of a log without the orientation that says where the ground is."""
    shapes = CollisionShapes(robot)
    rolling = [contact.type == "point" and shapes.about(contact.frame) is not None for contact in contacts]
    return [replace(x, radius=0.0) if rolls else x for x, rolls in zip(contacts, rolling, strict=True)]


def _balls_of_limbs(robot: Robot, shapes: CollisionShapes) -> list[str]:
    """Balls at the ends of limbs: of more than two that begin at the base, or called feet; no fingers or wheels."""
    if re.search(_NO_FEET, robot.base_link, re.IGNORECASE):  # of a hand
        return []
    parents, limbs = [body.parent for body in robot.bodies], dict[int, str]()
    for name in robot.links:
        body = root = robot.links[name][0]
        while root and parents[root]:
            root = parents[root]
        shape = shapes.about(name, meshes=False) if body and body not in parents else None
        if shape is not None and shape.kind == "sphere" and not re.search(_NO_FEET, name, re.IGNORECASE):
            limbs.setdefault(root, name)
    called = [name for name in limbs.values() if re.search("|".join(_FEET), name, re.IGNORECASE)]
    return list(limbs.values()) if len(limbs) > 2 else called


def held_joints(robot: Robot, lacking: Sequence[str]) -> list[str]:
    """Joints that a log lacks, but for those without a motor in loops, which follow from the others."""
    return [name for name in lacking if name not in robot.passive]


def welded_at(robot: Robot, held: Sequence[str]) -> list[str] | dict[str, float]:
    """Joints that are held, each at 0, or at the middle of its range if that is elsewhere."""
    limits = position_limits(robot.path)
    ranges = {name: limits.get(name, (-math.inf, math.inf)) for name in held}
    at = {name: 0.0 if low <= 0.0 <= high else float(f"{(low + high) / 2:.4g}") for name, (low, high) in ranges.items()}
    return at if any(at.values()) else list(at)


_SENSOR = r"(?<![a-z])(ft|force|torque|load_?cell)(?![a-z])"
_MOST_SENSORS = 16  # in limbs that are looked at


def limb_sensors(robot: Robot) -> dict[str, str]:
    """Children of fixed joints in limbs whose names say that a force/torque sensor is there, by joint."""
    found = fixed_joints(robot.path)
    named = {joint: child for joint, child in found.items() if re.search(_SENSOR, f"{joint} {child}", re.IGNORECASE)}
    in_limbs = {joint: child for joint, child in named.items() if child in robot.links and robot.links[child][0]}
    return {joint: child for joint, child in list(in_limbs.items())[:_MOST_SENSORS] if _can_be_split(robot, joint)}


def read_sensors(robot: Robot, logs: Sequence[Log]) -> list[str]:
    """Sensors in limbs that recordings have readings of, of those that the robot can be split at."""
    names = logs[0].ft_names if logs else ()
    joints = fixed_joints(robot.path) if names else {}
    return [name for name in names[:_MOST_SENSORS] if name in joints and _can_be_split(robot, name)]


def _can_be_split(robot: Robot, joint: str) -> bool:
    """Whether both sides of a fixed joint have mass."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TorchidWarning)  # said of the whole robot
            load_robot(robot.path, ft_joints=[joint], total_mass=float(robot.nominal[:, 0].sum()))
    except InputError:
        return False
    return True


def measured_torques(robot: Robot, logs: Sequence[Log]) -> list[str]:
    """Joints whose torque recordings have, if they have that of some driven ones alone; none otherwise."""
    of_joints = [zip(x.joint_names, x.joint_torque.T, strict=True) for x in logs if x.joint_torque is not None]
    if not of_joints:
        return []
    finite = [(name, bool(np.isfinite(torque).any())) for of_log in of_joints for name, torque in of_log]
    known = {name: any(x for other, x in finite if other == name) for name, _ in finite}
    driven = [name for name in robot.joint_names if name in known and name not in robot.passive]
    measured = [name for name in driven if known[name]]
    return measured if len(measured) < len(driven) else []


def proposed_sensors(
    fields: Collection[str],
    limbs: Sequence[str],
    contacts: Sequence[GuessedContact] = (),
    torques: Sequence[str] = (),
) -> str | dict[str, object]:
    """The set of sensors of a run, with those in limbs at fixed joints; `torques`: joints, if only some have one."""
    wrench, torque = bool(set(WRENCHES) & set(fields)), "joint_torque" in fields
    of_contacts = wrench or FORCE_NORMAL in fields
    named = ("full" if wrench else "joints") if torque or not of_contacts else "contacts"
    of_limbs: dict[str, object] = {"ft_sensors": list(limbs)} if limbs else {}
    if torques:
        components = {x.frame: list(WRENCH_COMPONENTS[: 6 if x.type == "flat" else 3]) for x in contacts}
        return of_limbs | {"joint_torques": list(torques)} | ({"contact_wrenches": components} if wrench else {})
    if not limbs:
        return named
    return of_limbs | ({"set": named} if wrench or torque else {})


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


# ---------------------------------------------------------------------------------------------------------------- hints

_OTHER_FILE = "; if another file has it: torchid init ROBOT 'FILE + FILE@SECONDS', docs/logs.md"
_LIMB_SENSOR = re.compile(r"(?<![a-z])(ft|loadcell|load_cell)(?![a-z]).*[xyz]$|(?<![a-z])fts?(?![a-z])", re.IGNORECASE)
_EULER = re.compile(r"(?<![a-z])(roll|pitch|yaw|rpy|euler)(?![a-z])", re.IGNORECASE)
_AS_ANGLES = "base_quat_wxyz: {rpy: ...}"
_STEP = re.compile(r"(dt|time_?step|sample_?rate|fps|rate_?hz|freq\w*)", re.IGNORECASE)


def missing_columns(joints: int, fields: Collection[str], partial: Mapping[str, Sequence[str]], what: str) -> list[str]:
    """What stamps and fields of joints lack, in words.

    Args:
        joints: how many the robot has.
        fields: of the log.
        partial: by field, joints that have columns of other fields alone.
        what: column or topic.
    """
    partial = {name: of for name, of in partial.items() if name not in fields}
    out = [f"{name}: no {what} of numbers of {join_names(of)}, but of all others" for name, of in partial.items()]
    for name in ("time", "joint_position") if joints else ("time",):
        if name not in {*fields, *partial}:
            of_joints = f", of most of {joints} joints" * (name != "time")
            out.append(f"{name}: no {what}s that look like it{of_joints}{_OTHER_FILE * (what == 'column')}")
    return out


def hints(
    left_out: Sequence[str], fields: Collection[str], joints: Sequence[str], what: str, like_torques: Sequence[Family]
) -> list[str]:
    """What columns or topics that are left out may hold of the fields that are missing.

    Args:
        left_out: their names.
        fields: of the log.
        joints: of the robot.
        what: column or topic.
        like_torques: columns of which there is one for each joint.
    """
    out = []
    measured = [name for name in left_out if not is_desired(name)]
    if plates := [name for name in left_out if propose_field(name) in OF_PLATES]:
        unknown = "without which foot stands on which and where each lies (docs/tables.md, Force plates)"
        out.append(f"contact_wrench_world: {join_names(plates)} may be readings of force plates, {unknown}")
    positions = [name for name in measured if propose_field(name) == "joint_position"]
    if joints and "joint_position" not in fields and len(positions) > 2:
        names = f"those of this robot are {join_names(joints)}"
        out.append(
            f"joint_position: {format_count(len(positions), what)} like '{excerpt(positions[0])}' may be of other"
            f" joints; {names}: is it the one that was recorded?"
        )
    out += _torque_hint([] if "joint_torque" in fields else measured, what, like_torques)
    if not {"ft_wrench", *WRENCHES} & set(fields) and (sensors := [x for x in measured if _LIMB_SENSOR.search(x)]):
        where = "contact_wrench_local of the foot's frame, or ft_wrench of a fixed joint in the limb"
        out.append(f"forces at the feet: {_like(sensors)} may be force/torque sensors: {where} (docs/sensors.md)")
    if "time" not in fields and (steps := [name for name in left_out if _STEP.fullmatch(name)]):
        out.append(f"time: '{steps[0]}' may be the step or the rate of the stamps, which have to be in the file")
    if not {"base_quat_wxyz", "base_quat_xyzw"} & set(fields) and (angles := [x for x in measured if _EULER.search(x)]):
        out.append(f"base_quat: {_like(angles)} may be angles of the base; give all three as {_AS_ANGLES}")
    return out


def unreadable(not_numbers: Sequence[str], fields: Collection[str]) -> list[str]:
    """Columns that are called like fields that are missing, and are no numbers."""
    named: dict[str, list[str]] = {}
    for name in not_numbers:
        if (field := propose_field(name)) not in ("", *fields):
            named.setdefault(field, []).append(name)
    why = "by name, but no numbers: text, or lists of several lengths"
    return [f"{field}: {_like(names)} {why}" for field, names in named.items()]


def _torque_hint(measured: Sequence[str], what: str, like_torques: Sequence[Family]) -> list[str]:
    """What may be torques, or currents of motors, of a log without torques that has columns that are left out."""
    each = join_names([_like(one.columns) for one in like_torques])
    if any(one.is_current for one in like_torques):
        return [f"joint_torque: {each} may be currents of motors; put torque constants and gear ratios in the file"]
    if like_torques:
        return [f"joint_torque: no {what} says that it is one; {each} have one of each joint: see the file"]
    currents = [name for name in measured if is_current(name)]
    more = "of some joints: joint_torque.current needs one of each (docs/tables.md)"
    return [f"joint_torque: {_like(currents)} may be currents of motors, {more}"] if currents else []


def notes_on_arrays(sample: FileSample, joints: int) -> dict[str, str]:
    """What arrays of a file without joint positions may be that no map takes as they are, by key.

    Args:
        sample: from `read_sample`.
        joints: of the robot.
    """
    out: dict[str, str] = {}
    for name, values in sample.items():
        if values is None or values.ndim != 2 or values.dtype.kind not in "fiu":
            continue
        shape, width = f"'{excerpt(name)}' has shape {values.shape}", values.shape[1]
        lists = {other: x for other, x in sample.items() if x is not None and x.dtype.kind not in "fiub"}
        texts = (other for other, x in lists.items() if x.shape == (width,))
        if (listed := next(texts, None)) is not None:
            out["columns"] = f"{shape}; if '{excerpt(listed)}' names its columns, save both as a table, CSV or Parquet"
        elif len(values) == joints < width:
            out["joint_position"] = f"{shape}; if its columns are the samples, save it transposed, (N, {joints})"
    return out


def _like(names: Sequence[str]) -> str:
    return f"'{excerpt(names[0])}'" + (f" and {len(names) - 1} more" if len(names) > 1 else "")
