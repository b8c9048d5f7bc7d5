"""Loads that Pinocchio's robot carries."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from synthetic import Oracle

from torchid.parameters import INERTIA_AXES
from torchid.robot import Payload


def load_on(oracle: Oracle, payload: Payload) -> None:
    """Let Pinocchio carry a payload, by its own frame of the link."""
    frame = oracle.model.frames[oracle.model.getFrameId(payload.link, pin.FrameType.BODY)]
    entries = np.zeros((3, 3))
    for value, (row, column) in zip(payload.inertia, INERTIA_AXES, strict=True):
        entries[row, column] = entries[column, row] = value
    inertia = pin.Inertia(payload.mass, np.array(payload.center_of_mass), entries)
    oracle.model.appendBodyToJoint(frame.parentJoint, inertia, frame.placement)
