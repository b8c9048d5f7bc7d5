"""The conic problem of linear data, a prior and conditions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from torchid import parameters
from torchid.errors import InputError
from torchid.estimators.conditions import Conditions, Enclosure, mirror_matrix
from torchid.estimators.conic_problem import (
    EQUAL_WITHIN,
    ConicProblem,
    LinearCondition,
    reduce_equalities,
    remove_implied,
)
from torchid.parameters import PER_BODY, Array
from torchid.problem import LinearProblem

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
