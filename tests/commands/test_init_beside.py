"""`torchid init` of columns that say what they are by those beside them, or by their numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from dialects import in_order, save_csv, wxyz
from initiated import URDF, columns_of, initiated, recorded
from motions import value

from torchid.commands.init import init
from torchid.logs.name_matching import KnownRobot
from torchid.logs.unitree import usual_order


@pytest.mark.parametrize(
    ("quaternion", "position"),
    [
        ("field.pose.pose.orientation.{}", "field.pose.pose.position.{}"),
        ("/mocap/rex/pose/orientation/{}", "/mocap/rex/pose/position/{}"),
        ("odom_tform_body.rotation.{}", "odom_tform_body.position.{}"),
        ("Becken Quaternion {}", "Becken Lage {} [mm]"),
        ("FloatingBase_q{}", "FloatingBase_{}"),
    ],
)
def test_the_position_beside_a_quaternion_is_that_of_the_base(tmp_path: Path, quaternion: str, position: str) -> None:
    log, scale = recorded(), 1e3 if "mm" in position else 1.0
    columns = {"t": log.time} | columns_of(log, ("q{}", "dq{}", "tau{}"))
    columns |= {quaternion.format(axis): x for axis, x in zip("wxyz", wxyz(log).T, strict=True)}
    path = scale * value(log.base_position_world)
    columns |= {position.format(axis): x for axis, x in zip("xyz", path.T, strict=True)}
    noisy = np.random.default_rng(0).normal(size=(3, len(log)))
    columns |= {f"target.pose.position.{axis}": x for axis, x in zip("xyz", noisy, strict=True)}
    found, said, _ = initiated(save_csv(tmp_path / "x.csv", columns))
    np.testing.assert_allclose(value(found.base_position_world), value(log.base_position_world), rtol=0.0, atol=1e-12)
    assert not any("motion of the base" in text for text in said.missing)


def test_an_orientation_alone_is_said_to_be_one(tmp_path: Path) -> None:
    log = recorded()
    columns = {"t": log.time} | columns_of(log, ("q{}", "dq{}", "tau{}"))
    columns |= {f"base.orientation.{axis}": x for axis, x in zip("wxyz", wxyz(log).T, strict=True)}
    said = init(URDF, save_csv(tmp_path / "x.csv", columns), tmp_path / "x.yaml")
    assert any("its orientation alone, no position or IMU" in text for text in said.missing)


def test_transposed_arrays_that_are_not_needed_are_ignored_by_their_names_in_the_file(tmp_path: Path) -> None:
    log = recorded()
    with h5py.File(tmp_path / "x.mat", "w") as file:
        file["log/time"] = log.time[None]
        for name, x in (("q", log.joint_position), ("qd", value(log.joint_velocity)), ("tau", value(log.joint_torque))):
            file[f"log/joints/{name}"] = x.T
        file["log/base/quat"], file["log/base/pos"] = wxyz(log).T, value(log.base_position_world).T
        file["log/joints/tau_des"], file["log/gains"] = in_order(log, log.joint_torque).T, np.ones((12, len(log)))
    found, said, text = initiated(tmp_path / "x.mat")
    np.testing.assert_array_equal(found.joint_position, log.joint_position)
    assert yaml.safe_load(text)["logs"]["columns"]["ignore"] == ["log/gains", "log/joints/tau_des"]
    assert not any("not read" in line for line in said.missing)


def test_of_two_accelerations_the_one_with_gravity_is_the_accelerometer(tmp_path: Path) -> None:
    log = recorded()
    columns: dict[str, Any] = {"t": log.time} | columns_of(log, ("q{}", "dq{}", "tau{}"))
    free = np.random.default_rng(1).normal(size=(3, len(log)))  # whose length is about 1, as that of readings in g
    force = value(log.imu_specific_force)
    columns |= {f"imu.linear_acceleration.{axis}": x for axis, x in zip("xyz", free, strict=True)}
    rate = value(log.imu_angular_velocity)
    columns |= {f"imu.angular_velocity.{axis}": x for axis, x in zip("xyz", rate.T, strict=True)}
    alone, both = save_csv(tmp_path / "alone.csv", columns), tmp_path / "both.csv"
    said = init(URDF, alone, tmp_path / "alone.yaml")
    assert "imu_specific_force: not 'imu.linear_acceleration.x', which is without gravity" in said.guessed
    save_csv(both, columns | {f"imu.accelerometer.{axis}": x for axis, x in zip("xyz", force.T, strict=True)})
    found, _, _ = initiated(both)
    np.testing.assert_array_equal(found.imu_specific_force, force)


def test_whole_numbers_beyond_degrees_are_counts_whose_scale_nobody_said(tmp_path: Path) -> None:
    log = recorded()
    columns: dict[str, Any] = {"millis": np.round(1e3 * log.time).astype(int)}
    columns |= columns_of(log, ("position{}", "velocity{}", "effort{}"))
    for name in [name for name in columns if name.startswith("position")]:
        columns[name] = np.round(columns[name] / (2.0 * np.pi) * 4096.0 + 2048.0).astype(int)
    said = init(URDF, save_csv(tmp_path / "x.csv", columns), tmp_path / "x.yaml")
    assert any(text.startswith("joint_position: whole numbers") and "scale" in text for text in said.guessed)
    assert not any(text.startswith("joint_velocity") for text in said.guessed)
    assert any(text.startswith("time: ms") for text in said.guessed)


def test_numbers_of_joints_count_those_that_mimic_others() -> None:
    robot = KnownRobot(("hip", "thumb", "knee"), (), "x", 1.0, "base", (), (), moving=("hip", "thumb", "tip", "knee"))
    assert usual_order("joint", robot, 4)[0] == ["hip", "thumb", None, "knee"]
    assert usual_order("joint", robot, 3)[0] == ["hip", "thumb", "knee"]


def test_nanos_and_accelerations_of_joints_are_known(tmp_path: Path) -> None:
    log = recorded()
    stamp = np.round(log.time * 1e9).astype(np.int64) + 999_000_000
    columns: dict[str, Any] = {"stamp.seconds": stamp // 10**9, "stamp.nanos": stamp % 10**9}
    rates = {"position": log.joint_position, "velocity": log.joint_velocity, "load": log.joint_torque}
    rates["acceleration"] = np.gradient(value(log.joint_velocity), log.time, axis=0)
    for name, x in rates.items():
        columns |= {f"joints.{joint}.{name}": value(x)[:, k] for k, joint in enumerate(log.joint_names)}
    path = save_csv(tmp_path / "x.csv", columns)
    found, _, _ = initiated(path)
    np.testing.assert_allclose(np.diff(found.time), np.diff(log.time), rtol=0.0, atol=2e-9)
    np.testing.assert_array_equal(found.joint_acceleration, rates["acceleration"])


def test_a_base_that_moves_without_a_foot_is_named(tmp_path: Path) -> None:
    log, urdf = recorded(), tmp_path / "crawler.urdf"
    urdf.write_text(URDF.read_text().replace("_foot", "_tip"))
    columns = {"t": log.time} | columns_of(log, ("q{}", "dq{}", "tau{}"))
    columns |= {f"base_q{axis}": x for axis, x in zip("wxyz", wxyz(log).T, strict=True)}
    columns |= {f"base_{axis}": x for axis, x in zip("xyz", value(log.base_position_world).T, strict=True)}
    said = init(urdf, save_csv(tmp_path / "x.csv", columns), tmp_path / "x.yaml")
    assert any(text.startswith("contacts: no link is called a foot") for text in said.missing)
