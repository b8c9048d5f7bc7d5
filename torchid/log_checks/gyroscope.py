"""A gyroscope without an orientation beside it, against how the base turns above feet that stand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from torchid.errors import InputError, format_percent
from torchid.log_checks.findings import (
    REJECTED,
    SUSPICIOUS,
    UNEXPLAINED,
    Finding,
    Skipped,
    median_step,
    widen_mask,
)
from torchid.log_checks.model import default_cutoff_hz, preprocess_pieces, recorded_link_poses
from torchid.log_checks.standing_feet import MAX_SLIP_RESIDUAL_SHARE
from torchid.logs import Log
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.units import advise_units, units_of_ratio
from torchid.problem.base_motion import imu_pose
from torchid.robot import Robot
from torchid.sensing import Contact

#: Difference between both angular velocities, over the feet's, from which on a mistake is looked for, and where none
#: explains it. Soft soles and balls that roll make a tenth.
MAX_DIFFERENCE, MAX_UNEXPLAINED_DIFFERENCE = 0.3, 0.6
#: Angular velocity [rad/s] that the difference is compared with where the base turns less: a usual gyroscope's offset
#: is far below the share of it.
MIN_TURNING = 0.05
#: Samples that must be left, and time at either end of a stance that does not count.
_MIN_SAMPLES, _TURN_END_S = 50, 0.1
#: Length that makes an axis of a flat foot a vector between points, and the largest radius that counts as none.
_AXIS_LENGTH_M, _MAX_RADIUS_M = 0.3, 0.03
_UNIT_TOLERANCE = 0.1
_FIELD, _CHECK = "imu_angular_velocity", "gyroscope against feet that stand"


def check_gyroscope(
    log: Log, robot: Robot | None, contacts: Sequence[Contact], cutoff_hz: float | None
) -> Iterator[Finding | Skipped]:
    """Findings about an angular velocity without an orientation beside it, which `check_angular_velocity` takes."""
    if robot is None or robot.fixed_base or log.imu_angular_velocity is None or log.base_quat_xyzw is not None:
        return
    if log.contact_active is None or set(log.joint_names) != set(robot.joint_names):
        return
    try:
        rotation, _ = imu_pose(log, robot)
        ready = preprocess_pieces(log, cutoff_hz or default_cutoff_hz(log))[0]
    except InputError as error:
        yield Skipped(_CHECK, f"{error.field}: {error.found}")
        return
    vectors, rates, omega = _turning(ready, robot, contacts, rotation.as_matrix())
    if len(vectors) < _MIN_SAMPLES:
        yield Skipped(_CHECK, "no flat foot and no two feet that stand at once")
        return
    yield from _compare(vectors, rates, omega)


def _turning(
    log: Log, robot: Robot, contacts: Sequence[Contact], R_base_imu: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Vectors [m] that keep still in the world, their rates in the base, and the gyroscope's readings, (M, 3) each.

    What touches with the base itself, as rotors that hold it in the air do, shows nothing of how it turns.
    """
    poses, feet = recorded_link_poses(log, robot), [c for c in contacts if c.frame in log.contact_names]
    feet = [c for c in feet if c.radius <= _MAX_RADIUS_M and c.frame in poses and robot.links[c.frame][0]]
    ends = max(1, round(_TURN_END_S / median_step(log)))
    omega = np.asarray(log.imu_angular_velocity) @ R_base_imu.T
    parts = []

    def add(vector: FloatArray, *standing: Contact) -> None:
        where = _stands(log, standing, ends)
        parts.append((vector[where], np.gradient(vector, log.time, axis=0)[where], omega[where]))

    for index, foot in enumerate(feet):
        T = foot.pose(poses[foot.frame].numpy())
        if foot.kind == "flat":
            for axis in range(3):
                add(_AXIS_LENGTH_M * T[:, :3, axis], foot)
        for other in feet[index + 1 :]:
            add(T[:, :3, 3] - other.pose(poses[other.frame].numpy())[:, :3, 3], foot, other)
    if not parts:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3))
    vectors, rates, read = (np.concatenate(part) for part in zip(*parts, strict=True))
    return vectors, rates, read


def _stands(log: Log, contacts: Sequence[Contact], ends: int) -> BoolArray:
    """Samples (N,) in which all these contacts stand, for a while already and still."""
    flags = np.asarray(log.contact_active)
    standing = np.all([flags[:, log.contact_names.index(c.frame)] for c in contacts], axis=0)
    return ~widen_mask(~standing, ends)


def _compare(vectors: FloatArray, rates: FloatArray, omega: FloatArray) -> Iterator[Finding]:
    """Findings: what stands turns in the base with minus the base's angular velocity, d/dt r = r x omega."""
    size = max(float(np.linalg.norm(rates)), MIN_TURNING * float(np.linalg.norm(vectors)))

    def left(corrected: FloatArray) -> float:
        return float(np.linalg.norm(rates - np.cross(vectors, corrected))) / size

    difference = left(omega)
    if difference < MAX_DIFFERENCE:
        return
    limit = MAX_SLIP_RESIDUAL_SHARE * difference
    text = f"differs by {100 * difference:.3g} % from how the base turns above the feet that stand"
    offset = _least_squares(vectors, rates - np.cross(vectors, omega), np.ones((len(omega), 1)))[:, 0]
    if (rest := left(omega + offset)) < limit:
        values = ", ".join(f"{-x:.3g}" for x in offset)
        found = f"{text}, {format_percent(rest)} % without a steady ({values}) rad/s"
        yield Finding("offset", SUSPICIOUS, _FIELD, found, "subtract it: a gyroscope at rest reads its offset")
        return
    turned = np.cross(vectors, omega)
    factor = float((rates * turned).sum() / max(float(np.square(turned).sum()), np.finfo(float).tiny))
    if (rest := left(factor * omega)) < limit:
        yield _factor_finding(factor, f"{text}, {format_percent(rest)} % times {factor:.3g}")
        return
    matrix = _least_squares(vectors, rates, omega)
    if (rest := left(omega @ matrix.T)) < limit:
        found = f"{text}, {format_percent(rest)} % along other axes"
        yield Finding("frame", REJECTED, _FIELD, found, "imu_frame is the frame along whose axes the IMU reads")
    elif difference > MAX_UNEXPLAINED_DIFFERENCE:
        advice = "check unit, axes and imu_frame, signs and zeros of joint positions, and the flags"
        yield Finding("standing feet", SUSPICIOUS, _FIELD, f"{text}{UNEXPLAINED}", advice)


def _factor_finding(factor: float, text: str) -> Finding:
    if factor < 0.0 and abs(factor + 1.0) < _UNIT_TOLERANCE:
        return Finding("sign", REJECTED, _FIELD, f"reversed: {text}", "reverse it")
    units = units_of_ratio(1.0 / factor, ("angular velocity",), _UNIT_TOLERANCE) if factor > 0.0 else ()
    if units:
        return Finding("unit", REJECTED, _FIELD, f"in {' or '.join(units)}: {text}", advise_units({_FIELD: units}))
    return Finding("ratio", SUSPICIOUS, _FIELD, text, "check its unit and range")


def _least_squares(vectors: FloatArray, rates: FloatArray, inputs: FloatArray) -> FloatArray:
    """The matrix (3, k) that makes angular velocities of inputs (M, k) which fit d/dt r = r x (matrix inputs) best."""
    columns = np.stack([np.cross(vectors, axis)[..., None] * inputs[:, None] for axis in np.eye(3)], axis=2)
    solution = np.linalg.lstsq(columns.reshape(3 * len(rates), -1), rates.reshape(-1), rcond=None)[0]
    return np.asarray(solution, np.float64).reshape(3, -1)
