"""Parts of a log in time: `walk.npz[0:30]` names the first thirty seconds of a file."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchid.errors import LogError, excerpt
from torchid.logs.log import FloatArray

RANGE_ACCEPTED = (
    "[START:END], each empty, seconds from the log's first stamp (below 0: before its end) or a share of it (80%)"
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


_START, _END = _Bound("start", 0.0), _Bound("end", 0.0)


@dataclass(frozen=True)
class TimeRange:
    """Samples from `start` on and before `stop`, as `text` says it; the log ends a median step after its last stamp."""

    text: str
    start: _Bound
    stop: _Bound

    @classmethod
    def parse(cls, text: str) -> TimeRange:
        """The range of a text such as `[0:30]`, `[-10:]` or `[:80%]`.

        Raises:
            ValueError: it is none.
        """
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
            LogError: a bound is outside of the log, or nothing is within.
        """
        since = time - time[0]
        step = float(np.median(np.diff(since))) if len(since) > 1 else 0.0
        length, slack = float(since[-1]) + step, _SLACK * step
        start, stop = self.start.at(length), self.stop.at(length)
        first, last = (int(np.searchsorted(since, bound - slack)) for bound in (start, stop))
        inside = -slack <= start and stop <= length + slack
        if not inside or first >= last:
            found = f"{self.text} of a log that lasts {length:.6g} s ({len(time)} samples)"
            found += ", without a sample in it" if inside else ""
            raise LogError.at_field("time range", found, f"a part of 0 to {length:.6g} s that has samples")
        return slice(first, last)


def _parse_bound(text: str, otherwise: _Bound) -> _Bound:
    """The bound that a text names, `otherwise` of an empty one; ValueError for anything else."""
    if not text:
        return otherwise
    found = _BOUND.fullmatch(text)
    if found is None:
        raise ValueError(text)
    sign, number, exponent, percent = found.groups()
    value = float(f"{number}e{exponent or 0}")
    if percent:
        if sign == "-" or value > 100.0:
            raise ValueError(text)
        return {0.0: _START, 100.0: _END}.get(value, _Bound("share", value / 100.0))
    return _Bound("end", -value) if sign == "-" else _Bound("start", value)


def share_samples(one: TimeRange | None, other: TimeRange | None) -> bool | None:
    """Whether two ranges of a log overlap (None: all of it); None where that depends on how long the log is."""
    if one is None or other is None:
        return True
    early, late = one.start.is_before(other.stop), other.start.is_before(one.stop)
    return False if early is False or late is False else None if None in (early, late) else True


@dataclass(frozen=True)
class LogPart:
    """The file (or folder) of a log, and which part of it in time is meant, None for all."""

    file: Path
    range: TimeRange | None

    @property
    def name(self) -> str:
        """The name of the file without its extension, and the range."""
        return self.file.stem + ("" if self.range is None else self.range.text)

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
    try:
        return LogPart(path.with_name(file), TimeRange.parse(bracket + inside))
    except ValueError as error:
        found = f"'{excerpt(bracket + inside)}' behind its name, and no file of that name"
        raise LogError(path, "time range", found, RANGE_ACCEPTED) from error
