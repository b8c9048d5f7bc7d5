"""Noise of the sensors and of the base rows from the residuals of a fit: variance components.

Every whitened, projected row mixes the noise of several sensors. But each sensor enters the rows of a sample along
known directions, which differ between postures and contact states. The variances are those at which the expected
covariance of the residuals equals the observed one (Rao's MINQUE, iterated, which is restricted maximum likelihood;
Searle, Casella and McCulloch, "Variance Components", 1992, chapters 6 and 11).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
import scipy.linalg
import scipy.optimize
import torch
from scipy.stats import chi2, norm
from torch import Tensor

from torchid import ranks
from torchid.parameters import Array
from torchid.problem.chunks import chunks_by_state, one_thread
from torchid.problem.compression import Part
from torchid.problem.contact_state import ContactState
from torchid.problem.extras import measured_components
from torchid.problem.linear import LinearProblem, TriangularFactor
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.rounding import is_significant
from torchid.sensing import SensorNoise

BASE_GROUPS = tuple(f"base_{kind}.{axis}" for kind in ("force", "moment") for axis in "xyz")
NOISE_GROUPS = ("joint_torque", "contact_force", "contact_moment", *BASE_GROUPS, "ft_force", "ft_moment")
"""Groups of one standard deviation each; base rows along the axes of the levelled base."""

_SAMPLES, _BYTES, _CHUNK = 1000, 2**27, 256  # rows in memory: 1000 samples give a standard deviation to 2 to 3 %
_THINNED = 4  # leverage is computed from one in so many of these
_NORMAL = 0.6745  # median of |x| of standard normal x
_CLIP = 3.0  # residuals, of impacts for instance, are clipped at three robust standard deviations
_CLIPPED = 0.99501  # E[min(x^2, 9)] of standard normal x
_HELD = 0.005  # weight of the previous variances against the residuals: determines confounded ones
_LEAST_STEP = 0.05  # least factor of a variance in one step
_SHARE = 0.01  # least share of a group in the variance along its own directions: a tenth of the deviation there
_SMALLEST = 1e-3  # of the stated noise, least standard deviation: exact logs leave only rounding
_LEFT = 0.1  # least share of the residual's degrees of freedom that a group is assigned
_FEW = 20.0  # least number of independent readings: a standard deviation to 16 %
_NEGLIGIBLE = 1e-9  # share of a source's variance in the rows below which it is projected out
_STEADY, _STEPS = 0.01, 40  # relative change of the noise along the directions of any group; most steps
_CONFOUNDED = 0.5  # relative standard error of a standard deviation


def std_by_group(noise: SensorNoise) -> dict[str, float]:
    """Standard deviation of every group, by name [N, N m]."""
    limb = noise.limb_std
    sensors = (noise.joint_torque, noise.contact_force, noise.contact_moment)
    return dict(zip(NOISE_GROUPS, [*sensors, *noise.base_std.tolist(), *limb], strict=True))


def noise_of_sensors(builder: RowBuilder) -> dict[str, float]:
    """Standard deviation of every group that a builder's sensors have, in `NOISE_GROUPS`' order [N m, N]."""
    names = set(_source_names(builder))
    return {name: value for name, value in std_by_group(builder.sensors.noise).items() if name in names}


def noise_of_groups(values: Mapping[str, float]) -> SensorNoise:
    """Sensor noise from standard deviations by group."""
    force, moment = (
        (values[names[0]], values[names[1]], values[names[2]]) for names in (BASE_GROUPS[:3], BASE_GROUPS[3:])
    )
    plain = {name: values[name] for name in NOISE_GROUPS if name not in BASE_GROUPS}
    return SensorNoise(**plain, base_force=force, base_moment=moment)


@dataclass(frozen=True)
class _Chunk:
    """Samples of one log in one contact state.

    `rows`, (B, n_rows, width + 1), whitened with the noise of the builder; `sources`, (B, E, n_rows), one standard
    deviation of each source of noise in these rows.
    """

    log: str
    state: ContactState
    oversampling: float
    rows: Tensor
    sources: Tensor


@dataclass(frozen=True)
class LogElsewhere:
    """A log that another process has: its number of samples, and their oversampling."""

    count: int
    oversampling: float

    def __len__(self) -> int:
        return self.count


class SampledRows:
    """Rows of about a thousand samples of the logs, in memory, to be whitened again with other noise.

    Attributes:
        builder: of the rows; its sensors' noise is the stated one, which variances are relative to.
        groups: those that the sensors have, in `NOISE_GROUPS`' order.
        group_of: (E,), index among `groups` of every source of noise.
    """

    @one_thread()
    @torch.no_grad()
    def __init__(self, logs: Sequence[Samples | LogElsewhere], builder: RowBuilder) -> None:
        """Compute the rows of random samples, always the same ones.

        Logs elsewhere are those of processes that share the work, each with successive ones; all get the rows of all.
        """
        self.builder = builder
        names = _source_names(builder)
        self.groups = tuple(name for name in NOISE_GROUPS if name in names)
        self.group_of = np.array([self.groups.index(name) for name in names], dtype=int)
        stated = std_by_group(builder.sensors.noise)
        self._std = torch.tensor([stated[name] for name in names], dtype=torch.float64)
        n_rows = builder.tree.n_rows
        most = min(_SAMPLES, _BYTES // (8 * max(n_rows, 1) * (builder.width + 1 + len(names))))
        self.chunks = [self._chunk(part, state) for part, state in _random_chunks(logs, max(most, 1))]
        elsewhere = any(isinstance(log, LogElsewhere) for log in logs)
        if any(ranks.gather(elsewhere, "logs that others have")):
            self.chunks = list(chain.from_iterable(ranks.gather(self.chunks, "samples for the noise")))

    @property
    def reference_std(self) -> Array:
        """Stated standard deviation of each group, which variances are relative to, (G,) [N m, N]."""
        stated = std_by_group(self.builder.sensors.noise)
        return np.array([stated[name] for name in self.groups])

    @property
    def oversampling(self) -> float:
        """Rows per independent row."""
        counts = np.array([[len(chunk.rows), len(chunk.rows) / chunk.oversampling] for chunk in self.chunks]).sum(0)
        return float(counts[0] / counts[1])

    def _chunk(self, samples: Samples, state: ContactState) -> _Chunk:
        rows, W = self.builder.rows_by_sample(samples.to(self.builder.device), state)
        sources = (self._unit_forces(samples.to(self.builder.device)) @ W).cpu() * self._std[:, None]
        return _Chunk(samples.source, state, samples.oversampling, rows.cpu().double(), sources.double())

    def _unit_forces(self, samples: Samples) -> Tensor:
        """Generalized force of a unit of each noise source, (B, E, n_rows)."""
        builder, base = self.builder, self.builder.tree.base_rows
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
            J = builder.contact_jacobian(samples) * samples.active[..., None, None]
            forces.append(J[:, torch.from_numpy(components)])
        return torch.cat(forces, dim=1)

    def whitened(self, variance: Array) -> Iterator[_Chunk]:
        """The chunks, whitened with variances of the groups relative to the stated ones, (G,)."""
        if (variance == 1.0).all():
            yield from self.chunks
            return
        scale = torch.from_numpy(np.sqrt(variance)[self.group_of])[:, None]
        for chunk in self.chunks:
            sources = chunk.sources * scale
            S = sources.mT @ sources
            empty = S.diagonal(dim1=1, dim2=2) == 0.0  # rows of zeros
            L = torch.linalg.cholesky(S + torch.diag_embed(empty.to(S)))
            rows = torch.linalg.solve_triangular(L, chunk.rows, upper=False)
            sources = torch.linalg.solve_triangular(L, sources.mT, upper=False).mT
            yield replace(chunk, rows=rows, sources=sources)

    @one_thread()
    def compress(self, variance: Array, columns: Mapping[str, Tensor] | None = None) -> list[Part]:
        """The rows, whitened with these variances and compressed.

        With parameters of an earlier fit in the builder's columns, by log, samples with large residuals count less, as
        in Huber's loss: otherwise the effect of impacts on the parameters would look like noise of all rows. A sample's
        rows are taken together, as another basis of their span must not make a difference.
        """
        parts: dict[tuple[str, ContactState], Part] = {}
        every = tuple(range(self.builder.width))
        for chunk in self.whitened(variance):
            key = chunk.log, chunk.state
            part = parts.setdefault(key, Part(*key, TriangularFactor(self.builder.width), 0))
            part.samples += len(chunk.rows)
            rows, present = chunk.rows, chunk.sources.abs().sum(1) > 0.0
            if columns is not None:
                size = torch.linalg.vector_norm(rows[..., :-1] @ columns[chunk.log] - rows[..., -1], dim=1)
                limit = _radius(present.sum(1))
                rows = rows * (limit / size).clamp_max(1.0).sqrt()[:, None, None]
            part.factor.add(every, rows[present], chunk.oversampling)
        return list(parts.values())


def _radius(rows: Tensor) -> Tensor:
    """Size of whitened residuals of so many rows that is exceeded as seldom as `_CLIP` standard deviations by one."""
    return torch.from_numpy(np.sqrt(chi2.isf(2.0 * norm.sf(_CLIP), rows.numpy())))


def _source_names(builder: RowBuilder) -> list[str]:
    """The group of every source of noise, in the order of `SampledRows._unit_forces`."""
    n = builder.tree.n
    limbs = ["ft_force"] * 3 + ["ft_moment"] * 3
    dofs = ["joint_torque" if dof < n else limbs[(dof - n) % 6] for dof in np.flatnonzero(builder.sensors.torque)]
    components = np.argwhere(measured_components(builder.contacts, builder.sensors))[:, 1]
    contacts = ["contact_force" if k < 3 else "contact_moment" for k in components]
    return [*BASE_GROUPS[: builder.tree.base_rows], *dofs, *contacts]


def _random_chunks(logs: Sequence[Samples | LogElsewhere], most: int) -> Iterator[tuple[Samples, ContactState]]:
    """About `most` random samples (regular ones could be in phase with a gait), log by log and state by state.

    Of filtered logs at most four for every independent sample: more would add little.
    """
    rng, share = np.random.default_rng(0), min(1.0, most / max(sum(map(len, logs)), 1))
    for log in logs:
        count = min(len(log), max(round(min(share, 4.0 / log.oversampling) * len(log)), 1))
        index = torch.from_numpy(np.sort(rng.choice(len(log), count, replace=False)))
        if isinstance(log, LogElsewhere):
            continue
        chosen = replace(log[index], oversampling=max(1.0, log.oversampling * count / len(log)), folder=None)
        for state, where in chunks_by_state(chosen, _CHUNK):
            yield chosen[where], state


@dataclass(frozen=True)
class GroupVariances:
    """Variances of the groups relative to the stated ones, those of the builder of `SampledRows`.

    Attributes:
        variance: (G,).
        share: (G,), the group's own share of the variance along its directions, between 0 and 1.
        estimated: (G,) bool, whether there were enough readings; if not, the variance is unchanged.
        error: (G,), relative standard error of the standard deviation, large where groups are confounded.
        change: largest relative change of the noise of all groups along the directions of any group since the start.
    """

    variance: Array
    share: Array
    estimated: np.ndarray
    error: Array
    change: float

    @property
    def upper_bound(self) -> np.ndarray:
        """Groups whose noise is far below that of others: only an upper bound is known, (G,) bool."""
        return self.estimated & (self.share <= 1.5 * _SHARE)

    @property
    def confounded(self) -> np.ndarray:
        """Groups that are confounded with others: residuals determine little but their sum, (G,) bool."""
        return self.estimated & ~self.upper_bound & (self.error > _CONFOUNDED)


@dataclass(frozen=True)
class _Residuals:
    """Residuals and noise sources of the rows, by chunk, and the degrees of freedom that the fit leaves.

    `r`: (B, n_rows), residuals; `U`: (B, E, n_rows), sources of the stated noise; `left`, (G,), share of each group's
    degrees of freedom that remain after the fit; `independent`, (G,), number of independent readings.
    """

    r: list[Tensor]
    U: list[Tensor]
    left: Array
    independent: Array


class VarianceComponentEstimator:
    """Estimates variances of groups from residuals at fitted parameters."""

    def __init__(self, rows: SampledRows, tied: Collection[str] = ()) -> None:
        """Estimate one common factor for the variances of the `tied` groups."""
        self.rows = rows
        count = len(rows.groups)
        kept = [index for index, name in enumerate(rows.groups) if name in tied]
        free = [index for index in range(count) if index not in kept]
        blocks = [kept, *([index] for index in free)] if kept else [[index] for index in free]
        self._blocks = np.zeros((count, len(blocks)))  # (G, unknown variances)
        for number, block in enumerate(blocks):
            self._blocks[block, number] = 1.0

    @one_thread()
    @torch.no_grad()
    def estimate(self, variance: Array, columns: Mapping[str, Tensor], problem: LinearProblem) -> GroupVariances:
        """Variances at which the expected covariance of the residuals equals the observed one.

        Residuals are clipped. A fit makes them smaller; each group is corrected by the leverage of its own directions.
        Its standard deviation is at least a tenth of that along its directions, and a thousandth of the stated noise.

        Args:
            variance: (G,), initial values, with which the parameters were fitted.
            columns: parameters in the builder's columns, (width,), by log.
            problem: of the fit.
        """
        residuals, start = self._residuals(variance, columns, problem), variance
        estimated = (residuals.independent > _FEW) @ self._blocks > 0.0
        first, *_ = M, q, t, count = self._moments(residuals, variance)
        for _ in range(_STEPS):
            share = np.divide(t, count, out=np.ones_like(t), where=count > 0.0)
            step = self._step(M, q, estimated)
            least = np.maximum(_SHARE / np.maximum(share, 1e-12), _SMALLEST**2 / variance)
            least_of_block = np.where(self._blocks > 0.0, least[:, None], 0.0).max(axis=0, initial=0.0)
            step = np.where(estimated, np.maximum(step, least_of_block), 1.0)
            factor = self._blocks @ step
            variance = variance * factor
            if _change(M, factor) < _STEADY:
                break
            M, q, t, count = self._moments(residuals, variance)
        error = _relative_errors(M * np.sqrt(np.outer(residuals.left, residuals.left)) / self.rows.oversampling)
        return GroupVariances(variance, share, self._blocks @ estimated > 0.0, error, _change(first, variance / start))

    def _step(self, M: Array, q: Array, estimated: np.ndarray) -> Array:
        """Factors of the unknown variances at which the squares are the expected ones; confounded ones stay near 1."""
        B = self._blocks
        M, q = B.T @ M @ B, B.T @ q
        free, held = np.flatnonzero(estimated), _HELD * np.diag(M)
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

    def _moments(self, residuals: _Residuals, variance: Array) -> tuple[Array, Array, Array, Array]:
        """M (G, G), q (G,) of the equations M x = q; variance in the rows and number of readings by group, (G,)."""
        group_of, count = self.rows.group_of, len(variance)
        member = torch.zeros(len(group_of), count, dtype=torch.float64)
        member[torch.arange(len(group_of)), torch.from_numpy(group_of)] = 1.0
        scale = torch.from_numpy(np.sqrt(variance)[group_of])[:, None]
        M, z, sizes = torch.zeros(count, count, dtype=torch.float64), [], []
        for r, U in zip(residuals.r, residuals.U, strict=True):
            sources = U * scale
            S = sources.mT @ sources
            S = S + torch.diag_embed((S.diagonal(dim1=1, dim2=2) == 0.0).to(S))
            L = torch.linalg.cholesky(S)
            white = torch.linalg.solve_triangular(L, sources.mT, upper=False)  # (B, n_rows, E)
            y = torch.linalg.solve_triangular(L, r[..., None], upper=False)
            M += member.T @ (white.mT @ white).square().sum(0) @ member
            sizes.append(white.square().sum(1))
            z.append((white.mT @ y)[..., 0])
        size, score = torch.cat(sizes).numpy(), torch.cat(z).numpy()
        q, t, n = (np.zeros(count) for _ in range(3))
        for group in range(count):
            own, scores = size[:, group_of == group], score[:, group_of == group]
            present = own > _NEGLIGIBLE
            t[group], n[group] = own.sum(), present.sum()
            if present.any():
                q[group] = t[group] * _clipped_variance(scores[present] / np.sqrt(own[present]), own[present])
        return M.numpy(), q / residuals.left, t, n

    def _residuals(self, variance: Array, columns: Mapping[str, Tensor], problem: LinearProblem) -> _Residuals:
        rows, group_of, directions = self.rows, self.rows.group_of, _fitted_directions(problem, self.rows.builder)
        leverages, size, readings = (np.zeros(len(variance)) for _ in range(3))
        for chunk in rows.whitened(variance):
            own = chunk.sources.square().sum(2)
            thinned = slice(None, None, _THINNED)
            leverage = (chunk.sources[thinned] @ (chunk.rows[thinned, :, :-1] @ directions)).square().sum((0, 2))
            np.add.at(leverages, group_of, chunk.oversampling * leverage.numpy())
            np.add.at(size, group_of, own[thinned].sum(0).numpy())
            np.add.at(readings, group_of, (own > _NEGLIGIBLE).sum(0).numpy() / chunk.oversampling)
        remaining = 1.0 - np.divide(leverages, size, out=np.zeros_like(size), where=size > 0.0)
        r = [chunk.rows[..., :-1] @ columns[chunk.log] - chunk.rows[..., -1] for chunk in rows.chunks]
        U = [chunk.sources for chunk in rows.chunks]
        return _Residuals(r, U, np.maximum(remaining, _LEFT), readings * np.maximum(remaining, 0.0))


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


def _fitted_directions(problem: LinearProblem, builder: RowBuilder) -> Tensor:
    """G, (width, rank), with `|x G|^2` the leverage of a whitened row x; that of the few extras is neglected."""
    scale = problem.scale[problem.free]
    _, values, Vh = scipy.linalg.svd(problem.A[:, problem.free] * scale, full_matrices=False, lapack_driver="gesvd")
    kept = is_significant(values)
    G = np.zeros((builder.width, int(kept.sum())))
    basis = scale[:, None] * Vh[kept].T / values[kept]
    G[: builder.columns.count] = builder.columns.parameter_map[:, problem.free] @ basis
    return torch.from_numpy(G)


def _clipped_variance(z: Array, weights: Array) -> float:
    """Variance of readings with outliers clipped; for Gaussian ones the same as without clipping."""
    limit = _CLIP * float(np.median(np.abs(z))) / _NORMAL
    if limit == 0.0:
        limit = np.inf
    return float(weights @ np.minimum(np.square(z), limit**2) / (_CLIPPED if limit < np.inf else 1.0) / weights.sum())
