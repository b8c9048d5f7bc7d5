"""Gaps that are filled where an array is sliced are those that are filled in the whole array."""

from __future__ import annotations

import numpy as np
import pytest

from torchid.logs.lazy_arrays import GapsFilled


@pytest.mark.parametrize("step", [1, 2, 5, 64])
@pytest.mark.parametrize("seed", range(4))
def test_each_gap_is_interpolated_whatever_the_parts(step: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(60, 5))
    values[rng.random(values.shape) < (0.0, 0.1, 0.3, 0.5)[seed]] = np.nan
    values[:7, 0], values[50:, 1], values[:, 2], values[1:, 3] = np.nan, np.nan, np.nan, np.nan
    filled = GapsFilled(values, 0.7, (values[start : start + step] for start in range(0, 60, step)))
    expected, index = values.copy(), np.arange(60)
    for column in expected.T:
        known = np.isfinite(column)
        column[~known] = np.interp(index[~known], index[known], column[known]) if known.sum() >= 18 else np.nan
        if known.sum() < 18:
            column[:] = np.nan
    assert filled.broken.tolist() == [False, False, True, True, False]
    for part in (slice(0, 60), slice(3, 9), slice(40, None), slice(12, 13)):
        np.testing.assert_array_equal(filled[part], expected[part])
