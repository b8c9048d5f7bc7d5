"""Robust statistics of a channel: medians, spreads and neighbours of samples, whatever NaN lies among them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchid.logs.log import BoolArray, FloatArray

#: Standard deviations of a normal distribution in one median absolute deviation.
NORMAL = 1.4826


def neighbours_of(series: FloatArray, at: NDArray[np.intp], direction: int, count: int) -> FloatArray:
    """The `count` items before (-1) or after (1) some places of a series (M, ...), nearest first, (P, count, ...).

    NaN beyond the ends.
    """
    index = at[:, None] + direction * np.arange(1, count + 1)
    inside = (index >= 0) & (index < len(series))
    found = series[np.clip(index, 0, len(series) - 1)]
    found[~inside] = np.nan
    return found


def finite_median(values: FloatArray) -> FloatArray:
    """Median along the second axis of (P, k, ...) over what is not NaN, the upper of two; 0 where nothing is."""
    ordered = np.sort(values, axis=1)  # NaN last
    count = np.sum(~np.isnan(ordered), axis=1, keepdims=True)
    middle = np.take_along_axis(ordered, np.minimum(count // 2, values.shape[1] - 1), axis=1)[:, 0]
    return np.where(count[:, 0] > 0, middle, 0.0)


def block_spread(differences: FloatArray, block: int) -> FloatArray:
    """Standard deviation (M,) of a normal distribution with the median size of its block of `differences` (M,)."""
    block = min(block, len(differences))
    whole = len(differences) // block
    blocks = np.abs(differences[: whole * block]).reshape(whole, block)
    medians = NORMAL * np.partition(blocks, block // 2, axis=1)[:, block // 2]
    rest = len(differences) - whole * block
    return np.append(np.repeat(medians, block), np.full(rest, medians[-1]))


def widen_mask(where: BoolArray, distance: int) -> BoolArray:
    """Which samples are within a distance of one in the mask (N,)."""
    padded = np.concatenate([np.zeros(distance + 1, np.intp), np.cumsum(where)])
    padded = np.concatenate([padded, np.full(distance, padded[-1])])
    return np.asarray(padded[2 * distance + 1 :] > padded[: -2 * distance - 1])
