"""Fields of a log that are computed from others where they are sliced."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Computed:
    """An array of a shape (N, ...) and type, some rows of which are what `rows_of` gives."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    rows_of: Callable[[slice], NDArray[Any]]

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        """Some rows."""
        return self.rows_of(slice(*rows.indices(self.shape[0])))
