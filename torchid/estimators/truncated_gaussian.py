"""Draws from a Gaussian that conditions cut off: chains for what conditions nearby concern, the rest given that."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from torchid.estimators.barrier_gaussian import BarrierGaussian, barrier_gaussian
from torchid.estimators.conic_problem import ConicProblem
from torchid.estimators.elliptical_slice import EllipticalSlice, inside
from torchid.parallel import run_in_workers
from torchid.parameters import Array
from torchid.problem.chunks import worker_count

_CHAINS, _BATCHES = 512, 2  # chains of a batch, which one thread works on, and batches at most


class TruncatedGaussian(torch.nn.Module):
    """Draws from exp(-objective / 2) of a conic problem, within its conditions.

    Few conditions are near: most often bounds of friction and armatures, and a body or two. The variables that these
    concern, and those of equalities, are sampled by chains (`EllipticalSlice`) in their marginal density, cut off by
    the conditions on them; all others have a Gaussian given these, which is drawn exactly. A draw that breaks one of
    the conditions that are far, which is rare, is dropped, chain's state and all.

    Attributes:
        chains: of the variables that conditions nearby concern; None where there are none.
        near: number of conditions nearby; `conditions`: of all.
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
        """Prepare.

        Args:
            conic: the problem, without log-determinants in its objective.
            owners: (n,) int, to which body each variable belongs.

        Raises:
            InputError: the conditions exclude each other.

        Warns:
            NumericalWarning: states of chains stay alike for too long, so that draws will be correlated.
        """
        super().__init__()
        gaussian = barrier_gaussian(conic)
        split = _Split.of(conic, gaussian)
        self.near, self.conditions = int(gaussian.near.sum()), len(gaussian.near)
        self.chains = None
        if len(split.near):
            self.chains = EllipticalSlice(*split.marginal(conic, gaussian), owners[split.near])
        blocks, rows = split.blocks, split.rows
        arrays = {
            "mean": gaussian.mean,
            "near_variables": split.near,
            "far_variables": split.far,
            **split.given(conic),
            "block_changes": gaussian.blocks[~blocks].reshape(-1, len(gaussian.mean)),
            "row_changes": gaussian.rows[~rows],
            "unit": np.eye(4)[np.triu_indices(4)][:, None],
        }
        for name, array in arrays.items():
            self.register_buffer(name, torch.from_numpy(np.ascontiguousarray(array)))

    def draw(self, count: int, generator: torch.Generator | None = None) -> Tensor:
        """Points x, (count, n), on the device of the module; they do not depend on the number of threads.

        Args:
            count: number of them.
            generator: of random numbers, on that device; None for torch's own.
        """
        device, batches = self.mean.device, max(1, min(_BATCHES, count // _CHAINS))
        seeds = torch.randint(2**62, (batches,), generator=generator, device=device).tolist()
        counts = [count * (k + 1) // batches - count * k // batches for k in range(batches)]
        tasks = list(enumerate(zip(counts, seeds, strict=True)))
        threads = worker_count(device)
        done = run_in_workers(tasks, lambda part: [(number, self._batch(*of)) for number, of in part], threads)
        drawn = dict(pair for pairs in done for pair in pairs)
        return torch.cat([drawn[k] for k in range(batches)], dim=1).T.contiguous()

    def _batch(self, count: int, seed: int) -> Tensor:
        """Points (n, count)."""
        generator, found, out = torch.Generator(self.mean.device).manual_seed(seed), 0, []
        for near in self._states(min(count, _CHAINS), generator):
            out.append(self._completed(near, generator))
            found += out[-1].shape[1]
            if found >= count:
                break
        return torch.cat(out, dim=1)[:, :count]

    def _states(self, chains: int, generator: torch.Generator) -> Iterator[Tensor]:
        """Of the variables that chains sample, (c, chains), without end."""
        if self.chains is not None:
            yield from self.chains.states(chains, generator)
        while True:
            yield self.mean.new_empty(0, chains)

    def _completed(self, near: Tensor, generator: torch.Generator) -> Tensor:
        """Points (n, B or fewer) of which a part is given, (c, B): those that meet all conditions."""
        x = self.mean.new_empty(len(self.mean), near.shape[1])
        size = (len(self.far_mean), near.shape[1])
        drawn = torch.randn(size, dtype=x.dtype, device=x.device, generator=generator)
        x[self.near_variables] = near
        x[self.far_variables] = self.far_mean[:, None] + self.far_gain @ near + self.far_root @ drawn
        change = x - self.mean[:, None]
        blocks = (self.block_changes @ change).view(-1, 10, x.shape[1]) + self.unit
        return x[:, inside(blocks, self.row_changes @ change)]


@dataclass(frozen=True)
class _Split:
    """Which variables and conditions are left to chains.

    Attributes:
        near, far: variables that conditions nearby or equalities concern, and the others.
        blocks, rows: (K,), (M,) bool, the conditions on the former alone.
        triangle: (n, n + 1), the upper triangular root and the target of the quadratic, `far` before `near`.
    """

    near: np.ndarray
    far: np.ndarray
    blocks: np.ndarray
    rows: np.ndarray
    triangle: Array

    @classmethod
    def of(cls, conic: ConicProblem, gaussian: BarrierGaussian) -> _Split:
        near_blocks, near_rows = np.split(gaussian.near, [len(conic.F0)])
        chosen = conic.G[near_rows].any(axis=0) | conic.E.any(axis=0)
        chosen[conic.variables[near_blocks]] = True
        near, far = np.flatnonzero(chosen), np.flatnonzero(~chosen)
        columns = np.column_stack([conic.root[:, far], conic.root[:, near], conic.target])
        triangle = np.asarray(np.linalg.qr(columns, mode="r"))
        blocks, rows = chosen[conic.variables].all(axis=1), ~conic.G[:, far].any(axis=1)
        return cls(near, far, np.asarray(blocks), np.asarray(rows), triangle)

    def marginal(self, conic: ConicProblem, gaussian: BarrierGaussian) -> tuple[ConicProblem, BarrierGaussian]:
        """The problem of the variables that chains sample, whatever the others are, and its Gaussian."""
        place, first, last = np.zeros(len(conic.linear), dtype=np.int64), len(self.far), len(conic.linear)
        place[self.near] = np.arange(len(self.near))
        kept = np.concatenate([self.blocks, self.rows])
        problem = replace(
            conic,
            root=self.triangle[first:last, first:last],
            target=self.triangle[first:last, last],
            linear=conic.linear[self.near],
            F0=conic.F0[self.blocks],
            F=conic.F[self.blocks],
            variables=place[conic.variables[self.blocks]],
            weights=conic.weights[self.blocks],
            G=conic.G[self.rows][:, self.near],
            h=conic.h[self.rows],
            E=conic.E[:, self.near],
            names=tuple(name for name, keep in zip(conic.names, kept, strict=True) if keep),
            deviations=conic.deviations[:, self.near],
        )
        return problem, gaussian.marginal(self.near, self.blocks, self.rows)

    def given(self, conic: ConicProblem) -> dict[str, Array]:
        """The Gaussian of the others given the former: mean `far_mean + far_gain @ near` and root of the covariance."""
        first, last = len(self.far), len(conic.linear)
        root, wanted = self.triangle[:first, :first], self.triangle[:first, first : last + 1]
        solved = scipy.linalg.solve_triangular(root, np.column_stack([wanted, np.eye(first)]))
        coupled, mean, far_root = np.split(solved, [last - first, last - first + 1], axis=1)
        return {"far_mean": mean[:, 0], "far_gain": -coupled, "far_root": far_root}
