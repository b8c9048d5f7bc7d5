"""Factors of torques and points of wrenches that fit the URDF better than those that were recorded: findings."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from torchid.errors import join_names
from torchid.log_checks.deviation import FilteredLog, UnknownEquations
from torchid.log_checks.findings import NOTE, SUSPICIOUS, Finding
from torchid.log_checks.scales import MIN_BLOCK_SHARE, MIN_STANDARD_DEVIATIONS, TorqueGains
from torchid.logs import Log
from torchid.logs.log import BoolArray, FloatArray
from torchid.parameters import MASS, mass_com_inertia
from torchid.problem import RowBuilder, Samples
from torchid.problem.predict import force_series
from torchid.robot import Robot

#: Gain of a torque relative to the other joints, and shift of a wrench's point, that are reported: errors of gears and
#: calibrations are smaller.
MIN_GAIN_RATIO, MIN_POINT_SHIFT_M = 1.15, 0.03
#: The same of all torques alike where contact forces do not say what the robot weighs: masses may be off by a fifth.
MIN_COMMON_GAIN_RATIO = 1.3
#: Share of a factor of all torques that every block of time must show: alone it has hardly more than the prior at 1.
MIN_COMMON_BLOCK_SHARE = 0.3
#: Gains with a smaller standard deviation are the reference for all others, if there are enough of them.
_MAX_REFERENCE_SPREAD, _MIN_REFERENCE_JOINTS = 0.1, 3
#: Of a factor of all torques that is noted: its size in standard deviations, how far the factor of a joint may be from
#: it in its own, and how many joints must have it.
_MIN_NOTED_DEVIATIONS, _MAX_DEVIATIONS_FROM_COMMON, _MIN_NOTED_JOINTS = 3.0, 2.0, 2
#: Share of what factors of all joints together explain that the common one explains; their prior standard deviation.
_MIN_EXPLAINED_SHARE, _FACTOR_PRIOR_STD = 0.5, 1.0


def gain_and_point_findings(log: Log, fit: TorqueGains | None, robot: Robot) -> Iterator[Finding]:
    """Findings about torques with another gain and wrenches about another point."""
    if fit is None:
        return
    m = len(fit.joints)
    spread, blocks = fit.spread[:m], fit.blocks[:, :m]
    yield from common_gain_findings(fit, robot)
    of = _reference_joints(fit)
    reference, of_reverse = (float(np.median(x[of])) if of.any() else 1.0 for x in (fit.gain, fit.reverse))
    relative = fit.gain / reference
    off = np.abs(fit.gain) > MIN_STANDARD_DEVIATIONS * spread  # readings of nothing have no factor
    off &= _is_beyond(relative, fit.reverse / of_reverse, MIN_GAIN_RATIO)
    references = np.median(blocks[:, of], axis=1, keepdims=True) if of.any() else 1.0
    off &= _is_certain(relative - 1.0, spread / reference, blocks / references - 1.0)
    if off.any() and m > 1:
        names = [robot.joint_names[joint] for joint in fit.joints[off]]
        gains = join_names([f"{gain:.3g} +- {std:.2g}" for gain, std in zip(relative[off], spread[off], strict=True)])
        text = f"{join_names(names)}: factors that fit the {robot.format} best, relative to the other joints: {gains}"
        advice = f"check gear ratios, torque constants and units, and the {robot.format}'s friction and inertias there"
        advice += f", or set sensors.scales: {{joint_torque: [[{', '.join(names)}]]}}"
        yield Finding("scale", SUSPICIOUS, "joint_torque", text, advice, tuple(names))
    shifted = _is_certain(fit.point, fit.spread[m:], fit.blocks[:, m:]) & (np.abs(fit.point) > MIN_POINT_SHIFT_M)
    if shifted.any():
        point = ", ".join(f"{1e3 * x:.0f}" for x in fit.point)
        text = f"forces and moments fit the {robot.format} about a point {point} mm from the contact frames' origins"
        advice = "give moments about the contact frame's origin, or name the sensor's own frame as the contact"
        if log.moments_about_world_origin:
            advice = "check the points of the moments, where the plates lie, and the base's position in the same world"
        severity = SUSPICIOUS
        if _is_centre_of_base(log, robot, float(np.linalg.norm(fit.point))):
            severity, advice = NOTE, f"none if its base's centre of mass may be as far off; else {advice}"
        yield Finding("point", severity, log.contact_wrench_field, text, advice)


def _is_centre_of_base(log: Log, robot: Robot, shift: float) -> bool:
    """Whether the base's centre of mass explains another point of wrenches on the base alone, as of a drone's rotors.

    Weight and inertia act alike on both; a centre of mass is off by less than the body's radius of gyration.
    """
    mass, _, inertia = mass_com_inertia(robot.nominal[0])
    if mass <= 0.0 or any(robot.link(frame)[0] for frame in log.contact_names):
        return False
    gyration = np.sqrt(0.5 * np.trace(inertia) / mass)
    return bool(shift * robot.nominal[:, MASS].sum() / mass < gyration)


def _reference_joints(fit: TorqueGains) -> BoolArray:
    """Joints (m,) whose factors are the reference for all others, none if too few are known.

    Those that the URDF's masses agree with, if there are any, however many have another factor: motors of one type are
    wrong alike. Else all of them, as the URDF may weigh too much or too little.
    """
    known, right = _known_and_right_joints(fit)
    return right if right.any() else known & (known.sum() >= _MIN_REFERENCE_JOINTS)


def _known_and_right_joints(fit: TorqueGains) -> tuple[BoolArray, BoolArray]:
    """Joints (m,) whose factors are known, and those of them whose factors are 1 within what a URDF is off by."""
    known = fit.spread[: len(fit.gain)] < _MAX_REFERENCE_SPREAD * np.maximum(np.abs(fit.gain), 1.0)
    known &= _agree(fit.gain, fit.reverse)
    least = _least_common_ratio(fit)
    is_off = _is_beyond(fit.gain, fit.gain, least) | _is_beyond(fit.reverse, fit.reverse, least)
    return known, known & ~is_off


def _least_common_ratio(fit: TorqueGains) -> float:
    """Factor of all torques alike that is no error of the URDF's masses."""
    return MIN_GAIN_RATIO if fit.common is not None and fit.common.is_weighed else MIN_COMMON_GAIN_RATIO


def common_gain_findings(of_joints: TorqueGains, robot: Robot) -> Iterator[Finding]:
    """A finding about all torques times a common factor."""
    fit = of_joints.common
    if fit is None or _known_and_right_joints(of_joints)[1].any() or not _agree(fit.gain, fit.reverse):
        return
    if not _is_beyond(fit.gain, fit.reverse, _least_common_ratio(of_joints)):
        return
    value, agreeing = np.array([fit.gain - 1.0]), fit.blocks[:, None] - 1.0
    if _is_certain(value, np.array([fit.spread]), agreeing, MIN_COMMON_BLOCK_SHARE).all():
        text = f"all torques: the factor that fits the {robot.format} best is {fit.gain:.3g} +- {fit.spread:.2g}"
        advice = (
            f"check units, gear ratios and torque constants, whether the {robot.format}'s masses and contact forces "
            "are right, or set sensors.scales: {joint_torque: all}"
        )
        yield Finding("scale", SUSPICIOUS, "joint_torque", text, advice)


def common_factor_notes(filtered: FilteredLog) -> Iterator[Finding]:
    """A note about a bolted arm's torques that are all the URDF's times one factor, which its masses may make up.

    Not by how torques fit the URDF, but by how the URDF fits them, beside all URDFs near it: what no parameters explain
    is in the torques, and makes the former too small.

    Args:
        filtered: a log that nothing else is wrong with.
    """
    rows, robot = filtered.rows, filtered.model.robot
    if rows is None or filtered.log.joint_torque is None:
        return
    nominal = robot.nominal.flatten()[None]

    def columns(builder: RowBuilder, part: Samples, number: int) -> FloatArray:
        required = np.asarray(force_series(builder, part, nominal)[1][0])
        return -required[..., None] * np.eye(robot.n)

    equations = UnknownEquations.of(rows, columns)
    common, each = equations.fit(_FACTOR_PRIOR_STD, np.ones((robot.n, 1))), equations.fit(_FACTOR_PRIOR_STD)
    factor, spread = 1.0 + float(common.value[0]), float(common.spread[0])
    known = each.spread < _MAX_REFERENCE_SPREAD
    apart = np.abs(each.value - common.value) > _MAX_DEVIATIONS_FROM_COMMON * each.spread
    agree = known.sum() >= _MIN_NOTED_JOINTS and not (known & apart).any()
    most = common.explained > _MIN_EXPLAINED_SHARE * each.explained
    certain = abs(factor - 1.0) > _MIN_NOTED_DEVIATIONS * spread and bool(common.steady[0])
    if agree and most and certain and _is_beyond(factor, factor, MIN_GAIN_RATIO):
        text = f"all torques are {factor:.3g} +- {spread:.1g} times what the {robot.format} needs: a wrong torque"
        text += f" constant, gear ratio, or masses of the {robot.format}, which no log tells apart"
        advice = f"none if the {robot.format}'s masses may have this error; else check torque constants and gear ratios"
        yield Finding("scale", NOTE, "joint_torque", text, advice)


def _agree(one: FloatArray | float, other: FloatArray | float) -> BoolArray:
    """Whether factors by either regression are the same, within what is reported of a factor."""
    return np.asarray(np.abs(other) < MIN_COMMON_GAIN_RATIO * np.abs(one))


def _is_beyond(one: FloatArray | float, other: FloatArray | float, ratio: float) -> BoolArray:
    """Whether factors by either regression are both larger than a ratio, or both smaller than its inverse."""
    low, high = np.minimum(one, other), np.maximum(one, other)
    return np.asarray((low > ratio) | (high < 1.0 / ratio))


def _is_certain(
    value: FloatArray,
    spread: FloatArray,
    blocks: FloatArray,
    share: float = MIN_BLOCK_SHARE,
) -> BoolArray:
    """Which values (k,) are not 0, by their standard deviations (k,) and their estimates by block (BLOCKS, k)."""
    agree = (blocks * np.sign(value) > share * np.abs(value)).all(axis=0)
    return np.asarray((np.abs(value) > MIN_STANDARD_DEVIATIONS * spread) & agree)
