"""How a robot stands: a configuration with every foot on the floor and the centre of mass above them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from torchid.errors import InputError, UnknownNameError
from torchid.parameters import Array
from torchid.simulation.controller import turn_between
from torchid.simulation.feet import Foot
from torchid.simulation.plant import Plant

_ITERATIONS, _LARGEST_STEP = 300, 0.2
_SINGULAR = 1e-4  # share of the largest singular value
_TOLERANCE = 1e-3  # m or rad
_STEEPEST = np.radians(40.0)  # that a sole may be off the horizontal in the given posture


@dataclass(frozen=True)
class Stance:
    """A standing robot: configuration (7 + n,) and centre of mass (3,); feet's middles (F, 3), rotations (F, 3, 3)."""

    position: Array
    com: Array
    feet: Array
    rotations: Array


def find_stance(plant: Plant, feet: Sequence[Foot], posture: Mapping[str, float], source: object) -> Stance:
    """Put the robot on its feet, its base level and its centre of mass over their middle, close to a posture.

    Args:
        plant: the robot; left in the stance.
        feet: what it stands on.
        posture: joint positions by name [rad or m]; others are 0, or the end of their range nearest to it.
        source: named in errors.

    Raises:
        UnknownNameError: a joint that the robot does not have.
        InputError: a joint beyond its limits, or no such configuration near the posture.
    """
    for name in posture:
        if name not in plant.joint_names:
            raise UnknownNameError(source, "posture", name, plant.joint_names)
    low, high = plant.limits.T
    for name, value in posture.items():
        place = plant.joint_names.index(name)
        if not low[place] <= value <= high[place]:
            accepted = f"{low[place]:g} to {high[place]:g}, the joint's limits"
            raise InputError(source, f"posture.{name}", f"{value:g}", accepted)
    joints = np.clip([posture.get(name, 0.0) for name in plant.joint_names], low, high)
    plant.place(np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], joints]))
    rotations = np.stack([_flattened(plant.foot(i).rotation, foot, source) for i, foot in enumerate(feet)])
    targets = np.stack([plant.foot(i).position for i in range(len(feet))])
    for target, R, foot in zip(targets, rotations, feet, strict=True):
        target[2] = -np.min(foot.arms @ R[2] - foot.radii)
    lift = np.mean([target[2] - plant.foot(i).position[2] for i, target in enumerate(targets)])
    plant.place(plant.shift(lift * np.eye(plant.nv)[2]))

    for _ in range(_ITERATIONS):
        A, off = _tasks(plant, feet, targets, rotations)
        home = np.concatenate([np.zeros(6), joints - plant.position[7:]])
        step = home + np.linalg.pinv(A, rcond=_SINGULAR) @ (off - A @ home)  # the posture yields to everything else
        step *= min(1.0, _LARGEST_STEP / max(np.abs(step).max(), _LARGEST_STEP))
        moved = plant.shift(step)
        moved[7:] = np.clip(moved[7:], low, high)
        plant.place(moved)
        if np.abs(step).max() < 1e-9:
            break
    _, off = _tasks(plant, feet, targets, rotations)
    if not np.abs(off).max() < _TOLERANCE:
        worst = np.abs(off).max()
        found = f"no stance near it with all feet on the floor and the base level: off by {worst:.2g} m or rad"
        raise InputError(source, "posture", found, "joint positions, by name, in which the robot nearly stands")
    return Stance(plant.position.copy(), plant.com.copy(), targets, rotations)


def _tasks(plant: Plant, feet: Sequence[Foot], targets: Array, rotations: Array) -> tuple[Array, Array]:
    """What should be zero: Jacobian (rows, nv), and how far off it is (rows,) [m, rad]."""
    jacobians, off = [], []
    for i, (foot, target, R) in enumerate(zip(feet, targets, rotations, strict=True)):
        now = plant.foot(i)
        jacobians.append(now.J[: foot.held])
        off.append(np.concatenate([target - now.position, turn_between(now.rotation, R)])[: foot.held])
    level = np.zeros((3, plant.nv))
    level[:, 3:6] = np.eye(3)
    A = np.vstack([*jacobians, plant.inertia[:2] / plant.mass, level])
    above = (targets.mean(axis=0) - plant.com)[:2]
    return A, np.concatenate([*off, above, turn_between(plant.base_rotation, np.eye(3))])


def _flattened(R: Array, foot: Foot, source: object) -> Array:
    """The rotation nearest to R that puts all points of the foot at one height."""
    if foot.held < 6:
        return R.copy()
    normal = np.linalg.svd(foot.arms @ R.T)[2][2]
    normal *= np.copysign(1.0, normal[2])
    axis = np.cross(normal, [0.0, 0.0, 1.0])
    angle = np.arctan2(np.linalg.norm(axis), normal[2])
    if angle > _STEEPEST:
        found = f"{foot.frame} is {np.degrees(angle):.0f} degrees off the horizontal"
        raise InputError(source, "posture", found, f"joint positions that put it within {np.degrees(_STEEPEST):.0f}")
    return Rotation.from_rotvec(angle * axis / max(float(np.linalg.norm(axis)), 1e-12)).as_matrix() @ R
