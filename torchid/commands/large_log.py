"""A log that is read, preprocessed and bound to a robot block by block."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from contextvars import copy_context
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchid.config.preprocessing import PreprocessingConfig
from torchid.errors import LogError, about_file
from torchid.logs import Columns, Log
from torchid.logs.blocks import GIGABYTE, LogBlocks, count_samples_from, open_log_blocks
from torchid.logs.coverage import Coverage, warn_of_gaps
from torchid.logs.log import CONTACT_READINGS, NORMALS, BoolArray, FloatArray
from torchid.logs.preprocess import (
    away_from_changes,
    find_unloaded,
    gapless_fields,
    lacks_derivatives,
    make_timeline,
    move_to_timeline,
    unloaded_readings,
)
from torchid.logs.rate_noise import warn_of_noisy_accelerations
from torchid.logs.signal_noise import MOST_SAMPLES, SignalNoise, signal_noise
from torchid.logs.spill import Filled, Spill, growing_array
from torchid.logs.timeline import SPLINE_BLOCK, Timeline
from torchid.problem import Samples, bind_log
from torchid.problem.base_motion import BaseMotion
from torchid.problem.chunks import one_thread
from torchid.problem.contact_slip import away_from_own_changes, base_velocity, ground_speeds, judge_speeds, warn_of_slip
from torchid.problem.samples import oversampling, require_forces
from torchid.problem.welded_joints import distances_from_welds, warn_of_moving_welds
from torchid.robot import Robot
from torchid.sensing import Contact, SensorSet

_COPIES = 16  # a block takes so many times the memory of its recorded arrays: derivatives, splines, bound tensors
_OF_MOTION = "joint_position", "joint_velocity", "joint_acceleration", "base_", "imu_", "contact_active", NORMALS
BLOCK_GB = 0.01
"""Recorded arrays of a block in memory; smaller ones spend more on the neighbourhood that a filter needs."""


def require_kept(kept: BoolArray, source: str | Path, checked_for_slip: bool) -> None:
    """Refuse a log none of whose samples (N,) are kept away from changes of contact and, if checked, from slip."""
    if kept.any():
        return
    found, accepted = "no sample away from changes of contact", "a smaller preprocessing.contact_margin_s"
    if checked_for_slip:
        found = f"{found} in which no contact slips"
        accepted = "a larger preprocessing.max_slip, or a smaller contact_margin_s"
    raise LogError(source, "contact_active", found, accepted)


@dataclass(frozen=True)
class LargeLog:
    """A log that is read, preprocessed and bound block by block, so that no more than its samples is in memory.

    Blocks are read one after the other; if the samples are held in memory, threads work on them.

    Attributes:
        path: its file.
        settings: of preprocessing.
        robot: whose log it is.
        contacts: in use.
        required: sensors whose every value must be there, None if gaps are allowed.
        folder: where there is room for the samples; None: in memory.
        motion_noise: of the recorded motion, as far as it is stated, as `preprocess` takes it.
        sign_width: as `preprocess` takes it.
        columns: as of `read_log`.
    """

    path: Path
    settings: PreprocessingConfig
    robot: Robot
    contacts: Sequence[Contact]
    required: SensorSet | None
    folder: Path | None
    motion_noise: Mapping[str, float] = field(default_factory=dict)
    sign_width: float | None = None
    columns: Columns | None = None

    def samples(self, with_unloaded: bool = True) -> Samples:
        """What reading, preprocessing and binding the log as a whole would give.

        Args:
            with_unloaded: with the readings of contact sensors in the air, which only say what their offsets are.

        Raises:
            InputError: as `read_log`, `preprocess` and `bind_log` would, or the disk is full.

        Warns:
            TorchidWarning: as `preprocess` would.
        """
        stored = _Stored(str(self.path), self.folder)
        self.each_block(stored.add, with_unloaded)
        return stored.samples()

    def each_block(
        self,
        add: Callable[[Samples, int, int], None],
        with_unloaded: bool = True,
        own: Callable[[Sequence[int]], slice] = lambda _: slice(None),
    ) -> None:
        """Read, preprocess and bind some successive blocks of the log; which ones makes no difference to their samples.

        Args:
            add: called with the samples of each block, the number of the first of them, and how many the log has.
            with_unloaded: as in `samples`.
            own: which of the log's blocks, from the numbers of their samples; all by default.
        """
        with about_file(self.path), open_log_blocks(self.path, self.folder, self.columns) as blocks:
            course = self._course(blocks, with_unloaded)
            pieces, kept = list(self._pieces(blocks, len(course.time))), course.kept
            mine = pieces[own([piece.stop - piece.start for piece in pieces])]
            start = mine[0].start if mine else 0
            row = start if kept is None else int(kept[:start].sum())
            total = len(course.time) if kept is None else int(kept.sum())
            course.follow_signs(start)
            threads = 0 if self.folder is not None else torch.get_num_threads()  # on a disk because memory is short
            read = (_read_block(blocks, piece, course.timeline, course.in_the_air) for piece in mine)
            with closing(_in_threads(partial(self._bound, course), read, threads)) as bound:
                for piece, samples in bound:
                    if course.in_the_air is None:
                        samples = replace(samples, unloaded=None)
                    if kept is not None:
                        samples = samples[torch.from_numpy(np.flatnonzero(kept[piece]))]
                    add(replace(samples, oversampling=course.oversampling, folder=self.folder), row, total)
                    row += len(samples)

    def _course(self, blocks: LogBlocks, with_unloaded: bool) -> _Course:
        """What of a log must be known before its blocks can be worked on, which takes a pass or two over it."""
        first, settings = blocks.read(slice(0, min(len(blocks), MOST_SAMPLES))), self.settings
        self._check_welds(blocks, first)
        rates = settings.filter_hz, settings.sample_rate_hz
        timeline = make_timeline(blocks.time, lacks_derivatives(first), *rates, self.sign_width)
        coverage = {} if timeline is None else self._coverage(blocks, first, timeline)
        time = blocks.time if timeline is None else blocks.time[0] + timeline.output_stamps
        contacts = self._contacts(blocks, first)
        kept = None if contacts is None else self._away_from_changes(contacts, time)
        in_the_air = None if contacts is None or not with_unloaded else _in_the_air(contacts)
        noise = signal_noise(first, timeline, self.motion_noise)
        course = _Course(blocks, timeline, coverage, time, kept, in_the_air, noise)
        if settings.max_slip is None or contacts is None or not self.contacts:
            return course
        stands = self._standing_firmly(course, contacts)
        kept = stands if kept is None else kept & stands
        require_kept(kept, self.path, checked_for_slip=True)
        return replace(course, kept=None if kept.all() else kept)

    def _standing_firmly(self, course: _Course, contacts: Log) -> BoolArray:
        """In which samples no contact slips, (N,), which takes a pass over the motion.

        Warns:
            TorchidWarning: as `warn_of_slip`.
        """
        settings, blocks, bare = self.settings, course.blocks, replace(course, in_the_air=None)
        motion = tuple(name for name in blocks.fields if name.startswith(_OF_MOTION))
        away = away_from_own_changes(contacts, course.time, self.contacts, settings.filter_hz)
        speeds = growing_array(self.path, self.folder, len(course.time))
        relative = not self.robot.fixed_base
        for piece in self._pieces(blocks, len(course.time)):
            block = _read_block(blocks, piece, course.timeline, None, motion)
            log = self._moved(bare, block)
            samples = bind_log(log, self.robot, self.contacts)
            base = base_velocity(log, samples)
            relative = relative and base is None
            speeds.append(ground_speeds(samples, self.robot, self.contacts, base, away[piece]))
        slip = judge_speeds(speeds.array(), self.contacts, settings.slip_limit, relative)
        warn_of_slip(slip, blocks.source)
        return np.asarray(~slip.slips.any(axis=1))

    def _check_welds(self, blocks: LogBlocks, first: Log) -> None:
        """Warn of joints that move though they are welded, which takes a pass over a log that has any."""
        if self.robot.welded.keys().isdisjoint(first.joint_names):
            return
        logs = (blocks.read(piece, only=("joint_position",)) for piece in self._pieces(blocks, len(blocks)))
        warn_of_moving_welds(first, self.robot, np.max([distances_from_welds(log, self.robot) for log in logs], axis=0))

    def _pieces(self, blocks: LogBlocks, count: int) -> Iterator[slice]:
        """The samples of a log, or of what becomes of them, in parts that fit into memory."""
        most = BLOCK_GB if self.folder is None else self.settings.memory_gb / _COPIES
        rows = most * GIGABYTE / blocks.row_bytes * count / len(blocks)
        step = max(SPLINE_BLOCK, int(rows))
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

    def _contacts(self, blocks: LogBlocks, first: Log) -> Log | None:
        """The log with nothing but the contacts' flags, which takes a pass over it; None if there are none."""
        if first.contact_active is None:
            return None
        flags = [
            blocks.read(piece, only=("contact_active",)).contact_active for piece in self._pieces(blocks, len(blocks))
        ]
        nothing = np.empty((len(blocks), 0))
        active = np.concatenate([x for x in flags if x is not None])
        return Log(blocks.source, blocks.time, (), nothing, contact_names=first.contact_names, contact_active=active)

    def _away_from_changes(self, contacts: Log, time: FloatArray) -> BoolArray | None:
        """Which samples are further than the margin from changes of contact, None for all."""
        margin = self.settings.contact_margin_s
        return None if margin is None else away_from_changes(contacts, time, margin)

    def _moved(self, course: _Course, block: _Block) -> Log:
        """A block of the preprocessed log."""
        return block.log if block.timeline is None else move_to_timeline(block.log, block.timeline, course.coverage)

    def _bound(self, course: _Course, block: _Block) -> tuple[slice, Samples]:
        """The numbers of a block's samples, and these; errors count from the beginning."""
        log = self._moved(course, block)
        if block.timeline is not None and not block.piece.start:  # the first block stands for all
            warn_of_noisy_accelerations(block.log, log, block.timeline, course.noise)
        samples = bind_log(replace(log, motion_noise=course.noise), self.robot, self.contacts)
        if self.required is not None:
            try:
                require_forces(samples, self.robot, self.contacts, self.required)
            except LogError as error:
                raise count_samples_from(block.piece.start, error) from error
        return block.piece, samples


@dataclass(frozen=True)
class _Course:
    """What is known of a whole log before its blocks are worked on; `kept`: which samples, None for all."""

    blocks: LogBlocks
    timeline: Timeline | None
    coverage: Mapping[str, Coverage]
    time: FloatArray
    kept: BoolArray | None
    in_the_air: BoolArray | None
    noise: SignalNoise

    @property
    def oversampling(self) -> float:
        """Samples per independent sample of noise."""
        return oversampling(self.time, None if self.timeline is None else self.timeline.bandwidth_hz)

    def follow_signs(self, start: int) -> None:
        """Read quaternions up to a sample of the preprocessed log, whose signs go on from those."""
        names = tuple(name for name in ("base_quat_xyzw", "base_quat_wxyz") if name in self.blocks.fields)
        end = start if self.timeline is None or not start else self.timeline.part(start, start + 1)[0].start
        step = max(SPLINE_BLOCK, int(BLOCK_GB * GIGABYTE / 32))
        for first in range(0, end, step) if names else ():
            self.blocks.read(slice(first, min(first + step, end)), only=names)


def _in_the_air(contacts: Log) -> BoolArray | None:
    """Which contacts are in the air for sure in which samples of the log, None if none ever is."""
    if contacts.contact_active is None:
        return None
    unloaded = find_unloaded(contacts.time, contacts.contact_active)
    return unloaded if unloaded.any() else None


@dataclass(frozen=True)
class _Block:
    """A part of the samples of a preprocessed log: their numbers, and what they are made of, as it was recorded."""

    piece: slice
    log: Log
    timeline: Timeline | None


def _read_block(
    blocks: LogBlocks,
    piece: slice,
    timeline: Timeline | None,
    in_the_air: BoolArray | None,
    only: tuple[str, ...] | None = None,
) -> _Block:
    """What a part of the preprocessed log depends on; `only` as of `LogBlocks.read`."""
    samples, part = (piece, None) if timeline is None else timeline.part(piece.start, piece.stop)
    log = blocks.read(samples, only)
    if in_the_air is not None:
        log = replace(log, contact_unloaded=unloaded_readings(log, in_the_air[samples]))
    return _Block(piece, log, part)


def _in_threads(
    bind: Callable[[_Block], tuple[slice, Samples]], blocks: Iterator[_Block], threads: int
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

    def __init__(self, source: str, folder: Path | None) -> None:
        self._source, self._folder = source, folder
        self._spills: dict[tuple[str, bool], Spill | Filled] = {}
        self._like: Samples | None = None  # the last block, for whatever is no tensor

    def add(self, samples: Samples, _: int, total: int) -> None:
        """Add the next of so many samples."""
        for part, of_base in ((samples, False), (samples.base, True)):
            for name, x in vars(part).items():
                if isinstance(x, Tensor):
                    if (name, of_base) not in self._spills:
                        self._spills[name, of_base] = growing_array(self._source, self._folder, total)
                    self._spills[name, of_base].append(x.numpy())
        self._like = samples

    def samples(self) -> Samples:
        """All of them."""
        own: dict[str, Any] = {}
        base: dict[str, Tensor] = {}
        for (name, of_base), spill in self._spills.items():
            (base if of_base else own)[name] = torch.from_numpy(spill.array())
        if self._like is None:
            raise ValueError("no samples")
        return replace(self._like, base=BaseMotion(**base), **own)
