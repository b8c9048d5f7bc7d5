"""What a training refuses to go on with or to replace."""

from __future__ import annotations

import resource
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import files_in, refusal
from repository import DEMO
from run_folders import names_in
from trainings import (
    EPOCHS,
    assert_as_uninterrupted,
    command,
    interrupt,
    stopped_in,
    training_of,
)

import torchid
from torchid.cli import main
from torchid.commands.folder import CHECKPOINT
from torchid.commands.training import load_checkpoint, save_checkpoint
from torchid.config import load_config

pytestmark = pytest.mark.usefixtures("events")


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
    assert "experiment.yaml: logs: differ from those of the checkpoint; accepted: the same files, unchanged" in line


@pytest.mark.parametrize("name", ["least_squares", "consistent"])
def test_what_is_done_in_one_go_is_not_gone_on_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    arguments = ["identify", str(DEMO / "quadruped.yaml"), f"estimator.name={name}", f"output={tmp_path / 'run'}"]
    line = refusal([*arguments, "--resume"], tmp_path, capsys)
    assert f"quadruped.yaml: --resume: {name} has nothing to resume; accepted: estimator.name: sgd" in line


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
    assert line.endswith("accepted: a checkpoint written by torchid")


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


# ----------------------------------------------------------------------------------------------------- what is replaced


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
    assert names_in(output.parent) == ["run", "run.training"]
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


def test_a_descent_that_diverges_ends_in_one_line_and_is_not_in_the_way_of_the_next(
    experiment: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its curves stay until then."""
    output = tmp_path / "runs" / "run"
    assert main(command(experiment, output, "estimator.training.optimizer.lr=1e9")) == 2
    printed = capsys.readouterr()
    (line,) = printed.err.splitlines()
    assert line.startswith("torchid: estimator: training: diverged: loss ")
    assert line.endswith("; accepted: a smaller lr")
    assert printed.out == ""
    assert names_in(output.parent) == ["run.training"]
    assert {path.name.split(".")[0] for path in training_of(output).iterdir()} == {"config", "events", "manifest"}
    assert main(command(experiment, output, "estimator.training.epochs=1")) == 0
    assert names_in(output.parent) == ["run"]


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


def test_a_finished_run_is_not_gone_on_with(experiment: Path, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = resume_refused(experiment, run, capsys)
    assert f"{run}: --resume: a finished run; accepted: an unfinished one, or overwrite=true" in line


def test_an_epoch_that_cannot_be_is_not_gone_on_from(
    experiment: Path, output: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = training_of(output)
    state = load_checkpoint(folder)
    state["trainer"]["epoch"] = -5
    save_checkpoint(folder, state)
    line = resume_refused(experiment, output, capsys)
    assert f"{folder / CHECKPOINT}: file: " in line
    assert f"epoch: found -5; accepted: a whole number from 0 to {EPOCHS}" in line


def test_nothing_to_learn_is_noticed_before_anything_is_written(
    experiment: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bodies = ", ".join(torchid.load_robot(DEMO / "quadruped.urdf").body_names)
    line = refusal(command(experiment, tmp_path / "run", f"estimator.frozen=[{bodies}]"), tmp_path, capsys)
    assert "experiment.yaml: sensors: they determine no parameter" in line


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


def test_an_option_that_is_a_setting_of_the_file_is_written_as_one(capsys: pytest.CaptureFixture[str]) -> None:
    for option, setting in (("--output=runs/a", "output"), ("--robot.base-link=trunk", "robot.base_link")):
        with pytest.raises(SystemExit):
            main(["identify", "a.yaml", option])
        assert capsys.readouterr().err.rstrip().endswith(f"; accepted: settings of the file as {setting}=VALUE")
