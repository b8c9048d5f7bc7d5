"""The settings of the estimators in an experiment file."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic.dataclasses import dataclass

from torchid.config.sensors import STRICT, NotNegative, Number, Positive, Seed, no_flag
from torchid.errors import ConfigError
from torchid.rounding import RANK_TOLERANCE


def _with_name(value: dict[str, Any]) -> dict[str, Any]:
    if not isinstance(value.get("name"), str):
        raise ValueError("a mapping with the name of a class, and its options")
    return value


Count = Annotated[int, BeforeValidator(no_flag), Field(ge=1)]
Named = Annotated[dict[str, Any], AfterValidator(_with_name)]
"""A class of `torch.optim` and what it takes: `{name: Adam, lr: 0.05}`."""


Interval = Annotated[list[Number | None], Field(min_length=2, max_length=2)]
"""[lower, upper], None where it is open."""


@dataclass(config=STRICT, frozen=True)
class SymmetryConfig:
    """Bodies whose names differ in `left` and `right` are mirror images along the base link's axis `normal`."""

    left: Annotated[str, Field(min_length=1)]
    right: Annotated[str, Field(min_length=1)]
    normal: Literal["x", "y", "z"] = "y"


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
    optimizer: Named = dataclasses.field(default_factory=lambda: {"name": "Adam"})
    schedule: Named | None = dataclasses.field(default_factory=lambda: {"name": "CosineAnnealingLR"})
    patience: Count | None = None
    clip: Positive = 1.0
    damping: Positive = 1.0
    seed: Seed = 0
    evaluate_every: Count = 10
    checkpoint_seconds: NotNegative = 5.0


Loss = Literal["huber", "tukey"]


@dataclass(config=STRICT, frozen=True)
class RobustConfig:
    """Rows that fit badly count less, in re-weighted passes.

    `loss` of whitened residuals, `tuning` in robust standard deviations (None: 1.345 for huber, 4.685 for tukey),
    `passes` at most.
    """

    loss: Loss
    tuning: Positive | None = None
    passes: Count = 50


def _by_loss(value: object) -> object:
    """A robust fit as a mapping, where it may be a loss alone."""
    return {"loss": value} if value in get_args(Loss) else value


ROBUST_ACCEPTED = f"{', '.join(get_args(Loss))}, or a mapping with loss, tuning and passes"
"""What a message says of a robust fit."""

Robust = Annotated[RobustConfig, BeforeValidator(_by_loss)]


AUTO = "auto"
"""What stands for a ridge that the data choose."""


def _number_or_auto(value: object, check: ValidatorFunctionWrapHandler) -> object:
    try:
        return value if value == AUTO else check(value)
    except ValidationError as error:
        raise ValueError(f"a finite number of at least 0, or {AUTO}") from error


if TYPE_CHECKING:
    Ridge = float | str
else:
    Ridge = Annotated[NotNegative, WrapValidator(_number_or_auto)]


@dataclass(config=STRICT, frozen=True)
class EstimatorConfig:
    """How parameters are found.

    `ridge` pulls to the URDF, auto: as far as predicts left-out blocks of the training logs best, `friction: false`
    leaves friction at the URDF's values, `frozen` bodies keep all of theirs; `robust` takes outliers out of a batch
    fit; `margin` of the scaled pseudo-inertias.

    For `consistent`: `prior` that the ridge is in, `total_mass` [kg] if known, `method` and whether to `certify` with
    the other; `com_inside` keeps centres of mass in what encloses the bodies' `com_shapes`, `symmetry` makes left
    and right mirror images, `bounds` are [lower, upper] by body and parameter, null for none.

    For `sgd`: `consistency` kept by log-Cholesky parameters or sought by `penalties`, and `training`.
    """

    name: Literal["least_squares", "consistent", "sgd"] = "least_squares"
    ridge: Ridge = 0.0
    rank_tolerance: Annotated[Number, Field(gt=0.0, lt=1.0)] = RANK_TOLERANCE
    friction: bool = True
    frozen: list[str] = dataclasses.field(default_factory=list)
    robust: Robust | None = None
    margin: Annotated[Number, Field(ge=0.0, lt=1.0)] = 1e-4
    prior: Literal["euclidean", "pullback", "entropic"] = "euclidean"
    method: Literal["barrier", "certified"] = "barrier"
    certify: bool = False
    total_mass: Positive | None = None
    com_inside: Literal["box", "ellipsoid"] | None = None
    com_shapes: Literal["visual", "collision"] = "visual"
    symmetry: SymmetryConfig | None = None
    bounds: dict[str, dict[str, Interval]] | None = None
    consistency: Literal["log_cholesky", "penalties"] = "log_cholesky"
    penalties: PenaltiesConfig = dataclasses.field(default_factory=PenaltiesConfig)
    training: TrainingConfig = dataclasses.field(default_factory=TrainingConfig)

    @property
    def chooses_ridge(self) -> bool:
        """Whether the ridge is to be chosen by the data."""
        return self.ridge == AUTO

    @property
    def pull(self) -> float:
        """The ridge as a number, 0 while it has not been chosen."""
        return 0.0 if isinstance(self.ridge, str) else self.ridge


_ALL = ("name", "ridge", "rank_tolerance", "friction", "frozen")
_BATCH = (*_ALL, "robust")
_PHYSICAL = ("prior", "method", "certify", "total_mass", "com_inside", "com_shapes", "symmetry", "bounds")
_KEYS = {
    "least_squares": _BATCH,
    "consistent": (*_BATCH, "margin", *_PHYSICAL),
    "sgd": (*_ALL, "margin", "consistency", "penalties", "training"),
}


def check_keys(estimator: EstimatorConfig, path: Path) -> None:
    """Refuse a setting that the estimator has not: it would be ignored in silence.

    Raises:
        ConfigError: names the estimators that have it.
    """
    defaults = EstimatorConfig()
    for key, value in vars(estimator).items():
        if key not in _KEYS[estimator.name] and value != getattr(defaults, key):
            having = [name for name, keys in _KEYS.items() if key in keys]
            found = f"set, which {estimator.name} has not"
            raise ConfigError(path, f"estimator.{key}", found, f"name: {' or '.join(having)}, or no such key")
    if estimator.consistency != "penalties" and estimator.penalties != defaults.penalties:
        found = f"set, which consistency: {estimator.consistency} has not"
        raise ConfigError(path, "estimator.penalties", found, "consistency: penalties, or no such key")
