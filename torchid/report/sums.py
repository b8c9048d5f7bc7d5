"""Sums of squares of generalized forces by row, and inside the contacts' null space."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch

from torchid.parameters import Array
from torchid.problem.plan import State
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples

WHITENED = "projected_residual"
"""The group of the rows that a fit sees: whitened, and projected so that nothing unmeasured is in them."""


class Squares:
    """Sums and sums of squares by row, over the samples where the row is known."""

    def __init__(self, rows: int) -> None:
        """Start empty."""
        self.plain, self.sum, self.count = np.zeros(rows), np.zeros(rows), np.zeros(rows)

    def add(self, x: torch.Tensor, weight: float = 1.0) -> None:
        """Add samples (N, rows), NaN where unknown, each of which stands for so many."""
        values = x.cpu().numpy()
        known = np.isfinite(values)
        values = np.where(known, values, 0.0)
        self.plain += weight * values.sum(0)
        self.sum += weight * np.square(values).sum(0)
        self.count += weight * known.sum(0)

    def add_squares(self, squares: float, count: int) -> None:
        """Add one row's sum of squares over so many samples, of whose mean nothing is known."""
        self.sum += squares
        self.count += count

    def rms(self, rows: slice = slice(None)) -> Array:
        """Row by row."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(self.sum[rows] / self.count[rows])

    def pooled(self, rows: slice) -> float:
        """Rms over all components of some rows."""
        count = self.count[rows].sum()
        return float(np.sqrt(self.sum[rows].sum() / count)) if count else np.nan

    def deviation(self, rows: slice) -> float:
        """Rms about the mean of each row, over all of them."""
        known = self.count[rows] > 0
        count, plain = self.count[rows][known], self.plain[rows][known]
        if not len(count):
            return np.nan
        return float(np.sqrt(max((self.sum[rows][known] - plain**2 / count).sum(), 0.0) / count.sum()))

    def merge(self, other: Squares) -> None:
        """Add what another has seen."""
        self.plain += other.plain
        self.sum += other.sum
        self.count += other.count


class ForceSums:
    """Of generalized forces (or their errors): rows as they are, and inside the contacts' null space.

    `whitened`: of the rows that a fit sees, V_x^T f of its sensors in units of their noise.
    """

    def __init__(self, nv: int) -> None:
        """Start empty."""
        self.rows, self.projected, self.whitened = Squares(nv), Squares(1), Squares(1)

    @classmethod
    def total(cls, parts: Sequence[ForceSums]) -> ForceSums:
        """Of all parts together."""
        out = cls(len(parts[0].rows.sum))
        for part in parts:
            out.rows.merge(part.rows)
            out.projected.merge(part.projected)
            out.whitened.merge(part.whitened)
        return out

    def rms(self, base_rows: int, n: int) -> dict[str, float]:
        """By group of rows, NaN where there are none, of a robot with so many base rows and joints."""
        joints = self.rows.rms(slice(base_rows, base_rows + n))
        force, moment = self._in_limbs(base_rows + n)
        return {
            "joint_torque": float(np.nanmean(joints)) if np.isfinite(joints).any() else np.nan,
            "base_force": self.rows.pooled(slice(0, 3)) if base_rows else np.nan,
            "base_moment": self.rows.pooled(slice(3, 6)) if base_rows else np.nan,
            "ft_force": force,
            "ft_moment": moment,
            "nullspace": self.projected.pooled(slice(None)),
            WHITENED: self.whitened.pooled(slice(None)),
        }

    def _in_limbs(self, first: int) -> tuple[float, float]:
        """Of forces and of moments of the sensors in limbs."""
        squares, count = (x[first:].reshape(-1, 2, 3).sum((0, 2)) for x in (self.rows.sum, self.rows.count))
        with np.errstate(invalid="ignore", divide="ignore"):
            force, moment = np.sqrt(squares / count)
        return float(force), float(moment)


def projected(builder: RowBuilder, samples: Samples, state: State, vectors: torch.Tensor) -> Iterator[torch.Tensor]:
    """V_x^T of generalized forces (M, B, nv), V_x the contacts' null space, in groups of one rank, (M, B', r).

    Joints away from contacts pass unchanged.
    """
    plan, base = builder.plan(state), builder.tree.base_rows
    mixed = [*range(base), *(base + joint for joint in plan.mixed_joints)]
    lone = [base + joint for joint in plan.lone_joints]
    for index, V in builder.bases(samples, state):
        these = vectors[:, index]
        yield torch.cat([(V.mT @ these[..., mixed, None])[..., 0], these[..., lone]], dim=2)


def figure(x: float) -> float | None:
    """A number, or None where there is none."""
    return float(x) if np.isfinite(x) else None
