"""How well combinations of parameters are known, and which are confounded with offsets, scales and actuator terms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchid import parameters
from torchid.estimators import Estimate
from torchid.parameters import Array
from torchid.problem import LinearProblem, RowBuilder
from torchid.problem.chunks import one_thread
from torchid.problem.compression import Part, merge_factors
from torchid.problem.elimination import Assembly, Elimination
from torchid.problem.extras import Extra
from torchid.rounding import RANK_TOLERANCE, UNOBSERVABLE_SHARE, numerical_rank

APART = 10.0
"""An unknown whose standard error grows more than this by not knowing all others cannot be told from them.

It is a variance inflation of 100, ten times what is commonly taken for serious collinearity; source: Belsley, Kuh,
Welsch, "Regression Diagnostics", 1980.
"""


@dataclass(frozen=True)
class Known:
    """What the rows say of the free parameters, in units of their scale and of the rows' noise.

    `root`, (P', rank): its outer product is their covariance; `hidden`, (P', ...): directions that no row sees;
    `values`: singular values that belong to the columns of both.
    """

    root: Array
    hidden: Array
    values: Array
    scale: Array
    free: np.ndarray

    @classmethod
    def of(cls, problem: LinearProblem, rank_tolerance: float) -> Known:
        """Of the rows of a problem; `rank_tolerance` as in `LeastSquares`."""
        scale = problem.scale[problem.free]
        _, values, Vt = np.linalg.svd(problem.A[:, problem.free] * scale, full_matrices=True)
        rank = numerical_rank(values, rank_tolerance, problem.A.shape)
        values = np.pad(values, (0, len(Vt) - len(values)))
        values[rank:] = 0.0
        return cls(Vt[:rank].T / values[:rank], Vt[rank:].T, values, scale, problem.free)

    def blamed(self, sensitivity: Array, noise: float) -> Array:
        """Share of the variance along sensitivities (P',) that each parameter brings in, of the largest such share.

        None is taken to be off by more than its scale: else the worst known would be named, however little it weighs.
        """
        noise = max(noise, UNOBSERVABLE_SHARE**2)  # of exact data, where the least known is to blame
        rank = self.root.shape[1]
        directions = np.hstack([self.root * self.values[:rank], self.hidden])
        along = directions.T @ sensitivity / (1.0 + (self.values / noise) ** 2)
        shares = sensitivity * (directions @ along)
        return np.asarray(shares / max(np.abs(shares).max(initial=0.0), np.finfo(float).tiny))

    def reached(self, sensitivity: Array) -> Array:
        """Sensitivities to all parameters, (M, 12 L), as those to the scaled free ones, (M, P')."""
        return np.asarray(sensitivity[:, self.free] * self.scale)


@dataclass(frozen=True)
class TotalMass:
    """The total mass and how well it is known [kg]: `standard_error`, infinite where the data do not determine it.

    `told_apart`: whether they tell it from offsets and scales of sensors, as of `ExtraEstimate`. `nominal`: the URDF's.
    """

    standard_error: float
    told_apart: bool
    value: float
    nominal: float

    @property
    def determined(self) -> bool:
        """Whether the data say anything of it: a 95 % interval no wider than the URDF's mass on either side."""
        return self.told_apart and 2.0 * self.standard_error <= self.nominal


def total_mass(assembly: Assembly, estimate: Estimate, rank_tolerance: float = RANK_TOLERANCE) -> TotalMass:
    """Of the estimated parameters."""
    weights = np.zeros((len(estimate.phi) // parameters.PER_BODY, parameters.PER_BODY))
    weights[:, parameters.MASS] = 1.0
    error, if_known = (
        standard_error_of(problem, estimate, weights.flatten(), rank_tolerance)
        for problem in (assembly.problem, assembly.if_known)
    )
    value, nominal = (float(weights.flatten() @ phi) for phi in (estimate.phi, assembly.problem.nominal))
    return TotalMass(error, not np.isfinite(if_known) or error <= APART * if_known, value, nominal)


@one_thread()
def standard_error_of(
    problem: LinearProblem, estimate: Estimate, weights: Array, rank_tolerance: float = RANK_TOLERANCE
) -> float:
    """Standard error of a combination `weights @ phi`, (12 L,), without the pull to nominal parameters.

    Infinite where the data do not determine it; what is not free counts as known.
    """
    known = Known.of(problem, rank_tolerance)
    along = known.reached(weights[None])
    if np.linalg.norm(along @ known.hidden) > UNOBSERVABLE_SHARE * np.linalg.norm(along):
        return float("inf")
    return float(np.sqrt(problem.oversampling) * estimate.residual_std * np.linalg.norm(along @ known.root))


_NAMED = 4  # parameters, at most, that a message names
_CONTRADICTS = 5.0  # standard errors between a reading in the air and what the ground says of it; noise is seldom white
_NOTICEABLE = 3.0  # standard deviations of the sensor's noise: what no single reading shows is not worth a word


@dataclass(frozen=True)
class ExtraEstimate:
    """An unknown beside the bodies' parameters, found.

    Attributes:
        extra: which.
        log: whose, "" of all.
        value: in its unit.
        nominal_value: the one that would fit best if the bodies' parameters were the nominal ones.
        standard_error: without the pull to nominal parameters, infinite where the data do not determine it.
        inflation: of the standard error by not knowing all other unknowns and parameters, at least 1.
        mixed_with: what it cannot be told from, most first; empty if it can.
    """

    extra: Extra
    log: str
    value: float
    nominal_value: float
    standard_error: float
    inflation: float
    mixed_with: tuple[str, ...]

    @property
    def told_apart(self) -> bool:
        """Whether the data tell it from everything else."""
        return self.inflation <= APART


@one_thread()
def estimate_extras(
    assembly: Assembly, estimate: Estimate, body_names: Sequence[str], rank_tolerance: float = RANK_TOLERANCE
) -> list[ExtraEstimate]:
    """All unknowns that were eliminated, at the estimated parameters; those that no row has are left out.

    Args:
        assembly: from `assemble`.
        estimate: of its problem.
        body_names: the robot's.
        rank_tolerance: as in `LeastSquares`.
    """
    if not assembly.eliminations:
        return []
    known, names = Known.of(assembly.problem, rank_tolerance), _names(assembly.problem.free, body_names)
    noise = float(np.sqrt(assembly.problem.oversampling) * estimate.residual_std)
    shared = next((found for found in assembly.eliminations if not found.log), None)
    values = zip(assembly.extras_at(estimate.phi), assembly.extras_at(assembly.problem.nominal), strict=True)
    out = []
    for found, pair in zip(assembly.eliminations, values, strict=True):
        out += _found(found, pair, noise, known, names, shared if found.log else None)
    return out


def _found(
    found: Elimination,
    values: tuple[Array, Array],
    noise: float,
    known: Known,
    names: Sequence[str],
    shared: Elimination | None,
) -> list[ExtraEstimate]:
    """The unknowns of one elimination, at identified and nominal parameters; `shared`: those they depend on."""
    P = len(known.free)
    sensitivity, own, hidden = found.inverse @ found.C[:, :P], [found.inverse], [found.unobservable]
    if shared is not None:
        through = found.inverse @ found.C[:, P:]
        sensitivity = sensitivity - through @ shared.inverse @ shared.C[:, :P]
        own.append(through @ shared.inverse)
        hidden.append(through @ shared.unobservable)
    G = known.reached(sensitivity)
    unseen = G @ known.hidden
    size = np.maximum(np.linalg.norm(G, axis=1), np.finfo(float).tiny)
    lost = np.linalg.norm(unseen, axis=1) > UNOBSERVABLE_SHARE * size
    through_parameters = ((G @ known.root) ** 2).sum(1)
    variance = sum((x**2).sum(1) for x in own) + through_parameters
    undetermined = lost | ~found.determined | (np.linalg.norm(np.hstack(hidden), axis=1) > UNOBSERVABLE_SHARE)
    deviation = np.where(undetermined, np.inf, np.sqrt(variance))
    out = []
    for k, extra in enumerate(found.extras):
        if not np.isfinite(found.std_if_known[k]):
            continue
        inflation = float(deviation[k] / found.std_if_known[k])
        mixed: tuple[str, ...] = ()
        if inflation > APART:
            blamed = lost[k] or 2.0 * through_parameters[k] > variance[k]
            mixed = _largest(known.blamed(G[k], noise), names) if blamed else ()
            others = _largest(np.where(np.arange(len(found.extras)) == k, 0.0, found.unobservable[k]), _labels(found))
            mixed = (*mixed, *others)
        error = noise * float(deviation[k]) if np.isfinite(deviation[k]) else np.inf
        value, nominal = (float(x[k]) for x in values)
        out.append(ExtraEstimate(extra, found.log, value, nominal, error, inflation, mixed))
    return out


@dataclass(frozen=True)
class Disagreement:
    """An offset that is one thing in the air and another on the ground.

    Attributes:
        extra: the offset.
        log: in which.
        in_the_air: what the sensor reads while nothing touches, in its unit.
        in_contact: what it would read there with the offset, and scale, that suit the rest of the data best.
        standard_error: of the difference.
    """

    extra: Extra
    log: str
    in_the_air: float
    in_contact: float
    standard_error: float

    @property
    def standard_errors(self) -> float:
        """How many of them the two are apart."""
        return abs(self.in_the_air - self.in_contact) / self.standard_error

    def matters(self, noise: Array) -> bool:
        """Whether the two contradict each other, beside the noise (6,) of contact sensors [N, N m]."""
        axis = 0 if self.extra.contact is None else self.extra.contact[1]
        apart = abs(self.in_the_air - self.in_contact)
        return self.standard_errors > _CONTRADICTS and apart > _NOTICEABLE * float(noise[axis])


@one_thread()
def disagreements(
    parts: Sequence[Part], builder: RowBuilder, in_contact: Sequence[ExtraEstimate], noise: float = 1.0
) -> list[Disagreement]:
    """Offsets whose readings in the air contradict all other rows, largest contradiction first.

    Args:
        parts: of the logs.
        builder: of their rows.
        in_contact: unknowns that a fit without the unloaded parts found.
        noise: standard deviation of whitened rows, correlation counted.
    """
    out = []
    for source in dict.fromkeys(part.source for part in parts if part.unloaded):
        own = {(x.extra.what, x.extra.contact): x for x in in_contact if x.log in ("", source)}
        R = merge_factors(
            (part.factor for part in parts if part.unloaded and part.source == source), builder
        ).triangle()
        for number, extra in enumerate(builder.extras, start=builder.columns.count):
            column, offset = R[:, number].numpy(), own.get((extra.what, extra.contact))
            if extra.what == "offset" and extra.contact is not None and offset is not None and column.any():
                weight = float(column @ column)
                read, scale = float(column @ R[:, -1].numpy()) / weight, own.get(("scale", extra.contact))
                expected, variance = offset.value, offset.standard_error**2 + noise**2 / weight
                if scale is not None:
                    expected, variance = expected / (1.0 + scale.value), variance + (read * scale.standard_error) ** 2
                out.append(Disagreement(extra, source, read, expected, float(np.sqrt(variance))))
    sensors = builder.sensors.noise.wrench_std
    return sorted((x for x in out if x.matters(sensors)), key=lambda x: -x.standard_errors)


def _labels(found: Elimination) -> list[str]:
    return [extra.label for extra in found.extras]


def _largest(along: Array, names: Sequence[str]) -> tuple[str, ...]:
    """Names of the largest components of a direction, none that is small beside them."""
    order = np.argsort(-np.abs(along))[:_NAMED]
    least = max(0.2 * np.abs(along).max(initial=0.0), UNOBSERVABLE_SHARE)
    return tuple(names[k] for k in order if np.abs(along[k]) > least)


def _names(free: np.ndarray, body_names: Sequence[str]) -> list[str]:
    """Names of the free parameters: "pelvis m"."""
    every = [f"{body} {name}" for body in body_names for name in parameters.PARAMETERS]
    return [name for name, chosen in zip(every, free, strict=True) if chosen]
