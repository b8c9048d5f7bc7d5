"""`torchid analyze`: what sensors and motion determine, and the smallest sensor set that does it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.progress import Progress

from torchid.commands.folder import ANALYSIS, check_free, new_folder, write_json
from torchid.commands.reading import LogReader
from torchid.commands.sensor_set_accuracy import accuracies
from torchid.config import AnalyzeConfig, dump_config, inputs_of
from torchid.errors import ConfigError, SensorError, UnknownNameError, during
from torchid.fitting.experiment import Scene, set_up_scene
from torchid.fitting.fit import frozen_parameters
from torchid.fitting.noise import estimated_noise, recorded_sensors, stating
from torchid.identifiability.base_parameters import BaseParameters, base_parameters
from torchid.parameters import WRENCH_COMPONENTS
from torchid.problem import Samples
from torchid.problem.chunks import chunks_by_state
from torchid.problem.compression import free_parameters
from torchid.problem.contact_state import ContactState
from torchid.problem.extras import measured_components
from torchid.problem.linear import parameter_scale
from torchid.report.analysis import (
    SetAccuracy,
    accuracy_figure,
    base_document,
    base_text,
    checks_document,
    plan_document,
)
from torchid.report.figures import save_figure
from torchid.report.tables import progress_bars
from torchid.report.tree_figure import tree_figure
from torchid.sensing import Contact, SensorSet
from torchid.sensor_planning.candidates import Candidate, candidates, sensor_set
from torchid.sensor_planning.check import StateCheck
from torchid.sensor_planning.planner import Question, SensorPlan, check, plan_sensors

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Asked:
    """Candidates, those to keep and to exclude, the set to check (None: none), and sets to compare by name."""

    scene: Scene
    source: object
    offered: tuple[Candidate, ...]
    keep: frozenset[Candidate]
    exclude: frozenset[Candidate]
    proposal: SensorSet | None
    named: Mapping[str, SensorSet]


def asked(scene: Scene, source: object = "experiment") -> Asked:
    """Look everything up.

    Raises:
        InputError: a name that nothing answers to, or that is taken.
    """
    settings, config = scene.config.analysis, scene.config
    wanted = settings.candidates
    with placed(source):
        offered = candidates(
            scene.robot, scene.contacts, wanted.joint_torques, wanted.contacts, settings.costs, wanted.ft_sensors
        )
    proposal = None if config.sensors.empty else scene.sensors_of(config.sensors, source)
    keep, exclude = (_chosen(getattr(settings, field), field, offered, source) for field in ("keep", "exclude"))
    return Asked(scene, source, offered, keep, exclude, proposal, _named_sets(scene, proposal, source))


@contextmanager
def placed(source: object, field: str = "analysis", instead_of: str = "") -> Iterator[None]:
    """Complaints name the experiment file and the place in it.

    Args:
        source: the file.
        field: put before the place that a complaint names, or instead of its beginning.
        instead_of: that beginning.
    """
    try:
        yield
    except UnknownNameError as error:
        raise UnknownNameError(source, _place(field, instead_of, error), error.name, error.valid) from error
    except SensorError as error:
        raise SensorError(source, _place(field, instead_of, error), error.found, error.accepted) from error


def scenarios(
    scene: Scene, train: Sequence[Samples], source: object = "experiment"
) -> dict[str, tuple[ContactState, ...]]:
    """Contact states by scenario; of logs, most frequent first.

    Raises:
        UnknownNameError: a frame that is no contact.
    """
    frames = [contact.frame for contact in scene.contacts]
    wanted = scene.config.analysis.scenarios
    if wanted is None:
        seen: Counter[ContactState] = Counter()
        for samples in train:
            for state, index in chunks_by_state(samples):
                seen[state] += len(samples[index])
        most_first = tuple(state for state, _ in seen.most_common())
        return {"logs": most_first} if seen else {"all_contacts": ((True,) * len(frames),)}
    out = {}
    for name, states in wanted.items():
        for frame in (frame for state in states for frame in state):
            if frame not in frames:
                raise UnknownNameError(source, f"analysis.scenarios.{name}", frame, frames)
        out[name] = tuple(dict.fromkeys(tuple(frame in state for frame in frames) for state in states))
    return out


def _place(field: str, instead_of: str, error: UnknownNameError | SensorError) -> str:
    return error.field.replace(instead_of, field, 1) if instead_of else f"{field}.{error.field}"


def _chosen(names: Sequence[str], field: str, offered: Sequence[Candidate], source: object) -> frozenset[Candidate]:
    by_name: dict[str, list[Candidate]] = {}
    for candidate in offered:
        by_name.setdefault(candidate.name, []).append(candidate)
    for name in names:
        if name not in by_name:
            raise UnknownNameError(source, f"analysis.{field}", name, by_name)
        if len(by_name[name]) > 1:
            found = f"'{name}', the name of several sensors: joint, contact or fixed joint"
            raise ConfigError(source, f"analysis.{field}", found, "a name that only one sensor has")
    return frozenset(by_name[name][0] for name in names)


def _named_sets(scene: Scene, proposal: SensorSet | None, source: object) -> dict[str, SensorSet]:
    """The proposed set and those that the file compares."""
    sets = {} if proposal is None else {"proposed": proposal}
    for name, choice in scene.config.analysis.compare.items():
        field = f"analysis.compare.{name}"
        if name in sets:
            raise ConfigError(source, field, "the name of what stands under sensors", "another name")
        with placed(source, field, instead_of="sensors"):
            sets[name] = scene.sensors_of(choice, source)
    return sets


@dataclass(frozen=True)
class Scenario:
    """Answers for some contact states.

    `proposed`: what the sensors of the experiment file see, state by state, None if it names none. `base`: the base
    parameters that those sensors, or else the planned ones, could determine at best.
    """

    name: str
    states: tuple[ContactState, ...]
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


def write_analysis(analysis: Analysis) -> None:
    """Write the folder."""
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
    with during("writing", analysis.output), new_folder(analysis.output, scene.config.overwrite, ANALYSIS) as folder:
        (folder / "config.yaml").write_text(dump_config(scene.config))
        write_json(folder / "analysis.json", document)
        (folder / "base_parameters.txt").write_text("\n\n".join(texts))
        for name, figure in figures.items():
            save_figure(figure, folder / f"{name}.png")


def _picture(scene: Scene, scenario: Scenario) -> Figure:
    """The robot's tree with the planned sensors."""
    plan, robot = scenario.plan, scene.robot
    sensors = sensor_set(robot, scene.contacts, plan.chosen)
    used = [c for c, *active in zip(scene.contacts, *scenario.states, strict=True) if any(active)]
    wrenches = {
        contact.frame: [WRENCH_COMPONENTS[k] for k in np.flatnonzero(row)]
        for contact, row in zip(scene.contacts, sensors.wrench, strict=True)
    }
    measured = [name for name, taken in zip(robot.dof_names, sensors.torque, strict=True) if taken]
    constrained = [joint for branch in plan.branches if branch.constrained for joint in branch.joints]
    channels = sum(candidate.channels for candidate in plan.chosen)
    title = f"{scenario.name}: {channels} of {sum(c.channels for c in plan.question.candidates)} sensor channels"
    return tree_figure(title, robot, used, measured, wrenches, constrained)


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
    check_free(output, config.overwrite, ANALYSIS, (source, *inputs_of(config)))
    scene = set_up_scene(config, source)
    ask = asked(scene, source)
    with progress_bars() as bars:
        train, test = _read(ask, bars)
        scene = _weighed(scene, train, source)
        ask = asked(scene, source)
        found = tuple(
            _answered(ask, name, states, train, bars) for name, states in scenarios(scene, train, source).items()
        )
        compared = accuracies(scene, _compared(ask, found, train), train, test, bars, source) if train else {}
        analysis = Analysis(scene, found, compared, output)
        bars.add_task("writing", total=None)
        write_analysis(analysis)
    return analysis


def _read(ask: Asked, bars: Progress) -> tuple[list[Samples], list[Samples]]:
    files, reader = ask.scene.config.logs, LogReader(ask.scene)
    if files is None:
        return [], []
    reading = bars.add_task("reading logs", total=len(files.train) + len(files.test))

    def done(_: Path) -> None:
        bars.advance(reading)

    return reader.read(files.train, ask.proposal, done), reader.read(files.test, None, done)


def _weighed(scene: Scene, train: Sequence[Samples], source: object) -> Scene:
    """The scene with the noise that the training logs show of all sensors that they have."""
    if not train:
        return scene
    found = estimated_noise(scene, recorded_sensors(scene, train), train, source)
    return replace(scene, config=stating(scene.config, found))


def _answered(
    ask: Asked, name: str, states: tuple[ContactState, ...], train: Sequence[Samples], bars: Progress
) -> Scenario:
    """Everything that is asked of one scenario."""
    scene, settings = ask.scene, ask.scene.config.analysis
    robot, contacts = scene.robot, scene.contacts
    estimator = scene.config.estimator
    free = free_parameters(robot, estimator.friction) & ~frozen_parameters(estimator, robot, ask.source)
    question = Question(
        robot=robot,
        contacts=contacts,
        states=states,
        candidates=ask.offered,
        prior=parameter_scale(robot.nominal).flatten() * free,
        keep=ask.keep,
        exclude=ask.exclude,
        noise=scene.noise,
        logs=tuple(train),
        criterion=settings.criterion or ("stack" if robot.fixed_base else "per_sample"),
        seed=settings.seed,
    )
    bar = bars.add_task(f"{name}: looking for sensors", total=None)

    def progress(what: str, step: int, steps: int) -> None:
        bars.update(bar, description=f"{name}: {what}", completed=step, total=steps)

    with placed(ask.source):
        plan = plan_sensors(question, progress)
    progress("base parameters", 0, 1)
    planned, checks = sensor_set(robot, contacts, plan.chosen), None
    if ask.proposal is not None:
        checks = _checks(question, ask.proposal, planned, plan.checks)
    at_best = question.stack.problem(planned if ask.proposal is None else ask.proposal)
    base = base_parameters(replace(at_best, free=free))
    progress("done", 1, 1)
    return Scenario(name, states, plan, checks, base)


def _checks(
    question: Question, proposal: SensorSet, planned: SensorSet, of_planned: tuple[StateCheck, ...]
) -> tuple[StateCheck, ...]:
    """Those of the proposed set; of the planned one, if they are the same."""
    return of_planned if same_sensors(proposal, planned, question.contacts) else tuple(check(question, proposal))


def same_sensors(a: SensorSet, b: SensorSet, contacts: Sequence[Contact]) -> bool:
    """Whether two sets measure the same; what a contact cannot exert does not count."""
    wrench_a, wrench_b = (measured_components(contacts, sensors) for sensors in (a, b))
    return np.array_equal(a.torque, b.torque) and np.array_equal(wrench_a, wrench_b)


def _compared(ask: Asked, found: Sequence[Scenario], train: Sequence[Samples]) -> dict[str, SensorSet]:
    """Sensor sets to compare by accuracy: those with a name, and those planned for contact states of the logs."""
    scene, sets = ask.scene, dict(ask.named)
    recorded = {state for samples in train for state, _ in chunks_by_state(samples)}
    for scenario in found:
        planned = sensor_set(scene.robot, scene.contacts, scenario.plan.chosen, scene.noise)
        if recorded & set(scenario.states) and not any(
            same_sensors(planned, other, scene.contacts) for other in sets.values()
        ):
            sets[f"planned for {scenario.name}"] = planned
    return sets
