"""`torchid init` of tables and arrays: exact names are proposed, what is not sure is listed to be filled in."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import yaml
from dialects import ORDER, in_order, save_csv, wxyz
from initiated import URDF, initiated, recorded
from motions import value
from refusals import refusal, refused
from repository import ROOT
from synthetic import ROBOTS
from urdfs import joint, link, write

from torchid.cli import main
from torchid.commands.init import init
from torchid.config import load_config
from torchid.errors import LogError
from torchid.logs import Log, read_log
from torchid.logs.units import UNITS

TIAGO = ROBOTS / "tiago_description/robots/tiago_no_hand.urdf"
CASES = ROOT.parent / "shared" / "cases"
FIELDS = ("joint_position", "joint_velocity", "joint_torque")


def by_name(log: Log, names: tuple[str, ...] = ("q_{}", "dq_{}", "tau_{}")) -> dict[str, Any]:
    """Stamps, and columns by name of the joint."""
    columns: dict[str, Any] = {"t": log.time}
    for pattern, field in zip(names, FIELDS, strict=False):
        for k, name in enumerate(log.joint_names):
            columns[pattern.format(name)] = value(getattr(log, field))[:, k]
    return columns


def arrays_of(log: Log) -> dict[str, Any]:
    """Arrays with a row for each sample, joints in an order that the file lists."""
    q, dq, tau = (in_order(log, getattr(log, field)) for field in FIELDS)
    names = {"t": log.time, "joint_names": np.array(ORDER)}
    return names | {"q": q, "dq": dq, "tau": tau, "quat_wxyz": wxyz(log), "base_pos": log.base_position_world}


def assert_recorded(found: Log, log: Log) -> None:
    for name in FIELDS:
        np.testing.assert_allclose(in_order(found, getattr(found, name)), in_order(log, getattr(log, name)), atol=1e-12)
    np.testing.assert_allclose(found.time, log.time, atol=1e-12)


def map_in(text: str) -> dict[str, Any]:
    return dict(yaml.safe_load(text)["logs"]["columns"])


# ----------------------------------------------------------------------------------------------------------- names


@pytest.mark.parametrize(
    "names",
    [
        ("q_{}", "dq_{}", "tau_{}"),
        ("{}.pos", "{}.vel", "{}.effort"),
        ("joint.{}.position", "joint.{}.velocity", "joint.{}.torque"),
        ("/robot/{}/qpos", "/robot/{}/qvel", "/robot/{}/trq"),
        ("Position {} ", "Velocity {} ", "Torque {} "),
        ("x1_{}_q", "x1_{}_qd", "x1_{}_tau_est"),
    ],
)
def test_exact_names_with_a_word_for_the_quantity_need_no_edit(tmp_path: Path, names: tuple[str, ...]) -> None:
    log = recorded()
    noise = {f"{word}_{joint}": log.time for word in ("tau_des", "temp", "q_ref") for joint in log.joint_names}
    found, said, text = initiated(save_csv(tmp_path / "x.csv", by_name(log, names) | noise))
    assert_recorded(found, log)
    assert not any(line.startswith("joint") for line in said.missing)
    assert map_in(text)["ignore"] == ["*", *(["q_ref_*", "tau_des_*"] if names[0] == "q_{}" else [])]


def test_the_pose_and_the_imu_of_a_base_are_known_by_their_names(tmp_path: Path) -> None:
    log = recorded()
    columns = by_name(log)
    columns |= {f"base_quat.{axis}": x for axis, x in zip("wxyz", wxyz(log).T, strict=True)}
    columns |= {f"basePos{axis}": x for axis, x in zip("XYZ", value(log.base_position_world).T, strict=True)}
    columns |= {f"imu.acc_{axis}": x for axis, x in zip("xyz", value(log.imu_specific_force).T, strict=True)}
    columns |= {f"gyro[{k}] (deg/s)": x for k, x in enumerate(np.degrees(value(log.imu_angular_velocity)).T)}
    columns |= {f"hand_pos_{axis}": log.time for axis in "xyz"} | {f"target_quat_{axis}": log.time for axis in "wxyz"}
    found, said, _ = initiated(save_csv(tmp_path / "x.csv", columns))
    for name in ("base_position_world", "base_quat_xyzw", "imu_specific_force", "imu_angular_velocity"):
        np.testing.assert_allclose(value(getattr(found, name)), value(getattr(log, name)), atol=1e-12, err_msg=name)
    assert any(line.startswith("imu_frame: ") for line in said.assumed)


def test_wrenches_and_flags_are_those_of_the_feet_that_they_name(tmp_path: Path) -> None:
    log = recorded()
    columns = by_name(log)
    for k, foot in enumerate(log.contact_names):
        name = foot.removesuffix("_foot")
        columns |= {f"{name}_f{x}": value(log.contact_wrench_local)[:, k, j] for j, x in enumerate("xyz")}
        columns |= {f"{name}.torque.{x} [Ncm]": 100.0 * log.time for x in "xyz"}
        columns |= {f"contact/{name}": log.contact_active[:, k].astype(int)}
    found, said, text = initiated(save_csv(tmp_path / "x.csv", columns))
    order = [found.contact_names.index(name) for name in log.contact_names]
    np.testing.assert_array_equal(value(found.contact_active)[:, order], log.contact_active)
    touching = log.contact_active[..., None] & np.ones(3, dtype=bool)
    wrench = value(found.contact_wrench_local)[:, order]
    np.testing.assert_allclose(wrench[..., :3][touching], log.contact_wrench_local[..., :3][touching], atol=1e-9)
    assert map_in(text)["contact_name"] == "{contact}_foot"
    assert any(line.startswith("contact_wrench_local: wrenches act on the robot") for line in said.assumed)


@pytest.mark.parametrize("components", ["Fx Fy Fz Mx My Mz", "fx fy fz mx my mz"])
def test_a_wrench_is_a_contact_of_the_link_that_its_columns_name_also_above_other_bodies(
    tmp_path: Path, components: str
) -> None:
    """Feet of a person, whose toes are bodies of their own; the plates' wrenches are those of the heels."""
    parts = [link("pelvis")]
    columns: dict[str, Any] = {"t": 0.01 * np.arange(200)}
    for number, side in enumerate("rl"):
        above = "pelvis"
        for body, hinge in (("tibia", "hip"), ("calcn", "ankle"), ("toes", "mtp")):
            parts += [link(f"{body}_{side}"), joint(f"{hinge}_{side}", above, f"{body}_{side}")]
            columns[f"q_{hinge}_{side}"] = np.sin(columns["t"] + number)
            above = f"{body}_{side}"
        for k, x in enumerate(components.split()):
            columns[f"calcn_{side}_{x}"] = 10.0 + number + np.cos(columns["t"] + k)
    found, _, text = initiated(save_csv(tmp_path / "x.csv", columns), write(tmp_path, *parts))
    names = [entry["frame"] for entry in yaml.safe_load(text)["contacts"]]
    assert sorted(names) == ["calcn_l", "calcn_r"]
    expected = np.stack([columns[f"calcn_l_{x}"] for x in components.split()], axis=1)
    wrench = value(found.contact_wrench_local)[:, found.contact_names.index("calcn_l")]
    np.testing.assert_allclose(wrench, expected, atol=1e-12)


def test_one_number_of_each_foot_is_no_flag_but_a_comment(tmp_path: Path) -> None:
    log = recorded()
    columns = by_name(log) | {f"force_{foot}": 10.0 * log.time for foot in log.contact_names}
    found, said, text = initiated(save_csv(tmp_path / "x.csv", columns))
    assert "    # contact_active: {column: 'force_{contact}', above: FILL_IN}" in text
    assert any(line.startswith("contact_active: uncertain") for line in said.missing)
    assert_recorded(found, log)


# --------------------------------------------------------------------------------------------------- numbers, arrays


@pytest.mark.parametrize("first", [0, 1])
def test_numbered_columns_have_the_order_of_the_robots_file_which_is_said(tmp_path: Path, first: int) -> None:
    log = recorded()
    columns: dict[str, Any] = {"stamp": log.time}
    for pattern, field in zip(("q{}", "dq{}", "tau{}"), FIELDS, strict=True):
        columns |= {pattern.format(k + first): x for k, x in enumerate(value(getattr(log, field)).T)}
    columns |= {f"temp{k}": log.time for k in range(12)}
    found, said, text = initiated(save_csv(tmp_path / "x.csv", columns))
    assert_recorded(found, log)
    assert map_in(text)["joint_order"] == list(log.joint_names)
    assert any(line.startswith("joint_order: the order of the robot's file") for line in said.assumed)


def test_a_robot_known_by_name_has_its_makers_order(tmp_path: Path) -> None:
    time = 0.005 * np.arange(300)
    columns: dict[str, Any] = {"tick": np.round(1e3 * time).astype(int)}
    for what in ("q", "dq", "tau_est"):
        columns |= {f"motor_state[{k}].{what}": np.sin(time + k) * (k < 12) for k in range(20)}
    go2 = ROBOTS / "go2_description/urdf/go2.urdf"
    found, said, text = initiated(save_csv(tmp_path / "x.csv", columns), go2)
    assert map_in(text)["joint_order"] == "go2"
    assert map_in(text)["time"] == {"column": "tick", "unit": "ms"}
    np.testing.assert_allclose(found.joint_position[:, found.joint_names.index("FL_hip_joint")], np.sin(time + 3))
    assert any("the motor order of go2" in line for line in said.assumed)


def test_a_list_of_names_in_the_file_is_the_order(tmp_path: Path) -> None:
    """With a gripper's finger that mimics another, in the middle of the arrays."""
    log = recorded()
    arrays = {name: x for name, x in arrays_of(log).items() if name != "joint_names"}
    arrays |= {name: np.insert(arrays[name], 5, 0.1 * log.time, axis=1) for name in ("q", "dq", "tau")}
    np.savez(tmp_path / "x.npz", **arrays, name=np.array([*ORDER[:5], "r_finger", *ORDER[5:]]))
    found, said, _ = initiated(tmp_path / "x.npz")
    assert_recorded(found, log)
    assert any(line.startswith("joint_order: the order in 'name'") for line in said.assumed)


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".mat"])
def test_samples_in_columns_are_transposed_by_their_number(tmp_path: Path, suffix: str) -> None:
    log, path = recorded(), tmp_path / f"x{suffix}"
    arrays = {name: x.T if x.ndim == 2 else x for name, x in arrays_of(log).items() if name != "joint_names"}
    arrays = {name: in_file_order(log, x.T).T if x.shape[0] == 12 else x for name, x in arrays.items()}
    arrays |= {"K": np.eye(12), "tau_des": arrays["tau"]}
    if suffix == ".npz":
        np.savez(path, **arrays)
    else:
        with h5py.File(path, "w") as file:
            for name, x in arrays.items():
                file[f"log/{name}"] = x
    found, said, text = initiated(path)
    assert map_in(text)["joint_position"] == f"{'' if suffix == '.npz' else 'log/'}q.T"
    assert any(f"are the {len(log)} samples; .T transposes it" in line for line in said.assumed)
    assert_recorded(found, log)
    np.testing.assert_array_equal(value(found.base_position_world), value(log.base_position_world))


def in_file_order(log: Log, values: np.ndarray) -> np.ndarray:
    """Columns in the order of the robot's file, of those in `ORDER`."""
    return values[:, [ORDER.index(name) for name in log.joint_names]]


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_fields_of_records_are_arrays(tmp_path: Path, suffix: str) -> None:
    log, path = recorded(), tmp_path / f"x{suffix}"
    arrays = {name: x for name, x in arrays_of(log).items() if name != "joint_names"}
    records = np.zeros(len(log), [(name, x.dtype, x.shape[1:]) for name, x in arrays.items()] + [("status", "u4")])
    for name, x in arrays.items():
        records[name] = x
    if suffix == ".npz":
        np.savez(path, data=records, joint_names=np.array(ORDER))
    else:
        with h5py.File(path, "w") as file:
            file["data"], file["joint_names"] = records, ORDER
    found, _, text = initiated(path)
    assert map_in(text)["joint_position"] == "data['q']"
    assert_recorded(found, log)


def test_matlabs_structures_and_python_objects(tmp_path: Path) -> None:
    log = recorded()
    arrays = arrays_of(log)
    scipy.io.savemat(tmp_path / "x.mat", {"log": arrays | {"joint_names": np.array(ORDER, dtype=object)}})
    found, _, text = initiated(tmp_path / "x.mat")
    assert map_in(text)["joint_position"] == "log/q"
    assert_recorded(found, log)
    rows = [{"t": t, "q": q} for t, q in zip(log.time, log.joint_position, strict=True)]
    np.savez(tmp_path / "y.npz", data=np.array(rows, dtype=object))
    line = refused(lambda: init(URDF, tmp_path / "y.npz", tmp_path / "y.yaml"), str(tmp_path / "y.npz"), LogError)
    assert "data: Python objects (pickled), references or ragged rows; accepted: one plain array per field" in line


# -------------------------------------------------------------------------------------------------------------- units


@pytest.mark.parametrize(
    ("time", "names"),
    [
        ("t [us]", ("q {} [deg]", "dq {} [mrad/s]", "tau {} (Ncm)")),
        ("t_us", ("{}_deg", "{}_mrad/s", "{}_Ncm")),
        ("stamp (us)", ("{} (deg)", "{}(mrad/s)", "{} (N cm)")),
    ],
)
def test_units_in_headers_are_those_of_the_map(tmp_path: Path, time: str, names: tuple[str, ...]) -> None:
    log = recorded()
    columns = by_name(log, names)
    del columns["t"]
    for pattern, factor in zip(names, (UNITS["angle"]["deg"], 1e-3, 1e-2), strict=True):
        columns |= {pattern.format(x): columns[pattern.format(x)] / factor for x in log.joint_names}
    found, said, _ = initiated(save_csv(tmp_path / "x.csv", {time: 1e6 * log.time} | columns))
    assert_recorded(found, log)
    assert not any(note.startswith(("time", "joint_")) for note in said.assumed)


def test_a_unit_that_nobody_knows_is_to_be_filled_in(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = save_csv(tmp_path / "x.csv", by_name(recorded(), ("q_{} [gon]", "dq_{}", "tau_{}")))
    said = init(URDF, path, tmp_path / "x.yaml")
    assert any("unit 'gon' of its columns is no angle or length unit" in line for line in said.missing)
    message = refusal(["identify", str(tmp_path / "x.yaml")], tmp_path, capsys)
    assert "logs.columns.joint_position.unit: 'FILL_IN', an unknown unit; accepted: rad, mrad, deg, rev" in message


def test_degrees_and_milliseconds_are_known_by_their_size(tmp_path: Path) -> None:
    log = recorded()
    columns = by_name(log)
    columns |= {"t": 1e3 * log.time}
    columns |= {x: np.degrees(y) + 360.0 for x, y in columns.items() if x.startswith("q_")}
    found, said, _ = initiated(save_csv(tmp_path / "x.csv", columns))
    np.testing.assert_allclose(found.joint_velocity, log.joint_velocity, atol=1e-9)
    np.testing.assert_allclose(found.joint_position, log.joint_position + 2.0 * np.pi, atol=1e-9)
    keys = [line.partition(":")[0] for line in said.assumed]
    assert {"time", "joint_position"} <= set(keys)


# -------------------------------------------------------------------------------------------------------- what lacks


def test_joints_without_columns_are_welded_and_torques_may_be_of_some(tmp_path: Path) -> None:
    log = recorded()
    lost, unmeasured = log.joint_names[2:9], log.joint_names[0]
    columns = {name: x for name, x in by_name(log).items() if not name.endswith(lost)}
    del columns[f"tau_{unmeasured}"]
    columns["q_x"] = log.time
    found, said, text = initiated(save_csv(tmp_path / "x.csv", columns))
    config = load_config(tmp_path / "x.yaml")
    assert set(config.robot.weld) == set(lost)
    assert set(found.joint_names) == set(log.joint_names) - set(lost)
    assert np.isnan(value(found.joint_torque)[:, found.joint_names.index(unmeasured)]).all()
    assert set(config.sensors.joint_torques) == set(found.joint_names) - {unmeasured}
    assert map_in(text)["ignore"] == ["*", "q_x"]
    assert any(line.startswith("robot.weld: ") for line in said.assumed)


def test_a_joint_with_a_torque_but_without_a_position_is_said(tmp_path: Path) -> None:
    log = recorded()
    columns = by_name(log)
    del columns[f"q_{log.joint_names[4]}"]
    found, said, _ = initiated(save_csv(tmp_path / "x.csv", columns))
    assert f"joint_torque: without {log.joint_names[4]}: no position in the log" in said.assumed
    assert log.joint_names[4] not in found.joint_names


UNKNOWN = {
    "positions": ("out_{}", "dq_{}", "tau_{}", "joint_position: still FILL_IN; accepted: the name"),
    "torques": ("q_{}", "dq_{}", "out_{}", "joint_torque: still FILL_IN; accepted: the name"),
}


@pytest.mark.parametrize("what", UNKNOWN)
def test_what_no_name_says_is_listed_and_filled_in_within_a_minute(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str
) -> None:
    log, (*names, message) = recorded(), UNKNOWN[what]
    path = save_csv(tmp_path / "x.csv", by_name(log, tuple(names)) | {"mode": [1] * 300, "note": ["a", "b"] * 150})
    said = init(URDF, path, tmp_path / "x.yaml")
    assert said.lines[-1][1].endswith("next: replace FILL_IN there")
    text = (tmp_path / "x.yaml").read_text()
    comments = [line for line in text.splitlines() if line.lstrip().startswith("#   ")]
    assert all(len(line) <= 80 for line in comments)
    assert "    #   mode: 1 to 1" in comments
    assert "    #   note: no numbers" in comments
    assert any(line.startswith("    #   out_{joint}: 12 columns, ") for line in comments)
    found = refusal(["identify", str(tmp_path / "x.yaml")], tmp_path, capsys)
    assert f"logs.columns.{message}" in found
    (tmp_path / "x.yaml").write_text(text.replace(": FILL_IN\n", ": 'out_{joint}'\n"))
    assert_recorded(read_log(path, columns=load_config(tmp_path / "x.yaml").logs.columns), log)


def test_a_quaternion_without_the_order_of_its_components_is_left_to_a_person(tmp_path: Path) -> None:
    arrays = arrays_of(recorded())
    arrays["base_quat"] = arrays.pop("quat_wxyz")
    np.savez(tmp_path / "x.npz", **arrays)
    _, said, text = initiated(tmp_path / "x.npz")
    assert "    # base_quat_wxyz: base_quat\n" in text
    assert "    # base_quat_xyzw: base_quat\n" in text
    assert any(line.startswith("base_quat_wxyz, base_quat_xyzw: uncertain") for line in said.missing)


# ------------------------------------------------------------------------------------- stamps, columns without names


def test_seconds_and_nanoseconds_in_two_columns_are_one_stamp(tmp_path: Path) -> None:
    log = recorded()
    stamp = np.round(log.time * 1e9).astype(np.int64) + 999_000_000
    columns = {"header.stamp.sec": stamp // 10**9, "header.stamp.nanosec": stamp % 10**9} | by_name(log)
    del columns["t"]
    found, _, text = initiated(save_csv(tmp_path / "x.csv", columns))
    np.testing.assert_allclose(found.time, log.time - log.time[0] + stamp[0] / 1e9, rtol=0.0, atol=1e-9)
    assert map_in(text)["time"] == {"column": "header.stamp.sec", "nanoseconds": "header.stamp.nanosec"}


def test_without_stamps_the_step_is_that_by_which_velocities_are_slopes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = recorded()
    columns = by_name(log)
    del columns["t"]
    found, said, text = initiated(save_csv(tmp_path / "x.csv", columns))
    assert map_in(text)["time"] == {"step": 10.0, "unit": "ms"}
    np.testing.assert_allclose(found.time, log.time - log.time[0], atol=1e-9)
    assert any(
        line.startswith("time: the log has no stamps; with this step velocities are the slopes of positions")
        for line in said.assumed
    )
    columns = {name: x for name, x in columns.items() if not name.startswith("dq")}
    init(URDF, save_csv(tmp_path / "y.csv", columns), tmp_path / "y.yaml")
    message = refusal(["identify", str(tmp_path / "y.yaml")], tmp_path, capsys)
    assert "logs.columns.time.step: found 'FILL_IN'; accepted: a number" in message


@pytest.mark.parametrize("counted", [False, True], ids=["numbers alone", "a line that counts the columns"])
def test_columns_without_names_are_known_by_their_place_and_slopes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], counted: bool
) -> None:
    log = recorded()
    columns = {str(k): x for k, x in enumerate(by_name(log).values())}
    path = save_csv(tmp_path / "x.csv", columns)
    path.write_text(path.read_text() if counted else path.read_text().partition("\n")[2])
    assert "columns: 37 columns of numbers without a line of names" in refusal(["check", str(path)], tmp_path, capsys)
    init(URDF, path, tmp_path / "x.yaml")
    text = (tmp_path / "x.yaml").read_text()
    assert map_in(text)["time"] == "column_0"
    assert map_in(text)["joint_velocity"] == {"column": "column_{index}", "first_index": 13}
    assert "    #   column_25: " in text
    torque = "joint_torque: {column: 'column_{index}', first_index: 25}"
    (tmp_path / "x.yaml").write_text(text.replace("joint_torque: FILL_IN", torque))
    assert_recorded(read_log(path, columns=load_config(tmp_path / "x.yaml").logs.columns), log)


def test_two_files_with_clocks_of_their_own_are_one_log(tmp_path: Path) -> None:
    log = recorded()
    columns = by_name(log)
    motion = {name: x for name, x in columns.items() if not name.startswith("tau")}
    forces = {name: x for name, x in columns.items() if name.startswith("tau")}
    save_csv(tmp_path / "motion.csv", motion | {"mode": log.time})
    save_csv(tmp_path / "forces.csv", {"t_ms": 1e3 * (log.time + 50.0), **forces, "mode": log.time})
    name = tmp_path / "motion.csv + forces.csv@-50s"
    init(URDF, name, tmp_path / "x.yaml")
    found = read_log(name, columns=load_config(tmp_path / "x.yaml").logs.columns)
    np.testing.assert_allclose(found.joint_torque, log.joint_torque, rtol=1e-9, atol=1e-9)


def test_arrays_with_clocks_of_their_own_have_other_times(tmp_path: Path) -> None:
    log = recorded()
    arrays = {f"joints/{name}": x for name, x in arrays_of(log).items() if not name.startswith(("base", "joint"))}
    imu = {"imu/t": log.time[::2], "imu/gyro": value(log.imu_angular_velocity)[::2]}
    np.savez(tmp_path / "x.npz", joint_names=ORDER, **arrays, **imu, **{"imu/acc": value(log.imu_specific_force)[::2]})
    found, _, text = initiated(tmp_path / "x.npz")
    assert map_in(text)["other_times"] == [{"column": "imu/t"}]
    np.testing.assert_allclose(found.imu_angular_velocity[::2], imu["imu/gyro"][: len(found.time[::2])], atol=1e-9)


# -------------------------------------------------------------------------------------------- logs that once failed


@pytest.mark.parametrize("name", ["part_of_robot", "no_stamps", "bag_other_names", "no_header"])
@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_logs_of_strangers_need_no_edit_or_one(tmp_path: Path, name: str) -> None:
    if not CASES.is_dir():
        pytest.skip("logs of strangers are not beside the repository")
    log = CASES / name / ("log" if name == "bag_other_names" else "arm.csv")
    init(CASES / name / "arm.urdf", log, tmp_path / "a.yaml")
    text = (tmp_path / "a.yaml").read_text()
    block = "joint_torque: {column: 'column_{index}', first_index: 7}"
    (tmp_path / "a.yaml").write_text(text.replace("joint_torque: FILL_IN", block))
    assert ("FILL_IN\n" in text) is (name == "no_header")
    assert main(["identify", str(tmp_path / "a.yaml"), "--quiet", f"output={tmp_path / 'run'}"]) == 0
    bodies = json.loads((tmp_path / "run" / "parameters.json").read_text())["bodies"]
    for body in bodies[1:] if name == "part_of_robot" else ():
        assert (body["identified"]["fc"], body["identified"]["fv"]) == pytest.approx((0.4, 0.3), rel=0.02)
