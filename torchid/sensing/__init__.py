"""Contacts, sensor sets, and the projection that removes unmeasured forces."""

from torchid.sensing.projection import ProjectedGroup, Projection
from torchid.sensing.sensors import (
    Contact,
    SensorNoise,
    SensorSet,
    chosen_sensors,
    named_sensors,
    validate_contacts,
    with_ft_sensors,
)

__all__ = [
    "Contact",
    "ProjectedGroup",
    "Projection",
    "SensorNoise",
    "SensorSet",
    "chosen_sensors",
    "named_sensors",
    "validate_contacts",
    "with_ft_sensors",
]
