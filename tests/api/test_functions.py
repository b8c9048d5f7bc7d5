"""`torchid.identify` and its siblings: the numbers of the commands, without their folders."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from demo import FAST_ESTIMATOR, shortened_demo
from repository import DEMO
from run_folders import names_in

import torchid
from torchid.cli import main
from torchid.config import load_config
from torchid.errors import ConfigError, InputError, UnknownNameError
from torchid.parameters import PARAMETERS

FILE = DEMO / "quadruped.yaml"
KNEE, SHANK = "front_left_knee", "front_left_shank_link"
LOG = torchid.Log(source="log", time=np.zeros(1), joint_names=("a",), joint_position=np.zeros((1, 1)))
UNPHYSICAL = "ignore:identified.urdf:torchid.errors.TorchidWarning"


def sections(demo: Path = DEMO) -> dict[str, Any]:
    """The demo as a user writes it in Python."""
    settings = yaml.safe_load((demo / "quadruped.yaml").read_text())
    del settings["output"]
    settings["robot"] = demo / "quadruped.urdf"
    settings["logs"] = {"train": [demo / "sway_train.npz"], "test": (str(demo / "sway_test.npz"),)}
    settings["preprocessing"]["cutoff_hz"] = np.float64(settings["preprocessing"]["cutoff_hz"])
    return settings


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo with less of its logs, and with its own estimator."""
    folder = shortened_demo(tmp_path_factory.mktemp("short") / "demo", 200)
    file = folder / "quadruped.yaml"
    file.write_text(
        file.read_text().replace(f"estimator: {FAST_ESTIMATOR}", "estimator: {name: consistent, ridge: auto}")
    )
    return folder


@pytest.fixture(scope="module")
def result(demo: Path) -> torchid.Identification:
    return torchid.identify(demo / "quadruped.yaml", output=None)


@pytest.fixture(scope="module")
def folder(demo: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("runs") / "demo"
    assert main(["identify", str(demo / "quadruped.yaml"), f"output={output}"]) == 0
    return output


def without_times(metrics: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in metrics.items() if key != "seconds"}


def test_the_function_finds_what_the_command_writes_to_the_last_bit(
    result: torchid.Identification, folder: Path
) -> None:
    document = json.loads(json.dumps(result.to_dict()))
    assert document["parameters"] == json.loads((folder / "parameters.json").read_text())
    assert without_times(document["metrics"]) == without_times(json.loads((folder / "metrics.json").read_text()))
    written = yaml.safe_load((folder / "config.yaml").read_text())
    assert {key for key, value in document["config"].items() if value != written[key]} == {"output"}


def test_without_an_output_nothing_is_written(
    demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, result: torchid.Identification
) -> None:
    monkeypatch.chdir(tmp_path)
    torchid.identify(demo / "quadruped.yaml", output=None, estimator=FAST_ESTIMATOR)
    torchid.evaluate(result, demo / "sway_test.npz")
    torchid.check(demo / "quadruped.yaml")
    assert names_in(tmp_path) == []
    assert not (demo / "runs").exists()


@pytest.mark.filterwarnings(UNPHYSICAL)
def test_a_result_is_written_as_the_command_writes_it(
    result: torchid.Identification, folder: Path, tmp_path: Path
) -> None:
    assert result.write(tmp_path / "run") == tmp_path / "run"
    assert load_config(tmp_path / "run" / "config.yaml").output == tmp_path / "run"
    for name in ("parameters.json", "identified.urdf"):
        assert (tmp_path / "run" / name).read_bytes() == (folder / name).read_bytes()
    assert {path.name.split(".")[0] for path in (tmp_path / "run").iterdir()} == {
        path.name.split(".")[0] for path in folder.iterdir()
    }
    with pytest.raises(ConfigError, match="output: not empty; accepted: a new folder, or overwrite=true"):
        result.write(tmp_path / "run")
    result.write(tmp_path / "run", overwrite=True)


@pytest.mark.parametrize("given", ["output=null", "output="])
def test_the_command_needs_an_output(given: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Nobody shall find after an hour that a variable of the shell was not set."""
    for command in ("identify", "analyze"):
        assert main([command, str(FILE), given]) == 2
        assert capsys.readouterr().err == f"torchid: {FILE}: output: found None; accepted: a path\n"


def test_a_body_has_its_values_under_their_names(result: torchid.Identification) -> None:
    robot, estimate = result.experiment.robot, result.estimate
    assert list(result) == list(robot.body_names)
    assert len(result) == len(robot.body_names)
    for number, name in enumerate(robot.body_names):
        body, columns = result[name], slice(12 * number, 12 * number + 12)
        phi, error, verdict = (x[columns] for x in (estimate.phi, estimate.standard_error, estimate.verdict))
        np.testing.assert_array_equal([body[one] for one in PARAMETERS], phi)
        np.testing.assert_array_equal([body.nominal[one] for one in PARAMETERS], robot.nominal[number])
        np.testing.assert_array_equal([body.standard_error[one] for one in PARAMETERS], error)
        assert list(body.verdict.to_dict().values()) == list(verdict)
        assert (body.mass, body.coulomb_friction, body.viscous_friction) == (phi[0], phi[10], phi[11])
        np.testing.assert_array_equal(body.first_moment, phi[1:4])
        np.testing.assert_array_equal(body.inertia[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]], phi[4:10])
        np.testing.assert_array_equal(body.inertia, body.inertia.T)
        np.testing.assert_allclose(body.center_of_mass * body.mass, phi[1:4], rtol=1e-14)
        assert body.verdict.mass == verdict[0]
        assert (np.isfinite(body.standard_error.mass)) == (verdict[0] in ("identified", "dominated by the prior"))


def test_a_body_is_found_by_its_joint_and_its_links(result: torchid.Identification) -> None:
    for name in (KNEE, "front_left_foot"):
        assert (result[name].name, result[name].joint) == (SHANK, KNEE)
    assert result["trunk"].joint == ""
    with pytest.raises(UnknownNameError, match="body or joint: unknown name 'trunc'; accepted: trunk"):
        result["trunc"]
    with pytest.raises(UnknownNameError, match="parameter: unknown name 'mass'; accepted: m, "):
        result["trunk"]["mass"]


def test_the_table_has_a_row_for_each_parameter(result: torchid.Identification) -> None:
    table = result.table()
    assert len(table) == 12 * len(result)
    assert len({tuple(row) for row in table}) == 1, "the same keys everywhere"
    (row,) = (row for row in table if row["body"] == SHANK and row["parameter"] == "fc")
    assert row["identified"] == result[KNEE].coulomb_friction
    assert row["urdf"] == result[KNEE].nominal.coulomb_friction
    assert len(str(table).splitlines()) == len(table) + 1


def test_a_result_and_its_folder_are_evaluated_alike(demo: Path, result: torchid.Identification, folder: Path) -> None:
    of_result = torchid.evaluate(result, demo / "sway_test.npz")
    of_folder = torchid.evaluate(folder, [demo / "sway_test.npz"])
    assert of_result.to_dict() == of_folder.to_dict()
    assert of_folder.output is None
    assert not (folder / "evaluation").exists()
    test = result.metrics["test"].identified.rms
    assert of_result.metrics["sway_test"].identified.rms == pytest.approx(test, rel=1e-12)


def test_logs_are_checked_from_files_and_from_memory(demo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checked = torchid.check(demo / "quadruped.yaml")
    assert [Path(one.log.source).name for one in checked] == ["sway_train.npz", "sway_test.npz"]
    assert checked.usable
    (alone,) = torchid.check(demo / "sway_test.npz", robot=demo / "quadruped.urdf")
    assert len(alone.skipped) < len(torchid.check(torchid.read_log(demo / "sway_test.npz")).skipped)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("changes", "kind", "message"),
    [
        ({"robto": "x"}, UnknownNameError, "torchid.identify: key: unknown name 'robto'; accepted: robot"),
        (
            {"sensors": ["joint_torque"]},
            ConfigError,
            "torchid.identify: sensors: found ['joint_torque']; accepted: ",
        ),
        ({"sensors": {"joint_torques": ["nee"]}}, UnknownNameError, "torchid.identify: sensors.joint_torques: unknown"),
        ({"logs": [object()]}, ConfigError, "torchid.identify: logs.0: found <object"),
        ({"logs": {"train": [LOG]}}, ConfigError, "experiment file; write a Log to a file with torchid.write_log"),
        ({"robot": None}, ConfigError, "torchid.identify: robot: found None; accepted: a mapping with urdf"),
        ({"overwrite": "often"}, ConfigError, "torchid.identify: overwrite: found 'often'"),
        ({"resume": True, "estimator": {"name": "sgd"}}, ConfigError, "--resume: needs an output; accepted: an"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_wrong_keyword_is_refused_in_one_line(changes: dict[str, Any], kind: type[InputError], message: str) -> None:
    with pytest.raises(kind) as raised:
        torchid.identify(**sections() | changes)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_missing_keyword_is_named(result: torchid.Identification) -> None:
    with pytest.raises(ConfigError, match="^torchid.identify: sensors, logs: missing; accepted: sensors: full, "):
        torchid.identify(robot=DEMO / "quadruped.urdf")
    with pytest.raises(ConfigError, match="^torchid.check: logs: missing; accepted: logs to check"):
        torchid.check(robot=DEMO / "quadruped.urdf")
    with pytest.raises(ConfigError, match="^torchid.evaluate: logs: none given; accepted: logs to evaluate"):
        torchid.evaluate(result, [])
    for device in ("tpu", "cuda:x", "cuda:99"):
        with pytest.raises(
            ConfigError, match=f"^torchid.evaluate: device: '{device}' is not available on this machine; acc"
        ):
            torchid.evaluate(result, DEMO / "sway_test.npz", device=device)
    with pytest.raises(ConfigError, match="^torchid.evaluate: write: True, but the run has no folder; accepted: run.w"):
        torchid.evaluate(result, DEMO / "sway_test.npz", write=True)
    with pytest.raises(UnknownNameError, match="sway_test.npz: key: 'logs', which needs an experiment file"):
        torchid.check(DEMO / "sway_test.npz", logs=[])
    with pytest.raises(ConfigError, match="sway_test.npz: robot: found {'base_link': 'a'}; accepted: a URDF, or a map"):
        torchid.check(DEMO / "sway_test.npz", robot={"base_link": "a"})
    with pytest.raises(ConfigError, match="^nowhere.yaml: file: cannot be read"):
        torchid.identify("nowhere.yaml")
