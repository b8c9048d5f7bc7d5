"""Nodes of the tree that the dynamics run over: one for each body, and five more for every weld that is measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchid.parameters import Array
from torchid.robot import Robot


@dataclass(frozen=True)
class Node:
    """A frame that a joint moves.

    `kind`: "base", "revolute", "prismatic", "welded" (the body beyond a force/torque sensor) or "massless" (a node
    before it). `body`: of the robot; None if massless. `motion`, (n + 6 F,), and `offset`: the joint's position from
    the robot's degrees of freedom. Poses as in `JointGeometry`.
    """

    kind: str
    body: int | None
    parent: int
    axis: Array
    slides: bool
    T_parent_joint: Array
    T_joint_link: Array
    motion: Array
    offset: float


def nodes_of(robot: Robot) -> list[Node]:
    """All nodes, depth first."""
    geometry, (matrix, constant) = robot.geometry, robot.joint_map
    dofs, nodes, node_of = np.eye(robot.dofs), list[Node](), list[int]()
    for index, body in enumerate(robot.bodies):
        parent = node_of[body.parent] if index else -1
        T_parent_joint, T_joint_link = geometry.T_parent_joint[index], geometry.T_joint_link[index]
        if body.joint is not None and geometry.welded[index]:
            first = robot.dof_names.index(f"{body.joint.name}.fx")
            sign = geometry.axis[index, 2]
            for k in range(6):
                last = k == 5
                nodes.append(
                    Node(
                        kind="welded" if last else "massless",
                        body=index if last else None,
                        parent=len(nodes) - 1 if k else parent,
                        axis=sign * np.eye(3)[k % 3],
                        slides=k < 3,
                        T_parent_joint=np.eye(4) if k else T_parent_joint,
                        T_joint_link=T_joint_link if last else np.eye(4),
                        motion=dofs[first + k],
                        offset=0.0,
                    )
                )
        else:
            slides = bool(geometry.prismatic[index])
            kind = "base" if not index else "prismatic" if slides else "revolute"
            motion = np.pad(matrix[index - 1], (0, robot.dofs - robot.n)) if index else np.zeros(robot.dofs)
            offset = float(constant[index - 1]) if index else 0.0
            axis = geometry.axis[index]
            nodes.append(Node(kind, index, parent, axis, slides, T_parent_joint, T_joint_link, motion, offset))
        node_of.append(len(nodes) - 1)
    return nodes
