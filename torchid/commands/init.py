"""`torchid init`: an experiment file from a robot and a log, with what was assumed and what is to be filled in."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from textwrap import wrap

import yaml

from torchid.commands.chosen_settings import needs_these_torques
from torchid.commands.folder import check_free_file
from torchid.commands.init_parts import (
    GuessedContact,
    Split,
    guess_contacts,
    held_joints,
    keys_for_gaps,
    keys_for_length,
    limb_sensors,
    log_in_folder,
    measured_torques,
    named_apart,
    proposed_sensors,
    read_sensors,
    split_logs,
    stated_contacts,
    welded_at,
    without_rolling,
)
from torchid.config import load_config
from torchid.config.logs import PreprocessingConfig
from torchid.config.robot import ContactConfig
from torchid.config.settings_files import inline_yaml, yaml_lines
from torchid.errors import (
    ConfigError,
    InputError,
    LogError,
    TorchidWarning,
    about_file,
    excerpt,
    join_names,
)
from torchid.fitting.experiment import is_along_base, resolve_contacts, set_up
from torchid.logs import Columns, Log, Topics
from torchid.logs.columns import FILL_IN
from torchid.logs.containers import LogKind, atomic_output, existing_log_kind
from torchid.logs.log import VARIANTS
from torchid.logs.read import read_recordings
from torchid.logs.time_range import split_range
from torchid.parameters import GRAVITY
from torchid.proposals.columns import MapProposal, joined, propose_map
from torchid.proposals.names import RobotNames
from torchid.proposals.samples import (
    find_episodes,
    read_bag_sample,
    read_sample,
    stated_names,
    with_samples_first,
)
from torchid.proposals.topics import USED_TYPES, frame_of, propose_topics
from torchid.reading.log_reader import memory_needed
from torchid.robot import Robot, load_robot
from torchid.robot.urdf import has_fixed_base
from torchid.robot.xml_files import is_mjcf
from torchid.settings import AUTO

_FORCES = ("joint_torque", "contact_wrench_local", "contact_wrench_world", "contact_force_normal", "ft_wrench")
_POSE = ("base_quat_wxyz", "base_quat_xyzw")
_IMU = ("imu_specific_force", "imu_angular_velocity")
_WIDTH = 80  # of comments that list what has no entry
_LISTED = 60  # lines of these
_WHAT = {
    "columns": "names, units and order of the columns: docs/logs.md",
    "topics": "content of the topics: docs/logs.md",
}
_WELDED = "joints without readings are held still; add readings of joints that move"


@dataclass
class InitReport:
    """What `init` has written, and what a user should know of it.

    Attributes:
        output: the experiment file.
        found: what log and robot have, in words.
        assumed: what should be compared with the robot and its manual.
        missing: what a fit needs and was not found.
        is_open: whether the file has entries that are to be filled in.
    """

    output: Path
    found: list[str] = field(default_factory=list)
    assumed: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    is_open: bool = False

    @property
    def lines(self) -> list[tuple[str, str]]:
        """A word for what each text is, and the text."""
        said = [(word, text) for word in ("found", "assumed", "missing") for text in getattr(self, word)]
        then = f"next: replace {FILL_IN} there" if self.is_open else f"next: torchid check {self.output}"
        return [*said, ("written to", f"{self.output}; {then}")]


_NO_CONTACT = (
    "contacts: no link is named foot. List the frames that touch the ground (or of rotors: docs/contacts.md), or set"
    " robot.fixed_base: true if the base stands still"
)


def init(urdf: str | Path, log: str | Path, output: str | Path, total_mass: float | None = None) -> InitReport:
    """Write an experiment file for a robot and a log, complete or not at all.

    Args:
        urdf: of the robot; or its MJCF file.
        log: a table or arrays, in the log format or not, several of these or a folder of them as one log, or a bag.
        output: the file; nothing that is there is replaced.
        total_mass: of the robot [kg], if it is known; a robot's file without any mass needs it.

    Raises:
        InputError: the URDF or the log cannot be read, or there is a file already.
    """
    target = Path(output)
    if target.suffix.lower() not in (".yaml", ".yml"):
        raise ConfigError("command line", "--output", f"'{target}'", "a file name that ends in .yaml or .yml")
    if os.path.lexists(target):
        raise ConfigError(target, "--output", "exists", "a new file; torchid init overwrites no file")
    path, of_folder = log_in_folder(Path(log))
    part = split_range(path)
    files = [file.path for file in part.files]
    check_free_file(target, "--output", False, [urdf, *files])
    is_bag = existing_log_kind(path) is LogKind.BAG
    robot = load_robot(urdf, fixed_base=has_fixed_base(Path(urdf)), total_mass=total_mass)
    contacts, fields, proposal = _of_bag(part.file, robot) if is_bag else _of_columns(files, robot)
    out = InitReport(target)
    _state_flags(robot, contacts, fields, proposal)
    contacts = contacts if _knows_ground(robot, contacts, fields) else without_rolling(contacts, robot)
    out.is_open = FILL_IN in str(proposal.columns)
    read = [] if out.is_open else _try(path, proposal)
    logs = [] if isinstance(read, InputError) else read
    gaps = keys_for_gaps(logs) | keys_for_length(logs)
    split = split_logs(logs, "base_motion" in _from_feet(robot, contacts, fields))
    limbs = list(proposal.columns.get("ft_wrenches", ())) or read_sensors(robot, logs)
    torques = measured_torques(robot, logs)
    sensors = proposed_sensors(fields, limbs, contacts, torques)
    known = {} if total_mass is None else {"total_mass": total_mass}
    write = partial(_text, robot, urdf, path, fields=fields, proposal=proposal, gaps=gaps, split=split, known=known)
    text = write(target, contacts, sensors=sensors)
    if logs and "base_motion" in _from_feet(robot, contacts, fields):
        here = Path("experiment.yaml")
        if not _explains(write(here, contacts, sensors=sensors)) and _explains(write(here, [], sensors=sensors)):
            contacts = []
            text = write(target, [], sensors=sensors)
            out.assumed.append(_HELD)
    _describe(out, robot, contacts, fields, proposal)
    _describe_log(out, read, fields)
    out.assumed += of_folder
    out.assumed += [f"preprocessing.{key}: {value} ({why})" for key, (value, why) in gaps.items()]
    out.assumed += [split.assumed] * bool(split.assumed)
    out.assumed += ["sensors.joint_torques: only the joints with torques in the log"] * bool(torques)
    out.missing += [split.missing] * bool(split.missing)
    with atomic_output(target) as new:
        new.write_text(text, encoding="utf-8")
    return out


def _explains(experiment: str) -> bool:
    """Whether the robot file's bodies need about the torques of a log, as an experiment file reads it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        return needs_these_torques(set_up(load_config(None, sections=yaml.safe_load(experiment))))


_HELD = (
    "robot.fixed_base: true, as the torques do not carry the robot's weight. If it stands on its feet, list them under "
    "contacts instead"
)


def _of_columns(files: Sequence[Path], robot: Robot) -> tuple[list[GuessedContact], set[str], MapProposal]:
    """Contacts, fields and a map of a table or arrays, or of several that are one log."""
    samples = []
    size = 0.0
    is_table = existing_log_kind(files[0]) is LogKind.TABLE
    for file in files:
        size = memory_needed(file, PreprocessingConfig().memory_gb, size)
        if size > PreprocessingConfig().memory_gb:
            accepted = "a log of a part of the recording; its map is valid for all of it"
            raise LogError(file, "file", f"arrays of {size:.2g} GB", accepted)
        with about_file(file):
            samples.append(read_sample(file))
    episodes = find_episodes(samples[0]) if len(files) == 1 and not is_table else None
    samples = [episodes.sample] if episodes else named_apart(samples, [file.name for file in files])
    sample, turned = with_samples_first(joined(samples)) if not is_table else (joined(samples), "")
    lists = [name for name, x in sample.items() if x is not None and x.dtype.kind not in "fiub"]
    texts = [*sample, *(text for name in lists for text in stated_names(sample, name))]
    contacts = guess_contacts(robot, stated_contacts(sample, robot), texts)
    proposal = propose_map(sample, _names_of(robot, contacts), samples if len(files) > 1 else ())
    if turned:
        proposal.assumed["columns"] = turned
    if episodes is not None:
        proposal.columns = {"episodes": episodes.entry, **proposal.columns}
        proposal.assumed["episodes"] = episodes.note
    return contacts, proposal.fields, proposal


def _of_bag(file: Path, robot: Robot) -> tuple[list[GuessedContact], set[str], MapProposal]:
    """Contacts, fields and a map of the topics of a bag."""
    with about_file(file):
        sample = read_bag_sample(file, USED_TYPES)
    contacts = guess_contacts(robot, [], [f"{frame_of(topic)} {name}" for name, topic in sample.items()])
    proposal = propose_topics(sample, _names_of(robot, contacts))
    return contacts, proposal.fields, proposal


def _names_of(robot: Robot, contacts: Sequence[GuessedContact]) -> RobotNames:
    """What the proposal of a map knows of the robot."""
    on_base = [name for name, (body, _) in robot.links.items() if not body]
    return RobotNames(
        joints=robot.joint_names,
        feet=[contact.frame for contact in contacts],
        name=robot.path.stem,
        weight=GRAVITY * float(robot.nominal[:, 0].sum()),
        base_link=robot.base_link,
        on_base=on_base,
        elsewhere=[name for name in robot.links if name not in on_base],
        along_base=[link for link in on_base if is_along_base(robot, link)],
        slides=robot.sliding,
        limb_sensors=limb_sensors(robot),
    )


def _is_fixed(contacts: Sequence[GuessedContact], fields: set[str]) -> bool:
    return not contacts and not {*_POSE, *_IMU} & fields


def _knows_ground(robot: Robot, contacts: Sequence[GuessedContact], fields: set[str]) -> bool:
    return robot.fixed_base or bool(set(_POSE) & fields) or "base_motion" in _from_feet(robot, contacts, fields)


def _lacks_base_motion(robot: Robot, contacts: Sequence[GuessedContact], fields: set[str]) -> bool:
    pose = set(_POSE) & fields and "base_position_world" in fields
    return not robot.fixed_base and not _is_fixed(contacts, fields) and not pose and not set(_IMU) <= fields


def _from_feet(robot: Robot, contacts: Sequence[GuessedContact], fields: set[str]) -> dict[str, object]:
    """Keys of preprocessing that take what was not recorded from joints and feet, if there are enough of these."""
    out: dict[str, object] = {}
    kinds = [contact.type for contact in contacts]
    if _lacks_base_motion(robot, contacts, fields) and ("flat" in kinds or len(kinds) > 2):
        out["base_motion"] = "contacts"
    if not robot.fixed_base and contacts and "contact_active" not in fields and "joint_torque" in fields:
        out["detect_contacts"] = True
    return out


def _state_flags(robot: Robot, contacts: Sequence[GuessedContact], fields: set[str], proposal: MapProposal) -> None:
    """Let every foot touch throughout, where neither the log nor torques say which does."""
    if contacts and "contact_active" not in fields and "detect_contacts" not in _from_feet(robot, contacts, fields):
        always = [contact.frame for contact in contacts]
        is_map = proposal.key == "columns"
        proposal.columns["contact_active"] = {"always": always} if is_map else dict.fromkeys(always, True)
        proposal.assumed["contact_active"] = "all feet always touch the ground, as the log does not say otherwise"


def _describe(
    out: InitReport, robot: Robot, contacts: Sequence[GuessedContact], fields: set[str], proposal: MapProposal
) -> None:
    """What was found, assumed and missed, in lines."""
    _describe_map(out, robot, contacts, fields, proposal)
    if contacts:
        balls = "; radius 0 (no rolling), as the log has no orientation"
        out.assumed.append(
            "contacts: from names and balls of links; type point for balls, or for more than two contacts"
            + balls * any(contact.radius == 0.0 for contact in contacts)
        )
    settings = [ContactConfig(x.frame, x.type, radius=AUTO if x.radius is None else x.radius) for x in contacts]
    rolling = resolve_contacts(settings, robot)[1]
    out.assumed += [f"contacts: {rolling}"] * bool(rolling)
    if _is_fixed(contacts, fields) and not robot.fixed_base and _HELD not in out.assumed:
        out.assumed.append("robot.fixed_base: true, as no foot and no base motion was found")
    if held := held_joints(robot, proposal.lacking):
        out.assumed.append(f"robot.weld: {_WELDED}: {join_names(held)}")
    if not contacts and not robot.fixed_base and not _is_fixed(contacts, fields):
        out.missing.append(_NO_CONTACT)
    from_feet = _from_feet(robot, contacts, fields)
    if contacts and "contact_active" not in fields:
        instead = "detected from joint torques" if "detect_contacts" in from_feet else "all feet always touch"
        out.missing.append(f"contact_active (which foot touches when): {instead}")
    if _lacks_base_motion(robot, contacts, fields):
        instead = "; computed from the standing feet" if "base_motion" in from_feet else ""
        lacks = "only its orientation, no position and no IMU" if set(_POSE) & fields else "no pose and no IMU"
        out.missing.append(f"motion of the base: {lacks}{instead}")


def _describe_map(
    out: InitReport, robot: Robot, contacts: Sequence[GuessedContact], fields: set[str], proposal: MapProposal
) -> None:
    """The robot, and what of a map there is."""
    frames = join_names([contact.frame for contact in contacts])
    out.found.append(f"{len(robot.joint_names)} joints" + f", contacts {frames}" * bool(contacts))
    no_fields = ("_order", "_name", "ignore", "episodes")
    if known := [x for x, entry in proposal.columns.items() if not x.endswith(no_fields) and FILL_IN not in str(entry)]:
        out.found.append(f"{proposal.key} of {', '.join(known)}")
    open_keys = [key for key, entry in proposal.columns.items() if FILL_IN in str(entry)]
    out.missing += [f"{key}: fill in {proposal.assumed.get(key, FILL_IN)}" for key in open_keys]
    out.assumed += [f"{key}: {note}" for key, note in proposal.assumed.items() if key not in open_keys]
    if "ignore" in proposal.columns or (proposal.key == "topics" and proposal.listed):
        what = f"unused {proposal.key}, listed in the file: {join_names(proposal.listed)}"
        out.assumed.append(what)
    if proposal.perhaps:
        keys = join_names(list(dict.fromkeys(key for key, _, _ in proposal.perhaps)))
        out.missing.append(f"{keys}: uncertain, given as comments in the file; uncomment what is right")
    if not set(_FORCES) & fields and "joint_torque" not in open_keys:
        out.missing.append("forces: no joint torques and no contact wrenches")


def _try(path: Path, proposal: MapProposal) -> list[Log] | InputError:
    """The recordings of the log as they are read with the map, or why it is not."""
    try:
        maps = {"columns": Columns, "topics": Topics}[proposal.key]
        given = {proposal.key: maps(**proposal.columns)} if proposal.columns else {}
        return read_recordings(path, **given)
    except InputError as error:
        return error


def _describe_log(out: InitReport, read: list[Log] | InputError, fields: set[str]) -> None:
    """What there is of the log, by the names of the file's fields, or why it is not read."""
    if isinstance(read, InputError):
        out.missing.append(
            f"the log cannot be read with this file yet: {read.field}: {read.found}; accepted: {read.accepted}"
        )
        return
    if not read:
        return
    recorded = {name: variant for variant, name in VARIANTS.items() if variant in fields}
    has = [recorded.get(name, name) for name, array in read[0].arrays().items() if array.size]
    seconds = sum(float(log.time[-1] - log.time[0]) for log in read)
    several = f" in {len(read)} recordings" * (len(read) > 1)
    out.found.append(f"{sum(map(len, read))} samples over {seconds:.4g} s{several}: {', '.join(has)}")


# ------------------------------------------------------------------------------------------------------- the file


def _text(
    robot: Robot,
    urdf: str | Path,
    log: Path,
    output: Path,
    contacts: Sequence[GuessedContact],
    fields: set[str],
    proposal: MapProposal,
    gaps: dict[str, tuple[object, str]],
    split: Split,
    sensors: str | dict[str, object],
    known: dict[str, float],
) -> str:
    """The experiment file, with comments."""
    from_feet = _from_feet(robot, contacts, fields)
    robot_keys: dict[str, object] = {"mjcf" if is_mjcf(Path(urdf)) else "urdf": _relative(Path(urdf), output)}
    robot_keys |= {"fixed_base": True} if robot.fixed_base or _is_fixed(contacts, fields) else {}
    robot_keys |= {"weld": weld} if (weld := welded_at(robot, held_joints(robot, proposal.lacking))) else {}
    names = f"{excerpt(log.name)} and {excerpt(robot.path.name)}"
    to_fill_in = f" and replace {FILL_IN}" * (FILL_IN in str(proposal.columns))
    lines = [f'# {names}, by torchid init; check lines marked "assumed"{to_fill_in}']
    lines += yaml_lines("robot", robot_keys)
    lines += [f"  # assumed: weld: {_WELDED}"] * bool(weld)
    if contacts:
        lines.append("contacts:  # assumed: from names of links")
        lines += [f"  - {inline_yaml(contact.entry)}" for contact in contacts]
    name = _relative(log, output)
    train, test = ([""], []) if split_range(log).range is not None else (split.train, split.test)
    lines += ["logs:", f"  train: {inline_yaml([f'{name}{part}' for part in train])}"]
    lines += [f"  test: {inline_yaml([f'{name}{part}' for part in test])}"] if test else []
    if proposal.columns:
        lines.append(f"  {proposal.key}:  # {_WHAT[proposal.key]}")
        for key, value in proposal.columns.items():
            note = proposal.assumed.get(key, "")
            verb = "fill in" if FILL_IN in str(value) else "assumed"
            lines += [f"    # {verb}: {note}"] if note else []
            lines += [f"    {line}" for line in yaml_lines(key, value)]
    lines += _comments(proposal)
    lines += [f"# {' and '.join(from_feet)}: not recorded"] if from_feet else []
    lines += [f"# {key}: {why}" for key, (_, why) in gaps.items()]
    stated = {key: value for key, (value, _) in gaps.items()}
    margin = {"contact_margin_s": "auto"} if contacts and "contact_active" in fields else {}
    lines += yaml_lines("preprocessing", {"cutoff_hz": "auto"} | margin | from_feet | stated)
    lines += yaml_lines("sensors", sensors)
    lines += ["# actuators: armature, delay, offsets, ... are chosen by the log; fix one with true, false or a number"]
    lines += yaml_lines("estimator", {"name": "consistent", "ridge": "auto", **known})
    lines += yaml_lines("output", f"runs/{output.stem}")
    return "\n".join(lines) + "\n"


def _comments(proposal: MapProposal) -> list[str]:
    """Entries that are not sure, and what has no entry, as comments."""
    out = []
    for key, entry, why in proposal.perhaps:
        instead = f" instead of {FILL_IN}" * (key in proposal.columns)
        out += wrap(f"perhaps{instead}, {why}:", _WIDTH, initial_indent="    # ", subsequent_indent="    # ")
        out += [f"    # {line}" for line in yaml_lines(key, entry)]
    if proposal.listed:
        what = "columns" if proposal.key == "columns" else "topics"
        where = " (left out by ignore)" * ("ignore" in proposal.columns)
        out.append(f"    # unused {what}{where}:")
    for text in proposal.listed[:_LISTED]:
        out += wrap(text, _WIDTH, initial_indent="    #   ", subsequent_indent="    #     ", break_on_hyphens=False)
    more = len(proposal.listed) - _LISTED
    out += [f"    #   and {more} more"] * (more > 0)
    if proposal.hint:
        out += wrap(proposal.hint, _WIDTH, initial_indent="    # ", subsequent_indent="    #   ")
    return out


def _relative(path: Path, output: Path) -> str:
    return os.path.relpath(os.path.abspath(path), os.path.abspath(output.parent))
