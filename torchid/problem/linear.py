"""The linear problem that estimators solve, and the triangular factors that any number of its rows compress to."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from torchid import parameters
from torchid.parameters import Array
from torchid.reprs import short_repr
from torchid.rounding import RANK_TOLERANCE

AT_BOUND = 1e-5
"""A number closer to a bound than this fraction of its scale counts as at the bound; solvers stop 1e-9 to 1e-7 away."""


@dataclass(frozen=True)
class SignCondition:
    """Condition that a physical quantity is not negative: `terms @ psi + parameters @ phi >= 0`.

    Attributes:
        name: of the quantity.
        terms: (M,).
        parameters: (P,).
        size: a plausible value.
        unit: of the quantity.
    """

    name: str
    terms: Array
    parameters: Array
    size: float
    unit: str

    def value(self, phi: Array, psi: Array) -> float:
        """The quantity at parameters phi, (P,), and terms psi, (M,)."""
        return float(self.terms @ psi + self.parameters @ phi)


@dataclass(frozen=True)
class EliminatedTerms:
    """Unknowns psi, (M,), that were eliminated from the rows of a `LinearProblem` but have physical bounds.

    The total cost is the cost of the problem plus ||C phi + D psi - z||^2. Without bounds this part is 0 at the best
    psi.

    Attributes:
        C: (r, P), whitened like the rows of the problem.
        D: (r, M), of rank r.
        z: (r,).
        size: (M,), plausible values.
        labels: (M,).
        conditions: bounds on psi.
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
        """Orthonormal combinations that no row depends on, (k, M), in units of `size`."""
        _, values, Vt = np.linalg.svd(self.D * self.size, full_matrices=True)
        return np.asarray(Vt[int((values > RANK_TOLERANCE * values.max(initial=0.0)).sum()) :])

    def best(self, phi: Array) -> Array:
        """Terms (M,) that fit parameters (P,) best, with the least norm."""
        scaled = np.linalg.lstsq(self.D * self.size, self.z - self.C @ phi, rcond=RANK_TOLERANCE)[0]
        return np.asarray(self.size * scaled)

    def misfit(self, phi: Array, psi: Array) -> float:
        """Cost that terms (M,) add at parameters (P,)."""
        return float(np.square(self.C @ phi + self.D @ psi - self.z).sum())

    def conditions_at(self, free: np.ndarray, nominal: Array) -> tuple[SignCondition, ...]:
        """Conditions that can hold strictly: without those on joints whose dry friction is fixed at 0.

        Args:
            free: (P,) bool, parameters that are fitted.
            nominal: (P,), values of the other parameters.
        """
        return tuple(
            condition
            for condition in self.conditions
            if not condition.parameters.any()
            or condition.parameters[free].any()
            or condition.parameters @ nominal > 0.0
        )

    def at_bounds(self, phi: Array, psi: Array | None) -> frozenset[str]:
        """Labels of terms whose conditions hold with equality at phi (P,) and psi (M,); empty without psi."""
        if psi is None:
            return frozenset()
        standing = [
            condition for condition in self.conditions if condition.value(phi, psi) <= AT_BOUND * condition.size
        ]
        return frozenset(self.labels[number] for condition in standing for number in np.flatnonzero(condition.terms))


T = TypeVar("T")

_MERGED = 8  # blocks per factorization: half of the work of one at a time


@dataclass(frozen=True)
class LinearProblem:
    """Linear least-squares problem: min over phi of ||A phi - b||^2 + residual, with rows whitened to unit noise.

    Attributes:
        A: (R, P), R at most the number of independent columns.
        b: (R,).
        residual: squared norm of the part of the right-hand side that no phi explains.
        rows: number of scalar equations before compression.
        nominal: (P,), prior mean of the parameters.
        scale: (P,), > 0, unit in which deviations of each parameter are measured.
        free: (P,) bool, parameters to fit; the others keep their nominal values.
        oversampling: rows per independent row, at least 1. A low-pass filter correlates noise, so the rows carry less
            information than their number suggests.
        shrinkage: (R, Q), or None. Correction of rows with much motion noise: b - A nominal has the expectation A (phi
            - nominal) - shrinkage @ deviations, for deviations with unit variance. The first P deviations are those of
            the parameters, in units of `PRIOR_DEVIATION` times `scale`.
        terms: further unknowns with physical bounds, or None.
    """

    A: Array
    b: Array
    residual: float
    rows: int
    nominal: Array
    scale: Array
    free: np.ndarray
    oversampling: float = 1.0
    shrinkage: Array | None = field(default=None, kw_only=True)
    terms: EliminatedTerms | None = field(default=None, kw_only=True)
    _shared: dict[Hashable, object] = field(default_factory=dict, init=False, repr=False, compare=False)

    __repr__ = short_repr

    def _headline(self) -> str:
        return f"{self.rows} whitened equations for {self.A.shape[1]} parameters ({int(self.free.sum())} free)"

    def __post_init__(self) -> None:
        """Check types and shapes, and that all numbers are finite."""
        for name, kind in (("A", "f"), ("b", "f"), ("nominal", "f"), ("scale", "f"), ("free", "b")):
            if not isinstance(x := getattr(self, name), np.ndarray) or x.dtype.kind != kind:
                reason = f"{type(x).__name__} (dtype {getattr(x, 'dtype', None)})"
                raise TypeError(
                    f"{name}: found {reason}; accepted: a NumPy array of {'bool' if kind == 'b' else 'floats'}"
                )
        rows, columns = self.A.shape
        shapes = (self.b.shape, self.nominal.shape, self.scale.shape, self.free.shape)
        if shapes != ((rows,), (columns,), (columns,), (columns,)):
            accepted = f"b of shape ({rows},), the others ({columns},)"
            raise ValueError(f"b, nominal, scale, free: found shapes {shapes}; accepted: {accepted}")
        if self.shrinkage is not None and (len(self.shrinkage) != rows or self.shrinkage.shape[1] < columns):
            accepted = f"({rows}, Q), Q at least {columns}"
            raise ValueError(f"shrinkage: found shape {self.shrinkage.shape}; accepted: {accepted}")
        for name in ("A", "b", "residual", "nominal", "scale"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name}: found a number that is not finite; accepted: finite numbers")
        if not (self.scale > 0.0).all():
            raise ValueError("scale: found a number that is not positive; accepted: positive numbers")
        if not 1.0 <= self.oversampling < np.inf:
            raise ValueError(f"oversampling: found {self.oversampling}; accepted: a finite number of at least 1")

    def require_bodies(self) -> None:
        """Raise ValueError if the number of columns is not a multiple of 12."""
        if len(self.free) % parameters.PER_BODY:
            raise ValueError(f"A: found {len(self.free)} columns; accepted: {parameters.PER_BODY} per body")

    def free_bodies(self) -> np.ndarray:
        """Indices of bodies with free inertial parameters, (L',) int.

        Raises:
            ValueError: the columns are not those of bodies, or a body has both free and fixed inertial parameters.
        """
        self.require_bodies()
        inertial = self.free.reshape(-1, parameters.PER_BODY)[:, parameters.INERTIAL]
        if (inertial.any(axis=1) != inertial.all(axis=1)).any():
            reason = "a body with both free and fixed inertial parameters"
            raise ValueError(f"free: found {reason}; accepted: all ten of a body free, or none")
        return np.flatnonzero(inertial.all(axis=1))

    def cost(self, phi: Array, psi: Array | None = None) -> float:
        """Sum of squared whitened residuals of all rows at parameters `phi`, (P,).

        `psi`: (M,), values of the `terms`; None for the best fit.
        """
        misfit = self.A @ phi - self.b
        added = 0.0 if psi is None or self.terms is None else self.terms.misfit(phi, psi)
        return float(misfit @ misfit + self.residual + added)

    def shared(self, key: Hashable, compute: Callable[[], T]) -> T:
        """Return a cached value that several solves of this problem share.

        Args:
            key: names the value and every setting it depends on.
            compute: called if the cache has no value under this key.
        """
        if key not in self._shared:
            self._shared[key] = compute()
        return cast(T, self._shared[key])

    @property
    def parameter_shrinkage(self) -> Array | None:
        """Columns of `shrinkage` for the free parameters, (R, P'), in units of their scale."""
        return None if self.shrinkage is None else self.shrinkage[:, : len(self.free)][:, self.free] / PRIOR_DEVIATION

    def prediction_distance(self, phi: Array, other: Array) -> float:
        """Rms difference between the whitened projected forces that two parameter vectors, (P,), predict."""
        difference = self.A @ (phi - other)
        return float(np.sqrt(difference @ difference / max(self.rows, 1)))


PRIOR_DEVIATION = 3.0**-0.5
"""Standard deviation, by its scale, of a parameter that is known to be within its scale of the nominal one.

A mass is then between nothing and twice the nominal one.
"""


FRICTION_WEIGHT_SHARE = 1e-3
"""Share of the weight of a robot's moving bodies that friction may easily be: 1 N of 100 kg."""


def parameter_scale(nominal: Array) -> Array:
    """Size of a plausible deviation of each parameter, (L, 12): its unit in the prior.

    Mass m of the body; first moments m r; inertias m r^2, with r the body's radius of gyration about its link origin;
    friction 1 N m and 1 N m s/rad, or more of a heavy robot: `FRICTION_WEIGHT_SHARE` of the weight of its moving
    bodies, or of that times r where this is more than a metre.
    """
    mass = nominal[:, parameters.MASS]
    typical = mass[mass > 0.0].mean()
    mass = np.maximum(mass, 1e-3 * typical)
    gyration = np.trace(parameters.inertia_matrix(nominal), axis1=1, axis2=2) / 2.0 / mass
    radius = np.sqrt(np.maximum(gyration, 1e-4))  # at least a centimetre
    weight = parameters.GRAVITY * (mass * np.maximum(radius, 1.0))[1:].sum()
    scale = np.full_like(nominal, max(1.0, FRICTION_WEIGHT_SHARE * weight))
    scale[:, parameters.MASS] = mass
    scale[:, parameters.FIRST_MOMENT] = (mass * radius)[:, None]
    scale[:, parameters.INERTIA] = (mass * radius**2)[:, None]
    return scale


_TENSORS = ("blocks", "noise_gram")


@dataclass(repr=False, eq=False)
class TriangularFactor:
    """Compressed rows: R with `R^T R = X^T X` for all rows X added so far; the last column is the right-hand side.

    Rows that are zero outside a few columns are factorized in a block with these columns only. Memory grows with the
    square of the number of columns, not with the number of rows. Householder factorizations keep the full accuracy (a
    Gram matrix would square the condition number). Factors of parts of the data can be merged.

    Attributes:
        columns: number of columns without the right-hand side.
        rows: number of added rows.
        independent_rows: the same, divided by their oversampling.
        blocks: compressed rows (M, len(support) + 1) by their non-zero columns (`support`).
        noise_gram: expected contribution of motion noise to X^T X, (len(support) + 1, len(support) + 1) by columns; an
            estimate, see `torchid.problem.noise_gram`.
    """

    columns: int
    rows: int = 0
    independent_rows: float = 0.0
    blocks: dict[tuple[int, ...], Tensor] = field(default_factory=dict)
    noise_gram: dict[tuple[int, ...], Tensor] = field(default_factory=dict)

    __repr__ = short_repr

    def _headline(self) -> str:
        return f"{self.rows} whitened rows, {self.columns} columns and the right-hand side"

    def __getstate__(self) -> dict[str, object]:
        """State to send to another process: NumPy arrays, because the process may use another device."""
        return vars(self) | {name: {at: x.cpu().numpy() for at, x in vars(self)[name].items()} for name in _TENSORS}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the state that another process sent."""
        tensors = {name: {at: torch.from_numpy(x) for at, x in state[name].items()} for name in _TENSORS}
        vars(self).update(state | tensors)

    @property
    def oversampling(self) -> float:
        """Rows per independent row; 1 for an empty factor."""
        return max(1.0, self.rows / self.independent_rows) if self.rows else 1.0

    def add(self, support: tuple[int, ...], rows: Tensor, oversampling: float = 1.0) -> None:
        """Add rows.

        Args:
            support: columns in which the rows are not zero.
            rows: (M, len(support) + 1), right-hand side last.
            oversampling: rows per independent row, at least 1.
        """
        self.count(rows.shape[0], oversampling)
        self.absorb(support, rows)

    def add_in_place(self, support: tuple[int, ...], stacked: Tensor, oversampling: float = 1.0) -> None:
        """Add rows in a buffer with free space above them; the buffer is overwritten.

        Args:
            support: columns in which the rows are not zero.
            stacked: (len(support) + 1 + M, len(support) + 1), columns contiguous; the rows are the last M.
            oversampling: rows per independent row, at least 1.
        """
        room = stacked.shape[1]
        count = stacked.shape[0] - room
        if count < room:
            self.add(support, stacked[room:], oversampling)
            return
        self.count(count, oversampling)
        kept = self.blocks.get(support)
        above = 0 if kept is None else len(kept)
        stacked[: room - above] = 0.0
        if kept is not None:
            stacked[room - above : room] = kept
        self.blocks[support] = triangularize(stacked)

    def merge(self, *others: TriangularFactor) -> None:
        """Add the rows of other factors.

        Raises:
            ValueError: the factors have different numbers of columns.
        """
        blocks: dict[tuple[int, ...], list[Tensor]] = {}
        for other in others:
            if other.columns != self.columns:
                raise ValueError(f"merge: found {other.columns} columns; accepted: {self.columns} columns")
            self.rows += other.rows
            self.independent_rows += other.independent_rows
            for support, block in other.blocks.items():
                blocks.setdefault(support, []).append(block)
            self.add_noise_gram(other.noise_gram)
        for support, added in blocks.items():
            if support not in self.blocks:
                self.blocks[support] = added.pop(0)
            for start in range(0, len(added), _MERGED):
                self.absorb(support, torch.cat(added[start : start + _MERGED]))

    def add_noise_gram(self, noise_gram: Mapping[tuple[int, ...], Tensor], weight: float = 1.0) -> None:
        """Add to the noise Gram matrix, by columns, times a weight."""
        for support, x in noise_gram.items():
            before = self.noise_gram.get(support)
            self.noise_gram[support] = weight * x if before is None else before + weight * x

    def scaled(self, factor: float) -> TriangularFactor:
        """The factor of the same rows times a number."""
        blocks = {support: factor * block for support, block in self.blocks.items()}
        noise_gram = {support: factor**2 * x for support, x in self.noise_gram.items()}
        return replace(self, blocks=blocks, noise_gram=noise_gram)

    def to_cpu(self) -> TriangularFactor:
        """The factor on the CPU, in float64. A CPU factorizes such small matrices faster than a GPU."""
        blocks = {support: block.to("cpu", torch.float64) for support, block in self.blocks.items()}
        noise_gram = {support: x.to("cpu", torch.float64) for support, x in self.noise_gram.items()}
        return replace(self, blocks=blocks, noise_gram=noise_gram)

    def compact(self) -> TriangularFactor:
        """The factor on the CPU, as one triangle in all columns if this takes less memory than the blocks."""
        sizes = ((len(block), block.shape[1]) for block in self.blocks.values())
        numbers = sum(rows * width - (rows * (rows - 1) // 2 if rows == width else 0) for rows, width in sizes)
        if numbers <= (self.columns + 1) * (self.columns + 2) // 2:
            return self.to_cpu()
        every = tuple(range(self.columns))
        noise_gram: dict[tuple[int, ...], Tensor] = {
            support: x for support, x in self.noise_gram.items() if len(support) == 1
        }
        if len(noise_gram) < len(self.noise_gram):
            noise_gram[every] = self.whole_noise_gram(dict.fromkeys(every, 0.0))
        return replace(self, blocks={every: self.triangle().triu()}, noise_gram=noise_gram)

    def triangle(self) -> Tensor:
        """Upper triangular R, (columns + 1, columns + 1), float64 on the CPU."""
        total = torch.zeros(self.columns + 1, self.columns + 1, dtype=torch.float64)
        scattered = [total]
        for support, block in self.blocks.items():
            wide = torch.zeros(block.shape[0], self.columns + 1, dtype=torch.float64)
            wide[:, [*support, self.columns]] = block.to("cpu", torch.float64)
            scattered.append(wide)
        return triangularize(torch.cat([rows.T for rows in scattered], dim=1).T)

    def noise_gram_of(self, reading_noise: Mapping[int, float]) -> Mapping[tuple[int, ...], Tensor]:
        """Noise Gram matrix with the noise of readings with unknown scale, given as numbers by column."""
        sizes = {
            support: reading_noise.get(support[0], 1.0) if len(support) == 1 else 1.0 for support in self.noise_gram
        }
        return {support: sizes[support] * x for support, x in self.noise_gram.items() if sizes[support]}

    def whole_noise_gram(self, reading_noise: Mapping[int, float] = MappingProxyType({})) -> Tensor:
        """As `noise_gram_of`, in all columns: (columns + 1, columns + 1), float64 on the CPU."""
        total = torch.zeros(self.columns + 1, self.columns + 1, dtype=torch.float64)
        for support, x in self.noise_gram_of(reading_noise).items():
            at = torch.tensor([*support, self.columns])
            total[at[:, None], at] += x.to("cpu", torch.float64)
        return total

    def count(self, rows: int, oversampling: float = 1.0) -> None:
        """Count rows that are passed to `absorb`; a negative number removes rows of zeros from the count."""
        self.rows += rows
        self.independent_rows = self.independent_rows + rows / oversampling if self.rows else 0.0

    @torch.no_grad()
    def absorb(self, support: tuple[int, ...], rows: Tensor) -> None:
        """Add rows (M, len(support) + 1), or a factor of them, without counting them."""
        kept = self.blocks.get(support)
        stacked = torch.cat([rows.T] if kept is None else [kept.T, rows.T], dim=1).T
        self.blocks[support] = stacked if len(stacked) < stacked.shape[1] else triangularize(stacked)


def gram_matrix(X: Tensor) -> Tensor:
    """X X^T of X (n, r, B), rows r of B samples by column; on the CPU NumPy's, which does half of the products."""
    if X.device.type != "cpu":
        return X.flatten(1) @ X.flatten(1).T
    by_row = X.numpy().transpose(1, 0, 2)  # whose products are together what one product of a copy is
    return torch.from_numpy(np.matmul(by_row, by_row.transpose(0, 2, 1)).sum(0))


def triangularize(stacked: Tensor) -> Tensor:
    """R of the factorization of rows (M, columns), columns contiguous, which it overwrites."""
    # the same tensor twice: LAPACK then works in place
    torch.geqrf(stacked, out=(stacked, stacked.new_empty(stacked.shape[1])))
    return stacked[: stacked.shape[1]].triu()
