"""MJCF with identified parameters: the robot's own file, or a model made of its URDF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from lxml import etree
from scipy.spatial.transform import Rotation

from torchid import parameters
from torchid.errors import InputError, join_names, warn
from torchid.parameters import Array
from torchid.report.urdf_files import mass_bounds, share_with_links_beyond_welds, warn_if_inconsistent
from torchid.robot import Robot
from torchid.robot.meshes import MeshError, mesh_path
from torchid.robot.mjcf import MjcfModel, mujoco_error, parse_model
from torchid.robot.tree import Mimic, joint_origin, link_parameters, resolve_mimics
from torchid.robot.urdf import MOVING_TYPES, TreeJoint, parse_xml, position_limits, read_urdf
from torchid.robot.xml_files import body_elements

NAME = "identified.xml"
_RULES = ("settotalmass", "boundmass", "boundinertia", "balanceinertia")
"""Attributes of `<compiler>` by which MuJoCo changes inertias that a file states."""


def identified_mjcf(
    robot: Robot,
    phi: Array,
    armature: Mapping[str, float],
    springs: Mapping[str, tuple[float, float]] | None = None,
) -> bytes:
    """The MJCF file of a robot with parameters `phi`, (L, 12), and what joints have; all else is as it was.

    Included files stand in it, and paths of meshes do not change. The inertia of a body is that of the body whose joint
    moves it; those welded to it have none. Where MuJoCo multiplies elements (`<replicate>`, `<attach>`), the file is
    its own of all that is left of them, with six digits of whatever was not identified.

    Args:
        robot: of an MJCF file.
        phi: identified parameters.
        armature: by joint [kg m^2 or kg], of those whose armature was fitted.
        springs: likewise, stiffness [N m/rad or N/m] and position at rest [rad or m].

    Warns:
        TorchidWarning: bodies or joints that MuJoCo will refuse.
    """
    model = MjcfModel(robot.path)
    root = parse_model(model.spec.to_xml()) if model.text.multiplies else model.text.root
    elements = body_elements(root)
    number = {name: i for i, name in enumerate(model.bodies)}
    explicit = _state_inertias(root, model)
    remaining, beyond = share_with_links_beyond_welds(robot, phi)
    moving = np.array([[body.name != model.bodies[0]] for body in robot.bodies])  # the world has no inertia there
    warn_if_inconsistent(robot, moving * remaining, NAME)
    written = set[int]()
    for body, values, identified, before in zip(robot.bodies, remaining, phi, robot.nominal, strict=True):
        if np.array_equal(identified[parameters.INERTIAL], before[parameters.INERTIAL]) or body.name == model.bodies[0]:
            continue
        for name in (link for link in body.links if link in number and link not in robot.links_beyond_welds):
            _set_inertial(elements[number[name]][0], values if name == body.name else np.zeros(parameters.PER_BODY))
            written.add(number[name])
    for name, values in beyond.items():
        _set_inertial(elements[number[name]][0], values)
        written.add(number[name])
    for i in range(1, model.model.nbody) if explicit else ():
        if i not in written:
            _set_inertial(elements[i][0], model.inertial(i))
    _set_joints(robot, model, elements, remaining, armature)
    in_degrees = not model.text.multiplies and bool(model.spec.compiler.degree)
    for name, (stiffness, at_rest) in (springs or {}).items():
        joint = model.joints.index(name)
        turns = in_degrees and not model.slides(joint)
        element = _joint_element(model, elements, joint)
        element.set("stiffness", repr(stiffness))
        element.set("springref", repr(float(np.degrees(at_rest)) if turns else at_rest))
    etree.indent(root)
    return etree.tostring(root, encoding="utf-8", xml_declaration=True)


def _state_inertias(root: etree._Element, model: MjcfModel) -> bool:
    """Let MuJoCo take inertias as they are stated; whether all of them must then be, as they were computed."""
    computed = model.computes_inertias
    for compiler in root.findall("compiler") if computed else ():
        for name in _RULES:
            compiler.attrib.pop(name, None)
        if compiler.get("inertiafromgeom") == "true":
            compiler.set("inertiafromgeom", "auto")
    return computed


def _set_inertial(body: etree._Element, values: Array) -> None:
    """Write the parameters (10,) of a body, 0 kg of one whose inertia belongs to another one."""
    for inertial in body.findall("inertial"):
        body.remove(inertial)
    body.insert(0, inertial_element(values))


def inertial_element(values: Array) -> etree._Element:
    """Inertial parameters (10,) as MJCF states them."""
    if not values[parameters.MASS]:
        return etree.Element("inertial", pos="0 0 0", mass="0", diaginertia="0 0 0")
    mass, com, inertia = parameters.mass_com_inertia(values)
    numbers = [inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2]]
    return etree.Element("inertial", pos=numbers_text(com), mass=repr(float(mass)), fullinertia=numbers_text(numbers))


def numbers_text(numbers: Sequence[float] | Array) -> str:
    """Numbers to the last digit."""
    return " ".join(repr(float(x)) for x in numbers)


def _set_joints(
    robot: Robot,
    model: MjcfModel,
    elements: Sequence[tuple[etree._Element, Sequence[etree._Element]]],
    phi: Array,
    armature: Mapping[str, float],
) -> None:
    """Write friction and armatures that are not what they were."""
    follow = _armature_of_mimics(robot)
    for body, values, before in zip(robot.bodies, phi, robot.nominal, strict=True):
        joint = body.joint
        if joint is None or joint.kind == "fixed":
            continue
        number = model.joints.index(joint.name)
        element = _joint_element(model, elements, number)
        for name, index in (("frictionloss", parameters.COULOMB), ("damping", parameters.VISCOUS)):
            if values[index] != before[index] or (name == "damping" and model.has_spring_damper(number)):
                element.set(name, repr(float(values[index])))
        if model.has_spring_damper(number):  # which MuJoCo would compute from the inertia
            element.set("springdamper", "0 0")
            element.set("stiffness", repr(joint.stiffness))
        if joint.name in armature:
            element.set("armature", repr(armature[joint.name] - follow.get(joint.name, 0.0)))
    negative = [name for name, value in armature.items() if value < follow.get(name, 0.0)]
    if negative:
        warn(f"{NAME}: MuJoCo refuses the negative armature of {join_names(negative)}.")


def _joint_element(
    model: MjcfModel, elements: Sequence[tuple[etree._Element, Sequence[etree._Element]]], number: int
) -> etree._Element:
    """The element of a joint, by its number."""
    body = int(model.model.jnt_bodyid[number])
    return elements[body][1][number - int(model.model.body_jntadr[body])]


def _armature_of_mimics(robot: Robot) -> dict[str, float]:
    """What joints that mimic others add to the armature of these, by the others' names."""
    out: dict[str, float] = {}
    for body in robot.bodies:
        joint = body.joint
        if joint is not None and joint.mimic is not None:
            added = joint.mimic.multiplier**2 * joint.armature
            out[joint.mimic.master] = out.get(joint.mimic.master, 0.0) + added
    return out


def require_loadable(text: bytes, source: Path) -> None:
    """Make sure that MuJoCo takes a model. Raises InputError: it does not."""
    if refusal := mujoco_error(text, source.parent):
        raise InputError(source, "MJCF", f"MuJoCo refuses it: {refusal}", "a robot that MuJoCo can simulate")


_MESHES = (".stl", ".obj")  # that MuJoCo reads


def mjcf_of_urdf(
    robot: Robot,
    phi: Array,
    armature: Mapping[str, float],
    meshes: bool = True,
    springs: Mapping[str, tuple[float, float]] | None = None,
) -> bytes:
    """A model of the robot for MuJoCo: bodies, joints, friction, armatures, primitive shapes and meshes by full paths.

    A floating base has a free joint; a mimic joint is an equality constraint.

    Args:
        robot: of a URDF.
        phi: identified parameters, (L, 12).
        armature: by joint [kg m^2 or kg], of those whose armature was fitted.
        meshes: whether meshes are named, too.
        springs: by joint, stiffness [N m/rad or N/m] and position at rest [rad or m], of those that were fitted.

    Warns:
        TorchidWarning: meshes that are not found or that MuJoCo does not read, or bodies that it will refuse.
    """
    model = _Model(robot, phi, armature, springs or {}, meshes)
    warn_if_inconsistent(robot, model.phi, "MJCF")
    if model.left_out:
        names = join_names(list(dict.fromkeys(model.left_out)))
        warn(f"{robot.path}: meshes that MuJoCo cannot find or read are left out: {names}")
    etree.indent(model.root)
    return etree.tostring(model.root, encoding="utf-8", xml_declaration=True)


def _body_name(link: str) -> str:
    return link if link != "world" else "world link"  # MuJoCo has a world of its own


class _Model:
    def __init__(
        self,
        robot: Robot,
        phi: Array,
        armature: Mapping[str, float],
        springs: Mapping[str, tuple[float, float]],
        meshes: bool,
    ) -> None:
        self.robot = robot
        self.armature = armature
        self.springs = springs
        self.meshes = meshes
        self.phi, self._beyond = share_with_links_beyond_welds(robot, phi)
        self.left_out: list[str] = []
        links, joints = read_urdf(robot.path)
        self._links = {link.name: link for link in links}
        self._joints = joints
        self._shapes = {link.get("name"): link for link in parse_xml(robot.path).getroot().findall("link")}
        self._limits = position_limits(robot.path)
        mimics = resolve_mimics(robot.path, joints)
        self.root = etree.Element("mujoco", model=robot.path.stem)
        rules = {"angle": "radian", "inertiafromgeom": "false", "autolimits": "true"} | mass_bounds(robot, self.phi)
        etree.SubElement(self.root, "compiler", rules)
        self._assets = etree.SubElement(self.root, "asset")
        world = etree.SubElement(self.root, "worldbody")
        children = {joint.child for joint in joints}
        (root,) = (name for name in self._links if name not in children)
        self._add_body(world, root, np.eye(4), None)
        self._add_mimics(mimics)
        self._add_loops()

    def _add_body(self, parent: etree._Element, name: str, T: Array, joint: TreeJoint | None) -> None:
        body = etree.SubElement(parent, "body", name=_body_name(name), pos=numbers_text(T[:3, 3]), quat=_quaternion(T))
        if joint is None and not self.robot.fixed_base:
            etree.SubElement(body, "freejoint")
        values = self._inertial(name)
        if values is not None:
            body.append(inertial_element(values))
        if joint is not None and joint.type in MOVING_TYPES:
            self._add_joint(body, joint)
        for kind in ("collision", "visual"):
            for shape in self._shapes[name].findall(kind):
                self._add_shape(body, shape, kind)
        for below in self._joints:
            if below.parent == name:
                self._add_body(body, below.child, joint_origin(below), below)

    def _inertial(self, link: str) -> Array | None:
        """Parameters (12,) of a link, those of its body if that has its name; None of one without mass."""
        number = self.robot.links[link][0]
        if link in self.robot.links_beyond_welds:
            values = self._beyond.get(link, link_parameters(self._links[link], np.eye(4)))
        elif self.robot.bodies[number].name == link:
            values = self.phi[number]
        else:
            return None
        return values if values[parameters.MASS] else None

    def _add_joint(self, body: etree._Element, joint: TreeJoint) -> None:
        kind = "slide" if joint.type == "prismatic" else "hinge"
        element = etree.SubElement(body, "joint", name=joint.name, type=kind, axis=numbers_text(joint.axis))
        if joint.name in self._limits:
            element.set("range", numbers_text(self._limits[joint.name]))
        moved = [x for x in self.robot.bodies if x.joint is not None and x.joint.name == joint.name]
        friction = self.phi[self.robot.bodies.index(moved[0])] if moved else np.zeros(parameters.PER_BODY)
        for name, index in (("frictionloss", parameters.COULOMB), ("damping", parameters.VISCOUS)):
            if friction[index]:
                element.set(name, repr(float(friction[index])))
        if joint.name in self.armature:
            element.set("armature", repr(float(self.armature[joint.name])))
        if joint.name in self.springs:
            for key, value in zip(("stiffness", "springref"), self.springs[joint.name], strict=True):
                element.set(key, repr(value))

    def _add_mimics(self, mimics: Mapping[str, Mimic]) -> None:
        free = {name: mimic for name, mimic in mimics.items() if mimic.master}
        equality = etree.SubElement(self.root, "equality") if free else None
        for name, mimic in free.items():
            if equality is not None:
                polynomial = numbers_text([mimic.offset, mimic.multiplier, 0.0, 0.0, 0.0])
                etree.SubElement(equality, "joint", joint1=name, joint2=mimic.master, polycoef=polynomial)

    def _add_loops(self) -> None:
        """Loops as `connect` and `weld` between sites in their frames."""
        equality = etree.SubElement(self.root, "equality") if self.robot.loops else None
        bodies = {body.get("name"): body for body in self.root.iter("body")}
        for number, loop in enumerate(self.robot.loops, start=1):
            sites = {f"site{end}": f"loop{number} {end}" for end in (1, 2)}
            for name, frame in zip(sites.values(), loop.frames, strict=True):
                etree.SubElement(bodies[_body_name(frame)], "site", name=name)
            if equality is not None:
                tag = "connect" if loop.kind == "point" else "weld"
                etree.SubElement(equality, tag, sites, name=f"loop{number}")

    def _add_shape(self, body: etree._Element, shape: etree._Element, kind: str) -> None:
        origin = shape.find("origin")
        geometry = shape.find("geometry")
        form = None if geometry is None else next((x for x in geometry if isinstance(x.tag, str)), None)
        if form is None:
            return
        attributes = self._form(form)
        if attributes is None:
            return
        xyz, rpy = ("0 0 0", "0 0 0") if origin is None else (origin.get(key, "0 0 0") for key in ("xyz", "rpy"))
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("xyz", [float(x) for x in str(rpy).split()]).as_matrix()
        element = etree.SubElement(body, "geom", attributes, pos=str(xyz), quat=_quaternion(T))
        if kind == "visual":
            for key in ("contype", "conaffinity"):
                element.set(key, "0")
            element.set("group", "2")

    def _form(self, form: etree._Element) -> dict[str, str] | None:
        """Attributes of a geom's shape; None of a mesh that is left out."""

        def numbers(name: str, factor: float = 1.0) -> list[float]:
            return [factor * float(x) for x in str(form.get(name, "0")).split()]

        if form.tag == "mesh":
            return self._mesh(str(form.get("filename", "")), str(form.get("scale", "1 1 1")))
        if form.tag == "box":
            return {"type": "box", "size": numbers_text(numbers("size", 0.5))}
        size = numbers("radius") + ([] if form.tag == "sphere" else numbers("length", 0.5))
        return {"type": str(form.tag), "size": numbers_text(size)}

    def _mesh(self, filename: str, scale: str) -> dict[str, str] | None:
        try:
            path = mesh_path(self.robot.path, filename) if self.meshes else Path()
        except MeshError:
            path = Path()
        if path.suffix.lower() not in _MESHES:
            if self.meshes:
                self.left_out.append(Path(filename).name)
            return None
        file = str(path.absolute())
        for asset in self._assets:
            if (asset.get("file"), asset.get("scale")) == (file, scale):
                return {"type": "mesh", "mesh": str(asset.get("name"))}
        name = f"{path.stem}_{len(self._assets)}"
        etree.SubElement(self._assets, "mesh", name=name, file=file, scale=scale)
        return {"type": "mesh", "mesh": name}


def _quaternion(T: Array) -> str:
    """Quaternion w x y z of a pose (4, 4)."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return numbers_text([w, x, y, z])
