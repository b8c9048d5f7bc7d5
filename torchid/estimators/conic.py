"""The conic problem of linear data, a prior and conditions, and the interior-point method that solves it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from torchid import parameters
from torchid.errors import InputError, NumericalWarning, warn
from torchid.estimators.conditions import Conditions, Enclosure, mirror_matrix
from torchid.parallel import one_thread
from torchid.parameters import PER_BODY, Array
from torchid.problem import LinearProblem

EQUAL_WITHIN = 1e-9
"""Numbers closer than this share of their scale count as equal."""

_FEASIBLE = "conditions that can all be met together"
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
        """Names of conditions that hold with equality at x (n,), within a tolerance."""
        blocks, rows = np.split(self.slack(x), [4 * len(self.F0)])
        slack = np.append(np.where(self.weights > 0.0, np.inf, blocks.reshape(-1, 4).min(axis=1, initial=np.inf)), rows)
        near = slack <= tolerance
        return tuple(dict.fromkeys(name for name, is_near in zip(self.names, near, strict=True) if is_near))

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
        blocks = self.blocks(x)
        weighted = self.weights > 0.0
        multiplier_slopes = np.zeros_like(self.F)  # w F^-1 dF F^-1 of weighted blocks
        inverse = np.linalg.inv(blocks[weighted])[:, None]
        multiplier_slopes[weighted] = self.weights[weighted, None, None, None] * inverse @ self.F[weighted] @ inverse
        residual = self.gradient(x) - self.G.T @ y - self._gathered(Z)
        step = self._balancing_step(residual, multiplier_slopes)
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

    def _balancing_step(self, residual: Array, multiplier_slopes: Array) -> Array:
        """The Newton step of quadratic and log-determinants, damped: short in directions without stiffness, (n,).

        Args:
            residual: of the gradient, (n,).
            multiplier_slopes: changes of the log-determinants' multipliers, (K, 10, 4, 4).
        """
        hessian = self.hessian
        if self.weights.any():
            hessian = hessian.copy()
            pairs = (self.variables[:, :, None], self.variables[:, None, :])
            np.add.at(hessian, pairs, np.einsum("kuij,kvij->kuv", multiplier_slopes, self.F))
        N = self.null_space
        along = N.T @ residual
        stiffness = N.T @ hessian @ N if len(self.e) else hessian.copy()
        rounding = np.finfo(float).eps * np.trace(stiffness) + np.finfo(float).tiny
        stiffness[np.diag_indices_from(stiffness)] += np.abs(along).max(initial=0.0) / _SEARCH_RADIUS + rounding
        return np.asarray(-N @ np.linalg.solve(stiffness, along))

    def _gathered(self, Z: Array) -> Array:
        """Sum of <Z_k, dF_k/dx>, (n,)."""
        out = np.zeros(len(self.linear))
        np.add.at(out, self.variables, np.einsum("kvij,kij->kv", self.F, Z))
        return out


def _reduced(rows: list[LinearCondition], count: int) -> tuple[Array, Array]:
    """Equalities on x (count,) as E x = e, in as few orthonormal rows as they have rank, and their right-hand sides.

    Raises:
        InputError: they contradict each other, or parameters that are not free.
    """
    E = np.array([row.row for row in rows]).reshape(len(rows), count)
    e = np.array([row.bound for row in rows])
    U, values, right = np.linalg.svd(E, full_matrices=False)
    kept = values > 1e-10 * values.max(initial=0.0)
    off = np.abs(e - U[:, kept] @ (U[:, kept].T @ e)) > EQUAL_WITHIN * (1.0 + np.abs(e).max(initial=0.0))
    if off.any():
        names = ", ".join(dict.fromkeys(row.name for row, wrong in zip(rows, off, strict=True) if wrong))
        raise InputError("estimator", names, "contradicts fixed parameters or other equality constraints", _FEASIBLE)
    return right[kept], (U[:, kept].T @ e) / values[kept]


def _without_implied(rows: list[LinearCondition], E: Array, e: Array) -> list[LinearCondition]:
    """Drop the inequalities that the equalities E x = e already imply; with them no point is strictly feasible.

    Raises:
        InputError: an inequality contradicts the equalities.
    """
    out = []
    for row in rows:
        along = E @ row.row
        if np.linalg.norm(row.row - E.T @ along) > EQUAL_WITHIN * np.linalg.norm(row.row):
            out.append(row)
        elif along @ e < row.bound - EQUAL_WITHIN * (1.0 + abs(row.bound)):
            raise InputError("estimator", row.name, "contradicts the equality constraints", _FEASIBLE)
    return out


Prior = Literal["euclidean", "pullback", "entropic"]

_FLOOR_OF_DATA = 1e-8  # fraction of the mean square of the data
_FLOOR_OF_RIDGE = 1e-3  # fraction of the ridge


class _Scaled:
    """Parameters and terms in scaled units: `start + slopes @ x`.

    Attributes:
        start, slopes: (12 L + M,) and (12 L + M, n), zero rows for fixed parameters.
        deviations: (n, n), the other rows.
        place: (L, 12) int, entry of x of each free parameter.
        bodies: bodies with free inertia.
    """

    def __init__(self, problem: LinearProblem, conditions: Conditions, prior: Prior, metric: Array) -> None:
        """Arguments as of `build_conic_problem`; `metric`, (12 L,), has the pseudo-inertias J_0 = L L^T of a prior.

        Of all but the Euclidean one the entries of U, with J = J_0 + L U L^T, are variables: so the prior is equally
        stiff in all directions. In units of the scale it would be 1e20 times stiffer across a flat body than along it.
        """
        self.name = conditions.body_name
        terms = 0 if problem.terms is None else len(problem.terms.size)
        self.free = problem.free.reshape(-1, PER_BODY)
        self.scale = problem.scale.reshape(-1, PER_BODY)
        self.start = np.concatenate([problem.nominal / problem.scale, np.zeros(terms)])
        self.parameters = int(problem.free.sum())
        self.place = (np.cumsum(problem.free) - 1).reshape(-1, PER_BODY)
        self.bodies = [int(body) for body in problem.free_bodies()]
        self.deviations = np.eye(self.parameters + terms)
        scaled = metric.reshape(-1, PER_BODY) / self.scale
        for body in self.bodies if prior != "euclidean" else ():
            at = self.ten(body)
            root = _pseudo_inertia_root(scaled[body], self.name(body), prior)
            self.deviations[np.ix_(at, at)] = parameters.change_of_frame(root)
        self.slopes = np.zeros((len(self.start), len(self.deviations)))
        self.slopes[np.append(problem.free, np.ones(terms, dtype=bool))] = self.deviations

    def ten(self, body: int) -> np.ndarray:
        """Entries of x of a body's inertial parameters, (10,)."""
        return self.place[body, parameters.INERTIAL]

    def condition(self, name: str, weights: Mapping[tuple[int, int], float] | Array, bound: float) -> LinearCondition:
        """The condition weights @ scaled >= (or ==) bound on x; weights by body and parameter, or all, (12 L + M,)."""
        if isinstance(weights, Mapping):
            whole = np.zeros(len(self.start))
            for (body, number), weight in weights.items():
                whole[PER_BODY * body + number] = weight
            weights = whole
        return LinearCondition(name, weights @ self.slopes, bound - float(weights @ self.start))

    def block(self, name: str, body: int, constant: Array, basis: Array) -> _Block:
        """The inequality constant + sum_v basis_v scaled_v >= 0, of a body's ten parameters, on x; basis (10, 4, 4)."""
        variables = self.ten(body)
        ten = slice(PER_BODY * body, PER_BODY * body + len(basis))
        F0 = constant + np.tensordot(self.start[ten], basis, axes=1)
        return _Block(name, F0, np.tensordot(self.slopes[ten][:, variables].T, basis, axes=1), variables)


@dataclass(frozen=True)
class _Block:
    """A linear matrix inequality F0 + sum_v x_v F_v >= 0 on ten variables, F0 (4, 4) and F (10, 4, 4)."""

    name: str
    F0: Array
    F: Array
    variables: np.ndarray


def build_conic_problem(
    problem: LinearProblem, conditions: Conditions, ridge: float, prior: Prior, reference: Array | None = None
) -> ConicProblem:
    """Build the convex problem in x, the scaled deviation of the free parameters from the nominal ones.

    Args:
        problem: the data.
        conditions: on the parameters.
        ridge: weight of the prior.
        prior: distance from the nominal parameters, as in `Consistent`.
        reference: (12 L,), pseudo-inertias of the metric of a pull-back prior; None for the nominal ones.
    """
    conditions.validate_bodies(len(problem.nominal) // PER_BODY)
    x = _Scaled(problem, conditions, prior, problem.nominal if reference is None else reference)
    margin = -conditions.margin * np.eye(4)  # Wensing, Kim, Slotine 2018
    blocks = [x.block(f"pseudo-inertia of {x.name(k)}", k, margin, parameters.PSEUDO_BASIS) for k in x.bodies]
    rows = _inequalities(x, problem, conditions)
    for enclosure in (candidate for candidate in conditions.enclosures if candidate.body in x.bodies):
        if enclosure.kind == "ellipsoid":
            blocks.append(_ellipsoid_block(x, enclosure))
        else:
            rows += _box_conditions(x, enclosure)
    count = len(x.deviations)
    E, e = _reduced(_equalities(x, conditions), count)
    rows = _without_implied(rows, E, e)
    weights = np.zeros(len(blocks))
    linear = np.zeros(count)
    metric = np.eye(x.parameters, count)
    for body in x.bodies if prior != "euclidean" else ():
        metric[x.ten(body)] = 0.0
        if prior == "entropic":  # of J_0^-1/2 J J_0^-1/2
            linear[x.ten(body)] = ridge * np.trace(parameters.PSEUDO_BASIS, axis1=1, axis2=2)
            name = f"pseudo-inertia of {x.name(body)}"
            blocks.append(_Block(name, np.eye(4), parameters.PSEUDO_BASIS, x.ten(body)))
            weights = np.append(weights, ridge)
        else:  # J_0^-1/2 dJ J_0^-1/2, as Lee, Wensing, Park 2020
            of_body = np.zeros((16, count))
            of_body[:, x.ten(body)] = parameters.PSEUDO_BASIS.reshape(10, 16).T
            metric = np.concatenate([metric, of_body])
    if problem.terms is not None:  # no prior but in combinations that no row depends on
        undetermined = problem.terms.undetermined
        metric = np.vstack([metric, np.hstack([np.zeros((len(undetermined), x.parameters)), undetermined])])
    root, target, unexplained = _compressed(problem, x, np.sqrt(ridge) * metric[metric.any(axis=1)])
    data = (float(problem.b @ problem.b) + problem.residual) / max(problem.rows, 1)
    return ConicProblem(
        root=root,
        target=target,
        linear=linear,
        constant=unexplained,
        F0=np.array([block.F0 for block in blocks]).reshape(-1, 4, 4),
        F=np.array([block.F for block in blocks]).reshape(len(blocks), 10, 4, 4),
        variables=np.array([block.variables for block in blocks], dtype=np.int64).reshape(-1, 10),
        weights=weights,
        G=np.array([row.row for row in rows]).reshape(len(rows), count),
        h=np.array([row.bound for row in rows]),
        E=E,
        e=e,
        names=(*(block.name for block in blocks), *(row.name for row in rows)),
        floor=max(_FLOOR_OF_DATA * data, _FLOOR_OF_RIDGE * ridge) or 1.0,
        deviations=x.deviations,
    )


def _compressed(problem: LinearProblem, x: _Scaled, prior: Array) -> tuple[Array, Array, float]:
    """Data, with no more rows than columns, and quadratic prior as ||root x - target||^2 + constant."""
    rows = max(problem.rows, 1)
    terms = problem.terms
    count = len(x.deviations)
    columns = problem.A * problem.scale
    b = problem.b - problem.A @ problem.nominal
    if terms is not None:
        of_terms = np.hstack([terms.C * problem.scale, terms.D * terms.size])
        columns = np.vstack([np.hstack([columns, np.zeros((len(columns), len(terms.size)))]), of_terms])
        b = np.append(b, terms.z - terms.C @ problem.nominal)
    A = columns @ x.slopes / np.sqrt(rows)
    b = b / np.sqrt(rows)
    unexplained = problem.residual / rows
    if len(A) > count:
        triangle = np.asarray(np.linalg.qr(np.column_stack([A, b]), mode="r"))
        A = triangle[:count, :count]
        b = triangle[:count, count]
        unexplained += float(np.square(triangle[count:, count]).sum())
    return np.concatenate([A, prior]), np.append(b, np.zeros(len(prior))), unexplained


def _ellipsoid_block(x: _Scaled, enclosure: Enclosure) -> _Block:
    """[[m 1, u], [u^T, m]] with u = (m com - m centre) / half along the axes: positive iff |u| <= m."""
    body = enclosure.body
    basis = np.zeros((10, 4, 4))
    to_axes = (enclosure.axes / enclosure.half).T  # (3, 3)
    mass = x.scale[body, parameters.MASS]
    moments = x.scale[body, parameters.FIRST_MOMENT]
    basis[parameters.MASS] = np.eye(4)
    basis[parameters.MASS, :3, 3] = basis[parameters.MASS, 3, :3] = -(to_axes @ enclosure.centre)
    for number, column in zip(range(10)[parameters.FIRST_MOMENT], (to_axes * moments / mass).T, strict=True):
        basis[number, :3, 3] = basis[number, 3, :3] = column
    return x.block(f"centre of mass of {x.name(body)}", body, np.zeros((4, 4)), basis)


def _box_conditions(x: _Scaled, enclosure: Enclosure) -> list[LinearCondition]:
    """M half +- (m com - m centre) >= 0 along each axis of the box."""
    body = enclosure.body
    out = []
    moments = x.scale[body, parameters.FIRST_MOMENT] / x.scale[body, parameters.MASS]
    for axis, half in zip(enclosure.axes.T, enclosure.half, strict=True):
        for sign in (1.0, -1.0):
            weights = {(body, parameters.MASS): 1.0 - sign * (axis @ enclosure.centre) / half}
            for number, weight in zip(range(10)[parameters.FIRST_MOMENT], sign * axis * moments / half, strict=True):
                weights[body, number] = weight
            out.append(x.condition(f"centre of mass of {x.name(body)}", weights, 0.0))
    return out


def _inequalities(x: _Scaled, problem: LinearProblem, conditions: Conditions) -> list[LinearCondition]:
    """Bounds of the free parameters, except coinciding ones, which are equalities, and conditions on terms."""
    out = list[LinearCondition]()
    terms = problem.terms
    lower, upper = conditions.bounds(len(x.free))
    differ = upper - lower > EQUAL_WITHIN * x.scale
    for bound, sign, word in ((lower, 1.0, "lower"), (upper, -1.0, "upper")):
        for body, number in zip(*np.nonzero(np.isfinite(bound) & x.free & differ), strict=True):
            name = f"{word} bound of {parameters.PARAMETERS[number]} of {x.name(body)}"
            limit = sign * float(bound[body, number] / x.scale[body, number])
            out.append(x.condition(name, {(body, number): sign}, limit))
    if terms is not None:
        for known in terms.conditions_at(problem.free, problem.nominal):
            weights = np.concatenate([known.parameters * problem.scale, known.terms * terms.size]) / known.size
            out.append(x.condition(known.name, weights, 0.0))
    return out


def _equalities(x: _Scaled, conditions: Conditions) -> list[LinearCondition]:
    """Total mass, mirror images and bounds that coincide."""
    out = list[LinearCondition]()
    scale = x.scale
    lower, upper = conditions.bounds(len(x.free))
    if conditions.total_mass is not None:
        masses = scale[:, parameters.MASS] / conditions.total_mass
        weights = {(body, parameters.MASS): float(mass) for body, mass in enumerate(masses)}
        out.append(x.condition("total_mass", weights, 1.0))
    for mirror in conditions.mirrors:
        body = mirror.body
        image = mirror.image
        for number, row in enumerate(mirror_matrix(mirror.reflection)):
            weights = {(image, number): -1.0}
            for other, weight in enumerate(row * scale[body] / scale[image, number]):
                weights[body, other] = weights.get((body, other), 0.0) + float(weight)
            out.append(x.condition(f"{x.name(image)} as mirror image of {x.name(body)}", weights, 0.0))
    for body, number in zip(*np.nonzero((upper - lower <= EQUAL_WITHIN * scale) & x.free), strict=True):
        least = lower[body, number]
        most = upper[body, number]
        name = f"bounds of {parameters.PARAMETERS[number]} of {x.name(body)}"
        if least - most > EQUAL_WITHIN * scale[body, number]:
            raise InputError("estimator", name, f"lower {least:g} is above upper {most:g}", "lower below upper")
        out.append(x.condition(name, {(body, number): 1.0}, float(0.5 * (least + most) / scale[body, number])))
    return out


def _pseudo_inertia_root(scaled: Array, called: str, prior: Prior) -> Array:
    """L, (4, 4), of the pseudo-inertia J = L L^T of scaled parameters (12,)."""
    J = parameters.pseudo_inertia(scaled)
    if np.linalg.eigvalsh(J)[0] <= np.finfo(float).eps * np.trace(J):
        reason = f"{prior}, but the nominal pseudo-inertia of {called} is not positive definite"
        raise InputError("estimator", "prior", reason, "euclidean, or physically consistent nominal bodies")
    return np.asarray(np.linalg.cholesky(J))


# ------------------------------------------------------------------------------------------- the interior-point method

_STEPS = 200  # Newton steps
_PHASE_ONE_ROOT = 1e-6  # of the deviations, by the slack, in the objective of phase I
_GOOD_SLACK = 1e-6  # of a starting point, at which phase I stops
_LEAST_SLACK = 1e-9  # of a starting point that is accepted if phase I finds no better one
_MOST_SLACK = 0.01  # bound of the slack in phase I
# at rows of a starting point, and moves to get there
_ROOM = 0.1
_MOVES = 3
_SHORTEST = 1e-6  # least fraction of a step; below, rounding decides about feasibility


@one_thread()
@torch.inference_mode()
def find_strictly_feasible(problem: ConicProblem) -> tuple[Array, int]:
    """Find a strictly feasible x, (n,), near 0 if possible (phase I); return it with the number of Newton steps.

    Raises:
        InputError: there is none; the message names the most violated condition.
    """
    x = problem.E.T @ problem.e
    worst = float(problem.slack(x).min(initial=np.inf))
    if worst > _GOOD_SLACK:
        return x, 0
    inside = _with_room(problem, x)
    if problem.slack(inside).min() > _GOOD_SLACK:
        return inside, 0
    path = PrimalDual(_phase_one(problem))
    point = path.start(np.append(x, 1.0 - worst))
    steps = 0
    while point.complementarity > 0.1 * _LEAST_SLACK and steps < _STEPS:
        after = path.step(point)
        if after is None:
            break
        point = after
        steps = steps + 1
        if problem.slack(point.x.numpy()[:-1]).min() > _GOOD_SLACK:
            return point.x.numpy()[:-1], steps
    z = point.x.numpy()
    slack = problem.slack(z[:-1])
    if slack.min() > _LEAST_SLACK:
        return z[:-1], steps
    which = int(slack.argmin())
    name = problem.names[which // 4 if which < 4 * len(problem.F0) else which - 3 * len(problem.F0)]
    raise InputError("estimator", name, "contradicts the other conditions", _FEASIBLE)


def _with_room(problem: ConicProblem, x: Array) -> Array:
    """Near x, a point that is well inside the linear conditions: nominal friction of 0 stands on the border of its own.

    Each move, of least length, makes room at the rows that lack it, and may take some from others.
    """
    for _ in range(_MOVES):
        slack = problem.G @ x - problem.h
        tight = slack < _ROOM
        if not tight.any():
            break
        rows = problem.G[tight] @ problem.null_space
        x = x + problem.null_space @ np.linalg.lstsq(rows, _ROOM - slack[tight], rcond=EQUAL_WITHIN)[0]
    return x


def _phase_one(problem: ConicProblem) -> ConicProblem:
    """Min s, with s added to every eigenvalue and slack: a point with negative s is strictly feasible.

    Boyd, Vandenberghe, section 11.4, with two additions: a small quadratic, for directions without a minimum, and a
    lower bound on s, which saves steps.
    """
    n = len(problem.linear)
    blocks = len(problem.F0)
    rows = len(problem.h)
    return replace(
        problem,
        root=_PHASE_ONE_ROOT * np.hstack([problem.deviations, np.zeros((n, 1))]),
        target=np.zeros(n),
        linear=np.eye(n + 1)[n],
        constant=0.0,
        F=np.concatenate([problem.F, np.broadcast_to(np.eye(4), (blocks, 1, 4, 4))], axis=1),
        variables=np.concatenate([problem.variables, np.full((blocks, 1), n)], axis=1),
        weights=np.zeros(blocks),
        G=np.vstack([np.hstack([problem.G, np.ones((rows, 1))]), np.eye(n + 1)[n:]]),
        h=np.append(problem.h, -_MOST_SLACK),
        E=np.hstack([problem.E, np.zeros((len(problem.e), 1))]),
    )


def damped_inverse(A: Tensor) -> Callable[[Tensor], Tensor]:
    """B -> A^-1 b for A positive semidefinite, (n, n), with the least damping that works (Levenberg).

    Of A, which it overwrites, the lower triangle counts.
    """
    scale = A.diagonal().abs().clamp_min(torch.finfo(A.dtype).tiny).rsqrt()
    scaled = A.mul_(scale).mul_(scale[:, None])
    damping = 0.0
    while True:
        root, failed = torch.linalg.cholesky_ex(scaled)
        if not failed:
            return lambda b: scale * torch.cholesky_solve((scale * b)[:, None], root)[:, 0]
        more = max(1e-15, 10.0 * damping)
        scaled.diagonal().add_(more - damping)
        damping = more


_LOOSE = 1e-6  # relative gap above which there is a warning
_PATIENCE = 2  # steps in a row without a smaller gap: rounding makes small gaps uneven
_SHARE = 0.98  # of the longest step that stays inside
_CENTRE_SHRINK = 0.1  # of the barrier's weight from step to step towards a point of the central path
_CENTRED_CHANGE = 1e-9  # relative, of blocks and slacks, in the last of these steps
_SHORT = 0.2  # length of a corrected step below which a plain one is taken
_ACCURATE = 1e-9  # relative complementarity below which the gap itself is computed
_CENTRED = 0.5


@one_thread()
@torch.inference_mode()
def solve_barrier(problem: ConicProblem, tolerance: float = 1e-9) -> Solution:
    """Follow the central path until the duality gap is below `tolerance` times the objective.

    Newton's method on primal and dual together, with Mehrotra's predictor and corrector, in the null space of the
    equalities; blocks and multipliers are linearized as by Helmberg, Rendl, Vanderbei, Wolkowicz, "An interior-point
    method for semidefinite programming", 1996. It needs half of the steps of a path that is followed by the primal
    alone. Newton or Gauss-Newton steps in log-Cholesky coordinates need many more: their curvature excites the stiff
    directions of the data.

    Args:
        problem: with objective and conditions.
        tolerance: relative gap; for optima near 0 relative to the problem's floor.

    Raises:
        InputError: the conditions exclude each other.

    Warns:
        NumericalWarning: rounding ended the path early.
    """
    x, steps = find_strictly_feasible(problem)
    path = PrimalDual(problem)
    point = path.start(x)
    best = Solution(x, problem.objective(x), np.inf, steps)
    worse = 0
    for count in range(1, _STEPS + 1):
        after = path.step(point)
        if after is not None:
            point = after
            steps += 1
        x = point.x.numpy()
        objective = problem.objective(x)
        last = after is None or count == _STEPS
        scale = max(objective, problem.floor)
        far = point.complementarity > _CENTRED * max(tolerance, _ACCURATE) * scale
        if far and not last and not problem.weights.any():
            continue  # the gap takes as long as a step; with small log-determinants rounding may leave none later on
        gap = problem.gap(x, *path.multipliers(point))
        worse = worse + 1 if gap >= best.gap and not far else 0
        if worse > _PATIENCE:
            break  # rounding errors exceed the progress
        if gap < best.gap:
            best = Solution(x, objective, gap, steps)
        if last or gap <= tolerance * scale:
            break
    if not best.gap <= max(_LOOSE, tolerance) * max(best.objective, problem.floor):
        message = f"estimator: not converged (duality gap {best.gap:.1g}, objective {best.objective:.3g})"
        warn(f"{message}. Set a larger estimator.ridge", NumericalWarning)
    return best


@dataclass(frozen=True)
class _Point:
    """A strictly feasible point and multipliers.

    Attributes:
        x: (n,).
        whitening: (K, 4, 4), inverse C^-1 of the Cholesky factors of the blocks F_k(x).
        slack: (M,), of the rows.
        Z: (K, 4, 4), multipliers of the blocks, C^T Z_k C.
        y: (M,), multipliers of the rows.
        complementarity: how far the multipliers are from those of a minimizer: the gap where the gradient is balanced.
    """

    x: Tensor
    whitening: Tensor
    slack: Tensor
    Z: Tensor
    y: Tensor
    complementarity: float


@dataclass(frozen=True)
class _Direction:
    """Step of a point, in its own coordinates; steps of the blocks are (K, 4, 4)."""

    x: Tensor
    blocks: Tensor
    slack: Tensor
    Z: Tensor
    y: Tensor


class PrimalDual:
    """Newton steps on a conic problem, whose arrays are tensors here."""

    def __init__(self, problem: ConicProblem) -> None:
        """They share memory with the arrays."""
        self.problem = problem
        self.F0 = torch.from_numpy(problem.F0)
        self.F = torch.from_numpy(problem.F)
        self.variables = torch.from_numpy(problem.variables)
        self.G = torch.from_numpy(problem.G)
        self.h = torch.from_numpy(problem.h)
        self.H = torch.from_numpy(problem.hessian)
        self._row_columns = torch.from_numpy(np.flatnonzero(problem.G.any(axis=0)))  # bounds are on one variable each
        self._rows = self.G[:, self._row_columns]
        self.weights = torch.from_numpy(problem.weights)
        self.null_space = torch.from_numpy(problem.null_space) if len(problem.e) else None
        self.eye = torch.eye(4, dtype=self.F0.dtype)

    def factors(self, x: Tensor) -> tuple[Tensor, Tensor] | None:
        """Cholesky factors (K, 4, 4) of the blocks and slacks (M,) of the rows at x, (n,); None if it is infeasible."""
        root, failed = torch.linalg.cholesky_ex(self.F0 + (x[self.variables, None, None] * self.F).sum(1))
        slack = self.G @ x - self.h
        return None if failed.any() or not (slack > 0.0).all() else (root, slack)

    def start(self, x: np.ndarray) -> _Point:
        """A feasible x, (n,), with multipliers of the central path; LinAlgError where rounding says that it is not."""
        at = torch.from_numpy(x.copy())
        factors = self.factors(at)
        if factors is None:
            raise np.linalg.LinAlgError("rounding made the starting point infeasible")
        kappa = max(self.problem.objective(x), self.problem.floor) / max(self.problem.degree, 1)
        Z = (self.weights + kappa)[:, None, None] * self.eye
        return self._point(at, factors, Z, kappa / factors[1])

    def _point(self, x: Tensor, factors: tuple[Tensor, Tensor], Z: Tensor, y: Tensor) -> _Point:
        """The point x, (n,), of these `factors`, with its multipliers."""
        root, slack = factors
        whitening = torch.linalg.solve_triangular(root, self.eye, upper=False)
        off = torch.linalg.eigvalsh(Z - self.weights[:, None, None] * self.eye)
        return _Point(x, whitening, slack, Z, y, float(off.abs().sum() + slack @ y))

    def multipliers(self, point: _Point) -> tuple[np.ndarray, np.ndarray]:
        """Of the blocks, (K, 4, 4), and of the rows, (M,)."""
        return (point.whitening.mT @ point.Z @ point.whitening).numpy(), point.y.numpy()

    def step(self, point: _Point) -> _Point | None:
        """The next point; None if rounding prevents it."""
        Z_root, failed = torch.linalg.cholesky_ex(point.Z)
        if failed.any():
            return None
        solve = self._newton(point)
        none = torch.zeros(())
        affine = solve(0.0, none, none)
        kappa = point.complementarity / max(self.problem.degree, 1)
        shrunk = (1.0 - min(1.0, self._longest(point, Z_root, affine))) ** 3 * kappa
        move = solve(shrunk, _symmetric(affine.blocks @ affine.Z), affine.slack * affine.y)
        length = min(1.0, _SHARE * self._longest(point, Z_root, move))
        if length < _SHORT:  # far from the path, where the corrections mislead: back to the path
            promised = -float(self.problem.gradient(point.x.numpy()) @ affine.x.numpy())
            move = solve(max(kappa, promised / max(self.problem.degree, 1)), none, none)
            length = min(1.0, _SHARE * self._longest(point, Z_root, move))
        return self._moved(point, move, length)

    def centre(self, x: np.ndarray, kappa: float) -> np.ndarray:
        """The point of the central path at a barrier weight, (n,), from a strictly feasible one."""
        point = self.start(x)
        none = torch.zeros(())
        for _ in range(_STEPS):
            target = max(kappa, _CENTRE_SHRINK * point.complementarity / max(self.problem.degree, 1))
            move = self._newton(point)(target, none, none)
            Z_root, failed = torch.linalg.cholesky_ex(point.Z)
            length = 0.0 if failed.any() else min(1.0, _SHARE * self._longest(point, Z_root, move))
            after = self._moved(point, move, length) if length else None
            if after is None:
                break
            relative = torch.cat([move.blocks.flatten(), move.slack / point.slack])
            point = after
            if target == kappa and length == 1.0 and float(relative.abs().sum()) < _CENTRED_CHANGE:
                break
        return point.x.numpy()

    def _moved(self, point: _Point, move: _Direction, length: float) -> _Point | None:
        """A fraction of a step from a point; None if rounding prevents it."""
        while (factors := self.factors(point.x + length * move.x)) is None and length > _SHORTEST:
            length *= 0.5  # infeasible by rounding alone
        if factors is None:
            return None
        change = point.whitening @ factors[0]
        Z = _symmetric(change.mT @ (point.Z + length * move.Z) @ change)
        return self._point(point.x + length * move.x, factors, Z, point.y + length * move.y)

    def _newton(self, point: _Point) -> Callable[[float, Tensor, Tensor], _Direction]:
        """Direction towards the point of the path at a barrier weight, with corrections of second order."""
        whitened = point.whitening[:, None] @ self.F @ point.whitening[:, None].mT  # (K, V, 4, 4), C^-1 F C^-T
        flat = whitened.flatten(2)

        def gathered(blocks: Tensor) -> Tensor:
            out = torch.zeros_like(point.x)
            return out.index_put_((self.variables,), (flat @ blocks.flatten(1)[..., None])[..., 0], accumulate=True)

        curvature = flat @ (whitened @ point.Z[:, None]).flatten(2).mT
        stiffness = point.y / point.slack
        of_rows = self._rows.T @ (stiffness[:, None] * self._rows)
        at = self._row_columns
        hessian = self.H.index_put((at[:, None], at), of_rows, accumulate=True)
        hessian.index_put_((self.variables[:, :, None], self.variables[:, None]), curvature, accumulate=True)
        N = self.null_space
        invert = damped_inverse(hessian if N is None else N.T @ hessian @ N)
        gradient = torch.from_numpy(self.problem.gradient(point.x.numpy())) - self.G.T @ point.y - gathered(point.Z)

        def solve(kappa: float, block_correction: Tensor, row_correction: Tensor) -> _Direction:
            Z = (self.weights + kappa)[:, None, None] * self.eye - point.Z - block_correction
            y = (kappa - row_correction) / point.slack - point.y
            slope = gathered(Z) + self.G.T @ y - gradient
            x = invert(slope) if N is None else N @ invert(N.T @ slope)
            blocks = (x[self.variables, None, None] * whitened).sum(1)
            slack = self.G @ x
            return _Direction(x, blocks, slack, Z - _symmetric(blocks @ point.Z), y - stiffness * slack)

        return solve

    def _longest(self, point: _Point, Z_root: Tensor, move: _Direction) -> float:
        """The largest share of a step that keeps blocks, slacks and multipliers nonnegative."""
        half = torch.linalg.solve_triangular(Z_root, move.Z, upper=False)
        relative_Z = _symmetric(torch.linalg.solve_triangular(Z_root, half.mT, upper=False))
        eigenvalues = torch.linalg.eigvalsh(torch.cat([move.blocks, relative_Z])).ravel()
        rates = torch.cat([eigenvalues, move.slack / point.slack, move.y / point.y])
        return 1.0 / max(-float(rates.min()), 1e-9) if len(rates) else np.inf


def _symmetric(A: Tensor) -> Tensor:
    return 0.5 * (A + A.mT)
