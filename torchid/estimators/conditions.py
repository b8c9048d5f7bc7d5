"""Conditions of physical consistency, and violations of them by given parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from torchid import parameters
from torchid.parameters import PER_BODY, Array
from torchid.problem import LinearProblem
from torchid.reprs import short_repr
from torchid.settings import BelowOne, Positive, validate_settings

EnclosureKind = Literal["box", "ellipsoid"]

_ROUNDING = 1e-6  # of matrices given with six digits


@dataclass(frozen=True)
class Enclosure:
    """Region for the centre of mass of a body: a box or an ellipsoid in its link frame.

    `axes`, (3, 3), orthonormal: columns are the directions of `half`, (3,) [m], half edges or semi-axes; `centre`, (3,)
    [m].
    """

    body: int
    kind: EnclosureKind
    centre: Array
    axes: Array
    half: Array

    __repr__ = short_repr

    def __post_init__(self) -> None:
        validate_settings(self)
        if np.shape(self.centre) != (3,) or not np.isfinite(self.centre).all():
            raise ValueError(f"centre: found {_short(self.centre)}; accepted: three finite numbers")
        if np.shape(self.half) != (3,) or not (np.isfinite(self.half).all() and (self.half > 0.0).all()):
            raise ValueError(f"half: found {_short(self.half)}; accepted: three positive numbers")
        _check_orthogonal("axes", self.axes)


@dataclass(frozen=True)
class Mirror:
    """Two bodies that are mirror images (friction included), or one symmetric body.

    `reflection`, (3, 3), orthogonal, maps vectors of the first link to the second. Its determinant is -1, or 1 for
    equal bodies with rotated links.
    """

    body: int
    image: int
    reflection: Array

    __repr__ = short_repr

    def __post_init__(self) -> None:
        _check_orthogonal("reflection", self.reflection)


def _check_orthogonal(name: str, matrix: Array) -> None:
    """Raise a ValueError unless a matrix is (3, 3) and orthogonal."""
    if np.shape(matrix) != (3, 3) or not np.allclose(matrix.T @ matrix, np.eye(3), rtol=0.0, atol=_ROUNDING):
        raise ValueError(f"{name}: found {_short(matrix)}; accepted: an orthogonal matrix (3, 3)")


def _short(value: object) -> str:
    return " ".join(str(value).split())


@dataclass(frozen=True)
class Conditions:
    """Conditions of physical consistency on the parameters (L, 12) of all bodies.

    Attributes:
        margin: smallest eigenvalue of every body's scaled pseudo-inertia. The scale is that of a body with the nominal
            mass and radius of gyration. Above 0, a positive mass density with these parameters exists.
        total_mass: of all bodies [kg]; None if unknown.
        enclosures: regions for centres of mass.
        mirrors: pairs of mirrored bodies.
        lower, upper: bounds (L, 12), infinite for no bound. Friction is never negative.
        names: of the bodies, for messages; numbers if empty.
    """

    margin: BelowOne = 1e-4
    total_mass: Positive | None = None
    enclosures: tuple[Enclosure, ...] = ()
    mirrors: tuple[Mirror, ...] = ()
    lower: Array | None = None
    upper: Array | None = None
    names: tuple[str, ...] = ()

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Check the numbers; `bounds` checks the bounds of bodies."""
        validate_settings(self)

    def body_name(self, body: int) -> str:
        """The name of a body in messages."""
        return self.names[body] if self.names else f"body {body}"

    def validate_bodies(self, bodies: int) -> None:
        """Raise ValueError if a condition names a body that a robot with this many bodies does not have."""
        for body in [e.body for e in self.enclosures] + [b for m in self.mirrors for b in (m.body, m.image)]:
            if not 0 <= body < bodies:
                raise ValueError(f"body: found {body}; accepted: 0 to {bodies - 1}")

    def bounds(self, bodies: int) -> tuple[Array, Array]:
        """Lower and upper bounds (L, 12), friction at least 0."""
        lower = np.full((bodies, PER_BODY), -np.inf) if self.lower is None else self.lower.copy()
        upper = np.full((bodies, PER_BODY), np.inf) if self.upper is None else self.upper
        for name, bound, impossible in (("lower", lower, np.inf), ("upper", upper, -np.inf)):
            if bound.shape != (bodies, PER_BODY):
                raise ValueError(f"{name}: found shape {bound.shape}; accepted: ({bodies}, {PER_BODY})")
            if np.isnan(bound).any() or (bound == impossible).any():
                accepted = f"numbers, {-impossible} for no bound"
                raise ValueError(f"{name}: found NaN or {impossible}; accepted: {accepted}")
        lower[:, parameters.FRICTION] = np.maximum(lower[:, parameters.FRICTION], 0.0)
        return lower, upper


def mirror_matrix(reflection: Array) -> Array:
    """The matrix (12, 12) that maps a body's parameters to those of its mirror image; reflection is (3, 3)."""
    T = np.eye(4)
    T[:3, :3] = reflection
    out = np.eye(PER_BODY)
    out[parameters.INERTIAL, parameters.INERTIAL] = parameters.change_of_frame(T)
    return out


@dataclass(frozen=True)
class Violation:
    """A violated condition on a body or an actuator term; `amount` is in `unit`."""

    body: int | None
    condition: str
    amount: float
    unit: str
    term: str | None = None


def validate_parameters(**arrays: Array) -> None:
    """Raise ValueError if arrays differ in shape (L, 12), are not finite, or if `scale` is not positive."""
    shape = (*next(iter(arrays.values())).shape[:1], PER_BODY)
    for name, array in arrays.items():
        if array.shape != shape or array.ndim != 2:
            raise ValueError(f"{name}: found shape {array.shape}; accepted: one shape (L, {PER_BODY}) for all")
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: found a number that is not finite; accepted: finite numbers")
        if name == "scale" and not (array > 0.0).all():
            raise ValueError(f"{name}: found a number that is not positive; accepted: positive numbers")


def violations(phi: Array, scale: Array, conditions: Conditions, tolerance: float = 1e-9) -> list[Violation]:
    """Conditions that parameters (L, 12) violate by more than `tolerance` times their `scale`, (L, 12)."""
    validate_parameters(phi=phi, scale=scale)
    conditions.validate_bodies(len(phi))
    out: list[Violation] = []
    for body in np.flatnonzero(phi[:, parameters.INERTIAL].any(axis=1)):
        out += _inertia_violations(int(body), phi[body], scale[body], conditions.margin, tolerance)
    for enclosure in (e for e in conditions.enclosures if phi[e.body, parameters.MASS] > 0.0):
        outside = _excursion(phi[enclosure.body], enclosure)
        condition = f"centre of mass outside its {enclosure.kind}"
        if outside > tolerance:
            out.append(Violation(enclosure.body, condition, outside, "of its size"))
    for mirror in conditions.mirrors:
        image = mirror_matrix(mirror.reflection) @ phi[mirror.body]
        error = float(np.max(np.abs(image - phi[mirror.image]) / scale[mirror.image]))
        if error > tolerance:
            condition = f"not the mirror image of {conditions.body_name(mirror.body)}"
            out.append(Violation(mirror.image, condition, error, "of its scale"))
    if conditions.total_mass is not None:
        error = float(abs(phi[:, parameters.MASS].sum() - conditions.total_mass))
        if error > tolerance * conditions.total_mass:
            out.append(Violation(None, "total mass differs", error, "kg"))
    return out + _bound_violations(phi, scale, conditions, tolerance)


def term_violations(problem: LinearProblem, phi: Array, psi: Array | None, tolerance: float = 1e-9) -> list[Violation]:
    """Conditions on the terms of a problem that are violated by more than `tolerance` times their size.

    Args:
        problem: with the terms.
        phi: (P,), parameters.
        psi: (M,), terms; None for the best fit at these parameters.
        tolerance: relative to the size.
    """
    terms = problem.terms
    if terms is None:
        return []
    psi = terms.best(phi) if psi is None else psi
    values = [(condition, condition.value(phi, psi)) for condition in terms.conditions]
    below = [(condition, value) for condition, value in values if value < -tolerance * condition.size]
    return [Violation(None, "negative", -value, condition.unit, condition.name) for condition, value in below]


def _bound_violations(phi: Array, scale: Array, conditions: Conditions, tolerance: float) -> list[Violation]:
    """Parameters outside their bounds."""
    out = []
    lower, upper = conditions.bounds(len(phi))
    beyond = np.maximum(lower - phi, phi - upper)
    for body, number in zip(*np.nonzero(beyond > tolerance * scale), strict=True):
        name = parameters.PARAMETERS[number]
        negative = number >= parameters.FRICTION.start and phi[body, number] < 0.0
        condition = f"{name} negative" if negative else f"{name} beyond its bounds"
        out.append(Violation(int(body), condition, float(beyond[body, number]), parameters.PARAMETER_UNITS[number]))
    return out


def _inertia_violations(body: int, phi: Array, scale: Array, margin: float, tolerance: float) -> list[Violation]:
    """Mass, inertia about the centre of mass, triangle inequality, pseudo-inertia of one body."""
    if phi[parameters.MASS] <= 0.0:
        return [Violation(body, "mass not positive", float(-phi[parameters.MASS]), "kg")]
    _, _, inertia = parameters.mass_com_inertia(phi)
    a, b, c = np.linalg.eigvalsh(inertia)
    size = float(scale[parameters.INERTIA].max())
    out = []
    if a < -tolerance * size:
        out.append(Violation(body, "inertia about the centre of mass not positive", float(-a), "kg m^2"))
    if a + b - c < -tolerance * size:
        out.append(Violation(body, "triangle inequality of principal inertias violated", float(c - a - b), "kg m^2"))
    least = float(np.linalg.eigvalsh(parameters.pseudo_inertia(phi / scale))[0])
    if least < margin - tolerance:
        out.append(Violation(body, f"pseudo-inertia below the margin of {margin:g}", margin - least, "scaled"))
    return out


def _excursion(phi: Array, enclosure: Enclosure) -> float:
    """Distance of the centre of mass outside its enclosure, relative to the half sizes; negative inside."""
    com = phi[parameters.FIRST_MOMENT] / phi[parameters.MASS]
    local = np.abs(enclosure.axes.T @ (com - enclosure.centre)) / enclosure.half
    return float((local.max() if enclosure.kind == "box" else np.linalg.norm(local)) - 1.0)
