"""The robot's file with identified parameters, of the kind that it was."""

from __future__ import annotations

from collections.abc import Mapping

from torchid.parameters import Array
from torchid.report.parameter_files import identified_urdf
from torchid.robot import Robot
from torchid.robot.xml_files import is_mjcf


def identified_name(robot: Robot) -> str:
    """Name of the file of a run with the robot and its identified parameters."""
    return "identified.xml" if is_mjcf(robot.path) else "identified.urdf"


def identified_robot(robot: Robot, phi: Array, armature: Mapping[str, float]) -> bytes:
    """The robot's file, URDF or MJCF, with parameters `phi`, (L, 12), and fitted armatures by joint [kg m^2 or kg].

    Meshes that MuJoCo needs of a URDF are named by full paths.

    Warns:
        TorchidWarning: as `identified_urdf`.
    """
    if not is_mjcf(robot.path):
        return identified_urdf(robot, phi, full_mesh_paths=True)
    from torchid.report.mjcf_files import identified_mjcf  # needs an extra

    return identified_mjcf(robot, phi, armature)
