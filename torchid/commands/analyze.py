"""`torchid analyze`: what sensors and motion determine, and the smallest sensor set that does it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.progress import Progress

from torchid import distributed
from torchid.commands.chosen_settings import with_chosen_settings
from torchid.commands.folder import ANALYSIS, check_free, new_folder, write_json
from torchid.commands.sensor_set_accuracy import accuracies
from torchid.config import AnalyzeConfig, dump_config, inputs_of
from torchid.errors import ConfigError, SensorError, UnknownNameError, during, join_names, warn
from torchid.fitting.experiment import RobotSetup, set_up_robot, with_noise
from torchid.fitting.left_out import Evidence, leave_sensors_out
from torchid.fitting.noise import unmeasured_at_rest
from torchid.identifiability.base_parameters import BaseParameters, base_parameters
from torchid.parallel import one_thread
from torchid.parameters import WRENCH_COMPONENTS
from torchid.problem import Samples
from torchid.problem.chunks import chunks_by_state
from torchid.problem.contact_state import ContactState
from torchid.problem.elimination import free_parameters
from torchid.problem.linear import parameter_scale
from torchid.reading.log_reader import LogReader, check_read
from torchid.report.analysis import (
    ALL_OF,
    SetAccuracy,
    base_parameters_document,
    base_parameters_text,
    observability_document,
    sensor_plan_document,
)
from torchid.report.figure_style import save_figures
from torchid.report.figures import tree_figure
from torchid.report.tables import progress_bars
from torchid.reprs import short_repr
from torchid.sensing import Contact, SensorSet
from torchid.sensing.sensors import NORMAL_FORCE, measured_components
from torchid.sensor_planning.observability import (
    BaseObservability,
    Candidate,
    candidates,
    contained_candidates,
    sensor_set,
)
from torchid.sensor_planning.planner import (
    PlanningProblem,
    SensorPlan,
    StepCallback,
    plan_sensors,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class ScenarioAnalysis:
    """Planned and proposed sensors for some contact states.

    `proposed`: the check of the experiment file's sensors, state by state, None if it names none. `base`: the base
    parameters that those sensors, or else the planned ones, could determine at best.
    """

    name: str
    states: tuple[ContactState, ...]
    plan: SensorPlan
    proposed: tuple[BaseObservability, ...] | None
    base: BaseParameters

    __repr__ = short_repr

    @property
    def plan_label(self) -> str:
        """Name of the planned sensors among the sets that are compared."""
        return _plan_label(self.name)

    def _headline(self) -> str:
        plan = self.plan
        names = join_names([sensor.name for sensor in self.plan.chosen])
        what = f"{len(plan.chosen)} sensors at a cost of {plan.cost:g} ({plan.proof}): {names}"
        return f"{self.name}, {len(self.states)} contact states, {what}"


@dataclass(frozen=True)
class Analysis:
    """Results of an analysis by scenario, the accuracy of sensor sets on logs, and the output folder, if any.

    Among processes that share the work, only the first has the scenarios.

    `resting`: fraction of the training logs' torques that count as unmeasured because joints rest. `without`: gain in
    predicting the other sensors when a sensor is left out, see `leave_sensors_out`.
    """

    setup: RobotSetup
    scenarios: tuple[ScenarioAnalysis, ...]
    accuracies: dict[str, SetAccuracy]
    output: Path | None
    resting: float | None = None
    without: Mapping[str, Evidence] = field(default_factory=dict)

    __repr__ = short_repr

    def _headline(self) -> str:
        sets = f"; accuracy of {join_names(list(self.accuracies))}" if self.accuracies else ""
        chosen = [
            f"{scenario.name}: {len(scenario.plan.chosen)} sensors, cost {scenario.plan.cost:g}"
            for scenario in self.scenarios
        ]
        return f"{self.setup.robot.path.name}; {'; '.join(chosen)}{sets}"

    def to_dict(self) -> dict[str, Any]:
        """Content of `analysis.json`."""
        names = self.setup.robot.body_names
        scenarios = {}
        for scenario in self.scenarios:
            proposed = scenario.proposed
            scenarios[scenario.name] = sensor_plan_document(scenario.plan) | {
                "proposed": None if proposed is None else observability_document(proposed),
                "base_parameters": base_parameters_document(scenario.base, names),
            }
        accuracy = {name: accuracy.as_dict() for name, accuracy in self.accuracies.items()} or None
        without = {name: asdict(evidence) for name, evidence in self.without.items()} or None
        document = {"scenarios": scenarios, "accuracy": accuracy, "resting_share": self.resting}
        return document | {"sensors_left_out": without}


@dataclass(frozen=True, kw_only=True)
class AnalysisRequest:
    """What an experiment file requests, its names looked up.

    Attributes:
        setup: robot, contacts and settings.
        candidates: sensors to choose from.
        keep: those that are there anyway.
        exclude: those that cannot be.
        proposed: the sensors of the file, None if it names none.
        compared: sensor sets to compare, by name.
    """

    setup: RobotSetup
    candidates: tuple[Candidate, ...]
    keep: frozenset[Candidate]
    exclude: frozenset[Candidate]
    proposed: SensorSet | None
    compared: Mapping[str, SensorSet]

    @classmethod
    def of(cls, setup: RobotSetup) -> AnalysisRequest:
        """The request of an experiment file. Raises InputError: a name that nothing has, or that is taken."""
        settings = setup.config.analysis
        config = setup.config
        choice = settings.candidates
        with errors_at("analysis"):
            offered = candidates(
                robot=setup.robot,
                contacts=setup.contacts,
                joint_torques=choice.joint_torques,
                per=choice.contacts,
                costs=settings.costs,
                ft_sensors=choice.ft_sensors,
                normal_forces=choice.normal_forces,
            )
        proposed = None if config.sensors.empty else setup.sensors_of(config.sensors)
        return cls(
            setup=setup,
            candidates=offered,
            keep=_candidates_named(settings.keep, "keep", offered),
            exclude=_candidates_named(settings.exclude, "exclude", offered),
            proposed=proposed,
            compared=_sets_named(setup, proposed),
        )


@contextmanager
def errors_at(field: str, instead_of: str = "") -> Iterator[None]:
    """Let errors name the experiment file, and a field of it before theirs or instead of its beginning."""
    try:
        yield
    except UnknownNameError as error:
        raise UnknownNameError.at_field(_field_in_file(field, instead_of, error), error.name, error.valid) from error
    except SensorError as error:
        raise SensorError.at_field(_field_in_file(field, instead_of, error), error.found, error.accepted) from error


def _field_in_file(field: str, instead_of: str, error: UnknownNameError | SensorError) -> str:
    return error.field.replace(instead_of, field, 1) if instead_of else f"{field}.{error.field}"


def _candidates_named(names: Sequence[str], field: str, offered: Sequence[Candidate]) -> frozenset[Candidate]:
    by_name: dict[str, list[Candidate]] = {}
    for candidate in offered:
        by_name.setdefault(candidate.name, []).append(candidate)
    for name in names:
        if name not in by_name:
            raise UnknownNameError.at_field(f"analysis.{field}", name, by_name)
        if len(by_name[name]) > 1:
            reason = f"several sensors are named '{name}' (joint, contact or fixed joint)"
            raise ConfigError.at_field(f"analysis.{field}", reason, "the name of one sensor")
    return frozenset(by_name[name][0] for name in names)


def _sets_named(setup: RobotSetup, proposed: SensorSet | None) -> dict[str, SensorSet]:
    """The proposed set and those that the file compares."""
    sets = {} if proposed is None else {"proposed": proposed}
    for name, choice in setup.config.analysis.compare.items():
        field = f"analysis.compare.{name}"
        if name in sets:
            raise ConfigError.at_field(field, "the name of the sensors block", "another name")
        with errors_at(field, instead_of="sensors"):
            sets[name] = setup.sensors_of(choice)
    return sets


@one_thread()
def analyze(config: AnalyzeConfig) -> Analysis:
    """Plan and check sensors as an experiment file says under `analysis`, and write a folder if there is an output.

    Raises:
        InputError: whatever does not fit; nothing has been written then.
    """
    output = None if config.output is None else _analysis_folder(config.output)
    if output is not None:
        distributed.from_first(partial(check_free, output, config.overwrite, ANALYSIS, inputs_of(config)), "output")
    setup = set_up_robot(config)
    request = AnalysisRequest.of(setup)
    with progress_bars() as bars:
        setup, _ = with_chosen_settings(setup, bars)
        request = replace(request, setup=setup)
        train, test = _read(request, bars)
        if train:
            noise = distributed.from_first(partial(setup.estimate_noise, train, suggest=False), "noise")
            setup = with_noise(setup, noise)
            request = AnalysisRequest.of(setup)
        choices: dict[str, SensorPlan] = {}
        results: list[ScenarioAnalysis] = []

        def choose() -> dict[str, SensorSet]:
            for name, states in scenarios(setup, train).items():
                progress = _progress(name, bars)
                choices[name] = _plan_sensors(request, states, train, progress)
                results.append(_analysis_of(request, name, choices[name], progress))
            return _sets_to_compare(request, choices, train)

        sets = distributed.from_first(choose, "sensor sets")
        bars.add_task("comparing sensor sets", total=None)
        compared = accuracies(setup, sets, train, test) if train and sets else {}
        without = distributed.from_first(partial(_leave_out, request, train), "sensors left out")
        analysis = Analysis(setup, tuple(results), compared, output, unmeasured_at_rest(train), without)
        if output is not None:
            bars.add_task("writing", total=None)
            distributed.from_first(partial(_write_analysis, analysis, output, config.overwrite), "analysis folder")
    return analysis


def _leave_out(request: AnalysisRequest, train: Sequence[Samples]) -> dict[str, Evidence]:
    """What leaving out each sensor of the file, or all of a kind, is worth to the prediction of the others."""
    setup = request.setup
    sensors = request.proposed
    if sensors is None or not train:
        return {}
    robot = setup.robot
    contacts = setup.contacts
    available = contained_candidates(contacts, sensors, candidates(robot, contacts, ft_sensors=robot.ft_names))
    dropped = {candidate.name: [candidate] for candidate in available}
    kinds = {candidate.kind: [other for other in available if other.kind == candidate.kind] for candidate in available}
    dropped |= {f"{ALL_OF}{kind}": members for kind, members in kinds.items() if 1 < len(members) < len(available)}
    sets = {}
    for name, members in dropped.items():
        torque = sensors.torque.copy()
        wrench = sensors.wrench.copy()
        for member in members:
            torque[list(member.dofs)] = False
            if member.contact is not None:
                wrench[member.contact] = False
        if (torque & ~robot.is_passive).any() or wrench.any():
            sets[name] = replace(sensors, torque=torque, wrench=wrench)
    return leave_sensors_out(train, setup.fitter(setup.builder(sensors), setup.conditions()), setup.terms, sets)


def _plan_label(name: str) -> str:
    """Name of the sensors planned for a scenario among the sets that are compared."""
    return f"sensor plan for {name}"


def _analysis_folder(output: Path) -> Path:
    """Where an analysis goes: beside the run of the same experiment file.

    Raises:
        ConfigError: the output has no name.
    """
    if not output.name:
        raise ConfigError.at_field("output", f"'{output}' is not a folder name", "a path to a new folder")
    return output.parent / f"{output.name}.analysis"


def _read(request: AnalysisRequest, bars: Progress) -> tuple[list[Samples], list[Samples]]:
    files = request.setup.config.logs
    reader = LogReader(request.setup)
    if files is None:
        return [], []
    reading = bars.add_task("reading logs", total=len(files.train) + len(files.test))
    train, test = (
        reader.read(paths, sensors, lambda _: bars.advance(reading))
        for paths, sensors in ((files.train, request.proposed), (files.test, None))
    )
    check_read({"train": train, "test": test})
    return train, test


def scenarios(setup: RobotSetup, train: Sequence[Samples]) -> dict[str, tuple[ContactState, ...]]:
    """Contact states by scenario: those of the settings, or else of the logs, most frequent first.

    Raises:
        UnknownNameError: a frame that is no contact.
    """
    frames = [contact.frame for contact in setup.contacts]
    chosen = setup.config.analysis.scenarios
    if chosen is None:
        recorded: Counter[ContactState] = Counter()
        for samples in train:
            for state, index in chunks_by_state(samples):
                recorded[state] += len(samples[index])
        most_first = tuple(state for state, _ in recorded.most_common())
        return {"logs": most_first} if recorded else {"all_contacts": ((True,) * len(frames),)}
    out = {}
    for name, states in chosen.items():
        for frame in (frame for state in states for frame in state):
            if frame not in frames:
                raise UnknownNameError.at_field(f"analysis.scenarios.{name}", frame, frames)
        out[name] = tuple(dict.fromkeys(tuple(frame in state for frame in frames) for state in states))
    return out


def _plan_sensors(
    request: AnalysisRequest, states: tuple[ContactState, ...], train: Sequence[Samples], progress: StepCallback
) -> SensorPlan:
    """Plan the sensors of one scenario."""
    setup = request.setup
    settings = request.setup.config.analysis
    robot = setup.robot
    problem = PlanningProblem(
        robot=robot,
        contacts=setup.contacts,
        states=states,
        candidates=request.candidates,
        prior=parameter_scale(robot.nominal).flatten() * _free(setup),
        keep=request.keep,
        exclude=request.exclude,
        noise=setup.noise,
        logs=tuple(train),
        criterion=settings.criterion or ("stack" if robot.fixed_base else "per_sample"),
        seed=settings.seed,
    )
    with errors_at("analysis"):
        return plan_sensors(problem, progress)


def _analysis_of(request: AnalysisRequest, name: str, plan: SensorPlan, progress: StepCallback) -> ScenarioAnalysis:
    """A plan, with a check of the sensors that are proposed."""
    setup = request.setup
    problem = plan.problem
    contacts = request.setup.contacts
    progress("base parameters", 0, 1)
    if request.proposed is None:
        proposed = None
        at_best = problem.stack.problem(sensor_set(setup.robot, contacts, plan.chosen))
    else:
        proposed = plan.observability
        if not _is_chosen(plan, request.proposed, contacts):
            proposed = tuple(problem.assess(request.proposed, contacts))
        at_best = problem.stack.problem(request.proposed, contacts=contacts)
    progress("done", 1, 1)
    return ScenarioAnalysis(name, problem.states, plan, proposed, base_parameters(replace(at_best, free=_free(setup))))


def _free(setup: RobotSetup) -> np.ndarray:
    """Parameters that are free, (12 L,) bool."""
    return free_parameters(setup.robot, setup.config.estimator.friction) & ~setup.frozen()


def _progress(name: str, bars: Progress) -> StepCallback:
    bar = bars.add_task(f"{name}: looking for sensors", total=None)

    def progress(what: str, step: int, steps: int) -> None:
        bars.update(bar, description=f"{name}: {what}", completed=step, total=steps)

    return progress


def _sets_to_compare(
    request: AnalysisRequest, choices: Mapping[str, SensorPlan], train: Sequence[Samples]
) -> dict[str, SensorSet]:
    """Sensor sets to compare by accuracy: those with a name, and those planned for contact states of the logs."""
    setup = request.setup
    sets = dict(request.compared)
    recorded = {state for samples in train for state, _ in chunks_by_state(samples)}
    for name, choice in choices.items():
        known = any(_is_chosen(choice, other, setup.contacts) for other in sets.values())
        if known or not recorded & set(choice.problem.states):
            continue
        if scalar := _chosen_along_normals(choice, setup.contacts):
            needed = f"sensors.contact_wrenches: {{{scalar[0]}: [{NORMAL_FORCE}]}}"
            bound = f"the sensors of the file do not read the normal force of {', '.join(scalar)} ({needed})"
            warn(f"{bound}; the accuracy of the {_plan_label(name)} is unknown")
        else:
            sets[_plan_label(name)] = sensor_set(setup.robot, setup.contacts, choice.chosen, setup.noise)
    return sets


def _chosen_along_normals(choice: SensorPlan, contacts: Sequence[Contact]) -> tuple[str, ...]:
    """Frames of contacts at which a scalar sensor alone is chosen, while others of the same frames read wrenches."""
    wrench = sensor_set(choice.problem.robot, contacts, choice.chosen).wrench
    return tuple(
        planned.frame
        for planned, contact, row in zip(choice.problem.contacts, contacts, wrench, strict=True)
        if planned.along_normal != contact.along_normal and row.any() and not row[list(contact.components)].all()
    )


def _is_chosen(choice: SensorPlan, sensors: SensorSet, contacts: Sequence[Contact]) -> bool:
    """Whether a set, read along the axes of these contacts, is the chosen one; what none can exert does not count."""
    chosen = sensor_set(choice.problem.robot, contacts, choice.chosen)
    wrench, other = (measured_components(contacts, x) for x in (chosen, sensors))
    same = np.array_equal(chosen.torque, sensors.torque) and np.array_equal(wrench, other)
    return same and not _chosen_along_normals(choice, contacts)


def _write_analysis(analysis: Analysis, output: Path, overwrite: bool = False) -> None:
    """Write the folder; one that stands there may be replaced with `overwrite`."""
    setup = analysis.setup
    names = analysis.setup.robot.body_names
    texts = []
    figures = {}
    for scenario in analysis.scenarios:
        which = "planned" if scenario.proposed is None else "proposed"
        texts.append(base_parameters_text(f"{scenario.name}, {which} sensors", scenario.base, names))
        figures[f"sensors-{scenario.name}"] = _picture(setup, scenario)
    with during("writing", output), new_folder(output, overwrite, ANALYSIS) as folder:
        (folder / "config.yaml").write_text(dump_config(setup.config))
        write_json(folder / "analysis.json", analysis.to_dict())
        (folder / "base_parameters.txt").write_text("\n\n".join(texts))
        save_figures(figures, folder, setup.config.figures.format)


def _picture(setup: RobotSetup, scenario: ScenarioAnalysis) -> Figure:
    """The robot's tree with the planned sensors."""
    plan = scenario.plan
    robot = setup.robot
    sensors = sensor_set(robot, setup.contacts, plan.chosen)
    used = [c for c, *active in zip(setup.contacts, *scenario.states, strict=True) if any(active)]
    wrenches = {
        contact.frame: [
            WRENCH_COMPONENTS[k] if row[0] else contact.component_name(k) for k in np.flatnonzero(row).tolist()
        ]
        for contact, row in zip(plan.problem.contacts, sensors.wrench, strict=True)
    }
    measured = [name for name, taken in zip(robot.dof_names, sensors.torque, strict=True) if taken]
    constrained = [joint for branch in plan.branches if branch.constrained for joint in branch.joints]
    channels, possible = (
        len({channel for candidate in sensors for channel in candidate.readings})
        for sensors in (plan.chosen, plan.problem.candidates)
    )
    title = f"Sensors for {scenario.name}: {channels} of {possible} channels"
    return tree_figure(title, robot, used, measured, wrenches, constrained)
