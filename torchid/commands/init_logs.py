"""How `torchid init` has a log used: files that are one log, its recordings, what is held back of them, and gaps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchid.errors import InputError, LogError, format_count, join_names
from torchid.logs import Log
from torchid.logs.columns import OF_FILE
from torchid.logs.containers import ARRAYS, TABLES, list_bag_files
from torchid.logs.cutoff import choose_cutoff
from torchid.logs.low_pass import DROPPED_PERIODS
from torchid.logs.schema import native_field
from torchid.logs.time_range import JOINED
from torchid.proposals.names import propose_field
from torchid.proposals.samples import FileSample, increases, numbers_of, read_sample

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
        raise LogError(path, "file", f"a folder of {len(files)} logs", f"at most {_FILES}, the files of one log")
    if (single := sorted(path.glob("*.npy"))) and not files:
        found = f"{len(single)} arrays in files of their own, {join_names([file.name for file in single])}"
        raise LogError(path, "file", found, f"one file of all: {_AS_ONE.format(path.name)}")
    steps = {file: step for file in files if (step := _step_of(file)) is not None}
    if not steps:
        accepted = "a folder of tables or arrays that have stamps, or one recorded by ROS 2; or name the files of a log"
        found = f"a folder, {format_count(len(files), 'log')} without stamps and fields"
        raise LogError(path, "file", found, accepted)
    used = sorted(steps, key=lambda file: steps[file])
    others = [file.name for file in files if file not in steps]
    note = f"logs: {format_count(len(used), 'file')} of the folder as one log, the fastest first"
    note += f"; without {join_names(others)}, which have no stamps or no field" * bool(others)
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
    filtered = "" if cutoff_hz is None else f" (the filter of {cutoff_hz:g} Hz spoils {spoiled:.2g} s)"
    if len(logs) > 1:
        return _split_recordings(lengths, spoiled, filtered)
    (length,) = lengths
    if _TESTED * length >= _LEAST_TEST * spoiled:
        return Split()
    if length <= spoiled:
        return Split(("",), (), missing=f"motion: {length:.2g} s are too short for a fit{filtered}")
    assumed = f"logs.test: none, as {length:.2g} s are too short for a part to be held back{filtered}"
    return Split(("",), (), assumed)


def _split_recordings(lengths: Sequence[float], spoiled: float, filtered: str) -> Split:
    """The split of recordings of some lengths [s] that follow one another: the last fifth of them is held back.

    Those of which a filter leaves next to nothing are left out.
    """
    long = [number for number, length in enumerate(lengths) if length >= _LEAST_TEST * spoiled]
    assumed = f"logs: {len(lengths)} recordings one after the other, as stamps begin anew"
    if len(long) < len(lengths):
        assumed += f"; {len(lengths) - len(long)} of them left out as too short{filtered}"
    if not long:
        text = f"motion: {len(lengths)} recordings of {max(lengths):.2g} s at most are too short for a fit{filtered}"
        return Split(_numbered(list(range(len(lengths)))), (), missing=text)
    held = max(1, round(_TESTED * len(long))) if len(long) > 1 else 0
    train, test = long[: len(long) - held], long[len(long) - held :]
    assumed += f"; the last {held} held back as test" * (held > 1) + "; the last held back as test" * (held == 1)
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
    longest, at_end, found = 0.0, False, ""
    for name in _MOTION:
        values = getattr(log, name)
        for missing in () if values is None else np.isnan(values).reshape(len(log), -1).T:
            known = np.flatnonzero(~missing)
            if not missing.any() or len(known) < 2:
                continue
            at_end |= bool(missing[0] or missing[-1])
            longest = max(longest, *np.diff(log.time[known])[np.diff(known) > 1].tolist(), 0.0)
            found = found or name
    return longest, at_end, found


def keys_for_gaps(logs: Sequence[Log]) -> dict[str, tuple[object, str]]:
    """The keys of preprocessing that recordings with gaps in their motion need, with the reason."""
    found = [_gaps_in_motion(log) for log in logs]
    longest, at_end = max((x for x, *_ in found), default=0.0), any(x for _, x, _ in found)
    name = next((x for *_, x in found if x), "")
    out: dict[str, tuple[object, str]] = {}
    if 0.0 < longest <= _BRIDGED_S:
        out["bridge_gaps_s"] = (_BRIDGED_S, f"as gaps of {name} take up to {longest:.2g} s")
    if longest > _BRIDGED_S or at_end:
        reason = (
            f"as gaps of {name} take up to {longest:.2g} s" if longest > _BRIDGED_S else f"as {name} has one at an end"
        )
        out["exclude_rejected"] = (True, reason)
    return out


def keys_for_length(logs: Sequence[Log]) -> dict[str, tuple[object, str]]:
    """The keys of preprocessing that long recordings should have, with the reason."""
    samples = sum(map(len, logs))
    if samples <= _MANY:
        return {}
    return {"sample_rate_hz": ("auto", f"as {samples} samples are many: five for each period of the cutoff are kept")}
