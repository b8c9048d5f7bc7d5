"""What `torchid init` proposes beside a map: contacts, welds and sensors by names, and how a log is used."""

from __future__ import annotations

import math
import re
import warnings
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from torchid.errors import InputError, LogError, TorchidWarning, format_count, join_names
from torchid.logs import Log
from torchid.logs.columns import OF_FILE
from torchid.logs.containers import ARRAYS, TABLES, list_bag_files
from torchid.logs.cutoff import choose_cutoff
from torchid.logs.log import FORCE_NORMAL, WRENCHES
from torchid.logs.low_pass import DROPPED_PERIODS
from torchid.logs.schema import native_field
from torchid.logs.time_range import JOINED
from torchid.parameters import WRENCH_COMPONENTS
from torchid.proposals.names import propose_field, within
from torchid.proposals.samples import FileSample, increases, numbers_of, read_sample, stated_names
from torchid.robot import CollisionShapes, Robot, load_robot
from torchid.robot.urdf import fixed_joints, position_limits

# ------------------------------------------------------------------------------------------------- contacts and sensors

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


def stated_contacts(sample: FileSample, robot: Robot) -> list[str]:
    """Contacts that a log in the format names, as far as the robot has them."""
    names = stated_names(sample, "contact_names")
    names += [name.split(".")[1] for name in sample if re.fullmatch(r"contact_active\.[^.]+", name)]
    return [name for name in dict.fromkeys(names) if name in robot.links]


def guess_contacts(robot: Robot, stated: Sequence[str], texts: Sequence[str]) -> list[GuessedContact]:
    """Links that three columns of a wrench name, and feet: outermost links with the surest word in their names.

    Each body has one, a ball if possible. Feet that the log names count before all others. No foot is below a link with
    a wrench.
    """
    shapes = CollisionShapes(robot)

    def rank(name: str) -> tuple[bool, bool, int]:
        return shapes.about(name, meshes=False) is None, "sole" not in name.lower(), len(name)

    texts = [text.lower() for text in texts if not re.search(_IN_LIMBS, text, re.IGNORECASE)]
    moving = sorted((name for name, (body, _) in robot.links.items() if body), key=len, reverse=True)
    forces = [text for text in texts if propose_field(text) in WRENCHES]
    columns = Counter(next((name for name in moving if within(name.lower()).search(text)), "") for text in forces)
    wrenches = [name for name in robot.links if columns[name] > 2]
    inner = {robot.links[name][0] for name in wrenches}
    parents = [body.parent for body in robot.bodies]
    for number, parent in enumerate(parents):
        inner |= {number} if parent in inner else set()
    inner |= {*parents}
    named = [name for name in robot.links if any(within(name.lower()).search(text) for text in texts)]
    frames = list(stated)
    for words, links in ((_NAMED, named), *((words, list(robot.links)) for words in _FEET)) if not frames else ():
        by_body: dict[int, list[str]] = {}
        for name in links:
            body = robot.links[name][0]
            is_foot = re.search(words, name, re.IGNORECASE)
            if body and body not in inner and is_foot and not re.search(_ON_FEET, name, re.IGNORECASE):
                by_body.setdefault(body, []).append(name)
        frames = [*wrenches, *(min(names, key=rank) for names in by_body.values())]
        if len(frames) > max(len(wrenches), 1):
            break
        frames = wrenches
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
    parents = [body.parent for body in robot.bodies]
    limbs = dict[int, str]()
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
    fixed = fixed_joints(robot.path)
    named = {joint: child for joint, child in fixed.items() if re.search(_SENSOR, f"{joint} {child}", re.IGNORECASE)}
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
    wrench = bool(set(WRENCHES) & set(fields))
    torque = "joint_torque" in fields
    of_contacts = wrench or FORCE_NORMAL in fields
    named = ("full" if wrench else "joints") if torque or not of_contacts else "contacts"
    of_limbs: dict[str, object] = {"ft_sensors": list(limbs)} if limbs else {}
    if torques:
        components = {x.frame: list(WRENCH_COMPONENTS[: 6 if x.type == "flat" else 3]) for x in contacts}
        return of_limbs | {"joint_torques": list(torques)} | ({"contact_wrenches": components} if wrench else {})
    if not limbs:
        return named
    return of_limbs | ({"set": named} if wrench or torque else {})


# ---------------------------------------------------------------------------------------------- files of a log, its use

_MOTION = ("joint_position", "base_quat_xyzw", "base_position_world", *("imu_specific_force", "imu_angular_velocity"))
_BRIDGED_S = 0.05
"""Gaps that `init` has bridged [s]."""
_MANY = 100_000
"""Samples that a fit works on for about a second; of more, no more are kept than a filter leaves information in."""
_TESTED = 0.2  # of a log, or of its recordings
_LEAST_TEST = 1.5  # of what a filter spoils at both ends: a third of a test is left
_FILES = 64  # in a folder
_AS_ONE = "numpy.savez('{0}.npz', **{{x.stem: numpy.load(x) for x in pathlib.Path('{0}').glob('*.npy')}})"


def log_in_folder(path: Path) -> tuple[Path, list[str]]:
    """The name of a log; of a folder of tables and arrays that of its files with stamps as one log, and a note.

    The file with most stamps in the same time comes first, as its stamps are those of the log.

    Raises:
        LogError: a folder that has none, or too many files.
    """
    if not path.is_dir() or list_bag_files(path):
        return path, []
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in (*TABLES, *ARRAYS) and file.is_file())
    if len(files) > _FILES:
        raise LogError(path, "file", f"a folder of {len(files)} logs", f"a folder of at most {_FILES} files of one log")
    if (single := sorted(path.glob("*.npy"))) and not files:
        reason = f"{len(single)} arrays in separate files: {join_names([file.name for file in single])}"
        raise LogError(path, "file", reason, f"one file with all of them: {_AS_ONE.format(path.name)}")
    steps = {file: step for file in files if (step := _step_of(file)) is not None}
    if not steps:
        accepted = "a folder of tables or arrays with stamps, a ROS 2 bag, or the names of the files of a log"
        reason = f"a folder with {format_count(len(files), 'log')} without stamps or known fields"
        raise LogError(path, "file", reason, accepted)
    used = sorted(steps, key=lambda file: steps[file])
    others = [file.name for file in files if file not in steps]
    note = f"logs: {format_count(len(used), 'file')} of the folder are one log; the fastest comes first"
    note += f"; {join_names(others)} left out (no stamps or no known field)" * bool(others)
    return path / JOINED.join(file.name for file in used), [note]


def _step_of(file: Path) -> float | None:
    """The median step of a file's stamps, in their unit; None where it has none, or nothing else that is in a log."""
    try:
        sample = read_sample(file)
    except InputError:
        return None
    stamps = [name for name, x in sample.items() if propose_field(name) == "time" and increases(x)]
    if not stamps or not {propose_field(name) for name in sample} - {"", "time"}:
        return None
    return float(np.median(np.diff(numbers_of(sample, stamps[:1])[:, 0])))


def named_apart(samples: Sequence[FileSample], files: Sequence[str]) -> list[FileSample]:
    """Columns of several files, those that others have too with the name of the file before them, but for stamps."""
    often = Counter(name for sample in samples for name in sample)
    again = {name for name, n in often.items() if n > 1 and not native_field(name) and propose_field(name) != "time"}
    if len(set(files)) < len(files):
        return list(samples)
    return [
        {f"{file}{OF_FILE}{name}" if name in again else name: x for name, x in sample.items()}
        for file, sample in zip(files, samples, strict=True)
    ]


@dataclass(frozen=True)
class Split:
    """How a log is used.

    Attributes:
        train, test: its parts that are fitted and held back, as behind its name.
        assumed, missing: why not, and what a filter leaves nothing of, in words; "" where all is as usual.
    """

    train: tuple[str, ...] = (f"[:{1.0 - _TESTED:.0%}]",)
    test: tuple[str, ...] = (f"[{1.0 - _TESTED:.0%}:]",)
    assumed: str = ""
    missing: str = ""


def split_logs(logs: Sequence[Log], base_is_derived: bool = False) -> Split:
    """The split of a log, by the filter that `preprocessing.cutoff_hz: auto` chooses; as usual if it is not read.

    Args:
        logs: its recordings, one or several; none where it is not read.
        base_is_derived: whether the motion of the base is worked out of that of the joints.
    """
    if not any(len(log) > 1 for log in logs):
        return Split()
    try:
        cutoff_hz = choose_cutoff(logs, base_is_derived=base_is_derived).cutoff_hz
    except InputError:  # which a fit will say
        return Split()
    lengths = [float(log.time[-1] - log.time[0]) for log in logs]
    spoiled = 0.0 if cutoff_hz is None else 2.0 * DROPPED_PERIODS / cutoff_hz
    filtered = "" if cutoff_hz is None else f" (the {cutoff_hz:g} Hz filter needs {spoiled:.2g} s)"
    if len(logs) > 1:
        return _split_recordings(lengths, spoiled, filtered)
    (length,) = lengths
    if _TESTED * length >= _LEAST_TEST * spoiled:
        return Split()
    if length <= spoiled:
        return Split(("",), (), missing=f"motion: {length:.2g} s is too short for a fit{filtered}")
    assumed = f"logs.test: none, as {length:.2g} s is too short for a test part{filtered}"
    return Split(("",), (), assumed)


def _split_recordings(lengths: Sequence[float], spoiled: float, filtered: str) -> Split:
    """The split of recordings of some lengths [s] that follow one another: the last fifth of them is held back.

    Those of which a filter leaves next to nothing are left out.
    """
    long = [number for number, length in enumerate(lengths) if length >= _LEAST_TEST * spoiled]
    assumed = f"logs: {len(lengths)} recordings in a row, as stamps start again"
    if len(long) < len(lengths):
        assumed += f"; {len(lengths) - len(long)} of them left out as too short{filtered}"
    if not long:
        text = f"motion: {len(lengths)} recordings of at most {max(lengths):.2g} s are too short for a fit{filtered}"
        return Split(_numbered(list(range(len(lengths)))), (), missing=text)
    held = max(1, round(_TESTED * len(long))) if len(long) > 1 else 0
    train = long[: len(long) - held]
    test = long[len(long) - held :]
    assumed += f"; the last {held} are the test logs" * (held > 1) + "; the last is the test log" * (held == 1)
    return Split(_numbered(train), _numbered(test), assumed)


def _numbered(numbers: Sequence[int]) -> tuple[str, ...]:
    """Numbers of recordings, in order, as behind the name of a file."""
    first = [number for number in numbers if number - 1 not in numbers]
    after = [number + 1 for number in numbers if number + 1 not in numbers]
    runs = zip(first, after, strict=True)
    return tuple(f"[#{start}:{stop}]" if stop > start + 1 else f"[#{start}]" for start, stop in runs)


# ----------------------------------------------------------------------------------------------------------------- gaps


def _gaps_in_motion(log: Log) -> tuple[float, bool, str]:
    """Gaps in the motion of a log: how long the longest takes, whether some are at an end, and a field with one.

    The length [s] is that from the value before to that after; gaps at an end do not count for it. Channels that are
    NaN throughout are none.
    """
    longest = 0.0
    at_end = False
    gap = ""
    for name in _MOTION:
        values = getattr(log, name)
        for missing in () if values is None else np.isnan(values).reshape(len(log), -1).T:
            known = np.flatnonzero(~missing)
            if not missing.any() or len(known) < 2:
                continue
            at_end |= bool(missing[0] or missing[-1])
            longest = max(longest, *np.diff(log.time[known])[np.diff(known) > 1].tolist(), 0.0)
            gap = gap or name
    return longest, at_end, gap


def keys_for_gaps(logs: Sequence[Log]) -> dict[str, tuple[object, str]]:
    """The keys of preprocessing that recordings with gaps in their motion need, with the reason."""
    gaps = [_gaps_in_motion(log) for log in logs]
    longest = max((x for x, *_ in gaps), default=0.0)
    at_end = any(x for _, x, _ in gaps)
    name = next((x for *_, x in gaps if x), "")
    out: dict[str, tuple[object, str]] = {}
    if 0.0 < longest <= _BRIDGED_S:
        out["bridge_gaps_s"] = (_BRIDGED_S, f"{name} has gaps of up to {longest:.2g} s")
    if longest > _BRIDGED_S or at_end:
        reason = f"{name} has gaps of up to {longest:.2g} s" if longest > _BRIDGED_S else f"{name} has a gap at one end"
        out["exclude_rejected"] = (True, reason)
    return out


def keys_for_length(logs: Sequence[Log]) -> dict[str, tuple[object, str]]:
    """The keys of preprocessing that long recordings should have, with the reason."""
    samples = sum(map(len, logs))
    if samples <= _MANY:
        return {}
    return {"sample_rate_hz": ("auto", f"of {samples} samples, five for each period of the cutoff are kept")}
