"""Mini-batch descent, epoch by epoch, with a state that can be saved and resumed; its end on all samples at once."""

from __future__ import annotations

import copy
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
import scipy.optimize
import torch
from torch import Tensor, nn

from torchid import parameters
from torchid.errors import InputError, NumericalWarning
from torchid.estimators.barrier import solve_barrier
from torchid.estimators.conic_problem import ConicLoss
from torchid.estimators.consistent import Consistent
from torchid.estimators.least_squares import ConstrainedEstimate, LeastSquares, Minimizer, report_rounding
from torchid.estimators.sgd import (
    OPTIMIZERS,
    FreeParameters,
    LearnableParameters,
    LogCholeskyParameters,
    Loss,
    LossTerms,
    Sgd,
    add_up,
    make_optimizer,
    make_schedule,
    penalties,
    precondition_by,
    step_schedule,
    validate_state,
)
from torchid.parallel import one_thread
from torchid.parameters import INERTIAL, PER_BODY, Array
from torchid.problem import Batch, LinearProblem, MiniBatches

_LBFGS_OPTIONS = {"maxiter": 20, "maxcor": 20, "ftol": 0.0, "gtol": 0.0}  # of L-BFGS between preconditioners
_DAMPING = 0.01  # of these, over the objective
_SETTLED, _MET = 1e-12, 1e-10  # relative decrease of the objective in a round, violation of a condition


@one_thread()
def finish(settings: Sgd, problem: LinearProblem, start: Minimizer) -> Minimizer:
    """Minimize the objective of a descent.

    Possible bodies have one minimizer, which the interior-point method computes wherever the descent ended. Descents
    do not reach it: at the border of what is possible, coordinates such as J = R R^T bend faster than they converge,
    so that 800 steps of L-BFGS left a quadruped 0.1 of a parameter's scale away, elsewhere with every rounding.

    Args:
        settings: of the descent; with penalties, `finish` rounds of L-BFGS are taken at most.
        problem: the compressed samples.
        start: where it ended.
    """
    if settings.consistency == "log_cholesky":
        exact = Consistent(settings.ridge, settings.prior, settings.conditions, rank_tolerance=settings.rank_tolerance)
        return exact.minimize(problem)
    conic, y = settings.conic_loss(problem), _deviations(problem, start)
    before = np.inf
    for _ in range(settings.finish or 0):
        damping = _DAMPING * max(float(conic.objective(y)), 1e-12) + settings.penalties.curvature
        P = precondition_by(conic.curvature(y), damping)

        def loss(moved: Array, y: Tensor = y, P: Tensor = P) -> tuple[float, Array]:
            u = torch.from_numpy(moved).requires_grad_()
            value = _penalized(settings, problem, conic, y + P @ u)
            (gradient,) = torch.autograd.grad(value, u)
            return value.item(), gradient.numpy()

        moved = scipy.optimize.minimize(loss, np.zeros(len(y)), jac=True, method="L-BFGS-B", options=_LBFGS_OPTIONS).x
        y = y + P @ torch.from_numpy(moved)
        value = float(conic.objective(y))
        if conic.update(y) <= _MET and abs(before - value) <= _SETTLED * abs(value):
            break
        before = value
    moves, terms = np.split(y.numpy(), [int(problem.free.sum())])
    phi = problem.nominal.copy()
    phi[problem.free] += problem.scale[problem.free] * moves
    return Minimizer(phi, None if problem.terms is None else terms * problem.terms.size)


def _deviations(problem: LinearProblem, found: Minimizer) -> Tensor:
    """Deviations of the free parameters and terms in units of their scale, (n,)."""
    y = ((found.phi - problem.nominal) / problem.scale)[problem.free]
    if problem.terms is not None:
        y = np.append(y, np.zeros_like(problem.terms.size) if found.psi is None else found.psi / problem.terms.size)
    return torch.from_numpy(y)


def _penalized(settings: Sgd, problem: LinearProblem, conic: ConicLoss, y: Tensor) -> Tensor:
    """Objective, conditions and penalties at deviations (n,)."""
    free, nominal = torch.from_numpy(problem.free), torch.from_numpy(problem.nominal / problem.scale)
    by_body = nominal.masked_scatter(free, nominal[free] + y[: int(free.sum())]).unflatten(0, (-1, PER_BODY))
    bodies = torch.from_numpy(problem.free_bodies())
    value = conic.objective(y) + conic.penalty(y)
    terms = penalties(by_body, bodies, settings.conditions.margin, settings.penalties)
    return value + torch.stack([value * 0.0, *terms.values()]).sum()


def excess(settings: Sgd, problem: LinearProblem, found: Minimizer) -> float:
    """How far the objective of a minimizer is above the least one at most, as a share of that or of what counts as 0.

    Where bodies are possible the least one is that of the interior-point method. With penalties, which only add to the
    quadratic, it is at least what this promises along the gradient.
    """
    problem_of_cones, conic = settings.conic_problem(problem), settings.conic_loss(problem)
    y = _deviations(problem, found)
    if settings.consistency == "log_cholesky":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericalWarning)  # of its gap, which counts below
            best = solve_barrier(problem_of_cones)
        value = float(conic.objective(y))
        least = best.objective - (best.gap if np.isfinite(best.gap) else 0.0)
    else:
        y.requires_grad_()
        loss = _penalized(settings, problem, conic, y)
        (gradient,) = torch.autograd.grad(loss, y)
        hessian = 2.0 * conic.root.T @ conic.root
        value = loss.item()
        least = value - 0.5 * float(gradient @ torch.linalg.pinv(hessian, hermitian=True) @ gradient)
    return (value - least) / max(least, problem_of_cones.floor)


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


_BLOCKS, _EVERY, _FEWEST = 20, 4, 2  # of samples; one of how many is held out to weigh a residual module; for an error
CONVERGED = 0.01
"""Share of the least objective that one of a converged descent is above it at most."""
_SMALLER = "a smaller lr"
_BETTER = 1e-5  # least relative decrease that counts as an improvement
_DIVERGED = 1e6  # times the loss at the nominal parameters, or that of the stated noise if that is larger


@dataclass(frozen=True)
class Epoch:
    """Losses and figures of one epoch.

    Attributes:
        number: from 1.
        losses: means over the batches by term; "data" is the mean squared whitened residual, "total" the sum of all.
        held_out: mean squared whitened residual on the held-out logs after the epoch, None without any.
        objective: mean squared whitened residual on all training samples plus prior, of the parameters alone, after the
            epoch.
        closed_form: the least objective of any parameters, from `LeastSquares`.
        distance: rms difference of the projected whitened forces from those of the closed form.
        shares: rms of the projected whitened force of the parameters, and of the residual module, over that of the
            measured force, in the epoch.
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


@dataclass(frozen=True, repr=False)
class SgdEstimate(ConstrainedEstimate):
    """The result of a descent; objective and distance are those of the parameters alone.

    Attributes:
        epochs: number of epochs run.
        best_epoch: the epoch of these parameters.
        residual: effect of the residual module, None without one.
        excess: of the objective, penalties included, over the least one under the same conditions, as a share of this;
            None with a residual module.
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
    """A descent on mini-batches, preconditioned by the compressed problem, with or without a residual module.

    The same settings, logs and seeds give the same numbers, also if the state is saved after an epoch and loaded into a
    new trainer. Batches that processes share give all of them these numbers, up to the rounding of sums.
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
            problem: the compressed training logs: for the preconditioner, the prior, and the closed form. Of samples
                whose `motion_noise` is None: the descent sees them one by one, with whatever noise they have.
            batches: of the training logs.
            held_out: of logs for early stopping.
            residual: any module r(q, v, a) -> (B, n_rows) [N, N m], on the device of the batches, whose output adds to
                K phi; arguments as in `Batch`.
            data: the problem of the batches' rows alone, where `problem` has more, as known masses; None if it is that.

        Raises:
            InputError: an optimizer or a schedule that does not work with its options; conditions that exclude each
                other.
        """
        if batches.share[1] > 1 and (residual is not None or OPTIMIZERS[settings.optimizer["name"]].full_batch):
            found = f"a share of {batches.share[1]}, with a residual module or {settings.optimizer['name']}"
            raise ValueError(f"batches: {found}; accepted: whole batches")
        settings.try_out()
        self.settings, self.problem, self.batches, self.held_out = settings, problem, batches, held_out
        self._least_squares = settings.least_squares
        self.closed_form = self._least_squares.solve(problem)
        self._conic, self._data, device = settings.conic_problem(problem), data, batches.columns.device
        self._least = self._conic.unconstrained
        self.loss = Loss(settings, problem, batches, _learnable(settings, problem).to(device), residual, data)
        self._trained: list[list[nn.Parameter]] = [[self.loss.learnable.raw]]
        if residual is not None:
            self._trained.append([x for x in residual.parameters() if x.requires_grad])
        groups: list[dict[str, Any]] = [{"params": trained} for trained in self._trained]
        if residual is not None and settings.residual_lr is not None:
            groups[1]["lr"] = settings.residual_lr
        self.optimizer = make_optimizer(settings.optimizer, groups)
        self.schedule = make_schedule(settings.schedule, self.optimizer, settings.epochs)
        if not any(self._trained[1:]):
            self.loss.residual_weight = settings.residual_weight or 0.0  # nothing to regularize
        self.weight_choice: WeightChoice | None = None
        self.epoch, self.best_epoch, self.best_loss = 0, 0, float("inf")
        self._best = self._snapshot()

    def __repr__(self) -> str:
        return f"Trainer: epoch {self.epoch} of {self.settings.epochs}, {self.batches!r}"

    @property
    def finished(self) -> bool:
        """Whether all epochs are done or the held-out loss has stopped falling."""
        if self.epoch >= self.settings.epochs:
            return True
        module_later = self.loss.residual is not None and self.settings.residual == "parameters_first"
        last_improvement = max(
            self.best_epoch, self.settings.epochs // 2 if module_later else 0
        )  # before, the module has not been trained
        patience = self.settings.patience
        return patience is not None and self.held_out is not None and self.epoch - last_improvement >= patience

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
        if self.loss.residual_weight is None:
            self.choose_residual_weight()
        self.epoch += 1
        self._freeze()
        self.loss.train()
        rate, start = float(self.optimizer.param_groups[0]["lr"]), time.perf_counter()
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
        found, size = self._minimizer(), squares.pop("measured")
        with np.errstate(over="ignore", invalid="ignore"):
            self._require_converging(self._objective(found))  # after the last step: losses are those before it
        self._require_converging(0.0 if held_out is None else held_out)
        if not all(bool(x.isfinite().all()) for x in chain(*self._trained)):
            self._require_converging(float("nan"))  # of a module, in the last step
        self._unfreeze()
        self.loss.update_conditions()
        step_schedule(self.schedule, losses["total"] if held_out is None else held_out)
        if held_out is None or held_out < self.best_loss * (1.0 - _BETTER):
            self.best_epoch, self.best_loss = self.epoch, losses["total"] if held_out is None else held_out
            self._best = self._snapshot()
        return Epoch(
            number=self.epoch,
            losses=losses,
            held_out=held_out,
            objective=self._objective(found),
            closed_form=self._least or 0.0,
            distance=self.problem.prediction_distance(found.phi, self.closed_form.phi),
            shares={name: float(np.sqrt(x / size)) if size else 0.0 for name, x in squares.items()},
            learning_rate=rate,
            samples_per_second=self.batches.samples / elapsed,
        )

    def choose_residual_weight(self) -> WeightChoice:
        """Choose the weight of the residual module by held-out samples, in the first epoch if the settings give none.

        Starting from the parameters without the module, a copy of it is trained with each of `CANDIDATE_WEIGHTS` for
        half of the epochs. The held-out samples are the held-out logs or, without any, a quarter of the training
        samples, in blocks.

        Raises:
            InputError: too few samples, or the loss diverges with every weight.
        """
        train, blocks = self.batches, [] if self.held_out is None else self.held_out.split_blocks(_BLOCKS)
        if self.held_out is None:
            train, blocks = self.batches.hold_out(_BLOCKS, _EVERY)
        if len(blocks) < _FEWEST:
            found = f"{self.batches.samples} samples are too few to choose it"
            raise InputError("estimator", "residual_weight", found, "a number, or longer logs")
        with torch.random.fork_rng():
            without_module = self._trial(train, None, 0.0, self.settings.epochs)
            alone = without_module.run()
            start = without_module.loss.learnable.state_dict()
            losses = [self._trial_losses(train, weight, start, blocks) for weight in CANDIDATE_WEIGHTS]
        if not np.isfinite(losses).any():
            raise InputError("estimator", "training", "a loss that diverges with every residual_weight", _SMALLER)
        values = torch.from_numpy(np.append(alone.phi, [] if alone.psi is None else alone.psi))
        values = values.to(self.batches.columns.device)
        loss_without = float(np.mean([without_module.loss.mean_square(block, values) for block in blocks]))
        choice = choose_weight(CANDIDATE_WEIGHTS, np.array(losses), loss_without)
        self.weight_choice = replace(choice, alone_converged=alone.converged)
        self.loss.residual_weight = self.weight_choice.weight
        return self.weight_choice

    def _trial(self, train: MiniBatches, residual: nn.Module | None, weight: float, epochs: int) -> Trainer:
        """A trainer on some of the samples."""
        settings = replace(self.settings, residual_weight=weight, epochs=epochs, patience=None)
        share = train.samples / self.batches.samples
        data = None if self._data is None else self._data.fraction(share)
        return Trainer(settings, self.problem.fraction(share), train, residual=residual, data=data)

    def _trial_losses(
        self, train: MiniBatches, weight: float, start: Mapping[str, Tensor], blocks: Sequence[MiniBatches]
    ) -> list[float]:
        """Losses by block, after a descent with a copy of the module; infinite if it diverges."""
        trial = self._trial(train, copy.deepcopy(self.loss.residual), weight, max(self.settings.epochs // 2, 1))
        trial.loss.learnable.load_state_dict(start)
        try:
            while not trial.finished:
                trial.run_epoch()
        except InputError:
            return [float("inf")] * len(blocks)
        return [trial.loss.mean_square(block) for block in blocks]

    def phi(self) -> Array:
        """The current parameters, (12 L,)."""
        return self._minimizer().phi

    def _minimizer(self) -> Minimizer:
        with torch.no_grad():
            values = np.array(self.loss.learnable().cpu().numpy(), dtype=np.float64)
        phi, psi = np.split(values, [len(self.problem.nominal)])
        return Minimizer(phi, None if self.problem.terms is None else psi)

    def estimate(self) -> SgdEstimate:
        """The parameters, and residual module, of least held-out loss; without held-out logs the last ones.

        After the last epoch, without held-out logs or a module, those of the least objective on all samples. Statistics
        are those of least squares with the same ridge.
        """
        self.loss.load_state_dict(self._best)
        plain, found = self.closed_form, self._minimizer()
        if self.finished and self.held_out is None and self.loss.residual is None and self.settings.finish:
            found = finish(self.settings, self.problem, found)
        phi, psi = found
        return SgdEstimate(
            **(vars(plain) | {"phi": phi, "psi": psi, "cost": self.problem.cost(phi, psi)}),
            objective=self._objective(found),
            unconstrained=self._least,
            distance=self.problem.prediction_distance(phi, plain.phi),
            eigenvalues=parameters.least_eigenvalues(phi, self.problem.scale),
            epochs=self.epoch,
            best_epoch=self.best_epoch,
            residual=residual_effect(self.loss, self.problem, self.batches, self._least_squares, self.weight_choice),
            excess=None if self.loss.residual is not None else excess(self.settings, self.problem, found),
        )

    def state_dict(self) -> dict[str, Any]:
        """The state from which a new trainer with the same settings and logs resumes: plain types and tensors."""
        return {
            "learned": self._snapshot(),
            "best": self._best,
            "optimizer": copy.deepcopy(self.optimizer.state_dict()),  # torch returns references
            "schedule": None if self.schedule is None else copy.deepcopy(self.schedule.state_dict()),
            "random": [torch.get_rng_state(), *torch.cuda.get_rng_state_all()],
            "epoch": self.epoch,
            "best_epoch": self.best_epoch,
            "best_loss": self.best_loss,
            "residual_weight": self.loss.residual_weight,
            "weight_choice": None if self.weight_choice is None else vars(self.weight_choice),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from where `state_dict` was called.

        Raises:
            ValueError: a value that does not fit the settings. Torch raises its own errors for the states of optimizer
                and schedule.
        """
        validate_state(state, self.state_dict(), self.settings.epochs)
        self.loss.load_state_dict(state["learned"])
        self._best = state["best"]
        self._load_optimizer(copy.deepcopy(state["optimizer"]))
        if self.schedule is not None:
            self.schedule.load_state_dict(copy.deepcopy(state["schedule"]))
        torch.set_rng_state(state["random"][0])
        torch.cuda.set_rng_state_all(state["random"][1:])
        self.epoch, self.best_epoch = state["epoch"], state["best_epoch"]
        self.best_loss = float(state["best_loss"])
        self.loss.residual_weight, choice = state["residual_weight"], state["weight_choice"]
        self.weight_choice = None if choice is None else WeightChoice(**choice)

    def _load_optimizer(self, state: dict[str, Any]) -> None:
        """Load an optimizer's state, scalars in their saved precision (torch would widen those of NAdam)."""
        self.optimizer.load_state_dict(state)
        trained = [x for group in self.optimizer.param_groups for x in group["params"]]
        for index, saved in state["state"].items():
            own = self.optimizer.state[trained[index]]
            for name, value in saved.items():
                if isinstance(value, Tensor):
                    own[name] = own[name].to(value.dtype)

    def _snapshot(self) -> dict[str, Tensor]:
        return {name: x.detach().clone() for name, x in self.loss.state_dict().items()}

    def _deviations(self, found: Minimizer) -> Array:
        free, terms = self.problem.free, self.problem.terms
        y = ((found.phi - self.problem.nominal) / self.problem.scale)[free]
        return y if terms is None or found.psi is None else np.append(y, found.psi / terms.size)

    def _objective(self, found: Minimizer) -> float:
        """Mean squared whitened residual plus prior."""
        y = self._deviations(found)
        return self._conic.objective(np.asarray(np.linalg.solve(self._conic.deviations, y), dtype=np.float64))

    def _freeze(self) -> None:
        """Freeze the parameters or the residual module if they are not trained in this epoch."""
        if self.loss.residual is None:
            return
        first = self.epoch <= self.settings.epochs // 2
        trained_now = {
            "joint": (True, True),
            "parameters_first": (first, not first),
            "alternating": (self.epoch % 2 == 1, self.epoch % 2 == 0),
        }[self.settings.residual]
        for group, trained in zip(self._trained, trained_now, strict=True):
            for x in group:
                x.requires_grad_(trained)

    def _unfreeze(self) -> None:
        """Unfreeze all: another trainer may use the residual module next."""
        for x in chain(*self._trained):
            x.requires_grad_(True)

    def _require_converging(self, loss: float) -> None:
        if not loss <= _DIVERGED * max(1.0, self.problem.cost(self.problem.nominal) / max(self.problem.rows, 1)):
            name, rate = self.settings.optimizer["name"], float(self.optimizer.param_groups[0]["lr"])
            found = f"a loss of {loss:.3g} in epoch {self.epoch}, with {name} at lr {rate:.3g}"
            raise InputError("estimator", "training", found, _SMALLER)

    def _steps(self) -> Iterator[tuple[Callable[[], Iterable[tuple[Batch, int]]], int]]:
        """Batches of each step of an epoch with the number of samples of each, and of all of them."""
        if OPTIMIZERS[self.settings.optimizer["name"]].full_batch:
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
                part, share = self.loss(batch, size), size / samples
                (share * part.total()).backward()
                terms = terms.plus(part, share)
            if self.batches.share[1] > 1:
                terms = add_up(terms, list(chain(*self._trained)))
            if not OPTIMIZERS[self.settings.optimizer["name"]].full_batch:
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


def _learnable(settings: Sgd, problem: LinearProblem) -> LearnableParameters:
    learnable: LearnableParameters
    if settings.consistency == "log_cholesky":
        learnable, damping = LogCholeskyParameters(problem, settings.conditions.margin), settings.damping
    else:
        learnable, damping = FreeParameters(problem), settings.damping + settings.penalties.curvature
    learnable.precondition(problem, settings.ridge, damping)
    return learnable
