"""Recordings side by side in a file of arrays, one after the other: stacked along an axis, or in a group for each."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, excerpt
from torchid.logs.columns import KEY, PLACEHOLDER, Columns, Episodes
from torchid.logs.containers import Container


def arrays_of_episodes(container: Container, columns: Columns | None) -> Arrays:
    """The arrays of a file as a map of its columns has them, one recording after the other where it says so."""
    if columns is None or columns.episodes is None:
        return Arrays(container)
    return GroupedArrays(container, columns.episodes) if columns.episodes.groups else StackedArrays(container, columns)


class Arrays:
    """Arrays of a file as they are."""

    def __init__(self, container: Container) -> None:
        self._container = container
        self.names = list(container.declared_bytes())

    def load(self, name: str) -> NDArray[Any]:
        """One of them."""
        return self._container.load(name)

    def stamps(self, time: NDArray[Any], rows: int, has_step: bool) -> NDArray[Any]:
        """Stamps of all samples, of those that were read; `has_step`: or counted, of so many rows throughout."""
        counts = self._counts_of(rows)
        if has_step and len(counts) > 1:
            return np.concatenate([time[:count] for count in counts])
        first = np.cumsum([0, *counts])
        if len(time) != first[-1] or not (time[first[1:-1]] > time[first[1:-1] - 1]).any():
            return time
        return np.asarray(time - np.repeat(time[first[:-1]], counts))  # of a clock that goes on to the next episode

    def _counts_of(self, rows: int) -> Sequence[int]:
        """Samples of each episode in so many rows."""
        return [rows]


def flat(array: NDArray[Any], shape: tuple[int, int], axis: int, lengths: NDArray[Any] | None = None) -> NDArray[Any]:
    """An array (E, N, ...), or (N, E, ...) where episodes are the second axis, as (sum of lengths, ...); others as is.

    Args:
        array: of a file.
        shape: the first two sizes of those that are stacked.
        axis: that counts episodes, 0 or 1.
        lengths: samples of each episode (E,), of arrays that are filled up; None: all.
    """
    if array.shape[:2] != shape:
        return array
    by_episode = np.moveaxis(array, axis, 0)
    if lengths is not None:
        return np.concatenate([one[:length] for one, length in zip(by_episode, lengths, strict=True)])
    return by_episode.reshape(-1, *array.shape[2:])


class StackedArrays(Arrays):
    """Arrays that have an axis of episodes beside that of samples, as the positions of the joints have."""

    def __init__(self, container: Container, columns: Columns) -> None:
        """Look at the positions; LogError where they are not stacked."""
        super().__init__(container)
        entry = columns.episodes or Episodes()
        self._axis, name = entry.axis, _positions(columns, self.names)
        array = container.load(name)
        if array.ndim < 2:
            found = f"axis: {entry.axis}, but '{excerpt(name)}' has shape {array.shape}"
            raise LogError.at_field(f"{KEY}.episodes", found, "arrays (episodes, samples, ...) or the other way round")
        self._shape = (int(array.shape[0]), int(array.shape[1]))
        count, self._samples = self._shape[:: -1 if self._axis else 1]
        lengths = np.full(count, self._samples)
        if entry.lengths is not None:
            given = container.load(entry.lengths) if entry.lengths in self.names else np.empty(0)
            lengths = given.ravel()
            if (
                given.dtype.kind not in "iu"
                or lengths.shape != (count,)
                or ((lengths < 1) | (lengths > self._samples)).any()
            ):
                accepted = f"an array of {count} whole numbers, the samples of each, from 1 to {self._samples}"
                raise LogError.at_field(f"{KEY}.episodes.lengths", f"'{excerpt(entry.lengths)}'", accepted)
        self._lengths = lengths.astype(np.int64)

    def load(self, name: str) -> NDArray[Any]:
        """One of them, with a row for each sample."""
        array = super().load(name)
        if array.size == self._samples != len(self._lengths) and array.ndim < 3 and array.dtype.kind in "fiu":
            clock = array.ravel()  # one for all
            return np.concatenate([clock[:count] for count in self._lengths])
        return flat(array, self._shape, self._axis, self._lengths)

    def _counts_of(self, rows: int) -> Sequence[int]:
        return self._lengths.tolist()


def in_groups(pattern: str) -> re.Pattern[str]:
    """What matches names within the groups that a pattern such as `data/demo_*` means: their number, and the rest."""
    return re.compile(re.escape(pattern.rstrip("/")).replace(r"\*", r"(\d+)") + "/(.+)")


def groups_of(names: Collection[str], pattern: str) -> dict[str, list[str]]:
    """Names of the groups of a file that a pattern such as `data/demo_*` means, by number, by what all have in them."""
    regex, found = in_groups(pattern), dict[str, dict[int, str]]()
    for name in names:
        if (match := regex.fullmatch(name)) is not None:
            found.setdefault(match[2], {})[int(match[1])] = name
    numbers = {number for of in found.values() for number in of}
    return {inner: [of[k] for k in sorted(of)] for inner, of in found.items() if len(of) == len(numbers)}


class GroupedArrays(Arrays):
    """Arrays of groups that hold an episode each, by their names in these."""

    def __init__(self, container: Container, entry: Episodes) -> None:
        """Look for the groups; LogError where there are none."""
        super().__init__(container)
        pattern = entry.groups or ""
        self._parts = groups_of(self.names, pattern)
        if not self._parts:
            accepted = f"a name with * for the number, of groups that hold the same arrays: {excerpt(self.names[0])}"
            raise LogError.at_field(f"{KEY}.episodes.groups", f"'{excerpt(pattern)}', no such groups", accepted)
        regex = in_groups(pattern)
        self.names = [*self._parts, *(x for x in self.names if not regex.fullmatch(x) and x not in self._parts)]
        self._counts = dict[int, list[int]]()  # samples of each, by those of all

    def load(self, name: str) -> NDArray[Any]:
        """One of them, that of all groups, or of the first where each has a single value; LogError for other shapes."""
        if name not in self._parts:
            return super().load(name)
        parts = [self._container.load(part) for part in self._parts[name]]
        if not any(part.ndim for part in parts):
            return parts[0]
        for part, text in zip(parts, self._parts[name], strict=True):
            if not part.ndim or part.shape[1:] != parts[0].shape[1:]:
                others = f"shape {part.shape}, but '{excerpt(self._parts[name][0])}' {parts[0].shape}"
                accepted = "as many columns in all groups; leave other groups out of the file"
                raise LogError.at_field(f"'{excerpt(text)}'", others, accepted)
        if not parts[0].dtype.hasobject:
            self._counts[sum(map(len, parts))] = [len(part) for part in parts]
        return np.concatenate(parts)

    def _counts_of(self, rows: int) -> Sequence[int]:
        return self._counts.get(rows, [rows])


def _positions(columns: Columns, names: Collection[str]) -> str:
    """The array of the joints' positions, or one of them; LogError where there is none."""
    entry = columns.joint_position
    text = "joint_position" if entry is None else entry.column or next(iter(entry.columns.values()), "")
    regex = re.compile(".+".join(map(re.escape, re.split(PLACEHOLDER.pattern, text)[::3])) + r"(\[.*\]|\.T)?")
    found = next((x for x in names if x == text or text.startswith(f"{x}[") or regex.fullmatch(x)), None)
    if found is None:
        raise LogError.at_field(f"{KEY}.episodes", "given without positions of joints", f"{KEY}.joint_position too")
    return found
