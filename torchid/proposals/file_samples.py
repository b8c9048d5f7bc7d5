"""Some of what a file holds, from which a map is proposed: columns, arrays, messages of topics."""

from __future__ import annotations

import os
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import TorchidError, excerpt
from torchid.logs.arrays import fields_of_records, require_plain
from torchid.logs.containers import LogKind, existing_log_kind, list_bag_files, open_container, reader_errors_explained
from torchid.logs.name_matching import KnownRobot, limb_and_words, match_names, propose_field
from torchid.logs.ros_messages import make_deserializer
from torchid.logs.ros_read import list_channels, open_bag_file
from torchid.logs.table_files import is_text_table
from torchid.logs.table_headers import read_header
from torchid.logs.tables import RowNames, sample_row_names, sample_table

FileSample = Mapping[str, NDArray[Any] | None]
"""Columns of a table or arrays with some of their rows, some of them names; None for what is neither."""


_NAMES = 300  # elements of a list of names
_SORTED = 0.9  # of the steps of stamps, forwards


def rows_of(path: Path) -> RowNames | None:
    """What names the joint of each row, of a table with a row for each joint and stamp; LogError as `read_sample`."""
    return sample_row_names(path) if existing_log_kind(path) is LogKind.TABLE else None


def read_sample(path: Path, rows: RowNames | None = None) -> FileSample:
    """The columns of a table or the arrays of a file, with some of the rows of tables; `rows` as from `rows_of`.

    Raises:
        LogError: it cannot be read, or is a bag.
    """
    if existing_log_kind(path) is LogKind.TABLE:
        return sample_table(path, rows)
    out: dict[str, NDArray[Any] | None] = {}
    with open_container(path) as container:
        for name in container.declared_bytes():
            with reader_errors_explained(name, "a plain array of numbers, truth values or text"):
                array = container.load(name)
            for part, values in fields_of_records(name, array):
                is_list = values.ndim == 1 and len(values) <= _NAMES
                is_plain = values.dtype.kind in "fiub" or (is_list and values.dtype.kind in "SU")
                out[part] = values if is_plain else None
        if out and not any(x is not None for x in out.values()):
            require_plain(name, array)
    return out


def states_degrees(path: Path) -> bool:
    """Whether a table says that its angles are in degrees; LogError where it cannot be read."""
    return existing_log_kind(path) is LogKind.TABLE and is_text_table(path) and read_header(path).in_degrees


def stated_names(sample: FileSample, field: str) -> list[str]:
    """Names of joints, contacts or sensors that a file of arrays states."""
    stated = sample.get(field)
    names = [] if stated is None else np.ravel(stated).tolist()
    return [name.decode(errors="replace") if isinstance(name, bytes) else str(name) for name in names]


def texts_in(sample: FileSample) -> list[str]:
    """Names of columns and arrays, and all that lists of names in them have."""
    listed = [name for name, x in sample.items() if x is not None and x.dtype.kind not in "fiub"]
    return [*sample, *(text for name in listed for text in stated_names(sample, name))]


def listed_order(
    sample: FileSample, kind: str, robot: KnownRobot, count: int
) -> tuple[Sequence[str | None], str] | None:
    """So many names of joints or feet that some array of a file lists, and which; None where none does.

    What it lists beside all of them, such as joints that mimic others, is None in its place.

    Args:
        sample: from `read_sample`.
        kind: joint or contact.
        robot: whose names they are.
        count: how many.
    """
    known = robot.joints if kind == "joint" else robot.feet
    texts = {
        name: stated_names(sample, name) for name, x in sample.items() if x is not None and x.dtype.kind not in "fiub"
    }
    numbered = defaultdict[str, list[tuple[int, str]]](list)  # of a column for each name, such as name[3]
    for name, one in texts.items():
        if len(one) == 1 and (found := re.search(r"\d+(?=\D*$)", name)):
            numbered[f"{name[: found.start()]}{{index}}{name[found.end() :]}"].append((int(found[0]), one[0]))
    texts |= {name: [text for _, text in sorted(of)] for name, of in numbered.items()}
    for name, listed in texts.items():
        matched = match_names(listed, known, kind) if len(listed) == count >= len(known) else {}
        if len(matched) == len(known) > 0:
            return [matched.get(text) for text in listed], f"as '{name}' of the file lists them"
    if kind == "contact":
        return _order_of_legs(texts, robot, count)
    return None


def listed_joints(sample: FileSample, name: str, count: int, joints: Sequence[str]) -> list[str]:
    """Joints of an array, as the list of so many that is called most like it says; none where there is none."""
    lists = [other for other, x in sample.items() if x is not None and x.dtype.kind in "SU" and x.shape == (count,)]
    closest = max(lists, key=lambda other: len(os.path.commonprefix([name, other])), default="")
    texts = stated_names(sample, closest)
    matched = match_names(texts, joints, "joint")
    return [matched[text] for text in texts] if len(matched) == count else []


def _order_of_legs(texts: Mapping[str, Sequence[str]], robot: KnownRobot, count: int) -> tuple[list[str], str] | None:
    """The feet in the order in which a list of all joints names their legs, one after the other or in turn.

    None where there is no such list, or where its joints follow no order of legs: the first joints of all legs, the
    second ones and so on must name them alike.
    """
    by_side = {limb_and_words(foot)[0]: foot for foot in robot.feet}
    for name, listed in texts.items():
        if len(listed) == len(robot.joints) == len(match_names(listed, robot.joints, "joint")):
            places: dict[frozenset[str], list[int]] = {}
            for place, text in enumerate(listed):
                if (side := limb_and_words(text)[0]) in by_side:
                    places.setdefault(side, []).append(place)
            in_order = all(list(turn) == sorted(turn) for turn in zip(*places.values(), strict=False))
            if in_order and len(places) == count == len(robot.feet):
                return [by_side[side] for side in places], f"legs as '{name}' of the file lists their joints"
    return None


#: Messages of a topic that are looked at, spread over all of the bag.
_MESSAGES = 500


@dataclass
class TopicSample:
    """A topic, and some of its messages where their type is known.

    Attributes:
        type: of the messages.
        messages: in the order of receipt.
        count: how many there are.
    """

    type: str
    messages: list[Any] = field(default_factory=list)
    count: int = 0


def read_bag_sample(path: Path, types: Collection[str]) -> dict[str, TopicSample]:
    """Every topic of a bag, and messages of those that have one of some types. Raises LogError: the bag is damaged."""
    files = list_bag_files(path)
    channels = list_channels(files)
    raw: dict[str, list[bytes]] = {name: [] for name, channel in channels.items() if channel.type in types}
    counts, steps = dict.fromkeys(channels, 0), dict.fromkeys(channels, 1)
    for file in files:
        with open_bag_file(file) as opened:
            for record in opened.records(raw.keys()):
                name = record.topic
                if counts[name] % steps[name] == 0:
                    raw[name].append(record.data)
                    if len(raw[name]) > 2 * _MESSAGES:
                        raw[name], steps[name] = raw[name][::2], 2 * steps[name]
                counts[name] += 1
    out = {}
    with open_bag_file(files[0]):  # whose errors are those of deserializing, too
        for name, channel in channels.items():
            try:
                make = make_deserializer(name, channel)
                messages = [make(data) for data in raw.get(name, [])]
            except TorchidError:  # a serialization of others, which may be on a topic that nobody needs
                messages = []
            out[name] = TopicSample(channel.type, messages, counts[name])
    return out


def increases(values: NDArray[Any] | None) -> bool:
    """Whether numbers (N,) are stamps: of a clock that goes forwards nearly throughout."""
    if values is None or values.ndim != 1 or len(values) < 3:
        return False
    return bool((np.diff(values) > 0).mean() > _SORTED)


def counts(values: NDArray[Any] | None) -> bool:
    """Whether numbers (N,) are those of samples: one more with each of them."""
    return values is not None and values.ndim == 1 and len(values) > 2 and bool((np.diff(values) == 1).all())


def side_by_side(sample: FileSample, columns: Sequence[str]) -> NDArray[Any]:
    """Numbers (N, k) of columns, or an array as it is; all in one row where columns have not as many each."""
    values = [x for column in columns if (x := sample[column]) is not None]
    if len(values) == 1:
        return np.asarray(values[0])
    alike = len({x.shape for x in values}) == 1
    return np.stack(values, axis=-1) if alike else np.concatenate([np.ravel(x) for x in values])


# --------------------------------------------------------------------------------- arrays whose columns are the samples

_FEW = 2  # arrays that agree about a length, of files without stamps


def with_samples_first(sample: FileSample, joints: int) -> tuple[FileSample, dict[str, str]]:
    """Arrays with a row for each sample, those that were transposed for it by the name `NAME.T`; and notes on them.

    How many samples there are is what stamps say, else the last length of several arrays. Nothing is transposed that
    has as many rows as columns, or as many rows as there are samples.

    Args:
        sample: arrays of a file, from `read_sample`.
        joints: of the robot.
    """
    matrices = {name: x for name, x in sample.items() if x is not None and x.ndim == 2 and x.dtype.kind in "fiub"}
    count = _count(sample, matrices.values())
    turned = [name for name, x in matrices.items() if x.shape[1] == count != x.shape[0]]
    square = [name for name, x in matrices.items() if x.shape == (count, count) and count == joints]
    notes = dict[str, str]()
    if turned:
        like = f"'{excerpt(turned[0])}'" + (f" and {len(turned) - 1} more" if len(turned) > 1 else "")
        notes["columns"] = f"the columns of {like} are the {count} samples: .T transposes them"
    if square:
        name = excerpt(square[0])
        notes["joint_order"] = (
            f"as many samples as joints: if the columns of '{name}' are the samples, write '{name}.T'"
        )
    out = {name: x for name, x in sample.items() if name not in turned}
    return out | {f"{name}.T": matrices[name].T for name in turned}, notes


def _count(sample: FileSample, matrices: Collection[NDArray[np.generic]]) -> int:
    """How many samples there are, 0 where arrays do not say so."""
    flat = {name: x for name, x in sample.items() if x is not None and x.size == max(x.shape, default=0) > 2}
    for name, x in flat.items():
        if x.dtype.kind in "fiu" and propose_field(name) == "time" and increases(np.ravel(x)):
            return int(x.size)
    first, last = (Counter(x.shape[axis] for x in matrices) for axis in (0, 1))
    (length, times), *_ = last.most_common(1) or [(0, 0)]
    return length if times >= _FEW and length > max(first, default=0) else 0
