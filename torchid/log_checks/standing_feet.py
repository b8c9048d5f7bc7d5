"""Standing feet: checks of orientation, joints, names, radii and the base's pose."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

from torchid.errors import format_percent, join_names
from torchid.log_checks.findings import (
    REJECTED,
    SUSPICIOUS,
    UNEXPLAINED,
    Finding,
    Skipped,
    find_spans,
    median_step,
)
from torchid.log_checks.mistakes import Mistake, exchanged_joints, possible_mistakes, reversed_joints
from torchid.log_checks.motion import (
    DEAD_ENCODER_ADVICE,
    LinkPoses,
    joints_of_limb,
    recorded_link_poses,
    same_poses,
    still_in_limb,
)
from torchid.logs import Log
from torchid.logs.log import FloatArray
from torchid.logs.quaternion import rotate_to_world
from torchid.problem.base_pose import rolled_distance
from torchid.robot import Robot
from torchid.sensing import Contact
from torchid.sensing.sensors import join_numbers

#: Motion of standing feet over that of the base above them. Soft soles and rolling feet have 0.05 to 0.2.
MAX_SLIP_SHARE = 0.3
#: The same where no mistake explains it. A person whose heels lift in squats has 0.4, an orientation that is wrong 0.9.
MAX_UNEXPLAINED_SLIP_SHARE = 0.6
#: Motion of standing feet from which on one of them is named, if the others leave less than this share of it: a zero of
#: 0.3 rad in one joint of a hexapod's 18 makes 0.07 to 0.1, of a humanoid's knee 0.07; without its foot 0.01 are left.
MIN_SINGLE_SHARE = 0.05
MAX_OTHERS_SHARE = 0.25
#: Windows in which the radius is fitted that feet roll on, and the fewest; passes of the fit, whose weights follow.
_ROLLING_WINDOW_S = 0.5
_FEWEST_WINDOWS = 10
_PASSES = 20
#: Difference of a radius that is a finding, as a share and in standard errors: 22 and 31 mm that creep show 16 and 25.
_RADIUS_SHARE = 0.4
_RADIUS_ERRORS = 5.0
#: Unknowns of a base's pose that are of one kind, how large they usually are [m, rad, s], and their weight in the fit.
_POSE_UNKNOWNS = {"offset": slice(0, 3), "lag": slice(6, 7), "turn": slice(3, 6), "all": slice(0, 7)}
_POSE_SIZE = np.array([0.3, 0.3, 0.3, 0.5, 0.5, 0.5, 0.1])
_POSE_PRIOR_SHARE = 1e-3
#: Share of this motion that a corrected mistake may leave.
MAX_SLIP_RESIDUAL_SHARE = 1.0 / 3.0
#: Time at either end of a stance for heel and toe, and the shortest rest of a stance.
_STANCE_END_S = 0.05
_MIN_STANCE_S = 0.15
#: Samples that are compared, and the rms motion that the base must have [rad, or 0.3 m].
_MAX_COMPARED_SAMPLES = 1500
_MIN_BASE_MOTION = 0.01
#: The same for each of many pairs of joints, and their step: the shortest stance must have four.
_MAX_TRIAL_SAMPLES = 600
_TRIAL_STEP_S = _MIN_STANCE_S / 4.0
_LENGTH_UNIT_M = 0.3
_CORRECTED_FIELDS = (
    *("joint_names", "joint_position", "base_quat_xyzw", "base_position_world"),
    *("contact_names", "contact_active"),
)
_STANDING_FEET_CHECK = "feet that stand"


def check_standing_feet(
    log: Log, robot: Robot | None, contacts: Sequence[Contact], derived: tuple[str, ...] = ()
) -> Iterator[Finding | Skipped]:
    """Findings about feet that move while their flag is set; `derived`: prefixes of fields that torchid computed."""
    if robot is None or not contacts or robot.fixed_base:
        return
    log = log.select(slice(None, None, max(1, len(log) // _MAX_COMPARED_SAMPLES)))
    has_poses = log.base_quat_xyzw is not None and set(log.joint_names) == set(robot.joint_names)
    poses = recorded_link_poses(log, robot) if has_poses else None
    slip = measure_foot_slip(log, robot, contacts, poses)
    if slip is None:
        yield Skipped(_STANDING_FEET_CHECK, "no orientation of the base, or the base never moves while a foot stands")
        return
    radius = list(_radius_findings(log, robot, contacts, poses))
    yield from radius
    other_pose = iter(()) if radius or derived or poses is None else _pose_findings(log, contacts, slip, poses)
    single = None if radius or derived else _single_foot(log, robot, contacts, slip, poses)
    if slip < MAX_SLIP_SHARE and single is None:
        yield from other_pose
        return
    finding = _usual_mistake(log, robot, contacts, slip, poses, derived) if slip >= MAX_SLIP_SHARE else None
    if finding is None and not radius and not derived:
        finding = _exchanged_joints(log, robot, contacts, slip)
    if (finding := finding or single or next(other_pose, None)) is not None:
        yield finding
    elif slip > MAX_UNEXPLAINED_SLIP_SHARE:
        yield _unexplained_motion(log, robot, contacts, slip, poses)


def _usual_mistake(
    log: Log,
    robot: Robot,
    contacts: Sequence[Contact],
    slip: float,
    poses: LinkPoses | None,
    derived: tuple[str, ...],
) -> Finding | None:
    """A finding about the usual mistake whose correction makes standing feet move least."""
    best = None
    least = MAX_SLIP_RESIDUAL_SHARE * slip
    for mistake in (*possible_mistakes(log, robot), *reversed_joints(log)):
        if mistake.field not in _CORRECTED_FIELDS or mistake.field.startswith(derived):
            continue
        corrected = mistake.correct(log)
        is_posed = same_poses(log, corrected, robot, [contact.frame for contact in contacts])
        trial = measure_foot_slip(corrected, robot, contacts, poses if is_posed else None)
        if trial is not None and trial < least:
            best = mistake
            least = trial
    return None if best is None else _corrected(best, slip, least)


def _corrected(mistake: Mistake, slip: float, least: float) -> Finding:
    """A finding about a mistake whose correction makes standing feet keep still."""
    share = f"{100 * slip:.3g} % as much as the base, {format_percent(least)} % after correction"
    text = f"{mistake.description}: standing feet move {share}"
    return Finding("unit, sign or frame", REJECTED, mistake.field, text, mistake.advice)


def _exchanged_joints(log: Log, robot: Robot, contacts: Sequence[Contact], slip: float) -> Finding | None:
    """A finding about any two joints with exchanged names, at least one of them between a foot and the base."""
    every = max(1, int(_TRIAL_STEP_S / median_step(log)))
    thinned = log.select(slice(0, every * _MAX_TRIAL_SAMPLES, every))
    legs = {name for contact in contacts for name in joints_of_limb(robot, contact.frame)}
    pairs = list(exchanged_joints(log.joint_names, legs))
    trials = [(measure_foot_slip(mistake.correct(thinned), robot, contacts), mistake) for mistake in pairs]
    judged = [(share, mistake) for share, mistake in trials if share is not None]
    least, best = min(judged, key=lambda pair: pair[0], default=(slip, None))
    return None if best is None or least > MAX_OTHERS_SHARE * slip else _corrected(best, slip, least)


def _unexplained_motion(
    log: Log, robot: Robot, contacts: Sequence[Contact], slip: float, poses: LinkPoses | None
) -> Finding:
    """A finding about standing feet that move, not explained by a usual mistake; the fastest feet come first."""
    alone = {c.frame: measure_foot_slip(log, robot, [c], poses) for c in contacts}
    moving = sorted((name for name, share in alone.items() if share), key=lambda name: -(alone[name] or 0.0))
    most = join_names([f"{name} {format_percent(alone[name] or 0.0)} %" for name in moving])
    text = f"standing feet move {100 * slip:.3g} % as much as the base{UNEXPLAINED}"
    advice = "check signs, scales and zeros of joint positions, the base's pose, flags, and frames under contacts"
    return Finding("standing feet", SUSPICIOUS, "all", f"{text}: {most}" if most else text, advice, tuple(moving))


def _single_foot(
    log: Log, robot: Robot, contacts: Sequence[Contact], slip: float, poses: LinkPoses | None
) -> Finding | None:
    """A finding about the single standing foot that moves."""
    if slip < MIN_SINGLE_SHARE:
        return None
    without = {c.frame: measure_foot_slip(log, robot, [x for x in contacts if x is not c], poses) for c in contacts}
    remaining = {frame: share for frame, share in without.items() if share is not None}
    frame = min(remaining, key=lambda name: remaining[name], default="")
    if not frame or remaining[frame] > MAX_OTHERS_SHARE * slip:
        return None
    text = (
        f"{frame} moves though its flag is on: standing feet move {format_percent(slip)} % as much as the base,"
        f" {format_percent(remaining[frame])} % without it"
    )
    advice = "check zeros, scales and signs of the joint positions in its limb, its flags, and whether it slips"
    if still := join_names(still_in_limb(log, robot, frame)):
        text += f". {still} in its limb never moves: is its encoder dead?"
        advice = f"{DEAD_ENCODER_ADVICE}; else {advice}"
    return Finding("standing feet", SUSPICIOUS, "joint_position", text, advice, (frame,))


def _pose_findings(log: Log, contacts: Sequence[Contact], slip: float, poses: LinkPoses) -> Iterator[Finding]:
    """A finding about a base pose of another frame or another time: its correction makes standing feet keep still.

    Motion capture markers are rarely at the base link's origin or along its axes.
    """
    quat = log.base_quat_xyzw
    place = log.base_position_world
    if slip < MIN_SINGLE_SHARE or quat is None or place is None or log.contact_active is None:
        return
    feet = [c for c in contacts if c.frame in log.contact_names and c.frame in poses]
    stances = [
        (c.pose(poses[c.frame].numpy())[stance, :3, 3], _rolled(log, c, poses[c.frame].numpy())[stance], stance)
        for c in feet
        for stance in _stances(log, log.contact_active[:, log.contact_names.index(c.frame)])
    ]
    recorded = Slerp(log.time, Rotation.from_quat(quat))

    def motion(x: FloatArray) -> FloatArray:
        """Deviations of standing feet from their mean places [m], flat, with the pose corrected by x."""
        at = np.clip(log.time + x[6], log.time[0], log.time[-1])
        R = (recorded(at) * Rotation.from_rotvec(x[3:6]).inv()).as_matrix()
        origin = np.stack([np.interp(at, log.time, axis) for axis in place.T], axis=1) - R @ x[:3]
        world = [np.einsum("nij,nj->ni", R[s], foot) + origin[s] - rolled for foot, rolled, s in stances]
        return np.concatenate([positions - positions.mean(axis=0) for positions in world]).ravel()

    as_recorded = float(np.linalg.norm(motion(np.zeros(7)))) if stances else 0.0
    for unknowns in _POSE_UNKNOWNS.values() if as_recorded else ():
        x = np.zeros(7)
        size = _POSE_SIZE[unknowns]

        def cost(y: FloatArray, which: slice = unknowns, size: FloatArray = size) -> FloatArray:
            correction = np.zeros(7)
            correction[which] = size * y
            return np.append(motion(correction), _POSE_PRIOR_SHARE * as_recorded * y)

        x[unknowns] = size * least_squares(cost, np.zeros(len(size)), ftol=1e-3, xtol=1e-3).x
        if (residual := float(np.linalg.norm(motion(x)))) < MAX_SLIP_RESIDUAL_SHARE * as_recorded:
            yield _pose_finding(x, slip, residual / as_recorded)
            return


def _pose_finding(x: FloatArray, slip: float, residual: float) -> Finding:
    """A finding about the pose of a frame at x[:3] [m], turned by x[3:6] [rad], in the base, that is x[6] [s] late."""
    at, turn = (", ".join(f"{value:.0f}" for value in values) for values in (1e3 * x[:3], np.degrees(x[3:6])))
    parts = [f"of a point at ({at}) mm of the base link"] if x[:3].any() else []
    parts += [f"turned about it by ({turn}) degrees"] if x[3:6].any() else []
    parts += [f"{1e3 * abs(x[6]):.0f} ms {'late' if x[6] > 0.0 else 'early'}"] if x[6] else []
    text = (
        f"standing feet move {format_percent(slip)} % as much as the base, but {format_percent(residual)} % of that"
        f" if the base's pose is {join_names(parts)}"
    )
    advice = "give the pose of the base link itself; shift_s corrects a late file"
    return Finding("frame", SUSPICIOUS, "base_quat_xyzw", text, advice)


def _radius_findings(log: Log, robot: Robot, contacts: Sequence[Contact], poses: LinkPoses | None) -> Iterator[Finding]:
    """A finding about feet that roll with another radius than stated, by more than creeping feet do."""
    points = [c for c in contacts if c.kind == "point" and c.frame in log.contact_names and c.frame in robot.links]
    windows = [] if poses is None or log.base_quat_xyzw is None else list(_rolling_windows(log, points, poses))
    if len(windows) < _FEWEST_WINDOWS:
        return
    squares, products, unit = np.array(windows).T
    weight = np.ones(len(windows))
    radius = 0.0
    for _ in range(_PASSES):
        radius = float(weight @ products / max(weight @ unit, np.finfo(float).tiny))
        residual = np.maximum(squares - 2.0 * radius * products + radius**2 * unit, 0.0)
        weight = 1.0 / np.maximum(residual, max(float(np.median(residual)), np.finfo(float).tiny))
    error = np.linalg.norm(weight * (products - radius * unit)) / max(weight @ unit, np.finfo(float).tiny)
    stated = float(np.mean([c.radius for c in points]))
    if radius > 0.0 and abs(radius - stated) > max(_RADIUS_SHARE * max(radius, stated), _RADIUS_ERRORS * error):
        text = (
            f"standing feet roll like balls with a radius of {1e3 * radius:.3g} mm (± {1e3 * error:.1g});"
            f" the stated radius is {1e3 * stated:.3g} mm. Creeping feet seem smaller"
        )
        centre = f", centre: {join_numbers(points[0].centre)}" if any(points[0].centre) else ""
        entry = f"{{frame: {points[0].frame}, type: point, radius: {radius:.3g}{centre}}}"
        advice = f"set contacts: [{entry}, ...] if the feet are balls"
        yield Finding("radius", SUSPICIOUS, "contact_names", text, advice, tuple(c.frame for c in points))


def _rolling_windows(log: Log, points: Sequence[Contact], poses: LinkPoses) -> Iterator[tuple[float, float, float]]:
    """Mean squares of the motion of vectors between standing points, in short windows, against rolling unit balls.

    Mean square of the first [m^2], mean product [m], mean square of the second: the vectors move by the radius times
    the second where feet roll, see `measure_foot_slip`.
    """
    quat = np.asarray(log.base_quat_xyzw)
    active = np.asarray(log.contact_active)
    frames = [poses[c.frame].numpy() for c in points]
    places = [rotate_to_world(quat, c.pose(T)[:, :3, 3]) for c, T in zip(points, frames, strict=True)]
    rolls = [_rolled(log, replace(c, radius=1.0), T) for c, T in zip(points, frames, strict=True)]
    flags = [active[:, log.contact_names.index(c.frame)] for c in points]
    length = max(4, round(_ROLLING_WINDOW_S / median_step(log)))
    for i, j in combinations(range(len(points)), 2):
        for stance in _stances(log, flags[i] & flags[j]):
            for start in range(stance.start, stance.stop - length // 2, length):
                window = slice(start, min(start + length, stance.stop))
                moved, rolled = ((x[i] - x[j])[window] - (x[i] - x[j])[window].mean(axis=0) for x in (places, rolls))
                yield float((moved**2).mean()), float((moved * rolled).mean()), float((rolled**2).mean())


def measure_foot_slip(
    log: Log, robot: Robot, contacts: Sequence[Contact], poses: LinkPoses | None = None
) -> float | None:
    """Motion of standing feet in the world over that in the base frame; None where the base hardly moves.

    Flat feet must not turn, vectors between standing feet are constant, and so is the position of each foot where the
    position of the base is known: of feet that roll, less what they have rolled. `poses`: of the links, where known.
    """
    feet = [c for c in contacts if c.frame in log.contact_names and c.frame in robot.links]
    if log.base_quat_xyzw is None or log.contact_active is None or set(log.joint_names) != set(robot.joint_names):
        return None
    poses = poses or recorded_link_poses(log, robot)
    active = {c.frame: log.contact_active[:, log.contact_names.index(c.frame)] for c in feet}
    rolled = {c.frame: _rolled(log, c, poses[c.frame].numpy()) for c in feet}
    parts: list[tuple[float, float, int]] = []
    for i, foot in enumerate(feet):
        T = foot.pose(poses[foot.frame].numpy())
        if foot.kind == "flat":
            for axis in range(3):
                parts += _stance_motion(log, T[:, :3, axis], active[foot.frame], 1.0)
        if log.base_position_world is not None:
            origin = log.base_position_world - rolled[foot.frame]
            parts += _stance_motion(log, T[:, :3, 3], active[foot.frame], _LENGTH_UNIT_M, origin)
        for second in feet[i + 1 :]:
            between = T[:, :3, 3] - second.pose(poses[second.frame].numpy())[:, :3, 3]
            apart = rolled[second.frame] - rolled[foot.frame]
            parts += _stance_motion(log, between, active[foot.frame] & active[second.frame], _LENGTH_UNIT_M, apart)
    world, base, samples = np.array(parts).reshape(-1, 3).sum(axis=0) if parts else (0.0, 0.0, 0)
    if not samples or base / samples < _MIN_BASE_MOTION**2:
        return None
    return float(np.sqrt(world / base))


def _rolled(log: Log, contact: Contact, T_base_foot: FloatArray) -> FloatArray:
    """Rolled distance of a foot along the ground since the log's start, (N, 3) [m]; 0 for feet that do not roll."""
    quat = log.base_quat_xyzw
    if not contact.radius or quat is None:
        return np.zeros((len(log), 3))
    normals: FloatArray = np.broadcast_to(contact.normal, (len(log), 3))
    if log.contact_normal_world is not None:
        recorded = log.contact_normal_world[:, log.contact_names.index(contact.frame)]
        normals = np.where(np.isfinite(recorded), recorded, normals)
    rotation = Rotation.from_quat(quat).as_matrix() @ T_base_foot[:, :3, :3]
    return rolled_distance(rotation, contact.radius, normals, contact.rolling_axis)


def _stances(log: Log, active: np.ndarray) -> Iterator[slice]:
    """Samples of each long enough stance, without its ends."""
    step = median_step(log)
    ends = round(_STANCE_END_S / step)
    shortest = max(4, round(_MIN_STANCE_S / step))
    for span in find_spans(active):
        if span.last + 1 - span.first - 2 * ends >= shortest:
            yield slice(span.first + ends, span.last + 1 - ends)


def _stance_motion(
    log: Log, vector: FloatArray, active: np.ndarray, unit: float, origin: FloatArray | None = None
) -> list[tuple[float, float, int]]:
    """Sums of squared deviations of a vector (N, 3) within each stance, in world and base frame, and sample counts."""
    quat = log.base_quat_xyzw
    if quat is None:
        return []
    world = rotate_to_world(quat, vector) + (0.0 if origin is None else origin)
    sums = []
    for stance in _stances(log, active):
        in_world, in_base = (
            float(np.square((x - x.mean(axis=0)) / unit).sum()) for x in (world[stance], vector[stance])
        )
        sums.append((in_world, in_base, stance.stop - stance.start))
    return sums
