"""`torchid identify`: from an experiment to an identification, and to a run folder, step by step."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from rich.progress import Progress

from torchid import distributed
from torchid.commands.chosen_settings import Choices, with_chosen_settings, with_ridge, with_sample_rates
from torchid.commands.evaluate import compare_forces
from torchid.commands.folder import RUN, check_free, claim_folder
from torchid.commands.plausibility import TrainingLogs, require_not_worse, require_plausible, suspected_mistake
from torchid.commands.run_folder import Identification, write_run
from torchid.commands.training import Training, descent_settings, require_trainable, training_folder
from torchid.config import ExperimentConfig, inputs_of
from torchid.errors import ConfigError, NumericalWarning, warn_about_file
from torchid.estimators import Estimate, violations
from torchid.estimators.conditions import term_violations
from torchid.fitting.experiment import Experiment, set_up, with_noise, with_task_weights
from torchid.fitting.factor_files import FactorFile, read_fleet
from torchid.fitting.fit import (
    Calibration,
    Comparison,
    Fit,
    LogFitter,
    calibrations,
    warn_of_confounded,
    warn_of_masked,
)
from torchid.fitting.left_out import CrossValidation, Scorer, calibrations_without_folds, gain_deviations
from torchid.fitting.noise import NoiseSummary, misfit, resting_joints, unfitted_friction
from torchid.fitting.posterior import fitted_posterior
from torchid.fitting.robust import RobustSummary, fit_robustly
from torchid.identifiability.base_parameters import StateReport, require_base, state_reports
from torchid.identifiability.confounding import LEAST_BLOCKS, TotalMass, mass_weights
from torchid.identifiability.information import Contributions, contributions
from torchid.parallel import one_thread
from torchid.parameters import PER_BODY
from torchid.problem import Metrics, RowBuilder, Samples
from torchid.problem.compression import (
    BY_FOLD,
    Block,
    Part,
    compress_in_blocks,
    fold_compressed,
    merge,
    split_into_folds,
)
from torchid.problem.contact_state import ContactState, state_name
from torchid.problem.metrics import LOG_SETS
from torchid.problem.samples import is_at_rest
from torchid.reading.log_reader import LogReader, check_read
from torchid.report.tables import progress_bars


@one_thread()
def identify(config: ExperimentConfig, resume: bool = False) -> Identification:
    """Fit the parameters and write the run folder, if there is an output; of several processes, the first writes.

    Args:
        config: the experiment.
        resume: go on with a training that was interrupted.

    Raises:
        InputError: whatever does not fit; nothing has been written then.
        BaseLostError: the sensors cannot see the base.
        KeyboardInterrupt: a training was interrupted; the message says how it can go on.
    """
    output = config.output
    trains = config.estimator.name == "sgd"
    resume = resume or (trains and output is not None and distributed.is_restart())
    with ExitStack() as stack:

        def claim() -> None:
            if trains and output is not None:
                stack.enter_context(claim_folder(training_folder(output)))
            require_trainable(config, resume)
            if output is not None:
                check_free(output, config.overwrite, RUN, inputs_of(config))

        distributed.from_first(claim, "output")
        bars = stack.enter_context(progress_bars())
        run, training = _identify(config, resume, bars)
        if output is not None:
            bars.add_task("writing", total=None)
            distributed.from_first(partial(write_run, run, output, config.overwrite, training), "run folder")
    return run


def _identify(config: ExperimentConfig, resume: bool, bars: Progress) -> tuple[Identification, Training | None]:
    """What the logs say, and how it was trained, if so."""
    clock = Stopwatch()
    with clock("read"):
        experiment = set_up(config)
        conditions = experiment.conditions()
        if config.estimator.name == "sgd":
            descent_settings(config)  # before any work
    data = (_data_of_factors if config.logs.compressed else _data_of_logs)(experiment, clock, bars)
    logs = data.logs
    builder = data.builder
    with clock("ridge"):
        experiment, ridge = with_ridge(data.experiment, data.parts, data.blocks, builder, conditions, bars)
    fitter = experiment.fitter(builder, conditions)
    checked = TrainingLogs(experiment, bars)
    evaluation = experiment.evaluation(experiment.noise_of_readings)

    with clock("solve"):
        training = None
        solve = None
        if config.estimator.name == "sgd":
            require_plausible(fitter.fit(data.parts), checked)
            training = Training(experiment)
            solve = partial(training.run, data.parts, fitter=fitter, logs=logs, evaluation=evaluation, bars=bars,
                            resume=resume)  # fmt: skip
        fit, robust = _robust(fitter.fit(data.parts, solve), data, fitter, bars)
        fit, mass = _judged(fit, fitter, data, checked)
        data.parts = []
        problem = fit.assembly.problem
        compared = calibrations(fit, experiment.robot, builder)
        shown = [*logs["test"], *logs["train"]][:1]
    with clock("identifiability"):
        by_state, added = _identifiability(fit, fitter, data, bars)
    with clock("evaluate"):
        scorer = Scorer(evaluation, builder)
        held_out, metrics, evaluated = _errors(scorer, fit, fitter, compared, data, bars)
        forces = distributed.from_first(lambda: [compare_forces(evaluation, log, compared) for log in shown], "forces")
        friction = unfitted_friction(problem, experiment.robot)

    phi, scale = (x.reshape(-1, PER_BODY) for x in (fit.estimate.phi, problem.scale))
    terms_beyond = term_violations(problem, fit.estimate.phi, fit.estimate.psi)
    run = Identification(
        experiment=experiment,
        estimate=fit.estimate,
        extras=fit.extras,
        noise=data.noise,
        motion_noise=fit.assembly.noise,
        misfit=misfit(fit.estimate, data.noise, data.blocks, fit.jackknife, friction),
        resting=resting_joints(problem, experiment.robot, builder, logs["train"]),
        at_rest=[name for name in LOG_SETS if is_at_rest(logs[name])],
        robust=robust,
        states=data.states,
        by_state=by_state,
        contributions=added,
        metrics=metrics,
        evaluated=evaluated,
        violations=[*violations(phi, scale, conditions), *terms_beyond],
        seconds=clock.seconds,
        samples=sum(map(len, data.blocks)),
        factors=data.factors,
        excluded=data.excluded,
        mass=mass,
        posterior=fitted_posterior(fit, experiment.robot, conditions),
        validation=held_out,
        ridge=ridge,
        choices=with_sample_rates(data.choices, experiment, logs["train"]),
        forces=next(iter(forces), None),
    )
    logs.clear()  # checks of a log and figures need room, too
    data.blocks = []
    require_not_worse(run.worse, run.metrics["train"].identified, experiment.sensors, checked)
    return replace(run, suspected=suspected_mistake(run, checked)), training


def _judged(fit: Fit, fitter: LogFitter, data: TrainingData, checked: TrainingLogs) -> tuple[Fit, TotalMass]:
    """The fit with errors by the sensors' gains, and its total mass, once it is plausible.

    Raises:
        ImplausibleFitError: no robot can have left it.
        ConfigError: task weights, with logs too short for the intervals that know of these.
    """
    experiment = data.experiment
    train = data.logs["train"]
    gains = distributed.from_first(
        partial(gain_deviations, train, fitter, experiment.terms, experiment.config.sensors.gain_error), "gains"
    )
    fit = replace(fit, estimate=replace(fit.estimate, gain_error=np.linalg.norm(gains, axis=0)))
    gain_error = float(np.linalg.norm(gains @ mass_weights(len(experiment.robot.bodies))))
    mass = require_plausible(fit, checked, train, gain_error)
    warn_of_confounded([x for x in fit.extras if x.extra.what not in data.choices.adopted_terms])
    warn_of_masked(fit.parts, fitter.builder)
    if experiment.sensors.task_weights is not None and fit.jackknife is None:  # its errors alone know of weights
        reason = f"needs {LEAST_BLOCKS} blocks of the logs for its intervals"
        raise ConfigError.at_field("estimator.task_weights", reason, "longer logs, or leave it out")
    return fit, mass


def _identifiability(
    fit: Fit, fitter: LogFitter, data: TrainingData, bars: Progress
) -> tuple[dict[str, Estimate], Contributions]:
    """What each contact state determines on its own, most frequent first, and what each log, state and sensor adds."""
    builder = fitter.builder
    parts = fit.parts
    if data.factors:  # by contact state
        parts = [*(part for x in data.factors for part in x.log.by_state), *(x for x in parts if x.unloaded)]
    whole = merge(parts, builder, "source", "state", "unloaded")
    samples = Counter[ContactState]()
    for part in whole:
        samples[part.state] += part.samples
    by_state = {}
    for state, _ in samples.most_common():
        problem = fitter.assemble([part for part in whole if part.state == state]).problem
        by_state[state_name(builder.contacts, state)] = fitter.least_squares.solve(problem)
    bar = bars.add_task("leaving out each in turn", total=None)
    problem = fit.assembly.problem
    tolerance = fitter.estimator.rank_tolerance
    done = partial(bars.advance, bar)
    added = distributed.from_first(
        lambda: contributions(whole, data.logs["train"], builder, problem, fitter.robot.dof_names, tolerance, done),
        "contributions",
    )
    bars.update(bar, total=1, completed=1)
    return by_state, added


def _errors(
    scorer: Scorer,
    fit: Fit,
    fitter: LogFitter,
    compared: Comparison[Calibration],
    data: TrainingData,
    bars: Progress,
) -> tuple[CrossValidation | None, dict[str, Comparison[Metrics]], dict[str, int]]:
    """Errors of cross-validation, and by set of logs, with the number of samples whose forces were predicted."""
    test = data.logs["test"]
    without_folds = calibrations_without_folds(fit, fitter)
    evaluated = {"train": scorer.scored(data.blocks)[1], "test": sum(map(len, test))}
    done = partial(bars.advance, bars.add_task("evaluating", total=sum(evaluated.values())))
    parts = merge(fit.parts, fitter.builder, *BY_FOLD)
    train, held_out = scorer.score_training(data.blocks, parts, compared, without_folds, done)
    metrics = {"train": train}
    if test:
        metrics["test"] = Comparison(*scorer.score(test, {log.fold: compared for log in test}, progress=done))
    return held_out, metrics, {name: evaluated[name] for name in metrics}


# ------------------------------------------------------------------------------------------------------- what is fitted


@dataclass
class Stopwatch:
    """Adds up seconds by step: `with clock("read"): ...`."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Add what the block takes to a step."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


@dataclass
class TrainingData:
    """Training logs in folds, or factors of them, with the noise of their weights, and compressed; test logs.

    `experiment`: with that noise, and what the logs have chosen. `factors`: files that the training logs come from, if
    they do.
    """

    experiment: Experiment
    logs: dict[str, list[Samples]]
    factors: list[FactorFile]
    excluded: Mapping[str, int]
    states: list[StateReport]
    noise: NoiseSummary
    builder: RowBuilder
    blocks: Sequence[Block]
    parts: list[Part]
    choices: Choices


def _data_of_logs(experiment: Experiment, clock: Stopwatch, bars: Progress) -> TrainingData:
    """The logs of an experiment, read and compressed, with its settings chosen."""
    with clock("settings"):
        experiment, choices = with_chosen_settings(experiment, bars)
    with clock("read"):
        logs, excluded = _read(experiment, bars)
    with clock("noise"):
        states = state_reports(logs["train"], experiment.builder(experiment.sensors))
        require_base(states, experiment.config.sensors.on_base_lost, experiment.contacts)
        noise = distributed.from_first(partial(experiment.estimate_noise, logs["train"], experiment.sensors), "noise")
        experiment = with_task_weights(with_noise(experiment, noise), logs["train"])
    with clock("compress"):
        builder = experiment.builder(experiment.sensors)
        blocks = split_into_folds(logs["train"], builder)
        streaming = bars.add_task("streaming samples", total=sum(map(len, logs["train"])))
        parts = compress_in_blocks(blocks, builder, progress=partial(bars.advance, streaming))
    return TrainingData(experiment, logs, [], excluded, states, noise, builder, blocks, parts, choices)


def _data_of_factors(experiment: Experiment, clock: Stopwatch, bars: Progress) -> TrainingData:
    """The logs of an experiment that fits factors of logs."""
    with clock("read"):
        reading = bars.add_task("reading factors", total=len(experiment.config.logs.train))
        fleet = read_fleet(experiment, lambda _: bars.advance(reading))
        require_base(fleet.states, experiment.config.sensors.on_base_lost, experiment.contacts)
        logs, _ = _read(fleet.experiment, bars)
    with clock("compress"):
        builder = fleet.experiment.builder(fleet.experiment.sensors)
        blocks = fold_compressed([x.log for x in fleet.files], builder)
        parts = [part for block in blocks for part in block.parts]
    return TrainingData(
        experiment=fleet.experiment,
        logs=logs,
        factors=fleet.files,
        excluded={x.log.source: x.excluded for x in fleet.files if x.excluded},
        states=fleet.states,
        noise=fleet.noise,
        builder=builder,
        blocks=blocks,
        parts=parts,
        choices=Choices(),
    )


def _read(experiment: Experiment, bars: Progress) -> tuple[dict[str, list[Samples]], dict[str, int]]:
    """Logs by use but for those of which there are factors, and how many samples of each were left out as rejected.

    Those that are trained on, or decide when to stop, have every sensor of the set.
    """
    reader = LogReader(experiment)
    settings = experiment.config.logs
    files = {name: getattr(settings, name) for name in ("train", "validation", "test")}
    if settings.compressed:
        files["train"] = []
    reading = bars.add_task("reading logs", total=sum(map(len, files.values())))
    logs = {
        name: reader.read(paths, None if name == "test" else experiment.sensors, lambda _: bars.advance(reading))
        for name, paths in files.items()
    }
    check_read(logs)
    return logs, reader.excluded


# -------------------------------------------------------------------------------------------------------------- the fit


def _robust(fit: Fit, data: TrainingData, fitter: LogFitter, bars: Progress) -> tuple[Fit, RobustSummary | None]:
    """The fit with outliers down-weighted, if the settings say so; only batch estimators can.

    Warns:
        NumericalWarning: the passes were too few.
    """
    loss = data.experiment.loss
    train = [x for x in data.blocks if isinstance(x, Samples)]
    if loss is None:
        return fit, None
    bar = bars.add_task("weighing outliers down", total=loss.passes * sum(map(len, train)))
    robust = fit_robustly(train, fitter, loss, first=fit, parts=data.parts, progress=partial(bars.advance, bar))
    bars.update(bar, total=1, completed=1)
    if not robust.summary.converged:
        message = f"estimator.robust: not converged after {robust.summary.passes} passes. Raise its passes."
        warn_about_file(message, NumericalWarning)
    return robust.fit, robust.summary
