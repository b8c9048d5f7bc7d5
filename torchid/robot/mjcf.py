"""MJCF as a URDF document: MuJoCo's own reading of a file, what it must not have, and the document."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from lxml import etree

from torchid.errors import InputError, LogError, UrdfError, excerpt, how_to_install, warn
from torchid.guards import MAX_LINKS, MAX_NUMBER
from torchid.parameters import GRAVITY, INERTIA_AXES, Array, inertial_vector
from torchid.reader import open_apart
from torchid.robot.xml_files import MJCF_WORLD, OWN, MjcfText

try:
    import mujoco as mujoco
except ImportError as error:
    found = "need MuJoCo, which " + ("is not installed" if error.name == "mujoco" else f"does not load: {error}")
    raise InputError("", "simulation and MJCF", found, how_to_install("sim")) from error

mujoco.set_mju_user_warning(lambda _: None)  # MuJoCo would write a log file where it runs


_MAX_SCENE_BODIES = 10 * MAX_LINKS


_PLACEHOLDER = 1e-3  # m, radius of the sphere that stands for a mesh which need not be read
_LINE = re.compile(r"line (\d+)")


@dataclass(frozen=True)
class MeshShape:
    """A mesh of a geom: its file as the MJCF names it, and its scale."""

    file: str
    scale: tuple[float, float, float]


class MjcfModel:
    """An MJCF file as MuJoCo compiles it: defaults, includes, frames, angles and inertias are resolved.

    `model` is MuJoCo's; `bodies` and `joints` are names by its numbers, made up where the file has none; `base` is the
    body that moves freely, or the world; `members` are the numbers of the robot's bodies, parents first. `meshes` are
    those of geoms, by number.
    """

    def __init__(self, path: Path) -> None:
        """Read and compile a file. Raises UrdfError: MuJoCo does not take it, or it has no joint."""
        self.path = path
        self.text = MjcfText(path)
        _try_to_read(path, path.stat().st_mtime_ns)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # of MuJoCo, about elements that it will not have for ever
                self.spec = mujoco.MjSpec.from_file(str(path))
                self._check_size()
                meshes, dropped = self._drop_files()
                self.model = self.spec.compile()
        except ValueError as error:
            if isinstance(error, InputError):
                raise
            text = excerpt(" ".join(str(error).split()), 300)
            raise UrdfError(path, "MJCF", f"MuJoCo refuses it: {text}", "a model that MuJoCo loads") from error
        self.meshes = {geom.id: mesh for geom, mesh in meshes}
        self._spring_dampers = {joint.id for joint in self.spec.joints if joint.springdamper.any()}
        self._dropped = {geom.id for geom in dropped}
        model = self.model
        self.bodies, self.joints = self.text.names(
            [model.body(i).name for i in range(model.nbody)],
            [(int(model.jnt_bodyid[i]), model.joint(i).name) for i in range(model.njnt)],
        )
        self.base, self.members = self._largest_tree()

    # ------------------------------------------------------------------------------------------------ what is read

    def joints_of(self, body: int) -> range:
        """Numbers of the joints that move a body, in order, without a free one."""
        first = int(self.model.body_jntadr[body])
        count = int(self.model.body_jntnum[body])
        return range(first, first + count) if count and not self.is_free(body) else range(0)

    def is_free(self, body: int) -> bool:
        """Whether a free joint moves a body."""
        model = self.model
        return bool(model.body_jntnum[body] and model.jnt_type[model.body_jntadr[body]] == mujoco.mjtJoint.mjJNT_FREE)

    def slides(self, joint: int) -> bool:
        """Whether a joint, hinge or slide, is a slide."""
        return bool(self.model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE)

    def geom_kind(self, geom: int) -> str:
        """Type of a geom: "SPHERE", "BOX", ...; "" of one that stands for what has not been read."""
        kind = mujoco.mjtGeom(int(self.model.geom_type[geom])).name.removeprefix("mjGEOM_")
        return "" if geom in self._dropped else str(kind)

    def pose(self, body: int) -> Array:
        """Pose of a body in its parent's frame at its joints' reference positions, (4, 4) [m]."""
        return pose(self.model.body_pos[body], self.model.body_quat[body])

    def inertial(self, body: int) -> Array:
        """Inertial parameters (10,) of a body in its frame."""
        compiled = self.model
        R = pose(np.zeros(3), compiled.body_iquat[body])[:3, :3]
        about_com = R @ np.diag(compiled.body_inertia[body]) @ R.T
        return inertial_vector(float(compiled.body_mass[body]), compiled.body_ipos[body], about_com)

    @property
    def computes_inertias(self) -> bool:
        """Whether the inertias are others than the file states: of geoms, or changed by a rule."""
        rules = self.spec.compiler
        from_geoms = int(rules.inertiafromgeom) == int(mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE)
        limits = max(rules.settotalmass, rules.boundmass, rules.boundinertia)
        return bool(from_geoms or rules.balanceinertia or limits > 0.0)

    def has_spring_damper(self, joint: int) -> bool:
        """Whether MuJoCo computes stiffness and damping of a joint from the inertia that it moves."""
        return joint in self._spring_dampers

    def refuse(self, element: Any, tag: str, name: str, reason: str, accepted: str) -> NoReturn:
        """Refuse an element of the specification, by its line. Raises UrdfError: always."""
        raise UrdfError(self.path, self.label(element, tag, name), reason, accepted)

    def label(self, element: Any, tag: str, name: str) -> str:
        """An element of the specification by tag, name and line: "<joint> 'knee', line 12 of leg.xml"."""
        line = _LINE.search(str(getattr(element, "info", "")))
        refers_to = [x for x in (getattr(element, key, "") for key in ("name1", "name2")) if x]
        where = self.text.where(tag, name, int(line[1]) if line else 0, refers_to)
        return f"<{tag}>{f' {name!r}' if name else ''}{where}"

    # ------------------------------------------------------------------------------------------------------ reading

    def _check_size(self) -> None:
        """Refuse a scene that takes long to compile, whatever part of it the robot is."""
        count = len(self.spec.bodies)
        if count > _MAX_SCENE_BODIES:
            raise UrdfError(self.path, "<body>", f"{count} bodies", f"at most {_MAX_SCENE_BODIES} in a scene")

    def _drop_files(self) -> tuple[list[tuple[Any, MeshShape]], list[Any]]:
        """Drop textures and such meshes as give no body its inertia.

        Returns:
            Geoms with the meshes that they name, and those geoms whose shape has been dropped.
        """
        spec = self.spec
        had = list[tuple[Any, MeshShape]]()
        kept = set[str]()
        dropped = list[Any]()
        spec.compiler.fusestatic = spec.compiler.discardvisual = False
        files = {mesh.name or Path(mesh.file).stem: mesh for mesh in spec.meshes}
        folder = Path(spec.compiler.meshdir or "")
        for body in spec.bodies:
            for geom in body.geoms:
                geom.material = ""
                field = geom.type == mujoco.mjtGeom.mjGEOM_HFIELD
                mesh = files.get(geom.meshname)
                if mesh is not None and mesh.file:
                    x, y, z = mesh.scale
                    had.append((geom, MeshShape(str(folder / mesh.file), (float(x), float(y), float(z)))))
                if (geom.meshname or field) and not self._gives_inertia(geom, body):
                    geom.type = mujoco.mjtGeom.mjGEOM_SPHERE
                    geom.meshname = ""
                    geom.hfieldname = ""
                    geom.size = [_PLACEHOLDER, 0.0, 0.0]
                    dropped.append(geom)
                elif geom.meshname:
                    kept.add(geom.meshname)
            for site in body.sites:
                site.material = ""
        for tendon in spec.tendons:
            tendon.material = ""
        for element in [
            *spec.skins,
            *spec.hfields,
            *(mesh for name, mesh in files.items() if name not in kept),
            *spec.materials,
            *spec.textures,
        ]:
            spec.delete(element)
        return had, dropped

    def _gives_inertia(self, geom: Any, body: Any) -> bool:
        """Whether a geom's shape enters the inertia of its body."""
        rule = int(self.spec.compiler.inertiafromgeom)
        never, always = (int(getattr(mujoco.mjtInertiaFromGeom, f"mjINERTIAFROMGEOM_{x}")) for x in ("FALSE", "TRUE"))
        if rule == never or (rule != always and body.explicitinertial) or body.name == MJCF_WORLD:
            return False
        low, high = self.spec.compiler.inertiagrouprange
        weightless = geom.mass == 0.0 if np.isfinite(geom.mass) else geom.density == 0.0
        return bool(low <= geom.group <= high and not weightless)

    def _largest_tree(self) -> tuple[int, list[int]]:
        """The base and the numbers of the bodies of the tree of most degrees of freedom.

        A tree is whatever one free joint carries, or all that moves on the world.
        """
        model = self.model
        trees: dict[int, list[int]] = {}
        for child in (i for i in range(1, model.nbody) if model.body_parentid[i] == 0):
            below = [i for i in range(child, model.nbody) if self._is_below(i, child)]
            if any(model.body_dofnum[i] for i in below):
                trees.setdefault(child if self.is_free(child) else 0, []).extend(below)
        if not trees:
            raise UrdfError(self.path, "<joint>", "none", "a model with a joint")
        dofs = {base: sum(int(model.body_dofnum[i]) for i in below) for base, below in trees.items()}
        most = [base for base in dofs if dofs[base] == max(dofs.values())]
        if len(most) > 1:
            reason = f"several trees with {max(dofs.values())} degrees of freedom: " + ", ".join(
                self.bodies[x] for x in most
            )
            raise UrdfError(self.path, "<worldbody>", reason, "one tree (the robot) with more than all others")
        if len(trees[most[0]]) > MAX_LINKS:
            raise UrdfError(self.path, "<body>", f"{len(trees[most[0]])} bodies", f"at most {MAX_LINKS}")
        return most[0], trees[most[0]]

    def _is_below(self, body: int, root: int) -> bool:
        while body > root:
            body = int(self.model.body_parentid[body])
        return body == root


@cache
def _try_to_read(path: Path, _: int) -> None:
    """Let the process with limits read a file first; `_`: when it was written."""
    accepted = "fewer elements, including those of hfield, replicate, composite and attach"
    try:
        with open_apart(_read_mjcf, path):
            pass
    except LogError as error:
        raise UrdfError(path, "MJCF", error.found, f"{accepted}; or {error.accepted}") from error
    except Exception as error:  # noqa: B902 - C++ raises what it likes, mostly as there is no memory
        reason = f"MuJoCo cannot read it ({excerpt(str(error))})"
        raise UrdfError(path, "MJCF", reason, accepted) from error


@contextmanager
def _read_mjcf(path: Path) -> Iterator[None]:
    """Read a file as MuJoCo does; what it says against one it says again to whoever reads it then."""
    with suppress(ValueError):
        mujoco.MjSpec.from_file(str(path))
    yield None


def pose(position: Array, quat_wxyz: Array) -> Array:
    """Pose (4, 4) [m] of a frame with an origin (3,) [m] and a unit quaternion."""
    T = np.eye(4)
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, quat_wxyz)
    T[:3, :3] = R.reshape(3, 3)
    T[:3, 3] = position
    return T


def mujoco_error(text: bytes, folder: Path) -> str:
    """What MuJoCo says against a model whose files lie relative to a folder, "" if it takes it."""
    try:
        spec = mujoco.MjSpec.from_string(text.decode())
        spec.modelfiledir = str(folder.absolute())
        spec.compile()
    except ValueError as error:
        return excerpt(" ".join(str(error).split()), 300)
    return ""


def parse_model(text: str) -> etree._Element:
    """The root of a model that MuJoCo has written."""
    return etree.fromstring(text.encode())


LOOPS = {"connect": "point", "weld": "weld"}
"""Type of the loop that an equality constraint closes, by its tag."""

_CLOSE = 0.02  # m/s^2: 9.8 and 9.81 are the same planet


def check_model(model: MjcfModel) -> None:
    """Refuse what makes forces on the robot's bodies beside gravity, joints' friction, armatures and springs.

    Raises:
        UrdfError: names the element and its line.

    Warns:
        TorchidWarning: the model's gravity is not the Earth's, which is used.
    """
    spec = model.spec
    members = {model.bodies[i] for i in model.members}
    for element in model.text.root.iter("inertial"):  # MuJoCo takes a NaN for an attribute that is not there
        if any(word.lower().lstrip("+-") in ("nan", "inf") for x in element.attrib.values() for word in x.split()):
            field = f"<inertial>, line {element.sourceline}"
            raise UrdfError(model.path, field, "a number is not finite", "finite numbers")
    for body in spec.bodies:
        if body.id in model.members:
            _check_body(model, body)
    for flex in spec.flexes:
        model.refuse(flex, "flex", flex.name, "a flexible body", "rigid bodies")
    for equality in spec.equalities:
        if equality.active and _touches(model, equality, members) and mimic_of(model, equality) is None:
            _check_equality(model, equality)
    _check_transmissions(model)
    _check_medium(model)


def _check_equality(model: MjcfModel, equality: Any) -> None:
    """Refuse all but closed loops, and what attaches the robot to something else."""
    kind = equality_kind(equality)
    if kind not in LOOPS:
        linear = {"joint": "only joint1 = c0 + c1 joint2", "tendon": "one fixed tendon of two joints"}
        accepted = linear.get(kind, "connect, weld, or a linear joint")
        model.refuse(equality, kind, equality.name, "an equality constraint", accepted)


def _check_body(model: MjcfModel, body: Any) -> None:
    if body.gravcomp:
        model.refuse(body, "body", body.name, f"gravcomp {body.gravcomp:g}", "gravcomp 0")
    if body.plugin.active:
        model.refuse(body, "body", body.name, "a plugin may exert forces", "no plugin")
    for joint in body.joints:
        _check_joint(model, joint)
        if joint.type.name == "mjJNT_FREE":
            _check_free_joint(model, joint)


def _check_joint(model: MjcfModel, joint: Any) -> None:
    if joint.type.name == "mjJNT_BALL":
        accepted = "hinge or slide; three hinges replace a ball"
        model.refuse(joint, "joint", joint.name, "type ball", accepted)
    values = {name: np.atleast_1d(getattr(joint, name)) for name in ("damping", "stiffness")}
    for name, value in values.items():
        if value[1:].any():
            model.refuse(joint, "joint", joint.name, f"{name} {_numbers(value)}", "one number")
        if np.abs(value).max() > MAX_NUMBER:
            accepted = f"at most {MAX_NUMBER:g}; remove a joint that cannot move"
            model.refuse(joint, "joint", joint.name, f"{name} {_numbers(value)}", accepted)


def _check_free_joint(model: MjcfModel, joint: Any) -> None:
    for name in ("armature", "damping", "frictionloss", "stiffness"):
        value = np.atleast_1d(getattr(joint, name))
        if value.any():
            reason = f"{name} {_numbers(value)} of a free joint"
            model.refuse(joint, "joint", joint.name, reason, f"{name} 0, or <freejoint/>")


def _check_transmissions(model: MjcfModel) -> None:
    """Refuse tendons and actuators that exert forces or have inertia by themselves; limits are as those of joints."""
    for tendon in model.spec.tendons:
        for name in ("stiffness", "damping", "frictionloss", "armature"):
            if np.any(getattr(tendon, name)):
                tag = _tendon_tag(model.model, tendon.id)
                accepted = "tendons without stiffness, damping, frictionloss and armature"
                model.refuse(tendon, tag, tendon.name, f"a tendon with {name}", accepted)
    for actuator in model.spec.actuators:
        for name in ("armature", "damping"):
            if np.any(getattr(actuator, name, 0.0)):  # MuJoCo has them since 3.5
                accepted = f"{name} of the joint, or no {name}"
                model.refuse(
                    actuator, _actuator_tag(model, actuator), actuator.name, f"{name} of an actuator", accepted
                )


def _check_medium(model: MjcfModel) -> None:
    option = model.model.opt
    for name in ("density", "viscosity"):
        if getattr(option, name):
            element = next((x for x in model.text.root.iter("option") if x.get(name)), None)
            line = "" if element is None else f", line {element.sourceline}"
            raise UrdfError(model.path, f"<option>{line}", f"{name} {getattr(option, name):g}", f"{name} 0 (no fluid)")
    off = option.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
    gravity = np.zeros(3) if off else option.gravity
    if np.abs(gravity - [0.0, 0.0, -GRAVITY]).max() > _CLOSE:
        warn(f"{model.path}: gravity {_numbers(gravity)}; torchid uses the Earth's, along -z")


def mimic_of(model: MjcfModel, equality: Any) -> tuple[str, str, float, float] | None:
    """Follower, master, multiplier and offset [rad or m] of two joints that an equality couples linearly; else None.

    MuJoCo's polynomial is of deviations from the joints' reference positions.
    """
    if equality_kind(equality) == "tendon" and equality.active:
        return _mimic_of_tendon(model, equality)
    if equality_kind(equality) != "joint" or not (equality.active and equality.name1 and equality.name2):
        return None
    c0, c1, *higher = equality.data[:5]
    if any(higher) or not c1:
        return None
    follower, master = (model.model.joint(name) for name in (equality.name1, equality.name2))
    reference = [float(model.model.qpos0[int(joint.qposadr[0])]) for joint in (follower, master)]
    return equality.name1, equality.name2, float(c1), float(c0 + reference[0] - c1 * reference[1])


def _mimic_of_tendon(model: MjcfModel, equality: Any) -> tuple[str, str, float, float] | None:
    """As `mimic_of`, of the two joints of a fixed tendon of constant length; the second follows the first."""
    compiled = model.model
    tendon = int(model.model.eq_obj1id[equality.id])
    wraps = slice(int(compiled.tendon_adr[tendon]), int(compiled.tendon_adr[tendon] + compiled.tendon_num[tendon]))
    if equality.name2 or list(compiled.wrap_type[wraps]) != [int(mujoco.mjtWrap.mjWRAP_JOINT)] * 2:
        return None
    (master, follower), (a, b) = map(int, compiled.wrap_objid[wraps]), map(float, compiled.wrap_prm[wraps])
    if not b:
        return None
    start, end = (float(compiled.qpos0[int(compiled.jnt_qposadr[joint])]) for joint in (master, follower))
    return model.joints[follower], model.joints[master], -a / b, end + (float(equality.data[0]) + a * start) / b


def _touches(model: MjcfModel, equality: Any, members: set[str]) -> bool:
    """Whether an equality constraint is on a body or joint of the robot, or on what is neither."""
    names = [name for name in (equality.name1, equality.name2) if name]
    kind = equality.objtype.name.removeprefix("mjOBJ_").lower()
    if equality_kind(equality) == "joint":
        on = {model.bodies[int(model.model.jnt_bodyid[i])] for i, name in enumerate(model.joints) if name in names}
    elif kind == "body":
        on = set(names)
    elif kind == "site":
        on = {model.bodies[int(model.model.site(name).bodyid[0])] for name in names}
    else:
        return True
    return bool(on & members)


def is_held(model: MjcfModel, equality: Any) -> bool:
    """Whether an equality constraint is active and holds a body of the robot to another body, of the robot or not."""
    if not equality.active or equality_kind(equality) not in LOOPS:
        return False
    return not {*model.members}.isdisjoint(loop_bodies(model, equality))


def loop_bodies(model: MjcfModel, equality: Any) -> tuple[int, int]:
    """Numbers of both bodies that a `connect` or `weld` keeps together."""
    compiled = model.model
    sites = equality.objtype.name == "mjOBJ_SITE"
    first = int(compiled.eq_obj1id[equality.id])
    second = int(compiled.eq_obj2id[equality.id])
    return (int(compiled.site_bodyid[first]), int(compiled.site_bodyid[second])) if sites else (first, second)


def loop_frames(model: MjcfModel, equality: Any) -> tuple[Array, Array]:
    """Poses (4, 4) [m], in their bodies, of both frames that a `connect` or `weld` keeps together.

    As `mj_instantiateEqual` has them: of bodies, the anchor of a connect in the first and in the second, and that of a
    weld in the second and in the first, with the second body's orientation in the first.
    """
    compiled = model.model
    data = model.model.eq_data[equality.id]
    if equality.objtype.name == "mjOBJ_SITE":
        sites = (int(x[equality.id]) for x in (compiled.eq_obj1id, compiled.eq_obj2id))
        first, second = (pose(compiled.site_pos[site], compiled.site_quat[site]) for site in sites)
        return first, second
    level = np.array([1.0, 0.0, 0.0, 0.0])
    if equality_kind(equality) == "connect":
        return pose(data[:3], level), pose(data[3:6], level)
    return pose(data[3:6], data[6:10]), pose(data[:3], level)


def driven_joints(model: MjcfModel) -> set[str] | None:
    """Names of the joints that actuators drive; None where some drive what is no joint, or there are none."""
    compiled = model.model
    driven = set[int]()
    kinds = mujoco.mjtTrn
    for kind, (target, _) in zip(compiled.actuator_trntype, compiled.actuator_trnid, strict=True):
        if int(kind) in map(int, (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT)):
            driven.add(int(target))
        elif int(kind) == int(kinds.mjTRN_TENDON):
            first = int(compiled.tendon_adr[target])
            count = int(compiled.tendon_num[target])
            if (compiled.wrap_type[first : first + count] != int(mujoco.mjtWrap.mjWRAP_JOINT)).any():
                return None
            driven.update(map(int, compiled.wrap_objid[first : first + count]))
        else:
            return None
    return {model.joints[joint] for joint in driven} or None


def equality_kind(equality: Any) -> str:
    """Tag of an equality constraint."""
    return str(equality.type.name).removeprefix("mjEQ_").lower()


def _tendon_tag(model: mujoco.MjModel, tendon: int) -> str:
    """Tag of a tendon, by its number."""
    first = int(model.wrap_type[model.tendon_adr[tendon]])
    return "fixed" if first == int(mujoco.mjtWrap.mjWRAP_JOINT) else "spatial"


def _actuator_tag(model: MjcfModel, actuator: Any) -> str:
    """Tag of an actuator, by its name."""
    sections = model.text.root.iter("actuator")
    named = (str(x.tag) for section in sections for x in section if x.get("name", "") == actuator.name)
    return next(named, "actuator")


def _numbers(values: Any) -> str:
    return " ".join(f"{x:g}" for x in np.atleast_1d(values))


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
        self.model = model
        self.root = etree.Element("robot", name=model.path.stem)
        self._links = set[str]()
        self._joints = set(model.joints)
        members = [model.base, *(i for i in model.members if i != model.base)]
        self._taken = {model.bodies[i] for i in members}
        self._by_body = {body.id: body for body in model.spec.bodies}
        mimics = (mimic_of(model, equality) for equality in model.spec.equalities)
        self._mimics = {mimic[0]: mimic[1:] for mimic in mimics if mimic is not None}
        for body in members:
            self._add_body(body)
        for body in members if model.base else members[1:]:
            self._add_shapes(body)
        self._add_loops()

    def _add_body(self, body: int) -> None:
        model = self.model
        name = self.model.bodies[body]
        before = model.bodies[int(model.model.body_parentid[body])]
        T = model.pose(body)
        joints = model.joints_of(body)
        for joint in joints:
            last = joint == joints[-1]
            link = name if last else f"{name}/{model.joints[joint]}"
            if not last:
                self._add_link(link)
            self._add_joint(joint, before, link, T)
            before = link
            T = np.eye(4)
        if body != model.base and not joints:
            self._weld(before, name, T)
        self._add_link(name, body if body else None)

    def _add_link(self, name: str, body: int | None = None) -> etree._Element:
        link = etree.SubElement(self.root, "link", name=name)
        if body is not None and self.model.model.body_mass[body] > 0.0:
            compiled = self.model.model
            inertial = etree.SubElement(link, "inertial")
            _add_origin(inertial, pose(compiled.body_ipos[body], compiled.body_iquat[body]))
            etree.SubElement(inertial, "mass", value=repr(float(compiled.body_mass[body])))
            numbers = np.diag(compiled.body_inertia[body])
            names = {f"i{'xyz'[row]}{'xyz'[k]}": repr(float(numbers[row, k])) for row, k in INERTIA_AXES}
            etree.SubElement(inertial, "inertia", names)
        return link

    def _add_joint(self, joint: int, parent: str, child: str, T_parent_body: Array) -> None:
        """A joint about an anchor that may be off the body's origin, at position 0 in its frame."""
        model = self.model
        compiled = self.model.model
        slides = model.slides(joint)
        dof = int(compiled.jnt_dofadr[joint])
        address = int(compiled.jnt_qposadr[joint])
        anchor = compiled.jnt_pos[joint]
        axis = compiled.jnt_axis[joint]
        reference = float(compiled.qpos0[address])
        limited = bool(compiled.jnt_limited[joint])
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
            low, high = map(float, compiled.jnt_range[joint])
            etree.SubElement(element, "limit", lower=repr(low), upper=repr(high), effort="0", velocity="0")
        damping = float(compiled.dof_damping[dof])
        friction = float(compiled.dof_frictionloss[dof])
        dynamics = etree.SubElement(element, "dynamics", damping=repr(damping), friction=repr(friction))
        beyond_urdf = {"armature": compiled.dof_armature[dof], "stiffness": compiled.jnt_stiffness[joint]}
        if beyond_urdf["stiffness"]:
            beyond_urdf["rest"] = compiled.qpos_spring[address]
        for name, value in beyond_urdf.items():
            if value:
                dynamics.set(OWN + name, repr(float(value)))
        if (mimic := self._mimics.get(model.joints[joint])) is not None:
            master, multiplier, offset = mimic
            attributes = {"joint": master, "multiplier": repr(multiplier), "offset": repr(offset)}
            etree.SubElement(element, "mimic", attributes)

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
        model = self.model
        compiled = self.model.model
        spec = self._by_body[body]
        for site in spec.sites:
            if site.name:
                self._frame(body, site.name, "site", pose(compiled.site_pos[site.id], compiled.site_quat[site.id]))
        for geom in spec.geoms:
            T = pose(compiled.geom_pos[geom.id], compiled.geom_quat[geom.id])
            collides = bool(geom.contype or geom.conaffinity)
            link = self.root.find(f"link[@name={_quoted(model.bodies[body])}]")
            origin = T
            shape = self._shape(geom.id)
            if geom.name and collides and shape is not None:
                link = self._frame(body, geom.name, "geom", T)
                origin = np.eye(4)
            if shape is not None and link is not None:
                element = etree.SubElement(link, "collision" if collides else "visual")
                _add_origin(element, origin if geom.id not in model.meshes else origin @ self._mesh_frame(geom.id))
                etree.SubElement(element, "geometry").append(shape)

    def _add_loops(self) -> None:
        """Loops and what else holds the robot, with links for their frames, and which joints no motor drives."""
        model = self.model
        for number, held in enumerate((x for x in model.spec.equalities if is_held(model, x)), start=1):
            name = held.name or f"loop{number}"
            poses = loop_frames(model, held)
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
        compiled = self.model.model
        mesh = int(self.model.model.geom_dataid[geom])
        return (
            np.eye(4)
            if mesh < 0
            else np.asarray(np.linalg.inv(pose(compiled.mesh_pos[mesh], compiled.mesh_quat[mesh])))
        )

    def _shape(self, geom: int) -> etree._Element | None:
        compiled = self.model.model
        mesh = self.model.meshes.get(geom)
        if mesh is not None:
            return etree.Element("mesh", filename=mesh.file, scale=_text(mesh.scale))
        kind = _SHAPES.get(self.model.geom_kind(geom))
        size = [float(x) for x in compiled.geom_size[geom]]
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
    c = np.cos(yaw)
    s = np.sin(yaw)
    pitch = float(np.arctan2(-R[2, 0], c * R[0, 0] + s * R[1, 0]))
    roll = float(np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1]))
    return roll, pitch, yaw
