"""`torchid evaluate`: errors of the parameters of a finished run on further logs, and forces beside measured ones."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter
from rich.progress import Progress

from torchid import distributed
from torchid.commands.folder import EVALUATION, EVALUATIONS, check_free, new_folder, refuse_link, write_json
from torchid.commands.run_folder import Identification, force_figures
from torchid.config import load_config
from torchid.config.robot import NoiseConfig
from torchid.errors import ConfigError, about_file, during, warn
from torchid.fitting.experiment import Experiment, require_device, set_up, stated_noise, with_estimated_noise
from torchid.fitting.fit import Calibration, Comparison
from torchid.fitting.left_out import Scorer
from torchid.fitting.posterior import RESIDUAL, RigidPlusResidual
from torchid.guards import MAX_JSON, MAX_YAML, read_bytes
from torchid.logs.time_range import log_title, split_range
from torchid.parallel import one_thread
from torchid.parameters import Array
from torchid.problem import Evaluation, Metrics, Samples
from torchid.problem.contact_state import state_name
from torchid.problem.metrics import (
    DECISIVE_GROUPS,
    WHITENED,
    at_motors,
    describe_errors,
    force_series,
    group_name,
    noise_series,
    pressure_series,
    torque_noise_series,
    torque_series,
)
from torchid.problem.samples import is_at_rest
from torchid.reading.log_reader import LogReader
from torchid.report.figure_style import save_figures
from torchid.report.figures import error_figure
from torchid.report.forces import ForceSeries
from torchid.report.parameter_files import read_parameters, read_shared_extras
from torchid.report.tables import progress_bars
from torchid.reprs import short_repr
from torchid.robot import Robot

_SETTINGS = "config.yaml"
_METRICS = "metrics.json"
_NOISE: TypeAdapter[NoiseConfig] = TypeAdapter(NoiseConfig)
FAR_OFF = 5.0
"""Times the error on the run's own logs from which on a log is not one of the same robot, moving otherwise."""
_SAMPLES = 10_000  # of a log, that figures show
_MOST_UNKNOWN = 0.1  # share of samples with unknown generalized forces up to which figures show these


@dataclass(frozen=True, kw_only=True)
class EvaluatedRun:
    """Errors of a run's parameters on further logs.

    Attributes:
        metrics: errors of the nominal and identified parameters, by log name.
        excluded: number of rejected samples, by log name.
        forces: measured and predicted forces of the first log.
        robot: of the run.
        at_rest: names of logs without motion.
        usual: errors on the run's own logs, by group of rows (the larger of train and test).
        explained: whether the model explains the forces of the run.
        output: output folder, if any.
        with_residual: errors of joint torques with the run's learned module, by log name.
    """

    metrics: dict[str, Comparison[Metrics]]
    excluded: dict[str, int]
    forces: ForceSeries
    robot: Robot
    at_rest: Sequence[str] = ()
    usual: Mapping[str, float] = field(default_factory=dict)
    explained: bool = True
    output: Path | None = None
    with_residual: Mapping[str, Metrics] = field(default_factory=dict)

    __repr__ = short_repr

    def far_off(self) -> str | None:
        """Text about a log that is predicted much worse than the run's own logs; None without one."""
        ratios = {
            (name, group): error / self.usual[group]
            for name, pair in self.metrics.items()
            for group in DECISIVE_GROUPS
            if (error := pair.identified.rms_of(group)) is not None and self.usual.get(group, 0.0) > 0.0
        }
        far = {key: ratio for key, ratio in ratios.items() if ratio >= FAR_OFF}
        if not far:
            return None
        name, group = worst = max(far, key=lambda key: (key[1] != WHITENED, far[key]))  # in N or N m, if it can be
        text = f"{name}: the error ({group_name(group)}) is {far[worst]:.0f} times that on the run's own logs"
        return f"{text}. Is it another robot, a payload or another friction? Check this log: torchid check."

    def _headline(self) -> str:
        texts = [f"{name}: {describe_errors(*pair)}" for name, pair in self.metrics.items()]
        return f"{self.robot.format} -> identified; {'; '.join(texts)}"

    def to_dict(self) -> dict[str, dict[str, object]]:
        """Content of `metrics.json`, by log name."""
        document: dict[str, dict[str, object]] = {
            name: {
                "identified": pair.identified.as_dict(),
                "nominal": pair.nominal.as_dict(),
                "noise_floor": pair.identified.noise,
            }
            for name, pair in self.metrics.items()
        }
        for name, count in self.excluded.items():
            document[name]["excluded_samples"] = count
        for name, errors in self.with_residual.items():
            rms = {group: errors.rms_of(group) for group in ("joint_torque", WHITENED)}
            document[name]["with_residual"] = {f"{group}_rms": x for group, x in rms.items()} | {
                "joint_torque_rms_by_joint": errors.by_joint_rms
            }
        return document


@dataclass(frozen=True, kw_only=True)
class FittedRun:
    """What a run has found, from its folder or from memory.

    `experiment`: with the noise that it estimated. `usual` and `explained` are as `EvaluatedRun` has them.
    """

    experiment: Experiment
    calibrations: Comparison[Calibration]
    usual: Mapping[str, float] = field(default_factory=dict)
    explained: bool = True
    learned: RigidPlusResidual | None = None


@one_thread()
def evaluate(
    run: str | Path,
    logs: Sequence[str | Path],
    device: str | None = None,
    write: bool = True,
    output: str | Path | None = None,
    overwrite: bool = False,
) -> EvaluatedRun:
    """Evaluate nominal and identified parameters; of processes that share the work, the first writes.

    Results go to `RUN/evaluation/<name of the first log>` and replace an earlier evaluation of that name, or to
    `output`.

    Args:
        run: folder that `identify` wrote.
        logs: log files, or parts of them (`walk.npz[30:]`), preprocessed as the run's own were.
        device: where to compute; None: where the run did.
        write: whether results are written at all.
        output: folder to write.
        overwrite: whether an evaluation that stands there may be replaced.

    Raises:
        InputError: the folder is no run, a log does not fit its robot, or `output` may not be replaced.
    """
    folder = Path(run)
    require_run(folder)
    given = None if output is None else Path(output)
    replaces = output is None or overwrite
    place = _output(folder, logs, given, replaces) if write else None
    with progress_bars() as bars:
        fitted = read_run(folder, device)
        if not fitted.usual:
            warn(f"{folder / _METRICS}: not readable. Whitened residuals use a guess of the noise.")
        evaluated = replace(_evaluate(fitted, logs, folder, bars), output=place)
        if place is not None:
            form = fitted.experiment.config.figures.format
            write_there = partial(_write, evaluated, place, folder / _SETTINGS, form, replaces)
            distributed.from_first(write_there, "evaluation folder")
    return evaluated


def require_run(folder: Path) -> None:
    """Make sure that a folder is that of a run. Raises ConfigError: it has no settings."""
    if not (folder / _SETTINGS).is_file():
        raise ConfigError(folder, "RUN", f"{_SETTINGS} is missing", "a folder written by torchid identify")


def read_run(folder: Path, device: str | None = None) -> FittedRun:
    """What a run has found, from its folder.

    Args:
        folder: that `identify` wrote.
        device: where to compute; None: where the run did.

    Raises:
        InputError: it is no run, or does not fit its robot any more.
    """
    require_run(folder)
    settings = folder / _SETTINGS
    parameters_file = folder / "parameters.json"
    config = load_config(settings, [f"device={device}"] if device else [], reads_logs=False)
    with about_file(settings):
        experiment, usual, explained = _with_own_metrics(set_up(config), folder / _METRICS)
    shared = Comparison(
        read_shared_extras(parameters_file, "nominal_value"), read_shared_extras(parameters_file, "value")
    )
    calibrations = _calibrations(experiment, read_parameters(parameters_file, experiment.robot), shared)
    learned = RigidPlusResidual.load(folder / RESIDUAL, experiment.robot) if (folder / RESIDUAL).is_file() else None
    return FittedRun(
        experiment=experiment, calibrations=calibrations, usual=usual, explained=explained, learned=learned
    )


@one_thread()
def evaluate_identification(run: Identification, logs: Sequence[str | Path], device: str | None = None) -> EvaluatedRun:
    """As `evaluate`, of a run that need not have been written; nothing is."""
    experiment = run.experiment
    if device is not None:
        require_device(device)
        experiment = replace(experiment, config=replace(experiment.config, device=device))
    shared = [(term.extra.label, term) for term in run.extras if not term.log]
    values = Comparison({x: term.nominal_value for x, term in shared}, {x: term.value for x, term in shared})
    fitted = FittedRun(
        experiment=experiment,
        calibrations=_calibrations(experiment, run.phi, values),
        usual=_usual([pair.identified.as_dict() for pair in run.metrics.values()]),
        explained=run.misfit.explained,
    )
    with progress_bars() as bars:
        return _evaluate(fitted, logs, None, bars)


def _evaluate(fitted: FittedRun, logs: Sequence[str | Path], folder: Path | None, bars: Progress) -> EvaluatedRun:
    """Errors of what a run has found; `folder`: on whose disk large logs are kept."""
    experiment = fitted.experiment
    compared = fitted.calibrations
    _log_names(logs)
    evaluation = experiment.evaluation(experiment.noise_of_readings)
    reading = bars.add_task("reading logs", total=len(logs))
    reader = LogReader(experiment, folder)
    samples = reader.read([Path(log) for log in logs], None, lambda _: bars.advance(reading))
    evaluating = bars.add_task("evaluating", total=sum(map(len, samples)))
    scorer = Scorer(evaluation, compared.identified.builder)
    metrics = {}
    with_residual = {}
    learned = fitted.learned
    for log in samples:
        pair = Comparison(*scorer.score([log], {log.fold: compared}, progress=lambda n: bars.advance(evaluating, n)))
        metrics[split_range(log.source).name] = pair
        if learned is not None:
            with_module = replace(compared.identified, phi=learned.phi.numpy())
            freed = learned.without_residual(log)
            (with_residual[split_range(log.source).name],) = scorer.score([freed], {log.fold: [with_module]})
        if not any(x is not None for x in pair.identified.rms.values()):
            warn(f"{log.source}: predictions cannot be compared: no joint torques and no contact wrenches.")
    excluded = {split_range(path).name: count for path, count in reader.excluded.items()}
    forces = distributed.from_first(partial(compare_forces, evaluation, samples[0], compared), "forces")
    return EvaluatedRun(
        metrics=metrics,
        excluded=excluded,
        forces=forces,
        robot=experiment.robot,
        at_rest=[split_range(log.source).name for log in samples if is_at_rest([log])],
        usual=fitted.usual,
        explained=fitted.explained,
        with_residual=with_residual,
    )


def _calibrations(experiment: Experiment, phi: Array, shared: Comparison[dict[str, float]]) -> Comparison[Calibration]:
    """Nominal and identified parameters (L, 12), each with the extra parameters of all logs, by label."""
    robot = experiment.robot
    builder = experiment.builder(experiment.sensors)
    nominal, identified = (
        Calibration(
            robot=robot,
            builder=builder,
            phi=of_bodies.flatten(),
            values={("", label): value for label, value in values.items()},
        )
        for of_bodies, values in zip((robot.nominal, phi), shared, strict=True)
    )
    return Comparison(nominal, identified)


def _write(evaluated: EvaluatedRun, output: Path, config: Path, form: str, overwrite: bool) -> None:
    """Write the folder, beside the settings of the run, with figures in a format."""
    with during("writing", output), new_folder(output, overwrite, EVALUATION) as new:
        (new / "config.yaml").write_bytes(read_bytes(config, MAX_YAML))
        write_json(new / "metrics.json", evaluated.to_dict())
        figures = {
            **{name: draw() for name, draw in force_figures(evaluated.forces, evaluated.robot).items()},
            "errors": error_figure(evaluated.metrics, evaluated.robot.format),
        }
        save_figures(figures, new, form)


def _log_names(logs: Sequence[str | Path]) -> list[str]:
    """Names of the logs, without their folders. Raises ConfigError: two have the same, or there is none."""
    names = [split_range(log).name for log in logs]
    if not names:
        raise ConfigError.at_field("logs", "none given", "logs to evaluate")
    again = [name for name in names if names.count(name) > 1]
    if again:
        raise ConfigError.at_field("logs", f"several logs named '{again[0]}'", "logs of different names")
    return names


def _output(run: Path, logs: Sequence[str | Path], given: Path | None, overwrite: bool) -> Path:
    """The folder of an evaluation of some logs, in that of the run if none is given.

    Raises:
        ConfigError: two logs have one name, it is of dots alone, or something else stands where results go.
    """
    name = _log_names(logs)[0]
    if given is None and name in (".", ".."):
        raise ConfigError.at_field("logs", f"'{logs[0]}' has a name of dots", "another file name")
    output = run / EVALUATIONS / name if given is None else given
    inputs = [file.path for log in logs for file in split_range(log).files]

    def check() -> None:
        if given is None:
            refuse_link(output.parent)
        check_free(output, overwrite, EVALUATION, inputs if given is None else [run, *inputs])

    distributed.from_first(check, "output")
    return output


def _with_own_metrics(experiment: Experiment, path: Path) -> tuple[Experiment, dict[str, float], bool]:
    """A run's experiment with the noise that it estimated, its errors, and whether the model explains its forces.

    Nothing of figures that cannot be read.
    """
    try:
        document = json.loads(read_bytes(path, MAX_JSON))
        any_stated = any(group["origin"] == "stated" for group in document["noise"]["groups"])
        used = stated_noise(_NOISE.validate_python(document["noise"]["used"]), experiment.robot)
        usual = _usual([document.get(name) or {} for name in ("train", "test")])
        explained = bool((document.get("misfit") or {}).get("explained", True))
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return experiment, {}, True
    return with_estimated_noise(experiment, used, any_stated), usual, explained


def _usual(documents: Sequence[Mapping[str, object]]) -> dict[str, float]:
    """The larger error of each group of rows in documents of `Metrics`."""
    usual: dict[str, float] = {}
    for document in documents:
        for group in DECISIVE_GROUPS:
            error = document.get(group if group == WHITENED else f"{group}_rms")
            if isinstance(error, float):
                usual[group] = max(error, usual.get(group, 0.0))
    return usual


def compare_forces(evaluation: Evaluation, samples: Samples, compared: Comparison[Calibration]) -> ForceSeries:
    """Forces of a whole log: nominal, identified, and measured as the latter calibrates it.

    Generalized forces if contact forces are measured, else joint torques by `torque_series`. Each prediction is as far
    from what was measured as from readings that are calibrated for it. Of a long log every k-th sample.
    """
    builder = evaluation.builder
    base = evaluation.robot.base_rows
    step = max(1, -(-len(samples) // _SAMPLES))
    parts = [calibration.calibrate([samples], step)[0] for calibration in compared]
    part = parts[1]
    series = [
        force_series(builder, readings, calibration.parameters(evaluation)[None])
        for readings, calibration in zip(parts, compared, strict=True)
    ]
    torques = [torque_series(builder, readings, forces) for readings, (_, forces) in zip(parts, series, strict=True)]
    unknown = np.isnan(series[1][0]) & np.isfinite(torques[1][0])
    recovered = bool(len(part)) and unknown[:, base:].any(axis=1).mean() > _MOST_UNKNOWN
    (measured, nominal), (calibrated, identified) = (
        at_motors(builder, readings, np.stack([forces, *predicted]))
        for readings, (forces, predicted) in zip(parts, torques if recovered else series, strict=True)
    )
    forces = np.stack([calibrated, nominal + np.nan_to_num(calibrated - measured), identified])  # NaN: not measured
    noise = None
    if evaluation.noise is not None:
        noise = (torque_noise_series if recovered else noise_series)(builder, part, evaluation.noise)
    pressure = None
    if recovered:
        forces[..., :base] = np.nan
    elif base:
        pressure = pressure_series(builder, part, forces[..., :6], evaluation.least_carried)
    present = list(dict.fromkeys(map(tuple, part.active.tolist())))
    rate = 1.0 / float(samples.time.diff().median()) if len(samples) > 1 else np.nan
    return ForceSeries(
        source=log_title(samples.source),
        time=part.time.numpy(),
        measured=forces[0],
        nominal=forces[1],
        identified=forces[2],
        noise=noise,
        pressure=pressure,
        recovered=recovered,
        states=tuple(state_name(builder.contacts, state) for state in present),
        state=np.array([present.index(tuple(active)) for active in part.active.tolist()]),
        rate=rate,
        bandwidth=0.5 * rate / max(samples.oversampling, step),
    )
