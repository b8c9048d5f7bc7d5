"""Compare torchid's reading and writing of MJCF files with MuJoCo, file by file.

    python scripts/survey_mjcf.py --table survey.md g1.xml humanoid.xml robot.urdf

Of every file: inverse dynamics at random states against `mj_inverse` (with armatures, damping and springs, without
constraints), what is read of the file that is written, and `mj_inverse` of this file, with perturbed parameters,
against K phi + armature * acceleration + friction. A URDF is saved as MJCF by MuJoCo first. Or what refuses it.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import torch
from lxml import etree
from scipy.spatial.transform import Rotation

from torchid import Regressor, load_robot
from torchid.errors import TorchidWarning
from torchid.parameters import FRICTION, INERTIA, Array, perturb_parameters
from torchid.report.mjcf_files import identified_mjcf
from torchid.robot import Robot
from torchid.robot.mjcf import MjcfModel
from torchid.robot.urdf import has_fixed_base, parse_xml

_STATES = 5


@dataclass(frozen=True)
class States:
    """Random states as the regressor has them: (B, 7 + n) or (B, n), and twice (B, nv)."""

    q: Array
    v: Array
    a: Array

    @classmethod
    def random(cls, robot: Robot, count: int = _STATES, seed: int = 0) -> States:
        """Some states."""
        rng = np.random.default_rng(seed)
        q = rng.uniform(-1.0, 1.0, (count, robot.n))
        if not robot.fixed_base:
            q = np.hstack([rng.normal(size=(count, 3)), Rotation.random(count, rng).as_quat(), q])
        return cls(q, rng.normal(size=(count, robot.nv)), 3.0 * rng.normal(size=(count, robot.nv)))


def torchid_forces(robot: Robot, phi: Array, armature: Array, states: States) -> Array:
    """K phi with the torques of armatures (n,) and of the file's springs, (B, nv)."""
    K = Regressor(robot)(*(torch.tensor(x) for x in (states.q, states.v, states.a)))
    forces = np.asarray((K @ torch.tensor(phi.flatten())).numpy(), dtype=np.float64)
    joints = slice(robot.base_rows, None)
    position = states.q[:, 7 if robot.base_rows else 0 :]
    forces[:, joints] += armature * states.a[:, joints] + robot.stiffness * position + robot.spring_torque
    return forces


def mujoco_forces(source: MjcfModel, robot: Robot, states: States) -> Array:
    """`mj_inverse` without constraints and with dry friction as MuJoCo reads it, in torchid's rows, (B, nv).

    MuJoCo has linear velocities and accelerations of a free base along the world's axes, angular ones along the base's.
    """
    model = source.model
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.opt.gravity = [0.0, 0.0, -9.81]
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)  # as torchid, which warns of it
    data, base, (matrix, constant), out = mujoco.MjData(model), robot.base_rows, robot.joint_map, []
    ids = [source.joints.index(body.joint.name) for body in robot.bodies if body.joint is not None]
    at, rate = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
    free = int(model.body_jntadr[source.base]) if base else -1
    for q, v, a in zip(states.q, states.v, states.a, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[at] = matrix @ q[7 if base else 0 :] + constant
        data.qvel[rate], data.qacc[rate] = matrix @ v[base:], matrix @ a[base:]
        R = np.eye(3)
        if base:
            R, start, dof = Rotation.from_quat(q[3:7]).as_matrix(), model.jnt_qposadr[free], model.jnt_dofadr[free]
            data.qpos[start : start + 7] = [*q[:3], q[6], *q[3:6]]
            data.qvel[dof : dof + 6] = [*(R @ v[:3]), *v[3:6]]
            data.qacc[dof : dof + 6] = [*(R @ (a[:3] + np.cross(v[3:6], v[:3]))), *a[3:6]]
        mujoco.mj_inverse(model, data)
        joints = matrix.T @ (data.qfrc_inverse[rate] + model.dof_frictionloss[rate] * np.sign(data.qvel[rate]))
        of_base = data.qfrc_inverse[dof : dof + 6] if base else np.zeros(0)
        out.append([*(R.T @ of_base[:3]), *of_base[3:], *joints] if base else joints)
    return np.array(out)


def difference(one: Array, other: Array) -> float:
    """Largest difference over the largest number of its column, (B, n) both: a joint's damping may be 1e11."""
    off, largest = np.abs(one - other).max(axis=0), np.abs(other).max(axis=0)
    return float(np.divide(off, largest, out=off, where=largest > 0.0).max(initial=0.0))


def largest_change(phi: Array, before: Array) -> float:
    """Largest relative change of a mass, first moment, inertia about the link's origin or friction, (L, 12) both."""
    blocks = [slice(0, 1), slice(1, 4), INERTIA, slice(10, 11), slice(11, 12)]
    pairs = ((one[block], other[block]) for one, other in zip(phi, before, strict=True) for block in blocks)
    return max(float(np.linalg.norm(one - other) / np.linalg.norm(other)) for one, other in pairs if other.any())


def perturbed(robot: Robot, seed: int = 1) -> tuple[Array, dict[str, float]]:
    """Consistent parameters near the nominal ones, with friction, and armatures by joint."""
    rng = np.random.default_rng(seed)
    phi = perturb_parameters(robot.nominal, 0.2, rng)
    moved = [k for k, body in enumerate(robot.bodies) if body.joint is not None and body.joint.kind != "fixed"]
    phi[moved, FRICTION] = robot.nominal[moved, FRICTION] + rng.uniform(0.1, 1.0, (len(moved), 2))
    if robot.fixed_base:
        phi[0] = robot.nominal[0]
    return phi, {name: float(robot.armature[k] + x) for k, (name, x) in enumerate(_named(robot, rng))}


def _named(robot: Robot, rng: np.random.Generator) -> list[tuple[str, float]]:
    return list(zip(robot.joint_names, rng.uniform(0.01, 0.1, robot.n), strict=True))


@dataclass(frozen=True)
class Survey:
    """What was found of a file: largest relative differences, or why it is refused."""

    name: str
    robot: Robot | None = None
    inverse_dynamics: float = np.nan
    read_again: float = np.nan
    written: float = np.nan
    refusal: str = ""

    def row(self) -> str:
        """A row of the table."""
        if self.robot is None:
            return f"| {self.name} | | | | refused: {self.refusal} |"
        numbers = " | ".join(f"{x:.1e}" for x in (self.inverse_dynamics, self.read_again, self.written))
        return f"| {self.name} | {self.robot.nv} | {numbers} |"


def survey(path: Path, folder: Path) -> Survey:
    """Compare one file; `folder` for what is written."""
    try:
        robot = load_robot(path, fixed_base=has_fixed_base(path))
    except ValueError as error:
        return Survey(path.name, refusal=str(error).replace(f"{path}: ", ""))
    states = States.random(robot)
    read = mujoco_forces(MjcfModel(path), robot, states)
    found = difference(torchid_forces(robot, robot.nominal, robot.armature, states), read)
    phi, armature = perturbed(robot)
    file = folder / f"{path.stem}.xml"
    file.write_bytes(_finding_meshes(identified_mjcf(robot, phi, armature), path))
    again = load_robot(file, fixed_base=robot.fixed_base)
    by_joint = np.array([armature[name] for name in robot.joint_names])
    written = difference(mujoco_forces(MjcfModel(file), robot, states), torchid_forces(robot, phi, by_joint, states))
    same = max(largest_change(again.nominal, phi), difference(again.armature[None], by_joint[None]))
    return Survey(path.name, robot, found, same, written)


def _finding_meshes(text: bytes, source: Path) -> bytes:
    """A model that is not beside the file that it was made of, with the full path of its meshes."""
    root = etree.fromstring(text)
    compilers = root.findall("compiler") or [etree.SubElement(root, "compiler")]
    for compiler in compilers:
        named = compiler.get("meshdir") or compiler.get("assetdir") or ""
        compiler.set("meshdir", str(source.resolve().parent / named))
    return etree.tostring(root)


def saved_by_mujoco(urdf: Path, folder: Path) -> Path:
    """MJCF of a URDF without shapes, whose files may be anywhere, as MuJoCo saves it, bolted to the world.

    Raises:
        ValueError: it does not.
    """
    root = parse_xml(urdf).getroot()
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    spec = mujoco.MjSpec.from_string(etree.tostring(root, encoding="unicode"))
    spec.compile()
    file = folder / f"{urdf.stem}.xml"
    file.write_text(spec.to_xml())
    return file


def survey_all(paths: Sequence[Path]) -> list[Survey]:
    """Compare files; a URDF only if MuJoCo saves it."""
    out = []
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        (Path(folder) / "out").mkdir()
        for path in paths:
            name, source = path.name, path
            if path.suffix == ".urdf":
                try:
                    source = saved_by_mujoco(path, Path(folder))
                except ValueError as error:
                    out.append(Survey(name, refusal=f"MuJoCo does not save it: {' '.join(str(error).split())[:80]}"))
                    continue
            out.append(replace(survey(source, Path(folder) / "out"), name=name))
    return out


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, help="MJCF and URDF files")
    parser.add_argument("--table", type=Path, help="file to write, too")
    options = parser.parse_args()
    head = ["| model | velocities | inverse dynamics | out and in | written file |", "|---|---|---|---|---|"]
    text = "\n".join([*head, *(one.row() for one in survey_all(options.files))])
    print(text)
    if options.table is not None:
        options.table.write_text(text + "\n")


if __name__ == "__main__":
    main()
