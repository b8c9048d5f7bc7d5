"""What an experiment file knows of bodies beforehand: conditions on their parameters, and masses told by a scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchid import parameters
from torchid.config.estimator import EstimatorConfig
from torchid.errors import ConfigError, UnknownNameError, warn_about_file
from torchid.estimators import Conditions, Enclosure, Mirror
from torchid.identifiability.confounding import mass_weights
from torchid.parallel import one_thread
from torchid.parameters import PARAMETERS, PER_BODY, Array
from torchid.problem import LinearProblem
from torchid.robot import Robot, body_extents, mirror_pairs

_FRICTION = PARAMETERS[parameters.FRICTION]
_POSITIVE = ("m", "Ixx", "Iyy", "Izz")


def conditions_from(settings: EstimatorConfig, robot: Robot) -> Conditions:
    """Conditions on the parameters (L, 12) of a robot's bodies, from an experiment file.

    Least squares ignores them; a descent with penalties uses only the margin. `com_inside` skips bodies that are
    frozen, have no mass, or have no known shape. Two frozen bodies need not be mirror images.

    Args:
        settings: of the estimator.
        robot: with bodies, shapes and symmetry.

    Raises:
        ConfigError: a bound that nothing meets or that bounds nothing, no known shapes, or bodies that are not mirrored
            (see `mirror_pairs`).
        UnknownNameError: a body or parameter does not exist.
        UrdfError: a shape is not described by numbers.

    Warns:
        TorchidWarning: bodies without known shapes, or with their URDF centre of mass outside them.
    """
    if settings.name == "least_squares" or (settings.name == "sgd" and settings.consistency == "penalties"):
        return Conditions(margin=settings.margin if settings.name == "sgd" else 0.0, names=robot.body_names)
    lower, upper = _bounds(settings, robot)
    return Conditions(
        margin=settings.margin,
        total_mass=None if settings.total_mass is None or settings.total_mass.std else settings.total_mass.value,
        enclosures=_enclosures(settings, robot),
        mirrors=_mirrors(settings, robot),
        lower=lower,
        upper=upper,
        names=robot.body_names,
    )


def _enclosures(settings: EstimatorConfig, robot: Robot) -> tuple[Enclosure, ...]:
    if settings.com_inside is None:
        if settings.com_shapes != EstimatorConfig.com_shapes:
            reason = f"{settings.com_shapes}, but com_inside is not set"
            raise ConfigError.at_field("estimator.com_shapes", reason, "com_inside: box or ellipsoid")
        return ()
    bodies = [i for i, body in enumerate(robot.bodies) if not body.massless and body.name not in settings.frozen]
    extents = body_extents(robot, settings.com_shapes, bodies)
    if not extents:
        reason = f"{settings.com_inside}, but no fitted body in {robot.path.name} has a shape"
        raise ConfigError.at_field("estimator.com_inside", reason, f"null, or a {robot.format} with shapes")
    out = []
    outside = []
    for body, extent in extents.items():
        half = extent.half if settings.com_inside == "box" else extent.semi_axes
        out.append(Enclosure(body, settings.com_inside, extent.centre, extent.axes, half))
        _, com, _ = parameters.mass_com_inertia(robot.nominal[body])
        local = np.abs(extent.axes.T @ (com - extent.centre)) / half
        if (local.max() if settings.com_inside == "box" else np.linalg.norm(local)) > 1.0:
            outside.append(robot.body_names[body])
    if outside:
        where = f"outside the {settings.com_inside} of {', '.join(outside)}"
        message = f"estimator.com_inside: the centre of mass of the {robot.format} is {where}"
        warn_about_file(f"{message}. Check these shapes, or change estimator.com_shapes")
    return tuple(out)


def _mirrors(settings: EstimatorConfig, robot: Robot) -> tuple[Mirror, ...]:
    symmetry = settings.symmetry
    if symmetry is None:
        return ()
    tokens = symmetry.left, symmetry.right, symmetry.normal
    pairs = mirror_pairs(robot, *tokens, "estimator.symmetry", settings.frozen)
    return tuple(
        Mirror(pair.body, pair.image, pair.reflection) for pair in pairs if not robot.bodies[pair.body].massless
    )


def _bounds(settings: EstimatorConfig, robot: Robot) -> tuple[Array | None, Array | None]:
    """Lower and upper bounds, (L, 12), None if the file has none."""
    exact = {name: mass.value for name, mass in settings.masses.items() if not mass.std and name in robot.body_names}
    if not (settings.bounds or exact):
        return None, None
    lower = np.full(robot.nominal.shape, -np.inf)
    upper = np.full(robot.nominal.shape, np.inf)
    for name, mass in exact.items():
        lower[robot.body_names.index(name), parameters.MASS] = mass
        upper[robot.body_names.index(name), parameters.MASS] = mass
    for name, intervals in (settings.bounds or {}).items():
        if name not in robot.body_names:
            raise UnknownNameError.at_field("estimator.bounds", name, robot.body_names)
        body = robot.body_names.index(name)
        for parameter, (low, high) in intervals.items():
            field = f"estimator.bounds.{name}"
            if parameter not in PARAMETERS:
                raise UnknownNameError.at_field(field, parameter, PARAMETERS)
            number = PARAMETERS.index(parameter)
            field = f"{field}.{parameter}"
            _check_fitted(settings, robot, body, parameter, field)
            _check_interval(parameter, low, high, field)
            lower[body, number] = -np.inf if low is None else low
            upper[body, number] = np.inf if high is None else high
    return lower, upper


def _check_fitted(settings: EstimatorConfig, robot: Robot, body: int, parameter: str, field: str) -> None:
    """Raise ConfigError for a bound on a parameter that is not fitted."""
    name = robot.body_names[body]
    friction = parameter in _FRICTION
    if name in settings.frozen:
        raise ConfigError.at_field(field, "a bound, but the body is frozen", "one of the two")
    if friction and robot.bodies[body].joint is None:
        raise ConfigError.at_field(field, f"a bound on friction, but {name} is the base", "a body with a joint")
    if friction and not settings.friction:
        raise ConfigError.at_field(field, "a bound on friction, but friction is not fitted", "estimator.friction: true")
    if not friction and robot.bodies[body].massless:
        raise ConfigError.at_field(field, f"a bound, but {name} has no mass in the {robot.format}", "a body with mass")


def _check_interval(parameter: str, low: float | None, high: float | None, field: str) -> None:
    """Raise ConfigError for bounds that no number, or no body, can meet."""
    if low is not None and high is not None and low > high:
        raise ConfigError.at_field(field, f"lower {low:g} is above upper {high:g}", "[lower, upper]; null for no bound")
    negative = min(x for x in (low, high, 0.0) if x is not None) < 0.0
    if parameter in _FRICTION and negative:
        raise ConfigError.at_field(field, f"[{low}, {high}]", "bounds of at least 0 (friction opposes motion)")
    if parameter in _POSITIVE and high is not None and high <= 0.0:
        raise ConfigError.at_field(field, f"upper bound {high:g}", "an upper bound above 0")


TOTAL = "estimator.total_mass"
"""Key of the mass of the whole robot."""

_WEIGHT = 10.0
"""Of an exact equation, in the largest singular value of all others.

They have no part along it (see `with_known_masses`), so that the weight matters only beside a ridge: one of 1e-3 leaves
1e-7 of the difference from the URDF. Each further ten takes a digit of the tolerance of rank.
"""

_LEAST_NOISE = 0.1
"""Least noise of whitened rows. Exact data have 1e-12, beside which a weighed mass would not count."""


@dataclass(frozen=True)
class KnownMass:
    """A known mass, `weights @ phi = value`.

    Attributes:
        field: key of the experiment file.
        weights: (12 L,), 1 at each mass in the sum.
        value: [kg].
        std: standard deviation [kg], 0 if exact.
    """

    field: str
    weights: Array
    value: float
    std: float = 0.0


def known_masses(settings: EstimatorConfig, robot: Robot) -> tuple[KnownMass, ...]:
    """Known masses of an experiment file.

    Raises:
        UnknownNameError: the robot has no such body.
        ConfigError: a body with a known mass is not fitted, or known masses leave nothing for the others.
    """
    stated = settings.masses
    for name in stated:
        field = f"estimator.masses.{name}"
        if name not in robot.body_names:
            raise UnknownNameError.at_field("estimator.masses", name, robot.body_names)
        if name in settings.frozen:
            raise ConfigError.at_field(field, "a mass, but the body is frozen", "one of the two")
        if robot.bodies[robot.body_names.index(name)].massless:
            raise ConfigError.at_field(field, f"a mass, but {name} has none in the {robot.format}", "a body with mass")
        if "m" in (settings.bounds or {}).get(name, {}):
            raise ConfigError.at_field(field, f"a mass, but estimator.bounds.{name}.m is also set", "one of the two")
    out = [
        KnownMass(f"estimator.masses.{name}", _weight_of(robot, name), mass.value, mass.std)
        for name, mass in stated.items()
    ]
    if settings.total_mass is not None:
        _check_total(settings, robot)
        mass = settings.total_mass
        out.append(KnownMass(TOTAL, mass_weights(len(robot.bodies)), mass.value, mass.std))
    return tuple(out)


def _weight_of(robot: Robot, body: str) -> Array:
    weights = np.zeros((len(robot.bodies), PER_BODY))
    weights[robot.body_names.index(body), parameters.MASS] = 1.0
    return weights.flatten()


def _check_total(settings: EstimatorConfig, robot: Robot) -> None:
    """Raise ConfigError if known and frozen masses exceed the total, or no mass is fitted."""
    total = settings.total_mass
    if total is None:
        return
    held = {name: float(robot.nominal[robot.body_names.index(name), parameters.MASS]) for name in settings.frozen}
    held |= {name: mass.value for name, mass in settings.masses.items()}
    free = [body.name for body in robot.bodies if not body.massless and body.name not in held]
    if sum(held.values()) >= total.value:
        reason = f"{total.value:g} kg, but {', '.join(held)} alone weigh {sum(held.values()):.4g} kg"
        raise ConfigError.at_field(TOTAL, reason, "the weighed mass of the whole robot")
    if not free:
        reason = f"{total.value:g} kg, but the masses of all bodies are frozen or known"
        raise ConfigError.at_field(TOTAL, reason, "remove this key, or fit the mass of a body")


@one_thread()
def with_known_masses(
    problem: LinearProblem, masses: Sequence[KnownMass], noise: float = 1.0, homogeneous: bool = False
) -> LinearProblem:
    """Add known masses to a problem as further rows.

    Exact masses are first eliminated from the other rows: these then depend only on deviations orthogonal to them (in
    units of the scale). So the rows of exact masses hold to rounding, whatever the data and their weight.

    Args:
        problem: in the bodies' parameters.
        masses: known masses.
        noise: standard deviation of whitened rows with correlation; it weights masses with a standard deviation.
        homogeneous: whether the rows do not determine the size of all forces. Zero forces would then fit best and
            shrink a mass with a standard deviation. So one such mass is eliminated too, and its row has only the
            deviation.
    """
    noise = max(noise, _LEAST_NOISE)
    kept = [mass for mass in masses if not mass.std]
    if homogeneous and not kept:
        kept = [*masses[-1:]]  # the total one, if any
    A, b, rows, values = _eliminated(problem, kept, noise)
    uncertain = [mass for mass in masses if mass not in kept]
    if uncertain:
        free = problem.free
        scale = problem.scale[problem.free]
        weights = noise / np.array([mass.std for mass in uncertain])
        (equations, missing) = _equations(problem, uncertain)
        more = np.zeros((len(weights), len(free)))
        more[:, free] = weights[:, None] * equations / scale
        rows = np.concatenate([rows, more])
        values = np.append(values, weights * missing + more @ problem.nominal)
    shrinkage = problem.shrinkage
    if shrinkage is not None:
        shrinkage = np.concatenate([shrinkage, np.zeros((len(rows), shrinkage.shape[1]))])
    return replace(
        problem,
        A=np.concatenate([A, rows]),
        b=np.append(b, values),
        rows=problem.rows + len(values),
        shrinkage=shrinkage,
    )


def _eliminated(problem: LinearProblem, masses: Sequence[KnownMass], noise: float) -> tuple[Array, Array, Array, Array]:
    """A and b of a problem that depend on no deviation along some masses, and the rows and right-hand side of these."""
    free = problem.free
    scale = problem.scale[problem.free]
    rows = np.zeros((len(masses), len(free)))
    if not masses:
        return problem.A, problem.b, rows, np.zeros(0)
    equations, missing = _equations(problem, masses)
    Q, R = np.linalg.qr(equations.T)
    target = np.linalg.solve(R.T, missing) + Q.T @ (problem.nominal[free] / scale)  # along Q, orthonormal columns
    scaled = problem.A[:, free] * scale
    A = problem.A.copy()
    along = scaled @ Q
    A[:, free] -= along @ (Q.T / scale)
    weight = _WEIGHT * float(np.linalg.norm(scaled - along @ Q.T, 2))
    if masses[0].std:
        weight = min(weight, noise / masses[0].std * float(np.linalg.norm(equations)))
    rows[:, free] = weight * Q.T / scale
    return A, problem.b - along @ target, rows, weight * target


def _equations(problem: LinearProblem, masses: Sequence[KnownMass]) -> tuple[Array, Array]:
    """Rows (k, P') and right-hand sides (k,) in scaled deviations of the free parameters from the nominal ones."""
    free = problem.free
    scale = problem.scale[problem.free]
    weights = np.array([mass.weights for mass in masses]).reshape(len(masses), len(free))
    missing = np.array([mass.value for mass in masses]) - weights @ problem.nominal
    return weights[:, free] * scale, missing
