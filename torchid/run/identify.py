"""`torchid identify`: from an experiment to a run folder."""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from rich.progress import Progress

from torchid.analysis.contributions import Contributions, contributions
from torchid.analysis.known import total_mass
from torchid.config import ExperimentConfig
from torchid.errors import NumericalWarning, SensorError
from torchid.estimators import Estimate, LeastSquares, violations
from torchid.parameters import PER_BODY, Array
from torchid.problem import LinearProblem, RowBuilder, Samples
from torchid.problem.plan import State, state_name
from torchid.problem.states import check_base, state_reports
from torchid.problem.streaming import Part, compress_parts
from torchid.report.metrics import SETS, Evaluation, Metrics
from torchid.run.calibration import Calibration, errors, warn_of_confounded
from torchid.run.claim import claimed
from torchid.run.estimation import assembled, batch_estimator, stated_conditions
from torchid.run.experiment import Experiment, set_up
from torchid.run.fit import Fit, fitted
from torchid.run.folder import check_free
from torchid.run.noise import weighed
from torchid.run.progress import progress_bars
from torchid.run.reading import LogReader
from torchid.run.results import Identification, write_run
from torchid.run.robust import RobustSummary, loss_of, robust_fit
from torchid.run.training import Training, check_training, training_folder

_IMPLAUSIBLE = 5.0  # residual in units of the stated noise; recorded logs with honest noise figures stay below 2
_UNEXPLAINED = 0.5  # of the weighted forces' rms: recorded logs stay below 0.35


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
        check_free(config.output, config.overwrite)
        return _identify(config, source, resume)


def _identify(config: ExperimentConfig, source: object, resume: bool) -> Identification:
    clock = _Clock()
    with progress_bars() as bars:
        with clock("read"):
            experiment = set_up(config, source)
            conditions = stated_conditions(config.estimator, experiment.robot, source)
            training = Training(config, experiment.robot, source) if config.estimator.name == "sgd" else None
            estimator = training or batch_estimator(config.estimator, conditions)
            reader = LogReader(experiment)
            logs = _read(reader, experiment, bars)
        with clock("noise"):
            states = state_reports(logs["train"], _builder(experiment))
            check_base(states, config.sensors.on_base_lost)
            experiment, noise = weighed(experiment, logs["train"], source)
        with clock("compress"):
            builder = _builder(experiment)
            parts = _compressed(builder, logs["train"], bars)
        evaluation = Evaluation(experiment.robot, experiment.contacts, config.device, experiment.terms)
        with clock("solve"):
            solve: Callable[[LinearProblem], Estimate]
            if isinstance(estimator, Training):
                evaluate = partial(_identified_metrics, evaluation, logs)
                solve = partial(estimator.run, builder=builder, logs=logs, evaluate=evaluate, bars=bars, resume=resume)
            else:
                solve = estimator.solve
            fit = fitted(parts, experiment, builder, solve, source)
            fit, robust = _robust(fit, experiment, builder, solve, logs["train"], bars, source)
            del parts
            estimate, problem = fit.estimate, fit.assembly.problem
            _check_sense(estimate, problem, source)
            warn_of_confounded(fit.extras, source)
        with clock("identifiability"):
            alone = _by_state(experiment, builder, fit.parts, source)
            adds = _contributions(experiment, builder, fit.parts, logs["train"], problem, bars)
        with clock("evaluate"):
            both = Calibration.both(experiment, experiment.sensors, estimate.phi, fit.extras)
            metrics = _metrics(evaluation, logs, both, bars)
        broken = violations(estimate.phi.reshape(-1, PER_BODY), problem.scale.reshape(-1, PER_BODY), conditions)
        samples = sum(map(len, logs["train"]))
        run = Identification(
            experiment,
            estimate,
            fit.extras,
            noise,
            robust,
            states,
            alone,
            adds,
            metrics,
            broken,
            clock.seconds,
            samples,
            reader.excluded,
            total_mass(fit.assembly, estimate, config.estimator.rank_tolerance),
        )
        bars.add_task("writing", total=None)
        write_run(run, evaluation, (logs["test"] or logs["train"])[0], both, training)
    return run


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
    settings, samples = experiment.config.estimator, Counter[State]()
    for part in parts:
        samples[part.state] += part.samples
    estimator, out = LeastSquares(settings.ridge, settings.rank_tolerance), {}
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


def _metrics(
    evaluation: Evaluation,
    logs: Mapping[str, Sequence[Samples]],
    both: tuple[Calibration, Calibration],
    bars: Progress,
) -> dict[str, tuple[Metrics, Metrics]]:
    """Nominal and identified metrics by set of logs."""
    sets = {name: logs[name] for name in SETS if logs[name]}
    bar = bars.add_task("evaluating", total=sum(len(log) for same in sets.values() for log in same))
    return {name: errors(evaluation, same, both, lambda n: bars.advance(bar, n)) for name, same in sets.items()}


def _identified_metrics(
    evaluation: Evaluation, logs: Mapping[str, Sequence[Samples]], phi: Array
) -> dict[str, Metrics]:
    return {name: evaluation.metrics(logs[name], phi[None])[0] for name in SETS if logs[name]}


def _check_sense(estimate: Estimate, problem: LinearProblem, source: object) -> None:
    """Refuse a fit of nothing, and warn of one that the dynamics cannot explain."""
    if not estimate.rank:
        raise SensorError(source, "sensors", "no parameter is in reach of them", "other sensors, contacts or logs")
    left = np.sqrt(estimate.cost / max(estimate.rows, 1))  # not corrected for the fit, which may be far from the best
    share = np.sqrt(estimate.cost / max(problem.cost(np.zeros_like(estimate.phi)), np.finfo(float).tiny))
    if left > _IMPLAUSIBLE:
        found = f"forces differ from any rigid-body model by {left:.3g} times the stated sensor noise"
        advice = "check units, frames, quaternion order and contact_active, or state the noise that there is"
        warnings.warn(f"{source}: {found}; {advice}", NumericalWarning, stacklevel=3)
    elif share > _UNEXPLAINED:
        found = f"no rigid-body model explains {100.0 * share:.3g} % of the weighted forces"
        warnings.warn(f"{source}: {found}; check units, frames, quaternion order and contact_active",
                      NumericalWarning, stacklevel=3)  # fmt: skip
