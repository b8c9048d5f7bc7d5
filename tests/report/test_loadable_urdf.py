"""`identified.urdf` as it is loads in MuJoCo and Pinocchio: links without mass, meshes in packages or nowhere."""

from __future__ import annotations

import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
from loadable import assert_loads
from lxml import etree
from mujoco_oracle import INERTIA_ROUNDING, IS_MUJOCO_3, mujoco_forces, mujoco_model
from regressors import assert_close, without_shapes
from repository import CONFIGS
from simulated import BIPED, SOLES
from synthetic import G1, ROBOTS, SOLO12, TALOS_FULL, Array, Oracle, load, make_log, random_states

import torchid
from torchid import parameters
from torchid.errors import TorchidWarning
from torchid.logs import write_log
from torchid.report import identified_urdf
from torchid.report.mjcf_files import mjcf_of_urdf
from torchid.report.urdf_files import SMALLEST
from torchid.robot import Robot

HUMAN = ROBOTS / "human_description/robots/human.urdf"
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def written(robot: Robot, folder: Path, phi: Array | None = None, full_mesh_paths: bool = True) -> Path:
    path = folder / "run" / "identified.urdf"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(identified_urdf(robot, robot.nominal if phi is None else phi, full_mesh_paths))
    return path


def pair(folder: Path, *shapes: str, lower: str = '<mass value="1"/>', extension: str = "") -> Robot:
    """A link without mass between two that have some, of the package `machine`; shapes are those of the last."""
    inertia = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
    links = "".join(
        f'<link name="{name}">{f"<inertial>{mass}{inertia}</inertial>" if mass else ""}{text}</link>'
        for name, mass, text in (("base", '<mass value="2"/>', ""), ("cross", "", ""), ("leg", lower, "".join(shapes)))
    )
    joints = "".join(
        f'<joint name="{name}" type="continuous"><parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
        "</joint>"
        for name, parent, child, axis in (("roll", "base", "cross", "1 0 0"), ("pitch", "cross", "leg", "0 1 0"))
    )
    package = folder / "machine"
    (package / "urdf").mkdir(parents=True, exist_ok=True)
    (package / "package.xml").write_text("<package/>")
    path = package / "urdf" / "machine.urdf"
    path.write_text(f'<robot name="machine">{extension}{links}{joints}</robot>')
    return load(path)


def shape(kind: str, name: str) -> str:
    return f'<{kind}><geometry><mesh filename="{name}"/></geometry></{kind}>'


def mesh_in(folder: Path, name: str) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(TETRAHEDRON)
    return path


def mesh_names(path: Path) -> list[str]:
    return [str(mesh.get("filename")) for mesh in etree.parse(str(path)).getroot().iter("mesh")]


# ---------------------------------------------------------------------------------------------------- without mass


def test_links_between_axes_weigh_nothing_in_pinocchio_and_next_to_nothing_in_mujoco(tmp_path: Path) -> None:
    """The human's hips have three axes and two links without mass; neither forces nor masses change."""
    robot = load(without_shapes(HUMAN, tmp_path))
    ends = [name for name in robot.massless if "hand" not in name]
    assert len(ends) > 10
    path = written(robot, tmp_path)
    model = mujoco_model(path, robot)
    assert model.body_mass.sum() == pytest.approx(robot.nominal[:, 0].sum(), rel=1e-12)
    empty = [model.body(name).id for name in robot.massless]
    np.testing.assert_array_equal(model.body_mass[empty], SMALLEST)
    states = random_states(np.random.default_rng(0), robot.n, 3)
    expected = Oracle(path, robot.joint_names, False).forces(*states)
    assert_close(mujoco_forces(model, robot, *states), expected, 1e-13 + INERTIA_ROUNDING)
    assert load(path).massless == robot.massless
    own = mujoco.MjModel.from_xml_string(mjcf_of_urdf(robot, robot.nominal, {}).decode())
    assert own.body_mass.sum() == pytest.approx(robot.nominal[:, 0].sum(), rel=1e-12)


def test_real_inertias_however_small_are_not_raised(tmp_path: Path) -> None:
    robot = pair(tmp_path)
    phi = robot.nominal.copy()
    phi[2, : parameters.PER_BODY - 2] = [1e-6, 0, 0, 0, 1e-12, 0, 0, 1e-12, 0, 1e-12]
    model = assert_loads(written(robot, tmp_path, phi), 2.0 + 1e-6)
    assert model.body("leg").mass == 1e-6
    np.testing.assert_allclose(model.body("leg").inertia, 1e-12)


# ---------------------------------------------------------------------------------------------------------- meshes


@pytest.mark.parametrize(("urdf", "meshes"), [(G1, 24), (TALOS_FULL, 37)], ids=["G1", "Talos"])
def test_meshes_in_packages_are_found_from_a_run_folder(urdf: Path, meshes: int, tmp_path: Path) -> None:
    robot = load(urdf)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = written(robot, tmp_path)
    assert_loads(path, robot.nominal[:, 0].sum(), None if IS_MUJOCO_3 else meshes)  # which counts them otherwise


def test_collision_meshes_and_relative_names_become_full_paths_and_packages_of_visuals_stay(tmp_path: Path) -> None:
    file = mesh_in(tmp_path, "machine/meshes/a.obj")
    names = ("package://machine/meshes/a.obj", "../meshes/a.obj", str(file))
    robot = pair(tmp_path, *(shape(kind, name) for kind in ("visual", "collision") for name in names))
    path = written(robot, tmp_path)
    assert mesh_names(path) == [names[0], *[str(file)] * 5]
    assert_loads(path, 3.0, 1)
    assert mesh_names(written(robot, tmp_path, full_mesh_paths=False)) == [*names, *names]


@pytest.mark.parametrize("name", ["package://machine/a--b.stl", "package://machine/meshes/a.dae", "../meshes/a.ply"])
def test_collisions_that_mujoco_does_not_find_or_read_are_left_out_and_said(name: str, tmp_path: Path) -> None:
    mesh_in(tmp_path, "machine/meshes/a.dae")
    robot = pair(tmp_path, shape("visual", "package://machine/meshes/a.dae"), shape("collision", name))
    with pytest.warns(TorchidWarning, match=f"are left out: {name}. To keep them, use torchid export --format urdf"):
        path = written(robot, tmp_path)
    assert mesh_names(path) == ["package://machine/meshes/a.dae"], "RViz shows it, MuJoCo skips it"
    assert assert_loads(path, 3.0).ngeom == 0
    assert mesh_names(written(robot, tmp_path, full_mesh_paths=False))[1] == name


# ------------------------------------------------------------------------------------------------------ whole runs


@pytest.mark.parametrize(
    ("urdf", "file", "feet"),
    [
        pytest.param(BIPED, CONFIGS / "biped_full.yaml", SOLES, id="biped", marks=pytest.mark.study),
        pytest.param(TALOS_FULL, None, ("left_sole_link", "right_sole_link"), id="Talos", marks=pytest.mark.study),
        pytest.param(SOLO12, None, ("FL_FOOT", "HR_FOOT"), id="Solo12"),
    ],
)
def test_a_run_writes_what_loads(urdf: Path, file: Path | None, feet: tuple[str, str], tmp_path: Path) -> None:
    """Random states, exact forces; Talos with its 37 collision meshes, Solo12 with 10."""
    oracle = Oracle.of(load(urdf))
    states = [[True, True], [True, False], [False, True]]
    log = make_log(oracle, [(foot, 6) for foot in feet], states, 300, np.random.default_rng(1))
    write_log(log, tmp_path / "log.npz")
    contacts = [{"frame": foot, "type": "flat"} for foot in feet]
    run = torchid.identify(
        file,
        robot={"urdf": str(urdf)},
        contacts=contacts,
        logs={"train": [str(tmp_path / "log.npz")], "test": []},
        preprocessing={"cutoff_hz": None, "sample_rate_hz": None},
        sensors="full",
        estimator={"name": "consistent", "ridge": 1e-4},
        output=str(tmp_path / "run"),
    )
    assert run.violations == []
    assert_loads(tmp_path / "run" / "identified.urdf", float(run.phi[:, 0].sum()))


def test_joints_that_move_no_mass_at_all_are_still_refused(tmp_path: Path) -> None:
    """They have no equation of motion: a file that loads would hide it."""
    robot = pair(tmp_path, lower="")
    path = written(robot, tmp_path)
    assert "boundmass" not in path.read_text()
    with pytest.raises(ValueError, match="mass and inertia of moving bodies"):
        mujoco.MjModel.from_xml_path(str(path))
