"""Random bodies and random problems about them, made of mass points: independent of the estimators under test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from synthetic import Array

from torchid import parameters
from torchid.estimators import Conditions, Enclosure, Mirror
from torchid.estimators.conic import Prior
from torchid.problem import LinearProblem
from torchid.problem.linear import parameter_scale

PRIORS: tuple[Prior, ...] = ("euclidean", "pullback", "entropic")


def of_points(mass: Array, place: Array) -> Array:
    """Twelve parameters of points, masses (N,) at places (N, 3), written out; no friction."""
    x, y, z = place.T
    pairs = ((y, y, z, z), (x, -y), (x, -z), (x, x, z, z), (y, -z), (x, x, y, y))
    inertia = [mass @ (p[0] * p[1] + p[2] * p[3]) if len(p) == 4 else mass @ (p[0] * p[1]) for p in pairs]
    return np.array([mass.sum(), *(mass @ place), *inertia, 0.0, 0.0])


def pseudo(phi: Array) -> Array:
    """Pseudo-inertia (4, 4) of one body, written out from its definition: second moments, first moments, mass."""
    m, x, y, z, xx, xy, xz, yy, yz, zz = phi[:10]
    second = [(yy + zz - xx) / 2.0, (xx + zz - yy) / 2.0, (xx + yy - zz) / 2.0]
    return np.array([[second[0], -xy, -xz, x], [-xy, second[1], -yz, y], [-xz, -yz, second[2], z], [x, y, z, m]])


def random_points(rng: np.random.Generator) -> tuple[Array, Array]:
    """Masses and places of the points of a body, a decimetre around a point of its link."""
    mass = rng.uniform(0.05, 2.0, 8)
    spread = 10.0 ** rng.uniform(-1.3, -0.5, 3)
    R = Rotation.random(random_state=rng).as_matrix()
    return mass, 0.2 * rng.normal(size=3) + (spread * rng.normal(size=(8, 3))) @ R.T


def random_bodies(rng: np.random.Generator, count: int) -> Array:
    """Parameters (L, 12) of bodies that exist, with friction."""
    bodies = np.array([of_points(*random_points(rng)) for _ in range(count)])
    bodies[:, 10:] = rng.choice([0.0, 1.0], (count, 2)) * rng.uniform(0.0, 0.5, (count, 2))
    return bodies


def random_reflection(rng: np.random.Generator) -> Array:
    """An improper rotation, (3, 3)."""
    return np.array(-Rotation.random(random_state=rng).as_matrix())


def com(phi: Array) -> Array:
    """Centre of mass of one body, (3,) [m]."""
    return phi[1:4] / phi[0]


def least_eigenvalues(phi: Array, scale: Array) -> Array:
    """Of every body's scaled pseudo-inertia, (L,)."""
    return np.array([np.linalg.eigvalsh(pseudo(body))[0] for body in phi / scale])


def data(
    rng: np.random.Generator, nominal: Array, truth: Array, scale: Array, rows: int, spread: float, noise: float
) -> LinearProblem:
    """All parameters free, `rows` rows whose singular values span a factor `spread`; (L, 12) in."""
    columns = nominal.size
    rank = min(rows, columns)
    U, V = (np.linalg.qr(rng.normal(size=(n, rank)))[0] for n in (rows, columns))
    values = spread ** -np.sort(np.append([0.0, 1.0], rng.uniform(size=rank))[:rank])
    A = np.sqrt(rows) * (U * values) @ V.T / scale.ravel()
    b = A @ truth.ravel() + noise * rng.normal(size=rows)
    return LinearProblem(A, b, 0.0, rows, nominal.ravel(), scale.ravel(), np.ones(columns, dtype=bool))


@dataclass(frozen=True)
class Case:
    """A problem with conditions that some bodies meet, and the true parameters (L, 12) behind its data."""

    problem: LinearProblem
    conditions: Conditions
    truth: Array

    @property
    def scale(self) -> Array:
        """(L, 12)."""
        return self.problem.scale.reshape(self.truth.shape)


def random_case(rng: np.random.Generator, plain: bool = False) -> Case:
    """One to four bodies, data from bodies that exist or not, any kinds of condition (`plain`: margin, friction)."""
    count = int(rng.choice([1, 1, 1, 1, 2, 2, 3, 4]))
    nominal = random_bodies(rng, count)
    margin = float(10.0 ** rng.uniform(-4.0, -2.0))
    conditions = Conditions(margin)
    if not plain and rng.uniform() < 0.6:
        nominal, conditions = _more(rng, nominal, margin)
    scale = parameter_scale(nominal)
    truth = nominal + 10.0 ** rng.uniform(-2.0, 0.0) * scale * rng.normal(size=nominal.shape)
    if rng.uniform() < 0.4:
        truth = 0.5 * nominal + 0.5 * random_bodies(rng, count)
    rows = int(rng.integers(1, 15 * count))
    spread, noise = 10.0 ** rng.uniform(0.0, 5.0), 10.0 ** rng.uniform(-3.0, -1.0)
    return Case(data(rng, nominal, truth, scale, rows, spread, noise), conditions, truth)


def _more(rng: np.random.Generator, nominal: Array, margin: float) -> tuple[Array, Conditions]:
    """Conditions that the nominal parameters, changed where need be, all meet."""
    count, mirrors, enclosures = len(nominal), [], []
    if count > 1 and rng.uniform() < 0.5:
        mass, place = random_points(rng)
        reflection = random_reflection(rng)
        nominal[0, :10], nominal[1, :10] = of_points(mass, place)[:10], of_points(mass, place @ reflection.T)[:10]
        nominal[1, 10:] = nominal[0, 10:]
        mirrors.append(Mirror(0, 1, reflection))
    scale = parameter_scale(nominal)
    for body in np.flatnonzero(rng.uniform(size=count) < 0.4):
        axes, half = Rotation.random(random_state=rng).as_matrix(), rng.uniform(0.02, 0.2, 3)
        centre = com(nominal[body]) + axes @ (half * rng.uniform(-0.5, 0.5, 3))
        enclosures.append(Enclosure(int(body), str(rng.choice(["box", "ellipsoid"])), centre, axes, half))
    lower, upper = np.full(nominal.shape, -np.inf), np.full(nominal.shape, np.inf)
    bounded = rng.uniform(size=nominal.shape) < 0.1
    lower[bounded] = (nominal - rng.uniform(0.01, 0.5, nominal.shape) * scale)[bounded]
    upper[bounded] = (nominal + rng.uniform(0.01, 0.5, nominal.shape) * scale)[bounded]
    total = float(nominal[:, 0].sum()) if rng.uniform() < 0.5 else None
    margin = min(margin, 0.5 * float(least_eigenvalues(nominal, scale).min()))
    return nominal, Conditions(margin, total, tuple(enclosures), tuple(mirrors), lower, upper)


def random_parameters_within(
    rng: np.random.Generator, phi: Array, scale: Array, conditions: Conditions, size: float
) -> Array | None:
    """Parameters near `phi`, (L, 12), that meet plain conditions (margin, friction), None if the draw does not."""
    other = phi + size * scale * rng.normal(size=phi.shape)
    other[:, 10:] = np.abs(other[:, 10:])
    return other if (least_eigenvalues(other, scale) >= conditions.margin).all() else None


def prior_value(prior: str, phi: Array, nominal: Array, scale: Array, reference: Array | None = None) -> float:
    """What the docstrings say, written out, of bodies (L, 12) that are all free; `reference` for the pull-back."""
    away = ((phi - nominal) / scale) ** 2
    if prior == "euclidean":
        return float(away.sum())
    value = float(away[:, 10:].sum())
    for body, urdf, measure in zip(phi, nominal, nominal if reference is None else reference, strict=True):
        L = np.linalg.cholesky(pseudo(measure))
        relative = np.linalg.solve(L, np.linalg.solve(L, pseudo(body)).T)  # similar to J_0^-1/2 J J_0^-1/2
        if prior == "pullback":
            start = np.linalg.solve(L, np.linalg.solve(L, pseudo(urdf)).T)
            value += np.sum((relative - start) ** 2)
        else:
            value += -np.linalg.slogdet(relative)[1] + np.trace(relative) - 4.0
    return value


def objective(prior: str, ridge: float, problem: LinearProblem, phi: Array) -> float:
    """Mean squared residual and prior at `phi`, (L, 12)."""
    nominal, scale = (x.reshape(phi.shape) for x in (problem.nominal, problem.scale))
    return problem.cost(phi.ravel()) / problem.rows + ridge * prior_value(prior, phi, nominal, scale)


def as_good_as_none(ridge: float, problem: LinearProblem) -> float:
    """The objective below which gaps are relative to this."""
    return max(1e-8 * problem.cost(np.zeros_like(problem.nominal)) / problem.rows, 1e-3 * ridge)


def active_case(seed: int, bodies: int = 2, rows: int = 20) -> tuple[LinearProblem, Array]:
    """Data from bodies that do not exist, so that the margin is active, and the scale (L, 12)."""
    rng = np.random.default_rng(seed)
    nominal = random_bodies(rng, bodies)
    scale = parameter_scale(nominal)
    truth = nominal + 0.7 * scale * rng.normal(size=nominal.shape)
    return data(rng, nominal, truth, scale, rows, 30.0, 0.1), scale


def nothing_seen(nominal: Array, free: np.ndarray | None = None) -> LinearProblem:
    """One row that says nothing about bodies (L, 12)."""
    free = np.ones(nominal.size, dtype=bool) if free is None else free
    row = np.zeros((1, nominal.size))
    return LinearProblem(row, np.zeros(1), 0.0, 1, nominal.ravel(), parameter_scale(nominal).ravel(), free)


turned = Rotation.from_euler("xyz", [0.3, -0.5, 0.7]).as_matrix()


def body(mass: float, centre: Array, principal: list[float], friction: tuple[float, float] = (0.1, 0.2)) -> Array:
    """One body, (1, 12), of principal inertias about its centre of mass in turned axes."""
    ten = parameters.inertial_vector(mass, np.asarray(centre, dtype=float), turned @ np.diag(principal) @ turned.T)
    return np.append(ten, friction)[None]


GOOD = body(2.0, np.array([0.1, -0.2, 0.3]), [0.3, 0.4, 0.5])
SCALE = parameter_scale(GOOD)
