"""`torchid identify`: from an experiment to a run folder."""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial

from rich.progress import Progress

from torchid.commands.folder import RUN, check_free, claimed
from torchid.commands.plausibility import check_not_worse, check_plausible
from torchid.commands.reading import LogReader
from torchid.commands.results import Identification, write_run
from torchid.commands.training import Training, check_training, descent_settings, training_folder
from torchid.config import ExperimentConfig, inputs_of
from torchid.errors import NumericalWarning
from torchid.estimators import Conditions, Estimate, LeastSquares, violations
from torchid.fitting.calibration import Calibration, warn_of_confounded, warn_of_disagreement
from torchid.fitting.cross_validation import CrossValidation, Judge, Pair, RidgeChoice, chosen_ridge
from torchid.fitting.experiment import Experiment, set_up
from torchid.fitting.fit import Fit, assembled, fits_without_folds, fitted, stand_in, stated_conditions
from torchid.fitting.noise import NoiseSummary, weighed
from torchid.fitting.robust import RobustSummary, loss_of, robust_fit
from torchid.identifiability.contributions import Contributions, contributions
from torchid.identifiability.rank import StateReport, check_base, state_reports
from torchid.parameters import PER_BODY, Array
from torchid.problem import Evaluation, LinearProblem, Metrics, RowBuilder, Samples, compress_parts
from torchid.problem.compression import Part, merge_folds, merge_states, split_into_folds
from torchid.problem.contact_state import ContactState, state_name
from torchid.problem.metrics import SETS
from torchid.report.tables import progress_bars


@dataclass
class _Clock:
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - start


def identify(config: ExperimentConfig, source: object = "experiment", resume: bool = False) -> Identification:
    """Fit the parameters and write the run folder.

    Args:
        config: the experiment.
        source: named in errors.
        resume: go on with a training that was interrupted.

    Raises:
        InputError: whatever does not fit; nothing has been written then.
        BaseLostError: the sensors cannot see the base.
        KeyboardInterrupt: a training was interrupted; the message says how it can go on.
    """
    trains = config.estimator.name == "sgd"
    with claimed(training_folder(config.output)) if trains else nullcontext():
        check_training(config, resume, source)
        check_free(config.output, config.overwrite, RUN, (source, *inputs_of(config)))
        return _identify(config, source, resume)


@dataclass
class _Prepared:
    """Logs on their way to a fit: read, with the noise and the ridge settled, cut into folds and compressed."""

    experiment: Experiment
    conditions: Conditions
    logs: dict[str, list[Samples]]
    excluded: Mapping[str, int]
    states: list[StateReport]
    noise: NoiseSummary
    builder: RowBuilder
    blocks: list[Samples]
    parts: list[Part]
    ridge: RidgeChoice | None


def _prepare(config: ExperimentConfig, source: object, clock: _Clock, bars: Progress) -> _Prepared:
    with clock("read"):
        experiment = set_up(config, source)
        conditions = stated_conditions(config.estimator, experiment.robot, source)
        if config.estimator.name == "sgd":
            descent_settings(config, source)  # before any work
        reader = LogReader(experiment)
        logs = _read(reader, experiment, bars)
    with clock("noise"):
        states = state_reports(logs["train"], _builder(experiment))
        check_base(states, config.sensors.on_base_lost)
        experiment, noise = weighed(experiment, logs["train"], source)
    with clock("compress"):
        builder = _builder(experiment)
        blocks = split_into_folds(logs["train"], builder)
        parts = _compressed(builder, blocks, bars)
    with clock("ridge"):
        experiment, ridge = _with_ridge(experiment, parts, blocks, builder, bars, source)
    return _Prepared(experiment, conditions, logs, reader.excluded, states, noise, builder, blocks, parts, ridge)


def _identify(config: ExperimentConfig, source: object, resume: bool) -> Identification:
    clock = _Clock()
    with progress_bars() as bars:
        ready = _prepare(config, source, clock, bars)
        experiment, builder, logs, blocks = ready.experiment, ready.builder, ready.logs, ready.blocks
        evaluation = Evaluation(experiment.robot, experiment.contacts, config.device, experiment.terms)
        training = None
        with clock("solve"):
            settings = experiment.config.estimator
            instead = stand_in(settings, ready.conditions).solve
            solve: Callable[[LinearProblem], Estimate] = instead
            if settings.name == "sgd":
                check_plausible(fitted(ready.parts, experiment, builder, instead, source), experiment, source)
                training = Training(experiment.config, experiment.robot, source)
                evaluate = partial(_identified_metrics, evaluation, logs)
                solve = partial(training.run, builder=builder, logs=logs, evaluate=evaluate, bars=bars, resume=resume)
            fit = fitted(ready.parts, experiment, builder, solve, source)
            fit, robust = _robust(fit, experiment, builder, solve, blocks, bars, source)
            ready.parts = []
            estimate, problem = fit.estimate, fit.assembly.problem
            mass = check_plausible(fit, experiment, source)
            warn_of_confounded(fit.extras, source)
            warn_of_disagreement(fit, experiment, builder, source)
        with clock("identifiability"):
            whole = merge_folds(fit.parts, builder)
            alone = _by_state(experiment, builder, whole, source)
            adds = _contributions(experiment, builder, whole, logs["train"], problem, bars)
        with clock("evaluate"):
            left_out = fits_without_folds(fit.parts, experiment, builder, instead, source)
            both, *without = (_calibrations(experiment, one) for one in (fit, *left_out))
            judge, of_blocks = Judge(evaluation, builder), merge_states(fit.parts, builder)
            metrics, validation = _metrics(judge, logs["test"], blocks, of_blocks, (both, without), bars)
        broken = violations(estimate.phi.reshape(-1, PER_BODY), problem.scale.reshape(-1, PER_BODY), ready.conditions)
        run = Identification(
            experiment=experiment,
            estimate=estimate,
            extras=fit.extras,
            noise=ready.noise,
            robust=robust,
            states=ready.states,
            by_state=alone,
            adds=adds,
            metrics=metrics,
            violations=broken,
            seconds=clock.seconds,
            samples=sum(map(len, logs["train"])),
            excluded=ready.excluded,
            mass=mass,
            validation=validation,
            ridge=ready.ridge,
        )
        check_not_worse(run.worse, experiment, source)
        bars.add_task("writing", total=None)
        write_run(run, evaluation, (logs["test"] or logs["train"])[0], both, training)
    return run


def _with_ridge(
    experiment: Experiment,
    parts: Sequence[Part],
    blocks: Sequence[Samples],
    builder: RowBuilder,
    bars: Progress,
    source: object,
) -> tuple[Experiment, RidgeChoice | None]:
    """The experiment with a ridge that is a number, and how it was chosen, if it was."""
    config = experiment.config
    if not config.estimator.chooses_ridge:
        return experiment, None
    bar = bars.add_task("choosing the ridge", total=None)
    choice = chosen_ridge(parts, blocks, experiment, experiment.sensors, builder, source)
    bars.update(bar, total=1, completed=1)
    chosen = replace(config, estimator=replace(config.estimator, ridge=choice.ridge))
    return replace(experiment, config=chosen), choice


def _read(reader: LogReader, experiment: Experiment, bars: Progress) -> dict[str, list[Samples]]:
    """Logs by use; those that are trained on, or decide when to stop, have every sensor of the set."""
    files = experiment.config.logs
    reading = bars.add_task("reading logs", total=len(files.train) + len(files.validation) + len(files.test))
    return {
        name: reader.read(
            getattr(files, name), None if name == "test" else experiment.sensors, lambda _: bars.advance(reading)
        )
        for name in ("train", "validation", "test")
    }


def _builder(experiment: Experiment) -> RowBuilder:
    scene = experiment.robot, experiment.contacts, experiment.sensors, experiment.terms
    return RowBuilder(*scene).to(experiment.config.device)


def _compressed(builder: RowBuilder, train: Sequence[Samples], bars: Progress) -> list[Part]:
    streaming = bars.add_task("streaming samples", total=sum(map(len, train)))
    return compress_parts(train, builder, progress=lambda n: bars.advance(streaming, n))


def _robust(
    fit: Fit,
    experiment: Experiment,
    builder: RowBuilder,
    solve: Callable[[LinearProblem], Estimate],
    train: Sequence[Samples],
    bars: Progress,
    source: object,
) -> tuple[Fit, RobustSummary | None]:
    """The fit with outliers weighed down, if that is asked for.

    Warns:
        NumericalWarning: the passes were too few.
    """
    settings = experiment.config.estimator.robust
    if settings is None:
        return fit, None
    bar = bars.add_task("weighing outliers down", total=settings.passes * sum(map(len, train)))
    better, found = robust_fit(
        fit,
        loss_of(settings.loss, settings.tuning),
        settings.passes,
        train,
        builder,
        lambda parts: fitted(parts, experiment, builder, solve, source),
        lambda n: bars.advance(bar, n),
    )
    bars.update(bar, total=1, completed=1)
    if not found.converged:
        message = f"{source}: estimator.robust: not settled after {found.passes} passes; accepted: more passes"
        warnings.warn(message, NumericalWarning, stacklevel=3)
    return better, found


def _by_state(
    experiment: Experiment, builder: RowBuilder, parts: Sequence[Part], source: object
) -> dict[str, Estimate]:
    """What each contact state determines on its own, by least squares, most frequent first."""
    settings, samples = experiment.config.estimator, Counter[ContactState]()
    for part in parts:
        samples[part.state] += part.samples
    estimator, out = LeastSquares(settings.pull, settings.rank_tolerance), {}
    for state, _ in samples.most_common():
        of_state = [part for part in parts if part.state == state]
        problem = assembled(of_state, builder, experiment.robot, settings, source).problem
        out[state_name(builder.contacts, state)] = estimator.solve(problem)
    return out


def _contributions(
    experiment: Experiment,
    builder: RowBuilder,
    parts: Sequence[Part],
    train: Sequence[Samples],
    problem: LinearProblem,
    bars: Progress,
) -> Contributions:
    """What each log, contact state and sensor adds."""
    leaving_out = bars.add_task("leaving out each in turn", total=None)
    tolerance, names = experiment.config.estimator.rank_tolerance, experiment.robot.dof_names
    found = contributions(parts, train, builder, problem, names, tolerance, lambda n: bars.advance(leaving_out, n))
    bars.update(leaving_out, total=1, completed=1)
    return found


def _calibrations(experiment: Experiment, fit: Fit) -> tuple[Calibration, Calibration]:
    return Calibration.both(experiment, experiment.sensors, fit.estimate.phi, fit.extras)


def _metrics(
    judge: Judge,
    test: Sequence[Samples],
    blocks: Sequence[Samples],
    parts: Sequence[Part],
    calibrations: tuple[tuple[Calibration, Calibration], Sequence[tuple[Calibration, Calibration]]],
    bars: Progress,
) -> tuple[dict[str, Pair], CrossValidation | None]:
    """Nominal and identified metrics by set of logs, and of fits without a fold each on that fold.

    `parts`: of the blocks of the training logs; `calibrations`: of the fit, and of the fits without a fold.
    """
    both, left_out = calibrations
    bar = bars.add_task("evaluating", total=sum(map(len, [*blocks, *test])))

    def done(samples: int) -> None:
        bars.advance(bar, samples)

    train, validation = judge.training_errors(blocks, parts, both, left_out, done)
    return {"train": train} | ({"test": judge.errors(test, both, done)} if test else {}), validation


def _identified_metrics(
    evaluation: Evaluation, logs: Mapping[str, Sequence[Samples]], phi: Array
) -> dict[str, Metrics]:
    return {name: evaluation.metrics(logs[name], phi[None])[0] for name in SETS if logs[name]}
