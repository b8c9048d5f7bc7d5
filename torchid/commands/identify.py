"""`torchid identify`: from an experiment to an identification, and to a run folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from rich.progress import Progress

from torchid import distributed
from torchid.commands.chosen_settings import with_sample_rates
from torchid.commands.evaluate import compare_forces, trace_forces
from torchid.commands.folder import RUN, check_free, claim_folder
from torchid.commands.plausibility import TrainingLogs, require_not_worse, require_plausible, suspected_mistake
from torchid.commands.prepared_data import PreparedData, Stopwatch, prepare
from torchid.commands.results import Identification, write_run
from torchid.commands.run_figures import Drawing, drawing, figures_left, fit_figures
from torchid.commands.training import Training, require_trainable, training_folder
from torchid.config import ExperimentConfig, inputs_of
from torchid.errors import ConfigError, NumericalWarning, warn_about_file
from torchid.estimators import Conditions, Estimate, Violation, violations
from torchid.estimators.conditions import term_violations
from torchid.fitting.calibration import Calibration, Comparison, warn_of_confounded, warn_of_masked
from torchid.fitting.cross_validation import CrossValidation, Scorer, calibrations_without_folds
from torchid.fitting.factor_files import FactorFile
from torchid.fitting.fit import Fit, LogFitter
from torchid.fitting.left_out import gain_deviations
from torchid.fitting.noise import misfit, resting_joints, unfitted_friction
from torchid.fitting.posterior import fitted_posterior
from torchid.fitting.robust import RobustSummary, fit_robustly
from torchid.identifiability.confounding import LEAST_BLOCKS, TotalMass, mass_weights
from torchid.identifiability.information import Contributions, contributions
from torchid.parallel import one_thread
from torchid.parameters import PER_BODY, Array
from torchid.problem import Evaluation, LinearProblem, Metrics, Samples
from torchid.problem.compression import BY_FOLD, Block, Part, merge
from torchid.problem.contact_state import ContactState, state_name
from torchid.problem.metrics import LOG_SETS
from torchid.problem.motion import is_at_rest
from torchid.report.forces import ForceSeries
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
    trains, output = config.estimator.name == "sgd", config.output
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
        run, training, begun = _identify(config, resume, bars, stack)
        if output is not None:
            bars.add_task("writing", total=None)
            begun.append(stack.enter_context(drawing(figures_left(run, begun), config)))
            distributed.from_first(partial(write_run, run, output, config.overwrite, training, begun), "run folder")
    return run


@dataclass(frozen=True)
class _Solved:
    """A fit, how outliers were down-weighted and how it was trained, if so, and the total mass."""

    fit: Fit
    robust: RobustSummary | None
    training: Training | None
    mass: TotalMass


def _solved(
    ready: PreparedData, evaluation: Evaluation, checked: TrainingLogs, bars: Progress, resume: bool
) -> _Solved:
    """The fit of prepared data, which may be that of a robot."""
    experiment, fitter, logs = ready.experiment, ready.fitter, ready.logs
    training, solve = None, None
    if experiment.config.estimator.name == "sgd":
        require_plausible(fitter.fit(ready.parts), checked)
        training = Training(experiment)

        def evaluate(phi: Array) -> dict[str, Metrics]:
            return {name: evaluation.metrics(logs[name], phi[None])[0] for name in LOG_SETS if logs[name]}

        solve = partial(
            training.run, ready.parts, fitter=fitter, logs=logs, evaluate=evaluate, bars=bars, resume=resume
        )
    fit = fitter.fit(ready.parts, solve)
    fit, robust = _robust(fit, ready, bars)
    terms, gain = experiment.terms, experiment.config.sensors.gain_error
    gains = distributed.from_first(partial(gain_deviations, logs["train"], fitter, terms, gain), "gains")
    fit = replace(fit, estimate=replace(fit.estimate, gain_error=np.linalg.norm(gains, axis=0)))
    of_mass = float(np.linalg.norm(gains @ mass_weights(len(experiment.robot.bodies))))
    mass = require_plausible(fit, checked, logs["train"], of_mass)
    warn_of_confounded([one for one in fit.extras if one.extra.what not in ready.choices.adopted_terms])
    warn_of_masked(fit.parts, fitter.builder)
    if experiment.sensors.task_weights is not None and fit.jackknife is None:  # the only errors that know of weights
        found = f"set, of logs of fewer than {LEAST_BLOCKS} blocks, whose scatter intervals come from"
        raise ConfigError.at_field("estimator.task_weights", found, "longer logs, or no such key")
    return _Solved(fit, robust, training, mass)


def _identify(
    config: ExperimentConfig, resume: bool, bars: Progress, stack: ExitStack
) -> tuple[Identification, Training | None, list[Drawing]]:
    """What the logs say, how it was trained, if so, and figures of it that are drawn until the stack is left."""
    clock = Stopwatch()
    ready = prepare(config, clock, bars)
    experiment, fitter, logs, blocks = ready.experiment, ready.fitter, ready.logs, ready.blocks
    checked, builder = TrainingLogs(experiment, bars), fitter.builder
    evaluation = experiment.evaluation(experiment.noise_of_readings)
    with clock("solve"):
        solved = _solved(ready, evaluation, checked, bars, resume)
        fit, ready.parts = solved.fit, []
        problem, compared = fit.assembly.problem, experiment.calibrations(fit, builder)
        shown = [*logs["test"], *logs["train"]][:1]
        forces = distributed.from_first(lambda: [compare_forces(evaluation, log, compared) for log in shown], "forces")
        begun = _begin_figures(ready, fit, forces, stack)
    with clock("identifiability"):
        whole = merge(_with_states(fit.parts, ready.factors), builder, "source", "state", "unloaded")
        alone = _by_state(fitter, whole)
        added = distributed.from_first(partial(_contributions, ready, whole, problem, bars), "contributions")
    with clock("evaluate"):
        without_folds = calibrations_without_folds(fit, fitter)
        scorer, of_blocks = Scorer(evaluation, builder), merge(fit.parts, builder, *BY_FOLD)
        scores = _scores(scorer, logs["test"], blocks, of_blocks, compared, without_folds, bars)
        traces = distributed.from_first(lambda: [trace_forces(evaluation, log, compared) for log in shown], "traces")
        friction = unfitted_friction(problem, experiment.robot)
        left = misfit(fit.estimate, ready.noise, blocks, fit.jackknife, friction)
    run = Identification(
        experiment=experiment,
        estimate=fit.estimate,
        extras=fit.extras,
        noise=ready.noise,
        motion_noise=fit.assembly.noise,
        misfit=left,
        resting=resting_joints(problem, experiment.robot, builder, logs["train"]),
        at_rest=[name for name in LOG_SETS if is_at_rest(logs[name])],
        robust=solved.robust,
        states=ready.states,
        by_state=alone,
        contributions=added,
        metrics=scores.metrics,
        evaluated=scores.samples,
        violations=_violations(fit.estimate, problem, ready.conditions),
        seconds=clock.seconds,
        samples=sum(map(len, blocks)),
        factors=ready.factors,
        excluded=ready.excluded,
        mass=solved.mass,
        posterior=fitted_posterior(fit, experiment.robot, ready.conditions),
        validation=scores.validation,
        ridge=ready.ridge,
        choices=with_sample_rates(ready.choices, experiment, logs["train"]),
        forces=next(iter(forces), None),
        traces=next(iter(traces), None),
    )
    logs.clear()  # checks of a log and figures need room, too
    ready.blocks = blocks = []
    require_not_worse(run.worse, run.metrics["train"].identified, experiment.sensors, checked)
    return replace(run, suspected=suspected_mistake(run, checked)), solved.training, begun


def _begin_figures(ready: PreparedData, fit: Fit, forces: Sequence[ForceSeries], stack: ExitStack) -> list[Drawing]:
    """Figures of a fit that one process, if it writes a run, draws beside what follows, until the stack is left."""
    experiment = ready.experiment
    if experiment.config.output is None or distributed.world_size() > 1:  # several processes draw all of them at last
        return []
    figures = fit_figures(experiment.robot, fit.estimate, fit.extras, ready.ridge, *forces)
    return [stack.enter_context(drawing(figures, experiment.config))]


def _robust(fit: Fit, ready: PreparedData, bars: Progress) -> tuple[Fit, RobustSummary | None]:
    """The fit with outliers down-weighted, if the settings say so; only batch estimators can.

    Warns:
        NumericalWarning: the passes were too few.
    """
    loss, train = ready.experiment.loss, [x for x in ready.blocks if isinstance(x, Samples)]
    if loss is None:
        return fit, None
    bar = bars.add_task("weighing outliers down", total=loss.passes * sum(map(len, train)))
    robust = fit_robustly(train, ready.fitter, loss, first=fit, parts=ready.parts, progress=partial(bars.advance, bar))
    bars.update(bar, total=1, completed=1)
    if not robust.summary.converged:
        message = f"estimator.robust: not converged after {robust.summary.passes} passes; accepted: more passes"
        warn_about_file(message, NumericalWarning)
    return robust.fit, robust.summary


def _with_states(parts: Sequence[Part], factors: Sequence[FactorFile]) -> Sequence[Part]:
    """The parts of a fit, by contact state where they come from factors, too."""
    if not factors:
        return parts
    return [*(part for one in factors for part in one.log.by_state), *(part for part in parts if part.unloaded)]


def _by_state(fitter: LogFitter, parts: Sequence[Part]) -> dict[str, Estimate]:
    """What each contact state determines on its own, by least squares, most frequent first."""
    samples = Counter[ContactState]()
    for part in parts:
        samples[part.state] += part.samples
    by_state = {state: [part for part in parts if part.state == state] for state, _ in samples.most_common()}
    problems = {state_name(fitter.builder.contacts, x): fitter.assemble(own).problem for x, own in by_state.items()}
    return {name: fitter.least_squares.solve(problem) for name, problem in problems.items()}


def _contributions(ready: PreparedData, parts: Sequence[Part], problem: LinearProblem, bars: Progress) -> Contributions:
    """What each log, contact state and sensor adds."""
    leaving_out = bars.add_task("leaving out each in turn", total=None)
    tolerance, names = ready.experiment.config.estimator.rank_tolerance, ready.experiment.robot.dof_names
    done, builder = partial(bars.advance, leaving_out), ready.fitter.builder
    out = contributions(parts, ready.logs["train"], builder, problem, names, tolerance, done)
    bars.update(leaving_out, total=1, completed=1)
    return out


def _violations(estimate: Estimate, problem: LinearProblem, conditions: Conditions) -> list[Violation]:
    phi, scale = (x.reshape(-1, PER_BODY) for x in (estimate.phi, problem.scale))
    return [*violations(phi, scale, conditions), *term_violations(problem, estimate.phi, estimate.psi)]


@dataclass
class _Scores:
    """Metrics and number of evaluated samples by set of logs, and of fits without a fold each on that fold."""

    metrics: dict[str, Comparison[Metrics]]
    samples: dict[str, int]
    validation: CrossValidation | None


def _scores(
    scorer: Scorer,
    test: Sequence[Samples],
    blocks: Sequence[Block],
    parts: Sequence[Part],
    compared: Comparison[Calibration],
    without_folds: Sequence[Comparison[Calibration]],
    bars: Progress,
) -> _Scores:
    """Metrics of the training logs, whose blocks the `parts` are of, and of the test logs."""
    unseen = sum(map(len, test))
    done = partial(bars.advance, bars.add_task("evaluating", total=scorer.scored(blocks)[1] + unseen))
    train = scorer.score_training(blocks, parts, compared, without_folds, done)
    scores = _Scores({"train": train.metrics}, {"train": train.samples}, train.cross_validation)
    if test:
        scores.metrics["test"] = scorer.score_logs(test, compared, done)
        scores.samples["test"] = unseen
    return scores
