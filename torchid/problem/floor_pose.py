"""Tilt, height, heading and place of a base above points that stand on a floor, and how far feet roll on it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from torchid.errors import LogError
from torchid.logs.log import BoolArray, FloatArray
from torchid.sensing import Contact
from torchid.sensing.sensors import UP

FEWEST_POINTS = 3
"""Points that say how a floor lies."""

_HALF_FOOT_M = 0.05  # a flat foot counts as the corners of a square, a line as two points, so far from its origin
_MIN_BREADTH = 0.05  # over the length of the feet that stand; below, noise of one tilts the base 20 times more
_ALONG = 0.8  # cosine of the angle between an axis of a flat foot's frame and the way up to the base: 37 degrees
_PASSES, _SETTLED_M = 50, 1e-13  # of feet that roll; each leaves some hundredth of the error before


def points_of(contact: Contact) -> int:
    """As how many points of a floor a contact counts."""
    return {"point": 1, "line": 2, "flat": 4}[contact.kind]


@dataclass(frozen=True)
class StanceFoot:
    """A contact, and in the base frame its rotation (N, 3, 3) and points (N, P, 3) [m] of a floor that it stands on."""

    contact: Contact
    rotation: FloatArray
    points: FloatArray

    @classmethod
    def of(cls, contact: Contact, pose: FloatArray, sole_axis: int = 2) -> StanceFoot:
        """A foot with poses (N, 4, 4) in the base; `sole_axis` of a flat one's frame is along the floor's normal."""
        rotation, origin = pose[:, :3, :3], pose[:, :3, 3]
        axes = np.eye(3)
        if contact.kind == "point":
            local = np.zeros((1, 3))
        elif contact.kind == "line":
            local = np.outer([1.0, -1.0], axes["xyz".index(contact.line_axis)])
        else:
            across = np.delete(axes, sole_axis, axis=0)
            local = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]]) @ across
        return cls(contact, rotation, origin[:, None] + (_HALF_FOOT_M * local) @ rotation.swapaxes(1, 2))


def foot_to_base(pose: FloatArray) -> FloatArray:
    """Vectors (N, 3) [m] from a foot with poses (N, 4, 4) in the base to the base's origin, along the foot's axes."""
    return np.asarray(-np.einsum("nji,nj->ni", pose[:, :3, :3], pose[:, :3, 3]))


def find_sole_axis(contact: Contact, way: FloatArray) -> int:
    """The axis of a flat foot's frame that is nearest to the way (3,) from the foot up to the base while it stands.

    Raises:
        LogError: none is near.
    """
    share = np.abs(way) / max(float(np.linalg.norm(way)), np.finfo(float).tiny)
    axis = int(share.argmax())
    if share[axis] < _ALONG:
        angle = float(np.degrees(np.arccos(share[axis])))
        found = f"the base is {angle:.0f} deg off the nearest axis of flat foot {contact.frame}"
        accepted = "a frame with an axis normal to the sole, below the base, for preprocessing.base_motion: contacts"
        raise LogError.at_field("contact_names", found, accepted)
    return axis


@dataclass(frozen=True)
class Floor:
    """Of N samples, in the base frame; NaN where the feet do not say.

    Attributes:
        up: unit vectors normal to the floor, (N, 3).
        height: of the base's origin above it, (N,) [m].
        uneven: rms distance from it of the points that stand, (N,) [m].
    """

    up: FloatArray
    height: FloatArray
    uneven: FloatArray


def fit_floors(points: FloatArray, radius: FloatArray, stands: BoolArray) -> Floor:
    """Floors below points (N, P, 3) [m] that stand, each on a ball; NaN where they do not say how it lies."""
    up, height, uneven = np.full((len(points), 3), np.nan), *np.full((2, len(points)), np.nan)
    states, index = np.unique(stands, axis=0, return_inverse=True)
    for number, state in enumerate(states):
        samples = np.flatnonzero(index.reshape(-1) == number)
        if state.sum() < FEWEST_POINTS:
            continue
        normal, middle, values = _fit_planes(points[samples][:, state], radius[state])
        broad = np.sqrt(values[:, 1]) > _MIN_BREADTH * np.sqrt(values[:, 2])
        samples, normal, middle = samples[broad], normal[broad], middle[broad]
        up[samples], height[samples] = normal, -(normal * middle).sum(axis=1)
        uneven[samples] = np.sqrt(np.maximum(values[broad, 0], 0.0) / state.sum())
    return Floor(up, height, uneven)


def _fit_planes(points: FloatArray, radius: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Planes below balls (M, P, 3): normals (M, 3) to the origin, points on them (M, 3), squared extents (M, 3)."""
    on_plane, up = points, np.zeros((len(points), 3))
    for _ in range(_PASSES):
        middle = on_plane.mean(axis=1)
        apart = on_plane - middle[:, None]
        values, vectors = np.linalg.eigh(apart.swapaxes(1, 2) @ apart)
        before, up = up, vectors[:, :, 0] * np.where((vectors[:, :, 0] * middle).sum(axis=1) > 0.0, -1.0, 1.0)[:, None]
        on_plane = points - radius[:, None] * up[:, None]
        if not np.ptp(radius) or np.abs(up - before).max() < _SETTLED_M:
            break
    return up, on_plane.mean(axis=1), values


@dataclass(frozen=True)
class Footholds:
    """Feet of N successive samples above their floor, in the base frame; `points`: of all feet, (N, P, 3) [m]."""

    feet: Sequence[StanceFoot]
    points: FloatArray
    floor: Floor

    @classmethod
    def of(cls, feet: Sequence[StanceFoot], stands: BoolArray) -> Footholds:
        """Of feet of whose P points these stand, (N, P)."""
        points = np.concatenate([foot.points for foot in feet], axis=1)
        radius = np.concatenate([np.full(foot.points.shape[1], foot.contact.radius) for foot in feet])
        return cls(feet, points, fit_floors(points, radius, stands))

    def __getitem__(self, samples: slice) -> Footholds:
        feet = [StanceFoot(foot.contact, foot.rotation[samples], foot.points[samples]) for foot in self.feet]
        floor = Floor(self.floor.up[samples], self.floor.height[samples], self.floor.uneven[samples])
        return Footholds(feet, self.points[samples], floor)


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
    """Heading and place of a base above feet that keep theirs, or roll, while they stand."""

    def __init__(self, stands: BoolArray, normal: Sequence[float]) -> None:
        """Stand on feet of whose P points these stand, (N, P), on a floor with a normal (3,)."""
        self._stands, self._normal = stands, np.array(normal)
        self._places = np.full((stands.shape[1], 2), np.nan)  # where points stood at the last sample so far
        self._last = 0  # first sample after it

    def begin(self, start: int) -> bool:
        """Forget points that were lifted before a segment; whether those that are left tell its heading."""
        stayed = self._stands[self._last : start + 1].all(axis=0)
        self._places[~stayed] = np.nan
        return bool(np.isfinite(self._places).all(axis=1).sum() >= 2)

    def along(self, runs: Sequence[slice], footholds: Footholds) -> tuple[FloatArray, FloatArray]:
        """Rotations (M, 3, 3) to the world and positions (M, 3) [m] in it, along the runs of a segment.

        Args:
            runs: of samples on the same feet, without a gap.
            footholds: of their M samples.
        """
        levelled_base = levelled(footholds.floor.up)  # base to floor but for the heading
        flat = np.einsum("nij,npj->npi", levelled_base, footholds.points)[..., :2]
        rolled = np.zeros_like(flat)
        rolling = [foot.contact.radius > 0.0 for foot in footholds.feet]
        for _ in range(_PASSES):
            yaw, place, places = self._follow(runs, levelled_base, flat, rolled)
            rotation = _about_z(yaw) @ levelled_base
            if not any(rolling):
                break
            before, rolled = rolled, _rolled(footholds.feet, rotation)
            if np.abs(rolled - before).max() < _SETTLED_M:
                break
        self._places, self._last = places, runs[-1].stop
        to_world = _rotation_between(np.array(UP), self._normal)
        position = np.concatenate([place, footholds.floor.height[:, None]], axis=1)
        return to_world @ rotation, position @ to_world.T

    def _follow(
        self, runs: Sequence[slice], levelled_base: FloatArray, flat: FloatArray, rolled: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Headings (M,) and places (M, 2) [m] of the base, and final ones (P, 2) of points that have rolled so far."""
        offset, anchor = runs[0].start, self._places - rolled[0]
        yaw, place = np.empty(len(rolled)), np.empty((len(rolled), 2))
        for run in runs:
            stands, own = self._stands[run.start], slice(run.start - offset, run.stop - offset)
            standing = flat[own][:, stands]
            known = np.isfinite(anchor[stands]).all(axis=1)
            start = rolled[own.start][stands]
            if known.sum() >= 2:
                turn, shift = _align(standing[:1, known], (anchor[stands] + start)[None, known])
            else:
                turn, shift = np.array([self._first_yaw(levelled_base[own.start])]), np.zeros((1, 2))
                known[:] = False
            placed = (_about_z(turn)[:, :2, :2] @ standing[0].T)[0].T + shift - start
            anchor[stands] = np.where(known[:, None], anchor[stands], placed)
            anchor[~stands] = np.nan
            yaw[own], place[own] = _align(standing, anchor[stands] + rolled[own][:, stands])
        return yaw, place, anchor + rolled[-1]

    def _first_yaw(self, levelled_base: FloatArray) -> float:
        """The heading at which the base's x axis has no part along the world's y axis, and looks along its x axis."""
        forward = levelled_base[:, 0]
        sideways, ahead = _rotation_between(np.array(UP), self._normal)[1::-1]  # the world's y and x axis by the floor
        a = sideways[0] * forward[0] + sideways[1] * forward[1]
        b = sideways[1] * forward[0] - sideways[0] * forward[1]
        size = max(float(np.hypot(a, b)), np.finfo(float).tiny)
        middle, half = np.arctan2(b, a), np.arccos(np.clip(-sideways[2] * forward[2] / size, -1.0, 1.0))
        both = [float(middle + half), float(middle - half)]
        return max(both, key=lambda yaw: float(ahead @ (_about_z(np.array([yaw]))[0] @ forward)))


def _rolled(feet: Sequence[StanceFoot], rotation: FloatArray) -> FloatArray:
    """How far the points of feet have rolled along the floor since the first sample, (M, P, 2) [m].

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
    middle, wanted = flat.mean(axis=1), target.mean(axis=1)
    x, y = flat - middle[:, None], target - wanted[:, None]
    turn = np.arctan2((x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0]).sum(axis=1), (x * y).sum(axis=(1, 2)))
    return turn, wanted - (_about_z(turn)[:, :2, :2] @ middle[..., None])[..., 0]


def _rotation_between(start: FloatArray, end: FloatArray) -> FloatArray:
    """The smallest rotation (3, 3) that takes one unit vector to another, which is not its opposite."""
    x, y, z = np.cross(start, end)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + float(start @ end)))


def rolled_distance(rotation: FloatArray, radius: float, normal: FloatArray, axis: str | None = None) -> FloatArray:
    """How far the origin of a frame goes that rolls without slipping, (N, 3) [m], from the first sample on.

    Args:
        rotation: of the frame to the world, (N, 3, 3).
        radius: of the sphere or cylinder about its origin [m].
        normal: of the ground, (3,) or (N, 3).
        axis: x, y or z of the frame, along which a cylinder is; None for a sphere.
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
