"""Contacts of an experiment file, with the radii on which they roll and where these are stated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from torchid.config import AnalyzeConfig, ExperimentConfig
from torchid.config.sensors import ChoiceConfig, ContactConfig
from torchid.errors import ConfigError, SensorError, format_count
from torchid.problem.floor_pose import FEWEST_POINTS, points_of
from torchid.problem.standing import FEET
from torchid.robot import CollisionShapes, Robot, RollingShape
from torchid.sensing import Contact, validate_contacts
from torchid.sensing.sensors import NORMAL_FORCE, UP, join_numbers


def resolve_contacts(settings: Sequence[ContactConfig], robot: Robot) -> tuple[tuple[Contact, ...], str]:
    """The contacts of a robot, and which of them roll on what, "" if none does.

    Raises:
        UnknownNameError: a frame that the URDF does not have.
        SensorError: a frame named twice.
        ConfigError: a radius of a flat contact, a normal of no length.
        UrdfError: a collision shape that is not described by numbers.
    """
    contacts = validate_contacts(robot, [Contact(c.frame, c.type, c.line_axis) for c in settings])
    out: list[Contact] = []
    sources: list[str] = []
    shapes: CollisionShapes | None = None
    for index, (contact, given) in enumerate(zip(contacts, settings, strict=True)):
        x, y, z = UP if given.normal is None else given.normal
        try:
            contact = replace(contact, normal=(x, y, z), radius=0.0 if given.radius == "auto" else given.radius)
        except SensorError as error:
            raise ConfigError.at_field(f"contacts[{index}].{error.field}", error.found, error.accepted) from error
        source = f"contacts[{index}].radius"
        if given.radius == "auto" and contact.kind != "flat":
            shapes = shapes or CollisionShapes(robot)
            shape = _rolling_shape(shapes, contact)
            if shape is not None:
                contact = replace(contact, radius=shape.radius)
                source = f"collision {shape.kind}" + (f" of {shape.link}" if shape.link != contact.frame else "")
        out.append(contact)
        sources.append(source)
    return tuple(out), _describe(out, sources)


def with_scalar_sensors(contacts: Sequence[Contact], sensors: ChoiceConfig) -> tuple[Contact, ...]:
    """The contacts, those with a scalar sensor (`fn`) read along the ground's normal."""
    scalar = {frame for frame, names in sensors.contact_wrenches.items() if NORMAL_FORCE in names}
    return tuple(replace(x, along_normal=True) if x.frame in scalar else x for x in contacts)


def suited_to_preprocessing(
    contacts: tuple[Contact, ...], config: ExperimentConfig | AnalyzeConfig, robot: Robot
) -> tuple[Contact, ...]:
    """The contacts, after making sure that flags and a base's motion can follow from them where settings want that.

    Raises:
        ConfigError: a fixed base, closed loops, feet that are too few even if all stand, normals of several floors, or
            thresholds of detection that contradict each other.
    """
    settings = config.preprocessing
    for key in ("detect_contacts", "base_motion"):
        if getattr(settings, key) is not None and config.robot.fixed_base:
            accepted = "null, or a base that floats"
            raise ConfigError.at_field(f"preprocessing.{key}", "set, though robot.fixed_base is true", accepted)
    for key in ("detect_contacts", "contact_threshold"):
        if getattr(settings, key) is not None and not contacts:
            raise ConfigError.at_field(f"preprocessing.{key}", "set, without contacts", "contacts to detect")
    if settings.zero_in_air and not contacts:
        raise ConfigError.at_field("preprocessing.zero_in_air", "true, without contacts", "false, or contacts")
    if settings.detect_contacts is not None:
        if robot.loops:
            found = f"set, for a robot with {format_count(len(robot.loops), 'closed loop')}"
            raise ConfigError.at_field("preprocessing.detect_contacts", found, "contact_threshold, or recorded flags")
        touch, lift = settings.detect_contacts.touch, settings.detect_contacts.lift
        if lift > touch:
            found, accepted = f"{lift:g}, above touch ({touch:g})", "a share of the weight up to that of touch"
            raise ConfigError.at_field("preprocessing.detect_contacts.lift", found, accepted)
    if settings.base_motion is not None:
        _require_floor(contacts)
    return contacts


def _require_floor(contacts: tuple[Contact, ...]) -> None:
    """Refuse contacts that do not say how a base stands above one floor, even if all stand."""
    if sum(map(points_of, contacts)) < FEWEST_POINTS:
        found = f"contacts, but the experiment has {', '.join(f'{c.kind} {c.frame}' for c in contacts) or 'none'}"
        raise ConfigError.at_field("preprocessing.base_motion", found, f"{FEET} among the contacts")
    for index, contact in enumerate(contacts):
        if not np.allclose(contact.normal, contacts[0].normal, rtol=0.0, atol=1e-9):
            found = f"{join_numbers(contact.normal)}, but contacts[0] has {join_numbers(contacts[0].normal)}"
            accepted = "one floor for all contacts, or preprocessing.base_motion: null"
            raise ConfigError.at_field(f"contacts[{index}].normal", found, accepted)


def _rolling_shape(shapes: CollisionShapes, contact: Contact) -> RollingShape | None:
    """The collision sphere of a point, or cylinder of a line, on which the URDF lets a contact roll; None without."""
    if contact.kind == "flat":
        return None
    return shapes.about(contact.frame, contact.line_axis if contact.kind == "line" else None)


def _describe(contacts: Sequence[Contact], sources: Sequence[str]) -> str:
    """The contacts that roll by radius and normal, with where the radius is stated."""
    frames: dict[str, list[str]] = {}
    for contact, source in zip(contacts, sources, strict=True):
        if contact.radius:
            tilted = "" if contact.normal == UP else f", normal {join_numbers(contact.normal)}"
            text = f"{contact.radius:g} m ({source.partition('[')[0]}{tilted})"
            frames.setdefault(text, []).append(contact.frame)
    return "; ".join(f"{', '.join(names)}: radius {text}" for text, names in frames.items())
