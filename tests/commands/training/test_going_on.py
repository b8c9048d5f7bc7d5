"""A descent as a run: curves, checkpoints, and going on after whatever stopped it as if nothing had."""

from __future__ import annotations

import json
import os
import random
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile_commands import Commands
from repository import DEMO
from run_figures import OF_A_RUN
from run_folders import names_in
from thinned import study_but
from trainings import (
    BY_EPOCH,
    EPOCHS,
    EVALUATED,
    assert_as_uninterrupted,
    command,
    events_in,
    interrupt,
    steps,
    stopped_in,
    training_of,
)

import torchid
from torchid import parameters
from torchid.cli import main
from torchid.commands.folder import CHECKPOINT
from torchid.commands.training import load_checkpoint
from torchid.config import load_config
from torchid.estimators import Trainer
from torchid.problem.linear import parameter_scale
from torchid.problem.metrics import ERROR_GROUPS, ROW_GROUPS

pytestmark = pytest.mark.usefixtures("events")


def test_the_run_folder_is_that_of_any_run_and_nothing_is_left_beside_it(run: Path) -> None:
    names = {"events" if path.name.startswith("events") else path.name for path in run.iterdir()}
    figures = {f"{name}.png" for name in OF_A_RUN}
    results = {"config.yaml", "parameters.json", "metrics.json", "identified.urdf", "manifest.json"}
    results |= {"report.json", "posterior.npz"}
    assert names == {"events", *results, *figures}
    assert names_in(run.parent) == [run.name]
    assert load_config(run / "config.yaml").estimator.training.epochs == EPOCHS


def test_metrics_and_parameters_are_those_of_the_best_epoch(run: Path) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    groups = ("joint_torque_rms", "joint_torque_rms_by_joint", "base_force_rms", "base_moment_rms", "nullspace_rms")
    groups += ("base_force_rms_by_axis", "base_moment_rms_by_axis", "projected_residual")
    for name in ("train", "test"):
        known = {*groups, *(f"{group}_relative" for group in groups), "centre_of_pressure_rms"}
        assert set(metrics[name]) == known
        for group in ("joint_torque_rms", "base_force_rms", "base_moment_rms", "nullspace_rms"):
            assert metrics[name][group] < metrics[f"{name}_nominal"][group]
    held_out = {event.step: event.value for event in events_in(run).Scalars("loss_held_out/data")}
    best = min(held_out, key=lambda step: held_out[step])
    assert metrics["solution"]["epochs"] == EPOCHS
    assert metrics["solution"]["best_epoch"] == best
    least = {event.step: event.value for event in events_in(run).Scalars("optimum/objective_above_least")}
    above = metrics["solution"]["objective"] / metrics["solution"]["unconstrained"] - 1.0
    assert above == pytest.approx(least[best], rel=1e-6)
    robot = torchid.load_robot(DEMO / "quadruped.urdf")
    bodies = json.loads((run / "parameters.json").read_text())["bodies"]
    phi = np.array([list(body["identified"].values()) for body in bodies])
    least_eigenvalues = parameters.least_eigenvalues(phi.ravel(), parameter_scale(robot.nominal).ravel())
    assert metrics["smallest_eigenvalue"] == pytest.approx(dict(zip(robot.body_names, least_eigenvalues, strict=True)))
    assert least_eigenvalues.min() > 1e-4
    assert phi[1:, 10:].min() > 0.0


def identified(run: Path) -> list[tuple[str, str]]:
    """Bodies and parameters that are identified one by one."""
    bodies = json.loads((run / "parameters.json").read_text())["bodies"]
    return [(x["name"], name) for x in bodies for name, verdict in x["verdict"].items() if verdict == "identified"]


def test_curves_say_everything_by_epoch_and_show_train_and_unseen_logs(run: Path) -> None:
    events, robot = events_in(run), torchid.load_robot(DEMO / "quadruped.urdf")
    by_epoch = [
        *(
            "loss/total",
            "loss/data",
            "loss/prior",
            "loss/beside",
            "loss_held_out/data",
            "share_of_force/rigid_body",
        ),
        *("optimum/objective_above_least", "optimum/distance"),
        *("training/learning_rate", "training/samples_per_second"),
    ]
    charts = [f"error_{kind}_{name}" for kind in ("relative", "rms") for name in ("train", "test")]
    evaluated = [f"training_{chart}/{group}" for chart in charts for group in ROW_GROUPS]
    evaluated += [f"training_smallest_eigenvalue/{name}" for name in robot.body_names]
    # the log is too short to leave folds of it out
    judged = [f"{chart}/{group}" for chart in charts for group in ERROR_GROUPS]
    judged += [f"smallest_eigenvalue/{name}" for name in robot.body_names]
    known = [f"{body}.{name}" for body, name in identified(run)]
    assert len(known) > 20
    evaluated += [f"training_parameter{end}/{name}" for end in ("", "_lower", "_upper") for name in known]
    judged += [f"parameter/{name}" for name in known]
    assert set(events.Tags()["scalars"]) == {*by_epoch, *evaluated, *judged, "identifiability/singular_value"}
    for tags, expected in ((by_epoch, BY_EPOCH), (evaluated, EVALUATED), (judged, [0, EPOCHS])):
        for tag in tags:
            assert steps(events, tag) == expected
    for tag in ("loss/data", "loss_held_out/data", "training_error_relative_test/nullspace", "optimum/distance"):
        values = [event.value for event in events.Scalars(tag)]
        unseen = tag in ("loss_held_out/data", "training_error_relative_test/nullspace")  # little, after 240 samples
        assert values[-1] < (0.97 if unseen else 0.9) * values[0], tag
    total = [event.value for event in events.Scalars("loss/total")]
    terms = ("data", "prior", "beside")
    parts = zip(*([event.value for event in events.Scalars(f"loss/{term}")] for term in terms), strict=True)
    assert total == pytest.approx([sum(pair) for pair in parts], rel=1e-6)
    assert set(events.Tags()["images"]) == {f"figure_{k}_{name}" for k, name in enumerate(OF_A_RUN, 1)}
    (text,) = events.Tensors("config/text_summary")
    assert b"checkpoint_seconds: 0" in text.tensor_proto.string_val[0]


# -------------------------------------------------------------------------------------------------------- being stopped


def killed(server: Commands, arguments: list[str], output: Path, after: float) -> int:
    """The exit status of a command that is killed so many seconds after a checkpoint that is not there yet."""
    checkpoint = training_of(output) / CHECKPOINT
    before = checkpoint.stat().st_mtime_ns if checkpoint.exists() else None
    child = server.start(arguments)
    deadline = time.monotonic() + 60.0
    while not checkpoint.exists() or checkpoint.stat().st_mtime_ns == before:
        assert time.monotonic() < deadline
        time.sleep(0.002)
    time.sleep(after)
    os.kill(child, signal.SIGKILL)
    time.sleep(1.0 - time.time() % 1.0)  # event files of several processes sort by the second they were made in
    return server.end(child).status


def test_a_run_killed_at_any_moments_ends_as_if_it_had_not_been(
    experiment: Path, run: Path, server: Commands, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output, plain = tmp_path / "runs" / "run", Trainer.run_epoch

    def slowly(trainer: Trainer) -> Any:
        time.sleep(0.1)  # or it is done before this process, on a busy machine, has killed it
        return plain(trainer)

    monkeypatch.setattr(Trainer, "run_epoch", slowly)
    output.parent.mkdir()
    draw, arguments = random.Random(0), command(experiment, output)
    for _ in range(2):
        assert killed(server, arguments, output, draw.uniform(0.0, 0.1)) == -signal.SIGKILL
        assert not output.exists()
        assert {path.name.split(".out")[0] for path in training_of(output).iterdir()} <= {
            *("config.yaml", CHECKPOINT, f".{CHECKPOINT}", "events", "manifest.json"),
        }
        assert load_checkpoint(training_of(output))["trainer"]["epoch"] < EPOCHS
        arguments = command(experiment, output, "--resume")
    monkeypatch.undo()
    assert main(arguments) == 0
    assert_as_uninterrupted(output, run)


@pytest.mark.parametrize("number", study_but([signal.SIGTERM], [signal.SIGINT, signal.SIGTERM]))
def test_a_signal_ends_a_training_with_a_line_on_how_to_go_on(
    experiment: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], number: int
) -> None:
    output = tmp_path / "runs" / "run"
    with pytest.MonkeyPatch.context() as monkeypatch:
        stopped_in(7, monkeypatch, interrupt(number))
        assert main(command(experiment, output)) == 1
    printed = capsys.readouterr()
    assert printed.err == "torchid: interrupted in epoch 6. Use --resume to continue after epoch 6.\n"
    assert printed.out == ""
    assert not output.exists()
    assert main(command(experiment, output, "--resume")) == 0
    assert_as_uninterrupted(output, run)


def test_what_came_after_the_last_checkpoint_is_done_again(
    experiment: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also if a resumed training is interrupted before its first checkpoint."""
    output, seldom = tmp_path / "runs" / "run", "estimator.training.checkpoint_seconds=1000"
    for resume, epoch, saved in (((), 5, 0), (("--resume",), 8, 0)):
        with pytest.MonkeyPatch.context() as monkeypatch:
            stopped_in(epoch, monkeypatch, interrupt())
            assert main(command(experiment, output, seldom, *resume)) == 1
        expected = f"torchid: interrupted in epoch {epoch - 1}. Use --resume to continue after epoch {saved}.\n"
        assert capsys.readouterr().err == expected
    assert main(command(experiment, output, seldom, "--resume")) == 0
    assert_as_uninterrupted(output, run)


def test_an_interrupt_while_results_are_written_loses_nothing_of_the_training(
    experiment: Path, run: Path, output: Path
) -> None:
    def stopped(*_: object, **__: object) -> None:
        signal.raise_signal(signal.SIGINT)

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("torchid.commands.run_folder.write_json", stopped)
        assert main(command(experiment, output, "--resume")) == 1
    assert names_in(output.parent) == ["run.training"]
    assert load_checkpoint(training_of(output))["trainer"]["epoch"] == EPOCHS
    assert main(command(experiment, output, "--resume")) == 0
    assert_as_uninterrupted(output, run)
