"""The settings of a descent in an experiment file."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field
from pydantic.dataclasses import dataclass

from torchid.config.types import STRICT, NotNegative, Positive, Seed, no_flag


def _with_name(value: dict[str, Any]) -> dict[str, Any]:
    if not isinstance(value.get("name"), str):
        raise ValueError("a mapping with the name of a class, and its options")
    return value


Count = Annotated[int, BeforeValidator(no_flag), Field(ge=1)]
Named = Annotated[dict[str, Any], AfterValidator(_with_name)]
"""A class of `torch.optim` and what it takes: `{name: Adam, lr: 0.05}`."""


@dataclass(config=STRICT, frozen=True)
class PenaltiesConfig:
    """Weights of what pulls a descent towards bodies that can exist."""

    eigenvalue: NotNegative = 10.0
    log_det: NotNegative = 0.0
    mass: NotNegative = 10.0
    friction: NotNegative = 10.0


@dataclass(config=STRICT, frozen=True)
class TrainingConfig:
    """How to descend: passes over the logs, samples per batch, optimizer and schedule of torch, when to stop.

    `patience`: epochs without a better loss on `logs.validation` after which to stop. `clip`: largest norm of a
    gradient. `damping`: of the preconditioner. Errors are worked out `evaluate_every` so many epochs, a checkpoint is
    written after `checkpoint_seconds` and the end of the epoch.
    """

    epochs: Count = 200
    batch_size: Count = 256
    optimizer: Named = dataclasses.field(default_factory=lambda: {"name": "Adam", "lr": 0.05})
    schedule: Named | None = dataclasses.field(default_factory=lambda: {"name": "CosineAnnealingLR"})
    patience: Count | None = None
    clip: Positive = 1.0
    damping: Positive = 1.0
    seed: Seed = 0
    evaluate_every: Count = 10
    checkpoint_seconds: NotNegative = 5.0
