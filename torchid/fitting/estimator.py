"""What an experiment file says of the estimator: itself, and the conditions on the parameters."""

from __future__ import annotations

import numpy as np

from torchid import parameters
from torchid.config.estimator import EstimatorConfig
from torchid.errors import ConfigError, UnknownNameError, warn
from torchid.estimators import Conditions, Consistent, Enclosure, LeastSquares, Mirror
from torchid.parameters import PARAMETERS, Array
from torchid.robot import Robot, body_extents, mirror_pairs

_FRICTION = PARAMETERS[parameters.FRICTION]
_POSITIVE = ("m", "Ixx", "Iyy", "Izz")


def batch_estimator(settings: EstimatorConfig, conditions: Conditions) -> LeastSquares | Consistent:
    """What solves a compressed problem in one go; for a descent, what it approaches with the same ridge.

    Penalties of a descent are not part of it.

    Args:
        settings: of the estimator.
        conditions: from `conditions_from`.

    Raises:
        InputError: the certified method without CVXPY and Clarabel.
    """
    if settings.name == "least_squares":
        return settings.least_squares
    if settings.name == "sgd" and (settings.consistency == "penalties" or not settings.numeric_ridge):
        return settings.least_squares
    return settings.consistent(conditions)


def conditions_from(settings: EstimatorConfig, robot: Robot, source: object = "experiment") -> Conditions:
    """Conditions on the parameters (L, 12) of a robot's bodies, as an experiment file says.

    Least squares may break them; those of a descent are a margin alone. `com_inside` leaves out bodies that are frozen,
    have no mass, or whose shapes are not known. Two frozen bodies need not be mirror images.

    Args:
        settings: of the estimator.
        robot: for its bodies, shapes and symmetry.
        source: named in errors.

    Raises:
        ConfigError: a bound that nothing can meet or that has nothing to bound; shapes nowhere; bodies that are not
            mirrored (see `mirror_pairs`).
        UnknownNameError: a body or parameter that there is not.
        UrdfError: a shape that is not described by numbers.

    Warns:
        TorchidWarning: bodies without known shapes, or whose centre of mass in the URDF is outside theirs.
    """
    if settings.name != "consistent":
        return Conditions(margin=settings.margin if settings.name == "sgd" else 0.0, names=robot.body_names)
    lower, upper = _bounds(settings, robot, source)
    return Conditions(
        margin=settings.margin,
        total_mass=settings.total_mass,
        enclosures=_enclosures(settings, robot, source),
        mirrors=_mirrors(settings, robot, source),
        lower=lower,
        upper=upper,
        names=robot.body_names,
    )


def _enclosures(settings: EstimatorConfig, robot: Robot, source: object) -> tuple[Enclosure, ...]:
    if settings.com_inside is None:
        if settings.com_shapes != EstimatorConfig.com_shapes:
            found = f"{settings.com_shapes}, without com_inside"
            raise ConfigError(source, "estimator.com_shapes", found, "com_inside: box or ellipsoid as well")
        return ()
    bodies = [i for i, body in enumerate(robot.bodies) if not body.massless and body.name not in settings.frozen]
    extents = body_extents(robot, settings.com_shapes, bodies)
    if not extents:
        found = f"{settings.com_inside}, but {robot.path.name} says of no body that is fitted what shape it has"
        raise ConfigError(source, "estimator.com_inside", found, "null, or a URDF with shapes")
    out, outside = [], []
    for body, extent in extents.items():
        half = extent.half if settings.com_inside == "box" else extent.semi_axes
        out.append(Enclosure(body, settings.com_inside, extent.centre, extent.axes, half))
        _, com, _ = parameters.mass_com_inertia(robot.nominal[body])
        local = np.abs(extent.axes.T @ (com - extent.centre)) / half
        if (local.max() if settings.com_inside == "box" else np.linalg.norm(local)) > 1.0:
            outside.append(robot.body_names[body])
    if outside:
        message = f"the URDF's own centre of mass is outside the {settings.com_inside} at {', '.join(outside)}"
        advice = "are the shapes where the matter is? (estimator.com_shapes)"
        warn(f"{source}: estimator.com_inside: {message}; {advice}")
    return tuple(out)


def _mirrors(settings: EstimatorConfig, robot: Robot, source: object) -> tuple[Mirror, ...]:
    symmetry = settings.symmetry
    if symmetry is None:
        return ()
    pairs = mirror_pairs(
        robot, symmetry.left, symmetry.right, symmetry.normal, source, "estimator.symmetry", settings.frozen
    )
    return tuple(
        Mirror(pair.body, pair.image, pair.reflection) for pair in pairs if not robot.bodies[pair.body].massless
    )


def _bounds(settings: EstimatorConfig, robot: Robot, source: object) -> tuple[Array | None, Array | None]:
    """Lower and upper bounds, (L, 12), None if the file has none."""
    if not settings.bounds:
        return None, None
    lower, upper = np.full(robot.nominal.shape, -np.inf), np.full(robot.nominal.shape, np.inf)
    for name, intervals in settings.bounds.items():
        if name not in robot.body_names:
            raise UnknownNameError(source, "estimator.bounds", name, robot.body_names)
        body = robot.body_names.index(name)
        for parameter, (low, high) in intervals.items():
            field = f"estimator.bounds.{name}"
            if parameter not in PARAMETERS:
                raise UnknownNameError(source, field, parameter, PARAMETERS)
            number, field = PARAMETERS.index(parameter), f"{field}.{parameter}"
            _check_fitted(settings, robot, body, parameter, source, field)
            _check_interval(parameter, low, high, source, field)
            lower[body, number] = -np.inf if low is None else low
            upper[body, number] = np.inf if high is None else high
    return lower, upper


def _check_fitted(
    settings: EstimatorConfig, robot: Robot, body: int, parameter: str, source: object, field: str
) -> None:
    """Refuse a bound on what stays as it is in the URDF."""
    name, friction = robot.body_names[body], parameter in _FRICTION
    if name in settings.frozen:
        raise ConfigError(source, field, "a bound on a body that is frozen", "one of the two")
    if friction and robot.bodies[body].joint is None:
        raise ConfigError(source, field, f"a bound on friction, but {name} is the base", "a body that a joint moves")
    if friction and not settings.friction:
        raise ConfigError(source, field, "a bound on friction, which is not fitted", "friction: true")
    if not friction and robot.bodies[body].massless:
        raise ConfigError(source, field, f"a bound, but {name} has no mass in the URDF", "a body that has")


def _check_interval(parameter: str, low: float | None, high: float | None, source: object, field: str) -> None:
    """Refuse what no number, or no body, is within."""
    if low is not None and high is not None and low > high:
        raise ConfigError(source, field, f"{low:g} above {high:g}", "[lower, upper], null for an open side")
    negative = min(x for x in (low, high, 0.0) if x is not None) < 0.0
    if parameter in _FRICTION and negative:
        raise ConfigError(source, field, f"[{low}, {high}]", "bounds of at least 0: friction resists")
    if parameter in _POSITIVE and high is not None and high <= 0.0:
        raise ConfigError(source, field, f"at most {high:g}", "an upper bound above 0")
