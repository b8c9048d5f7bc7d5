"""Extra parameters of sensors and actuators, the total mass, and what they are confounded with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchid import parameters
from torchid.estimators import Estimate
from torchid.parallel import one_thread
from torchid.parameters import Array
from torchid.problem import LinearProblem, RowBuilder
from torchid.problem.compression import Part, merge_factors
from torchid.problem.elimination import Assembly, Elimination
from torchid.problem.extras import Extra
from torchid.reprs import decimal
from torchid.rounding import RANK_TOLERANCE, UNOBSERVABLE_SHARE

INFLATION_LIMIT = 10.0
"""An extra parameter is confounded with others if not knowing these increases its standard error by more than this.

It is a variance inflation of 100, ten times what is commonly taken for serious collinearity; source: Belsley, Kuh,
Welsch, "Regression Diagnostics", 1980.
"""

_BY_MASS = 0.9  # share of a variance that a known total mass would take off, from which on it is named
_NAMED = 4  # parameters, at most, in a message
_CONTRADICTS = 5.0  # standard errors between readings in the air and in contact; noise is seldom white
_NOTICEABLE = 3.0  # standard deviations of the sensor's noise: less is invisible in a single reading


@dataclass(frozen=True)
class ExtraEstimate:
    """An estimated offset, scale or actuator term.

    Attributes:
        extra: the parameter.
        log: source of the log, "" if it is common to all.
        value: in its unit.
        nominal_value: the best fit at the nominal parameters of the bodies.
        noise_error: standard error without regularization if residuals are independent noise; infinite if the data do
            not determine it.
        inflation: of the standard error by not knowing all other parameters, at least 1.
        confounded_with: names of other parameters, those with most influence first; empty if it is separable.
        block_error: standard error by the scatter between blocks of the logs, see `Jackknife`; 0 where there are too
            few.
        mass_separates: whether it is confounded with the total mass, so that stating this would separate it.
        at_bound: whether a condition on it holds with equality: it would be beyond, but cannot be.
    """

    extra: Extra
    log: str
    value: float
    nominal_value: float
    noise_error: float
    inflation: float
    confounded_with: tuple[str, ...]
    block_error: float = 0.0
    mass_separates: bool = False
    at_bound: bool = False

    @property
    def standard_error(self) -> float:
        """The larger of `noise_error` and `block_error`."""
        return max(self.noise_error, self.block_error)

    @property
    def separable(self) -> bool:
        """Whether the data separate it from all other parameters."""
        return self.inflation <= INFLATION_LIMIT


@one_thread()
def estimate_extras(
    assembly: Assembly, estimate: Estimate, body_names: Sequence[str], rank_tolerance: float = RANK_TOLERANCE
) -> list[ExtraEstimate]:
    """All eliminated extra parameters that some row depends on, at the estimated parameters of the bodies.

    Args:
        assembly: from `assemble`.
        estimate: of its problem.
        body_names: the robot's.
        rank_tolerance: as in `LeastSquares`.
    """
    if not assembly.eliminations:
        return []
    covariance = ParameterCovariance.of(assembly.problem, rank_tolerance, assembly.stated)
    names = _names(assembly.problem.free, body_names)
    noise = float(np.sqrt(assembly.problem.oversampling) * estimate.residual_std)
    shared = next((elimination for elimination in assembly.eliminations if not elimination.log), None)
    values = zip(
        assembly.extras_at(estimate.phi, estimate.psi), assembly.extras_at(assembly.problem.nominal), strict=True
    )
    out = []
    for elimination, pair in zip(assembly.eliminations, values, strict=True):
        out += _estimates(elimination, pair, noise, covariance, names, shared if elimination.log else None)
    terms = assembly.problem.terms
    bound = set() if terms is None else terms.at_bounds(estimate.phi, estimate.psi)
    out = [replace(x, at_bound=not x.log and x.extra.label in bound) for x in out]
    if assembly.scaled_by is None:
        return out
    return [replace(x, noise_error=np.inf, inflation=np.inf, mass_separates=True) for x in out]


@dataclass(frozen=True)
class Disagreement:
    """An offset for which readings in the air and the other data disagree.

    Attributes:
        extra: the offset.
        log: source of the log.
        in_the_air: reading of the unloaded sensor, in its unit.
        in_contact: the same, predicted with the offset and scale that fit the other data best.
        standard_error: of the difference.
    """

    extra: Extra
    log: str
    in_the_air: float
    in_contact: float
    standard_error: float

    @property
    def standard_errors(self) -> float:
        """Difference of the two in standard errors."""
        return abs(self.in_the_air - self.in_contact) / self.standard_error

    def exceeds_noise(self, noise: Array) -> bool:
        """Whether the difference is significant and exceeds the noise (6,) of contact sensors [N, N m]."""
        axis = 0 if self.extra.contact is None else self.extra.contact[1]
        difference = abs(self.in_the_air - self.in_contact)
        return self.standard_errors > _CONTRADICTS and difference > _NOTICEABLE * float(noise[axis])


@one_thread()
def disagreements(
    parts: Sequence[Part], builder: RowBuilder, in_contact: Sequence[ExtraEstimate], noise: float = 1.0
) -> list[Disagreement]:
    """Offsets for which readings in the air and all other rows disagree, most significant first.

    Args:
        parts: of the logs.
        builder: of their rows.
        in_contact: extra parameters of a fit without the unloaded parts.
        noise: standard deviation of whitened rows, correlation counted.
    """
    out = []
    for source in dict.fromkeys(part.source for part in parts if part.unloaded):
        estimates = {(x.extra.what, at): x for x in in_contact if x.log in ("", source) for at in x.extra.contacts}
        R = merge_factors(
            (part.factor for part in parts if part.unloaded and part.source == source), builder
        ).triangle()
        for number, extra in enumerate(builder.extras, start=builder.columns.count):
            column, at = R[:, number].numpy(), extra.contact
            if extra.what != "offset" or at is None or not column.any():
                continue
            if (offset := estimates.get(("offset", at))) is not None:
                weight = float(column @ column)
                read, scale = float(column @ R[:, -1].numpy()) / weight, estimates.get(("scale", at))
                expected, variance = offset.value, offset.standard_error**2 + noise**2 / weight
                if scale is not None:
                    expected, variance = expected / (1.0 + scale.value), variance + (read * scale.standard_error) ** 2
                deviation = float(np.sqrt(variance))
                out.append(Disagreement(extra, source, read, expected, deviation))
    sensors = builder.sensors.noise.wrench_std
    return sorted((x for x in out if x.exceeds_noise(sensors)), key=lambda x: -x.standard_errors)


@dataclass(frozen=True)
class TotalMass:
    """The total mass of a fit [kg].

    Attributes:
        standard_error: infinite where the data do not determine it.
        separable: whether it is not confounded with offsets and scales of sensors, as in `ExtraEstimate`.
        value: the identified one.
        nominal: the URDF's.
    """

    standard_error: float
    separable: bool
    value: float
    nominal: float

    @property
    def determined(self) -> bool:
        """Whether the data determine it: a 95 % interval no wider than the URDF's mass on either side."""
        return self.separable and 2.0 * self.standard_error <= self.nominal

    def __str__(self) -> str:
        """The total mass with its standard error, or the reason why it is not determined."""
        if self.determined:
            return f"{decimal(self.value)} ± {self.standard_error:.2g} kg"
        if not self.separable:
            return "not determined: confounded with offsets"
        known = f", standard error {self.standard_error:.2g} kg" if np.isfinite(self.standard_error) else ""
        return f"not determined by the data{known}"


def total_mass(
    assembly: Assembly,
    estimate: Estimate,
    rank_tolerance: float = RANK_TOLERANCE,
    block_error: float = 0.0,
    gain_error: float = 0.0,
) -> TotalMass:
    """The total mass of estimated parameters, with a standard error without regularization.

    Args:
        assembly: from `assemble`.
        estimate: of its problem.
        rank_tolerance: as in `LeastSquares`.
        block_error: standard error by the scatter between blocks of the logs, which counts if it is the larger.
        gain_error: standard error by errors of the sensors' gain.
    """
    weights = mass_weights(len(estimate.phi) // parameters.PER_BODY)
    known = assembly.problem, assembly.if_known
    error, if_known = (combination_standard_error(x, estimate, weights, rank_tolerance) for x in known)
    noise = float(np.sqrt(assembly.problem.oversampling) * estimate.residual_std)
    covariance = ParameterCovariance.of(assembly.problem, rank_tolerance, assembly.stated)
    along = covariance.scale_sensitivity(weights[None])[0]
    by_rows = noise * float(np.linalg.norm(along @ covariance.root)) if np.isfinite(error) else error
    by_data = noise * covariance.without_stated(by_rows / noise, along) if assembly.stated and noise else by_rows
    separable = not np.isfinite(if_known) or by_data <= INFLATION_LIMIT * if_known
    value, nominal = (float(weights @ phi) for phi in (estimate.phi, assembly.problem.nominal))
    if assembly.scaled_by is not None:
        return TotalMass(np.inf, False, value, nominal)
    return TotalMass(float(np.hypot(max(error, block_error), gain_error)), separable, value, nominal)


def mass_weights(bodies: int) -> Array:
    """Weights of the total mass in all parameters of so many bodies, (12 L,)."""
    weights = np.zeros((bodies, parameters.PER_BODY))
    weights[:, parameters.MASS] = 1.0
    return weights.flatten()


@one_thread()
def combination_standard_error(
    problem: LinearProblem, estimate: Estimate, weights: Array, rank_tolerance: float = RANK_TOLERANCE
) -> float:
    """Standard error of a combination `weights @ phi`, (12 L,), without regularization, if residuals are noise.

    Infinite where the data do not determine it; what is not free counts as known.
    """
    covariance = ParameterCovariance.of(problem, rank_tolerance)
    along = covariance.scale_sensitivity(weights[None])
    if np.linalg.norm(along @ covariance.null_space) > UNOBSERVABLE_SHARE * np.linalg.norm(along):
        return float("inf")
    noise = np.sqrt(problem.oversampling) * estimate.residual_std * np.linalg.norm(along @ covariance.root)
    if problem.shrinkage is None:
        return float(noise)
    by_rows = covariance.root.T @ (problem.A[:, problem.free] * covariance.scale).T @ problem.shrinkage
    return float(np.hypot(noise, np.linalg.norm(along @ covariance.root @ by_rows)))


@dataclass(frozen=True)
class ParameterCovariance:
    """Covariance of the free parameters by the rows alone, in units of their scale and of the rows' noise.

    Attributes:
        root: (P', rank), its outer product is the covariance.
        null_space: (P', P' - rank), directions that no row depends on.
        values: (P',), singular values that belong to the columns of both.
        scale: (P',), of the free parameters.
        free: (P,) bool.
        by_stated: (P', stated), change of the parameters by unit errors of what is known of them.
    """

    root: Array
    null_space: Array
    values: Array
    scale: Array
    free: np.ndarray
    by_stated: Array

    @classmethod
    def of(cls, problem: LinearProblem, rank_tolerance: float, stated: int = 0) -> ParameterCovariance:
        """Of the rows of a problem, the last `stated` of which are no data; `rank_tolerance` as in `LeastSquares`."""
        return problem.shared(("covariance", rank_tolerance, stated), lambda: cls._of(problem, rank_tolerance, stated))

    @classmethod
    def _of(cls, problem: LinearProblem, rank_tolerance: float, stated: int) -> ParameterCovariance:
        scale = problem.scale[problem.free]
        _, values, Vt = np.linalg.svd(problem.A[:, problem.free] * scale, full_matrices=True)
        least = max(rank_tolerance, np.finfo(float).eps * max(problem.A.shape)) * values.max(initial=0.0)
        rank = int((values > least).sum())
        values = np.pad(values, (0, len(Vt) - len(values)))
        values[rank:] = 0.0
        root = Vt[:rank].T / values[:rank]
        known = problem.A[len(problem.A) - stated :, problem.free] * scale
        return cls(root, Vt[rank:].T, values, scale, problem.free, by_stated=root @ (root.T @ known.T))

    def variance_shares(self, sensitivity: Array, noise: float) -> Array:
        """Part (P',) of the variance along sensitivities (P',) due to each parameter, as a share of the largest.

        The prior bounds each deviation to about its scale: else the least certain parameter would dominate.
        """
        shares = sensitivity * self._bounded(sensitivity, noise)
        return np.asarray(shares / max(np.abs(shares).max(initial=0.0), np.finfo(float).tiny))

    def shared_variance(self, sensitivity: Array, other: Array, noise: float) -> float:
        """Share of the variance along sensitivities (P',) that goes if a combination of parameters, (P',), is known.

        It is their squared correlation, with variances as in `variance_shares`.
        """
        own, of_other = self._bounded(sensitivity, noise), self._bounded(other, noise)
        product = float(sensitivity @ own) * float(other @ of_other)
        return float(other @ own) ** 2 / max(product, np.finfo(float).tiny)

    def _bounded(self, sensitivity: Array, noise: float) -> Array:
        """Covariance of the parameters, each bounded by its scale, with a combination (P',) of them, (P',)."""
        noise = max(noise, UNOBSERVABLE_SHARE**2)  # of exact data, whose variance is all due to the least certain
        rank = self.root.shape[1]
        directions = np.hstack([self.root * self.values[:rank], self.null_space])
        return np.asarray(directions @ (directions.T @ sensitivity / (1.0 + (self.values / noise) ** 2)))

    def without_stated(self, deviation: float, sensitivity: Array) -> float:
        """A standard deviation along sensitivities (P',) less the part of what is known of the parameters."""
        if not self.by_stated.size:
            return deviation
        return float(np.sqrt(max(deviation**2 - float(np.square(sensitivity @ self.by_stated).sum()), 0.0)))

    def scale_sensitivity(self, sensitivity: Array) -> Array:
        """Sensitivities to the scaled free parameters, (M, P'), of those to all parameters, (M, 12 L)."""
        return np.asarray(sensitivity[:, self.free] * self.scale)


def _estimates(
    elimination: Elimination,
    values: tuple[Array, Array],
    noise: float,
    covariance: ParameterCovariance,
    names: Sequence[str],
    shared: Elimination | None,
) -> list[ExtraEstimate]:
    """Estimates of one elimination at identified and nominal parameters; `shared`: that of the unknowns of all logs."""
    P = len(covariance.free)
    sensitivity = elimination.inverse @ elimination.C[:, :P]
    own, unobservable = [elimination.inverse], [elimination.unobservable]
    if shared is not None:
        through = elimination.inverse @ elimination.C[:, P:]
        sensitivity = sensitivity - through @ shared.inverse @ shared.C[:, :P]
        own.append(through @ shared.inverse)
        unobservable.append(through @ shared.unobservable)
    G = covariance.scale_sensitivity(sensitivity)
    mass = covariance.scale_sensitivity(mass_weights(P // parameters.PER_BODY)[None])[0]
    size = np.maximum(np.linalg.norm(G, axis=1), np.finfo(float).tiny)
    undetermined_by_bodies = np.linalg.norm(G @ covariance.null_space, axis=1) > UNOBSERVABLE_SHARE * size
    through_parameters = ((G @ covariance.root) ** 2).sum(1)
    variance = sum((x**2).sum(1) for x in own) + through_parameters
    undetermined = (
        undetermined_by_bodies
        | ~elimination.determined
        | (np.linalg.norm(np.hstack(unobservable), axis=1) > UNOBSERVABLE_SHARE)
    )
    deviation = np.where(undetermined, np.inf, np.sqrt(variance))
    out = []
    for k, extra in enumerate(elimination.extras):
        if not np.isfinite(elimination.std_if_known[k]):
            continue
        inflation = covariance.without_stated(float(deviation[k]), G[k]) / float(elimination.std_if_known[k])
        by_mass = inflation > INFLATION_LIMIT and covariance.shared_variance(G[k], mass, noise) > _BY_MASS
        confounded: tuple[str, ...] = ()
        if inflation > INFLATION_LIMIT:
            by_bodies = undetermined_by_bodies[k] or 2.0 * through_parameters[k] > variance[k]
            confounded = _largest(covariance.variance_shares(G[k], noise), names) if by_bodies else ()
            unobservable_others = np.where(np.arange(len(elimination.extras)) == k, 0.0, elimination.unobservable[k])
            others = _largest(unobservable_others, [extra.label for extra in elimination.extras])
            confounded = (*confounded, *others)
        error = noise * float(deviation[k]) if np.isfinite(deviation[k]) else np.inf
        value, nominal = (float(x[k]) for x in values)
        out.append(
            ExtraEstimate(
                extra=extra,
                log=elimination.log,
                value=value,
                nominal_value=nominal,
                noise_error=error,
                inflation=inflation,
                confounded_with=confounded,
                mass_separates=by_mass,
            )
        )
    return out


def _largest(along: Array, names: Sequence[str]) -> tuple[str, ...]:
    """Names of the largest components of a direction, without relatively small ones."""
    order = np.argsort(-np.abs(along))[:_NAMED]
    least = max(0.2 * np.abs(along).max(initial=0.0), UNOBSERVABLE_SHARE)
    return tuple(names[k] for k in order if np.abs(along[k]) > least)


def _names(free: np.ndarray, body_names: Sequence[str]) -> list[str]:
    """Names of the free parameters: "pelvis m"."""
    every = [f"{body} {name}" for body in body_names for name in parameters.PARAMETERS]
    return [name for name, chosen in zip(every, free, strict=True) if chosen]
