"""Mini-batch descent: optimizers, learnable parameters, settings, and the final step that meets the conditions."""

from __future__ import annotations

import inspect
import re
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import scipy.optimize
import torch
from torch import Tensor, nn
from torch.optim import Optimizer, lr_scheduler
from torch.optim.lr_scheduler import LRScheduler, ReduceLROnPlateau

from torchid import parameters
from torchid.errors import InputError, NumericalWarning, UnknownNameError
from torchid.estimators.conditions import Conditions
from torchid.estimators.conic import ConicProblem, Prior, build_conic_problem, solve_barrier
from torchid.estimators.consistent import Consistent
from torchid.estimators.least_squares import Minimizer, Regularized
from torchid.parallel import one_thread
from torchid.parameters import INERTIAL, PER_BODY, Array
from torchid.problem import LinearProblem
from torchid.reprs import short_repr
from torchid.settings import Count, NamedClass, NotNegative, Positive, validate_settings

Group = dict[str, Any]

_WHOLE_RUN = ("T_max", "total_steps")  # lengths that are the number of epochs unless given
_FAILURES = (ArithmeticError, AssertionError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
"""What torch's classes raise at options that they do not accept."""


OPTIMIZERS: dict[str, dict[str, Any]] = {
    "ASGD": {"lr": 1.0},
    "Adadelta": {"lr": 30.0},
    "Adafactor": {"lr": 0.1, "eps": (None, 1.0)},  # steps count in units of the second, not of parameters
    "Adagrad": {"lr": 0.5},
    "Adam": {"lr": 0.05},
    "AdamW": {"lr": 0.05},
    "Adamax": {"lr": 0.3},
    "LBFGS": {"line_search_fn": "strong_wolfe"},
    "NAdam": {"lr": 0.1},
    "RAdam": {"lr": 0.3},
    "RMSprop": {"lr": 0.05},
    "Rprop": {"lr": 0.2},
    "SGD": {"lr": 0.5},
}
"""The supported optimizers of torch, those that converge to the closed form (figures in docs/results.md).

With defaults of options that are not given: torch's own are for unknown curvature, while that of the preconditioned
parameters is near one.
"""

_PLAIN_SGD = {"momentum": 0.9, "nesterov": True}  # further defaults of SGD where no option is given

FULL_BATCH = ("LBFGS", "Rprop")
"""Optimizers that take all samples in every step, so that an epoch is one step.

A line search, or a memory of signs, compares gradients between steps, which differ randomly between mini-batches.
Gradients are then not clipped.
"""


def optimizer_names() -> list[str]:
    """Names of the supported optimizers of `torch.optim`."""
    return sorted(name for name in _classes(torch.optim, Optimizer) if name in OPTIMIZERS)


def schedule_names() -> list[str]:
    """Names of the classes in `torch.optim.lr_scheduler`."""
    return sorted(_classes(lr_scheduler, LRScheduler))


def make_optimizer(chosen: Mapping[str, Any], groups: Sequence[Group]) -> Optimizer:
    """Make an optimizer for parameter groups.

    Args:
        chosen: name and options; missing options are those of `OPTIMIZERS`.
        groups: parameter groups, as torch takes them.

    Raises:
        UnknownNameError: `torch.optim` has no such class.
        InputError: the class is not supported, or does not take an option.
    """
    name, cls, options = _class_and_options(chosen, torch.optim, Optimizer, "optimizer", optimizer_names())
    if name not in OPTIMIZERS:
        raise InputError("estimator", f"optimizer {name}", "not supported", ", ".join(optimizer_names()))
    if name == "LBFGS" and len(groups) > 1:  # it takes one group
        if any("lr" in group for group in groups):
            raise InputError("estimator", "residual_lr", "set, but LBFGS has only one lr", "null, or another optimizer")
        groups = [{"params": [x for group in groups for x in group["params"]]}]
    if name == "SGD":
        options = options or _PLAIN_SGD
    made: Optimizer = _construct(f"optimizer {name}", cls, list(groups), OPTIMIZERS[name] | options)
    return made


def make_schedule(chosen: Mapping[str, Any] | None, optimizer: Optimizer, epochs: int) -> LRScheduler | None:
    """Make a learning-rate schedule that is stepped once per epoch.

    Args:
        chosen: name and options; `T_max` and `total_steps` default to `epochs`. None for no schedule.
        optimizer: whose learning rate it sets.
        epochs: of the whole run.

    Raises:
        UnknownNameError: `torch.optim.lr_scheduler` has no such class.
        InputError: the class does not take an option, or needs one that a settings file cannot express.
    """
    if chosen is None:
        return None
    name, cls, options = _class_and_options(chosen, lr_scheduler, LRScheduler, "schedule", schedule_names())
    lengths = {key: epochs for key in _WHOLE_RUN if key in inspect.signature(cls).parameters}
    made: LRScheduler = _construct(f"schedule {name}", cls, optimizer, lengths | options)
    return made


def step_schedule(schedule: LRScheduler | None, loss: float) -> None:
    """End an epoch whose loss was `loss`."""
    if isinstance(schedule, ReduceLROnPlateau):
        schedule.step(loss)
    elif schedule is not None:
        schedule.step()


def _classes(module: Any, base: type) -> dict[str, Any]:
    members = inspect.getmembers(module, inspect.isclass)
    return {name: x for name, x in members if issubclass(x, base) and x is not base and not name.startswith("_")}


def _class_and_options(
    chosen: Mapping[str, Any], module: Any, base: type, kind: str, names: Sequence[str]
) -> tuple[str, Any, dict[str, Any]]:
    """Name, class and options of a choice. Raises UnknownNameError: the module has no such class."""
    options = dict(chosen)
    name = options.pop("name")
    classes = _classes(module, base)
    if name not in classes:
        same = [known for known in names if known.lower() == name.lower()]  # difflib does not match `sgd` to SGD
        raise UnknownNameError("estimator", kind, name, same or names)
    return name, classes[name], options


def _construct(field: str, cls: Any, first: Any, options: Mapping[str, Any]) -> Any:
    """Make an instance. Raises InputError: the class does not take the options."""
    try:
        return cls(first, **options)
    except _FAILURES as error:
        accepted = ", ".join(name for name in inspect.signature(cls).parameters if name not in ("params", "optimizer"))
        raise InputError("estimator", field, _short(error), f"options {accepted}") from error


def _short(error: Exception) -> str:
    text = str(error.args[0] if error.args else error)  # a KeyError's own text is a repr
    first = (text.splitlines() or [""])[0]
    return re.sub(r"\w+\.__init__\(\)", "", first).strip() or type(error).__name__


_LEAST_FRICTION = 0.01  # of its scale: initial friction if the URDF has none, since a softplus is never 0
_LEAST_EIGENVALUE = 1e-3  # above the margin: initial one of a body whose nominal eigenvalue is smaller


class LearnableParameters(nn.Module, ABC):
    """Parameters phi, (12 L,), and M terms as a function of `raw`, which is 0 at the nominal parameters.

    phi is a function of `preconditioner @ raw`: in units of `raw` the Hessian of the compressed problem is near the
    identity.
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
            size: number of variables of `constrained`.
        """
        super().__init__()
        for name in ("nominal", "scale", "free"):
            self.register_buffer(name, torch.from_numpy(np.array(getattr(problem, name))))
        terms = np.zeros(0) if problem.terms is None else problem.terms.size
        self.register_buffer("terms", torch.from_numpy(terms.copy()), persistent=bool(len(terms)))
        self.register_buffer("preconditioner", torch.eye(size + len(terms), dtype=torch.float64))
        self.raw = nn.Parameter(torch.zeros(size + len(terms), dtype=torch.float64))

    @abstractmethod
    def constrained(self, u: Tensor) -> Tensor:
        """Parameters (12 L,) at variables `u`."""

    def _with_terms(self, u: Tensor) -> Tensor:
        count = len(u) - len(self.terms)
        return torch.cat([self.constrained(u[:count]), self.terms * u[count:]])

    def forward(self) -> Tensor:
        """Phi and terms, (12 L + M,)."""
        return self._with_terms(self.preconditioner @ self.raw)

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
        self.preconditioner.copy_(_inverse_root(hessian, damping))


def _inverse_root(hessian: Tensor, damping: float) -> Tensor:
    """(H + damping I)^(-1/2) of a symmetric matrix, (n, n), whose negative eigenvalues are rounding."""
    values, vectors = torch.linalg.eigh(hessian)
    return vectors @ ((values.clamp_min(0.0) + damping).rsqrt()[:, None] * vectors.T)


class FreeParameters(LearnableParameters):
    """Parameters without conditions: nominal values plus scaled deviations of the free ones."""

    def __init__(self, problem: LinearProblem) -> None:
        """Start at the nominal parameters of a problem."""
        super().__init__(problem, int(problem.free.sum()))

    def constrained(self, u: Tensor) -> Tensor:
        """Parameters (12 L,) at deviations `u` of the free ones (F,)."""
        return self.nominal.masked_scatter(self.free, self.nominal[self.free] + self.scale[self.free] * u)


class LogCholeskyParameters(LearnableParameters):
    """Physically consistent parameters: scaled pseudo-inertias above a margin, positive friction.

    J = margin I + R R^T with R = R_0 M. R_0 is the Cholesky factor at the nominal parameters. M is lower triangular;
    its coordinates are the logarithms of its diagonal and its other entries, so M is the identity at 0. Friction is a
    softplus.

    Source: Rucker, Wensing, "Smooth parameterization of rigid-body inertia", RA-L 2022.
    """

    root: Tensor
    friction_start: Tensor

    def __init__(self, problem: LinearProblem, margin: float = Conditions.margin) -> None:
        """Start at the nominal parameters, with eigenvalues raised above the margin.

        Args:
            problem: its nominal parameters, scale and free parameters are used.
            margin: smallest eigenvalue of every free body's scaled pseudo-inertia.

        Raises:
            ValueError: a body has both free and fixed inertial parameters.
        """
        free = problem.free.reshape(-1, PER_BODY)
        bodies = problem.free_bodies()
        moving = np.zeros(free.shape, dtype=bool)
        moving[bodies, INERTIAL] = True
        frictional = (free & ~moving).ravel()
        super().__init__(problem, INERTIAL.stop * len(bodies) + int(frictional.sum()))
        self.margin = margin
        scaled = (problem.nominal / problem.scale).reshape(-1, PER_BODY)
        values, vectors = np.linalg.eigh(parameters.pseudo_inertia(scaled[bodies]))
        above = np.maximum(values - margin, _LEAST_EIGENVALUE)
        start = np.maximum(scaled.ravel()[frictional], _LEAST_FRICTION)
        rows, columns = np.tril_indices(4)
        arrays = {
            "root": np.linalg.cholesky((vectors * above[:, None]) @ vectors.transpose(0, 2, 1)),
            "friction_start": start + np.log(-np.expm1(-start)),
            "_from_pseudo": np.linalg.pinv(parameters.PSEUDO_BASIS.reshape(-1, 16).T),
            "_rows": rows,
            "_columns": columns,
            "_inertial": moving.ravel(),
            "_frictional": frictional,
        }
        for name, array in arrays.items():
            self.register_buffer(name, torch.from_numpy(np.array(array)))

    def constrained(self, u: Tensor) -> Tensor:
        """Parameters (12 L,) at log-Cholesky coordinates `u`: ten per body, then friction."""
        bodies = len(self.root)
        coordinates = u[: INERTIAL.stop * bodies].reshape(bodies, INERTIAL.stop)
        rows = self.get_buffer("_rows")
        columns = self.get_buffer("_columns")
        entries = torch.where(rows == columns, coordinates.exp(), coordinates)
        M = entries.new_zeros(bodies, 4, 4)
        M[:, rows, columns] = entries
        R = self.root @ M
        J = R @ R.mT + self.margin * torch.eye(4, dtype=u.dtype, device=u.device)
        ten = J.flatten(1) @ self.get_buffer("_from_pseudo").T
        friction = nn.functional.softplus(u[INERTIAL.stop * bodies :] + self.friction_start)
        inertial = self.get_buffer("_inertial")
        frictional = self.get_buffer("_frictional")
        phi = self.nominal.masked_scatter(inertial, ten.flatten() * self.scale[inertial])
        return phi.masked_scatter(frictional, friction * self.scale[frictional])


LEAST_LOGARITHM = 1e-4
"""Eigenvalue above the margin below which the barrier goes on as the tangent of its logarithm."""


@dataclass(frozen=True)
class PenaltyWeights:
    """Weights of the penalties that are added to the mean squared whitened residual.

    Attributes:
        eigenvalue: of the squared shortfall of the scaled pseudo-inertias' eigenvalues below the margin.
        log_det: of minus the logarithm of these eigenvalues above the margin (a barrier).
        mass: of squared negative masses, in units of their scale.
        friction: of squared negative friction, in units of its scale.
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
        basis = torch.from_numpy(parameters.PSEUDO_BASIS).to(scaled)
        eigenvalues = torch.linalg.eigvalsh(torch.tensordot(scaled[bodies][:, parameters.INERTIAL], basis, dims=1))
        if weights.eigenvalue:
            out["eigenvalue"] = weights.eigenvalue * (margin - eigenvalues).clamp_min(0.0).square().sum()
        if weights.log_det:
            above = eigenvalues - margin
            inside = above.clamp_min(LEAST_LOGARITHM)
            out["log_det"] = -weights.log_det * (inside.log() + (above - inside) / LEAST_LOGARITHM).sum()
    if weights.mass:
        out["mass"] = weights.mass * scaled[bodies, parameters.MASS].clamp_max(0.0).square().sum()
    if weights.friction:
        out["friction"] = weights.friction * scaled[:, parameters.FRICTION].clamp_max(0.0).square().sum()
    return out


Consistency = Literal["log_cholesky", "penalties"]


@dataclass(frozen=True)
class TrainingSettings:
    """Optimizer, learning-rate schedule and stopping rule of a descent.

    Attributes:
        epochs: largest number of passes over the logs.
        optimizer: name, one of `optimizer_names()`, and options of a class of `torch.optim`; defaults in `OPTIMIZERS`.
        schedule: name and options of a class of `torch.optim.lr_scheduler`, stepped once per epoch; None for none.
        patience: training stops after this number of epochs without a smaller loss on the held-out logs; None: never.
        clip: largest norm of a gradient.
        damping: of the preconditioner, in units of the mean squared whitened residual per squared scale.
        finish: whether to take, after the last epoch, the optimum on all samples. Only without held-out logs.
    """

    epochs: Count = 200
    optimizer: NamedClass = field(default_factory=lambda: {"name": "Adam"})
    schedule: NamedClass | None = field(default_factory=lambda: {"name": "CosineAnnealingLR"})
    patience: Count | None = None
    clip: Positive = 1.0
    damping: Positive = 1.0
    finish: bool = True

    def try_out(self) -> None:
        """Test the options early: take two steps on a parabola and run the schedule through all epochs.

        Raises:
            UnknownNameError: torch has no such optimizer or schedule.
            InputError: the options or the optimizer do not work here.
        """
        x = nn.Parameter(torch.ones(3, dtype=torch.float64))
        optimizer = make_optimizer(self.optimizer, [{"params": [x]}])
        schedule = make_schedule(self.schedule, optimizer, self.epochs)

        def loss() -> Tensor:
            optimizer.zero_grad()
            value = x.square().sum()
            value.backward()
            return value

        at = f"optimizer {self.optimizer['name']}"
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                for _ in range(2):
                    optimizer.step(loss)  # type: ignore[arg-type]  # torch's own documentation returns a tensor
            at = f"schedule {(self.schedule or {}).get('name')}"
            for _ in range(self.epochs):
                step_schedule(schedule, 1.0)
        except _FAILURES as error:
            raise InputError("estimator", at, f"fails: {_short(error)}", "other options, or another one") from error


@dataclass(frozen=True)
class Sgd(TrainingSettings, Regularized):
    """Mini-batch descent on the mean squared whitened residual + ridge * prior + penalties.

    Attributes:
        consistency: "log_cholesky": pseudo-inertias stay above the margin and friction stays positive in every step;
            all conditions hold at the end. "penalties": violations of the margin or these signs cost; there are no
            other conditions.
        prior, conditions: as in `Consistent`.
        penalties: weights, for "penalties".
        residual_lr: learning rate of a residual module; None for that of the optimizer.
        residual_weight: weight of the module's mean squared whitened force in the loss. A module that can fit any force
            fits the fraction 1 / (1 + residual_weight) of the residual.
    """

    consistency: Consistency = "log_cholesky"
    prior: Prior = "euclidean"
    conditions: Conditions = field(default_factory=Conditions)
    penalties: PenaltyWeights = field(default_factory=PenaltyWeights)
    residual_lr: Positive | None = None
    residual_weight: NotNegative = 0.1

    __repr__ = short_repr

    def conic_problem(self, problem: LinearProblem) -> ConicProblem:
        """Objective and conditions for the compressed samples."""
        return build_conic_problem(problem, self.conditions, self.ridge, self.prior)

    def learnable(self, problem: LinearProblem) -> LearnableParameters:
        """Learnable parameters with their preconditioner."""
        learnable: LearnableParameters = FreeParameters(problem)
        damping = self.damping + self.penalties.curvature
        if self.consistency == "log_cholesky":
            learnable = LogCholeskyParameters(problem, self.conditions.margin)
            damping = self.damping
        learnable.precondition(problem, self.ridge, damping)
        return learnable

    @property
    def consistent(self) -> Consistent:
        """The closed-form estimator with the same objective."""
        return Consistent(self.ridge, self.prior, self.conditions, rank_tolerance=self.rank_tolerance)


class Objective(nn.Module):
    """Part of a descent's objective without the data, and the quadratic on all samples, at scaled deviations y, (n,).

    y contains the free parameters and the problem's terms.
    """

    root: Tensor
    target: Tensor
    linear: Tensor
    log_det_weight: Tensor
    F0: Tensor
    F: Tensor
    variables: Tensor
    start: Tensor
    free: Tensor
    bodies: Tensor
    G: Tensor
    h: Tensor

    def __init__(self, settings: Sgd, problem: LinearProblem) -> None:
        """Of a descent's settings, and the compressed samples."""
        super().__init__()
        self._margin = settings.conditions.margin
        self._weights = settings.penalties
        conic = settings.conic_problem(problem)
        terms = problem.terms
        self.floor = conic.floor
        self.constant = conic.constant
        self._data_rows = min(len(problem.A) + (len(terms.C) if terms else 0), len(conic.linear))
        inverse = np.linalg.inv(conic.deviations)
        weighted = conic.weights > 0.0
        of_blocks = inverse[conic.variables[weighted][:, :, None], conic.variables[weighted][:, None, :]]
        bounded = {condition.name for condition in terms.conditions} if terms else set()
        rows = np.array([name in bounded for name in conic.names[len(conic.F0) :]], dtype=bool)
        arrays = {
            "root": conic.root @ inverse,
            "target": conic.target,
            "linear": inverse.T @ conic.linear,
            "log_det_weight": conic.weights[weighted],
            "F0": conic.F0[weighted],
            "F": np.einsum("kvw,kvij->kwij", of_blocks, conic.F[weighted]),
            "variables": conic.variables[weighted],
            "start": problem.nominal / problem.scale,
            "free": problem.free,
            "bodies": problem.free_bodies(),
            "G": conic.G[rows] @ inverse,
            "h": conic.h[rows],
        }
        for name, array in arrays.items():
            self.register_buffer(name, torch.from_numpy(np.array(array, order="C")), persistent=False)

    def prior(self, y: Tensor) -> Tensor:
        """What the ridge weights."""
        value = (self.root[self._data_rows :] @ y).square().sum() + self.linear @ y
        if not len(self.F0):
            return value
        blocks = self.F0 + (y[self.variables][..., None, None] * self.F).sum(1)
        return value - self.log_det_weight @ torch.linalg.eigvalsh(blocks).clamp_min(1e-300).log().sum(1)

    def penalties(self, y: Tensor) -> dict[str, Tensor]:
        """Of bodies, and of terms beyond their bounds, by name."""
        moved = self.start[self.free] + y[: int(self.free.sum())]
        scaled = self.start.masked_scatter(self.free, moved).unflatten(0, (-1, PER_BODY))
        out = penalties(scaled, self.bodies, self._margin, self._weights)
        if len(self.h):
            out["terms"] = self._weights.friction * (self.G @ y - self.h).clamp_max(0.0).square().sum()
        return out

    @property
    def hessian(self) -> Tensor:
        """Of the quadratic on all samples, (n, n)."""
        return 2.0 * self.root.T @ self.root

    def slope(self, y: Array) -> tuple[float, Array]:
        """The quadratic on all samples with penalties: value and gradient."""
        at = torch.from_numpy(np.array(y)).requires_grad_()
        value = (self.root @ at - self.target).square().sum() + self.linear @ at + self.constant
        value = value + sum(self.penalties(at).values())
        (gradient,) = torch.autograd.grad(value, at)
        return value.item(), gradient.numpy()


_LBFGS_OPTIONS = {"maxiter": 3000, "maxcor": 30, "ftol": 0.0, "gtol": 1e-12}


@one_thread()
def least_penalized(settings: Sgd, problem: LinearProblem, start: Minimizer) -> Minimizer:
    """The parameters of the least objective with penalties on all samples, by preconditioned L-BFGS.

    Args:
        settings: of the descent.
        problem: the compressed samples.
        start: where the descent ended.
    """
    penalized = Objective(settings, problem)
    y = deviations(problem, start)
    damping = 1e-6 * float(penalized.hessian.diagonal().max()) + settings.penalties.curvature
    P = _inverse_root(penalized.hessian, damping).numpy()

    def loss(u: Array) -> tuple[float, Array]:
        value, gradient = penalized.slope(y + P @ u)
        return value, P @ gradient

    y = y + P @ scipy.optimize.minimize(loss, np.zeros(len(y)), jac=True, method="L-BFGS-B", options=_LBFGS_OPTIONS).x
    count = int(problem.free.sum())
    phi = problem.nominal.copy()
    phi[problem.free] += problem.scale[problem.free] * y[:count]
    return Minimizer(phi, None if problem.terms is None else y[count:] * problem.terms.size)


_MET = 1e-9  # violation of a condition, in units of the scale, that is rounding


def nearest_allowed(settings: Sgd, problem: LinearProblem, minimizer: Minimizer) -> Minimizer:
    """The feasible parameters nearest to the result of a descent.

    The distance is the change of the mean squared whitened residual plus ridge.
    """
    conic = settings.conic_problem(problem)
    x = np.asarray(np.linalg.solve(conic.deviations, deviations(problem, minimizer)), dtype=np.float64)
    if conic.slack(x).min(initial=0.0) >= -_MET and np.abs(conic.E @ x - conic.e).max(initial=0.0) <= _MET:
        return minimizer
    terms = problem.terms
    moved = replace(problem, nominal=minimizer.phi, b=problem.A @ minimizer.phi, residual=0.0)
    if terms is not None and minimizer.psi is not None:
        moved = replace(moved, terms=replace(terms, z=terms.C @ minimizer.phi + terms.D @ minimizer.psi))
    return replace(settings.consistent, prior="euclidean").minimize(moved)


def deviations(problem: LinearProblem, minimizer: Minimizer) -> Array:
    """Deviations of the free parameters and terms in units of their scale, (n,)."""
    y = ((minimizer.phi - problem.nominal) / problem.scale)[problem.free]
    if problem.terms is None or minimizer.psi is None:
        return np.asarray(y)
    return np.append(y, minimizer.psi / problem.terms.size)


@one_thread()
def excess(settings: Sgd, problem: LinearProblem, minimizer: Minimizer) -> float:
    """Upper bound of the relative excess of a minimizer's objective over the least objective.

    The least objective is that of the interior-point method. With penalties, which only add to the quadratic, the
    gradient gives a lower bound of it.
    """
    if settings.consistency == "penalties":
        penalized = Objective(settings, problem)
        value, slope = penalized.slope(deviations(problem, minimizer))
        least = value - 0.5 * float(slope @ np.linalg.pinv(penalized.hessian.numpy(), hermitian=True) @ slope)
        return (value - least) / max(least, penalized.floor)
    conic = settings.conic_problem(problem)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)  # of its gap, which counts below
        best = solve_barrier(conic)
    x = np.asarray(np.linalg.solve(conic.deviations, deviations(problem, minimizer)), dtype=np.float64)
    value = conic.objective(x)
    least = best.objective - (best.gap if np.isfinite(best.gap) else 0.0)
    return (value - least) / max(least, conic.floor)
