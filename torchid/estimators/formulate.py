"""From a linear problem, conditions and a prior to the conic problem."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from torchid import parameters
from torchid.errors import InputError
from torchid.estimators.conditions import Conditions, Enclosure, mirrored_parameters
from torchid.estimators.conic import ConicProblem
from torchid.parameters import PER_BODY, Array
from torchid.problem.linear import LinearProblem

Prior = Literal["euclidean", "pullback", "entropic"]

_TEN = parameters.pseudo_inertia(np.eye(10))  # (10, 4, 4), change of a pseudo-inertia with each number


@dataclass(frozen=True)
class _Block:
    """A 4 x 4 block that depends on ten variables."""

    name: str
    base: Array
    slopes: Array
    variables: np.ndarray


@dataclass(frozen=True)
class _Row:
    """A linear condition: row @ x >= bound."""

    name: str
    row: Array
    bound: float


class _Variables:
    """Which entry of x every free parameter is, and what the others are worth, all in units of their scale."""

    def __init__(self, problem: LinearProblem) -> None:
        self.free, self.count = problem.free.reshape(-1, PER_BODY), int(problem.free.sum())
        self.place = (np.cumsum(problem.free) - 1).reshape(-1, PER_BODY)
        self.scale = problem.scale.reshape(-1, PER_BODY)
        self.nominal = problem.nominal.reshape(-1, PER_BODY) / self.scale
        inertial = self.free[:, parameters.INERTIAL]
        if (inertial.any(axis=1) != inertial.all(axis=1)).any():
            raise ValueError("free: found a body of which part is free; accepted: inertial parameters body by body")
        self.bodies = [int(body) for body in np.flatnonzero(inertial.all(axis=1))]

    def ten(self, body: int) -> np.ndarray:
        """Variables of a body's inertial parameters, (10,)."""
        return self.place[body, parameters.INERTIAL]

    def row(self, body: int, weights: Array) -> tuple[Array, float]:
        """`weights @ phi` of a body, (12,), as a row on x and a constant."""
        scaled = weights * self.scale[body]
        row, free = np.zeros(self.count), self.free[body]
        row[self.place[body][free]] = scaled[free]
        return row, float(scaled @ self.nominal[body])


def conic_problem(
    problem: LinearProblem, conditions: Conditions, ridge: float, prior: Prior, reference: Array | None = None
) -> ConicProblem:
    """The convex problem in x, the deviation of the free parameters from nominal in units of their scale.

    Args:
        problem: the data.
        conditions: on the parameters.
        ridge: weight of the prior.
        prior: what pulls to the nominal parameters.
        reference: (12 L,), whose pseudo-inertias measure a pull-back prior's deviations; None for the nominal ones.
    """
    conditions.check_bodies(len(problem.nominal) // PER_BODY)
    x = _Variables(problem)
    blocks = [_matter(x, body, conditions.margin) for body in x.bodies]
    rows = _bounds(x, conditions)
    for enclosure in conditions.enclosures:
        if enclosure.body in x.bodies and enclosure.kind == "ellipsoid":
            blocks.append(_ellipsoid(x, enclosure))
        elif enclosure.body in x.bodies:
            rows += _box(x, enclosure)
    weights, linear = np.zeros(len(blocks)), np.zeros(x.count)
    pull = np.eye(x.count)
    if prior == "pullback":
        pull = _pull_back(x, problem.nominal if reference is None else reference)
    if prior == "entropic":
        relative = [_relative(x, body) for body in x.bodies]
        for block in relative:
            pull[block.variables] = 0.0
            linear[block.variables] = ridge * np.trace(block.slopes, axis1=1, axis2=2)
        blocks += relative
        weights = np.append(weights, np.full(len(relative), ridge))
    root, target, unexplained = _compressed(problem, np.sqrt(ridge) * pull)
    E, e = _equalities(x, conditions)
    return ConicProblem(
        root=root,
        target=target,
        linear=linear,
        constant=unexplained,
        base=np.array([block.base for block in blocks]).reshape(-1, 4, 4),
        slopes=np.array([block.slopes for block in blocks]).reshape(len(blocks), 10, 4, 4),
        variables=np.array([block.variables for block in blocks], dtype=np.int64).reshape(-1, 10),
        weights=weights,
        G=np.array([row.row for row in rows]).reshape(-1, x.count),
        h=np.array([row.bound for row in rows]),
        E=E,
        e=e,
        names=(*(block.name for block in blocks), *(row.name for row in rows)),
    )


def _compressed(problem: LinearProblem, pull: Array) -> tuple[Array, Array, float]:
    """Data and quadratic prior as ||root x - target||^2 + constant, with no more rows than columns."""
    free, rows = problem.free, max(problem.rows, 1)
    A = problem.A[:, free] * problem.scale[free] / np.sqrt(rows)
    b = (problem.b - problem.A @ problem.nominal) / np.sqrt(rows)
    right = np.concatenate([b, np.zeros(len(pull))])
    triangle = np.linalg.qr(np.column_stack([np.concatenate([A, pull]), right]), mode="r")
    count = A.shape[1]
    return triangle[:count, :count], triangle[:count, count], problem.residual / rows + float(triangle[count:, count] @ triangle[count:, count])


def _matter(x: _Variables, body: int, margin: float) -> _Block:
    """Scaled pseudo-inertia of a body, less the margin."""
    base = parameters.pseudo_inertia(x.nominal[body]) - margin * np.eye(4)
    return _Block(f"pseudo-inertia of body {body}", base, _TEN, x.ten(body))


def _ellipsoid(x: _Variables, enclosure: Enclosure) -> _Block:
    """[[m 1, u], [u^T, m]] with u = (m com - m centre) / half along the axes: positive iff |u| <= m."""
    body, slopes = enclosure.body, np.zeros((10, 4, 4))
    to_axes = (enclosure.axes / enclosure.half).T  # (3, 3)
    mass, moments = x.scale[body, parameters.MASS], x.scale[body, parameters.FIRST_MOMENT]
    slopes[parameters.MASS] = mass * np.eye(4)
    slopes[parameters.MASS, :3, 3] = slopes[parameters.MASS, 3, :3] = -mass * (to_axes @ enclosure.centre)
    for number, column in zip(range(10)[parameters.FIRST_MOMENT], (to_axes * moments).T, strict=True):
        slopes[number, :3, 3] = slopes[number, 3, :3] = column
    slopes /= mass
    base = np.einsum("v,vij->ij", x.nominal[body, parameters.INERTIAL], slopes)
    return _Block(f"centre of mass of body {body}", base, slopes, x.ten(body))


def _box(x: _Variables, enclosure: Enclosure) -> list[_Row]:
    """M half +- (m com - m centre) >= 0 along each axis of the box."""
    out = []
    for axis, half in zip(enclosure.axes.T, enclosure.half, strict=True):
        for sign in (1.0, -1.0):
            weights = np.zeros(PER_BODY)
            weights[parameters.MASS] = 1.0 - sign * (axis @ enclosure.centre) / half
            weights[parameters.FIRST_MOMENT] = sign * axis / half
            row, constant = x.row(enclosure.body, weights / x.scale[enclosure.body, parameters.MASS])
            out.append(_Row(f"centre of mass of body {enclosure.body}", row, -constant))
    return out


def _bounds(x: _Variables, conditions: Conditions) -> list[_Row]:
    lower, upper = conditions.bounds(len(x.free))
    out = []
    for bound, sign, word in ((lower, 1.0, "lower"), (upper, -1.0, "upper")):
        for body, number in zip(*np.nonzero(np.isfinite(bound) & x.free & (lower < upper)), strict=True):
            row = np.zeros(x.count)
            row[x.place[body, number]] = sign
            limit = sign * (bound[body, number] / x.scale[body, number] - x.nominal[body, number])
            out.append(_Row(f"{word} bound of {parameters.PARAMETERS[number]} of body {body}", row, float(limit)))
    return out


def _equalities(x: _Variables, conditions: Conditions) -> tuple[Array, Array]:
    """Total mass and mirror images, as independent rows E x = e."""
    rows, values = [np.zeros((0, x.count))], [np.zeros(0)]
    if conditions.total_mass is not None:
        mass = np.eye(PER_BODY)[parameters.MASS]
        found = [x.row(body, mass) for body in range(len(x.free))]
        rows.append(np.sum([row for row, _ in found], axis=0)[None] / conditions.total_mass)
        values.append(np.array([1.0 - sum(constant for _, constant in found) / conditions.total_mass]))
    for mirror in conditions.mirrors:
        reflected = mirrored_parameters(mirror.reflection)
        for number, unit in enumerate(np.eye(PER_BODY)):
            size = x.scale[mirror.image, number]
            (left, known), (right, fixed) = x.row(mirror.body, reflected[number]), x.row(mirror.image, unit)
            rows.append((left - right)[None] / size)
            values.append(np.array([(fixed - known) / size]))
    lower, upper = conditions.bounds(len(x.free))
    for body, number in zip(*np.nonzero((lower >= upper) & x.free), strict=True):
        rows.append(np.eye(x.count)[[x.place[body, number]]])
        values.append(np.array([lower[body, number] / x.scale[body, number] - x.nominal[body, number]]))
        if lower[body, number] > upper[body, number]:
            name = f"bounds of {parameters.PARAMETERS[number]} of body {body}"
            raise InputError(
                "estimator", name, f"{lower[body, number]:g} above {upper[body, number]:g}", "lower <= upper"
            )
    return _independent(np.concatenate(rows), np.concatenate(values))


def _independent(E: Array, e: Array) -> tuple[Array, Array]:
    """The same conditions in as few rows as they have rank.

    Raises:
        InputError: they contradict each other, or what is held fixed.
    """
    if not E.size:
        U, kept, values, right = np.zeros((len(e), 0)), np.zeros(0, dtype=bool), np.zeros(0), E[:0]
    else:
        U, values, right = np.linalg.svd(E, full_matrices=False)
        kept = values > 1e-10 * max(float(values[0]), np.finfo(float).tiny)
    reached = U[:, kept] @ (U[:, kept].T @ e)
    if np.abs(e - reached).max(initial=0.0) > 1e-9 * (1.0 + np.abs(e).max(initial=0.0)):
        found = "excluded by each other or by what is held fixed"
        raise InputError("estimator", "total mass, mirror images or equal bounds", found, "equalities that can be met")
    return values[kept, None] * right[kept], U[:, kept].T @ e


def _pull_back(x: _Variables, reference: Array) -> Array:
    """Root of the constant pull-back metric: per body J_0^-1/2 dJ J_0^-1/2, of friction the scaled deviation."""
    scaled = reference.reshape(-1, PER_BODY) / x.scale
    rows = [np.eye(x.count)[x.place[:, parameters.FRICTION][x.free[:, parameters.FRICTION]]]]
    for body in x.bodies:
        row = np.zeros((16, x.count))
        row[:, x.ten(body)] = _whitened(scaled[body], body, "pullback").reshape(10, 16).T
        rows.append(row)
    return np.concatenate(rows)


def _relative(x: _Variables, body: int) -> _Block:
    """J_0^-1/2 J J_0^-1/2 of a body."""
    slopes = _whitened(x.nominal[body], body, "entropic")
    return _Block(f"pseudo-inertia of body {body}", np.eye(4), slopes, x.ten(body))


def _whitened(scaled: Array, body: int, prior: Prior) -> Array:
    """L^-1 dJ L^-T for each of ten numbers, (10, 4, 4), of the pseudo-inertia J = L L^T of scaled parameters (12,)."""
    J = parameters.pseudo_inertia(scaled)
    if np.linalg.eigvalsh(J)[0] <= 0.0:
        found = f"{prior}, but no density of matter has the parameters of body {body} that it starts from"
        raise InputError("estimator", "prior", found, "euclidean, or bodies that can exist")
    inverse = np.linalg.inv(np.linalg.cholesky(J))
    return np.asarray(inverse @ _TEN @ inverse.T)
