"""`torchid init`: an experiment file from a URDF or MJCF and a log, with what was guessed beside it."""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import yaml

from torchid.commands.chosen_settings import needs_these_torques
from torchid.commands.folder import check_free_file
from torchid.commands.init_files import log_in_folder, named_apart
from torchid.commands.init_logs import Split, keys_for_gaps, keys_for_length, split_logs
from torchid.commands.init_orders import settle_order
from torchid.commands.init_proposals import (
    GuessedContact,
    guess_contacts,
    held_joints,
    hints,
    like_torques,
    limb_sensors,
    measured_torques,
    missing_columns,
    notes_on_arrays,
    proposed_sensors,
    read_sensors,
    stated_contacts,
    unreadable,
    welded_at,
    without_rolling,
)
from torchid.config import load_config
from torchid.config.log_reading import PreprocessingConfig
from torchid.config.robot import ContactConfig
from torchid.config.yaml_text import inline_yaml, yaml_lines
from torchid.errors import (
    ConfigError,
    InputError,
    LogError,
    TorchidWarning,
    about_file,
    excerpt,
    format_count,
    join_names,
)
from torchid.fitting.experiment import is_along_base, resolve_contacts, set_up
from torchid.logs import Columns, Log, Topics
from torchid.logs.containers import LogKind, atomic_output, existing_log_kind
from torchid.logs.log import VARIANTS
from torchid.logs.name_matching import KnownRobot
from torchid.logs.read import read_recordings
from torchid.logs.time_range import split_range
from torchid.parameters import GRAVITY
from torchid.proposals.column_groups import MapProposal
from torchid.proposals.episodes import find_episodes
from torchid.proposals.file_samples import read_bag_sample, read_sample, rows_of, states_degrees, texts_in
from torchid.proposals.maps import propose_map
from torchid.proposals.stamps import arrays_by_stamps
from torchid.proposals.topics import USED_TYPES, frame_of, propose_topics
from torchid.reading.log_reader import memory_needed
from torchid.robot import Robot, load_robot
from torchid.robot.urdf import has_fixed_base
from torchid.robot.xml_files import is_mjcf
from torchid.settings import AUTO

_FORCES = ("joint_torque", "contact_wrench_local", "contact_wrench_world", "contact_force_normal", "ft_wrench")
_POSE = ("base_quat_wxyz", "base_quat_xyzw")
_IMU = ("imu_specific_force", "imu_angular_velocity")
_RATE = "base_angular_velocity_base"
_WHAT = {
    "columns": "names, units and orders of the file: docs/tables.md",
    "topics": "what the messages of the bag hold: docs/bags.md",
}
_WELDED = "joints that the log lacks, held still; one that moves needs readings"


@dataclass
class InitReport:
    """What `init` has written, and what a user should know of it.

    Attributes:
        output: the experiment file.
        found: what log and robot have, in words.
        guessed: what should be compared with the robot and its manual.
        missing: what a fit needs and was not found.
    """

    output: Path
    found: list[str] = field(default_factory=list)
    guessed: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    @property
    def lines(self) -> list[tuple[str, str]]:
        """A word for what each text is, and the text."""
        said = [(word, text) for word in ("found", "guessed", "missing") for text in getattr(self, word)]
        return [*said, ("written to", f"{self.output}; next: torchid check {self.output}")]


_NO_CONTACT = (
    "contacts: no link is called a foot, so that nothing but gravity acts on the base; name the frames that touch the"
    " ground, or that rotors push at (docs/contacts.md), or robot.fixed_base: true if the base stands still"
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
        raise ConfigError(target, "--output", "exists", "a new file: torchid init replaces none")
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
    bolted, detects = _is_fixed(contacts, fields), "detect_contacts" in _from_feet(robot, contacts, fields)
    read = settle_order(proposal, partial(_try, path), robot, contacts, bolted, detects)
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
            contacts, text = [], write(target, [], sensors=sensors)
            out.guessed.append(_HELD)
    _describe(out, robot, contacts, fields, proposal)
    _describe_log(out, read, fields)
    out.guessed += of_folder
    out.guessed += [f"preprocessing.{key}: {value}, {why}" for key, (value, why) in gaps.items()]
    out.guessed += [split.guessed] * bool(split.guessed)
    out.guessed += ["sensors.joint_torques: those that the log has, not of all joints"] * bool(torques)
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
    "robot.fixed_base: true, as torques are those of legs on a held base, not of feet that carry the robot; "
    "if it stands, name its feet under contacts instead"
)


def _of_columns(files: Sequence[Path], robot: Robot) -> tuple[list[GuessedContact], set[str], MapProposal]:
    """Contacts, fields and a map of a table or arrays, or of several that are one log."""
    samples, in_degrees, size, rows = [], set[str](), 0.0, None
    for file in files:
        size = memory_needed(file, PreprocessingConfig().memory_gb, size)
        if size > PreprocessingConfig().memory_gb:
            accepted = "a log of a part of the recording, whose map holds for all of it"
            raise LogError(file, "file", f"arrays of {size:.2g} GB", accepted)
        with about_file(file):
            if (rows := rows_of(file)) is not None and len(files) > 1:
                accepted = "one table, joined by stamp and joint; or a column for each joint"
                raise LogError(
                    file, f"column '{rows.column}'", "a row for each joint, in one of several files", accepted
                )
            samples.append(read_sample(file, rows))
            in_degrees |= set(samples[-1]) if states_degrees(file) else set()
    episodes = find_episodes(samples[0]) if len(files) == 1 and existing_log_kind(files[0]) is LogKind.ARRAYS else None
    samples = [episodes.sample] if episodes else named_apart(samples, [file.name for file in files], robot)
    sample = {name: values for of_file in reversed(samples) for name, values in of_file.items()}
    contacts = guess_contacts(robot, stated_contacts(sample, robot), texts_in(sample))
    clocks = arrays_by_stamps(sample) if existing_log_kind(files[0]) is LogKind.ARRAYS and len(files) == 1 else ()
    known = replace(_known(robot, contacts), simulated=episodes is not None and "axis" in episodes.entry)
    proposal = propose_map(sample, known, samples if len(files) > 1 else (), in_degrees, clocks)
    fields = {*(name.partition(".")[0] for name in sample), *proposal.columns}
    if episodes is not None:
        proposal.columns = {"episodes": episodes.entry, **proposal.columns}
        proposal.notes["episodes"] = episodes.note
    if rows is not None:
        proposal.columns = {"rows_of": rows.column, **proposal.columns}
        proposal.notes["rows_of"] = "the column that names the joint of each row, as rows share stamps"
    if "joint_position" not in fields:
        proposal.notes |= notes_on_arrays(sample, len(robot.joint_names))
    _add_imu_frame(robot, fields, proposal)
    return contacts, fields, proposal


def _of_bag(file: Path, robot: Robot) -> tuple[list[GuessedContact], set[str], MapProposal]:
    """Contacts, fields and a map of the topics of a bag."""
    with about_file(file):
        sample = read_bag_sample(file, USED_TYPES)
    contacts = guess_contacts(robot, [], [f"{frame_of(topic)} {name}" for name, topic in sample.items()])
    proposal = propose_topics(sample, _known(robot, contacts))
    return contacts, proposal.fields, proposal


def _known(robot: Robot, contacts: Sequence[GuessedContact]) -> KnownRobot:
    """What the proposal of a map knows of the robot."""
    on_base, elsewhere = ([name for name, (body, _) in robot.links.items() if bool(body) == x] for x in (False, True))
    feet, weight = [contact.frame for contact in contacts], GRAVITY * float(robot.nominal[:, 0].sum())
    known = robot.joint_names, feet, robot.path.stem, weight, robot.base_link, on_base, elsewhere, limb_sensors(robot)
    moving = [body.joint.name for body in robot.bodies if body.joint is not None and body.joint.kind != "fixed"]
    along = [link for link in on_base if is_along_base(robot, link)]
    return KnownRobot(*known, along, robot.sliding, moving, _limbs(robot))


def _limbs(robot: Robot) -> list[list[str]]:
    """Independent joints along each part of the tree without branches."""
    children, limb_of = Counter(body.parent for body in robot.bodies), dict[int, list[str]]()
    for number, body in enumerate(robot.bodies):
        own = limb_of.get(body.parent) if body.parent and children[body.parent] == 1 else None
        limb_of[number] = [] if own is None else own
        limb_of[number] += [body.joint.name] if body.joint and body.joint.name in robot.joint_names else []
    return list({id(limb): limb for limb in limb_of.values() if limb}.values())


def _add_imu_frame(robot: Robot, fields: set[str], proposal: MapProposal) -> None:
    if not set(_IMU) & fields or "imu_frame" in fields:
        return
    if _IMU[0] in fields and _IMU[1] not in fields and (rate := proposal.columns.pop(_RATE, None)):
        proposal.columns[_IMU[1]] = rate
        fields ^= {_RATE, _IMU[1]}
    if not set(_IMU) <= fields:  # one alone is of no use
        for name in set(_IMU) & set(proposal.columns):
            proposal.leave_out(name)
            fields.discard(name)
        return
    named = [name for name, (body, _) in robot.links.items() if body == 0 and "imu" in name.lower()]
    frame = min(named, key=len, default=robot.base_link)
    proposal.columns = {"imu_frame": frame, **proposal.columns}
    others = [name for name, (body, _) in robot.links.items() if body and "imu" in name.lower()]
    moving = f"; not {join_names(others)}, beyond a joint" if others else ""
    why = "from its name" if named else f"the base link, as no link of it is called imu{moving}"
    proposal.notes["imu_frame"] = why
    fields.add("imu_frame")


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
        proposal.notes["contact_active"] = "every foot touches throughout, as nothing recorded says otherwise"


def _describe(
    out: InitReport, robot: Robot, contacts: Sequence[GuessedContact], fields: set[str], proposal: MapProposal
) -> None:
    """What was found, guessed and missed, in lines."""
    what = proposal.key.removesuffix("s")
    _describe_found(out, robot, contacts, fields, proposal)
    out.guessed += [f"{key}: {note}" for key, note in proposal.notes.items()]
    if contacts:
        balls = "; radius 0, as no orientation says where the ground is that balls roll on"
        out.guessed.append(
            "contacts: from names or balls of links; point where there is a ball or more than two"
            + balls * any(contact.radius == 0.0 for contact in contacts)
        )
    settings = [ContactConfig(x.frame, x.type, radius=AUTO if x.radius is None else x.radius) for x in contacts]
    rolling = resolve_contacts(settings, robot)[1]
    out.guessed += [f"contacts: {rolling}"] * bool(rolling)
    if _is_fixed(contacts, fields) and not robot.fixed_base and _HELD not in out.guessed:
        out.guessed.append("robot.fixed_base: true, as there is neither a foot nor a motion of the base")
    if held := held_joints(robot, proposal.lacking):
        out.guessed.append(f"robot.weld: {_WELDED}: {join_names(held)}")
    if proposal.left_out:
        out.guessed.append(f"{format_count(len(proposal.left_out), what)} not needed: {join_names(proposal.left_out)}")
    out.missing += missing_columns(len(robot.joint_names), fields, proposal.partial, what)
    if not set(_FORCES) & fields:
        out.missing.append("forces: neither joint torques nor contact wrenches")
    if not contacts and not robot.fixed_base and not _is_fixed(contacts, fields):
        out.missing.append(_NO_CONTACT)
    out.missing += [*unreadable(proposal.not_numbers, fields)]
    out.missing += hints(proposal.left_out, fields, robot.joint_names, what, proposal.like_torques)
    from_feet = _from_feet(robot, contacts, fields)
    if contacts and "contact_active" not in fields:
        instead = "detected from joint torques" if "detect_contacts" in from_feet else "set to touch throughout"
        out.missing.append(f"contact_active: which foot touches when; {instead}")
    if _lacks_base_motion(robot, contacts, fields):
        instead = "; taken from the feet that stand" if "base_motion" in from_feet else ""
        lacks = "its orientation alone, no position or IMU" if set(_POSE) & fields else "neither its pose nor an IMU"
        out.missing.append(f"motion of the base: {lacks}{instead}")


def _describe_found(
    out: InitReport, robot: Robot, contacts: Sequence[GuessedContact], fields: set[str], proposal: MapProposal
) -> None:
    """The robot, and what of a map there is."""
    frames = join_names([contact.frame for contact in contacts])
    out.found.append(f"{len(robot.joint_names)} joints" + f", contacts {frames}" * bool(contacts))
    no_fields = ("_order", "_name", "ignore", "episodes")
    of_map = [name for name in proposal.columns if name in fields and not name.endswith(no_fields)]
    known = list(proposal.columns) if proposal.key == "topics" else of_map
    if known:
        out.found.append(f"{proposal.key} of {', '.join(known)}")


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
            f"the log is not read with this file yet: {read.field}: {read.found}; accepted: {read.accepted}"
        )
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
    own: dict[str, object] = {"mjcf" if is_mjcf(Path(urdf)) else "urdf": _relative(Path(urdf), output)}
    own |= {"fixed_base": True} if robot.fixed_base or _is_fixed(contacts, fields) else {}
    own |= {"weld": weld} if (weld := welded_at(robot, held_joints(robot, proposal.lacking))) else {}
    names = f"{excerpt(log.name)} and {excerpt(robot.path.name)}"
    lines = [f"# {names}, by torchid init; what is marked as guessed should be checked"]
    lines += yaml_lines("robot", own)
    lines += [f"  # guessed: weld: {_WELDED}"] * bool(weld)
    if contacts:
        lines.append("contacts:  # guessed: from names of links")
        lines += [f"  - {inline_yaml(contact.entry)}" for contact in contacts]
    name = _relative(log, output)
    train, test = ([""], []) if split_range(log).range is not None else (split.train, split.test)
    lines += ["logs:", f"  train: {inline_yaml([f'{name}{part}' for part in train])}"]
    lines += [f"  test: {inline_yaml([f'{name}{part}' for part in test])}"] if test else []
    if proposal.columns:
        lines.append(f"  {proposal.key}:  # {_WHAT[proposal.key]}")
        for key, value in proposal.columns.items():
            note = proposal.notes.get(key, "")
            lines += [f"    # guessed: {note}"] if note else []
            lines += [f"    {line}" for line in yaml_lines(key, value)]
        remark, entries = like_torques(proposal.like_torques)
        lines += [
            f"    # {line}"
            for line in [remark, *(x for one in entries for x in yaml_lines("joint_torque", one))]
            if line
        ]
    lines += [f"# {' and '.join(from_feet)}: not recorded"] if from_feet else []
    lines += [f"# {key}: {why}" for key, (_, why) in gaps.items()]
    stated = {key: value for key, (value, _) in gaps.items()}
    margin = {"contact_margin_s": "auto"} if contacts and "contact_active" in fields else {}
    lines += yaml_lines("preprocessing", {"cutoff_hz": "auto"} | margin | from_feet | stated)
    lines += yaml_lines("sensors", sensors)
    lines += ["# actuators: chosen by the log (armature, delay, offsets, ...); true, false or a number fixes one"]
    lines += yaml_lines("estimator", {"name": "consistent", "ridge": "auto", **known})
    lines += yaml_lines("output", f"runs/{output.stem}")
    return "\n".join(lines) + "\n"


def _relative(path: Path, output: Path) -> str:
    return os.path.relpath(os.path.abspath(path), os.path.abspath(output.parent))
