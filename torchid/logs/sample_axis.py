"""Arrays whose columns are the samples, found by their lengths: those of Matlab, and of programs that append rows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from torchid.errors import excerpt
from torchid.logs.column_proposals import propose_field
from torchid.logs.file_samples import FileSample, increases

_FEW = 2  # arrays that agree about a length, of files without stamps


def with_samples_first(sample: FileSample, joints: int) -> tuple[FileSample, dict[str, str]]:
    """Arrays with a row for each sample, those that were transposed for it by the name `NAME.T`; and notes on them.

    How many samples there are is what stamps say, else the last length of several arrays. Nothing is transposed that
    has as many rows as columns, or as many rows as there are samples.

    Args:
        sample: arrays of a file, from `read_sample`.
        joints: of the robot.
    """
    matrices = {name: x for name, x in sample.items() if x is not None and x.ndim == 2 and x.dtype.kind in "fiub"}
    count = _count(sample, matrices.values())
    turned = [name for name, x in matrices.items() if x.shape[1] == count != x.shape[0]]
    square = [name for name, x in matrices.items() if x.shape == (count, count) and count == joints]
    notes = dict[str, str]()
    if turned:
        like = f"'{excerpt(turned[0])}'" + (f" and {len(turned) - 1} more" if len(turned) > 1 else "")
        notes["columns"] = f"the columns of {like} are the {count} samples: .T transposes them"
    if square:
        name = excerpt(square[0])
        notes["joint_order"] = (
            f"as many samples as joints: if the columns of '{name}' are the samples, write '{name}.T'"
        )
    out = {name: x for name, x in sample.items() if name not in turned}
    return out | {f"{name}.T": matrices[name].T for name in turned}, notes


def _count(sample: FileSample, matrices: Collection[NDArray[np.generic]]) -> int:
    """How many samples there are, 0 where arrays do not say so."""
    flat = {name: x for name, x in sample.items() if x is not None and x.size == max(x.shape, default=0) > 2}
    for name, x in flat.items():
        if x.dtype.kind in "fiu" and propose_field(name) == "time" and increases(np.ravel(x)):
            return int(x.size)
    first, last = (Counter(x.shape[axis] for x in matrices) for axis in (0, 1))
    (length, times), *_ = last.most_common(1) or [(0, 0)]
    return length if times >= _FEW and length > max(first, default=0) else 0
