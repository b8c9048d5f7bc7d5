"""Pose of the base from the feet that stand on a floor, for logs without a pose."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from torchid.errors import LogError, about_file, format_count, warn
from torchid.logs import Log
from torchid.logs.log import NORMALS, BoolArray, FloatArray
from torchid.logs.quaternion import make_sign_continuous
from torchid.problem.log_joints import joint_order
from torchid.problem.samples import ACTIVE, require_contacts
from torchid.robot import Robot
from torchid.sensing import Contact
from torchid.sensing.sensors import UP

FEET = "three point feet, one flat foot, or a line foot and another foot"
"""Feet that determine the pose of the base, in messages."""

FEWEST_POINTS = 3
"""Points that determine a floor."""

_POSES_TOGETHER = 4096  # samples per computation of link poses
_MAX_UNEVEN_M = 0.005  # rms distance from a plane that gives a warning: one of four feet is 2 cm off
_HEADING_TOLERANCE = 0.02  # accepted error of a recorded normal's components
_HALF_FOOT_M = 0.05  # distance of a foot's points from its origin: corners of a square, or two points of a line
_MIN_BREADTH = 0.05  # breadth over length of the standing feet; below, noise tilts the base 20 times more
_ALONG = 0.8  # cosine of the largest angle (37 deg) between a flat foot's axis and the direction to the base
_PASSES = 50  # at most; each pass reduces the error of rolling feet to about a hundredth
_SETTLED_M = 1e-13


@dataclass(frozen=True)
class LogWithPose:
    """A log with the pose of the base where enough feet stand.

    Attributes:
        log: with `base_quat_xyzw` and `base_position_world`, NaN where unknown, and no other motion of the base.
        segments: of successive samples with a pose. Do not differentiate across their ends.
        dropped: number of samples without a pose, by reason.
        uneven: rms distance of the standing feet from a common plane [m].
    """

    log: Log
    segments: tuple[slice, ...]
    dropped: dict[str, int]
    uneven: float


def warn_of_pose(standing: LogWithPose, too_short: int) -> None:
    """Warn about dropped samples, `too_short` of them in short segments, and about feet that are off a common plane."""
    source = standing.log.source
    count = len(standing.log)
    dropped = standing.dropped | ({"segments too short to differentiate": too_short} if too_short else {})
    if dropped:
        reasons = ", ".join(f"{reason}: {number}" for reason, number in dropped.items())
        what = f"{sum(dropped.values())} of {count} samples dropped: the feet do not determine the base pose"
        warn(f"{source}: {what} ({reasons})")
    if standing.uneven > _MAX_UNEVEN_M:
        what = f"the standing feet are {1e3 * standing.uneven:.2g} mm (rms) off a common plane"
        warn(f"{source}: {what}. Check joint zeros, contact flags, and the frames and radii of contacts")


def longest_with_pose(log: Log, robot: Robot, contacts: Sequence[Contact]) -> Log:
    """The longest segment with a base pose from the standing feet; raises as `base_pose_from_feet`."""
    standing = base_pose_from_feet(log, robot, contacts)
    return standing.log.select(max(standing.segments, key=lambda segment: segment.stop - segment.start))


def base_pose_from_feet(log: Log, robot: Robot, contacts: Sequence[Contact]) -> LogWithPose:
    """Compute the pose of the base from the feet that stand on a floor with the contacts' common normal.

    The floor goes through the world's origin. Tilt and height follow from the feet of each sample. Heading and
    horizontal position follow from feet that do not move, or roll, while they stand (least squares over all feet).
    Where a segment begins without two such points, the base's x axis lies above the world's x axis. On a level floor
    the dynamics do not depend on this choice; on a sloped floor only the first such segment has a pose.

    The frame of a flat foot has one axis along the floor's normal: the axis nearest to the direction up to the base.
    All flat frames have the same height above the floor. A point or line with a radius is that high above it.

    Args:
        log: as recorded; its motion of the base is not used.
        robot: the robot.
        contacts: its feet, all with the same normal.

    Raises:
        LogError: joints or contacts are missing, no sample has enough standing feet, a flat foot has no axis along the
            normal, or readings are along world axes although the heading is unknown.
    """
    active = _standing_flags(log, contacts)
    if log.contact_wrench_world is not None:
        refusal = "preprocessing.base_motion: contacts does not know the heading in the world"
        raise LogError(log.source, "contact_wrench_world", refusal, "contact_wrench_local, or a log without wrenches")
    _require_floor_normals(log, active, contacts)
    with about_file(log.source):
        poses = feet_poses(log, robot, contacts)
        feet = [StanceFoot.of(contact, poses[contact.frame], active[:, i]) for i, contact in enumerate(contacts)]
    stands = np.repeat(active, [points_of(contact) for contact in contacts], axis=1)
    footholds = Footholds.of(feet, stands)
    known = np.isfinite(footholds.height)
    few = int((stands.sum(axis=1) < FEWEST_POINTS).sum())
    _require_some(log.source, active, known, few)
    dropped = {"too few standing feet": few, "standing feet on one line": int((~known).sum()) - few}
    odometry = LegOdometry(stands, contacts[0].normal)
    segments = list[slice]()
    quat = np.full((len(log), 4), np.nan)
    position = np.full((len(log), 3), np.nan)
    for runs in split_at_lost_feet(stands, known):
        samples = slice(runs[0].start, runs[-1].stop)
        if odometry.begin(samples.start) or contacts[0].normal == UP or not segments:
            rotation, position[samples] = odometry.along(runs, footholds[samples])
            quat[samples] = make_sign_continuous(Rotation.from_matrix(rotation).as_quat())
            segments.append(samples)
        else:
            lost = "heading unknown on a sloped floor"
            dropped[lost] = dropped.get(lost, 0) + samples.stop - samples.start
    fields: dict[str, Any] = {name: None for name in vars(log) if name.startswith(("base_", "imu_"))}
    fields |= {"imu_frame": "", "base_quat_xyzw": quat, "base_position_world": position, NORMALS: None}
    named = {reason: count for reason, count in dropped.items() if count}
    uneven = float(np.sqrt(np.square(footholds.uneven[known]).mean()))
    return LogWithPose(dataclasses.replace(log, **fields), tuple(segments), named, uneven)


def _standing_flags(log: Log, contacts: Sequence[Contact]) -> BoolArray:
    """Which contacts stand, (N, C), by the flags of a log; LogError without flags."""
    if log.contact_active is None:
        raise LogError(log.source, "contact_active", "missing", ACTIVE)
    require_contacts(log.source, log.contact_names, contacts)
    return log.contact_active[:, [log.contact_names.index(contact.frame) for contact in contacts]]


def _require_some(source: str, active: BoolArray, known: BoolArray, few: int) -> None:
    """Raise LogError if no sample determines the pose of the base."""
    if known.any():
        return
    if not active.any():
        reason = "no contact stands in any sample"
    elif few == len(known):
        most = int(active.sum(axis=1).max())
        reason = f"at most {format_count(most, 'contact')} at the same time, too few for the base pose"
    else:
        reason = "all standing feet are on one line, and the base could turn about it"
    accepted = f"{FEET} on the floor; preprocessing.base_motion: null if the log has the base motion"
    raise LogError(source, "contact_active", reason, accepted)


def _require_floor_normals(log: Log, active: BoolArray, contacts: Sequence[Contact]) -> None:
    """Raise LogError if recorded normals of standing contacts (N, C) differ from that of the floor."""
    normals = log.contact_normal_world
    if normals is None:
        return
    columns = [log.contact_names.index(contact.frame) for contact in contacts]
    other = np.abs(normals[:, columns] - np.array([contact.normal for contact in contacts]))
    if (active & (other > _HEADING_TOLERANCE).any(axis=2)).any():
        reason = "differs from contacts[].normal, the one floor that preprocessing.base_motion: contacts assumes"
        raise LogError(log.source, NORMALS, reason, "the same normal in both, or a log without this field")


def feet_poses(log: Log, robot: Robot, contacts: Sequence[Contact]) -> dict[str, FloatArray]:
    """Poses (N, 4, 4) of the contacts' frames in the base, their origins at the contacts' centres."""
    position = log.joint_position[:, joint_order(log, robot)]
    parts = []
    for start in range(0, len(log), _POSES_TOGETHER):
        poses = robot.link_poses(torch.from_numpy(position[start : start + _POSES_TOGETHER]))
        parts.append({contact.frame: contact.pose(poses[contact.frame].numpy()) for contact in contacts})
    return {frame: np.concatenate([part[frame] for part in parts]) for frame in parts[0]}


def points_of(contact: Contact) -> int:
    """Number of floor points that a contact counts as."""
    return {"point": 1, "line": 2, "flat": 4}[contact.kind]


@dataclass(frozen=True)
class StanceFoot:
    """A contact with, in the base frame, its rotation (N, 3, 3) and the floor points (N, P, 3) [m] below it."""

    contact: Contact
    rotation: FloatArray
    points: FloatArray

    @classmethod
    def of(cls, contact: Contact, pose: FloatArray, stands: BoolArray) -> StanceFoot:
        """A foot with poses (N, 4, 4) in the base; `stands`: (N,) bool.

        Raises:
            LogError: no axis of a flat foot's frame points to the base while it stands.
        """
        rotation = pose[:, :3, :3]
        origin = pose[:, :3, 3]
        axes = np.eye(3)
        if contact.kind == "point":
            local = np.zeros((1, 3))
        elif contact.kind == "line":
            local = np.outer([1.0, -1.0], axes["xyz".index(contact.line_axis)])
        else:
            normal = _sole_axis(contact, rotation[stands], origin[stands]) if stands.any() else 2
            local = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]]) @ np.delete(axes, normal, axis=0)
        return cls(contact, rotation, origin[:, None] + (_HALF_FOOT_M * local) @ rotation.swapaxes(1, 2))


def _sole_axis(contact: Contact, rotation: FloatArray, origin: FloatArray) -> int:
    """Axis of a flat foot's frame nearest to the direction up to the base; LogError if none is near."""
    way = -np.einsum("nji,nj->ni", rotation, origin).mean(axis=0)
    share = np.abs(way) / max(float(np.linalg.norm(way)), np.finfo(float).tiny)
    axis = int(share.argmax())
    if share[axis] < _ALONG:
        angle = float(np.degrees(np.arccos(share[axis])))
        reason = f"no axis of flat foot {contact.frame} points to the base (the nearest is {angle:.0f} deg off)"
        accepted = "a frame with an axis normal to the sole and the base above it (preprocessing.base_motion: contacts)"
        raise LogError.at_field("contact_names", reason, accepted)
    return axis


@dataclass(frozen=True)
class Footholds:
    """Feet of N successive samples above their floor, in the base frame; NaN where the floor is unknown.

    Attributes:
        feet: the feet.
        points: of all feet, (N, P, 3) [m].
        up: unit vectors normal to the floor, (N, 3).
        height: of the base's origin above the floor, (N,) [m].
        uneven: rms distance of the standing points from the floor, (N,) [m].
    """

    feet: Sequence[StanceFoot]
    points: FloatArray
    up: FloatArray
    height: FloatArray
    uneven: FloatArray

    @classmethod
    def of(cls, feet: Sequence[StanceFoot], stands: BoolArray) -> Footholds:
        """From feet with P points; `stands`: (N, P) bool."""
        points = np.concatenate([foot.points for foot in feet], axis=1)
        radius = np.concatenate([np.full(foot.points.shape[1], foot.contact.radius) for foot in feet])
        up, height, uneven = np.full((len(points), 3), np.nan), *np.full((2, len(points)), np.nan)
        states, index = np.unique(stands, axis=0, return_inverse=True)
        for number, state in enumerate(states):
            samples = np.flatnonzero(index.reshape(-1) == number)
            if state.sum() < FEWEST_POINTS:
                continue
            normal, middle, values = _fit_planes(points[samples][:, state], radius[state])
            broad = np.sqrt(values[:, 1]) > _MIN_BREADTH * np.sqrt(values[:, 2])
            samples = samples[broad]
            normal = normal[broad]
            middle = middle[broad]
            up[samples] = normal
            height[samples] = -(normal * middle).sum(axis=1)
            uneven[samples] = np.sqrt(np.maximum(values[broad, 0], 0.0) / state.sum())
        return cls(feet, points, up, height, uneven)

    def __getitem__(self, samples: slice) -> Footholds:
        feet = [StanceFoot(foot.contact, foot.rotation[samples], foot.points[samples]) for foot in self.feet]
        return Footholds(feet, self.points[samples], self.up[samples], self.height[samples], self.uneven[samples])


def _fit_planes(points: FloatArray, radius: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Planes below balls (M, P, 3): normals (M, 3) to the origin, points on them (M, 3), squared extents (M, 3)."""
    on_plane = points
    up = np.zeros((len(points), 3))
    for _ in range(_PASSES):
        middle = on_plane.mean(axis=1)
        apart = on_plane - middle[:, None]
        values, vectors = np.linalg.eigh(apart.swapaxes(1, 2) @ apart)
        before = up
        up = vectors[:, :, 0] * np.where((vectors[:, :, 0] * middle).sum(axis=1) > 0.0, -1.0, 1.0)[:, None]
        on_plane = points - radius[:, None] * up[:, None]
        if not np.ptp(radius) or np.abs(up - before).max() < _SETTLED_M:
            break
    return up, on_plane.mean(axis=1), values


def split_at_lost_feet(stands: BoolArray, known: BoolArray) -> Iterator[list[slice]]:
    """Runs of samples on the same feet, grouped where two points or more stand on both sides of a change."""
    changes = (stands[1:] != stands[:-1]).any(axis=1) | (known[1:] != known[:-1])
    ends = [0, *(np.flatnonzero(changes) + 1).tolist(), len(known)]
    runs: list[slice] = []
    for first, last in zip(ends, ends[1:], strict=False):
        kept = bool(runs) and (stands[first - 1] & stands[first]).sum() >= 2
        if runs and not (known[first] and kept):
            yield runs
            runs = []
        if known[first]:
            runs.append(slice(first, last))
    if runs:
        yield runs


class LegOdometry:
    """Heading and horizontal position of a base above feet that do not move, or roll, while they stand."""

    def __init__(self, stands: BoolArray, normal: Sequence[float]) -> None:
        """Start with points that stand, (N, P) bool, on a floor with a normal (3,)."""
        self._stands = stands
        self._normal = np.array(normal)
        self._places = np.full((stands.shape[1], 2), np.nan)  # where points stood at the last sample so far
        self._last = 0  # first sample after it

    def begin(self, start: int) -> bool:
        """Forget points that were lifted before a segment; return whether the other points determine its heading."""
        stayed = self._stands[self._last : start + 1].all(axis=0)
        self._places[~stayed] = np.nan
        return bool(np.isfinite(self._places).all(axis=1).sum() >= 2)

    def along(self, runs: Sequence[slice], footholds: Footholds) -> tuple[FloatArray, FloatArray]:
        """Rotations (M, 3, 3) to the world and positions (M, 3) [m] in it, along the runs of a segment.

        Args:
            runs: of samples on the same feet, without a gap.
            footholds: of their M samples.
        """
        levelled_base = levelled(footholds.up)  # base to floor but for the heading
        flat = np.einsum("nij,npj->npi", levelled_base, footholds.points)[..., :2]
        rolled = np.zeros_like(flat)
        rolling = [foot.contact.radius > 0.0 for foot in footholds.feet]
        for _ in range(_PASSES):
            yaw, place, places = self._follow(runs, levelled_base, flat, rolled)
            rotation = _about_z(yaw) @ levelled_base
            if not any(rolling):
                break
            before = rolled
            rolled = _rolled(footholds.feet, rotation)
            if np.abs(rolled - before).max() < _SETTLED_M:
                break
        self._places = places
        self._last = runs[-1].stop
        to_world = _rotation_between(np.array(UP), self._normal)
        position = np.concatenate([place, footholds.height[:, None]], axis=1)
        return to_world @ rotation, position @ to_world.T

    def _follow(
        self, runs: Sequence[slice], levelled_base: FloatArray, flat: FloatArray, rolled: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Headings (M,) and positions (M, 2) [m] of the base, and final positions (P, 2) of rolling points."""
        offset = runs[0].start
        anchor = self._places - rolled[0]
        yaw = np.empty(len(rolled))
        place = np.empty((len(rolled), 2))
        for run in runs:
            stands = self._stands[run.start]
            part = slice(run.start - offset, run.stop - offset)
            standing = flat[part][:, stands]
            known = np.isfinite(anchor[stands]).all(axis=1)
            start = rolled[part.start][stands]
            if known.sum() >= 2:
                turn, shift = _align(standing[:1, known], (anchor[stands] + start)[None, known])
            else:
                turn = np.array([self._first_yaw(levelled_base[part.start])])
                shift = np.zeros((1, 2))
                known[:] = False
            placed = (_about_z(turn)[:, :2, :2] @ standing[0].T)[0].T + shift - start
            anchor[stands] = np.where(known[:, None], anchor[stands], placed)
            anchor[~stands] = np.nan
            yaw[part], place[part] = _align(standing, anchor[stands] + rolled[part][:, stands])
        return yaw, place, anchor + rolled[-1]

    def _first_yaw(self, levelled_base: FloatArray) -> float:
        """The heading at which the base's x axis has no part along the world's y axis, and looks along its x axis."""
        forward = levelled_base[:, 0]
        sideways, ahead = _rotation_between(np.array(UP), self._normal)[1::-1]  # the world's y and x axis by the floor
        a = sideways[0] * forward[0] + sideways[1] * forward[1]
        b = sideways[1] * forward[0] - sideways[0] * forward[1]
        size = max(float(np.hypot(a, b)), np.finfo(float).tiny)
        middle = np.arctan2(b, a)
        half = np.arccos(np.clip(-sideways[2] * forward[2] / size, -1.0, 1.0))
        both = [float(middle + half), float(middle - half)]
        return max(both, key=lambda yaw: float(ahead @ (_about_z(np.array([yaw]))[0] @ forward)))


def _rolled(feet: Sequence[StanceFoot], rotation: FloatArray) -> FloatArray:
    """Distance that the points of feet have rolled along the floor since the first sample, (M, P, 2) [m].

    Args:
        feet: at M samples.
        rotation: of the base to the floor, (M, 3, 3).
    """
    out = []
    for foot in feet:
        turned = rotation @ foot.rotation
        far = rolled_distance(turned, foot.contact.radius, np.array(UP), foot.contact.rolling_axis)
        out.append(np.repeat(far[:, None, :2], foot.points.shape[1], axis=1))
    return np.concatenate(out, axis=1)


def levelled(up: FloatArray) -> FloatArray:
    """Rotations (N, 3, 3) that take upward vectors (N, 3) of the base frame to z."""
    nearest = np.abs(np.nan_to_num(up)).argmin(axis=1)
    x = np.eye(3)[nearest] - up * np.take_along_axis(up, nearest[:, None], axis=1)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(up, x), up], axis=1)


def _about_z(yaw: FloatArray) -> FloatArray:
    """Rotations (N, 3, 3) by angles (N,) [rad]."""
    out = np.zeros((len(yaw), 3, 3))
    out[:, 0, 0] = out[:, 1, 1] = np.cos(yaw)
    out[:, 1, 0] = np.sin(yaw)
    out[:, 0, 1] = -out[:, 1, 0]
    out[:, 2, 2] = 1.0
    return out


def _align(flat: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Turns (M,) [rad] and shifts (M, 2) that take points (M, P, 2) to others by least squares."""
    middle = flat.mean(axis=1)
    wanted = target.mean(axis=1)
    x = flat - middle[:, None]
    y = target - wanted[:, None]
    turn = np.arctan2((x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0]).sum(axis=1), (x * y).sum(axis=(1, 2)))
    return turn, wanted - (_about_z(turn)[:, :2, :2] @ middle[..., None])[..., 0]


def _rotation_between(start: FloatArray, end: FloatArray) -> FloatArray:
    """The smallest rotation (3, 3) that takes one unit vector to another, which is not its opposite."""
    x, y, z = np.cross(start, end)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + float(start @ end)))


def rolled_distance(rotation: FloatArray, radius: float, normal: FloatArray, axis: str | None = None) -> FloatArray:
    """Displacement of the origin of a frame that rolls without slipping, (N, 3) [m], from the first sample on.

    Args:
        rotation: of the frame to the world, (N, 3, 3).
        radius: of the sphere or cylinder about its origin [m].
        normal: of the ground, (3,) or (N, 3).
        axis: x, y or z, the cylinder's axis in the frame; None for a sphere.
    """
    normals = np.broadcast_to(normal, (len(rotation), 3))
    if axis is not None:
        along = rotation[:, :, "xyz".index(axis)]
        across = normals - along * (along * normals).sum(axis=1, keepdims=True)
        normals = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(float).tiny)
    turned = Rotation.from_matrix(rotation[1:] @ rotation[:-1].transpose(0, 2, 1)).as_rotvec()
    steps = radius * np.cross(turned, 0.5 * (normals[1:] + normals[:-1]))
    out: FloatArray = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return out
