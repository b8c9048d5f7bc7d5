"""`torchid init` of a robot of a single body, and of columns and arrays whose names say little of what they are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from dialects import in_order, save_csv
from initiated import URDF, initiated, recorded
from motions import value
from synthetic import ROBOTS
from urdfs import link, write

from torchid.commands.init import init
from torchid.config import load_config
from torchid.errors import UnphysicalInertiaWarning
from torchid.logs import read_log
from torchid.robot import load_robot

SIDES = ("front_left", "front_right", "rear_left", "rear_right")
ROMEO_SMALL = ROBOTS / "romeo_description/urdf/romeo_small.urdf"


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
        joints = load_robot(ROMEO_SMALL).joint_names
    motion = {f"{name}_position": np.sin(np.arange(200) / 50.0) for name in joints}
    path = save_csv(tmp_path / "x.csv", {"t": np.arange(200) / 50.0} | motion)
    with pytest.warns(UnphysicalInertiaWarning) as told:
        init(ROMEO_SMALL, path, tmp_path / "x.yaml")
    assert len([one for one in told if one.category is UnphysicalInertiaWarning]) == 1


@pytest.mark.parametrize(
    ("names", "per_second"), [(("tv_sec", "tv_usec"), 10**6), (("ZeitInSec", "ZeitInNanoSec"), 10**9)]
)
def test_stamps_in_two_columns_are_one_and_a_number_among_others_is_that_of_the_joint(
    tmp_path: Path, names: tuple[str, str], per_second: int
) -> None:
    log = recorded()
    ticks = np.round((1_700_000_000.5 + log.time.astype(np.longdouble)) * per_second).astype(np.int64)
    columns: dict[str, Any] = {names[0]: ticks // per_second, names[1]: ticks % per_second}
    measured = in_order(log, log.joint_torque).T
    for what, factor in (("axisTauExt", 0.1), ("axisTauMsr", 1.0)):  # what a model says of the environment comes first
        columns |= {f"{what}_R_7_800_1[{k}]": factor * x for k, x in enumerate(measured)}
    columns |= {f"axisQMsr_R_7_800_1[{k}]": x for k, x in enumerate(in_order(log, log.joint_position).T)}
    found, _, _ = initiated(save_csv(tmp_path / "x.csv", columns))
    np.testing.assert_allclose(np.diff(found.time), np.diff(log.time), atol=1e-6)
    np.testing.assert_array_equal(value(found.joint_torque), measured.T)


@pytest.mark.parametrize("carried", [1.0, 0.1], ids=["those of feet", "those of hands"])
def test_forces_of_two_sides_are_those_of_feet_if_they_carry_the_robot(tmp_path: Path, carried: float) -> None:
    log = recorded()
    arrays: dict[str, Any] = {"t": log.time, "q": in_order(log, log.joint_position), "vBody": np.ones((len(log), 3))}
    weight = np.tile([0.0, 0.0, carried * load_robot(URDF).nominal[:, 0].sum() * 9.81 / 4], (len(log), 1))
    arrays |= {f"f_{side}": weight for side in ("fl", "fr", "rl", "rr")}
    np.savez(tmp_path / "x.npz", **arrays)
    init(URDF, tmp_path / "x.npz", tmp_path / "x.yaml")
    written = yaml.safe_load((tmp_path / "x.yaml").read_text())["logs"]["columns"]
    assert ("contact_wrench_world" in written) == (carried == 1.0)
    assert written["base_linear_velocity_base"] == "vBody"


def test_the_frame_of_an_odometry_with_every_second_row_is_found_and_stamps_that_repeat_are_refused(
    tmp_path: Path,
) -> None:
    log = recorded()
    velocity = np.gradient(value(log.base_position_world), log.time, axis=0)
    columns: dict[str, Any] = {"__time": log.time}
    columns |= {
        f"/joint_states/position/{name}": x for name, x in zip(log.joint_names, log.joint_position.T, strict=True)
    }
    quat = value(log.base_quat_xyzw)
    columns |= {f"/odom/pose/pose/orientation/{axis}": x for axis, x in zip("xyzw", quat.T, strict=True)}
    columns |= {
        f"/odom/pose/pose/position/{axis}": x for axis, x in zip("xyz", value(log.base_position_world).T, strict=True)
    }
    columns |= {f"/odom/twist/twist/linear/{axis}": x for axis, x in zip("xyz", velocity.T, strict=True)}
    for name in [name for name in columns if "position/x" in name or "linear" in name]:
        columns[name] = np.where(np.arange(len(log)) % 2, np.nan, columns[name])
    init(URDF, save_csv(tmp_path / "x.csv", columns), tmp_path / "x.yaml")
    written = yaml.safe_load((tmp_path / "x.yaml").read_text())["logs"]["columns"]
    assert "base_linear_velocity_world" in written, "a velocity that is the slope of the position, unlike what ROS says"
    said = init(URDF, save_csv(tmp_path / "y.csv", columns | {"__time": 0.0 * log.time}), tmp_path / "y.yaml")
    assert any("not read with this file yet" in line for line in said.missing)


def test_generalized_coordinates_have_the_order_of_the_robots_file_feet_included(tmp_path: Path) -> None:
    log = recorded()
    pose = np.hstack([value(log.base_position_world), np.roll(value(log.base_quat_xyzw), 1, axis=1)])
    none = np.zeros((len(log), 6))
    arrays = {"dt": 0.01, "gc": np.hstack([pose, log.joint_position]), "gf": np.hstack([none, value(log.joint_torque)])}
    arrays["gv"] = np.hstack([none, np.gradient(log.joint_position, log.time, axis=0)])
    arrays["contact_force"] = np.tile([0.0, 0.0, 50.0], (len(log), 4, 1))
    np.savez(tmp_path / "x.npz", **arrays)
    found, _, _ = initiated(tmp_path / "x.npz")
    np.testing.assert_array_equal(value(found.joint_torque), value(log.joint_torque))
    np.testing.assert_array_equal(value(found.joint_velocity), arrays["gv"][:, 6:])
    assert found.contact_names == log.contact_names


def test_joints_that_mimic_others_may_be_among_those_that_a_file_lists(tmp_path: Path) -> None:
    panda, rng = ROBOTS / "panda_description/urdf/panda.urdf", np.random.default_rng(2)
    names = [*(f"panda_joint{k}" for k in range(1, 8)), "panda_finger_joint1", "panda_finger_joint2"]
    arrays = {"sim_time": np.arange(300) / 100.0, "joint_pos": np.cumsum(rng.normal(size=(300, 9)), axis=0) / 100.0}
    arrays["joint_pos"][:, 8] = arrays["joint_pos"][:, 7]
    for more in ({"joint_names": np.array(names)}, {}):
        path = tmp_path / f"{len(more)}.npz"
        np.savez(path, **arrays, **more)
        found, _, _ = initiated(path, panda)
        of = found.joint_names.index("panda_joint3")
        np.testing.assert_array_equal(found.joint_position[:, of], arrays["joint_pos"][:, 2])


def test_arrays_of_one_limb_each_are_its_joints_in_the_order_of_the_robots_file(tmp_path: Path) -> None:
    log, arrays = recorded(), dict[str, Any]()
    for limb, side in (("RR", "rear_right"), ("FL", "front_left"), ("RL", "rear_left"), ("FR", "front_right")):
        columns = [log.joint_names.index(f"{side}_{joint}") for joint in ("hip", "thigh", "knee")]
        arrays |= {
            f"{limb}/state/q": log.joint_position[:, columns],
            f"{limb}/state/time": log.time + 1e-3 * len(arrays),
        }
    np.savez(tmp_path / "x.npz", **arrays)
    found, said, _ = initiated(tmp_path / "x.npz")
    of = [found.joint_names.index(name) for name in log.joint_names]
    np.testing.assert_array_equal(found.joint_position[:, of], log.joint_position)
    assert any(
        line.startswith("time: of 'RR/state/time', from which others differ by up to 0.00") for line in said.guessed
    )
    np.savez(tmp_path / "y.npz", **{name: x for name, x in arrays.items() if "FR" not in name})
    said = init(URDF, tmp_path / "y.npz", tmp_path / "y.yaml")
    assert any(line.startswith("joint_position: ") for line in said.missing), "limbs alone are not the robot"


@pytest.mark.parametrize("kind", ["arrays with lists of names", "numbered columns", "one limb without a name"])
def test_parts_of_a_robot_are_told_by_lists_of_names_by_limbs_and_by_what_is_left(tmp_path: Path, kind: str) -> None:
    log, columns = recorded(), dict[str, Any]()
    limbs = {side: [f"{side}_{joint}" for joint in ("knee", "hip", "thigh")] for side in SIDES}
    for limb, joints in limbs.items():
        ordered = joints if kind.startswith("arrays") else [f"{limb}_{x}" for x in ("hip", "thigh", "knee")]
        values = np.stack([log.joint_position[:, log.joint_names.index(name)] for name in ordered], axis=1)
        if kind == "numbered columns":
            columns |= {f"{limb}.position.{k}": x for k, x in enumerate(values.T)}
            continue
        called = "spine" if limb == SIDES[-1] and kind.startswith("one") else limb
        columns |= {f"{called}MotorPos": values} | ({f"{limb}JointNames": ordered} if ordered is joints else {})
    save = save_csv if kind == "numbered columns" else lambda path, given: (np.savez(path, **given), path)[1]
    found, _, _ = initiated(save(tmp_path / ("x.csv" if save is save_csv else "x.npz"), {"t": log.time} | columns))
    of = [found.joint_names.index(name) for name in log.joint_names]
    np.testing.assert_array_equal(found.joint_position[:, of], log.joint_position)


def test_files_with_the_same_columns_are_told_by_their_names(tmp_path: Path) -> None:
    log, files = recorded(), []
    for name, values in (
        ("positions", log.joint_position),
        ("torques", value(log.joint_torque)),
        ("kelvin", log.joint_position),
    ):
        columns = {"time": log.time} | dict(zip(log.joint_names, values.T, strict=True))
        files.append(str(save_csv(tmp_path / f"{name}.csv", columns)))
    init(URDF, " + ".join(files), tmp_path / "x.yaml")
    columns = load_config(tmp_path / "x.yaml").logs.columns
    found = read_log(" + ".join(files), columns=columns)
    np.testing.assert_array_equal(found.joint_position, log.joint_position)
    np.testing.assert_array_equal(value(found.joint_torque), value(log.joint_torque))
