"""Consistency of positions, velocities, accelerations, orientation and loops: unit, sign, frame, order and delay."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from torchid.errors import LogError, join_names
from torchid.log_checks.findings import NOTE, REJECTED, SUSPICIOUS, Finding, Skipped, channel_names
from torchid.logs import Log
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.preprocess import DERIVATIVE_CHAINS
from torchid.logs.quaternion import (
    angular_velocity_base,
    inverse_rotation,
    make_sign_continuous,
    rotate_to_base,
    rotate_to_world,
)
from torchid.logs.signal_noise import rough_noise
from torchid.logs.units import UNIT_TOLERANCE, advise_units, describe_units, units_of_derivative_ratio
from torchid.parameters import GRAVITY
from torchid.problem.log_joints import loop_gaps, with_loop_joints
from torchid.problem.motion import MIN_MOTION
from torchid.robot import Robot
from torchid.rounding import STD_PER_MAD

# ---------------------------------------------------------------------------------------------- unit of joint positions

#: Two turns: joints with end stops have a smaller range.
MAX_ANGLE_RAD = 4.0 * np.pi
#: Median speed of the joints: motors of legs reach 20 to 30 rad/s.
MAX_SPEED_RAD_S = 40.0
DEAD_ENCODER_ADVICE = "check whether the joint moves; if it does, its encoder is dead: do not use this log"
#: Descriptions of mistakes, and what to do.
QUATERNION_ORDER = "wrong order: w first and w last are confused", "rename base_quat_wxyz and base_quat_xyzw"
INVERSE_QUATERNION = "rotates world to base, not base to world", "give the inverse"


def check_angle_unit(log: Log, robot: Robot | None) -> Iterator[Finding]:
    """Findings about the unit of `joint_position`.

    Continuous joints, such as wheels, may turn any number of times. They count only if most other joints do, too.
    """
    bodies = () if robot is None else robot.bodies
    joints = {body.joint.name: body.joint for body in bodies if body.joint is not None}
    columns = [i for i, x in enumerate(map(joints.get, log.joint_names)) if x is None or x.kind != "prismatic"]
    if not columns:
        return
    position = log.joint_position[:, columns]
    has_stops = np.array([x is None or not x.continuous for x in (joints.get(log.joint_names[i]) for i in columns)])
    moved = np.abs(position).max(axis=0) > 0.0
    far = np.abs(position).max(axis=0) > MAX_ANGLE_RAD
    if 2 * int(far.sum()) < int(moved.sum()):
        far &= has_stops
    names = [log.joint_names[columns[i]] for i in np.flatnonzero(far)]
    advice = "convert joint_position, joint_velocity and joint_acceleration to radians"
    if far.any():
        text = f"{join_names(names)}: up to {np.abs(position[:, far]).max():.4g} rad, more than two turns. In degrees?"
        certain = 0 < int((moved & has_stops).sum()) <= 2 * int((far & has_stops).sum())
        severity = REJECTED if certain else SUSPICIOUS
        yield Finding("unit", severity, "joint_position", text, advice, tuple(names))
    elif len(log) > 2:
        speed = np.percentile(np.abs(np.diff(position, axis=0)) / np.diff(log.time)[:, None], 90.0, axis=0)
        if float(np.median(speed)) > MAX_SPEED_RAD_S:
            text = f"half of the joints exceed {np.median(speed):.3g} rad/s. Are angles in degrees, or time in ms?"
            yield Finding("unit", SUSPICIOUS, "joint_position", text, advice)


# ----------------------------------------------------------------- comparison of recorded derivatives with their bases

#: Time over which differences are compared: a tenth of a second resolves motion up to 5 Hz.
LAG_S = 0.1
#: Largest shift that is tried in either direction.
MAX_DELAY_SAMPLES = 20
#: Rms difference of a channel over its noise, above which it is compared.
_MIN_SIGNAL_TO_NOISE = 20.0
#: Samples that are compared: all of a short log, evenly spread ones of a long log.
_MAX_COMPARED_SAMPLES = 20000


@dataclass(frozen=True, eq=False)
class DerivativeComparison:
    """A recorded derivative of c channels compared with the derivative of its base.

    Attributes:
        ratio: (c,) regression slope of the recorded over the true derivative, NaN where the channel hardly moves.
        correlation: (c,) of both at the best shift, NaN likewise.
        delay: (c,) the best shift [samples], positive where the recorded derivative lags, NaN likewise.
        excess: (c,) mean of the recorded less that of the true derivative, in its unit.
        misfit: norm of the difference over that of the true derivative, both without their means, all channels together
            at their best common shift.
    """

    ratio: FloatArray
    correlation: FloatArray
    delay: FloatArray
    excess: FloatArray
    misfit: float


def compare_derivative(
    time: FloatArray, base: FloatArray, derivative: FloatArray, order: int = 1
) -> DerivativeComparison | None:
    """Compare a derivative (N, c) of some order with its base (N, c), N stamps [s]; None if the log is too short."""
    step = float(np.median(np.diff(time))) if len(time) > 1 else LAG_S
    lag = max(2, round(LAG_S / step))
    if len(time) < order * lag + 6 * MAX_DELAY_SAMPLES:
        return None
    for _ in range(order):
        derivative = _integrate(time, derivative)
    true, given = (_differences(values, lag, order) for values in (base, derivative))
    at = np.arange(MAX_DELAY_SAMPLES, len(true) - MAX_DELAY_SAMPLES, max(1, len(true) // _MAX_COMPARED_SAMPLES))
    excess = (given[at] - true[at]).mean(axis=0) / (lag * step) ** order
    target = true[at] - true[at].mean(axis=0)
    size = np.square(target).sum(axis=0)
    products = []
    misfits = []
    for shift in range(-MAX_DELAY_SAMPLES, MAX_DELAY_SAMPLES + 1):
        shifted = given[at + shift] - given[at + shift].mean(axis=0)
        products.append(((target * shifted).sum(axis=0), np.square(shifted).sum(axis=0)))
        misfits.append(float(np.sqrt(np.square(shifted - target).sum() / max(size.sum(), 1e-300))))
    inner, norms = (np.array(values) for values in zip(*products, strict=True))
    noise = STD_PER_MAD * np.median(np.abs(np.diff(base, n=2, axis=0)), axis=0)
    moves = np.sqrt(size / len(at)) > np.maximum(_MIN_SIGNAL_TO_NOISE * noise, 1e-9)
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = np.nan_to_num(inner / (np.sqrt(size) * np.sqrt(norms)), posinf=0.0, neginf=0.0)
        best = np.argmax(np.abs(correlation), axis=0)[None]
        ratio, highest = (np.take_along_axis(x, best, axis=0)[0] for x in (inner / size, correlation))
    delay = _interpolate_maximum(np.abs(correlation), best[0]) - MAX_DELAY_SAMPLES
    ratio, highest, delay = (np.where(moves, x, np.nan) for x in (ratio, highest, delay))
    return DerivativeComparison(ratio, highest, delay, excess, min(misfits))


def _integrate(time: FloatArray, values: FloatArray) -> FloatArray:
    """Integral over time from the first sample on, (N, c), by the trapezoidal rule."""
    areas = 0.5 * (values[1:] + values[:-1]) * np.diff(time)[:, None]
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(areas, axis=0)])


def _differences(values: FloatArray, lag: int, order: int) -> FloatArray:
    for _ in range(order):
        values = values[lag:] - values[:-lag]
    return values


def _interpolate_maximum(correlation: FloatArray, best: np.ndarray) -> FloatArray:
    """Positions (c,) of the maxima of (S, c), by a parabola through the largest values, at `best` (c,)."""
    inside = np.clip(best, 1, len(correlation) - 2)
    left, middle, right = (np.take_along_axis(correlation, inside[None] + k, axis=0)[0] for k in (-1, 0, 1))
    curvature = left - 2.0 * middle + right
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = np.where(curvature < 0.0, 0.5 * (left - right) / curvature, 0.0)
    return np.where(inside == best, best + np.clip(offset, -0.5, 0.5), best)


# ----------------------------------------------------------------------------------------- velocities and accelerations

#: Delay that is reported: integrators and central differences have half a sample.
MIN_DELAY_SAMPLES = 1.5
#: Deviation of the ratio from 1: filters in a driver take a tenth.
MAX_RATIO_ERROR = 0.15
#: Correlation of a derivative with that of its base.
MIN_CORRELATION = 0.9
#: Misfit above which other frames and orders are tried, and the share of it that the right one may leave.
MAX_MISFIT = 0.15
MAX_DERIVATIVE_RESIDUAL_SHARE = 0.3
_TINY = 1e-300
_DERIVATIVE_CHECK = "velocities and accelerations against positions"


def check_derivatives(log: Log) -> Iterator[Finding | Skipped]:
    """Findings about recorded velocities and accelerations."""
    if not any(getattr(log, name) is not None for chain in DERIVATIVE_CHAINS for name in chain[1:]):
        yield Skipped(_DERIVATIVE_CHECK, "the log has neither velocities nor accelerations")
    for chain in DERIVATIVE_CHAINS:
        given = [(order, name) for order, name in enumerate(chain) if getattr(log, name) is not None]
        for (low, base), (high, name) in zip(given, given[1:], strict=False):
            comparison = compare_derivative(log.time, getattr(log, base), getattr(log, name), high - low)
            if comparison is None:
                yield Skipped(_DERIVATIVE_CHECK, f"{name}: the log is too short")
            else:
                findings = list(_frame_findings(log, name, base, high - low, comparison))
                channels = channel_names(log, name)
                yield from findings or _derivative_findings(comparison, name, base, channels, high - low)


def _derivative_findings(
    comparison: DerivativeComparison, name: str, base: str, channels: tuple[str, ...], order: int = 1
) -> Iterator[Finding]:
    """Findings about one derivative and its channels."""
    follows = np.abs(comparison.correlation) >= MIN_CORRELATION  # NaN compares false
    lost = ~follows & np.isfinite(comparison.correlation)
    compared = comparison.ratio[follows]
    alike = bool((np.abs(compared / np.median(compared) - 1.0) < UNIT_TOLERANCE).all()) if len(compared) else False
    meanings = [
        _meaning(ratio, name, base, order if alike else None) if ok else None
        for ratio, ok in zip(comparison.ratio, follows, strict=True)
    ]
    named = np.array([meaning is not None for meaning in meanings], bool)
    derive = "remove the field: torchid then derives it"
    for meaning in dict.fromkeys(meaning for meaning in meanings if meaning is not None):
        mask = np.array([other == meaning for other in meanings])
        text = f"{comparison.ratio[mask][0]:.4g} times the derivative of {base}: {meaning[0]}"
        yield _finding("unit or sign", REJECTED, name, channels, mask, text, meaning[1])
    off = follows & ~named & (np.abs(comparison.ratio - 1.0) > MAX_RATIO_ERROR)
    if off.any():
        worst = int(np.argmax(np.abs(np.log(np.where(off, np.abs(comparison.ratio), 1.0) + _TINY))))
        text = f"{comparison.ratio[worst]:.3g} times the derivative of {base} ({channels[worst]})"
        yield _finding("ratio", SUSPICIOUS, name, channels, off, text, derive)
    late = follows & (np.abs(comparison.delay) >= MIN_DELAY_SAMPLES)
    if late.any():
        typical = float(np.median(comparison.delay[late]))
        text = f"{'lags' if typical > 0 else 'leads'} the derivative of {base} by {abs(typical):.3g} samples"
        yield _finding("delay", SUSPICIOUS, name, channels, late, text, derive)
    if lost.any():
        text = f"does not follow the derivative of {base} (correlation {np.nanmin(np.abs(comparison.correlation)):.2f})"
        advice = f"check the {'order of its joints' if name.startswith('joint') else 'frame'}, or {derive}"
        yield _finding("derivative", SUSPICIOUS, name, channels, lost, text, advice)


def _meaning(ratio: float, name: str, base: str, order: int | None) -> tuple[str, str] | None:
    """Cause of a derivative's ratio, and what to do; None if unknown. `order`: None if time cannot be the cause."""
    if abs(ratio + 1.0) < UNIT_TOLERANCE:
        return "the sign is reversed", "reverse it, or remove the field"
    units = units_of_derivative_ratio(ratio, name, base, order)
    if not units:
        return None
    return describe_units(units), f"{advise_units(units)}, or convert or remove the field"


def _frame_findings(log: Log, name: str, base: str, order: int, comparison: DerivativeComparison) -> Iterator[Finding]:
    """Findings about a vector of the base that is in the other frame, or that contains gravity."""
    if name == "base_linear_acceleration_world" and abs(abs(comparison.excess[2] / GRAVITY) - 1.0) < UNIT_TOLERANCE:
        text = f"exceeds the derivative of {base} by {comparison.excess[2]:.2f} m/s^2 along z: it contains gravity"
        advice = "give the derivative of the velocity, or rename it to imu_specific_force"
        yield Finding("gravity", REJECTED, name, text, advice, ("z",))
    if not name.startswith("base_linear") or log.base_quat_xyzw is None or comparison.misfit < MAX_MISFIT:
        return
    for rotate, actual in ((rotate_to_world, "base"), (rotate_to_base, "world")):
        rotated = rotate(log.base_quat_xyzw, getattr(log, name))
        trial = compare_derivative(log.time, getattr(log, base), rotated, order)
        if trial is not None and trial.misfit < MAX_DERIVATIVE_RESIDUAL_SHARE * comparison.misfit:
            text = f"fits {base} in the {actual} frame, not in the frame of its name"
            yield Finding("frame", REJECTED, name, text, f"rename it to {name.replace('world', actual)}")


def _finding(
    name: str, severity: str, field: str, channels: tuple[str, ...], mask: BoolArray, text: str, advice: str
) -> Finding:
    names = tuple(channel for channel, concerned in zip(channels, mask, strict=True) if concerned)
    return Finding(name, severity, field, f"{join_names(names)}: {text}", advice, names)


# ------------------------------------------------------------------------------------- angular velocity and orientation

_ANGULAR_VELOCITY_CHECK = "angular velocity against orientation"


def check_angular_velocity(log: Log, robot: Robot | None) -> Iterator[Finding | Skipped]:
    """Findings about angular velocity and orientation."""
    quat = log.base_quat_xyzw
    if quat is None and robot is not None and robot.fixed_base:
        return
    if quat is None or len(log) < 3:
        yield Skipped(_ANGULAR_VELOCITY_CHECK, "no orientation of the base" if quat is None else "the log is too short")
        return
    recorded = dict(_recorded_velocities(log, robot))
    if not recorded:
        unknown = "the IMU needs a robot with imu_frame"
        yield Skipped(_ANGULAR_VELOCITY_CHECK, unknown if log.imu_frame else "no angular velocity of the base")
    for field, omega in recorded.items():
        comparison = compare_derivative(log.time, _integrate(log.time, _omega(log.time, quat)), omega)
        if comparison is None:
            yield Skipped(_ANGULAR_VELOCITY_CHECK, f"{field}: the log is too short")
            continue
        mistake = None
        if comparison.misfit > MAX_MISFIT:
            data = log.time, quat, omega, comparison.misfit
            mistake = _best_mistake(*data) or _mounted_otherwise(*data)
        if mistake is None:
            yield from _derivative_findings(comparison, field, "base_quat", ("x", "y", "z"))
        else:
            yield Finding("frame or order", REJECTED, mistake.field or field, mistake.description, mistake.advice)


def _recorded_velocities(log: Log, robot: Robot | None) -> Iterator[tuple[str, FloatArray]]:
    """Angular velocities of the base in the base frame, by field."""
    if log.base_angular_velocity_base is not None:
        yield "base_angular_velocity_base", log.base_angular_velocity_base
    if log.imu_angular_velocity is not None and robot is not None and log.imu_frame in robot.links:
        body, T_base_imu = robot.links[log.imu_frame]
        if body == 0:
            yield "imu_angular_velocity", log.imu_angular_velocity @ T_base_imu[:3, :3].T


def _omega(time: FloatArray, quat: FloatArray) -> FloatArray:
    """Angular velocity (N, 3) [rad/s] in the base frame of orientations (N, 4), by central differences."""
    return angular_velocity_base(quat, np.gradient(quat, time, axis=0))


@dataclass(frozen=True, eq=False)
class _Mistake:
    """A common mistake: description, advice, its field ("": angular velocity), and the corrected values."""

    description: str
    advice: str
    field: str
    quat: FloatArray
    omega: FloatArray


def _mistakes(quat: FloatArray, omega: FloatArray) -> Iterator[_Mistake]:
    """Common mistakes with an orientation (N, 4) and an angular velocity (N, 3)."""
    frame = "fits in the {} frame, not in the {} frame"
    yield _Mistake(frame.format("world", "base"), "rename it to ..._world", "", quat, rotate_to_base(quat, omega))
    yield _Mistake(frame.format("base", "world"), "rename it to ..._base", "", quat, rotate_to_world(quat, omega))
    for shift in (1, -1):
        rolled = make_sign_continuous(np.roll(quat, shift, axis=1))
        yield _Mistake(*QUATERNION_ORDER, "base_quat_xyzw", rolled, omega)
        from_world = rotate_to_base(rolled, rotate_to_world(quat, omega))  # if the log gave it in the world frame
        yield _Mistake(*QUATERNION_ORDER, "base_quat_xyzw", rolled, from_world)
    yield _Mistake("the sign is reversed", "reverse it", "", quat, -omega)
    yield _Mistake(*INVERSE_QUATERNION, "base_quat_xyzw", inverse_rotation(quat), omega)


def _best_mistake(time: FloatArray, quat: FloatArray, omega: FloatArray, misfit: float) -> _Mistake | None:
    """The mistake whose correction has the smallest misfit, if that is small enough.

    Several may do: the inverse and the reversed orientation are nearly equal for a base that turns little.
    """
    best = None
    least = MAX_DERIVATIVE_RESIDUAL_SHARE * misfit
    for mistake in _mistakes(quat, omega):
        trial = compare_derivative(time, _integrate(time, _omega(time, mistake.quat)), mistake.omega)
        if trial is not None and trial.misfit < least:
            best = mistake
            least = trial.misfit
    return best


def _mounted_otherwise(time: FloatArray, quat: FloatArray, omega: FloatArray, misfit: float) -> _Mistake | None:
    """An angular velocity along the axes of another frame; None if no rotation explains the misfit."""
    lag = max(2, round(LAG_S / float(np.median(np.diff(time)))))
    true, read = (_differences(_integrate(time, x), lag, 1) for x in (_omega(time, quat), omega))
    turn = Rotation.align_vectors(true - true.mean(axis=0), read - read.mean(axis=0))[0]
    turned = omega @ turn.as_matrix().T
    trial = compare_derivative(time, _integrate(time, _omega(time, quat)), turned)
    if trial is None or trial.misfit > MAX_DERIVATIVE_RESIDUAL_SHARE * misfit:
        return None
    degrees = ", ".join(f"{x:.0f}" for x in turn.as_rotvec(degrees=True))
    text = f"fits the orientation if turned by ({degrees}) degrees about the base's axes"
    return _Mistake(text, "set imu_frame to the robot's frame with the axes of the IMU", "", quat, turned)


def completed(log: Log, robot: Robot | None) -> tuple[Log, list[Finding]]:
    """The log with the dependent joints of loops, see `with_loop_joints`; or the log as it is, and a finding."""
    try:
        return with_loop_joints(log, robot), []
    except LogError as error:
        finding = Finding("open loop", REJECTED, "joint_position", error.found, f"give {error.accepted}")
        return log, [finding]


def check_loops(log: Log, robot: Robot | None) -> Iterator[Finding]:
    """A finding for each loop; none if the log lacks joints of the robot."""
    if robot is None or not robot.loops or not set(robot.joint_names) <= set(log.joint_names):
        return
    order = [log.joint_names.index(name) for name in robot.joint_names]
    for gap in loop_gaps(robot, torch.from_numpy(log.joint_position[:, order])):
        if gap.is_open:
            advice = f"check the loop's frames, encoder zeros and signs; accepted: {gap.accepted}"
            text = f"{gap.loop.label} do not meet: {gap}"
            yield Finding("open loop", REJECTED, "joint_position", text, advice, gap.loop.frames)
        else:
            text = f"{gap.loop.label} meet: {gap}"
            yield Finding("closed loop", NOTE, "joint_position", text, f"nothing; accepted: {gap.accepted}")


# ------------------------------------------------------------------------------------------------------ poses and rest

LinkPoses = dict[str, torch.Tensor]
"""Poses (N, 4, 4) in the base of the robot's links, by name."""


def recorded_link_poses(log: Log, robot: Robot) -> LinkPoses:
    """Poses of the links at the samples of a log of all the robot's joints."""
    order = [log.joint_names.index(name) for name in robot.joint_names]
    return robot.link_poses(torch.from_numpy(log.joint_position[:, order]))


def same_poses(log: Log, other: Log, robot: Robot, links: Sequence[str]) -> bool:
    """Whether some links have the same poses in the base in two logs; other joints do not count."""
    if log.joint_position is other.joint_position and log.joint_names == other.joint_names:
        return True
    moved = {body - 1 for link in links if link in robot.links for body in robot.bodies_to(robot.links[link][0])}
    joints = np.unique(np.nonzero(robot.joint_map[0][sorted(moved)])[1])  # those that others follow among them
    names = [robot.joint_names[joint] for joint in joints]
    if not set(names) <= set(log.joint_names) & set(other.joint_names):
        return False
    positions, theirs = (x.joint_position[:, [x.joint_names.index(name) for name in names]] for x in (log, other))
    return np.array_equal(positions, theirs)


#: Time over which positions are averaged, and velocities added up: a tenth of a second resolves motion up to 5 Hz.
_AVERAGED_S = 0.1
#: Largest range of averages of white noise, in their standard deviations, in a thousand of them.
_NOISE_RANGE = 8.0
#: Travel by a joint's velocity over its noise, and over that of its position, from which on it moves.
_MIN_TRAVEL_TO_NOISE = 20.0
_MIN_TRAVEL_RATIO = 10.0


def still_joints(log: Log) -> tuple[str, ...]:
    """Joints that never move by more than their noise, while others do."""
    position = log.joint_position
    if len(log) < 2 or not position.size or np.ptp(position, axis=0).max() <= MIN_MOTION:
        return ()
    count = max(1, round(_AVERAGED_S / float(np.median(np.diff(log.time)))))
    whole = count * (len(log) // count)
    if whole < 2 * count:
        return ()
    averages = position[:whole].reshape(-1, count, position.shape[1]).mean(axis=1)
    noise = rough_noise(position) / np.sqrt(count)
    still = np.ptp(averages, axis=0) <= np.minimum(_NOISE_RANGE * noise, MIN_MOTION)
    return tuple(name for name, rests in zip(log.joint_names, still, strict=True) if rests)


def check_still_velocities(log: Log) -> Iterator[Finding]:
    """A finding about joints with constant positions whose velocities show a motion."""
    names = still_joints(log)
    velocity = log.joint_velocity
    if not names or velocity is None:
        return
    step = float(np.median(np.diff(log.time)))
    lag = max(1, round(_AVERAGED_S / step))
    travelled = step * np.cumsum(velocity, axis=0)
    moved, read = (x[lag:] - x[:-lag] for x in (travelled, log.joint_position))
    size, still = (np.std(x, axis=0) for x in (moved, read))
    least = np.maximum(_MIN_TRAVEL_TO_NOISE * step * np.sqrt(lag) * rough_noise(velocity), _MIN_TRAVEL_RATIO * still)
    dead = [name for name in names if size[(j := log.joint_names.index(name))] > max(least[j], 1e-9)]
    if dead:
        ranges = [f"{name} {np.ptp(travelled[:, log.joint_names.index(name)]):.2g}" for name in dead]
        text = f"positions are constant, but velocities move these joints (rad or m): {join_names(ranges)}"
        yield Finding("dead encoder", SUSPICIOUS, "joint_position", text, DEAD_ENCODER_ADVICE, tuple(dead))


def joints_of_limb(robot: Robot, frame: str) -> list[str]:
    """The joints between the base and a link, from the base on."""
    joints = (robot.bodies[body].joint for body in robot.bodies_to(robot.links[frame][0]))
    return [joint.name for joint in joints if joint is not None]


def still_in_limb(log: Log, robot: Robot, frame: str) -> list[str]:
    """The joints between the base and a link that never move in the log."""
    still = still_joints(log)
    return [name for name in joints_of_limb(robot, frame) if name in still]
