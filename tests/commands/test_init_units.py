"""`torchid init`: units in the headers of columns, joints that nobody recorded, and several files as one log."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from dialects import save_csv, with_velocity
from motions import value
from repository import DEMO

from torchid.cli import main
from torchid.commands.init import InitReport, init
from torchid.config import load_config
from torchid.errors import LogError
from torchid.fitting.experiment import set_up
from torchid.logs import Log, read_log
from torchid.logs.name_matching import propose_field
from torchid.logs.units import quantities_with, split_unit, unit_factor

URDF = DEMO / "quadruped.urdf"
TURN = 180.0 / np.pi


def recorded() -> Log:
    return with_velocity(read_log(DEMO / "sway_train.npz").select(slice(0, 300)))


def stem(joint: str) -> str:
    return joint.removesuffix("_joint")


@pytest.mark.parametrize(
    ("column", "name", "unit"),
    [
        ("q1 [deg]", "q1", "deg"),
        ("t[ms]", "t", "ms"),
        ("tau_hip (Nm)", "tau_hip", "Nm"),
        ("Fz_N", "Fz", "N"),
        ("time_us", "time", "us"),
        ("pos_mm", "pos", "mm"),
        ("vel_rad/s", "vel", "rad/s"),
        ("vel_deg_s", "vel", "deg/s"),
        ("a_m_per_s2", "a", "m/s2"),
        ("acc_g", "acc", "g"),
        ("w [rad s^-1]", "w", "rad s^-1"),
        ("quat_w [-]", "quat_w", "-"),
        ("angle [gon]", "angle", "gon"),
        ("motor_state[3]", "motor_state[3]", ""),
        ("acc[x]", "acc[x]", ""),
        ("left_hip_pitch", "left_hip_pitch", ""),
        ("angle_Grad", "angle", "Grad"),
        ("angle_gon", "angle_gon", ""),
    ],
)
def test_a_unit_is_what_brackets_hold_or_a_suffix_that_is_known(column: str, name: str, unit: str) -> None:
    assert split_unit(column) == (name, unit)


@pytest.mark.parametrize("unit", ["U/min", "tr/min", "1/min", "giri/min", "r / min"])
def test_turns_per_minute_are_spelled_in_many_ways(unit: str) -> None:
    assert unit_factor("x", unit, ("angular velocity",)) == unit_factor("x", "rpm", ("angular velocity",))
    assert quantities_with("Nm/min") == ()


def test_a_unit_tells_the_field_where_the_name_says_nothing() -> None:
    assert propose_field("LF_HAA [deg]") == "joint_position"
    assert propose_field("LF_HAA (deg/s)") == "joint_velocity"
    assert propose_field("LF_HAA_Nm") == "joint_torque"
    assert propose_field("oil [degC]") == ""


def with_units(log: Log, joints: tuple[str, ...], what: tuple[str, str, str]) -> dict[str, Any]:
    """Columns with units in their names, of motion smaller than a guess from numbers could see."""
    columns: dict[str, Any] = {}
    for of, values in zip(
        what, (TURN * log.joint_position, 1e3 * log.joint_velocity, 100.0 * log.joint_torque), strict=True
    ):
        columns |= {of.format(stem(name)): values[:, log.joint_names.index(name)] for name in joints}
    return columns


@pytest.mark.parametrize(
    ("time", "what", "axis"),
    [
        ("Zeit [us]", ("{} angle [deg]", "{} rate [mrad/s]", "{} load (Ncm)"), "acc {} [g]"),
        ("t_us", ("q_{}_deg", "dq_{}_mrad/s", "tau_{}_Ncm"), "acc_{}_g"),
        ("stamp (us)", ("{} (deg)", "v.{}(mrad/s)", "{} (N cm)"), "imu.acc_g.{}"),
    ],
)
def test_units_of_headers_give_the_log_that_was_recorded(
    tmp_path: Path, time: str, what: tuple[str, str, str], axis: str
) -> None:
    log = recorded()
    rng = np.random.default_rng(0)
    force, turn = rng.standard_normal((2, len(log), 3))  # far from 9.81 m/s^2: numbers tell no unit
    columns = {time: 1e6 * log.time, **with_units(log, log.joint_names, what)}
    columns |= {axis.format(x): force[:, k] / 9.80665 for k, x in enumerate("xyz")}
    columns |= {f"gyro_{x} [deg/s]": TURN * turn[:, k] for k, x in enumerate("xyz")}
    path = save_csv(tmp_path / "x.csv", columns)
    written = init(URDF, path, tmp_path / "new.yaml")
    again = read_log(path, columns=load_config(tmp_path / "new.yaml").logs.columns)
    order = [again.joint_names.index(name) for name in log.joint_names]
    for field, expected in (
        ("joint_position", log.joint_position),
        ("joint_velocity", log.joint_velocity),
        ("joint_torque", log.joint_torque),
    ):
        np.testing.assert_allclose(again.arrays()[field][:, order], expected, rtol=1e-12, atol=1e-12, err_msg=field)
    np.testing.assert_allclose(again.time, log.time, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(again.imu_specific_force, force, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(again.imu_angular_velocity, turn, rtol=1e-12, atol=1e-12)
    assert not any(note.startswith(("time", "joint_", "imu_specific")) for note in written.guessed), written.guessed


def test_a_unit_that_nobody_knows_is_named(tmp_path: Path) -> None:
    log = recorded()
    path = save_csv(tmp_path / "x.csv", {"t": log.time, **with_units(log, log.joint_names, ("q_{} [gon]",) * 3)})
    said = [note for note in init(URDF, path, tmp_path / "new.yaml").guessed if "gon" in note]
    assert len(said) == 1
    assert "unit 'gon' of its columns is none of angle or length" in said[0]


def without(log: Log, joints: tuple[str, ...], folder: Path) -> InitReport:
    kept = tuple(name for name in log.joint_names if name not in joints)
    what = ("{} [deg]", "{} [mrad/s]", "{} [Ncm]")
    path = save_csv(folder / "x.csv", {"t": log.time, **with_units(log, kept, what)})
    return init(URDF, path, folder / "new.yaml")


def test_joints_that_nobody_recorded_are_welded(tmp_path: Path) -> None:
    log = recorded()
    lost = log.joint_names[2:5]
    written = without(log, lost, tmp_path)
    config = load_config(tmp_path / "new.yaml")
    assert set(config.robot.weld) == set(lost)
    assert any(note.startswith("robot.weld: ") and all(name in note for name in lost) for note in written.guessed)
    assert "joint_position" not in " ".join(written.missing)
    assert set(set_up(config).robot.joint_names) == set(log.joint_names) - set(lost)


def test_a_log_that_lacks_most_joints_has_no_weld(tmp_path: Path) -> None:
    log = recorded()
    assert any(text.startswith("joint_position: no ") for text in without(log, log.joint_names[:6], tmp_path).missing)
    assert "weld" not in yaml.safe_load((tmp_path / "new.yaml").read_text())["robot"]


def test_a_joint_with_a_torque_but_without_a_position_is_named_and_not_welded(tmp_path: Path) -> None:
    log = recorded()
    columns = with_units(log, log.joint_names, ("{} [deg]", "{} [mrad/s]", "{} [Ncm]"))
    del columns[f"{stem(log.joint_names[4])} [deg]"]
    written = init(URDF, save_csv(tmp_path / "x.csv", {"t": log.time, **columns}), tmp_path / "new.yaml")
    named = f"joint_position: no column of numbers of {log.joint_names[4]}, but of all others"
    assert named in written.missing
    assert "weld" not in yaml.safe_load((tmp_path / "new.yaml").read_text())["robot"]


def test_torques_of_some_joints_are_the_sensors_of_the_fit(tmp_path: Path) -> None:
    log = recorded()
    columns = with_units(log, log.joint_names, ("{} [deg]", "{} [mrad/s]", "{} [Ncm]"))
    del columns[f"{stem(log.joint_names[4])} [Ncm]"]
    written = init(URDF, save_csv(tmp_path / "x.csv", {"t": log.time, **columns}), tmp_path / "new.yaml")
    config = load_config(tmp_path / "new.yaml")
    assert not [text for text in written.missing if text.startswith("joint_torque")]
    assert any(text.startswith("sensors.joint_torques: ") for text in written.guessed)
    assert set(config.sensors.joint_torques) == set(log.joint_names) - {log.joint_names[4]}
    again = read_log(tmp_path / "x.csv", columns=config.logs.columns)
    np.testing.assert_array_equal(
        np.isnan(again.joint_torque).any(axis=0), ~np.isin(again.joint_names, config.sensors.joint_torques)
    )


def test_the_first_letter_of_a_component_is_no_unit(tmp_path: Path) -> None:
    log = recorded()
    columns = {"t": log.time, **with_units(log, log.joint_names, ("{} [deg]", "{} [mrad/s]", "{} [Ncm]"))}
    for foot in log.contact_names:
        columns |= {
            f"{foot}_{axis}": np.full(len(log), 50.0 + k) for k, axis in enumerate(("fx", "fy", "fz", "mx", "my", "mz"))
        }
    written = init(URDF, save_csv(tmp_path / "x.csv", columns), tmp_path / "new.yaml")
    entry = value(load_config(tmp_path / "new.yaml").logs.columns).contact_wrench_local
    assert (entry.force.column, entry.moment.column) == ("{contact}_f{axis}", "{contact}_m{axis}")
    assert not [text for text in written.guessed if "unit" in text]


def test_joints_that_a_log_lacks_are_named_with_the_key_that_holds_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = recorded()
    lost = log.joint_names[2:4]
    without(log, lost, tmp_path)
    settings = yaml.safe_load((tmp_path / "new.yaml").read_text())
    del settings["robot"]["weld"]
    settings["preprocessing"] = {}
    (tmp_path / "new.yaml").write_text(yaml.safe_dump(settings))
    capsys.readouterr()
    assert main(["identify", str(tmp_path / "new.yaml"), "sensors=joints"]) == 2
    message = capsys.readouterr().err
    for text in (f"{lost[0]}, {lost[1]} of quadruped.urdf missing", f"robot.weld: [{lost[0]}, {lost[1]}]"):
        assert text in message


def test_two_files_of_a_laboratory_are_one_log(tmp_path: Path) -> None:
    log = recorded()
    angles = with_units(log, log.joint_names, ("{}_deg", "{}_mrad/s", "{}_Ncm"))
    motion = {name: x for name, x in angles.items() if not name.endswith("Ncm")}
    forces = {name: x for name, x in angles.items() if name.endswith("Ncm")}
    for k, contact in enumerate(log.contact_names):
        for i, component in enumerate(("FX_N", "FY_N", "FZ_N", "MX_Nmm", "MY_Nmm", "MZ_Nmm")):
            factor = 1e3 if component.endswith("Nmm") else 1.0
            forces[f"{contact}_{component}"] = factor * np.nan_to_num(log.contact_wrench_local[:, k, i])
    save_csv(tmp_path / "motion.csv", {"Time (s)": log.time, **motion})
    save_csv(tmp_path / "forces.csv", {"t_ms": 1e3 * (log.time + 50.0), **forces})
    name = "forces.csv@-50s"
    init(URDF, tmp_path / f"motion.csv + {name}", tmp_path / "new.yaml")
    config = load_config(tmp_path / "new.yaml")
    again = read_log(tmp_path / f"motion.csv + {name}", columns=config.logs.columns)
    assert len(again) == len(log)
    joints = [again.joint_names.index(x) for x in log.joint_names]
    contacts = [again.contact_names.index(x) for x in log.contact_names]
    np.testing.assert_allclose(again.joint_torque[:, joints], log.joint_torque, rtol=1e-9, atol=1e-9)
    expected = np.nan_to_num(log.contact_wrench_local)
    np.testing.assert_allclose(again.contact_wrench_local[:, contacts], expected, rtol=1e-9, atol=1e-9)
    assert again.contact_active[:, contacts][expected[..., 2] > 50.0].all()
    set_up(config)


@pytest.mark.parametrize("component", ["Fx_N", "FY [N]", "Mz_Nmm", ".MX [Nm]", ".tilt [Nm]"])
def test_no_sideways_force_is_taken_for_a_contact_flag(tmp_path: Path, component: str) -> None:
    log = recorded()
    columns = {f"{name}_{component}": np.sin(log.time) for name in log.contact_names}
    columns |= with_units(log, log.joint_names, ("{} [deg]", "{} [mrad/s]", "{} [Ncm]"))
    init(URDF, save_csv(tmp_path / "x.csv", {"t": log.time, **columns}), tmp_path / "new.yaml")
    proposed = yaml.safe_load((tmp_path / "new.yaml").read_text())
    assert "contact_active" not in proposed["logs"]["columns"]
    assert proposed["preprocessing"]["detect_contacts"]


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("t,q,q\n0,1,2\n1,2,3\n")
    with pytest.raises(LogError, match=r"x\.csv: column 'q': given twice"):
        init(URDF, tmp_path / "x.csv", tmp_path / "new.yaml")
