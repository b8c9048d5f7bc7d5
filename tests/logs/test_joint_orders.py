"""Orders of joints and feet by name of a robot, in maps of columns and topics, against the robot's URDF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from dialects import save_csv
from low_states import FEET, GO2, TOPIC, moving, write_low_states
from motions import value
from refusals import refusal
from synthetic import G1, ROBOTS

from torchid.cli import main
from torchid.config import load_config
from torchid.config.logs import load_columns
from torchid.logs import Columns, Log, read_log
from torchid.logs.blocks import open_log_blocks
from torchid.logs.unitree import JOINT_ORDERS

URDF = ROBOTS / "go2_description/urdf/go2.urdf"
FLAGS = {"above": 5}
PATTERNS = ("motor_state[{index}].{what}", "motor_state_{index}_{what}", "low_state.motor_state.{index}.{what}")


def low_state_csv(path: Path, log: Log, pattern: str, motors: int) -> Path:
    """Columns of all motors of a message, unused ones too; motors are in the order of the log's joints."""
    columns: dict[str, Any] = {"time": log.time}
    quantities = {"q": log.joint_position, "dq": value(log.joint_velocity), "tau_est": value(log.joint_torque)}
    for index in range(motors):
        for what, x in quantities.items():
            used = index < x.shape[1]
            columns[pattern.format(index=index, what=what)] = x[:, index] if used else np.zeros(len(log))
        columns[pattern.format(index=index, what="temperature")] = np.full(len(log), 40)
    columns |= {f"foot_force[{k}]": np.arange(len(log)) + 10 * k for k in range(4)}
    return save_csv(path, columns)


def columns_of(pattern: str, **more: Any) -> dict[str, Any]:
    fields = {"joint_position": "q", "joint_velocity": "dq", "joint_torque": "tau_est"}
    entries = {field: pattern.replace("{what}", what) for field, what in fields.items()}
    ignored = [pattern.format(index="*", what=what) for what in ("temperature",)]
    return {"joint_order": "go2", "contact_order": "go2", **entries, "ignore": ignored} | more


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("motors", [12, 20])
def test_columns_of_motors_need_the_name_of_the_robot_alone(tmp_path: Path, pattern: str, motors: int) -> None:
    log = moving(GO2)
    path = low_state_csv(tmp_path / "x.csv", log, pattern, motors)
    again = read_log(
        path, columns=Columns(**columns_of(pattern, contact_force_normal="foot_force[{index}]", contact_active=FLAGS))
    )
    assert again.joint_names == GO2
    assert again.contact_names == FEET
    for field in ("joint_position", "joint_velocity", "joint_torque"):
        np.testing.assert_array_equal(getattr(again, field), getattr(log, field))
    np.testing.assert_array_equal(value(again.contact_force_normal)[3], [3, 13, 23, 33])


@pytest.mark.parametrize("width", [12, 15, 20])
def test_arrays_may_have_the_motors_that_are_not_used(tmp_path: Path, width: int) -> None:
    log = moving(GO2)
    arrays = {"q": log.joint_position, "tau_est": value(log.joint_torque)}
    arrays = {name: np.pad(x, ((0, 0), (0, width - 12)), constant_values=9.0) for name, x in arrays.items()}
    np.savez(tmp_path / "x.npz", time=log.time, **arrays)
    columns = Columns(joint_order="go2", joint_position="q", joint_torque="tau_est")  # type: ignore[arg-type]
    again = read_log(tmp_path / "x.npz", columns=columns)
    np.testing.assert_array_equal(again.joint_position, log.joint_position)
    np.testing.assert_array_equal(again.joint_torque, log.joint_torque)
    with open_log_blocks(tmp_path / "x.npz", tmp_path, columns) as blocks:
        np.testing.assert_array_equal(blocks.read(slice(7, 9)).joint_position, log.joint_position[7:9])


def test_names_and_numbers_of_motors_are_those_of_the_sdk() -> None:
    for robot, motor, joint in (
        ("go2", 4, "FL_thigh_joint"), ("b2", 11, "RL_calf_joint"), ("h1", 0, "right_hip_roll_joint"),
        ("h1", 8, "right_hip_yaw_joint"), ("h1", 10, "left_ankle_joint"), ("h1", 16, "left_shoulder_pitch_joint"),
        ("h1", 6, "torso_joint"), ("h1", 9, None), ("g1", 14, "waist_pitch_joint"),
        ("g1", 22, "right_shoulder_pitch_joint"),
        ("g1", 19, "left_wrist_roll_joint"), ("g1_23dof", 13, None), ("g1_23dof", 26, "right_wrist_roll_joint"),
    ):  # fmt: skip
        assert JOINT_ORDERS[robot].joints[motor] == joint
    counts = {"go2": 12, "b2": 12, "a1": 12, "go1": 12, "g1": 29, "g1_23dof": 23, "h1": 19}
    assert {name: len(order.names) for name, order in JOINT_ORDERS.items()} == counts


# ------------------------------------------------------------------------------------------------ experiment files


def experiment(folder: Path, urdf: Path, log: Path, **maps: Any) -> Path:
    settings = {
        "robot": {"urdf": str(urdf)},
        "contacts": [{"frame": name, "type": "point"} for name in FEET],
        "logs": {"train": [str(log)], **maps},
        "sensors": "joints",
        "estimator": {"name": "least_squares"},
        "output": str(folder / "run"),
    }
    path = folder / "robot.yaml"
    path.write_text(yaml.safe_dump(settings))
    return path


def test_a_file_with_a_name_is_dumped_and_read_as_its_list(tmp_path: Path) -> None:
    path = low_state_csv(tmp_path / "x.csv", moving(GO2), PATTERNS[0], 20)
    more = {"contact_active": {"column": "foot_force[{index}]"} | FLAGS}
    file = experiment(tmp_path, URDF, path, columns=columns_of(PATTERNS[0], **more))
    columns = load_config(file).logs.columns
    assert columns == load_columns(file)
    assert columns is not None
    assert columns.joint_order == [*GO2, *[None] * 8]
    assert main(["convert", str(path), str(tmp_path / "out.npz"), "--columns", str(file)]) == 0
    assert read_log(tmp_path / "out.npz").contact_names == FEET


@pytest.mark.parametrize(
    ("order", "message"),
    [
        ("g1", "logs.columns.joint_order: 'g1' has a joint 'left_hip_pitch_joint', your robot has not; accepted: go2"),
        ("go3", "logs.columns.joint_order: found 'go3'; accepted: a list of names, or a robot: go2, b2, a1, "),
        (["FR_hip"], "logs.columns.joint_order: unknown name 'FR_hip'; accepted: FR_hip_joint"),
    ],
)  # fmt: skip
def test_an_order_of_another_robot_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], order: object, message: str
) -> None:
    path = low_state_csv(tmp_path / "x.csv", moving(GO2), PATTERNS[1], 20)
    file = experiment(tmp_path, URDF, path, columns=columns_of(PATTERNS[1]) | {"joint_order": order})
    assert message in refusal(["check", str(file)], tmp_path, capsys)


@pytest.mark.parametrize(
    ("urdf", "low_state", "message"),
    [
        (URDF, {"robot": "h1"}, "robot: 'h1' has a joint 'right_hip_roll_joint', your robot has not; accepted: go2, "),
        (ROBOTS / G1, {"robot": "go2"}, "robot: 'go2' has a joint 'FR_hip_joint', your robot has not; accepted: g1, g"),
        (URDF, {"joints": ["FR_hip"]}, "low_state.joints: unknown name 'FR_hip'; accepted: FR_hip_joint"),
        (ROBOTS / "panda_description/urdf/panda.urdf", {"robot": "go2"}, "joint names by number: no known robot"),
    ],
)  # fmt: skip
def test_a_state_of_a_robot_that_is_not_the_urdfs_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], urdf: Path, low_state: dict[str, Any], message: str
) -> None:
    path = write_low_states(tmp_path / "x.mcap", moving(GO2, 4), GO2)
    file = experiment(tmp_path, urdf, path, topics={"low_state": {"topic": TOPIC, **low_state}})
    assert message in refusal(["check", str(file)], tmp_path, capsys)
