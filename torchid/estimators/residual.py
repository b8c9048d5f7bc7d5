"""A residual module beside the rigid bodies: the choice of its weight, and its share of the force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import nn

from torchid.estimators.least_squares import LeastSquares
from torchid.estimators.sgd import Loss
from torchid.parameters import INERTIAL, PER_BODY, Array
from torchid.problem import LinearProblem, MiniBatches

CANDIDATE_WEIGHTS = (10.0, 1.0, 0.1, 0.01, 0.001, 0.0)
"""Candidate weights: a module that can fit any force fits the share 1 / (1 + weight) of the residual."""


@dataclass(frozen=True)
class WeightChoice:
    """The weight of a residual module, chosen by its predictions of held-out samples.

    Attributes:
        weight: the largest whose held-out loss is at most one standard error above the least.
        candidates: weights that were tried, descending.
        losses: of each, the held-out mean squared whitened residual.
        standard_error: of the least loss, over blocks of time.
        alone: the held-out loss of rigid bodies without the module.
        alone_converged: whether their descent had converged: only then is a smaller loss the module's gain.
    """

    weight: float
    candidates: tuple[float, ...]
    losses: tuple[float, ...]
    standard_error: float
    alone: float
    alone_converged: bool = True

    @property
    def gain(self) -> float | None:
        """Share of the loss of rigid bodies alone that the module takes away; None where that has not converged."""
        return 1.0 - self.losses[self.candidates.index(self.weight)] / self.alone if self.alone_converged else None


def choose_weight(candidates: Sequence[float], losses: Array, alone: float) -> WeightChoice:
    """The largest weight that is not significantly worse than the best: the one-standard-error rule.

    Args:
        candidates: W weights.
        losses: (W, blocks) held-out losses, at least two blocks; infinite where the descent diverged.
        alone: held-out loss without the module.

    Source: Breiman, Friedman, Olshen, Stone, "Classification and Regression Trees", 1984, section 3.4.3.
    """
    means = losses.mean(axis=1)
    best = int(np.argmin(means))
    error = float(losses[best].std(ddof=1) / np.sqrt(losses.shape[1]))
    good = [weight for weight, mean in zip(candidates, means, strict=True) if mean <= means[best] + error]
    return WeightChoice(max(good), tuple(candidates), tuple(means.tolist()), error, alone)


@dataclass(frozen=True)
class ResidualEffect:
    """Effect of a residual module on force and parameters, on the training samples.

    Attributes:
        weight: under which it was trained.
        choice: how the weight was chosen, None if it was given.
        rms: of the module's force by group, "base_force" [N], "base_moment" [N m], "joint_torque" [N m, N] and
            "limb_wrench" [N, N m].
        shares: by group, that rms over the rms of the whole force, rigid bodies and module together.
        rigid_share: rms of the part of the module's projected whitened force that rigid bodies can explain, over the
            rms of all of it.
        moved: (12 L,), change of the parameters by the module: the least squares estimate on the force less the
            module's part, minus that on the whole force.
        moved_scaled: (L,), the largest of each body's ten inertial parameters, in units of their scale.
        moved_errors: (L,), likewise in standard errors of the parameters that the data determine, NaN without any.
    """

    weight: float
    choice: WeightChoice | None
    rms: dict[str, float]
    shares: dict[str, float]
    rigid_share: float
    moved: Array
    moved_scaled: Array
    moved_errors: Array


def residual_effect(
    loss: Loss, problem: LinearProblem, batches: MiniBatches, estimator: LeastSquares, choice: WeightChoice | None
) -> ResidualEffect | None:
    """Effect of a loss's residual module; None without a module.

    Args:
        loss: with the current parameters and module.
        problem: the compressed samples.
        batches: the samples.
        estimator: for the estimates with and without the module's part.
        choice: how the weight was chosen.
    """
    if loss.residual is None:
        return None
    with loss.evaluating(), torch.no_grad():
        gradient, square = _correlation(loss, batches)
        rms, shares = _by_group(loss.residual, loss.learnable().cpu().numpy(), batches)
    free = problem.free
    explained = np.linalg.lstsq(problem.A[:, free].T, gradient[free], rcond=None)[
        0
    ]  # A^T explained = sum of K^T W W^T r
    plain, without_module = (estimator.solve(x) for x in (problem, replace(problem, b=problem.b - explained)))
    moved = without_module.phi - plain.phi
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = np.abs(moved) / np.where(plain.standard_error > 0.0, plain.standard_error, np.nan)
    return ResidualEffect(
        weight=loss.residual_weight or 0.0,
        choice=choice,
        rms=rms,
        shares=shares,
        rigid_share=float(np.linalg.norm(explained) / np.sqrt(square)) if square else 0.0,
        moved=moved,
        moved_scaled=_largest(np.abs(moved) / problem.scale),
        moved_errors=_largest(errors),
    )


def _correlation(loss: Loss, batches: MiniBatches) -> tuple[Array, float]:
    """K^T r over all whitened projected rows, (12 L,), and the sum of squares of r, the module's force."""
    phi = loss.learnable()
    total, square = torch.zeros_like(phi), 0.0
    for batch in batches.chunks():
        force = loss.forces(batch, phi)[1]
        if force is not None:
            total += batches.columns.T @ torch.einsum("bij,bi->j", batch.K, force)
            square += float(force.square().sum())
    return total.cpu().numpy(), square


def _by_group(module: nn.Module, phi: Array, batches: MiniBatches) -> tuple[dict[str, float], dict[str, float]]:
    """Rms of a module's force by group, and its share of the rms of the whole."""
    base_rows = batches.builder.tree.base_rows
    own: dict[str, float] = {}
    whole: dict[str, float] = {}
    for (q, v, a), rigid in batches.generalized_forces(phi):
        force = module(q, v, a)
        for name, rows in _groups(base_rows, v.shape[1], rigid.shape[1]).items():
            per_row = 1.0 / (batches.samples * (rows.stop - rows.start))
            for sums, part in ((own, force), (whole, rigid + force)):
                sums[name] = sums.get(name, 0.0) + per_row * float(part[:, rows].square().sum())
    shares = {name: float(np.sqrt(own[name] / x)) if x else 0.0 for name, x in whole.items()}
    return {name: float(np.sqrt(x)) for name, x in own.items()}, shares


def _groups(base_rows: int, nv: int, rows: int) -> dict[str, slice]:
    """Rows by group, without empty groups."""
    base = {"base_force": slice(0, 3), "base_moment": slice(3, 6)} if base_rows else {}
    groups = base | {"joint_torque": slice(base_rows, nv), "limb_wrench": slice(nv, rows)}
    return {name: rows for name, rows in groups.items() if rows.stop > rows.start}


def _largest(x: Array) -> Array:
    """Largest of each body's ten inertial entries, (L,), of (12 L,); NaN if all are."""
    by_body = x.reshape(-1, PER_BODY)[:, INERTIAL]
    return np.where(np.isnan(by_body).all(axis=1), np.nan, np.nan_to_num(by_body).max(axis=1))
