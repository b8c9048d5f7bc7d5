"""How much is known of the parameters: bits, and combinations known better than to within their scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from torchid.parameters import Array
from torchid.problem import RowBuilder

DEPENDENT = 1e-9
"""What moves the whitened rows by less than this share of its size is rounding."""


@dataclass(frozen=True)
class Knowledge:
    """What data tell beyond "each free parameter is within one scale of its nominal value".

    With H the information of the whitened rows in units of the scales, `bits` = log2 det(I + H) / 2, by how many
    halvings the standard deviations shrink in all, and `determined` = tr((I + H)^-1 H), the number of independent
    combinations that the data know better than the prior, counted by their share.
    """

    bits: float
    determined: float

    @classmethod
    def of(cls, information: Array) -> Knowledge:
        """From the eigenvalues of H, (M,), at least 0 but for rounding."""
        values = np.maximum(information, 0.0)
        return cls(float(np.log1p(values).sum() / np.log(4.0)), float((values / (1.0 + values)).sum()))

    def __sub__(self, other: Knowledge) -> Knowledge:
        return Knowledge(self.bits - other.bits, self.determined - other.determined)


def prior_directions(builder: RowBuilder, prior: Array) -> Array:
    """N, (columns, M), so that rows X in the builder's columns have the information `N^T X^T X N`.

    `N N^T` is the covariance of the columns' parameters if parameters are independent with the standard deviations
    `prior`, (12 L,), 0 where they are known, and extras with that of their size.
    """
    rigid = triangle((builder.columns.from_parameters() * prior).T).T
    return np.asarray(scipy.linalg.block_diag(rigid, np.diag([extra.size for extra in builder.extras])))


def triangle(X: Array) -> Array:
    """Triangular R, (min(M, N), N), with `R^T R = X^T X`."""
    return np.asarray(np.linalg.qr(X, mode="r"))


def information_without(H: Array, unknown: Sequence[int], size: Array) -> Array:
    """As `elimination.without`, of H = X^T X.

    Args:
        H: (N, N).
        unknown: places of M columns.
        size: (M,), squared norms of these; what is below the share `DEPENDENT` of them is rounding.
    """
    if not unknown:
        return H
    scale = 1.0 / np.sqrt(np.where(size > 0.0, size, 1.0))
    crossed = np.delete(H[list(unknown)], unknown, axis=1) * scale[:, None]
    values, V = np.linalg.eigh(H[np.ix_(unknown, unknown)] * scale * scale[:, None])
    along = V[:, values > DEPENDENT].T @ crossed
    rest = np.delete(np.delete(H, unknown, axis=0), unknown, axis=1)
    return np.asarray(rest - along.T @ (along / values[values > DEPENDENT, None]))


def information_in(rows: Tensor, weight: float) -> Tensor:
    """`weight X^T X`, (c, c), of the rows X of all samples together, (B, r, c)."""
    X = rows.flatten(0, 1)
    return weight * (X.T @ X)


def unit_readings(ways: Tensor, W: Tensor) -> Tensor:
    """Rows `ways W`, (B, c, nv), of norm 1, or zero where they are rounding.

    A sensor that enters the generalized force of a sample by `way^T` times its reading tells what the whitened rows
    `W^T K` hold along `W^T way^T`: without it, `W W^T` loses that and no more.

    Args:
        ways: (B, c, nv) or (c, nv).
        W: (B, nv, nv), from `RowBuilder.rows_by_sample`.
    """
    readings = ways @ W
    size = torch.linalg.vector_norm(readings, dim=-1, keepdim=True)
    least = DEPENDENT * torch.linalg.matrix_norm(W)[:, None, None] * ways.norm(dim=-1, keepdim=True)
    return torch.where(size > least, readings / size, 0.0)
