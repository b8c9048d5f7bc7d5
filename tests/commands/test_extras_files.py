"""Offsets, actuator terms and limb sensors from files to files, through the commands."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml
from demo import NO_TERMS
from misread import WIDTH, World, with_actuators
from recordings import Miscalibration
from rich.progress import Progress
from synthetic import Oracle, load, make_log
from welded import CONTACTS, SENSORS, STATES, machine

from torchid.cli import main
from torchid.commands.chosen_settings import with_chosen_settings
from torchid.config import load_config
from torchid.fitting.experiment import set_up
from torchid.logs import write_log
from torchid.problem import ExtraTerms

EXACT = 1e-7


def files(folder: Path, deviation: float) -> tuple[Path, dict[tuple[str, str], float], dict[str, Miscalibration]]:
    """An experiment file of a machine that is off its URDF; its actuators, and the sensors of each of three logs."""
    path, rng = machine(folder), np.random.default_rng(13)
    robot = load(path, None, False, SENSORS)
    oracle = Oracle.of(robot)
    if deviation:
        oracle.perturb(rng, deviation)
    contacts = [(contact.frame, len(contact.components)) for contact in CONTACTS]
    logs = [make_log(oracle, contacts, STATES, 80, rng, f"{name}.npz") for name in ("first", "second", "new")]
    ideal = [
        Miscalibration(*(np.full(shape, x) for shape in ((robot.n,), (3, 6), (len(SENSORS), 6)) for x in (0.0, 1.0)))
    ] * 3
    terms = ExtraTerms(armature=True, asymmetric_coulomb=True, sign_width=WIDTH)
    acting, true = with_actuators(World(robot, oracle, logs, ideal), terms)
    off = {str(folder / log.source): Miscalibration.random(log, rng) for log in acting}
    for (file, found), log in zip(off.items(), acting, strict=True):
        write_log(found.read(log), file)
    experiment = {
        "robot": {"urdf": str(path)},
        "contacts": [{"frame": "sole", "type": "flat"}, {"frame": "thigh", "type": "point"},
                     {"frame": "fin", "type": "line", "line_axis": "z"}],
        "logs": {"train": ["first.npz", "second.npz"]},
        "sensors": {"set": "full", "ft_sensors": list(SENSORS), "offsets": "log"},
        "actuators": NO_TERMS | {"armature": True, "asymmetric_coulomb": True, "sign_width": WIDTH},
        "estimator": {"name": "least_squares", "ridge": 0.0},
        "output": str(folder / "run"),
    }  # fmt: skip
    (folder / "experiment.yaml").write_text(yaml.safe_dump(experiment))
    return folder / "experiment.yaml", true, off


def errors_in(metrics: dict[str, float]) -> dict[str, float]:
    groups = ("joint_torque", "base_force", "base_moment", "nullspace", "ft_force", "ft_moment")
    return {group: metrics[f"{group}_rms"] for group in groups}


@dataclass(frozen=True)
class Run:
    """A folder with logs, an experiment file and its run, and the truth of `files`."""

    folder: Path
    file: Path
    true: dict[tuple[str, str], float]
    off: dict[str, Miscalibration]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("machine")
    file, true, off = files(folder, 0.2)
    assert main(["identify", str(file)]) == 0
    return Run(folder, file, true, off)


def test_a_run_through_files_finds_them_and_another_log_is_predicted_with_them(run: Run) -> None:
    """Offsets of each log, armature and asymmetric friction: the new log's own offsets are fitted on it."""
    tmp_path, true, off = run.folder, run.true, run.off
    document = json.loads((tmp_path / "run" / "parameters.json").read_text())
    values = {(entry["log"] or "", entry["label"]): entry for entry in document["extras"]}
    for key, expected in true.items():
        assert values[key]["value"] == pytest.approx(expected, rel=EXACT)
    for log in ("first", "second"):
        offset = values[str(tmp_path / f"{log}.npz"), "offset of sole fz"]["value"]
        assert offset == pytest.approx(off[str(tmp_path / f"{log}.npz")].wrench[0, 2], rel=EXACT)
    assert all(entry["told_apart"] and entry["standard_error"] is not None for entry in document["extras"])
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert max(errors_in(metrics["train"]).values()) < 1e-8, "each log is read with its own offsets"

    assert main(["evaluate", str(tmp_path / "run"), "--log", str(tmp_path / "new.npz")]) == 0
    (written,) = (tmp_path / "run" / "evaluation").rglob("metrics.json")
    found = json.loads(written.read_text())["new"]
    assert max(errors_in(found["identified"]).values()) < 1e-8
    assert min(errors_in(found["nominal"]).values()) > 1e-2


@pytest.mark.slow("two fits with bounds, of offsets of every log")
def test_actuators_that_cannot_be_stand_on_their_bounds_and_are_named(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    """Something pushes a joint forwards, by more than dry friction resists: no friction does."""
    overrides = []
    for name in ("first", "second"):
        with np.load(run.folder / f"{name}.npz") as log:
            fields = dict(log)
        joint = str(fields["joint_names"][0])
        fields["joint_torque"][:, 0] -= 9.0 * np.abs(np.tanh(fields["joint_velocity"][:, 0] / WIDTH))
        np.savez(run.folder / f"pushed_{name}.npz", **fields)
        overrides.append(str(run.folder / f"pushed_{name}.npz"))
    settings, output = [f"logs.train={json.dumps(overrides)}"], run.folder / "pushed"
    assert main(["identify", str(run.file), *settings, f"output={output}"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    negative = f"The fit makes Coulomb friction of {joint} forwards negative: impossible."
    assert f"{negative} Use estimator.name=consistent" in shown
    assert "all 9 physically consistent" in shown, "it is no body's fault"
    (broken,) = json.loads((output / "metrics.json").read_text())["violations"]
    assert (broken["term"], broken["unit"]) == (f"Coulomb friction of {joint} forwards", "N m")
    assert broken["amount"] > 0.1

    settings += ["estimator.name=consistent", "estimator.ridge=1e-6", "overwrite=true", f"output={output}"]
    assert main(["identify", str(run.file), *settings, "--verbose"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "|: at a physical limit" in shown
    assert f"Coulomb friction of {joint} forwards" in shown
    metrics, document = (json.loads((output / f"{name}.json").read_text()) for name in ("metrics", "parameters"))
    assert metrics["violations"] == []
    assert f"Coulomb friction of {joint} forwards" in metrics["solution"]["active"]
    (found,) = [x for x in document["extras"] if (x["what"], x["name"]) == ("asymmetric_coulomb", joint)]
    bodies = {body["name"]: body["identified"]["fc"] for body in document["bodies"]}
    robot = load(run.folder / "machine.urdf", None, False, SENSORS)
    resisting = sum(
        abs(x) * bodies[body.name] for body, x in zip(robot.bodies[1:], robot.joint_map[0][:, 0], strict=True)
    )
    assert found["at_bound"]
    assert -found["value"] == pytest.approx(resisting, abs=1e-4)


@pytest.mark.slow("a search of the width")
def test_the_width_of_the_sign_is_found_where_friction_does_not_reverse_at_once(run: Run) -> None:
    """Everything else is fitted anew for each width."""
    setup = set_up(load_config(run.file, ["actuators.sign_width=auto"]))
    choice = with_chosen_settings(setup, Progress(disable=True))[1].sign_width
    assert choice is not None
    assert choice.value == pytest.approx(WIDTH, rel=2e-3)


def test_a_urdf_that_is_right_has_no_errors_whatever_the_offsets(tmp_path: Path) -> None:
    """Offsets and actuators are fitted for it too: those of the identified parameters would be held against it."""
    file, _, _ = files(tmp_path, 0.0)
    assert main(["identify", str(file), f"logs.train=[{tmp_path / 'first.npz'}]"]) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert max(errors_in(metrics["train_nominal"]).values()) < 1e-8
    assert main(["evaluate", str(tmp_path / "run"), "--log", str(tmp_path / "new.npz")]) == 0
    (written,) = (tmp_path / "run" / "evaluation").rglob("metrics.json")
    assert max(errors_in(json.loads(written.read_text())["new"]["nominal"]).values()) < 1e-8
