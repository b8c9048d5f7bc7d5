"""An MJCF file: its text with what it includes, and MuJoCo's own reading of it without meshes and textures.

Imports MuJoCo, an extra, for all modules that need it.
"""

from __future__ import annotations

import copy
import os
import re
import subprocess
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from lxml import etree

from torchid.errors import InputError, UrdfError, excerpt, how_to_install
from torchid.guards import MAX_LINKS
from torchid.parameters import Array, inertial_vector
from torchid.robot.xml_files import MJCF_WORLD, read_xml

try:
    import mujoco
except ImportError as error:
    found = "need MuJoCo, which " + ("is not installed" if error.name == "mujoco" else f"does not load: {error}")
    raise InputError("", "simulation and MJCF", found, how_to_install("sim")) from error

mujoco.set_mju_user_warning(lambda _: None)  # MuJoCo would write a log file where it runs

__all__ = ["MeshShape", "MjcfModel", "MjcfText", "body_elements", "mujoco_error", "mujoco", "parse_model", "pose"]

_MOST_FILES = 100
_LONGEST_TAG = 20  # lines
_MULTIPLYING = ("replicate", "attach", "composite", "flexcomp")
_TRIAL = """
import sys, mujoco
try:
    import resource
    for kind, most in ((resource.RLIMIT_AS, 2**30), (resource.RLIMIT_CPU, 10), (resource.RLIMIT_CORE, 0)):
        resource.setrlimit(kind, (most, most))
    mujoco.MjSpec.from_file(sys.argv[1])
except (ImportError, ValueError):
    pass
"""


class MjcfText:
    """An MJCF file and all that it includes.

    `root` is one tree in which the included elements stand in place of `<include>`.
    """

    def __init__(self, path: Path) -> None:
        """Read the files. Raises UrdfError: one of them is missing, or no well-formed XML, or there are too many."""
        self.path, self._files = path, dict[Path, etree._Element]()
        self.root = self._expanded(path, "mujoco")

    @property
    def multiplies(self) -> bool:
        """Whether MuJoCo makes bodies that no element of its own stands for."""
        return any(True for _ in self.root.iter(*_MULTIPLYING))

    def where(self, tag: str, name: str, line: int, refers_to: Sequence[str] = ()) -> str:
        """Line of an element, ", line 12 of arm.xml", with the file if it is an included one; "" if it is not found.

        Args:
            tag: of the element.
            name: "" for none.
            line: by MuJoCo, which knows it of the main file alone, or 0.
            refers_to: names in its attributes.
        """
        for file, root in self._files.items():
            for element in root.iter(tag):
                at = element.sourceline or 0  # where the start tag ends, which may go over several lines
                is_near = 0 <= at - line <= _LONGEST_TAG if line else set(refers_to) <= set(element.attrib.values())
                if (element.get("name") or "") == name and is_near and not _is_default(element):
                    return f", line {line or at}" + ("" if file == self.path else f" of {file.name}")
        return f", line {line}" if line else ""

    def names(self, bodies: Sequence[str], joints: Sequence[tuple[int, str]]) -> tuple[list[str], list[str]]:
        """Names of bodies and joints by their numbers, made up where they have none.

        Args:
            bodies: names or "", depth first, the world first.
            joints: number of the body that each moves, and name or "".
        """
        named = list(bodies)
        for number, name in enumerate(bodies):
            named[number] = name or _unused(f"body{number}", {*named, *bodies})
        out, taken = list[str](), {name for _, name in joints}
        for body, name in joints:
            out.append(name or _unused(f"{named[body]}_joint", taken))
            taken.add(out[-1])
        return named, out

    def _expanded(self, path: Path, root: str) -> etree._Element:
        if len(self._files) >= _MOST_FILES:
            raise UrdfError(self.path, "<include>", f"more than {_MOST_FILES} files", "fewer")
        if path in self._files:
            raise UrdfError(self.path, "<include>", f"{path.name} more than once", "every file once")
        self._files[path] = read_xml(path, root).getroot()
        out = copy.deepcopy(self._files[path])
        for include in list(out.iter("include")):
            parent = include.getparent()
            if parent is None:
                continue
            inner = self._expanded(self._included(path, str(include.get("file", ""))), "")
            at = parent.index(include)
            parent[at : at + 1] = list(inner)
        return out

    def _included(self, by: Path, file: str) -> Path:
        """The file that another includes: beside it, or else beside the main one; UrdfError where there is none."""
        found = next((path for path in (by.parent / file, self.path.parent / file) if path.is_file()), None)
        if found is None:
            accepted = f"a file beside {' or '.join(dict.fromkeys((by.name, self.path.name)))}"
            raise UrdfError(by, "<include>", f"'{excerpt(file)}', which is not there", accepted)
        return found


def body_elements(root: etree._Element) -> list[tuple[etree._Element, list[etree._Element]]]:
    """Elements of the bodies of a model, depth first, each with those of its joints; the world is the first.

    That is the order in which MuJoCo numbers them; frames do not count.
    """
    out: list[tuple[etree._Element, list[etree._Element]]] = [(etree.Element("worldbody"), [])]
    for world in root.findall("worldbody"):
        _collect(world, out[0][1], out)
    return out


def _collect(
    element: etree._Element, joints: list[etree._Element], out: list[tuple[etree._Element, list[etree._Element]]]
) -> None:
    bodies = []
    for child in _through_frames(element):
        if child.tag in ("joint", "freejoint"):
            joints.append(child)
        else:
            bodies.append(child)
    for body in bodies:
        out.append((body, []))
        _collect(body, out[-1][1], out)


def _through_frames(element: etree._Element) -> Iterator[etree._Element]:
    """Bodies and joints of an element, those in frames too, in order."""
    for child in element.iterchildren("body", "joint", "freejoint", "frame"):
        if child.tag == "frame":
            yield from _through_frames(child)
        else:
            yield child


def _is_default(element: etree._Element) -> bool:
    return any(above.tag == "default" for above in element.iterancestors())


def _unused(name: str, taken: set[str]) -> str:
    number, out = 2, name
    while out in taken:
        out, number = f"{name}_{number}", number + 1
    return out


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
        self.path, self.text = path, MjcfText(path)
        if next(self.text.root.iter(*_MULTIPLYING, "model", "hfield"), None) is not None:
            _try_to_read(path, path.stat().st_mtime_ns)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # of MuJoCo, about elements that it will not have for ever
                self.spec = mujoco.MjSpec.from_file(str(path))
                meshes, dropped = self._drop_files()
                self.model = self.spec.compile()
        except ValueError as error:
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
        first, count = int(self.model.body_jntadr[body]), int(self.model.body_jntnum[body])
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
        of = self.model
        R = pose(np.zeros(3), of.body_iquat[body])[:3, :3]
        about_com = R @ np.diag(of.body_inertia[body]) @ R.T
        return inertial_vector(float(of.body_mass[body]), of.body_ipos[body], about_com)

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

    def refuse(self, element: Any, tag: str, name: str, found: str, accepted: str) -> NoReturn:
        """Refuse an element of the specification, by its line. Raises UrdfError: always."""
        raise UrdfError(self.path, self.label(element, tag, name), found, accepted)

    def label(self, element: Any, tag: str, name: str) -> str:
        """An element of the specification by tag, name and line: "<joint> 'knee', line 12 of leg.xml"."""
        line = _LINE.search(str(getattr(element, "info", "")))
        refers_to = [x for x in (getattr(element, key, "") for key in ("name1", "name2")) if x]
        where = self.text.where(tag, name, int(line[1]) if line else 0, refers_to)
        return f"<{tag}>{f' {name!r}' if name else ''}{where}"

    # ------------------------------------------------------------------------------------------------------ reading

    def _drop_files(self) -> tuple[list[tuple[Any, MeshShape]], list[Any]]:
        """Drop textures and such meshes as give no body its inertia.

        Returns:
            Geoms with the meshes that they name, and those geoms whose shape has been dropped.
        """
        spec, had, kept, dropped = self.spec, list[tuple[Any, MeshShape]](), set[str](), list[Any]()
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
                    geom.type, geom.meshname, geom.hfieldname = mujoco.mjtGeom.mjGEOM_SPHERE, "", ""
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
            found = f"several trees of {max(dofs.values())} degrees of freedom: " + ", ".join(
                self.bodies[x] for x in most
            )
            raise UrdfError(self.path, "<worldbody>", found, "one that has more than the others, the robot")
        if len(trees[most[0]]) > MAX_LINKS:
            raise UrdfError(self.path, "<body>", f"{len(trees[most[0]])} of them", f"at most {MAX_LINKS}")
        return most[0], trees[most[0]]

    def _is_below(self, body: int, root: int) -> bool:
        while body > root:
            body = int(self.model.body_parentid[body])
        return body == root


@cache
def _try_to_read(path: Path, _: int) -> None:
    """Let another process read a file that may stand for far more than it holds; `_`: when it was written last."""
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "PYTHONSAFEPATH": "1"}  # threads take address space
    if subprocess.run([sys.executable, "-c", _TRIAL, str(path)], env=environment, capture_output=True).returncode:
        found = "MuJoCo crashes as it reads it, or needs more than 1 GiB or 10 s"
        raise UrdfError(path, "MJCF", found, "a smaller model: see hfield, replicate, composite, model")


def pose(position: Array, quat_wxyz: Array) -> Array:
    """Pose (4, 4) [m] of a frame with an origin (3,) [m] and a unit quaternion."""
    T, R = np.eye(4), np.zeros(9)
    mujoco.mju_quat2Mat(R, quat_wxyz)
    T[:3, :3], T[:3, 3] = R.reshape(3, 3), position
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
