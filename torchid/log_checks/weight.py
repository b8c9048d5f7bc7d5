"""What the contacts carry against the robot's weight, and an accelerometer at rest against gravity."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from torchid.log_checks.findings import CONDEMNED, NOTE, SUSPICIOUS, Finding, Skipped, median_step, widen_mask
from torchid.log_checks.model import link_poses
from torchid.logs import Log
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.quaternion import rotate_to_world
from torchid.regressor.kinematics import GRAVITY_WORLD
from torchid.robot import Robot

GRAVITY = -GRAVITY_WORLD[2]
#: How far the carried mass may be from the URDF's without a word, and from where on no CAD model is that wrong.
NEGLIGIBLE_MASS, WRONG_MASS = 0.02, 0.2
#: What a force sensor's unit makes of 1 N, and how far the URDF's mass may then be off.
UNITS = {"kN": 1e-3, "kg": 1.0 / GRAVITY, "lbf": 0.22481, "g": 1e3 / GRAVITY, "mN": 1e3}
_UNIT_WITHIN = 0.15
#: Rest [s] that it takes; else the mean over a log of at least so long [s]: a change of speed of 1 m/s between its ends
#: counts 2 % then.
_REST, _LONG = 0.5, 5.0
#: Samples for which the pose of the contact frames is computed.
_POSES = 4000
#: How far the accelerometer's reading at rest may be from gravity: a good one is within 0.5 %.
_ACCELEROMETER = 0.02
#: Angle [deg] between gravity by the accelerometer and by the base's orientation.
_TILT = 5.0
_NAME, _IMU = "weight at rest", "accelerometer at rest"


def check_weight(log: Log, robot: Robot | None) -> Iterator[Finding | Skipped]:
    """Findings about the sum of the contact forces."""
    if robot is not None and robot.fixed_base and not log.contact_names:
        return  # what it is bolted to carries it
    still = _find_rest(log)
    step = median_step(log)
    rests = still.sum() * step >= _REST
    if not rests and log.time[-1] - log.time[0] < _LONG:
        yield Skipped(_NAME, f"the robot never rests for {_REST:g} s")
        return
    chosen = np.flatnonzero(still) if rests else np.arange(len(log))
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(_POSES, len(chosen))).astype(int)]
    upward = _upward(log.select(chosen), robot)
    if isinstance(upward, str):
        yield Skipped(_NAME, upward)
        return
    when = f"at rest ({still.sum() * step:.3g} s)" if rests else f"on average over {log.time[-1] - log.time[0]:.4g} s"
    field = log.contact_wrench_field
    yield from _judged(float(upward.mean()), when, field, robot)


def _judged(carried: float, when: str, field: str, robot: Robot | None) -> Iterator[Finding]:
    mass = carried / GRAVITY
    if carried < 0.0:
        text = f"contacts pull with {-carried:.4g} N {when}"
        yield Finding("sign", CONDEMNED, field, text, "reverse it: wrenches are what the ground exerts on the robot")
        return
    if robot is None:
        text = f"contacts carry {mass:.4g} kg {when}"
        yield Finding("weight", NOTE, field, text, "compare with a scale, or give a URDF")
        return
    nominal = float(robot.nominal[:, 0].sum())
    ratio = mass / nominal
    text = f"contacts carry {mass:.4g} kg {when}, the URDF weighs {nominal:.4g} kg ({100 * (ratio - 1):+.2g} %)"
    for unit, size in UNITS.items():
        if abs(ratio / size - 1.0) < _UNIT_WITHIN:
            text = f"contacts carry {ratio:.3g} of the weight {when}: forces in {unit}?"
            yield Finding("unit", CONDEMNED, field, text, "convert forces to N and moments to N m")
            return
    if abs(ratio - 1.0) > WRONG_MASS:
        advice = "look for a contact that is not measured, a payload, a sensor's offset or gain"
        yield Finding("weight", SUSPICIOUS, field, text, advice)
    elif abs(ratio - 1.0) > NEGLIGIBLE_MASS:
        yield Finding(
            "weight", NOTE, field, text, "none if the URDF may be that far off; a sensor's offset looks the same"
        )


def _upward(log: Log, robot: Robot | None) -> FloatArray | str:
    """Sum of the vertical contact forces (M,) [N] over samples where all active ones were measured, or why not."""
    wrench = log.contact_wrench
    if wrench is None or log.contact_active is None:
        return "no contact forces"
    force = np.where(log.contact_active[..., None], wrench[..., :3], 0.0)
    if log.contact_wrench_world is None:
        if robot is None:
            return "contact forces along the frames' own axes, and no robot"
        if log.base_quat_xyzw is None and not robot.fixed_base:
            return "contact forces along the frames' own axes, and no orientation of the base"
        if set(log.joint_names) != set(robot.joint_names) or not set(log.contact_names) <= set(robot.links):
            return "the log's joints or contacts are not the robot's"
        force = _in_world(log, robot, force)
    known = np.isfinite(force).all(axis=(1, 2))
    return force[known, :, 2].sum(axis=1) if known.any() else "no sample at which all active contacts were measured"


def _in_world(log: Log, robot: Robot, force: FloatArray) -> FloatArray:
    poses = link_poses(log, robot)
    turned = [
        np.einsum("nij,nj->ni", poses[name][:, :3, :3].numpy(), force[:, index])
        for index, name in enumerate(log.contact_names)
    ]
    if log.base_quat_xyzw is not None:
        turned = [rotate_to_world(log.base_quat_xyzw, one) for one in turned]
    return np.stack(turned, axis=1)


# -------------------------------------------------------------------------------------------------------- accelerometer


def check_accelerometer(log: Log, robot: Robot | None) -> Iterator[Finding | Skipped]:
    """Findings about the IMU's specific force, at rest; its direction also on average over a long log."""
    if log.imu_specific_force is None:
        return
    still = _find_rest(log)
    rests = still.sum() >= 10
    if not rests:
        yield Skipped(_IMU, f"the robot never rests for {_REST:g} s")
        if log.base_quat_xyzw is None or log.time[-1] - log.time[0] < _LONG:
            return
        yield from _tilt(log, robot, np.ones(len(log), bool), "on average")
        return
    mean = log.imu_specific_force[still].mean(axis=0)
    size = float(np.linalg.norm(mean))
    name, text = "imu_specific_force", f"{size:.4g} m/s^2 at rest"
    if abs(size - 1.0) < 0.1:
        yield Finding("unit", CONDEMNED, name, f"{text}: in units of g", f"multiply by {GRAVITY}")
    elif size < 0.1 * GRAVITY:
        advice = "give what the accelerometer reads: acceleration minus gravity, upward at rest"
        yield Finding("gravity", CONDEMNED, name, f"{text}: gravity has been taken out", advice)
    elif abs(size / GRAVITY - 1.0) > _ACCELEROMETER:
        yield Finding("gravity", SUSPICIOUS, name, f"{text}, gravity is {GRAVITY}", "calibrate the accelerometer")
    if size > 0.5 * GRAVITY or abs(size - 1.0) < 0.1:
        yield from _tilt(log, robot, still, "at rest")


def _tilt(log: Log, robot: Robot | None, still: BoolArray, when: str) -> Iterator[Finding | Skipped]:
    """Findings about gravity measured along another direction than by the base's orientation."""
    if log.base_quat_xyzw is None or log.imu_specific_force is None:
        return
    if robot is None or robot.links.get(log.imu_frame, (1, None))[0] != 0:
        yield Skipped("gravity against orientation", "no robot that says where the IMU is on the base")
        return
    in_base = log.imu_specific_force[still] @ robot.links[log.imu_frame][1][:3, :3].T
    up = rotate_to_world(log.base_quat_xyzw[still], in_base).mean(axis=0)
    angle = float(np.degrees(np.arccos(np.clip(up[2] / np.linalg.norm(up), -1.0, 1.0))))
    name, text = "imu_specific_force", f"{angle:.3g} degrees from up {when}, by base_quat"
    if angle <= 90.0:
        if angle > _TILT:
            advice = "look at the IMU's frame in the URDF and the order of the quaternion"
            yield Finding("gravity", SUSPICIOUS, name, text, advice)
        return
    above = _above_feet(log.select(np.flatnonzero(still)), robot, in_base)
    if above is None or above < 0.0:
        below = "" if above is None else ", and the base hangs below the feet that carry it"
        advice = (
            "reverse it if it is gravity minus acceleration; else look at the IMU's frame and the quaternion's order"
        )
        yield Finding("gravity", CONDEMNED, name, f"{text}{below}: reversed?", advice)
    else:
        text = f"imu_specific_force {text}, and the base is above its feet: a world whose z axis points down?"
        advice = "turn the world so that z points up; else look at the order of the quaternion"
        yield Finding("gravity", CONDEMNED, "base_quat_xyzw", text, advice)


def _above_feet(log: Log, robot: Robot, upward: FloatArray) -> float | None:
    """Mean height [m] of the base's origin above the active contacts, up being along vectors (N, 3) of the base."""
    if log.contact_active is None or set(log.joint_names) != set(robot.joint_names):
        return None
    known = [index for index, name in enumerate(log.contact_names) if name in robot.links]
    some = np.linspace(0, len(log) - 1, min(_POSES, len(log))).astype(int)
    poses, active = link_poses(log.select(some), robot), log.contact_active[some]
    mean = upward.mean(axis=0)
    heights = [-(poses[log.contact_names[k]][:, :3, 3].numpy() @ mean)[active[:, k]] for k in known]
    found = np.concatenate(heights) if heights else np.zeros(0)
    return float(found.mean() / np.linalg.norm(mean)) if len(found) else None


# ----------------------------------------------------------------------------------------------------------------- rest

#: Time [s] over which nothing may have moved by more than `MOVED` [rad, m, or of a quaternion's component].
WINDOW = 0.5
#: 0.01 within half a second, and within either half of it: accelerations well below 0.2 m/s^2, 2 % of gravity.
MOVED = 0.01


def _find_rest(log: Log) -> BoolArray:
    """Which samples (N,) are inside a window in which neither base nor joints move."""
    still = np.zeros(len(log), bool)
    if len(log) < 3:
        return still
    half = max(1, round(0.5 * WINDOW / median_step(log)))
    if len(log) <= 2 * half:
        return still
    middle = np.ones(len(log) - 2 * half, bool)
    for values in _poses(log):
        start, centre, end = values[: -2 * half], values[half:-half], values[2 * half :]
        for one, other in ((start, centre), (centre, end), (start, end)):
            middle &= (np.abs(one - other) < MOVED).all(axis=1)
    if log.imu_angular_velocity is not None:
        turned = np.linalg.norm(log.imu_angular_velocity, axis=1)[half:-half] * WINDOW
        middle &= turned < 10.0 * MOVED  # a gyroscope has a bias
    still[half:-half] = middle
    return widen_mask(still, half)


def _poses(log: Log) -> list[FloatArray]:
    found = (log.joint_position, log.base_quat_xyzw, log.base_position_world)
    return [values for values in found if values is not None and values.shape[1]]
