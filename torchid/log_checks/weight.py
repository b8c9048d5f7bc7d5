"""Contact forces against the robot's weight, and the accelerometer at rest against gravity."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from torchid.errors import format_percent
from torchid.log_checks.findings import NOTE, REJECTED, SUSPICIOUS, Finding, Skipped, median_step, widen_mask
from torchid.log_checks.model import recorded_link_poses
from torchid.logs import Log
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.quaternion import rotate_to_base, rotate_to_world
from torchid.logs.units import advise_units, units_of_ratio
from torchid.parameters import GRAVITY
from torchid.robot import Robot

#: Relative error of the carried mass that is noted, and that no CAD model has.
MIN_NOTED_MASS_ERROR, MAX_MASS_ERROR = 0.02, 0.2
#: Rest that the check needs, or else the length of log over which it averages: a change of speed of 1 m/s between its
#: ends is then 2 % of gravity.
_MIN_REST_S, _MIN_AVERAGING_S = 0.5, 5.0
#: Samples for which poses of contact frames are computed.
_MAX_POSE_SAMPLES = 4000
#: Relative error of an accelerometer at rest: a good one is within 0.5 %.
_MAX_ACCELEROMETER_ERROR = 0.02
#: Deviation of its reading from gravity in another unit, or from twice gravity.
_ACCELEROMETER_UNIT_TOLERANCE = 0.1
#: Mean of a reading without gravity, and its median size where nothing else says that the base does not turn over, over
#: gravity.
_MAX_MEAN_WITHOUT_GRAVITY, _MAX_SIZE_WITHOUT_GRAVITY = 0.1, 0.5
#: Mean of the vertical along the axes of a base that does not turn over.
_MIN_MEAN_VERTICAL = 0.7
#: Mean along the world's axes over gravity below which it has no direction.
_MIN_MEAN_WITH_DIRECTION = 0.5
#: Angle between gravity by the accelerometer and by the orientation of the base.
_MAX_TILT_DEG = 5.0
_WEIGHT_CHECK, _ACCELEROMETER_CHECK = "weight at rest", "accelerometer at rest"


def check_weight(log: Log, robot: Robot | None, scaled: bool = False) -> Iterator[Finding | Skipped]:
    """Findings about the sum of the contact forces; notes where these have an unknown scale by the experiment."""
    if robot is not None and robot.fixed_base and not log.contact_names:
        return  # the mounting carries the weight
    still = _find_rest(log)
    step = median_step(log)
    rests = still.sum() * step >= _MIN_REST_S
    if not rests and log.time[-1] - log.time[0] < _MIN_AVERAGING_S:
        yield Skipped(_WEIGHT_CHECK, f"the robot never rests for {_MIN_REST_S:g} s")
        return
    samples = np.flatnonzero(still) if rests else np.arange(len(log))
    samples = samples[np.linspace(0, len(samples) - 1, min(_MAX_POSE_SAMPLES, len(samples))).astype(int)]
    vertical = _vertical_force(log.select(samples), robot)
    if isinstance(vertical, str):
        yield Skipped(_WEIGHT_CHECK, vertical)
        return
    when = f"at rest ({still.sum() * step:.3g} s)" if rests else f"on average over {log.time[-1] - log.time[0]:.4g} s"
    field = log.contact_wrench_field
    for finding in _weight_findings(float(vertical.mean()), when, field, robot):
        yield replace(finding, severity=NOTE) if scaled and finding.name != "sign" else finding


def _weight_findings(carried: float, when: str, field: str, robot: Robot | None) -> Iterator[Finding]:
    mass = carried / GRAVITY
    if carried < 0.0:
        text = f"contacts pull with {-carried:.4g} N {when}"
        yield Finding("sign", REJECTED, field, text, "reverse it: wrenches are what the ground exerts on the robot")
        return
    if robot is None:
        text = f"contacts carry {mass:.4g} kg {when}"
        yield Finding("weight", NOTE, field, text, "compare with a scale, or give the robot")
        return
    nominal = float(robot.nominal[:, 0].sum())
    ratio = mass / nominal
    more = format_percent(ratio - 1.0, "+")
    text = f"contacts carry {mass:.4g} kg {when}, the {robot.format} weighs {nominal:.4g} kg ({more} %)"
    if units := units_of_ratio(ratio, ("force",)):
        text = f"contacts carry {ratio:.3g} of the weight {when}: forces in {' or '.join(units)}?"
        yield Finding("unit", REJECTED, field, text, "convert forces to N and moments to N m")
        return
    if abs(ratio - 1.0) > MAX_MASS_ERROR:
        advice = "check for an unmeasured contact, a payload, an offset or gain of a sensor"
        advice += f", and whether the {robot.format} is that of this robot" * (not 0.5 < ratio < 2.0)
        yield Finding("weight", SUSPICIOUS, field, text, advice)
    elif abs(ratio - 1.0) > MIN_NOTED_MASS_ERROR:
        advice = f"none if the {robot.format} may have this error; an offset of a sensor has the same effect"
        yield Finding("weight", NOTE, field, text, advice)


def _vertical_force(log: Log, robot: Robot | None) -> FloatArray | str:
    """Sum of the vertical contact forces (M,) [N] where all active contacts were measured, or why there is none."""
    wrench = log.contact_wrench
    if wrench is None or log.contact_active is None:
        return "no contact forces"
    force = np.where(log.contact_active[..., None], wrench[..., :3], 0.0)
    if log.contact_wrench_world is None:
        if robot is None:
            return "contact forces along the contact frames' axes, and no robot"
        if log.base_quat_xyzw is None and not robot.fixed_base:
            return "contact forces along the contact frames' axes, and no orientation of the base"
        if set(log.joint_names) != set(robot.joint_names) or not set(log.contact_names) <= set(robot.links):
            return "the log's joints or contacts are not the robot's"
        force = _rotate_to_world(log, robot, force)
    known = np.isfinite(force).all(axis=(1, 2))
    return force[known, :, 2].sum(axis=1) if known.any() else "no sample at which all active contacts were measured"


def _rotate_to_world(log: Log, robot: Robot, force: FloatArray) -> FloatArray:
    poses = recorded_link_poses(log, robot)
    rotated = [
        np.einsum("nij,nj->ni", poses[name][:, :3, :3].numpy(), force[:, index])
        for index, name in enumerate(log.contact_names)
    ]
    if log.base_quat_xyzw is not None:
        rotated = [rotate_to_world(log.base_quat_xyzw, vector) for vector in rotated]
    return np.stack(rotated, axis=1)


# -------------------------------------------------------------------------------------------------------- accelerometer


def check_accelerometer(log: Log, robot: Robot | None) -> Iterator[Finding | Skipped]:
    """Findings about the IMU's specific force at rest, and about its direction on average over a long log."""
    if log.imu_specific_force is None:
        return
    still = _find_rest(log)
    rests = still.sum() >= 10
    if not rests:
        found = _accelerometer_in_motion(log, robot)
        yield found or Skipped(_ACCELEROMETER_CHECK, f"the robot never rests for {_MIN_REST_S:g} s")
        mistaken = found is not None and found.name == "gravity"
        if mistaken or log.base_quat_xyzw is None or log.time[-1] - log.time[0] < _MIN_AVERAGING_S:
            return
        yield from _tilt_findings(log, robot, np.ones(len(log), bool), "on average")
        return
    mean = log.imu_specific_force[still].mean(axis=0)
    size = float(np.linalg.norm(mean))
    name, text = "imu_specific_force", f"{size:.4g} m/s^2 at rest"
    if units := units_of_ratio(size / GRAVITY, ("acceleration",), _ACCELEROMETER_UNIT_TOLERANCE):
        yield _accelerometer_unit_finding(f"{size:.4g} at rest", units)
    elif size < 0.1 * GRAVITY:
        yield _no_gravity_finding(text)
    elif _is_twice_gravity(size):
        yield _twice_gravity_finding(text)
    elif abs(size / GRAVITY - 1.0) > _MAX_ACCELEROMETER_ERROR:
        yield Finding("gravity", SUSPICIOUS, name, f"{text}, gravity is {GRAVITY}", "calibrate the accelerometer")
    if units or size > 0.5 * GRAVITY:
        yield from _tilt_findings(log, robot, still, "at rest")


def _accelerometer_in_motion(log: Log, robot: Robot | None) -> Finding | None:
    """Finding about unit or gravity of an accelerometer that never rests, by mean and median size, over a long log.

    Both are gravity's for a base that hardly turns and falls; of one without gravity, the mean is nearly zero. Along
    the world's axes the mean is gravity however the base accelerates: its velocity does not grow.
    """
    if log.imu_specific_force is None or log.time[-1] - log.time[0] < _MIN_AVERAGING_S:
        return None
    mean, size = (
        float(np.linalg.norm(log.imu_specific_force.mean(axis=0))),
        float(np.median(np.linalg.norm(log.imu_specific_force, axis=1))),
    )
    by_mean, by_size = (
        units_of_ratio(x / GRAVITY, ("acceleration",), _ACCELEROMETER_UNIT_TOLERANCE) for x in (mean, size)
    )
    units = tuple(unit for unit in by_size if unit in by_mean)
    if units:
        return _accelerometer_unit_finding(f"{size:.4g} in the median", units)
    text, in_base = f"{size:.3g} m/s^2 in the median", _specific_force_in_base(log, robot)
    if in_base is not None and log.base_quat_xyzw is not None:
        vertical = rotate_to_base(log.base_quat_xyzw, np.tile([0.0, 0.0, 1.0], (len(log), 1))).mean(axis=0)
        if np.linalg.norm(vertical) > _MIN_MEAN_VERTICAL:
            mean = size = float(np.linalg.norm(rotate_to_world(log.base_quat_xyzw, in_base).mean(axis=0)))
    if mean < _MAX_MEAN_WITHOUT_GRAVITY * GRAVITY and size < _MAX_SIZE_WITHOUT_GRAVITY * GRAVITY:
        return _no_gravity_finding(text)
    return _twice_gravity_finding(text) if _is_twice_gravity(mean) and _is_twice_gravity(size) else None


def _specific_force_in_base(log: Log, robot: Robot | None) -> FloatArray | None:
    """What the accelerometer reads along the axes of the base (N, 3); None where it is not known to be on the base."""
    if log.imu_specific_force is None or robot is None or robot.links.get(log.imu_frame, (1, None))[0] != 0:
        return None
    return np.asarray(log.imu_specific_force @ robot.links[log.imu_frame][1][:3, :3].T)


def _is_twice_gravity(size: float) -> bool:
    return abs(size / (2.0 * GRAVITY) - 1.0) < _ACCELEROMETER_UNIT_TOLERANCE


def _twice_gravity_finding(text: str) -> Finding:
    advice = "give the reading of the accelerometer, to which nothing was added; or halve it, if its range is another"
    return Finding("gravity", REJECTED, "imu_specific_force", f"{text}: gravity is in it twice", advice)


def _no_gravity_finding(text: str) -> Finding:
    advice = "give the reading of the accelerometer: acceleration minus gravity, upward at rest"
    return Finding("gravity", REJECTED, "imu_specific_force", f"{text}: gravity has been taken out", advice)


def _accelerometer_unit_finding(text: str, units: tuple[str, ...]) -> Finding:
    field = "imu_specific_force"
    advice = f"{advise_units({field: units})}; without a map convert it to m/s^2"
    return Finding("unit", REJECTED, field, f"{text}: in {' or '.join(units)}", advice)


def _tilt_findings(log: Log, robot: Robot | None, still: BoolArray, when: str) -> Iterator[Finding | Skipped]:
    """Findings about the direction of gravity, by the accelerometer against the orientation of the base."""
    if log.base_quat_xyzw is None or log.imu_specific_force is None:
        return
    read = _specific_force_in_base(log, robot)
    if read is None or robot is None:
        yield Skipped("gravity against orientation", "no robot with the IMU's frame on the base")
        return
    in_base = read[still]
    up = rotate_to_world(log.base_quat_xyzw[still], in_base).mean(axis=0)
    if np.linalg.norm(up) < _MIN_MEAN_WITH_DIRECTION * GRAVITY:
        return
    angles = np.degrees(np.arccos(np.clip(up / np.linalg.norm(up), -1.0, 1.0)))
    angle = float(angles[2])
    name, text = "imu_specific_force", f"{angle:.3g} degrees from up {when}, by base_quat"
    if (level := int(np.argmin(angles))) < 2 and angles[level] < _MAX_TILT_DEG:
        advice = f"turn the world so that z points up; else check the IMU's frame in the {robot.format}"
        text = f"imu_specific_force {text}: a world whose {'xy'[level]} axis points up?"
        yield Finding("gravity", SUSPICIOUS, "base_quat_xyzw", text, advice)
        return
    if angle <= 90.0:
        if angle > _MAX_TILT_DEG:
            advice = f"check the IMU's frame in the {robot.format} and the order of the quaternion"
            yield Finding("gravity", SUSPICIOUS, name, text, advice)
        return
    height = _height_above_feet(log.select(np.flatnonzero(still)), robot, in_base)
    if height is None or height < 0.0:
        below = "" if height is None else ", and the base hangs below the feet that carry it"
        advice = "reverse it if it is gravity minus acceleration; else check the IMU's frame and the quaternion's order"
        yield Finding("gravity", REJECTED, name, f"{text}{below}: reversed?", advice)
    else:
        text = f"imu_specific_force {text}, and the base is above its feet: a world whose z axis points down?"
        advice = "rotate the world so that z points up; else check the order of the quaternion"
        yield Finding("gravity", REJECTED, "base_quat_xyzw", text, advice)


def _height_above_feet(log: Log, robot: Robot, upward: FloatArray) -> float | None:
    """Mean height [m] of the base's origin above the active contacts, along upward vectors (N, 3) in the base frame."""
    if log.contact_active is None or set(log.joint_names) != set(robot.joint_names):
        return None
    known = [index for index, name in enumerate(log.contact_names) if name in robot.links]
    samples = np.linspace(0, len(log) - 1, min(_MAX_POSE_SAMPLES, len(log))).astype(int)
    poses, active = recorded_link_poses(log.select(samples), robot), log.contact_active[samples]
    mean = upward.mean(axis=0)
    heights = [-(poses[log.contact_names[k]][:, :3, 3].numpy() @ mean)[active[:, k]] for k in known]
    all_heights = np.concatenate(heights) if heights else np.zeros(0)
    return float(all_heights.mean() / np.linalg.norm(mean)) if len(all_heights) else None


# ----------------------------------------------------------------------------------------------------------------- rest

#: Time over which nothing may move by more than `MAX_REST_MOTION` [rad, m, or of a quaternion's component].
REST_WINDOW_S = 0.5
#: 0.01 within half a second, and within either half of it: accelerations well below 0.2 m/s^2, 2 % of gravity.
MAX_REST_MOTION = 0.01


def _find_rest(log: Log) -> BoolArray:
    """Samples (N,) inside a window in which neither base nor joints move."""
    still = np.zeros(len(log), bool)
    if len(log) < 3:
        return still
    half = max(1, round(0.5 * REST_WINDOW_S / median_step(log)))
    if len(log) <= 2 * half:
        return still
    middle = np.ones(len(log) - 2 * half, bool)
    for values in _poses(log):
        start, centre, end = values[: -2 * half], values[half:-half], values[2 * half :]
        for first, second in ((start, centre), (centre, end), (start, end)):
            middle &= (np.abs(first - second) < MAX_REST_MOTION).all(axis=1)
    if log.imu_angular_velocity is not None:
        turned = np.linalg.norm(log.imu_angular_velocity, axis=1)[half:-half] * REST_WINDOW_S
        middle &= turned < 10.0 * MAX_REST_MOTION  # of a gyroscope with bias
    still[half:-half] = middle
    return widen_mask(still, half)


def _poses(log: Log) -> list[FloatArray]:
    candidates = (log.joint_position, log.base_quat_xyzw, log.base_position_world)
    return [values for values in candidates if values is not None and values.shape[1]]
