"""The robot's file with identified parameters, of the kind that it was."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from torchid.errors import join_names, warn
from torchid.parameters import Array
from torchid.problem.extras import Extra
from torchid.report.urdf_files import identified_urdf
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
    def of(cls, found: Iterable[tuple[Extra, float]], stribeck_velocity: float | None = None) -> FittedJoints:
        """From extra parameters with their values."""
        values: dict[str, dict[str, float]] = {name: {} for name in IN_FILES}
        for extra, value in found:
            if extra.what in values:
                values[extra.what][extra.name] = value
        return cls(**values, stribeck_velocity=stribeck_velocity)

    def springs(self, robot: Robot, file: str) -> dict[str, tuple[float, float]]:
        """Stiffness and position at rest [rad or m] of springs that say what was fitted, with offsets of their torque.

        An offset o of a spring of stiffness k moves its rest by -o / k. Of joints without a spring no file can say it.

        Warns:
            TorchidWarning: offsets that are lost, and springs that MuJoCo does not take.
        """
        springs, lost = dict[str, tuple[float, float]](), []
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
            warn(f"{file}: MJCF cannot say what was fitted of {join_names(lost)}: an offset without a spring, or a "
                 "spring that pushes or moves several joints")  # fmt: skip
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
