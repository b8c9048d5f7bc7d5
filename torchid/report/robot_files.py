"""The robot's file with identified parameters, of the kind that it was, and its joints for simulators."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from torchid import parameters
from torchid.errors import InputError, TorchidWarning, join_names, warn
from torchid.parameters import Array
from torchid.problem.extras import Extra
from torchid.report.urdf_files import identified_urdf, links_that_are_no_bodies, massless_ends
from torchid.robot import Robot
from torchid.robot.xml_files import is_mjcf

IN_FILES = ("armature", "stiffness", "torque_offset", "stribeck")
"""Kinds of extra parameters that some file of a robot, or of its actuators, has a place for."""


@dataclass(frozen=True)
class FittedJoints:
    """What a fit has found of joints beside friction, by joint.

    Attributes:
        armature: [kg m^2 or kg].
        stiffness: of springs [N m/rad or N/m].
        torque_offset: [N m or N].
        stribeck: friction at rest beyond Coulomb friction [N m or N].
        stribeck_velocity: over which that drops [rad/s or m/s]; None without it.
    """

    armature: Mapping[str, float] = field(default_factory=dict)
    stiffness: Mapping[str, float] = field(default_factory=dict)
    torque_offset: Mapping[str, float] = field(default_factory=dict)
    stribeck: Mapping[str, float] = field(default_factory=dict)
    stribeck_velocity: float | None = None

    @classmethod
    def of(cls, extras: Iterable[tuple[Extra, float]], stribeck_velocity: float | None = None) -> FittedJoints:
        """From extra parameters with their values."""
        values: dict[str, dict[str, float]] = {name: {} for name in IN_FILES}
        for extra, value in extras:
            if extra.what in values:
                values[extra.what][extra.name] = value
        return cls(**values, stribeck_velocity=stribeck_velocity)

    def springs(self, robot: Robot, file: str) -> dict[str, tuple[float, float]]:
        """Stiffness and position at rest [rad or m] of springs that say what was fitted, with offsets of their torque.

        An offset o of a spring of stiffness k moves its rest by -o / k. Of joints without a spring no file can say it.

        Warns:
            TorchidWarning: offsets that are lost, and springs that MuJoCo does not take.
        """
        springs = dict[str, tuple[float, float]]()
        lost = []
        masters = {body.joint.mimic.master for body in robot.bodies if body.joint is not None and body.joint.mimic}
        for number, name in enumerate(robot.joint_names):
            if name not in self.stiffness and name not in self.torque_offset:
                continue
            stiffness = self.stiffness.get(name, float(robot.stiffness[number]))
            constant = float(robot.spring_torque[number]) + self.torque_offset.get(name, 0.0)
            if stiffness > 0.0 and name not in masters:
                springs[name] = stiffness, -constant / stiffness
            elif stiffness or constant:
                lost.append(name)
        if lost:
            why = "(an offset without a spring, a negative stiffness, or a spring of coupled joints)"
            warn(f"{file}: MJCF cannot express the fitted offset or spring of {join_names(lost)} {why}.")
        return springs


def identified_name(robot: Robot) -> str:
    """Name of the file of a run with the robot and its identified parameters."""
    return "identified.xml" if is_mjcf(robot.path) else "identified.urdf"


def identified_robot(robot: Robot, phi: Array, fitted: FittedJoints) -> bytes:
    """The robot's file, URDF or MJCF, with parameters `phi`, (L, 12), and what was fitted of joints.

    Meshes that MuJoCo needs of a URDF are named by full paths.

    Warns:
        TorchidWarning: as `identified_urdf`.
    """
    if not is_mjcf(robot.path):
        return identified_urdf(robot, phi, full_mesh_paths=True)
    from torchid.report.mjcf_files import identified_mjcf  # needs an extra

    return identified_mjcf(robot, phi, fitted.armature, fitted.springs(robot, identified_name(robot)))


def refused_by_simulators(robot: Robot, phi: Array, fitted: FittedJoints) -> str:
    """What MuJoCo says against `identified_robot`, "" if it takes it; where it is not installed, what it would say."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)  # said where the file is written
        text = identified_robot(robot, phi, fitted)
    try:
        from torchid.robot.mjcf import mujoco_error  # needs an extra
    except InputError:
        refused = [*massless_ends(robot, phi), *links_that_are_no_bodies(robot, phi)]
        return f"inertia of {join_names(refused)} is not physically consistent" if refused else ""
    return mujoco_error(text, robot.path.parent)


_UNITS = {
    "revolute": ("kg m^2", "N m", "N m s/rad", "N m", "rad/s"),
    "prismatic": ("kg", "N", "N s/m", "N", "m/s"),
}


@dataclass(frozen=True)
class JointParameters:
    """What an actuator model needs of a joint.

    Attributes:
        name: of the joint.
        kind: "revolute" or "prismatic".
        armature: reflected rotor inertia [kg m^2 or kg]; None where it was not fitted and the robot's file has none.
        coulomb: torque or force of dry friction, at any velocity [N m or N].
        viscous: friction over velocity [N m s/rad or N s/m].
        stribeck: what dry friction at rest is beyond that [N m or N].
        stribeck_velocity: v_s, where exp(-(velocity / v_s)^2) of it is left [rad/s or m/s]; None without it.
    """

    name: str
    kind: str
    armature: float | None
    coulomb: float
    viscous: float
    stribeck: float
    stribeck_velocity: float | None

    def for_isaaclab(self) -> dict[str, float]:
        """What an actuator of Isaac Lab says, without what was neither identified nor in the robot's file."""
        friction = {"friction": self.coulomb + self.stribeck, "dynamic_friction": self.coulomb}
        friction |= {"viscous_friction": self.viscous}
        known = {} if self.armature is None else {"armature": self.armature}
        return known | {name: value for name, value in friction.items() if value}


def joint_parameters(robot: Robot, phi: Array, fitted: FittedJoints) -> list[JointParameters]:
    """Of the independent joints: one that mimics another has no actuator, its armature and friction are the other's.

    By the ratio k of their positions, armature and viscous friction count k^2 times, Coulomb friction |k| times.

    Args:
        robot: the robot.
        phi: identified parameters, (L, 12).
        fitted: what else was found of joints; those whose armature was not fitted have that of the robot's file.
    """
    ratio = np.abs(robot.joint_map[0])
    coulomb = ratio.T @ phi[1:, parameters.COULOMB]
    viscous = (ratio**2).T @ phi[1:, parameters.VISCOUS]
    return [
        JointParameters(
            name=name,
            kind="prismatic" if name in robot.sliding else "revolute",
            armature=fitted.armature.get(name, float(robot.armature[k]) or None),
            coulomb=float(coulomb[k]),
            viscous=float(viscous[k]),
            stribeck=float(fitted.stribeck.get(name, 0.0)),
            stribeck_velocity=fitted.stribeck_velocity if name in fitted.stribeck else None,
        )
        for k, name in enumerate(robot.joint_names)
    ]


def isaaclab_text(joints: Sequence[JointParameters], source: str) -> str:
    """Python text of an `ImplicitActuatorCfg` with all independent joints by name.

    Joints of which other parameters are known have one of their own, as Isaac Lab takes 0 for a joint that a mapping
    does not name, and keeps what the asset has where there is no mapping.

    Args:
        joints: from `joint_parameters`.
        source: what they come from, for the first line.
    """
    groups: dict[tuple[str, ...], list[JointParameters]] = {}
    for joint in joints:
        groups.setdefault(tuple(joint.for_isaaclab()), []).append(joint)
    numbered = enumerate(groups.items(), start=1)
    return (
        f'"""Actuators identified by torchid: {_plain(source)}.\n\n'
        "friction: of joints at rest [N m or N]: an effort from Isaac Sim 5.0 on, a coefficient without unit before.\n"
        "dynamic_friction: Coulomb friction, that of joints that move [N m or N], from Isaac Sim 5.0 on.\n"
        "viscous_friction: [N m s/rad or N s/m], from Isaac Sim 5.0 on; before, leave it out and add its numbers to\n"
        "damping. stiffness, damping: the gains of your controller; with 0 and 0 the joints take efforts.\n"
        "What was not identified is left out: the asset's value stays.\n"
        '"""\n\n'
        "from isaaclab.actuators import ImplicitActuatorCfg\n"
    ) + "".join(_actuator(f"IDENTIFIED_ACTUATORS{f'_{k}' * (k > 1)}", keys, group) for k, (keys, group) in numbered)


def _actuator(name: str, keys: Sequence[str], joints: Sequence[JointParameters]) -> str:
    """One actuator of joints of which the same parameters are known."""

    def entries(key: str) -> str:
        return "".join(f"        {_pattern(joint)}: {joint.for_isaaclab()[key]!r},\n" for joint in joints)

    names = "".join(f"        {_pattern(joint)},\n" for joint in joints)
    known = "".join(f"    {key}={{\n{entries(key)}    }},\n" for key in keys)
    gains = "    stiffness=0.0,\n    damping=0.0,\n"
    return f"\n{name} = ImplicitActuatorCfg(\n    joint_names_expr=[\n{names}    ],\n{gains}{known})\n"


def parameters_export(robot: Robot, phi: Array, joints: Sequence[JointParameters]) -> dict[str, Any]:
    """Bodies by mass, centre of mass and inertia about it, in their link frames, and joints, with units."""
    bodies = {}
    for body, values in zip(robot.bodies, phi, strict=True):
        if values[parameters.MASS]:
            mass, com, inertia = parameters.mass_com_inertia(values)
            bodies[body.name] = {"mass": mass, "center_of_mass": com.tolist(), "inertia": inertia.tolist()}
    entries = {joint.name: asdict(joint) | {"units": list(_UNITS[joint.kind])} for joint in joints}
    return {
        "robot": robot.path.name,
        "units": {"mass": "kg", "center_of_mass": "m", "inertia": "kg m^2"},
        "frame": "each body's link frame; inertia about the centre of mass, along the link's axes",
        "bodies": bodies,
        "joints": {name: {k: x for k, x in entry.items() if k != "name"} for name, entry in entries.items()},
    }


def _pattern(joint: JointParameters) -> str:
    """A joint's name as a regular expression that fits it alone, in Python."""
    return repr(re.escape(joint.name))


def _plain(text: str) -> str:
    return text.replace("\\", "/").replace('"', "'")
