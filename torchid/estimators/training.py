"""Mini-batch descent, epoch by epoch, with a state that can be saved and resumed."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchid import distributed, parameters
from torchid.errors import InputError
from torchid.estimators.least_squares import ConstrainedEstimate, Minimizer, report_rounding
from torchid.estimators.sgd import (
    FULL_BATCH,
    LearnableParameters,
    Objective,
    Sgd,
    deviations,
    excess,
    least_penalized,
    make_optimizer,
    make_schedule,
    nearest_allowed,
    step_schedule,
)
from torchid.parallel import one_thread
from torchid.parameters import Array
from torchid.problem import Batch, LinearProblem, MiniBatches


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
    """Sum the gradients and loss terms of all processes that share a batch; return the terms."""
    trained = [x for x in trained if x.grad is not None]
    own_gradients = [x.grad.cpu().numpy() for x in trained if x.grad is not None]
    values = [{name: float(x) for name, x in sums.items()} for sums in (terms.losses, terms.squares)]
    gradients, sums = zip(*distributed.all_gather((own_gradients, values), "gradients"), strict=True)
    for x, parts in zip(trained, zip(*gradients, strict=True), strict=True):
        x.grad = torch.from_numpy(np.sum(parts, axis=0)).to(x)
    losses, squares = (
        {name: torch.tensor(sum(part[name] for part in same), dtype=torch.float64) for name in same[0]}
        for same in zip(*sums, strict=True)
    )
    return LossTerms(losses, squares)


class Loss(nn.Module):
    """The loss of a batch; its mean over an epoch is the loss of all samples.

    Attributes:
        learnable: parameters of the bodies.
        residual: module r(q, v, a) -> (B, n_rows) [N, N m] whose output adds to K phi, or None.
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
        self.learnable = learnable
        self.residual = residual
        self._columns = batches.columns
        self._per_row = batches.samples / max(problem.rows, 1)
        self._processes = batches.share[1]
        self._objective = Objective(settings, problem).to(batches.columns.device)
        self._beside = None if data is None else _difference(problem, data, batches.columns.device)

    def forward(self, batch: Batch, size: int | None = None) -> LossTerms:
        """Terms of the loss of one batch.

        Args:
            batch: the batch, or the part that this process has.
            size: number of samples in all processes that share the batch; their terms sum to those of the batch.
        """
        settings = self.settings
        phi = self.learnable()
        rigid, other = self.forces(batch, phi)
        share = self._per_row / (size or len(batch))
        of_one = 1.0 / self._processes
        misfit = (rigid if other is None else rigid + other) - batch.f
        losses = {"data": share * misfit.square().sum()}
        if self._beside is not None:
            losses["beside"] = of_one * self._beside(phi)
        if settings.ridge:
            losses["prior"] = of_one * self._objective.prior(self._scaled(phi))
        if settings.consistency == "penalties":
            losses |= {name: of_one * x for name, x in self._objective.penalties(self._scaled(phi)).items()}
        forces = {"rigid_body": rigid, "measured": batch.f}
        if other is not None:
            forces["residual"] = other
            if settings.residual_weight:
                losses["residual"] = settings.residual_weight * share * other.square().sum()
        return LossTerms(losses, {name: x.detach().square().sum() for name, x in forces.items()})

    def _scaled(self, values: Tensor) -> Tensor:
        """Deviations of the free parameters, and the terms, in units of their scale, of phi and terms (12 L + M,)."""
        learnable = self.learnable
        count = len(learnable.free)
        phi = ((values[:count] - learnable.nominal) / learnable.scale)[learnable.free]
        return torch.cat([phi, values[count:] / learnable.terms])

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
        total = 0.0
        rows = 0
        phi = self.learnable() if phi is None else phi
        with self.evaluating():
            for batch in batches.chunks():
                rigid, other = self.forces(batch, phi)
                misfit = (rigid if other is None else rigid + other) - batch.f
                total = total + float(misfit.square().sum())
                rows = rows + batch.rows
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
    """Mean square of the problem's further equations, such as known masses, at parameters and terms."""

    def quadratic(problem: LinearProblem) -> tuple[Tensor, Tensor]:
        A = problem.A
        b = problem.b
        terms = problem.terms
        if terms is not None:
            A = np.block([[A, np.zeros((len(A), len(terms.size)))], [terms.C, terms.D]])
            b = np.append(b, terms.z)
        return torch.from_numpy(A).to(device), torch.from_numpy(b).to(device)

    (A, b), (C, d) = quadratic(problem), quadratic(data)
    residual = problem.residual - data.residual
    return lambda x: ((A @ x - b).square().sum() - (C @ x - d).square().sum() + residual) / max(problem.rows, 1)


@dataclass(frozen=True)
class ResidualEffect:
    """Force of a residual module on the training samples.

    Attributes:
        rms: by group, "base_force" [N], "base_moment" [N m], "joint_torque" [N m, N] and "limb_wrench" [N, N m].
        shares: by group, this rms divided by the rms of the whole force (rigid bodies and module).
    """

    rms: dict[str, float]
    shares: dict[str, float]


@torch.no_grad()
def residual_effect(loss: Loss, batches: MiniBatches) -> ResidualEffect | None:
    """The force of a loss's residual module on some samples; None without a module."""
    if loss.residual is None:
        return None
    with_module: dict[str, float] = {}
    alone: dict[str, float] = {}
    with loss.evaluating():
        phi = loss.learnable().cpu().numpy()
        for (q, v, a), rigid in batches.generalized_forces(phi):
            force = loss.residual(q, v, a)
            for name, rows in _groups(batches.builder.tree.base_rows, v.shape[1], rigid.shape[1]).items():
                per_row = 1.0 / (batches.samples * (rows.stop - rows.start))
                for sums, part in ((alone, force), (with_module, rigid + force)):
                    sums[name] = sums.get(name, 0.0) + per_row * float(part[:, rows].square().sum())
    shares = {name: float(np.sqrt(alone[name] / x)) if x else 0.0 for name, x in with_module.items()}
    return ResidualEffect({name: float(np.sqrt(x)) for name, x in alone.items()}, shares)


def _groups(base_rows: int, nv: int, rows: int) -> dict[str, slice]:
    """Rows by group, without empty groups."""
    base = {"base_force": slice(0, 3), "base_moment": slice(3, 6)} if base_rows else {}
    groups = base | {"joint_torque": slice(base_rows, nv), "limb_wrench": slice(nv, rows)}
    return {name: rows for name, rows in groups.items() if rows.stop > rows.start}


CONVERGED = 0.01
"""Largest relative excess of a converged descent over the least objective."""
_BETTER = 1e-5  # least relative decrease that counts as an improvement
_DIVERGED = 1e6  # times the loss at the nominal parameters, or that of the stated noise if that is larger


@dataclass(frozen=True)
class Epoch:
    """Losses and statistics of one epoch.

    Attributes:
        number: from 1.
        losses: means over the batches by term; "data" is the mean squared whitened residual, "total" the sum.
        held_out: mean squared whitened residual on the held-out logs after the epoch; None without held-out logs.
        objective: mean squared whitened residual on all training samples plus prior, without the residual module.
        closed_form: the least objective without conditions, from `LeastSquares`.
        distance: rms difference of the projected whitened forces from those of the closed form.
        shares: rms of the projected whitened force of the parameters, and of the residual module, divided by that of
            the measured force.
        learning_rate: of the parameters.
        samples_per_second: training speed.
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


@dataclass(frozen=True, repr=False)
class SgdEstimate(ConstrainedEstimate):
    """Result of a descent; objective and distance are those of the parameters without residual module.

    Attributes:
        epochs: number of epochs run.
        best_epoch: the epoch of these parameters.
        residual: effect of the residual module; None without one.
        excess: (objective - least objective) / least objective under the same conditions; None with a residual module.
    """

    epochs: int
    best_epoch: int
    residual: ResidualEffect | None
    excess: float | None = None

    @property
    def converged(self) -> bool:
        """Whether the objective is known to be at most `CONVERGED` above the least one."""
        return self.excess is not None and self.excess <= CONVERGED

    def _headline(self) -> str:
        off = "" if self.unconstrained is None else f", {self.deviation:.2g} standard errors from least squares"
        return super()._headline() + off


class Trainer:
    """Runs a mini-batch descent, preconditioned by the compressed problem, with or without a residual module.

    The same settings, logs and seeds give the same numbers, also after saving the state and loading it into a new
    trainer. Processes that share batches get these numbers too, up to rounding of sums.
    """

    @report_rounding("sgd")
    def __init__(
        self,
        settings: Sgd,
        problem: LinearProblem,
        batches: MiniBatches,
        held_out: MiniBatches | None = None,
        residual: nn.Module | None = None,
        data: LinearProblem | None = None,
    ) -> None:
        """Start at the nominal parameters.

        Args:
            settings: of the descent.
            problem: the compressed training logs, for the preconditioner, the prior and the closed form. Compress them
                from samples with `motion_noise` None, because the descent does not correct motion noise.
            batches: of the training logs.
            held_out: batches of logs for early stopping.
            residual: any module r(q, v, a) -> (B, n_rows) [N, N m] on the device of the batches. Its output is added to
                K phi; arguments as in `Batch`.
            data: the problem of the batches' rows alone, if `problem` has further equations such as known masses; else
                None.

        Raises:
            InputError: an optimizer or a schedule does not work with its options, or the conditions contradict each
                other.
            ValueError: processes share the batches of a full-batch optimizer or a residual module.
        """
        if batches.share[1] > 1 and (residual is not None or settings.optimizer["name"] in FULL_BATCH):
            reason = f"found a share of {batches.share[1]} with a residual module or {settings.optimizer['name']}"
            raise ValueError(f"batches: {reason}; accepted: whole batches")
        settings.try_out()
        self.settings = settings
        self.problem = problem
        self.batches = batches
        self.held_out = held_out
        self.closed_form = settings.least_squares.solve(problem)
        self._conic = settings.conic_problem(problem)
        self._least = self._conic.unconstrained
        learnable = settings.learnable(problem).to(batches.columns.device)
        self.loss = Loss(settings, problem, batches, learnable, residual, data)
        self._trained: list[list[nn.Parameter]] = [[self.loss.learnable.raw]]
        if residual is not None:
            self._trained.append([x for x in residual.parameters() if x.requires_grad])
        groups: list[dict[str, Any]] = [{"params": trained} for trained in self._trained]
        if residual is not None and settings.residual_lr is not None:
            groups[1]["lr"] = settings.residual_lr
        self.optimizer = make_optimizer(settings.optimizer, groups)
        self.schedule = make_schedule(settings.schedule, self.optimizer, settings.epochs)
        self.epoch = 0
        self.best_epoch = 0
        self.best_loss = float("inf")
        self._best = self._snapshot()

    def __repr__(self) -> str:
        return f"Trainer: epoch {self.epoch} of {self.settings.epochs}, {self.batches!r}"

    @property
    def finished(self) -> bool:
        """Whether all epochs are done or the held-out loss has stopped decreasing."""
        if self.epoch >= self.settings.epochs:
            return True
        patience = self.settings.patience
        return patience is not None and self.held_out is not None and self.epoch - self.best_epoch >= patience

    def run(self, on_epoch: Callable[[Epoch], None] | None = None) -> SgdEstimate:
        """Train until finished.

        Args:
            on_epoch: called after each epoch.

        Raises:
            InputError: the loss diverges.
        """
        while not self.finished:
            epoch = self.run_epoch()
            if on_epoch is not None:
                on_epoch(epoch)
        return self.estimate()

    def run_epoch(self) -> Epoch:
        """Train on all samples once.

        Raises:
            InputError: the loss diverges.
        """
        self.epoch += 1
        self.loss.train()
        rate = float(self.optimizer.param_groups[0]["lr"])
        start = time.perf_counter()
        losses: dict[str, float] = {}
        squares: dict[str, float] = {}
        with one_thread():
            for batches, samples in self._steps():
                terms = self._step(batches, samples)
                weight = samples / self.batches.samples
                for sums, values, factor in ((losses, terms.losses, weight), (squares, terms.squares, 1.0)):
                    for name, value in values.items():
                        sums[name] = sums.get(name, 0.0) + factor * float(value)
            elapsed = time.perf_counter() - start
            held_out = None if self.held_out is None else self.loss.mean_square(self.held_out)
        losses["total"] = sum(losses.values())
        minimizer = self._minimizer()
        size = squares.pop("measured")
        with np.errstate(over="ignore", invalid="ignore"):
            self._require_converging(self._objective(minimizer))  # after the last step: losses are those before it
        self._require_converging(0.0 if held_out is None else held_out)
        if not all(bool(x.isfinite().all()) for x in chain(*self._trained)):
            self._require_converging(float("nan"))  # of a module, in the last step
        step_schedule(self.schedule, losses["total"] if held_out is None else held_out)
        if held_out is None or held_out < self.best_loss * (1.0 - _BETTER):
            self.best_epoch = self.epoch
            self.best_loss = losses["total"] if held_out is None else held_out
            self._best = self._snapshot()
        return Epoch(
            number=self.epoch,
            losses=losses,
            held_out=held_out,
            objective=self._objective(minimizer),
            closed_form=self._least or 0.0,
            distance=self.problem.prediction_distance(minimizer.phi, self.closed_form.phi),
            shares={name: float(np.sqrt(x / size)) if size else 0.0 for name, x in squares.items()},
            learning_rate=rate,
            samples_per_second=self.batches.samples / elapsed,
        )

    def phi(self) -> Array:
        """The current parameters, (12 L,)."""
        return self._minimizer().phi

    def _minimizer(self) -> Minimizer:
        with torch.no_grad():
            values = np.array(self.loss.learnable().cpu().numpy(), dtype=np.float64)
        phi, psi = np.split(values, [len(self.problem.nominal)])
        return Minimizer(phi, None if self.problem.terms is None else psi)

    def estimate(self) -> SgdEstimate:
        """Parameters and residual module with the least held-out loss; without held-out logs, the last ones.

        Without held-out logs and module, after the last epoch, the optimum on all samples is returned: by L-BFGS with
        penalties, by the interior-point method for consistent bodies. Descents converge slowly at the border of the
        consistent set: 800 steps of L-BFGS left a quadruped 0.1 of a parameter's scale away. Statistics are those of
        least squares with the same ridge.
        """
        self.loss.load_state_dict(self._best)
        plain = self.closed_form
        minimizer = self._minimizer()
        finish = self.finished and self.held_out is None and self.loss.residual is None and self.settings.finish
        if self.settings.consistency == "penalties":
            minimizer = least_penalized(self.settings, self.problem, minimizer) if finish else minimizer
        elif finish:
            minimizer = self.settings.consistent.minimize(self.problem)
        else:
            minimizer = nearest_allowed(self.settings, self.problem, minimizer)
        phi, psi = minimizer
        return SgdEstimate(
            **(vars(plain) | {"phi": phi, "psi": psi, "cost": self.problem.cost(phi, psi)}),
            objective=self._objective(minimizer),
            unconstrained=self._least,
            distance=self.problem.prediction_distance(phi, plain.phi),
            eigenvalues=parameters.least_eigenvalues(phi, self.problem.scale),
            epochs=self.epoch,
            best_epoch=self.best_epoch,
            residual=residual_effect(self.loss, self.batches),
            excess=None if self.loss.residual is not None else excess(self.settings, self.problem, minimizer),
        )

    def state_dict(self) -> dict[str, Any]:
        """State to resume from, with the same settings and logs: plain types and tensors."""
        return {
            "learned": self._snapshot(),
            "best": self._best,
            "optimizer": copy.deepcopy(self.optimizer.state_dict()),  # torch returns references
            "schedule": None if self.schedule is None else copy.deepcopy(self.schedule.state_dict()),
            "random": [torch.get_rng_state(), *torch.cuda.get_rng_state_all()],
            "epoch": self.epoch,
            "best_epoch": self.best_epoch,
            "best_loss": self.best_loss,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a saved state.

        Raises:
            ValueError: the epoch does not exist. Torch raises its own errors for states of other settings.
        """
        for name, most in (("epoch", self.settings.epochs), ("best_epoch", state["epoch"])):
            if not (isinstance(state[name], int) and 0 <= state[name] <= most):
                raise ValueError(f"{name}: found {state[name]}; accepted: a whole number from 0 to {most}")
        self.loss.load_state_dict(state["learned"])
        self._best = state["best"]
        self._load_optimizer(copy.deepcopy(state["optimizer"]))
        if self.schedule is not None:
            self.schedule.load_state_dict(copy.deepcopy(state["schedule"]))
        torch.set_rng_state(state["random"][0])
        torch.cuda.set_rng_state_all(state["random"][1:])
        self.epoch = state["epoch"]
        self.best_epoch = state["best_epoch"]
        self.best_loss = float(state["best_loss"])

    def _load_optimizer(self, state: dict[str, Any]) -> None:
        """Load an optimizer's state, scalars in their saved precision (torch would widen those of NAdam)."""
        self.optimizer.load_state_dict(state)
        trained = [x for group in self.optimizer.param_groups for x in group["params"]]
        for index, saved in state["state"].items():
            current = self.optimizer.state[trained[index]]
            for name, value in saved.items():
                if isinstance(value, Tensor):
                    current[name] = current[name].to(value.dtype)

    def _snapshot(self) -> dict[str, Tensor]:
        return {name: x.detach().clone() for name, x in self.loss.state_dict().items()}

    def _objective(self, minimizer: Minimizer) -> float:
        """Mean squared whitened residual plus prior."""
        y = deviations(self.problem, minimizer)
        return self._conic.objective(np.asarray(np.linalg.solve(self._conic.deviations, y), dtype=np.float64))

    def _require_converging(self, loss: float) -> None:
        if not loss <= _DIVERGED * max(1.0, self.problem.cost(self.problem.nominal) / max(self.problem.rows, 1)):
            name = self.settings.optimizer["name"]
            rate = float(self.optimizer.param_groups[0]["lr"])
            reason = f"diverged: loss {loss:.3g} in epoch {self.epoch} with {name} at lr {rate:.3g}"
            raise InputError("estimator", "training", reason, "a smaller lr")

    def _steps(self) -> Iterator[tuple[Callable[[], Iterable[tuple[Batch, int]]], int]]:
        """Batches of each step of an epoch with the number of samples of each, and of all of them."""
        if self.settings.optimizer["name"] in FULL_BATCH:
            yield self.batches.sized_chunks, self.batches.samples
        else:
            for batch, size in self.batches.sized_epoch(self.epoch):
                yield partial(list, [(batch, size)]), size

    def _step(self, batches: Callable[[], Iterable[tuple[Batch, int]]], samples: int) -> LossTerms:
        """Take one step of the optimizer; returns the terms before it."""
        evaluated: list[LossTerms] = []

        def closure() -> Tensor:
            self.optimizer.zero_grad()
            terms = LossTerms({}, {})
            for batch, size in batches():
                part = self.loss(batch, size)
                share = size / samples
                (share * part.total()).backward()
                terms = terms.plus(part, share)
            if self.batches.share[1] > 1:
                terms = add_up(terms, list(chain(*self._trained)))
            if self.settings.optimizer["name"] not in FULL_BATCH:
                for group in self.optimizer.param_groups:
                    nn.utils.clip_grad_norm_(group["params"], self.settings.clip)
            evaluated.append(terms)
            return terms.total()

        try:
            self.optimizer.step(closure)  # type: ignore[arg-type]  # torch's own documentation returns a tensor
        except torch.linalg.LinAlgError:  # type: ignore[attr-defined]  # eigenvalues of a matrix with NaN
            self._require_converging(float("nan"))
        self._require_converging(float(evaluated[0].losses["data"]))
        return evaluated[0]
