"""From a URDF to a tree of bodies with nominal parameters."""

from typing import TYPE_CHECKING

import lazy_loader  # type: ignore[import-untyped]

if TYPE_CHECKING:
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

__getattr__, __dir__, _ = lazy_loader.attach(  # the process that reads meshes and models needs no torch
    __name__,
    submod_attrs={
        "robot": [
            "Payload",
            "Robot",
            "load_robot",
            "mirror_pairs",
            "payload_parameters",
            "require_payloads",
            "with_payload",
        ],
        "shapes": ["CollisionShapes", "Extent", "RollingShape", "body_extents"],
        "tree": ["Loop"],
    },
)
