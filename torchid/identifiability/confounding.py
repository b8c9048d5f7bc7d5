"""Extra parameters, the total mass, what these are confounded with, and jackknife standard errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri, stdtrit  # scipy.stats takes 0.2 s to import

from torchid import parameters
from torchid.estimators import Estimate
from torchid.estimators.least_squares import residual_std
from torchid.parallel import one_thread
from torchid.parameters import PER_BODY, Array
from torchid.problem import LinearProblem, RowBuilder
from torchid.problem.compression import Part
from torchid.problem.elimination import Assembly, Elimination
from torchid.problem.extras import Extra
from torchid.reprs import decimal
from torchid.rounding import RANK_TOLERANCE, UNOBSERVABLE_SHARE

INFLATION_LIMIT = 10.0
"""An extra parameter is confounded with others if not knowing these increases its standard error by more than this.

It is a variance inflation of 100, ten times what is commonly taken for serious collinearity; source: Belsley, Kuh,
Welsch, "Regression Diagnostics", 1980.
"""

_BY_MASS = 0.9  # a known total mass is named if it would remove this fraction of a variance
_NAMED = 4  # parameters, at most, in a message


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
    """Estimate all eliminated extra parameters that some row depends on, at the bodies' estimated parameters.

    Args:
        assembly: from `assemble`.
        estimate: of its problem.
        body_names: of the robot.
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
class TotalMass:
    """Total mass of a fit [kg].

    Attributes:
        standard_error: infinite if the data do not determine the mass.
        separable: whether it is not confounded with sensor offsets and scales, as in `ExtraEstimate`.
        value: identified.
        nominal: of the URDF.
    """

    standard_error: float
    separable: bool
    value: float
    nominal: float

    @property
    def determined(self) -> bool:
        """Whether the data determine it: the 95 % interval is no wider than the URDF's mass on either side."""
        return self.separable and 2.0 * self.standard_error <= self.nominal

    def __str__(self) -> str:
        """The total mass with its standard error, or the reason why it is not determined."""
        if self.determined:
            return f"{decimal(self.value)} ± {self.standard_error:.2g} kg"
        if not self.separable:
            return "not determined: confounded with sensor offsets"
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
    """Weights of the total mass in the parameters of all bodies, (12 L,)."""
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
    """Covariance of the free parameters from the rows alone, in units of their scale and of the rows' noise.

    Attributes:
        root: (P', rank); its outer product is the covariance.
        null_space: (P', P' - rank), directions that no row depends on.
        values: (P',), singular values of the columns of both.
        scale: (P',), of the free parameters.
        free: (P,) bool.
        by_stated: (P', stated), change of the parameters per unit error of stated values, such as known masses.
    """

    root: Array
    null_space: Array
    values: Array
    scale: Array
    free: np.ndarray
    by_stated: Array

    @classmethod
    def of(cls, problem: LinearProblem, rank_tolerance: float, stated: int = 0) -> ParameterCovariance:
        """From the rows of a problem; the last `stated` rows are not data. `rank_tolerance` as in `LeastSquares`."""
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
        along_sensitivity = self._bounded(sensitivity, noise)
        of_other = self._bounded(other, noise)
        product = float(sensitivity @ along_sensitivity) * float(other @ of_other)
        return float(other @ along_sensitivity) ** 2 / max(product, np.finfo(float).tiny)

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
    roots = [elimination.inverse]
    unobservable = [elimination.unobservable]
    if shared is not None:
        through = elimination.inverse @ elimination.C[:, P:]
        sensitivity = sensitivity - through @ shared.inverse @ shared.C[:, :P]
        roots.append(through @ shared.inverse)
        unobservable.append(through @ shared.unobservable)
    G = covariance.scale_sensitivity(sensitivity)
    mass = covariance.scale_sensitivity(mass_weights(P // parameters.PER_BODY)[None])[0]
    size = np.maximum(np.linalg.norm(G, axis=1), np.finfo(float).tiny)
    undetermined_by_bodies = np.linalg.norm(G @ covariance.null_space, axis=1) > UNOBSERVABLE_SHARE * size
    through_parameters = ((G @ covariance.root) ** 2).sum(1)
    variance = sum((x**2).sum(1) for x in roots) + through_parameters
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


LEAST_BLOCKS = 3
"""Fewer blocks give no useful scatter: with two, a 95 % interval of Student's t is 12.7 standard errors wide."""

_LEAST_JUDGED = 8
"""With fewer blocks residuals that are alike within them are not told from noise, whose variance they hardly know."""

MOST_BLOCKS = 100
"""Of more, neighbours count as one: the factors of a fleet's logs are more than memory has room for matrices."""

_LEVERAGE = 0.95  # of the information that a block has on a combination, at most: it alone cannot say how it scatters
#: Noise of the motion in the information on a combination, as a share of what is left without it, up to which scatter
#: shows a lack of fit: beyond, noise times noise does not average out in a block, and scatters 3 to 9 times as much.
_LITTLE_NOISE = 0.1
_NORMAL = float(ndtri(0.975))


@dataclass(frozen=True)
class Jackknife:
    """Standard errors from the scatter of the parameters between blocks of the logs.

    Blocks of successive samples are longer than the correlation time of residuals: filtered noise, but also model
    errors such as friction. Leaving out one block at a time shows how much of such residuals enters the estimate.
    Standard errors from the size of the residuals treat them as white noise.

    Source: delete-a-group jackknife (Shao, Wu, Annals of Statistics 17, 1989), which for least squares is the
    cluster-robust covariance CR3 (Bell, McCaffrey, Survey Methodology 28, 2002), with quantiles of Student's t.

    Attributes:
        blocks: number G of blocks.
        deviations: (G, 12 L); their norm over the blocks is the standard error of the parameters, and 1.96 times it
            half of a 95 % interval. Rows from `shrinkage` of `LinearProblem` follow, if the rows are mostly motion
            noise; the scatter does not show this error.
        without_ridge: (G, 12 L), the same for the estimate without regularization.
        extras: the same for the extra parameters, (G, M) for each elimination, without regularization.
        lack_of_fit: variance of the residuals between blocks, divided by its value for white residuals: 1 if the model
            explains the forces, larger if residuals are correlated within a block. Only combinations with little motion
            noise count. None with too few blocks.
    """

    blocks: int
    deviations: Array
    without_ridge: Array
    extras: tuple[Array, ...]
    lack_of_fit: float | None

    @property
    def error(self) -> Array:
        """Standard errors of the parameters, (12 L,)."""
        return np.asarray(np.linalg.norm(self.deviations, axis=0))

    def error_along(self, weights: Array) -> float:
        """Standard error of a combination `weights @ phi`, (12 L,), without regularization."""
        return float(np.linalg.norm(self.without_ridge @ weights))

    @property
    def mass_error(self) -> float:
        """Standard error of the total mass [kg], without regularization."""
        return self.error_along(mass_weights(self.without_ridge.shape[1] // PER_BODY))


@one_thread()
def jackknife_blocks(
    parts: Sequence[Part], builder: RowBuilder, assembly: Assembly, ridge: float, rank_tolerance: float
) -> Jackknife | None:
    """The jackknife of an estimate over the blocks of its logs; None if these are too few.

    Args:
        parts: of the fit, from `compress_in_blocks`.
        builder: of their rows.
        assembly: of these parts.
        ridge: of the estimate.
        rank_tolerance: as in `LeastSquares`.
    """
    numbers = _numbered(parts)
    count = len({*numbers.values()})
    if count < LEAST_BLOCKS:
        return None
    problem = assembly.problem
    covariance = ParameterCovariance.of(problem, rank_tolerance)
    basis = np.zeros((len(problem.nominal), covariance.root.shape[1]))  # of unit variance by the rows alone
    basis[problem.free] = covariance.scale[:, None] * covariance.root
    best = problem.nominal + basis @ (basis.T @ (problem.A.T @ (problem.b - problem.A @ problem.nominal)))
    gradients, of_rows, of_noise = _by_block(parts, numbers, builder, assembly, best, basis)
    shares = of_rows - of_noise
    scores = gradients["bodies"] @ basis
    noise = (
        problem.oversampling * residual_std(problem.cost(best), problem.rows, basis.shape[1], problem.oversampling) ** 2
    )
    of_motion, axes = np.linalg.eigh(of_noise.sum(axis=0))
    known = axes[:, of_motion < _LITTLE_NOISE]
    expected = noise * np.trace(known.T @ (of_rows - of_rows @ shares).sum(axis=0) @ known)
    factor = np.sqrt((count - 1) / count) * stdtrit(count - 1, 0.975) / _NORMAL
    shrinkage = np.zeros((0, basis.shape[1])) if problem.shrinkage is None else problem.shrinkage.T @ problem.A @ basis
    without_ridge = np.concatenate([factor * _left_out(scores, shares), shrinkage]) @ basis.T
    with_ridge = without_ridge
    if ridge > 0.0:
        values = covariance.values[: basis.shape[1]]
        shrunk = values / np.sqrt(values**2 + ridge * problem.rows)
        scattered = factor * _left_out(scores * shrunk, shares * np.outer(shrunk, shrunk))
        with_ridge = np.concatenate([scattered, shrinkage * shrunk]) * shrunk @ basis.T
    growth = float(np.square(scores @ known).sum() / expected) if expected > 0.0 else 1.0
    return Jackknife(
        blocks=count,
        deviations=with_ridge,
        without_ridge=without_ridge,
        extras=_of_extras(gradients, without_ridge, assembly, factor),
        lack_of_fit=growth if count >= _LEAST_JUDGED else None,
    )


_Key = tuple[str, int, int]


def _key(part: Part) -> _Key:
    return part.source, part.fold, part.block


def _numbered(parts: Sequence[Part]) -> dict[_Key, int]:
    """The number of each block, log by log in time; neighbours share one where there are too many."""
    logs = list(dict.fromkeys(part.source for part in parts))
    keys = sorted({_key(part) for part in parts if not part.unloaded}, key=lambda key: (logs.index(key[0]), *key[1:]))
    count = min(len(keys), MOST_BLOCKS)
    return {key: index * count // len(keys) for index, key in enumerate(keys)}


def _left_out(scores: Array, shares: Array) -> Array:
    """Change of the estimate by each block, (G, r), where it is left out."""
    identity = np.eye(scores.shape[1])
    return np.array(
        [np.linalg.solve(identity - _LEVERAGE * share, score) for score, share in zip(scores, shares, strict=True)]
    )


def _by_block(
    parts: Sequence[Part],
    numbers: Mapping[_Key, int],
    builder: RowBuilder,
    assembly: Assembly,
    phi: Array,
    basis: Array,
) -> tuple[dict[str, Array], Array, Array]:
    """Gradients of half the squared residuals of each block, (G, columns), its share of information, and its noise.

    Gradients exclude the contribution of motion noise. They are by "bodies" (all parameters, with the best extra
    parameters), and by the log of each elimination (its extra parameters, with the best ones of single logs). Shares
    and noise are (G, r, r), by the columns of the basis.
    """
    count = max(numbers.values()) + 1
    gradients = {name: np.zeros((count, width)) for name, width in _widths(assembly).items()}
    shares, of_noise = (np.zeros((count, basis.shape[1], basis.shape[1])) for _ in range(2))
    columns = None
    along = basis
    for part in sorted((part for part in parts if not part.unloaded), key=lambda part: part.source):
        if columns is None or columns.source != part.source:
            columns = _Columns.of(builder, assembly, part.source, phi)
            along = columns.by_phi @ basis
        number = numbers[_key(part)]
        for support, block in part.factor.blocks.items():
            # the same bits from a cache
            rows = np.ascontiguousarray(block.cpu().double().numpy())
            at = list(support)
            residual = rows[:, -1] - rows[:, :-1] @ columns.values[at]
            columns.add_gradient(gradients, number, at, rows[:, :-1].T @ residual)
            projected = rows[:, :-1] @ along[at]
            shares[number] += projected.T @ projected
        for support, tensor in part.factor.noise_gram_of(assembly.reading_noise).items():
            more = np.ascontiguousarray(tensor.cpu().double().numpy())
            at = list(support)
            columns.add_gradient(gradients, number, at, more[:-1, :-1] @ columns.values[at] - more[:-1, -1])
            of_noise[number] += along[at].T @ more[:-1, :-1] @ along[at]
    return gradients, shares, of_noise


def _name(log: str) -> str:
    return f"extras of {log}"


def _widths(assembly: Assembly) -> dict[str, int]:
    return {"bodies": len(assembly.problem.nominal)} | {
        _name(elimination.log): len(elimination.extras) for elimination in assembly.eliminations
    }


@dataclass(frozen=True)
class _Columns:
    """Parameters in the columns of a log's rows, (width,), and their derivatives by the parameters of a fit.

    `by_phi`, (width, 12 L), with the best extra parameters; `by_extras`: (width, M) by the log of an elimination (""
    for all logs), with the best unknowns of single logs.
    """

    source: str
    values: Array
    by_phi: Array
    by_extras: dict[str, Array]

    def add_gradient(self, gradients: Mapping[str, Array], number: int, at: Sequence[int], gradient: Array) -> None:
        """Add the gradient by some columns to the gradient of a block."""
        gradients["bodies"][number] += self.by_phi[at].T @ gradient
        for log, by_extras in self.by_extras.items():
            gradients[_name(log)][number] += by_extras[at].T @ gradient

    @classmethod
    def of(cls, builder: RowBuilder, assembly: Assembly, source: str, phi: Array) -> _Columns:
        numbers = {
            eliminated.log: number
            for number, eliminated in enumerate(assembly.eliminations)
            if eliminated.log in ("", source)
        }
        values = np.zeros(builder.width)
        by_phi = np.zeros((builder.width, len(phi)))
        count = builder.columns.count
        values[:count] = builder.columns.parameter_map @ phi
        by_phi[:count] = builder.columns.parameter_map
        at_best = assembly.extras_at(phi)
        sensitivities = assembly.extras_sensitivity()
        by_extras: dict[str, Array] = {}
        for log, number in sorted(numbers.items()):  # that of all logs comes first
            elimination = assembly.eliminations[number]
            places = [count + builder.extras.index(extra) for extra in elimination.extras]
            values[places] = at_best[number]
            by_phi[places] = sensitivities[number]
            by_extras[log] = np.zeros((builder.width, len(places)))
            by_extras[log][places, range(len(places))] = 1.0
            if log and "" in numbers:
                by_extras[""][places] = -elimination.inverse @ elimination.C[:, len(phi) :]
        return cls(source, values, by_phi, by_extras)


def _of_extras(gradients: dict[str, Array], bodies: Array, assembly: Assembly, factor: float) -> tuple[Array, ...]:
    """Deviations of the extra parameters of each elimination, (G, M), from those of the bodies', (G, 12 L)."""
    out: dict[str, Array] = {}
    that_of_all_logs_first = sorted(assembly.eliminations, key=lambda elimination: elimination.log)
    for eliminated in that_of_all_logs_first:
        moved = np.hstack([bodies, out[""]]) if eliminated.log and "" in out else bodies
        direct = np.zeros((len(moved), len(eliminated.extras)))
        gradient = gradients[_name(eliminated.log)]
        direct[: len(gradient)] = factor * gradient @ eliminated.inverse @ eliminated.inverse.T
        out[eliminated.log] = direct - moved @ (eliminated.inverse @ eliminated.C[:, : moved.shape[1]]).T
    return tuple(out[eliminated.log] for eliminated in assembly.eliminations)
