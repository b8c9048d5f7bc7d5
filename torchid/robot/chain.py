"""The chain of pytorch-kinematics, for poses of all links; the only module that imports it, which takes a while."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pytorch_kinematics as pk
import torch
from pytorch_kinematics.frame import Frame, Joint, Link

from torchid.parameters import Array
from torchid.robot.tree import BodyJoint, JointGeometry

_MOVED = " (moved by its joint)"  # the frame a joint moves; the body's link frame may be offset from it


def build_chain(
    names: Sequence[str],
    joints: Sequence[BodyJoint | None],
    links: Mapping[str, tuple[int, Array]],
    geometry: JointGeometry,
) -> pk.Chain:
    """Chain with a frame for every URDF link, by the link's name, beneath the joint frame of its body.

    The chain's root is the base link. Every moving joint is a parameter of the chain, mimic joints too.

    Args:
        names: of the bodies, parents first.
        joints: that move them, None for the base.
        links: body of each link, and the link's pose in it, (4, 4).
        geometry: of the joints.
    """
    moved: list[Frame] = []
    for name, joint, T_parent_joint in zip(names, joints, geometry.T_parent_joint, strict=True):
        if joint is None:
            motion = Joint(f"{name} (base)", dtype=torch.float64)
        else:
            axis = torch.tensor(joint.axis)
            motion = Joint(joint.name, _transform(T_parent_joint), joint.kind, axis, dtype=torch.float64)
        frame = Frame(name + _MOVED, Link(name + _MOVED), motion)
        moved.append(frame)
        if joint is not None:
            moved[joint.parent].add_child(frame)
    for name, (body, T_body_link) in links.items():
        offset = _transform(geometry.T_joint_link[body] @ T_body_link)
        moved[body].add_child(Frame(name, Link(name), Joint(f"{name} (weld)", offset, dtype=torch.float64)))
    return pk.Chain(moved[0], dtype=torch.float64)


def link_poses(chain: pk.Chain, positions: torch.Tensor) -> dict[str, torch.Tensor]:
    """Poses `T_base_link`, (B, 4, 4) [m], of every URDF link for joint positions by the chain's order, (B, n_all)."""
    transforms = chain.forward_kinematics(positions)
    return {name: T.get_matrix() for name, T in transforms.items() if not name.endswith(_MOVED)}


def _transform(T: Array) -> pk.Transform3d:
    return pk.Transform3d(matrix=torch.tensor(T, dtype=torch.float64), dtype=torch.float64)
