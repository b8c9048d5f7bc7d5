"""Contacts, sensor sets, and the projection that removes unmeasured forces."""

from torchid.sensing.contacts import Contact, check_contacts
from torchid.sensing.projection import ProjectedGroup, Projection
from torchid.sensing.sensors import SensorNoise, SensorSet, chosen_sensors, named_sensors, with_ft_sensors
from torchid.wrenches import COMPONENTS

__all__ = [
    "COMPONENTS",
    "Contact",
    "ProjectedGroup",
    "Projection",
    "SensorNoise",
    "SensorSet",
    "check_contacts",
    "chosen_sensors",
    "named_sensors",
    "with_ft_sensors",
]
