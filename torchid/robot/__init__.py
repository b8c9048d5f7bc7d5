"""From a URDF to a tree of bodies with nominal parameters."""

from torchid.robot.robot import Body, Robot, load_robot

__all__ = ["Body", "Robot", "load_robot"]
