"""Optimizers and learning-rate schedules of `torch.optim`, by name, and a test of their options."""

from __future__ import annotations

import inspect
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch.optim import Optimizer, lr_scheduler
from torch.optim.lr_scheduler import LRScheduler, ReduceLROnPlateau

from torchid.errors import InputError, UnknownNameError

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
