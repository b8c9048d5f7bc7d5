"""Scripts that measure: their stages, posteriors, paths through the code, and networks beside the rigid body."""

from __future__ import annotations

import re
from pathlib import Path

import benchmark
import numpy as np
import pytest
import torch
from demo import WITHOUT_TERMS, shortened_demo
from posterior_accuracy import Synthetic, differences, long_run
from posterior_coverage import covered
from random_samples import random_samples, sensor_set
from repository import DEMO
from script_calls import call, script
from stages import STAGES, Limits, measure_stages, stage_table
from synthetic import load
from trainings import events_in

from torchid.estimators.truncated_gaussian import TruncatedGaussian
from torchid.problem import RowBuilder
from torchid.sensing import Contact

LIMITS = Limits(operations=1e9, copied=8e9, uploaded=None)
FILE = str(DEMO / "quadruped.yaml")


def test_every_stage_of_a_compression_is_measured_beside_its_floor() -> None:
    robot = load(DEMO / "quadruped.urdf")
    contacts = [Contact(f"{leg}_foot", "point") for leg in ("front_left", "front_right", "rear_left", "rear_right")]
    samples, _ = random_samples(robot, contacts, 64, 2, states=1)
    samples.active[:] = torch.ones(4, dtype=torch.bool)
    builder = RowBuilder(robot, contacts, sensor_set("joints", robot, contacts))
    stages = measure_stages(builder, samples, LIMITS)
    assert tuple(stages.measured) == tuple(stages.floor) == STAGES
    assert all(floor > 0.0 for floor in stages.floor.values())
    assert stages.measured[STAGES[0]] > 0.0
    table = stage_table({"quadruped": stages}, LIMITS, torch.device("cpu"))
    assert table.row_count == len(STAGES) + 1


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["benchmark.py", "--device", "cuda"])
    with pytest.raises(SystemExit) as ended:
        benchmark.main()
    (line,) = str(ended.value).splitlines()
    assert "found no GPU" in line


@pytest.mark.study
def test_samples_of_an_arm_have_the_moments_of_long_chains() -> None:
    posterior = Synthetic("UR5", 0).posterior(0)
    sampler = TruncatedGaussian(posterior.conic_problem(0.2), posterior.owners())
    draws = sampler.draw(40_000, torch.Generator().manual_seed(0)).numpy()
    found = differences(draws, long_run(posterior, 0.2, 300, 200))
    assert {name: largest < 0.05 for name, (largest, _) in found.items()} == dict.fromkeys(found, True)


def test_credible_intervals_hold_the_truth_where_the_data_speak() -> None:
    """Of 8 times 6 combinations, a share that chance alone moves by 3 %."""
    robot = Synthetic("Solo12", 0, rough=1.0)
    assert np.mean([covered(robot, number, 0.2).mean() for number in range(8)]) > 0.85


def test_the_librarys_path_from_a_log_to_parameters_passes_no_command_and_no_report(tmp_path: Path) -> None:
    trace_path = script("trace_path")
    trace_path.import_everything()
    demo = shortened_demo(tmp_path / "demo", 60) / "quadruped.yaml"
    trace = trace_path.Trace().run(lambda: trace_path.library_path(demo)).from_log()
    packages = list(dict.fromkeys(call[0].split("/")[0] for call in trace.calls))
    assert packages[0] == "logs"
    assert {"regressor", "sensing", "problem", "estimators"} < set(packages)
    assert not {"commands", "config", "fitting", "report", "simulation"} & set(packages)
    assert trace.calls[-1][0].startswith("estimators/") or trace.calls[-1][0].startswith("problem/")
    assert any("read_log" in line for line in trace.functions())


@pytest.mark.slow("trainings of networks")
def test_networks_find_the_friction_that_the_model_lacks(tmp_path: Path) -> None:
    status, printed, _ = call(
        "train_residual", FILE, "estimator.friction=false", WITHOUT_TERMS, "--epochs", "8", "--curves", str(tmp_path)
    )
    assert status == 0
    rows = [line for line in printed.splitlines() if "│" in line]
    alone, beside = (float(re.findall(r"\d+\.\d+", row)[1]) for row in rows)
    assert beside < 0.5 * alone
    assert {path.name for path in tmp_path.iterdir()} == {"rigid_bodies_alone", "with_networks"}
    for row, run in zip(rows, ("rigid_bodies_alone", "with_networks"), strict=True):
        events = events_in(tmp_path / run)
        unseen = [event.value for event in events.Scalars("loss_unseen/data")]
        assert len(unseen) == 8
        assert f"{unseen[-1] ** 0.5:.3f}" in row
        assert "_hparams_/session_start_info" in events.summary_metadata

    status, _, told = call("train_residual", FILE, "--curves", str(tmp_path))
    assert status == 2
    assert told == f"train_residual: command line: --curves: {tmp_path} exists; accepted: a new folder\n"


@pytest.mark.slow("a training")
def test_the_script_computes_where_it_is_told(tmp_path: Path) -> None:
    """The option counts, not the file; without a GPU it is refused before any work, with one it is used."""
    arguments = (FILE, "device=cuda:99", "--epochs", "1", "--weight", "1", "--curves")
    status, _, told = call("train_residual", *arguments, str(tmp_path / "cpu"), "--device", "cpu")
    assert (status, told) == (0, "")
    status, _, told = call("train_residual", *arguments, str(tmp_path / "cuda"), "--device", "cuda")
    if torch.cuda.is_available():
        assert (status, told) == (0, "")
    else:
        assert status == 2
        assert "device: 'cuda' is not available on this machine; accepted: cpu, cuda, cuda:0, ..." in told
