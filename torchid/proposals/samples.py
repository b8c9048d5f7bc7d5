"""Samples of a file for the proposal of a map: columns, arrays, episodes, messages of topics."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import excerpt
from torchid.logs.arrays import ARRAY_ACCEPTED, TRANSPOSED, fields_of_records, require_plain
from torchid.logs.bags import ENCODINGS, MESSAGES_ACCEPTED, list_channels, make_deserializer, messages_of
from torchid.logs.containers import LogKind, existing_log_kind, list_bag_files, open_container, reader_errors_explained
from torchid.logs.episodes import groups_of, in_groups
from torchid.logs.tables import sample_table
from torchid.proposals.names import propose_field

FileSample = Mapping[str, NDArray[Any] | None]
"""Columns of a table or arrays with some of their rows, some of them names; None for what is neither."""

_NAMES = 300  # elements of a list of names
_SORTED = 0.9  # of the steps of stamps, forwards
_JUMP = 1.0  # [rad or m] from sample to sample: a turn that an encoder jumps by


def read_sample(path: Path) -> FileSample:
    """The columns of a table or the arrays of a file, with some of the rows of tables.

    Raises:
        LogError: it cannot be read, or is a bag.
    """
    if existing_log_kind(path) is LogKind.TABLE:
        return sample_table(path)
    out: dict[str, NDArray[Any] | None] = {}
    with open_container(path) as container:
        for name in container.declared_bytes():
            with reader_errors_explained(name, ARRAY_ACCEPTED):
                array = container.load(name)
            for part, values in fields_of_records(name, array):
                is_list = values.ndim == 1 and len(values) <= _NAMES
                is_plain = values.dtype.kind in "fiub" or (is_list and values.dtype.kind in "SU")
                out[part] = values if is_plain else None
        if out and not any(x is not None for x in out.values()):
            require_plain(name, array)
    return out


def stated_names(sample: FileSample, name: str) -> list[str]:
    """The texts of an array of names."""
    stated = sample.get(name)
    names = [] if stated is None else np.ravel(stated).tolist()
    return [x.decode(errors="replace") if isinstance(x, bytes) else str(x) for x in names]


def numbers_of(sample: FileSample, columns: Sequence[str]) -> NDArray[np.float64]:
    """Numbers (N, k) of columns or of an array; one single column if these differ in rows."""
    arrays = [np.asarray(x, dtype=float) for column in columns if (x := sample[column]) is not None]
    flat_ones = [x.reshape(len(x), -1) if x.ndim else x.reshape(1, 1) for x in arrays]
    if len({len(x) for x in flat_ones}) == 1:
        return np.concatenate(flat_ones, axis=1)
    return np.concatenate([np.zeros(0), *map(np.ravel, flat_ones)])[:, None]


def increases(values: NDArray[Any] | None, strictly: bool = True) -> bool:
    """Whether numbers (N,) or (N, 1) are stamps: a clock that goes forwards, always (`strictly`) or nearly always."""
    if (
        values is None
        or values.dtype.kind not in "fiu"
        or values.size != max(values.shape, default=0)
        or values.size < 3
    ):
        return False
    steps = np.diff(np.ravel(values))
    return bool((steps > 0).mean() > _SORTED if strictly else (steps >= 0).mean() > _SORTED and (steps > 0).any())


def slope_fit(position: NDArray[Any], velocity: NDArray[Any]) -> tuple[float, float]:
    """Correlation of velocities (N, ...) with steps of positions, and the time between samples."""
    steps = np.diff(position.astype(float), axis=0)
    mean = 0.5 * (velocity[1:] + velocity[:-1]).astype(float)
    with np.errstate(all="ignore"):
        product = np.nansum(steps * mean)
        step_power = np.nansum(steps**2)
        mean_power = np.nansum(mean**2 + 0.0 * steps)
    if not step_power > 0.0 or not mean_power > 0.0:
        return 0.0, 0.0
    return float(product / np.sqrt(step_power * mean_power)), float(product / mean_power)


def with_samples_first(sample: FileSample) -> tuple[FileSample, str]:
    """Arrays with a row for each sample, transposed arrays as `NAME.T`; and a note.

    Nothing is transposed that has as many rows as there are stamps.
    """
    stamps = (x.size for name, x in sample.items() if x is not None and propose_field(name) == "time" and increases(x))
    count = next(stamps, 0)
    matrices = {name: x for name, x in sample.items() if x is not None and x.ndim == 2 and x.dtype.kind in "fiub"}
    turned = [name for name, x in matrices.items() if x.shape[1] == count != x.shape[0] and x.shape[0] > 1]
    if not turned:
        return sample, ""
    others = {name: x for name, x in sample.items() if name not in turned}
    note = f"the columns of '{excerpt(turned[0])}' are the {count} samples; .T transposes it"
    return others | {f"{name}{TRANSPOSED}": matrices[name].T for name in turned}, note


# ------------------------------------------------------------------------------------------------------- episodes

_EPISODES = re.compile(r"((?:demo|episode|ep|traj|trajectory|trial|run|rollout)[^A-Za-z0-9/]?)\d+(?=/)", re.IGNORECASE)
_LENGTHS = re.compile(r"(\w*_)?(lengths?|lens?)", re.IGNORECASE)


@dataclass(frozen=True)
class FoundEpisodes:
    """Episodes of a file: the entry of a map, the first of them as a sample, and what was assumed."""

    entry: dict[str, Any]
    sample: FileSample
    note: str


def find_episodes(sample: FileSample) -> FoundEpisodes | None:
    """Episodes in groups called `demo_0`, ..., or stacked in arrays of joints with three axes; None without any."""
    groups = dict.fromkeys(name[: m.start(1)] + m[1] + "*" for name in sample for m in _EPISODES.finditer(name))
    for pattern in groups:
        parts = groups_of(sample, pattern)
        first = {inner: sample[names[0]] for inner, names in parts.items() if len(names) > 1}
        if any(propose_field(inner).startswith("joint_") for inner in first):
            others = {name: x for name, x in sample.items() if not in_groups(pattern).fullmatch(name)}
            return FoundEpisodes({"groups": pattern}, others | first, "each group is one recording")
    joints = {name: x for name, x in sample.items() if x is not None and propose_field(name).startswith("joint_")}
    stacked = sorted(
        (name for name in joints if joints[name].ndim == 3), key=lambda x: propose_field(x) != "joint_position"
    )
    if not stacked or any(x.ndim == 2 and len(x) == len(joints[stacked[0]]) for x in joints.values()):
        return None
    array = joints[stacked[0]].astype(float)
    shape = array.shape[:2]
    steps = [np.nanmedian(np.abs(np.diff(array, axis=k))) if shape[k] > 1 else np.inf for k in (0, 1)]
    axis = int(steps[1] > steps[0])
    count = shape[axis]
    samples = shape[1 - axis]
    lengths = next((x for x, y in sample.items() if _LENGTHS.fullmatch(x) and y is not None and y.size == count), "")
    shown = samples if not lengths else int(np.ravel(sample[lengths])[0])  # type: ignore[arg-type]

    def first_of(x: NDArray[Any]) -> NDArray[Any]:
        if x.shape[:2] == shape:
            return np.take(x, 0, axis=axis)[:shown]
        is_clock = x.size == samples != count and x.ndim < 3
        return x.ravel()[:shown] if is_clock else x

    taken = {name: x if x is None or x.dtype.kind not in "fiub" else first_of(x) for name, x in sample.items()}
    entry = {"axis": axis} | ({"lengths": lengths} if lengths else {})
    axes = "(episodes, samples, ...)" if axis == 0 else "(samples, episodes, ...)"
    return FoundEpisodes(entry, taken, f"{count} recordings in arrays {axes}: neighbouring samples differ little")


# --------------------------------------------------------------------------------------------------------- topics

_MESSAGES = 500  # of a topic that are looked at, spread over all of the bag


@dataclass
class TopicSample:
    """A topic, and some of its messages where their type is known: in the order of receipt, `count` in all."""

    type: str
    messages: list[Any] = field(default_factory=list)
    count: int = 0


def read_bag_sample(path: Path, types: Collection[str]) -> dict[str, TopicSample]:
    """Every topic of a bag, and messages of those that have one of some types. Raises LogError: the bag is damaged."""
    files = list_bag_files(path)
    channels = list_channels(files)
    out = {name: TopicSample(channel.type) for name, channel in channels.items()}
    known = [name for name, channel in channels.items() if channel.type in types and channel.encoding in ENCODINGS]
    steps = dict.fromkeys(known, 1)
    decoders = {name: make_deserializer(name, channels[name]) for name in known}
    for name, _, data, _ in messages_of(files, known):
        topic = out[name]
        if topic.count % steps[name] == 0:
            with reader_errors_explained("file", MESSAGES_ACCEPTED):
                topic.messages.append(decoders[name](data))
            if len(topic.messages) > 2 * _MESSAGES:
                topic.messages = topic.messages[::2]
                steps[name] = 2 * steps[name]
        topic.count += 1
    return out
