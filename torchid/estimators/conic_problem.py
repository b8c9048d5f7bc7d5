"""The conic problem of linear data, a prior and conditions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import scipy.linalg

from torchid import parameters
from torchid.errors import InputError
from torchid.estimators.conditions import Conditions, Enclosure, mirror_matrix
from torchid.parameters import PER_BODY, Array
from torchid.problem import LinearProblem

EQUAL_WITHIN = 1e-9
"""Numbers closer than this share of their scale count as equal."""

_SEARCH_RADIUS = 1e3
"""Radius, in scales of the parameters, within which a gap is valid along directions that the data do not determine."""


@dataclass(frozen=True)
class Solution:
    """An approximate minimizer.

    Attributes:
        x: (n,).
        objective: at x.
        gap: duality gap, which bounds how far the objective is above the least one.
        steps: Newton steps.
    """

    x: Array
    objective: float
    gap: float
    steps: int


@dataclass(frozen=True)
class LinearCondition:
    """row @ x >= bound, or == bound, and its name for messages."""

    name: str
    row: Array
    bound: float


@dataclass(frozen=True)
class ConicProblem:
    """min ||R x - r||^2 + c^T x + constant - sum_k w_k log det F_k(x), with F_k(x) >= 0, G x >= h, E x = e.

    The linear matrix inequalities are F_k(x) = F0_k + sum_v x_v F_kv, as in Boyd, Vandenberghe, "Convex Optimization",
    section 4.6, each on ten of the variables.

    Attributes:
        root: R, (m, n); target: r, (m,); linear: c, (n,); constant.
        F0: (K, 4, 4).
        F: (K, 10, 4, 4), zero where an inequality depends on fewer than ten variables.
        variables: (K, 10) int, which entries of x those are.
        weights: (K,) >= 0, of the log-determinants in the objective (an entropic prior's).
        G, h: (M, n), (M,).
        E, e: (Q, n), (Q,), rows of E orthonormal.
        names: (K,) and then (M,): of the conditions, for messages.
        floor: > 0, the objective that counts as 0: below, gaps are relative to this.
        deviations: (n, n): `deviations @ x` is the deviation of the parameters from nominal, in units of their scale,
            and then the terms of the problem in units of their size.
    """

    root: Array
    target: Array
    linear: Array
    constant: float
    F0: Array
    F: Array
    variables: np.ndarray
    weights: Array
    G: Array
    h: Array
    E: Array
    e: Array
    names: tuple[str, ...]
    floor: float
    deviations: Array

    @property
    def degree(self) -> int:
        """Degree of the barrier: near its minimizer at weight kappa the duality gap is this times kappa."""
        return 4 * len(self.F0) + len(self.h)

    @cached_property
    def hessian(self) -> Array:
        """Hessian of the quadratic, (n, n)."""
        return 2.0 * self.root.T @ self.root

    @cached_property
    def null_space(self) -> Array:
        """Orthonormal basis of the null space of E, (n, n - Q)."""
        if not len(self.e):
            return np.eye(len(self.linear))
        return np.ascontiguousarray(np.linalg.svd(self.E)[2][len(self.e) :].T)

    @cached_property
    def unconstrained(self) -> float | None:
        """Least objective without conditions; None where log-determinants keep one."""
        if self.weights.any() or self.linear.any():
            return None
        return self.objective(np.asarray(np.linalg.lstsq(self.root, self.target)[0], dtype=np.float64))

    def blocks(self, x: Array) -> Array:
        """F_k(x), (K, 4, 4)."""
        return self.F0 + np.einsum("kv,kvij->kij", x[self.variables], self.F)

    def slack(self, x: Array) -> Array:
        """Distance of x from the border of every condition: eigenvalues of F_k(x) (4 K,), then G x - h (M,)."""
        return np.concatenate([np.linalg.eigvalsh(self.blocks(x)).ravel(), self.G @ x - self.h])

    def active(self, x: Array, tolerance: float) -> tuple[str, ...]:
        """Names of conditions from whose border x (n,) is no further than a tolerance; an entropic prior is none."""
        blocks, rows = np.split(self.slack(x), [4 * len(self.F0)])
        slack = np.append(np.where(self.weights > 0.0, np.inf, blocks.reshape(-1, 4).min(axis=1, initial=np.inf)), rows)
        return tuple(dict.fromkeys(name for name, one in zip(self.names, slack, strict=True) if one <= tolerance))

    def gradient(self, x: Array) -> Array:
        """Gradient of the quadratic and the linear term, (n,)."""
        return 2.0 * self.root.T @ (self.root @ x - self.target) + self.linear

    def objective(self, x: Array) -> float:
        """Objective at x (n,); inf where a block with a weight is not positive definite."""
        misfit = self.root @ x - self.target
        value = misfit @ misfit + self.linear @ x + self.constant
        weighted = self.weights > 0.0
        if weighted.any():
            eigenvalues = np.linalg.eigvalsh(self.blocks(x)[weighted])
            if eigenvalues.min() <= 0.0:
                return np.inf
            value -= float((self.weights[weighted] * np.log(eigenvalues).sum(1)).sum())
        return float(value)

    def gap(self, x: Array, Z: Array, y: Array) -> float:
        """Objective at x less the dual objective: no feasible point within `_SEARCH_RADIUS` is better by more.

        Whatever the multipliers, weak duality holds, so that this bounds the error of any solver.

        Args:
            x: (n,), a point that meets the conditions.
            Z: (K, 4, 4), positive semidefinite multipliers of the blocks; of weighted blocks, w_k / J_k and the like.
            y: (M,) >= 0, multipliers of the rows.
        """
        blocks, weighted = self.blocks(x), self.weights > 0.0
        multiplier_slopes = np.zeros_like(self.F)  # w F^-1 dF F^-1 of weighted blocks
        inverse = np.linalg.inv(blocks[weighted])[:, None]
        multiplier_slopes[weighted] = self.weights[weighted, None, None, None] * inverse @ self.F[weighted] @ inverse
        residual = self.gradient(x) - self.G.T @ y - self._gathered(Z)
        # A Newton step balances the part of it in directions in which quadratic and log-determinants are stiff enough.
        step = None if weighted.any() else self._balancing_step(residual)
        if step is None:
            values, vectors = self._stiffness_modes(multiplier_slopes)
            modes = vectors.T @ (self.null_space.T @ residual)
            balanced = np.abs(modes) <= 2.0 * _SEARCH_RADIUS * values
            lengths = modes[balanced] / np.maximum(values[balanced], np.finfo(float).tiny)
            step = -self.null_space @ (vectors[:, balanced] @ lengths)
        multiplier_change = np.einsum("kv,kvij->kij", step[self.variables], multiplier_slopes)
        unbalanced = self.null_space.T @ (residual + self.hessian @ step + self._gathered(multiplier_change))
        gap = 0.5 * step @ self.hessian @ step + y @ (self.G @ x - self.h) + _SEARCH_RADIUS * np.abs(unbalanced).sum()
        products = blocks @ (Z - multiplier_change)
        gap += np.trace(products[~weighted], axis1=1, axis2=2).sum()
        weights = self.weights[weighted, None]
        relative = np.linalg.eigvals(products[weighted]).real / weights
        if relative.min(initial=1.0) <= 0.0:
            return np.inf
        return float(gap + (weights * (relative - 1.0 - np.log(relative))).sum())

    def _balancing_step(self, residual: Array) -> Array | None:
        """The Newton step of the quadratic; None where it is not stiff enough in all directions."""
        if self._stiffness_root is None:
            return None
        lengths = scipy.linalg.cho_solve((self._stiffness_root, True), self.null_space.T @ residual)
        return -self.null_space @ lengths if np.linalg.norm(lengths) <= 2.0 * _SEARCH_RADIUS else None

    @cached_property
    def _stiffness_root(self) -> Array | None:
        """Lower triangular factor of the quadratic in the null space of the equalities; None by rounding."""
        reduced = self.null_space.T @ self.hessian @ self.null_space if len(self.e) else self.hessian
        try:
            return np.asarray(np.linalg.cholesky(reduced))
        except np.linalg.LinAlgError:
            return None

    def _stiffness_modes(self, multiplier_slopes: Array) -> tuple[Array, Array]:
        """Those of quadratic and log-determinants, whose multipliers change by these slopes, (K, 10, 4, 4)."""
        hessian = self.hessian.copy()
        pairs = (self.variables[:, :, None], self.variables[:, None, :])
        np.add.at(hessian, pairs, np.einsum("kuij,kvij->kuv", multiplier_slopes, self.F))
        values, vectors = np.linalg.eigh(self.null_space.T @ hessian @ self.null_space)
        return values, vectors

    def _gathered(self, Z: Array) -> Array:
        """Sum of <Z_k, dF_k/dx>, (n,)."""
        out = np.zeros(len(self.linear))
        np.add.at(out, self.variables, np.einsum("kvij,kij->kv", self.F, Z))
        return out


def reduce_equalities(rows: list[LinearCondition], count: int) -> tuple[Array, Array]:
    """The same equalities E x = e in as few orthonormal rows as they have rank.

    Args:
        rows: the equalities.
        count: of entries in x, n.

    Returns:
        E, (rank, n), with orthonormal rows, and e, (rank,).

    Raises:
        InputError: they contradict each other, or parameters that are not free.
    """
    E, e = np.array([row.row for row in rows]).reshape(len(rows), count), np.array([row.bound for row in rows])
    U, values, right = np.linalg.svd(E, full_matrices=False)
    kept = values > 1e-10 * values.max(initial=0.0)
    off = np.abs(e - U[:, kept] @ (U[:, kept].T @ e)) > EQUAL_WITHIN * (1.0 + np.abs(e).max(initial=0.0))
    if off.any():
        names = ", ".join(dict.fromkeys(row.name for row, wrong in zip(rows, off, strict=True) if wrong))
        found = "contradicts what is held fixed or the other equalities"
        raise InputError("estimator", names, found, "equalities that some parameters meet")
    return right[kept], (U[:, kept].T @ e) / values[kept]


def remove_implied(rows: list[LinearCondition], E: Array, e: Array) -> list[LinearCondition]:
    """The inequalities without those that equalities E x = e imply: with them there is no strictly feasible point.

    Raises:
        InputError: an inequality contradicts the equalities.
    """
    out = []
    for row in rows:
        along = E @ row.row
        if np.linalg.norm(row.row - E.T @ along) > EQUAL_WITHIN * np.linalg.norm(row.row):
            out.append(row)
        elif along @ e < row.bound - EQUAL_WITHIN * (1.0 + abs(row.bound)):
            raise InputError("estimator", row.name, "excluded by equalities", "conditions that some robot can meet")
    return out


Prior = Literal["euclidean", "pullback", "entropic"]

_FLOOR_OF_DATA, _FLOOR_OF_RIDGE = 1e-8, 1e-3  # shares of the mean square of the data, of the ridge


@dataclass(frozen=True)
class _Block:
    """A linear matrix inequality F0 + sum_v x_v F_v >= 0 on ten variables, F0 (4, 4) and F (10, 4, 4)."""

    name: str
    F0: Array
    F: Array
    variables: np.ndarray


class _Variables:
    """Indices in x of the free parameters, and the values of the fixed ones, all in units of their scale.

    `deviations @ x` is the deviation of the free parameters from nominal, followed by the problem's terms, (n,).
    """

    def __init__(self, problem: LinearProblem, conditions: Conditions) -> None:
        self.body_name = conditions.body_name
        self.free, self.parameters = problem.free.reshape(-1, PER_BODY), int(problem.free.sum())
        self.count = self.parameters + (0 if problem.terms is None else len(problem.terms.size))
        self.index = (np.cumsum(problem.free) - 1).reshape(-1, PER_BODY)
        self.scale = problem.scale.reshape(-1, PER_BODY)
        self.nominal = problem.nominal.reshape(-1, PER_BODY) / self.scale
        self.bodies = [int(body) for body in problem.free_bodies()]
        self.deviations, self._are_deviations = np.eye(self.count), True

    def ten(self, body: int) -> np.ndarray:
        """Variables of a body's inertial parameters, (10,)."""
        return self.index[body, parameters.INERTIAL]

    def use_pseudo_inertia_roots(self, roots: Mapping[int, Array]) -> None:
        """Use the entries of U as variables, with J = J_0 + L U L^T and roots L, (4, 4), of the pseudo-inertias.

        Then the priors of pseudo-inertias are equally stiff in all directions. In units of the scale they would be 1e20
        times stiffer across a flat body than along it, and ill-conditioned.
        """
        for body, root in roots.items():
            self.deviations[np.ix_(self.ten(body), self.ten(body))] = parameters.change_of_frame(root)
            self._are_deviations = False

    def of_deviations(self, rows: Array) -> Array:
        """Rows on the deviations, (m, n), as rows on x."""
        return rows if self._are_deviations else rows @ self.deviations

    def row(self, body: int, weights: Array) -> tuple[Array, float]:
        """`weights @ phi` of a body, (12,), as a row on x and a constant."""
        scaled = weights * self.scale[body]
        row, free = np.zeros(self.count), self.free[body]
        row[self.index[body][free]] = scaled[free]
        return row @ self.deviations, float(scaled @ self.nominal[body])


def build_conic_problem(
    problem: LinearProblem, conditions: Conditions, ridge: float, prior: Prior, reference: Array | None = None
) -> ConicProblem:
    """The convex problem in x, the deviation of the free parameters from nominal in units of their scale.

    Args:
        problem: the data.
        conditions: on the parameters.
        ridge: weight of the prior.
        prior: the distance from the nominal parameters, as in `Consistent`.
        reference: (12 L,), parameters whose pseudo-inertias are the metric of a pull-back prior; None for nominal ones.
    """
    conditions.validate_bodies(len(problem.nominal) // PER_BODY)
    x = _Variables(problem, conditions)
    if prior != "euclidean":
        measured = problem.nominal if reference is None else reference
        scaled = measured.reshape(-1, PER_BODY) / x.scale
        x.use_pseudo_inertia_roots(
            {body: _pseudo_inertia_root(scaled[body], x.body_name(body), prior) for body in x.bodies}
        )
    blocks = [_pseudo_inertia_block(x, body, conditions.margin) for body in x.bodies]
    enclosures = [enclosure for enclosure in conditions.enclosures if enclosure.body in x.bodies]
    blocks += [_ellipsoid_block(x, enclosure) for enclosure in enclosures if enclosure.kind == "ellipsoid"]
    boxes = [_box_conditions(x, enclosure) for enclosure in enclosures if enclosure.kind == "box"]
    E, e = _equalities(x, conditions)
    rows = remove_implied([*_bounds(x, conditions), *_signs(x, problem), *sum(boxes, [])], E, e)
    weights, linear, metric = np.zeros(len(blocks)), np.zeros(x.count), np.eye(x.parameters, x.count)
    if prior == "pullback":
        metric = _pullback_metric(x)
    elif prior == "entropic":
        relative = [
            _Block(f"pseudo-inertia of {x.body_name(body)}", np.eye(4), parameters.PSEUDO_BASIS, x.ten(body))
            for body in x.bodies
        ]  # J_0^-1/2 J J_0^-1/2
        for block in relative:
            metric[block.variables] = 0.0
            linear[block.variables] = ridge * np.trace(block.F, axis1=1, axis2=2)
        blocks += relative
        weights = np.append(weights, np.full(len(relative), ridge))
    metric = np.vstack([metric, _prior_of_terms(x, problem)])
    root, target, unexplained = _compressed(problem, x, np.sqrt(ridge) * metric)
    return ConicProblem(
        root=root,
        target=target,
        linear=linear,
        constant=unexplained,
        F0=np.array([block.F0 for block in blocks]).reshape(-1, 4, 4),
        F=np.array([block.F for block in blocks]).reshape(len(blocks), 10, 4, 4),
        variables=np.array([block.variables for block in blocks], dtype=np.int64).reshape(-1, 10),
        weights=weights,
        G=np.array([row.row for row in rows]).reshape(len(rows), x.count),
        h=np.array([row.bound for row in rows]),
        E=E,
        e=e,
        names=(*(block.name for block in blocks), *(row.name for row in rows)),
        floor=_floor(problem, ridge),
        deviations=x.deviations,
    )


def _compressed(problem: LinearProblem, x: _Variables, prior: Array) -> tuple[Array, Array, float]:
    """Data, with no more rows than columns, and quadratic prior as ||root x - target||^2 + constant."""
    free, rows, terms = problem.free, max(problem.rows, 1), problem.terms
    A, b = problem.A[:, free] * problem.scale[free], problem.b - problem.A @ problem.nominal
    if terms is not None:
        A = np.block(
            [[A, np.zeros((len(A), len(terms.size)))], [terms.C[:, free] * problem.scale[free], terms.D * terms.size]]
        )
        b = np.append(b, terms.z - terms.C @ problem.nominal)
    A, b, unexplained = x.of_deviations(A) / np.sqrt(rows), b / np.sqrt(rows), problem.residual / rows
    if len(A) > x.count:
        triangle = np.asarray(np.linalg.qr(np.column_stack([A, b]), mode="r"))
        A, b = triangle[: x.count, : x.count], triangle[: x.count, x.count]
        unexplained += float(np.square(triangle[x.count :, x.count]).sum())
    return np.concatenate([A, prior]), np.append(b, np.zeros(len(prior))), unexplained


def _floor(problem: LinearProblem, ridge: float) -> float:
    """The objective that counts as 0, to which gaps are relative below."""
    data = (float(problem.b @ problem.b) + problem.residual) / max(problem.rows, 1)
    return max(_FLOOR_OF_DATA * data, _FLOOR_OF_RIDGE * ridge) or 1.0


def _pseudo_inertia_block(x: _Variables, body: int, margin: float) -> _Block:
    """Scaled pseudo-inertia of a body less the margin, positive semidefinite (Wensing, Kim, Slotine 2018)."""
    F0 = parameters.pseudo_inertia(x.nominal[body]) - margin * np.eye(4)
    return _block(x, f"pseudo-inertia of {x.body_name(body)}", body, F0, parameters.PSEUDO_BASIS)


def _block(x: _Variables, name: str, body: int, F0: Array, slopes: Array) -> _Block:
    """A matrix inequality from its slopes, (10, 4, 4), in a body's ten parameters in units of their scale."""
    variables = x.ten(body)
    by_variable = np.einsum("wv,wij->vij", x.deviations[np.ix_(variables, variables)], slopes)
    return _Block(name, F0, by_variable, variables)


def _ellipsoid_block(x: _Variables, enclosure: Enclosure) -> _Block:
    """[[m 1, u], [u^T, m]] with u = (m com - m centre) / half along the axes: positive iff |u| <= m."""
    body, slopes = enclosure.body, np.zeros((10, 4, 4))
    to_axes = (enclosure.axes / enclosure.half).T  # (3, 3)
    mass, moments = x.scale[body, parameters.MASS], x.scale[body, parameters.FIRST_MOMENT]
    slopes[parameters.MASS] = mass * np.eye(4)
    slopes[parameters.MASS, :3, 3] = slopes[parameters.MASS, 3, :3] = -mass * (to_axes @ enclosure.centre)
    for number, column in zip(range(10)[parameters.FIRST_MOMENT], (to_axes * moments).T, strict=True):
        slopes[number, :3, 3] = slopes[number, 3, :3] = column
    slopes /= mass
    F0 = np.einsum("v,vij->ij", x.nominal[body, parameters.INERTIAL], slopes)
    return _block(x, f"centre of mass of {x.body_name(body)}", body, F0, slopes)


def _box_conditions(x: _Variables, enclosure: Enclosure) -> list[LinearCondition]:
    """M half +- (m com - m centre) >= 0 along each axis of the box."""
    out = []
    for axis, half in zip(enclosure.axes.T, enclosure.half, strict=True):
        for sign in (1.0, -1.0):
            weights = np.zeros(PER_BODY)
            weights[parameters.MASS] = 1.0 - sign * (axis @ enclosure.centre) / half
            weights[parameters.FIRST_MOMENT] = sign * axis / half
            row, constant = x.row(enclosure.body, weights / x.scale[enclosure.body, parameters.MASS])
            out.append(LinearCondition(f"centre of mass of {x.body_name(enclosure.body)}", row, -constant))
    return out


def _bounds(x: _Variables, conditions: Conditions) -> list[LinearCondition]:
    """Bounds of the free parameters, except coinciding ones, which are in `_equalities`."""
    lower, upper = conditions.bounds(len(x.free))
    out = []
    for bound, sign, word in ((lower, 1.0, "lower"), (upper, -1.0, "upper")):
        for body, number in zip(*np.nonzero(np.isfinite(bound) & x.free & ~_coincide(x, lower, upper)), strict=True):
            row = sign * x.deviations[x.index[body, number]]
            limit = sign * (bound[body, number] / x.scale[body, number] - x.nominal[body, number])
            name = f"{word} bound of {parameters.PARAMETERS[number]} of {x.body_name(body)}"
            out.append(LinearCondition(name, row, float(limit)))
    return out


def _signs(x: _Variables, problem: LinearProblem) -> list[LinearCondition]:
    """Conditions on the problem's terms."""
    terms, out = problem.terms, list[LinearCondition]()
    if terms is None:
        return out
    for one in terms.conditions_at(problem.free, problem.nominal):
        row = np.concatenate([(one.parameters * problem.scale)[problem.free], one.terms * terms.size])
        bound = -float(one.parameters @ problem.nominal)
        out.append(LinearCondition(one.name, row @ x.deviations / one.size, bound / one.size))
    return out


def _prior_of_terms(x: _Variables, problem: LinearProblem) -> Array:
    """Terms have no prior but in combinations that no row depends on, (k, n)."""
    undetermined = np.zeros((0, 0)) if problem.terms is None else problem.terms.undetermined
    return np.hstack([np.zeros((len(undetermined), x.parameters)), undetermined])


def _coincide(x: _Variables, lower: Array, upper: Array) -> np.ndarray:
    """Where lower and upper bounds, (L, 12), are equal, (L, 12) bool."""
    return np.asarray(upper - lower <= EQUAL_WITHIN * x.scale)


def _equalities(x: _Variables, conditions: Conditions) -> tuple[Array, Array]:
    """Total mass, mirror images and bounds that coincide, as orthonormal rows E x = e."""
    out: list[LinearCondition] = []
    if conditions.total_mass is not None:
        mass = np.eye(PER_BODY)[parameters.MASS] / conditions.total_mass
        mass_rows = [x.row(body, mass) for body in range(len(x.free))]
        row = np.sum([row for row, _ in mass_rows], axis=0)
        out.append(LinearCondition("total_mass", row, 1.0 - sum(constant for _, constant in mass_rows)))
    for mirror in conditions.mirrors:
        reflected = mirror_matrix(mirror.reflection)
        for number, unit in enumerate(np.eye(PER_BODY)):
            size = x.scale[mirror.image, number]
            (left, known), (right, fixed) = x.row(mirror.body, reflected[number]), x.row(mirror.image, unit)
            name = f"{x.body_name(mirror.image)} as mirror image of {x.body_name(mirror.body)}"
            out.append(LinearCondition(name, (left - right) / size, (fixed - known) / size))
    lower, upper = conditions.bounds(len(x.free))
    for body, number in zip(*np.nonzero(_coincide(x, lower, upper) & x.free), strict=True):
        least, most, scale = lower[body, number], upper[body, number], x.scale[body, number]
        name = f"bounds of {parameters.PARAMETERS[number]} of {x.body_name(body)}"
        if least - most > EQUAL_WITHIN * scale:
            raise InputError("estimator", name, f"{least:g} above {most:g}", "a lower bound below the upper one")
        value = 0.5 * (least + most) / scale - x.nominal[body, number]
        out.append(LinearCondition(name, x.deviations[x.index[body, number]], value))
    return reduce_equalities(out, x.count)


def _pullback_metric(x: _Variables) -> Array:
    """Root of the constant pull-back metric (Lee, Wensing, Park 2020).

    Per body it is J_0^-1/2 dJ J_0^-1/2, of friction the scaled deviation.
    """
    rows = [np.eye(x.count)[x.index[:, parameters.FRICTION][x.free[:, parameters.FRICTION]]]]
    for body in x.bodies:
        row = np.zeros((16, x.count))
        row[:, x.ten(body)] = parameters.PSEUDO_BASIS.reshape(10, 16).T
        rows.append(row)
    return np.concatenate(rows)


def _pseudo_inertia_root(scaled: Array, called: str, prior: Prior) -> Array:
    """L, (4, 4), of the pseudo-inertia J = L L^T of scaled parameters (12,)."""
    J = parameters.pseudo_inertia(scaled)
    if np.linalg.eigvalsh(J)[0] <= np.finfo(float).eps * np.trace(J):
        found = f"{prior}, but the pseudo-inertia of {called} that it is relative to is not positive definite"
        raise InputError("estimator", "prior", found, "euclidean, or physically consistent bodies")
    return np.asarray(np.linalg.cholesky(J))
