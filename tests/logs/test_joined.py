"""Several files of one recording as one log: the stamps of the first, the others interpolated as topics of bags are."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import entries_of, recorded, write_bag
from dialects import ORDER, in_order, parsed_map, save_csv
from raw_logs import log_refusal
from repository import DEMO

from torchid.errors import LogError, TorchidWarning
from torchid.logs import Log, read_log, write_log
from torchid.logs.blocks import open_log_blocks
from torchid.logs.time_range import LogFile, join_files, split_range

MOTION = ("joint_position", "base_quat_xyzw", "base_position_world")
CONTACTS = ("contact_active", "contact_wrench_local")


@pytest.fixture(scope="module")
def log() -> Log:
    return read_log(DEMO / "sway_train.npz").select(slice(0, 400))


def only(log: Log, *fields: str) -> Log:
    """The log with some fields alone; a joint's position belongs to every log in memory."""
    absent = dict.fromkeys(set(log.arrays()) - {"time", "joint_position", *fields})
    names = {} if set(CONTACTS) & set(fields) else {"contact_names": ()}
    changed: dict[str, Any] = absent | names
    return replace(log, **changed)


def write_fields(path: Path, log: Log, *fields: str) -> None:
    """A file with some fields of a log and its stamps, written as `write_log` writes them."""
    whole = path.with_name(f"whole_{path.stem}.npz")
    write_log(only(log, *fields), whole)
    with np.load(whole) as arrays:
        kept = {name: x for name, x in arrays.items() if name in ("time", *fields)}
        names = {name: arrays[name] for name in ("joint_names", "contact_names") if name in arrays}
    whole.unlink()
    of = {name for name in names if any(field.startswith(name.partition("_")[0]) for field in fields)}
    np.savez(path, **kept, **{name: names[name] for name in of})


def same(one: Log, other: Log) -> None:
    """Both logs have the same fields to the last bit."""
    assert one.names == other.names
    assert one.arrays().keys() == other.arrays().keys()
    for name, x in one.arrays().items():
        assert np.array_equal(x, other.arrays()[name], equal_nan=True), name


def smooth(time: np.ndarray, hz: float) -> dict[str, np.ndarray]:
    """Signals of a frequency: two joints, a turning base, forces of a foot."""
    phase = 2.0 * np.pi * hz * time
    yaw = 0.8 * np.sin(phase + 0.4)
    return {
        "joint_position": np.stack([np.sin(phase), np.cos(phase + 1.0)], axis=1),
        "joint_torque": np.stack([np.cos(phase), np.sin(phase + 2.0)], axis=1),
        "base_quat_wxyz": np.stack([np.cos(yaw / 2), 0 * yaw, 0.6 * np.sin(yaw / 2), 0.8 * np.sin(yaw / 2)], axis=1),
        "contact_wrench_local": np.sin(phase[:, None, None] + np.arange(6.0)),
    }


def test_files_with_equal_stamps_are_the_whole_log_to_the_last_bit(log: Log, tmp_path: Path) -> None:
    write_fields(tmp_path / "motion.npz", log, *MOTION)
    write_fields(tmp_path / "torques.npz", log, "joint_torque")
    write_fields(tmp_path / "plates.npz", log, *CONTACTS)
    same(read_log(tmp_path / "motion.npz + torques.npz + plates.npz"), log)
    part = read_log(tmp_path / "motion.npz + plates.npz + torques.npz[1:2.5]")
    same(part, log.select(slice(100, 250)))
    assert Path(part.source).name == "motion.npz + plates.npz + torques.npz[1:2.5]"


def test_names_in_another_order_are_sorted_as_in_the_first_file(log: Log, tmp_path: Path) -> None:
    write_fields(tmp_path / "motion.npz", log, *MOTION, *CONTACTS)
    torques = in_order(log, log.joint_torque)
    np.savez(tmp_path / "torques.npz", time=log.time, joint_names=ORDER, joint_torque=torques)
    same(read_log(tmp_path / "motion.npz + torques.npz"), log)
    np.savez(tmp_path / "torques.npz", time=log.time, joint_names=ORDER[1:], joint_torque=torques[:, 1:])
    with pytest.raises(
        LogError,
        match=r"torques.npz: joint_names: 'front_right_hip' missing; accepted: all joints",
    ):
        read_log(tmp_path / "motion.npz + torques.npz")


@pytest.mark.parametrize("rate", [100.0, 1_000.0, 240.0])
def test_other_rates_are_interpolated_with_the_error_of_the_spline(tmp_path: Path, rate: float) -> None:
    time, other = np.arange(300) / 240.0, 0.3 + np.arange(round(0.7 * rate)) / rate + 0.0013
    hz, first, second = 2.0, smooth(time, 2.0), smooth(other, 2.0)
    own = {"joint_names": ["a", "b"], "joint_position": first["joint_position"]}
    np.savez(tmp_path / "motion.npz", time=time + 1.7e9, **own, base_quat_wxyz=first["base_quat_wxyz"])
    signals = {"contact_names": ["foot"], "contact_wrench_local": second["contact_wrench_local"]}
    touches = (other < 0.6)[:, None]
    np.savez(tmp_path / "plates.npz", time=other + 1.7e9, contact_active=touches, **signals)
    joined = read_log(tmp_path / "motion.npz + plates.npz")
    inside = (time >= other[0]) & (time <= other[-1])
    assert np.array_equal(joined.time, time[inside] + 1.7e9)  # stamps of the first file that both cover
    assert np.array_equal(joined.joint_position, own["joint_position"][inside])
    at, middle = time[inside], slice(20, -20)  # the spline ends less exactly
    assert joined.contact_wrench_local is not None
    assert joined.contact_active is not None
    error = np.abs(joined.contact_wrench_local - smooth(at, hz)["contact_wrench_local"])[middle].max()
    rounding = 2.0 * np.pi * hz * 1.7e9 * 2.0**-52  # of the stamps
    assert error < 4.0 * (hz / rate) ** 6 + 4.0 * rounding
    held = np.array([touches[other <= t][-1, 0] for t in at - 1e-9])
    assert (joined.contact_active[:, 0] != held).sum() <= 1  # each holds until the next


def test_a_shift_is_added_to_the_stamps_of_its_file(log: Log, tmp_path: Path) -> None:
    write_fields(tmp_path / "motion.npz", log, *MOTION)
    write_fields(tmp_path / "rest.npz", replace(log, time=log.time + 12.5), "joint_torque", *CONTACTS)
    same(read_log(tmp_path / "motion.npz + rest.npz@-12.5s"), log)
    message = log_refusal(tmp_path / "motion.npz + rest.npz")
    assert "time: no time that all files share with motion.npz: rest.npz starts at 12.5" in message
    assert "motion.npz ends at 3.99" in message
    assert "shift_s" in message
    same(read_log(tmp_path / "motion.npz@12.5 + rest.npz"), replace(log, time=log.time + 12.5))


def test_a_name_says_where_the_files_are_and_by_how_much_they_are_shifted(tmp_path: Path) -> None:
    for other in (tmp_path / "a/plates.csv", tmp_path / "a/b/plates.csv", tmp_path / "plates.csv"):
        files = (LogFile(tmp_path / "a/motion.csv", 1e-7), LogFile(other, -0.25))
        part = split_range(join_files(files) + "[0:30]")
        assert part.files == files
        assert part.name == "motion + plates[0:30]"
        assert Path(os.path.normpath(part.file)) == part.file
    assert join_files([LogFile(Path("a/b.csv")), LogFile(Path("a/c.csv"), 0.5)]) == "a/b.csv + c.csv@0.5s"


def test_a_file_whose_name_looks_like_several_is_meant_as_it_is(log: Log, tmp_path: Path) -> None:
    folder = tmp_path / "left + right"
    folder.mkdir()
    write_log(log, folder / "a + b.npz")
    same(read_log(folder / "a + b.npz"), log)
    os.rename(folder / "a + b.npz", folder / "a.npz + b.npz")
    same(read_log(folder / "a.npz + b.npz"), log)


def test_a_map_serves_all_files_and_each_takes_the_entries_that_it_has_columns_of(log: Log, tmp_path: Path) -> None:
    text = """
    time: {column: stamp, unit: ms}
    joint_position: {column: "{joint}_q", unit: deg}
    joint_torque: "{joint}_q_tau"
    base_quat_xyzw: "base_{axis}"
    base_position_world: {column: "p{index}", unit: mm}
    contact_active: {above: 20}
    contact_wrench_local: {force: "{contact}_f{axis}"}
    ignore: ["*_temperature"]
    """
    joints = dict(enumerate(log.joint_names))
    assert log.joint_torque is not None
    assert log.base_quat_xyzw is not None
    assert log.base_position_world is not None
    assert log.contact_wrench_local is not None
    motion = {"stamp": log.time * 1e3}
    motion |= {f"{name}_q": np.degrees(log.joint_position[:, k]) for k, name in joints.items()}
    motion |= {f"base_{axis}": log.base_quat_xyzw[:, k] for k, axis in enumerate("xyzw")}
    motion |= {f"p{k}": 1e3 * log.base_position_world[:, k] for k in range(3)}
    torques = {"time": log.time} | {f"{name}_q_tau": log.joint_torque[:, k] for k, name in joints.items()}
    torques |= {f"{name}_temperature": 40 + log.time for name in log.joint_names}
    force = np.where(np.isnan(log.contact_wrench_local[..., :3]), [0.0, 0.0, 50.0], log.contact_wrench_local[..., :3])
    plates = {"stamp": log.time * 1e3} | {
        f"{name}_f{axis}": force[:, k, j] for k, name in enumerate(log.contact_names) for j, axis in enumerate("xyz")
    }
    save_csv(tmp_path / "motion.csv", motion, ";", ",")
    save_csv(tmp_path / "torques.csv", torques)
    save_csv(tmp_path / "plates.csv", plates, "\t")
    columns, name = parsed_map(text), tmp_path / "motion.csv + torques.csv + plates.csv"
    found = read_log(name, columns=columns)
    assert np.abs(found.joint_position - log.joint_position).max() < 1e-14
    assert np.array_equal(found.joint_torque, log.joint_torque)
    assert found.contact_wrench_local is not None
    assert np.array_equal(found.contact_wrench_local[..., :3], force)
    assert np.array_equal(found.contact_active, np.linalg.norm(force, axis=2) > 20.0)

    save_csv(tmp_path / "torques.csv", torques | {"knee_current": log.time})
    with pytest.raises(LogError, match=r"torques.csv: logs.columns: no entry for knee_current"):
        read_log(name, columns=columns)
    with pytest.raises(LogError, match=r"logs.columns.joint_torque: motion.csv, plates.csv have no such column"):
        read_log(tmp_path / "motion.csv + plates.csv", columns=columns)


def test_a_field_in_two_files_is_refused_by_name(log: Log, tmp_path: Path) -> None:
    write_fields(tmp_path / "a.npz", log, *MOTION, "joint_torque")
    write_fields(tmp_path / "b.npz", log, "joint_torque")
    message = log_refusal(tmp_path / "a.npz + b.npz")
    assert "joint_torque: in a.npz and in b.npz; accepted: each field in one file only, or with" in message
    assert "base_quat_wxyz" not in message
    assert log.base_quat_xyzw is not None
    np.savez(tmp_path / "b.npz", time=log.time, base_quat_wxyz=np.roll(log.base_quat_xyzw, 1, axis=1))
    assert "base_quat_wxyz: given together with base_quat_xyzw" in log_refusal(tmp_path / "a.npz + b.npz")


def test_files_that_make_up_no_log_are_refused_in_one_line(log: Log, tmp_path: Path) -> None:
    write_fields(tmp_path / "motion.npz", log, *MOTION)
    write_fields(tmp_path / "torques.npz", log, "joint_torque")
    np.savez(tmp_path / "timeless.npz", joint_names=log.joint_names, joint_torque=log.joint_torque)
    np.savez(tmp_path / "short.npz", time=log.time[:5], joint_names=log.joint_names, joint_torque=log.joint_torque)
    np.savez(tmp_path / "foreign.npz", time=log.time, tau_7=log.time)
    write_bag(tmp_path / "walk.mcap", entries_of(recorded()))
    late = {"time": log.time + 0.003, "joint_names": log.joint_names}
    broken = np.where(np.arange(400)[:, None] == 7, np.nan, log.joint_position)
    np.savez(tmp_path / "broken.npz", **late, joint_velocity=broken)
    np.savez(tmp_path / "flat.npz", **late, joint_torque=log.time)
    np.savez(tmp_path / "infinite.npz", **late, joint_torque=np.where(np.isnan(broken), np.inf, broken))
    refusals = {
        "motion.npz + flat.npz": "flat.npz: joint_torque: shape (400,); accepted: shape (N, n) = (400, n)",
        "motion.npz + broken.npz": "broken.npz: joint_velocity: nan at sample 7, component 0; accepted: finite numbers",
        "motion.npz + infinite.npz": "infinite.npz: joint_torque: inf at sample 7",
        "motion.npz + absent.npz": "absent.npz: file: no such file",
        "motion.npz + timeless.npz": "timeless.npz: time: missing; accepted: stamps in each",
        "motion.npz + short.npz": "short.npz: joint_torque: shape",
        "motion.npz + foreign.npz": "foreign.npz: ",
        "torques.npz + motion.npz[9:]": "time range: [9:], but the log lasts 4 s",
        "motion.npz + walk.mcap": "walk.mcap: file: a bag in a log of several files",
        "motion.npz + torques.wav": "torques.wav: file: extension '.wav'",
    }
    for name, found in refusals.items():
        with pytest.raises(LogError) as raised:
            read_log(tmp_path / name)
        assert found in str(raised.value), name
        assert "\n" not in str(raised.value)
    write_fields(tmp_path / "base.npz", log, "base_quat_xyzw")
    assert "joint_position: missing" in log_refusal(tmp_path / "base.npz + torques.npz")


def test_gaps_of_a_file_that_is_interpolated_are_named_and_bridged(log: Log, tmp_path: Path) -> None:
    assert log.joint_torque is not None
    other = np.arange(4_000) / 1_000.0
    torque = np.sin(other[:, None] + np.arange(12.0))
    torque[1_200:1_203, 4] = np.nan
    write_fields(tmp_path / "motion.npz", log, *MOTION)
    np.savez(tmp_path / "torques.npz", time=other, joint_names=log.joint_names, joint_torque=torque)
    name = tmp_path / "motion.npz + torques.npz"
    with pytest.warns(
        TorchidWarning, match="joint_torque: NaN in some samples; after interpolation all samples are NaN"
    ):
        lost = read_log(name)
    assert np.isnan(lost.joint_torque).all(axis=0).tolist() == [k == 4 for k in range(12)]
    with pytest.warns(TorchidWarning, match="torques.npz: joint_torque: gaps of up to 0.01 s were bridged in 3 of"):
        found = read_log(name, bridge_gaps_s=0.01)
    assert np.abs(found.joint_torque - np.sin(found.time[:, None] + np.arange(12.0))).max() < 1e-9
    np.savez(tmp_path / "torques.npz", time=np.where(other < 2.0, other, other + 0.05), joint_torque=np.sin(torque))
    with pytest.raises(LogError, match=r"torques.npz: time: a gap of 0.051 s after 1.999 s.*cut the file there"):
        read_log(name)


def test_entries_of_a_map_that_have_no_columns_go_with_the_fields_that_they_belong_to(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    time, q, dq, desired = np.arange(50) / 100.0, *rng.standard_normal((3, 50, 2))
    gravity = rng.standard_normal((50, 3))
    names = np.array([b"a", b"b"])
    np.savez(tmp_path / "joints.npz", time=time, joint_names=names, q=q, dq=dq, wanted=desired)
    np.savez(tmp_path / "imu.npz", t=1e3 * time, acc=gravity, imu_angular_velocity=-gravity)
    text = """
    time: ticks
    other_times: [{column: t, unit: ms}]
    joint_position: q
    joint_velocity: dq
    joint_torque: {pd: {kp: 20, kd: 2, position: wanted}}
    contact_active: {always: [foot]}
    imu_frame: trunk
    imu_specific_force: {column: acc, unit: g}
    """
    for order in ("joints.npz + imu.npz", "imu.npz + joints.npz"):
        found = read_log(tmp_path / order, columns=parsed_map(text))
        assert (found.imu_frame, found.joint_names, found.contact_names) == ("trunk", ("a", "b"), ("foot",))
        assert found.contact_active is not None
        assert found.joint_torque is not None
        assert found.imu_specific_force is not None
        assert found.contact_active.all()
        assert np.abs(found.joint_torque - 20.0 * (desired - q) + 2.0 * dq).max() < 1e-13
        assert np.abs(found.imu_specific_force - 9.80665 * gravity).max() < 1e-13


@pytest.mark.parametrize("suffix", ["npz", "csv"])
def test_files_without_stamps_have_those_of_one_step_each_from_its_first_sample(tmp_path: Path, suffix: str) -> None:
    angle, force = np.arange(50.0), 100.0 + np.arange(47.0)
    np.savez(tmp_path / "joints.npz", q=np.stack([angle, -angle], axis=1))
    if suffix == "npz":
        np.savez(tmp_path / "feet.npz", fz=force[:, None])
    else:
        save_csv(tmp_path / "feet.csv", {"fz": force})
    text = """
    time: {step: 5, unit: ms}
    joint_order: [hip, knee]
    joint_position: q
    contact_order: [foot]
    contact_force_normal: fz
    contact_active: {above: 120}
    """
    text = text if suffix == "npz" else text.replace("normal: fz", "normal: {columns: {foot: fz}}")
    for shift, first in (("", 0), ("@0.01s", 2)):
        found = read_log(tmp_path / f"joints.npz + feet.{suffix}{shift}", columns=parsed_map(text))
        np.testing.assert_allclose(found.time, 0.005 * np.arange(first, min(50, 47 + first)), atol=1e-12)
        assert found.contact_force_normal is not None
        np.testing.assert_array_equal(found.contact_force_normal[:, 0], force[: len(found)])
        np.testing.assert_array_equal(found.joint_position[:, 0], angle[first : first + len(found)])
    np.savez(tmp_path / "clock.npz", time=0.005 * np.arange(50), q=np.stack([angle, -angle], axis=1))
    mixed = read_log(tmp_path / f"clock.npz + feet.{suffix}", columns=parsed_map(text))
    np.testing.assert_array_equal(mixed.time, 0.005 * np.arange(47))


def test_arrays_of_one_file_that_have_stamps_of_their_own_are_those_of_two_files(tmp_path: Path) -> None:
    """Of two stamps that are as many, each belongs to what its name begins like."""
    columns = parsed_map("""
    time: joints/stamp
    other_times: [{column: imu/stamp_us, unit: us}]
    joint_order: [a, b]
    joint_position: joints/q
    imu_frame: trunk
    imu_specific_force: imu/acc
    imu_angular_velocity: imu/gyro
    ignore: [camera/t]
    """)
    fast = 2.0 + np.arange(400) / 1000.0
    for slow in (2.01 + np.arange(150) / 400.0, 2.0004 + np.arange(400) / 1000.0):
        q, acc, gyro = (np.sin(7.0 * x[:, None] + np.arange(k)) for x, k in ((fast, 2), (slow, 3), (slow, 3)))
        joints = {"stamp": fast, "q": q}
        imu = {"stamp_us": 1e6 * slow, "acc": acc, "gyro": gyro}
        parts = {"joints": joints, "imu": imu, "camera": {"t": np.arange(3.0)}}
        np.savez(tmp_path / "one.npz", **{f"{of}/{name}": x for of, xs in parts.items() for name, x in xs.items()})
        for of in ("joints", "imu"):
            np.savez(tmp_path / f"{of}.npz", **{f"{of}/{name}": x for name, x in parts[of].items()})
        found = read_log(tmp_path / "one.npz", columns=columns)
        expected = read_log(tmp_path / "joints.npz + imu.npz", columns=columns)
        assert found.time[0] >= slow[0]
        assert found.time[-1] <= slow[-1]
        for name, x in expected.arrays().items():
            np.testing.assert_array_equal(getattr(found, name), x, err_msg=name)
        assert np.abs(found.imu_specific_force - np.sin(7.0 * found.time[:, None] + np.arange(3))).max() < 1e-9
    with (
        pytest.raises(LogError, match="a file with stamps 'imu/stamp_us' must fit into memory"),
        open_log_blocks(tmp_path / "one.npz", tmp_path, columns),
    ):
        pass


def test_quaternions_of_another_file_are_interpolated_without_sign_flips_and_normalised(tmp_path: Path) -> None:
    time, other = np.arange(300) / 240.0, np.arange(150) / 100.0
    quat = smooth(other, 2.0)["base_quat_wxyz"] * np.where(np.arange(150) % 7 < 3, 1.0, -1.0)[:, None]
    joints = smooth(time, 2.0)["joint_position"]
    np.savez(tmp_path / "joints.npz", time=time, joint_names=["a", "b"], joint_position=joints)
    np.savez(tmp_path / "base.npz", time=other, base_quat_wxyz=quat)
    found = read_log(tmp_path / "joints.npz + base.npz").base_quat_xyzw
    assert found is not None
    wanted = np.roll(smooth(time, 2.0)["base_quat_wxyz"], -1, axis=1)
    assert np.abs(np.abs((found * wanted).sum(axis=1)) - 1.0)[20:-20].max() < 1e-8
    assert np.abs(np.linalg.norm(found, axis=1) - 1.0).max() < 1e-15
