"""What a folder of results may replace: files that torchid wrote, as it wrote them, and nothing else of anybody."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path

import pytest
from hostile_commands import Commands
from refusals import refusal
from run_folders import Add, a_run, everything, names_in, write

from torchid.cli import main
from torchid.commands.folder import (
    EVALUATION,
    MANIFEST,
    RUN,
    SIMULATION,
    TRAINING,
    check_free,
    new_folder,
    read_manifest,
    refuse_inputs,
    require_replaceable,
)
from torchid.commands.training import Training
from torchid.errors import ConfigError, TorchidWarning

# --------------------------------------------------------------------------------------------- what others put there


def _text(name: str) -> Add:
    return lambda run: write(run, {name: "mine"})


def _link(name: str) -> Add:
    """A link in place of what the run wrote, which lies elsewhere."""

    def add(run: Path) -> None:
        kept = run.parent / "kept"
        (run / name).rename(kept)
        (run / name).symlink_to(kept)

    return add


def _evaluation_copied(run: Path) -> None:
    shutil.copytree(run / "evaluation" / "log", run / "evaluation" / "kept")


def _run_kept_inside(run: Path) -> None:
    shutil.copytree(run, run.parent / "copy")
    (run.parent / "copy").rename(run / "kept")


FOREIGN: dict[str, tuple[Add, str]] = {
    "notes": (_text("notes.txt"), "notes.txt (not written by torchid)"),
    "notes in an evaluation": (_text("evaluation/log/notes.txt"), "evaluation/log/notes.txt (not written by torchid)"),
    "a hidden file": (_text(".git/config"), ".git/ (not written by torchid)"),
    "a hidden folder of a name like ours": (
        _text(".x-01234567.torchid/notes.txt"),
        ".x-01234567.torchid/ (not written",
    ),
    "an empty folder": (lambda run: (run / "ideas").mkdir(), "ideas/ (not written by torchid)"),
    "a pipe": (lambda run: os.mkfifo(run / "pipe"), "pipe (not written by torchid)"),
    "control characters": (_text("\x1b[2J\n.txt"), r"\x1b[2J\n.txt (not written by torchid)"),
    "edited figures": (_text("metrics.json"), "metrics.json (changed since torchid wrote it)"),
    "a link in place of a file": (_link("metrics.json"), "metrics.json (not written by torchid)"),
    "a link in place of a folder": (_link("hparams"), "hparams (not written by torchid)"),
    "a link in place of the evaluations": (_link("evaluation"), "evaluation (not written by torchid)"),
    "a link in place of the manifest": (_link(MANIFEST), "no manifest.json of a run"),
    "an evaluation that was copied": (_evaluation_copied, "evaluation/kept/ (not written by torchid)"),
    "another run": (_run_kept_inside, "kept/ (not written by torchid)"),
}


@pytest.mark.parametrize(("add", "said"), FOREIGN.values(), ids=FOREIGN)
def test_what_torchid_did_not_write_is_named_and_stays(tmp_path: Path, add: Add, said: str) -> None:
    output = a_run(tmp_path / "run")
    add(output)
    before = everything(tmp_path)
    for _ in range(2):
        with pytest.raises(ConfigError, match=re.escape(said)) as caught:
            check_free(output, True)
        assert len(str(caught.value).splitlines()) == 1
    with pytest.raises(ConfigError, match=re.escape(said)), new_folder(output, True):
        pass
    assert everything(tmp_path) == before


@pytest.mark.parametrize(("add", "said"), [FOREIGN["notes"], FOREIGN["edited figures"]])
def test_what_comes_in_the_way_while_a_run_goes_on_stays_with_the_old_run(tmp_path: Path, add: Add, said: str) -> None:
    output = a_run(tmp_path / "run")
    with pytest.raises(ConfigError, match=re.escape(said)), new_folder(output, True) as new:  # noqa: PT012
        write(new, {"config.yaml": "new"})
        add(output)
        before = everything(tmp_path)
    left = {name for name in everything(tmp_path) if not name.startswith(".run-")}
    assert left == {name for name in before if not name.startswith(".run-")}
    assert [path.name for path in tmp_path.glob(".*")] == []


def test_a_folder_as_torchid_left_it_is_replaced_whole_even_if_files_are_gone(tmp_path: Path) -> None:
    output = a_run(tmp_path / "run")
    (output / "metrics.json").unlink()
    a_run(output, "new")
    assert {path.read_text() for path in output.rglob("*") if path.is_file() and path.name != MANIFEST} == {"new"}
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    require_replaceable(output, RUN)


OTHERS: dict[str, dict[str, str]] = {
    "a run of an older version": {"config.yaml": "x", "parameters.json": "x", "hparams/events.out.tfevents.1": "x"},
    "the manifest of a web page": {"manifest.json": '{"name": "app", "icons": []}'},
    "a manifest cut short": {"manifest.json": '{"torchid": "a run", "files": {'},
    "a manifest nested beyond all bounds": {"manifest.json": "[" * 10**5},
}


@pytest.mark.parametrize("files", OTHERS.values(), ids=OTHERS)
def test_a_folder_without_a_manifest_of_torchid_is_no_run(tmp_path: Path, files: dict[str, str]) -> None:
    write(tmp_path / "run", files)
    before = everything(tmp_path)
    with pytest.raises(ConfigError, match="but no manifest.json of a run; accepted: a new folder"):
        check_free(tmp_path / "run", True)
    assert everything(tmp_path) == before


@pytest.mark.parametrize("place", ["../mine.txt", "{folder}/mine.txt", "link/mine.txt", ".."])
def test_a_manifest_cannot_name_what_lies_elsewhere(tmp_path: Path, place: str) -> None:
    write(tmp_path, {"mine.txt": "mine"})
    output = a_run(tmp_path / "run")
    manifest = read_manifest(output)
    assert manifest is not None
    text = (output / MANIFEST).read_text().replace("metrics.json", place.format(folder=tmp_path))
    (output / "metrics.json").unlink()
    (output / MANIFEST).write_text(text)
    a_run(output, "new")
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_a_folder_of_one_kind_is_not_replaced_by_another(tmp_path: Path) -> None:
    with new_folder(tmp_path / "x", kind=SIMULATION) as folder:
        write(folder, {"logs/a.npz": "x"})
    for kind in (RUN, TRAINING, EVALUATION):
        with pytest.raises(ConfigError, match="contains a simulation; accepted: a new folder"):
            check_free(tmp_path / "x", True, kind)


def test_inputs_are_no_part_of_what_is_replaced(tmp_path: Path) -> None:
    output = a_run(tmp_path / "run")
    (tmp_path / "link").symlink_to(output)
    (tmp_path / "other.json").symlink_to(output / "metrics.json")
    for path in (output / "metrics.json", tmp_path / "link" / "metrics.json", tmp_path / "other.json"):
        with pytest.raises(ConfigError, match="contains the input .*; accepted: another output"):
            check_free(output, True, RUN, [path])
    check_free(output, True, RUN, ["experiment", tmp_path / "elsewhere", tmp_path, tmp_path / "runs"])
    refuse_inputs(tmp_path / "ru", [output / "metrics.json"])


@pytest.mark.skipif(os.getuid() == 0, reason="nothing is closed to root")
def test_a_folder_that_may_not_be_changed_is_refused_before_any_work(tmp_path: Path) -> None:
    output = a_run(tmp_path / "run")
    (output / "hparams").chmod(0o555)
    with pytest.raises(ConfigError, match="hparams .no write permission"):
        check_free(output, True)
    (output / "hparams").chmod(0o755)


# ---------------------------------------------------------------------------------------------------------- commands


@pytest.fixture(scope="module")
def run(place: Path, server: Commands) -> Path:
    """A finished run with an evaluation."""
    output = place / "run"
    assert server.run(["identify", str(place / "demo" / "quadruped.yaml"), f"output={output}"]).status == 0
    for _ in range(2):  # an evaluation replaces one of its name
        assert server.run(["evaluate", str(output), "--log", str(place / "demo" / "sway_test.npz")]).status == 0
    return output


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Path:
    shutil.copytree(run, tmp_path / "run")
    return tmp_path / "run"


def refused(server: Commands, arguments: list[str], folder: Path) -> str:
    before = everything(folder)
    ended = server.run(arguments)
    assert (ended.status, len(ended.said)) == (2, 1), ended
    assert everything(folder) == before
    return ended.said[0]


def test_a_run_lists_every_file_of_its_own(copy: Path, place: Path, server: Commands) -> None:
    manifest = read_manifest(copy)
    assert manifest is not None
    names = {str(path.relative_to(copy)) for path in copy.rglob("*") if path.is_file()}
    evaluation = {name for name in names if name.startswith("evaluation/")}
    assert set(manifest.files) == names - evaluation - {MANIFEST}
    assert len(evaluation) == 7
    assert (
        server.run(["identify", str(place / "demo" / "quadruped.yaml"), f"output={copy}", "overwrite=true"]).status == 0
    )
    assert not (copy / "evaluation").exists()
    assert names_in(copy.parent) == ["run"]


def test_an_evaluation_somebody_wrote_in_is_not_replaced(copy: Path, place: Path, server: Commands) -> None:
    arguments = ["evaluate", str(copy), "--log", str(place / "demo" / "sway_test.npz")]
    (copy / "evaluation" / "sway_test" / "metrics.json").write_text("{}")
    assert "metrics.json (changed since" in refused(server, arguments, copy)
    write(copy, {"evaluation/sway_test/notes.txt": "mine"})
    assert "contains notes.txt (not written by torchid)" in refused(server, arguments, copy)
    (copy / "evaluation").rename(copy.parent / "elsewhere")
    (copy / "evaluation").symlink_to(copy.parent / "elsewhere")
    assert "evaluation: output: a link; accepted: a folder" in refused(server, arguments, copy.parent)


def test_the_end_of_a_training_takes_and_removes_what_is_its_own(tmp_path: Path) -> None:
    training = object.__new__(Training)
    training.folder = tmp_path / "run.training"
    with new_folder(training.folder, kind=TRAINING) as new:
        write(new, {"config.yaml": "old"})
    files = {"checkpoint.pt": "x", "events.out.tfevents.1.host.7.0": "x"}
    write(training.folder, files | {"notes.txt": "mine", "more/checkpoint.pt": "mine"})
    training.copy_curves(tmp_path)
    assert [path.name for path in tmp_path.glob("events*")] == ["events.out.tfevents.1.host.7.0"]
    with pytest.warns(TorchidWarning, match="run.training: not removed, as it has files that torchid did not write"):
        training.remove_checkpoint()
    assert set(everything(training.folder)) == {"notes.txt", "more", "more/checkpoint.pt"}


def test_a_training_does_not_begin_where_somebody_keeps_notes(place: Path, tmp_path: Path, server: Commands) -> None:
    output = tmp_path / "run"
    line = ["identify", str(place / "demo" / "quadruped.yaml"), f"output={output}",
            "estimator={name: sgd, training: {epochs: 3, checkpoint_seconds: 0}}"]  # fmt: skip
    with new_folder(tmp_path / "run.training", kind=TRAINING) as folder:
        write(folder, {"config.yaml": "old"})
    write(tmp_path / "run.training", {"notes.txt": "mine"})
    assert "contains notes.txt (not written by torchid)" in refused(server, line, tmp_path)
    (tmp_path / "run.training").rename(tmp_path / "elsewhere")
    (tmp_path / "run.training").symlink_to(tmp_path / "elsewhere")
    for more in ("overwrite=true", "--resume"):
        assert "run.training: output: a link" in refused(server, [*line, more], tmp_path)
    (tmp_path / "run.training").unlink()
    shutil.rmtree(tmp_path / "elsewhere")
    assert server.run([*line, "--resume"]).status == 0
    assert names_in(tmp_path) == ["run"]


def test_files_are_replaced_only_on_request_and_links_and_inputs_never(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, json_file, figure = tmp_path / "log.npz", tmp_path / "found.json", tmp_path / "found.png"
    shutil.copy(place / "demo" / "sway_test.npz", log)
    given = ["check", str(log), "--json", str(json_file), "--figure", str(figure)]
    write(tmp_path, {"found.json": "mine", "found.png": "mine"})
    assert "found.json: --json: exists; accepted: a new file, or --overwrite" in refusal(given, tmp_path, capsys)
    json_file.unlink()
    assert "found.png: --figure: exists" in refusal(given, tmp_path, capsys)
    assert main([*given, "--overwrite"]) == 0
    assert json.loads(json_file.read_text())
    capsys.readouterr()
    json_file.unlink()
    json_file.symlink_to(figure)
    assert "--json: a link" in refusal([*given, "--overwrite"], tmp_path, capsys)
    (tmp_path / "same.npz").hardlink_to(log)
    for target in (log, tmp_path / "." / "log.npz"):
        assert "this is an input" in refusal(["convert", str(log), str(target), "--overwrite"], tmp_path, capsys)


def test_experiments_never_remove_what_they_read(copy: Path, place: Path, tmp_path: Path, server: Commands) -> None:
    """A log in the output, the output above the logs, the URDF and the settings of the run that is replaced."""
    demo, more = place / "demo", [f"output={copy}", "overwrite=true"]
    shutil.copy(demo / "sway_test.npz", copy / "mine.npz")
    line = refused(
        server, ["identify", str(demo / "quadruped.yaml"), *more, f"logs.test=[{copy / 'mine.npz'}]"], tmp_path
    )
    assert "contains the input mine.npz" in line
    (copy / "mine.npz").unlink()
    line = refused(server, ["identify", str(copy / "config.yaml"), *more], tmp_path)
    assert "contains the input config.yaml" in line
    line = refused(
        server, ["identify", str(demo / "quadruped.yaml"), *more, f"robot.urdf={copy}/identified.urdf"], tmp_path
    )
    assert "contains the input identified.urdf" in line
    shutil.copytree(demo, tmp_path / "project" / "logs")
    for command in ("identify", "analyze"):
        output = tmp_path / ("project.analysis" if command == "analyze" else "project")
        if command == "analyze":
            (tmp_path / "project").rename(output)
        more = [f"output={tmp_path / 'project'}", "overwrite=true"]
        line = refused(server, [command, str(output / "logs" / "quadruped.yaml"), *more], tmp_path)
        assert "contains the input logs/quadruped.yaml" in line
