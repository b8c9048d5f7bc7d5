"""Rows of some samples by source of noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.special import chdtri, ndtr
from torch import Tensor

from torchid import distributed
from torchid.parallel import map_in_workers, one_thread
from torchid.parameters import Array
from torchid.problem.chunks import chunks_by_state, worker_count
from torchid.problem.contact_state import ContactState
from torchid.problem.linear import TriangularFactor
from torchid.problem.noise_gram import noise_of_reading
from torchid.problem.parts import Part
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.sensing.sensors import measured_components

_SAMPLES, _BYTES, _CHUNK = 1000, 2**27, 256  # rows in memory: 1000 samples give a standard deviation to 2 to 3 %
CLIP = 3.0
"""Robust standard deviations at which residuals, of impacts for instance, are clipped."""


def noise_of_sensors(builder: RowBuilder) -> dict[str, float]:
    """Standard deviation of every group that a builder's sensors have, in `NoiseGroups`' order [N m, N]."""
    names, values = set(builder.noise_sources), builder.noise_groups.values(builder.sensors.noise)
    return {name: value for name, value in values.items() if name in names}


@dataclass(frozen=True)
class SampledChunk:
    """Samples of one log in one contact state.

    `rows`, (B, n_rows, width + 1), whitened with the noise of the builder; `sources`, (B, E, n_rows), one standard
    deviation of each source of noise in these rows. `blocks`: numbers of sources, (k, e), and of rows, (k, r), that
    have nothing to do with others, for all k that have as many.
    """

    log: str
    state: ContactState
    oversampling: float
    rows: Tensor
    sources: Tensor
    blocks: tuple[tuple[Tensor, Tensor], ...]


@dataclass(frozen=True)
class LogOfOtherProcess:
    """A log that another process has: its number of samples, and their oversampling."""

    count: int
    oversampling: float

    def __len__(self) -> int:
        return self.count


class SampledRows:
    """Rows of about a thousand samples of the logs, in memory, to be whitened again with other noise.

    Attributes:
        builder: of the rows; its sensors' noise is the stated one, which variances are relative to.
        groups: those that the sensors have, in `NoiseGroups`' order.
        alike: indices of groups whose noise may be of one size.
        group_of: (E,), index among `groups` of every source of noise.
    """

    @one_thread()
    @torch.no_grad()
    def __init__(self, logs: Sequence[Samples | LogOfOtherProcess], builder: RowBuilder, chunk: int = _CHUNK) -> None:
        """Compute the rows of random samples, always the same ones.

        Logs elsewhere are those of processes that share the work, each with successive ones; all get the rows of all.

        Args:
            logs: bound logs.
            builder: of their rows.
            chunk: samples at a time; their number rounds otherwise, which moves an ill-determined noise by per cents.
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
            builder.layout(state, samples.contact_normal is not None)
        self.chunks = map_in_workers(drawn, lambda one: self._chunk(*one), worker_count(builder.device))
        elsewhere = any(isinstance(log, LogOfOtherProcess) for log in logs)
        if any(distributed.all_gather(elsewhere, "logs that others have")):
            self.chunks = list(chain.from_iterable(distributed.all_gather(self.chunks, "samples for the noise")))

    @property
    def reference_std(self) -> Array:
        """Stated standard deviation of each group, which variances are relative to, (G,) [N m, N]."""
        return np.array([*noise_of_sensors(self.builder).values()])

    @property
    def oversampling(self) -> float:
        """Rows per independent row."""
        counts = np.array([[len(chunk.rows), len(chunk.rows) / chunk.oversampling] for chunk in self.chunks]).sum(0)
        return float(counts[0] / counts[1])

    def _chunk(self, samples: Samples, state: ContactState) -> SampledChunk:
        rows, W = self.builder.rows_by_sample(samples.to(self.builder.device), state)
        sources = (self._unit_forces(samples.to(self.builder.device)) @ W).cpu() * self._std[:, None]
        blocks = _blocks((sources != 0.0).any(0).numpy())
        return SampledChunk(samples.source, state, samples.oversampling, rows.cpu().double(), sources.double(), blocks)

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
            J = builder.contact_jacobian(samples)
            J = torch.where(samples.active[..., None, None], J, 0.0)  # in the air a normal may be NaN
            forces.append(J[:, torch.from_numpy(components)])
        return torch.cat(forces, dim=1)

    def whiten(self, chunk: SampledChunk, variance: Array, step: int = 1) -> SampledChunk:
        """A chunk whitened with variances of the groups relative to the stated ones, (G,).

        Of its `rows` those of every `step`-th sample.
        """
        if (variance == 1.0).all():
            return replace(chunk, rows=chunk.rows[::step])
        scale = torch.from_numpy(np.sqrt(variance)[self.group_of])
        before, sources, coupled = chunk.rows[::step], torch.zeros_like(chunk.sources), []
        std = torch.ones_like(before[..., :1])  # of rows on their own
        for own, slots in chunk.blocks:
            of = slice(None), own[..., None], slots[:, None]
            U = scale[of[1]] * chunk.sources[of]
            L = noise_root(U)
            sources[of] = whitened(L, U.mT).mT
            if slots.shape[1] == 1:
                std[:, slots[:, 0]] = L[::step, ..., 0]
            else:
                coupled.append((slots, L[::step]))
        rows = before / std
        for slots, L in coupled:
            rows[:, slots] = whitened(L, before[:, slots])
        return replace(chunk, rows=rows, sources=sources)

    @one_thread()
    def compress(self, variance: Array, columns: Mapping[str, Tensor] | None = None) -> list[Part]:
        """The rows, whitened with these variances and compressed.

        With parameters of an earlier fit in the builder's columns, by log, samples with large residuals count less, as
        in Huber's loss: otherwise the effect of impacts on the parameters would look like noise of all rows. A sample's
        rows are taken together, as another basis of their span must not make a difference.
        """

        def factor_of(chunk: SampledChunk) -> TriangularFactor:
            chunk = self.whiten(chunk, variance)
            rows, present = chunk.rows, chunk.sources.abs().sum(1) > 0.0
            readings, root = chunk.sources.square().sum(2), rows.new_ones(len(rows))
            if columns is not None:
                size = torch.linalg.vector_norm(rows[..., :-1] @ columns[chunk.log] - rows[..., -1], dim=1)
                limit = _radius(present.sum(1))
                weight = (limit / size).clamp_max(1.0)
                root, readings = weight.sqrt(), readings * weight[:, None]
            factor = TriangularFactor(self.builder.width)
            for support, slots in supports(rows).items():
                own = rows[:, torch.tensor(slots)[:, None], torch.tensor([*support, self.builder.width])]
                own *= root[:, None, None]
                factor.add(support, own[present[:, slots]], chunk.oversampling)
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
    """L (..., r, r) with `L L^T` the covariance of rows that have these sources (..., e, r); 1 of rows of zeros."""
    if sources.shape[-1] == 1:
        size = torch.linalg.vector_norm(sources, dim=-2, keepdim=True)
        return torch.where(size == 0.0, 1.0, size)
    S = sources.mT @ sources
    return torch.linalg.cholesky(S + torch.diag_embed((S.diagonal(dim1=-2, dim2=-1) == 0.0).to(S)))


def whitened(root: Tensor, rows: Tensor) -> Tensor:
    """L^-1 X of rows X (..., r, columns) with such a root (..., r, r): a quotient where r is 1."""
    return rows / root if root.shape[-1] == 1 else torch.linalg.solve_triangular(root, rows, upper=False)


def _blocks(present: np.ndarray) -> tuple[tuple[Tensor, Tensor], ...]:
    """`SampledChunk.blocks` by which source is in which row, (E, n_rows)."""
    sources, rows = np.nonzero(present)
    count, size = len(present), sum(present.shape)
    linked = coo_array((np.ones(len(rows)), (sources, count + rows)), (size, size))
    label = connected_components(linked, directed=False)[1]
    alike: dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray]]] = {}
    for number in np.unique(label[sources]):
        of = np.flatnonzero(label == number)
        block = of[of < count], of[of >= count] - count
        alike.setdefault((len(block[0]), len(block[1])), []).append(block)
    return tuple(
        (torch.from_numpy(np.stack([own for own, _ in blocks])), torch.from_numpy(np.stack([own for _, own in blocks])))
        for blocks in alike.values()
    )


def _sources_of_scales(builder: RowBuilder) -> dict[int, list[int]]:
    """Numbers of the sources of noise of readings with an unknown scale, by its column."""
    base, torque = builder.tree.base_rows, np.asarray(builder.sensors.torque)
    components = measured_components(builder.contacts, builder.sensors)
    dofs, places = base + np.cumsum(torque) - 1, base + torque.sum() + np.cumsum(components).reshape(-1, 6) - 1
    return {
        column: [*(int(dofs[dof]) for dof in extra.dofs), *(int(places[at]) for at in extra.contacts if components[at])]
        for column, extra in enumerate(builder.extras, builder.columns.count)
        if extra.what == "scale"
    }


def supports(rows: Tensor) -> dict[tuple[int, ...], list[int]]:
    """Columns in which rows (B, n_rows, width + 1), right-hand side last, are not zero: numbers of rows by these."""
    out: dict[tuple[int, ...], list[int]] = {}
    for slot, used in enumerate((rows[..., :-1] != 0.0).any(0).numpy()):
        out.setdefault(tuple(np.flatnonzero(used).tolist()), []).append(slot)
    return out


def _radius(rows: Tensor) -> Tensor:
    """Size of whitened residuals of so many rows that is exceeded as seldom as `CLIP` standard deviations by one."""
    return torch.from_numpy(np.sqrt(chdtri(rows.numpy(), 2.0 * ndtr(-CLIP))))


def _random_chunks(
    logs: Sequence[Samples | LogOfOtherProcess], most: int, chunk: int
) -> Iterator[tuple[Samples, ContactState]]:
    """About `most` random samples (regular ones could be in phase with a gait), log by log and state by state.

    Of filtered logs at most four for every independent sample: more would add little.
    """
    rng, share = np.random.default_rng(0), min(1.0, most / max(sum(map(len, logs)), 1))
    for log in logs:
        count = min(len(log), max(round(min(share, 4.0 / log.oversampling) * len(log)), 1))
        index = torch.from_numpy(np.sort(rng.choice(len(log), count, replace=False)))
        if isinstance(log, LogOfOtherProcess):
            continue
        chosen = replace(log[index], oversampling=max(1.0, log.oversampling * count / len(log)), folder=None)
        for state, where in chunks_by_state(chosen, chunk):
            yield chosen[where], state
