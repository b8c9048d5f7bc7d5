"""The URDF with identified inertias and friction, and what MuJoCo needs in it to load it as it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import scipy.linalg
from lxml import etree

from torchid import parameters
from torchid.errors import join_names, warn
from torchid.parameters import Array
from torchid.robot import Robot
from torchid.robot.meshes import MeshError, mesh_path
from torchid.robot.urdf import drop_repeated_origins, parse_xml
from torchid.robot.xml_files import is_mjcf, plain_urdf

_ROUNDING = 1e-12  # of a body's mass: below it the link that gives it its name has none
_LEAST_SHARE = (
    0.01  # of a body, that every link has which a joint moves in a simulator and for which nothing else is left
)

MUJOCO_MESHES = (".stl", ".obj", ".msh")
"""Extensions of the meshes that MuJoCo reads of a URDF."""

SMALLEST = 1e-14
"""Mass [kg] and principal inertia [kg m^2] of moving links without any: MuJoCo refuses less than 1e-15 (mjMINVAL)."""


def identified_urdf(robot: Robot, phi: Array, full_mesh_paths: bool = False) -> bytes:
    """The URDF with parameters `phi`, (L, 12).

    The inertia of a body is that of the link with its name; links welded to it have none. Links beyond a joint that
    the experiment welds have their part of it, see `share_with_links_beyond_welds`. Of an MJCF robot it is the URDF
    that says the same of bodies, joints and friction.

    Args:
        robot: the robot.
        phi: its parameters.
        full_mesh_paths: whether meshes are named as `resolve_meshes` does, or as they were.

    Warns:
        TorchidWarning: inconsistent bodies, or negative friction, which simulators (and `load_robot`) refuse; meshes
            that are not found.
    """
    tree = parse_xml(robot.path, with_world=True)
    drop_repeated_origins(tree.getroot())
    links = {link.get("name"): link for link in tree.getroot().findall("link")}
    joints = {joint.get("name"): joint for joint in tree.getroot().findall("joint")}
    phi, beyond = share_with_links_beyond_welds(robot, phi)
    warn_if_inconsistent(robot, phi)
    for body, values in zip(robot.bodies, phi, strict=True):
        if body.joint is not None and body.joint.kind != "fixed":
            _set_friction(joints[body.joint.name], values)
        if not body.massless or values[parameters.INERTIAL].any():
            for name in (link for link in body.links if link not in robot.links_beyond_welds):
                _set_inertial(links[name], values if name == body.name and values[parameters.MASS] else None)
    for name, values in beyond.items():
        _set_inertial(links[name], values)
    bound_massless_links(tree.getroot(), robot, phi)
    if is_mjcf(robot.path):
        plain_urdf(tree.getroot())
    elif full_mesh_paths:
        resolve_meshes(tree.getroot(), robot.path, "identified.urdf")
        if tree.find("link/collision/geometry/mesh") is not None:
            _set_compiler(tree.getroot(), {"strippath": "false"})  # MuJoCo 3 drops the folders of meshes
    etree.indent(tree)
    return etree.tostring(tree, xml_declaration=True, encoding="utf-8")


def share_with_links_beyond_welds(robot: Robot, phi: Array) -> tuple[Array, dict[str, Array]]:
    """What a file has of bodies that the experiment's welds made of several, in which joints move again.

    Links beyond the welds keep what the robot's file has, and the link that names the body has the rest. Where that
    leaves a link that is no body, all are parts of the body that was identified: those without an inertia of their own
    of its shape, the others as their file has them but for their size.

    Returns:
        Parameters of the bodies without links beyond welds, (L, 12), and those of the latter that change, (10,), in
        their own frames.
    """
    remaining = phi.copy()
    changed = dict[str, Array]()
    for number in sorted({robot.links[name][0] for name in robot.links_beyond_welds}):
        whole = phi[number, parameters.INERTIAL]
        before = {name: x for name, x in robot.links_beyond_welds.items() if robot.links[name][0] == number}
        share = whole - np.sum(list(before.values()), axis=0)
        if abs(share[parameters.MASS]) <= _ROUNDING * abs(whole[parameters.MASS]):
            share = np.zeros_like(share)
        empty = [name for name, x in before.items() if not _is_body(x, name in robot.moved_beyond_welds)]
        if (empty or not _is_body(share, False)) and parameters.consistency_margin(whole) > 0.0:
            parts = _parts(whole, before, empty)
            share = whole - np.sum(list(parts.values()), axis=0)
            T_link_body = {name: np.asarray(np.linalg.inv(robot.links[name][1]), np.float64) for name in parts}
            changed |= {n: parameters.change_of_frame(T_link_body[n]) @ x for n, x in parts.items() if x.any()}
        remaining[number, parameters.INERTIAL] = share
    return remaining, changed


def links_that_are_no_bodies(robot: Robot, phi: Array) -> list[str]:
    """Names of links that simulators refuse in a file with parameters (L, 12)."""
    remaining, changed = share_with_links_beyond_welds(robot, phi)
    beyond = {name: (x, name in robot.moved_beyond_welds) for name, x in (robot.links_beyond_welds | changed).items()}
    bodies = {
        body.name: (x, bool(x.any()) and body.joint is not None and body.joint.kind != "fixed")
        for body, x in zip(robot.bodies, remaining[:, parameters.INERTIAL], strict=True)
    }
    return [name for name, (values, moves) in (bodies | beyond).items() if not _is_body(values, moves)]


def _is_body(values: Array, moves: bool) -> bool:
    """Whether simulators take the parameters (10,) of a link, which may be zero unless a joint moves it."""
    if not values.any():
        return not moves
    if values[parameters.MASS] <= 0.0 or parameters.consistency_margin(values) < parameters.POSSIBLE_MARGIN:
        return False
    return not moves or np.linalg.eigvalsh(parameters.mass_com_inertia(values)[2])[0] > SMALLEST


def _parts(whole: Array, links: Mapping[str, Array], empty: Sequence[str]) -> dict[str, Array]:
    """Parts (10,) of a body for links of it, which leave at least `_LEAST_SHARE` of it in every direction."""
    others = {name: x for name, x in links.items() if name not in empty}
    total = np.sum([*others.values(), np.zeros_like(whole)], axis=0)
    share = scipy.linalg.eigh(*map(parameters.pseudo_inertia, (total, whole)), eigvals_only=True)[-1]
    scale = min(1.0, (1.0 - 2.0 * _LEAST_SHARE) / max(share, _LEAST_SHARE))
    shares = {name: _LEAST_SHARE / len(empty) * whole for name in empty}
    return shares | {name: scale * x for name, x in others.items()}


def warn_if_inconsistent(robot: Robot, phi: Array, file: str = "identified.urdf") -> None:
    """Warn of what simulators refuse in a file with parameters (L, 12)."""
    inconsistent = (phi[:, parameters.MASS] < 0.0) | (parameters.consistency_margin(phi) < parameters.POSSIBLE_MARGIN)
    bodies = [robot.bodies[number] for number in np.flatnonzero(phi.any(axis=1) & inconsistent)]
    if bodies:
        names = join_names([body.name for body in bodies])
        warn(f"{file}: not physically consistent, simulators refuse or misread them: {names}. "
             "Use estimator.name=consistent.")  # fmt: skip
    negative = [robot.bodies[number] for number in np.flatnonzero((phi[:, parameters.FRICTION] < 0.0).any(axis=1))]
    joints = [body.joint.name for body in negative if body.joint is not None]
    if joints:
        warn(f"{file}: simulators and torchid refuse the negative friction of {join_names(joints)}.")


def _set_inertial(link: etree._Element, values: Array | None) -> None:
    """Write the parameters (12,) of a link, or None for a link whose inertia belongs to another one.

    The latter has an explicit mass of 0 kg: for a link with collision shapes and without `<inertial>`, MuJoCo assumes
    the density of water, Bullet 1 kg.
    """
    before = link.findall("inertial")
    for inertial in before:
        link.remove(inertial)
    if values is not None:
        link.insert(0, _inertial_element(*parameters.mass_com_inertia(values)))
    elif before or link.find("collision") is not None:
        link.insert(0, _inertial_element(0.0, np.zeros(3), np.zeros((3, 3))))


def _inertial_element(mass: float, com: Array, inertia: Array) -> etree._Element:
    element = etree.Element("inertial")
    etree.SubElement(element, "origin", xyz=" ".join(repr(float(x)) for x in com), rpy="0 0 0")
    etree.SubElement(element, "mass", value=repr(mass))
    numbers = {f"i{'xyz'[row]}{'xyz'[k]}": repr(float(inertia[row, k])) for row, k in parameters.INERTIA_AXES}
    etree.SubElement(element, "inertia", numbers)
    return element


def _set_friction(joint: etree._Element, values: Array) -> None:
    dynamics = joint.find("dynamics")
    if dynamics is None and not values[parameters.FRICTION].any():
        return
    dynamics = etree.SubElement(joint, "dynamics") if dynamics is None else dynamics
    for name, value in zip(("friction", "damping"), values[parameters.FRICTION], strict=True):
        dynamics.set(name, repr(float(value)))


# ---------------------------------------------------------------------------------------------------- for MuJoCo


def bound_massless_links(root: etree._Element, robot: Robot, phi: Array) -> None:
    """Let MuJoCo, and no other program, give `SMALLEST` to links without mass that move something with mass.

    Those are the links between the axes of a joint of several axes. A joint that moves no mass has no equation of
    motion; MuJoCo goes on refusing a file with such.

    Args:
        root: of the URDF.
        robot: whose bodies are bounded.
        phi: parameters that the file has, (L, 12).
    """
    _set_compiler(root, mass_bounds(robot, phi))


def _set_compiler(root: etree._Element, attributes: Mapping[str, str]) -> None:
    """Give attributes to MuJoCo's `<compiler>` in a URDF, which no other program reads; those that it has stay."""
    if not attributes:
        return
    extension = root.find("mujoco")
    if extension is None:
        extension = etree.Element("mujoco")
        root.insert(0, extension)
    compiler = extension.find("compiler")
    if compiler is None:
        compiler = etree.SubElement(extension, "compiler")
    for name, value in attributes.items():
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
    skips them. Collisions with meshes that MuJoCo does not find or read are left out.

    Args:
        root: of the URDF.
        urdf: where it is read from.
        file: name of the written file, for the warning.

    Warns:
        TorchidWarning: meshes of collisions that are not found, or that MuJoCo does not read.
    """
    left_out = list[str]()
    for link in root.findall("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            mesh = shape.find("geometry/mesh")
            name = "" if mesh is None else str(mesh.get("filename", ""))
            collides = shape.tag == "collision"
            if mesh is None or (not collides and (Path(name).is_absolute() or "://" in name)):
                continue
            try:
                if collides and Path(name).suffix.lower() not in MUJOCO_MESHES:
                    raise MeshError
                if not Path(name).is_absolute():
                    mesh.set("filename", str(mesh_path(urdf, name).absolute()))
            except MeshError:
                if collides:
                    left_out.append(name)
                    link.remove(shape)
    if left_out:
        listed = join_names(list(dict.fromkeys(left_out)))
        text = f"{file}: collision meshes that MuJoCo cannot find or read are left out: {listed}"
        warn(f"{text}. To keep them, use torchid export --format urdf.")
