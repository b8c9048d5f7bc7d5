"""Conditions that an experiment file puts on the parameters of a robot's bodies."""

from __future__ import annotations

import numpy as np

from torchid import parameters
from torchid.config.estimator import EstimatorConfig
from torchid.errors import ConfigError, UnknownNameError, warn_about_file
from torchid.estimators import Conditions, Enclosure, Mirror
from torchid.parameters import PARAMETERS, Array
from torchid.robot import Robot, body_extents, mirror_pairs

_FRICTION = PARAMETERS[parameters.FRICTION]
_POSITIVE = ("m", "Ixx", "Iyy", "Izz")


def conditions_from(settings: EstimatorConfig, robot: Robot) -> Conditions:
    """Conditions on the parameters (L, 12) of a robot's bodies, as an experiment file says.

    Least squares may break them; those of a descent are a margin alone. `com_inside` leaves out bodies that are frozen,
    have no mass, or whose shapes are not known. Two frozen bodies need not be mirror images.

    Args:
        settings: of the estimator.
        robot: for its bodies, shapes and symmetry.

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
            found = f"{settings.com_shapes}, without com_inside"
            raise ConfigError.at_field("estimator.com_shapes", found, "com_inside: box or ellipsoid as well")
        return ()
    bodies = [i for i, body in enumerate(robot.bodies) if not body.massless and body.name not in settings.frozen]
    extents = body_extents(robot, settings.com_shapes, bodies)
    if not extents:
        found = f"{settings.com_inside}, but {robot.path.name} says of no body that is fitted what shape it has"
        raise ConfigError.at_field("estimator.com_inside", found, f"null, or a {robot.format} with shapes")
    out, outside = [], []
    for body, extent in extents.items():
        half = extent.half if settings.com_inside == "box" else extent.semi_axes
        out.append(Enclosure(body, settings.com_inside, extent.centre, extent.axes, half))
        _, com, _ = parameters.mass_com_inertia(robot.nominal[body])
        local = np.abs(extent.axes.T @ (com - extent.centre)) / half
        if (local.max() if settings.com_inside == "box" else np.linalg.norm(local)) > 1.0:
            outside.append(robot.body_names[body])
    if outside:
        where = f"outside the {settings.com_inside} at {', '.join(outside)}"
        message = f"estimator.com_inside: the {robot.format}'s own centre of mass is {where}"
        warn_about_file(f"{message}; are the shapes where the matter is? (estimator.com_shapes)")
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
    lower, upper = np.full(robot.nominal.shape, -np.inf), np.full(robot.nominal.shape, np.inf)
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
            number, field = PARAMETERS.index(parameter), f"{field}.{parameter}"
            _check_fitted(settings, robot, body, parameter, field)
            _check_interval(parameter, low, high, field)
            lower[body, number] = -np.inf if low is None else low
            upper[body, number] = np.inf if high is None else high
    return lower, upper


def _check_fitted(settings: EstimatorConfig, robot: Robot, body: int, parameter: str, field: str) -> None:
    """Refuse a bound on what stays as it is in the URDF."""
    name, friction = robot.body_names[body], parameter in _FRICTION
    if name in settings.frozen:
        raise ConfigError.at_field(field, "a bound on a body that is frozen", "one of the two")
    if friction and robot.bodies[body].joint is None:
        raise ConfigError.at_field(field, f"a bound on friction, but {name} is the base", "a body that a joint moves")
    if friction and not settings.friction:
        raise ConfigError.at_field(field, "a bound on friction, which is not fitted", "friction: true")
    if not friction and robot.bodies[body].massless:
        raise ConfigError.at_field(field, f"a bound, but {name} has no mass in the {robot.format}", "a body that has")


def _check_interval(parameter: str, low: float | None, high: float | None, field: str) -> None:
    """Refuse what no number, or no body, is within."""
    if low is not None and high is not None and low > high:
        raise ConfigError.at_field(field, f"{low:g} above {high:g}", "[lower, upper], null for an open side")
    negative = min(x for x in (low, high, 0.0) if x is not None) < 0.0
    if parameter in _FRICTION and negative:
        raise ConfigError.at_field(field, f"[{low}, {high}]", "bounds of at least 0: friction resists")
    if parameter in _POSITIVE and high is not None and high <= 0.0:
        raise ConfigError.at_field(field, f"at most {high:g}", "an upper bound above 0")
