"""The study of the paper's section V, run as a reader runs it (`scripts/reproduce_paper.py --quick`)."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forked import forked_simulations
from paper.results import NOMINAL, TRUE, Record, Results, examine_claims
from repository import ROOT
from script_calls import call
from shared_work import TORCHRUN, finish
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchid.problem import Metrics
from torchid.problem.metrics import ROW_GROUPS

SETS = ("full", "contacts", "joints", "reduced")
CONDITIONS = ("exact sensors", "white noise", "bias and gain", "delay", "joint friction", "all")
TRAINING = ("all runs", "squats alone")


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a quick study, and what it printed."""
    folder = tmp_path_factory.mktemp("study") / "paper"
    with forked_simulations():
        status, out, err = call("reproduce_paper", "--quick", "--output", str(folder))
    assert status == 0, err
    return folder, out


@pytest.fixture(scope="module")
def error(study: tuple[Path, str]) -> Callable[..., float]:
    """Median error on the unseen log, as a share of the measured."""
    records = json.loads((study[0] / "results.json").read_text())["records"]

    def median(condition: str, training: str, sensors: str, group: str, against: str = "exact") -> float:
        key = (condition, training, sensors)
        chosen = [r for r in records if (r["condition"], r["training"], r["sensors"]) == key]
        return float(np.median([r[against][f"{group}/relative"] for r in chosen]))

    return median


def test_every_sensor_set_meets_every_condition_on_both_training_sets(study: tuple[Path, str]) -> None:
    document = json.loads((study[0] / "results.json").read_text())
    found = {(r["condition"], r["training"], r["sensors"]) for r in document["records"]}
    rows = (NOMINAL, *SETS, TRUE)
    assert found == {(c, t, s) for c in CONDITIONS for t in TRAINING for s in rows}
    draws = {r["nominal_draw"] for r in document["records"] if r["sensors"] == "full"}
    assert draws == {0, 1}


@pytest.mark.parametrize("condition", ["exact sensors", "white noise", "delay"])
def test_full_sensing_is_a_tenth_of_the_nominal_error_or_less(condition: str, error: Callable[..., float]) -> None:
    for group in ROW_GROUPS:
        assert error(condition, "all runs", "full", group) < 0.1 * error(condition, "all runs", NOMINAL, group)


@pytest.mark.parametrize("condition", ["exact sensors", "white noise", "delay", "joint friction"])
def test_contacts_alone_give_the_base_rows_and_not_the_joint_torques(
    condition: str, error: Callable[..., float]
) -> None:
    nominal, full, contacts = (
        {group: error(condition, "all runs", sensors, group) for group in ROW_GROUPS}
        for sensors in (NOMINAL, "full", "contacts")
    )
    assert contacts["base_force"] < 0.2 * nominal["base_force"]
    assert contacts["base_moment"] < 0.2 * nominal["base_moment"]
    assert contacts["joint_torque"] > 2.0 * full["joint_torque"]


def test_joints_alone_do_not_feel_a_delay_of_the_foot_sensors(error: Callable[..., float]) -> None:
    for training in TRAINING:
        for group in ROW_GROUPS:
            exact, late = (error(c, training, "joints", group) for c in ("exact sensors", "delay"))
            assert abs(late - exact) < 0.1 * exact + 1e-4  # the delay moves a few contact flags, nothing else


def test_figures_and_charts_are_written(study: tuple[Path, str]) -> None:
    folder, _ = study
    for name in ("rms", "forces", "projected"):
        assert (folder / f"{name}.png").stat().st_size > 20_000
    assert {path.name for path in folder.iterdir()} == {
        "results.json", "tables.txt", "rms.png", "forces.png", "projected.png", "tensorboard", "manifest.json",
    }  # fmt: skip
    events = EventAccumulator(str(folder / "tensorboard"), size_guidance={"images": 0})
    events.Reload()
    assert set(events.Tags()["images"]) == {"rms", "forces", "projected"}
    joints = EventAccumulator(str(folder / "tensorboard" / "joints"))
    joints.Reload()
    assert set(joints.Tags()["scalars"]) == {f"{training}/{group}" for training in TRAINING for group in ROW_GROUPS}
    assert len(joints.Scalars("all runs/base_force")) == len(CONDITIONS)


@pytest.mark.study
def test_two_processes_write_the_study_of_one(tmp_path: Path) -> None:
    script, outputs = str(ROOT / "scripts" / "reproduce_paper.py"), []
    for name, before in (("one", (sys.executable,)), ("two", (*TORCHRUN, "2"))):
        outputs.append(tmp_path / name)
        status, printed, complained = finish((*before, script, "--quick", "--output", str(outputs[-1])))
        assert status == 0, complained
        assert printed.count("written to") == 1
    for name in ("results.json", "tables.txt", "rms.png", "forces.png", "projected.png"):
        assert (outputs[1] / name).read_bytes() == (outputs[0] / name).read_bytes(), name
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one", "two"]


@pytest.mark.study
def test_a_folder_that_holds_something_else_ends_both_processes_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    script = str(ROOT / "scripts" / "reproduce_paper.py")
    status, printed, complained = finish((*TORCHRUN, "2", script, "--quick", "--output", str(tmp_path)))
    assert status != 0
    assert not printed
    (line,) = [line for line in complained.splitlines() if line.startswith("reproduce_paper: ")]
    assert str(tmp_path) in line
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


# ------------------------------------------------------------------------------------------------------------ findings


def results(**errors: tuple[float, float, float, float]) -> Results:
    """Results of one condition with the given errors by sensors, in the order of `ROW_GROUPS`."""

    def record(sensors: str, values: tuple[float, ...], draw: int, scale: float) -> Record:
        rms: dict[str, Any] = {group: value * scale for group, value in zip(ROW_GROUPS, values, strict=True)}
        metrics = Metrics(rms, rms, {}, {}, 1.0)
        return Record("noise", "all", sensors, draw, 0, metrics, metrics)

    draws = ((0, 1.0), (1, 0.5), (2, 100.0))  # the median is the first
    return Results([record(s, v, number, scale) for s, v in errors.items() for number, scale in draws], [])


PAPER = results(
    nominal=(10.0, 10.0, 10.0, 10.0),
    full=(0.5, 0.1, 0.2, 0.3),
    contacts=(8.0, 0.1, 0.2, 3.0),
    joints=(2.0, 3.0, 3.0, 0.1),
    true=(0.01, 0.01, 0.01, 0.01),
)  # fmt: skip


def holds(found: Results) -> list[bool]:
    return [finding.holds for finding in examine_claims(found, "noise", "all")]


def test_the_papers_own_pattern_confirms_all_three_findings() -> None:
    assert holds(PAPER) == [True, True, True]
