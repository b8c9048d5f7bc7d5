"""Equations of sensors whose contact is in the air: they read their offsets, whatever the robot weighs.

With nothing to touch, the force s y - o that a reading y stands for is 0. What hangs between such a sensor and the
ground counts as part of its offset: a sensor above a heavy foot is one in a limb.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples

_FEWEST, _BATCHES = 16, 8  # readings that make an equation, and in how many their slow changes show
_ZEROS = 0.01  # share of readings that are exactly 0 from which on something else than a sensor has written them,
_ONE_SIDED = 0.05  # unless both signs are at least this frequent: then 0 is one step of a coarse sensor among others
_OUTLYING = 4.0  # standard deviations; of Gaussian readings 6e-5 are left out
_NORMAL = 0.6745  # median of |x| of standard normal x


@dataclass(frozen=True)
class UnloadedChannel:
    """What some samples say of the unknown offset of a contact sensor's channel.

    Attributes:
        offset: its number among the extras.
        scale: number of the channel's unknown scale, None if that is known.
        gated: whether readings in the air are exactly 0, as masked, clamped or missing ones are: no equation.
        mean: of the readings, outliers left out [N, N m].
        deviation: standard deviation of the mean, that of independent readings with the stated noise, or more if they
            scatter more, one by one or over longer spans of time.
    """

    offset: int
    scale: int | None
    gated: bool = False
    mean: float = 0.0
    deviation: float = 1.0

    def row(self, builder: RowBuilder) -> tuple[tuple[int, ...], Tensor]:
        """The whitened equation `o - (s - 1) mean = mean` as a block of one row: its columns, and (1, columns + 1).

        The scale's column holds the mean, for the noise of single readings would pull the scale to 0.
        """
        first, row = builder.columns.count, [1.0, self.mean]
        columns: tuple[int, ...] = (first + self.offset,)
        if self.scale is not None:
            columns, row = (*columns, first + self.scale), [1.0, -self.mean, self.mean]
        like = builder.tree.ancestors
        return columns, torch.tensor([row], dtype=like.dtype, device=like.device) / self.deviation


def unloaded_channels(builder: RowBuilder, samples: Samples) -> Iterator[UnloadedChannel]:
    """What the readings in the air among some samples of a log say of every offset that is unknown."""
    if samples.unloaded is None:
        return
    scales = {x.contact: number for number, x in enumerate(builder.extras) if x.what == "scale" and x.contact}
    noise = builder.sensors.noise.wrench.tolist()
    for number, extra in enumerate(builder.extras):
        if extra.what != "offset" or extra.contact is None:
            continue
        contact, axis = extra.contact
        y = samples.unloaded[:, contact, axis]
        y = y[torch.isfinite(y)]
        if len(y) < _FEWEST:
            continue
        if _gated(y):
            yield UnloadedChannel(number, None, gated=True)
        else:
            mean, deviation = _mean(y, noise[axis], samples.oversampling)
            yield UnloadedChannel(number, scales.get(extra.contact), False, mean, deviation)


def _gated(y: Tensor) -> bool:
    above, below = ((y > 0.0).double().mean(), (y < 0.0).double().mean())
    return bool(1.0 - above - below > _ZEROS and min(above, below) < _ONE_SIDED)


def _mean(y: Tensor, noise: float, oversampling: float) -> tuple[float, float]:
    """Mean of readings (M,) in their order, outliers left out, and its standard deviation before oversampling."""
    away = (y - y.median()).abs()
    y = y[away <= _OUTLYING * max(float(away.median()) / _NORMAL, noise)]
    batches = y[: len(y) // _BATCHES * _BATCHES].view(_BATCHES, -1).mean(1)
    seen = max(float(y.var()) / len(y), float(batches.var()) / _BATCHES) / oversampling
    return float(y.mean()), max(noise**2 / len(y), seen) ** 0.5
