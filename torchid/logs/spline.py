"""Values and derivatives of the quintic spline through samples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import make_interp_spline

from torchid.logs.fields import FloatArray

#: Samples per spline. One spline through a long log needs 22 numbers a sample for its banded matrix alone; through
#: blocks the temporaries stay small.
BLOCK = 4096
#: Samples added on both sides of a block: on a uniform grid a sample's influence fades by 0.43 per step, so nothing
#: is left of the cut after 128.
OVERLAP = 128


def spline_degree(samples: int) -> int:
    """The spline's degree: 5, or 3 or 1 where fewer than 6 or 4 samples leave no choice."""
    return 5 if samples >= 6 else 3 if samples >= 4 else 1


def spline_derivatives(
    time: FloatArray, values: FloatArray, at: FloatArray, orders: Sequence[int], block: int = BLOCK
) -> list[FloatArray]:
    """Derivatives of the spline through `values` (with not-a-knot ends), one array (K, ...) per order.

    Args:
        time: (N,) [s], strictly increasing, N >= 2.
        values: (N, ...), finite.
        at: (K,) [s], increasing, within `time`.
        orders: order of each derivative wanted, 0 being the value itself.
        block: samples per spline.
    """
    flat = values.reshape(len(time), -1)
    out = [np.zeros((len(at), flat.shape[1])) for _ in orders]
    degree = spline_degree(len(time))
    for start in range(0, len(time) if flat.size else 0, block):
        stop = start + block
        first = int(np.searchsorted(at, time[start])) if start else 0
        last = int(np.searchsorted(at, time[stop])) if stop < len(time) else len(at)
        if first < last:
            near = slice(max(0, start - OVERLAP), stop + OVERLAP)
            spline = make_interp_spline(time[near], flat[near], k=degree)
            for derivative, order in zip(out, orders, strict=True):
                derivative[first:last] = spline(at[first:last], order)
    return [derivative.reshape(len(at), *values.shape[1:]) for derivative in out]
