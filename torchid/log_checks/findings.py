"""What a check says: a finding with the samples it concerns, or why the check could not be made."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchid.logs.log import BoolArray

#: These samples must not be fitted.
CONDEMNED = "condemned"
#: Somebody should look at it; a fit may still be right.
SUSPICIOUS = "suspicious"
#: True of the log and worth knowing.
NOTE = "note"

SEVERITIES = (CONDEMNED, SUSPICIOUS, NOTE)


@dataclass(frozen=True)
class Span:
    """Successive samples, both ends included, of one channel of the finding's field ("": of all of them).

    `shift`: by how much the channel is too large from `last` on, where a jump is known to be no motion.
    """

    first: int
    last: int
    channel: str = ""
    shift: float = 0.0

    def __len__(self) -> int:
        return self.last - self.first + 1

    def __str__(self) -> str:
        return str(self.first) if self.first == self.last else f"{self.first}-{self.last}"


@dataclass(frozen=True)
class Finding:
    """One thing that a check found in a log.

    Attributes:
        name: of what was found, as in "spike".
        severity: one of `SEVERITIES`.
        field: of the log.
        channels: names within the field; empty for all of it.
        spans: the samples; empty for the whole log, unless the finding is to be seen at some places.
        found: what was found, with numbers.
        advice: what to do.
        everywhere: whether it concerns every sample though `spans` say where it is to be seen.
    """

    name: str
    severity: str
    field: str
    found: str
    advice: str
    channels: tuple[str, ...] = ()
    spans: tuple[Span, ...] = ()
    everywhere: bool = False

    @property
    def whole(self) -> bool:
        """Whether it concerns every sample."""
        return self.everywhere or not self.spans

    @property
    def condemns_all(self) -> bool:
        """Whether no sample of the log may be fitted."""
        return self.severity == CONDEMNED and self.whole

    def mask(self, samples: int) -> BoolArray:
        """Which of so many samples it concerns."""
        mask = np.full(samples, self.whole)
        for span in self.spans:
            mask[span.first : span.last + 1] = True
        return mask


@dataclass(frozen=True)
class Skipped:
    """A check that could not be made, and what it lacks."""

    name: str
    reason: str


def find_spans(where: BoolArray | NDArray[np.intp], channel: str = "") -> Iterator[Span]:
    """Runs of successive samples in a mask (N,) or in ascending sample numbers (M,)."""
    numbers = np.flatnonzero(where) if where.dtype == np.bool_ else where
    for run in np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1):
        if len(run):
            yield Span(int(run[0]), int(run[-1]), channel)
