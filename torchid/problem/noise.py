"""Noise of the sensors and of the base rows, estimated from residuals of a fit (variance components).

Every whitened, projected row mixes the noise of several sensors. Each sensor enters the rows of a sample along known
directions, which differ between postures and contact states. The variances are those at which the expected covariance
of the residuals equals the observed one (Rao's MINQUE, iterated, which is restricted maximum likelihood; Searle,
Casella and McCulloch, "Variance Components", 1992, chapters 6 and 11).

Similar sources, such as motors of one make, have log-variances that are normal about a common mean. A source that the
residuals determine keeps its own variance; another gets that of all. Their spread is estimated too (restricted maximum
likelihood of a normal random effect; Breslow and Clayton, "Approximate Inference in Generalized Linear Mixed Models",
1993; of variances: Smyth, "Linear Models and Empirical Bayes Methods", 2004).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
import scipy.linalg
import scipy.optimize
import torch
from scipy.special import chdtri, ndtr
from torch import Tensor

from torchid import distributed
from torchid.parallel import map_in_workers, one_thread
from torchid.parameters import Array
from torchid.problem.chunks import chunks_by_state, worker_count
from torchid.problem.compression import Part
from torchid.problem.contact_state import ContactState
from torchid.problem.elimination import Assembly
from torchid.problem.linear import TriangularFactor
from torchid.problem.noise_gram import noise_of_reading
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.rounding import MAD_PER_STD, RANK_TOLERANCE, is_significant
from torchid.sensing.sensors import measured_components

_SAMPLES = 1000  # enough for a standard deviation within 2 to 3 %
_BYTES = 2**27  # of rows in memory
_CHUNK = 256  # samples
CLIP = 3.0
"""Residuals (of impacts, for instance) are clipped at this many robust standard deviations."""


def noise_of_sensors(builder: RowBuilder) -> dict[str, float]:
    """Standard deviation of every sensor group of a builder, in the order of `NoiseGroups` [N m, N]."""
    names = set(builder.noise_sources)
    values = builder.noise_groups.values(builder.sensors.noise)
    return {name: value for name, value in values.items() if name in names}


@dataclass(frozen=True)
class SampledChunk:
    """Samples of one log in one contact state.

    `rows`, (B, n_rows, width + 1), whitened with the builder's noise. `sources`, (B, E, n_rows), one standard deviation
    of each noise source in these rows.
    """

    log: str
    state: ContactState
    oversampling: float
    rows: Tensor
    sources: Tensor


@dataclass(frozen=True)
class LogOfOtherProcess:
    """A log in another process: its number of samples, and their oversampling."""

    count: int
    oversampling: float

    def __len__(self) -> int:
        return self.count


class SampledRows:
    """Rows of about a thousand samples of the logs, in memory, to whiten again with other noise.

    Attributes:
        builder: of the rows; variances are relative to its sensor noise, the stated one.
        groups: sensor groups, in the order of `NoiseGroups`.
        alike: indices of groups whose noise may have the same size.
        group_of: (E,), index in `groups` of every noise source.
    """

    @one_thread()
    @torch.no_grad()
    def __init__(self, logs: Sequence[Samples | LogOfOtherProcess], builder: RowBuilder, chunk: int = _CHUNK) -> None:
        """Compute the rows of random samples, always the same ones.

        Among processes that share the work, each has some of the logs; all get the rows of all logs.

        Args:
            logs: bound logs.
            builder: of the rows.
            chunk: samples at a time. Another number rounds differently, which changes ill-determined noise by a few
                percent.
        """
        self.builder = builder
        names = builder.noise_sources
        self.groups = tuple(noise_of_sensors(builder))
        self.alike = builder.noise_groups.alike(self.groups)
        self.group_of = np.array([self.groups.index(name) for name in names], dtype=int)
        self._std = torch.from_numpy(self.reference_std[self.group_of])
        n_rows = builder.tree.n_rows
        most = min(_SAMPLES, _BYTES // (8 * max(n_rows, 1) * (builder.width + 1 + len(names))))
        self._scaled = _sources_of_scales(builder)
        self._drawn = max(most, 1), chunk
        drawn = list(_random_chunks(logs, *self._drawn))
        for samples, state in drawn:
            builder.layout_of(samples, state)
        self.chunks = map_in_workers(drawn, lambda drawn_chunk: self._chunk(*drawn_chunk), worker_count(builder.device))
        elsewhere = any(isinstance(log, LogOfOtherProcess) for log in logs)
        if any(distributed.all_gather(elsewhere, "remote logs")):
            self.chunks = list(chain.from_iterable(distributed.all_gather(self.chunks, "noise samples")))

    @property
    def reference_std(self) -> Array:
        """Stated standard deviation of each group, (G,) [N m, N]; variances are relative to it."""
        return np.array([*noise_of_sensors(self.builder).values()])

    @property
    def oversampling(self) -> float:
        """Rows per independent row."""
        counts = np.array([[len(chunk.rows), len(chunk.rows) / chunk.oversampling] for chunk in self.chunks]).sum(0)
        return float(counts[0] / counts[1])

    def _chunk(self, samples: Samples, state: ContactState) -> SampledChunk:
        rows, W = self.builder.rows_by_sample(samples.to(self.builder.device), state)
        sources = (self._unit_forces(samples.to(self.builder.device)) @ W).cpu() * self._std[:, None]
        return SampledChunk(samples.source, state, samples.oversampling, rows.cpu().double(), sources.double())

    def _unit_forces(self, samples: Samples) -> Tensor:
        """Generalized force of a unit of each noise source, (B, E, n_rows)."""
        builder = self.builder
        base = self.builder.tree.base_rows
        n_rows = builder.tree.n_rows
        unit = torch.eye(n_rows, dtype=samples.time.dtype, device=samples.time.device)
        forces = [unit[:base].expand(len(samples), -1, -1)]
        if base and (axes := builder.noise_axes(samples.base.rotation)) is not None:
            rotated = forces[0].clone()
            rotated[:, :3, :3] = rotated[:, 3:6, 3:6] = axes.mT
            forces = [rotated]
        forces.append(unit[(base + np.flatnonzero(builder.sensors.torque)).tolist()].expand(len(samples), -1, -1))
        components = measured_components(builder.contacts, builder.sensors)
        if components.any():
            J = builder.contact_jacobian(samples)
            J = torch.where(samples.active[..., None, None], J, 0.0)  # in the air a normal may be NaN
            forces.append(J[:, torch.from_numpy(components)])
        return torch.cat(forces, dim=1)

    def whiten(self, chunk: SampledChunk, variance: Array, step: int = 1) -> SampledChunk:
        """Whiten a chunk with variances of the groups relative to the stated ones, (G,).

        Uses every `step`-th sample of the `rows`.
        """
        if (variance == 1.0).all():
            return replace(chunk, rows=chunk.rows[::step])
        sources = torch.from_numpy(np.sqrt(variance)[self.group_of])[:, None] * chunk.sources
        L = noise_root(sources)
        rows = torch.linalg.solve_triangular(L[::step], chunk.rows[::step], upper=False)
        return replace(chunk, rows=rows, sources=torch.linalg.solve_triangular(L, sources.mT, upper=False).mT)

    @one_thread()
    def compress(self, variance: Array, columns: Mapping[str, Tensor] | None = None) -> list[Part]:
        """Compress the rows, whitened with these variances.

        With parameters of an earlier fit (in the builder's columns, by log), samples with large residuals get less
        weight, as in Huber's loss; otherwise impacts would look like noise of all rows. All rows of a sample get one
        weight, because their basis is arbitrary.
        """

        def factor_of(chunk: SampledChunk) -> TriangularFactor:
            chunk = self.whiten(chunk, variance)
            rows = chunk.rows
            present = chunk.sources.abs().sum(1) > 0.0
            readings = chunk.sources.square().sum(2)
            root = rows.new_ones(len(rows))
            if columns is not None:
                size = torch.linalg.vector_norm(rows[..., :-1] @ columns[chunk.log] - rows[..., -1], dim=1)
                limit = _radius(present.sum(1))
                weight = (limit / size).clamp_max(1.0)
                root = weight.sqrt()
                readings = readings * weight[:, None]
            factor = TriangularFactor(self.builder.width)
            for support, slots in supports(rows).items():
                weighted = rows[:, torch.tensor(slots)[:, None], torch.tensor([*support, self.builder.width])]
                weighted *= root[:, None, None]
                factor.add(support, weighted[present[:, slots]], chunk.oversampling)
            for column, sources in self._scaled.items():
                factor.add_noise_gram(noise_of_reading(column, readings[:, sources].sum()))
            return factor

        parts: dict[tuple[str, ContactState], Part] = {}
        for chunk, factor in zip(self.chunks, map_in_workers(self.chunks, factor_of), strict=True):
            key = chunk.log, chunk.state
            part = parts.setdefault(key, Part(*key, TriangularFactor(self.builder.width), 0))
            part.samples += len(chunk.rows)
            part.factor.merge(factor)
        return list(parts.values())


def noise_root(sources: Tensor) -> Tensor:
    """L (B, r, r) with `L L^T` the covariance of rows with these noise sources (B, e, r); 1 for rows of zeros."""
    S = sources.mT @ sources
    return torch.linalg.cholesky(S + torch.diag_embed((S.diagonal(dim1=-2, dim2=-1) == 0.0).to(S)))


def _sources_of_scales(builder: RowBuilder) -> dict[int, list[int]]:
    """Noise sources of readings with an unknown scale, by the column of the scale."""
    base = builder.tree.base_rows
    torque = np.asarray(builder.sensors.torque)
    components = measured_components(builder.contacts, builder.sensors)
    dofs = base + np.cumsum(torque) - 1
    places = base + torque.sum() + np.cumsum(components).reshape(-1, 6) - 1
    return {
        column: [*(int(dofs[dof]) for dof in extra.dofs), *(int(places[at]) for at in extra.contacts if components[at])]
        for column, extra in enumerate(builder.extras, builder.columns.count)
        if extra.what == "scale"
    }


def supports(rows: Tensor) -> dict[tuple[int, ...], list[int]]:
    """Numbers of rows (B, n_rows, width + 1), right-hand side last, by their non-zero columns."""
    out: dict[tuple[int, ...], list[int]] = {}
    for slot, used in enumerate((rows[..., :-1] != 0.0).any(0).numpy()):
        out.setdefault(tuple(np.flatnonzero(used).tolist()), []).append(slot)
    return out


def _radius(rows: Tensor) -> Tensor:
    """Size of that many whitened residuals with the same probability of excess as `CLIP` standard deviations of one."""
    return torch.from_numpy(np.sqrt(chdtri(rows.numpy(), 2.0 * ndtr(-CLIP))))


def _random_chunks(
    logs: Sequence[Samples | LogOfOtherProcess], most: int, chunk: int
) -> Iterator[tuple[Samples, ContactState]]:
    """About `most` random samples, by log and contact state (regular ones could be in phase with a gait).

    Filtered logs give at most four samples for every independent one.
    """
    rng = np.random.default_rng(0)
    share = min(1.0, most / max(sum(map(len, logs)), 1))
    for log in logs:
        count = min(len(log), max(round(min(share, 4.0 / log.oversampling) * len(log)), 1))
        index = torch.from_numpy(np.sort(rng.choice(len(log), count, replace=False)))
        if isinstance(log, LogOfOtherProcess):
            continue
        chosen = replace(log[index], oversampling=max(1.0, log.oversampling * count / len(log)), folder=None)
        for state, where in chunks_by_state(chosen, chunk):
            yield chosen[where], state


_LEAST = 1e-4  # variance of the logarithms: standard deviations within 0.5 %
_MOST = 1e3  # the same: any standard deviation
_POINTS = 41
_HELD_OTHERS = 1e-6  # fraction added to the information on other variances, because it may be zero


def information_about(index: np.ndarray, information: Array, score: Array) -> tuple[Array, Array]:
    """Information (k, k) and score (k,) for the logarithms of some variances, with the others estimated too.

    Args:
        index: (k,), of these variances.
        information: Fisher information for the logarithms of all, (U, U).
        score: derivative of the likelihood, (U,).
    """
    others = np.setdiff1d(np.arange(len(score)), index)
    known = information[np.ix_(others, others)]
    size = 1.0 / np.sqrt(np.where(np.diag(known) > 0.0, np.diag(known), 1.0))  # of base rows that are lost: 0
    known = known * size * size[:, None] + _HELD_OTHERS * np.eye(len(others))
    across = size * scipy.linalg.solve(known, size[:, None] * information[np.ix_(others, index)], assume_a="pos").T
    conditional = information[np.ix_(index, index)] - across @ information[np.ix_(others, index)]
    return conditional, score[index] - across @ score[others]


def prior_precision(logarithms: Array, information: Array, score: Array) -> Array:
    """Precision (k, k) of the deviations of logarithms of variances from their common mean, which is free.

    Args:
        logarithms: (k,), of the present variances.
        information: on them, (k, k).
        score: likewise, (k,).
    """
    count = len(logarithms)
    values, Q = np.linalg.eigh(information)
    kept = values > RANK_TOLERANCE * max(values[-1], np.finfo(float).tiny)
    values = values[kept]
    Q = Q[:, kept]
    root = np.sqrt(values)
    y = Q.T @ (information @ logarithms + score) / root
    mean = root * Q.sum(0)

    def deviance(log_spread: float) -> float:
        variance = 1.0 + np.exp(log_spread) * values
        weight = mean @ (mean / variance)
        off = y - mean * (mean @ (y / variance) / weight)
        return float(np.log(variance).sum() + np.log(weight) + off @ (off / variance))

    grid = np.linspace(np.log(_LEAST), np.log(_MOST), _POINTS)
    best = int(np.argmin([deviance(x) for x in grid])) if len(values) > 1 else 0
    low = grid[max(best - 1, 0)]
    high = grid[min(best + 1, _POINTS - 1)]
    spread = scipy.optimize.minimize_scalar(deviance, bounds=(low, high), method="bounded").x if best else grid[0]
    return (np.eye(count) - 1.0 / count) / float(np.exp(spread))


_THINNED = 4  # leverage is computed from every fourth sample
_CLIPPED = 0.99501  # E[min(x^2, 9)] of standard normal x
_HELD = 0.005  # weight of the previous variances, which decides confounded ones
_LEAST_STEP = 0.05  # least factor of a variance in one step
_SHARE = 0.01  # least fraction of a group in the variance along its directions (a tenth of the deviation)
#: Of the stated noise, least standard deviation: exact logs leave only rounding. Where none is stated it is of the
#: forces themselves, if these are less than what is guessed, as those of robots of millimetres are.
_SMALLEST = 1e-3
_LEFT = 0.1  # least fraction of the residual's degrees of freedom for a group
_FEW = 20.0  # least number of independent readings: a standard deviation to 16 %
_NEGLIGIBLE = 1e-9  # a source with a smaller fraction of its variance in the rows is projected out
_STEADY = 0.01  # relative change of the noise along the directions of any group
_STEPS = 40  # at most
_CONFOUNDED = 0.5  # relative standard error of a standard deviation
_POOLED = 0.5  # fraction of the prior in the information on a variance


@dataclass(frozen=True)
class GroupVariances:
    """Variances of the groups relative to the stated ones (the noise of the builder of `SampledRows`).

    Attributes:
        variance: (G,).
        share: (G,), fraction of the variance along a group's directions that is its own, between 0 and 1.
        estimated: (G,) bool, whether there were enough readings; otherwise the variance is unchanged.
        error: (G,), relative standard error of the standard deviation, large for confounded groups.
        pooled: (G,) bool, whether the value is mostly that of similar groups.
        change: largest relative change of the noise along the directions of any group.
    """

    variance: Array
    share: Array
    estimated: np.ndarray
    error: Array
    pooled: np.ndarray
    change: float

    @classmethod
    def unknown(cls, count: int) -> GroupVariances:
        """The stated variances, if residuals contain no information."""
        none = np.zeros(count, dtype=bool)
        ones = np.ones(count)
        return cls(ones, share=ones, estimated=none, error=ones, pooled=none, change=0.0)

    @property
    def upper_bound(self) -> np.ndarray:
        """Groups whose noise is far below that of others: only an upper bound is known, (G,) bool."""
        return self.estimated & (self.share <= 1.5 * _SHARE)

    @property
    def confounded(self) -> np.ndarray:
        """Groups that are confounded with others: residuals determine little but their sum, (G,) bool."""
        return self.estimated & ~self.upper_bound & (self.error > _CONFOUNDED)


class VarianceComponentEstimator:
    """Estimates variances of groups from residuals at fitted parameters."""

    def __init__(self, rows: SampledRows, tied: Collection[str] = ()) -> None:
        """Set the `tied` groups, which share one factor."""
        self.rows = rows
        count = len(rows.groups)
        kept = [index for index, name in enumerate(rows.groups) if name in tied]
        free = [index for index in range(count) if index not in kept]
        blocks = [kept, *([index] for index in free)] if kept else [[index] for index in free]
        self._blocks = np.zeros((count, len(blocks)))  # (G, unknown variances)
        for number, block in enumerate(blocks):
            self._blocks[block, number] = 1.0
        self._alike = [index for index in rows.alike if len(index) > 1 and not set(index) & set(kept)]
        self._smallest = np.full(count, _SMALLEST)
        self._smallest[free] *= np.minimum(_forces(rows), 1.0)[free]

    @one_thread()
    @torch.no_grad()
    def estimate(
        self, variance: Array, columns: Mapping[str, Tensor], directions: Mapping[str, Tensor]
    ) -> GroupVariances:
        """Variances at which the expected covariance of the residuals equals the observed one.

        Residuals are clipped. The fit reduces them; each group is corrected by the leverage of its own directions. A
        standard deviation is at least a tenth of that along the group's directions, and `_SMALLEST` of the stated
        noise.

        Args:
            variance: (G,), initial values, used in the fit of the parameters.
            columns: parameters in the builder's columns, (width,), by log.
            directions: free directions of the fit, by log, from `fitted_directions`.
        """
        start = variance
        residuals, remaining, independent = self._residuals(variance, columns, directions)
        estimated = self._enough(independent) @ self._blocks > 0.0
        first, *_ = M, q, t, count = self._moments(residuals, remaining, variance)
        for _ in range(_STEPS):
            share = np.divide(t, count, out=np.ones_like(t), where=count > 0.0)
            _, weight, pull = self._prior(M, q, variance, remaining)
            step = self._step(M + weight, q + pull, estimated)
            least = np.maximum(_SHARE / np.maximum(share, 1e-12), self._smallest**2 / variance)
            least_of_block = np.where(self._blocks > 0.0, least[:, None], 0.0).max(axis=0, initial=0.0)
            step = np.where(estimated, np.maximum(step, least_of_block), 1.0)
            factor = self._blocks @ step
            variance = variance * factor
            if _change(M, factor) < _STEADY:
                break
            M, q, t, count = self._moments(residuals, remaining, variance)
        information = self._information(M, remaining)
        precision, _, _ = self._prior(M, q, variance, remaining)
        error = _relative_errors(2.0 * (information + precision))
        return GroupVariances(
            variance,
            share,
            self._blocks @ estimated > 0.0,
            error,
            _is_pooled(precision, error),
            _change(first, variance / start),
        )

    def _enough(self, readings: Array) -> np.ndarray:
        """Groups with enough readings for an estimate, their own or those of similar groups, (G,) bool."""
        enough = readings > _FEW
        for index in self._alike:
            enough[index] = readings[index].sum() > _FEW
        return enough

    def _information(self, M: Array, remaining: Array) -> Array:
        """Fisher information of Gaussian noise for the logarithms of the variances, (G, G)."""
        return M * np.sqrt(np.outer(remaining, remaining)) / (2.0 * self.rows.oversampling)

    def _prior(self, M: Array, q: Array, variance: Array, remaining: Array) -> tuple[Array, Array, Array]:
        """Prior that similar groups have variances of one size, as far as residuals support it.

        Returns:
            Precision of the logarithms of the variances, (G, G), zero for all others; and its part of the equations M x
                = q, with x the factors of the variances: (G, G) and (G,).
        """
        count = len(variance)
        oversampling = self.rows.oversampling
        information = self._information(M, remaining)
        score = remaining * (q - M.sum(1)) / (2.0 * oversampling)
        logarithms = np.log(np.square(self.rows.reference_std) * variance)
        precision = np.zeros((count, count))
        weight = np.zeros((count, count))
        for index in self._alike:
            known = information_about(index, information, score)
            places = np.ix_(index, index)
            precision[places] = prior_precision(logarithms[index], *known)
            weight[places] = 2.0 * oversampling / remaining[index].mean() * precision[places]  # 0 along equal factors
        return precision, weight, -weight @ logarithms

    def _step(self, M: Array, q: Array, estimated: np.ndarray) -> Array:
        """Factors of the unknown variances at which the squares are the expected ones; confounded ones stay near 1."""
        B = self._blocks
        M = B.T @ M @ B
        q = B.T @ q
        free = np.flatnonzero(estimated)
        held = _HELD * np.diag(M)
        if not len(free):
            return np.ones(len(q))
        rhs = (q - M[:, ~estimated].sum(1) + held)[free]
        kept = M[np.ix_(free, free)] + np.diag(held[free])
        size = 1.0 / np.sqrt(np.diag(kept))
        L = np.linalg.cholesky(kept * size * size[:, None])
        target = scipy.linalg.solve_triangular(L, size * (rhs - _LEAST_STEP * kept.sum(1)), lower=True)
        out = np.ones(len(q))
        out[free] = _LEAST_STEP + size * scipy.optimize.nnls(L.T, target)[0]
        return out

    def _moments(
        self, residuals: Sequence[Tensor], remaining: Array, variance: Array
    ) -> tuple[Array, Array, Array, Array]:
        """M (G, G), q (G,) of the equations M x = q; variance in the rows and number of readings by group, (G,)."""
        group_of = self.rows.group_of
        count = len(variance)
        index = torch.from_numpy(group_of)
        scale = torch.from_numpy(np.sqrt(variance)[group_of])

        def of_chunk(number: int) -> tuple[Tensor, Tensor, Tensor]:
            chunk = self.rows.chunks[number]
            r = residuals[number]
            sources = scale[:, None] * chunk.sources
            both = torch.cat([sources.mT, r[..., None]], dim=2)
            solved = torch.linalg.solve_triangular(noise_root(sources), both, upper=False)
            white = solved[..., :-1]
            y = solved[..., -1:]  # (B, n_rows, E), (B, n_rows, 1)
            M = torch.zeros(count, count, dtype=torch.float64)
            M.index_put_((index[:, None], index), (white.mT @ white).square().sum(0), accumulate=True)
            return M, white.square().sum(1), (white.mT @ y)[..., 0]

        parts = map_in_workers(range(len(residuals)), of_chunk)
        M = torch.stack([x for x, *_ in parts]).sum(0)
        size, score = (torch.cat([part[k] for part in parts]).numpy() for k in (1, 2))
        q, t, n = (np.zeros(count) for _ in range(3))
        for group in range(count):
            sizes = size[:, group_of == group]
            scores = score[:, group_of == group]
            present = sizes > _NEGLIGIBLE
            t[group] = sizes.sum()
            n[group] = present.sum()
            if present.any():
                q[group] = t[group] * _clipped_variance(scores[present] / np.sqrt(sizes[present]), sizes[present])
        return M.numpy(), q / remaining, t, n

    def _residuals(
        self, variance: Array, columns: Mapping[str, Tensor], directions: Mapping[str, Tensor]
    ) -> tuple[list[Tensor], Array, Array]:
        """Residuals of the rows, (B, n_rows) by chunk, and the degrees of freedom of each group.

        Returns:
            The residuals; the fraction of each group's degrees of freedom that remains after the fit, (G,); its number
                of independent readings, (G,).
        """
        rows = self.rows
        group_of = self.rows.group_of
        leverages, size, readings = (np.zeros(len(variance)) for _ in range(3))

        def of_chunk(chunk: SampledChunk) -> tuple[Tensor, Tensor, Tensor]:
            white = rows.whiten(chunk, variance, _THINNED)
            sizes = white.sources.square().sum(2)
            fitted = white.rows.new_zeros(*white.rows.shape[:2], directions[chunk.log].shape[1])
            for support, slots in supports(white.rows).items():
                at = torch.tensor(support, dtype=torch.long)
                fitted[:, slots] = white.rows[:, torch.tensor(slots)[:, None], at] @ directions[chunk.log][at]
            leverage = (white.sources[::_THINNED] @ fitted).square().sum((0, 2))
            return leverage, sizes[::_THINNED].sum(0), (sizes > _NEGLIGIBLE).sum(0)

        for chunk, residuals in zip(rows.chunks, map_in_workers(rows.chunks, of_chunk), strict=True):
            leverage, sizes, count = (x.numpy() for x in residuals)
            np.add.at(leverages, group_of, chunk.oversampling * leverage)
            np.add.at(size, group_of, sizes)
            np.add.at(readings, group_of, count / chunk.oversampling)
        remaining = 1.0 - np.divide(leverages, size, out=np.zeros_like(size), where=size > 0.0)
        r = map_in_workers(rows.chunks, lambda chunk: chunk.rows[..., :-1] @ columns[chunk.log] - chunk.rows[..., -1])
        return r, np.maximum(remaining, _LEFT), readings * np.maximum(remaining, 0.0)


def _forces(rows: SampledRows) -> Array:
    """Rms of the readings of each group, (G,), in units of its stated noise; of all rows where that is zero."""
    squares = np.zeros(len(rows.groups))
    sizes = np.zeros(len(rows.groups))
    for chunk in rows.chunks:
        size = chunk.sources.square().sum(2)
        along = torch.einsum("ber,br->be", chunk.sources, chunk.rows[..., -1]).square() / size.clamp_min(_NEGLIGIBLE)
        np.add.at(squares, rows.group_of, along.sum(0).numpy())
        np.add.at(sizes, rows.group_of, size.sum(0).numpy())
    all_rows = float(np.mean([chunk.rows[..., -1].square().mean().item() for chunk in rows.chunks]))
    forces = np.sqrt(np.divide(squares, sizes, out=np.zeros_like(sizes), where=sizes > 0.0))
    return np.where(forces > 0.0, forces, np.sqrt(all_rows) or 1.0)


def _is_pooled(precision: Array, error: Array) -> np.ndarray:
    """Whether the prior has more weight than the residuals in a group's variance."""
    of_prior = np.diag(precision)
    return (of_prior > 0.0) & (np.square(2.0 * error) > _POOLED / np.where(of_prior > 0.0, of_prior, 1.0))


def _relative_errors(M: Array) -> Array:
    """Relative standard errors, (G,), of the standard deviations of Gaussian noise with Fisher information M / 2."""
    present = np.diag(M) > 0.0
    size = np.where(present, np.diag(M), 1.0) ** -0.5
    values, V = np.linalg.eigh(M * size * size[:, None])
    return np.where(present, size * np.sqrt(0.5 * (np.square(V) / np.maximum(values, 1e-9)).sum(1)), np.inf)


def _change(M: Array, factor: Array) -> float:
    """Largest relative change of the standard deviation along a group's directions, with variances times factors."""
    before = M.sum(1)
    after = np.divide(M @ factor, before, out=np.ones_like(before), where=before > 0.0)
    return float(np.abs(np.sqrt(after) - 1.0).max(initial=0.0))


def fitted_directions(assembly: Assembly, builder: RowBuilder, log: str) -> Tensor:
    """G, (width, k), with `|x G|^2` the leverage of a whitened row x of a log in a fit, extra parameters included."""
    problem = assembly.problem
    scale = problem.scale[problem.free]
    _, values, Vh = scipy.linalg.svd(problem.A[:, problem.free] * scale, full_matrices=False, lapack_driver="gesvd")
    kept = is_significant(values)
    directions = np.zeros((len(problem.nominal), int(kept.sum())))
    directions[problem.free] = scale[:, None] * Vh[kept].T / values[kept]
    places = {extra.label: builder.columns.count + number for number, extra in enumerate(builder.extras)}
    eliminations = sorted((x for x in assembly.eliminations if x.log in ("", log)), key=lambda x: x.log != "")
    extras: list[tuple[int, Array]] = []
    for elimination in eliminations:  # those of all logs first, which those of a log depend on
        values_of = np.hstack([-elimination.inverse @ elimination.C @ directions, elimination.inverse])
        extras += zip((places[extra.label] for extra in elimination.extras), values_of, strict=True)
        directions = np.pad(directions, ((0, 0), (0, elimination.inverse.shape[1])))
        directions = directions if elimination.log else np.vstack([directions, values_of])
    G = np.zeros((builder.width, directions.shape[1]))
    G[: builder.columns.count] = builder.columns.parameter_map @ directions[: len(problem.nominal)]
    for place, row in extras:
        G[place, : len(row)] = row
    return torch.from_numpy(G)


def _clipped_variance(z: Array, weights: Array) -> float:
    """Variance of readings with outliers clipped; for Gaussian ones the same as without clipping."""
    limit = CLIP * float(np.median(np.abs(z))) / MAD_PER_STD
    if limit == 0.0:
        limit = np.inf
    return float(weights @ np.minimum(np.square(z), limit**2) / (_CLIPPED if limit < np.inf else 1.0) / weights.sum())
