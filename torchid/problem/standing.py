"""Pose of a base that nobody measured, from the feet that stand on a floor."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from torchid.errors import LogError, about_file, warn
from torchid.logs import Log
from torchid.logs.log import NORMALS, BoolArray, FloatArray
from torchid.logs.quaternion import make_sign_continuous
from torchid.logs.stretches import preprocess_stretches
from torchid.problem.floor_pose import FEWEST_POINTS, Foot, Walk, fit_floors, split_at_lost_feet
from torchid.problem.samples import joint_order
from torchid.robot import Robot
from torchid.sensing import Contact
from torchid.sensing.sensors import UP

FEET = "three point feet, one flat foot, or a line and another foot"
"""Feet that say how a base stands above them, in messages."""

_POSES_TOGETHER = 4096  # samples for which the poses of all links are worked out at once
_MAX_UNEVEN_M = 0.005  # rms distance from one floor that is worth a warning: of four feet, one is 2 cm off
_HEADING_TOLERANCE = 0.02  # of a recorded normal's components against the stated one


@dataclass(frozen=True)
class StandingBase:
    """A log with the pose of the base wherever enough feet stand.

    Attributes:
        log: with `base_quat_xyzw` and `base_position_world`, NaN where they are not known, and no other motion of the
            base.
        stretches: of successive samples with a pose; nothing may be differentiated across their ends.
        dropped: number of samples without a pose, by the reason.
        uneven: rms distance of the feet that stand from one floor [m].
    """

    log: Log
    stretches: tuple[slice, ...]
    dropped: dict[str, int]
    uneven: float


def preprocess_standing(
    log: Log,
    robot: Robot,
    contacts: Sequence[Contact],
    cutoff_hz: float | None,
    sample_rate_hz: float | None,
    sign_width: float | None = None,
) -> Log:
    """As `preprocess`, with the motion of the base from the feet that stand; samples with too few of them are left out.

    Args:
        log: as recorded.
        robot: the robot.
        contacts: its feet.
        cutoff_hz: as of `preprocess`.
        sample_rate_hz: likewise.
        sign_width: likewise.

    Raises:
        InputError: as `stand_on_feet` and `preprocess`, or no stretch is long enough for the filter.

    Warns:
        TorchidWarning: as `preprocess`; number of samples left out, with the reasons; feet that are not on one floor.
    """
    standing = stand_on_feet(log, robot, contacts)
    out, too_short = preprocess_stretches(standing.log, standing.stretches, cutoff_hz, sample_rate_hz, sign_width)
    dropped = standing.dropped | ({"stretches too short to differentiate": too_short} if too_short else {})
    if dropped:
        reasons = ", ".join(f"{reason}: {count}" for reason, count in dropped.items())
        what = f"{sum(dropped.values())} of {len(log)} samples left out, base motion unknown"
        warn(f"{log.source}: base_motion contacts: {what} ({reasons})")
    if standing.uneven > _MAX_UNEVEN_M:
        what = f"feet that stand are {1e3 * standing.uneven:.2g} mm (rms) off one floor"
        advice = "check joint zeros, contact flags, contacts' frames and radii"
        warn(f"{log.source}: base_motion contacts: {what}; {advice}")
    return out


def longest_standing(log: Log, robot: Robot, contacts: Sequence[Contact]) -> Log:
    """The longest stretch of a log with the pose of the base from the feet that stand; LogError as `stand_on_feet`."""
    standing = stand_on_feet(log, robot, contacts)
    return standing.log.select(max(standing.stretches, key=lambda stretch: stretch.stop - stretch.start))


def stand_on_feet(log: Log, robot: Robot, contacts: Sequence[Contact]) -> StandingBase:
    """Pose of the base in the world from the feet that stand on a floor, which has the contacts' common normal.

    The floor goes through the world's origin. Tilt and height follow from the feet of each sample alone, heading and
    place from feet that keep theirs, or roll, while they stand; least squares over all feet. At the start of a stretch
    from which on no two points stay, the base's x axis lies above the world's: on a level floor the dynamics do not
    depend on that, and on another only the first such stretch has a pose.

    A frame of a flat foot has one axis along the floor's normal, the nearest to the way up to the base; such frames
    are equally high above the floor. A point or line with a radius is that high above it.

    Args:
        log: as recorded; what it has of the base's motion is not used.
        robot: the robot.
        contacts: its feet, all with the same normal.

    Raises:
        LogError: joints or contacts that are missing, no sample with enough feet, a foot without an axis along the
            normal, or readings along axes of a world whose heading nobody knows.
    """
    frames = [contact.frame for contact in contacts]
    active = _flags(log, contacts)
    _require_no_heading(log, contacts)
    with about_file(log.source):
        poses = _poses(log, robot, frames)
        feet = [Foot.of(contact, poses[contact.frame], active[:, i]) for i, contact in enumerate(contacts)]
    points = np.concatenate([foot.points for foot in feet], axis=1)
    radius = np.concatenate([np.full(foot.points.shape[1], foot.contact.radius) for foot in feet])
    stands = np.repeat(active, [foot.points.shape[1] for foot in feet], axis=1)
    floor = fit_floors(points, radius, stands)
    known = np.isfinite(floor.height)
    few = int((stands.sum(axis=1) < FEWEST_POINTS).sum())
    dropped = {"too few feet stand": few, "feet in a line": int((~known).sum()) - few}
    _require_some(log, active, known, few)
    normal = contacts[0].normal
    walk = Walk(feet, points, stands, floor, normal)
    rotation, position = np.full((len(log), 3, 3), np.nan), np.full((len(log), 3), np.nan)
    stretches: list[slice] = []
    for runs in split_at_lost_feet(stands, known):
        samples = slice(runs[0].start, runs[-1].stop)
        if walk.begin(samples.start) or normal == UP or not stretches:
            rotation[samples], position[samples] = walk.along(runs)
            stretches.append(samples)
        else:
            lost = "heading on a floor that is not level"
            dropped[lost] = dropped.get(lost, 0) + samples.stop - samples.start
    quat = np.full((len(log), 4), np.nan)
    for samples in stretches:
        quat[samples] = make_sign_continuous(Rotation.from_matrix(rotation[samples]).as_quat())
    fields: dict[str, Any] = {name: None for name in vars(log) if name.startswith(("base_", "imu_"))} | {
        "imu_frame": ""
    }
    fields |= {"base_quat_xyzw": quat, "base_position_world": position, NORMALS: None}
    uneven = float(np.sqrt(np.nanmean(np.square(floor.uneven))))
    named = {reason: count for reason, count in dropped.items() if count}
    return StandingBase(dataclasses.replace(log, **fields), tuple(stretches), named, uneven)


# ------------------------------------------------------------------------------------------------- what a log must have


def _flags(log: Log, contacts: Sequence[Contact]) -> BoolArray:
    """Which contacts stand, (N, C)."""
    if log.contact_active is None:
        accepted = "(N, C) bool: which contact stands when; base_motion: contacts follows from it"
        raise LogError(log.source, "contact_active", "missing", accepted)
    for contact in contacts:
        if contact.frame not in log.contact_names:
            accepted = "every contact of the experiment"
            raise LogError(log.source, "contact_names", f"contact '{contact.frame}' missing", accepted)
    return log.contact_active[:, [log.contact_names.index(contact.frame) for contact in contacts]]


def _require_some(log: Log, active: BoolArray, known: BoolArray, few: int) -> None:
    """Refuse a log in whose samples nothing says how the base stands."""
    if known.any():
        return
    if not active.any():
        found = "no contact stands in any sample"
    elif few == len(known):
        most = int(active.sum(axis=1).max())
        found = f"at most {most} of the contacts stand at once"
    else:
        found = "the feet that stand are in a line, about which the base may turn"
    accepted = f"{FEET} on the floor, or preprocessing.base_motion: null for a log with the base's motion"
    raise LogError(log.source, "contact_active", f"{found}, though preprocessing.base_motion is contacts", accepted)


def _require_no_heading(log: Log, contacts: Sequence[Contact]) -> None:
    """Refuse readings along axes of the world, or of the floor, that the feet do not know."""
    if log.contact_wrench_world is not None:
        found = "given, but preprocessing.base_motion: contacts knows no heading in the world"
        raise LogError(log.source, "contact_wrench_world", found, "contact_wrench_local, or a log without wrenches")
    if log.contact_normal_world is not None and log.contact_active is not None:
        columns = [log.contact_names.index(contact.frame) for contact in contacts]
        other = np.abs(log.contact_normal_world[:, columns] - np.array([contact.normal for contact in contacts]))
        if (log.contact_active[:, columns] & (other > _HEADING_TOLERANCE).any(axis=2)).any():
            found = "other normals than that of the contacts, though preprocessing.base_motion is contacts"
            raise LogError(log.source, NORMALS, found, "contacts[].normal of the one floor, or a log without the field")


def _poses(log: Log, robot: Robot, frames: Sequence[str]) -> dict[str, FloatArray]:
    """Poses (N, 4, 4) of frames in the base."""
    position, parts = log.joint_position[:, joint_order(log, robot)], []
    for start in range(0, len(log), _POSES_TOGETHER):
        poses = robot.link_poses(torch.from_numpy(position[start : start + _POSES_TOGETHER]))
        parts.append({frame: poses[frame].numpy() for frame in frames})
    return {frame: np.concatenate([part[frame] for part in parts]) for frame in frames}
