"""From URDF links and joints to a tree of bodies: its parameters and chain, and what constrains its joints."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_kinematics as pk
import torch
from pytorch_kinematics.frame import Frame
from pytorch_kinematics.frame import Joint as FrameJoint
from pytorch_kinematics.frame import Link as FrameLink
from scipy.spatial.transform import Rotation
from yourdfpy.urdf import Inertial, Link

from torchid import parameters
from torchid.errors import ConfigError, UnknownNameError, UnphysicalInertiaWarning, UrdfError, join_names, warn
from torchid.guards import MAX_NUMBER
from torchid.parameters import Array
from torchid.robot.urdf import MOVING_TYPES, TreeJoint, parse_xml, position_limits
from torchid.robot.xml_files import OWN

FT_FIELD = "force/torque sensor at a fixed joint"

_TRIANGLE_TOLERANCE = 1e-3  # URDFs carry few digits: thin plates violate the inequality by rounding alone
_INERTIA_ROUNDING = 1e-6  # of the largest principal inertia
_DUMMY = 1e-4  # share of the robot's mass, and of the largest element of an inertia in it, that a dummy link is below
_POINT = 1e-12  # [m^2]: below it the link is a point mass
_MOVED = " (moved by its joint)"  # the frame a joint moves; the body's link frame may be offset from it


@dataclass(frozen=True)
class Mimic:
    """Position = multiplier * (position of the independent joint `master`) + offset [rad or m]."""

    master: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class BodyJoint:
    """The joint that moves a body; of kind "fixed", the weld through a force/torque sensor.

    `T_parent_joint`, (4, 4), is the pose of the joint frame at position 0 in the parent body's link frame; the joint
    moves that frame about or along `axis`, (3,), a unit vector in it; it has no end stops if `continuous`.
    `T_joint_link`, (4, 4), is the pose of the body's link frame in the moved joint frame: the identity unless
    `base_link` reverses the joint, or the body of an MJCF file has its joint off its origin. Of such files come
    `armature` [kg m^2 or kg], and a spring of `stiffness` [N m/rad or N/m] that is at rest at a position [rad or m].
    The axis of a weld is z, or -z where the joint is reversed, so that the sensor reads the opposite wrench.
    """

    name: str
    kind: str
    parent: int
    axis: Array
    T_parent_joint: Array
    T_joint_link: Array
    mimic: Mimic | None
    damping: float
    friction: float
    armature: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    continuous: bool = False


@dataclass
class BodyTree:
    """Bodies in depth-first order; `links[name]` is the body that carries a URDF link and the link's pose in it."""

    names: list[str]
    joints: list[BodyJoint | None]
    links: dict[str, tuple[int, Array]]


def build_tree(
    path: Path, links: list[Link], joints: list[TreeJoint], base_link: str | None, ft_joints: Sequence[str] = ()
) -> BodyTree:
    """Depth-first tree of bodies from `base_link` (the URDF's root if None); `ft_joints` are not lumped.

    Raises:
        UnknownNameError: `base_link` names no link, or one of `ft_joints` no fixed joint.
        UrdfError: the joints do not form one tree, or a mimic chain closes on itself.
    """
    root = _find_root(path, links, joints)
    if base_link is None:
        base_link = root
    names = [link.name for link in links]
    if base_link not in names:
        raise UnknownNameError(path, "robot.base_link", base_link, names)
    _check_welds(path, names, joints, ft_joints)
    mimics = resolve_mimics(path, joints)
    locked = {name for name, mimic in mimics.items() if not mimic.master}
    neighbours: dict[str, list[tuple[TreeJoint, bool]]] = {name: [] for name in names}
    for edge in joints:  # children before parents, each in the URDF's order
        neighbours[edge.parent].append((edge, False))
    for edge in joints:
        neighbours[edge.child].append((edge, True))

    tree = BodyTree([], [], {})
    stack: list[tuple[str, TreeJoint | None, bool]] = [(base_link, None, False)]
    while stack:
        name, joint, reverse = stack.pop()
        if joint is None:
            _start_body(tree, name, None)
        elif joint.name in ft_joints or (joint.type in MOVING_TYPES and joint.name not in locked):
            _start_body(tree, name, _body_joint(tree, joint, reverse, mimics.get(joint.name)))
        else:
            parent = joint.child if reverse else joint.parent
            body, T_body_parent = tree.links[parent]
            tree.links[name] = (body, T_body_parent @ _locked_pose(joint, reverse, mimics))
        next_joints = [
            (other.parent if backwards else other.child, other, backwards)
            for other, backwards in neighbours[name]
            if other is not joint
        ]
        stack.extend(reversed(next_joints))
    return tree


def _check_welds(path: Path, links: Sequence[str], joints: Sequence[TreeJoint], ft_joints: Sequence[str]) -> None:
    kinds = {joint.name: joint.type for joint in joints}
    welds = [name for name, kind in kinds.items() if kind not in MOVING_TYPES]
    for name in ft_joints:
        if name not in welds:
            what = "a link" if name in links else ""
            if name in kinds:
                what = f"a {kinds[name]} joint"
            raise UnknownNameError(path, FT_FIELD, name, welds, what and f"{what}, not a fixed joint")


def _find_root(path: Path, links: list[Link], joints: list[TreeJoint]) -> str:
    parent: dict[str, str] = {}
    for joint in joints:
        if joint.child in parent:
            reason = f"two joints have this child, one is '{joint.name}'"
            raise UrdfError(path, f"link '{joint.child}'", reason, "one parent per link: a tree without loops")
        parent[joint.child] = joint.parent
    roots = [link.name for link in links if link.name not in parent]
    reached = set(roots[:1])
    queue = list(roots[:1])
    children: dict[str, list[str]] = {}
    for child, parent_name in parent.items():
        children.setdefault(parent_name, []).append(child)
    while queue:
        for child in children.get(queue.pop(), []):
            reached.add(child)
            queue.append(child)
    if len(roots) > 1:
        raise UrdfError(path, "tree", f"several root links: {', '.join(roots[:4])}", "one link without a parent joint")
    if len(reached) < len(links):
        unreached = next(link.name for link in links if link.name not in reached)
        raise UrdfError(path, f"link '{unreached}'", "part of a loop of joints", "a tree without loops")
    return roots[0]


def resolve_mimics(path: Path, joints: Sequence[TreeJoint]) -> dict[str, Mimic]:
    """Mimic relations of moving joints; a chain of them is composed into one relation to its independent joint."""
    by_name = {joint.name: joint for joint in joints}
    resolved = {}
    for joint in joints:
        if joint.mimic is None or joint.type not in MOVING_TYPES:
            continue
        multiplier = 1.0
        offset = 0.0
        master = joint
        visited = {joint.name}
        while master.mimic is not None and master.type in MOVING_TYPES:
            offset += multiplier * master.mimic.offset
            multiplier *= master.mimic.multiplier
            master = by_name[master.mimic.joint]
            if master.name in visited:
                raise UrdfError(path, f"joint '{joint.name}', <mimic>", "mimic joints form a loop", "a free master")
            visited.add(master.name)
        _check_mimic_size(path, joint.name, multiplier, offset)
        if master.type not in MOVING_TYPES:
            reason = f"its mimic master '{master.name}' is fixed, so this joint is fixed too"
            warn(f"{path}: joint '{joint.name}': {reason}")
        resolved[joint.name] = Mimic(master.name if master.type in MOVING_TYPES else "", multiplier, offset)
    return resolved


def _check_mimic_size(path: Path, joint: str, multiplier: float, offset: float) -> None:
    """Bound the product of a chain's ratios; `read_urdf` bounds each of them."""
    if not max(abs(multiplier), abs(offset)) <= MAX_NUMBER:
        reason = f"multiplier {multiplier:g} and offset {offset:g} along its chain"
        raise UrdfError(path, f"joint '{joint}', <mimic>", reason, f"at most {MAX_NUMBER:g}")


def _start_body(tree: BodyTree, name: str, joint: BodyJoint | None) -> None:
    tree.links[name] = (len(tree.names), np.eye(4))
    tree.names.append(name)
    tree.joints.append(joint)


def joint_origin(joint: TreeJoint) -> Array:
    """Pose of a joint's frame in its parent link's, (4, 4) [m]."""
    return np.eye(4) if joint.origin is None else np.asarray(joint.origin, dtype=np.float64)


def _child_offset(joint: TreeJoint) -> Array:
    """Pose of a joint's child link in the moved joint frame, (4, 4) [m]."""
    T = np.eye(4)
    T[:3, 3] = joint.child_offset
    return T


def _inverse(T: Array) -> Array:
    return np.asarray(np.linalg.inv(T), dtype=np.float64)


def _body_joint(tree: BodyTree, joint: TreeJoint, reverse: bool, mimic: Mimic | None) -> BodyJoint:
    """The joint as seen from the base: if reversed, its frame is at the child link and its axis changes sign."""
    body, T_body_near = tree.links[joint.child if reverse else joint.parent]
    weld = joint.type not in MOVING_TYPES
    axis = np.array([0.0, 0.0, 1.0]) if weld else joint.axis / np.linalg.norm(joint.axis)
    return BodyJoint(
        name=joint.name,
        kind="fixed" if weld else "prismatic" if joint.type == "prismatic" else "revolute",
        parent=body,
        axis=-axis if reverse else axis,
        T_parent_joint=T_body_near @ (_inverse(_child_offset(joint)) if reverse else joint_origin(joint)),
        T_joint_link=_inverse(joint_origin(joint)) if reverse else _child_offset(joint),
        mimic=mimic,
        damping=joint.dynamics.damping if joint.dynamics else 0.0,
        friction=joint.dynamics.friction if joint.dynamics else 0.0,
        armature=joint.armature,
        stiffness=joint.stiffness,
        rest=joint.rest,
        continuous=joint.type == "continuous",
    )


def _locked_pose(joint: TreeJoint, reverse: bool, mimics: dict[str, Mimic]) -> Array:
    """Pose of the next link in the previous one, seen from the base, across a joint that does not move."""
    T_parent_child = joint_origin(joint)
    if joint.name in mimics:
        T_parent_child = T_parent_child @ joint_transform(joint, mimics[joint.name].offset)
    T_parent_child = T_parent_child @ _child_offset(joint)
    return _inverse(T_parent_child) if reverse else T_parent_child


def joint_transform(joint: TreeJoint, position: float) -> Array:
    """Pose of the child link in a joint's frame at a position [rad or m], (4, 4)."""
    axis = joint.axis / np.linalg.norm(joint.axis)
    T = np.eye(4)
    if joint.type == "prismatic":
        T[:3, 3] = position * axis
    else:
        T[:3, :3] = Rotation.from_rotvec(position * axis).as_matrix()
    return T


def spread_mass(path: Path, links: Sequence[Link], joints: Sequence[TreeJoint], total: float) -> None:
    """Make the root and each link that a joint moves equal balls of water that weigh so much together [kg].

    The centre of each is the mean of the origins of its link and of the joints on it. Raises UrdfError: no mass.
    """
    if not 0.0 < total < np.inf:
        raise UrdfError(path, "total_mass", f"{total:g} kg", "a number greater than 0")
    welded = {joint.child for joint in joints if joint.type == "fixed"}
    heavy = [link for link in links if link.name not in welded]
    mass = total / len(heavy)
    inertia = 0.4 * mass * (mass / (1000.0 * 4.0 / 3.0 * np.pi)) ** (2.0 / 3.0) * np.eye(3)
    for link in heavy:
        places = [np.zeros(3), *(joint_origin(joint)[:3, 3] for joint in joints if joint.parent == link.name)]
        T_link_ball = np.eye(4)
        T_link_ball[:3, 3] = np.mean(places, axis=0)
        link.inertial = Inertial(T_link_ball, mass, inertia)
    warn(f"{path}: no link has mass; {len(heavy)} links share {total:g} kg equally, as balls of water")


def nominal_parameters(path: Path, tree: BodyTree, links: dict[str, Link]) -> Array:
    """Parameters (L, 12) of the bodies, each in its link frame.

    Warns:
        UnphysicalInertiaWarning: inertias of links that belong to no distribution of positive mass, in one line; not
            of dummy links, see `_DUMMY`.
    """
    nominal = np.zeros((len(tree.names), parameters.PER_BODY))
    unphysical = dict[str, str]()
    inertials = {name: links[name].inertial for name in tree.links if links[name].inertial is not None}
    least_mass = _DUMMY * sum(x.mass for x in inertials.values())
    least_inertia = _DUMMY * max((np.abs(x.inertia).max() for x in inertials.values()), default=0.0)
    for name, inertial in inertials.items():
        counts = inertial.mass >= least_mass or np.abs(inertial.inertia).max() >= least_inertia
        if counts and (what := _unphysical(inertial)):
            unphysical[name] = what
        body, T_body_link = tree.links[name]
        nominal[body, parameters.INERTIAL] += link_parameters(links[name], T_body_link)
    for body, joint in enumerate(tree.joints):
        if joint is not None:
            nominal[body, parameters.FRICTION] = joint.friction, joint.damping
    for name, what in list(unphysical.items())[:1]:
        others = join_names([other for other in unphysical if other != name])
        what += f"; also physically inconsistent: {others}" if others else ""
        warn(f"{path}: link '{name}': {what}; it is used as it is", UnphysicalInertiaWarning)
    return nominal


def link_parameters(link: Link, T_body_link: Array) -> Array:
    """Inertial parameters (10,) of a link in the frame of its body."""
    inertial = link.inertial
    if inertial is None:
        return np.zeros(parameters.INERTIAL.stop)
    T_link_com = np.eye(4) if inertial.origin is None else inertial.origin
    at_com = parameters.inertial_vector(inertial.mass, np.zeros(3), inertial.inertia)
    return parameters.change_of_frame(T_body_link @ T_link_com) @ at_com


def _unphysical(inertial: Inertial) -> str:
    """Why no distribution of positive mass has an inertia; "" if one has."""
    small, middle, large = np.linalg.eigvalsh(inertial.inertia)
    if large == small == inertial.mass == 0.0:
        return ""
    if inertial.mass == 0.0:
        return "the mass is 0, but the inertia is not"
    if small < -_INERTIA_ROUNDING * large - _POINT * inertial.mass:
        return f"principal inertias ({small:.3g}, {middle:.3g}, {large:.3g} kg m^2) must be positive"
    if large > (small + middle) * (1.0 + _TRIANGLE_TOLERANCE) + _POINT * inertial.mass:
        return f"the largest principal inertia ({large:.3g} kg m^2) exceeds the sum of the others, {small + middle:.3g}"
    return ""


@dataclass(frozen=True)
class JointGeometry:
    """Poses of joint frames, one row per body of the chain; the base's row is the identity.

    `T_parent_joint`, (L, 4, 4): joint frame at position 0 in the parent's joint frame [m]. `axis`, (L, 3), unit
    length. `prismatic`, `welded`, (L,) bool. `T_joint_link`, (L, 4, 4): the body's link frame in its moved joint frame.
    """

    T_parent_joint: Array
    axis: Array
    prismatic: np.ndarray
    welded: np.ndarray
    T_joint_link: Array


def build_chain(tree: BodyTree) -> pk.Chain:
    """Chain with a frame for every URDF link, by the link's name, beneath the joint frame of its body.

    The chain's root is the base link. Every moving joint is a parameter of the chain, mimic joints too.
    """
    moved: list[Frame] = []
    for name, joint in zip(tree.names, tree.joints, strict=True):
        if joint is None:
            motion = FrameJoint(f"{name} (base)", dtype=torch.float64)
        else:
            T_parent_joint = _link_in_joint_frame(tree, joint.parent) @ joint.T_parent_joint
            motion = FrameJoint(
                joint.name, _transform(T_parent_joint), joint.kind, torch.tensor(joint.axis), dtype=torch.float64
            )
        frame = Frame(name + _MOVED, FrameLink(name + _MOVED), motion)
        moved.append(frame)
        if joint is not None:
            moved[joint.parent].add_child(frame)
    for name, (body, T_body_link) in tree.links.items():
        weld = FrameJoint(
            f"{name} (weld)", _transform(_link_in_joint_frame(tree, body) @ T_body_link), dtype=torch.float64
        )
        moved[body].add_child(Frame(name, FrameLink(name), weld))
    return pk.Chain(moved[0], dtype=torch.float64)


def joint_geometry(chain: pk.Chain, body_names: tuple[str, ...]) -> JointGeometry:
    """Joint frames and axes of a chain, for the regressor."""
    moved = [chain.find_frame(name + _MOVED) for name in body_names]
    links = [chain.find_frame(name) for name in body_names]
    return JointGeometry(
        T_parent_joint=np.stack([_matrix(frame.joint.offset) for frame in moved]),
        axis=np.stack([frame.joint.axis.numpy() for frame in moved]),
        prismatic=np.array([frame.joint.joint_type == "prismatic" for frame in moved]),
        welded=np.array([frame.joint.joint_type == "fixed" for frame in moved]) & (np.arange(len(moved)) > 0),
        T_joint_link=np.stack([_matrix(frame.joint.offset) for frame in links]),
    )


def link_poses(chain: pk.Chain, positions: torch.Tensor) -> dict[str, torch.Tensor]:
    """Poses `T_base_link`, (B, 4, 4) [m], of every URDF link for joint positions by the chain's order, (B, n_all)."""
    transforms = chain.forward_kinematics(positions)
    return {name: T.get_matrix() for name, T in transforms.items() if not name.endswith(_MOVED)}


def _link_in_joint_frame(tree: BodyTree, body: int) -> Array:
    joint = tree.joints[body]
    return np.eye(4) if joint is None else joint.T_joint_link


def _transform(T: Array) -> pk.Transform3d:
    return pk.Transform3d(matrix=torch.tensor(T, dtype=torch.float64), dtype=torch.float64)


def _matrix(transform: pk.Transform3d | None) -> Array:
    return np.eye(4) if transform is None else transform.get_matrix()[0].numpy()


WELD_FIELD = "robot.weld"

_POSITION_ROUNDING = 1e-6  # [rad or m] by which a position may exceed a limit: URDFs carry few digits


def weld_positions(path: Path, joints: Sequence[TreeJoint], weld: Mapping[str, float]) -> dict[str, float]:
    """Position [rad or m] of every joint that is welded, by name, in the URDF's order.

    Args:
        path: the URDF.
        joints: its joints.
        weld: position by name or pattern of joints. Joints that mimic a welded one follow it.

    Raises:
        UnknownNameError: a name that no joint has.
        ConfigError: a pattern that matches no joint that moves, two positions for one joint, a position outside of the
            joint's limits, a mimic joint whose master moves, or no joint left that moves.
    """
    if not weld:
        return {}
    moving = {joint.name: joint for joint in joints if joint.type in MOVING_TYPES}
    stated = _stated(joints, moving, weld)
    mimics = {name: mimic for name, mimic in resolve_mimics(path, joints).items() if mimic.master}
    for name, (key, _) in stated.items():
        if name in mimics and mimics[name].master not in stated:
            reason = f"joint '{name}' follows '{mimics[name].master}', which moves"
            raise ConfigError.at_field(_field(key), reason, "also its master joint")
    limits = position_limits(path)
    for name, (key, position) in stated.items():
        low, high = limits.get(name, (-np.inf, np.inf))
        if name not in mimics and not low - _POSITION_ROUNDING <= position <= high + _POSITION_ROUNDING:
            reason = f"{position:g} is outside the limits of joint '{name}'"
            accepted = f"a position from {low:g} to {high:g}, such as weld: {{'{name}': {(low + high) / 2:.4g}}}"
            raise ConfigError.at_field(_field(key), reason, accepted)
    welded = {}
    for name in moving:
        mimic = mimics.get(name)
        if mimic is None and name in stated:
            welded[name] = stated[name][1]
        elif mimic is not None and mimic.master in stated:
            welded[name] = mimic.multiplier * stated[mimic.master][1] + mimic.offset
    if len(welded) == len(moving):
        raise ConfigError.at_field(WELD_FIELD, "fixes every joint", "patterns that leave a joint free")
    return welded


def _stated(
    joints: Sequence[TreeJoint], moving: Mapping[str, TreeJoint], weld: Mapping[str, float]
) -> dict[str, tuple[str, float]]:
    """Name or pattern and position by name of joint."""
    names = [joint.name for joint in joints]
    stated = dict[str, tuple[str, float]]()
    for key, position in weld.items():
        for name in matching_joints(WELD_FIELD, key, moving, names):
            other, before = stated.setdefault(name, (key, position))
            if before != position:
                reason = f"{position:g} for joint '{name}', but '{other}' says {before:g}"
                raise ConfigError.at_field(_field(key), reason, "one position per joint")
    return stated


def matching_joints(field: str, key: str, moving: Iterable[str], names: Iterable[str] = ()) -> list[str]:
    """Joints that a name or pattern stands for.

    Args:
        field: of the settings, for errors.
        key: the name or pattern.
        moving: joints to choose from.
        names: of all joints.

    Raises:
        UnknownNameError: a name that is none of them.
        ConfigError: a pattern that matches none.
    """
    pattern = any(sign in key for sign in "*?")
    moving = list(moving)
    matches = [name for name in moving if (fnmatchcase(name, key) if pattern else name == key)]
    if not matches and pattern:
        raise ConfigError.at_field(field, f"'{key}' matches no joint that moves", f"a pattern for {join_names(moving)}")
    if not matches:
        raise UnknownNameError.at_field(field, key, moving, "a fixed joint" if key in names else "")
    return matches


def _field(key: str) -> str:
    return f"{WELD_FIELD}.{key}"


def weld_joints(joints: Sequence[TreeJoint], positions: Mapping[str, float]) -> list[TreeJoint]:
    """The joints, those with a position fixed there."""

    def welded(joint: TreeJoint) -> TreeJoint:
        origin = joint_origin(joint) @ joint_transform(joint, positions[joint.name])
        changes: dict[str, Any] = {"type": "fixed", "mimic": None, "origin": origin}
        return replace(joint, **changes)

    return [welded(joint) if joint.name in positions else joint for joint in joints]


def links_beyond(
    joints: Sequence[TreeJoint], welded: Iterable[str], body_of: Mapping[str, int], heads: Sequence[str]
) -> list[str]:
    """Links that a welded joint separates from the link that gives their body its name.

    Args:
        joints: of the URDF.
        welded: names of those that are welded.
        body_of: number of the body of each link.
        heads: names of the bodies.
    """
    welded = set(welded)
    near = dict[str, list[str]]()
    reached = set(heads)
    for joint in joints:
        if joint.name not in welded and body_of[joint.parent] == body_of[joint.child]:
            near.setdefault(joint.parent, []).append(joint.child)
            near.setdefault(joint.child, []).append(joint.parent)
    queue = list(heads)
    while queue:
        new = [name for name in near.get(queue.pop(), []) if name not in reached]
        reached.update(new)
        queue += new
    return [name for name in body_of if name not in reached]


LOOPS_FIELD = "robot.loops"
PASSIVE_FIELD = "robot.passive"
MAX_GAP = 0.005
MAX_ANGLE = 0.05
"""Rms distance [m] and angle [rad] over a log up to which a loop counts as closed, unless it states its own."""


@dataclass(frozen=True)
class Loop:
    """A loop closure (a cut joint): two frames of the robot that coincide.

    `frames`: names of links. `kind`: "point" keeps their origins together (a ball joint, MuJoCo's `connect`), "weld"
    their axes too. What it exerts acts on both bodies, equal and opposite, and is not measured. `max_gap` [m] and
    `max_angle` [rad]: rms over a log by which they may be apart.
    """

    frames: tuple[str, str]
    kind: str = "point"
    max_gap: float = MAX_GAP
    max_angle: float = MAX_ANGLE

    @property
    def components(self) -> tuple[int, ...]:
        """Indices in `WRENCH_COMPONENTS` of what it can exert."""
        return tuple(range(3 if self.kind == "point" else 6))

    @property
    def label(self) -> str:
        """Both frames."""
        return f"{self.frames[0]} and {self.frames[1]}"


def loops_of_file(path: Path) -> tuple[Loop, ...]:
    """The loops that a robot's file has: `connect` and `weld` of MJCF; a URDF never says.

    Warns:
        TorchidWarning: some hold the robot to what is no part of it, as a mocap body: contacts, if they are named.
    """
    root = parse_xml(path).getroot()
    for attachment in root.findall(f"{OWN}attachment"):
        held = "attaches the robot to something else; torchid ignores this force"
        contact = (
            f"{{frame: {attachment.get('frame')}, type: {'point' if attachment.get('type') == 'point' else 'flat'}}}"
        )
        warn(f"{path}: {attachment.get('where')}: {held}. If it acted in a log, set contacts: [{contact}]")
    loops = root.findall(f"{OWN}loop")
    return tuple(Loop((str(x.get("one")), str(x.get("other"))), str(x.get("type"))) for x in loops)


def validate_loops(loops: Sequence[Loop], links: Mapping[str, tuple[int, Array]]) -> None:
    """Make sure that loops are between different bodies of a robot.

    Args:
        loops: by the number that they have in the settings.
        links: body and pose of each link.

    Raises:
        UnknownNameError: a frame that the robot does not have.
        ConfigError: two frames of one body.
    """
    for number, loop in enumerate(loops):
        field = f"{LOOPS_FIELD}[{number}].frames"
        for frame in loop.frames:
            if frame not in links:
                raise UnknownNameError.at_field(field, frame, links)
        first, second = loop.frames
        if links[first][0] == links[second][0]:
            reason = f"{first} and {second} are on the same body"
            raise ConfigError.at_field(field, reason, "frames on two bodies that move relative to each other")


def passive_joints(joints: Sequence[TreeJoint], names: Sequence[str] | None, moving: Iterable[str]) -> tuple[str, ...]:
    """Names of joints without a motor, in the order of `moving`.

    Args:
        joints: of the robot's file.
        names: names or patterns; None for those that the file says are passive.
        moving: the robot's independent joints.

    Raises:
        UnknownNameError: a name that no joint has which moves by itself.
        ConfigError: a pattern that matches none.
    """
    moving = list(moving)
    if names is None:
        chosen = {joint.name for joint in joints if joint.passive}
    else:
        chosen = {name for key in names for name in matching_joints(PASSIVE_FIELD, key, moving)}
    return tuple(name for name in moving if name in chosen)
