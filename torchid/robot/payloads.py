"""Known loads that a robot carries while a log is recorded, as inertial parameters of its bodies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from torchid import parameters
from torchid.errors import ConfigError
from torchid.parameters import Array
from torchid.robot.robot import Robot
from torchid.settings import STRICT, Name, Number, Positive

INERTIA_ACCEPTED = "ixx, ixy, ixz, iyy, iyz, izz [kg m^2] about the payload's centre of mass, of a body that can be"


@dataclass(config=STRICT, frozen=True)
class Payload:
    """A load that is fixed to a link.

    Attributes:
        link: of the URDF.
        mass: [kg].
        center_of_mass: (3,) in the link's frame [m].
        inertia: Ixx, Ixy, Ixz, Iyy, Iyz, Izz about the load's centre of mass, along the link's axes [kg m^2]; a point
            mass by default.
    """

    link: Name
    mass: Positive
    center_of_mass: Annotated[tuple[Number, ...], Field(min_length=3, max_length=3)]
    inertia: Annotated[tuple[Number, ...], Field(min_length=6, max_length=6)] = (0.0,) * 6

    @property
    def about_center(self) -> Array:
        """Inertial parameters (10,) about the centre of mass, along the link's axes."""
        return np.array([self.mass, 0.0, 0.0, 0.0, *self.inertia])

    @property
    def inertial(self) -> Array:
        """Inertial parameters (10,) in the link's frame."""
        inertia = parameters.inertia_matrix(self.about_center)
        return parameters.inertial_vector(self.mass, np.array(self.center_of_mass), inertia)


def payload_parameters(robot: Robot, payloads: Sequence[Payload], recording: str = "") -> Array:
    """What payloads add to the robot's parameters, (12 L,), each body's in its link frame.

    Args:
        robot: that carries them.
        payloads: loads.
        recording: in which it does, for errors.

    Raises:
        UnknownNameError: the URDF has no such link.
        ConfigError: an inertia that no body has, or a link of a body that has none of its own.
    """
    of = f" of {recording}" if recording else ""
    added = np.zeros_like(robot.nominal)
    for payload in payloads:
        body, T_body_link = robot.link(payload.link, f"payload.link{of}")
        if parameters.consistency_margin(payload.about_center) < parameters.POSSIBLE_MARGIN:
            found = f"{list(payload.inertia)}, which no body has"
            raise ConfigError.at_field(f"payload.inertia{of}", found, INERTIA_ACCEPTED)
        if robot.bodies[body].massless:
            found = f"'{payload.link}', of a body without mass in the {robot.format}"
            raise ConfigError.at_field(
                f"payload.link{of}", found, "a link of a body with mass, or an <inertial> for it"
            )
        added[body, parameters.INERTIAL] += parameters.change_of_frame(T_body_link) @ payload.inertial
    return added.flatten()


def require_payloads(robot: Robot, payloads: Mapping[str, Sequence[Payload]]) -> None:
    """Refuse payloads, by recording, that a robot cannot carry, as `payload_parameters`."""
    for recording, of_recording in payloads.items():
        payload_parameters(robot, of_recording, recording)


def with_payload(robot: Robot, added: Array | None) -> Robot:
    """The robot with the nominal parameters that it has with payloads, which add (12 L,) to its own; None for none."""
    return robot if added is None else replace(robot, nominal=robot.nominal + added.reshape(robot.nominal.shape))
