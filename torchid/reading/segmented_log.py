"""A log in segments that are read in blocks, with what must be known of all of it before."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from torchid.errors import LogError
from torchid.logs import Log
from torchid.logs.blocks import LogBlocks
from torchid.logs.gaps import Coverage
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.preprocess import find_unloaded, move_to_timeline, unloaded_readings
from torchid.logs.signal_noise import SignalNoise
from torchid.logs.timeline import Timeline
from torchid.problem.samples import oversampling


@dataclass(frozen=True)
class RecordedBlock:
    """A part of the samples of a preprocessed log: their numbers, and what they are made of, as it was recorded."""

    piece: slice
    log: Log
    timeline: Timeline | None

    def preprocessed(self, coverage: Mapping[str, Coverage]) -> Log:
        """The samples."""
        return self.log if self.timeline is None else move_to_timeline(self.log, self.timeline, coverage, is_part=True)


@dataclass(frozen=True)
class Segment:
    """Successive samples of a log that are preprocessed by themselves.

    Attributes:
        blocks: of these samples alone.
        timeline: of them; None where nothing has to be done.
        first: number of the first of their samples in the preprocessed log.
        in_the_air: which contacts are in the air for sure, None if none ever is.
    """

    blocks: LogBlocks
    timeline: Timeline | None
    first: int
    in_the_air: BoolArray | None

    @property
    def time(self) -> FloatArray:
        """Stamps of its samples in the preprocessed log [s]."""
        return self.blocks.time if self.timeline is None else self.timeline.stamps_of(self.blocks.time)

    def read(self, piece: slice, only: tuple[str, ...] | None = None) -> RecordedBlock:
        """What a part of the preprocessed log depends on; with `only` some fields, no readings in the air."""
        samples, part = self._part(piece.start, piece.stop)
        log = self.blocks.read(samples, only)
        if self.in_the_air is not None and only is None:
            log = replace(log, contact_unloaded=unloaded_readings(log, self.in_the_air[samples]))
        return RecordedBlock(piece, log, part)

    def _part(self, first: int, last: int) -> tuple[slice, Timeline | None]:
        """As `Timeline.part`, of samples of the preprocessed log."""
        first, last = first - self.first, last - self.first
        return (slice(first, last), None) if self.timeline is None else self.timeline.part(first, last)


@dataclass(frozen=True)
class SegmentedLog:
    """A log in segments, with what must be known of all of it before its blocks are worked on.

    Attributes:
        segments: of it, in their order.
        coverage: of its fields that must have no gap.
        time: stamps of the preprocessed log [s].
        kept: which of its samples, None for all.
        noise: of the recorded motion.
    """

    segments: tuple[Segment, ...]
    coverage: Mapping[str, Coverage]
    time: FloatArray
    kept: BoolArray | None = None
    noise: SignalNoise = field(default_factory=lambda: SignalNoise({}))

    @cached_property
    def oversampling(self) -> float:
        """Samples per independent sample of noise."""
        timelines = [segment.timeline for segment in self.segments if segment.timeline is not None]
        bandwidths = [x.bandwidth_hz for x in timelines if x.bandwidth_hz is not None]
        return oversampling(self.time, min(bandwidths, default=None))

    @property
    def longest(self) -> Segment:
        """The segment that stands for all."""
        return max(self.segments, key=lambda segment: len(segment.blocks))

    def pieces(self, step: int) -> Iterator[tuple[Segment, slice]]:
        """The samples of the preprocessed log in parts of at most so many, each with its segment."""
        for segment in self.segments:
            first, stop = segment.first, segment.first + len(segment.time)
            for start in range(first, stop, step):
                yield segment, slice(start, min(start + step, stop))


def in_the_air(contacts: Log) -> BoolArray | None:
    """Which contacts are in the air for sure in which samples of the log, (N, C), None if none ever is."""
    if contacts.contact_active is None:
        return None
    unloaded = find_unloaded(contacts.time, contacts.contact_active)
    return unloaded if unloaded.any() else None


def require_kept(kept: BoolArray, source: str | Path, checked_for_slip: bool) -> None:
    """Refuse a log none of whose samples (N,) are kept away from changes of contact and, if checked, from slip."""
    if kept.any():
        return
    found, accepted = "no sample away from changes of contact", "a smaller preprocessing.contact_margin_s"
    if checked_for_slip:
        found = f"{found} in which no contact slips"
        accepted = "a larger preprocessing.max_slip, or a smaller contact_margin_s"
    raise LogError(source, "contact_active", found, accepted)
