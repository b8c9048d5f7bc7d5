"""Contribution of motion noise, and of readings with unknown scales, to the normal equations, and its removal.

Noise of positions, velocities and accelerations enlarges the regressor on average: X^T X grows by the covariance of the
noise in X, and the parameters of noisy columns become too small. Samples with the same amount of noise added again show
this growth; pairs of opposite noise cancel its linear part. After the subtraction, the normal equations are on average
those of the true motion (corrected least squares).

Source: Fuller, "Measurement Error Models", 1987, section 2.2. The noise is added as in simulation extrapolation (Cook,
Stefanski, JASA 89, 1994), but to the sufficient statistics instead of the estimate.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchid import distributed
from torchid.errors import format_percent
from torchid.parallel import one_thread
from torchid.parameters import Array
from torchid.problem.chunks import blocks_in, chunk_size, join_pieces, map_chunks, span_of_samples
from torchid.problem.contact_state import ContactState
from torchid.problem.linear import TriangularFactor, gram_matrix
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.rounding import RANK_TOLERANCE, column_scale, is_significant

LEAST_SIGNAL = 1.0 / 3.0
"""Share of the information on a combination of parameters that remains at least: all but that may be noise.

Beyond, the size of what is taken off, which chance changes by a third in logs of half a minute, would decide on the
combination. Less is taken off, and the nominal parameters make up for what is then too much.
"""

_MOST_SIGNAL = 2.0  # beyond, it is rounding
_LEAST_PERTURBED = 5000  # samples of all logs, evenly spread, see `_perturbed`
_MOST_PERTURBED = 20_000  # likewise
_NEGLIGIBLE = 1e-5  # fraction of noise in any combination, far below all standard errors
_COPIES = 3  # of each sample, see `_copies`
_RESOLVED = 1e-5  # least singular value, of columns of unit size, along which a difference of squares is no rounding

NoiseGram = dict[tuple[int, ...], Tensor]


class PartKey(NamedTuple):
    """Key of rows that belong together: log, contact state, fold and block; see `Part`."""

    source: str
    state: ContactState
    fold: int = 0
    block: int = 0
    unloaded: bool = False

    @classmethod
    def spans(cls, samples: Samples, state: ContactState) -> list[tuple[PartKey, int, int]]:
        """Keys of the parts in a chunk, each with its first sample and its end."""
        return [(cls(samples.source, state, fold, block), a, b) for fold, block, a, b in blocks_in(samples)]


@dataclass(frozen=True)
class NoiseShares:
    """Fractions of motion noise in the information on parameter combinations, before its subtraction.

    Attributes:
        combinations: number of combinations that the rows determine; 0 without motion noise.
        largest: largest fraction of noise.
        lost: number of combinations with more than 1 - `LEAST_SIGNAL` noise, which stay near the nominal values.
    """

    combinations: int = 0
    largest: float = 0.0
    lost: int = 0

    @classmethod
    def of(cls, shares: Array) -> NoiseShares:
        """From the fraction of each combination."""
        return cls(len(shares), max(float(shares.max(initial=0.0)), 0.0), int((shares > 1.0 - LEAST_SIGNAL).sum()))

    def __str__(self) -> str:
        text = f"up to {format_percent(self.largest)} % of the information on a combination is noise; it is subtracted"
        if self.lost:
            text += f". {self.lost} of {self.combinations} are mostly noise and stay near the nominal values"
        return text


def scale_columns(builder: RowBuilder) -> list[int]:
    """Columns of unknown scales of sensors."""
    return [number for number, extra in enumerate(builder.extras, builder.columns.count) if extra.what == "scale"]


def noise_of_reading(column: int, size: Tensor) -> NoiseGram:
    """Contribution of noise in readings with an unknown scale; `size` is its sum of squares in the rows.

    The reading enters the force and, negated, the column of its scale. The size of this noise follows from a fit.
    """
    return {(column,): size * size.new_tensor([[1.0, -1.0], [-1.0, 1.0]])}


def estimate_noise_gram(logs: Sequence[Samples], builder: RowBuilder) -> dict[PartKey, NoiseGram]:
    """Estimate the contribution of motion noise to X^T X for each part of logs; empty without noise.

    Args:
        logs: bound logs, or pieces of them in the order of their samples, with their folds and blocks.
        builder: of the rows.
    """
    scaled = bool(scale_columns(builder))
    step = distributed.broadcast(max(1, sum(map(len, logs)) // _perturbed(logs)), "noise samples")
    by_log: dict[str, list[Samples]] = {}
    for piece in logs:
        if (scaled or piece.motion_noise is not None) and len(piece):
            blocks = [piece[start:end] for *_, start, end in blocks_in(piece)]
            by_log.setdefault(piece.source, []).extend(_spread(block, step) for block in blocks)
    total: dict[PartKey, NoiseGram] = {}
    if not by_log:
        return total
    reduce = partial(_noise_gram_of_chunks, builder)
    chunk = chunk_size(builder.device) // _COPIES
    for of_worker in map_chunks(list(map(join_pieces, by_log.values())), builder, reduce, chunk):
        for key, noise_gram in of_worker.items():
            halves = {support: x.cpu().triu() for support, x in noise_gram.items()}
            both = {support: x + x.triu(1).T for support, x in halves.items()}  # to the last bit, as files have one
            _add(total.setdefault(key, {}), both, float(step))
    return total


def _add(total: NoiseGram, noise_gram: NoiseGram, weight: float) -> None:
    for support, x in noise_gram.items():
        total[support] = total[support] + weight * x if support in total else weight * x


def _perturbed(pieces: Sequence[Samples]) -> int:
    """Number of samples to add noise to: that of independent ones, within limits.

    Let noise be a fraction s of the information on a combination of parameters, and a fraction h of the mean square
    residual. With n of N independent samples the variance of the combination grows by the fraction 2 s h N / n: not
    noticeably for s = 0.01, by 4 % for s = 0.2, h = 0.1 (encoders with 1e-3 rad of noise) and n = N.
    """
    independent = sum(len(piece) / piece.oversampling for piece in pieces)
    return int(min(max(independent, _LEAST_PERTURBED), _MOST_PERTURBED))


def _spread(piece: Samples, step: int) -> Samples:
    """One in so many samples, drawn so that they are in phase with nothing."""
    if step == 1:
        return piece
    starts = np.arange(0, len(piece), step)
    width = np.minimum(step, len(piece) - starts)
    at = starts + (np.random.default_rng(0).uniform(size=len(starts)) * width).astype(int)
    return piece[torch.from_numpy(at)]


def _copies(spans: Sequence[tuple[int, int]]) -> tuple[Tensor, Tensor]:
    """Copies of successive samples, span by span: unchanged, then with positive, then with negative noise.

    Returns:
        Numbers of the samples, (3 B,), and the sign of their noise, (3 B,).
    """
    at = torch.cat([torch.arange(*span).repeat(_COPIES) for span in spans])
    lengths = torch.tensor([end - start for start, end in spans])
    side = torch.tensor([0.0, 1.0, -1.0]).repeat(len(spans)).repeat_interleave(lengths.repeat_interleave(_COPIES))
    return at, side


@torch.no_grad()
def _noise_gram_of_chunks(
    builder: RowBuilder, chunks: Iterator[tuple[Samples, ContactState]]
) -> dict[PartKey, NoiseGram]:
    """Noise Gram matrix by part: half of the growth of X^T X for pairs of samples with noise."""
    out: dict[PartKey, NoiseGram] = {}
    workspace = builder.workspaces.take()
    scales = set(scale_columns(builder))
    for samples, state in chunks:
        spans = PartKey.spans(samples, state)
        if scales:
            alone = samples.with_noise_alone(builder.sensors.noise)
            for rows, index in builder.blocks(alone, state, workspace):
                for key, start, end in spans:
                    first, last = span_of_samples(index, start, end)
                    for column in scales & set(rows.block.support):
                        of_column = rows.values[rows.block.support.index(column), :, first:last]
                        _add(out.setdefault(key, {}), noise_of_reading(column, of_column.square().sum()), 1.0)
        noise = samples.motion_noise
        if noise is None:
            continue
        at, side = _copies([(start, end) for _, start, end in spans])
        repeated = samples[at.to(samples.time.device)]
        perturbed = repeated.perturbed(noise, side.to(samples.time)[:, None])
        for rows, index in builder.blocks(perturbed, state, workspace):
            for key, start, end in spans:
                sums = out.setdefault(key, {})
                second = 2 * start + end
                for weight, (first, last) in (
                    (-1.0, span_of_samples(index, 3 * start, second)),
                    (0.5, span_of_samples(index, second, 3 * end)),
                ):
                    _add(sums, {rows.block.support: gram_matrix(rows.values[:, :, first:last])}, weight)
    builder.workspaces.give_back(workspace)
    return out


@dataclass(frozen=True)
class ColumnPrior:
    """Prior of the bodies' parameters, in the first columns of a factor.

    Attributes:
        nominal: (count,).
        spread: (count, P), deviations for each of P independent deviations of unit variance.
        reading_noise: as in `Assembly`.
    """

    nominal: Array
    spread: Array
    reading_noise: Mapping[int, float] = field(default_factory=dict)


@dataclass(frozen=True)
class CorrectedTriangle:
    """A factor without the contribution of motion noise.

    Attributes:
        R: (columns + 1, columns + 1), upper triangular, right-hand side last.
        noise: the subtracted noise.
        shrinkage: (columns, P + extra parameters), or None. By how much the best fit of R does not follow deviations
            from the nominal parameters: unit deviations of the prior, and those of extra parameters.
    """

    R: Array
    noise: NoiseShares = field(default_factory=NoiseShares)
    shrinkage: Array | None = None


@one_thread()
def corrected_triangle(factor: TriangularFactor, prior: ColumnPrior) -> CorrectedTriangle:
    """Subtract the contribution of motion noise from a factor.

    Residuals remain those of the rows at the parameters that fit R best. Noise larger than the unexplained part of the
    rows is reduced to that part, as in total least squares. If a combination has the fraction s of noise, at most 1 -
    `LEAST_SIGNAL` is subtracted. The combination then follows its data by (1 - s) / `LEAST_SIGNAL`, and the prior by
    the rest, as with a ridge. By chance s may exceed 1; then the data give no information on it.

    Args:
        factor: of rows.
        prior: of the parameters in its columns.
    """
    R = factor.triangle().numpy()
    noise_gram = factor.whole_noise_gram(prior.reading_noise).numpy()
    if not noise_gram.any():
        return CorrectedTriangle(R)
    rows = R[:, :-1]
    rhs = R[:, -1]
    size = np.linalg.norm(rows, axis=0)
    scale = column_scale(rows)
    U, values, Vh = np.linalg.svd(rows * scale, full_matrices=False)
    kept = is_significant(values, _RESOLVED)
    other = is_significant(values, RANK_TOLERANCE) & ~kept
    whitening = scale[:, None] * Vh[kept].T / values[kept]  # rows @ whitening has orthonormal columns
    noise = whitening.T @ noise_gram[:-1, :-1] @ whitening
    shares, turn = np.linalg.eigh(0.5 * (noise + noise.T))
    along = turn.T @ (U[:, kept].T @ rhs)
    of_forces = turn.T @ (whitening.T @ noise_gram[:-1, -1])
    beyond = U[:, other].T @ rhs
    of_noise = np.square(along) @ np.minimum(shares, 1.0) - 2.0 * along @ of_forces + noise_gram[-1, -1]
    spent = min((len(along) + len(beyond)) / max(factor.independent_rows, 1.0), 1.0)
    residual = np.square(rhs - U[:, kept] @ (turn @ along) - U[:, other] @ beyond).sum()
    possible = min(residual / ((1.0 - spent) * of_noise), 1.0) if spent < 1.0 and of_noise > 0.0 else 1.0
    shares = possible * shares
    of_forces = possible * of_forces
    scales = [column for column, size in prior.reading_noise.items() if size > 0.0]
    of_readings = noise_gram[scales, scales] @ np.square((whitening @ turn)[scales])
    bound, lacking = _bound_of_readings(shares, possible * of_readings)
    shares = bound * shares
    of_forces = bound * of_forces
    if np.abs(shares).max(initial=0.0) < _NEGLIGIBLE:
        return CorrectedTriangle(R, NoiseShares.of(shares))
    remaining_share = np.clip(1.0 - shares, LEAST_SIGNAL, _MOST_SIGNAL)
    combinations = turn.T @ (values[kept, None] * Vh[kept] * size)
    target = along - of_forces
    remaining = ((shares > 1.0 - LEAST_SIGNAL) & (bound == 1.0)) * (remaining_share - np.maximum(1.0 - shares, 0.0))
    target += remaining * (combinations[:, : len(prior.nominal)] @ prior.nominal)
    best = whitening @ (turn @ (target / remaining_share))
    residual = np.linalg.norm(rhs - rows @ best - U[:, other] @ beyond)
    stacked = [
        np.column_stack([np.sqrt(remaining_share)[:, None] * combinations, target / np.sqrt(remaining_share)]),
        np.column_stack([values[other, None] * Vh[other] * size, beyond]),
        np.append(np.zeros_like(size), residual)[None],
        np.zeros((len(R) - 1 - len(target) - len(beyond), R.shape[1])),
    ]
    noise = NoiseShares.of(shares + lacking)
    triangle = np.asarray(np.linalg.qr(np.concatenate(stacked), mode="r"))
    if not noise.lost:
        return CorrectedTriangle(triangle, noise)
    deviations = np.where(np.isin(range(len(best)), scales), np.maximum(np.abs(1.0 + best), 1.0), best)
    shrinkage = ((remaining + lacking) / remaining_share)[:, None] * combinations
    count = len(prior.nominal)
    units = np.hstack([shrinkage[:, :count] @ prior.spread, shrinkage[:, count:] * deviations[count:]])
    return CorrectedTriangle(triangle, noise, whitening @ turn @ units)


def _bound_of_readings(shares: Array, of_readings: Array) -> tuple[Array, Array]:
    """Factors of shares of noise, mostly that of readings, beyond what is taken off, and how much is left in for that.

    Noise of readings draws their scales towards 0, not to the nominal 1 that makes up for other noise.
    """
    most = np.minimum((1.0 - LEAST_SIGNAL) / np.maximum(shares, 0.5), 1.0)
    bound = np.where(of_readings > 0.5 * shares, most, 1.0)
    return bound, np.minimum(shares, 1.0) - np.minimum(bound * shares, 1.0)
