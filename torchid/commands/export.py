"""`torchid export`: identified parameters of a run as a simulator reads them."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

from torchid.commands import EXPORT_FORMATS
from torchid.commands.evaluate import read_run
from torchid.commands.folder import check_free_file
from torchid.config import inputs_of
from torchid.errors import ConfigError, InputError, TorchidWarning, during, join_names, warn
from torchid.parameters import PER_BODY, Array
from torchid.report import FittedJoints, identified_robot, identified_urdf
from torchid.report.robot_files import isaaclab_text, joint_parameters, parameters_export, refused_by_simulators
from torchid.robot import Robot
from torchid.robot.xml_files import is_mjcf
from torchid.staging import atomic_file


def export(run: str | Path, form: str, output: str | Path | None = None, overwrite: bool = False) -> str:
    """Identified parameters of a run: a model of the robot, actuators of Isaac Lab, or a plain document.

    Args:
        run: folder that `identify` wrote.
        form: one of `EXPORT_FORMATS`. "mjcf": the robot's own file, or one made of its URDF; "urdf" likewise;
            "isaaclab": a Python module with an `ImplicitActuatorCfg`; "json": bodies and joints.
        output: file to write; None: none is.
        overwrite: whether a file there may be replaced.

    Returns:
        The text.

    Raises:
        InputError: the folder is no run, the file may not be written, or MuJoCo, which "mjcf" needs, is not installed
            or does not take the robot.

    Warns:
        TorchidWarning: what the format cannot say, or what simulators will refuse.
    """
    folder = Path(run)
    target = None if output is None else Path(output)
    if form not in EXPORT_FORMATS:
        raise ConfigError("command line", "--format", f"'{form}'", ", ".join(EXPORT_FORMATS))
    fitted = read_run(folder)
    if target is not None:
        check_free_file(target, "--output", overwrite, [folder, *inputs_of(fitted.experiment.config)])
    if fitted.learned is not None:
        warn(f"{form}: bodies and friction only. For the learned module use torch.export of torchid.RigidPlusResidual.")
    robot = fitted.experiment.robot
    identified = fitted.calibrations.identified
    joints = FittedJoints.of(identified.of_joints, identified.builder.tree.stribeck)
    text = robot_text(form, robot, identified.phi.reshape(-1, PER_BODY), joints, folder)
    if target is not None:
        with during("writing", target), atomic_file(target) as new:
            new.write_text(text, encoding="utf-8")
    return text


def robot_text(form: str, robot: Robot, phi: Array, fitted: FittedJoints, folder: Path) -> str:
    """The robot of a run with parameters phi, (L, 12), and what was fitted of joints, as text.

    Raises:
        InputError: as `export`.

    Warns:
        TorchidWarning: as `export`.
    """
    joints = joint_parameters(robot, phi, fitted)
    if form == "isaaclab":
        return isaaclab_text(joints, f"{folder.resolve().name} of {robot.path.name}")
    if form == "json":
        return json.dumps(parameters_export(robot, phi, joints), indent=1, allow_nan=False) + "\n"
    if at_rest := [joint.name for joint in joints if joint.stribeck]:
        most = max(joint.stribeck for joint in joints)
        warn(f"{form.upper()}: Stribeck friction of {join_names(at_rest)} is lost, up to {most:.3g} N m (N) at rest. "
             "Use --format isaaclab or json.")  # fmt: skip
    if form == "mjcf" and not is_mjcf(robot.path):
        return _mjcf_of_urdf(robot, phi, fitted).decode()
    if refused := refused_by_simulators(robot, phi, fitted):
        warn(f"{form.upper()}: MuJoCo refuses it: {refused}")
    if form == "mjcf":
        return identified_robot(robot, phi, fitted).decode()
    lost = [joint.name for joint in joints if joint.armature]
    if lost:
        warn(f"URDF: the armature of {join_names(lost)} is lost. Use --format mjcf or isaaclab.")
    return identified_urdf(robot, phi).decode()


def _mjcf_of_urdf(robot: Robot, phi: Array, fitted: FittedJoints) -> bytes:
    """A model made of the robot's URDF, with meshes if MuJoCo takes them."""
    from torchid.report.mjcf_files import mjcf_of_urdf, require_loadable

    springs = fitted.springs(robot, "MJCF")
    text = mjcf_of_urdf(robot, phi, fitted.armature, springs=springs)
    try:
        require_loadable(text, robot.path)
    except InputError as error:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TorchidWarning)  # said already
            bare = mjcf_of_urdf(robot, phi, fitted.armature, False, springs)
        require_loadable(bare, robot.path)
        warn(f"{robot.path}: meshes are left out: {error.found}")
        return bare
    return text
