"""What `init` makes of forces, flags and velocities whose columns name sides rather than the robot's frames."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchid.logs.name_matching import KnownRobot
from torchid.proposals.column_groups import MapProposal
from torchid.proposals.maps import propose_map

WEIGHT, N = 300.0, 400
TIME = 0.005 * np.arange(N)
BIPED = KnownRobot(["l_hip", "r_hip"], ["r_ankle", "l_ankle"], "biped", WEIGHT, "pelvis", ["pelvis"], [])
LEGS = ("FR", "FL", "RR", "RL")
QUADRUPED = KnownRobot([f"{x}_hip" for x in LEGS], [f"{x}_foot" for x in LEGS], "dog", WEIGHT, "trunk", ["trunk"], [])


def proposed(robot: KnownRobot, columns: dict[str, Any]) -> MapProposal:
    return propose_map({"time": TIME, **columns}, robot)


def swinging(seed: int) -> np.ndarray:
    """Numbers (N,) of a load that comes and goes."""
    return WEIGHT * np.maximum(np.sin(3.0 * TIME + seed), 0.0)


PARTS = ("Force", "Moment")
WRENCHES = {
    "letters": ("{side}_foot_{part}{axis}", ("left", "right")),
    "couples": ("{Side}FootForceSensor_{part}{axis}", ("Left", "Right")),
    "camels": ("{side}Foot{Part}{Axis}", ("left", "right")),
    "numbers": ("FT_{side}_foot[{k}]", ("left", "right")),
    "inside": ("Device/{Side}Foot/Wrench/{part}{axis}/Sensor/Value", ("Left", "Right")),
}


@pytest.mark.parametrize("dialect", WRENCHES)
def test_wrenches_named_by_sides_are_those_of_the_feet_on_these(dialect: str) -> None:
    text, sides = WRENCHES[dialect]
    letters = "fc" if dialect == "couples" else "fm"
    columns = {
        text.format(
            side=side,
            Side=side,
            part=letters[k // 3],
            Part=PARTS[k // 3],
            axis="xyz"[k % 3],
            Axis="XYZ"[k % 3],
            k=k,
        ): swinging(k)
        for side in sides
        for k in range(6)
    }
    entry = proposed(BIPED, columns).columns["contact_wrench_local"]
    of_left = [
        of["columns"]["l_ankle"] for of in ([entry] if "columns" in entry else [entry["force"], entry["moment"]])
    ]
    assert (
        of_left
        == {
            "letters": ["left_foot_f{axis}", "left_foot_m{axis}"],
            "camels": ["leftFootForce{AXIS}", "leftFootMoment{AXIS}"],
            "couples": ["LeftFootForceSensor_f{axis}", "LeftFootForceSensor_c{axis}"],
            "numbers": ["FT_left_foot[{component}]"],
            "inside": [f"Device/LeftFoot/Wrench/{part}{{axis}}/Sensor/Value" for part in "fm"],
        }[dialect]
    )


def test_arrays_of_lf_and_rf_are_wrenches_of_the_left_and_right_foot_of_a_biped() -> None:
    wrench = np.stack([swinging(k) for k in range(6)], axis=1)
    out = proposed(BIPED, {"lf_wrench": wrench, "rf_wrench": wrench, "lh_wrench": wrench, "rh_wrench": wrench})
    assert out.columns["contact_wrench_local"] == {"columns": {"r_ankle": "rf_wrench", "l_ankle": "lf_wrench"}}
    assert {"lh_wrench", "rh_wrench"} <= set(out.columns["ignore"])


def test_truth_values_of_each_foot_are_flags_whatever_they_are_called() -> None:
    flags = {f"{side}_foot_state": swinging(k) > 0.0 for k, side in enumerate(("left", "right"))}
    entry = proposed(BIPED, flags).columns["contact_active"]
    assert entry == {"columns": {"r_ankle": "right_foot_state", "l_ankle": "left_foot_state"}}
    counts = {name: 3.0 + x for name, x in flags.items()}
    assert "contact_active" not in proposed(BIPED, counts).columns


def test_moments_of_each_joint_are_torques_and_one_of_something_else_is_not() -> None:
    columns = {f"{joint}_moment": swinging(k) for k, joint in enumerate(BIPED.joints)}
    assert proposed(BIPED, columns).columns["joint_torque"] == {"column": "{joint}_moment"}
    assert "joint_torque" not in proposed(BIPED, {"l_hip_moment": swinging(0), "moment": swinging(1)}).columns


def test_wrenches_of_hands_are_none_of_feet() -> None:
    columns = {f"{side}_hand_f{axis}": swinging(k) for side in ("left", "right") for k, axis in enumerate("xyz")}
    assert "contact_wrench_local" not in proposed(BIPED, columns).columns


def test_forces_that_pull_a_robot_down_are_those_on_the_ground() -> None:
    up = np.stack([np.zeros(N), np.zeros(N), 10.0 + swinging(0)], axis=1)
    out = proposed(QUADRUPED, {f"{x.lower()}_contact_force": -up for x in LEGS})
    entry = out.columns["contact_wrench_world"]["force"]
    assert entry == {"columns": {f"{x}_foot": f"{x.lower()}_contact_force" for x in LEGS}, "scale": -1}
    assert "as they pull the robot down" in out.notes["contact_wrench_world"]


def test_one_force_of_each_foot_by_french_sides_is_a_flag_above_a_threshold() -> None:
    sides = {"FL_foot": "avg", "FR_foot": "avd", "RL_foot": "arg", "RR_foot": "ard"}
    columns = {f"force_pied_{x}": swinging(k) for k, x in enumerate(sides.values())}
    entry = proposed(QUADRUPED, columns).columns["contact_active"]
    assert entry["columns"] == {foot: f"force_pied_{x}" for foot, x in sides.items()}
    assert 0.0 < entry["above"] < 0.2 * WEIGHT


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize(("force", "flag"), [("foot_force_{}", "contact_{}"), ("force_pied_{}", "contact_pied_{}")])
def test_recorded_flags_count_before_a_threshold_of_forces(force: str, flag: str, order: int) -> None:
    names = ("avg", "avd", "arg", "ard") if "pied" in force else LEGS
    forces = {force.format(x): swinging(k) for k, x in enumerate(names)}
    flags = {flag.format(x): (swinging(k) > 0.1 * WEIGHT).astype(int) for k, x in enumerate(names)}
    entry = proposed(QUADRUPED, dict([*forces.items(), *flags.items()][::order])).columns["contact_active"]
    assert "above" not in entry
    assert "force" not in str(entry)


def test_feet_without_names_are_in_the_order_of_the_legs_in_a_list_of_joints() -> None:
    legs = ("FL", "FR", "RL", "RR")
    forces = np.stack([swinging(k) for k in range(4)], axis=1)
    out = proposed(QUADRUPED, {"names": np.array([f"{x}_hip" for x in legs]), "foot_forces": forces})
    assert out.columns["contact_order"] == [f"{x}_foot" for x in legs]


def pose() -> tuple[np.ndarray, Rotation, np.ndarray]:
    """Position (N, 3), orientation and world velocity (N, 3) of a base that turns far."""
    wave = np.stack([np.sin(2.0 * TIME), np.cos(3.0 * TIME), np.sin(TIME)], axis=1)
    slope = np.stack([2.0 * np.cos(2.0 * TIME), -3.0 * np.sin(3.0 * TIME), np.cos(TIME)], axis=1)
    return wave, Rotation.from_rotvec(np.outer(1.5 * TIME, [0.0, 0.0, 1.0])), slope


@pytest.mark.parametrize("frame", ["world", "base"])
def test_the_frame_of_a_base_velocity_is_that_in_which_it_is_the_slope_of_the_pose(frame: str) -> None:
    position, turn, slope = pose()
    velocity = slope if frame == "world" else turn.inv().apply(slope)
    columns = {"base_pos": position, "base_quat": turn.as_quat(), "base_lin_vel": velocity}
    out = proposed(BIPED, columns)
    assert out.columns[f"base_linear_velocity_{frame}"] == {"column": "base_lin_vel"}
    assert sum("velocity" in key for key in out.columns) == 1


def test_a_base_velocity_that_contradicts_the_pose_is_left_out() -> None:
    position, turn, slope = pose()
    out = proposed(BIPED, {"base_pos": position, "base_quat": turn.as_quat(), "base_lin_vel": slope[::-1]})
    assert not any("velocity" in key for key in out.columns)
    assert "base_lin_vel" in out.columns["ignore"]


def test_thirteen_columns_with_a_pose_are_a_pose_and_a_twist() -> None:
    position, turn, slope = pose()
    rate = np.tile([0.0, 0.0, 1.5], (N, 1))
    out = proposed(BIPED, {"root_states": np.hstack([position, turn.as_quat(), slope, rate])}).columns
    found = {key: entry["column"] for key, entry in out.items() if key.startswith("base")}
    assert (found["base_position_world"], found["base_quat_xyzw"]) == ("root_states[0:3]", "root_states[3:7]")
    assert found["base_linear_velocity_world"] == "root_states[7:10]"
    assert any(found.get(f"base_angular_velocity_{x}") == "root_states[10:13]" for x in ("world", "base"))


@pytest.mark.parametrize("name", ["tau_d", "tau_J_d", "torque_soll", "couple_cons"])
def test_torques_that_are_wanted_are_not_taken_for_measured_ones(name: str) -> None:
    columns = {f"{x}_{joint}": swinging(k) for k, joint in enumerate(BIPED.joints) for x in (name, "tau")}
    assert proposed(BIPED, columns).columns["joint_torque"] == {"column": "tau_{joint}"}


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("name", ["foot_force_world", "net_forces_w", "foot_force"])
def test_forces_of_two_feet_are_in_the_world_if_their_name_says_so(name: str, sign: float) -> None:
    forces = np.stack([swinging(0), swinging(1), WEIGHT * np.ones(N)], axis=1)[:, None].repeat(2, axis=1)
    entry = proposed(BIPED, {name: sign * forces}).columns
    if name == "foot_force":
        assert entry["contact_wrench_local"] == {"force": {"column": name}}
    else:
        assert entry["contact_wrench_world"]["force"].get("scale", 1) == sign


@pytest.mark.parametrize(
    ("name", "unit", "in_newtons"),
    [
        ("{foot}_fn", "", 1.0),
        ("normal_force_{side}", "", 1.0),
        ("Force verticale pied {side} (kN)", "kN", 1e-3),
    ],
)
@pytest.mark.parametrize("carried", [1.0, 0.1], ids=["of the weight", "of less, or counts"])
def test_forces_along_the_normal_are_those_that_say_so_and_carry_the_robot(
    name: str, unit: str, in_newtons: float, carried: float
) -> None:
    loads = np.stack([swinging(k) for k in range(4)], axis=1)
    loads[loads < 60.0] = 0.0
    loads *= carried * WEIGHT / np.maximum(loads.sum(axis=1, keepdims=True), 1.0)
    columns = {name.format(foot=f"{side}_foot", side=side): in_newtons * loads[:, k] for k, side in enumerate(LEGS)}
    turn = np.tile([0.0, 0.0, 0.0, 1.0], (N, 1))
    found = proposed(QUADRUPED, columns | {"base_quat_xyzw": turn}).columns
    assert ("contact_force_normal" in found) == (carried == 1.0)
    assert "contact_force_normal" not in proposed(QUADRUPED, columns).columns, "of no known orientation"
    if carried == 1.0:
        assert found["contact_force_normal"].get("unit", "") == unit
        assert 5.0 < found["contact_active"]["above"] < 60.0
    unsaid = {"fn": "fz", "normal": "foot", "verticale": ""}
    others = {re.sub("|".join(unsaid), lambda word: unsaid[word[0]], name): x for name, x in columns.items()}
    assert "contact_force_normal" not in proposed(QUADRUPED, others | {"base_quat_xyzw": turn}).columns
