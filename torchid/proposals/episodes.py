"""Recordings that lie side by side in a file of arrays: stacked along an axis, or in a group for each."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import excerpt
from torchid.logs.episodes import filled_lengths, flat, groups_of, in_groups
from torchid.logs.name_matching import is_desired, propose_field, words_of
from torchid.proposals.file_samples import FileSample, increases

_SHOWN = 8  # episodes that a map is proposed from
_WORDS = {
    "demo", "demonstration", "episode", "ep", "eps", "traj", "trajectory", "trial", "run", "rollout", "seq", "sequence",
    "take", "recording", "rec", "log", "path", "test", "exp", "experiment", "motion", "session", "env", "versuch",
}  # fmt: skip
_LENGTHS = {"length", "lengths", "len", "lens", "steps", "samples", "count", "counts", "frames"}
_GROUP = re.compile(r"([A-Za-z]*)[^A-Za-z0-9/]?(\d+)(?=/)")


@dataclass(frozen=True)
class FoundEpisodes:
    """Episodes of a file.

    Attributes:
        entry: of a map.
        sample: the first of them, one after the other.
        note: what was guessed.
    """

    entry: dict[str, Any]
    sample: FileSample
    note: str


def find_episodes(sample: FileSample) -> FoundEpisodes | None:
    """The episodes of arrays; None where all are one recording."""
    return _in_groups(sample) or _stacked(sample)


def _in_groups(sample: FileSample) -> FoundEpisodes | None:
    """Groups that differ in a number and hold arrays of joints; by what they are called, or as they differ in length.

    Limbs have groups of the same length.
    """
    found = {f"{name[: match.start(2)]}*": match[1].lower() for name in sample for match in _GROUP.finditer(name)}
    for groups, word in found.items():
        parts = {inner: [sample[name] for name in of] for inner, of in groups_of(sample, groups).items()}
        arrays = {inner: [x for x in of if x is not None and x.ndim] for inner, of in parts.items()}
        alike = {
            inner: of
            for inner, of in arrays.items()
            if len(of) == len(parts[inner]) > 1 and len({x.shape[1:] for x in of}) == 1 and max(map(len, of)) > 1
        }
        of_joints = [of for inner, of in alike.items() if of[0].ndim == 2 and _is_of_joints(inner)]
        if of_joints and (not word or word in _WORDS or len(set(map(len, of_joints[0]))) > 1):
            flat_ones = {inner: np.concatenate(of[:_SHOWN]) for inner, of in alike.items()}
            others = {name: x for name, x in sample.items() if not in_groups(groups).fullmatch(name)}
            count = len(of_joints[0])
            note = f"{count} groups like '{excerpt(groups)}', a recording each; arrays are called as in these"
            return FoundEpisodes({"groups": groups}, dict.fromkeys(parts) | others | flat_ones, note)
    return None


def _is_of_joints(name: str) -> bool:
    return propose_field(name).startswith("joint_") and not is_desired(name)


def _stacked(sample: FileSample) -> FoundEpisodes | None:
    """Arrays of joints (A, B, n) that no others (A, n) of joints are beside, whose samples are what changes little."""
    numeric = {name: x for name, x in sample.items() if x is not None and x.dtype.kind in "fiub"}
    of_joints = {name: x for name, x in numeric.items() if _is_of_joints(name) and x.ndim > 1}
    stacks = {name: x for name, x in of_joints.items() if x.ndim == 3 and x.shape[1] > 1}
    if not stacks or any(x.ndim == 2 and x.shape[1] > 1 and _is_other(x, stacks) for x in of_joints.values()):
        return None
    first = next((name for name in stacks if propose_field(name) == "joint_position"), next(iter(stacks)))
    shape = stacks[first].shape[:2]
    axis, why = _axis_of_episodes(numeric, stacks[first])
    count, samples = shape[axis], shape[1 - axis]
    lengths = next((name for name, x in numeric.items() if _are_lengths(name, x, count, samples)), None)
    shown, more = slice(0, _SHOWN), f"; as long as '{lengths}' says"
    some = numeric[lengths].ravel().astype(int)[shown] if lengths else None
    if lengths is None and (filled := _filled_up(numeric, shape, axis)) is not None:
        lengths, some = filled[0], filled[1][shown]
        more = f"; {filled[1].sum()} of {count * samples} samples, behind which all arrays are 0 or repeat their last"

    def flattened(x: NDArray[Any]) -> NDArray[Any]:
        if x.shape[:2] == shape:
            part = np.moveaxis(np.moveaxis(x, axis, 0)[shown], 0, axis)
            return flat(part, (part.shape[0], part.shape[1]), axis, some)
        if x.size == samples != count and x.ndim < 3:  # of one clock for all
            return np.concatenate(
                [x.ravel()[:n] for n in (np.full(min(count, _SHOWN), samples) if some is None else some)]
            )
        return x

    entry = {"axis": axis} | ({"lengths": lengths} if lengths else {})
    axes = "(episodes, samples, ...)" if axis == 0 else "(samples, episodes, ...)"
    note = f"{count} recordings side by side, arrays {axes}, {why}"
    taken = {name: flattened(x) if name in numeric and x is not None else x for name, x in sample.items()}
    return FoundEpisodes(entry, taken, note + more * bool(lengths))


def _filled_up(
    numeric: Mapping[str, NDArray[Any]], shape: tuple[int, int], axis: int
) -> tuple[str, NDArray[np.int64]] | None:
    """The measured array that tells best where episodes are filled up, and their samples (E,); None where they are not.

    A joint that stands still at the end is no filling: all arrays must be constant from there on.
    """
    measured = {x: propose_field(x) not in ("", "time") and numeric[x].dtype.kind == "f" for x in numeric}
    lengths = {
        x: filled_lengths(numeric[x], axis)
        for x, is_one in measured.items()
        if is_one and numeric[x].shape[:2] == shape
    }
    if not lengths:
        return None
    best = max(lengths, key=lambda name: int(lengths[name].sum()))
    is_filled = lengths[best].min() > 0 and min(np.max(list(lengths.values()), axis=0)) < shape[1 - axis]
    return (best, lengths[best]) if is_filled else None


def _is_other(array: NDArray[Any], stacks: Mapping[str, NDArray[Any]]) -> bool:
    return any(len(array) == len(x) and array.shape[1] != x.shape[1] for x in stacks.values())


def _axis_of_episodes(numeric: Mapping[str, NDArray[Any]], positions: NDArray[Any]) -> tuple[int, str]:
    """Which of two axes counts episodes, and why: not that of stamps, else that along which positions jump."""
    rows, columns = positions.shape[:2]
    for name, x in numeric.items():
        if propose_field(name) != "time" or x.dtype.kind not in "fiu":
            continue
        if x.size in (rows, columns) and rows != columns and increases(np.ravel(x)):
            return (1 if x.size == rows else 0), f"as '{excerpt(name)}' has as many stamps as samples"
        if x.shape[:2] == (rows, columns) and (_goes_on(x[:, 0].ravel()) != _goes_on(x[0].ravel())):
            return (1 if _goes_on(x[:, 0].ravel()) else 0), f"by the stamps of '{excerpt(name)}'"
    steps = [np.nanmedian(np.abs(np.diff(positions.astype(float), axis=axis))) if n > 1 else np.inf
             for axis, n in enumerate((rows, columns))]  # fmt: skip
    return int(steps[1] > steps[0]), "as from sample to sample little changes"


def _goes_on(stamps: NDArray[Any]) -> bool:
    """Whether stamps (N,), which may be filled up, change and go back at most once, where what fills them is 0."""
    steps = np.diff(stamps.astype(float))
    return bool(np.any(steps > 0.0) and (steps < 0.0).sum() < 2)


def _are_lengths(name: str, array: NDArray[Any], count: int, samples: int) -> bool:
    """Whether an array says how many samples each episode has, of which some are filled up."""
    is_number = array.dtype.kind in "iu" and array.size == count == max(array.shape, default=0)
    return (
        is_number and bool(_LENGTHS & set(words_of(name))) and 0 < array.min() < samples and int(array.max()) <= samples
    )
