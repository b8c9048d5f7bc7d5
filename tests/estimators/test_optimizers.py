"""Whatever `torch.optim` has works by its name or is refused in one line before any work depends on it."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from descents import demo
from torch.optim import Optimizer

from torchid.errors import InputError, UnknownNameError
from torchid.estimators import Sgd, Trainer
from torchid.estimators.sgd import make_optimizer, make_schedule, optimizer_names, schedule_names, step_schedule

REFUSED = {"SparseAdam", "Muon"}  # the latter since torch 2.9
EPOCHS_OF = {"LBFGS": 3, "ASGD": 40, "Rprop": 40}
SCHEDULES: dict[str, dict[str, Any]] = {
    "ConstantLR": {"total_iters": 3},
    "CosineAnnealingLR": {},
    "CosineAnnealingWarmRestarts": {"T_0": 4},
    "CyclicLR": {"base_lr": 0.01, "max_lr": 0.1},
    "ExponentialLR": {"gamma": 0.9},
    "LinearLR": {"total_iters": 3},
    "MultiStepLR": {"milestones": [2, 5]},
    "OneCycleLR": {"max_lr": 0.1},
    "PolynomialLR": {"total_iters": 30},
    "ReduceLROnPlateau": {"patience": 1},
    "StepLR": {"step_size": 3},
}
ONLY_CODE = {"ChainedScheduler", "LambdaLR", "MultiplicativeLR", "SequentialLR"}
EPOCHS = 12


def one_line(error: BaseException) -> str:
    message = str(error)
    assert "\n" not in message
    assert "; accepted: " in message
    return message


def refused(**settings: Any) -> str:
    descent = Sgd(**settings)
    with pytest.raises(InputError) as raised:
        descent.try_out()
    return one_line(raised.value)


def parabola(name: str, **options: Any) -> tuple[Optimizer, torch.nn.Parameter]:
    x = torch.nn.Parameter(torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64))
    return make_optimizer({"name": name, **options}, [{"params": [x]}]), x


def rates(name: str, options: dict[str, Any], epochs: int = EPOCHS, losses: list[float] | None = None) -> list[float]:
    """The learning rate in every epoch."""
    optimizer, x = parabola("Adam", lr=0.05)
    schedule, out = make_schedule({"name": name, **options}, optimizer, epochs), []
    x.grad = torch.zeros_like(x)
    for epoch in range(epochs):
        out.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        step_schedule(schedule, 1.0 if losses is None else losses[epoch])
    return out


# --------------------------------------------------------------------------------------------------------- optimizers


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_an_optimizer_of_torch_that_cannot_do_it_is_refused_by_those_that_can(name: str) -> None:
    accepted = refused(optimizer={"name": name}).split("; accepted: ")[1]
    assert accepted.split(", ") == optimizer_names()


@pytest.mark.parametrize("name", optimizer_names())
def test_every_supported_optimizer_comes_near_the_closed_form_by_its_name_alone(name: str) -> None:
    """Share of the way from the URDF that is left after so few epochs: most 3e-4 to 7e-4, Adam 4e-3, RAdam 7e-3."""
    w = demo()
    estimate = Trainer(Sgd(0.001, optimizer={"name": name}, epochs=EPOCHS_OF.get(name, 15)), w.problem, w.batches).run()
    whole = w.problem.cost(w.problem.nominal) / w.problem.rows - estimate.unconstrained
    assert 0.0 < estimate.objective - estimate.unconstrained < 0.01 * whole


@pytest.mark.parametrize(
    ("name", "nearest"),
    [("Adm", "Adam"), ("adam", "Adam"), ("ADAMW", "AdamW"), ("RMSProp", "RMSprop"), ("lbfgs", "LBFGS"), ("sgd", "SGD")],
)
def test_a_misspelt_optimizer_is_refused_by_the_nearest_names(name: str, nearest: str) -> None:
    with pytest.raises(UnknownNameError) as raised:
        Sgd(optimizer={"name": name}).try_out()
    message = one_line(raised.value)
    assert f"optimizer: unknown name '{name}'" in message
    assert nearest in message.split("accepted: ")[1].split(", ")


def test_an_option_that_does_not_exist_is_refused_by_those_that_do() -> None:
    message = refused(optimizer={"name": "SGD", "lr": 0.1, "momentun": 0.9})
    assert "momentun" in message
    assert {"lr", "momentum", "weight_decay", "nesterov"} <= set(message.split("options ")[1].split(", "))
    message = refused(schedule={"name": "ExponentialLR", "gama": 0.9})
    assert "gama" in message
    assert message.endswith("accepted: options gamma, last_epoch")


@pytest.mark.parametrize(
    "options",
    [
        {"lr": -1.0}, {"lr": float("nan")}, {"lr": "fast"}, {"lr": None}, {"betas": 3}, {"betas": [0.9]},
        {"betas": [0.9, 1.5]}, {"weight_decay": [1.0]}, {"eps": "x"}, {"params": 3}, {"differentiable": True},
        {"fused": True, "foreach": True}, {"capturable": True},
    ],
    ids=str,
)  # fmt: skip
def test_options_that_cannot_be_are_refused(options: dict[str, Any]) -> None:
    assert "estimator: optimizer Adam: " in refused(optimizer={"name": "Adam", **options})


# ---------------------------------------------------------------------------------------------------------- schedules


@pytest.mark.parametrize("name", schedule_names())
def test_every_schedule_of_torch_lasts_all_epochs_by_its_name_or_is_refused(name: str) -> None:
    if name in ONLY_CODE:
        for options in ({}, {"schedulers": [], "milestones": []}, {"lr_lambda": "x"}):
            assert f"schedule {name}" in refused(schedule={"name": name, **options})
        return
    Sgd(schedule={"name": name, **SCHEDULES[name]}, epochs=EPOCHS).try_out()
    found = rates(name, SCHEDULES[name])
    assert min(found) >= 0.0
    assert len(set(found)) > 1, "it does something"


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("StepLR", {"step_size": 0}), ("StepLR", {"step_size": "x"}), ("CosineAnnealingLR", {"T_max": 0}),
        ("OneCycleLR", {"max_lr": 1.0, "total_steps": 5}), ("OneCycleLR", {"max_lr": "x"}),
        ("CyclicLR", {"base_lr": 0.1, "max_lr": 1.0, "step_size_up": 0}), ("CyclicLR", {"base_lr": 0.1}),
        ("ExponentialLR", {"gamma": 0.9, "last_epoch": 5}), ("MultiStepLR", {"milestones": 3}),
        ("ReduceLROnPlateau", {"mode": "x"}), ("ReduceLROnPlateau", {"factor": 2.0}), ("StepLR", {}),
    ],
    ids=str,
)  # fmt: skip
def test_a_schedule_that_would_fail_in_some_epoch_is_refused_before_the_first(
    name: str, options: dict[str, Any]
) -> None:
    assert f"estimator: schedule {name}: " in refused(schedule={"name": name, **options}, epochs=EPOCHS)


# ----------------------------------------------------------------------------------------------------- other settings


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"ridge": -1.0}, "ridge: found -1.0; accepted: greater than or equal to 0"),
        ({"residual_weight": float("nan")}, "residual_weight: found nan"),
        ({"optimizer": {"lr": 0.1}}, "optimizer: found {'lr': 0.1}; accepted: a mapping with the name of a class"),
        ({"epochs": True}, "epochs: found True; accepted: a number"),
        ({"clip": 0.0}, "clip: found 0.0; accepted: greater than 0"),
        ({"damping": float("inf")}, "damping: found inf; accepted: a finite number"),
        ({"epochs": 0}, "epochs: found 0; accepted: greater than or equal to 1"),
        ({"patience": 0}, "patience: found 0; accepted: greater than or equal to 1"),
        ({"residual_lr": -0.1}, "residual_lr: found -0.1; accepted: greater than 0"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_settings_that_cannot_be_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        Sgd(**settings)
