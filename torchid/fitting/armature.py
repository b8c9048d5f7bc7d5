"""Reflected rotor inertia that was not fitted, by what a fit leaves of the torques in proportion to accelerations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from torchid.errors import join_names
from torchid.estimators import LeastSquares
from torchid.fitting.fit import LogFitter
from torchid.problem import ExtraTerms, RowBuilder, Samples
from torchid.problem.compression import compress_in_blocks

_SAMPLES = 5000  # of all logs, evenly spaced
_SURELY = 4.0  # standard errors of a rotor inertia that is there
_RIDGE = 1e-6  # as of a delay: the data determine some parameters badly
_NAMED_JOINTS = 2


@dataclass(frozen=True)
class UnfittedArmature:
    """Reflected rotor inertia beyond the robot file's that was not fitted.

    Attributes:
        joints: of which it is there for certain, those that show it most clearly first.
        values: of it, each in its unit; `standard_errors`: of these.
        units: kg m^2, or kg of joints that slide.
    """

    joints: tuple[str, ...]
    values: tuple[float, ...]
    standard_errors: tuple[float, ...]
    units: tuple[str, ...]

    @property
    def significant(self) -> bool:
        """Whether chance would show as much of one joint in fewer than one of ten thousand fits."""
        return bool(self.joints)

    def __str__(self) -> str:
        """Of which joints it is most certain, and what finds it."""
        shown = [
            f"{joint} {value:.2g} ± {error:.1g} {unit}"
            for joint, value, error, unit in zip(
                self.joints, self.values, self.standard_errors, self.units, strict=True
            )
        ]
        named = join_names(shown, _NAMED_JOINTS)
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
    beyond = {
        one.extra.name: (one.value - in_file[one.extra.name], one.standard_error, one.extra.unit)
        for one in fit.extras
        if one.extra.what == "armature" and one.separable
    }
    clear = {joint: found for joint, found in beyond.items() if found[0] > _SURELY * found[1]}
    order = sorted(clear, key=lambda joint: -clear[joint][0] / max(clear[joint][1], 1e-300))
    values, errors, units = (tuple(clear[joint][k] for joint in order) for k in range(3))
    return UnfittedArmature(tuple(order), values, errors, units)  # type: ignore[arg-type]
