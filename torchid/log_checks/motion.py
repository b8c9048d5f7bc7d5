"""Positions, velocities, accelerations and orientation against each other: unit, sign, frame, order and delay."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from torchid.errors import join_names
from torchid.log_checks.findings import CONDEMNED, NORMAL, SUSPICIOUS, Finding, Skipped, channel_names
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
from torchid.regressor.kinematics import GRAVITY_WORLD
from torchid.robot import Robot

# ---------------------------------------------------------------------------------------------- unit of joint positions

#: Two turns [rad]: a joint with stops goes nowhere near.
TWO_TURNS = 4.0 * np.pi
#: Speed [rad/s] that half of a robot's joints do not exceed: motors of legs reach 20 to 30.
FAST = 40.0
_ADVICE = "convert joint_position, and velocities and accelerations with it, to radians"
_ENDLESS = ("continuous", "prismatic")


def check_angle_unit(log: Log, robot: Robot | None) -> Iterator[Finding]:
    """Findings about the unit of `joint_position`."""
    bodies = () if robot is None else robot.bodies
    joints = {body.joint.name: body.joint.kind for body in bodies if body.joint is not None}
    columns = [i for i, name in enumerate(log.joint_names) if joints.get(name) not in _ENDLESS]
    if not columns:
        return
    position = log.joint_position[:, columns]
    moved = np.abs(position).max(axis=0) > 0.0
    far = np.abs(position).max(axis=0) > TWO_TURNS
    names = [log.joint_names[columns[i]] for i in np.flatnonzero(far)]
    if far.any():
        text = f"{join_names(names)}: up to {np.abs(position).max():.4g}, more than two turns: degrees?"
        certain = 2 * int(far.sum()) >= int(moved.sum())
        severity = CONDEMNED if certain else SUSPICIOUS
        yield Finding("unit", severity, "joint_position", text, _ADVICE, tuple(names))
    elif len(log) > 2:
        speed = np.percentile(np.abs(np.diff(position, axis=0)) / np.diff(log.time)[:, None], 90.0, axis=0)
        if float(np.median(speed)) > FAST:
            text = f"half of the joints faster than {np.median(speed):.3g} rad/s: degrees, or time in another unit?"
            yield Finding("unit", SUSPICIOUS, "joint_position", text, _ADVICE)


# -------------------------------------------------------------------- a derivative against what it is the derivative of

#: Time [s] across which differences are compared: a tenth of a second resolves motion up to 5 Hz.
LAG = 0.1
#: Shifts tried on either side [samples].
MAX_DELAY = 20
#: Size of a difference, in that of its noise, from which on a channel moves enough to be judged.
_MOVES = 20.0
#: Samples that are compared: every one of a short log, evenly spread ones of a long one.
_COMPARED = 20000


@dataclass(frozen=True, eq=False)
class Comparison:
    """How a derivative compares with what it should be.

    Attributes:
        ratio: (c,) slope of the derivative over what it should be, NaN where the channel hardly moves.
        correlation: (c,) of the two at the best shift, NaN likewise.
        delay: (c,) that shift [samples], positive where the derivative lags, NaN likewise.
        excess: (c,) mean of the derivative beyond what it should be, in its unit.
        misfit: size of the difference of both about their means over that of what it should be, all channels together
            at their best common shift.
    """

    ratio: FloatArray
    correlation: FloatArray
    delay: FloatArray
    excess: FloatArray
    misfit: float


def compare_derivative(time: FloatArray, base: FloatArray, derivative: FloatArray, order: int = 1) -> Comparison | None:
    """Compare a derivative (N, c) of some order with its base (N, c), N stamps [s]; None if the log is too short."""
    step = float(np.median(np.diff(time))) if len(time) > 1 else LAG
    lag = max(2, round(LAG / step))
    if len(time) < order * lag + 6 * MAX_DELAY:
        return None
    for _ in range(order):
        derivative = _integrate(time, derivative)
    wanted, given = (_differences(values, lag, order) for values in (base, derivative))
    at = np.arange(MAX_DELAY, len(wanted) - MAX_DELAY, max(1, len(wanted) // _COMPARED))
    excess = (given[at] - wanted[at]).mean(axis=0) / (lag * step) ** order
    target = wanted[at] - wanted[at].mean(axis=0)
    size = np.square(target).sum(axis=0)
    products, misfits = [], []
    for shift in range(-MAX_DELAY, MAX_DELAY + 1):
        shifted = given[at + shift] - given[at + shift].mean(axis=0)
        products.append(((target * shifted).sum(axis=0), np.square(shifted).sum(axis=0)))
        misfits.append(float(np.sqrt(np.square(shifted - target).sum() / max(size.sum(), 1e-300))))
    inner, norms = (np.array(values) for values in zip(*products, strict=True))
    noise = NORMAL * np.median(np.abs(np.diff(base, n=2, axis=0)), axis=0)
    moves = np.sqrt(size / len(at)) > np.maximum(_MOVES * noise, 1e-9)
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = np.nan_to_num(inner / (np.sqrt(size) * np.sqrt(norms)), posinf=0.0, neginf=0.0)
        best = np.argmax(np.abs(correlation), axis=0)[None]
        ratio, follows = (np.take_along_axis(x, best, axis=0)[0] for x in (inner / size, correlation))
    delay = _refined(np.abs(correlation), best[0]) - MAX_DELAY
    ratio, follows, delay = (np.where(moves, x, np.nan) for x in (ratio, follows, delay))
    return Comparison(ratio, follows, delay, excess, min(misfits))


def _integrate(time: FloatArray, values: FloatArray) -> FloatArray:
    """Integral over time from the first sample on, (N, c), by the trapezoidal rule."""
    areas = 0.5 * (values[1:] + values[:-1]) * np.diff(time)[:, None]
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(areas, axis=0)])


def _differences(values: FloatArray, lag: int, order: int) -> FloatArray:
    for _ in range(order):
        values = values[lag:] - values[:-lag]
    return values


def _refined(correlation: FloatArray, best: np.ndarray) -> FloatArray:
    """Places (c,) of the largest of (S, c), between the integers by a parabola through it and its neighbours."""
    inside = np.clip(best, 1, len(correlation) - 2)
    left, middle, right = (np.take_along_axis(correlation, inside[None] + k, axis=0)[0] for k in (-1, 0, 1))
    bend = left - 2.0 * middle + right
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = np.where(bend < 0.0, 0.5 * (left - right) / bend, 0.0)
    return np.where(inside == best, best + np.clip(offset, -0.5, 0.5), best)


# ----------------------------------------------------------------------------------------- velocities and accelerations

#: A delay [samples] worth a word: half a sample comes from integrators and central differences.
DELAYED = 1.5
#: How far the ratio of a derivative to what it should be may be from 1. Filters in a driver take a tenth.
RATIO = 0.15
#: Correlation below which a derivative does not follow.
FOLLOWS = 0.9
#: Misfit above which other frames and orders are tried, and the share of it that one must leave to be the right one.
WRONG, BETTER = 0.15, 0.3
#: Ratios that have a name, and by which share they may be missed.
ANGLES = {-1.0: "the sign is reversed", 180.0 / np.pi: "it is in degrees", np.pi / 180.0: "{base} is in degrees"}
LENGTHS = {-1.0: "the sign is reversed", 1e3: "it is in mm", 1e-3: "{base} is in mm"}
_CLOSE = 0.15
#: Ratio of every derivative where time is in minutes: 5 % from that of degrees.
MINUTES = 1.0 / 60.0
_TINY = 1e-300
_DERIVATIVES = "velocities and accelerations against positions"


def check_derivatives(log: Log) -> Iterator[Finding | Skipped]:
    """Findings about the derivatives that the log gives."""
    if not any(getattr(log, name) is not None for chain in DERIVATIVE_CHAINS for name in chain[1:]):
        yield Skipped(_DERIVATIVES, "the log gives neither velocities nor accelerations")
    for chain in DERIVATIVE_CHAINS:
        given = [(order, name) for order, name in enumerate(chain) if getattr(log, name) is not None]
        for (low, base), (high, name) in zip(given, given[1:], strict=False):
            found = compare_derivative(log.time, getattr(log, base), getattr(log, name), high - low)
            if found is None:
                yield Skipped(_DERIVATIVES, f"{name}: the log is too short")
            else:
                wrong = list(_frame(log, name, base, high - low, found))
                yield from wrong or _derivative_findings(found, name, base, channel_names(log, name))


def _derivative_findings(found: Comparison, name: str, base: str, channels: tuple[str, ...]) -> Iterator[Finding]:
    """Findings about one derivative, given with the names of its channels."""
    follows = np.abs(found.correlation) >= FOLLOWS  # so written, NaN does not follow
    lost = ~follows & np.isfinite(found.correlation)
    meanings = {**(LENGTHS if name.startswith("base_linear") else ANGLES), MINUTES: "time is in minutes"}
    away = np.array([np.abs(found.ratio / ratio - 1.0) for ratio in meanings])  # (meanings, c)
    named = follows & (away.min(axis=0) < _CLOSE)
    for number, meaning in enumerate(meanings.values()):
        here = named & (away.argmin(axis=0) == number)
        if here.any():
            text = f"{found.ratio[here][0]:.4g} times the derivative of {base}: {meaning.format(base=base)}"
            yield _finding("unit or sign", CONDEMNED, name, channels, here, text, "convert it, or leave the field out")
    off = follows & ~named & (np.abs(found.ratio - 1.0) > RATIO)
    if off.any():
        worst = int(np.argmax(np.abs(np.log(np.where(off, np.abs(found.ratio), 1.0) + _TINY))))
        text = f"{found.ratio[worst]:.3g} times the derivative of {base} ({channels[worst]})"
        yield _finding("ratio", SUSPICIOUS, name, channels, off, text, "leave the field out: it is derived then")
    late = follows & (np.abs(found.delay) >= DELAYED)
    if late.any():
        typical = float(np.median(found.delay[late]))
        text = f"{'lags' if typical > 0 else 'leads'} the derivative of {base} by {abs(typical):.3g} samples"
        yield _finding("delay", SUSPICIOUS, name, channels, late, text, "leave the field out: it is derived then")
    if lost.any():
        text = f"does not follow {base}: correlation {np.nanmin(np.abs(found.correlation)):.2f} with its derivative"
        cause = "the order of its joints" if name.startswith("joint") else "its frame"
        advice = f"leave the field out: it is derived then; or look for {cause}"
        yield _finding("derivative", SUSPICIOUS, name, channels, lost, text, advice)


def _frame(log: Log, name: str, base: str, order: int, found: Comparison) -> Iterator[Finding]:
    """Findings about a vector of the base in another frame than its name states, or that contains gravity."""
    if name == "base_linear_acceleration_world" and abs(abs(found.excess[2] / GRAVITY_WORLD[2]) - 1.0) < _CLOSE:
        text = f"{found.excess[2]:+.2f} m/s^2 along z on average beyond the derivative of {base}: it contains gravity"
        advice = "give d/dt of the velocity, or name it imu_specific_force"
        yield Finding("gravity", CONDEMNED, name, text, advice, ("z",))
    if not name.startswith("base_linear") or log.base_quat_xyzw is None or found.misfit < WRONG:
        return
    for turn, actual in ((rotate_to_world, "base"), (rotate_to_base, "world")):
        turned = compare_derivative(log.time, getattr(log, base), turn(log.base_quat_xyzw, getattr(log, name)), order)
        if turned is not None and turned.misfit < BETTER * found.misfit:
            text = f"follows {base} if it is in the {actual} frame, not in the one that its name says"
            yield Finding("frame", CONDEMNED, name, text, f"call it {name.replace('world', actual)}")


def _finding(
    name: str, severity: str, field: str, channels: tuple[str, ...], where: BoolArray, text: str, advice: str
) -> Finding:
    chosen = tuple(channel for channel, here in zip(channels, where, strict=True) if here)
    return Finding(name, severity, field, f"{join_names(list(chosen))}: {text}", advice, chosen)


# ------------------------------------------------------------------------------------- angular velocity and orientation

_TURNING = "angular velocity against orientation"


def check_angular_velocity(log: Log, robot: Robot | None) -> Iterator[Finding | Skipped]:
    """Findings about angular velocities and the orientation."""
    quat = log.base_quat_xyzw
    if quat is None and robot is not None and robot.fixed_base:
        return  # it does not turn
    if quat is None or len(log) < 3:
        yield Skipped(_TURNING, "no orientation of the base" if quat is None else "the log is too short")
        return
    given = dict(_measured(log, robot))
    if not given:
        nowhere = "an IMU, and no robot that says where it is"
        yield Skipped(_TURNING, nowhere if log.imu_frame else "no angular velocity of the base")
    for field, omega in given.items():
        found = compare_derivative(log.time, _integrate(log.time, _omega(log.time, quat)), omega)
        if found is None:
            yield Skipped(_TURNING, f"{field}: the log is too short")
            continue
        mistaken = _explaining(log.time, quat, omega, found.misfit) if found.misfit > WRONG else None
        if mistaken is None:
            yield from _derivative_findings(found, field, "base_quat", ("x", "y", "z"))
        else:
            yield Finding("frame or order", CONDEMNED, mistaken.field or field, mistaken.found, mistaken.advice)


def _measured(log: Log, robot: Robot | None) -> Iterator[tuple[str, FloatArray]]:
    """Angular velocities of the base in its own frame, by field."""
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
    """A usual mistake: what was found, what to do, the field to blame ("": omega), and what was meant."""

    found: str
    advice: str
    field: str
    quat: FloatArray
    omega: FloatArray


def _mistakes(quat: FloatArray, omega: FloatArray) -> Iterator[_Mistake]:
    """Usual mistakes with an orientation (N, 4) and an angular velocity (N, 3)."""
    frame = "fits in the {} frame, not in the {} frame"
    yield _Mistake(frame.format("world", "base"), "call it ..._world", "", quat, rotate_to_base(quat, omega))
    yield _Mistake(frame.format("base", "world"), "call it ..._base", "", quat, rotate_to_world(quat, omega))
    order = "the components' order is the other one: w first against w last"
    for shift in (1, -1):
        other = make_sign_continuous(np.roll(quat, shift, axis=1))
        for value in (
            omega,
            rotate_to_base(other, rotate_to_world(quat, omega)),
        ):  # as it is, or as it was given in the world
            yield _Mistake(order, "rename base_quat_wxyz and base_quat_xyzw", "base_quat_xyzw", other, value)
    yield _Mistake("the sign is reversed", "reverse it", "", quat, -omega)
    name = "rotates world to base, not base to world"
    yield _Mistake(name, "give the inverse", "base_quat_xyzw", inverse_rotation(quat), omega)


def _explaining(time: FloatArray, quat: FloatArray, omega: FloatArray, misfit: float) -> _Mistake | None:
    """The mistake that leaves the least of a misfit once it is taken back, if that is little.

    The least, for a base that turns little is as well off with the inverse as with the reverse.
    """
    best, least = None, BETTER * misfit
    for mistake in _mistakes(quat, omega):
        found = compare_derivative(time, _integrate(time, _omega(time, mistake.quat)), mistake.omega)
        if found is not None and found.misfit < least:
            best, least = mistake, found.misfit
    return best
