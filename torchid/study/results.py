"""What the study found: errors on the unseen log by condition, training logs, sensors and draw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchid.report.metrics import GROUPS, Metrics
from torchid.study.fits import StateRank

NOMINAL, TRUE = "nominal", "true"
"""Rows beside the sensor sets: the parameters that every fit starts from, and those of the simulated robot."""


@dataclass(frozen=True)
class Record:
    """Errors of one parameter vector on the unseen log.

    `measured` compares with what the imperfect sensors of that log say, `exact` with what truly happened.
    """

    condition: str
    training: str
    sensors: str
    noise_draw: int
    nominal_draw: int
    measured: Metrics
    exact: Metrics


@dataclass(frozen=True)
class Spread:
    """Median, least and greatest of a figure over the draws."""

    median: float
    least: float
    greatest: float


@dataclass(frozen=True)
class Ranks:
    """Sample counts and ranks per contact state, of one training set and sensor set."""

    training: str
    sensors: str
    states: Sequence[StateRank]


@dataclass(frozen=True)
class Results:
    """All records of a study."""

    records: Sequence[Record]
    ranks: Sequence[Ranks]

    @property
    def conditions(self) -> list[str]:
        """In the order of the study."""
        return list(dict.fromkeys(record.condition for record in self.records))

    @property
    def trainings(self) -> list[str]:
        """In the order of the study."""
        return list(dict.fromkeys(record.training for record in self.records))

    @property
    def sensors(self) -> list[str]:
        """The nominal parameters, every sensor set, the true parameters."""
        return list(dict.fromkeys(record.sensors for record in self.records))

    def spread(self, condition: str, training: str, sensors: str, figure: str, against: str = "exact") -> Spread:
        """A figure over all draws.

        Args:
            condition: of the sensors.
            training: which logs were fitted.
            sensors: the sensor set, or NOMINAL or TRUE.
            figure: a key of `figures`.
            against: "exact" or "measured".
        """
        found = [
            figures(getattr(record, against))[figure]
            for record in self.records
            if (record.condition, record.training, record.sensors) == (condition, training, sensors)
        ]
        return Spread(float(np.median(found)), min(found), max(found))


def figures(metrics: Metrics) -> dict[str, float]:
    """All figures of the table: `GROUP` in units, `GROUP/relative` and `base_force/variation` as shares."""
    out = {group: metrics.rms[group] for group in GROUPS}
    out |= {f"{group}/relative": metrics.relative[group] for group in GROUPS}
    out["base_force/variation"] = metrics.base_force_of_variation
    return {name: float("nan") if value is None else value for name, value in out.items()}
