"""Contacts: where the environment can push, and which components of the wrench it can exert there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torchid.errors import SensorError
from torchid.robot import Robot
from torchid.wrenches import COMPONENTS

_FORCES, _MOMENTS = (0, 1, 2), (3, 4, 5)
CONTACT_TYPES = ("point", "line", "flat")


@dataclass(frozen=True)
class Contact:
    """A contact at a URDF frame.

    `kind`: "point" exerts three force components; "flat" all six; "line" all but the moment about the line, which runs
    along the frame's `line_axis`.
    """

    frame: str
    kind: str
    line_axis: str = "y"

    def __post_init__(self) -> None:
        """Refuse what is no contact.

        Raises:
            SensorError: an unknown kind or line axis.
        """
        if self.kind not in CONTACT_TYPES:
            raise SensorError(f"contact '{self.frame}'", "type", f"'{self.kind}'", ", ".join(CONTACT_TYPES))
        if self.line_axis not in ("x", "y", "z"):
            raise SensorError(f"contact '{self.frame}'", "line_axis", f"'{self.line_axis}'", "x, y, z")

    @property
    def components(self) -> tuple[int, ...]:
        """Places in `COMPONENTS` that can differ from zero."""
        if self.kind == "point":
            return _FORCES
        if self.kind == "flat":
            return _FORCES + _MOMENTS
        return _FORCES + tuple(m for m in _MOMENTS if m != _MOMENTS["xyz".index(self.line_axis)])

    @property
    def component_names(self) -> tuple[str, ...]:
        """Names of `components`."""
        return tuple(COMPONENTS[k] for k in self.components)


def check_contacts(robot: Robot, contacts: Sequence[Contact], source: object = "contacts") -> tuple[Contact, ...]:
    """The contacts, after making sure that the robot has their frames.

    Raises:
        UnknownNameError: a frame that the URDF does not have.
        SensorError: a frame named twice.
    """
    seen: set[str] = set()
    for index, contact in enumerate(contacts):
        field = f"contacts[{index}]"
        robot.link(contact.frame, f"{field}.frame", source)
        if contact.frame in seen:
            raise SensorError(source, f"{field}.frame", f"'{contact.frame}' named twice", "each frame once")
        seen.add(contact.frame)
    return tuple(contacts)
