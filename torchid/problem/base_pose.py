"""Pose of the base in logs without it, from the feet that stand on a floor."""

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
from torchid.problem.floor_pose import (
    FEWEST_POINTS,
    Footholds,
    LegOdometry,
    StanceFoot,
    find_sole_axis,
    foot_to_base,
    points_of,
    split_at_lost_feet,
)
from torchid.problem.log_joints import joint_order
from torchid.problem.samples import require_contacts
from torchid.robot import Robot
from torchid.sensing import Contact
from torchid.sensing.sensors import UP

FEET = "three point feet, one flat foot, or a line and another foot"
"""Feet that say how a base stands above them, in messages."""

_POSES_TOGETHER = 4096  # samples for which the poses of all links are worked out at once
_MAX_UNEVEN_M = 0.005  # rms distance from one floor that is worth a warning: of four feet, one is 2 cm off
_HEADING_TOLERANCE = 0.02  # of a recorded normal's components against the stated one


@dataclass(frozen=True)
class LogWithPose:
    """A log with the pose of the base wherever enough feet stand to say how it does.

    Attributes:
        log: with `base_quat_xyzw` and `base_position_world`, NaN where they are not known, and no other motion of the
            base.
        segments: of successive samples with a pose; nothing may be differentiated across their ends.
        dropped: number of samples without a pose, by the reason.
        uneven: rms distance of the feet that stand from one floor [m].
    """

    log: Log
    segments: tuple[slice, ...]
    dropped: dict[str, int]
    uneven: float


def warn_of_pose(standing: LogWithPose, too_short: int) -> None:
    """Say which samples are left out, some in segments that are too short, and whether feet are uneven."""
    source, count = standing.log.source, len(standing.log)
    dropped = standing.dropped | ({"segments too short to differentiate": too_short} if too_short else {})
    if dropped:
        reasons = ", ".join(f"{reason}: {number}" for reason, number in dropped.items())
        what = f"{sum(dropped.values())} of {count} samples left out, base motion unknown"
        warn(f"{source}: base_motion contacts: {what} ({reasons})")
    if standing.uneven > _MAX_UNEVEN_M:
        what = f"feet that stand are {1e3 * standing.uneven:.2g} mm (rms) off one floor"
        advice = "check joint zeros, contact flags, contacts' frames and radii"
        warn(f"{source}: base_motion contacts: {what}; {advice}")


def longest_with_pose(log: Log, robot: Robot, contacts: Sequence[Contact]) -> Log:
    """The longest segment with the base's pose from the feet that stand; LogError as `base_pose_from_feet`."""
    standing = base_pose_from_feet(log, robot, contacts)
    return standing.log.select(max(standing.segments, key=lambda segment: segment.stop - segment.start))


def base_pose_from_feet(log: Log, robot: Robot, contacts: Sequence[Contact]) -> LogWithPose:
    """Pose of the base in the world from the feet that stand on a floor, which has the contacts' common normal.

    The floor goes through the world's origin. Tilt and height follow from the feet of each sample alone, heading and
    place from feet that keep theirs, or roll, while they stand; least squares over all feet. At the start of a segment
    from which on no two points stay, the base's x axis lies above the world's: on a level floor the dynamics do not
    depend on that, and on another only the first such segment has a pose.

    A frame of a flat foot has one axis along the floor's normal, the nearest to the way up to the base; such frames
    are equally high above the floor. A point or line with a radius is that high above it.

    Args:
        log: as recorded; what it has of the base's motion is not used.
        robot: the robot.
        contacts: its feet, all with the same normal.

    Raises:
        LogError: joints or contacts that are missing, no sample with enough feet, a foot without an axis along the
            normal, or readings along axes of a world whose heading is unknown.
    """
    active = _standing_flags(log, contacts)
    if log.contact_wrench_world is not None:
        found = "given, but preprocessing.base_motion: contacts knows no heading in the world"
        raise LogError(log.source, "contact_wrench_world", found, "contact_wrench_local, or a log without wrenches")
    _require_floor_normals(log, active, contacts)
    with about_file(log.source):
        poses = feet_poses(log, robot, contacts)
        feet = [_stance_foot(contact, poses[contact.frame], active[:, i]) for i, contact in enumerate(contacts)]
    stands = np.repeat(active, [points_of(contact) for contact in contacts], axis=1)
    footholds = Footholds.of(feet, stands)
    known = np.isfinite(footholds.floor.height)
    few = int((stands.sum(axis=1) < FEWEST_POINTS).sum())
    _require_some(log.source, active, known, few)
    dropped = {"too few feet stand": few, "feet in a line": int((~known).sum()) - few}
    odometry, segments = LegOdometry(stands, contacts[0].normal), list[slice]()
    quat, position = np.full((len(log), 4), np.nan), np.full((len(log), 3), np.nan)
    for runs in split_at_lost_feet(stands, known):
        samples = slice(runs[0].start, runs[-1].stop)
        if odometry.begin(samples.start) or contacts[0].normal == UP or not segments:
            rotation, position[samples] = odometry.along(runs, footholds[samples])
            quat[samples] = make_sign_continuous(Rotation.from_matrix(rotation).as_quat())
            segments.append(samples)
        else:
            lost = "heading on a floor that is not level"
            dropped[lost] = dropped.get(lost, 0) + samples.stop - samples.start
    fields: dict[str, Any] = {name: None for name in vars(log) if name.startswith(("base_", "imu_"))}
    fields |= {"imu_frame": "", "base_quat_xyzw": quat, "base_position_world": position, NORMALS: None}
    named = {reason: count for reason, count in dropped.items() if count}
    uneven = float(np.sqrt(np.square(footholds.floor.uneven[known]).mean()))
    return LogWithPose(dataclasses.replace(log, **fields), tuple(segments), named, uneven)


# ------------------------------------------------------------------------------------------------- what a log must have


def _standing_flags(log: Log, contacts: Sequence[Contact]) -> BoolArray:
    """Which contacts stand, (N, C), by the flags of a log; LogError without any."""
    if log.contact_active is None:
        accepted = "(N, C) bool: which contact stands when; base_motion: contacts follows from it"
        raise LogError(log.source, "contact_active", "missing", accepted)
    require_contacts(log.source, log.contact_names, contacts)
    return log.contact_active[:, [log.contact_names.index(contact.frame) for contact in contacts]]


def _require_some(source: str, active: BoolArray, known: BoolArray, few: int) -> None:
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
    raise LogError(source, "contact_active", f"{found}, though preprocessing.base_motion is contacts", accepted)


def _require_floor_normals(log: Log, active: BoolArray, contacts: Sequence[Contact]) -> None:
    """Refuse recorded normals of contacts that stand (N, C) which are not that of the floor."""
    normals = log.contact_normal_world
    if normals is None:
        return
    columns = [log.contact_names.index(contact.frame) for contact in contacts]
    other = np.abs(normals[:, columns] - np.array([contact.normal for contact in contacts]))
    if (active & (other > _HEADING_TOLERANCE).any(axis=2)).any():
        found = "other normals than that of the contacts, though preprocessing.base_motion is contacts"
        raise LogError(log.source, NORMALS, found, "contacts[].normal of the one floor, or a log without the field")


def _stance_foot(contact: Contact, pose: FloatArray, stands: BoolArray) -> StanceFoot:
    """A foot with poses (N, 4, 4) in the base, a flat one on the axis that is along the floor's normal as it stands."""
    way = foot_to_base(pose)[stands]
    flat = contact.kind == "flat" and len(way) > 0
    return StanceFoot.of(contact, pose, find_sole_axis(contact, way.mean(axis=0)) if flat else 2)


def feet_poses(log: Log, robot: Robot, contacts: Sequence[Contact]) -> dict[str, FloatArray]:
    """Poses (N, 4, 4) of the contacts' frames in the base, their origins at the contacts' centres."""
    position, parts = log.joint_position[:, joint_order(log, robot)], []
    for start in range(0, len(log), _POSES_TOGETHER):
        poses = robot.link_poses(torch.from_numpy(position[start : start + _POSES_TOGETHER]))
        parts.append({contact.frame: contact.pose(poses[contact.frame].numpy()) for contact in contacts})
    return {frame: np.concatenate([part[frame] for part in parts]) for frame in parts[0]}
