"""The kinematic chain, built from pytorch-kinematics objects in float64 (the only module that imports it).

Its own URDF reader takes origins in float32 and refuses files for tags that carry no kinematics, so the frames are
made here from a `BodyTree`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytorch_kinematics as pk
import torch
from pytorch_kinematics.frame import Frame, Joint, Link

from torchid.parameters import Array
from torchid.robot.tree import BodyTree

_MOVED = " (moved by its joint)"  # the frame a joint moves; the body's link frame may be offset from it


@dataclass(frozen=True)
class JointGeometry:
    """Where joint frames sit, one row per body of the chain; the base's row is the identity.

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
            motion = Joint(f"{name} (base)", dtype=torch.float64)
        else:
            T_parent_joint = _link_in_joint_frame(tree, joint.parent) @ joint.T_parent_joint
            motion = Joint(
                joint.name, _transform(T_parent_joint), joint.kind, torch.tensor(joint.axis), dtype=torch.float64
            )
        frame = Frame(name + _MOVED, Link(name + _MOVED), motion)
        moved.append(frame)
        if joint is not None:
            moved[joint.parent].add_child(frame)
    for name, (body, T_body_link) in tree.links.items():
        weld = Joint(f"{name} (weld)", _transform(_link_in_joint_frame(tree, body) @ T_body_link), dtype=torch.float64)
        moved[body].add_child(Frame(name, Link(name), weld))
    return pk.Chain(moved[0], dtype=torch.float64)


def joint_geometry(chain: pk.Chain, body_names: tuple[str, ...]) -> JointGeometry:
    """Read back from a chain what the regressor needs."""
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
