"""Contact forces against the weight, contact flags against forces, slip, and sensors in limbs without contact."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchid.errors import InputError, format_count, format_percent
from torchid.log_checks.equations import (
    COMPARED_SAMPLES,
    MAX_DIFFERENTIATED_SAMPLES,
    bind_some_samples,
    default_cutoff_hz,
    preprocess_pieces,
)
from torchid.log_checks.findings import (
    NOTE,
    REJECTED,
    SUSPICIOUS,
    Finding,
    Skipped,
    Span,
    find_spans,
    median_step,
    widen_mask,
)
from torchid.log_checks.mistakes import quarter_turns
from torchid.log_checks.motion import recorded_link_poses
from torchid.logs import Log
from torchid.logs.log import FORCE_NORMAL, BoolArray, FloatArray
from torchid.logs.quaternion import rotate_to_base, rotate_to_world
from torchid.logs.units import advise_units, units_of_ratio
from torchid.parameters import GRAVITY, WRENCH_COMPONENTS
from torchid.problem import RowBuilder, bind_log
from torchid.problem.contact_slip import measure_slip
from torchid.problem.metrics import force_series
from torchid.robot import Robot
from torchid.rounding import STD_PER_MAD
from torchid.sensing import Contact, named_sensors

#: Relative error of the carried mass that is noted, and that no CAD model has.
MIN_NOTED_MASS_ERROR = 0.02
MAX_MASS_ERROR = 0.2
#: Rest that the check needs, or else the length of log over which it averages: a change of speed of 1 m/s between its
#: ends is then 2 % of gravity.
_MIN_REST_S = 0.5
_MIN_AVERAGING_S = 5.0
#: Samples for which poses of contact frames are computed.
_MAX_POSE_SAMPLES = 4000
#: Relative error of an accelerometer at rest: a good one is within 0.5 %.
_MAX_ACCELEROMETER_ERROR = 0.02
#: Deviation of its reading from gravity in another unit, or from twice gravity.
_ACCELEROMETER_UNIT_TOLERANCE = 0.1
#: Mean of a reading without gravity, and its median size where nothing else says that the base does not turn over, over
#: gravity.
_MAX_MEAN_WITHOUT_GRAVITY = 0.1
_MAX_SIZE_WITHOUT_GRAVITY = 0.5
#: Mean of the vertical along the axes of a base that does not turn over.
_MIN_MEAN_VERTICAL = 0.7
#: Mean along the world's axes over gravity below which it has no direction.
_MIN_MEAN_WITH_DIRECTION = 0.5
#: Angle between gravity by the accelerometer and by the orientation of the base.
_MAX_TILT_DEG = 5.0
_WEIGHT_CHECK = "weight at rest"
_ACCELEROMETER_CHECK = "accelerometer at rest"


def check_weight(log: Log, robot: Robot | None, scaled: bool = False) -> Iterator[Finding | Skipped]:
    """Findings about the sum of the contact forces; `scaled`: their scale is unknown, so findings are notes."""
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
        text = f"contacts pull the robot down with {-carried:.4g} N {when}"
        yield Finding("sign", REJECTED, field, text, "reverse the wrenches: give what the ground exerts on the robot")
        return
    if robot is None:
        text = f"contacts carry {mass:.4g} kg {when}"
        yield Finding("weight", NOTE, field, text, "weigh the robot and compare, or give its file (--urdf)")
        return
    nominal = float(robot.nominal[:, 0].sum())
    ratio = mass / nominal
    more = format_percent(ratio - 1.0, "+")
    text = f"contacts carry {mass:.4g} kg {when}, but the {robot.format} has {nominal:.4g} kg ({more} %)"
    if units := units_of_ratio(ratio, ("force",)):
        unit_text = f"contacts carry {ratio:.3g} times the robot's weight {when}. Are forces in {' or '.join(units)}?"
        yield Finding("unit", REJECTED, field, unit_text, "convert forces to N and moments to N m")
        return
    if abs(ratio - 1.0) > MAX_MASS_ERROR:
        advice = "check for an unmeasured contact, a payload, a sensor offset and a wrong gain"
        advice += f"; check that the {robot.format} describes this robot" * (not 0.5 < ratio < 2.0)
        yield Finding("weight", SUSPICIOUS, field, text, advice)
    elif abs(ratio - 1.0) > MIN_NOTED_MASS_ERROR:
        advice = f"nothing if the {robot.format} may have this error. A sensor offset has the same effect"
        yield Finding("weight", NOTE, field, text, advice)


def _vertical_force(log: Log, robot: Robot | None) -> FloatArray | str:
    """Sum of the vertical contact forces (M,) [N] where all active contacts were measured, or why it is unknown."""
    wrench = log.contact_wrench
    if wrench is None or log.contact_active is None:
        return "the log has no contact forces"
    force = np.where(log.contact_active[..., None], wrench[..., :3], 0.0)
    if log.contact_wrench_world is None:
        if robot is None:
            return "wrenches in contact frames need a robot (--urdf)"
        if log.base_quat_xyzw is None and not robot.fixed_base:
            return "wrenches in contact frames need the orientation of the base"
        if set(log.joint_names) != set(robot.joint_names) or not set(log.contact_names) <= set(robot.links):
            return "the log and the robot have different joints or contacts"
        force = _rotate_to_world(log, robot, force)
    known = np.isfinite(force).all(axis=(1, 2))
    return force[known, :, 2].sum(axis=1) if known.any() else "no sample has the forces of all active contacts"


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
    """Findings about the IMU's specific force at rest, else on average over a long log."""
    reading = log.imu_specific_force
    if reading is None:
        return
    still = _find_rest(log)
    rests = bool(still.sum() >= 10)
    if not rests and log.time[-1] - log.time[0] < _MIN_AVERAGING_S:
        yield Skipped(_ACCELEROMETER_CHECK, f"the robot never rests for {_MIN_REST_S:g} s")
        return
    used = still if rests else np.ones(len(log), bool)
    mean = float(np.linalg.norm(reading[used].mean(axis=0)))
    size = mean if rests else float(np.median(np.linalg.norm(reading, axis=1)))
    text = f"the accelerometer reads {size:.4g} m/s^2 {'at rest' if rests else 'in the median'}"
    by_mean, by_size = (
        units_of_ratio(x / GRAVITY, ("acceleration",), _ACCELEROMETER_UNIT_TOLERANCE) for x in (mean, size)
    )
    units = tuple(unit for unit in by_size if unit in by_mean)
    if not rests and not units:
        mean, size = _mean_along_world(log, robot) or (mean, size)
    finding = _gravity_finding(mean, size, text, units, rests)
    if finding is not None:
        yield finding
    elif not rests:
        yield Skipped(_ACCELEROMETER_CHECK, f"the robot never rests for {_MIN_REST_S:g} s")
    has_direction = size > 0.5 * GRAVITY if rests else finding is None or finding.name != "gravity"
    if units or has_direction:
        yield from _tilt_findings(log, robot, used, "at rest" if rests else "on average")


def _gravity_finding(mean: float, size: float, text: str, units: tuple[str, ...], rests: bool) -> Finding | None:
    """Finding about the unit or the gravity of a reading, by the size of its mean and its median size [m/s^2].

    Both equal gravity if the base hardly turns and accelerates; without gravity the mean is nearly zero.
    """
    field = "imu_specific_force"
    original = "give the raw reading of the accelerometer"
    if units:
        unit_text = f"{text.replace(' m/s^2', '')}. Is the unit {' or '.join(units)}?"
        return Finding("unit", REJECTED, field, unit_text, f"{advise_units({field: units})}, or convert it to m/s^2")
    if mean < _MAX_MEAN_WITHOUT_GRAVITY * GRAVITY and size < _MAX_SIZE_WITHOUT_GRAVITY * GRAVITY:
        advice = f"{original}: acceleration minus gravity, 9.81 m/s^2 upward at rest"
        return Finding("gravity", REJECTED, field, f"{text}: gravity was removed", advice)
    if max(abs(x / (2.0 * GRAVITY) - 1.0) for x in (mean, size)) < _ACCELEROMETER_UNIT_TOLERANCE:
        advice = f"{original}, without added gravity; or halve it if the sensor's range is half of what was assumed"
        return Finding("gravity", REJECTED, field, f"{text}: twice gravity", advice)
    if rests and abs(size / GRAVITY - 1.0) > _MAX_ACCELEROMETER_ERROR:
        advice = "calibrate the accelerometer"
        return Finding("gravity", SUSPICIOUS, field, f"{text}, but gravity is {GRAVITY}", advice)
    return None


def _mean_along_world(log: Log, robot: Robot | None) -> tuple[float, float] | None:
    """Size of the mean along the world's axes, twice; None if it is unknown, or the base turns over.

    This mean is gravity even if the base accelerates, as its velocity does not grow.
    """
    in_base = _specific_force_in_base(log, robot)
    if in_base is None or log.base_quat_xyzw is None:
        return None
    vertical = rotate_to_base(log.base_quat_xyzw, np.tile([0.0, 0.0, 1.0], (len(log), 1))).mean(axis=0)
    if np.linalg.norm(vertical) <= _MIN_MEAN_VERTICAL:
        return None
    size = float(np.linalg.norm(rotate_to_world(log.base_quat_xyzw, in_base).mean(axis=0)))
    return size, size


def _specific_force_in_base(log: Log, robot: Robot | None) -> FloatArray | None:
    """The accelerometer's readings along the axes of the base (N, 3); None if it is not on the base."""
    if log.imu_specific_force is None or robot is None or robot.links.get(log.imu_frame, (1, None))[0] != 0:
        return None
    return np.asarray(log.imu_specific_force @ robot.links[log.imu_frame][1][:3, :3].T)


def _tilt_findings(log: Log, robot: Robot | None, still: BoolArray, when: str) -> Iterator[Finding | Skipped]:
    """Findings about the direction of gravity, by the accelerometer against the orientation of the base."""
    if log.base_quat_xyzw is None or log.imu_specific_force is None:
        return
    read = _specific_force_in_base(log, robot)
    if read is None or robot is None:
        yield Skipped("gravity against orientation", "needs a robot with imu_frame on its base link")
        return
    in_base = read[still]
    up = rotate_to_world(log.base_quat_xyzw[still], in_base).mean(axis=0)
    if np.linalg.norm(up) < _MIN_MEAN_WITH_DIRECTION * GRAVITY:
        return
    angles = np.degrees(np.arccos(np.clip(up / np.linalg.norm(up), -1.0, 1.0)))
    angle = float(angles[2])
    name = "imu_specific_force"
    text = f"the accelerometer's up is {angle:.3g} degrees from up by base_quat {when}"
    if (level := int(np.argmin(angles))) < 2 and angles[level] < _MAX_TILT_DEG:
        advice = f"rotate the world so that z points up, or check imu_frame in the {robot.format}"
        question = f"Does the world's {'xy'[level]} axis point up?"
        yield Finding("gravity", SUSPICIOUS, "base_quat_xyzw", f"{text}. {question}", advice)
        return
    if angle <= 90.0:
        if angle > _MAX_TILT_DEG:
            advice = f"check imu_frame in the {robot.format} and the order of the quaternion"
            yield Finding("gravity", SUSPICIOUS, name, text, advice)
        return
    height = _height_above_feet(log.select(np.flatnonzero(still)), robot, in_base)
    if height is None or height < 0.0:
        below = "" if height is None else ", and the base hangs below its feet"
        advice = "reverse it if it is gravity minus acceleration, or check imu_frame and the order of the quaternion"
        yield Finding("gravity", REJECTED, name, f"{text}{below}. Is the reading reversed?", advice)
    else:
        text = f"{text}, and the base is above its feet. Does the world's z axis point down?"
        advice = "rotate the world so that z points up, or check the order of the quaternion"
        yield Finding("gravity", REJECTED, "base_quat_xyzw", text, advice)


def _height_above_feet(log: Log, robot: Robot, upward: FloatArray) -> float | None:
    """Mean height [m] of the base's origin above the active contacts, along upward vectors (N, 3) in the base frame."""
    if log.contact_active is None or set(log.joint_names) != set(robot.joint_names):
        return None
    known = [index for index, name in enumerate(log.contact_names) if name in robot.links]
    samples = np.linspace(0, len(log) - 1, min(_MAX_POSE_SAMPLES, len(log))).astype(int)
    poses = recorded_link_poses(log.select(samples), robot)
    active = log.contact_active[samples]
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
        start = values[: -2 * half]
        centre = values[half:-half]
        end = values[2 * half :]
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


# ------------------------------------------------------------------------------------------------- flags against forces

#: Share of the weight that an inactive contact may carry. Thresholds of flags are 20 to 50 N, for 60 kg 3 to 8 %.
MAX_INACTIVE_WEIGHT_SHARE = 0.1
#: Share of the weight that an active contact carries at least.
MIN_ACTIVE_WEIGHT_SHARE = 0.005
#: The same of all contacts together, from which on a robot stands though no flag says so.
_MIN_STANDING_WEIGHT_SHARE = 0.5
#: Time for which a contact may be active without a force: filters widen flags by as much.
_MAX_UNLOADED_S = 0.1
#: A reading in the air is an offset if it varies by at most this share, has enough samples, and is below this share of
#: the usual load: above it, the foot stands.
_MAX_OFFSET_SPREAD_SHARE = 0.2
_MIN_OFFSET_SAMPLES = 10
_MAX_OFFSET_LOAD_SHARE = 0.5
#: Share of its active samples in which a sensor reads other than 0 up to which it is dead: noise alone is not 0.
_MOST_READ_OF_DEAD_SHARE = 0.01
#: Delay of a flag against the force: its resolution, and the longest one.
MIN_DELAY_SAMPLES = 2
_MAX_DELAY_S = 0.2
#: Changes of a flag that a delay needs, and the share of them that must agree to `MIN_DELAY_SAMPLES`.
_MIN_CHANGES = 3
_MIN_AGREEING_SHARE = 0.7
_FLAG_CHECK = "contact flags against forces"


@dataclass(frozen=True, eq=False)
class _Contact:
    name: str
    active: BoolArray
    force: FloatArray  # (N, 3) [N], NaN where not measured


def check_contact_flags(log: Log, robot: Robot | None = None) -> Iterator[Finding | Skipped]:
    """Findings about contact flags and sensor offsets, relative to the total load: forces may be in any unit.

    If no contact ever carries a load with its flag on, the URDF's weight tells a standing robot from one in the air.
    """
    if not log.contact_names:
        return
    contacts = list(_contacts(log))
    if not contacts:
        yield Skipped(_FLAG_CHECK, "no contact has its force in all samples of contact")
        return
    judged = {contact.name for contact in contacts}
    for name in (name for name in log.contact_names if name not in judged):
        yield Skipped(_FLAG_CHECK, f"{name}: its force is missing in some samples of contact")
    weight = _largest_load(contacts) or _load_without_flags(contacts, robot)
    if not weight > 0.0:
        yield Skipped(_FLAG_CHECK, "no contact carries a force while its flag is on")
        return
    for contact in contacts:
        offset = _offset(contact)
        size = np.linalg.norm(contact.force - offset, axis=1)
        if (constant := float(np.linalg.norm(offset))) > MIN_ACTIVE_WEIGHT_SHARE * weight:
            text = f"{contact.name}: reads a constant {constant:.3g} N in the air"
            advice = "set sensors.offsets: {contact_force: log} to identify it, or preprocessing.zero_in_air: true"
            yield Finding("offset", NOTE, "contact_wrench", text, advice, (contact.name,))
        yield from _load_findings(log, contact, size, weight)
        yield from _delay_findings(log, contact, size, weight)


def _contacts(log: Log) -> Iterator[_Contact]:
    """Contacts whose force was measured in all active samples; NaN is allowed while a contact is inactive."""
    wrench = log.contact_wrench
    if wrench is None or log.contact_active is None:
        return
    for index, name in enumerate(log.contact_names):
        force = wrench[:, index, :3]
        active = log.contact_active[:, index]
        measured = np.asarray(np.isfinite(force).all(axis=1))
        if measured.any() and measured[active].all():
            yield _Contact(name, active, np.where(measured[:, None], force, np.nan))


def _largest_load(contacts: list[_Contact]) -> float:
    """High percentile of the total contact force [N]: about the weight of a standing robot."""
    sizes = [np.where(contact.active, np.linalg.norm(contact.force, axis=1), 0.0) for contact in contacts]
    total = np.sum(sizes, axis=0)
    return float(np.percentile(total, 90.0))


def _load_without_flags(contacts: list[_Contact], robot: Robot | None) -> float:
    """Median total contact force [N] without regard to flags; 0 if it is far below the robot's weight."""
    if robot is None:
        return 0.0
    total = np.sum([np.nan_to_num(np.linalg.norm(contact.force, axis=1)) for contact in contacts], axis=0)
    load = float(np.median(total))
    return load if load > _MIN_STANDING_WEIGHT_SHARE * GRAVITY * float(robot.nominal[:, 0].sum()) else 0.0


def subtract_contact_offsets(log: Log) -> Log:
    """The log without the constant readings of contact sensors in the air."""
    offsets = {contact.name: _offset(contact) for contact in _contacts(log)}
    field = log.contact_wrench_field
    if not any(np.any(offset) for offset in offsets.values()):
        return log
    wrench = getattr(log, field).copy()
    for name, offset in offsets.items():
        wrench[:, log.contact_names.index(name), :3] -= offset
    return dataclasses.replace(log, **{field: wrench})


def _offset(contact: _Contact) -> FloatArray:
    """The sensor's constant reading in the air, (3,) [N]; 0 where it has none."""
    air = contact.force[~contact.active & np.isfinite(contact.force[:, 0])]
    if len(air) < _MIN_OFFSET_SAMPLES or not contact.active.any():
        return np.zeros(3)
    offset = np.median(air, axis=0)
    size = float(np.linalg.norm(offset))
    load = float(np.median(np.linalg.norm(contact.force[contact.active], axis=1)))
    constant = _spread(air - offset) < _MAX_OFFSET_SPREAD_SHARE * size
    return offset if constant and size < _MAX_OFFSET_LOAD_SHARE * load else np.zeros(3)


def _spread(deviations: FloatArray) -> float:
    """Robust standard deviation of vectors (M, 3) about their median."""
    return STD_PER_MAD * float(np.median(np.linalg.norm(deviations, axis=1)))


def _load_findings(log: Log, contact: _Contact, size: FloatArray, weight: float) -> Iterator[Finding]:
    """Findings about forces without a contact, and contacts without a force."""
    loaded = ~contact.active & (size > MAX_INACTIVE_WEIGHT_SHARE * weight)
    if loaded.any():
        samples = format_count(int(loaded.sum()), "sample")
        text = f"{contact.name}: carries up to {size[loaded].max():.3g} N while its flag is off, in {samples}"
        advice = "set the flag there: forces of contacts without a flag are ignored"
        spans = tuple(find_spans(loaded, contact.name))
        yield Finding("force without contact", REJECTED, "contact_active", text, advice, (contact.name,), spans)
    longest = max(1, round(_MAX_UNLOADED_S / median_step(log)))
    threshold = MIN_ACTIVE_WEIGHT_SHARE * weight
    unloaded = contact.active & (size < threshold)
    spans = tuple(span for span in find_spans(unloaded, contact.name) if len(span) > longest)
    if spans:
        samples = format_count(sum(len(span) for span in spans), "sample")
        never = "; the flag never changes" if contact.active.all() else ""
        text = f"{contact.name}: carries less than {threshold:.2g} N while its flag is on, in {samples}{never}"
        advice = "clear the flag while the foot is in the air. A wrong flag costs data, not accuracy"
        if np.mean(contact.force[contact.active].any(axis=1)) < _MOST_READ_OF_DEAD_SHARE:
            text = f"{contact.name}: its sensor reads 0 in {samples} with its flag on: it is dead or its column wrong"
            advice = "list only the other contacts in sensors.contact_wrenches, or correct the column or the flags"
        yield Finding("contact without force", SUSPICIOUS, "contact_active", text, advice, (contact.name,), spans)


def _delay_findings(log: Log, contact: _Contact, size: FloatArray, weight: float) -> Iterator[Finding]:
    """Findings about flags that change earlier or later than the force."""
    touches = size > 0.5 * MAX_INACTIVE_WEIGHT_SHARE * weight
    flags, forces = (np.flatnonzero(np.diff(x.astype(np.int8))) for x in (contact.active, touches))
    if len(flags) < _MIN_CHANGES or len(forces) < _MIN_CHANGES or len(log) < 3:
        return
    longest = max(MIN_DELAY_SAMPLES + 1, round(_MAX_DELAY_S / median_step(log)))
    shifts: dict[bool, list[int]] = {True: [], False: []}  # by direction: landing, lift-off
    for flag, landing in zip(flags, contact.active[flags + 1], strict=True):
        candidates = forces[touches[forces + 1] == landing]
        nearest = candidates[np.argmin(np.abs(candidates - flag))] if len(candidates) else flag + longest + 1
        if abs(nearest - flag) <= longest:
            shifts[bool(landing)].append(int(flag - nearest))
    count = sum(map(len, shifts.values()))
    if count < _MIN_CHANGES:
        return
    typical = {landing: float(np.median(values or [0])) for landing, values in shifts.items()}
    agree = [abs(x - typical[landing]) <= MIN_DELAY_SAMPLES for landing, values in shifts.items() for x in values]
    same_direction = typical[True] * typical[False] > 0.0
    late_enough = min(map(abs, typical.values())) >= MIN_DELAY_SAMPLES
    if np.mean(agree) < _MIN_AGREEING_SHARE or not same_direction or not late_enough:
        return
    shift = float(np.mean(list(typical.values())))
    text = f"{contact.name}: the flag changes {abs(shift):.3g} samples {'after' if shift > 0 else 'before'} the force"
    spans = tuple(Span(int(i), int(i) + 1, contact.name) for i in flags)
    advice = "shift contact_active, or derive it from the forces"
    yield Finding("delay", SUSPICIOUS, "contact_active", text, advice, (contact.name,), spans)


def check_scalar_wrenches(log: Log) -> Iterator[Finding]:
    """Findings about wrenches in which a single force is ever nonzero: a scalar sensor's reading among zeros."""
    wrench = log.contact_wrench
    active = log.contact_active
    if wrench is None or active is None:
        return
    for index, name in enumerate(log.contact_names):
        touching = wrench[active[:, index], index]
        present = np.nan_to_num(touching).any(axis=0)
        forces = np.flatnonzero(present[:3])
        if len(forces) != 1 or present[3:].any() or np.isnan(touching[:, :3]).any():
            continue
        text = f"{name}: only {WRENCH_COMPONENTS[forces[0]]} is ever nonzero, as from a scalar sensor"
        advice = (
            f"give it as {FORCE_NORMAL} and set sensors.contact_wrenches: {{FRAME: [fn]}}. "
            "Else the zeros are fitted as measured forces"
        )
        yield Finding("scalar sensor", SUSPICIOUS, log.contact_wrench_field, text, advice, (name,))


# -------------------------------------------------------------------------------------------------------------- slip

MOST_SLIPPING_SHARE = 0.3
"""Share of a contact's samples; if more slip, the cause is wrong flags, wrong radii or another motion."""

CLEAR_SLIP = 2.0
"""Least peak speed over the limit for a finding: noise of cameras and encoders has long tails."""

_SLIP_CHECK = "slip of contacts"


def check_slip(
    log: Log, robot: Robot | None, contacts: Sequence[Contact], cutoff_hz: float | None, derived: tuple[str, ...] = ()
) -> Iterator[Finding | Skipped]:
    """Findings about contacts that slip; none if torchid computed the flags or the base's motion."""
    if robot is None or not contacts or log.contact_active is None:
        return
    if derived:
        return
    cutoff_hz = cutoff_hz or default_cutoff_hz(log)
    slips = np.zeros((len(log), len(contacts)), dtype=bool)
    checked = False
    standing = np.zeros(len(contacts))
    fastest = np.zeros(len(contacts))
    for start in range(0, len(log), MAX_DIFFERENTIATED_SAMPLES):
        part = log.select(slice(start, start + MAX_DIFFERENTIATED_SAMPLES))
        try:
            (ready,) = preprocess_pieces(part, cutoff_hz)
            samples = bind_log(ready, robot, contacts)
        except InputError as error:
            yield Skipped(_SLIP_CHECK, f"{error.field}: {error.found}")
            return
        slip = measure_slip(ready, samples, part, robot, contacts, cutoff_hz=cutoff_hz)
        checked |= slip.checked
        nearest = start + np.searchsorted(part.time, ready.time).clip(0, len(part) - 1)
        for index in range(len(contacts)):
            slips[nearest[slip.slips[:, index]], index] = True
        standing += np.isfinite(slip.speed).sum(axis=0)
        fastest = np.maximum(fastest, np.nanmax(slip.speed / slip.limits, axis=0, initial=0.0))
    if not checked:
        yield Skipped(_SLIP_CHECK, "needs the base's linear velocity, or two contacts that stand at the same time")
    for contact, own, stands, peak in zip(contacts, slips.T, standing.tolist(), fastest.tolist(), strict=True):
        if peak >= CLEAR_SLIP and own.sum() <= MOST_SLIPPING_SHARE * stands:
            text = f"{contact.frame} slips on the ground in {int(own.sum())} samples"
            advice = (
                "nothing if only joint torques are fitted; else preprocessing.max_slip: auto."
                " Check for dust and late flags"
            )
            yield Finding("slip", SUSPICIOUS, "contact_active", text, advice, (contact.frame,), tuple(find_spans(own)))


# ---------------------------------------------------------------------------------------------- limb sensors in the air

#: Samples in the air that the check needs.
_MIN_AIR_SAMPLES = 20
#: Correlation of reading and model that separates the weight beyond a sensor from its offset: the limb must turn.
_MIN_CORRELATION = 0.9
#: Share of the squared residual of another mass beyond a sensor that mass and offset may leave, for the offset to be
#: told from a mass: noise of accelerations makes the mass too small and an offset of the rest, which leave 0.85 of it.
_MAX_OFFSET_RESIDUAL = 0.5
#: Misfit of a sensor's forces that loads and offsets do not make, and the share of it that another frame may leave.
_MIN_FRAME_MISFIT = 0.7
_MAX_TURNED_SHARE = 0.35
_LIMB_SENSOR_CHECK = "limb sensors in the air"


def check_limb_sensors(
    log: Log, robot: Robot | None, contacts: Sequence[Contact], cutoff_hz: float | None
) -> Iterator[Finding | Skipped]:
    """Findings about the forces that limb sensors read in the air; `cutoff_hz` as in `check_forces_against_urdf`."""
    if robot is None or log.ft_wrench is None:
        return
    try:
        pieces = preprocess_pieces(log, cutoff_hz or default_cutoff_hz(log))
        samples = bind_some_samples(pieces, robot, contacts, 12 * COMPARED_SAMPLES)
    except InputError:  # reported by `check_forces_against_urdf`
        return
    builder = RowBuilder(robot, contacts, named_sensors("joints", robot.n, len(contacts), ft=len(robot.ft_names)))
    measured_series, (model_series,) = force_series(builder, samples, robot.nominal.flatten()[None])
    active = samples.active.numpy()
    for number, name in enumerate(robot.ft_names):
        if name not in log.ft_names:
            continue
        force = slice(robot.base_rows + robot.n + 6 * number, robot.base_rows + robot.n + 6 * number + 3)
        measured = measured_series[:, force]
        model = model_series[:, force]
        beyond = _contacts_beyond(robot, contacts, name)
        air = ~active[:, beyond].any(axis=1) & np.isfinite(measured).all(axis=1)
        if not beyond and not robot.fixed_base and not contacts:
            yield Skipped(_LIMB_SENSOR_CHECK, "needs contacts: one of them may load the limb beyond the sensor")
        elif air.sum() < _MIN_AIR_SAMPLES:
            yield Skipped(_LIMB_SENSOR_CHECK, f"{name}: too few readings while nothing beyond it touches")
        else:
            yield from _limb_sensor_findings(name, measured[air], model[air], robot)


def _contacts_beyond(robot: Robot, contacts: Sequence[Contact], name: str) -> list[int]:
    """Numbers of the contacts on bodies beyond a sensor."""
    above = ([robot.bodies[x].joint for x in robot.bodies_to(robot.links[contact.frame][0])] for contact in contacts)
    return [number for number, joints in enumerate(above) if any(x is not None and x.name == name for x in joints)]


def _turned_sensor(measured: FloatArray, model: FloatArray) -> str | None:
    """The rotation by right angles that makes measured forces (M, 3) fit the model, in words; None without one."""

    def misfit(forces: FloatArray) -> float:
        return float(np.linalg.norm(forces - model)) / max(float(np.linalg.norm(model)), 1e-9)

    as_read = misfit(measured)
    unexplained, words = min((misfit(measured @ R.T), words) for words, R in quarter_turns())
    return words if as_read > _MIN_FRAME_MISFIT and unexplained < _MAX_TURNED_SHARE * as_read else None


def _limb_sensor_findings(name: str, measured: FloatArray, model: FloatArray, robot: Robot) -> Iterator[Finding]:
    """Findings about measured forces (M, 3) of a sensor against those of the URDF's bodies, (M, 3)."""
    weight = float(np.linalg.norm(model.mean(axis=0)))
    x = model - model.mean(axis=0)
    y = measured - measured.mean(axis=0)
    product = float((x * y).sum())
    correlated = abs(product) > _MIN_CORRELATION * np.linalg.norm(x) * np.linalg.norm(y)
    if not correlated and (turned := _turned_sensor(measured, model)) is not None:
        text = f"{name}: in the air it reads the {robot.format}'s load beyond it, along axes rotated by right angles"
        advice = f"rotate forces and moments into the joint's child frame: its {turned}"
        yield Finding("frame", SUSPICIOUS, "ft_wrench", text, advice, (name,))
        return
    gain = product / float(np.square(x).sum()) if correlated else 1.0
    text = f"{name}: in the air it reads {gain:.3g} times the {robot.format}'s load beyond it ({weight:.3g} N)"
    if gain < 0.0:
        advice = "reverse it: give the wrench that the parent side exerts on the child side"
        yield Finding("sign", REJECTED, "ft_wrench", text, advice, (name,))
        return
    if abs(gain - 1.0) > MAX_MASS_ERROR:
        advice = "check the sensor's unit and gain, and the load mounted beyond it"
        yield Finding("weight", SUSPICIOUS, "ft_wrench", text, advice, (name,))
    residual = measured - gain * model
    offset = np.median(residual, axis=0)
    size = float(np.linalg.norm(offset))
    spread = _spread(residual - offset)
    threshold = MIN_ACTIVE_WEIGHT_SHARE * GRAVITY * float(robot.nominal[:, 0].sum())
    mass_alone = measured - (measured.mean(axis=0) @ model.mean(axis=0)) / max(weight, 1e-9) ** 2 * model
    separate = correlated and np.square(residual - offset).sum() < _MAX_OFFSET_RESIDUAL * np.square(mass_alone).sum()
    if not separate:
        threshold += MAX_MASS_ERROR * weight
    if size > max(threshold, spread):
        text = f"{name}: in the air it reads a constant {size:.3g} N beside the {robot.format}'s load ({weight:.3g} N)"
        ambiguity = "" if separate else ". A load of that weight has the same effect"
        advice = f"set sensors.offsets: {{ft_force: log}} to identify it, or subtract it{ambiguity}"
        yield Finding("offset", NOTE, "ft_wrench", text, advice, (name,))
