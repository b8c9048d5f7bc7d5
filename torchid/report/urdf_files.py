"""What MuJoCo needs in a URDF to load it as it is; other programs read the same robot."""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath

import numpy as np
from lxml import etree

from torchid import parameters
from torchid.errors import join_names, warn
from torchid.parameters import Array
from torchid.robot import Robot
from torchid.robot.urdf import MeshError, mesh_path

MUJOCO_MESHES = (".stl", ".obj", ".msh")
"""Extensions of the meshes that MuJoCo reads of a URDF."""

SMALLEST = 1e-14
"""Mass [kg] and principal inertia [kg m^2] of moving links without any: MuJoCo refuses less than 1e-15 (mjMINVAL)."""


def bound_massless_links(root: etree._Element, robot: Robot, phi: Array) -> None:
    """Let MuJoCo, and no other program, give `SMALLEST` to links without mass that move something with mass.

    Those are the links between the axes of a joint of several axes. A joint that moves no mass has no equation of
    motion; MuJoCo goes on refusing a file with such.

    Args:
        root: of the URDF.
        robot: whose bodies are bounded.
        phi: parameters that the file has, (L, 12).
    """
    bounds = mass_bounds(robot, phi)
    if not bounds:
        return
    extension = root.find("mujoco")
    if extension is None:
        extension = etree.Element("mujoco")
        root.insert(0, extension)
    compiler = extension.find("compiler")
    if compiler is None:
        compiler = etree.SubElement(extension, "compiler")
    for name, value in bounds.items():
        compiler.set(name, compiler.get(name, value))


def mass_bounds(robot: Robot, phi: Array) -> dict[str, str]:
    """Attributes of MuJoCo's `<compiler>` by which it takes moving links without mass; none where no rule would help.

    Args:
        robot: whose links they are.
        phi: parameters, (L, 12).
    """
    moving = [body.joint is not None and body.joint.kind != "fixed" for body in robot.bodies]
    empty = bool((np.array(moving) & (phi[:, parameters.MASS] == 0.0)).any())
    return (
        dict.fromkeys(("boundmass", "boundinertia"), repr(SMALLEST)) if empty and not massless_ends(robot, phi) else {}
    )


def massless_ends(robot: Robot, phi: Array) -> list[str]:
    """Names of bodies whose joints move no mass at all, of parameters (L, 12)."""
    moved = phi[:, parameters.MASS] != 0.0
    for index in reversed(range(1, len(robot.bodies))):  # parents come before their children
        moved[robot.bodies[index].parent] |= moved[index]
    return [
        body.name
        for body, any_mass in zip(robot.bodies, moved, strict=True)
        if body.joint is not None and body.joint.kind != "fixed" and not any_mass
    ]


def resolve_meshes(root: etree._Element, urdf: Path, file: str) -> None:
    """Name meshes by full paths where MuJoCo, or whoever reads the file from another folder, would not find them.

    Those are meshes of collisions, and all with relative names. Visual meshes `package://` keep their names, as MuJoCo
    skips them. Collisions with meshes that are not found, or of a format that MuJoCo does not read, become comments.

    Args:
        root: of the URDF.
        urdf: where it is read from.
        file: name of the written file, for the warning.

    Warns:
        TorchidWarning: meshes of collisions that are not found, or that MuJoCo does not read.
    """
    missing, foreign = list[str](), list[str]()
    for link in root.findall("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            mesh = shape.find("geometry/mesh")
            name = "" if mesh is None else str(mesh.get("filename", ""))
            if mesh is None or (shape.tag == "visual" and (Path(name).is_absolute() or "://" in name)):
                continue
            if shape.tag == "collision" and Path(name).suffix.lower() not in MUJOCO_MESHES:
                foreign.append(name)
                _comment_out(shape, "not of a format that MuJoCo reads")
                continue
            if Path(name).is_absolute():
                continue
            path = _found(urdf, name)
            if path is not None:
                mesh.set("filename", str(path.absolute()))
            elif shape.tag == "collision":
                missing.append(name)
                _comment_out(shape, "not found")
    reasons = {"that are not found": missing, f"that are none of {', '.join(MUJOCO_MESHES)}": foreign}
    for reason, names in reasons.items():
        if names:
            listed = join_names(list(dict.fromkeys(names)))
            text = f"{file}: meshes of collisions {reason}, which MuJoCo would refuse, are comments: {listed}"
            warn(f"{text}; torchid export --format urdf keeps them")


def _found(urdf: Path, name: str) -> Path | None:
    """A mesh file beside the URDF, in its package or in one that ROS knows of."""
    try:
        return mesh_path(urdf, name)
    except MeshError:
        return next((path for path in _ros_paths(name) if path.is_file()), None)


def _ros_paths(name: str) -> list[Path]:
    """Where ROS looks for `package://NAME/...`."""
    scheme, _, rest = name.partition("://")
    parts = PurePosixPath(rest.lstrip("/")).parts
    if scheme != "package" or not parts or ".." in parts:
        return []
    listed = [Path(x) for x in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if x]
    own = [folder.joinpath(*parts[1:]) for folder in listed if folder.name == parts[0]]
    shared = [Path(x) / "share" for x in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if x]
    return [*own, *(folder.joinpath(*parts) for folder in (*listed, *shared))]


def _comment_out(element: etree._Element, reason: str) -> None:
    tail, element.tail = element.tail, None
    text = etree.tostring(element, encoding="unicode").replace("--", "- -")
    comment = etree.Comment(f" {reason}: {text} ")
    comment.tail = tail
    parent = element.getparent()
    if parent is not None:
        parent.replace(element, comment)
