"""From a URDF to a tree of bodies with nominal parameters."""

from torchid.robot.constraints import Loop
from torchid.robot.payloads import Payload, payload_parameters, require_payloads, with_payload
from torchid.robot.robot import Body, Robot, load_robot
from torchid.robot.shapes import CollisionShapes, Extent, RollingShape, body_extents
from torchid.robot.symmetry import MirrorPair, mirror_pairs

__all__ = [
    "Body",
    "CollisionShapes",
    "Extent",
    "Loop",
    "MirrorPair",
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
