"""Equations of unknown offsets of contact sensors: what they read while nothing touches."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.rounding import MAD_PER_STD

LEAST_READINGS = 16
"""In the air, for one equation."""

_BATCHES = 8  # batches of successive readings, whose means show drift
_MASKED_SHARE = 0.01  # readings are masked or clamped, not measured, if more than this share is exactly 0 ...
_ONE_SIDED = 0.05  # ... and less than this share has one of the signs (else 0 is one step of a coarse sensor)
_OUTLYING = 4.0  # standard deviations; of Gaussian readings 6e-5 are dropped


@dataclass(frozen=True)
class UnloadedOffsetEquation:
    """The equation for a contact sensor's unknown offset from its readings while the contact is in the air.

    The sensor then reads its offset and the weight of the parts beyond it.

    Attributes:
        offset: its number among the extras.
        scale: number of the channel's unknown scale, None if that is known.
        gated: whether the readings are masked, clamped or missing (exactly 0), so that there is no equation.
        mean: of the readings, without outliers [N, N m].
        deviation: standard deviation of the mean [N, N m]: that of independent readings with the stated noise, or more
            if they or their means over longer spans of time scatter more.
    """

    offset: int
    scale: int | None
    gated: bool = False
    mean: float = 0.0
    deviation: float = 1.0

    def row(self, builder: RowBuilder) -> tuple[tuple[int, ...], Tensor]:
        """The whitened equation `o - (s - 1) mean = mean` as a block of one row: its columns, and (1, columns + 1).

        The scale's column holds the mean: the noise of single readings would bias the scale towards 0. The row is on
        the CPU, where readings in the air are, and so is the block of such rows in a factor.
        """
        first, row = builder.columns.count, [1.0, self.mean]
        columns: tuple[int, ...] = (first + self.offset,)
        if self.scale is not None:
            columns, row = (*columns, first + self.scale), [1.0, -self.mean, self.mean]
        return columns, torch.tensor([row], dtype=builder.tree.ancestors.dtype) / self.deviation


def unloaded_offset_equations(builder: RowBuilder, samples: Samples) -> Iterator[UnloadedOffsetEquation]:
    """Equations of the unknown offsets, from the readings in the air among some samples of a log."""
    if samples.unloaded is None:
        return
    scales = {at: number for number, x in enumerate(builder.extras) if x.what == "scale" for at in x.contacts}
    noise = builder.sensors.noise.wrench_std.tolist()
    for number, extra in enumerate(builder.extras):
        if extra.what != "offset" or extra.contact is None:
            continue
        contact, axis = extra.contact
        y = samples.unloaded[:, contact, axis]
        y = y[torch.isfinite(y)]
        if len(y) < LEAST_READINGS:
            continue
        if is_masked(y):
            yield UnloadedOffsetEquation(number, None, gated=True)
        else:
            mean, deviation = _robust_mean(y, noise[axis], samples.oversampling)
            yield UnloadedOffsetEquation(number, scales.get(extra.contact), False, mean, deviation)


def is_masked(y: Tensor) -> bool:
    """Whether readings (M,) in the air are masked or clamped, not measured: many are exactly 0, and few of one sign."""
    return are_masked(len(y), int((y > 0.0).sum()), int((y < 0.0).sum()))


def are_masked(count: int, above: int, below: int) -> bool:
    """The same of so many readings, of which some are above and below 0."""
    zero = count - above - below
    return zero > _MASKED_SHARE * count and min(above, below) < _ONE_SIDED * count


def _robust_mean(y: Tensor, noise: float, oversampling: float) -> tuple[float, float]:
    """Mean of successive readings (M,) without outliers, and its standard deviation without oversampling."""
    deviation = (y - y.median()).abs()
    y = y[deviation <= _OUTLYING * max(float(deviation.median()) / MAD_PER_STD, noise)]
    batches = y[: len(y) // _BATCHES * _BATCHES].view(_BATCHES, -1).mean(1)
    scatter = max(float(y.var()) / len(y), float(batches.var()) / _BATCHES) / oversampling
    return float(y.mean()), max(noise**2 / len(y), scatter) ** 0.5
