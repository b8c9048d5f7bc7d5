"""Mini-batch descent: settings, penalties, loss, and the check of a saved state."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from torchid import distributed, parameters
from torchid.estimators.conditions import Conditions
from torchid.estimators.conic_formulation import Prior, build_conic_problem
from torchid.estimators.conic_loss import ConicLoss
from torchid.estimators.conic_problem import ConicProblem
from torchid.estimators.learnable import LearnableParameters
from torchid.estimators.least_squares import Regularized
from torchid.estimators.optimizers import try_out
from torchid.problem import Batch, LinearProblem, MiniBatches
from torchid.reprs import short_repr
from torchid.settings import Count, NamedClass, NotNegative, Positive, validate_settings

Consistency = Literal["log_cholesky", "penalties"]
ResidualMode = Literal["joint", "parameters_first", "alternating"]

_FREE = ("residual_weight", "weight_choice")  # entries of a saved state that are None before the first epoch
_LOGARITHMIC = 1e-4  # of an eigenvalue, below which a penalty goes on as a tangent of its logarithm
_SCHEDULED = ("lr", "momentum", "betas")  # options of optimizer groups that schedules change


@dataclass(frozen=True)
class PenaltyWeights:
    """Weights of the penalties beside the mean squared whitened residual.

    Attributes:
        eigenvalue: squares of the shortfall of scaled pseudo-inertias' eigenvalues from the margin.
        log_det: minus the logarithms of these eigenvalues less the margin, a barrier.
        mass: squares of negative masses, in units of their scale.
        friction: squares of negative friction, in units of its scale.
    """

    eigenvalue: NotNegative = 10.0
    log_det: NotNegative = 0.0
    mass: NotNegative = 10.0
    friction: NotNegative = 10.0

    def __post_init__(self) -> None:
        validate_settings(self)

    @property
    def curvature(self) -> float:
        """Bound of the second derivatives, in units of the scale; off-diagonal entries of a matrix count twice."""
        return 2.0 * (2.0 * self.eigenvalue + self.mass + self.friction)


@dataclass(frozen=True)
class TrainingSettings:
    """Optimizer, learning-rate schedule and stopping rule of a descent.

    Attributes:
        epochs: passes over the logs, at most.
        optimizer: name, one of `optimizer_names()`, and options of a class of `torch.optim`; defaults are those of
            `OPTIMIZERS`.
        schedule: name and options of a class of `torch.optim.lr_scheduler`, stepped once per epoch; None for none.
        patience: epochs without a better loss on the held-out logs after which training stops; None: never.
        clip: largest norm of a gradient.
        damping: of the preconditioner, in units of the mean squared whitened residual per squared scale.
        finish: after the last epoch, take the parameters of the least objective on all samples; None: do not. With
            "penalties", the most rounds of L-BFGS. Without held-out logs only, whose least loss is what to stop at.
    """

    epochs: Count = 200
    optimizer: NamedClass = field(default_factory=lambda: {"name": "Adam"})
    schedule: NamedClass | None = field(default_factory=lambda: {"name": "CosineAnnealingLR"})
    patience: Count | None = None
    clip: Positive = 1.0
    damping: Positive = 1.0
    finish: Count | None = 40

    def try_out(self) -> None:
        """Test optimizer and schedule on a parabola, so that invalid options fail before any work.

        Raises:
            UnknownNameError: an optimizer or a schedule that torch does not have.
            InputError: options, or a kind of optimizer, that do not work here.
        """
        try_out(self.optimizer, self.schedule, self.epochs)


@dataclass(frozen=True)
class Sgd(TrainingSettings, Regularized):
    """min of the mean squared whitened residual + ridge * prior + penalties, one mini-batch at a time.

    Attributes:
        consistency: "log_cholesky", parameters are physically consistent in every step, and meet all conditions at the
            end; "penalties", violations of the margin and of friction are penalized, and there are no other conditions.
        prior, conditions: as in `Consistent`.
        penalties: their weights, for "penalties".
        residual: how a residual module is trained: "joint", with the parameters; "parameters_first", after them, in the
            second half of the epochs; "alternating", in every other epoch.
        residual_lr: learning rate of the module; None: the optimizer's.
        residual_weight: of the mean square of the module's whitened force in the loss; None: the largest whose loss on
            held-out samples is not significantly above the least.
    """

    consistency: Consistency = "log_cholesky"
    prior: Prior = "euclidean"
    conditions: Conditions = field(default_factory=Conditions)
    penalties: PenaltyWeights = field(default_factory=PenaltyWeights)
    residual: ResidualMode = "joint"
    residual_lr: Positive | None = None
    residual_weight: NotNegative | None = None

    __repr__ = short_repr

    def conic_problem(self, problem: LinearProblem) -> ConicProblem:
        """Objective and conditions for the compressed samples, but for what penalties are in place of."""
        conic, terms = build_conic_problem(problem, self.conditions, self.ridge, self.prior), problem.terms
        if self.consistency == "penalties":
            signs = {one.name for one in terms.conditions} if terms else set()
            rows = np.array([name in signs for name in conic.names[len(conic.F0) :]], dtype=bool)
            conic = replace(conic, G=conic.G[rows], h=conic.h[rows])
        return conic

    def conic_loss(self, problem: LinearProblem, data: bool = True) -> ConicLoss:
        """The same as a loss; for mini-batches, without `data`, the prior alone, and softer conditions."""
        conic, terms = self.conic_problem(problem), problem.terms
        hessian = conic.hessian
        if not data:
            rows = min(len(problem.A) + (len(terms.C) if terms else 0), len(conic.linear))
            conic = replace(conic, root=conic.root[rows:], target=conic.target[rows:], constant=0.0)
        return ConicLoss(conic, len(problem.free_bodies()), hessian, 10.0 if data else 1.0)


def pseudo_inertias(scaled: Tensor) -> Tensor:
    """Pseudo-inertias (L, 4, 4) of parameters (L, 12), differentiable (`parameters.pseudo_inertia` is not)."""
    return torch.tensordot(scaled[:, parameters.INERTIAL], torch.from_numpy(parameters.PSEUDO_BASIS).to(scaled), dims=1)


def penalties(scaled: Tensor, bodies: Tensor, margin: float, weights: PenaltyWeights) -> dict[str, Tensor]:
    """Weighted penalties by name; those of weight 0 are left out.

    Args:
        scaled: (L, 12), parameters in units of their scale.
        bodies: (L',) int, bodies whose inertia is penalized; friction is penalized for all.
        margin: least eigenvalue without a penalty.
        weights: of the terms.
    """
    out: dict[str, Tensor] = {}
    if weights.eigenvalue or weights.log_det:
        eigenvalues = torch.linalg.eigvalsh(pseudo_inertias(scaled[bodies]))
        if weights.eigenvalue:
            out["eigenvalue"] = weights.eigenvalue * (margin - eigenvalues).clamp_min(0.0).square().sum()
        if weights.log_det:
            out["log_det"] = -weights.log_det * _extended_log(eigenvalues - margin).sum()
    if weights.mass:
        out["mass"] = weights.mass * scaled[bodies, parameters.MASS].clamp_max(0.0).square().sum()
    if weights.friction:
        out["friction"] = weights.friction * scaled[:, parameters.FRICTION].clamp_max(0.0).square().sum()
    return out


def _extended_log(x: Tensor) -> Tensor:
    """The logarithm, and below `_LOGARITHMIC` its tangent, so that the gradient of an infeasible body points inside."""
    inside = x.clamp_min(_LOGARITHMIC)
    return inside.log() + (x - inside) / _LOGARITHMIC


@dataclass(frozen=True)
class LossTerms:
    """Terms of a batch's loss, and sums of squares of its projected whitened forces, both by name."""

    losses: dict[str, Tensor]
    squares: dict[str, Tensor]

    def total(self) -> Tensor:
        """Sum of the terms."""
        return torch.stack(list(self.losses.values())).sum()

    def plus(self, other: LossTerms, share: float) -> LossTerms:
        """Sum with the terms of another batch, weighted with its share of the samples, without gradients."""
        losses = {name: self.losses.get(name, 0.0) + share * x.detach() for name, x in other.losses.items()}
        return LossTerms(losses, {name: self.squares.get(name, 0.0) + x for name, x in other.squares.items()})


def add_up(terms: LossTerms, trained: Sequence[nn.Parameter]) -> LossTerms:
    """Add up what the processes that share a batch have: the gradients of what is trained, and the terms, returned."""
    trained = [x for x in trained if x.grad is not None]
    own = [x.grad.cpu().numpy() for x in trained if x.grad is not None]
    values = [{name: float(x) for name, x in sums.items()} for sums in (terms.losses, terms.squares)]
    gradients, sums = zip(*distributed.all_gather((own, values), "gradients"), strict=True)
    for x, parts in zip(trained, zip(*gradients, strict=True), strict=True):
        x.grad = torch.from_numpy(np.sum(parts, axis=0)).to(x)
    losses, squares = (
        {name: torch.tensor(sum(one[name] for one in same), dtype=torch.float64) for name in same[0]}
        for same in zip(*sums, strict=True)
    )
    return LossTerms(losses, squares)


class Loss(nn.Module):
    """The loss of a batch; its mean over an epoch is the loss of all samples.

    Attributes:
        learnable: parameters of the bodies.
        residual: module r(q, v, a) -> (B, n_rows) [N, N m] whose output adds to K phi, or None.
        residual_weight: of the mean square of the module's whitened force; None (as 0) before it is chosen.
    """

    def __init__(
        self,
        settings: Sgd,
        problem: LinearProblem,
        batches: MiniBatches,
        learnable: LearnableParameters,
        residual: nn.Module | None,
        data: LinearProblem | None = None,
    ) -> None:
        """Arguments as of `Trainer`, with the parameters to learn."""
        super().__init__()
        self.settings = settings
        self.learnable, self.residual = learnable, residual
        self.residual_weight = settings.residual_weight
        self._columns = batches.columns
        self._per_row = batches.samples / max(problem.rows, 1)
        self._processes = batches.share[1]
        self.conic = settings.conic_loss(problem, data=False).to(batches.columns.device)
        self._beside = None if data is None else _difference(problem, data, batches.columns.device)
        self.register_buffer(
            "_bodies", torch.from_numpy(problem.free_bodies()).to(batches.columns.device), persistent=False
        )

    def forward(self, batch: Batch, size: int | None = None) -> LossTerms:
        """Terms of the loss of one batch.

        Args:
            batch: or what this process has of it.
            size: samples that all processes have in it, if they share it; their terms add up to those of the batch.
        """
        settings, phi = self.settings, self.learnable()
        y = self.learnable.deviations(phi)
        rigid, other = self.forces(batch, phi)
        share, of_one = self._per_row / (size or len(batch)), 1.0 / self._processes
        misfit = (rigid if other is None else rigid + other) - batch.f
        losses = {"data": share * misfit.square().sum()}
        if self._beside is not None:
            losses["beside"] = of_one * self._beside(phi)
        if settings.ridge:
            losses["prior"] = of_one * self.conic.objective(y)
        if len(self.conic.G) or len(self.conic.E) or len(self.conic.F0):
            losses["conditions"] = of_one * self.conic.penalty(y)
        if settings.consistency == "penalties":
            scaled, bodies = self.learnable.by_body(phi), self.get_buffer("_bodies")
            terms = penalties(scaled, bodies, settings.conditions.margin, settings.penalties)
            losses |= {name: of_one * x for name, x in terms.items()}
        forces = {"rigid_body": rigid, "measured": batch.f}
        if other is not None:
            forces["residual"] = other
            if self.residual_weight:
                losses["residual"] = self.residual_weight * share * other.square().sum()
        return LossTerms(losses, {name: x.detach().square().sum() for name, x in forces.items()})

    def update_conditions(self) -> None:
        """Move the multipliers of the conditions to the current parameters, at the end of an epoch."""
        with torch.no_grad():
            self.conic.update(self.learnable.deviations(self.learnable()))

    def forces(self, batch: Batch, phi: Tensor) -> tuple[Tensor, Tensor | None]:
        """Whitened projected forces, (B, n_rows), of parameters (12 L,) and of the residual module."""
        rigid = batch.K @ (self._columns @ phi)
        if self.residual is None:
            return rigid, None
        r = self.residual(batch.q, batch.v, batch.a)
        if r.shape != batch.f.shape:
            raise ValueError(f"residual: found a force of shape {tuple(r.shape)}; accepted: {tuple(batch.f.shape)}")
        return rigid, (batch.W.mT @ r[..., None])[..., 0]

    @torch.no_grad()
    def mean_square(self, batches: MiniBatches, phi: Tensor | None = None) -> float:
        """Mean squared whitened residual over all rows of some logs, with the module in evaluation mode.

        `phi`: parameters and terms; None for those that are learned.
        """
        total, rows, phi = 0.0, 0, self.learnable() if phi is None else phi
        with self.evaluating():
            for batch in batches.chunks():
                rigid, other = self.forces(batch, phi)
                misfit = (rigid if other is None else rigid + other) - batch.f
                total, rows = total + float(misfit.square().sum()), rows + batch.rows
        if batches.share[1] > 1:
            total, rows = (sum(parts) for parts in zip(*distributed.all_gather((total, rows), "loss"), strict=True))
        return total / max(rows, 1)

    @contextmanager
    def evaluating(self) -> Iterator[None]:
        """Evaluation mode inside the block; the previous mode afterwards."""
        training = self.training
        self.eval()
        try:
            yield
        finally:
            self.train(training)


def _difference(problem: LinearProblem, data: LinearProblem, device: torch.device) -> Callable[[Tensor], Tensor]:
    """Mean square that a problem has beside that of the samples alone, as of known masses, at parameters and terms."""

    def quadratic(one: LinearProblem) -> tuple[Tensor, Tensor]:
        A, b, terms = one.A, one.b, one.terms
        if terms is not None:
            A = np.block([[A, np.zeros((len(A), len(terms.size)))], [terms.C, terms.D]])
            b = np.append(b, terms.z)
        return torch.from_numpy(A).to(device), torch.from_numpy(b).to(device)

    (A, b), (C, d) = quadratic(problem), quadratic(data)
    rest = problem.residual - data.residual
    return lambda x: ((A @ x - b).square().sum() - (C @ x - d).square().sum() + rest) / max(problem.rows, 1)


def validate_state(saved: Mapping[str, Any], new: Mapping[str, Any], epochs: int) -> None:
    """Refuse a saved state that cannot come from a descent with the same settings.

    Args:
        saved: the state.
        new: the state of a descent before its first epoch.
        epochs: of the whole descent.

    Raises:
        ValueError: names the key of the state, its value and what is accepted.
    """
    require_same_structure(saved, {name: value for name, value in new.items() if name not in _FREE})
    epoch, best_epoch, best_loss = (saved[name] for name in ("epoch", "best_epoch", "best_loss"))
    _require_count("epoch", epoch, epochs)
    _require_count("best_epoch", best_epoch, epoch)
    if not (best_loss >= 0.0 and np.isfinite(best_loss) == (best_epoch > 0)):
        raise ValueError(f"best_loss: found {best_loss}; accepted: at least 0, infinite only before the first epoch")
    for key in ("learned", "best"):
        _require_learned(key, saved[key], new[key])
    for number, (group, fresh) in enumerate(
        zip(saved["optimizer"]["param_groups"], new["optimizer"]["param_groups"], strict=True)
    ):
        for name, value in fresh.items():
            _require_option(f"optimizer.param_groups.{number}.{name}", group[name], value, name in _SCHEDULED)
    if saved["schedule"] is not None and saved["schedule"].get("last_epoch") != epoch:
        last = saved["schedule"].get("last_epoch")
        raise ValueError(f"schedule.last_epoch: found {last}; accepted: {epoch}, the epoch")
    _require_weight(saved.get("residual_weight"), new["residual_weight"], epoch)


def require_same_structure(saved: Any, expected: Any, path: str = "state") -> None:
    """Refuse a saved state whose keys, types or shapes are not those of a new descent; values may differ.

    A mapping that is empty in `expected`, an optimizer's state before its first step, may contain mappings.

    Raises:
        ValueError: names the first key that differs.
    """
    if isinstance(expected, Tensor):
        alike = isinstance(saved, Tensor) and (saved.shape, saved.dtype) == (expected.shape, expected.dtype)
    elif isinstance(expected, (int, float)):
        number = isinstance(saved, (int, float)) and saved == saved
        alike = number and isinstance(saved, bool) == isinstance(expected, bool)
    else:
        alike = isinstance(saved, type(expected))
    if alike and expected == {}:
        alike = all(isinstance(value, dict) for value in saved.values())
    if not alike:
        raise ValueError(f"{path} has the wrong type or shape")
    if isinstance(expected, Mapping) and expected:
        for key in expected:
            require_same_structure(saved.get(key), expected[key], f"{path}.{key}")
    elif isinstance(expected, (list, tuple)) and expected:
        if len(saved) != len(expected):
            raise ValueError(f"{path} has the wrong length")
        for index, (one, other) in enumerate(zip(saved, expected, strict=True)):
            require_same_structure(one, other, f"{path}.{index}")


def _require_count(name: str, value: Any, most: int) -> None:
    if not (isinstance(value, int) and 0 <= value <= most):
        raise ValueError(f"{name}: found {value}; accepted: a whole number from 0 to {most}")


def _require_learned(path: str, saved: Mapping[str, Tensor], new: Mapping[str, Tensor]) -> None:
    for name, value in new.items():
        if value.is_floating_point() and not bool(saved[name].isfinite().all()):
            raise ValueError(f"{path}.{name}: found a number that is not finite; accepted: finite numbers")


def _require_option(path: str, saved: Any, new: Any, changes: bool) -> None:
    if changes and not all(np.isfinite(x) and x >= 0.0 for x in np.atleast_1d(saved)):
        raise ValueError(f"{path}: found {saved}; accepted: finite numbers of at least 0")
    if not changes and saved != new:
        raise ValueError(f"{path}: found {saved}; accepted: {new}, as in the settings")


def _require_weight(saved: Any, given: float | None, epoch: int) -> None:
    """Check the weight of a residual module: as in the settings, or chosen in the first epoch."""
    if given is None and epoch > 0:
        if not (isinstance(saved, (int, float)) and np.isfinite(saved) and saved >= 0.0):
            raise ValueError(f"residual_weight: found {saved}; accepted: a finite number of at least 0")
    elif saved != given:
        raise ValueError(f"residual_weight: found {saved}; accepted: {given}")
