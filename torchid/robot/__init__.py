"""From a URDF to a tree of bodies with nominal parameters."""

from torchid.robot.robot import (
    Payload,
    Robot,
    load_robot,
    mirror_pairs,
    payload_parameters,
    require_payloads,
    with_payload,
)
from torchid.robot.shapes import CollisionShapes, Extent, RollingShape, body_extents
from torchid.robot.tree import Loop

__all__ = [
    "CollisionShapes",
    "Extent",
    "Loop",
    "Payload",
    "Robot",
    "RollingShape",
    "body_extents",
    "load_robot",
    "mirror_pairs",
    "payload_parameters",
    "require_payloads",
    "with_payload",
]
