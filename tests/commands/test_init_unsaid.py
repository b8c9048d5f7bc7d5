"""`torchid init` of columns that do not say what they are, say it in parts, or in another language."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from dialects import ORDER, in_order, save_csv
from initiated import URDF, columns_of, initiated, recorded
from motions import value
from refusals import refused
from scipy.spatial.transform import Rotation

from torchid.commands.init import init
from torchid.commands.init_proposals import guess_contacts
from torchid.config import load_config
from torchid.errors import LogError
from torchid.logs import Columns, Log, read_log, write_log
from torchid.robot import load_robot


def test_columns_that_may_be_torques_are_listed_and_take_no_more_than_a_mark_off(tmp_path: Path) -> None:
    log = recorded()
    columns = {"t": log.time} | columns_of(log, ("q{}", "dq{}", "actuator_output_{}"), 1)
    columns |= {f"motor{k}_temp": log.time + k for k in range(12)} | {f"mode{k}": 0 * log.time for k in range(12)}
    path = save_csv(tmp_path / "x.csv", columns)
    _, said, text = initiated(path)
    named = [line for line in said.missing if line.startswith("joint_torque: no column says that it is one")]
    assert len(named) == 1
    assert "'actuator_output_1' and 11 more" in named[0]
    assert "temp" not in named[0]
    commented = [line for line in text.splitlines() if line.startswith("    # joint_torque: ")]
    assert len(commented) == 1
    path.with_suffix(".yaml").write_text(text.replace(commented[0], commented[0].replace("# ", "")))
    found = read_log(path, columns=load_config(path.with_suffix(".yaml")).logs.columns)
    np.testing.assert_array_equal(value(found.joint_torque), in_order(log, log.joint_torque))


def test_the_sensors_of_an_arm_without_torques_are_its_joints(tmp_path: Path) -> None:
    log = recorded()
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(URDF.read_text().replace("_foot", "_tip"))
    columns = {"t": log.time} | columns_of(log, ("q{}", "dq{}", "out{}"))
    _, _, text = initiated(save_csv(tmp_path / "x.csv", columns), urdf)
    settings = yaml.safe_load(text)
    assert settings["robot"]["fixed_base"] is True
    assert settings["sensors"] == "joints", "of which a fit says that joint_torque is missing"


@pytest.mark.parametrize("swing", [2.0, 2.54], ids=["half a turn is free", "a fifth, between quarters"])
@pytest.mark.parametrize("ending", ["csv", "npz"])
def test_a_joint_with_names_of_the_format_that_jumps_by_a_turn_gets_where_its_turn_begins(
    tmp_path: Path, ending: str, swing: float
) -> None:
    log = recorded()
    position = log.joint_position.copy()
    position[:, 2] = 2.3 - np.pi + swing * np.sin(2.0 * log.time)
    wrapped = position.copy()
    wrapped[:, 2] = np.mod(position[:, 2] + 2.0, 2.0 * np.pi) - 2.0
    path = tmp_path / f"x.{ending}"
    write_log(replace(log, joint_position=wrapped, joint_velocity=None), path)
    assert np.abs(np.diff(wrapped, axis=0)).max() > 6.0
    found, said, _ = initiated(path)
    turns = (found.joint_position - position) / (2.0 * np.pi)
    np.testing.assert_allclose(turns, np.broadcast_to(np.round(turns[0]), turns.shape), atol=1e-9)
    assert any(line.startswith("joint_position: turns begin at ") for line in said.guessed)
    write_log(log, tmp_path / f"y.{ending}")
    assert "joint_position" not in initiated(tmp_path / f"y.{ending}")[2]


def test_names_in_columns_of_text_are_the_order_of_numbers(tmp_path: Path) -> None:
    """Of `rostopic echo -p`."""
    log = recorded()
    order = list(np.random.default_rng(2).permutation(12))
    columns: dict[str, Any] = {"%time": np.round(log.time * 1e9).astype(int), "field.header.frame_id": ["x"] * len(log)}
    columns |= {f"field.name{k}": [ORDER[j]] * len(log) for k, j in enumerate(order)}
    for name, x in (("position", log.joint_position), ("effort", log.joint_torque)):
        columns |= {f"field.{name}{k}": in_order(log, x)[:, j] for k, j in enumerate(order)}
    found, said, _ = initiated(save_csv(tmp_path / "x.csv", columns))
    np.testing.assert_array_equal(in_order(found, found.joint_position), in_order(log, log.joint_position))
    np.testing.assert_array_equal(in_order(found, found.joint_torque), in_order(log, log.joint_torque))
    assert any("as 'field.name{index}' of the file lists them" in line for line in said.guessed)


def test_seconds_and_nanoseconds_in_two_columns_are_one_stamp(tmp_path: Path) -> None:
    log = recorded()
    stamp = np.round(log.time * 1e9).astype(np.int64) + 999_000_000
    columns: dict[str, Any] = {"/js.header.stamp.sec": stamp // 10**9, "/js.header.stamp.nanosec": stamp % 10**9}
    columns |= {"/imu.header.stamp.sec": stamp // 10**9, "/imu.header.stamp.nanosec": stamp % 10**9}
    columns |= {f"/js.position[{k}]": x for k, x in enumerate(np.degrees(in_order(log, log.joint_position)).T)}
    columns |= {f"/js.velocity[{k}]": x for k, x in enumerate(in_order(log, log.joint_velocity).T)}
    path = save_csv(tmp_path / "x.csv", columns)
    found, _, text = initiated(path)
    np.testing.assert_allclose(found.time, log.time - log.time[0] + stamp[0] / 1e9, rtol=0.0, atol=1e-9)
    entry = {"column": "/js.header.stamp.sec", "nanoseconds": "/js.header.stamp.nanosec"}
    assert yaml.safe_load(text)["logs"]["columns"]["time"] == entry


@pytest.mark.parametrize("names", ["base_{}", "base_{}_m", "base.{} [mm]", "pelvis {} (m)"])
def test_axes_of_a_base_without_another_word_are_its_position(tmp_path: Path, names: str) -> None:
    log, scale = recorded(), 1e3 if "mm" in names else 1.0
    columns = {"t": log.time} | columns_of(log, ("q{}", "dq{}", "tau{}"))
    columns |= {names.format(axis): x * scale for axis, x in zip("xyz", value(log.base_position_world).T, strict=True)}
    found, _, _ = initiated(save_csv(tmp_path / "x.csv", columns))
    np.testing.assert_allclose(value(found.base_position_world), value(log.base_position_world), rtol=0.0, atol=1e-12)


def test_a_base_s_axes_in_another_unit_than_of_length_are_not_its_position(tmp_path: Path) -> None:
    log = recorded()
    columns = {"t": log.time} | columns_of(log, ("q{}", "dq{}", "tau{}"))
    columns |= {f"base_{axis}_deg": x for axis, x in zip("xyz", value(log.base_position_world).T, strict=True)}
    found, _, _ = initiated(save_csv(tmp_path / "x.csv", columns))
    assert found.base_position_world is None


def test_numbers_of_states_are_no_flags(tmp_path: Path) -> None:
    """Of feet whose contact is 1 where it is made and 2 where it is lost."""
    log = recorded()
    columns = {"t": log.time} | columns_of(log, ("q{}", "dq{}", "tau{}"))
    rising = np.arange(len(log))[:, None] > [50, 90, 130, 170]
    columns |= {f"foot_state.{k}.contact": np.where(x, 1, 2) for k, x in enumerate(rising.T)}
    found, said, _ = initiated(save_csv(tmp_path / "x.csv", columns))
    assert found.contact_active is None
    assert any("'foot_state.0.contact' has numbers of states" in line for line in said.guessed)
    columns |= {f"foot_state.{k}.contact": x.astype(int) for k, x in enumerate(rising.T)}
    found, _, _ = initiated(save_csv(tmp_path / "y.csv", columns))
    np.testing.assert_array_equal(value(found.contact_active), rising)


def test_arrays_that_no_map_takes_are_named_with_what_to_do(tmp_path: Path) -> None:
    log = recorded()
    names = ["t", *(f"q_{name}" for name in log.joint_names)]
    np.savez(tmp_path / "y.npz", data=np.column_stack([log.time, log.joint_position]), labels=np.array(names))
    said = init(URDF, tmp_path / "y.npz", tmp_path / "y.yaml")
    assert any("if 'labels' names its columns, save both as a table" in line for line in said.guessed)


def test_small_angles_by_which_a_base_would_lie_on_its_back_in_radians_are_degrees(tmp_path: Path) -> None:
    log = recorded()
    columns = {"t": log.time} | columns_of(log, ("q{}", "dq{}", "tau{}"))
    roll = 5.0 * np.sin(log.time)
    found, _, _ = initiated(save_csv(tmp_path / "x.csv", columns | {"Roll": roll, "Pitch": 0 * roll, "Yaw": 0 * roll}))
    np.testing.assert_allclose(value(found.base_quat_xyzw)[:, 0], np.sin(0.5 * np.radians(roll)), atol=1e-12)


HEADERS = {
    "German": ("Zeit [s]", "Gelenkwinkel {} [°]", "Winkelgeschwindigkeit {} [°/s]", "Drehmoment {} [Nm]",
               "Beschleunigung {} [m/s²]", "Drehrate {} [°/s]"),
    "French": ("temps_s", "angle_{}_deg", "vitesse_{}_deg/s", "couple_{}_Nm", "accélération_{}", "gyro_{}_deg/s"),
    "Japanese": ("時刻[s]", "関節角度{}[deg]", "関節角速度{}[deg/s]", "トルク{}[Nm]", "加速度{}[m/s2]",
                 "角速度{}[deg/s]"),
    "Chinese": ("时间", "关节角度_{}[deg]", "关节速度_{}[deg/s]", "力矩_{}", "加速度_{}", "角速度_{}[deg/s]"),
    "Italian": ("tempo_s", "posizione_{}_gradi", "velocità_{}_gradi_s", "coppia_{}_Nm", "accelerometro_{}_m_s2",
                "giroscopio_{}_gradi_s"),
    "Portuguese": ("tempo", "posição {} [graus]", "velocidade {} [graus/s]", "torque {} [N.m]", "aceleração {}",
                   "giroscópio {} [graus/s]"),
    "short": ("t", "Q_{}[deg]", "dQ_{}[deg/s]", "Tau_{}", "Acc{}(m/s2)", "Gyr{}(dps)"),
}  # fmt: skip


@pytest.mark.parametrize("language", HEADERS)
def test_headers_in_other_languages_say_what_they_are(tmp_path: Path, language: str) -> None:
    time, position, velocity, torque, force, rate = HEADERS[language]
    log, columns = recorded(), {time: recorded().time}
    degrees = np.degrees(log.joint_position), np.degrees(value(log.joint_velocity)), log.joint_torque
    for name, x in zip((position, velocity, torque), degrees, strict=True):
        columns |= {name.format(joint): value(x)[:, k] for k, joint in enumerate(log.joint_names)}
    for name, x in ((force, log.imu_specific_force), (rate, np.degrees(value(log.imu_angular_velocity)))):
        columns |= {name.format(axis): value(x)[:, k] for k, axis in enumerate("XYZ")}
    found, _, _ = initiated(save_csv(tmp_path / "x.csv", columns, ";", ","))
    for name in ("joint_position", "joint_velocity", "joint_torque"):
        np.testing.assert_allclose(in_order(found, getattr(found, name)), in_order(log, getattr(log, name)), atol=1e-12)
    for name in ("time", "imu_specific_force", "imu_angular_velocity"):
        np.testing.assert_allclose(getattr(found, name), getattr(log, name), atol=1e-12)


def test_the_number_of_a_sample_is_a_stamp_only_where_nothing_else_is(tmp_path: Path) -> None:
    log = recorded()
    joints = (("q", log.joint_position), ("dq", log.joint_velocity), ("tau", log.joint_torque))
    columns = {f"{what}_{name}": value(x)[:, k] for what, x in joints for k, name in enumerate(log.joint_names)}
    columns = {"time_index": np.arange(len(log))} | columns
    found, _, _ = initiated(save_csv(tmp_path / "x.csv", columns | {"timestamp": log.time}))
    np.testing.assert_allclose(found.time, log.time, atol=1e-12)
    found, said, _ = initiated(save_csv(tmp_path / "y.csv", columns))
    assert len(found) == len(log)
    text = next(x for x in said.guessed if x.startswith("joint_velocity: "))
    assert "times the slope of the positions, as no unit explains: are the stamps right?" in text
    assert found.joint_velocity is not None
    np.testing.assert_array_equal(in_order(found, found.joint_velocity), in_order(log, log.joint_velocity))


def twist_in_world(log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Linear and angular velocity of a base, by the slope of its pose."""
    rotation, step = Rotation.from_quat(value(log.base_quat_xyzw)), np.diff(log.time)[:, None]
    rate = (rotation[1:] * rotation[:-1].inv()).as_rotvec() / step
    return np.gradient(value(log.base_position_world), log.time, axis=0), np.vstack([rate, rate[-1:]])


@pytest.mark.parametrize("turned", [False, True], ids=["world", "base"])
def test_twists_and_poses_of_nested_messages_belong_together(tmp_path: Path, turned: bool) -> None:
    log = recorded()
    rotation = Rotation.from_quat(value(log.base_quat_xyzw))
    position, (linear, angular) = value(log.base_position_world), twist_in_world(log)
    recorded_twist = [rotation.inv().apply(x) if turned else x for x in (linear, angular)]
    frames = ("position", position), ("linear", recorded_twist[0]), ("angular", recorded_twist[1])
    columns: dict[str, Any] = {"t": log.time} | columns_of(log, ("q{}", "dq{}", "tau{}"))
    for name, x in frames:
        message = "pose/pose" if name == "position" else "twist/twist"
        columns |= {f"/estimator/robot_state/{message}/{name}/{axis}": x[:, k] for k, axis in enumerate("xyz")}
    turns = value(log.base_quat_xyzw)
    columns |= {f"/estimator/robot_state/pose/pose/orientation/{axis}": turns[:, k] for k, axis in enumerate("xyzw")}
    found, _, _ = initiated(save_csv(tmp_path / "x.csv", columns))
    np.testing.assert_allclose(value(found.base_linear_velocity_world), linear, atol=1e-9)
    np.testing.assert_allclose(value(found.base_angular_velocity_base), rotation.inv().apply(angular), atol=1e-9)


def test_velocities_of_a_free_joint_are_those_of_the_base(tmp_path: Path) -> None:
    """MuJoCo's qvel: linear in the world, angular in the base."""
    log = recorded()
    linear, angular = twist_in_world(log)
    angular = Rotation.from_quat(value(log.base_quat_xyzw)).inv().apply(angular)
    joints = [in_order(log, x) for x in (log.joint_position, log.joint_velocity, log.joint_torque)]
    arrays = {
        "time": log.time, "joint_names": np.array(ORDER),
        "qpos": np.hstack([value(log.base_position_world), np.roll(value(log.base_quat_xyzw), 1, axis=1), joints[0]]),
        "qvel": np.hstack([linear, angular, joints[1]]), "tau": joints[2],
    }  # fmt: skip
    np.savez(tmp_path / "x.npz", **arrays)
    found, _, _ = initiated(tmp_path / "x.npz")
    np.testing.assert_array_equal(value(found.base_linear_velocity_world), linear)
    np.testing.assert_array_equal(value(found.base_angular_velocity_base), angular)


def test_a_list_of_names_may_have_more_than_the_robot(tmp_path: Path) -> None:
    """A gripper's finger that mimics another, in the middle of the arrays."""
    log = recorded()
    names = [*ORDER[:5], "r_finger", *ORDER[5:]]
    fields = {"position": log.joint_position, "velocity": log.joint_velocity, "effort": log.joint_torque}
    arrays = {name: np.insert(in_order(log, x), 5, 0.1 * log.time, axis=1) for name, x in fields.items()}
    np.savez(tmp_path / "x.npz", t=log.time, name=np.array(names), **arrays)
    found, said, _ = initiated(tmp_path / "x.npz")
    for name in ("joint_position", "joint_velocity", "joint_torque"):
        np.testing.assert_array_equal(in_order(found, getattr(found, name)), in_order(log, getattr(log, name)))
    assert any(text.startswith("joint_order: as 'name' of the file lists them") for text in said.guessed)


@pytest.mark.parametrize("kind", ["text", "lists"])
def test_columns_that_are_no_numbers_are_named_with_the_field_that_lacks_them(tmp_path: Path, kind: str) -> None:
    log, name = recorded(), "tau" if kind == "text" else "q"
    rows = {what: list(in_order(log, x)) for what, x in (("q", log.joint_position), ("tau", log.joint_torque))}
    if kind == "text":
        rows[name] = [[f"{x} Nm" for x in row] for row in rows[name]]
    else:
        rows[name] = [[*row, 0.0][: 12 + k % 2] for k, row in enumerate(rows[name])]
    columns = {what: [list(row) for row in x] for what, x in rows.items()}
    pq.write_table(pa.table({"t": log.time, **columns}), tmp_path / "x.parquet")
    said = init(URDF, tmp_path / "x.parquet", tmp_path / "x.yaml")
    field = "joint_torque" if kind == "text" else "joint_position"
    assert f"{field}: '{name}' by name, but no numbers: text, or lists of several lengths" in said.missing
    if kind == "lists":
        given = Columns(time="t", joint_order=ORDER, joint_position="q[{index}]", joint_torque="tau[{index}]")
        line = refused(lambda: read_log(tmp_path / "x.parquet", columns=given), "", LogError)
        assert "joint_position: 'q[0]' of the column 'q', which has no lists, or lists of several lengths" in line


def test_a_gyroscope_alone_beside_an_orientation_is_the_rate_of_the_base(tmp_path: Path) -> None:
    log = recorded()
    rotation, angular = Rotation.from_quat(value(log.base_quat_xyzw)), twist_in_world(log)[1]
    columns: dict[str, Any] = {"t": log.time} | columns_of(log, ("q{}", "dq{}", "tau{}"))
    columns |= {f"base_quat_{axis}": value(log.base_quat_xyzw)[:, k] for k, axis in enumerate("xyzw")}
    columns |= {f"omega_{axis}": rotation.inv().apply(angular)[:, k] for k, axis in enumerate("xyz")}
    found, _, _ = initiated(save_csv(tmp_path / "x.csv", columns))
    np.testing.assert_allclose(value(found.base_angular_velocity_base), rotation.inv().apply(angular), atol=1e-9)


@pytest.mark.parametrize("separator", [",", ";"])
def test_names_in_two_lines_are_joined_where_one_has_some_twice(tmp_path: Path, separator: str) -> None:
    """Of pandas, whose columns have several levels."""
    log = recorded()
    joints = (("position", log.joint_position), ("velocity", log.joint_velocity), ("effort", log.joint_torque))
    path = tmp_path / "x.csv"
    columns = {f"{what}.{name}": value(x)[:, k] for what, x in joints for k, name in enumerate(log.joint_names)}
    save_csv(path, {"time": log.time} | columns, separator)
    first, _, rows = path.read_text().partition("\n")
    levels = [name.partition(".")[::2] for name in first.split(separator)]
    path.write_text("\n".join([*(separator.join(level) for level in zip(*levels, strict=True)), rows]))
    found, _, _ = initiated(path)
    np.testing.assert_array_equal(in_order(found, found.joint_torque), in_order(log, log.joint_torque))
    np.testing.assert_allclose(found.time, log.time, atol=1e-12)


def _star(path: Path, tips: str) -> Path:
    """A robot of three limbs, of one hinge each, that end in balls."""
    inertial = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    ball = '<collision><geometry><sphere radius="0.02"/></geometry></collision>'
    limbs = "".join(
        f'<link name="{k} {tips}">{inertial}{ball}</link><joint name="j{k}" type="revolute"><parent link="body"/>'
        f'<child link="{k} {tips}"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="9" velocity="9"/></joint>'
        for k in range(3)
    )
    path.write_text(f'<robot name="star"><link name="body">{inertial}</link>{limbs}</robot>')
    return path


@pytest.mark.parametrize(("tips", "found"), [("tip", 3), ("fingertip", 0), ("wheel_link", 0)])
def test_balls_at_the_ends_of_limbs_are_feet_where_no_link_is_called_so_but_for_fingers_and_wheels(
    tmp_path: Path, tips: str, found: int
) -> None:
    contacts = guess_contacts(load_robot(_star(tmp_path / "star.urdf", tips)), [], [])
    assert [(one.frame, one.type) for one in contacts] == [(f"{k} {tips}", "point") for k in range(found)]


def test_a_gyroscope_called_g_and_forces_called_kraft_are_found_with_bare_names_of_the_pose(tmp_path: Path) -> None:
    time = np.linspace(0.0, 4.0, 400)
    turn, still = 0.3 * np.sin(time), np.zeros_like(time)
    columns = {"t": time} | {f"j{k} pos": 0.2 * np.sin(time + k) for k in range(3)}
    columns |= {"qx": still, "qy": np.sin(turn / 2), "qz": still, "qw": np.cos(turn / 2)}
    columns |= {"x": 0.1 * np.sin(time), "y": still, "z": 1.0 + still}
    columns |= {"imu.ax": 9.81 * np.sin(turn), "imu.ay": still, "imu.az": 9.81 * np.cos(turn)}
    columns |= {"imu.gx": still, "imu.gy": 0.3 * np.cos(time), "imu.gz": still}
    columns |= {f"{k} tip Kraft {axis} [N]": 13.0 * (axis == "z") + turn for k in range(3) for axis in "xyz"}
    pq.write_table(pa.table(columns), tmp_path / "log.parquet")
    init(_star(tmp_path / "star.urdf", "tip"), tmp_path / "log.parquet", tmp_path / "new.yaml")
    entries = yaml.safe_load((tmp_path / "new.yaml").read_text(encoding="utf-8"))["logs"]["columns"]
    assert {"imu_specific_force", "imu_angular_velocity", "base_quat_xyzw", "base_position_world"} <= set(entries)
    assert any(name.startswith("contact_wrench") for name in entries)
