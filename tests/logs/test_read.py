"""Log files: what is read comes back in canonical frames, what is wrong is named in one line."""

from __future__ import annotations

import dataclasses
import os
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from raw_logs import log_refusal, without_package, write_arrays
from scipy.spatial.transform import Rotation

from torchid.errors import InputError, LogError, UnknownNameError
from torchid.logs import Log, read_log, write_log
from torchid.logs import containers as container

N = 6
SUFFIXES = (".npz", ".h5", ".hdf5")
WRITTEN = (*SUFFIXES, ".csv", ".parquet")


def file_fields() -> dict[str, Any]:
    """A valid file of 6 samples, 2 joints, 2 contacts, a limb's sensor and an IMU, every quantity different."""
    rng = np.random.default_rng(5)
    quat = Rotation.from_rotvec(np.outer(np.arange(N), [0.3, -0.2, 0.5])).as_quat()
    return {
        "time": 0.01 * np.arange(N),
        "joint_names": np.array(["hip", "knee"]),
        "joint_position": rng.standard_normal((N, 2)),
        "joint_velocity": rng.standard_normal((N, 2)),
        "joint_acceleration": rng.standard_normal((N, 2)),
        "joint_torque": np.where(np.arange(N)[:, None] == 2, np.nan, rng.standard_normal((N, 2))),
        "base_quat_xyzw": quat,
        "base_position_world": rng.standard_normal((N, 3)),
        "base_linear_velocity_world": rng.standard_normal((N, 3)),
        "base_angular_velocity_base": rng.standard_normal((N, 3)),
        "base_linear_acceleration_world": rng.standard_normal((N, 3)),
        "base_angular_acceleration_base": rng.standard_normal((N, 3)),
        "contact_names": np.array(["l_sole", "r_sole"]),
        "contact_active": rng.random((N, 2)) > 0.5,
        "contact_wrench_local": np.where(np.arange(6) > 2, np.nan, rng.standard_normal((N, 2, 6))),
        "ft_names": np.array(["l_ankle_ft"]),
        "ft_wrench": np.where(np.arange(N)[:, None, None] == 1, np.nan, rng.standard_normal((N, 1, 6))),
        "imu_frame": np.array("chest_imu"),
        "imu_specific_force": rng.standard_normal((N, 3)),
        "imu_angular_velocity": rng.standard_normal((N, 3)),
        "imu_angular_acceleration": rng.standard_normal((N, 3)),
    }


def changed(**changes: Any) -> dict[str, Any]:
    """The valid file with some fields replaced, or left out where None."""
    return {name: value for name, value in (file_fields() | changes).items() if value is not None}


def edited(name: str, index: object, value: float) -> dict[str, Any]:
    """A change that sets one element of a field."""
    array = file_fields()[name].astype(float)
    array[index] = value
    return {name: array}


def assert_same(one: Log, other: Log) -> None:
    """Both logs hold the same fields and values."""
    assert one.arrays().keys() == other.arrays().keys()
    for name, array in one.arrays().items():
        np.testing.assert_array_equal(array, other.arrays()[name], err_msg=name)
        np.testing.assert_array_equal(np.signbit(array), np.signbit(other.arrays()[name]), err_msg=name)
    assert (one.names, one.imu_frame) == (other.names, other.imu_frame)


@pytest.mark.parametrize("suffix", WRITTEN)
def test_a_written_log_reads_back_the_same(tmp_path: Path, suffix: str) -> None:
    raw = write_arrays(tmp_path / f"raw{suffix if suffix in SUFFIXES else '.npz'}", file_fields())
    log = read_log(raw)
    write_log(log, tmp_path / f"again{suffix}")
    again = read_log(tmp_path / f"again{suffix}")
    assert_same(log, again)
    assert again.source == str(tmp_path / f"again{suffix}")
    assert len(again) == N
    for name, value in file_fields().items():
        if name not in (*again.names, "imu_frame", "base_quat_xyzw"):
            np.testing.assert_array_equal(getattr(again, name), value)
    assert again.ft_names == ("l_ankle_ft",)
    assert again.imu_frame == "chest_imu"
    assert sorted(os.listdir(tmp_path)) == sorted([raw.name, f"again{suffix}"])


@pytest.mark.parametrize("suffix", WRITTEN)
def test_a_log_of_joint_positions_alone_reads_with_everything_else_absent(tmp_path: Path, suffix: str) -> None:
    log = Log("x", np.array([3.0]), ("größe",), np.array([[0.1]]))
    write_log(log, tmp_path / f"x{suffix}")
    again = read_log(tmp_path / f"x{suffix}")
    assert_same(log, again)
    assert set(again.arrays()) == {"time", "joint_position"}


@pytest.mark.parametrize("suffix", WRITTEN)
def test_a_robot_without_joints_has_a_log(tmp_path: Path, suffix: str) -> None:
    fields = {"time": np.arange(3), "joint_names": np.array([]), "joint_position": np.zeros((3, 0))}
    if suffix in SUFFIXES:
        assert read_log(write_arrays(tmp_path / f"x{suffix}", fields)).joint_names == ()
    write_log(Log("x", np.arange(3.0), (), np.zeros((3, 0))), tmp_path / f"y{suffix}")
    assert read_log(tmp_path / f"y{suffix}").joint_position.shape == (3, 0)


def test_names_and_numbers_of_any_width_are_understood(tmp_path: Path) -> None:
    fields = changed(
        joint_names=np.array([b"hip", b"knee"]), contact_active=file_fields()["contact_active"].astype(np.int8)
    )
    fields["joint_position"] = fields["joint_position"].astype(">f4")
    log = read_log(write_arrays(tmp_path / "x.npz", fields))
    assert log.joint_names == ("hip", "knee")
    assert log.joint_position.dtype == np.float64
    np.testing.assert_array_equal(log.contact_active, file_fields()["contact_active"])
    with h5py.File(tmp_path / "x.h5", "w") as file:
        for name, value in file_fields().items():
            file[name] = value.tolist() if value.dtype.kind == "U" else value  # variable-length strings
    assert read_log(tmp_path / "x.h5").contact_names == ("l_sole", "r_sole")


def test_both_quaternion_orders_are_one_rotation_without_sign_flips(tmp_path: Path) -> None:
    quat = file_fields()["base_quat_xyzw"]
    flipped = np.roll(quat, 1, axis=1) * np.array([1, -1, -1, 1, -1, 1.0])[:, None] * 1.0005
    log = read_log(write_arrays(tmp_path / "x.npz", changed(base_quat_xyzw=None, base_quat_wxyz=flipped)))
    assert log.base_quat_xyzw is not None
    np.testing.assert_allclose(
        log.base_quat_xyzw * np.sign(quat[0] @ log.base_quat_xyzw[0]), quat, rtol=0.0, atol=1e-15
    )


@pytest.mark.parametrize(
    ("given_name", "canonical", "to_canonical"),
    [
        ("base_linear_velocity_base", "base_linear_velocity_world", 1),
        ("base_linear_acceleration_base", "base_linear_acceleration_world", 1),
        ("base_angular_velocity_world", "base_angular_velocity_base", -1),
        ("base_angular_acceleration_world", "base_angular_acceleration_base", -1),
    ],
)
def test_components_in_the_other_frame_are_rotated(
    tmp_path: Path, given_name: str, canonical: str, to_canonical: int
) -> None:
    vector = np.random.default_rng(1).standard_normal((N, 3))
    log = read_log(write_arrays(tmp_path / "x.npz", changed(**{canonical: None, given_name: vector})))
    world_base = Rotation.from_quat(file_fields()["base_quat_xyzw"])
    expected = world_base.apply(vector, inverse=to_canonical < 0)
    np.testing.assert_allclose(getattr(log, canonical), expected, rtol=0.0, atol=1e-15)
    without = changed(**{canonical: None, given_name: vector, "base_quat_xyzw": None})
    assert given_name in log_refusal(write_arrays(tmp_path / "y.npz", without))


BAD_FIELDS: list[tuple[dict[str, Any], str, str]] = [
    ({"time": None}, "time", "missing"),
    ({"joint_names": None}, "joint_names", "missing"),
    ({"joint_position": None}, "joint_position", "missing"),
    ({"joint_positon": np.zeros((N, 2))}, "joint_positon", "accepted: joint_position"),
    ({"joint_position": np.zeros((N, 3))}, "joint_position", "shape (6, 3); accepted: shape (N, n) = (6, 2)"),
    ({"joint_torque": np.zeros((N + 1, 2))}, "joint_torque", "shape (7, 2)"),
    ({"time": np.zeros((N, 1))}, "time", "shape (6, 1); accepted: shape (N)"),
    ({"time": np.float64(3.0)}, "time", "shape ()"),
    ({"base_quat_xyzw": np.ones((N, 3))}, "base_quat_xyzw", "shape (6, 3); accepted: shape (N, 4) = (6, 4)"),
    ({"contact_wrench_local": np.zeros((N, 2, 3))}, "contact_wrench_local", "(6, 2, 3)"),
    ({"contact_active": np.ones((N, 3), bool)}, "contact_active", "(6, 3)"),
    ({"joint_velocity": np.zeros((N, 2), complex)}, "joint_velocity", "complex128"),
    ({"joint_velocity": np.full((N, 2), b"a")}, "joint_velocity", "values of type"),
    ({"joint_torque": np.zeros((N, 2), bool)}, "joint_torque", "bool"),
    ({"joint_names": np.array([1, 2])}, "joint_names", "int64"),
    ({"joint_names": np.array([["hip", "knee"]])}, "joint_names", "shape (1, 2)"),
    ({"joint_names": np.array(["hip", "hip"])}, "joint_names", "'hip' again at 1"),
    ({"joint_names": np.array(["hip", ""])}, "joint_names", "empty name at 1"),
    ({"joint_names": np.array([b"hip", b"\xff"])}, "joint_names", "UTF-8"),
    ({"contact_names": np.array(["a", "a"])}, "contact_names", "'a' again at 1"),
    ({"time": np.array([0.0, 1, 2, 2, 3, 4])}, "time", "2.0 at sample 3, after 2.0 at sample 2"),
    ({"time": np.array([0.0, 1, 3, 2, 3, 4])}, "time", "2.0 at sample 3"),
    (edited("time", 4, np.nan), "time", "nan at sample 4"),
    (edited("time", 5, np.inf), "time", "inf at sample 5"),
    (edited("base_quat_xyzw", 3, 0.0), "base_quat_xyzw", "norm 0 at sample 3"),
    (edited("base_quat_xyzw", 3, 1e300), "base_quat_xyzw", "1e+300 at sample 3"),
    (edited("base_quat_xyzw", 3, 1e30), "base_quat_xyzw", "norm 2e+30 at sample 3"),
    (edited("base_quat_xyzw", 3, np.nan), "base_quat_xyzw", "nan at sample 3"),
    ({"base_quat_xyzw": 1.002 * file_fields()["base_quat_xyzw"]}, "base_quat_xyzw", "norm 1.002 at sample 0"),
    (edited("joint_position", (2, 1), np.nan), "joint_position", "nan at sample 2, knee"),
    (edited("joint_velocity", (2, 1), np.nan), "joint_velocity", "nan at sample 2, knee"),
    (edited("base_position_world", (1, 2), np.nan), "base_position_world", "nan at sample 1, component 2"),
    (edited("base_linear_velocity_world", 1, np.nan), "base_linear_velocity_world", "nan at sample 1"),
    (edited("joint_torque", (1, 0), -np.inf), "joint_torque", "-inf at sample 1, hip"),
    (edited("contact_wrench_local", (4, 1, 2), np.inf), "contact_wrench_local", "inf at sample 4, r_sole fz"),
    ({"base_quat_wxyz": file_fields()["base_quat_xyzw"]}, "base_quat_wxyz", "together with base_quat_xyzw"),
    ({"base_linear_velocity_base": np.zeros((N, 3))}, "base_linear_velocity_base", "given together with"),
    ({"contact_wrench_world": np.zeros((N, 2, 6))}, "contact_wrench", "given together with"),
    ({"contact_names": None}, "contact_active", "without contact_names"),
    ({"contact_names": None, "contact_active": None}, "contact_wrench_local", "without contact_names"),
    ({"contact_active": None}, "contact_wrench_local", "without contact_active"),
    (edited("contact_active", (5, 0), 0.5), "contact_active", "0.5 at sample 5, l_sole"),
    (edited("contact_active", (5, 0), np.nan), "contact_active", "nan at sample 5"),
    ({"contact_active": np.full((N, 2), b"yes")}, "contact_active", "values of type"),
    ({"ft_wrench": np.zeros((N, 6))}, "ft_wrench", "shape (6, 6); accepted: shape (N, F, 6) = (6, 1, 6)"),
    ({"ft_wrench": np.zeros((N, 2, 6))}, "ft_wrench", "shape (6, 2, 6)"),
    (edited("ft_wrench", (2, 0, 4), np.inf), "ft_wrench", "inf at sample 2, l_ankle_ft my"),
    ({"ft_names": None}, "ft_wrench", "without ft_names"),
    ({"ft_names": np.array(["a", "a"])}, "ft_names", "'a' again at 1"),
    ({"imu_specific_force": np.zeros((N, 2))}, "imu_specific_force", "shape (6, 2); accepted: shape (N, 3) = (6, 3)"),
    (edited("imu_angular_velocity", (3, 1), np.nan), "imu_angular_velocity", "nan at sample 3, component 1"),
    ({"imu_frame": None}, "imu_specific_force", "without imu_frame"),
    ({"imu_specific_force": None}, "imu_", "without imu_specific_force"),
    ({"imu_angular_velocity": None}, "imu_", "without imu_angular_velocity"),
    ({"imu_frame": np.array(["a", "b"])}, "imu_frame", "2 values; accepted: one name"),
    ({"imu_frame": np.array("")}, "imu_frame", "empty name"),
    ({"imu_frame": np.array(3)}, "imu_frame", "int64"),
]


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
@pytest.mark.parametrize(("changes", "field", "found"), BAD_FIELDS)
def test_every_unusable_field_is_named_in_one_line(
    tmp_path: Path, suffix: str, changes: dict[str, Any], field: str, found: str
) -> None:
    message = log_refusal(write_arrays(tmp_path / f"bad{suffix}", changed(**changes)))
    assert field in message
    assert found in message


def test_a_misspelt_field_is_an_unknown_name_to_those_who_catch_it(tmp_path: Path) -> None:
    path = write_arrays(tmp_path / "x.npz", changed(base_quat=np.zeros((N, 4))))
    with pytest.raises(UnknownNameError, match="base_quat_") as caught:
        read_log(path)
    assert caught.value.name == "base_quat"


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_a_log_without_samples_is_refused(tmp_path: Path, suffix: str) -> None:
    fields = {"time": np.zeros(0), "joint_names": np.array(["a"]), "joint_position": np.zeros((0, 1))}
    assert "no samples" in log_refusal(write_arrays(tmp_path / f"x{suffix}", fields))


def test_absent_and_foreign_files_are_named(tmp_path: Path) -> None:
    assert "no such file" in log_refusal(tmp_path / "absent.npz")
    (tmp_path / "folder.npz").mkdir()
    assert "a folder" in log_refusal(tmp_path / "folder.npz")
    (tmp_path / "log.xls").write_text("time\n0\n")
    accepted = ".npz, .h5, .hdf5, .csv, .parquet, .mat, .json, .tsv, .txt, .dat, .mot, .sto, .jsonl, .ndjson, .bag"
    assert f"extension '.xls'; accepted: {accepted}" in log_refusal(tmp_path / "log.xls")
    for suffix in SUFFIXES:
        (tmp_path / f"text{suffix}").write_text("not a log")
        assert "cannot be read" in log_refusal(tmp_path / f"text{suffix}")
        (tmp_path / f"empty{suffix}").write_bytes(b"")
        log_refusal(tmp_path / f"empty{suffix}")


def test_without_h5py_the_message_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_arrays(tmp_path / "x.h5", changed())
    log = read_log(path)
    without_package("h5py", monkeypatch, tmp_path)
    line = "HDF5, but h5py is not installed; accepted: a .npz file, or pip install '.[hdf5]' in the clone of torchid"
    assert log_refusal(path) == f"{path}: file: {line}"
    with pytest.raises(LogError, match="h5py is not installed"):
        write_log(log, tmp_path / "y.h5")
    assert not (tmp_path / "y.h5").exists()


def test_hdf5_groups_empty_datasets_and_dangling_links_are_refused(tmp_path: Path) -> None:
    for name, item in (("link", h5py.SoftLink("/nowhere")), ("empty", h5py.Empty("f8")), ("group", None)):
        path = write_arrays(tmp_path / f"{name}.h5", changed(joint_torque=None))
        with h5py.File(path, "a") as file:
            if item is None:
                file.create_group("joint_torque")
            else:
                file["joint_torque"] = item
        assert "joint_torque: cannot be read" in log_refusal(path)


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_truncated_files_are_refused(tmp_path: Path, suffix: str) -> None:
    whole = write_arrays(tmp_path / f"whole{suffix}", file_fields()).read_bytes()
    path = tmp_path / f"cut{suffix}"
    for share in (0.001, 0.1, 0.5, 0.9, 0.99):
        path.write_bytes(whole[: int(share * len(whole))])
        assert "cannot be read" in log_refusal(path)


@pytest.mark.filterwarnings("ignore")  # of numpy's, on headers from before Python 3
@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), min_size=1, max_size=4))
def test_damaged_bytes_give_a_log_or_one_line(damage: list[tuple[int, int]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = write_arrays(Path(folder) / "x.npz", file_fields())
        content = bytearray(path.read_bytes())
        for place, value in damage:
            content[place % len(content)] = value
        path.write_bytes(content)
        complaint = ""
        try:
            assert len(read_log(path)) == N
        except LogError as error:
            complaint = str(error)
        assert "\n" not in complaint


def test_absurd_declared_sizes_are_refused_before_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    huge = b"\x93NUMPY\x01\x00" + (118).to_bytes(2, "little")
    huge += b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000,), }".ljust(117) + b"\n"
    with zipfile.ZipFile(write_arrays(tmp_path / "x.npz", changed(time=None)), "a") as archive:
        archive.writestr("time.npy", huge)
    assert "time: cannot be read" in log_refusal(tmp_path / "x.npz")
    with h5py.File(write_arrays(tmp_path / "x.h5", changed(time=None)), "a") as file:
        file.create_dataset("time", (10**12,), dtype="f8", chunks=(10**8,))
    assert "bytes in all" in log_refusal(tmp_path / "x.h5")
    monkeypatch.setattr(container, "MAX_ARRAYS", 100)
    assert "at most 100 bytes" in log_refusal(write_arrays(tmp_path / "y.npz", file_fields()))


def test_writing_fails_in_one_line_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = read_log(write_arrays(tmp_path / "x.npz", file_fields()))
    with pytest.raises(InputError, match=r"extension '.mat'; accepted"):
        write_log(log, tmp_path / "x.mat")
    with pytest.raises(LogError, match="cannot be written"):
        write_log(log, tmp_path / "nowhere" / "x.npz")
    with pytest.raises(LogError, match="cannot be written"):
        write_log(log, tmp_path / "x.npz" / "y.npz")
    before = (tmp_path / "x.npz").read_bytes()

    def interrupted(stream: Any, **_: Any) -> None:
        stream.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_log(log, tmp_path / "x.npz")
    assert (tmp_path / "x.npz").read_bytes() == before
    assert os.listdir(tmp_path) == ["x.npz"]


def test_logs_made_in_memory_are_checked_for_shape_and_type() -> None:
    log = Log("x", np.arange(4.0), ("a",), np.zeros((4, 1)))
    with pytest.raises(LogError, match=r"x: joint_torque: shape \(4, 2\)"):
        dataclasses.replace(log, joint_torque=np.zeros((4, 2)))
    with pytest.raises(LogError, match="joint_velocity: values of type float32; accepted: float64"):
        dataclasses.replace(log, joint_velocity=np.zeros((4, 1), np.float32))
    wrench = np.zeros((4, 1, 6))
    with pytest.raises(LogError, match="given together with"):
        dataclasses.replace(log, contact_names=("f",), contact_wrench_local=wrench, contact_wrench_world=wrench)


def test_selecting_samples_takes_the_same_ones_of_every_field(tmp_path: Path) -> None:
    log = read_log(write_arrays(tmp_path / "x.npz", file_fields()))
    part = log.select(slice(1, 4))
    assert len(part) == 3
    for name, array in part.arrays().items():
        np.testing.assert_array_equal(array, log.arrays()[name][1:4])
        assert np.shares_memory(array, log.arrays()[name])
    chosen = log.select(np.array([4, 0]))
    np.testing.assert_array_equal(chosen.joint_position, log.joint_position[[4, 0]])
    assert len(log.select(log.time > 0.025)) == 3


def test_pickled_objects_are_refused(tmp_path: Path) -> None:
    objects = np.array([{}, 1], dtype=object)
    np.savez(tmp_path / "x.npz", **changed(joint_names=objects))
    assert "joint_names: Python objects (pickled), references or ragged rows" in log_refusal(tmp_path / "x.npz")
    ragged = h5py.vlen_dtype(np.float64)
    with h5py.File(write_arrays(tmp_path / "x.h5", changed(time=None)), "a") as file:
        file.create_dataset("time", (N,), dtype=ragged)
    assert "time: Python objects (pickled), references or ragged rows" in log_refusal(tmp_path / "x.h5")


def test_a_name_given_twice_in_one_archive_is_refused(tmp_path: Path) -> None:
    path = write_arrays(tmp_path / "x.npz", file_fields())
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("time.npy", archive.read("time.npy"))
    assert "occurs twice" in log_refusal(path)
