"""Optimizers and learning-rate schedules of `torch.optim` by name, tried out before any work depends on them."""

from __future__ import annotations

import inspect
import re
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch.optim import Optimizer, lr_scheduler
from torch.optim.lr_scheduler import LRScheduler, ReduceLROnPlateau

from torchid.errors import InputError, UnknownNameError

Group = dict[str, Any]

_WHOLE_RUN = ("T_max", "total_steps")  # lengths that are the number of epochs unless given
_FAILURES = (ArithmeticError, AssertionError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
"""What torch's classes have been seen to raise at options that cannot be."""


def optimizer_names() -> list[str]:
    """Names of the classes in `torch.optim`."""
    return sorted(name for name, _ in _classes(torch.optim, Optimizer))


def schedule_names() -> list[str]:
    """Names of the classes in `torch.optim.lr_scheduler`."""
    return sorted(name for name, _ in _classes(lr_scheduler, LRScheduler))


def make_optimizer(name: str, options: Mapping[str, Any], groups: Sequence[Group]) -> Optimizer:
    """An optimizer of parameter groups.

    Raises:
        UnknownNameError: `torch.optim` has no such class.
        InputError: an option it does not take.
    """
    found = dict(_classes(torch.optim, Optimizer)).get(name)
    if found is None:
        raise _unknown("optimizer", name, optimizer_names())
    try:
        return found(list(groups), **options)
    except _FAILURES as error:
        raise InputError("estimator", f"optimizer {name}", _short(error), _accepted(found)) from error


def make_schedule(
    name: str | None, options: Mapping[str, Any], optimizer: Optimizer, epochs: int
) -> LRScheduler | None:
    """A schedule that is stepped once per epoch; `T_max` and `total_steps` are `epochs` unless given.

    Raises:
        UnknownNameError: `torch.optim.lr_scheduler` has no such class.
        InputError: an option it does not take, or one that only code can give.
    """
    if name is None:
        return None
    found = dict(_classes(lr_scheduler, LRScheduler)).get(name)
    if found is None:
        raise _unknown("schedule", name, schedule_names())
    lengths = {key: epochs for key in _WHOLE_RUN if key in inspect.signature(found).parameters}
    try:
        return found(optimizer, **{**lengths, **options})
    except _FAILURES as error:
        raise InputError("estimator", f"schedule {name}", _short(error), _accepted(found)) from error


def step_schedule(schedule: LRScheduler | None, loss: float) -> None:
    """End an epoch whose loss was `loss`."""
    if isinstance(schedule, ReduceLROnPlateau):
        schedule.step(loss)
    elif schedule is not None:
        schedule.step()


def try_out(
    optimizer: str, options: Mapping[str, Any], schedule: str | None, schedule_options: Mapping[str, Any], epochs: int
) -> None:
    """Take two steps on a parabola and the schedule through all epochs, so that what does not work is known at once.

    Raises:
        UnknownNameError: a name that torch does not have.
        InputError: options, or a kind of optimizer, that do not work here.
    """
    x = torch.nn.Parameter(torch.ones(3, dtype=torch.float64))
    tried = make_optimizer(optimizer, options, [{"params": [x]}])
    schedule_of = make_schedule(schedule, schedule_options, tried, epochs)

    def loss() -> torch.Tensor:
        tried.zero_grad()
        value = x.square().sum()
        value.backward()
        return value

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for _ in range(2):
                tried.step(loss)  # type: ignore[arg-type]  # torch's own documentation returns a tensor
    except _FAILURES as error:
        found = f"cannot take a step: {_short(error)}"
        raise InputError("estimator", f"optimizer {optimizer}", found, "another, for example Adam") from error
    try:
        for _ in range(epochs):
            step_schedule(schedule_of, 1.0)
    except _FAILURES as error:
        found = f"does not last {epochs} epochs: {_short(error)}"
        raise InputError("estimator", f"schedule {schedule}", found, "other options, or another schedule") from error


def _classes(module: Any, base: type) -> list[tuple[str, Any]]:
    found = inspect.getmembers(module, inspect.isclass)
    return [(name, x) for name, x in found if issubclass(x, base) and x is not base and not name.startswith("_")]


def _unknown(field: str, name: str, names: Sequence[str]) -> UnknownNameError:
    """The refusal of a name; one that is right but for its case is the nearest (`sgd` is like no name to difflib)."""
    same = [known for known in names if known.lower() == name.lower()]
    return UnknownNameError("estimator", field, name, same or names)


def _accepted(found: Any) -> str:
    options = [name for name in inspect.signature(found).parameters if name not in ("params", "optimizer")]
    return f"options {', '.join(options)}"


def _short(error: Exception) -> str:
    text = str(error.args[0] if error.args else error)  # a KeyError's own text is a repr
    first = (text.splitlines() or [""])[0]
    return re.sub(r"\w+\.__init__\(\)", "", first).strip() or type(error).__name__
