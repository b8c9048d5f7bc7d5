"""Mini-batch descent: optimizers, learnable parameters, settings, penalties, loss, and the check of a saved state."""

from __future__ import annotations

import inspect
import re
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim import Optimizer, lr_scheduler
from torch.optim.lr_scheduler import LRScheduler, ReduceLROnPlateau

from torchid import distributed, parameters
from torchid.errors import InputError, UnknownNameError
from torchid.estimators.conditions import Conditions
from torchid.estimators.conic_problem import ConicLoss, ConicProblem, Prior, build_conic_problem
from torchid.estimators.least_squares import Regularized
from torchid.parallel import one_thread
from torchid.parameters import PER_BODY
from torchid.problem import Batch, LinearProblem, MiniBatches
from torchid.reprs import short_repr
from torchid.settings import Count, NamedClass, NotNegative, Positive, validate_settings

Group = dict[str, Any]

_WHOLE_RUN = ("T_max", "total_steps")  # lengths that are the number of epochs unless given
_UNSUITED = {"SparseAdam": "takes sparse gradients alone", "Muon": "takes matrices alone"}
_FAILURES = (ArithmeticError, AssertionError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
"""What torch's classes raise at options that they do not accept."""


@dataclass(frozen=True)
class OptimizerUse:
    """How an optimizer of torch is used for the preconditioned parameters.

    Attributes:
        defaults: of options that are not given. Torch's own are for unknown curvature; that of the preconditioned
            parameters is near one.
        alone: further defaults if no option is given.
        full_batch: whether every step takes all samples, so that an epoch is one step: a line search or a memory of
            signs compares gradients between steps, which differ randomly between mini-batches. Gradients are then not
            clipped.
    """

    defaults: Mapping[str, Any] = field(default_factory=dict)
    alone: Mapping[str, Any] = field(default_factory=dict)
    full_batch: bool = False


OPTIMIZERS: dict[str, OptimizerUse] = {
    "ASGD": OptimizerUse({"lr": 1.0}),
    "Adadelta": OptimizerUse({"lr": 30.0}),
    "Adafactor": OptimizerUse({"lr": 0.1, "eps": (None, 1.0)}),  # steps count in units of the second, not of parameters
    "Adagrad": OptimizerUse({"lr": 0.5}),
    "Adam": OptimizerUse({"lr": 0.05}),
    "AdamW": OptimizerUse({"lr": 0.05}),
    "Adamax": OptimizerUse({"lr": 0.3}),
    "LBFGS": OptimizerUse({"line_search_fn": "strong_wolfe"}, full_batch=True),
    "NAdam": OptimizerUse({"lr": 0.1}),
    "RAdam": OptimizerUse({"lr": 0.3}),
    "RMSprop": OptimizerUse({"lr": 0.05}),
    "Rprop": OptimizerUse({"lr": 0.2}, full_batch=True),
    "SGD": OptimizerUse({"lr": 0.5}, {"momentum": 0.9, "nesterov": True}),
}
"""The supported optimizers: those that converge to the closed form (figures in docs/measurements.md)."""


def optimizer_names() -> list[str]:
    """Names of the classes in `torch.optim` that are supported: those in `OPTIMIZERS` that this torch has."""
    return sorted(name for name, _ in _classes(torch.optim, Optimizer) if name in OPTIMIZERS)


def schedule_names() -> list[str]:
    """Names of the classes in `torch.optim.lr_scheduler`."""
    return sorted(name for name, _ in _classes(lr_scheduler, LRScheduler))


def make_optimizer(chosen: Mapping[str, Any], groups: Sequence[Group]) -> Optimizer:
    """An optimizer of parameter groups.

    Args:
        chosen: its name, and options; those that are not given are as in `OPTIMIZERS`.
        groups: of parameters, as torch takes them.

    Raises:
        UnknownNameError: no class of `torch.optim`, or one that is not supported.
        InputError: an option it does not take.
    """
    name, options = _split(chosen)
    cls = dict(_classes(torch.optim, Optimizer)).get(name)
    if cls is not None and name not in OPTIMIZERS:
        accepted = ", ".join(optimizer_names())
        raise InputError("estimator", f"optimizer {name}", _UNSUITED.get(name, "not supported"), accepted)
    if cls is None:
        raise _unknown("optimizer", name, optimizer_names())
    if name == "LBFGS" and len(groups) > 1:  # it takes one group
        if any("lr" in group for group in groups):
            raise InputError(
                "estimator", "residual_lr", "set, but LBFGS has one lr for all", "None, or another optimizer"
            )
        groups = [{"params": [x for group in groups for x in group["params"]]}]
    use = OPTIMIZERS[name]
    try:
        return cls(list(groups), **{**use.defaults, **(options or use.alone)})
    except _FAILURES as error:
        raise InputError("estimator", f"optimizer {name}", _short(error), _accepted(cls)) from error


def make_schedule(chosen: Mapping[str, Any] | None, optimizer: Optimizer, epochs: int) -> LRScheduler | None:
    """A schedule that is stepped once per epoch.

    Args:
        chosen: its name, and options, of which `T_max` and `total_steps` are `epochs` unless given; None for none.
        optimizer: whose learning rate it sets.
        epochs: of the whole run.

    Raises:
        UnknownNameError: `torch.optim.lr_scheduler` has no such class.
        InputError: an option it does not take, or one that a settings file cannot express.
    """
    if chosen is None:
        return None
    name, options = _split(chosen)
    cls = dict(_classes(lr_scheduler, LRScheduler)).get(name)
    if cls is None:
        raise _unknown("schedule", name, schedule_names())
    lengths = {key: epochs for key in _WHOLE_RUN if key in inspect.signature(cls).parameters}
    try:
        return cls(optimizer, **{**lengths, **options})
    except _FAILURES as error:
        raise InputError("estimator", f"schedule {name}", _short(error), _accepted(cls)) from error


def step_schedule(schedule: LRScheduler | None, loss: float) -> None:
    """End an epoch whose loss was `loss`."""
    if isinstance(schedule, ReduceLROnPlateau):
        schedule.step(loss)
    elif schedule is not None:
        schedule.step()


def try_out(optimizer: Mapping[str, Any], schedule: Mapping[str, Any] | None, epochs: int) -> None:
    """Take two steps on a parabola and run the schedule through all epochs, so that invalid options fail early.

    Arguments as of `make_optimizer` and `make_schedule`.

    Raises:
        UnknownNameError: a name that torch does not have.
        InputError: options, or a kind of optimizer, that do not work here.
    """
    x = torch.nn.Parameter(torch.ones(3, dtype=torch.float64))
    trial = make_optimizer(optimizer, [{"params": [x]}])
    trial_schedule = make_schedule(schedule, trial, epochs)

    def loss() -> torch.Tensor:
        trial.zero_grad()
        value = x.square().sum()
        value.backward()
        return value

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for _ in range(2):
                trial.step(loss)  # type: ignore[arg-type]  # torch's own documentation returns a tensor
    except _FAILURES as error:
        found = f"cannot take a step: {_short(error)}"
        raise InputError("estimator", f"optimizer {optimizer['name']}", found, "other options") from error
    try:
        for _ in range(epochs):
            step_schedule(trial_schedule, 1.0)
    except _FAILURES as error:
        found, name = f"fails within {epochs} epochs: {_short(error)}", (schedule or {}).get("name")
        raise InputError("estimator", f"schedule {name}", found, "other options, or another schedule") from error


def _split(chosen: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    options = dict(chosen)
    return options.pop("name"), options


def _classes(module: Any, base: type) -> list[tuple[str, Any]]:
    members = inspect.getmembers(module, inspect.isclass)
    return [(name, x) for name, x in members if issubclass(x, base) and x is not base and not name.startswith("_")]


def _unknown(field: str, name: str, names: Sequence[str]) -> UnknownNameError:
    """Error for an unknown name; it suggests one that differs in case only (difflib does not match `sgd` to SGD)."""
    same = [known for known in names if known.lower() == name.lower()]
    return UnknownNameError("estimator", field, name, same or names)


def _accepted(cls: Any) -> str:
    options = [name for name in inspect.signature(cls).parameters if name not in ("params", "optimizer")]
    return f"options {', '.join(options)}"


def _short(error: Exception) -> str:
    text = str(error.args[0] if error.args else error)  # a KeyError's own text is a repr
    first = (text.splitlines() or [""])[0]
    return re.sub(r"\w+\.__init__\(\)", "", first).strip() or type(error).__name__


_LEAST_FRICTION = 0.01  # of its scale: initial friction if the URDF has none, since a softplus is never 0
_LEAST_EIGENVALUE = 1e-3  # above the margin: initial one of a body whose nominal eigenvalue is smaller


class LearnableParameters(nn.Module, ABC):
    """phi, (12 L,), and M terms, if the problem has any, as a function of `raw`, which is 0 at the nominal parameters.

    In the units of `raw` the compressed problem's Hessian is near the identity: phi is a function of
    `preconditioner @ raw`.
    """

    nominal: Tensor
    scale: Tensor
    free: Tensor
    terms: Tensor
    preconditioner: Tensor

    def __init__(self, problem: LinearProblem, size: int) -> None:
        """Start at the nominal parameters, without a preconditioner.

        Args:
            problem: its nominal parameters, scale and free parameters are used.
            size: of `raw`.
        """
        super().__init__()
        self.register_buffer("nominal", torch.from_numpy(problem.nominal.copy()))
        self.register_buffer("scale", torch.from_numpy(problem.scale.copy()))
        self.register_buffer("free", torch.from_numpy(problem.free.copy()))
        terms = np.zeros(0) if problem.terms is None else problem.terms.size
        self.register_buffer("terms", torch.from_numpy(terms.copy()), persistent=bool(len(terms)))
        self.register_buffer("preconditioner", torch.eye(size + len(terms), dtype=torch.float64))
        self.raw = nn.Parameter(torch.zeros(size + len(terms), dtype=torch.float64))

    @abstractmethod
    def constrained(self, u: Tensor) -> Tensor:
        """phi, (12 L,), at the first `size` entries of `preconditioner @ raw`."""

    def _with_terms(self, u: Tensor) -> Tensor:
        count = len(u) - len(self.terms)
        return torch.cat([self.constrained(u[:count]), self.terms * u[count:]])

    def forward(self) -> Tensor:
        """Phi and terms, (12 L + M,)."""
        return self._with_terms(self.preconditioner @ self.raw)

    def deviations(self, values: Tensor) -> Tensor:
        """What `forward` gives as deviations of the free parameters, and the terms, in units of their scale."""
        scaled = (values[: len(self.free)] - self.nominal) / self.scale
        return torch.cat([scaled[self.free], values[len(self.free) :] / self.terms])

    @one_thread()  # on a busy machine two took up to 1.4 s instead of 3 ms
    def precondition(self, problem: LinearProblem, ridge: float, damping: float) -> None:
        """Set the preconditioner to (H + damping I)^(-1/2).

        H is the Gauss-Newton Hessian at the nominal parameters of the mean squared residual plus ridge, in the
        variables of `constrained`. Without it first-order methods need some 1e10 steps at condition number 1e5. Without
        damping, steps along directions that the data hardly excite would be too long.
        """
        start = torch.zeros_like(self.raw)
        slopes = torch.autograd.functional.jacobian(self._with_terms, start, vectorize=True).cpu()
        data = torch.from_numpy(problem.A) @ slopes[: len(self.free)]
        if problem.terms is not None:
            data = torch.cat([data, torch.from_numpy(np.hstack([problem.terms.C, problem.terms.D])) @ slopes])
        prior = slopes[: len(self.free)] / self.scale.cpu()[:, None]
        hessian = 2.0 * (data.T @ data / max(problem.rows, 1) + ridge * prior.T @ prior)
        self.preconditioner.copy_(precondition_by(hessian, damping))

    def by_body(self, phi: Tensor) -> Tensor:
        """Parameters in units of their scale, (L, 12)."""
        return (phi[: len(self.free)] / self.scale).unflatten(0, (-1, PER_BODY))


def precondition_by(hessian: Tensor, damping: float) -> Tensor:
    """(H + damping I)^(-1/2) of a symmetric matrix, (n, n), whose negative eigenvalues are rounding."""
    values, vectors = torch.linalg.eigh(hessian)
    return vectors @ ((values.clamp_min(0.0) + damping).rsqrt()[:, None] * vectors.T)


class FreeParameters(LearnableParameters):
    """Any phi, an affine function of `raw`."""

    def __init__(self, problem: LinearProblem) -> None:
        super().__init__(problem, int(problem.free.sum()))

    def constrained(self, u: Tensor) -> Tensor:
        """Nominal parameters (P,) plus `u`, of the free ones (F,), in units of the scale."""
        return self.nominal.masked_scatter(self.free, self.nominal[self.free] + self.scale[self.free] * u)


class LogCholeskyParameters(LearnableParameters):
    """Only physically consistent phi: scaled pseudo-inertias above a margin, positive friction.

    J = margin I + R R^T with R = R_0 M, where R_0 is the Cholesky factor at the nominal parameters and M is lower
    triangular with the logarithms of its diagonal and its other entries as coordinates, so that M is the identity where
    they are 0. Friction is a softplus.

    Source: Rucker, Wensing, "Smooth parameterization of rigid-body inertia", RA-L 2022.
    """

    root: Tensor
    friction_start: Tensor

    def __init__(self, problem: LinearProblem, margin: float = Conditions.margin) -> None:
        """Start at the nominal parameters, with eigenvalues raised above the margin.

        Args:
            problem: the problem.
            margin: least eigenvalue of every free body's scaled pseudo-inertia.

        Raises:
            ValueError: inertial parameters that are not free body by body.
        """
        free = problem.free.reshape(-1, PER_BODY)
        bodies = problem.free_bodies()
        super().__init__(problem, parameters.INERTIAL.stop * len(bodies) + int(free[:, parameters.FRICTION].sum()))
        self.margin = margin
        scaled = (problem.nominal / problem.scale).reshape(-1, PER_BODY)
        values, vectors = np.linalg.eigh(parameters.pseudo_inertia(scaled[bodies]))
        above = np.maximum(values - margin, _LEAST_EIGENVALUE)
        nominal = torch.from_numpy((vectors * above[:, None]) @ vectors.transpose(0, 2, 1))
        self.register_buffer("root", torch.linalg.cholesky(nominal))
        self.register_buffer(
            "_from_pseudo", torch.from_numpy(np.linalg.pinv(parameters.PSEUDO_BASIS.reshape(-1, 16).T))
        )
        rows, columns = np.tril_indices(4)
        self.register_buffer("_rows", torch.from_numpy(rows))
        self.register_buffer("_columns", torch.from_numpy(columns))
        moving = np.zeros(free.shape, dtype=bool)
        moving[bodies, parameters.INERTIAL] = True
        self.register_buffer("_inertial", torch.from_numpy(moving.ravel()))
        self.register_buffer("_frictional", torch.from_numpy((free & ~moving).ravel()))
        start = np.maximum(scaled.ravel()[(free & ~moving).ravel()], _LEAST_FRICTION)
        self.register_buffer("friction_start", torch.from_numpy(start + np.log(-np.expm1(-start))))

    def constrained(self, u: Tensor) -> Tensor:
        """Parameters of the bodies with log-Cholesky coordinates `u`, ten by body, then friction."""
        bodies = len(self.root)
        coordinates = u[: parameters.INERTIAL.stop * bodies].reshape(bodies, parameters.INERTIAL.stop)
        rows, columns = self.get_buffer("_rows"), self.get_buffer("_columns")
        entries = torch.where(rows == columns, coordinates.exp(), coordinates)
        M = entries.new_zeros(bodies, 4, 4)
        M[:, rows, columns] = entries
        R = self.root @ M
        J = R @ R.mT + self.margin * torch.eye(4, dtype=u.dtype, device=u.device)
        ten = J.flatten(1) @ self.get_buffer("_from_pseudo").T
        friction = nn.functional.softplus(u[parameters.INERTIAL.stop * bodies :] + self.friction_start)
        inertial, frictional = self.get_buffer("_inertial"), self.get_buffer("_frictional")
        phi = self.nominal.masked_scatter(inertial, ten.flatten() * self.scale[inertial])
        return phi.masked_scatter(frictional, friction * self.scale[frictional])


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
