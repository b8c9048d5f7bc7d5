"""The delete-a-block jackknife over blocks of the logs: standard errors that need residuals not be noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri, stdtrit  # scipy.stats takes 0.2 s to import

from torchid.estimators.least_squares import residual_std
from torchid.identifiability.confounding import ParameterCovariance, mass_weights
from torchid.parallel import one_thread
from torchid.parameters import PER_BODY, Array
from torchid.problem import RowBuilder
from torchid.problem.compression import Part
from torchid.problem.elimination import Assembly

LEAST_BLOCKS = 3
"""With fewer blocks their scatter says nothing: of two, 95 % of Student's t reach to 12.7 standard errors."""

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
    """What parameters scatter by from block to block of the logs, as standard errors.

    Blocks of successive samples are longer than whatever correlates the residuals of neighbouring ones: noise that a
    filter has smeared, but also what the model lacks, such as friction. Left out one by one, they say how much of such
    residuals ends up in the estimate; standard errors by the size of the residuals count them as noise instead.

    Source: delete-a-group jackknife (Shao, Wu, Annals of Statistics 17, 1989), which for least squares is the
    cluster-robust covariance CR3 (Bell, McCaffrey, Survey Methodology 28, 2002), with quantiles of Student's t.

    Attributes:
        blocks: their number G.
        deviations: (G, 12 L), whose norm over the blocks is the standard error of the parameters; 1.96 times it is half
            of a 95 % interval. Where rows are mostly noise of the motion, rows of what they lack follow (`shrinkage` of
            `LinearProblem`): no scatter shows that.
        without_ridge: (G, 12 L), the same of the estimate without regularization.
        extras: the same of the extra parameters, (G, M) for each elimination, without regularization.
        lack_of_fit: variance of the blocks' part of the residuals over what it is if residuals are independent noise: 1
            if the model explains the forces, more if residuals are alike within a block. Of combinations of parameters
            on which little of the information is noise of the motion. None where blocks are too few to tell.
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
    """Gradients of half the squared residuals of each block, (G, columns), its share of information, and noise in it.

    Gradients, without what noise of the motion adds, are by "bodies", all parameters with the extra ones at their best,
    and by the log of each elimination, its extra parameters with those of single logs at their best. Shares and noise
    are (G, r, r), by the columns of the basis.
    """
    count = max(numbers.values()) + 1
    gradients = {name: np.zeros((count, width)) for name, width in _widths(assembly).items()}
    shares, of_noise = (np.zeros((count, basis.shape[1], basis.shape[1])) for _ in range(2))
    columns, along = None, basis
    for part in sorted((part for part in parts if not part.unloaded), key=lambda part: part.source):
        if columns is None or columns.source != part.source:
            columns = _Columns.of(builder, assembly, part.source, phi)
            along = columns.by_phi @ basis
        number = numbers[_key(part)]
        for support, block in part.factor.blocks.items():
            rows, at = np.ascontiguousarray(block.cpu().double().numpy()), list(support)  # the same bits from a cache
            residual = rows[:, -1] - rows[:, :-1] @ columns.values[at]
            columns.add_gradient(gradients, number, at, rows[:, :-1].T @ residual)
            projected = rows[:, :-1] @ along[at]
            shares[number] += projected.T @ projected
        for support, tensor in part.factor.noise_gram_of(assembly.reading_noise).items():
            more, at = np.ascontiguousarray(tensor.cpu().double().numpy()), list(support)
            columns.add_gradient(gradients, number, at, more[:-1, :-1] @ columns.values[at] - more[:-1, -1])
            of_noise[number] += along[at].T @ more[:-1, :-1] @ along[at]
    return gradients, shares, of_noise


def _name(log: str) -> str:
    return f"extras of {log}"


def _widths(assembly: Assembly) -> dict[str, int]:
    return {"bodies": len(assembly.problem.nominal)} | {
        _name(one.log): len(one.extras) for one in assembly.eliminations
    }


@dataclass(frozen=True)
class _Columns:
    """Parameters in the columns of a log's rows, (width,), and how they depend on those that a fit has.

    `by_phi`, (width, 12 L), with the extra parameters at their best; `by_extras`: (width, M) by the log of an
    elimination, "" for that of all logs, with the unknowns of single logs at their best.
    """

    source: str
    values: Array
    by_phi: Array
    by_extras: dict[str, Array]

    def add_gradient(self, gradients: Mapping[str, Array], number: int, at: Sequence[int], gradient: Array) -> None:
        """Add the gradient by some columns to that of a block."""
        gradients["bodies"][number] += self.by_phi[at].T @ gradient
        for log, by_extras in self.by_extras.items():
            gradients[_name(log)][number] += by_extras[at].T @ gradient

    @classmethod
    def of(cls, builder: RowBuilder, assembly: Assembly, source: str, phi: Array) -> _Columns:
        own = {one.log: number for number, one in enumerate(assembly.eliminations) if one.log in ("", source)}
        values, by_phi = np.zeros(builder.width), np.zeros((builder.width, len(phi)))
        count = builder.columns.count
        values[:count], by_phi[:count] = builder.columns.parameter_map @ phi, builder.columns.parameter_map
        at_best, sensitivities = assembly.extras_at(phi), assembly.extras_sensitivity()
        by_extras: dict[str, Array] = {}
        for log, number in sorted(own.items()):  # that of all logs comes first
            elimination = assembly.eliminations[number]
            places = [count + builder.extras.index(extra) for extra in elimination.extras]
            values[places], by_phi[places] = at_best[number], sensitivities[number]
            by_extras[log] = np.zeros((builder.width, len(places)))
            by_extras[log][places, range(len(places))] = 1.0
            if log and "" in own:
                by_extras[""][places] = -elimination.inverse @ elimination.C[:, len(phi) :]
        return cls(source, values, by_phi, by_extras)


def _of_extras(gradients: dict[str, Array], bodies: Array, assembly: Assembly, factor: float) -> tuple[Array, ...]:
    """Deviations of the extra parameters of each elimination, (G, M), from those of the bodies', (G, 12 L)."""
    out: dict[str, Array] = {}
    for one in sorted(assembly.eliminations, key=lambda elimination: elimination.log):  # that of all logs comes first
        moved = np.hstack([bodies, out[""]]) if one.log and "" in out else bodies
        direct = np.zeros((len(moved), len(one.extras)))
        direct[: len(gradients[_name(one.log)])] = factor * gradients[_name(one.log)] @ one.inverse @ one.inverse.T
        out[one.log] = direct - moved @ (one.inverse @ one.C[:, : moved.shape[1]]).T
    return tuple(out[one.log] for one in assembly.eliminations)
