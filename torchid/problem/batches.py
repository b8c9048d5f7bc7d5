"""Shuffled mini-batches of projected rows, several logs and contact states mixed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from scipy.linalg import block_diag
from torch import Tensor

from torchid.parallel import one_thread
from torchid.parameters import Array
from torchid.problem.chunks import chunks_by_state
from torchid.problem.contact_state import ContactState
from torchid.problem.elimination import Assembly
from torchid.problem.metrics import predict_forces, with_payload_columns
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples

_CHUNK = 1024  # samples whose rows are computed together; smaller chunks have too much overhead
_MEMORY = 2**30  # [bytes] of cached rows


@dataclass(frozen=True)
class Batch:
    """Projected and whitened rows of B samples. A fit makes `K @ (columns @ phi)` equal to `f`.

    Attributes:
        K: (B, n_rows, P'), `W^T K`, in the columns of `MiniBatches`; padded with rows of zeros.
        f: (B, n_rows), `W^T f`, in standard deviations of the sensor noise.
        W: (B, n_rows, n_rows), maps a generalized force r, (B, n_rows) [N, N m], to these rows: `W^T r`.
        q, v, a: generalized coordinates as in `Samples.coordinates`.
    """

    K: Tensor
    f: Tensor
    W: Tensor
    q: Tensor
    v: Tensor
    a: Tensor

    def __len__(self) -> int:
        return len(self.f)

    @property
    def rows(self) -> int:
        """Rows that are not zero."""
        return int(self.W.any(dim=1).sum())

    def __getitem__(self, index: slice | Tensor) -> Batch:
        return Batch(*(getattr(self, field.name)[index] for field in fields(self)))

    @property
    def nbytes(self) -> int:
        """Memory of all its tensors."""
        return sum(getattr(self, field.name).nbytes for field in fields(self))


class MiniBatches:
    """Shuffled mini-batches of logs.

    Samples are randomly assigned, once, to chunks. The rows of a chunk are computed together, and cached if memory
    allows. Every epoch shuffles the chunks and the samples in each. The order depends only on the seed and the epoch
    number.
    """

    def __init__(
        self,
        logs: Sequence[Samples],
        builder: RowBuilder,
        batch_size: int = 256,
        seed: int = 0,
        memory: int = _MEMORY,
        share: tuple[int, int] = (0, 1),
        assembly: Assembly | None = None,
    ) -> None:
        """Assign the samples to chunks.

        Args:
            logs: bound logs.
            builder: of the rows; batches are on its device.
            batch_size: samples per batch; the last batch of a chunk may have fewer.
            seed: of all random orders.
            memory: bytes of rows to cache; other rows are recomputed in each epoch.
            share: (k, n): process k of n, which share every batch. This process takes every n-th sample.
            assembly: result of `assemble` for these logs; needed if the builder has extra parameters. These take their
                best values for the bodies' parameters. The `terms` of its problem are the last columns.

        Raises:
            ValueError: `batch_size` is below 1, or `assembly` is missing.
        """
        if batch_size < 1:
            raise ValueError(f"batch_size: found {batch_size}; accepted: at least 1")
        self.builder = builder
        self.batch_size = batch_size
        self.seed = seed
        self.assembly = assembly
        terms = None if assembly is None else assembly.problem.terms
        identity = np.eye(0 if terms is None else len(terms.size))
        self.columns = torch.from_numpy(block_diag(builder.columns.parameter_map, identity)).to(builder.device)
        self._eliminated = {log.source: self._elimination(log.source) for log in logs} if builder.extras else {}
        self.samples = sum(map(len, logs))
        self._logs = tuple(logs)
        self._memory = memory
        self.share = share
        self._starts = torch.tensor([0, *(len(log) for log in logs)]).cumsum(0).tolist()
        chunk = max(_CHUNK // batch_size, 1) * batch_size
        self._chunks = torch.randperm(self.samples, generator=self._generator(0)).split(chunk)
        self._cache: dict[int, Batch] = {}
        self._memory_left = memory

    def __repr__(self) -> str:
        return f"MiniBatches: {self.samples} samples of {len(self._logs)} logs, {self.batch_size} per batch"

    def epoch(self, number: int) -> Iterator[Batch]:
        """All samples in the order of an epoch, numbered from 1."""
        return (batch for batch, _ in self.sized_epoch(number))

    def sized_epoch(self, number: int) -> Iterator[tuple[Batch, int]]:
        """As `epoch`, each batch with the number of its samples in all processes together."""
        generator = self._generator(number)
        rank, size = self.share
        for chunk in torch.randperm(len(self._chunks), generator=generator).tolist():
            order = torch.randperm(len(self._chunks[chunk]), generator=generator)
            rows = self._rows(chunk)
            for part in order.to(rows.f.device).split(self.batch_size):
                share = part if size == 1 else part[part % size == rank] // size
                yield rows[share], len(part)

    def chunks(self) -> Iterator[Batch]:
        """All samples, chunk by chunk, always in the same order."""
        return (batch for batch, _ in self.sized_chunks())

    def sized_chunks(self) -> Iterator[tuple[Batch, int]]:
        """As `chunks`, each with the number of its samples in all processes together."""
        return ((self._rows(number), len(chunk)) for number, chunk in enumerate(self._chunks))

    @torch.no_grad()
    def generalized_forces(self, phi: Array) -> Iterator[tuple[tuple[Tensor, Tensor, Tensor], Tensor]]:
        """Coordinates (q, v, a) and forces K phi, (B, n_rows) [N, N m], of parameters (12 L,), log by log."""
        columns = self.builder.to_columns(phi[None])
        for log in self._logs:
            for start in range(0, len(log), _CHUNK):
                samples = log[start : start + _CHUNK].to(self.builder.device)
                phi_columns = with_payload_columns(self.builder, samples, columns)
                yield (
                    samples.coordinates(),
                    predict_forces(self.builder, self.builder.dynamics(samples), phi_columns)[0].T,
                )

    def _generator(self, number: int) -> torch.Generator:
        return torch.Generator().manual_seed((self.seed * 1_000_003 + number) % 2**63)

    def _rows(self, chunk: int) -> Batch:
        if chunk in self._cache:
            return self._cache[chunk]
        batch = self._compute_rows(self._chunks[chunk])
        if batch.nbytes <= self._memory_left:
            self._memory_left -= batch.nbytes
            self._cache[chunk] = batch
        return batch

    @torch.no_grad()
    def _compute_rows(self, index: Tensor) -> Batch:
        """Rows of numbered samples, sorted by log and contact state; this share has every so-many-th of these."""
        parts: list[Batch] = []
        rank, size = self.share
        before = 0
        with one_thread():
            for log, start, end in zip(self._logs, self._starts, self._starts[1:], strict=False):
                samples = log[index[(index >= start) & (index < end)] - start].to(self.builder.device)
                for state, where in chunks_by_state(samples, len(index)):
                    chosen = samples[where]
                    share = chosen[(rank - before) % size :: size]
                    before += len(chosen)
                    if len(share) or not parts:  # a chunk with fewer samples than processes needs at least the shapes
                        parts.append(self._batch(share if len(share) else chosen[:1], state)[: len(share)])
        return Batch(*(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(Batch)))

    def _batch(self, samples: Samples, state: ContactState) -> Batch:
        """Rows of samples that share a contact state."""
        rows, W = self.builder.rows_by_sample(samples, state)
        if self._eliminated:
            rows = rows @ self._eliminated[samples.source]
        return Batch(rows[..., :-1], rows[..., -1], W, *samples.coordinates())

    def _elimination(self, source: str) -> Tensor:
        """Matrix that maps rows of a log with extra parameters, (width + 1,), to rows without; right-hand side last.

        Extra parameters are psi = inverse (z - C x), as in `Elimination`; terms with conditions stay as columns.
        """
        if self.assembly is None:
            raise ValueError("assembly: found None; accepted: a result of assemble (builder has extra parameters)")
        parameter_map = self.builder.columns.parameter_map
        kept = len(self.columns)
        rhs = np.eye(1, kept + 1, kept)
        x = np.pad(np.linalg.pinv(parameter_map), ((0, 0), (0, kept + 1 - len(parameter_map))))
        values: dict[str, Array] = {}
        for elimination in sorted(self.assembly.eliminations, key=lambda x: x.log):  # "" of all logs first
            if elimination.log not in ("", source):
                continue
            if elimination.log or self.assembly.problem.terms is None:
                psi = elimination.inverse @ (elimination.z[:, None] * rhs - elimination.C @ x)
            else:
                psi = np.eye(len(elimination.extras), kept + 1, len(parameter_map))
            x = x if elimination.log else np.vstack([x, psi])
            values |= {extra.label: row for extra, row in zip(elimination.extras, psi, strict=True)}
        extras = np.array([values[extra.label] for extra in self.builder.extras])
        extras[:, -1] *= -1.0  # of the right-hand side
        out = np.vstack([np.eye(len(parameter_map), kept + 1), extras, rhs])
        return torch.from_numpy(out).to(self.builder.device)
