"""Which components of the contacts' wrenches are measured, and which must have been recorded for it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchid.sensing.contacts import Contact
from torchid.sensing.sensors import SensorSet


def read_components(contacts: Sequence[Contact], sensors: SensorSet, in_world: bool) -> np.ndarray:
    """Recorded components (C, 6) that the measured ones are computed from: along world axes, whole vectors."""
    measured = measured_components(contacts, sensors)
    if not in_world:
        return measured
    whole = measured.reshape(-1, 2, 3).any(axis=2)
    return np.repeat(whole, 3, axis=1)


def measured_components(contacts: Sequence[Contact], sensors: SensorSet) -> np.ndarray:
    """Measured components (C, 6) that the contacts can exert, along the frames' axes."""
    possible = np.zeros((len(contacts), 6), dtype=bool)
    for index, contact in enumerate(contacts):
        possible[index, list(contact.components)] = True
    return possible & sensors.wrench
