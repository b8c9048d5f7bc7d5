"""`torchid analyze`: what sensors and motion determine, and the smallest sensor set that does it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.progress import Progress

from torchid.analysis.base_check import StateCheck
from torchid.analysis.base_parameters import base_parameters
from torchid.analysis.candidates import sensor_set
from torchid.analysis.planner import Question, check, plan_sensors
from torchid.config import AnalyzeConfig
from torchid.errors import ConfigError
from torchid.problem import Samples
from torchid.problem.chunks import by_state
from torchid.problem.linear import parameter_scale
from torchid.problem.measured import measured_components
from torchid.problem.plan import State
from torchid.problem.streaming import free_parameters
from torchid.run.accuracy import accuracies
from torchid.run.analysis_results import Analysis, Scenario, write_analysis
from torchid.run.estimation import frozen_parameters
from torchid.run.experiment import Scene, set_up_scene
from torchid.run.folder import ANALYSIS, check_free
from torchid.run.noise import estimated_noise, recorded_sensors, stating
from torchid.run.progress import progress_bars
from torchid.run.questions import Asked, asked, placed, scenarios
from torchid.run.reading import LogReader
from torchid.sensing import Contact, SensorSet


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


def _answered(ask: Asked, name: str, states: tuple[State, ...], train: Sequence[Samples], bars: Progress) -> Scenario:
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
    recorded = {state for samples in train for state, _ in by_state(samples)}
    for scenario in found:
        planned = sensor_set(scene.robot, scene.contacts, scenario.plan.chosen, scene.noise)
        if recorded & set(scenario.states) and not any(
            same_sensors(planned, other, scene.contacts) for other in sets.values()
        ):
            sets[f"planned for {scenario.name}"] = planned
    return sets
