"""The steps from a recorded log to samples of a robot: flags, pose of the base, filter, binding, slip.

A log is one block if it is in memory, and many that depend on their neighbourhood where it is larger than that.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from contextvars import copy_context
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchid.config.log_reading import PreprocessingConfig
from torchid.errors import LogError, about_file
from torchid.logs import Columns, Log
from torchid.logs.blocks import (
    GIGABYTE,
    LogBlocks,
    LogInMemory,
    bridge_in_blocks,
    count_samples_from,
    open_log_blocks,
)
from torchid.logs.dry_friction import with_sign_filter, with_signs_of
from torchid.logs.gaps import Coverage, warn_of_gaps
from torchid.logs.lazy_arrays import Filled, MappedPages, Spill, growing_array
from torchid.logs.log import CONTACT_READINGS, NORMALS, BoolArray, FloatArray
from torchid.logs.preprocess import (
    away_from_changes,
    away_from_stamps,
    find_unloaded,
    gapless_fields,
    lacks_derivatives,
    make_timeline,
    move_to_timeline,
    unloaded_readings,
)
from torchid.logs.segments import count_samples, long_segments
from torchid.logs.signal_noise import MOST_SAMPLES, SignalNoise, signal_noise, warn_of_noisy_accelerations
from torchid.logs.timeline import SPLINE_BLOCK, Timeline
from torchid.parallel import one_thread, thread_count
from torchid.problem import Samples, bind_log
from torchid.problem.base_pose import PoseSegments, warn_of_pose
from torchid.problem.contact_slip import (
    away_from_own_changes,
    base_velocity,
    ground_speeds,
    judge_speeds,
    warn_of_slip,
)
from torchid.problem.derived_blocks import (
    base_pose_in_blocks,
    contacts_alone,
    detect_in_blocks,
    flag_by_force_in_blocks,
    motion_fields,
    with_flags,
    zero_in_blocks,
)
from torchid.problem.log_joints import distances_from_welds, warn_of_moving_welds
from torchid.problem.motion import BaseMotion
from torchid.problem.samples import oversampling
from torchid.robot import Robot
from torchid.sensing import Contact, SensorSet

_COPIES = 16  # a block takes so many times the memory of its recorded arrays: derivatives, splines, bound tensors
BLOCK_GB = 0.02
"""Recorded arrays of a block in memory; smaller ones spend more on the neighbourhood that a filter needs."""


@dataclass(frozen=True)
class _RecordedBlock:
    """A part of the samples of a preprocessed log: their numbers, and what they are made of, as it was recorded."""

    piece: slice
    log: Log
    timeline: Timeline | None

    def preprocessed(self, coverage: Mapping[str, Coverage]) -> Log:
        """The samples."""
        return self.log if self.timeline is None else move_to_timeline(self.log, self.timeline, coverage, is_part=True)


@dataclass(frozen=True)
class _Segment:
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

    def read(self, piece: slice, only: tuple[str, ...] | None = None) -> _RecordedBlock:
        """What a part of the preprocessed log depends on; with `only` some fields, no readings in the air."""
        samples, part = self._part(piece.start, piece.stop)
        log = self.blocks.read(samples, only)
        if self.in_the_air is not None and only is None:
            log = replace(log, contact_unloaded=unloaded_readings(log, self.in_the_air[samples]))
        return _RecordedBlock(piece, log, part)

    def _part(self, first: int, last: int) -> tuple[slice, Timeline | None]:
        """As `Timeline.part`, of samples of the preprocessed log."""
        first, last = first - self.first, last - self.first
        if self.timeline is None:
            return slice(first, last), None
        if last - first == len(self.time):
            return slice(0, len(self.blocks)), self.timeline
        return self.timeline.part(first, last)


@dataclass(frozen=True)
class _SegmentedLog:
    """A log in segments, with what must be known of all of it before its blocks are worked on.

    Attributes:
        segments: of it, in their order.
        coverage: of its fields that must have no gap.
        time: stamps of the preprocessed log [s].
        kept: which of its samples, None for all.
        noise: of the recorded motion.
    """

    segments: tuple[_Segment, ...]
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
    def longest(self) -> _Segment:
        """The segment that stands for all."""
        return max(self.segments, key=lambda segment: len(segment.blocks))

    def pieces(self, step: int) -> Iterator[tuple[_Segment, slice]]:
        """The samples of the preprocessed log in parts of at most so many, each with its segment."""
        for segment in self.segments:
            first, stop = segment.first, segment.first + len(segment.time)
            for start in range(first, stop, step):
                yield segment, slice(start, min(start + step, stop))


@dataclass(frozen=True)
class _Derived:
    """A log with the contact flags and the motion of its base that the settings want.

    Attributes:
        blocks: the log.
        certain: where its flags are, (N,); None everywhere.
        standing: where the pose of its base is known; None throughout.
    """

    blocks: LogBlocks
    certain: BoolArray | None = None
    standing: PoseSegments | None = None


@dataclass(frozen=True)
class LogSteps:
    """A log that is preprocessed and bound to a robot block by block.

    Blocks are read one after the other; if the samples are held in memory, threads work on them.

    Attributes:
        path: its file.
        settings: of preprocessing.
        robot: whose log it is.
        contacts: in use.
        required: sensors whose every value must be there, None if gaps are allowed.
        folder: where there is room for the samples; None: in memory.
        motion_noise: of the recorded motion, as far as it is stated, as `preprocess` takes it.
        sign_width, stribeck, finds_rest: as `preprocess` takes them.
        columns: as of `read_log`.
        loaded: the robot with what it carried in the log, if it carried something.
    """

    path: Path
    settings: PreprocessingConfig
    robot: Robot
    contacts: Sequence[Contact]
    required: SensorSet | None
    folder: Path | None
    motion_noise: Mapping[str, float] = field(default_factory=dict)
    sign_width: float | None = None
    stribeck: float | None = None
    finds_rest: bool = False
    columns: Columns | None = None
    loaded: Robot | None = None

    def samples(self, with_unloaded: bool = True) -> Samples:
        """What reading, preprocessing and binding the log as a whole would give.

        Args:
            with_unloaded: with the readings of contact sensors in the air, which only say what their offsets are.

        Raises:
            InputError: as `read_log`, `preprocess` and `bind_log` would, or the disk is full.

        Warns:
            TorchidWarning: as `preprocess` would.
        """
        needs_flags = self.settings.needs_flags
        with about_file(self.path), open_log_blocks(self.path, self.folder, self.columns, needs_flags) as opened:
            recorded = opened.about_world_origin()
            parts = self._pieces(recorded, len(recorded))
            recorded = bridge_in_blocks(recorded, self.settings.bridge_gaps_s, parts)
            self._check_welds(recorded)
            segmented = self._in_segments(self._standing(self._with_contacts(recorded)), with_unloaded)
            return self._samples(segmented, self._step(recorded, len(segmented.time)), segmented.kept)

    def samples_of(
        self,
        log: Log,
        certain: BoolArray,
        with_unloaded: bool = True,
        repaired: Log | None = None,
        drop: Callable[[Samples, bool], Samples] | None = None,
    ) -> Samples:
        """As `samples`, of a log in memory.

        Args:
            log: as recorded, with the flags that the settings want.
            certain: where these are, (N,).
            with_unloaded: as of `samples`.
            repaired: the log, as it is filtered; None for as recorded.
            drop: leaves out samples, of which it is told whether they depend on those beside them.
        """
        clean = log if repaired is None else repaired
        with about_file(log.source):
            derived = self._standing(_Derived(LogInMemory(clean), certain))
            segmented = self._in_segments(derived, with_unloaded, log)
            kept = segmented.kept
            samples = self._samples(segmented, len(segmented.time), kept if drop is None else None)
            if drop is None:
                return samples
            depend = segmented.longest.timeline is not None or segmented.noise.found
            samples = drop(samples, bool(depend))
            if kept is None:
                return samples
            away = np.isin(samples.time.numpy(), segmented.time[kept])
            _require_kept(away, self.path, self._checks_slip)
            return samples[torch.from_numpy(np.flatnonzero(away))]

    def _samples(self, segmented: _SegmentedLog, step: int, kept: BoolArray | None) -> Samples:
        """The samples that are kept (N,), all for None, of a log in blocks of at most so many."""
        pieces = list(segmented.pieces(step))
        count = len(segmented.time) if kept is None else int(np.count_nonzero(kept))
        stored = _Stored(str(self.path), self.folder, count)
        read = (segment.read(piece) for segment, piece in pieces)
        is_alone = self.folder is not None or len(pieces) == 1  # on a disk because memory is short
        with closing(_in_threads(partial(self._bound, segmented), read, 0 if is_alone else thread_count())) as bound:
            for piece, samples in bound:
                if segmented.longest.in_the_air is None:
                    samples = replace(samples, unloaded=None)
                if kept is not None:
                    samples = samples[torch.from_numpy(np.flatnonzero(kept[piece]))]
                samples = replace(samples, oversampling=segmented.oversampling, folder=self.folder)
                if len(pieces) == 1 and self.folder is None:
                    return samples
                stored.add(samples)
        return stored.samples()

    def _with_contacts(self, recorded: LogBlocks) -> _Derived:
        """The log with flags and zeros of contacts, each of which takes passes over it."""
        settings = self.settings
        out = self._flagged(recorded)
        if settings.zero_in_air:
            zeroed = zero_in_blocks(out.blocks, self.contacts, partial(self._pieces, recorded))
            out = replace(out, blocks=zeroed) if settings.contact_threshold is None else self._flagged(zeroed)
        return out

    def _standing(self, flagged: _Derived) -> _Derived:
        """The log with the pose of the base by its feet, if the settings want that; passes over the joints."""
        if self.settings.base_motion is None:
            return flagged
        pieces = partial(self._pieces, flagged.blocks)
        blocks, standing = base_pose_in_blocks(flagged.blocks, self.robot, self.contacts, pieces, self.folder)
        return replace(flagged, blocks=blocks, standing=standing)

    def _flagged(self, blocks: LogBlocks) -> _Derived:
        """The log with flags as recorded, from joint torques or from forces."""
        settings, rest = self.settings, (partial(self._pieces, blocks), self.folder)
        if settings.detect_contacts is not None and self.contacts:
            robot = self.robot if self.loaded is None else self.loaded
            found = detect_in_blocks(blocks, robot, self.contacts, settings.detect_contacts, *rest, self.sign_width)
            active, certain = found.flags(settings.takes_possible_contacts)
            return _Derived(with_flags(blocks, self.contacts, active), certain)
        if settings.contact_threshold is not None:
            return _Derived(*flag_by_force_in_blocks(blocks, settings.contact_threshold, *rest))
        return _Derived(blocks)

    def _in_segments(self, derived: _Derived, with_unloaded: bool, recorded: Log | None = None) -> _SegmentedLog:
        """What of a log must be known before its blocks can be worked on, which takes a pass or two over it.

        Args:
            derived: the log.
            with_unloaded: as of `samples`.
            recorded: its contacts before they were repaired, if they were.
        """
        blocks, settings, standing = derived.blocks, self.settings, derived.standing
        chosen = [slice(0, len(blocks))] if standing is None else standing.segments
        longest = max(chosen, key=lambda segment: segment.stop - segment.start)
        start = blocks if standing is None else blocks.part(longest)
        first = start.log if isinstance(start, LogInMemory) else start.read(slice(0, min(len(start), MOST_SAMPLES)))
        rates = settings.filter_hz, settings.sample_rate_hz, self.sign_width, self.stribeck, self.finds_rest
        whole = make_timeline(blocks.time, lacks_derivatives(first), *rates)
        noise = signal_noise(first, whole, self.motion_noise if standing is None else {})
        read = partial(start.read, only=("joint_position",))
        parts = ((start.time[piece], read(piece).joint_position) for piece in self._pieces(start, len(start)))
        whole = whole and with_sign_filter(whole, first, noise, parts)
        coverage = {} if whole is None else self._coverage(blocks, first, whole)
        contacts = None if first.contact_active is None else contacts_alone(blocks, partial(self._pieces, blocks))
        air = None if contacts is None or not with_unloaded else _in_the_air(contacts)
        if standing is None or whole is None:
            segments: tuple[_Segment, ...] = (_Segment(blocks, whole, 0, air),)
        else:
            segments = self._segments(blocks, standing, whole, air)
        time = np.concatenate([segment.time for segment in segments])
        segmented = _SegmentedLog(segments, coverage, time, noise=noise)
        if contacts is None:
            return segmented
        kept = self._kept(segmented, contacts if recorded is None else recorded, derived.certain)
        return replace(segmented, kept=kept)

    def _segments(
        self, blocks: LogBlocks, standing: PoseSegments, whole: Timeline, air: BoolArray | None
    ) -> tuple[_Segment, ...]:
        """The segments of a log with a pose that are long enough, each with its timeline; warns of the others."""
        out, first, settings = list[_Segment](), 0, self.settings
        usable = long_segments(blocks.time, standing.segments, whole)
        for segment in usable:
            part = blocks.part(segment)
            rates = settings.filter_hz, settings.sample_rate_hz, self.sign_width, self.stribeck, self.finds_rest
            timeline = make_timeline(part.time, True, *rates)
            if timeline is not None:
                timeline = with_signs_of(timeline, whole)
            out.append(_Segment(part, timeline, first, None if air is None else air[segment]))
            first += len(out[-1].time)
        too_short = count_samples(standing.segments) - count_samples(usable)
        warn_of_pose(blocks.source, len(blocks), standing, too_short)
        return tuple(out)

    def _kept(self, segmented: _SegmentedLog, contacts: Log, certain: BoolArray | None) -> BoolArray | None:
        """Which samples are kept, None for all: away from changes of contact, with flags that are certain, no slip."""
        settings, parts = self.settings, list[BoolArray]()
        if self._checks_slip:
            parts.append(self._standing_firmly(segmented, contacts))
        if settings.margin_s is not None and settings.detect_contacts is None:
            away = away_from_changes(contacts, segmented.time, settings.margin_s)
            parts += [] if away is None else [away]
        if certain is not None and not certain.all():
            parts.append(away_from_stamps(segmented.time, contacts.time[~certain], settings.margin_s or 0.0))
        kept = np.all(parts, axis=0) if parts else np.ones(1, dtype=bool)
        _require_kept(kept, self.path, self._checks_slip)
        return None if kept.all() else kept

    @property
    def _checks_slip(self) -> bool:
        return self.settings.max_slip is not None and bool(self.contacts)

    def _standing_firmly(self, segmented: _SegmentedLog, contacts: Log) -> BoolArray:
        """In which samples no contact slips, (N,), which takes a pass over the motion.

        Warns:
            TorchidWarning: as `warn_of_slip`.
        """
        settings, blocks = self.settings, segmented.longest.blocks
        motion = motion_fields(blocks, "contact_active", NORMALS)
        away = away_from_own_changes(contacts, segmented.time, self.contacts, settings.filter_hz)
        speeds = growing_array(self.path, self.folder, len(segmented.time))
        known = settings.base_motion is None
        for segment, piece in segmented.pieces(self._step(blocks, len(segmented.time))):
            log = segment.read(piece, motion).preprocessed(segmented.coverage)
            samples = bind_log(log, self.robot, self.contacts)
            base = base_velocity(log, samples) if known else None
            known = base is not None
            speeds.append(ground_speeds(samples, self.robot, self.contacts, base, away[piece]))
        slip = judge_speeds(speeds.array(), self.contacts, settings.slip_limit, not known and not self.robot.fixed_base)
        warn_of_slip(slip, blocks.source)
        return np.asarray(~slip.slips.any(axis=1))

    def _check_welds(self, blocks: LogBlocks) -> None:
        """Warn of joints that move though they are welded, which takes a pass over a log that has any."""
        first = blocks.read(slice(0, 1), only=("joint_position",))
        if self.robot.welded.keys().isdisjoint(first.joint_names):
            return
        logs = (blocks.read(piece, only=("joint_position",)) for piece in self._pieces(blocks, len(blocks)))
        warn_of_moving_welds(first, self.robot, np.max([distances_from_welds(log, self.robot) for log in logs], axis=0))

    def _step(self, blocks: LogBlocks, count: int) -> int:
        """How many samples of a log, or of so many that become of it, fit into memory."""
        if isinstance(blocks, LogInMemory):
            return count
        most = BLOCK_GB if self.folder is None else self.settings.memory_gb / _COPIES
        return max(SPLINE_BLOCK, int(most * GIGABYTE / blocks.row_bytes * count / len(blocks)))

    def _pieces(self, blocks: LogBlocks, count: int) -> Iterator[slice]:
        """The samples of a log, or of what becomes of them, in parts that fit into memory."""
        step = self._step(blocks, count)
        return (slice(start, min(start + step, count)) for start in range(0, count, step))

    def _coverage(self, blocks: LogBlocks, first: Log, timeline: Timeline) -> dict[str, Coverage]:
        """Which channels were measured throughout, which takes a pass over the log."""
        coverages = {name: Coverage.empty(getattr(first, name).shape[1:]) for name in gapless_fields(first, timeline)}
        for piece in self._pieces(blocks, len(blocks)) if coverages else ():
            log = blocks.read(piece, only=(*coverages, "contact_active"))
            for name, coverage in coverages.items():
                coverage.add(getattr(log, name), log.contact_active if name in CONTACT_READINGS else None)
        for name, coverage in coverages.items():
            warn_of_gaps(first, name, coverage)
        return coverages

    def _bound(self, segmented: _SegmentedLog, block: _RecordedBlock) -> tuple[slice, Samples]:
        """The numbers of a block's samples, and these; errors count from the beginning."""
        log = block.preprocessed(segmented.coverage)
        if block.timeline is not None and block.piece.start == segmented.longest.first:  # this block stands for all
            warn_of_noisy_accelerations(block.log, log, block.timeline, segmented.noise)
        if self.settings.base_motion is None:
            log = replace(log, motion_noise=segmented.noise)
        try:
            return block.piece, bind_log(log, self.robot, self.contacts, self.required)
        except LogError as error:
            if len(block.log) == len(segmented.longest.blocks):  # all of it
                raise
            raise count_samples_from(block.piece.start, error) from error


def _in_threads(
    bind: Callable[[_RecordedBlock], tuple[slice, Samples]], blocks: Iterator[_RecordedBlock], threads: int
) -> Generator[tuple[slice, Samples], None, None]:
    """What becomes of each block, in their order; they are read here, a few ahead of those that are worked on.

    Args:
        bind: called with each block, in the context of the caller.
        blocks: of a log.
        threads: that `bind` runs in, 0 for this one alone.
    """
    if not threads:
        yield from map(bind, blocks)
        return
    with one_thread(), ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        ahead: deque[Future[tuple[slice, Samples]]] = deque()
        try:
            for block in blocks:
                ahead.append(pool.submit(copy_context().run, bind, block))
                if len(ahead) > threads:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        finally:
            for future in ahead:
                future.cancel()


class _Stored:
    """Tensors of the samples of one log, by name and whether they are the base's, that grow block by block."""

    def __init__(self, source: str, folder: Path | None, count: int) -> None:
        self._source, self._folder, self._count = source, folder, count
        self._spills: dict[tuple[str, bool], Spill | Filled] = {}
        self._like: Samples | None = None  # the last block, for whatever is no tensor

    def add(self, samples: Samples) -> None:
        """Add the next samples."""
        for part, of_base in ((samples, False), (samples.base, True)):
            for name, x in vars(part).items():
                if isinstance(x, Tensor):
                    if (name, of_base) not in self._spills:
                        self._spills[name, of_base] = growing_array(self._source, self._folder, self._count)
                    self._spills[name, of_base].append(x.numpy())
        self._like = samples

    def samples(self) -> Samples:
        own: dict[str, Any] = {}
        base: dict[str, Tensor] = {}
        arrays = {key: spill.array() for key, spill in self._spills.items()}
        for (name, of_base), array in arrays.items():
            (base if of_base else own)[name] = torch.from_numpy(array)
        if self._like is None:
            raise ValueError("no samples")
        pages = None if self._folder is None else MappedPages(arrays.values())
        return replace(self._like, base=BaseMotion(**base), pages=pages, **own)


def _in_the_air(contacts: Log) -> BoolArray | None:
    """Which contacts are in the air for sure in which samples of the log, (N, C), None if none ever is."""
    if contacts.contact_active is None:
        return None
    unloaded = find_unloaded(contacts.time, contacts.contact_active)
    return unloaded if unloaded.any() else None


def _require_kept(kept: BoolArray, source: str | Path, checked_for_slip: bool) -> None:
    """Refuse a log none of whose samples (N,) are kept away from changes of contact and, if checked, from slip."""
    if kept.any():
        return
    found, accepted = "no sample away from changes of contact", "a smaller preprocessing.contact_margin_s"
    if checked_for_slip:
        found = f"{found} in which no contact slips"
        accepted = "a larger preprocessing.max_slip, or a smaller contact_margin_s"
    raise LogError(source, "contact_active", found, accepted)
