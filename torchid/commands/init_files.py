"""Several files as one log: which of a folder's they are, and columns that more than one of them has."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchid.errors import InputError, LogError, format_count, join_names
from torchid.logs.column_entries import OF_FILE
from torchid.logs.columns import is_column
from torchid.logs.containers import ARRAYS, TABLES, list_bag_files
from torchid.logs.name_matching import propose_field
from torchid.logs.time_range import JOINED
from torchid.logs.units import UNITS
from torchid.proposals.file_samples import FileSample, increases, read_sample, rows_of
from torchid.proposals.numbers import unit_of_step
from torchid.robot import Robot

_MOST = 64  # files in a folder
_AS_ONE = "numpy.savez('{0}.npz', **{{x.stem: numpy.load(x) for x in pathlib.Path('{0}').glob('*.npy')}})"


def log_in_folder(path: Path) -> tuple[Path, list[str]]:
    """The name of a log; of a folder of tables and arrays that of its files as one log, and a note on these.

    They are those that have stamps and a quaternion or something that their names say is a field, the fastest first, as
    its stamps are those of the log.

    Raises:
        LogError: a folder that has none, or too many files.
    """
    if not path.is_dir() or list_bag_files(path):
        return path, []
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in (*TABLES, *ARRAYS) and file.is_file())
    if len(files) > _MOST:
        raise LogError(path, "file", f"a folder of {len(files)} logs", f"at most {_MOST}, the files of one log")
    if (single := sorted(path.glob("*.npy"))) and not files:
        found = f"{len(single)} arrays in files of their own, {join_names([file.name for file in single])}"
        raise LogError(path, "file", found, f"one file of all: {_AS_ONE.format(path.name)}")
    steps = {file: step for file in files if (step := _step_of(file)) is not None}
    if not steps:
        accepted = "a folder of tables or arrays that have stamps, or one recorded by ROS 2; or name the files of a log"
        raise LogError(path, "file", f"a folder, {format_count(len(files), 'log')} without stamps and fields", accepted)
    used = sorted(steps, key=lambda file: steps[file])
    others = [file.name for file in files if file not in steps]
    note = f"logs: {format_count(len(used), 'file')} of the folder as one log, the fastest first"
    note += f"; without {join_names(others)}, which have no stamps or no field" * bool(others)
    return path / JOINED.join(file.name for file in used), [note]


def _step_of(file: Path) -> float | None:
    """The median step [s] of a file's stamps; None where it has none, or nothing else that is in a log."""
    try:
        rows = rows_of(file)
        sample = read_sample(file, rows)
    except InputError:
        return None
    stamps = [name for name, x in sample.items() if propose_field(name) == "time" and increases(x)]
    fields = {
        propose_field(f"{file.stem}.{name}") for name, x in sample.items() if x is not None and x.dtype.kind in "fiub"
    }
    has_quaternion = set("wxyz") <= {name[-1:].lower() for name in sample}  # of a pose called by letters alone
    if not stamps or not (fields - {"", "time"} or has_quaternion):
        return None
    step = float(np.median(np.diff(np.asarray(sample[stamps[0]], dtype=float))))
    return step * UNITS["time"][unit_of_step(step)]


def named_apart(samples: Sequence[FileSample], files: Sequence[str], robot: Robot) -> list[FileSample]:
    """Columns of several files, those that others may have too with the name of the file before them, but for stamps.

    A column that is called as a joint or a link of the robot says nothing of what it has: its file does.
    """
    often = Counter(name for sample in samples for name in sample)
    parts = {*robot.joint_names, *robot.links} if len(files) > 1 else set()
    again = {
        name
        for name, count in often.items()
        if (count > 1 or name in parts) and not is_column(name) and propose_field(name) != "time"
    }
    if len(set(files)) < len(files):
        return list(samples)
    return [
        {f"{file}{OF_FILE}{name}" if name in again else name: x for name, x in sample.items()}
        for file, sample in zip(files, samples, strict=True)
    ]
