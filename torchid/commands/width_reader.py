"""Training logs with one width of friction's sign after the other, read once where only that depends on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchid.commands.reading import LogReader
from torchid.errors import about_file
from torchid.fitting.experiment import Scene
from torchid.logs import Log
from torchid.logs.log import FloatArray
from torchid.logs.preprocess import directions, lacks_derivatives, make_timeline
from torchid.problem import Samples
from torchid.problem.log_joints import columns_in_order
from torchid.problem.samples import joint_order
from torchid.sensing import SensorSet


@dataclass(frozen=True)
class _Directions:
    """What the filter makes of the sign of a log's joint velocities, by the width of the sign.

    `stamps`: (K,) of the preprocessed log [s]; `order`: columns of the robot's joints.
    """

    stamps: FloatArray
    order: list[int]
    by_width: Callable[[float | None], FloatArray | None]

    def of(self, samples: Samples, width: float | None) -> Tensor | None:
        """Those of some of the samples."""
        found = self.by_width(width)
        if found is None:
            return None
        return torch.from_numpy(columns_in_order(found[np.searchsorted(self.stamps, samples.time.numpy())], self.order))


class WidthReader(LogReader):
    """Reads logs that fit into memory once for all widths; others anew for each, since the filter comes after friction.

    So are logs whose base moves as the feet say: they are filtered in stretches.
    """

    def __init__(self, scene: Scene) -> None:
        """Nothing is read yet."""
        super().__init__(scene)
        self._directions: dict[str, _Directions] = {}
        self._logs: list[Samples] | None = None

    def logs(self, width: float | None, required: SensorSet | None) -> list[Samples]:
        """The training logs as `read` gives them with a width; with the same `required` at each call."""
        files, actuators = self.scene.config.logs, self.scene.config.actuators
        if self._logs is None or len(self._directions) < len(self._logs):
            config = replace(self.scene.config, actuators=replace(actuators, sign_width=width))
            self.scene, self._directions = replace(self.scene, config=config), {}
            self._logs = self.read(files.train if files else [], required)
            return self._logs
        return [replace(log, direction=self._directions[log.source].of(log, width)) for log in self._logs]

    def _preprocessed(self, clean: Log) -> Log:
        log, settings = super()._preprocessed(clean), self.scene.config.preprocessing
        if settings.base_motion is None:
            rates = settings.filter_hz, settings.sample_rate_hz
            with about_file(log.source):
                timeline = make_timeline(clean.time, lacks_derivatives(clean), *rates)
            by_width = (lambda _: None) if timeline is None else directions(clean, timeline)
            self._directions[log.source] = _Directions(log.time, joint_order(log, self.scene.robot), by_width)
        return log
