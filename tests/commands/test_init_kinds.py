"""`torchid init` of kinds of recordings: a base without a name, currents, samples in columns, records, slides."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import yaml
from dialects import ORDER, in_order, save_csv, wxyz
from initiated import URDF, columns_of, initiated, recorded
from motions import value
from refusals import refused
from scipy.spatial.transform import Rotation
from synthetic import ROBOTS

from torchid.commands.init import init
from torchid.config import load_config
from torchid.errors import LogError
from torchid.logs import Log, read_log

TIAGO = ROBOTS / "tiago_description/robots/tiago_no_hand.urdf"
JOINTS = ("q_{}", "dq_{}", "tau_{}")


def columns_by_name(log: Log) -> dict[str, Any]:
    """Stamps, and columns by name of the joint."""
    fields = {"q": log.joint_position, "dq": log.joint_velocity, "tau": log.joint_torque}
    columns = {f"{what}_{name}": value(x)[:, k] for what, x in fields.items() for k, name in enumerate(log.joint_names)}
    return {"t": log.time} | columns


def arrays_of(log: Log) -> dict[str, Any]:
    """Arrays with a row for each sample, joints in an order that the file lists."""
    return {
        "t": log.time,
        "joint_names": np.array(ORDER),
        "q": in_order(log, log.joint_position),
        "dq": in_order(log, log.joint_velocity),
        "tau": in_order(log, log.joint_torque),
        "base_quat": wxyz(log),
        "base_pos": value(log.base_position_world),
    }


def assert_recorded(found: Log, log: Log) -> None:
    for name in ("joint_position", "joint_velocity", "joint_torque"):
        np.testing.assert_allclose(in_order(found, getattr(found, name)), in_order(log, getattr(log, name)), atol=1e-12)
    np.testing.assert_allclose(found.time, log.time, atol=1e-12)


# ------------------------------------------------------------------------------------------------------------ the base


@pytest.mark.parametrize(
    "names", [("X", "Y", "Z"), ("p1", "p2", "p3"), ("pos_0", "pos_1", "pos_2"), ("x [mm]", "y [mm]", "z [mm]")]
)
@pytest.mark.parametrize(
    "quaternion",
    [("QW", "QX", "QY", "QZ"), ("Qw", "Qx", "Qy", "Qz"), ("e0", "e1", "e2", "e3"), ("ow", "ox", "oy", "oz")],
)
def test_the_pose_of_a_base_is_known_by_its_numbers(
    tmp_path: Path, names: tuple[str, ...], quaternion: tuple[str, ...]
) -> None:
    log, scale = recorded(), 1e3 if "mm" in names[0] else 1.0
    columns = {"t": log.time} | columns_of(log, JOINTS)
    columns |= dict(zip(names, scale * value(log.base_position_world).T, strict=True))
    columns |= dict(zip(quaternion, wxyz(log).T, strict=True))
    found, _, _ = initiated(save_csv(tmp_path / "x.csv", columns))
    np.testing.assert_allclose(value(found.base_position_world), value(log.base_position_world), atol=1e-12)
    np.testing.assert_allclose(value(found.base_quat_xyzw), value(log.base_quat_xyzw), atol=1e-12)


def test_an_array_called_position_is_the_path_of_the_base(tmp_path: Path) -> None:
    log = recorded()
    arrays = arrays_of(log)
    arrays["position"] = arrays.pop("base_pos")
    np.savez(tmp_path / "x.npz", **arrays)
    found, _, _ = initiated(tmp_path / "x.npz")
    np.testing.assert_array_equal(value(found.base_position_world), value(log.base_position_world))
    assert_recorded(found, log)


@pytest.mark.parametrize(
    "names",
    [
        "com_{}",
        "com_pos_{}",
        "zmp_{}",
        "target_{}",
        "pos_des_{}",
        "foot_pos_{}",
        "hand_position_{}",
        "marker_{}",
        "p{}_N",
    ],
)
def test_positions_of_something_else_are_not_those_of_the_base(tmp_path: Path, names: str) -> None:
    log = recorded()
    columns = {"t": log.time} | columns_of(log, JOINTS)
    for numbered in ("xyz", "012"):
        path = dict(zip(map(names.format, numbered), value(log.base_position_world).T, strict=True))
        found, _, _ = initiated(save_csv(tmp_path / f"{numbered}.csv", columns | path))
        assert found.base_position_world is None


def test_numbers_that_jump_are_no_path_and_those_of_another_length_no_quaternion(tmp_path: Path) -> None:
    log, rng = recorded(), np.random.default_rng(0)
    columns = {"t": log.time} | columns_of(log, JOINTS)
    columns |= dict(zip("XYZ", rng.normal(size=(3, len(log))), strict=True))
    columns |= dict(zip(("e0", "e1", "e2", "e3"), 1.01 * wxyz(log).T, strict=True))
    found, _, _ = initiated(save_csv(tmp_path / "x.csv", columns))
    assert found.base_position_world is None
    assert found.base_quat_xyzw is None


@pytest.mark.parametrize("has_imu", [True, False])
@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
@pytest.mark.parametrize("turn", [[0.0, 0.0, 2.2], [0.0, 0.0, -1.7], [2.1, 0.3, 0.2], [0.2, 2.4, 0.1]])
def test_the_order_of_a_quaternion_is_that_by_which_gravity_or_the_base_points_up(
    tmp_path: Path, turn: list[float], order: str, has_imu: bool
) -> None:
    upright = turn[0] + turn[1] == 0.0
    if not upright and not has_imu:
        return
    log = recorded()
    quat = (Rotation.from_rotvec(turn) * Rotation.from_quat(value(log.base_quat_xyzw))).as_quat()
    arrays = arrays_of(log) | {"base_quat": quat if order == "xyzw" else np.roll(quat, 1, axis=1)}
    if has_imu:
        arrays["imu_acc"] = Rotation.from_quat(quat).inv().apply([0.0, 0.0, 9.81])
        arrays["imu_gyro"] = np.zeros((len(log), 3))
    np.savez(tmp_path / "x.npz", **arrays)
    found, _, text = initiated(tmp_path / "x.npz")
    np.testing.assert_allclose(np.abs(np.sum(value(found.base_quat_xyzw) * quat, axis=1)), 1.0, atol=1e-12)
    assert ("where the accelerometer reads it" in text) == has_imu


def test_an_order_in_a_name_counts_before_the_numbers(tmp_path: Path) -> None:
    log = recorded()
    arrays = arrays_of(log)
    arrays["orientation_xyzw"] = arrays.pop("base_quat")
    np.savez(tmp_path / "x.npz", **arrays)
    initiated(tmp_path / "x.npz")
    assert "base_quat_xyzw: orientation_xyzw" in (tmp_path / "x.yaml").read_text()


# ----------------------------------------------------------------------------------------------- currents, units, turns


@pytest.mark.parametrize(
    ("name", "per_ampere"),
    [("{}/i_meas_A", 1.0), ("motor_current_{}", 1.0), ("{}.iq [mA]", 1e3), ("{}_effort [A]", 1.0), ("cur_{}", 1.0)],
)
def test_currents_are_torques_once_constants_and_gears_are_put_in(tmp_path: Path, name: str, per_ampere: float) -> None:
    log, torque = recorded(), in_order(recorded(), recorded().joint_torque)
    constant, gear = {"*": 0.1, "*_knee": 0.2}, {"*": 8.0, "*_hip": 6.0}
    columns: dict[str, Any] = {"t": log.time}
    for k, joint in enumerate(ORDER):
        factor = (0.2 if "knee" in joint else 0.1) * (6.0 if "hip" in joint else 8.0)
        columns |= {f"{joint}_q": in_order(log, log.joint_position)[:, k], f"{joint}_temp": log.time}
        columns |= {name.format(joint): per_ampere * torque[:, k] / factor}
    path = save_csv(tmp_path / "x.csv", columns)
    found, said, text = initiated(path)
    assert found.joint_torque is None
    assert any("may be currents of motors; put torque constants and gear ratios in the file" in x for x in said.missing)
    edited = text.replace("# joint_torque:", "joint_torque:").replace("KT", str(constant)).replace("GEAR", str(gear))
    path.with_suffix(".yaml").write_text(edited.replace("put in N m/A for {'*'", "put in N m/A for KT # {'*'"))
    log_of_file = read_log(path, columns=load_config(path.with_suffix(".yaml")).logs.columns)
    np.testing.assert_allclose(in_order(log_of_file, log_of_file.joint_torque), torque, atol=1e-12)
    path.with_suffix(".yaml").write_text(text.replace("# joint_torque:", "joint_torque:"))
    line = refused(lambda: load_config(path.with_suffix(".yaml")), "", Exception)
    assert "joint_torque.current.torque_constant" in line


def test_a_measured_torque_is_taken_before_currents(tmp_path: Path) -> None:
    log = recorded()
    columns = columns_by_name(log)
    columns |= {f"current_{k}": log.time for k in range(12)}
    found, _, text = initiated(save_csv(tmp_path / "x.csv", columns))
    assert "KT" not in text
    assert_recorded(found, log)


def slid(seed: int = 0) -> tuple[Log, np.ndarray]:
    """A motion of a robot with a slide among hinges, and which of its joints that is."""
    from torchid.robot import load_robot

    robot, rng = load_robot(TIAGO), np.random.default_rng(seed)
    time = 0.005 * np.arange(400)
    turn = np.outer(time, rng.uniform(2.0, 5.0, robot.n)) + rng.uniform(0.0, 6.0, robot.n)
    slide = np.isin(robot.joint_names, robot.sliding)
    size = np.where(slide, 0.05, 0.6)
    position, velocity = size * np.sin(turn), np.gradient(size * np.sin(turn), time, axis=0)
    torque = rng.normal(size=position.shape)
    return Log("x", time, robot.joint_names, position, joint_velocity=velocity, joint_torque=torque), slide


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
@pytest.mark.parametrize("how", ["in names", "in numbers", "by number"])
def test_a_slide_among_hinges_has_a_unit_of_its_own(tmp_path: Path, how: str) -> None:
    log, slide = slid()
    columns: dict[str, Any] = {"t": log.time}
    for k, name in enumerate(log.joint_names):
        position, speed, force = ("mm", "mm/s", "N") if slide[k] else ("deg", "deg/s", "Nm")
        joint = str(k) if how == "by number" else name
        units = ("", "", "") if how == "in numbers" else (f" [{position}]", f" [{speed}]", f" [{force}]")
        factor = 1e3 if slide[k] else 180.0 / np.pi
        columns |= {f"{joint}_pos{units[0]}": factor * log.joint_position[:, k]}
        columns |= {f"{joint}_vel{units[1]}": factor * value(log.joint_velocity)[:, k]}
        columns |= {f"{joint}_eff{units[2]}": value(log.joint_torque)[:, k]}
    found, _, _ = initiated(save_csv(tmp_path / "x.csv", columns), TIAGO)
    order = [found.joint_names.index(name) for name in log.joint_names]
    for name in ("joint_position", "joint_velocity", "joint_torque"):
        np.testing.assert_allclose(value(getattr(found, name))[:, order], value(getattr(log, name)), atol=1e-9)


def test_turns_begin_where_each_joint_is_never(tmp_path: Path) -> None:
    """One joint swings about half a turn, another about none: no place suits both."""
    log = recorded()
    position = in_order(log, log.joint_position).copy()
    position[:, 0] = np.pi + 2.6 * np.sin(2.0 * log.time)
    position[:, 1] = 2.6 * np.sin(2.5 * log.time)
    wrapped = position.copy()
    wrapped[:, 0] = np.mod(position[:, 0] + np.pi, 2.0 * np.pi) - np.pi
    wrapped[:, 1] = np.mod(position[:, 1], 2.0 * np.pi)
    columns = {"t": log.time} | {f"{name}.deg": np.degrees(x) for name, x in zip(ORDER, wrapped.T, strict=True)}
    found, said, text = initiated(save_csv(tmp_path / "x.csv", columns))
    np.testing.assert_allclose(in_order(found, found.joint_position), position, atol=1e-9)
    entry = yaml.safe_load(text)["logs"]["columns"]["joint_position"]
    assert set(entry["turn_from"]) == set(ORDER[:2])
    assert any("as angles jump by a whole turn" in line for line in said.guessed)


# ----------------------------------------------------------------------------------------------------- kinds of arrays


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".mat"])
def test_samples_in_columns_are_transposed_by_their_number(tmp_path: Path, suffix: str) -> None:
    log, path = recorded(), tmp_path / f"x{suffix}"
    arrays = {name: x.T if x.ndim == 2 else x[None] for name, x in arrays_of(log).items() if name != "joint_names"}
    arrays["K"] = np.eye(12)
    if suffix == ".npz":
        np.savez(path, **arrays)
    else:
        with h5py.File(path, "w") as file:
            for name, x in arrays.items():
                file[f"log/{name}"] = x
            file["#refs#/a"] = np.zeros(3)
    found, said, text = initiated(path)
    names = {name: f"{'' if suffix == '.npz' else 'log/'}{name}.T" for name in arrays}
    assert yaml.safe_load(text)["logs"]["columns"]["joint_position"] == names["q"]
    assert any(f"are the {len(log)} samples: .T transposes them" in line for line in said.guessed)
    np.testing.assert_array_equal(found.joint_position, in_order(log, log.joint_position))
    np.testing.assert_array_equal(value(found.base_position_world), value(log.base_position_world))


def test_as_many_samples_as_joints_are_said_and_not_transposed(tmp_path: Path) -> None:
    log = recorded().select(slice(0, 12))
    arrays = {name: x for name, x in arrays_of(log).items() if not name.startswith("base")}
    np.savez(tmp_path / "x.npz", **arrays)
    found, said, text = initiated(tmp_path / "x.npz")
    assert any(
        "as many samples as joints: if the columns of 'q' are the samples, write 'q.T'" in x for x in said.guessed
    )
    assert ".T" not in yaml.safe_dump(yaml.safe_load(text))
    np.testing.assert_array_equal(found.joint_position, arrays["q"])


def test_a_map_without_the_transposition_names_it(tmp_path: Path) -> None:
    log = recorded()
    np.savez(tmp_path / "x.npz", time=log.time, q=log.joint_position.T)
    settings: dict[str, Any] = {"joint_order": list(log.joint_names), "joint_position": {"column": "q"}}
    from torchid.logs import Columns

    line = refused(lambda: read_log(tmp_path / "x.npz", columns=Columns(**settings)), str(tmp_path / "x.npz"), LogError)
    assert "'q.T' if its columns are the samples" in line


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
    assert yaml.safe_load(text)["logs"]["columns"]["joint_position"] == "data['q']"
    assert_recorded(found, log)
    np.testing.assert_array_equal(value(found.base_position_world), value(log.base_position_world))


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_records_have_a_field_for_each_joint(tmp_path: Path, suffix: str) -> None:
    log, path = recorded(), tmp_path / f"x{suffix}"
    of_joint = [("pos", "f8"), ("vel", "f8"), ("torque", "f8"), ("fault", "u2")]
    records = np.zeros(len(log), [("stamp", "f8"), *((name, of_joint) for name in ORDER)])
    records["stamp"] = log.time
    for what, x in (("pos", log.joint_position), ("vel", log.joint_velocity), ("torque", log.joint_torque)):
        for name, values in zip(ORDER, in_order(log, x).T, strict=True):
            records[name][what] = values
    if suffix == ".npz":
        np.savez(path, records=records)
    else:
        with h5py.File(path, "w") as file:
            file["robot/records"] = records
    found, _, text = initiated(path)
    root = "records" if suffix == ".npz" else "robot/records"
    assert yaml.safe_load(text)["logs"]["columns"]["joint_position"] == f"{root}['{{joint}}']['pos']"
    assert_recorded(found, log)


def test_a_gyroscope_in_degrees_is_known_by_how_the_base_turns(tmp_path: Path) -> None:
    """Its accelerometer reads more than gravity."""
    log, rng = recorded(), np.random.default_rng(0)
    tilt = 0.05 * np.sin(3.0 * log.time)
    quat = Rotation.from_rotvec(np.outer(tilt, [1.0, 0.0, 0.0])).as_quat()
    rate = np.outer(0.15 * np.cos(3.0 * log.time), [1.0, 0.0, 0.0])
    force = [0.0, 0.0, 9.81] + 3.0 * rng.normal(size=(len(log), 3))
    arrays = arrays_of(log) | {"base_quat": quat, "imu_acc": force}
    for name, factor in (("rad", 1.0), ("deg", 180.0 / np.pi)):
        np.savez(tmp_path / f"{name}.npz", **arrays, imu_gyro=factor * rate)
        found, _, _ = initiated(tmp_path / f"{name}.npz")
        np.testing.assert_allclose(value(found.imu_angular_velocity), rate, atol=1e-12)


def test_python_objects_are_refused_in_a_line_and_left_out_where_nobody_needs_them(tmp_path: Path) -> None:
    log = recorded()
    rows = [{"t": t, "q": q} for t, q in zip(log.time, log.joint_position, strict=True)]
    np.savez(tmp_path / "x.npz", data=np.array(rows, dtype=object))
    line = refused(lambda: init(URDF, tmp_path / "x.npz", tmp_path / "x.yaml"), str(tmp_path / "x.npz"), LogError)
    assert "data: Python objects (pickled), references or ragged rows; accepted: plain arrays, one for each" in line
    np.savez(tmp_path / "y.npz", **arrays_of(log), notes=np.array([{"operator": "x"}], dtype=object))
    assert_recorded(initiated(tmp_path / "y.npz")[0], log)


@pytest.mark.parametrize("do_compression", [False, True])
def test_matlabs_files_of_before_7_3_are_read_with_what_is_in_structures(tmp_path: Path, do_compression: bool) -> None:
    log = recorded()
    arrays = arrays_of(log)
    arrays["joint_names"] = np.array(arrays["joint_names"], dtype=object)  # a cell array
    scipy.io.savemat(tmp_path / "x.mat", {"log": arrays, "note": "a walk"}, do_compression=do_compression)
    found, _, text = initiated(tmp_path / "x.mat")
    assert yaml.safe_load(text)["logs"]["columns"]["joint_position"] == "log/q"
    assert_recorded(found, log)


def test_what_matlab_4_wrote_is_refused(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "x.mat", {"q": np.zeros((5, 12))}, format="4")
    line = refused(lambda: init(URDF, tmp_path / "x.mat", tmp_path / "x.yaml"), str(tmp_path / "x.mat"), LogError)
    assert "accepted: a complete file of Matlab 5 or later" in line


@pytest.mark.parametrize(("suffix", "separator"), [("txt", " "), ("tsv", "\t"), ("dat", ";")])
def test_tables_of_text_have_many_endings(tmp_path: Path, suffix: str, separator: str) -> None:
    log = recorded()
    found, _, _ = initiated(save_csv(tmp_path / f"x.{suffix}", columns_by_name(log), separator))
    assert_recorded(found, log)
