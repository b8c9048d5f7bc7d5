"""Logs on their way from files to a robot's samples, block by block where they are larger than memory."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from contextvars import copy_context
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchid import ranks
from torchid.config.experiment import PreprocessingConfig
from torchid.config.logs import require_apart
from torchid.errors import LogError, about_file
from torchid.fitting.experiment import Scene
from torchid.log_checks import Checked, drop_condemned
from torchid.log_checks.check import check
from torchid.logs import Log, read_log
from torchid.logs.blocks import GIGABYTE, LogBlocks, count_samples_from, log_bytes, open_log_blocks
from torchid.logs.containers import LogKind, existing_log_kind
from torchid.logs.log import WRENCHES, BoolArray, FloatArray
from torchid.logs.preprocess import (
    Coverage,
    away_from_changes,
    find_unloaded,
    gapless_fields,
    lacks_derivatives,
    make_timeline,
    move_to_timeline,
    preprocess,
    unloaded_readings,
    warn_of_gaps,
)
from torchid.logs.spill import Filled, Spill
from torchid.logs.time_range import LogPart, share_samples, split_range
from torchid.logs.timeline import SPLINE_BLOCK, Timeline
from torchid.problem import Samples, bind_log
from torchid.problem.base_motion import BaseMotion
from torchid.problem.chunks import one_thread
from torchid.problem.samples import oversampling, require_forces
from torchid.robot import Robot
from torchid.sensing import Contact, SensorSet

_COPIES = 16  # a block takes so many times the memory of its recorded arrays: derivatives, splines, bound tensors
_BLOCK_GB = 0.01  # recorded arrays of a block; smaller ones spend more on the neighbourhood that a filter needs
_WHOLE_GB = 4.0 * _BLOCK_GB  # recorded arrays that are taken whole: no block is worth its neighbourhood


class LogReader:
    """Reads, preprocesses and binds logs; each on its own, so that nothing is differentiated across a seam.

    Logs whose arrays together take more than the memory they may take are kept on the disk from then on, all but bags.

    Attributes:
        scene: robot, contacts and settings.
        folder: on whose disk logs are kept.
        excluded: how many samples of each log were left out because they are condemned, by path.
    """

    def __init__(self, scene: Scene, folder: Path | None = None) -> None:
        """Nothing is read yet; without a `folder` it is the one that the output of the scene goes to."""
        self.scene = scene
        self.folder = _folder_beside(scene.config.output) if folder is None else folder
        self.excluded: dict[str, int] = {}
        self._held = 0.0  # arrays of logs in memory [GB]

    def read(
        self, paths: Sequence[Path], required: SensorSet | None, on_read: Callable[[Path], None] | None = None
    ) -> list[Samples]:
        """The samples of log files.

        Args:
            paths: log files.
            required: sensors that must have been recorded.
            on_read: called after each file.

        Raises:
            LogError: a file that cannot be read, or does not fit the robot.
        """
        limit, logs = self.scene.config.preprocessing.memory_gb, []
        for path in paths:
            together = self._together(path)
            bag = existing_log_kind(path) is LogKind.BAG
            large = together > limit and not bag
            logs.append(self._samples(path, required, together if large else None))
            if not large:
                self._held = together + (logs[-1].nbytes / GIGABYTE if bag else 0.0)
            if on_read is not None:
                on_read(path)
        names = ranks.as_first([log.source for log in logs], "names of the logs")  # they may lie elsewhere there
        return [log if log.source == name else replace(log, source=name) for log, name in zip(logs, names, strict=True)]

    def _together(self, path: Path) -> float:
        """What a log takes in memory with those before it [GB]."""
        return memory_needed(path, self.scene.config.preprocessing.memory_gb, self._held)

    def _samples(self, path: Path, required: SensorSet | None, together: float | None) -> Samples:
        """The samples of a log; `together`: what it takes with those before it [GB], if that is too much."""
        return self._small(path, required) if together is None else self._large(path, required, together)

    def _small(self, path: Path, required: SensorSet | None) -> Samples:
        """A log that fits into memory."""
        settings, files = self.scene.config.preprocessing, self.scene.config.logs
        if not settings.exclude_condemned and log_bytes(path, GIGABYTE * _WHOLE_GB) > GIGABYTE * _WHOLE_GB:
            return self._in_blocks(path, required, None)
        topics = None if files is None else files.topics
        recorded = read_log(path, topics, allow_gaps=settings.exclude_condemned)
        checked = self._checked(recorded)
        clean = recorded if checked is None else checked.repaired
        log = preprocess(clean, settings.cutoff_hz, settings.sample_rate_hz)
        samples = bind_log(log, self.scene.robot, self.scene.contacts, required)
        if not fits_contact_offsets(self.scene):
            samples = replace(samples, unloaded=None)
        if checked is not None:
            count = len(samples)
            samples = drop_condemned(samples, checked, settings.cutoff_hz, derived=log is not clean)
            self.excluded[str(path)] = count - len(samples)
        if settings.contact_margin_s is None:
            return samples
        kept = away_from_changes(recorded, samples.time.numpy(), settings.contact_margin_s)
        return samples if kept is None else samples[torch.from_numpy(np.flatnonzero(kept))]

    def _large(self, path: Path, required: SensorSet | None, together: float) -> Samples:
        """A log that does not, with those before it [GB]."""
        settings = self.scene.config.preprocessing
        if settings.exclude_condemned:
            found = f"set for arrays of {together:.2g} GB, which are not in memory at once"
            accepted = f"a preprocessing.memory_gb above {together:.2g}, or parts of the logs that torchid check passes"
            raise LogError(path, "preprocessing.exclude_condemned", found, accepted)
        return self._in_blocks(path, required, self.folder)

    def _in_blocks(self, path: Path, required: SensorSet | None, folder: Path | None) -> Samples:
        """A log that is read block by block."""
        scene = self.scene
        log = LargeLog(path, scene.config.preprocessing, scene.robot, scene.contacts, required, folder)
        return log.samples(fits_contact_offsets(scene))

    def _checked(self, log: Log) -> Checked | None:
        """What the checks of a log say, if condemned samples are to be left out."""
        settings = self.scene.config.preprocessing
        if not settings.exclude_condemned:
            return None
        return check(log, self.scene.robot, self.scene.contacts, settings.cutoff_hz)


def check_parts(logs: Mapping[str, Sequence[Samples]]) -> None:
    """Make sure that no sample has two uses, of parts of logs of which the experiment file alone does not say.

    Args:
        logs: by their key in `logs`.

    Raises:
        ConfigError: as `require_apart`.

    Warns:
        TorchidWarning: likewise.
    """
    parts = {key: [split_range(log.source) for log in of_key] for key, of_key in logs.items()}
    spans = {split_range(log.source): log.time[[0, -1]].tolist() for of_key in logs.values() for log in of_key}

    def share(one: LogPart, other: LogPart) -> bool:
        (start, stop), (of_other, until) = spans[one], spans[other]
        return share_samples(one.range, other.range) is None and start <= until and of_other <= stop

    require_apart(parts, share)


def fits_contact_offsets(scene: Scene) -> bool:
    """Whether offsets of contact sensors are fitted, the only use of their readings in the air."""
    return any(channel.startswith("contact") for channel in scene.terms.offsets)


def memory_needed(path: Path, memory_gb: float, held: float = 0.0) -> float:
    """What the arrays of a log take together with those that are held [GB]; at most that, where that is in `memory_gb`.

    A bag counts as nothing: its size is known when it has been read.

    Raises:
        LogError: the file cannot be read.
    """
    return held + log_bytes(path, GIGABYTE * (memory_gb - held)) / GIGABYTE


def _folder_beside(output: Path) -> Path:
    """The folder that a run goes to, or the nearest above it that exists already."""
    return next((folder for folder in output.absolute().parents if folder.is_dir()), Path.cwd())


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
    """

    path: Path
    settings: PreprocessingConfig
    robot: Robot
    contacts: Sequence[Contact]
    required: SensorSet | None
    folder: Path | None

    def samples(self, with_unloaded: bool = True) -> Samples:
        """What reading, preprocessing and binding the log as a whole would give.

        Args:
            with_unloaded: with the readings of contact sensors in the air, which only say what their offsets are.

        Raises:
            InputError: as `read_log`, `preprocess` and `bind_log` would, or the disk is full.

        Warns:
            TorchidWarning: as `preprocess` would.
        """
        with about_file(self.path), open_log_blocks(self.path, self.folder) as blocks:
            first, settings = blocks.read(slice(0, min(len(blocks), 2))), self.settings
            derived = lacks_derivatives(first)
            timeline = make_timeline(blocks.time, derived, settings.cutoff_hz, settings.sample_rate_hz)
            coverage = {} if timeline is None else self._coverage(blocks, first, timeline)
            time = blocks.time if timeline is None else blocks.time[0] + timeline.output_stamps
            contacts = self._contacts(blocks, first)
            kept = None if contacts is None else self._away_from_changes(contacts, time)
            in_the_air = None if contacts is None or not with_unloaded else _in_the_air(contacts)
            stored = _Stored(blocks.source, self.folder, len(time) if kept is None else int(kept.sum()))
            threads = 0 if self.folder is not None else torch.get_num_threads()  # on a disk because memory is short
            read = (_read_block(blocks, piece, timeline, in_the_air) for piece in self._pieces(blocks, len(time)))
            with closing(_in_threads(partial(self._bound, coverage), read, threads)) as bound:
                for piece, samples in bound:
                    if in_the_air is None:
                        samples = replace(samples, unloaded=None)
                    stored.add(samples, None if kept is None else np.flatnonzero(kept[piece]))
            bandwidth = None if timeline is None else timeline.bandwidth_hz
            return stored.samples(samples, oversampling(time, bandwidth))

    def _pieces(self, blocks: LogBlocks, count: int) -> Iterator[slice]:
        """The samples of a log, or of what becomes of them, in parts that fit into memory."""
        most = _BLOCK_GB if self.folder is None else self.settings.memory_gb / _COPIES
        rows = most * GIGABYTE / blocks.row_bytes * count / len(blocks)
        step = max(SPLINE_BLOCK, int(rows))
        return (slice(start, min(start + step, count)) for start in range(0, count, step))

    def _coverage(self, blocks: LogBlocks, first: Log, timeline: Timeline) -> dict[str, Coverage]:
        """Which channels were measured throughout, which takes a pass over the log."""
        coverages = {name: Coverage.empty(getattr(first, name).shape[1:]) for name in gapless_fields(first, timeline)}
        for piece in self._pieces(blocks, len(blocks)) if coverages else ():
            log = blocks.read(piece, only=(*coverages, "contact_active"))
            for name, coverage in coverages.items():
                coverage.add(getattr(log, name), log.contact_active if name in WRENCHES else None)
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

    def _bound(self, coverage: Mapping[str, Coverage], block: _Block) -> tuple[slice, Samples]:
        """The numbers of a block's samples, and these; errors count from the beginning."""
        log = block.log if block.timeline is None else move_to_timeline(block.log, block.timeline, coverage)
        samples = bind_log(log, self.robot, self.contacts)
        if self.required is not None:
            try:
                require_forces(samples, self.robot, self.contacts, self.required)
            except LogError as error:
                raise count_samples_from(block.piece.start, error) from error
        return block.piece, samples


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


def _read_block(blocks: LogBlocks, piece: slice, timeline: Timeline | None, in_the_air: BoolArray | None) -> _Block:
    """What a part of the preprocessed log depends on."""
    samples, part = (piece, None) if timeline is None else timeline.part(piece.start, piece.stop)
    log = blocks.read(samples)
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
    """Tensors of the samples of one log, by name and whether they are the base's, that grow part by part."""

    def __init__(self, source: str, folder: Path | None, samples: int) -> None:
        self._folder = folder
        grow: Callable[[], Spill | Filled] = (
            partial(Filled, samples) if folder is None else partial(Spill, source, folder)
        )
        self._spills: defaultdict[tuple[str, bool], Spill | Filled] = defaultdict(grow)

    def add(self, samples: Samples, kept: np.ndarray | None) -> None:
        """Add samples, or those of some numbers."""
        for part, of_base in ((samples, False), (samples.base, True)):
            for name, x in vars(part).items():
                if isinstance(x, Tensor):
                    values = x.numpy()
                    self._spills[name, of_base].append(values if kept is None else values[kept])

    def samples(self, like: Samples, oversampling: float) -> Samples:
        """All of them, with whatever else belongs to samples `like` the last ones."""
        own: dict[str, Any] = {}
        base: dict[str, Tensor] = {}
        for (name, of_base), spill in self._spills.items():
            (base if of_base else own)[name] = torch.from_numpy(spill.array())
        return replace(like, base=BaseMotion(**base), oversampling=oversampling, folder=self._folder, **own)
