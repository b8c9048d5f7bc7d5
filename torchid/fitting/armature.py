"""Reflected rotor inertia that was not fitted, by what a fit leaves of the torques in proportion to accelerations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from torchid.errors import join_names
from torchid.estimators import LeastSquares
from torchid.fitting.fit import LogFitter
from torchid.problem import ExtraTerms, RowBuilder, Samples
from torchid.problem.compression import compress_in_blocks

_SAMPLES = 5000  # of all logs, evenly spaced
_SURELY = 4.0  # standard errors of a rotor inertia that is there
_RIDGE = 1e-6  # as of a delay: the data determine some parameters badly
_NAMED_JOINTS = 2


class RotorInertia(NamedTuple):
    """Reflected rotor inertia of a joint, in its unit (kg m^2, or kg of one that slides)."""

    joint: str
    value: float
    standard_error: float
    unit: str

    def __str__(self) -> str:
        return f"{self.joint} {self.value:.2g} ± {self.standard_error:.1g} {self.unit}"


@dataclass(frozen=True)
class UnfittedArmature:
    """Reflected rotor inertia beyond the robot file's that was not fitted.

    `found`: of joints in which it is there for certain, the clearest first.
    """

    found: tuple[RotorInertia, ...]

    @property
    def significant(self) -> bool:
        """Whether chance would show as much of one joint in fewer than one of ten thousand fits."""
        return bool(self.found)

    def __str__(self) -> str:
        """Of which joints it is most certain, and what finds it."""
        named = join_names([str(one) for one in self.found], _NAMED_JOINTS)
        return f"torques go with accelerations as rotors would make them ({named}; actuators.armature: true)"


def unfitted_armature(logs: Sequence[Samples], fitter: LogFitter, terms: ExtraTerms) -> UnfittedArmature | None:
    """Rotor inertia that a fit without it leaves in the residuals; None where it was fitted, or no torque tells.

    By least squares, without conditions, as what is negative is no rotor but something else that goes with
    accelerations: a spring, or torques that are late.

    Args:
        logs: bound training logs.
        fitter: of their rows.
        terms: extra parameters of these.
    """
    robot, of = fitter.robot, fitter.builder
    if terms.armature or not of.sensors.torque[: robot.n].any() or not any(map(len, logs)):
        return None
    step = max(1, sum(map(len, logs)) // _SAMPLES)
    some = [
        replace(log.every(step), oversampling=max(1.0, log.oversampling / step), folder=None, motion_noise=None)
        for log in logs
    ]
    builder = RowBuilder(robot, of.contacts, of.sensors, replace(terms, armature=True)).to(of.device)
    estimator = LeastSquares(_RIDGE, rank_tolerance=fitter.estimator.rank_tolerance)
    fit = replace(fitter, builder=builder, estimator=estimator).fit(compress_in_blocks(some, builder))
    in_file = dict(zip(robot.joint_names, robot.armature.tolist(), strict=True))
    found = []
    for one in fit.extras:
        beyond = one.value - in_file.get(one.extra.name, 0.0)
        if one.extra.what == "armature" and one.separable and beyond > _SURELY * one.standard_error:
            found.append(RotorInertia(one.extra.name, beyond, one.standard_error, one.extra.unit))
    return UnfittedArmature(tuple(sorted(found, key=lambda x: x.standard_error / x.value)))
