"""Logs on their way from files to a robot's samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from torchid.errors import LogError
from torchid.hygiene import Checked, check, without_condemned
from torchid.logs import Log, preprocess, read_log
from torchid.logs.blocks import GIGABYTE, size_of
from torchid.logs.kinds import Kind, kind_to_read
from torchid.logs.transitions import away_from_changes
from torchid.problem import Samples, bind
from torchid.run.experiment import Scene
from torchid.run.large_logs import LargeLog
from torchid.sensing import SensorSet


def gigabytes(path: Path, memory_gb: float, held: float = 0.0) -> float:
    """What the arrays of a log take together with those that are held [GB]; at most that, where that is in `memory_gb`.

    A bag counts as nothing: its size is known when it has been read.

    Raises:
        LogError: the file cannot be read.
    """
    return held + size_of(path, GIGABYTE * (memory_gb - held)) / GIGABYTE


def _folder_beside(output: Path) -> Path:
    """The folder that a run goes to, or the nearest above it that exists already."""
    return next((folder for folder in output.absolute().parents if folder.is_dir()), Path.cwd())


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
            together = gigabytes(path, limit, self._held)
            if kind_to_read(path) is Kind.BAG:
                logs.append(self._small(path, required))
                self._held += logs[-1].nbytes / GIGABYTE
            elif together <= limit:
                logs.append(self._small(path, required))
                self._held = together
            else:
                logs.append(self._large(path, required, together))
            if on_read is not None:
                on_read(path)
        return logs

    def _small(self, path: Path, required: SensorSet | None) -> Samples:
        """A log that fits into memory."""
        settings, files = self.scene.config.preprocessing, self.scene.config.logs
        topics = None if files is None else files.topics
        recorded = read_log(path, topics, allow_gaps=settings.exclude_condemned)
        checked = self._checked(recorded)
        clean = recorded if checked is None else checked.repaired
        log = preprocess(clean, settings.cutoff_hz, settings.sample_rate_hz)
        samples = bind(log, self.scene.robot, self.scene.contacts, required)
        if checked is not None:
            count = len(samples)
            samples = without_condemned(samples, checked, settings.cutoff_hz, derived=log is not clean)
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
        return LargeLog(path, settings, self.scene.robot, self.scene.contacts, required, self.folder).samples()

    def _checked(self, log: Log) -> Checked | None:
        """What the checks of a log say, if condemned samples are to be left out."""
        settings = self.scene.config.preprocessing
        if not settings.exclude_condemned:
            return None
        return check(log, self.scene.robot, self.scene.contacts, settings.cutoff_hz)
