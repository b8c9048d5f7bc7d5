"""`torchid identify`: from an experiment to a run folder."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from torchid.config import ExperimentConfig, dump_config
from torchid.errors import NumericalWarning, SensorError
from torchid.estimators import ConsistentEstimate, Estimate
from torchid.parameters import PER_BODY, Array
from torchid.problem import RowBuilder, Samples, compress, linear_problem
from torchid.problem.predict import force_series
from torchid.problem.states import StateReport, check_base, state_reports
from torchid.report.figures import ForceSeries, error_figure, force_figure, parameter_figure
from torchid.report.metrics import Evaluation, Metrics
from torchid.report.parameters_json import parameters_document
from torchid.report.tensorboard import write_events
from torchid.report.urdf_export import identified_urdf
from torchid.robot import Robot
from torchid.run.estimation import estimate_parameters
from torchid.run.experiment import Experiment, set_up
from torchid.run.folder import check_free, new_folder, write_json
from torchid.run.progress import progress_bars

_PLOTTED_SAMPLES = 3000
_IMPLAUSIBLE = 5.0  # residual in units of the stated noise; recorded logs with honest noise figures stay below 2


@dataclass(frozen=True)
class Identification:
    """A finished run: the fit, and nominal and identified metrics by set of logs ("train", "test")."""

    experiment: Experiment
    estimate: Estimate
    states: list[StateReport]
    metrics: dict[str, tuple[Metrics, Metrics]]
    seconds: dict[str, float]
    samples: int


@dataclass
class _Clock:
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - start


def identify(config: ExperimentConfig, source: object = "experiment") -> Identification:
    """Fit the parameters and write the run folder.

    Args:
        config: the experiment.
        source: named in errors.

    Raises:
        InputError: whatever does not fit; nothing has been written then.
        BaseLostError: the sensors cannot see the base.
    """
    check_free(config.output, config.overwrite)
    clock = _Clock()
    with progress_bars() as bars:
        with clock("read"):
            experiment = set_up(config, source)
            paths = [*config.logs.train, *config.logs.test]
            reading = bars.add_task("reading logs", total=len(paths))
            train = experiment.read(config.logs.train, True, lambda _: bars.advance(reading))
            test = experiment.read(config.logs.test, False, lambda _: bars.advance(reading))
        robot, count = experiment.robot, sum(map(len, train))
        with clock("compress"):
            builder = RowBuilder(robot, experiment.contacts, experiment.sensors).to(config.device)
            states = state_reports(train, builder)
            check_base(states, config.sensors.on_base_lost)
            streaming = bars.add_task("streaming samples", total=count)
            factor = compress(train, builder, progress=lambda n: bars.advance(streaming, n))
        with clock("solve"):
            problem = linear_problem(factor, builder, robot, config.estimator.friction)
            estimate = estimate_parameters(problem, config.estimator, robot, source)
            _check_sense(estimate, source)
        with clock("evaluate"):
            evaluation = Evaluation(robot, experiment.contacts, config.device)
            candidates = np.stack([robot.nominal.flatten(), estimate.phi])
            evaluating = bars.add_task("evaluating", total=count + sum(map(len, test)))
            metrics: dict[str, tuple[Metrics, Metrics]] = {}
            for name, logs in (("train", train), ("test", test)):
                if logs:
                    nominal, identified = evaluation.metrics(logs, candidates, lambda n: bars.advance(evaluating, n))
                    metrics[name] = (nominal, identified)
        run = Identification(experiment, estimate, states, metrics, clock.seconds, count)
        bars.add_task("writing", total=None)
        _write(run, evaluation, (test or train)[0], candidates)
    return run


def _check_sense(estimate: Estimate, source: object) -> None:
    """Refuse a fit of nothing, and warn of one that the dynamics cannot explain."""
    if not estimate.rank:
        raise SensorError(source, "sensors", "no parameter is in reach of them", "other sensors, contacts or logs")
    if estimate.residual_std > _IMPLAUSIBLE:
        found = f"forces differ from any rigid-body model by {estimate.residual_std:.3g} times the stated sensor noise"
        advice = "check units, frames, quaternion order and contact_active, or state the noise that there is"
        warnings.warn(f"{source}: {found}; {advice}", NumericalWarning, stacklevel=3)


def _write(run: Identification, evaluation: Evaluation, shown: Samples, candidates: Array) -> None:
    config, robot = run.experiment.config, run.experiment.robot
    figures = {
        "forces": forces_of(evaluation, shown, candidates, robot),
        "errors": error_figure(run.metrics),
        "parameters": parameter_figure(
            robot.body_names,
            robot.nominal,
            run.estimate.phi.reshape(-1, PER_BODY),
            run.estimate.standard_error.reshape(-1, PER_BODY),
        ),
    }
    with new_folder(config.output, config.overwrite) as folder:
        (folder / "config.yaml").write_text(dump_config(config))
        write_json(folder / "parameters.json", parameters_document(robot, run.estimate))
        write_json(folder / "metrics.json", metrics_document(run))
        (folder / "identified.urdf").write_bytes(identified_urdf(robot, run.estimate.phi.reshape(-1, PER_BODY)))
        for name, figure in figures.items():
            figure.savefig(folder / f"{name}.png", dpi=130)
        write_events(folder, run.metrics, run.estimate, dump_config(config), _hyperparameters(config), figures)


def forces_of(evaluation: Evaluation, samples: Samples, candidates: Array, robot: Robot) -> Figure:
    """The figure of measured and predicted forces of a log's first samples."""
    part = samples[:_PLOTTED_SAMPLES]
    measured, (nominal, identified) = force_series(evaluation.builder, part, candidates)
    series = ForceSeries(Path(samples.source).name, part.time.numpy(), measured, nominal, identified)
    return force_figure(series, robot.joint_names, robot.base_rows)


def metrics_document(run: Identification) -> dict[str, object]:
    """What `metrics.json` holds: errors of the identified parameters, and of the nominal ones beside them."""
    estimate, robot = run.estimate, run.experiment.robot
    document: dict[str, object] = {}
    for name in ("train", "test"):
        pair = run.metrics.get(name)
        document[name] = None if pair is None else pair[1].as_dict()
        document[f"{name}_nominal"] = None if pair is None else pair[0].as_dict()
    if isinstance(estimate, ConsistentEstimate):
        document["consistency"] = consistency_document(estimate, robot)
    variation = {name: pair[1].base_force_of_variation for name, pair in run.metrics.items()}
    return document | {
        "base_force_rms_of_variation": variation,
        "rank": estimate.rank,
        "parameters": int(estimate.phi.size),
        "condition_number": estimate.condition_number if estimate.rank else None,
        "samples": run.samples,
        "rows": estimate.rows,
        "residual_std": estimate.residual_std,
        "total_mass": float(estimate.phi.reshape(-1, PER_BODY)[:, 0].sum()),
        "total_mass_nominal": float(robot.nominal[:, 0].sum()),
        "contact_states": [asdict(state) for state in run.states],
        "seconds": run.seconds,
    }


def consistency_document(estimate: ConsistentEstimate, robot: Robot) -> dict[str, object]:
    """What `metrics.json` says of an estimate that meets its conditions."""
    eigenvalues = zip(robot.body_names, estimate.eigenvalues, strict=True)
    return {
        "objective": estimate.objective,
        "unconstrained_objective": estimate.unconstrained,
        "gap": estimate.gap,
        "certified_gap": estimate.certified_gap,
        "smallest_eigenvalue": {name: float(x) for name, x in eigenvalues if np.isfinite(x)},
        "steps": estimate.steps,
    }


def _hyperparameters(config: ExperimentConfig) -> dict[str, str | float | bool]:
    return {
        "sensors": config.sensors.set or "by name",
        "estimator": config.estimator.name,
        "ridge": config.estimator.ridge,
        "friction": config.estimator.friction,
        "cutoff_hz": config.preprocessing.cutoff_hz or 0.0,
    }
