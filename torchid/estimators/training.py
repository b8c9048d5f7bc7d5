"""Mini-batch descent, epoch by epoch, with a state that can be saved and taken up again."""

from __future__ import annotations

import copy
import operator
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchid import parameters
from torchid.errors import InputError
from torchid.estimators.learnable import FreeParameters, LearnableParameters, LogCholeskyParameters
from torchid.estimators.least_squares import LeastSquares
from torchid.estimators.loss import Loss, Terms
from torchid.estimators.optimizers import make_optimizer, make_schedule, step_schedule
from torchid.estimators.result import BoundEstimate, rounding_reported
from torchid.estimators.sgd import Sgd
from torchid.parameters import Array
from torchid.problem.batches import Batch, MiniBatches
from torchid.problem.linear import LinearProblem
from torchid.problem.threads import one_thread

_BETTER = 1e-5  # relative: less is no improvement
_DIVERGED = 1e6  # times the loss at the nominal parameters, or that of stated noise if more


@dataclass(frozen=True)
class Epoch:
    """What an epoch left behind.

    Attributes:
        number: from 1.
        losses: means over the batches by term; "data" is the mean squared whitened residual, "total" the sum of all.
        held_out: mean squared whitened residual on the held-out logs after the epoch, None without any.
        objective: mean squared whitened residual on all training samples plus prior, of the parameters alone, after the
            epoch.
        closed_form: the least that any parameters have, from `LeastSquares`.
        distance: rms difference of the projected whitened forces from those of the closed form.
        shares: rms of the projected whitened force of the parameters, and of the residual module, over that of the
            measured one, in the epoch.
        learning_rate: of the parameters, in the epoch.
        samples_per_second: trained on.
    """

    number: int
    losses: dict[str, float]
    held_out: float | None
    objective: float
    closed_form: float
    distance: float
    shares: dict[str, float]
    learning_rate: float
    samples_per_second: float


@dataclass(frozen=True)
class SgdEstimate(BoundEstimate):
    """What a descent arrived at; objective and distance are those of the parameters alone.

    Attributes:
        epochs: that were run.
        best_epoch: whose parameters these are.
    """

    epochs: int
    best_epoch: int


class Trainer:
    """A descent on mini-batches, preconditioned by the compressed problem, with or without a residual module.

    Same settings, logs and seeds give the same numbers, also if the state is saved after any epoch and loaded into a
    new trainer.
    """

    @rounding_reported("sgd")
    def __init__(
        self,
        settings: Sgd,
        problem: LinearProblem,
        batches: MiniBatches,
        held_out: MiniBatches | None = None,
        residual: nn.Module | None = None,
    ) -> None:
        """Get ready at the nominal parameters.

        Args:
            settings: of the descent.
            problem: the compressed training logs: preconditioner, prior, and what to compare with.
            batches: of the training logs.
            held_out: of logs for early stopping.
            residual: any module r(q, v, a) -> (B, nv) [N, N m], on the device of the batches, whose output adds to
                K phi; arguments as in `Batch`.
        """
        self.settings, self.problem, self.batches, self.held_out = settings, problem, batches, held_out
        self.closed_form = LeastSquares(settings.ridge, settings.rank_tolerance).solve(problem)
        device = batches.columns.device
        self.loss = Loss(settings, problem, batches, _learnable(settings, problem).to(device), residual)
        groups: list[dict[str, Any]] = [{"params": [self.loss.learnable.raw]}]
        if residual is not None:
            own = {} if settings.residual_lr is None else {"lr": settings.residual_lr}
            groups.append({"params": [x for x in residual.parameters() if x.requires_grad]} | own)
        self.optimizer = make_optimizer(settings.optimizer, settings.optimizer_options, groups)
        self.schedule = make_schedule(settings.schedule, settings.schedule_options, self.optimizer, settings.epochs)
        self.epoch, self.best_epoch, self.best_loss = 0, 0, float("inf")
        self._best = self._learned()

    @property
    def finished(self) -> bool:
        """Whether all epochs are done or the held-out loss has stopped falling."""
        if self.epoch >= self.settings.epochs:
            return True
        late = self.loss.residual is not None and self.settings.residual == "parameters_first"
        since = max(self.best_epoch, self.settings.epochs // 2 if late else 0)  # the module has its turn in any case
        patience = self.settings.patience
        return patience is not None and self.held_out is not None and self.epoch - since >= patience

    def run(self, on_epoch: Callable[[Epoch], None] | None = None) -> SgdEstimate:
        """Train until finished.

        Args:
            on_epoch: called after each epoch.

        Raises:
            InputError: the loss has grown beyond all bounds.
        """
        while not self.finished:
            epoch = self.run_epoch()
            if on_epoch is not None:
                on_epoch(epoch)
        return self.estimate()

    def run_epoch(self) -> Epoch:
        """Train on all samples once.

        Raises:
            InputError: the loss has grown beyond all bounds.
        """
        self.epoch += 1
        self._choose_trained()
        self.loss.train()
        rate, start = float(self.optimizer.param_groups[0]["lr"]), time.perf_counter()
        losses: dict[str, float] = {}
        squares: dict[str, float] = {}
        with one_thread():
            for batch in self.batches.epoch(self.epoch):
                terms = self._step(batch)
                weight = len(batch) / self.batches.samples
                for sums, found, factor in ((losses, terms.losses, weight), (squares, terms.squares, 1.0)):
                    for name, value in found.items():
                        sums[name] = sums.get(name, 0.0) + factor * float(value)
            elapsed = time.perf_counter() - start
            held_out = None if self.held_out is None else self.loss.mean_square(self.held_out)
        losses["total"] = sum(losses.values())
        phi, size = self.phi(), squares.pop("measured")
        with np.errstate(over="ignore", invalid="ignore"):
            self._check(self._objective(phi))  # no batch has seen the last step yet
        self._check(0.0 if held_out is None else held_out)
        self._learn_all()
        step_schedule(self.schedule, losses["total"] if held_out is None else held_out)
        if held_out is None or held_out < self.best_loss * (1.0 - _BETTER):
            self.best_epoch, self.best_loss = self.epoch, losses["total"] if held_out is None else held_out
            self._best = self._learned()
        return Epoch(
            number=self.epoch,
            losses=losses,
            held_out=held_out,
            objective=self._objective(phi),
            closed_form=self._objective(self.closed_form.phi),
            distance=self.problem.distance(phi, self.closed_form.phi),
            shares={name: float(np.sqrt(x / size)) if size else 0.0 for name, x in squares.items()},
            learning_rate=rate,
            samples_per_second=self.batches.samples / elapsed,
        )

    def phi(self) -> Array:
        """The parameters as they are now, (12 L,)."""
        with torch.no_grad():
            return np.array(self.loss.learnable().cpu().numpy(), dtype=np.float64)

    def estimate(self) -> SgdEstimate:
        """The parameters with the least held-out loss (the last without held-out logs); a residual module follows.

        Statistics are those of least squares with the same ridge.
        """
        self._learn(self._best)
        plain, phi = self.closed_form, self.phi()
        return SgdEstimate(
            **(vars(plain) | {"phi": phi, "cost": self.problem.cost(phi)}),
            objective=self._objective(phi),
            unconstrained=self._objective(plain.phi),
            distance=self.problem.distance(phi, plain.phi),
            eigenvalues=parameters.least_eigenvalues(phi, self.problem.scale),
            epochs=self.epoch,
            best_epoch=self.best_epoch,
        )

    def state_dict(self) -> dict[str, Any]:
        """All that a new trainer of the same settings and logs needs to go on: plain types and tensors."""
        return {
            "learned": self._learned(),
            "best": self._best,
            "optimizer": copy.deepcopy(self.optimizer.state_dict()),  # torch hands out what the next step writes to
            "schedule": None if self.schedule is None else copy.deepcopy(self.schedule.state_dict()),
            "random": [torch.get_rng_state(), *torch.cuda.get_rng_state_all()],
            "epoch": self.epoch,
            "best_epoch": self.best_epoch,
            "best_loss": self.best_loss,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where `state_dict` was called.

        Raises:
            TypeError: numbers of epochs that are none; what else is no such state raises whatever torch does.
        """
        self._learn(state["learned"])
        self._best = state["best"]
        self._load_optimizer(copy.deepcopy(state["optimizer"]))
        if self.schedule is not None:
            self.schedule.load_state_dict(copy.deepcopy(state["schedule"]))
        torch.set_rng_state(state["random"][0])
        torch.cuda.set_rng_state_all(state["random"][1:])
        self.epoch, self.best_epoch = (operator.index(state[name]) for name in ("epoch", "best_epoch"))
        self.best_loss = float(state["best_loss"])

    def _load_optimizer(self, state: dict[str, Any]) -> None:
        """Load an optimizer's state, scalars in the precision they had (torch would widen those of NAdam)."""
        self.optimizer.load_state_dict(state)
        trained = [x for group in self.optimizer.param_groups for x in group["params"]]
        for index, saved in state["state"].items():
            own = self.optimizer.state[trained[index]]
            for name, value in saved.items():
                if isinstance(value, Tensor):
                    own[name] = own[name].to(value.dtype)

    def _learned(self) -> dict[str, Tensor]:
        return {name: x.detach().clone() for name, x in self.loss.state_dict().items()}

    def _learn(self, learned: Mapping[str, Tensor]) -> None:
        self.loss.load_state_dict(learned)

    def _objective(self, phi: Array) -> float:
        deviation = (phi - self.problem.nominal) / self.problem.scale
        return self.problem.cost(phi) / max(self.problem.rows, 1) + self.settings.ridge * float(deviation @ deviation)

    def _choose_trained(self) -> None:
        """Which of parameters and residual module learn in this epoch."""
        if self.loss.residual is None:
            return
        first = self.epoch <= self.settings.epochs // 2
        ours, theirs = {
            "joint": (True, True),
            "parameters_first": (first, not first),
            "alternating": (self.epoch % 2 == 1, self.epoch % 2 == 0),
        }[self.settings.residual]
        for group, trained in zip(self.optimizer.param_groups, (ours, theirs), strict=True):
            for x in group["params"]:
                x.requires_grad_(trained)

    def _learn_all(self) -> None:
        """Leave nothing frozen: another trainer may take the residual module up."""
        for group in self.optimizer.param_groups:
            for x in group["params"]:
                x.requires_grad_(True)

    def _check(self, loss: float) -> None:
        if not loss <= _DIVERGED * max(1.0, self.problem.cost(self.problem.nominal) / max(self.problem.rows, 1)):
            raise InputError("estimator", "training", f"a loss of {loss:.3g} in epoch {self.epoch}", "smaller steps")

    def _step(self, batch: Batch) -> Terms:
        """One step of the optimizer; terms are those before it."""
        found: list[Terms] = []

        def closure() -> Tensor:
            self.optimizer.zero_grad()
            terms = self.loss(batch)
            total = terms.total()
            total.backward()
            for group in self.optimizer.param_groups:
                nn.utils.clip_grad_norm_(group["params"], self.settings.clip)
            found.append(Terms({name: x.detach() for name, x in terms.losses.items()}, terms.squares))
            return total

        try:
            self.optimizer.step(closure)  # type: ignore[arg-type]  # torch's own documentation returns a tensor
        except torch.linalg.LinAlgError:  # type: ignore[attr-defined]  # eigenvalues of what is not finite
            self._check(float("nan"))
        self._check(float(found[0].losses["data"]))
        return found[0]


def _learnable(settings: Sgd, problem: LinearProblem) -> LearnableParameters:
    learnable: LearnableParameters = FreeParameters(problem)
    damping = settings.damping
    if settings.consistency == "log_cholesky":
        learnable = LogCholeskyParameters(problem, settings.margin)
    else:
        damping += settings.penalties.curvature
    learnable.precondition(problem, settings.ridge, damping)
    return learnable
