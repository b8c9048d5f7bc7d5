"""What the rows of a log were formed with, by which factors are told apart that must not be merged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from torchid.errors import LogError, join_names
from torchid.parameters import Array
from torchid.problem import RowBuilder
from torchid.problem.sampled_rows import noise_of_sensors
from torchid.reprs import short_repr
from torchid.robot import Robot
from torchid.robot.tree import BodyJoint
from torchid.rounding import KINEMATIC_TOLERANCE
from torchid.sensing import Contact
from torchid.sensing.sensors import measured_components

Value = bool | int | float | str | list[str] | None

NOISE = "sensors.noise"
"""Key of an experiment file under which noise is stated."""


@dataclass(frozen=True)
class RowModel:
    """Robot, contacts, sensors, extra parameters and preprocessing that rows were formed with.

    Attributes:
        settings: by the key of an experiment file that they come from; names of the robot's parts under "robot.urdf",
            and the number of columns.
        noise: standard deviations of the sensors by group [N m, N].
        geometry: constants of the kinematic tree and poses of contacts, in units of the URDF.
    """

    settings: dict[str, Value]
    noise: dict[str, float]
    geometry: dict[str, Array]

    __repr__ = short_repr

    @classmethod
    def of(cls, robot: Robot, builder: RowBuilder, preprocessing: Mapping[str, float | None]) -> RowModel:
        """The model of the rows of a builder.

        Nominal inertial parameters, friction to fit and all other settings of estimators are not in it: these are the
        affair of a fit, and robots of one type may differ in them.

        Args:
            robot: the robot.
            builder: of the rows.
            preprocessing: settings that samples depend on.
        """
        tree, extras = builder.tree, builder.extras
        labels = {
            kind: [f"{x.label}, {'by log' if x.per_log else 'of all logs'}" for x in extras if x.what == kind]
            for kind in ("offset", "scale")
        }
        settings: dict[str, Value] = {
            "robot.base_link": robot.base_link,
            "robot.fixed_base": robot.fixed_base,
            "robot.urdf": [f"{body.name} ({_joint_text(body.joint)})" for body in robot.bodies],
            "contacts": [_contact_text(contact) for contact in builder.contacts],
            "sensors": _channels(robot, builder),
            "sensors.offsets": labels["offset"],
            "sensors.scales": labels["scale"],
            "actuators": [x.label for x in extras if x.what not in labels],
            "actuators.sign_width": tree.sign_width,
            "columns": builder.width,
        }
        if robot.welded:  # a factor of a robot without stays what it was
            settings["robot.weld"] = [f"{name} at {position!r}" for name, position in robot.welded.items()]
        if robot.loops:
            settings["robot.loops"] = [f"{loop.kind} of {loop.label}" for loop in robot.loops]
        if robot.passive:
            settings["robot.passive"] = list(robot.passive)
        if tree.stribeck is not None:
            settings["actuators.stribeck"] = tree.stribeck
        if any(robot.base_tilt):
            settings["robot.base_tilt"] = ", ".join(map(repr, robot.base_tilt))
        for name in ("armature", "stiffness", "spring_torque"):
            if (stated := getattr(robot, name)).any():  # of an MJCF robot, taken off the right-hand side
                settings[f"robot.mjcf {name}"] = [repr(float(x)) for x in stated]
        settings |= {f"preprocessing.{name}": value for name, value in preprocessing.items()}
        geometry = {
            "T_parent_joint": tree.T_parent_joint,
            "T_joint_link": tree.T_joint_link,
            "joint_map": tree.joint_map.cpu().numpy(),
            "joint_constant": tree.joint_constant.cpu().numpy(),
            "contact_node": np.array([node for node, _ in builder.frames], dtype=float),
            "T_node_contact": np.array([pose for _, pose in builder.frames]).reshape(-1, 4, 4),
        }
        if robot.loops:
            poses = [tree.frame(robot, frame)[1] for loop in robot.loops for frame in loop.frames]
            geometry["T_node_loop"] = np.array(poses)
        return cls(settings, noise_of_sensors(builder), geometry)


def require_same_rows(path: object, found: RowModel, expected: RowModel, reference: str) -> None:
    """Refuse factors of rows that were formed with something else than others; noise is another matter.

    Args:
        path: of the factors, for the message.
        found: what they were formed with.
        expected: what they should have been formed with.
        reference: where that is stated.

    Raises:
        LogError: names the setting, its value and the accepted one.
    """
    for key in (*expected.settings, *(key for key in found.settings if key not in expected.settings)):
        one, other = found.settings.get(key), expected.settings.get(key)
        if one != other:
            raise LogError(path, key, *_texts(one, other, reference))
    if found.noise.keys() != expected.noise.keys():
        raise LogError(path, NOISE, join_names(list(found.noise)) or "none", join_names(list(expected.noise)))
    for name, array in expected.geometry.items():
        own = found.geometry[name]
        if own.shape != array.shape or not np.allclose(own, array, rtol=0.0, atol=KINEMATIC_TOLERANCE):
            raise LogError(path, "robot.urdf", _where(name, own, array, expected), f"the kinematics of {reference}")


def require_same_noise(path: object, found: RowModel, expected: RowModel, reference: object) -> None:
    """Refuse factors that were weighted with other noise than others, of rows that are alike otherwise.

    Raises:
        LogError: names the noise, its value and the accepted one.
    """
    for group, value in expected.noise.items():
        if not np.isclose(found.noise[group], value, rtol=KINEMATIC_TOLERANCE, atol=0.0):
            accepted = f"{value:g}, as in {reference}: compress with all of sensors.noise stated"
            raise LogError(path, f"{NOISE}.{group}", f"{found.noise[group]:g}", accepted)


def _contact_text(contact: Contact) -> str:
    kind = f"line along {contact.line_axis}" if contact.kind == "line" else contact.kind
    if contact.radius:  # a factor of a contact that does not roll stays what it was
        kind += f", radius {contact.radius!r} m, normal {', '.join(map(repr, contact.normal))}"
    if contact.along_normal:
        kind += f", read along {', '.join(map(repr, contact.normal))}"
    return f"{contact.frame} ({kind})"


def _joint_text(joint: BodyJoint | None) -> str:
    return "base" if joint is None else f"{joint.kind} {joint.name}"


def _channels(robot: Robot, builder: RowBuilder) -> list[str]:
    """Measured channels by name."""
    measured = measured_components(builder.contacts, builder.sensors)
    names = [robot.dof_names[dof] for dof in np.flatnonzero(builder.sensors.torque)]
    return names + [
        f"{builder.contacts[i].frame} {builder.contacts[i].component_name(k)}" for i, k in np.argwhere(measured)
    ]


def _texts(found: Value, expected: Value, reference: str) -> tuple[str, str]:
    """What was found and what is accepted, in words."""
    if not (isinstance(found, list) and isinstance(expected, list)):
        return _text(found), f"{_text(expected)}, as in {reference}"
    missing, more = ([x for x in a if x not in b] for a, b in ((expected, found), (found, expected)))
    texts = [f"{what} {join_names(names)}" for what, names in (("without", missing), ("with", more)) if names]
    return " and ".join(texts) or "another order", f"those of {reference}: {join_names(expected) or 'none'}"


def _text(value: Value) -> str:
    if isinstance(value, list):
        return join_names(value) or "none"
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _where(name: str, found: Array, expected: Array, model: RowModel) -> str:
    """Which part of a robot differs, and by how much."""
    if found.shape != expected.shape:
        return f"{name} of shape {found.shape}"
    apart = np.abs(found - expected).reshape(len(expected), -1).max(axis=1)
    worst = int(apart.argmax())
    if "contact" in name:
        contacts = model.settings["contacts"]
        return f"contact {contacts[worst] if isinstance(contacts, list) else worst} is {apart[worst]:.2g} off"
    bodies = model.settings["robot.urdf"]
    known = isinstance(bodies, list) and len(bodies) == len(expected)
    part = f"{bodies[worst]}" if isinstance(bodies, list) and known else f"frame {worst}"
    return f"{name} of {part} is {apart[worst]:.2g} off"
