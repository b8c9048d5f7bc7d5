"""A finished identification, and the files of its run folder: numbers, models, figures, events and the page."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from torchid.commands.answer import answer, summary_lines
from torchid.commands.check import check_experiment
from torchid.commands.folder import (
    RUN,
    check_free,
    check_free_file,
    file_checksum,
    new_folder,
    read_manifest,
    refuse_link,
    write_json,
)
from torchid.commands.results import Results
from torchid.commands.training import Training, body_eigenvalues, known_parameters
from torchid.config import ExperimentConfig, dump_config, inputs_of
from torchid.errors import ConfigError, InputError, during, excerpt
from torchid.estimators import ConstrainedEstimate, Estimate, SgdEstimate
from torchid.fitting.factor_files import FactorFile
from torchid.fitting.fit import list_confounded
from torchid.fitting.noise import Misfit
from torchid.fitting.posterior import POSTERIOR, RESIDUAL, RigidPlusResidual, write_posterior
from torchid.guards import MAX_JSON, MAX_YAML, read_bytes
from torchid.identifiability.information import Contributions
from torchid.logs.containers import atomic_output
from torchid.logs.time_range import log_title
from torchid.parallel import share_between_forks, thread_count
from torchid.parameters import PER_BODY
from torchid.problem import Metrics
from torchid.problem.extras import NoiseGroups
from torchid.problem.metrics import LOG_SETS, describe_worse
from torchid.report import identified_name, identified_robot, identified_urdf, parameters_document
from torchid.report.figure_style import draw_for
from torchid.report.figures import (
    contribution_figure,
    error_figure,
    extra_figure,
    identifiability_figure,
    inertia_figure,
    parameter_figure,
    ridge_figure,
)
from torchid.report.forces import ForceSeries, force_figure, pressure_figure, spectrum_figure
from torchid.report.log_checks import log_check_document
from torchid.report.page import FIGURES, RunFiles, page_text, versions
from torchid.report.tables import table_text, verdict_counts_table
from torchid.robot import Robot
from torchid.staging import atomic_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = "report.html"
DATA = "report.json"
_JSON = ("parameters.json", "metrics.json", DATA)

_WRITTEN = "a folder written by this version of torchid identify"


@dataclass(frozen=True, kw_only=True, repr=False)
class Identification(Results):
    """Result of `identify`; `run["l_knee"]` gives the estimate of a body, by its name or that of its joint.

    Its attributes are those of `torchid.commands.results.Results`.
    """

    def __repr__(self) -> str:
        return "\n".join(summary_lines(self))

    def to_dict(self) -> dict[str, Any]:
        """Content of `parameters.json`, `metrics.json` and `config.yaml` of a run folder."""
        parameters = parameters_document(self.experiment.robot, self.estimate, self.by_state, self.extras)
        config = yaml.safe_load(dump_config(self.experiment.config))
        return {"parameters": parameters, "metrics": _metrics_document(self), "config": config}

    def to_urdf(self, path: str | Path, overwrite: bool = False) -> Path:
        """Write the URDF with the identified parameters; references to meshes do not change.

        Raises:
            ConfigError: the file exists and `overwrite` is not set, or it is an input.

        Warns:
            TorchidWarning: a body is not physically consistent.
        """
        inputs = inputs_of(self.experiment.config)
        check_free_file(path := Path(path), "path", overwrite, inputs, "overwrite=True")
        with atomic_output(path) as new:
            new.write_bytes(identified_urdf(self.experiment.robot, self.phi))
        return path

    def write(self, output: str | Path, overwrite: bool = False, learned: RigidPlusResidual | None = None) -> Path:
        """Write the run folder of `torchid identify`; with `learned`, the residual module too, which `evaluate` uses.

        Raises:
            ConfigError: the folder exists and must not be replaced.
        """
        check_free(path := Path(output).absolute(), overwrite, RUN, inputs_of(self.experiment.config))
        write_run(self, path, overwrite, learned=learned)
        return path


def write_run(
    run: Results,
    output: Path,
    overwrite: bool = False,
    training: Training | None = None,
    learned: RigidPlusResidual | None = None,
) -> None:
    """Write the run folder.

    Args:
        run: what to write.
        output: the folder.
        overwrite: whether a run that stands there may be replaced.
        training: whose curves go into the folder, and whose checkpoint is then no longer needed.
        learned: a module beside the rigid bodies, with its parameters of these.

    Raises:
        ConfigError: the folder exists and may not be replaced.
    """
    config = replace(run.experiment.config, output=output)
    robot = run.experiment.robot
    run = replace(run, experiment=replace(run.experiment, config=config))
    with during("writing", output), new_folder(output, overwrite) as folder:
        (folder / "config.yaml").write_text(dump_config(config))
        write_json(folder / "parameters.json", parameters_document(robot, run.estimate, run.by_state, run.extras))
        write_json(folder / "metrics.json", _metrics_document(run))
        if learned is not None:
            learned.save(folder / RESIDUAL)
        write_posterior(folder / POSTERIOR, run.posterior)
        (folder / identified_name(robot)).write_bytes(identified_robot(robot, run.phi, run.fitted_joints))
        write_json(folder / DATA, report_document(run))
        if training is not None:
            training.copy_curves(folder)
        write_events(run, folder, draw_figures(run, folder))
        write_page(folder, output)
    if training is not None:
        training.remove_checkpoint()


def _metrics_document(run: Results) -> dict[str, object]:
    """What `metrics.json` holds: errors of the identified and of the nominal parameters."""
    estimate = run.estimate
    robot = run.experiment.robot
    document: dict[str, object] = {}
    for name in LOG_SETS:
        pair = run.metrics.get(name)
        document[name] = None if pair is None else pair.identified.as_dict()
        document[f"{name}_nominal"] = None if pair is None else pair.nominal.as_dict()
    variation = {name: pair.identified.base_force_of_variation for name, pair in run.metrics.items()}
    return document | {
        "noise_floor": {name: pair.identified.noise for name, pair in run.metrics.items()},
        "base_force_rms_of_variation": variation,
        "rank": estimate.rank,
        "parameters": int(estimate.phi.size),
        "condition_number": estimate.condition_number if estimate.rank else None,
        "samples": run.samples,
        "contacts": run.experiment.rolling,
        "evaluated_samples": dict(run.evaluated),
        "excluded_samples": run.excluded,
        **({"factors": list(map(_factor_entry, run.factors))} if run.factors else {}),
        "rows": estimate.rows,
        "residual_std": estimate.residual_std,
        "misfit": _misfit_document(run.misfit),
        "resting_joints": dict(run.resting),
        "at_rest": list(run.at_rest),
        "motion_noise": asdict(run.motion_noise),
        "nominal_error": None if run.posterior.nominal_error is None else asdict(run.posterior.nominal_error),
        "total_mass": run.mass.value if run.mass.determined else None,
        "total_mass_standard_error": run.mass.standard_error if np.isfinite(run.mass.standard_error) else None,
        "total_mass_separable_from_offsets": run.mass.separable,
        "confounded": [asdict(confounded) | {"message": str(confounded)} for confounded in list_confounded(run.extras)],
        "total_mass_nominal": float(robot.nominal[:, 0].sum()),
        "smallest_eigenvalue": body_eigenvalues(robot, estimate.phi),
        "noise": {
            "groups": [asdict(group) for group in run.noise.groups],
            "used": NoiseGroups.of(robot).settings(run.noise.known),
            "suggested": run.noise.suggested,
        },
        "robust": None if run.robust is None else asdict(run.robust),
        "violations": run.violations_by_name(),
        "solution": _solution_document(estimate),
        "cross_validation": None
        if run.validation is None
        else {
            "folds": run.validation.folds,
            "nominal": run.validation.nominal.as_dict(),
            "identified": run.validation.identified.as_dict(),
        },
        "ridge_selection": None if run.ridge is None else asdict(run.ridge),
        **{f"{name}_selection": x and asdict(x) for name, x in vars(run.choices).items()},
        "worse_than_nominal": [asdict(group) for group in run.worse],
        "verdict": describe_worse(run.worse, robot.format),
        "contact_states": run.state_entries(),
        "identifiability": _identifiability_document(run),
        "seconds": run.seconds,
    }


def _misfit_document(misfit: Misfit) -> dict[str, object]:
    """What the fit leaves of the forces."""
    return {
        "explained": misfit.explained,
        "message": str(misfit),
        "expected_residual_std": misfit.expected,
        "lack_of_fit": misfit.lack_of_fit,
        "standard_error_growth": misfit.error_growth,
        "unfitted_friction": None if misfit.friction is None else misfit.friction.ratio,
    }


def _factor_entry(factors: FactorFile) -> dict[str, object]:
    """Which log a file of factors is of."""
    log = factors.log
    names = {"file": log.source, "log": factors.name, "sha256": factors.sha256, "torchid": factors.version}
    return names | {"samples": log.samples, "duration_s": factors.duration}


def _identifiability_document(run: Results) -> dict[str, object]:
    """What the data determine, and what each log and sensor adds; contact states have a list of their own."""
    estimate = run.estimate
    contributions = run.contributions
    return {
        "singular_values": estimate.singular_values.tolist(),
        "condition_number": estimate.condition_number if estimate.rank else None,
        "oversampling": estimate.oversampling,
        **asdict(contributions.total),
        "verdicts": estimate.verdict_counts(),
        "logs": [asdict(log) for log in contributions.logs],
        "sensors": [asdict(sensor) for sensor in contributions.sensors],
    }


def _solution_document(estimate: Estimate) -> dict[str, object] | None:
    """What is known of the optimum, or of the descent."""
    if not isinstance(estimate, ConstrainedEstimate):
        return None
    names = ["objective", "unconstrained", "distance", "gap", "steps", "active", "epochs", "best_epoch", "excess"]
    return {name: getattr(estimate, name) for name in names if hasattr(estimate, name)}


# --------------------------------------------------------------------------------------------------- figures and events


Figures = dict[str, Callable[[], "Figure"]]
"""What makes figures, by name."""


def run_figures(run: Results) -> Figures:
    """Those of a run, in the order in which they are to be seen."""
    robot = run.experiment.robot
    estimate = run.estimate
    kinds = {body.joint.kind for body in robot.bodies if body.joint is not None}
    figures = Figures() if run.forces is None else force_figures(run.forces, robot)
    figures["errors"] = partial(error_figure, run.metrics, robot.format)
    figures["parameters"] = partial(parameter_figure, robot.body_names, robot.nominal, estimate, kinds, robot.format)
    figures["identifiability"] = partial(identifiability_figure, robot.body_names, estimate)
    figures["inertia"] = partial(inertia_figure, robot, estimate.phi.reshape(-1, PER_BODY))
    figures["contributions"] = partial(contribution_figure, _bits(run.contributions))
    if run.extras:
        figures["extras"] = partial(extra_figure, run.extras)
    if run.ridge is not None:
        figures["ridge"] = partial(ridge_figure, run.ridge, robot.format)
    return figures


def force_figures(series: ForceSeries, robot: Robot) -> Figures:
    """Those of the forces of a log, as far as these are measured."""
    figures = Figures()
    args = (robot.dof_names, robot.base_rows, robot.sliding, robot.format)
    if series.known:
        figures["forces"] = partial(force_figure, series, *args)
    if series.pressure is not None and np.isfinite(series.pressure[0]).any():
        measured, nominal, identified = series.pressure
        points = replace(series, measured=measured, nominal=nominal, identified=identified, noise=None)
        figures["pressure"] = partial(pressure_figure, points, robot.format)
    if series.known:
        figures["spectra"] = partial(spectrum_figure, series, *args)
    return figures


def _bits(contributions: Contributions) -> dict[str, list[tuple[str, float]]]:
    """Names and bits, by kind."""
    return {
        "logs": [(log_title(log.name), log.bits) for log in contributions.logs],
        "contact states": [(state.name, state.bits) for state in contributions.states],
        "sensors": [(sensor.name, sensor.bits) for sensor in contributions.sensors],
    }


def draw_figures(run: Results, folder: Path) -> dict[str, bytes]:
    """Draw the figures of a run to files in a folder, on all cores; PNG of them by name, in their order."""
    figures = run_figures(run)
    form = run.experiment.config.figures.format
    files = [(folder / f"{name}.{form}", make) for name, make in figures.items()]
    drawn = share_between_forks(files, lambda file: draw_for(*file), thread_count())
    for (path, _), figure in zip(files, drawn, strict=True):
        path.write_bytes(figure.file)
    return {name: figure.png for name, figure in zip(figures, drawn, strict=True)}


def write_events(run: Results, folder: Path, figures: Mapping[str, bytes]) -> None:
    """Write errors, losses, verdicts, settings and figures of a run; a descent has written its epochs before.

    Args:
        run: a finished one.
        folder: of its files.
        figures: PNG by name.
    """
    from torchid.report.tensorboard import RunEvents  # takes 0.3 s, which runs that write nothing need not

    estimate = run.estimate
    robot = run.experiment.robot
    descent = isinstance(estimate, SgdEstimate)
    last = estimate.epochs if isinstance(estimate, SgdEstimate) else 1
    known = known_parameters(robot, estimate, estimate.phi)
    nominal = known_parameters(robot, estimate, robot.nominal.flatten())
    if run.mass.determined and np.isfinite(run.mass.standard_error):
        known["total_mass"] = run.mass.value, run.mass.standard_error
        nominal["total_mass"] = run.mass.nominal, run.mass.standard_error
    with RunEvents(folder) as events:
        if not descent:  # which has said before what there is to show
            events.write_layout(robot.body_names)
            events.write_solution(estimate)
        for step, phi, values in ((0, robot.nominal.flatten(), nominal), (last, estimate.phi, known)):
            events.write_errors(step, _errors(run, nominal=step == 0))
            events.write_eigenvalues(step, body_eigenvalues(robot, phi))
            events.write_parameters(step, values)
        events.write_answer(last, _answer_lines(run))
        table = table_text(verdict_counts_table(run.by_state, estimate))
        events.write_identifiability(last, estimate, table)
        events.write_summary(dump_config(run.experiment.config), figures, last)
        events.write_hyperparameters(hyperparameters(run.experiment.config), _compared_tags(run))


def _errors(run: Results, nominal: bool) -> dict[str, Metrics]:
    """Errors by set of logs, of blocks that are left out of the fit, too."""
    errors = {name: pair.nominal if nominal else pair.identified for name, pair in run.metrics.items()}
    if run.validation is not None:
        errors["left_out"] = run.validation.nominal if nominal else run.validation.identified
    return errors


def _answer_lines(run: Results) -> list[str]:
    """What the terminal says first."""
    said = answer(run)
    file_kind = run.experiment.robot.format
    errors = [
        f"{group}: {before:.4g} by the {file_kind}, {after:.4g} identified"
        + ("" if floor is None else f", {floor:.4g} noise")
        for group, before, after, floor in said.errors
    ]
    named = [f"total mass: {said.total_mass}", f"bodies: {said.bodies}"]
    return [said.headline, "", *errors, "", *named, *(f"attention: {text}" for text in said.attention)]


def _compared_tags(run: Results) -> list[str]:
    """Charts whose last values compare runs, test logs first: TensorBoard shows the first few."""
    tags = [
        f"error_relative_{name}/{group}"
        for name in reversed(LOG_SETS)
        if name in run.metrics
        for group, value in run.metrics[name].identified.relative.items()
        if value is not None
    ]
    return [*tags, "optimum/objective_above_least"] if isinstance(run.estimate, SgdEstimate) else tags


def hyperparameters(config: ExperimentConfig) -> dict[str, str | float | bool]:
    """The same keys for every estimator: TensorBoard compares runs by the keys of the first that it finds.

    It shows the first five by name at first: what most runs have in common comes after them.
    """
    estimator = config.estimator
    training = config.estimator.training
    descent = estimator.name == "sgd"
    return {
        "cutoff_hz": config.preprocessing.filter_hz or 0.0,
        "estimator": estimator.name,
        "friction": estimator.friction,
        "ridge": estimator.numeric_ridge,
        "sensors": config.sensors.set or "by name",
        "settings.consistency": estimator.consistency if descent else estimator.name,
        "settings.margin": 0.0 if estimator.name == "least_squares" else estimator.margin,
        "settings.prior": estimator.prior,
        "training.optimizer": training.optimizer["name"] if descent else "none",
        "training.lr": float(training.optimizer.get("lr", 0.0)) if descent else 0.0,
        "training.schedule": (training.schedule or {}).get("name", "none") if descent else "none",
        "training.batch_size": training.batch_size if descent else 0,
        "training.epochs": training.epochs if descent else 0,
        "training.seed": training.seed if descent else 0,
    }


# ------------------------------------------------------------------------------------------------------------- the page


def report_document(run: Results) -> dict[str, Any]:
    """What `report.json` holds: what the page of a run shows and no other file of its folder has."""
    robot = run.experiment.robot
    return {
        "answer": asdict(answer(run)),
        "robot": {"name": robot.path.name, "base": robot.base_link, "joints": robot.n, "format": robot.format},
        "versions": versions(),
    }


def write_page(folder: Path, output: Path) -> None:
    """Write the page of a run that is being written.

    Args:
        folder: with its files.
        output: that the folder will be.
    """
    asked = f"To list the findings of the log checks here, run torchid report {output}."
    (folder / PAGE).write_text(page_text(replace(_read(folder), name=output.name, not_checked=asked)))


def report(run: str | Path) -> Path:
    """Make the page of a finished run anew, with the findings of the checks of its logs; the path of the page.

    Raises:
        InputError: the folder is no run, or its page has been edited.
    """
    folder = Path(run)
    refuse_link(folder)
    manifest = read_manifest(folder)
    if manifest is None or manifest.kind != RUN.name:
        raise ConfigError(folder, "RUN", "not a run of torchid", _WRITTEN)
    page = folder / PAGE
    written = manifest.files.get(PAGE)
    there = page.exists() or page.is_symlink()
    if there and (page.is_symlink() or not page.is_file() or written is None or file_checksum(page) != written):
        raise ConfigError(folder, PAGE, "changed since torchid wrote it", f"a run without your {PAGE}; move it first")
    files = _with_findings(_read(folder), folder)
    with during("writing", folder), atomic_file(page) as new:
        new.write_text(_made(files, folder))
    replace(manifest, files=manifest.files | {PAGE: file_checksum(page)}).write(folder)
    return page


def _made(files: RunFiles, folder: Path) -> str:
    """The page of files that somebody may have changed. Raises InputError: they are not what a page needs."""
    try:
        return page_text(files)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        reason = f"not usable for the page ({excerpt(str(error))})"
        raise InputError(folder, ", ".join(_JSON), reason, _WRITTEN) from error


def _read(folder: Path) -> RunFiles:
    """The files of a run that its page shows. Raises InputError: one is missing or cannot be read."""
    parameters, metrics, data = (_document(folder, name) for name in _JSON)
    return RunFiles(
        name=folder.resolve().name,
        config=_text(folder, "config.yaml", MAX_YAML),
        parameters=parameters,
        metrics=metrics,
        report=data,
        figures=_figures(folder),
    )


def _figures(folder: Path) -> dict[str, str]:
    """The figures of a run that a browser shows, as URLs that hold them."""
    out = {}
    for suffix, kind in ((".svg", "image/svg+xml"), (".png", "image/png")):
        for path in (folder / f"{name}{suffix}" for name in FIGURES):
            if path.is_file():
                with during("reading", path):
                    out[path.stem] = f"data:{kind};base64,{b64encode(read_bytes(path, MAX_JSON)).decode()}"
    return out


def _document(folder: Path, name: str) -> dict[str, Any]:
    text = _text(folder, name, MAX_JSON)
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(folder, name, f"not readable as JSON ({excerpt(str(error))})", _WRITTEN) from error
    return document if isinstance(document, dict) else {}


def _text(folder: Path, name: str, most: int) -> str:
    if not (folder / name).exists():
        raise InputError(folder, name, "missing", _WRITTEN)
    try:
        return read_bytes(folder / name, most).decode()
    except (OSError, ValueError) as error:
        raise InputError(folder, name, f"not readable ({excerpt(str(error))})", _WRITTEN) from error


def _with_findings(files: RunFiles, folder: Path) -> RunFiles:
    """With what the checks of the logs find, or why they cannot be made."""
    try:
        checked = check_experiment(folder / "config.yaml")
    except InputError as error:
        return replace(files, not_checked=f"The logs could not be checked: {error}")
    return replace(files, findings=log_check_document(checked)["logs"])
