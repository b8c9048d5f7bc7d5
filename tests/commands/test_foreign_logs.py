"""Foreign recordings through all commands: the fit of a dialect, by its map in the experiment file, is the log's."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from demo import FAST_ESTIMATOR
from dialects import DIALECTS, with_velocity
from refusals import refusal
from repository import DEMO

from torchid.cli import main
from torchid.logs import Log, read_log, write_log

SAMPLES = 300
PARQUET, PD, MOTORS = "nested names", "PD law", "motor numbers in degrees"
SMALL = "preprocessing.memory_gb=0.0001"


def recorded(name: str) -> Log:
    """The demo's log, without an IMU."""
    log = with_velocity(read_log(DEMO / f"{name}.npz").select(slice(0, SAMPLES)))
    return Log(**(vars(log) | {"imu_frame": "", "imu_specific_force": None, "imu_angular_velocity": None}))


def experiment(folder: Path, dialect: str | None, **more: Any) -> Path:
    """An experiment file with logs in a dialect and their map; None: in the format."""
    settings = yaml.safe_load((DEMO / "quadruped.yaml").read_text())
    settings |= {"output": str(folder / "run"), "estimator": FAST_ESTIMATOR}
    settings["robot"]["urdf"] = str(DEMO / "quadruped.urdf")
    file, text, write = DIALECTS[dialect or PARQUET]
    suffix, logs = Path(file).suffix if dialect else ".npz", {}
    for key in ("train", "test"):
        path = folder / f"{key}{suffix}"
        write(path, recorded(f"sway_{key}")) if dialect else write_log(recorded(f"sway_{key}"), path)
        logs[key] = [path.name]
    settings["logs"] = logs | ({"columns": yaml.safe_load(text)} if dialect else {})
    (folder / "experiment.yaml").write_text(yaml.safe_dump(settings | more, sort_keys=False))
    return folder / "experiment.yaml"


def identified(folder: Path, dialect: str | None, *overrides: str) -> tuple[dict[str, float], dict[str, Any]]:
    """Every identified parameter by body and name, and the metrics."""
    folder.mkdir()
    assert main(["identify", str(experiment(folder, dialect)), *overrides]) == 0
    bodies = json.loads((folder / "run" / "parameters.json").read_text())["bodies"]
    metrics = json.loads((folder / "run" / "metrics.json").read_text())
    return {f"{body['name']} {key}": x for body in bodies for key, x in body["identified"].items()}, metrics


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> dict[str, float]:
    """What the log in the format gives."""
    return identified(tmp_path_factory.mktemp("format") / "x", None)[0]


def assert_same(found: dict[str, float], expected: dict[str, float]) -> None:
    size = max(map(abs, expected.values()))
    assert found.keys() == expected.keys()
    assert max(abs(found[name] - x) for name, x in expected.items()) < 1e-8 * size


@pytest.mark.parametrize(("dialect", "overrides"), [(MOTORS, ()), (PD, (SMALL,)), (PARQUET, (SMALL,))])
def test_a_dialect_gives_the_parameters_of_the_log_and_is_evaluated_by_the_runs_own_map(
    tmp_path: Path, expected: dict[str, float], dialect: str, overrides: tuple[str, ...]
) -> None:
    found, metrics = identified(tmp_path / "x", dialect, *overrides)
    assert_same(found, expected)
    run, log = tmp_path / "x" / "run", next((tmp_path / "x").glob("test.*"))
    assert main(["evaluate", str(run), "--log", str(log)]) == 0
    again = json.loads((run / "evaluation" / "test" / "metrics.json").read_text())["test"]["identified"]
    assert again["joint_torque_rms"] == pytest.approx(metrics["test"]["joint_torque_rms"], rel=1e-9)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_check_and_convert_take_the_map_of_an_experiment_file(
    tmp_path: Path, dialect: str, capsys: pytest.CaptureFixture[str]
) -> None:
    name, text, write = DIALECTS[dialect]
    path, map_file = write(tmp_path / name, with_velocity(recorded("sway_test"))), tmp_path / "map.yaml"
    map_file.write_text(yaml.safe_dump({"logs": {"columns": yaml.safe_load(text)}}, sort_keys=False))
    main(["check", str(path), "--columns", str(map_file)])
    assert "300 samples" in (shown := capsys.readouterr().out), shown
    assert main(["convert", str(path), str(tmp_path / "out.npz"), "--columns", str(map_file)]) == 0
    again = read_log(tmp_path / "out.npz")
    order = [again.joint_names.index(name) for name in recorded("sway_test").joint_names]
    np.testing.assert_allclose(again.joint_position[:, order], recorded("sway_test").joint_position, rtol=1e-12)
    capsys.readouterr()
    message = refusal(["check", str(path)], tmp_path, capsys)
    assert "a map of the columns (logs.columns) in an experiment file" in message


BAD: list[tuple[dict[str, Any], str]] = [
    (
        {"joint_order": ["front_right_hipp"]},
        "logs.columns.joint_order: unknown name 'front_right_hipp'; accepted: fron",
    ),
    ({"contact_order": ["font"]}, "logs.columns.contact_order: unknown name 'font'; accepted: "),
    (
        {"joint_torque": {"column": "t{index}", "order": ["knee"]}},
        "logs.columns.joint_torque.order: unknown name 'knee'",
    ),
    ({"contact_active": {"always": ["foot"]}}, "logs.columns.contact_active.always: unknown name 'foot'"),
    ({"joint_torqe": "tau"}, "logs.columns: unknown name 'joint_torqe'; accepted: joint_torque"),
    (
        {"joint_torque": 3},
        "logs.columns.joint_torque: found 3; accepted: the name of a column, a pattern such as {joint}",
    ),
    ({"joint_torque": {"colum": "tau"}}, "logs.columns.joint_torque: unknown name 'colum'; accepted: column"),
    (
        {"joint_torque": {"column": "t", "scale": "x"}},
        "logs.columns.joint_torque.scale.*: found 'x'; accepted: a number",
    ),
    ({"joint_torque": {"column": "t", "unit": 3}}, "logs.columns.joint_torque.unit.*: found 3; accepted: a text"),
    (
        {"joint_torque": {"pd": {"kp": True, "position": "x"}}},
        "joint_torque.pd.kp.value.*: found True; accepted: a number",
    ),
    (
        {"time": {"column": "t", "unit": "h"}},
        "logs.columns.time.unit: 'h', an unknown unit; accepted: s, ms, us, ns, min",
    ),
    ({"joint_order": "a"}, "logs.columns.joint_order: found 'a'; accepted: a list"),
    ({"ignore": "a"}, "logs.columns.ignore: found 'a'; accepted: a list"),
]


@pytest.mark.parametrize(("changes", "found"), BAD)
def test_a_map_that_does_not_fit_the_robot_or_itself_is_named_by_its_key_before_a_log_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, Any], found: str
) -> None:
    file = experiment(tmp_path, MOTORS)
    settings = yaml.safe_load(file.read_text())
    settings["logs"]["columns"] |= changes
    file.write_text(yaml.safe_dump(settings, sort_keys=False))
    message = refusal(["identify", str(file)], tmp_path, capsys)
    assert message.startswith(f"error: {file}: ") or f"{file}: " in message
    assert found in message


def test_a_log_that_lacks_joints_of_the_robot_says_which(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = experiment(tmp_path, MOTORS)
    settings = yaml.safe_load(file.read_text())
    columns = settings["logs"]["columns"]
    columns["joint_order"] = columns["joint_order"][:11]
    columns["ignore"] = ["*"]
    file.write_text(yaml.safe_dump(settings, sort_keys=False))
    message = refusal(["identify", str(file)], tmp_path, capsys)
    assert "joint_names: missing joints of quadruped.urdf: rear_left_knee" in message
