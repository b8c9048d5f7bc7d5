"""What a descent goes down: the mean squared whitened residual, prior and penalties, with or without a module."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchid.estimators.learnable import LearnableParameters
from torchid.estimators.penalties import penalties
from torchid.estimators.sgd import Sgd
from torchid.problem.batches import Batch, MiniBatches
from torchid.problem.linear import LinearProblem


@dataclass(frozen=True)
class Terms:
    """Terms of the loss of a batch, and sums of squares of its projected whitened forces, both by name."""

    losses: dict[str, Tensor]
    squares: dict[str, Tensor]

    def total(self) -> Tensor:
        """Sum of the terms."""
        return torch.stack(list(self.losses.values())).sum()

    def plus(self, other: Terms, share: float) -> Terms:
        """These and those of another batch, which holds this share of the samples, without their gradients."""
        losses = {name: self.losses.get(name, 0.0) + share * x.detach() for name, x in other.losses.items()}
        return Terms(losses, {name: self.squares.get(name, 0.0) + x for name, x in other.squares.items()})


class Loss(nn.Module):
    """The loss of a batch, such that its mean over an epoch is the loss of all samples.

    Attributes:
        learnable: parameters of the bodies.
        residual: module r(q, v, a) -> (B, nv) [N, N m] whose output adds to K phi, or None.
        residual_weight: of the mean square of the module's whitened force; None, which counts as 0, until it is chosen.
    """

    def __init__(
        self,
        settings: Sgd,
        problem: LinearProblem,
        batches: MiniBatches,
        learnable: LearnableParameters,
        residual: nn.Module | None,
    ) -> None:
        """Fix what is trained on which logs."""
        super().__init__()
        self.settings = settings
        self.learnable, self.residual = learnable, residual
        self.residual_weight = settings.residual_weight
        self._columns = batches.columns
        self._per_row = batches.samples / max(problem.rows, 1)
        self.register_buffer(
            "_bodies", torch.from_numpy(problem.free_bodies()).to(batches.columns.device), persistent=False
        )

    def forward(self, batch: Batch) -> Terms:
        """Terms of one batch."""
        settings, phi = self.settings, self.learnable()
        rigid, other = self.forces(batch, phi)
        share = self._per_row / len(batch)
        misfit = (rigid if other is None else rigid + other) - batch.f
        losses = {"data": share * misfit.square().sum()}
        if settings.ridge:
            deviation = (phi - self.learnable.nominal) / self.learnable.scale
            losses["prior"] = settings.ridge * deviation.square().sum()
        if settings.consistency == "penalties":
            scaled, bodies = self.learnable.by_body(phi), self.get_buffer("_bodies")
            losses |= penalties(scaled, bodies, settings.margin, settings.penalties)
        forces = {"rigid_body": rigid, "measured": batch.f}
        if other is not None:
            forces["residual"] = other
            if self.residual_weight:
                losses["residual"] = self.residual_weight * share * other.square().sum()
        return Terms(losses, {name: x.detach().square().sum() for name, x in forces.items()})

    def forces(self, batch: Batch, phi: Tensor) -> tuple[Tensor, Tensor | None]:
        """Whitened projected forces, (B, nv), of parameters (12 L,) and of the residual module."""
        rigid = batch.K @ (self._columns @ phi)
        if self.residual is None:
            return rigid, None
        r = self.residual(batch.q, batch.v, batch.a)
        if r.shape != batch.f.shape:
            raise ValueError(f"residual: found a force of shape {tuple(r.shape)}; accepted: {tuple(batch.f.shape)}")
        return rigid, (batch.W.mT @ r[..., None])[..., 0]

    @torch.no_grad()
    def mean_square(self, batches: MiniBatches) -> float:
        """Mean squared whitened residual over all rows of some logs, the module evaluating."""
        total, rows, phi = 0.0, 0, self.learnable()
        with self.evaluating():
            for batch in batches.chunks():
                rigid, other = self.forces(batch, phi)
                misfit = (rigid if other is None else rigid + other) - batch.f
                total, rows = total + float(misfit.square().sum()), rows + batch.rows
        return total / max(rows, 1)

    @contextmanager
    def evaluating(self) -> Iterator[None]:
        """The module evaluates, and trains again afterwards if it did before."""
        training = self.training
        self.eval()
        try:
            yield
        finally:
            self.train(training)
