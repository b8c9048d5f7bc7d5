"""Whether a recorded robot stayed on its feet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from torchid.config import BoundsConfig
from torchid.errors import InputError
from torchid.logs.fields import BoolArray
from torchid.parameters import Array
from torchid.simulation.feet import Foot
from torchid.simulation.plant import Plant
from torchid.simulation.recording import Recording, exact
from torchid.simulation.stance import Stance


@dataclass(frozen=True)
class Stability:
    """How a robot stood during a motion.

    Attributes:
        base_height: least and greatest height of the base's origin [m].
        height_change: most that it differed from the stance's [m].
        slip: most that a foot moved along the floor between touching it and leaving it [m].
        zmp_margin: least distance from the zero-moment point to the border of the support polygon [m].
        beyond_limits: most that a joint was outside its range [rad or m].
        effort: greatest torque as a share of what the URDF allows, 0 if it sets no limit.
        unloaded: share of the time in which each foot did not stand, (F,).
    """

    base_height: tuple[float, float]
    height_change: float
    slip: float
    zmp_margin: float
    beyond_limits: float
    effort: float
    unloaded: tuple[float, ...]

    def check(self, bounds: BoundsConfig, motion: str, source: object) -> None:
        """Refuse a motion that the robot did not do standing.

        Raises:
            InputError: a bound is broken.
        """
        for found, allowed in (
            (f"base height changes by {self.height_change:.3g} m", self.height_change <= bounds.height_m),
            (f"a foot slips by {1e3 * self.slip:.3g} mm", self.slip <= bounds.slip_m),
            (f"zero-moment point {1e3 * self.zmp_margin:.3g} mm inside the support", self.zmp_margin >= bounds.zmp_m),
            (f"a joint passes its limits by {self.beyond_limits:.3g}", self.beyond_limits <= 0.0),
            (f"a joint needs {100 * self.effort:.0f} % of its effort limit", self.effort <= 1.0),
        ):
            if not allowed:
                wanted = "a gentler motion, another posture or wider bounds"
                raise InputError(source, f"motions.{motion}", found, wanted)


def stability(
    recording: Recording, plant: Plant, stance: Stance, feet: tuple[Foot, ...], load: float, source: object
) -> Stability:
    """Measure how a robot stood.

    Args:
        recording: what it did.
        plant: the robot.
        stance: where it started.
        feet: what it stood on.
        load: vertical force [N] from which on a foot counts as standing.
        source: named in errors.

    Raises:
        InputError: a foot never bears that much.
    """
    log = recording.log
    wrench = exact(log, "contact_wrench_local")
    R = recording.rotations
    force, moment = ((R @ part[..., None])[..., 0] for part in (wrench[..., :3], wrench[..., 3:]))
    middles = recording.feet + np.einsum("nfij,fj->nfi", R, np.array([foot.middle for foot in feet]))
    standing = force[..., 2] > load
    bearing = np.linalg.norm(force, axis=2).max(axis=0)
    for foot, most in zip(feet, bearing, strict=True):
        if most <= load:
            found = f"{load:g} N, but {foot.frame} never bears more than {most:.3g} N"
            raise InputError(source, "sensors.contact_threshold", found, "a fraction of what a standing foot bears")
    low, high = plant.limits.T
    height = exact(log, "base_position_world")[:, 2]
    return Stability(
        (float(height.min()), float(height.max())),
        float(np.abs(height - stance.position[2]).max()),
        max(_slip(middles[:, i, :2], standing[:, i]) for i in range(len(feet))),
        _zmp_margin(recording.feet, force, moment, stance, feet),
        max(float((log.joint_position - high).max()), float((low - log.joint_position).max()), 0.0),
        float(np.max(np.abs(exact(log, "joint_torque")) / plant.efforts)),
        tuple(map(float, 1.0 - standing.mean(axis=0))),
    )


def _slip(place: Array, standing: BoolArray) -> float:
    """Most that a point, (N, 2), moved from where it was when it began to stand."""
    begins = np.flatnonzero(np.diff(standing.astype(int), prepend=0) == 1)
    if not len(begins):
        return 0.0
    began = begins[np.maximum(np.cumsum(np.isin(np.arange(len(place)), begins)) - 1, 0)]
    return float(np.linalg.norm(place - place[began], axis=1)[standing].max())


def _zmp_margin(place: Array, force: Array, moment: Array, stance: Stance, feet: tuple[Foot, ...]) -> float:
    """Least distance from the zero-moment point to the border of the support polygon, per set of feet on the floor."""
    arm = np.cross(place, force) + moment
    total, turning = force.sum(axis=1), arm.sum(axis=1)
    aloft = total[:, 2] < 1.0
    zmp = np.stack([-turning[:, 1], turning[:, 0]], axis=1) / np.where(aloft, np.nan, total[:, 2])[:, None]
    corners = [
        target[:2] + (foot.arms @ R.T)[:, :2]
        for target, R, foot in zip(stance.feet, stance.rotations, feet, strict=True)
    ]
    margin = np.inf if not aloft.any() else -np.inf
    on = force[..., 2] > 0.0
    for state in np.unique(on[~aloft], axis=0):
        support = np.concatenate([corner for corner, active in zip(corners, state, strict=True) if active])
        if len(support) < 3:
            return -np.inf
        hull = ConvexHull(support).equations
        inside = zmp[(on == state).all(axis=1)]
        margin = min(margin, float(-(inside @ hull[:, :2].T + hull[:, 2]).max()))
    return margin
