"""URDFs: of a made-up arm, the one that is given, and the true one, whose links are other bodies."""

from __future__ import annotations

import shutil
import sysconfig
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lxml import etree
from scipy.spatial.transform import Rotation

from torchid.parameters import Array

ROBOTS = Path(sysconfig.get_path("purelib")) / "cmeel.prefix/share/example-robot-data"
_LIGHT = 1e-3  # kg: what weighs less is there to please simulators, and has impossible inertias
_LEAST = 1e-3  # of a body's largest second moment: true bodies are no discs or rods, which some URDFs have
_ENTRIES = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}


@dataclass(frozen=True)
class Payload:
    """Something on a link that the given URDF lacks: masses [kg] and places [m] are drawn from these ranges."""

    link: str
    mass: tuple[float, float]
    reach: float = 0.08


def serial_arm(name: str, lengths: Sequence[float], masses: Sequence[float], axes: str) -> str:
    """URDF of an arm of rods along z, each turning about an axis of the one before: "z", "y", ..."""
    parts = [f'<robot name="{name}">', '<link name="base"/>']
    ends = [0.0, *lengths]
    for k, (length, mass, axis) in enumerate(zip(lengths, masses, axes, strict=True), start=1):
        across, along = mass * (length**2 / 12.0 + 0.0012), mass * 0.0016
        xyz = " ".join(str(float(letter == axis)) for letter in "xyz")
        parent = f"l{k - 1}" if k > 1 else "base"
        effort = 20.0 * (1 + len(lengths) - k)
        parts.append(
            f'<link name="l{k}"><inertial><origin xyz="0.01 0.005 {0.5 * length:.6g}"/><mass value="{mass}"/>'
            f'<inertia ixx="{across:.6g}" ixy="0" ixz="0" iyy="{across:.6g}" iyz="0" izz="{along:.6g}"/></inertial>'
            f'</link><joint name="j{k}" type="revolute"><parent link="{parent}"/><child link="l{k}"/>'
            f'<origin xyz="0 0 {ends[k - 1]:.6g}"/><axis xyz="{xyz}"/>'
            f'<limit lower="-2.5" upper="2.5" effort="{effort:g}" velocity="4"/></joint>'
        )
    return "\n".join([*parts, "</robot>"])


def write_given(source: Path | str, folder: Path) -> Path:
    """The URDF that a user has, without pictures; meshes of feet are copied beside it, others left out."""
    root = etree.fromstring(source) if isinstance(source, str) else etree.parse(str(source)).getroot()
    etree.strip_tags(root, etree.Comment)
    for link in root.findall("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            mesh = shape.find("geometry/mesh")
            if shape.tag == "visual" or (mesh is not None and "foot" not in link.get("name", "").lower()):
                link.remove(shape)
            elif mesh is not None:
                file = ROBOTS / mesh.get("filename", "").removeprefix("package://example-robot-data/")
                shutil.copy(file, folder / file.name)
                mesh.set("filename", file.name)
    path = folder / "robot.urdf"
    path.write_bytes(etree.tostring(root, pretty_print=True))
    return path


def write_true(given: Path, rng: np.random.Generator, share: float, payload: Payload | None) -> dict[str, float]:
    """The true URDF beside the given one: every link off by up to a share, all can exist. Returns the links' masses."""
    root = etree.parse(str(given)).getroot()
    masses = {}
    for link in root.findall("link"):
        name, inertial = str(link.get("name")), link.find("inertial")
        loaded = payload is not None and payload.link == name
        if inertial is None:
            continue
        if float(inertial.find("mass").get("value")) < _LIGHT and not loaded:
            link.remove(inertial)
            continue
        mass, com, inertia = _unlike(*_read(inertial), rng, share)
        if loaded and payload is not None:
            mass, com, inertia = _with_load(mass, com, inertia, payload, rng)
        _write(inertial, mass, com, inertia)
        masses[name] = mass
    (given.parent / "true.urdf").write_bytes(etree.tostring(root))
    return masses


def state_friction(urdf: Path, joints: Sequence[str], friction: Array) -> None:
    """Write Coulomb and viscous friction (n, 2) of joints into a URDF."""
    root = etree.parse(str(urdf)).getroot()
    for joint in root.findall("joint"):
        if joint.get("name") in joints:
            for old in joint.findall("dynamics"):
                joint.remove(old)
            coulomb, viscous = friction[joints.index(joint.get("name"))]
            etree.SubElement(joint, "dynamics", friction=repr(float(coulomb)), damping=repr(float(viscous)))
    urdf.write_bytes(etree.tostring(root))


def _unlike(
    mass: float, com: Array, inertia: Array, rng: np.random.Generator, share: float
) -> tuple[float, Array, Array]:
    """Another body: mass, centre of mass, second moments along its principal axes and these axes are off."""
    moments, axes = np.linalg.eigh(inertia)
    second = np.maximum(0.5 * moments.sum() - moments, 0.0)
    second = np.maximum(second, _LEAST * second.max())
    factor = 1.0 + share * rng.uniform(-1.0, 1.0)
    second = second * factor * (1.0 + share * rng.uniform(-1.0, 1.0, 3))
    com = com + share * np.sqrt(0.5 * moments.sum() / mass) * rng.uniform(-1.0, 1.0, 3)
    axes = Rotation.from_rotvec(share * rng.uniform(-1.0, 1.0, 3)).as_matrix() @ axes
    return factor * mass, com, axes @ np.diag(second.sum() - second) @ axes.T


def _with_load(
    mass: float, com: Array, inertia: Array, payload: Payload, rng: np.random.Generator
) -> tuple[float, Array, Array]:
    load, place = rng.uniform(*payload.mass), payload.reach * rng.uniform(-1.0, 1.0, 3)
    total = mass + load
    middle = (mass * com + load * place) / total
    inertia = inertia + load * 0.03**2 * np.eye(3)
    for m, point in ((mass, com - middle), (load, place - middle)):
        inertia = inertia + m * (point @ point * np.eye(3) - np.outer(point, point))
    return total, middle, inertia


def _read(inertial: etree._Element) -> tuple[float, Array, Array]:
    """Mass, centre of mass, and inertia about it along the link's axes."""
    origin = inertial.find("origin")
    xyz, rpy = ("0 0 0",) * 2 if origin is None else (origin.get("xyz", "0 0 0"), origin.get("rpy", "0 0 0"))
    turn = Rotation.from_euler("xyz", [float(x) for x in rpy.split()]).as_matrix()
    inertia, entries = np.zeros((3, 3)), inertial.find("inertia")
    for name, at in _ENTRIES.items():
        inertia[at] = inertia[at[::-1]] = float(entries.get(name, 0.0))
    com = np.array([float(x) for x in xyz.split()])
    return float(inertial.find("mass").get("value")), com, turn @ inertia @ turn.T


def _write(inertial: etree._Element, mass: float, com: Array, inertia: Array) -> None:
    for old in list(inertial):
        inertial.remove(old)
    etree.SubElement(inertial, "origin", xyz=" ".join(repr(float(x)) for x in com), rpy="0 0 0")
    etree.SubElement(inertial, "mass", value=repr(float(mass)))
    values = {name: repr(float(inertia[at])) for name, at in _ENTRIES.items()}
    etree.SubElement(inertial, "inertia", values)
