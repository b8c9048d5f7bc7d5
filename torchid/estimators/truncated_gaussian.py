"""Draws from a Gaussian that conditions cut off: chains for what conditions nearby concern, the rest given that."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from torchid.errors import NumericalWarning, warn
from torchid.estimators.conic import ConicProblem, PrimalDual, find_strictly_feasible
from torchid.parallel import one_thread, run_in_workers
from torchid.parameters import Array
from torchid.problem.chunks import worker_count

UPPER = np.triu_indices(4)
"""Rows and columns of the ten stored entries of a symmetric (4, 4) matrix."""

ENTRY_WEIGHTS = np.where(UPPER[0] == UPPER[1], 1.0, 2.0)
"""Number of times each stored entry is in the matrix, (10,)."""

CURVATURE = 0.25
"""Share of the barrier's Hessian in that of the Gaussian.

With all of it chains reach the tails too seldom: 40 000 draws of an exponential tail had a standard deviation 4 % too
small. With a quarter it is within 1 %, for as many passes.
"""

_RARE = 0.01  # a condition that excludes a larger fraction of draws counts as near
_DRAWS = 400
_PASSES = 6


@dataclass(frozen=True)
class BarrierGaussian:
    """N(mean, C C^T) for a density exp(-||R x - r||^2 / 2) within conditions F_k(x) >= 0, G x >= h, E x = e.

    `mean` minimizes ||R x - r||^2 / 2 - sum log det F_k(x) - sum log (G x - h), summed over the conditions that are
    near, and the covariance is the inverse of the Hessian there with a share `CURVATURE` of the barrier's. Of an
    exponential tail that a bound cuts off the mean is exactly right, and the standard deviation twice what it is.
    Without conditions nearby, it is the Gaussian itself.

    Attributes:
        mean: (n,), inside all conditions.
        root: (n, n), upper triangular, `root.T @ root` the inverse covariance.
        directions: C, (n, d), of the null space of E.
        blocks: (K, 10, n), change of the entries `UPPER` of J^-1/2 F_k(x) J^-1/2, where J = F_k(mean), by x.
        rows: (M, n), change of (G x - h) by x, relative to what it is at the mean.
        near: (K + M,) bool, the conditions that have a barrier.
    """

    mean: Array
    root: Array
    directions: Array
    blocks: Array
    rows: Array
    near: np.ndarray

    @property
    def covariance(self) -> Array:
        """(n, n)."""
        return self.directions @ self.directions.T

    def marginal(self, variables: np.ndarray, blocks: np.ndarray, rows: np.ndarray) -> BarrierGaussian:
        """The Gaussian of some variables, (m,) int, whatever the others are, some blocks, (K,), and rows, (M,) bool."""
        others = np.setdiff1d(np.arange(len(self.mean)), variables)
        triangle = np.asarray(np.linalg.qr(self.root[:, [*others, *variables]], mode="r"))
        directions = np.asarray(np.linalg.qr(self.directions[variables].T, mode="r")).T
        return BarrierGaussian(
            mean=self.mean[variables],
            root=triangle[len(others) :, len(others) :],
            directions=directions,
            blocks=self.blocks[blocks][:, :, variables],
            rows=self.rows[rows][:, variables],
            near=self.near[np.concatenate([blocks, rows])],
        )


@one_thread()
@torch.inference_mode()
def barrier_gaussian(conic: ConicProblem) -> BarrierGaussian:
    """The Gaussian for the density exp(-objective / 2) of a problem without log-determinants.

    Raises:
        InputError: the conditions exclude each other.
    """
    x, _ = find_strictly_feasible(conic)
    near = np.zeros(len(conic.F0) + len(conic.h), dtype=bool)
    for _ in range(_PASSES):
        mean = _mean(conic, x, near)
        outside = _outside(conic, mean[:, None])[:, 0]
        if not outside.any():
            directions = _gaussian_at(conic, mean, near).directions
            drawn = np.random.default_rng(0).normal(size=(directions.shape[1], _DRAWS))
            outside = _outside(conic, mean[:, None] + directions @ drawn).mean(axis=1) > _RARE
        if not (outside & ~near).any():
            break
        near |= outside
    else:
        near[:] = True
    return _gaussian_at(conic, _mean(conic, x, near), near)


def _mean(conic: ConicProblem, x: Array, near: np.ndarray) -> Array:
    """Where the density times the barriers of some conditions is largest, from a point inside all."""
    blocks, rows = np.split(near, [len(conic.F0)])
    part = replace(
        conic,
        F0=conic.F0[blocks],
        F=conic.F[blocks],
        variables=conic.variables[blocks],
        weights=conic.weights[blocks],
        G=conic.G[rows],
        h=conic.h[rows],
    )
    return PrimalDual(part).centre(x, 2.0)


def _outside(conic: ConicProblem, x: Array) -> np.ndarray:
    """Whether points (n, B) break each condition, (K + M, B)."""
    blocks = conic.F0[:, None] + np.einsum("kvb,kvij->kbij", x[conic.variables], conic.F)
    return np.concatenate([np.linalg.eigvalsh(blocks)[..., 0] <= 0.0, conic.G @ x <= conic.h[:, None]])


def _gaussian_at(conic: ConicProblem, mean: Array, near: np.ndarray) -> BarrierGaussian:
    """The Gaussian of a minimizer; LinAlgError where rounding says that this is not inside all conditions."""
    count = len(conic.F0)
    n = len(conic.linear)
    inverse = np.linalg.inv(np.linalg.cholesky(conic.blocks(mean)))[:, None]
    slack = conic.G @ mean - conic.h
    if not (slack > 0.0).all():
        raise np.linalg.LinAlgError("rounding moved a point outside the conditions")
    slopes = (inverse @ conic.F @ np.swapaxes(inverse, 2, 3))[:, :, UPPER[0], UPPER[1]]
    blocks = np.zeros((count, len(ENTRY_WEIGHTS), n))
    rows = conic.G / slack[:, None]
    np.put_along_axis(blocks, conic.variables[:, None], np.swapaxes(slopes, 1, 2), axis=2)
    of_blocks = (blocks[near[:count]] * np.sqrt(CURVATURE * ENTRY_WEIGHTS)[:, None]).reshape(-1, n)
    of_rows = np.sqrt(CURVATURE) * rows[near[count:]]
    root = np.asarray(np.linalg.qr(np.concatenate([conic.root, of_blocks, of_rows]), mode="r"))
    reduced = np.linalg.qr(root @ conic.null_space, mode="r")
    directions = scipy.linalg.solve_triangular(reduced, conic.null_space.T, trans=1).T
    return BarrierGaussian(mean, root, directions, blocks, rows, near)


_CHAINS = 512  # to measure how many passes make a state independent
_TRIES = (3, 6, 15)  # on an ellipse, at once, after which a chain stays where it is; each halves the arc
_INSIDE = 1e-12  # least pivot of a block and slack of a row, relative to the mean's: above what rounding can hide
_ALIKE = 0.25  # correlation of a coordinate with its start below which states count as independent
_MOST = 200  # passes after which moves of pairs count as too slow
_BURN_IN = 4  # times the passes that make a state independent, before the first sample
# of draws from the Gaussian that are outside, towards its mean
_SHRINK = 0.8
_SHRINKS = 200
_DIAGONAL = tuple(np.flatnonzero(UPPER[0] == UPPER[1]).tolist())


@dataclass(frozen=True)
class _Group:
    """Variables that move together: `spread @ y`, y of unit variance where all others are fixed.

    `basis`: (n, d), orthonormal columns of the Gaussian's root; `change`: of the entries of the blocks, 10 for each of
    them, and of the rows.
    """

    variables: Tensor
    spread: Tensor
    basis: Tensor
    change: Tensor
    blocks: Tensor
    rows: Tensor


@dataclass
class _State:
    """Points of B chains, all relative to the mean: x (n, B), root @ x, entries of blocks (K, 10, B), rows (M, B)."""

    x: Tensor
    whitened: Tensor
    blocks: Tensor
    rows: Tensor


class EllipticalSlice(torch.nn.Module):
    """Draws from exp(-objective / 2) of a conic problem, within its conditions.

    The Gaussian's density is constant along an ellipse through the state and a draw from the Gaussian. So a point on
    the ellipse needs only to meet the conditions and the remaining density factor (`BarrierGaussian`); the arc is
    shortened until one does. If the conditions are far, all variables move together, otherwise two bodies at a time.
    The kind of move, and the number of passes for an independent state, are measured once, on a first set of chains.

    Source: Murray, Adams, MacKay, "Elliptical slice sampling", AISTATS 2010; with a chosen Gaussian: Nishihara, Murray,
    Adams, "Parallel MCMC with generalized elliptical slice sampling", JMLR 2014.
    """

    mean: Tensor
    root: Tensor
    directions: Tensor
    block_variables: Tensor
    block_changes: Tensor
    row_changes: Tensor
    near: Tensor
    weights: Tensor
    unit: Tensor

    def __init__(self, gaussian: BarrierGaussian, variables: np.ndarray, E: Array, owners: np.ndarray) -> None:
        """Measure the moves.

        Args:
            gaussian: approximation of the problem.
            variables: (K, 10) int, of the blocks.
            E: (Q, n), of the equalities.
            owners: (n,) int, body of each variable.

        Warns:
            NumericalWarning: states stay correlated for too long, so draws will be correlated.
        """
        super().__init__()
        arrays = {
            "mean": gaussian.mean,
            "root": gaussian.root,
            "directions": gaussian.directions,
            "block_variables": variables,
            "block_changes": np.take_along_axis(gaussian.blocks, variables[:, None], axis=2),
            "row_changes": gaussian.rows,
            "near": gaussian.near.astype(np.float64),
            "weights": ENTRY_WEIGHTS[:, None],
            "unit": (UPPER[0] == UPPER[1]).astype(np.float64)[:, None],
        }
        for name, array in arrays.items():
            self.register_buffer(name, torch.from_numpy(np.ascontiguousarray(array)))
        self._groups = 0
        for moving in (np.arange(len(owners)), *_pairs(gaussian, owners)):
            self._add_group(gaussian, E, moving)
        self.moved = 1  # groups that move in a pass, the first one all variables together
        self.passes = 1
        self._measure()

    def _add_group(self, gaussian: BarrierGaussian, E: Array, variables: np.ndarray) -> None:
        _, values, Vt = np.linalg.svd(E[:, variables])
        basis = Vt[int((values > 1e-10).sum()) :].T  # of what equalities leave them
        if not basis.shape[1]:
            return
        Q, R = np.linalg.qr(gaussian.root[:, variables] @ basis)
        spread = basis @ np.linalg.inv(R)
        blocks = np.flatnonzero(gaussian.blocks[:, :, variables].any(axis=(1, 2)))
        rows = np.flatnonzero(gaussian.rows[:, variables].any(axis=1))
        of_blocks = gaussian.blocks[blocks][:, :, variables].reshape(-1, len(variables))
        change = np.concatenate([of_blocks, gaussian.rows[rows][:, variables]]) @ spread
        for name, array in zip(_Group.__annotations__, (variables, spread, Q, change, blocks, rows), strict=True):
            self.register_buffer(f"{name}_{self._groups}", torch.from_numpy(np.ascontiguousarray(array)))
        self._groups += 1

    def states(self, chains: int, generator: torch.Generator) -> Iterator[Tensor]:
        """Yield independent points x of all chains, (n, chains), on the device of the module."""
        state = self._start(chains, generator)
        for _ in range(_BURN_IN * self.passes):
            self._pass(state, generator)
        while True:
            yield self.mean[:, None] + state.x
            for _ in range(self.passes):
                self._pass(state, generator)

    @one_thread()
    @torch.no_grad()
    def _measure(self) -> None:
        """Find out which moves it takes, and how many, until states are new."""
        generator = torch.Generator().manual_seed(0)
        for moved, most in ((1, 5 + self._groups), (self._groups, _MOST)):  # a pass of pairs is as many moves
            self.moved = moved
            state = self._start(_CHAINS, generator)
            for _ in range(2):
                self._pass(state, generator)
            first = _standardized(state.x)
            for self.passes in range(1, most + 1):
                self._pass(state, generator)
                alike = float((first * _standardized(state.x)).mean(dim=1).max()) if len(state.x) else 0.0
                if alike <= _ALIKE:
                    return
        message = f"the sampler mixes slowly: correlation {alike:.2g} after {_MOST} passes"
        warn(f"estimator: {message}. The samples vary too little", NumericalWarning)

    def _start(self, chains: int, generator: torch.Generator | None) -> _State:
        """Draws from the Gaussian, those outside of the conditions moved to the mean until they are inside."""
        size = (self.directions.shape[1], chains)
        x = self.directions @ torch.randn(size, dtype=torch.float64, device=self.mean.device, generator=generator)
        state = self._at(x)
        share = x.new_ones(chains)
        for _ in range(_SHRINKS):
            fits = inside(state.blocks + self.unit, state.rows)
            if bool(fits.all()):
                return state
            share = torch.where(fits, share, _SHRINK * share)
            state = self._at(x * share)
        return self._at(torch.zeros_like(x))

    def _at(self, x: Tensor) -> _State:
        return _State(x, self.root @ x, self.block_changes @ x[self.block_variables], self.row_changes @ x)

    def _pass(self, state: _State, generator: torch.Generator | None) -> None:
        """One move of all variables together, or of one pair of bodies after the other while the others rest."""
        for number in reversed(range(min(self.moved, self._groups))):
            self._move(state, self._group(number), generator)

    def _group(self, number: int) -> _Group:
        return _Group(*(getattr(self, f"{name}_{number}") for name in _Group.__annotations__))

    def _move(self, state: _State, group: _Group, generator: torch.Generator | None) -> None:
        centre = -(group.basis.T @ state.whitened)  # of y, which is 0 at the state
        drawn = torch.randn(centre.shape, dtype=torch.float64, device=centre.device, generator=generator)
        blocks = state.blocks[group.blocks]
        rows = state.rows[group.rows]
        near = self.near[: len(state.blocks)][group.blocks], self.near[len(state.blocks) :][group.rows]
        cut = 10 * len(blocks)
        now = torch.cat([blocks.flatten(0, 1), rows])
        along = group.change @ centre
        across = group.change @ drawn
        angle = self._angle((now, along, across), cut, near, generator)
        versed = 1.0 - torch.cos(angle)
        sine = torch.sin(angle)
        y = centre * versed + drawn * sine
        changed = along * versed + across * sine
        state.x[group.variables] += group.spread @ y
        state.whitened += group.basis @ y
        state.blocks[group.blocks] += changed[:cut].view(-1, 10, changed.shape[1])
        state.rows[group.rows] += changed[cut:]

    def _angle(
        self,
        ellipse: tuple[Tensor, Tensor, Tensor],
        cut: int,
        near: tuple[Tensor, Tensor],
        generator: torch.Generator | None,
    ) -> Tensor:
        """Angles of the next states on ellipses, (B,), 0 where `_TRIES` have found none.

        Args:
            ellipse: entries of blocks and then rows, (10 K + M, B), at the state, by 1 - cos and by sin of the angle.
            cut: 10 K.
            near: which blocks and rows the Gaussian has barriers for.
            generator: of random numbers.
        """
        now, along, across = ellipse
        uniform = _uniform(now, generator)
        level = self._excess(now, cut, near) + torch.log(uniform())
        angle = 2.0 * math.pi * uniform()
        least = angle - 2.0 * math.pi
        most = angle
        out = torch.zeros_like(angle)
        chains = torch.arange(len(angle), device=angle.device)
        for count in _TRIES:
            tried = angle.new_empty(count, len(angle))
            for number in range(count):  # as if all before had failed, so that these need not be known to have
                tried[number] = angle
                least = torch.where(angle < 0.0, angle, least)
                most = torch.where(angle < 0.0, most, angle)
                angle = torch.lerp(least, most, _uniform(now, generator)())
            versed = 1.0 - torch.cos(tried)
            sine = torch.sin(tried)
            there = (now[:, None] + along[:, None] * versed + across[:, None] * sine).flatten(1)
            fits = inside(there[:cut].view(-1, 10, there.shape[1]) + self.unit, there[cut:])
            fits &= self._excess(there, cut, near) >= level.repeat(count)
            failed = (~fits).view(count, -1).to(torch.int64).cumprod(0).sum(0)  # before the first that fits
            fitting = torch.nonzero(failed < count)[:, 0]
            out[chains[fitting]] = tried[failed[fitting], fitting]
            failing = torch.nonzero(failed == count)[:, 0]
            if not len(failing):
                break
            chains, level, angle, least, most = (x[failing] for x in (chains, level, angle, least, most))
            now, along, across = (x.index_select(1, failing) for x in (now, along, across))
        return out

    def _excess(self, entries: Tensor, cut: int, near: tuple[Tensor, Tensor]) -> Tensor:
        """Logarithm of the density over that of the Gaussian, up to a constant, (B,).

        With E = J^-1/2 F_k J^-1/2 - 1 of a block that has a barrier it is ||E||^2 / 2 - tr E, and likewise of a row.
        """
        blocks = entries[:cut].view(-1, 10, entries.shape[1])
        rows = entries[cut:]
        of_blocks = 0.5 * CURVATURE * (self.weights * blocks.square()).sum(1) - blocks[:, _DIAGONAL].sum(1)
        return near[0] @ of_blocks + near[1] @ (0.5 * CURVATURE * rows.square() - rows)


def _uniform(like: Tensor, generator: torch.Generator | None) -> Callable[[], Tensor]:
    """Draws of uniform numbers, one for each column."""
    return lambda: torch.rand(like.shape[1], dtype=like.dtype, device=like.device, generator=generator)


def inside(blocks: Tensor, rows: Tensor) -> Tensor:
    """Where all blocks, (K, 10, B), are positive definite, and all rows, (M, B), above -1: (B,) bool."""
    a, b, c, d, e, f, g, h, i, j = blocks.unbind(1)  # rows a b c d, e f g, h i, j of the upper triangle
    first = 1.0 / a
    e = e - b * b * first
    f = f - b * c * first
    g = g - b * d * first
    h = h - c * c * first
    i = i - c * d * first
    j = j - d * d * first
    second = 1.0 / e
    h = h - f * f * second
    i = i - f * g * second
    j = j - g * g * second
    last = j - i * i / h
    pivots = torch.minimum(torch.minimum(a, e), torch.minimum(h, last))  # NaN where one before is 0
    return (pivots > _INSIDE).all(0) & (rows > _INSIDE - 1.0).all(0)


def _standardized(x: Tensor) -> Tensor:
    """Coordinates (n, B) with mean 0 and variance 1 over the chains; constant ones are 0."""
    centred = x - x.mean(dim=1, keepdim=True)
    deviation = centred.square().mean(dim=1, keepdim=True).sqrt()
    return torch.where(deviation > 0.0, centred / deviation, 0.0)


def _pairs(gaussian: BarrierGaussian, owners: np.ndarray) -> list[np.ndarray]:
    """Variables of the most correlated pairs of bodies: the edges of the best spanning tree."""
    bodies = np.unique(owners)
    deviation = np.linalg.norm(gaussian.directions, axis=1)
    scaled = gaussian.directions / np.where(deviation > 0.0, deviation, 1.0)[:, None]
    member = (owners[:, None] == bodies).astype(np.float64)
    together = member.T @ np.square(scaled @ scaled.T) @ member
    inside = [0]
    outside = list(range(1, len(bodies)))
    pairs = []
    while outside:
        row, column = np.unravel_index(int(together[np.ix_(inside, outside)].argmax()), (len(inside), len(outside)))
        pairs.append((inside[row], outside[column]))
        inside.append(outside.pop(int(column)))
    return [np.flatnonzero(np.isin(owners, bodies[list(pair)])) for pair in pairs]


# chains of a batch, which one thread works on, and batches at most
_BATCH_CHAINS = 512
_BATCHES = 2


class TruncatedGaussian(torch.nn.Module):
    """Draws from exp(-objective / 2) of a conic problem, within its conditions.

    Usually few conditions are near: bounds of friction and armatures, and one or two bodies. Chains (`EllipticalSlice`)
    sample the variables of these conditions, and of equalities, from their truncated marginal density. All other
    variables are Gaussian given these and are drawn exactly. A draw that violates a far condition (rare) is dropped.

    Attributes:
        chains: of the variables of near conditions; None without any.
        near: number of near conditions.
        conditions: number of all conditions.
    """

    mean: Tensor
    near_variables: Tensor
    far_variables: Tensor
    far_mean: Tensor
    far_root: Tensor
    far_gain: Tensor
    block_changes: Tensor
    row_changes: Tensor
    unit: Tensor

    def __init__(self, conic: ConicProblem, owners: np.ndarray) -> None:
        """Find the near conditions and set up the chains.

        Args:
            conic: the problem, without log-determinants in its objective.
            owners: (n,) int, body of each variable.

        Raises:
            InputError: the conditions contradict each other.

        Warns:
            NumericalWarning: states stay correlated for too long, so draws will be correlated.
        """
        super().__init__()
        gaussian = barrier_gaussian(conic)
        self.near = int(gaussian.near.sum())
        self.conditions = len(gaussian.near)
        near_blocks, near_rows = np.split(gaussian.near, [len(conic.F0)])
        is_near = conic.G[near_rows].any(axis=0) | conic.E.any(axis=0)
        is_near[conic.variables[near_blocks]] = True
        near = np.flatnonzero(is_near)
        far = np.flatnonzero(~is_near)
        blocks = np.asarray(is_near[conic.variables].all(axis=1))
        rows = np.asarray(~conic.G[:, far].any(axis=1))
        self.chains = None
        if len(near):
            variables = (np.cumsum(is_near) - 1)[conic.variables[blocks]]
            marginal = gaussian.marginal(near, blocks, rows)
            self.chains = EllipticalSlice(marginal, variables, conic.E[:, near], owners[near])
        columns = np.column_stack([conic.root[:, far], conic.root[:, near], conic.target])
        triangle = np.asarray(np.linalg.qr(columns, mode="r"))[: len(far)]
        given = np.column_stack([triangle[:, len(far) :], np.eye(len(far))])
        solved = scipy.linalg.solve_triangular(triangle[:, : len(far)], given)
        coupled, far_mean, far_root = np.split(solved, [len(near), len(near) + 1], axis=1)
        arrays = {
            "mean": gaussian.mean,
            "near_variables": near,
            "far_variables": far,
            "far_mean": far_mean[:, 0],
            "far_gain": -coupled,
            "far_root": far_root,
            "block_changes": gaussian.blocks[~blocks].reshape(-1, len(gaussian.mean)),
            "row_changes": gaussian.rows[~rows],
            "unit": np.eye(4)[np.triu_indices(4)][:, None],
        }
        for name, array in arrays.items():
            self.register_buffer(name, torch.from_numpy(np.ascontiguousarray(array)))

    def draw(self, count: int, generator: torch.Generator | None = None) -> Tensor:
        """Draw points x, (count, n), on the device of the module; independent of the number of threads.

        Args:
            count: number of points.
            generator: of random numbers, on that device; None for torch's default.
        """
        device = self.mean.device
        batches = max(1, min(_BATCHES, count // _BATCH_CHAINS))
        seeds = torch.randint(2**62, (batches,), generator=generator, device=device).tolist()
        counts = [count * (k + 1) // batches - count * k // batches for k in range(batches)]
        tasks = list(enumerate(zip(counts, seeds, strict=True)))
        threads = worker_count(device)
        done = run_in_workers(tasks, lambda part: [(number, self._batch(*batch)) for number, batch in part], threads)
        drawn = dict(pair for pairs in done for pair in pairs)
        return torch.cat([drawn[k] for k in range(batches)], dim=1).T.contiguous()

    def _batch(self, count: int, seed: int) -> Tensor:
        """Points (n, count)."""
        generator = torch.Generator(self.mean.device).manual_seed(seed)
        drawn = 0
        out = []
        for near in self._states(min(count, _BATCH_CHAINS), generator):
            out.append(self._completed(near, generator))
            drawn += out[-1].shape[1]
            if drawn >= count:
                break
        return torch.cat(out, dim=1)[:, :count]

    def _states(self, chains: int, generator: torch.Generator) -> Iterator[Tensor]:
        """Of the variables that chains sample, (c, chains), without end."""
        if self.chains is not None:
            yield from self.chains.states(chains, generator)
        while True:
            yield self.mean.new_empty(0, chains)

    def _completed(self, near: Tensor, generator: torch.Generator) -> Tensor:
        """Complete points from a part, (c, B): those, (n, B or fewer), that meet all conditions."""
        x = self.mean.new_empty(len(self.mean), near.shape[1])
        size = (len(self.far_mean), near.shape[1])
        drawn = torch.randn(size, dtype=x.dtype, device=x.device, generator=generator)
        x[self.near_variables] = near
        x[self.far_variables] = self.far_mean[:, None] + self.far_gain @ near + self.far_root @ drawn
        change = x - self.mean[:, None]
        blocks = (self.block_changes @ change).view(-1, 10, x.shape[1]) + self.unit
        return x[:, inside(blocks, self.row_changes @ change)]
