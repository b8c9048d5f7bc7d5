"""Pose of the base in logs without it, from the feet that stand on a floor."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
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
class PoseSegments:
    """Where enough feet of a log stand to say how its base does.

    Attributes:
        segments: of successive samples with a pose; nothing may be differentiated across their ends.
        dropped: number of samples without a pose, by the reason.
        uneven: rms distance of the feet that stand from one floor [m].
    """

    segments: tuple[slice, ...]
    dropped: dict[str, int]
    uneven: float


@dataclass(frozen=True)
class LogWithPose(PoseSegments):
    """A log with the pose of the base wherever enough feet stand.

    Attributes:
        log: with `base_quat_xyzw` and `base_position_world`, NaN where they are not known, and no other motion of the
            base.
    """

    log: Log


def warn_of_pose(source: str, count: int, standing: PoseSegments, too_short: int) -> None:
    """Say which of so many samples are left out, some in segments that are too short, and whether feet are uneven."""
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
    active = standing_flags(log.source, log.contact_names, log.contact_active, contacts)
    normals = None if log.contact_active is None else log.contact_normal_world
    require_no_heading(log.source, log.contact_wrench_world is not None)
    require_floor_normals(log.source, log.contact_names, normals, active, contacts)
    with about_file(log.source):
        poses = feet_poses(log, robot, contacts)
        soles = [foot_to_base(poses[x.frame])[active[:, i]] for i, x in enumerate(contacts)]
        axes = sole_axes(contacts, [way.mean(axis=0) if len(way) else None for way in soles])
        feet = [StanceFoot.of(x, poses[x.frame], axis) for x, axis in zip(contacts, axes, strict=True)]
    whole = Footholds.of(feet, points_that_stand(active, contacts))
    quat, position = np.full((len(log), 4), np.nan), np.full((len(log), 3), np.nan)

    def add(samples: slice, turned: FloatArray, placed: FloatArray) -> None:
        quat[samples], position[samples] = turned, placed

    found = base_pose_in_parts(log.source, contacts, active, whole.__getitem__, [slice(0, len(log))], add)
    fields: dict[str, Any] = {name: None for name in vars(log) if name.startswith(("base_", "imu_"))} | {
        "imu_frame": ""
    }
    fields |= {"base_quat_xyzw": quat, "base_position_world": position, NORMALS: None}
    return LogWithPose(found.segments, found.dropped, found.uneven, dataclasses.replace(log, **fields))


def base_pose_in_parts(
    source: str,
    contacts: Sequence[Contact],
    active: BoolArray,
    footholds: Callable[[slice], Footholds],
    parts: Sequence[slice],
    add: Callable[[slice, FloatArray, FloatArray], None],
) -> PoseSegments:
    """As `base_pose_from_feet`, of a log whose feet are worked out part by part.

    Args:
        source: name of the log.
        contacts: its feet, C of them.
        active: which stand, (N, C).
        footholds: of successive samples.
        parts: all samples; nothing but flags and heights above the floor is kept from one to the next.
        add: called with successive samples, their quaternions (M, 4) and positions (M, 3) [m].
    """
    stands = points_that_stand(active, contacts)
    known, uneven, counted = np.zeros(len(active), dtype=bool), 0.0, 0
    for part in parts:
        floor = footholds(part).floor
        known[part] = np.isfinite(floor.height)
        uneven += float(np.square(floor.uneven[known[part]]).sum())
        counted += int(known[part].sum())
    few = int((stands.sum(axis=1) < FEWEST_POINTS).sum())
    dropped = {"too few feet stand": few, "feet in a line": int((~known).sum()) - few}
    _require_some(source, active, known, few)
    normal = contacts[0].normal
    odometry = LegOdometry(stands, normal)
    segments: list[slice] = []
    for runs in split_at_lost_feet(stands, known):
        samples = slice(runs[0].start, runs[-1].stop)
        if odometry.begin(samples.start) or normal == UP or not segments:
            _follow_segment(odometry, runs, footholds, [part.start for part in parts], add)
            segments.append(samples)
        else:
            lost = "heading on a floor that is not level"
            dropped[lost] = dropped.get(lost, 0) + samples.stop - samples.start
    named = {reason: count for reason, count in dropped.items() if count}
    return PoseSegments(tuple(segments), named, float(np.sqrt(uneven / max(counted, 1))))


def _follow_segment(
    odometry: LegOdometry,
    runs: Sequence[slice],
    footholds: Callable[[slice], Footholds],
    starts: Sequence[int],
    add: Callable[[slice, FloatArray, FloatArray], None],
) -> None:
    """Follow a segment, in parts that begin at some of the samples `starts`."""
    first, last = runs[0].start, runs[-1].stop
    borders = [first, *(start for start in starts if first < start < last), last]
    before: FloatArray | None = None
    for start, stop in zip(borders, borders[1:], strict=False):
        begin = start if before is None else start - 1  # where the part before has ended
        own = [slice(max(run.start, begin), min(run.stop, stop)) for run in runs if run.stop > begin < stop > run.start]
        rotation, position = odometry.along(own, footholds(slice(begin, stop)))
        quat = make_sign_continuous(Rotation.from_matrix(rotation).as_quat())
        if before is not None and float(quat[0] @ before) < 0.0:
            quat = -quat
        before = quat[-1]
        add(slice(start, stop), quat[start - begin :], position[start - begin :])


# ------------------------------------------------------------------------------------------------- what a log must have


def standing_flags(
    source: str, names: Sequence[str], flags: BoolArray | None, contacts: Sequence[Contact]
) -> BoolArray:
    """Which contacts stand, (N, C), by the flags of a log whose contacts have these names; LogError without any."""
    if flags is None:
        accepted = "(N, C) bool: which contact stands when; base_motion: contacts follows from it"
        raise LogError(source, "contact_active", "missing", accepted)
    require_contacts(source, names, contacts)
    return flags[:, [list(names).index(contact.frame) for contact in contacts]]


def points_that_stand(active: BoolArray, contacts: Sequence[Contact]) -> BoolArray:
    """Which points of contacts stand that are active, (N, P)."""
    return np.repeat(active, [points_of(contact) for contact in contacts], axis=1)


def sole_axes(contacts: Sequence[Contact], ways: Sequence[FloatArray | None]) -> list[int]:
    """Axes along the normals of flat feet, from the mean ways up (3,) while they stand; z where one never does."""
    return [
        2 if way is None or contact.kind != "flat" else find_sole_axis(contact, way)
        for contact, way in zip(contacts, ways, strict=True)
    ]


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


def require_no_heading(source: str, in_world: bool) -> None:
    """Refuse readings along axes of the world, whose heading the feet do not know."""
    if in_world:
        found = "given, but preprocessing.base_motion: contacts knows no heading in the world"
        raise LogError(source, "contact_wrench_world", found, "contact_wrench_local, or a log without wrenches")


def require_floor_normals(
    source: str, names: Sequence[str], normals: FloatArray | None, active: BoolArray, contacts: Sequence[Contact]
) -> None:
    """Refuse recorded normals (N, C', 3) of contacts of these names that are not that of the floor."""
    if normals is None:
        return
    columns = [list(names).index(contact.frame) for contact in contacts]
    other = np.abs(normals[:, columns] - np.array([contact.normal for contact in contacts]))
    if (active & (other > _HEADING_TOLERANCE).any(axis=2)).any():
        found = "other normals than that of the contacts, though preprocessing.base_motion is contacts"
        raise LogError(source, NORMALS, found, "contacts[].normal of the one floor, or a log without the field")


def feet_poses(log: Log, robot: Robot, contacts: Sequence[Contact]) -> dict[str, FloatArray]:
    """Poses (N, 4, 4) of the contacts' frames in the base, their origins at the contacts' centres."""
    position, parts = log.joint_position[:, joint_order(log, robot)], []
    for start in range(0, len(log), _POSES_TOGETHER):
        poses = robot.link_poses(torch.from_numpy(position[start : start + _POSES_TOGETHER]))
        parts.append({contact.frame: contact.pose(poses[contact.frame].numpy()) for contact in contacts})
    return {frame: np.concatenate([part[frame] for part in parts]) for frame in parts[0]}
