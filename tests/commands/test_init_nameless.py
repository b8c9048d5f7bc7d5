"""`torchid init` of a robot of a single body, and of columns and arrays that nothing says what they are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from dialects import in_order, save_csv
from initiated import URDF, recorded
from motions import value
from synthetic import ROBOTS
from urdfs import link, write

from torchid.commands.init import init
from torchid.config import load_config
from torchid.errors import UnphysicalInertiaWarning
from torchid.logs import read_log
from torchid.robot import load_robot

TIAGO = ROBOTS / "tiago_description/robots/tiago_no_hand.urdf"


def test_a_body_without_joints_has_a_pose_and_only_columns_that_are_named_are_ignored(tmp_path: Path) -> None:
    time = np.arange(400) / 100.0
    turn = 0.3 * np.sin(time)
    columns: dict[str, Any] = {
        "t": time,
        "q[0]": np.cos(turn),
        "q[1]": np.sin(turn),
        "q[2]": 0 * time,
        "q[3]": 0 * time,
    }
    columns |= {axis: np.sin(time + k) for k, axis in enumerate("xyz")}
    columns |= {f"thrust_{axis}": np.cos(time + k) for k, axis in enumerate("xyz")}
    body = write(tmp_path, link("body"))
    said = init(body, save_csv(tmp_path / "x.csv", columns), tmp_path / "x.yaml")
    log = read_log(tmp_path / "x.csv", columns=load_config(tmp_path / "x.yaml").logs.columns)
    np.testing.assert_allclose(value(log.base_position_world)[:, 1], columns["y"])
    np.testing.assert_allclose(value(log.base_quat_xyzw)[:, 3], columns["q[0]"])
    assert not [line for line in said.missing if "joint_position" in line]
    (said_of_contacts,) = (line for line in said.missing if line.startswith("contacts"))
    assert "nothing but gravity acts on the base" in said_of_contacts
    ignored = yaml.safe_load((tmp_path / "x.yaml").read_text())["logs"]["columns"]["ignore"]
    assert "*" not in ignored


def test_three_columns_that_nothing_names_are_ignored_one_by_one(tmp_path: Path) -> None:
    log = recorded()
    position = value(log.joint_position).T
    columns = {"t": log.time} | {f"q_{name}": x for name, x in zip(log.joint_names, position, strict=True)}
    columns |= {axis: np.sin(log.time) for axis in "xyz"} | {"w": 0 * log.time}
    arm = tmp_path / "arm.urdf"
    arm.write_text(URDF.read_text().replace("_foot", "_tip"))
    init(arm, save_csv(tmp_path / "x.csv", columns), tmp_path / "x.yaml")
    ignored = yaml.safe_load((tmp_path / "x.yaml").read_text())["logs"]["columns"]["ignore"]
    assert sorted(ignored) == ["w", "x", "y", "z"]


def test_an_array_of_columns_that_no_name_tells_is_ignored_by_its_own_name_and_may_be_torques(tmp_path: Path) -> None:
    log = recorded()
    arrays = {"t": log.time, "q": in_order(log, log.joint_position).T, "u": in_order(log, log.joint_torque).T}
    np.savez(tmp_path / "x.npz", **arrays)
    said = init(URDF, tmp_path / "x.npz", tmp_path / "x.yaml")
    assert not [line for line in said.missing if "not read" in line]
    assert any(line.startswith("joint_torque: no column says that it is one; 'u.T'") for line in said.missing)
    assert "ignore: [u]" in (tmp_path / "x.yaml").read_text()


def test_an_inertia_that_no_body_has_is_said_once(tmp_path: Path) -> None:
    with pytest.warns(UnphysicalInertiaWarning):
        joints = load_robot(TIAGO).joint_names
    motion = {f"{name}_position": np.sin(np.arange(200) / 50.0) for name in joints}
    path = save_csv(tmp_path / "x.csv", {"t": np.arange(200) / 50.0} | motion)
    with pytest.warns(UnphysicalInertiaWarning) as told:
        init(TIAGO, path, tmp_path / "x.yaml")
    assert len([one for one in told if one.category is UnphysicalInertiaWarning]) == 1
