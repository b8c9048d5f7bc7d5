"""MJCF as a URDF document, from which everything else is read as from a URDF.

What a URDF cannot say is in a namespace of its own, `xml_files.OWN`: the offset of a link from its joint, armatures,
springs, closed loops and joints without a motor.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from lxml import etree

from torchid.parameters import INERTIA_AXES, Array
from torchid.robot.mjcf_checks import (
    LOOPS,
    check_model,
    driven_joints,
    equality_kind,
    is_held,
    loop_bodies,
    loop_frames,
    mimic_of,
)
from torchid.robot.mjcf_model import MjcfModel, pose
from torchid.robot.xml_files import OWN

_SHAPES = {"SPHERE": "sphere", "CAPSULE": "capsule", "CYLINDER": "cylinder", "BOX": "box", "ELLIPSOID": "box"}


def urdf_document(path: Path) -> etree._ElementTree:
    """The URDF document of an MJCF robot: the tree of most degrees of freedom in the file.

    A body is a link; of several joints of a body all but the last move links without mass, named "body/joint". Sites
    and named geoms that collide are links welded to their body, by their names; " (site)" or " (geom)" follows where a
    link has the name. The base is the body with the free joint, or the world.

    Raises:
        UrdfError: MuJoCo does not take the file, or what it has is refused, see `check_model`.
    """
    model = MjcfModel(path)
    check_model(model)
    return etree.ElementTree(_Document(model).root)


class _Document:
    def __init__(self, model: MjcfModel) -> None:
        self.model, self.root = model, etree.Element("robot", name=model.path.stem)
        self._links, self._joints = set[str](), set(model.joints)
        members = [model.base, *(i for i in model.members if i != model.base)]
        self._taken = {model.bodies[i] for i in members}
        self._by_body = {body.id: body for body in model.spec.bodies}
        mimics = (mimic_of(model, equality) for equality in model.spec.equalities)
        self._mimics = {found[0]: found[1:] for found in mimics if found is not None}
        for body in members:
            self._add_body(body)
        for body in members if model.base else members[1:]:
            self._add_shapes(body)
        self._add_loops()

    def _add_body(self, body: int) -> None:
        model, name = self.model, self.model.bodies[body]
        before, T = model.bodies[int(model.model.body_parentid[body])], model.pose(body)
        joints = model.joints_of(body)
        for joint in joints:
            last = joint == joints[-1]
            link = name if last else f"{name}/{model.joints[joint]}"
            if not last:
                self._add_link(link)
            self._add_joint(joint, before, link, T)
            before, T = link, np.eye(4)
        if body != model.base and not joints:
            self._weld(before, name, T)
        self._add_link(name, body if body else None)

    def _add_link(self, name: str, body: int | None = None) -> etree._Element:
        link = etree.SubElement(self.root, "link", name=name)
        if body is not None and self.model.model.body_mass[body] > 0.0:
            of = self.model.model
            inertial = etree.SubElement(link, "inertial")
            _add_origin(inertial, pose(of.body_ipos[body], of.body_iquat[body]))
            etree.SubElement(inertial, "mass", value=repr(float(of.body_mass[body])))
            numbers = np.diag(of.body_inertia[body])
            names = {f"i{'xyz'[row]}{'xyz'[k]}": repr(float(numbers[row, k])) for row, k in INERTIA_AXES}
            etree.SubElement(inertial, "inertia", names)
        return link

    def _add_joint(self, joint: int, parent: str, child: str, T_parent_body: Array) -> None:
        """A joint about an anchor that may be off the body's origin, at position 0 in its frame."""
        model, of = self.model, self.model.model
        slides, dof, address = model.slides(joint), int(of.jnt_dofadr[joint]), int(of.jnt_qposadr[joint])
        anchor, axis, reference = of.jnt_pos[joint], of.jnt_axis[joint], float(of.qpos0[address])
        limited = bool(of.jnt_limited[joint])
        element = etree.SubElement(self.root, "joint", name=model.joints[joint])
        element.set("type", "prismatic" if slides else "revolute" if limited else "continuous")
        back = np.eye(4)
        if slides:
            back[:3, 3] = -reference * axis
        else:
            half = 0.5 * reference
            back = pose(np.zeros(3), np.array([np.cos(half), *(-np.sin(half) * axis)]))
        T_anchor = np.eye(4)
        T_anchor[:3, 3] = anchor
        _add_origin(element, T_parent_body @ T_anchor @ back)
        etree.SubElement(element, "parent", link=parent)
        link = etree.SubElement(element, "child", link=child)
        if anchor.any():
            link.set(f"{OWN}xyz", _text(-anchor))
        etree.SubElement(element, "axis", xyz=_text(axis))
        if limited:
            low, high = map(float, of.jnt_range[joint])
            etree.SubElement(element, "limit", lower=repr(low), upper=repr(high), effort="0", velocity="0")
        damping, friction = float(of.dof_damping[dof]), float(of.dof_frictionloss[dof])
        dynamics = etree.SubElement(element, "dynamics", damping=repr(damping), friction=repr(friction))
        own = {"armature": of.dof_armature[dof], "stiffness": of.jnt_stiffness[joint]}
        if own["stiffness"]:
            own["rest"] = of.qpos_spring[address]
        for name, value in own.items():
            if value:
                dynamics.set(OWN + name, repr(float(value)))
        if (mimic := self._mimics.get(model.joints[joint])) is not None:
            master, multiplier, offset = mimic
            found = {"joint": master, "multiplier": repr(multiplier), "offset": repr(offset)}
            etree.SubElement(element, "mimic", found)

    def _weld(self, parent: str, child: str, T: Array) -> None:
        name = f"{child}_fixed"
        while name in self._joints:
            name += "_"
        self._joints.add(name)
        element = etree.SubElement(self.root, "joint", name=name, type="fixed")
        _add_origin(element, T)
        etree.SubElement(element, "parent", link=parent)
        etree.SubElement(element, "child", link=child)

    def _add_shapes(self, body: int) -> None:
        """Sites as links; geoms as shapes of the body's link, or of a link of their own if they have a name."""
        model, of = self.model, self.model.model
        spec = self._by_body[body]
        for site in spec.sites:
            if site.name:
                self._frame(body, site.name, "site", pose(of.site_pos[site.id], of.site_quat[site.id]))
        for geom in spec.geoms:
            T, collides = pose(of.geom_pos[geom.id], of.geom_quat[geom.id]), bool(geom.contype or geom.conaffinity)
            link, origin = self.root.find(f"link[@name={_quoted(model.bodies[body])}]"), T
            shape = self._shape(geom.id)
            if geom.name and collides and shape is not None:
                link, origin = self._frame(body, geom.name, "geom", T), np.eye(4)
            if shape is not None and link is not None:
                element = etree.SubElement(link, "collision" if collides else "visual")
                _add_origin(element, origin if geom.id not in model.meshes else origin @ self._mesh_frame(geom.id))
                etree.SubElement(element, "geometry").append(shape)

    def _add_loops(self) -> None:
        """Loops and what else holds the robot, with links for their frames, and which joints no motor drives."""
        model = self.model
        for number, held in enumerate((x for x in model.spec.equalities if is_held(model, x)), start=1):
            name, poses = held.name or f"loop{number}", loop_frames(model, held)
            links = [
                str(self._frame(body, f"{name} of {model.bodies[body]}", "loop", T).get("name"))
                for body, T in zip(loop_bodies(model, held), poses, strict=True)
                if body in (model.base, *model.members)
            ]
            kind = equality_kind(held)
            if len(links) == 1:  # to a mocap body, or to scenery
                where = model.label(held, kind, held.name)
                etree.SubElement(self.root, f"{OWN}attachment", frame=links[0], type=LOOPS[kind], where=where)
            else:
                etree.SubElement(self.root, f"{OWN}loop", one=links[0], other=links[1], type=LOOPS[kind])
        driven = driven_joints(model) if self.root.find(f"{OWN}loop") is not None else None
        for joint in self.root.findall("joint"):
            dynamics = joint.find("dynamics")
            if driven is not None and dynamics is not None and joint.get("name") not in driven:
                dynamics.set(f"{OWN}passive", "true")

    def _frame(self, body: int, name: str, kind: str, T: Array) -> etree._Element:
        link = name
        while link in self._taken:
            link += f" ({kind})"
        self._taken.add(link)
        self._weld(self.model.bodies[body], link, T)
        return self._add_link(link)

    def _mesh_frame(self, geom: int) -> Array:
        """Pose of a mesh file's axes in the frame of its geom, which MuJoCo puts into the mesh's principal axes."""
        of, mesh = self.model.model, int(self.model.model.geom_dataid[geom])
        return np.eye(4) if mesh < 0 else np.asarray(np.linalg.inv(pose(of.mesh_pos[mesh], of.mesh_quat[mesh])))

    def _shape(self, geom: int) -> etree._Element | None:
        of, mesh = self.model.model, self.model.meshes.get(geom)
        if mesh is not None:
            return etree.Element("mesh", filename=mesh.file, scale=_text(mesh.scale))
        kind = _SHAPES.get(self.model.geom_kind(geom))
        size = [float(x) for x in of.geom_size[geom]]
        if kind is None:
            return None
        if kind == "box":  # of an ellipsoid the one around it
            return etree.Element("box", size=_text(2.0 * np.array(size)))
        attributes = {"radius": repr(size[0])} | ({} if kind == "sphere" else {"length": repr(2.0 * size[1])})
        return etree.Element(kind, attributes)


def _quoted(name: str) -> str:
    return f'"{name}"' if "'" in name else f"'{name}'"


def _text(numbers: Iterable[float]) -> str:
    return " ".join(repr(float(x)) for x in numbers)


def _add_origin(element: etree._Element, T: Array) -> None:
    etree.SubElement(element, "origin", xyz=_text(T[:3, 3]), rpy=_text(roll_pitch_yaw(T[:3, :3])))


def roll_pitch_yaw(R: Array) -> tuple[float, float, float]:
    """Angles [rad] about fixed x, y and z axes of a rotation (3, 3), to the last digits at a pitch of 90 degrees too.

    Any yaw will do there, as long as the other two follow from it: they are those of Rz(-yaw) R.
    """
    yaw = float(np.arctan2(R[1, 0], R[0, 0]))
    c, s = np.cos(yaw), np.sin(yaw)
    pitch = float(np.arctan2(-R[2, 0], c * R[0, 0] + s * R[1, 0]))
    roll = float(np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1]))
    return roll, pitch, yaw
