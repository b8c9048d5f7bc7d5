"""Parts of a log: `walk.npz[0:30]` names the first thirty seconds, `walk.npz[#2]` the third recording of a file."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from torchid.errors import LogError, excerpt, format_count
from torchid.logs.log import FloatArray, check_time

RANGE_ACCEPTED = (
    "[START:END] in seconds from the first stamp (negative: before the end) or in percent (80%), each may be empty;"
    " [#2] for the third recording of a file"
)
"""Accepted after the name of a log, in messages."""

#: Share of a median step by which stamps may miss a bound: seconds since 1970 are rounded to 0.2 us.
_SLACK = 0.01
_BOUND = re.compile(r"([+-]?)(\d+\.?\d*|\.\d+)(?:[eE]([+-]?\d{1,3}))?(%?)")


@dataclass(frozen=True)
class _Bound:
    """A moment of a log: seconds after its first stamp, seconds (at most 0) after its end, or a share of its length."""

    origin: str
    value: float

    def at(self, length: float) -> float:
        """Seconds after the first stamp of a log of a length [s]."""
        return self.value * length if self.origin == "share" else self.value + length * (self.origin == "end")

    def is_before(self, other: _Bound) -> bool | None:
        """Whether it is earlier in a log of any length; None where that depends on the length."""
        if self.origin == other.origin:
            return self.value < other.value
        if self == _START or other == _END:
            return True
        return False if self == _END or other == _START else None


_START = _Bound("start", 0.0)
_END = _Bound("end", 0.0)


@dataclass(frozen=True)
class TimeRange:
    """Samples from `start` on and before `stop`, as `text` says it; the log ends a median step after its last stamp."""

    text: str
    start: _Bound
    stop: _Bound

    @classmethod
    def parse(cls, text: str) -> TimeRange:
        """The range of a text such as `[0:30]`, `[-10:]` or `[:80%]`. Raises ValueError: it is none."""
        start, colon, stop = text[1:-1].partition(":")
        if text[:1] + text[-1:] != "[]" or not colon:
            raise ValueError(text)
        return cls(text, _parse_bound(start, _START), _parse_bound(stop, _END))

    def select(self, time: FloatArray) -> slice:
        """The samples in the range.

        Stamps that miss a bound by rounding alone count as on it, so that ranges that meet share no sample and lose
        none.

        Args:
            time: (N,) [s], all stamps of the log.

        Raises:
            LogError: a bound is outside of the log, or nothing is within, or stamps that do not increase.
        """
        check_time(time)
        since = time - time[0]
        step = float(np.median(np.diff(since))) if len(since) > 1 else 0.0
        length = float(since[-1]) + step
        slack = _SLACK * step
        start = self.start.at(length)
        stop = self.stop.at(length)
        first, last = (int(np.searchsorted(since, bound - slack)) for bound in (start, stop))
        inside = -slack <= start and stop <= length + slack
        if not inside or first >= last:
            reason = f"{self.text}, but the log lasts {length:.6g} s ({len(time)} samples)"
            reason += "; this range has no sample" if inside else ""
            raise LogError.at_field("time range", reason, f"a range within 0 to {length:.6g} s with samples")
        return slice(first, last)


def _parse_bound(text: str, otherwise: _Bound) -> _Bound:
    """The bound that a text names, `otherwise` of an empty one; ValueError for anything else."""
    if not text:
        return otherwise
    match = _BOUND.fullmatch(text)
    if match is None:
        raise ValueError(text)
    sign, number, exponent, percent = match.groups()
    value = float(f"{number}e{exponent or 0}")
    if percent:
        if sign == "-" or value > 100.0:
            raise ValueError(text)
        return {0.0: _START, 100.0: _END}.get(value, _Bound("share", value / 100.0))
    return _Bound("end", -value) if sign == "-" else _Bound("start", value)


_RECORDING = re.compile(r"\[#(\d{1,9})\]")
_RECORDINGS = re.compile(r"\[#(\d{1,9}):(\d{1,9})\]")
_MOST_RECORDINGS = 100_000  # that one name stands for


@dataclass(frozen=True)
class Recording:
    """One of several recordings, such as episodes, that follow one another in a file: each has stamps of its own.

    Attributes:
        text: `[#2]`.
        number: counted from 0.
    """

    text: str
    number: int

    def select(self, time: FloatArray) -> slice:
        """Its samples; LogError where there are not so many recordings.

        Args:
            time: (N,) [s], all stamps of the file, which begin anew with each recording.
        """
        starts = recording_starts(time)
        if self.number >= len(starts):
            reason = f"{self.text}, but the file has {format_count(len(starts), 'recording')}"
            raise LogError.at_field("recording", reason, f"[#0] to [#{len(starts) - 1}]")
        return slice(*[*starts, len(time)][self.number : self.number + 2])


def recording_starts(time: FloatArray) -> list[int]:
    """The first samples of recordings that follow one another, where stamps (N,) go back."""
    return [0, *(np.flatnonzero(np.diff(time) < 0.0) + 1).tolist()]


def each_recording(name: str) -> list[str]:
    """The names of the recordings that a name such as `walk.npz[#2:40]` stands for; itself for any other."""
    file, bracket, inside = name.rpartition("[")
    if (match := _RECORDINGS.fullmatch(bracket + inside)) is None:
        return [name]
    first, stop = (int(x) for x in match.groups())
    return [f"{file}[#{k}]" for k in range(first, min(stop, first + _MOST_RECORDINGS))]


def share_samples(part: TimeRange | Recording | None, other: TimeRange | Recording | None) -> bool | None:
    """Whether two parts of a log overlap (None: all of it); None where that depends on how long the log is."""
    if part is None or other is None:
        return True
    if isinstance(part, Recording) or isinstance(other, Recording):
        return part == other
    early = part.start.is_before(other.stop)
    late = other.start.is_before(part.stop)
    return False if early is False or late is False else None if None in (early, late) else True


JOINED = " + "
"""Between the names of several files that are one log."""

#: Seconds behind the name of one of several files: `plates.csv@-0.12s`.
_SHIFT = re.compile(r"(.+)@([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)s?")
JOINED_ACCEPTED = "FILE + FILE, with @SECONDS to shift the clock of a file: 'motion.csv + plates.csv@0.12s'"
"""Accepted as a name of several files, in messages."""


@dataclass(frozen=True)
class LogFile:
    """A file of a log, and what is added to its stamps [s]."""

    path: Path
    shift_s: float = 0.0


def join_files(files: Sequence[LogFile]) -> str:
    """The name of several files as one log; all but the first by how they lie in its folder, if they do."""
    folder = files[0].path.parent
    names = [str(files[0].path)]
    for file in files[1:]:
        beside = file.path.is_relative_to(folder)
        names.append(str(file.path.relative_to(folder) if beside else file.path))
    shifts = [f"@{file.shift_s!r}s" if file.shift_s else "" for file in files]
    return JOINED.join(f"{name}{shift}" for name, shift in zip(names, shifts, strict=True))


def log_title(log: str | os.PathLike[str]) -> str:
    """The name of a log without folders."""
    return JOINED.join(Path(text).name for text in str(log).split(JOINED))


def _split_files(path: Path) -> tuple[LogFile, ...]:
    """The files that a name joins, the others relative to the folder of the first; one for a name of no several."""
    first, *others = str(path).split(JOINED)
    if not others or not all(Path(text).suffix for text in (first, *others)) or os.path.lexists(path):
        return (LogFile(path),)
    shifted = [_shifted(text) for text in (first, *others)]
    folder = shifted[0].path.parent
    return (shifted[0], *(LogFile(folder / file.path, file.shift_s) for file in shifted[1:]))


def _shifted(text: str) -> LogFile:
    match = _SHIFT.fullmatch(text)
    return LogFile(Path(text)) if match is None else LogFile(Path(match[1]), float(match[2]))


@dataclass(frozen=True)
class LogPart:
    """The file (or folder) of a log, or several as one name, and which part of it is meant, None for all."""

    file: Path
    range: TimeRange | Recording | None

    @cached_property
    def files(self) -> tuple[LogFile, ...]:
        """The file, or those that make up one log; the first has its stamps."""
        return _split_files(self.file)

    @property
    def joins(self) -> bool:
        """Whether it is made up of several files."""
        return len(self.files) > 1

    @property
    def kind(self) -> str:
        """Extensions of the files, with what their stamps are shifted by."""
        shifts = [f"@{file.shift_s!r}" if file.shift_s else "" for file in self.files]
        return JOINED.join(f"{x.path.suffix.lower()}{shift}" for x, shift in zip(self.files, shifts, strict=True))

    @property
    def name(self) -> str:
        """The names of the files without their extensions, and the range."""
        stems = [file.path.stem for file in self.files]
        return JOINED.join(stems) + ("" if self.range is None else self.range.text)

    def shares_samples(self, other: LogPart) -> bool | None:
        """Whether it overlaps with a part of the same (first) file; None where that depends on stamps.

        Ranges count from the first stamp of all files together.
        """
        if self.file == other.file:
            return share_samples(self.range, other.range)
        return True if any(part.range is None and not part.joins for part in (self, other)) else None

    def __str__(self) -> str:
        return str(self.file) + ("" if self.range is None else self.range.text)


def split_range(path: str | os.PathLike[str]) -> LogPart:
    """The file that a path names, and the range behind its name; a file with that very name is meant as it is.

    Raises:
        LogError: brackets behind the name of a file that hold no range.
    """
    path = path if isinstance(path, Path) else Path(path)
    file, bracket, inside = path.name.rpartition("[")
    if not inside.endswith("]") or not file or os.path.lexists(path):
        return LogPart(path, None)
    if match := _RECORDING.fullmatch(bracket + inside):
        return LogPart(path.with_name(file), Recording(bracket + inside, int(match[1])))
    try:
        return LogPart(path.with_name(file), TimeRange.parse(bracket + inside))
    except ValueError as error:
        text = f"'{excerpt(bracket + inside)}' is no range, and no such file exists"
        raise LogError(path, "time range", text, RANGE_ACCEPTED) from error
