"""Results of the study: errors on the unseen log by condition, and whether the three claims of the paper hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from paper.fits import StateRank
from torchid.problem import Metrics
from torchid.problem.metrics import ROW_GROUPS, group_name

NOMINAL, TRUE = "nominal", "true"
"""Rows beside the sensor sets: the parameters that every fit starts from, and those of the simulated robot."""


@dataclass(frozen=True)
class Record:
    """Errors of one parameter vector on the unseen log.

    `measured` compares with the readings of that log's imperfect sensors, `exact` with the true forces.
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
            figure: a key of `error_figures`.
            against: "exact" or "measured".
        """
        values = [
            error_figures(getattr(record, against))[figure]
            for record in self.records
            if (record.condition, record.training, record.sensors) == (condition, training, sensors)
        ]
        return Spread(float(np.median(values)), min(values), max(values))


def error_figures(metrics: Metrics) -> dict[str, float]:
    """All figures of the table: `GROUP` in units, `GROUP/relative` and `base_force/variation` as shares."""
    out = {group: metrics.rms[group] for group in ROW_GROUPS}
    out |= {f"{group}/relative": metrics.relative[group] for group in ROW_GROUPS}
    out["base_force/variation"] = metrics.base_force_of_variation
    return {name: float("nan") if value is None else value for name, value in out.items()}


GOOD = 0.2
"""A set is good on a group of rows if its error is at most this share of the nominal parameters' ..."""
FLOOR = 2.0
"""... or at most this many times that of the true parameters, which is what filter and friction model leave."""
POOR = 2.0
"""A set is poor on a group of rows if its error is at least this many times that of full sensing, or if it is no
better there than the nominal parameters."""

_SETS = ("full", "contacts", "joints")
_BASE, _INSIDE = ("base_force", "base_moment"), "nullspace"


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, whether the results support it, and the figures in evidence."""

    number: int
    holds: bool
    why: str


def examine_claims(results: Results, condition: str, training: str) -> tuple[Claim, Claim, Claim]:
    """Examine the claims of section V, on medians of the errors against the true forces.

    (1) Full sensing is adequate everywhere: good on every group of rows. (2) Contacts only is good on the base rows and
    poor on joint torques. (3) Joints only is the best of the three sets inside the projected space, and poor outside,
    on joint torques, base force or base moment. What good and poor mean is stated beside `GOOD` and `POOR`.
    """

    def error(sensors: str, group: str) -> float:
        return results.spread(condition, training, sensors, group).median

    def share(sensors: str, group: str) -> float:
        return error(sensors, group) / error(NOMINAL, group)

    def times(sensors: str, group: str) -> float:
        return error(sensors, group) / error("full", group)

    def good(sensors: str, group: str) -> bool:
        return share(sensors, group) <= GOOD or error(sensors, group) <= FLOOR * error(TRUE, group)

    def poor(sensors: str, group: str) -> bool:
        return times(sensors, group) >= POOR or share(sensors, group) >= 1.0

    worst = max(ROW_GROUPS, key=lambda group: share("full", group))
    above_floor = error("full", worst) / error(TRUE, worst)
    base = max(_BASE, key=lambda group: share("contacts", group))
    torque = times("contacts", "joint_torque")
    best = min(_SETS, key=lambda sensors: error(sensors, _INSIDE))
    outside = max((group for group in ROW_GROUPS if group != _INSIDE), key=lambda group: times("joints", group))
    return (
        Claim(
            1,
            all(good("full", group) for group in ROW_GROUPS),
            f"worst, {group_name(worst)}: {share('full', worst):.2g} x nominal, {above_floor:.2g} x true",
        ),
        Claim(
            2,
            all(good("contacts", group) for group in _BASE) and poor("contacts", "joint_torque"),
            f"{group_name(base)} {share('contacts', base):.2g} x nominal, joint torque {torque:.2g} x full",
        ),
        Claim(
            3,
            best == "joints" and any(poor("joints", group) for group in ROW_GROUPS if group != _INSIDE),
            f"inside best: {best}; outside, {group_name(outside)} {times('joints', outside):.2g} x full",
        ),
    )
