"""`torchid analyze`: what sensors and motion determine, and the smallest sensor set that does it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.progress import Progress

from torchid.analysis.base_check import StateCheck
from torchid.analysis.base_parameters import BaseParameters, base_parameters
from torchid.analysis.candidates import Candidate, candidates, sensor_set
from torchid.analysis.planner import Question, SensorPlan, check, plan_sensors
from torchid.analysis.structure import structural_problem
from torchid.config import AnalyzeConfig, dump_config
from torchid.errors import ConfigError, SensorError, UnknownNameError
from torchid.problem import Samples
from torchid.problem.chunks import by_state
from torchid.problem.plan import State
from torchid.problem.samples import measured_components
from torchid.report.accuracy import SetAccuracy, accuracy_figure
from torchid.report.analysis_document import base_document, base_text, checks_document, plan_document
from torchid.report.tree_figure import tree_figure
from torchid.run.accuracy import accuracies
from torchid.run.experiment import Scene, set_up_scene
from torchid.run.folder import ANALYSIS, check_free, new_folder, write_json
from torchid.run.progress import progress_bars
from torchid.sensing import COMPONENTS, Contact, SensorSet


@dataclass(frozen=True)
class Scenario:
    """Answers for some contact states.

    `proposed`: what the sensors of the experiment file see, state by state, None if it names none.
    `base`: the base parameters that those sensors, or else the planned ones, could determine at best.
    """

    name: str
    states: tuple[State, ...]
    plan: SensorPlan
    proposed: tuple[StateCheck, ...] | None
    base: BaseParameters


@dataclass(frozen=True)
class Analysis:
    """All answers: by scenario, and the accuracy of sensor sets on logs."""

    scene: Scene
    scenarios: tuple[Scenario, ...]
    accuracies: dict[str, SetAccuracy]
    output: Path


def analysis_folder(output: Path) -> Path:
    """Where an analysis goes: beside the run of the same experiment file."""
    return output.parent / f"{output.name}.analysis"


def analyze(config: AnalyzeConfig, source: object = "experiment") -> Analysis:
    """Answer what an experiment file asks under `analysis`, and write a folder with the answers.

    Args:
        config: the experiment file.
        source: named in errors.

    Raises:
        InputError: whatever does not fit; nothing has been written then.
    """
    output = analysis_folder(config.output)
    if not config.output.name:
        raise ConfigError(source, "output", f"'{config.output}', no name for a folder", "a path to a new folder")
    check_free(output, config.overwrite, ANALYSIS)
    scene = set_up_scene(config, source)
    proposal = None if config.sensors.empty else scene.sensors_of(config.sensors, source)
    offered, named = _offered(scene, source), _named_sets(scene, proposal, source)
    with progress_bars() as bars:
        train, test = _read(scene, proposal, bars)
        scenarios = tuple(
            _scenario(scene, name, states, offered, proposal, train, bars, source)
            for name, states in _scenarios(scene, train, source).items()
        )
        found = accuracies(scene, _compared(scene, named, scenarios), train, test, bars, source) if train else {}
        analysis = Analysis(scene, scenarios, found, output)
        bars.add_task("writing", total=None)
        _write(analysis)
    return analysis


def _write(analysis: Analysis) -> None:
    scene, names = analysis.scene, analysis.scene.robot.body_names
    document: dict[str, Any] = {"scenarios": {}, "accuracy": None}
    texts, figures = [], {}
    for scenario in analysis.scenarios:
        plan, proposed = scenario.plan, scenario.proposed
        document["scenarios"][scenario.name] = plan_document(plan) | {
            "proposed": None if proposed is None else checks_document(proposed),
            "base_parameters": base_document(scenario.base, names),
        }
        which = "planned" if proposed is None else "proposed"
        texts.append(base_text(f"{scenario.name}, {which} sensors", scenario.base, names))
        figures[f"sensors-{scenario.name}"] = _picture(scene, scenario)
    if analysis.accuracies:
        document["accuracy"] = {name: found.as_dict() for name, found in analysis.accuracies.items()}
        figures["accuracy"] = accuracy_figure(analysis.accuracies)
    with new_folder(analysis.output, scene.config.overwrite, ANALYSIS) as folder:
        (folder / "config.yaml").write_text(dump_config(scene.config))
        write_json(folder / "analysis.json", document)
        (folder / "base_parameters.txt").write_text("\n\n".join(texts))
        for name, figure in figures.items():
            figure.savefig(folder / f"{name}.png", dpi=130)


def _picture(scene: Scene, scenario: Scenario) -> Figure:
    """The robot's tree with the planned sensors."""
    plan, robot = scenario.plan, scene.robot
    sensors = sensor_set(robot, scene.contacts, plan.chosen)
    used = [c for c, *active in zip(scene.contacts, *scenario.states, strict=True) if any(active)]
    wrenches = {
        contact.frame: [COMPONENTS[k] for k in np.flatnonzero(row)]
        for contact, row in zip(scene.contacts, sensors.wrench, strict=True)
    }
    torques = [name for name, measured in zip(robot.joint_names, sensors.torque, strict=True) if measured]
    constrained = [joint for branch in plan.branches if branch.constrained for joint in branch.joints]
    channels = sum(candidate.channels for candidate in plan.chosen)
    title = f"{scenario.name}: {channels} of {sum(c.channels for c in plan.question.candidates)} sensor channels"
    return tree_figure(title, robot, used, torques, wrenches, constrained)


def _offered(scene: Scene, source: object) -> tuple[Candidate, ...]:
    """The candidates of the experiment file."""
    settings = scene.config.analysis
    wanted = settings.candidates
    per = "device" if wanted.contacts == "none" else wanted.contacts
    with _placed(source):
        found = candidates(scene.robot, scene.contacts, wanted.joint_torques, per, settings.costs)
    return tuple(c for c in found if c.joint is not None or wanted.contacts != "none")


@contextmanager
def _placed(source: object) -> Iterator[None]:
    """Complaints about the question name the experiment file and the place in it."""
    try:
        yield
    except UnknownNameError as error:
        raise UnknownNameError(source, f"analysis.{error.field}", error.name, error.valid) from error
    except SensorError as error:
        raise SensorError(source, f"analysis.{error.field}", error.found, error.accepted) from error


def _read(scene: Scene, proposal: SensorSet | None, bars: Progress) -> tuple[list[Samples], list[Samples]]:
    files = scene.config.logs
    if files is None:
        return [], []
    reading = bars.add_task("reading logs", total=len(files.train) + len(files.test))

    def done(_: Path) -> None:
        bars.advance(reading)

    return scene.read_logs(files.train, proposal, done), scene.read_logs(files.test, None, done)


def _scenarios(scene: Scene, train: Sequence[Samples], source: object) -> dict[str, tuple[State, ...]]:
    """Contact states by scenario.

    Raises:
        UnknownNameError: a frame that is no contact.
    """
    frames = [contact.frame for contact in scene.contacts]
    asked = scene.config.analysis.scenarios
    if asked is None:
        seen: Counter[State] = Counter()
        for samples in train:
            for state, index in by_state(samples):
                seen[state] += len(samples[index])
        most_first = tuple(state for state, _ in seen.most_common())
        return {"logs": most_first} if seen else {"all_contacts": ((True,) * len(frames),)}
    out = {}
    for name, states in asked.items():
        for frame in (frame for state in states for frame in state):
            if frame not in frames:
                raise UnknownNameError(source, f"analysis.scenarios.{name}", frame, frames)
        out[name] = tuple(dict.fromkeys(tuple(frame in state for frame in frames) for state in states))
    return out


def _named(names: Sequence[str], field: str, offered: Sequence[Candidate], source: object) -> frozenset[Candidate]:
    by_name = {candidate.name: candidate for candidate in offered}
    for name in names:
        if name not in by_name:
            raise UnknownNameError(source, f"analysis.{field}", name, by_name)
    return frozenset(by_name[name] for name in names)


def _scenario(
    scene: Scene,
    name: str,
    states: tuple[State, ...],
    offered: tuple[Candidate, ...],
    proposal: SensorSet | None,
    train: Sequence[Samples],
    bars: Progress,
    source: object,
) -> Scenario:
    settings, robot, contacts = scene.config.analysis, scene.robot, scene.contacts
    everything = structural_problem(robot, contacts, sensor_set(robot, contacts, offered), states)
    question = Question(
        robot=robot,
        contacts=contacts,
        states=states,
        candidates=offered,
        prior=everything.scale * everything.free,
        keep=_named(settings.keep, "keep", offered, source),
        exclude=_named(settings.exclude, "exclude", offered, source),
        noise=scene.noise,
        logs=tuple(train),
        criterion=settings.criterion or ("stack" if robot.fixed_base else "per_sample"),
        seed=settings.seed,
    )
    bar = bars.add_task(f"{name}: looking for sensors", total=None)

    def progress(what: str, step: int, steps: int) -> None:
        bars.update(bar, description=f"{name}: {what}", completed=step, total=steps)

    with _placed(source):
        plan = plan_sensors(question, progress)
    progress("base parameters", 0, 1)
    used = sensor_set(robot, contacts, plan.chosen) if proposal is None else proposal
    base = base_parameters(structural_problem(robot, contacts, used, states, scene.config.estimator.friction))
    checks: tuple[StateCheck, ...] | None = None
    if proposal is not None:
        planned = same_sensors(proposal, sensor_set(robot, contacts, plan.chosen), contacts)
        checks = plan.checks if planned else tuple(check(question, proposal))
    progress("done", 1, 1)
    return Scenario(name, states, plan, checks, base)


def same_sensors(a: SensorSet, b: SensorSet, contacts: Sequence[Contact]) -> bool:
    """Whether two sets measure the same; what a contact cannot exert does not count."""
    wrench_a, wrench_b = (measured_components(contacts, sensors) for sensors in (a, b))
    return np.array_equal(a.torque, b.torque) and np.array_equal(wrench_a, wrench_b)


def _named_sets(scene: Scene, proposal: SensorSet | None, source: object) -> dict[str, SensorSet]:
    """The proposed set and those that the file compares.

    Raises:
        InputError: names that do not fit the robot, or one that is taken.
    """
    sets = {} if proposal is None else {"proposed": proposal}
    for name, choice in scene.config.analysis.compare.items():
        field = f"analysis.compare.{name}"
        if name in sets:
            raise ConfigError(source, field, "the name of what stands under sensors", "another name")
        try:
            sets[name] = scene.sensors_of(choice, source)
        except UnknownNameError as error:
            raise UnknownNameError(source, error.field.replace("sensors", field, 1), error.name, error.valid) from error
        except SensorError as error:
            raise SensorError(source, error.field.replace("sensors", field, 1), error.found, error.accepted) from error
    return sets


def _compared(scene: Scene, named: Mapping[str, SensorSet], scenarios: Sequence[Scenario]) -> dict[str, SensorSet]:
    """Sensor sets to compare by accuracy: those with a name, and the planned ones."""
    sets = dict(named)
    for scenario in scenarios:
        planned = sensor_set(scene.robot, scene.contacts, scenario.plan.chosen, scene.noise)
        if not any(same_sensors(planned, other, scene.contacts) for other in sets.values()):
            sets[f"planned for {scenario.name}"] = planned
    return sets
