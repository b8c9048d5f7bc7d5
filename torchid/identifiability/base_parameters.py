"""Base parameters: the combinations of parameters that the rows of a problem determine, and their formulas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.linalg
import torch
from torch import Tensor, nn

from torchid import parameters
from torchid.identifiability.rank import RankGap, rank_and_gap, unit_columns
from torchid.parameters import PARAMETERS, PER_BODY, Array
from torchid.problem import LinearProblem
from torchid.problem.chunks import one_thread
from torchid.rounding import RANK_TOLERANCE

_ROUNDING = 1e-9  # of a coefficient, columns having norm 1; joint angles written as 1.5707963 leave 1e-11
_LEAST_PREFERENCE = 1e-2  # between 1e-1 and 1e-4 sums are shortest, and conditioning is the same


def drop_preference(count: int) -> Array:
    """How gladly each of `count` parameters is regrouped into others, (count,), from 1 down to 0.01.

    As textbooks do it: limbs into what carries them; of a body the mass first, then first moments, then inertia.
    """
    bodies = max(count // parameters.PER_BODY, 1)
    return np.concatenate(np.array_split(np.geomspace(1.0, _LEAST_PREFERENCE, count), bodies)[::-1])


class BaseParameters(nn.Module):
    """Base parameters phi_B = G phi with `K phi = K_B phi_B` (eq. 11) for every row K of the kind they were made from.

    Attributes:
        kept: (P_B,) int, ascending; base parameter i is parameter `kept[i]` and what was regrouped into it.
        combination: G, (P_B, P): the identity in the kept columns, zero in those that are not free.
        hidden: (P_free - P_B, P), directions h with K h = 0; `hidden / scale` is orthonormal.
        free: (P,) bool; the others are constants, see `forward`.
        scale: (P,), the problem's.
        rank, gap, singular_values: of the columns scaled to norm 1, see `rank_and_gap`.
    """

    index: Tensor

    def __init__(
        self,
        kept: np.ndarray,
        combination: Array,
        free: np.ndarray,
        scale: Array,
        singular_values: Array,
        rank_gap: RankGap,
    ) -> None:
        """See `base_parameters`, which finds them."""
        super().__init__()
        self.kept, self.combination, self.free, self.scale = kept, combination, free, scale
        self.singular_values = singular_values
        self.rank, self.gap = rank_gap
        self.hidden = _hidden(kept, combination, free, scale)
        self.register_buffer("index", torch.from_numpy(kept), persistent=False)

    def forward(self, K: Tensor) -> Tensor:
        """K_B, (..., P_B), of a regressor K, (..., P).

        Parameters that are not free have no part in phi_B: `K phi = K_B phi_B + K[..., ~free] @ phi[~free]`.
        """
        return K.index_select(-1, self.index)

    def of(self, phi: Array) -> Array:
        """Base parameters (..., P_B) of parameters (..., P)."""
        return phi @ self.combination.T

    def lift(self, phi_B: Array, nominal: Array) -> Array:
        """The parameters (..., P) nearest to `nominal`, (P,), in units of `scale`, with base parameters (..., P_B)."""
        step = np.zeros((*phi_B.shape[:-1], len(self.scale)))
        step[..., self.kept] = (phi_B - self.of(nominal)) / self.scale[self.kept]
        directions = self.hidden / self.scale
        return nominal + self.scale * (step - step @ directions.T @ directions)

    def problem(self, problem: LinearProblem) -> LinearProblem:
        """The same problem in the base parameters, all free and seen; constants move to its right-hand side.

        Raises:
            ValueError: other parameters are free there.
        """
        if not np.array_equal(problem.free, self.free):
            raise ValueError("free: found other parameters than these base parameters were made from; accepted: those")
        constant = np.where(self.free, 0.0, problem.nominal)
        return replace(
            problem,
            A=problem.A[:, self.kept],
            b=problem.b - problem.A @ constant,
            nominal=self.of(problem.nominal),
            scale=problem.scale[self.kept],
            free=np.ones(len(self.kept), dtype=bool),
        )


@one_thread()
def base_parameters(
    problem: LinearProblem, tolerance: float = RANK_TOLERANCE, preference: Array | None = None
) -> BaseParameters:
    """Base parameters of a problem.

    Columns are scaled to norm 1, so that a finger's inertia counts as much as the torso's mass; a pivoted QR
    factorization of their null space settles which parameters are regrouped into the others.

    Args:
        problem: its rows decide what is seen.
        tolerance: a column below this share of the largest, in units of `problem.scale`, is not seen at all; a singular
            value of the scaled columns below this share of the largest counts as zero.
        preference: (P,), > 0, how gladly each parameter is regrouped into others; by default `drop_preference`.

    Warns:
        NumericalWarning: the rank is a matter of the tolerance.
    """
    free, count = np.flatnonzero(problem.free), len(problem.scale)
    columns, units = unit_columns(problem, tolerance)
    _, values, Vh = scipy.linalg.svd(columns, lapack_driver="gesvd")  # gesdd can fail on dozens of null directions
    rank_gap = rank_and_gap(values, tolerance)
    null_space = Vh[rank_gap.rank :].T
    weight = (drop_preference(count) if preference is None else preference)[free]
    _, order = scipy.linalg.qr((null_space * weight[:, None]).T, mode="r", pivoting=True)
    hidden_count = len(free) - rank_gap.rank
    dropped, kept = order[:hidden_count], np.sort(order[hidden_count:])
    regrouped = -np.linalg.solve(null_space[dropped].T, null_space[kept].T).T
    regrouped[np.abs(regrouped) < _ROUNDING] = 0.0

    combination = np.zeros((len(kept), count))
    combination[np.arange(len(kept)), free[kept]] = 1.0
    combination[:, free[dropped]] = units[kept, None] * regrouped / units[dropped]
    return BaseParameters(free[kept], combination, problem.free, problem.scale, values, rank_gap)


def _hidden(kept: np.ndarray, combination: Array, free: np.ndarray, scale: Array) -> Array:
    """Null space of G in the free parameters, orthonormal in units of `scale`."""
    dropped = np.setdiff1d(np.flatnonzero(free), kept)
    directions = np.zeros((len(scale), len(dropped)))
    directions[dropped, np.arange(len(dropped))] = 1.0
    directions[kept] = -combination[:, dropped]
    hidden = np.zeros((len(dropped), len(scale)))
    hidden[:, free] = np.linalg.qr(directions[free] / scale[free, None]).Q.T * scale[free]
    return hidden


def relations(base: BaseParameters, body_names: Sequence[str]) -> list[str]:
    """One sum per base parameter, such as `m[shank] + m[foot] - 0.31 Ixx[foot]`, coefficients in SI units.

    Args:
        base: in the parameters of bodies.
        body_names: of the L bodies, in order.
    """
    names = [f"{name}[{body}]" for body in body_names for name in PARAMETERS]
    lines = []
    for kept, row in zip(base.kept, base.combination, strict=True):
        others = [place for place in np.flatnonzero(row) if place != kept]
        lines.append("".join([names[kept], *(_term(row[place], names[place]) for place in others)]))
    return lines


def _term(coefficient: float, name: str) -> str:
    size = f"{abs(coefficient):.3g}"
    return f" {'-' if coefficient < 0 else '+'} {name if size == '1' else f'{size} {name}'}"


def unseen(base: BaseParameters, body_names: Sequence[str]) -> list[str]:
    """Free parameters that are part of no sum, one line per body, such as `foot: Ixx, Ixy, Ixz, Iyy, Iyz, Izz`.

    Args:
        base: in the parameters of bodies.
        body_names: of the L bodies, in order.
    """
    lost = (base.free & ~base.combination.any(axis=0)).reshape(-1, PER_BODY)
    return [
        f"{body}: {', '.join(PARAMETERS[place] for place in np.flatnonzero(numbers))}"
        for body, numbers in zip(body_names, lost, strict=True)
        if numbers.any()
    ]
