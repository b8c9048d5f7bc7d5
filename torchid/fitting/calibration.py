"""Logs as calibrated sensors would have recorded them, and what actuators add to predictions."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Generic, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from torchid.errors import ConfoundedWarning, LogError, about_file, current_file, join_names, warn, warn_about_file
from torchid.estimators.least_squares import Minimizer
from torchid.fitting.fit import Fit
from torchid.identifiability.confounding import ExtraEstimate
from torchid.parameters import Array
from torchid.problem import Evaluation, RowBuilder, Samples, assemble, compress_parts
from torchid.problem.compression import Block, CompressedBlock, Part
from torchid.problem.elimination import Assembly
from torchid.problem.extras import ACTUATORS, Extra
from torchid.problem.metrics import calibrate_readings
from torchid.problem.samples import require_forces
from torchid.reprs import short_repr
from torchid.robot import Robot

T = TypeVar("T")


class Comparison(NamedTuple, Generic[T]):
    """The same thing of nominal and of identified parameters."""

    nominal: T
    identified: T


ExtraValues = Mapping[tuple[str, str], float]
"""Values of extra parameters, by log ("" for those of all logs) and `Extra.label`."""


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Parameters of the bodies with the extra parameters that fit them best, known or fitted anew to every new log.

    Readings of other logs of the same robot, as calibrated sensors would have recorded them::

        calibration = torchid.calibrations(fit, robot, builder).identified
        corrected = calibration.calibrate(new_logs)  # offsets of each log are fitted, scales of all logs are known

    Attributes:
        robot: the robot.
        builder: of the rows of the sensors and actuators whose extra parameters are meant.
        phi: (12 L,), parameters of the bodies.
        values: the extra parameters that are known.
    """

    robot: Robot
    builder: RowBuilder
    phi: Array
    values: ExtraValues
    _of_new_logs: dict[str, Array | float] = field(default_factory=dict, init=False)

    __repr__ = short_repr

    @property
    def changes_readings(self) -> bool:
        """Whether readings have offsets or scales."""
        return any(extra.what in ("offset", "scale") for extra in self.builder.extras)

    @property
    def of_joints(self) -> list[tuple[Extra, float]]:
        """Extra parameters of joints that some row depends on, with their values."""
        extras = (x for x in self.builder.extras if x.what in ACTUATORS)
        return [(x, self.values["", x.label]) for x in extras if ("", x.label) in self.values]

    def calibrate(self, logs: Sequence[Samples], step: int = 1) -> list[Samples]:
        """The logs with calibrated readings; extra parameters of a new log are fitted to it first, to all its samples.

        Args:
            logs: as recorded.
            step: every `step`-th sample of each comes back.

        Warns:
            TorchidWarning: a new log lacks sensors, so that its readings are taken as they are.
        """
        if not self.changes_readings:
            return [log.every(step) for log in logs]
        tree = self._on_cpu.tree
        return [calibrate_readings(log.every(step), self.builder.extras, self._values_for(log), tree) for log in logs]

    def parameters(self, evaluation: Evaluation) -> Array:
        """Parameters as `Evaluation.metrics` takes them, (12 L + E,)."""
        return np.append(self.phi, self._known(evaluation.builder.extras, ""))

    def columns(self, builder: RowBuilder, log: Block) -> Tensor:
        """Parameters in a builder's columns for the rows of a log, (width,)."""
        return builder.to_columns(np.append(self.phi, self._values_for(log))[None])[0]

    @cached_property
    def _on_cpu(self) -> RowBuilder:
        """The builder where readings are."""
        builder = self.builder
        return builder if builder.device.type == "cpu" else copy.deepcopy(builder).to(torch.device("cpu"))

    def _known(self, extras: Sequence[Extra], log: str) -> Array:
        """Values of extra parameters of a log and of all logs, 0 where none is known."""
        return np.array([self.values.get((log if x.per_log else "", x.label), 0.0) for x in extras])

    def _values_for(self, log: Block) -> Array:
        extras = self.builder.extras
        values = self._known(extras, log.source)
        own = np.array([x.per_log for x in extras])
        if own.any() and not any(source == log.source for source, _ in self.values):
            if log.source not in self._of_new_logs:
                self._of_new_logs[log.source] = self._fitted(log, values[~own])
            values[own] = self._of_new_logs[log.source]
        return values

    def _fitted(self, log: Block, shared: Array) -> Array | float:
        """Extra parameters of a log, with everything else known."""
        builder = self._on_cpu

        def solve(parts: list[Part]) -> Array:
            elimination = assemble(parts, builder, self.robot).eliminations[0]
            return elimination.inverse @ (elimination.z - elimination.C @ np.append(self.phi, shared))

        if isinstance(log, CompressedBlock):
            return solve(log.parts)
        try:
            require_forces(log, self.robot, builder.contacts, builder.sensors)
        except LogError as error:
            message = f"{error.source}: {error.field}: {error.found}; offsets and scales of this log stay unknown"
            warn(message)
            return 0.0
        return solve(compress_parts([log], builder))


def calibrations(fit: Fit, robot: Robot, builder: RowBuilder) -> Comparison[Calibration]:
    """Nominal and identified parameters, each with the extra parameters that the logs of a fit show for them.

    Args:
        fit: of compressed logs.
        robot: the robot.
        builder: of their rows.
    """
    return calibrations_at(fit.assembly, Minimizer(fit.estimate.phi, fit.estimate.psi), robot, builder)


def calibrations_at(
    assembly: Assembly, minimizer: Minimizer, robot: Robot, builder: RowBuilder
) -> Comparison[Calibration]:
    """As `calibrations`, of what an estimator has found; arguments as of `calibration_at`."""
    pair = Minimizer(assembly.problem.nominal), minimizer
    return Comparison(*(calibration_at(assembly, one, robot, builder) for one in pair))


def calibration_at(assembly: Assembly, minimizer: Minimizer, robot: Robot, builder: RowBuilder) -> Calibration:
    """Parameters that an estimator has found, with the extra parameters that fit them best.

    Args:
        assembly: of compressed logs.
        minimizer: for its problem.
        robot: the robot.
        builder: of the rows.
    """
    extras = zip(assembly.eliminations, assembly.extras_at(*minimizer), strict=True)
    values = {
        (one.log, extra.label): float(value)
        for one, found in extras
        for extra, value, std in zip(one.extras, found, one.std_if_known, strict=True)
        if np.isfinite(std)
    }
    return Calibration(robot=robot, builder=builder, phi=minimizer.phi, values=values)


_NAMED, _NAMED_IN_SHORT = 6, 2  # sensors or bodies that a warning names, and the answer of a run


def warn_of_confounded(extras: Sequence[ExtraEstimate]) -> None:
    """Name sensors whose offset or scale, in the extra parameters of a fit, is confounded with other parameters.

    Warns:
        ConfoundedWarning: one for each log that has some.
    """
    for one in list_confounded(extras):
        with about_file(one.log or current_file()):
            warn_about_file(str(one), ConfoundedWarning)


@dataclass(frozen=True)
class Confounded:
    """Extra parameters that the data do not separate from others.

    Attributes:
        log: that they are of, "" for all.
        extras: their labels.
        confounded_with: the others: "total mass" if stating this would do, else parameters of bodies.
        advice: what would separate them.
    """

    log: str
    extras: tuple[str, ...]
    confounded_with: tuple[str, ...]
    advice: str

    def __str__(self) -> str:
        others = "the total mass" if self.confounded_with == (_TOTAL_MASS,) else _grouped(self.confounded_with)
        return f"{_grouped(self.extras)}: confounded with {others or 'each other'}; do not trust either; {self.advice}"

    @property
    def in_short(self) -> str:
        """What to do, before what it is good for, without what they are confounded with."""
        return f"{self.advice}; until then do not trust {_grouped(self.extras, _NAMED_IN_SHORT)}"


_TOTAL_MASS = "total mass"


def list_confounded(extras: Sequence[ExtraEstimate]) -> list[Confounded]:
    """Extra parameters of a fit that are confounded, by log, those with the total mass apart from others."""
    out = []
    for log in dict.fromkeys(x.log for x in extras):
        for by_mass in (True, False):
            own = [x for x in extras if x.log == log and not x.separable and x.mass_separates is by_mass]
            if not own:
                continue
            others = dict.fromkeys(name for x in own for name in x.confounded_with if " of " not in name)
            found = (_TOTAL_MASS,) if by_mass else tuple(others)
            out.append(Confounded(log, tuple(x.extra.label for x in own), found, _advice(own, by_mass)))
    return out


def _advice(extras: Sequence[ExtraEstimate], by_mass: bool) -> str:
    """What would separate extra parameters from what they are confounded with."""
    kinds = {x.extra.what for x in extras}
    if by_mass:
        return "state estimator.total_mass" + (", or leave a sensor out of scales" if kinds == {"scale"} else "")
    if kinds == {"scale"}:
        return (
            "add motion, state a known mass (estimator.total_mass, estimator.masses), or leave a sensor out of scales"
        )
    terms = [f"actuators.{kind}" for kind in ACTUATORS if kind in kinds]
    if terms:
        return f"add motion, or leave out {' and '.join(terms)}"
    return "add motion that unloads the sensor, state what is known, or zero the sensor before the log"


def warn_of_masked(parts: Sequence[Part], builder: RowBuilder) -> None:
    """Name contact sensors whose readings in the air say nothing of their offsets.

    Warns:
        TorchidWarning: one for each log that has some.
    """
    for log in dict.fromkeys(part.source for part in parts):
        masked = {number for part in parts if part.source == log for number in part.masked}
        if masked:
            channels = (builder.extras[number] for number in sorted(masked))
            named = _grouped(f"{x.name} {x.component}" for x in channels)
            message = f"{log}: {named} read exactly 0 in the air, as if masked or clamped"
            warn(f"{message}, which says nothing of their offsets")


def _grouped(labels: Iterable[str], most: int = _NAMED) -> str:
    """So many labels by sensor or body, the most frequent first: "scale of l_hip, r_hip; m, mcx of pelvis"."""
    groups: dict[str, dict[str, None]] = {}
    for label in labels:
        first, _, last = label.rpartition(" ")
        groups.setdefault(first, {})[last] = None
    order = sorted(groups, key=lambda first: -len(groups[first]))
    more = f"; and {len(order) - most} more" if len(order) > most else ""
    named = ((first, join_names(list(groups[first]), most)) for first in order[:most])
    return "; ".join(f"{first} {names}" if " of" in first else f"{names} of {first}" for first, names in named) + more
