"""What `torchid evaluate` says on one screen."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from repository import DEMO

import torchid
from torchid.cli import main
from torchid.commands.evaluate import EvaluatedRun
from torchid.problem import Metrics
from torchid.terminal.identification import evaluation_lines

LOG = str(DEMO / "sway_test.npz")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("evaluated") / "run"
    more = ["estimator.ridge=0.01"]
    assert main(["identify", "-q", str(DEMO / "quadruped.yaml"), f"output={output}", *more]) == 0
    return output


@pytest.fixture(scope="module")
def evaluated(run: Path) -> EvaluatedRun:
    return torchid.evaluate(run, LOG)


def with_torque_error(metrics: Metrics, error: float) -> Metrics:
    return replace(metrics, rms=metrics.rms | {"joint_torque": error})


def with_logs(evaluated: EvaluatedRun, errors: dict[str, float]) -> EvaluatedRun:
    """The same with logs of other names and errors of joint torques."""
    (pair,) = evaluated.metrics.values()
    metrics = {
        name: pair._replace(identified=with_torque_error(pair.identified, error)) for name, error in errors.items()
    }
    return replace(evaluated, metrics=metrics)


def test_one_log_is_judged_in_a_sentence_with_its_errors(evaluated: EvaluatedRun) -> None:
    said = evaluation_lines(evaluated, 80)
    (pair,) = evaluated.metrics.values()
    assert said[0].startswith("Much better than the URDF on sway_test: the error is ")
    numbers = (pair.nominal.rms["base_force"], pair.identified.rms["base_force"], pair.identified.noise["base_force"])
    (row,) = (line for line in said if line.startswith("base force [N]"))
    assert row.split()[-3:] == [f"{x:.4g}" for x in numbers if x is not None]


def test_a_log_that_is_predicted_far_worse_than_the_runs_own_needs_attention(run: Path, tmp_path: Path) -> None:
    assert not any(line.startswith("attention") for line in evaluation_lines(torchid.evaluate(run, LOG), 400))
    with np.load(LOG) as file:
        log = dict(file)
    log["joint_torque"] = -log["joint_torque"]
    np.savez(tmp_path / "reversed.npz", **log)
    said = evaluation_lines(torchid.evaluate(run, str(tmp_path / "reversed.npz")), 400)
    (line,) = [line for line in said if line.startswith("attention")]
    assert re.search(
        r"reversed: the error \((joint torque|base force|base moment)\) is [0-9]+ times that on the run's own logs",
        line,
    ), line
    assert "torchid check" in line


def test_the_worst_log_comes_first_and_what_is_worse_than_the_urdf_is_said(evaluated: EvaluatedRun) -> None:
    logs = with_logs(evaluated, {"good": 0.1, "bad": 5.0, "fair": 0.2})
    said = " ".join(line.strip() for line in evaluation_lines(logs, 80))
    assert said.startswith("WORSE THAN URDF (URDF -> identified) on bad: joint torque 0.362 -> 5 N m")
    assert said.index("on bad") < said.index("on fair") < said.index("on good")


def test_all_errors_are_printed_when_asked_for(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    printed = {}
    for option in ("--quiet", "--verbose", None):
        assert main(["evaluate", str(run), "--log", LOG, *([] if option is None else [option])]) == 0
        printed[option] = capsys.readouterr().out
    assert printed["--quiet"] == ""
    assert "of its variation" in printed["--verbose"]
    assert "of its variation" not in str(printed[None])
    assert str(printed[None]).splitlines()[-1] == f"written to    {run / 'evaluation' / 'sway_test'}"


def test_a_run_whose_model_does_not_explain_its_own_logs_says_so_of_others(run: Path, evaluated: EvaluatedRun) -> None:
    assert evaluated.explained
    assert "not explain" not in evaluation_lines(evaluated, 400)[0]
    file = run / "metrics.json"
    document = json.loads(file.read_text())
    try:
        file.write_text(json.dumps(document | {"misfit": document["misfit"] | {"explained": False}}))
        lacking = torchid.evaluate(run, LOG)
    finally:
        file.write_text(json.dumps(document))
    assert evaluation_lines(lacking, 400)[0].endswith("residuals are not noise alone: intervals are too narrow.")


def test_samples_left_out_are_counted(evaluated: EvaluatedRun) -> None:
    lines = evaluation_lines(replace(evaluated, excluded={"sway_test": 12}), 80)
    assert "left out      12 samples that torchid check rejects" in lines
    assert not any("left out" in line for line in evaluation_lines(evaluated, 80))
