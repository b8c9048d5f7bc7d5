"""Logs larger than memory: read, preprocessed and bound block by block, and kept on a disk."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchid.config.experiment import PreprocessingConfig
from torchid.errors import LogError
from torchid.logs import Log
from torchid.logs.blocks import GIGABYTE, Blocks, counted_from, open_blocks
from torchid.logs.fields import WRENCHES, BoolArray, FloatArray
from torchid.logs.measured import Coverage, check_coverage
from torchid.logs.preprocess import differentiates, gapless_fields, on_timeline, timeline_of
from torchid.logs.spill import Spill
from torchid.logs.spline import BLOCK
from torchid.logs.timeline import Timeline
from torchid.logs.transitions import away_from_changes, unloaded, unloaded_readings
from torchid.problem import Samples, bind
from torchid.problem.base_motion import BaseMotion
from torchid.problem.samples import check_forces, oversampling
from torchid.robot import Robot
from torchid.sensing import Contact, SensorSet

_COPIES = 16  # a block takes so many times the memory of its recorded arrays: derivatives, splines, bound tensors


@dataclass(frozen=True)
class LargeLog:
    """A log whose samples go to a disk on their way to a robot.

    Attributes:
        path: its file.
        settings: of preprocessing.
        robot: whose log it is.
        contacts: in use.
        required: sensors whose every value must be there, None if gaps are allowed.
        folder: where there is room.
    """

    path: Path
    settings: PreprocessingConfig
    robot: Robot
    contacts: Sequence[Contact]
    required: SensorSet | None
    folder: Path

    def samples(self) -> Samples:
        """What reading, preprocessing and binding the log as a whole would give, on the disk.

        Raises:
            InputError: as `read_log`, `preprocess` and `bind` would, or the disk is full.

        Warns:
            TorchidWarning: as `preprocess` would.
        """
        with open_blocks(self.path, self.folder) as blocks:
            first, settings = blocks.read(slice(0, min(len(blocks), 2))), self.settings
            derived = differentiates(first)
            timeline = timeline_of(blocks.source, blocks.time, derived, settings.cutoff_hz, settings.sample_rate_hz)
            coverage = {} if timeline is None else self._coverage(blocks, first, timeline)
            time = blocks.time if timeline is None else blocks.time[0] + timeline.at
            contacts = self._contacts(blocks, first)
            kept = None if contacts is None else self._away_from_changes(contacts, time)
            in_the_air = None if contacts is None else _in_the_air(contacts)
            stored = _Stored(blocks.source, self.folder)
            for piece in self._pieces(blocks, len(time)):
                samples = self._bound(_preprocessed(blocks, piece, timeline, coverage, in_the_air), piece)
                if in_the_air is None:
                    samples = replace(samples, unloaded=None)
                stored.add(samples, None if kept is None else np.flatnonzero(kept[piece]))
            bandwidth = None if timeline is None else timeline.bandwidth_hz
            return stored.samples(samples, oversampling(time, bandwidth))

    def _pieces(self, blocks: Blocks, count: int) -> Iterator[slice]:
        """The samples of a log, or of what becomes of them, in parts that fit into memory."""
        rows = self.settings.memory_gb * GIGABYTE / (_COPIES * blocks.row_bytes) * count / len(blocks)
        step = max(BLOCK, int(rows))
        for start in range(0, count, step):
            yield slice(start, min(start + step, count))

    def _coverage(self, blocks: Blocks, first: Log, timeline: Timeline) -> dict[str, Coverage]:
        """Which channels were measured throughout, which takes a pass over the log."""
        found = {name: Coverage.of(getattr(first, name).shape[1:]) for name in gapless_fields(first, timeline)}
        for piece in self._pieces(blocks, len(blocks)) if found else ():
            log = blocks.read(piece, only=(*found, "contact_active"))
            for name, coverage in found.items():
                coverage.add(getattr(log, name), log.contact_active if name in WRENCHES else None)
        for name, coverage in found.items():
            check_coverage(first, name, coverage)
        return found

    def _contacts(self, blocks: Blocks, first: Log) -> Log | None:
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

    def _bound(self, log: Log, piece: slice) -> Samples:
        """The samples of a part; errors count from the beginning."""
        samples = bind(log, self.robot, self.contacts)
        if self.required is not None:
            try:
                check_forces(samples, self.robot, self.contacts, self.required)
            except LogError as error:
                raise counted_from(piece.start, error) from error
        return samples


def _in_the_air(contacts: Log) -> BoolArray | None:
    """Which contacts are in the air for sure in which samples of the log, None if none ever is."""
    if contacts.contact_active is None:
        return None
    found = unloaded(contacts.time, contacts.contact_active)
    return found if found.any() else None


def _preprocessed(
    blocks: Blocks,
    piece: slice,
    timeline: Timeline | None,
    coverage: Mapping[str, Coverage],
    in_the_air: BoolArray | None,
) -> Log:
    """A part of the preprocessed log."""
    samples, part = (piece, None) if timeline is None else timeline.part(piece.start, piece.stop)
    log = blocks.read(samples)
    if in_the_air is not None:
        log = replace(log, contact_unloaded=unloaded_readings(log, in_the_air[samples]))
    return log if part is None else on_timeline(log, part, coverage)


class _Stored:
    """Tensors of the samples of one log, by name and whether they are the base's, that grow part by part."""

    def __init__(self, source: str, folder: Path) -> None:
        self._folder = folder
        self._spills: defaultdict[tuple[str, bool], Spill] = defaultdict(partial(Spill, source, folder))

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
