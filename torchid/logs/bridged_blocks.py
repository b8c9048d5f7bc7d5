"""Short gaps of a log that is read block by block, bridged as in one that is read as a whole."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.logs.blocks import LogBlocks
from torchid.logs.gaps import fill_short_gaps, warn_of_filled
from torchid.logs.lazy_arrays import Computed
from torchid.logs.log import CONTACT_READINGS, FLAGS

_AROUND = 64
"""Samples beyond the longest gap on either side that a spline is put through.

A cubic spline forgets what is further away: by a factor of 0.27 each sample.
"""


def bridge_in_blocks(blocks: LogBlocks, longest_s: float | None, pieces: Iterable[slice]) -> LogBlocks:
    """The log with its short gaps filled as by `bridge_gaps`, which takes a pass over it.

    Args:
        blocks: the log as recorded, with moments about the world's origin.
        longest_s: from the value before a gap to that after it [s]; None leaves all as it is.
        pieces: successive parts of it, all of it together.

    Raises:
        LogError: an invalid value.

    Warns:
        TorchidWarning: how many samples were filled.
    """
    if longest_s is None:
        return blocks
    names, count = dict[str, None](), 0
    for piece in pieces:
        filled = _filled(blocks, tuple(blocks.fields), piece, longest_s)[1]
        names |= dict.fromkeys(filled)
        if filled:
            count += int(np.any(list(filled.values()), axis=0).sum())
    if names:
        warn_of_filled(names, count, len(blocks), longest_s)

    def bridged(name: str) -> Computed:
        def rows_of(rows: slice) -> NDArray[Any]:
            wanted = (name, FLAGS) if name in CONTACT_READINGS and FLAGS in blocks.fields else (name,)
            return _filled(blocks, wanted, rows, longest_s)[0][name]

        return Computed(blocks.fields[name].shape, blocks.fields[name].dtype, rows_of)

    return blocks.replaced({name: bridged(name) for name in names})


def _filled(
    blocks: LogBlocks, names: tuple[str, ...], rows: slice, longest_s: float
) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[np.bool_]]]:
    """Fields of some rows, as `fill_short_gaps` has them, and in which of the rows of which something was filled."""
    time = blocks.time
    first = int(np.searchsorted(time, time[rows.start] - 2.0 * longest_s)) - _AROUND
    last = int(np.searchsorted(time, time[rows.stop - 1] + 2.0 * longest_s)) + _AROUND
    window = slice(max(first, 0), min(last, len(time)))
    inside = slice(rows.start - window.start, rows.stop - window.start)
    out, filled = fill_short_gaps(blocks.raw(window, names), longest_s)
    in_rows = {name: where[inside] for name, where in filled.items()}
    return {name: out[name][inside] for name in names}, {name: x for name, x in in_rows.items() if x.any()}
