"""A descent as a run: curves, checkpoints, and going on after whatever stopped it as if nothing had."""

from __future__ import annotations

import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from matplotlib.figure import Figure
from refusals import files_in, refusal
from repository import DEMO
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.summary.writer import event_file_writer

import torchid
from torchid import parameters
from torchid.cli import main
from torchid.commands.training import CHECKPOINT, load_checkpoint, save_checkpoint
from torchid.config import load_config
from torchid.errors import InputError
from torchid.estimators import Trainer
from torchid.estimators.least_squares import VERDICTS
from torchid.problem.linear import parameter_scale
from torchid.problem.metrics import ERROR_GROUPS, ROW_GROUPS, WHITENED

EPOCHS, EVERY = 16, 5
FIGURES = ("draw_forces", "error_figure", "parameter_figure", "identifiability_figure", "contribution_figure")
EVALUATED = sorted({*range(0, EPOCHS + 1, EVERY), EPOCHS})
BY_EPOCH = list(range(1, EPOCHS + 1))


@pytest.fixture(scope="module", autouse=True)
def _event_files_in_order() -> Iterator[None]:
    """Event files of one second and one process sort by a number that is not padded, so that 10 comes before 9."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(event_file_writer, "_global_uid", event_file_writer.AtomicCounter(1000))
        yield


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo shortened, with held-out samples, trained by mini-batches; a checkpoint after every epoch."""
    folder = tmp_path_factory.mktemp("training") / "experiment"
    folder.mkdir()
    shutil.copy(DEMO / "quadruped.urdf", folder)
    for name, log, part in (
        ("train", "sway_train", slice(0, 240)),
        ("held_out", "sway_train", slice(700, 800)),
        ("test", "sway_test", slice(0, 100)),
    ):
        with np.load(DEMO / f"{log}.npz") as file:
            fields = {key: x if key.endswith("names") else x[part] for key, x in file.items()}
        np.savez(folder / f"{name}.npz", **fields)
    settings = yaml.safe_load((DEMO / "quadruped.yaml").read_text())
    settings["logs"] = {"train": ["train.npz"], "validation": ["held_out.npz"], "test": ["test.npz"]}
    training: dict[str, Any] = {"epochs": EPOCHS, "batch_size": 64, "evaluate_every": EVERY, "checkpoint_seconds": 0}
    training |= {"optimizer": {"name": "Adam", "lr": 0.05}, "schedule": {"name": "CosineAnnealingLR"}}
    settings["estimator"] = {"name": "sgd", "ridge": 0.001, "training": training}
    (folder / "experiment.yaml").write_text(yaml.safe_dump(settings))
    return folder


@pytest.fixture(scope="module")
def run(experiment: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the experiment, never interrupted."""
    output = tmp_path_factory.mktemp("runs") / "whole"
    assert main(["identify", str(experiment / "experiment.yaml"), f"output={output}"]) == 0
    return output


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are empty: drawing them is most of the time of so short a run."""
    for name in FIGURES:
        monkeypatch.setattr(f"torchid.commands.results.{name}", lambda *_: Figure())


def command(experiment: Path, output: Path, *more: str) -> list[str]:
    return ["identify", str(experiment / "experiment.yaml"), f"output={output}", *more]


def training_of(output: Path) -> Path:
    return output.with_name(f"{output.name}.training")


def stopped_in(epoch: int, monkeypatch: pytest.MonkeyPatch, by: Callable[[], object]) -> pytest.MonkeyPatch:
    """Let something happen when an epoch begins."""
    plain_epoch = Trainer.run_epoch

    def run_epoch(trainer: Trainer) -> Any:
        if trainer.epoch + 1 == epoch:
            by()
        return plain_epoch(trainer)

    monkeypatch.setattr(Trainer, "run_epoch", run_epoch)
    return monkeypatch


def interrupt(number: int = signal.SIGINT) -> Callable[[], None]:
    return lambda: signal.raise_signal(number)


@pytest.fixture(scope="module")
def unfinished(experiment: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What was left of a training that was interrupted in epoch 9."""
    output = tmp_path_factory.mktemp("interrupted") / "run"
    with pytest.MonkeyPatch.context() as monkeypatch:
        stopped_in(9, monkeypatch, interrupt())
        assert main(command(experiment, output)) == 1
    assert not output.exists()
    return training_of(output)


@pytest.fixture
def output(unfinished: Path, tmp_path: Path) -> Path:
    """A place for a run, with a copy of the unfinished training beside it."""
    output = tmp_path / "runs" / "run"
    shutil.copytree(unfinished, training_of(output))
    return output


def events_in(folder: Path) -> EventAccumulator:
    events = EventAccumulator(str(folder), size_guidance={"images": 0, "scalars": 0, "tensors": 0})
    events.Reload()
    return events


def steps(events: EventAccumulator, tag: str) -> list[int]:
    return [event.step for event in events.Scalars(tag)]


def assert_as_uninterrupted(output: Path, run: Path) -> None:
    """The same results to the last byte, the same curves, no step twice or missing, and all beside them gone."""
    for name in ("parameters.json", "identified.urdf"):
        assert (output / name).read_bytes() == (run / name).read_bytes()
    found, expected = (json.loads((folder / "metrics.json").read_text()) for folder in (output, run))
    assert found | {"seconds": None} == expected | {"seconds": None}
    assert [path.name for path in output.parent.iterdir()] == [output.name]
    curves, whole = events_in(output), events_in(run)
    assert curves.Tags()["scalars"] == whole.Tags()["scalars"]
    for tag in whole.Tags()["scalars"]:
        values = {event.step: event.value for event in whole.Scalars(tag)}
        assert steps(curves, tag) == steps(whole, tag)
        if tag != "descent/samples_per_second":
            assert all(event.value == values[event.step] for event in curves.Scalars(tag))


# ----------------------------------------------------------------------------------------------------- what is written


def test_the_run_folder_is_that_of_any_run_and_nothing_is_left_beside_it(run: Path) -> None:
    names = {"events" if path.name.startswith("events") else path.name for path in run.iterdir()}
    figures = {"forces.png", "errors.png", "parameters.png", "identifiability.png", "contributions.png"}
    results = {"config.yaml", "parameters.json", "metrics.json", "identified.urdf", "manifest.json"}
    assert names == {"events", "hparams", *results, *figures}
    assert list(run.parent.iterdir()) == [run]
    assert load_config(run / "config.yaml").estimator.training.epochs == EPOCHS


def test_metrics_and_parameters_are_those_of_the_best_epoch(run: Path) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    groups = ("joint_torque_rms", "joint_torque_rms_by_joint", "base_force_rms", "base_moment_rms", "nullspace_rms")
    groups += ("projected_residual",)
    for name in ("train", "test"):
        assert set(metrics[name]) == {*groups, *(f"{group}_relative" for group in groups)}
        for group in ("joint_torque_rms", "base_force_rms", "base_moment_rms", "nullspace_rms"):
            assert metrics[name][group] < metrics[f"{name}_nominal"][group]
    held_out = {event.step: event.value for event in events_in(run).Scalars("loss_held_out/data")}
    best = min(held_out, key=lambda step: held_out[step])
    assert metrics["solution"]["epochs"] == EPOCHS
    assert metrics["solution"]["best_epoch"] == best
    least = {event.step: event.value for event in events_in(run).Scalars("closed_form/objective_above_least")}
    above = metrics["solution"]["objective"] / metrics["solution"]["unconstrained"] - 1.0
    assert above == pytest.approx(least[best], rel=1e-6)
    robot = torchid.load_robot(DEMO / "quadruped.urdf")
    bodies = json.loads((run / "parameters.json").read_text())["bodies"]
    phi = np.array([list(body["identified"].values()) for body in bodies])
    least_eigenvalues = parameters.least_eigenvalues(phi.ravel(), parameter_scale(robot.nominal).ravel())
    assert metrics["smallest_eigenvalue"] == pytest.approx(dict(zip(robot.body_names, least_eigenvalues, strict=True)))
    assert least_eigenvalues.min() > 1e-4
    assert phi[1:, 10:].min() > 0.0


def test_curves_say_everything_by_epoch_and_show_train_and_unseen_logs(run: Path) -> None:
    events, robot = events_in(run), torchid.load_robot(DEMO / "quadruped.urdf")
    by_epoch = [
        *("loss/total", "loss/data", "loss/prior", "loss_held_out/data", "share_of_force/rigid_body"),
        *("closed_form/objective_above_least", "closed_form/distance"),
        *("descent/learning_rate", "descent/samples_per_second"),
    ]
    evaluated = [f"{kind}_error_{name}/{group}" for kind in ("relative", "rms") for name in ("train", "test")
                 for group in ROW_GROUPS]  # fmt: skip
    # the log is too short to leave folds of it out
    judged = [f"{kind}_error_{name}/{WHITENED}" for kind in ("relative", "rms") for name in ("train", "test")]
    evaluated += [f"eigenvalue/{name}" for name in robot.body_names]
    once = ["fit/residual_std", "fit/rank", "fit/condition_number", "identifiability/bits"]
    once += ["identifiability/combinations", *(f"verdicts/{verdict}" for verdict in VERDICTS)]
    assert set(events.Tags()["scalars"]) == {*by_epoch, *evaluated, *judged, *once, "identifiability/singular_value"}
    for tags, expected in ((by_epoch, BY_EPOCH), (evaluated, EVALUATED), (judged, [0, EPOCHS]), (once, [EPOCHS])):
        for tag in tags:
            assert steps(events, tag) == expected
    for tag in ("loss/data", "loss_held_out/data", "relative_error_test/nullspace", "closed_form/distance"):
        values = [event.value for event in events.Scalars(tag)]
        assert values[-1] < 0.8 * values[0]
    total = [event.value for event in events.Scalars("loss/total")]
    parts = zip(*([event.value for event in events.Scalars(f"loss/{term}")] for term in ("data", "prior")), strict=True)
    assert total == pytest.approx([sum(pair) for pair in parts], rel=1e-6)
    assert set(events.Tags()["images"]) == {"forces", "errors", "parameters", "identifiability", "contributions"}
    (text,) = events.Tensors("config/text_summary")
    assert b"checkpoint_seconds: 0" in text.tensor_proto.string_val[0]


def test_hyperparameters_stand_beside_the_final_errors(run: Path) -> None:
    events = events_in(run / "hparams")
    tags = set(events.Tags()["scalars"])
    assert {f"final/{name}_{group}" for name in ("train", "test") for group in ROW_GROUPS} <= tags
    metrics = json.loads((run / "metrics.json").read_text())
    (found,) = events.Scalars("final/test_nullspace")
    assert found.value == pytest.approx(metrics["test"]["nullspace_rms_relative"], rel=1e-6)
    (start,) = (summary for name, summary in events.summary_metadata.items() if name == "_hparams_/session_start_info")
    for name in (b"optimizer", b"Adam", b"CosineAnnealingLR", b"batch_size", b"consistency", b"log_cholesky"):
        assert name in start.plugin_data.content


def test_custom_charts_show_training_and_unseen_logs_together(run: Path) -> None:
    events = events_in(run)
    layout = layout_pb2.Layout()
    layout.ParseFromString(events.Tensors("custom_scalars__config__")[0].tensor_proto.string_val[0])
    charts = {chart.title: list(chart.multiline.tag) for category in layout.category for chart in category.chart}
    for group in ERROR_GROUPS:
        assert charts[group] == [f"relative_error_{name}/{group}" for name in ("train", "test", "left_out")]
    assert charts["train and held out"] == ["loss/data", "loss_held_out/data"]
    tags = events.Tags()["scalars"]
    for title, patterns in charts.items():
        shown = [tag for tag in tags if any(re.match(pattern, tag) for pattern in patterns)]
        assert len(shown) >= 2, f"{title} shows nothing"
    bodies = torchid.load_robot(DEMO / "quadruped.urdf").body_names
    assert len(charts["smallest eigenvalue"]) == len(bodies)


# -------------------------------------------------------------------------------------------------------- being stopped

SERVER = """
import os, sys, time
from matplotlib.figure import Figure
import torchid.commands.results as results
from torchid.cli import main
from torchid.estimators import Trainer
for name in {figures}:
    setattr(results, name, lambda *_: Figure())
plain = Trainer.run_epoch
Trainer.run_epoch = lambda trainer: time.sleep(0.03) or plain(trainer)  # or a fast machine is done before it is killed
print("ready", flush=True)
for line in sys.stdin:
    child = os.fork()
    if not child:
        os._exit(main(line.rstrip("\\n").split("\\t")))
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@pytest.fixture(scope="module")
def server() -> Iterator[subprocess.Popen[str]]:
    """A process that has everything loaded and runs a command in a child for every line it reads."""
    code = SERVER.format(figures=FIGURES)
    with subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield process
        process.stdin.close()


def killed(server: subprocess.Popen[str], arguments: list[str], output: Path, after: float) -> int:
    """The exit status of a command that is killed so many seconds after a checkpoint that is not there yet."""
    checkpoint = training_of(output) / CHECKPOINT
    before = checkpoint.stat().st_mtime_ns if checkpoint.exists() else None
    server.stdin.write("\t".join(arguments) + "\n")
    server.stdin.flush()
    child = int(server.stdout.readline())
    deadline = time.monotonic() + 60.0
    while not checkpoint.exists() or checkpoint.stat().st_mtime_ns == before:
        assert time.monotonic() < deadline
        time.sleep(0.002)
    time.sleep(after)
    os.kill(child, signal.SIGKILL)
    time.sleep(1.0 - time.time() % 1.0)  # event files of several processes sort by the second they were made in
    while not (line := server.stdout.readline()).startswith(("-", "0", "1", "2")):  # tables of a run that was done
        pass
    return int(line)


@pytest.mark.usefixtures("plain")
def test_a_run_killed_at_any_moments_ends_as_if_it_had_not_been(
    experiment: Path, run: Path, server: subprocess.Popen[str], tmp_path: Path
) -> None:
    output = tmp_path / "runs" / "run"
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
    assert main(arguments) == 0
    assert_as_uninterrupted(output, run)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.usefixtures("plain")
def test_a_signal_ends_a_training_with_a_line_on_how_to_go_on(
    experiment: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], number: int
) -> None:
    output = tmp_path / "runs" / "run"
    with pytest.MonkeyPatch.context() as monkeypatch:
        stopped_in(7, monkeypatch, interrupt(number))
        assert main(command(experiment, output)) == 1
    printed = capsys.readouterr()
    assert printed.err == "torchid: interrupted in epoch 6; --resume goes on after epoch 6\n"
    assert printed.out == ""
    assert not output.exists()
    assert main(command(experiment, output, "--resume")) == 0
    assert_as_uninterrupted(output, run)


@pytest.mark.usefixtures("plain")
def test_what_came_after_the_last_checkpoint_is_done_again(
    experiment: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also if a resumed training is interrupted before its first checkpoint."""
    output, seldom = tmp_path / "runs" / "run", "estimator.training.checkpoint_seconds=1000"
    for resume, epoch, saved in (((), 5, 0), (("--resume",), 8, 0)):
        with pytest.MonkeyPatch.context() as monkeypatch:
            stopped_in(epoch, monkeypatch, interrupt())
            assert main(command(experiment, output, seldom, *resume)) == 1
        expected = f"torchid: interrupted in epoch {epoch - 1}; --resume goes on after epoch {saved}\n"
        assert capsys.readouterr().err == expected
    assert main(command(experiment, output, seldom, "--resume")) == 0
    assert_as_uninterrupted(output, run)


@pytest.mark.usefixtures("plain")
def test_an_interrupt_before_the_first_checkpoint_leaves_nothing_in_the_way(
    experiment: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "runs" / "run"
    with pytest.MonkeyPatch.context() as context:
        context.setattr("torchid.commands.training.save_checkpoint", lambda *_: signal.raise_signal(signal.SIGINT))
        assert main(command(experiment, output)) == 1
    assert capsys.readouterr().err == "torchid: interrupted in epoch 0; --resume goes on after epoch 0\n"
    monkeypatch.setattr(Trainer, "finished", True)  # what matters is that it starts
    assert main(command(experiment, output, "--resume")) == 0
    assert "no checkpoint to go on from; training starts at the beginning" in capsys.readouterr().err
    assert [path.name for path in output.parent.iterdir()] == ["run"]


def test_an_interrupt_while_results_are_written_loses_nothing_of_the_training(
    experiment: Path, run: Path, output: Path, plain: None
) -> None:
    def stopped(*_: object, **__: object) -> None:
        signal.raise_signal(signal.SIGINT)

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("torchid.commands.results.write_json", stopped)
        assert main(command(experiment, output, "--resume")) == 1
    assert [path.name for path in output.parent.iterdir()] == ["run.training"]
    assert load_checkpoint(training_of(output))["trainer"]["epoch"] == EPOCHS
    assert main(command(experiment, output, "--resume")) == 0
    assert_as_uninterrupted(output, run)


# ---------------------------------------------------------------------------------------------------- what cannot go on


def resume_refused(experiment: Path, output: Path, capsys: pytest.CaptureFixture[str], *more: str) -> str:
    return refusal(command(experiment, output, "--resume", *more), output.parent, capsys)


@pytest.mark.parametrize(
    ("override", "place", "found"),
    [
        ("estimator.training.optimizer.lr=0.1", "estimator.training.optimizer.lr", "0.1, but the checkpoint has 0.05"),
        ("estimator.training.epochs=30", "estimator.training.epochs", f"30, but the checkpoint has {EPOCHS}"),
        ("sensors=full", "sensors.set", "full, but the checkpoint has joints"),
        ("estimator.training.schedule=null", "estimator.training.schedule", "None, but the checkpoint has"),
        ("logs.test=[]", "logs.test", "[], but the checkpoint has"),
    ],
)
def test_other_settings_are_not_gone_on_with(
    experiment: Path, output: Path, capsys: pytest.CaptureFixture[str], override: str, place: str, found: str
) -> None:
    line = resume_refused(experiment, output, capsys, override)
    assert f"experiment.yaml: {place}: {found}" in line
    assert line.endswith("accepted: the same settings")


def test_other_logs_are_not_gone_on_with(
    experiment: Path, output: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other"
    shutil.copytree(experiment, other)
    with np.load(other / "train.npz") as file:
        fields = dict(file)
    fields["joint_torque"] = fields["joint_torque"] * (1.0 + 1e-6)
    np.savez(other / "train.npz", **fields)
    shutil.move(experiment / "train.npz", tmp_path / "kept.npz")
    try:
        shutil.copy(other / "train.npz", experiment / "train.npz")
        line = resume_refused(experiment, output, capsys)
    finally:
        shutil.move(tmp_path / "kept.npz", experiment / "train.npz")
    assert "experiment.yaml: logs: not those of the checkpoint; accepted: the same files, unchanged" in line


def test_a_finished_run_is_not_gone_on_with(experiment: Path, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = resume_refused(experiment, run, capsys)
    assert f"{run}: --resume: a finished run; accepted: an unfinished one, or overwrite=true" in line


@pytest.mark.parametrize("name", ["least_squares", "consistent"])
def test_what_is_done_in_one_go_is_not_gone_on_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    arguments = ["identify", str(DEMO / "quadruped.yaml"), f"estimator.name={name}", f"output={tmp_path / 'run'}"]
    line = refusal([*arguments, "--resume"], tmp_path, capsys)
    assert f"quadruped.yaml: --resume: {name}, which is done in one go; accepted: estimator.name: sgd" in line


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda content: b"",
    "last byte missing": lambda content: content[:-1],
    "one bit of a number": lambda content: _flipped(content, len(content) // 3),
    "one bit near the start": lambda content: _flipped(content, 700),
}


def _flipped(content: bytes, place: int) -> bytes:
    return content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :]


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_not_gone_on_with(
    experiment: Path, output: Path, capsys: pytest.CaptureFixture[str], damage: str
) -> None:
    path = training_of(output) / CHECKPOINT
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    line = resume_refused(experiment, output, capsys)
    assert f"{path}: file: not readable (" in line
    assert line.endswith("accepted: a checkpoint that torchid wrote")


@pytest.mark.parametrize("state", [{"trainer": {}}, [1, 2]], ids=str)
def test_a_file_of_tensors_that_is_no_checkpoint_is_not_gone_on_with(
    experiment: Path, output: Path, capsys: pytest.CaptureFixture[str], state: Any
) -> None:
    torch.save(state, training_of(output) / CHECKPOINT)
    assert f"{training_of(output) / CHECKPOINT}: file: " in resume_refused(experiment, output, capsys)


@pytest.mark.parametrize("epoch", [10**9, -5])
def test_an_epoch_edited_by_hand_is_not_gone_on_from(
    experiment: Path, output: Path, capsys: pytest.CaptureFixture[str], epoch: int
) -> None:
    folder = training_of(output)
    state = load_checkpoint(folder)
    state["trainer"]["epoch"] = epoch
    save_checkpoint(folder, state)
    line = resume_refused(experiment, output, capsys)
    assert f"{folder / CHECKPOINT}: file: " in line
    assert f"epoch: found {epoch}; accepted: a whole number from 0 to {EPOCHS}" in line
    torch.save(state, folder / CHECKPOINT)
    assert "not the values that were written" in resume_refused(experiment, output, capsys)


def test_a_full_disk_is_told_as_such_and_leaves_the_last_checkpoint(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, {"epoch": 1})
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))  # what a file may hold; longer ones fail as on a disk
    try:
        with pytest.raises(OSError, match="File too large") as raised:
            save_checkpoint(tmp_path, {"epoch": 2, "x": torch.zeros(1000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert raised.value.filename == str(tmp_path / CHECKPOINT)
    assert load_checkpoint(tmp_path) == {"epoch": 1}
    assert [path.name for path in tmp_path.iterdir()] == [CHECKPOINT]


def test_whatever_bit_of_a_checkpoint_flips_it_is_refused_or_says_the_same(tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    numbers = torch.randn(300, generator=generator, dtype=torch.float64)
    save_checkpoint(tmp_path, {"config": "a: 1", "trainer": {"x": numbers, "epoch": 3}})
    path, draw = tmp_path / CHECKPOINT, random.Random(0)
    content, read = path.read_bytes(), 0
    for _ in range(300):
        place = draw.randrange(len(content))
        path.write_bytes(content[:place] + bytes([content[place] ^ (1 << draw.randrange(8))]) + content[place + 1 :])
        with suppress(InputError):
            state = load_checkpoint(tmp_path)
            read += 1
            assert torch.equal(state["trainer"]["x"], numbers)
            assert (state["config"], state["trainer"]["epoch"]) == ("a: 1", 3)
    assert read < 250, "some bits are only padding, but not most"


# ----------------------------------------------------------------------------------------------------- what is replaced


@pytest.mark.usefixtures("plain")
def test_a_run_stays_as_it_is_until_the_one_that_replaces_it_is_complete(
    experiment: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "runs" / "run"
    shutil.copytree(run, output)
    before = files_in(output)
    with pytest.MonkeyPatch.context() as monkeypatch:
        stopped_in(4, monkeypatch, interrupt())
        assert main(command(experiment, output, "overwrite=true")) == 1
    assert files_in(output) == before
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("json.dumps", _full_disk)
        assert main(command(experiment, output, "overwrite=true", "--resume")) == 1
    assert "No space left" in capsys.readouterr().err
    assert files_in(output) == before
    assert sorted(path.name for path in output.parent.iterdir()) == ["run", "run.training"]
    refusal(command(experiment, output, "--resume"), output.parent, capsys)
    assert main(command(experiment, output, "overwrite=true", "--resume")) == 0
    assert_as_uninterrupted(output, run)


def _full_disk(*_: object, **__: object) -> None:
    raise OSError(28, "No space left on device")


def test_an_unfinished_training_is_not_overwritten_unless_asked_for(
    experiment: Path, output: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = refusal(command(experiment, output), output.parent, capsys)
    assert f"{training_of(output)}: output: an unfinished training; accepted: --resume, overwrite=true" in line


@pytest.mark.usefixtures("plain")
def test_an_unfinished_training_is_begun_anew_if_asked_for(
    experiment: Path, output: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = ("overwrite=true", "estimator.training.epochs=1", "estimator.training.seed=3")
    assert main(command(experiment, output, *more)) == 0
    assert steps(events_in(output), "loss/data") == [1], "nothing of the old curves"
    assert [path.name for path in output.parent.iterdir()] == ["run"]


@pytest.mark.parametrize("more", [(), ("overwrite=true",), ("--resume",)], ids=["plain", "overwrite", "resume"])
def test_a_folder_of_that_name_that_is_no_training_stays(
    experiment: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...]
) -> None:
    output = tmp_path / "runs" / "run"
    training_of(output).mkdir(parents=True)
    (training_of(output) / "notes.txt").write_text("mine")
    assert "holds notes.txt, and no manifest.json that says that torchid wrote a training" in refusal(
        command(experiment, output, *more), tmp_path, capsys
    )


@pytest.mark.usefixtures("plain")
def test_a_descent_that_diverges_ends_in_one_line_and_is_not_in_the_way_of_the_next(
    experiment: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its curves stay until then."""
    output = tmp_path / "runs" / "run"
    assert main(command(experiment, output, "estimator.training.optimizer.lr=1e9")) == 2
    printed = capsys.readouterr()
    (line,) = printed.err.splitlines()
    assert line.startswith("torchid: estimator: training: a loss of ")
    assert line.endswith("; accepted: a smaller lr")
    assert printed.out == ""
    assert [path.name for path in output.parent.iterdir()] == ["run.training"]
    assert {path.name.split(".")[0] for path in training_of(output).iterdir()} == {"config", "events", "manifest"}
    assert main(command(experiment, output, "estimator.training.epochs=1")) == 0
    assert [path.name for path in output.parent.iterdir()] == ["run"]


def test_nothing_to_learn_is_noticed_before_anything_is_written(
    experiment: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bodies = ", ".join(torchid.load_robot(DEMO / "quadruped.urdf").body_names)
    line = refusal(command(experiment, tmp_path / "run", f"estimator.frozen=[{bodies}]"), tmp_path, capsys)
    assert "experiment.yaml: sensors: no parameter is in reach of them" in line


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("estimator.training.optimizer.name=Adm", "estimator.training.optimizer: unknown name 'Adm'; accepted: Adam, "),
        ("estimator.training.optimizer.rate=1", "estimator.training.optimizer Adam: "),
        ("estimator.training.schedule.T_min=3", "estimator.training.schedule CosineAnnealingLR: "),
        ("estimator.frozen=[trunc]", "estimator.frozen: unknown name 'trunc'; accepted: trunk"),
    ],
)
def test_a_slip_in_the_settings_of_a_descent_is_named_before_anything_is_written(
    experiment: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], override: str, expected: str
) -> None:
    line = refusal(command(experiment, tmp_path / "run", override), tmp_path, capsys)
    assert f"experiment.yaml: {expected}" in line


@pytest.mark.usefixtures("plain")
def test_overrides_may_come_before_and_after_options_and_strangers_are_refused(
    experiment: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As they stand in `torchid identify FILE --resume overwrite=true`, where argparse takes them for strangers."""
    place, once = f"output={tmp_path / 'run'}", "estimator.training.epochs=1"
    assert main(["identify", str(experiment / "experiment.yaml"), once, "--resume", place, "--debug"]) == 0
    assert load_config(tmp_path / "run" / "config.yaml").estimator.training.epochs == 1
    for stranger in (["identify", "a.yaml", "--resume", "--hurry"], ["evaluate", "run", "--log", "a.npz", "b=1"]):
        with pytest.raises(SystemExit) as raised:
            main(stranger)
        assert raised.value.code == 2
        assert f"unrecognized arguments: {stranger[-1]}" in capsys.readouterr().err
