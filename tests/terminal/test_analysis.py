"""What `torchid analyze` says on one screen."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from repository import DEMO

from torchid.cli import main
from torchid.commands.analyze import Analysis, analyze
from torchid.config import load_analysis
from torchid.identifiability.base_parameters import unobservable_parameters
from torchid.problem.metrics import ROW_GROUPS
from torchid.report.analysis import SetAccuracy
from torchid.report.tables import LINES, terminal_width
from torchid.terminal.analysis import analysis_lines

SIDES = ("front_left", "front_right", "rear_left", "rear_right")
LEGS = tuple(f"{side}-limb-of-a-robot-with-names-that-are-rather-long" for side in SIDES)
FEET = tuple(f"{leg}_foot" for leg in LEGS)
TORQUES = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("hip", "thigh", "knee"))
WIDTHS = (60, 80, 120)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a robot with long names that stands on four feet or three, with torques of all joints but one knee."""
    folder = tmp_path_factory.mktemp("analysis")
    urdf = (DEMO / "quadruped.urdf").read_text()
    for side, leg in zip(SIDES, LEGS, strict=True):
        urdf = urdf.replace(f"{side}_", f"{leg}_")
    (folder / "robot.urdf").write_text(urdf)
    settings = {
        "robot": {"urdf": "robot.urdf"},
        "contacts": [{"frame": foot, "type": "point"} for foot in FEET],
        "sensors": {"joint_torques": list(TORQUES[:-1])},
        "analysis": {"scenarios": {"stand": [list(FEET), list(FEET[:3])]}},
        "output": str(folder / "run"),
    }
    (folder / "run.yaml").write_text(yaml.safe_dump(settings))
    return folder / "run.yaml"


@pytest.fixture(scope="module")
def lame(file: Path) -> Analysis:
    return analyze(load_analysis(file))


def sound(analysis: Analysis) -> Analysis:
    """The same without a proposal."""
    return replace(analysis, scenarios=tuple(replace(one, proposed=None) for one in analysis.scenarios))


def with_logs(analysis: Analysis, rank: int, *confounded: str, sets: int = 1) -> Analysis:
    """The same with the accuracy of sensor sets on logs that determine so many combinations."""
    measured: Any = SimpleNamespace(rms=dict.fromkeys(ROW_GROUPS, 0.1234))
    names = ["proposed", *(f"set {k}" for k in range(1, sets))]
    advice = tuple(f"mend that {message}" for message in confounded)
    accuracy = SetAccuracy(11, rank, measured, confounded, advice)
    setup = analysis.setup
    settings = replace(setup.config.analysis, scenarios=None)
    setup = replace(setup, config=replace(setup.config, analysis=settings))
    return replace(analysis, setup=setup, accuracies=dict.fromkeys(names, accuracy))


def in_scenarios(analysis: Analysis, count: int) -> Analysis:
    """Two scenarios or more, of which the second has the fault."""
    (bad,), (good,) = analysis.scenarios, sound(analysis).scenarios
    others = (replace(good if k != 1 else bad, name=f"scenario_{k}") for k in range(count))
    return replace(analysis, scenarios=tuple(others))


def text(analysis: Analysis, width: int = 100) -> str:
    return " ".join(" ".join(analysis_lines(analysis, width)).split())


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("scenarios", [1, 2, 9])
@pytest.mark.parametrize("sets", [0, 1, 2, 12])
def test_any_number_of_scenarios_and_sensor_sets_fits_on_a_screen(
    lame: Analysis, scenarios: int, sets: int, width: int
) -> None:
    analysis = lame if scenarios == 1 else in_scenarios(lame, scenarios)
    if sets:
        analysis = with_logs(analysis, 90, "offsets: confounded with masses; state them", sets=sets)
    lines = analysis_lines(analysis, width)
    assert len(lines) <= LINES
    assert lines[-1] == f"written to    {lame.output}"
    assert max(len(line) for line in lines[:-1] if "-limb-" not in line) <= width
    shown = sum(line.startswith(("proposed ", "set ")) for line in lines)
    counted = [int(line.split()[1]) for line in lines if line.endswith(": --verbose") and " set" in line]
    assert shown + sum(counted) == sets


def test_what_is_lost_and_what_would_help_comes_first(lame: Analysis) -> None:
    said = text(lame)
    assert said.startswith("The sensors of the file do not suffice: the base is unobservable in 1 of 2 contact states.")
    attention, posture = (line for line in analysis_lines(lame, 1000) if line.startswith("attention     "))
    assert attention.startswith(f"attention     {FEET[3]} needs 1 more sensor in 1 of 2 contact states. Add one of: ")
    assert TORQUES[-1] in attention
    assert posture.startswith("attention     The base is unobservable with all joints at zero.")


def test_sensors_that_suffice_are_named_with_the_proof(lame: Analysis) -> None:
    said = analysis_lines(sound(lame), 10_000)
    assert said[0] == "12 sensors suffice: the base is observable in all 2 contact states."
    assert f"smallest set  12 sensors, cost 12, no cheaper set exists: {', '.join(TORQUES)}" in said
    (scenario,) = lame.scenarios
    own = replace(lame, scenarios=(replace(scenario, proposed=scenario.plan.observability),))
    assert "smallest set  12 sensors, cost 12, no cheaper set exists: the set of the file" in analysis_lines(own, 100)


def test_parameters_are_counted_that_are_known_alone_in_sums_and_not_at_all(lame: Analysis) -> None:
    (scenario,) = lame.scenarios
    base, names = scenario.base, lame.setup.robot.body_names
    sizes = [int((row != 0.0).sum()) for row in base.combination]
    unseen = unobservable_parameters(base, names)
    hidden = sum(len(line.split(": ")[1].split(", ")) for line in unseen)
    alone = sizes.count(1)
    assert hidden > 0
    (said,) = (line for line in analysis_lines(lame, 10_000) if line.startswith("determined "))
    assert f"at best {alone} of {base.free.sum()} parameters alone" in said
    assert f"{base.free.sum() - alone - hidden} only in {base.rank - alone} combinations, {hidden} not at all" in said
    assert f"{hidden} not at all (of {unseen[0].split(':')[0]}" in said


def test_logs_that_determine_less_than_the_sensors_could_are_named(lame: Analysis) -> None:
    rank = lame.scenarios[0].base.rank
    assert f"The logs determine {rank - 7} of {rank} base parameters. Record more" in text(with_logs(lame, rank - 7))
    assert "The logs determine" not in text(with_logs(lame, rank))
    assert "rms error, measured joint torque [N m] base force [N]" in text(with_logs(lame, rank))
    said = text(with_logs(lame, rank, "offset of a: confounded with b; do not trust either", "another", sets=2))
    assert "attention proposed, set 1: mend that offset of a: confounded with b; do not trust either" in said
    assert " 2 more: --verbose" in said


def test_the_scenario_with_the_fault_comes_first(lame: Analysis) -> None:
    lines = analysis_lines(in_scenarios(lame, 9), 100)
    rows = [line.split()[0] for line in lines if line.startswith("scenario_")]
    assert rows[0] == "scenario_1"
    assert f"and {9 - len(rows)} more scenarios: --verbose" in lines
    said = " ".join(lines)
    assert "do not suffice: the base is unobservable in 1 of 9 scenarios (in 1 of 2 contact states of" in said
    assert f"attention     scenario_1: {FEET[3]} needs 1 more sensor" in "\n".join(
        analysis_lines(in_scenarios(lame, 9), 200)
    )


def test_all_tables_are_printed_when_asked_for(
    file: Path, lame: Analysis, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.modules[analyze.__module__], "analyze", lambda _: lame)
    printed = {}
    for option in ("--quiet", "--verbose", None):
        assert main(["analyze", str(file), *([] if option is None else [option])]) == 0
        printed[option] = capsys.readouterr().out
    assert printed["--quiet"] == ""
    for title in (
        "Scenario stand",
        "Branches",
        "Chosen sensors",
        "Proposed sensors",
        "Without one sensor",
        "structure ",
    ):
        assert title in str(printed["--verbose"])
        assert title not in str(printed[None])
    assert str(printed[None]).splitlines() == analysis_lines(lame, terminal_width())


def test_ranks_of_the_base_are_said_to_be_those_of_joints_that_move(lame: Analysis) -> None:
    (_, attention) = (line for line in analysis_lines(replace(lame, resting=0.31), 1000) if "attention" in line)
    assert "actuators.stiction leaves out 31 % of the torques, as joints rest." in attention


def test_where_nothing_touches_no_sensor_is_needed(file: Path, tmp_path: Path) -> None:
    only_air = ["analysis.scenarios={}", "analysis.scenarios={air: [[]]}"]
    settings = [*only_air, "sensors={}", f"output={tmp_path / 'run'}"]
    flight = analyze(load_analysis(file, settings))
    assert text(flight).startswith("No sensor is needed: the base is observable in the contact state")
