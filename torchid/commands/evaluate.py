"""`torchid evaluate`: errors of the parameters of a finished run on further logs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from torchid import ranks
from torchid.commands.folder import EVALUATION, RUN, check_free, new_folder, refuse_link, write_json
from torchid.commands.reading import LogReader
from torchid.commands.results import draw_forces, noise_of_readings
from torchid.config import load_config
from torchid.errors import ConfigError, about_file, during, warn
from torchid.fitting.calibration import Calibration, Comparison
from torchid.fitting.cross_validation import Scorer
from torchid.fitting.experiment import Experiment, set_up
from torchid.guards import MAX_JSON, MAX_YAML, read_bytes
from torchid.logs.time_range import split_range
from torchid.problem import Metrics, RowBuilder
from torchid.report.figures import error_figure, save_figure
from torchid.report.parameter_files import read_parameters, read_shared_extras
from torchid.report.tables import progress_bars


@dataclass(frozen=True)
class EvaluatedRun:
    """Errors of the parameters of a run by the name of a log, and the folder that they were written to."""

    metrics: dict[str, Comparison[Metrics]]
    output: Path


def evaluate(run: str | Path, logs: Sequence[str | Path], device: str | None = None) -> EvaluatedRun:
    """Evaluate nominal and identified parameters; of processes that share the work, the first writes.

    Results go to `RUN/evaluation/<name of the first log>` and replace an earlier evaluation of that name.

    Args:
        run: folder that `identify` wrote.
        logs: log files, or parts of them (`walk.npz[30:]`), preprocessed as the run's own were.
        device: where to compute; None: where the run did.

    Raises:
        InputError: the folder is no run, or a log does not fit its robot.
    """
    folder = Path(run)
    output = _output(folder, logs)
    config = load_config(folder / "config.yaml", [f"device={device}"] if device else [])
    with progress_bars() as bars:
        with about_file(folder / "config.yaml"):
            experiment = set_up(config)
        builder = experiment.builder(experiment.sensors)
        evaluation = experiment.evaluation(noise_of_readings(config, _states_noise(folder / "metrics.json")))
        compared = _calibrations(experiment, builder, folder / "parameters.json")
        reading = bars.add_task("reading logs", total=len(logs))
        reader = LogReader(experiment, folder)
        samples = reader.read([Path(log) for log in logs], None, lambda _: bars.advance(reading))
        evaluating = bars.add_task("evaluating", total=sum(map(len, samples)))
        scorer = Scorer(evaluation, builder)
        metrics = {}
        for log in samples:
            pair = scorer.score_logs([log], compared, lambda n: bars.advance(evaluating, n))
            metrics[split_range(log.source).name] = pair
            if not any(x is not None for x in pair.identified.rms.values()):
                warn(f"{log.source}: neither joint torques nor contact wrenches to compare predictions with")
        document = _document(metrics, reader.excluded)

        def write() -> None:
            with during("writing", output), new_folder(output, True, EVALUATION) as new:
                (new / "config.yaml").write_bytes(read_bytes(folder / "config.yaml", MAX_YAML))
                write_json(new / "metrics.json", document)
                save_figure(draw_forces(evaluation, samples[0], compared), new / "forces.png")
                save_figure(error_figure(metrics), new / "errors.png")

        ranks.from_first(write, "evaluation folder")
    return EvaluatedRun(metrics, output)


def _output(run: Path, logs: Sequence[str | Path]) -> Path:
    """The folder of an evaluation of some logs.

    Raises:
        ConfigError: the folder is no run, two logs have one name, a name that no folder can have, or something else stands where results go.
    """
    if not (run / "config.yaml").is_file():
        raise ConfigError(run, "RUN", "no config.yaml in it", "a folder that torchid identify wrote")
    parts = [split_range(log) for log in logs]
    names = [part.name for part in parts]
    again = [name for name in names if names.count(name) > 1]
    if again:
        raise ConfigError("command line", "--log", f"several logs named '{again[0]}'", "logs of different names")
    if names[0] in (".", ".."):
        raise ConfigError(
            "command line", "--log", f"'{logs[0]}', whose name is of dots alone", "another name of the file"
        )
    output = run / RUN.inner_folder / names[0]

    def check() -> None:
        refuse_link(output.parent)
        check_free(output, True, EVALUATION, [file.path for part in parts for file in part.files])

    ranks.from_first(check, "output")
    return output


def _states_noise(path: Path) -> bool:
    """Whether the settings of a run stated the noise of any sensor; its settings have the estimated one as well."""
    try:
        groups = json.loads(read_bytes(path, MAX_JSON))["noise"]["groups"]
        return any(group["origin"] == "stated" for group in groups)
    except (OSError, ValueError, LookupError, TypeError):
        return False


def _document(metrics: Mapping[str, Comparison[Metrics]], excluded: Mapping[str, int]) -> dict[str, dict[str, object]]:
    """What `metrics.json` has, by name of a log."""
    document: dict[str, dict[str, object]] = {
        name: {
            "identified": pair.identified.as_dict(),
            "nominal": pair.nominal.as_dict(),
            "noise_floor": pair.identified.noise,
        }
        for name, pair in metrics.items()
    }
    for path, count in excluded.items():
        document[split_range(path).name]["excluded_samples"] = count
    return document


def _calibrations(experiment: Experiment, builder: RowBuilder, path: Path) -> Comparison[Calibration]:
    """Parameters of a `parameters.json`, each with the extra parameters of all logs that suit them."""
    robot, loss = experiment.robot, experiment.loss
    phi = read_parameters(path, robot).flatten()
    nominal, identified = (
        {("", label): value for label, value in read_shared_extras(path, column).items()}
        for column in ("nominal_value", "value")
    )
    return Comparison(
        Calibration(robot=robot, builder=builder, phi=robot.nominal.flatten(), values=nominal, loss=loss),
        Calibration(robot=robot, builder=builder, phi=phi, values=identified, loss=loss),
    )
