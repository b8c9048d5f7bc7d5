"""The block `estimator` of an experiment file: the estimators' own settings, and those that need the experiment."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import BeforeValidator, Field
from pydantic.dataclasses import dataclass

from torchid.config.robot import PerAxis, PerJoint
from torchid.errors import ConfigError
from torchid.estimators import Conditions, Consistent, LeastSquares, PenaltyWeights, Sgd, TrainingSettings
from torchid.estimators.conditions import EnclosureKind
from torchid.estimators.conic import Prior
from torchid.estimators.sgd import Consistency
from torchid.settings import (
    AUTO,
    STRICT,
    BelowOne,
    Count,
    Name,
    NotNegative,
    Number,
    Positive,
    Ridge,
    RidgeRule,
    Seed,
    Tolerance,
)

ESTIMATORS: dict[str, type[LeastSquares | Consistent | Sgd]] = {
    "least_squares": LeastSquares,
    "consistent": Consistent,
    "sgd": Sgd,
}
"""By their names in an experiment file."""

Interval = Annotated[list[Number | None], Field(min_length=2, max_length=2)]
"""[lower, upper], None where it is open."""


@dataclass(config=STRICT, frozen=True)
class SymmetryConfig:
    """Bodies whose names differ in `left` and `right` are mirror images along the base link's axis `normal`."""

    left: Name
    right: Name
    normal: Literal["x", "y", "z"] = "y"


@dataclass(config=STRICT, frozen=True)
class TrainingConfig(TrainingSettings):
    """Training of `sgd`: `batch_size` samples a mini-batch, in an order by `seed`.

    Errors are evaluated every `evaluate_every` epochs. A checkpoint is written at the end of an epoch, at most every
    `checkpoint_seconds`.
    """

    batch_size: Count = 256
    seed: Seed = 0
    evaluate_every: Count = 10
    checkpoint_seconds: NotNegative = 5.0


@dataclass(config=STRICT, frozen=True)
class MassConfig:
    """A known mass [kg]. `std`: its standard deviation [kg], 0 for an exact mass."""

    value: Positive
    std: NotNegative = 0.0


def _mass(value: object) -> object:
    """A mass as a mapping, where it may be a number alone."""
    return value if value is None or isinstance(value, (dict, MassConfig)) else {"value": value}


MASS_ACCEPTED = "a number greater than 0, or a mapping with value and std [kg]"
"""Accepted for a known mass, in messages."""

Mass = Annotated[MassConfig, BeforeValidator(_mass)]

LossKind = Literal["huber", "tukey"]


@dataclass(config=STRICT, frozen=True)
class RobustConfig:
    """Outliers get smaller weights, in at most `passes` repeated fits.

    `loss`: of the whitened residuals. `tuning`: residual from which weights decrease, in robust standard deviations;
    null: 1.345 for huber, 4.685 for tukey.
    """

    loss: LossKind
    tuning: Positive | None = None
    passes: Count = 50


def _by_loss(value: object) -> object:
    """A robust fit as a mapping, where it may be a loss alone."""
    return {"loss": value} if value in get_args(LossKind) else value


ROBUST_ACCEPTED = f"{', '.join(get_args(LossKind))}, or a mapping with loss, tuning and passes"
"""Accepted for a robust fit, in messages."""

Robust = Annotated[RobustConfig, BeforeValidator(_by_loss)]


Solver = TypeVar("Solver", LeastSquares, Consistent, Sgd)


@dataclass(config=STRICT, frozen=True)
class TaskWeightsConfig:
    """Weights of errors in the fit: of joint torques, and of base force and moment along the base's axes; null: 1."""

    joint_torque: PerJoint | None = None
    base_force: PerAxis | None = None
    base_moment: PerAxis | None = None


@dataclass(config=STRICT, frozen=True)
class _FitConfig:
    """What is fitted, for every estimator; see `EstimatorConfig`."""

    name: Literal["least_squares", "consistent", "sgd"] = "consistent"
    ridge: Ridge = AUTO
    rank_tolerance: Tolerance = LeastSquares.rank_tolerance
    friction: bool = True
    frozen: list[str] = dataclasses.field(default_factory=list)
    robust: Robust | None = None
    task_weights: TaskWeightsConfig = dataclasses.field(default_factory=TaskWeightsConfig)
    total_mass: Annotated[MassConfig | None, BeforeValidator(_mass)] = None
    masses: dict[str, Mass] = dataclasses.field(default_factory=dict)


@dataclass(config=STRICT, frozen=True)
class _ConditionsConfig:
    """Conditions that the identified bodies must meet; see `EstimatorConfig`."""

    margin: BelowOne = Conditions.margin
    com_inside: EnclosureKind | None = None
    com_shapes: Literal["visual", "collision"] = "visual"
    symmetry: SymmetryConfig | None = None
    bounds: dict[str, dict[str, Interval]] | None = None


@dataclass(config=STRICT, frozen=True)
class EstimatorConfig(_ConditionsConfig, _FitConfig):
    """An estimator by its name, with the keys of all estimators. A file may set only the keys of its estimator.

    Attributes:
        ridge: weight of the prior. auto: `torchid.fitting.left_out.RIDGE` times the mean square of the residuals, or
            more if that predicts held-out blocks better. one_standard_error: the largest ridge whose error on held-out
            blocks is within one standard error of the smallest.
        rank_tolerance: smallest singular value that counts as determined, as a share of the largest.
        friction: false keeps the friction of the robot's file.
        frozen: bodies that keep all parameters of the robot's file.
        robust: smaller weights for outliers; not for `sgd`.
        task_weights: weights of the errors of joint torques and of the base.
        total_mass: known mass of the robot [kg], for example from a scale.
        masses: known masses of bodies by name [kg].
        margin: smallest allowed eigenvalue of each body's scaled pseudo-inertia.
        com_inside: enclosure of each body's shapes that must contain its centre of mass.
        com_shapes: these shapes.
        symmetry: left and right bodies are mirror images.
        bounds: [lower, upper] by body and parameter; null: no bound.
    """

    prior: Prior = Consistent.prior
    consistency: Consistency = Sgd.consistency
    penalties: PenaltyWeights = dataclasses.field(default_factory=PenaltyWeights)
    training: TrainingConfig = dataclasses.field(default_factory=TrainingConfig)

    @property
    def chooses_ridge(self) -> bool:
        """Whether the ridge is to be chosen by the data."""
        return isinstance(self.ridge, str)

    @property
    def ridge_rule(self) -> RidgeRule:
        """Which ridge the data choose, if they do."""
        return "auto" if self.ridge == AUTO else "one_standard_error"

    @property
    def numeric_ridge(self) -> float:
        """The ridge as a number, 0 while it has not been chosen."""
        return 0.0 if isinstance(self.ridge, str) else self.ridge

    @property
    def least_squares(self) -> LeastSquares:
        """Least squares with these settings."""
        return self._settings(LeastSquares)

    def sgd(self, conditions: Conditions) -> Sgd:
        """A descent with these settings."""
        return self._settings(Sgd, conditions=conditions)

    def consistent(self, conditions: Conditions) -> Consistent:
        """A consistent fit with these settings."""
        return self._settings(Consistent, conditions=conditions)

    def _settings(self, estimator: type[Solver], **given: Any) -> Solver:
        """An estimator with its fields taken from here, from `training`, or as given."""
        values = vars(self) | vars(self.training) | {"ridge": self.numeric_ridge} | given
        return estimator(**{key: values[key] for key in _fields(estimator) if key in values})


def validate_keys(estimator: EstimatorConfig) -> None:
    """Refuse a setting that the estimator does not use. Raises ConfigError: names the estimators that use it."""
    defaults = EstimatorConfig()
    for key, value in vars(estimator).items():
        having = _estimators_with(key)
        if estimator.name not in having and value != getattr(defaults, key):
            reason = f"not used by {estimator.name}"
            raise ConfigError.at_field(f"estimator.{key}", reason, f"name: {' or '.join(having)}, or leave it out")
    if estimator.name == "sgd" and estimator.consistency == "penalties":
        for key in (*_fields(_ConditionsConfig), "prior"):
            if key not in ("margin", "com_shapes") and getattr(estimator, key) != getattr(defaults, key):
                reason = "not used with consistency: penalties"
                raise ConfigError.at_field(f"estimator.{key}", reason, "consistency: log_cholesky, or leave it out")
    if estimator.consistency != "penalties" and estimator.penalties != defaults.penalties:
        reason = f"not used with consistency: {estimator.consistency}"
        raise ConfigError.at_field("estimator.penalties", reason, "consistency: penalties, or leave it out")


_OF_BATCH_FITS = {"robust"}


def _estimators_with(key: str) -> list[str]:
    """Names of the estimators that a key of the block is for."""
    if key in _fields(_FitConfig) and key not in _OF_BATCH_FITS:
        return list(ESTIMATORS)
    return [name for name, estimator in ESTIMATORS.items() if key in _keys_of(estimator)]


def _keys_of(estimator: type) -> set[str]:
    """Keys of the block that are for an estimator alone or with some others."""
    keys = set(_fields(estimator))
    if "conditions" in keys:
        keys |= set(_fields(_ConditionsConfig))
    return keys | ({"training"} if issubclass(estimator, TrainingSettings) else _OF_BATCH_FITS)


def _fields(settings: type) -> list[str]:
    return [field.name for field in dataclasses.fields(settings)]
