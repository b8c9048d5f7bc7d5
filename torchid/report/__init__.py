"""What a run leaves behind: tables, figures, TensorBoard events, parameters and a file of the robot."""

from torchid.report.parameter_files import parameters_document
from torchid.report.robot_files import FittedJoints, identified_name, identified_robot
from torchid.report.urdf_files import identified_urdf

__all__ = ["FittedJoints", "identified_name", "identified_robot", "identified_urdf", "parameters_document"]
