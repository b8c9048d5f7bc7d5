"""`torchid init`: an experiment file from a URDF and a log, with what was guessed beside it."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import fill
from typing import Any

import yaml

from torchid.commands.folder import check_free_file
from torchid.commands.reading import memory_needed
from torchid.config.preprocessing import PreprocessingConfig
from torchid.errors import ConfigError, InputError, LogError, about_file, excerpt, format_count, join_names
from torchid.logs import Columns, Topics, read_log
from torchid.logs.bag_samples import read_bag_sample
from torchid.logs.column_proposals import OF_PLATES, propose_field
from torchid.logs.column_samples import read_sample, stated_names, states_degrees, texts_in
from torchid.logs.containers import LogKind, atomic_output, existing_log_kind
from torchid.logs.map_proposals import MapProposal, propose_map
from torchid.logs.name_matching import KnownRobot, within
from torchid.logs.time_range import split_range
from torchid.logs.topic_proposals import USED_TYPES, frame_of, propose_topics
from torchid.regressor.kinematics import GRAVITY_WORLD
from torchid.robot import CollisionShapes, Robot, load_robot
from torchid.robot.urdf import fixed_joints, position_limits

_FEET = (r"foot|feet", r"sole", r"ankle_roll|ankle_flexion", r"toe|ankle|paw|hoof")
"""Words in names of links that touch the ground, the surest first."""

_SENSOR = r"(?<![a-z])(ft|force|torque|load_?cell)(?![a-z])"
_MOST_SENSORS = 16  # in limbs that are looked at
_ON_FEET = r"sensor|imu|camera|bumper|laser"
_NAMED = r"foot|feet|sole"
_FORCES = ("joint_torque", "contact_wrench_local", "contact_wrench_world", "contact_force_normal", "ft_wrench")
_POSE = ("base_quat_wxyz", "base_quat_xyzw")
_IMU = ("imu_specific_force", "imu_angular_velocity")
_WHAT = {"columns": "names, units and orders of the file", "topics": "what the messages of the bag hold"}
_WELDED = "joints that the log lacks, held still; one that moves needs readings"
_OTHER_FILE = "; if another file has it: torchid init URDF 'FILE + FILE@SECONDS', docs/logs.md"
_LINE = 118


@dataclass
class Initiated:
    """What `init` has written, and what a user should know of it.

    Attributes:
        output: the experiment file.
        found: what log and robot have, in words.
        guessed: what should be compared with the robot and its manual.
        missing: what a fit needs and nobody found.
    """

    output: Path
    found: list[str] = field(default_factory=list)
    guessed: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        said = [(word, text) for word in ("found", "guessed", "missing") for text in getattr(self, word)]
        lines = [fill(f"{word:<14}{text}", 100, subsequent_indent=" " * 14) for word, text in said]
        return "\n".join([*lines, f"written to    {self.output}; next: torchid check {self.output}"])


@dataclass(frozen=True)
class _Contact:
    frame: str
    type: str


def init(urdf: str | Path, log: str | Path, output: str | Path) -> Initiated:
    """Write an experiment file for a robot and a log, complete or not at all.

    Args:
        urdf: of the robot.
        log: a table or arrays, in the log format or not, several of these as one log, or a bag.
        output: the file; nothing that is there is replaced.

    Raises:
        InputError: the URDF or the log cannot be read, or there is a file already.
    """
    target, path = Path(output), Path(log)
    if target.suffix.lower() not in (".yaml", ".yml"):
        raise ConfigError("command line", "--output", f"'{target}'", "a file name that ends in .yaml or .yml")
    if os.path.lexists(target):
        raise ConfigError(target, "--output", "exists", "a new file: torchid init replaces none")
    part = split_range(path)
    files = [file.path for file in part.files]
    check_free_file(target, "--output", False, [urdf, *files])
    is_bag = existing_log_kind(part.file) is LogKind.BAG
    robot = load_robot(urdf)
    contacts, fields, proposal = _of_bag(part.file, robot) if is_bag else _of_columns(files, robot)
    out = Initiated(target)
    text = _text(robot, urdf, path, target, contacts, fields, proposal)
    _describe(out, robot, contacts, fields, proposal)
    _try(out, path, proposal)
    with atomic_output(target) as new:
        new.write_text(text, encoding="utf-8")
    return out


def _of_columns(files: Sequence[Path], robot: Robot) -> tuple[list[_Contact], set[str], MapProposal]:
    """Contacts, fields and a map of a table or arrays, or of several that are one log."""
    samples, in_degrees, size = [], set[str](), 0.0
    for file in files:
        size = memory_needed(file, PreprocessingConfig().memory_gb, size)
        if size > PreprocessingConfig().memory_gb:
            accepted = "a log of a part of the recording, whose map holds for all of it"
            raise LogError(file, "file", f"arrays of {size:.2g} GB", accepted)
        with about_file(file):
            samples.append(read_sample(file))
            in_degrees |= set(samples[-1]) if states_degrees(file) else set()
    sample = {name: values for of_file in reversed(samples) for name, values in of_file.items()}
    contacts = _guess_contacts(robot, _stated_contacts(sample, robot), texts_in(sample))
    proposal = propose_map(sample, _known(robot, contacts), samples if len(files) > 1 else (), in_degrees)
    fields = _fields_of(sample, proposal)
    _add_imu_frame(robot, fields, proposal)
    return contacts, fields, proposal


def _of_bag(file: Path, robot: Robot) -> tuple[list[_Contact], set[str], MapProposal]:
    """Contacts, fields and a map of the topics of a bag."""
    with about_file(file):
        sample = read_bag_sample(file, USED_TYPES)
    contacts = _guess_contacts(robot, [], [f"{frame_of(topic)} {name}" for name, topic in sample.items()])
    proposal = propose_topics(sample, _known(robot, contacts))
    return contacts, proposal.fields, proposal


def _known(robot: Robot, contacts: Sequence[_Contact]) -> KnownRobot:
    """What the proposal of a map knows of the robot."""
    on_base, elsewhere = ([name for name, (body, _) in robot.links.items() if bool(body) == x] for x in (False, True))
    feet, weight = [contact.frame for contact in contacts], -GRAVITY_WORLD[2] * float(robot.nominal[:, 0].sum())
    sensors = _limb_sensors(robot)
    return KnownRobot(robot.joint_names, feet, robot.path.stem, weight, robot.base_link, on_base, elsewhere, sensors)


def _limb_sensors(robot: Robot) -> dict[str, str]:
    """Children of fixed joints in limbs whose names say that a force/torque sensor is there, by joint."""
    found = fixed_joints(robot.path)
    named = {joint: child for joint, child in found.items() if re.search(_SENSOR, f"{joint} {child}", re.IGNORECASE)}
    in_limbs = {joint: child for joint, child in named.items() if child in robot.links and robot.links[child][0]}
    return {joint: child for joint, child in list(in_limbs.items())[:_MOST_SENSORS] if _can_be_split(robot, joint)}


def _can_be_split(robot: Robot, joint: str) -> bool:
    """Whether both sides of a fixed joint have mass."""
    try:
        load_robot(robot.path, ft_joints=[joint])
    except InputError:
        return False
    return True


def _stated_contacts(sample: Any, robot: Robot) -> list[str]:
    """Contacts that a log in the format names, as far as the robot has them."""
    names = stated_names(sample, "contact_names")
    names += [name.split(".")[1] for name in sample if re.fullmatch(r"contact_active\.[^.]+", name)]
    return [name for name in dict.fromkeys(names) if name in robot.links]


def _guess_contacts(robot: Robot, stated: Sequence[str], texts: Sequence[str]) -> list[_Contact]:
    """Feet: links of outermost bodies with the surest word in their names, one of each body, spheres first.

    Those that the log names, in one of its texts, count before all others.
    """
    shapes = CollisionShapes(robot)
    inner = {body.parent for body in robot.bodies}
    named = [name for name in robot.links if any(within(name.lower()).search(text.lower()) for text in texts)]
    frames = list(stated)
    for words, links in ((_NAMED, named), *((words, list(robot.links)) for words in _FEET)) if not frames else ():
        by_body: dict[int, list[str]] = {}
        for name in links:
            body, is_foot = robot.links[name][0], re.search(words, name, re.IGNORECASE)
            if body and body not in inner and is_foot and not re.search(_ON_FEET, name, re.IGNORECASE):
                by_body.setdefault(body, []).append(name)
        frames = [min(names, key=lambda name: (shapes.about(name) is None, len(name))) for names in by_body.values()]
        if len(frames) > 1:
            break
        frames = []
    flat = len(frames) < 3
    return [_Contact(x, "flat" if flat and shapes.about(x) is None else "point") for x in frames]


def _fields_of(sample: Any, proposal: MapProposal) -> set[str]:
    """Fields of a log that file and map have."""
    return {*(name.partition(".")[0] for name in sample), *proposal.columns}


def _add_imu_frame(robot: Robot, fields: set[str], proposal: MapProposal) -> None:
    if not set(_IMU) & fields or "imu_frame" in fields:
        return
    if not set(_IMU) <= fields:  # one alone is of no use
        for name in set(_IMU) & set(proposal.columns):
            proposal.columns.setdefault("ignore", []).append(_as_ignored(proposal.columns.pop(name)["column"]))
            fields.discard(name)
        return
    named = [name for name, (body, _) in robot.links.items() if body == 0 and "imu" in name.lower()]
    frame = min(named, key=len, default=robot.base_link)
    proposal.columns = {"imu_frame": frame, **proposal.columns}
    proposal.notes["imu_frame"] = "from its name" if named else "the base link, as no link of it is called imu"
    fields.add("imu_frame")


def _as_ignored(pattern: str) -> str:
    return re.sub(r"\{[^{}]*\}", "*", pattern)


def _sensors(fields: set[str], limbs: Sequence[str]) -> str | dict[str, object]:
    """The set of sensors of a run, with those in limbs at fixed joints."""
    wrench = bool({"contact_wrench_local", "contact_wrench_world"} & fields)
    named = ("full" if wrench else "joints") if "joint_torque" in fields else "contacts"
    if not limbs:
        return named
    return ({"set": named} if wrench or named == "joints" else {}) | {"ft_sensors": list(limbs)}


def _is_fixed(contacts: Sequence[_Contact], fields: set[str]) -> bool:
    return not contacts and not {*_POSE, *_IMU} & fields


def _lacks_base_motion(contacts: Sequence[_Contact], fields: set[str]) -> bool:
    pose = set(_POSE) & fields and "base_position_world" in fields
    return not _is_fixed(contacts, fields) and not pose and not set(_IMU) <= fields


def _from_feet(contacts: Sequence[_Contact], fields: set[str]) -> dict[str, object]:
    """Keys of preprocessing that take what nobody recorded from joints and feet, if there are enough of these."""
    out: dict[str, object] = {}
    kinds = [contact.type for contact in contacts]
    if _lacks_base_motion(contacts, fields) and ("flat" in kinds or len(kinds) > 2):
        out["base_motion"] = "contacts"
    if contacts and "contact_active" not in fields and "joint_torque" in fields:
        out["detect_contacts"] = True
    return out


def _describe_plates(out: Initiated, proposal: MapProposal) -> None:
    """What of force plates no file says."""
    if plates := [name for name in proposal.left_out if propose_field(name) in OF_PLATES]:
        unknown = "without which foot stands on which and where each lies (docs/logs.md, Force plates)"
        out.missing.append(f"contact_wrench_world: {join_names(plates)} may be readings of force plates, {unknown}")


def _describe(
    out: Initiated, robot: Robot, contacts: Sequence[_Contact], fields: set[str], proposal: MapProposal
) -> None:
    """What was found, guessed and missed, in lines."""
    what = proposal.key.removesuffix("s")
    _describe_found(out, robot, contacts, fields, proposal)
    out.guessed += [f"{key}: {note}" for key, note in proposal.notes.items()]
    if contacts:
        out.guessed.append("contacts: from names of links; point where there is a ball or more than two of them")
    if _is_fixed(contacts, fields):
        out.guessed.append("robot.fixed_base: true, as there is neither a foot nor a motion of the base")
    if proposal.lacking:
        out.guessed.append(f"robot.weld: {_WELDED}: {join_names(proposal.lacking)}")
    if proposal.left_out:
        out.guessed.append(f"{format_count(len(proposal.left_out), what)} not needed: {join_names(proposal.left_out)}")
    out.missing += _missing_columns(robot, fields, proposal)
    if not set(_FORCES) & fields:
        out.missing.append("forces: neither joint torques nor contact wrenches")
    _describe_plates(out, proposal)
    from_feet = _from_feet(contacts, fields)
    if contacts and "contact_active" not in fields:
        instead = "detected from joint torques" if "detect_contacts" in from_feet else "set to touch throughout"
        out.missing.append(f"contact_active: which foot touches when; {instead}")
    if _lacks_base_motion(contacts, fields):
        instead = "; taken from the feet that stand" if "base_motion" in from_feet else ""
        out.missing.append(f"motion of the base: neither its pose nor an IMU{instead}")


def _missing_columns(robot: Robot, fields: set[str], proposal: MapProposal) -> list[str]:
    """What stamps and fields of joints lack, in words."""
    what = proposal.key.removesuffix("s")
    partial = {name: joints for name, joints in proposal.partial.items() if name not in fields}
    out = [
        f"{name}: no {what} of numbers of {join_names(joints)}, but of all others" for name, joints in partial.items()
    ]
    for name in ("time", "joint_position"):
        if name not in fields | partial.keys():
            of_joints = f", of most of {len(robot.joint_names)} joints" * (name != "time")
            out.append(f"{name}: no {what}s that look like it{of_joints}{_OTHER_FILE * (what == 'column')}")
    return out


def _describe_found(
    out: Initiated, robot: Robot, contacts: Sequence[_Contact], fields: set[str], proposal: MapProposal
) -> None:
    """The robot, and what of a map there is."""
    frames = join_names([contact.frame for contact in contacts])
    out.found.append(f"{len(robot.joint_names)} joints" + f", contacts {frames}" * bool(contacts))
    if proposal.key == "topics":
        known = list(proposal.columns)
    else:
        names = [name for name in proposal.columns if name in fields]
        known = [name for name in names if not name.endswith(("_order", "_name", "ignore"))]
    if known:
        out.found.append(f"{proposal.key} of {', '.join(known)}")


def _try(out: Initiated, path: Path, proposal: MapProposal) -> None:
    """Read the log with the map, and say why that fails if it does."""
    try:
        maps = {"columns": Columns, "topics": Topics}[proposal.key]
        given = {proposal.key: maps(**proposal.columns)} if proposal.columns else {}
        log = read_log(path, allow_gaps=True, **given)
    except InputError as error:
        out.missing.append(f"the log is not read with this file yet: {error.field}: {error.found}")
        return
    out.found.append(f"{len(log)} samples over {log.time[-1] - log.time[0]:.4g} s: {', '.join(log.arrays())}")


# ------------------------------------------------------------------------------------------------------- the file


def _text(
    robot: Robot,
    urdf: str | Path,
    log: Path,
    output: Path,
    contacts: Sequence[_Contact],
    fields: set[str],
    proposal: MapProposal,
) -> str:
    """The experiment file, with comments."""
    from_feet, is_map = _from_feet(contacts, fields), proposal.key == "columns"
    if contacts and "contact_active" not in fields and "detect_contacts" not in from_feet:
        always = [contact.frame for contact in contacts]
        proposal.columns["contact_active"] = {"always": always} if is_map else dict.fromkeys(always, True)
        proposal.notes["contact_active"] = "every foot touches throughout, as nothing recorded says otherwise"
    own: dict[str, object] = {"urdf": _relative(Path(urdf), output)} | (
        {"fixed_base": True} if _is_fixed(contacts, fields) else {}
    )
    own |= {"weld": weld} if (weld := _weld(robot, proposal)) else {}
    names = f"{excerpt(log.name)} and {excerpt(robot.path.name)}"
    lines = [f"# {names}, by torchid init; what is marked as guessed should be checked"]
    lines += _entry("robot", own)
    lines += [f"  # guessed: weld: {_WELDED}"] if weld else []
    if contacts:
        lines.append("contacts:  # guessed: from names of links")
        lines += [f"  - {_flow({'frame': contact.frame, 'type': contact.type})}" for contact in contacts]
    name = _relative(log, output)
    whole = split_range(log).range is not None
    lines += ["logs:", f"  train: {_flow([name if whole else f'{name}[:80%]'])}"]
    lines += [] if whole else [f"  test: {_flow([f'{name}[80%:]'])}"]
    if proposal.columns:
        lines.append(f"  {proposal.key}:  # {_WHAT[proposal.key]}: docs/logs.md")
        for key, value in proposal.columns.items():
            note = proposal.notes.get(key, "")
            lines += [f"    # guessed: {note}"] if note else []
            lines += [f"    {line}" for line in _entry(key, value)]
    lines += [f"# {' and '.join(from_feet)}: nobody recorded them"] if from_feet else []
    lines += _entry("preprocessing", {"cutoff_hz": "auto"} | from_feet)
    lines += _entry("sensors", _sensors(fields, list(proposal.columns.get("ft_wrenches", ()))))
    lines += _entry("estimator", {"name": "consistent", "ridge": "auto"})
    lines += _entry("output", f"runs/{output.stem}")
    return "\n".join(lines) + "\n"


def _weld(robot: Robot, proposal: MapProposal) -> list[str] | dict[str, float]:
    """Joints that a log lacks, each at 0, or at the middle of its range if that is elsewhere."""
    limits = position_limits(robot.path)
    ranges = {name: limits.get(name, (-math.inf, math.inf)) for name in proposal.lacking}
    at = {name: 0.0 if low <= 0.0 <= high else float(f"{(low + high) / 2:.4g}") for name, (low, high) in ranges.items()}
    return at if any(at.values()) else list(at)


def _relative(path: Path, output: Path) -> str:
    return os.path.relpath(os.path.abspath(path), os.path.abspath(output.parent))


def _flow(value: object) -> str:
    """A value on one line, as YAML."""
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**6, allow_unicode=True)
    return text.removesuffix("\n").removesuffix("\n...")


def _entry(key: str, value: object) -> list[str]:
    """A key with its value, short ones on one line; a column alone is its name."""
    if isinstance(value, dict) and set(value) == {"column"}:
        value = value["column"]
    line = f"{key}: {_flow(value)}"
    if len(line) <= _LINE - 4 or not isinstance(value, (dict, list)):
        return [line]
    block = yaml.safe_dump({key: value}, default_flow_style=None, sort_keys=False, width=_LINE - 4, allow_unicode=True)
    return block.splitlines()
