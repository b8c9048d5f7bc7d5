"""Maps of foreign columns: what a pattern, a unit, an order mean, and one line for each that does not fit."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from dialects import save_csv
from mapped import ORDER, POSITION, TIME, mapped
from repository import ROOT, SHARED
from scipy.spatial.transform import Rotation

from torchid.errors import ConfigError, LogError
from torchid.logs import Columns, Log, read_log
from torchid.logs.blocks import open_log_blocks
from torchid.logs.columns import check_columns
from torchid.logs.log import NAME_FIELDS, SHAPES, VARIANTS
from torchid.logs.units import UNITS, quantities_of, unit_factor


def mapped_arrays(folder: Path, text: str, **arrays: Any) -> Log:
    """Arrays of three samples read by a map, the same in blocks."""
    path, columns = folder / "x.npz", Columns(**yaml.safe_load(text))
    np.savez(path, **({"time": np.array(TIME), "q": np.arange(6.0).reshape(3, 2)} | arrays))
    log = read_log(path, columns=columns)
    with open_log_blocks(path, path.parent, columns) as blocks:
        for field, values in blocks.read(slice(1, 3)).arrays().items():
            np.testing.assert_array_equal(values, log.arrays()[field][1:])
    return log


# ---------------------------------------------------------------------------------------------------- names and orders


def test_an_order_names_the_columns_by_number_and_null_leaves_one_out(tmp_path: Path) -> None:
    log = mapped(
        tmp_path, 'joint_position: {column: "q_{index}", order: [knee, ~, hip], first_index: 0}', q_2=[7, 8, 9]
    )
    assert log.joint_names == ("knee", "hip")
    np.testing.assert_array_equal(log.joint_position, [[1, 7], [2, 8], [3, 9]])
    arrays = {"q": np.arange(9.0).reshape(3, 3)}
    log = mapped_arrays(tmp_path, "joint_position: {column: q, order: [knee, ~, hip]}", **arrays)
    assert log.joint_names == ("knee", "hip")
    np.testing.assert_array_equal(log.joint_position, arrays["q"][:, [0, 2]])


def test_a_joint_without_a_column_of_torques_was_not_measured_and_one_without_a_position_is_refused(
    tmp_path: Path,
) -> None:
    text = 'joint_torque: "tau_{joint}"\njoint_position: "q_{joint}"'
    columns = {"q_0": None, "q_1": None, "q_hip": [1, 2, 3], "q_knee": [4, 5, 6]}
    log = mapped(tmp_path, text, **columns, tau_knee=[7, 8, 9])
    assert log.joint_names == ("hip", "knee")
    np.testing.assert_array_equal(log.joint_torque, [[np.nan, 7], [np.nan, 8], [np.nan, 9]])
    with pytest.raises(LogError, match="joint_torque: joint 'toe' missing in other fields"):
        mapped(tmp_path, text, **columns, tau_toe=[7, 8, 9])
    with pytest.raises(LogError, match="joint_velocity: joint 'hip' missing here"):
        mapped(tmp_path, text + '\njoint_velocity: "dq_{joint}"', **columns, tau_knee=TIME, dq_knee=[7, 8, 9])


def test_every_field_may_have_an_order_of_its_own(tmp_path: Path) -> None:
    text = POSITION + 'joint_torque: {column: "tau{index}", order: [knee, hip], first_index: 1}'
    log = mapped(tmp_path, text, tau1=[1.5, 2.5, 3.5], tau2=[0.5, 0.25, 0.0])
    assert log.joint_names == ("hip", "knee")
    np.testing.assert_array_equal(log.joint_torque, [[0.5, 1.5], [0.25, 2.5], [0.0, 3.5]])


def test_names_in_columns_may_be_parts_of_the_urdfs(tmp_path: Path) -> None:
    text = 'joint_name: "{joint}_joint"\njoint_position: "pos-{joint}"\ntime: time'
    columns = {"q_0": None, "q_1": None, "pos-hip": [1, 2, 3], "pos-knee": [4, 5, 6]}
    assert mapped(tmp_path, text, **columns).joint_names == ("hip_joint", "knee_joint")
    ordered = mapped(tmp_path, text + "\njoint_order: [knee_joint, hip_joint]", **columns)
    assert ordered.joint_names == ("knee_joint", "hip_joint")
    np.testing.assert_array_equal(ordered.joint_position[0], [4, 1])
    with pytest.raises(ConfigError, match=r"joint_name: 'knee' does not fit the pattern '\{joint\}_joint'"):
        mapped(tmp_path, text + "\njoint_order: [knee, hip]", **columns)


def test_columns_may_be_named_one_by_one(tmp_path: Path) -> None:
    text = 'joint_position: {columns: {knee: q_1, hip: q_0}}\nimu_frame: imu\nimu_specific_force: "a{AXIS}"\n'
    text += "imu_angular_velocity: {columns: {y: roll, x: pitch, z: yaw}}"
    axes = {"aX": [1, 1, 1], "aY": [2, 2, 2], "aZ": [3, 3, 3], "pitch": [4, 4, 4], "roll": [5, 5, 5], "yaw": [6, 6, 6]}
    log = mapped(tmp_path, text, **axes)
    assert (log.joint_names, log.imu_frame) == (("knee", "hip"), "imu")
    np.testing.assert_array_equal(log.joint_position[0], [4, 1])
    assert log.imu_specific_force is not None
    assert log.imu_angular_velocity is not None
    np.testing.assert_array_equal(log.imu_specific_force[0], [1, 2, 3])
    np.testing.assert_array_equal(log.imu_angular_velocity[0], [4, 5, 6])


def test_the_pattern_with_most_letters_has_a_column(tmp_path: Path) -> None:
    columns = {"q_hip": [1, 2, 3], "q_des_hip": [4, 5, 6], "q_raw_hip": [0, 0, 0], "q_0": None, "q_1": None}
    text = 'joint_position: "q_{joint}"\njoint_torque: "q_des_{joint}"\nignore: ["q_raw_*"]'
    log = mapped(tmp_path, text, **columns)
    assert log.joint_names == ("hip",)
    np.testing.assert_array_equal(log.joint_torque, [[4], [5], [6]])
    with pytest.raises(LogError, match=r"column 'q_a_w': fits the patterns of .*joint_position and .*joint_torque"):
        mapped(tmp_path, 'joint_position: "q_{joint}"\njoint_torque: "{joint}_w"', q_0=None, q_1=None, q_a_w=TIME)


def test_ignoring_everything_leaves_what_the_map_and_the_format_name(tmp_path: Path) -> None:
    columns = {"note": ["a", "b", "c"], "joint_torque__hip": [1, 2, 3], "joint_torque__knee": [3, 2, 1], "w[0]": TIME}
    log = mapped(tmp_path, POSITION + 'ignore: ["*"]', **columns)
    np.testing.assert_array_equal(log.joint_torque, [[1, 3], [2, 2], [3, 1]])
    log = mapped(tmp_path, POSITION + 'ignore: ["joint_torque.*", note, "w[*"]', **columns)
    assert log.joint_torque is None


def test_names_of_the_format_need_no_entry_and_share_the_order_of_those_that_have_one(tmp_path: Path) -> None:
    torque = {"joint_torque__knee": [1, 2, 3], "joint_torque__hip": [4, 5, 6], "contact_active__foot": ["true"] * 3}
    log = mapped(tmp_path, POSITION, **torque)
    assert (log.joint_names, log.contact_names) == (("hip", "knee"), ("foot",))
    np.testing.assert_array_equal(log.joint_torque, [[4, 1], [5, 2], [6, 3]])
    log = mapped_arrays(tmp_path, "joint_position: q", joint_names=np.array(["b", "a"]), joint_torque=np.ones((3, 2)))
    assert log.joint_names == ("b", "a"), "the file's own names are the order"
    text = "joint_position: {column: q, order: [a, b]}"
    log = mapped_arrays(tmp_path, text, joint_names=np.array(["b", "a"]), joint_torque=np.ones((3, 2)))
    np.testing.assert_array_equal(log.joint_position[0], [1.0, 0.0])


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_a_log_in_the_format_is_read_as_it_is_with_a_map_of_others(tmp_path: Path, suffix: str) -> None:
    columns = Columns(**yaml.safe_load("time: t\njoint_position: {column: motors, order: [a, b]}"))
    path = tmp_path / f"x{suffix}"
    if suffix == ".csv":
        save_csv(path, {"time": TIME, "joint_position.a": TIME})
    else:
        np.savez(path, time=TIME, joint_names=["a"], joint_position=np.array(TIME)[:, None])
    np.testing.assert_array_equal(read_log(path, columns=columns).joint_position[:, 0], TIME)


def test_a_map_of_columns_is_built_without_numpy_or_torch() -> None:
    script = """
import sys, torchid
assert torchid.Columns is not None
assert not {"torch", "pyarrow", "h5py"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)


def test_every_field_of_the_format_has_a_key_in_a_map() -> None:
    keys = {field.name for field in fields(Columns)}
    assert {*SHAPES, *VARIANTS} - set(NAME_FIELDS) <= keys
    plain = ("base_quat_", "contact_active", "contact_normal", "imu_frame")  # numbers without a unit, and a name
    for name in keys & {*SHAPES, *VARIANTS}:
        assert bool(quantities_of(name, "fx" if "wrench" in name else "")) != name.startswith(plain), name


def test_the_maps_of_the_documentation_are_maps_of_at_most_15_lines() -> None:
    text = (ROOT / "docs" / "logs.md").read_text()
    blocks = [block for block in re.findall(r"```yaml\n(.*?)```", text, re.DOTALL) if "columns:" in block]
    assert len(blocks) == 7
    for block in blocks:
        assert len(block.splitlines()) <= 15
        check_columns(Columns(**yaml.safe_load(block)["logs"]["columns"]))


def test_angles_of_the_base_give_its_quaternion_and_none_where_one_is_missing(tmp_path: Path) -> None:
    angles = {"r": [10.0, -20.0, 30.0], "p": [40.0, 50.0, -60.0], "y": [170.0, 190.0, -200.0]}
    text = ": {rpy: {columns: {roll: r, pitch: p, yaw: y}, unit: deg, scale: {pitch: -1}}}"
    x, y, z = (
        Rotation.from_rotvec(np.outer(sign * np.radians(of), axis))
        for of, axis, sign in zip(angles.values(), np.eye(3), (1.0, -1.0, 1.0), strict=True)
    )
    for order in ("xyzw", "wxyz"):
        log = mapped(tmp_path, f"{POSITION}base_quat_{order}{text}", **angles)
        assert log.base_quat_xyzw is not None
        off = (z * y * x).inv() * Rotation.from_quat(log.base_quat_xyzw)
        np.testing.assert_allclose(off.magnitude(), 0.0, atol=1e-14)
    arrays = {"q": np.zeros((3, 2)), "e": np.array([[0.1, 0.2, 0.3], [0.1, np.nan, 0.3], [0.1, 0.2, 0.4]])}
    path = tmp_path / "gap.npz"
    np.savez(path, time=np.array(TIME), **arrays)
    columns = Columns(**yaml.safe_load(ORDER + "joint_position: q\nbase_quat_wxyz: {rpy: e}"))
    gap = read_log(path, columns=columns, allow_gaps=True).base_quat_xyzw
    assert gap is not None
    np.testing.assert_array_equal(np.isnan(gap).all(axis=1), [False, True, False])


# ---------------------------------------------------------------------------------------------------- units and signs


def test_units_are_those_of_the_si_brochure_and_the_workshop() -> None:
    expected = {
        ("time", "ms"): 1e-3, ("time", "µs"): 1e-6, ("time", "ns"): 1e-9,
        ("angle", "deg"): np.pi / 180, ("angle", "°"): np.pi / 180, ("angle", "degrees"): np.pi / 180,
        ("angular velocity", "rpm"): 2 * np.pi / 60, ("angular velocity", "deg/s"): np.pi / 180,
        ("torque", "N mm"): 1e-3, ("torque", "N·mm"): 1e-3, ("torque", "Nm"): 1.0, ("torque", "N*m"): 1.0,
        ("torque", "kg·m"): 9.80665, ("torque", "kgf cm"): 0.0980665, ("force", "kg"): 9.80665,
        ("acceleration", "g"): 9.80665, ("acceleration", "m/s²"): 1.0, ("acceleration", "m/s^2"): 1.0,
        ("length", "mm"): 1e-3, ("force", "lbf"): 4.4482216152605,
    }  # fmt: skip
    for (quantity, unit), factor in expected.items():
        assert unit_factor("key", unit, (quantity,)) == pytest.approx(factor, rel=1e-15), unit
    assert all(1.0 in units.values() for units in UNITS.values()), "an SI unit of each"


def test_units_and_signs_may_differ_from_joint_to_joint_and_axis_to_axis(tmp_path: Path) -> None:
    text = ORDER + 'joint_position: {column: "q_{index}", unit: {"*": deg, hip: mm}, scale: {"k*": -2}}\n'
    text += 'ft_wrench: {column: "{sensor}_{axis}", unit: {"*.m?": N mm, "*.f?": kN}, scale: {"ankle.fz": -1}}'
    wrench = {f"ankle_{axis}": [1.0, 2.0, 3.0] for axis in ("fx", "fy", "fz", "mx", "my", "mz")}
    log = mapped(tmp_path, text, **wrench)
    np.testing.assert_allclose(log.joint_position[0], [1e-3, -8.0 * np.pi / 180], rtol=1e-15)
    assert log.ft_wrench is not None
    np.testing.assert_allclose(log.ft_wrench[0, 0], [1e3, 1e3, -1e3, 1e-3, 1e-3, 1e-3], rtol=1e-15)


def test_without_a_unit_numbers_stay_to_the_bit(tmp_path: Path) -> None:
    values = np.random.default_rng(0).standard_normal((3, 2))
    np.testing.assert_array_equal(mapped(tmp_path, POSITION, q_0=values[:, 0], q_1=values[:, 1]).joint_position, values)


# ------------------------------------------------------------------------------------- what is computed from columns


def test_a_pd_law_gives_the_torque(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    q, dq, wanted, speed, extra = rng.standard_normal((5, 3, 2))
    arrays = {"q": q, "dq": dq, "wanted": wanted, "speed": speed, "extra": extra}
    text = (
        "joint_order: [l_hip, l_knee]\njoint_position: q\njoint_velocity: dq\nignore: ['*']\njoint_torque: {pd: {%s}}"
    )
    gain = np.array([30.0, 50.0])
    for law, expected in (
        ("kp: 20, position: wanted", 20.0 * (wanted - q)),
        ("kp: 20, kd: 2, position: wanted", 20.0 * (wanted - q) - 2.0 * dq),
        ("kd: 2, velocity: speed, feed_forward: extra", 2.0 * (speed - dq) + extra),
        ('kp: {"*": 30, "*_knee": 50}, kd: 1, position: {column: wanted, unit: deg}, velocity: speed',
         gain * (np.radians(wanted) - q) + speed - dq),
        ("kp: {column: gains, order: [l_knee, l_hip]}, position: wanted", gain[::-1] * (wanted - q)),
        ("kp: changing, position: wanted", np.outer(TIME, gain) * (wanted - q)),
    ):  # fmt: skip
        log = mapped_arrays(tmp_path, text % law, gains=gain, changing=np.outer(TIME, gain), **arrays)
        np.testing.assert_allclose(log.joint_torque, expected, rtol=1e-14, atol=1e-14, err_msg=law)


def test_currents_times_constants_and_gears_are_torques(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    q, current = rng.standard_normal((2, 3, 2))
    text = "joint_order: [l_hip, l_knee]\njoint_position: q\njoint_torque: {current: {%s}}"
    for entry, factor in (
        ("column: i, torque_constant: 0.1, gear_ratio: 9", [0.9, 0.9]),
        ('column: i, unit: mA, torque_constant: {"*": 0.1, l_knee: 0.2}, gear_ratio: {"*": 9, "*_hip": 6}',
         [0.6e-3, 1.8e-3]),
        ("column: i, scale: {l_hip: -1, l_knee: 1}, torque_constant: 0.1, gear_ratio: 9", [-0.9, 0.9]),
        ("column: i, order: [l_knee, l_hip], torque_constant: {l_hip: 1, l_knee: 2}, gear_ratio: 1", None),
    ):  # fmt: skip
        log = mapped_arrays(tmp_path, text % entry, q=q, i=current)
        expected = current[:, ::-1] * [1.0, 2.0] if factor is None else current * factor
        np.testing.assert_allclose(log.joint_torque, expected, rtol=1e-14, err_msg=entry)


def test_gains_may_be_columns_of_a_table(tmp_path: Path) -> None:
    text = POSITION + 'joint_torque: {pd: {kp: "kp_{index}", position: "goal_{index}"}}'
    columns = {"kp_0": [1, 2, 3], "kp_1": [10, 20, 30], "goal_0": [2, 2, 2], "goal_1": [5, 5, 5]}
    log = mapped(tmp_path, text, **columns)
    np.testing.assert_array_equal(log.joint_torque, [[1, 10], [0, 0], [-3, -30]])


def test_contacts_are_active_where_a_number_is_above_a_threshold_or_always(tmp_path: Path) -> None:
    force = {"f_a": [10.0, 30.0, 20.0], "f_b": [-50.0, 21.0, 500.0]}
    expected = [[False, False], [True, True], [False, True]]
    for entry in (
        'contact_active: {column: "f_{contact}", above: 20}',
        'contact_force_normal: "f_{contact}"\ncontact_active: {above: 20}',
    ):
        log = mapped(tmp_path, POSITION + entry, **force)
        assert log.contact_names == ("a", "b")
        np.testing.assert_array_equal(log.contact_active, expected)
    vectors = {f"{foot}_{axis}": [0.0, 3.0 * k, 4.0 * k] for foot in "ab" for k, axis in enumerate("xyz", 1)}
    text = POSITION + 'contact_wrench_world: {force: "{contact}_{axis}"}\ncontact_active: {above: 14.9}'
    log = mapped(tmp_path, text, **vectors)
    np.testing.assert_array_equal(log.contact_active, [[False] * 2, [False] * 2, [True] * 2])
    assert log.contact_wrench_world is not None
    assert np.isnan(log.contact_wrench_world[..., 3:]).all(), "moments were not measured"
    always = mapped(tmp_path, POSITION + "contact_active: {always: [a, b]}")
    assert always.contact_names == ("a", "b")
    assert always.contact_active is not None
    assert always.contact_active.all()
    with pytest.raises(LogError, match="contact_active: nan at sample 1, a"):
        mapped(tmp_path, POSITION + 'contact_active: {column: "f_{contact}", above: 20}', f_a=[1, "", 2], f_b=TIME)


@pytest.mark.skipif(not SHARED.is_dir(), reason="recorded logs are not beside the repository")
def test_a_recorded_controllers_arrays_are_read_by_four_lines() -> None:
    text = (
        "joint_position: dof_pos\njoint_velocity: dof_vel\njoint_torque: {pd: {kp: kp, kd: kd, position: des_dof_pos, "
    )
    path = SHARED / "go2_in_air" / "log.npz"
    log = read_log(path, columns=Columns(**yaml.safe_load(text + "velocity: des_dof_vel}}")))
    with np.load(path) as raw:
        expected = raw["kp"] * (raw["des_dof_pos"] - raw["dof_pos"]) + raw["kd"] * (raw["des_dof_vel"] - raw["dof_vel"])
        assert log.joint_names == tuple(raw["joint_names"])
    np.testing.assert_array_equal(log.joint_torque, expected)
