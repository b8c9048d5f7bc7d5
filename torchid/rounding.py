"""Which numbers count and which are rounding: the tolerances of numerical rank, and the rule that applies them."""

from __future__ import annotations

import numpy as np

from torchid.parameters import Array

RANK_TOLERANCE = 1e-10
"""Singular values of the rows of data, columns of comparable size, below this share of the largest are rounding."""

KINEMATIC_TOLERANCE = 1e-9
"""The same of contact Jacobians, unit wrenches, and readings of sensors that are projected with their null spaces."""

BASE_RANK_TOLERANCE = 1e-6
"""Parts of unit vectors below this are rounding, as in the rank of S_b V_x, V_x being orthonormal.

Axes that a URDF's rounded angles (1.5708) tilt by 4e-6 from parallel count as independent.
"""

UNOBSERVABLE_SHARE = 1e-6
"""A parameter with less than this share in unobservable directions, all of unit length, is identifiable.

Far above rounding, 1e-10 on a humanoid, and below any share found in a robot, 1e-4.
"""


def relative_tolerance(tolerance: float, shape: tuple[int, ...], eps: float = float(np.finfo(float).eps)) -> float:
    """Share of the largest singular value that counts as zero in a matrix: the tolerance, but never less than rounding.

    A singular value is off by up to about `eps` times the larger dimension times the largest one (as
    `numpy.linalg.matrix_rank` assumes, after Golub and Van Loan, "Matrix Computations", section 5.4).

    Args:
        tolerance: the share.
        shape: of the matrix.
        eps: rounding unit of its precision.
    """
    return max(tolerance, max(shape, default=0) * eps)


def is_significant(values: Array, tolerance: float = RANK_TOLERANCE, shape: tuple[int, ...] = ()) -> np.ndarray:
    """Which singular values count, bool like `values`: those above a share of the largest.

    Args:
        values: >= 0, in any order.
        tolerance: the share.
        shape: of the matrix, for tolerances that might be smaller than rounding.
    """
    return np.asarray(values > relative_tolerance(tolerance, shape) * values.max(initial=0.0))


def numerical_rank(values: Array, tolerance: float = RANK_TOLERANCE, shape: tuple[int, ...] = ()) -> int:
    """Number of singular values that count, as `is_significant` says."""
    return int(is_significant(values, tolerance, shape).sum())
