"""Unknowns that a linear problem has been freed of, where physics bounds them: armatures, springs, dry friction."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from torchid.parameters import Array
from torchid.reprs import short_repr
from torchid.rounding import RANK_TOLERANCE

AT_BOUND = 1e-5
"""A number within this share of its scale of a bound is at it: solvers stop 1e-9 to 1e-7 away."""


@dataclass(frozen=True)
class SignCondition:
    """`terms @ psi + parameters @ phi >= 0`: a number that physics keeps from being negative.

    Attributes:
        name: of the number.
        terms: (M,); parameters: (P,).
        size: of a plausible value; unit: of both.
    """

    name: str
    terms: Array
    parameters: Array
    size: float
    unit: str

    def value(self, phi: Array, psi: Array) -> float:
        """The number at parameters phi, (P,), and terms psi, (M,)."""
        return float(self.terms @ psi + self.parameters @ phi)


@dataclass(frozen=True)
class EliminatedTerms:
    """Unknowns psi, (M,), beside the parameters phi of a `LinearProblem`, whose rows they have been eliminated from.

    The whole cost is that of the problem plus ||C phi + D psi - z||^2, which is 0 at their best for any phi: whoever
    does not bound them need not know of them.

    Attributes:
        C: (r, P); D: (r, M), of rank r; z: (r,); whitened as the rows of the problem.
        size: (M,), of plausible values; labels: (M,).
        conditions: on them.
    """

    C: Array
    D: Array
    z: Array
    size: Array
    labels: tuple[str, ...]
    conditions: tuple[SignCondition, ...]

    __repr__ = short_repr

    @cached_property
    def undetermined(self) -> Array:
        """Orthonormal combinations that no row depends on, (k, M), in units of the size."""
        _, values, Vt = np.linalg.svd(self.D * self.size, full_matrices=True)
        return np.asarray(Vt[int((values > RANK_TOLERANCE * values.max(initial=0.0)).sum()) :])

    def best(self, phi: Array) -> Array:
        """The terms that fit parameters (P,) best, of least norm, (M,)."""
        scaled = np.linalg.lstsq(self.D * self.size, self.z - self.C @ phi, rcond=RANK_TOLERANCE)[0]
        return np.asarray(self.size * scaled)

    def misfit(self, phi: Array, psi: Array) -> float:
        """What terms (M,) add to the cost at parameters (P,)."""
        return float(np.square(self.C @ phi + self.D @ psi - self.z).sum())

    def conditions_at(self, free: np.ndarray, nominal: Array) -> tuple[SignCondition, ...]:
        """The conditions that some terms meet strictly: not that on a joint whose dry friction is fixed at none.

        Args:
            free: (P,) bool, parameters that are fitted.
            nominal: (P,), the values of the others.
        """
        return tuple(
            one
            for one in self.conditions
            if not one.parameters.any() or one.parameters[free].any() or one.parameters @ nominal > 0.0
        )

    def at_bounds(self, phi: Array, psi: Array | None) -> frozenset[str]:
        """Labels of terms of conditions that hold with equality at phi (P,) and psi (M,); none without psi."""
        if psi is None:
            return frozenset()
        standing = [one for one in self.conditions if one.value(phi, psi) <= AT_BOUND * one.size]
        return frozenset(self.labels[number] for one in standing for number in np.flatnonzero(one.terms))

    def scaled(self, root: float) -> EliminatedTerms:
        """The same with rows times a number."""
        return replace(self, C=root * self.C, D=root * self.D, z=root * self.z)
