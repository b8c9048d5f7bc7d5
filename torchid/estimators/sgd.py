"""The settings of mini-batch descent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np

from torchid.estimators.optimizers import try_out
from torchid.estimators.penalties import PenaltyWeights

Consistency = Literal["log_cholesky", "penalties"]
ResidualMode = Literal["joint", "parameters_first", "alternating"]


@dataclass(frozen=True)
class Sgd:
    """min of the mean squared whitened residual + ridge * prior + penalties, one mini-batch at a time.

    The prior is that of `LeastSquares`, ||(phi - nominal) / scale||^2.

    Attributes:
        ridge: weight of the prior.
        rank_tolerance: of the statistics, as in `LeastSquares`.
        consistency: "log_cholesky", every step's parameters are physical; "penalties", steps are pulled there.
        margin: least eigenvalue of every body's scaled pseudo-inertia, kept or aimed at.
        penalties: their weights, with "penalties".
        optimizer, optimizer_options: one of `optimizer_names()`, classes of `torch.optim`, and what it takes; what is
            not given is as in `METHODS`.
        schedule, schedule_options: a class of `torch.optim.lr_scheduler`, stepped once per epoch; None for none.
        epochs: passes over the logs, at most.
        patience: epochs without a better loss on the held-out logs after which to stop; None: never.
        clip: largest norm of a gradient.
        damping: of the preconditioner, in units of the mean squared whitened residual per squared scale.
        residual: with a residual module: train it and the parameters together, the parameters for the first half of the
            epochs and then the module, or each in every other epoch.
        residual_lr: learning rate of the module; None: the optimizer's.
        residual_weight: of the mean square of the module's whitened force in the loss; None: the largest whose loss on
            held-out samples is not significantly above the least.
    """

    ridge: float = 0.0
    rank_tolerance: float = 1e-10
    consistency: Consistency = "log_cholesky"
    margin: float = 1e-4
    penalties: PenaltyWeights = field(default_factory=PenaltyWeights)
    optimizer: str = "Adam"
    optimizer_options: Mapping[str, Any] = field(default_factory=dict)
    schedule: str | None = "CosineAnnealingLR"
    schedule_options: Mapping[str, Any] = field(default_factory=dict)
    epochs: int = 200
    patience: int | None = None
    clip: float = 1.0
    damping: float = 1.0
    residual: ResidualMode = "joint"
    residual_lr: float | None = None
    residual_weight: float | None = None

    def __post_init__(self) -> None:
        """Check names and numbers.

        Raises:
            ValueError: a number out of range or an unknown mode.
            InputError: an optimizer or a schedule that torch does not have or that does not take its options.
        """
        for name, accepted in (("consistency", get_args(Consistency)), ("residual", get_args(ResidualMode))):
            if getattr(self, name) not in accepted:
                raise ValueError(f"{name}: found {getattr(self, name)!r}; accepted: {', '.join(accepted)}")
        for name in ("ridge", "residual_weight"):
            value = getattr(self, name)
            if not (value is None and name == "residual_weight") and not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name}: found {value}; accepted: a finite number of at least 0")
        for name in ("clip", "damping", "epochs", "patience", "residual_lr"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"{name}: found {value}; accepted: a positive number")
        if not (np.isfinite(self.margin) and 0.0 <= self.margin < 1.0):
            raise ValueError(f"margin: found {self.margin}; accepted: a number from 0 to 1, without 1")
        try_out(self.optimizer, self.optimizer_options, self.schedule, self.schedule_options, self.epochs)
