"""Several recordings in one file of arrays, stacked along an axis or in groups, read one after the other."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, excerpt
from torchid.logs.columns import KEY, PLACEHOLDER, Columns, Episodes

AnyArray = NDArray[Any]


class EpisodeArrays:
    """Arrays of a file for a map of its columns; recordings follow one another if the map has episodes.

    Attributes:
        names: of the arrays.
    """

    def __init__(self, names: Sequence[str], load: Callable[[str], AnyArray], columns: Columns | None) -> None:
        """Look for episodes; LogError where there are none of those that the map says.

        Args:
            names: arrays of the file.
            load: reads one.
            columns: the map.
        """
        self.names = list(names)
        self._load = load
        self._groups = dict[str, list[str]]()  # arrays of all groups, by what they are called in each
        self._lengths = list[int]()  # samples of each of episodes that are stacked
        self._shape = (0, 0)
        self._axis = 0
        self._counts = dict[int, list[int]]()  # samples of each episode, by those of all
        entry = None if columns is None else columns.episodes
        if entry is not None and entry.groups:
            self._find_groups(entry.groups)
        elif entry is not None and columns is not None:
            self._find_axis(entry, _positions(columns, names))

    def _find_groups(self, pattern: str) -> None:
        self._groups = groups_of(self.names, pattern)
        if not self._groups:
            accepted = f"a name with * for the number, of groups with equal arrays; one array: {excerpt(self.names[0])}"
            raise LogError.at_field(f"{KEY}.episodes.groups", f"no groups '{excerpt(pattern)}'", accepted)
        regex = in_groups(pattern)
        self.names = [*self._groups, *(x for x in self.names if not regex.fullmatch(x) and x not in self._groups)]

    def _find_axis(self, entry: Episodes, name: str) -> None:
        """Episodes and samples as the first two axes that the positions have."""
        array = self._load(name)
        if array.ndim < 2:
            reason = f"axis: {entry.axis}, but '{excerpt(name)}' has shape {array.shape}"
            raise LogError.at_field(f"{KEY}.episodes", reason, "(episodes, samples, ...) or (samples, episodes, ...)")
        self._axis = entry.axis
        self._shape = (int(array.shape[0]), int(array.shape[1]))
        count = self._shape[entry.axis]
        samples = self._shape[1 - entry.axis]
        lengths = np.full(count, samples)
        if entry.lengths is not None:
            lengths = self._load(entry.lengths).ravel() if entry.lengths in self.names else np.empty(0)
            is_whole = lengths.dtype.kind in "iu" and lengths.shape == (count,)
            if not is_whole or ((lengths < 1) | (lengths > samples)).any():
                accepted = f"an array of {count} integers, the samples of each episode, from 1 to {samples}"
                raise LogError.at_field(f"{KEY}.episodes.lengths", f"'{excerpt(entry.lengths)}'", accepted)
        self._lengths = lengths.astype(np.int64).tolist()

    def load(self, name: str) -> AnyArray:
        """An array with a row for each sample of all episodes; LogError if arrays of groups differ in shape."""
        if name in self._groups:
            return self._grouped(self._groups[name])
        array = self._load(name)
        if not self._lengths:
            return array
        samples = self._shape[1 - self._axis]
        if array.size == samples != len(self._lengths) and array.ndim < 3 and array.dtype.kind in "fiu":
            clock = array.ravel()  # one for all
            return np.concatenate([clock[:count] for count in self._lengths])
        if array.shape[:2] != self._shape:
            return array
        episodes = np.moveaxis(array, self._axis, 0)
        return np.concatenate([episode[:length] for episode, length in zip(episodes, self._lengths, strict=True)])

    def _grouped(self, names: Sequence[str]) -> AnyArray:
        """The arrays of all groups, or that of the first where each has a single value."""
        parts = [self._load(name) for name in names]
        if not any(part.ndim for part in parts):
            return parts[0]
        for part, text in zip(parts, names, strict=True):
            if not part.ndim or part.shape[1:] != parts[0].shape[1:]:
                others = f"shape {part.shape}, but '{excerpt(names[0])}' has {parts[0].shape}"
                accepted = "equally many columns in all groups; remove other groups from the file"
                raise LogError.at_field(f"'{excerpt(text)}'", others, accepted)
        if not parts[0].dtype.hasobject:
            self._counts[sum(map(len, parts))] = [len(part) for part in parts]
        return np.concatenate(parts)

    def stamps(self, time: AnyArray, rows: int, has_step: bool) -> AnyArray:
        """Stamps of all samples, from the stamps of the file; `has_step`: from counted stamps of this many rows."""
        counts = self._lengths or self._counts.get(rows, [rows])
        if has_step and len(counts) > 1:
            return np.concatenate([time[:count] for count in counts])
        first = np.cumsum([0, *counts])
        if len(time) != first[-1] or not (time[first[1:-1]] > time[first[1:-1] - 1]).any():
            return time
        return np.asarray(time - np.repeat(time[first[:-1]], counts))  # of a clock that goes on to the next episode


def in_groups(pattern: str) -> re.Pattern[str]:
    """Regular expression for names in the groups of a pattern such as `data/demo_*`: number, and rest of the name."""
    return re.compile(re.escape(pattern.rstrip("/")).replace(r"\*", r"(\d+)") + "/(.+)")


def groups_of(names: Collection[str], pattern: str) -> dict[str, list[str]]:
    """Names in the groups of a pattern such as `data/demo_*`, by number, by their common part."""
    numbered = dict[str, dict[int, str]]()
    for name in names:
        if (match := in_groups(pattern).fullmatch(name)) is not None:
            numbered.setdefault(match[2], {})[int(match[1])] = name
    count = len({number for by_number in numbered.values() for number in by_number})
    return {inner: [x[k] for k in sorted(x)] for inner, x in numbered.items() if len(x) == count}


def _positions(columns: Columns, names: Collection[str]) -> str:
    """The array of the joints' positions, or one of them; LogError where there is none."""
    entry = columns.joint_position
    text = "joint_position" if entry is None else entry.column or next(iter(entry.columns.values()), "")
    regex = re.compile(".+".join(map(re.escape, re.split(PLACEHOLDER.pattern, text)[::3])) + r"(\[.*\]|\.T)?")
    name = next((x for x in names if x == text or text.startswith(f"{x}[") or regex.fullmatch(x)), None)
    if name is None:
        raise LogError.at_field(f"{KEY}.episodes", "given without joint positions", f"{KEY}.joint_position")
    return name
