"""Bodies that are mirror images of each other: paired by name, checked by where the URDF puts them."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import torch

from torchid.errors import ConfigError, join_names
from torchid.parameters import Array
from torchid.robot.robot import Robot

MIRROR_TOLERANCE = 1e-3
"""Greatest distance of an origin from its mirror image, in units of the robot's size."""


@dataclass(frozen=True)
class MirrorPair:
    """Indices of two bodies, and the matrix (3, 3) that takes vectors of the first one's link to the second one's."""

    body: int
    image: int
    reflection: Array


def mirror_pairs(
    robot: Robot,
    left: str,
    right: str,
    normal: str = "y",
    field: str = "symmetry",
    apart: Collection[str] = (),
) -> tuple[MirrorPair, ...]:
    """Pairs of bodies whose names become each other's if `left` and `right` change places in them.

    All of them do, or else one alone: LAnkleRoll and RAnkleRoll differ in one letter of three, L and R. With all joints
    at 0 the two bodies must be mirror images with respect to the plane through the base link's origin whose normal is
    the base link's axis `normal`: with D the reflection, D p_i = p_j for the origins, to `MIRROR_TOLERANCE`, and D a_i
    parallel to a_j for the joints' axes. From one link frame to the other the reflection is R_j^T D R_i.

    Args:
        robot: any.
        left: part of the names of bodies on one side, as "l_".
        right: the part in its stead in the names of their mirror images.
        normal: "x", "y" or "z".
        field: that names them, for errors.
        apart: bodies that need no counterpart; two of them are no pair.

    Raises:
        ConfigError: no pair at all; a body without its counterpart; a body with two; a pair that is not mirrored, or
            of which one has no mass.
    """
    names = robot.body_names
    pairs = _by_name(names, left, right, apart, field)
    poses = robot.link_poses(torch.zeros(1, robot.n, dtype=torch.float64))
    T = np.stack([poses[name][0].numpy() for name in names])
    size = float(np.ptp(T[:, :3, 3], axis=0).max())
    D = np.eye(3)
    D["xyz".index(normal), "xyz".index(normal)] = -1.0
    out = []
    for i, j in pairs:
        pair, accepted = f"{names[i]} and {names[j]}", "mirror images when all joints are at 0"
        off = float(np.linalg.norm(D @ T[i, :3, 3] - T[j, :3, 3]))
        if off > MIRROR_TOLERANCE * size:
            found = f"{pair} are {off:.3g} m from being mirror images along {normal} in a robot of {size:.3g} m"
            raise ConfigError.at_field(field, found, f"{accepted}, to {MIRROR_TOLERANCE * size:.2g} m")
        aslant = _angle(robot, T, D, i, j)
        if aslant > MIRROR_TOLERANCE:
            raise ConfigError.at_field(field, f"the joints of {pair} are {aslant:.3g} rad off", accepted)
        if robot.bodies[i].massless != robot.bodies[j].massless:
            raise ConfigError.at_field(field, f"of {pair} one has no mass", "two bodies that have")
        out.append(MirrorPair(i, j, T[j, :3, :3].T @ D @ T[i, :3, :3]))
    return tuple(out)


def _by_name(
    names: tuple[str, ...], left: str, right: str, apart: Collection[str], field: str
) -> list[tuple[int, int]]:
    """Indices of bodies whose names answer to each other."""
    if left == right:
        raise ConfigError.at_field(field, f"'{left}' on both sides", "two different parts of names")
    images = {name: _images(name, left, right, names) for name in names}
    for name, found in images.items():
        expected = _exchanged(name, left, right)
        if not found and name not in apart and expected != name:
            raise ConfigError.at_field(field, f"{name} has no counterpart", f"a body named {expected}")
        if len(found) > 1 or any(images[image] != [name] for image in found):
            others = [other for other in names if other in found or name in images[other]]
            raise ConfigError.at_field(field, f"{name} corresponds to {' and to '.join(others)}", "one counterpart")
    pairs = [(i, names.index(images[name][0])) for i, name in enumerate(names) if images[name]]
    if not pairs:
        raise ConfigError.at_field(
            field, f"no two bodies differ in '{left}' and '{right}'", f"parts of names: {join_names(names)}"
        )
    return [(i, j) for i, j in pairs if i < j and not (names[i] in apart and names[j] in apart)]


def _images(name: str, left: str, right: str, names: tuple[str, ...]) -> list[str]:
    """Bodies whose name is this one with left and right exchanged wherever they are words, or else once anywhere."""
    exchanged = _exchanged(name, left, right)
    if exchanged != name and exchanged in names:
        return [exchanged]
    found = [
        name[:i] + other + name[i + len(token) :]
        for token, other in ((left, right), (right, left))
        for i in range(len(name))
        if name.startswith(token, i)
    ]
    return [other for other in names if other in found]


def _exchanged(name: str, left: str, right: str) -> str:
    """The name with left and right exchanged, other than inside words, as l_ is in shell_link."""
    alone = []
    for token in sorted((left, right), key=len, reverse=True):
        before = "(?<![A-Za-z0-9])" if token[0].isalnum() else ""
        after = "(?![A-Za-z0-9])" if token[-1].isalnum() else ""
        alone.append(before + re.escape(token) + after)
    return re.sub("|".join(alone), lambda match: right if match[0] == left else left, name)


def _angle(robot: Robot, T: Array, D: Array, i: int, j: int) -> float:
    """Angle between the axis of body j's joint and the mirrored one of body i's [rad], pi if only one slides."""
    one, other = robot.bodies[i].joint, robot.bodies[j].joint
    if one is None or other is None:
        return 0.0
    if one.kind != other.kind:
        return float(np.pi)
    axes = [T[k, :3, :3] @ joint.T_joint_link[:3, :3].T @ joint.axis for k, joint in ((i, one), (j, other))]
    return float(np.arcsin(min(1.0, float(np.linalg.norm(np.cross(D @ axes[0], axes[1]))))))
