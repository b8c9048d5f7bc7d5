"""Shared numerical tolerances and the functions that apply them."""

from __future__ import annotations

import numpy as np

from torchid.parameters import Array

RANK_TOLERANCE = 1e-10
"""Rank tolerance for data with columns of comparable size, relative to the largest singular value."""

KINEMATIC_TOLERANCE = 1e-9
"""The same for contact Jacobians, unit wrenches, and sensor readings projected onto their null spaces."""

BASE_RANK_TOLERANCE = 1e-6
"""Absolute rank tolerance for parts of orthonormal matrices, such as S_b V_x.

Axes that are 4e-6 from parallel, by the rounded angles (1.5708) of a URDF, count as independent.
"""

UNOBSERVABLE_SHARE = 1e-6
"""A parameter with a smaller component in all unit vectors of the unobservable space is identifiable.

The value is far above rounding (1e-10 on a humanoid) and below all components found in robots (1e-4).
"""

MAD_PER_STD = 0.6745
"""Median of |x| of a standard normal x: a median absolute deviation over it is a robust standard deviation."""

STD_PER_MAD = 1.4826
"""Its inverse, as rounded in the literature on outliers."""


def column_scale(A: Array) -> Array:
    """Factors that scale the columns of A, (R, n), to norm 1, (n,); 0 for columns of zeros or of rounding errors."""
    norms = np.linalg.norm(A, axis=0)
    rounding = float(np.finfo(float).eps) * norms.max(initial=0.0)
    return np.divide(1.0, norms, out=np.zeros_like(norms), where=norms > rounding)


def relative_tolerance(tolerance: float, shape: tuple[int, ...], eps: float = float(np.finfo(float).eps)) -> float:
    """The tolerance relative to the largest singular value of a matrix, at least the rounding error.

    The error of a singular value is up to about `eps` times the larger dimension times the largest one (as
    `numpy.linalg.matrix_rank` assumes, after Golub and Van Loan, "Matrix Computations", section 5.4).

    Args:
        tolerance: the share.
        shape: of the matrix.
        eps: rounding unit of its precision.
    """
    return max(tolerance, max(shape, default=0) * eps)


def is_significant(values: Array, tolerance: float = RANK_TOLERANCE, shape: tuple[int, ...] = ()) -> np.ndarray:
    """Whether singular values are above a share of the largest, bool like `values`.

    Args:
        values: >= 0, in any order.
        tolerance: the share.
        shape: of the matrix, for its rounding error.
    """
    return np.asarray(values > relative_tolerance(tolerance, shape) * values.max(initial=0.0))


def numerical_rank(values: Array, tolerance: float = RANK_TOLERANCE, shape: tuple[int, ...] = ()) -> int:
    """Number of singular values that `is_significant`."""
    return int(is_significant(values, tolerance, shape).sum())
