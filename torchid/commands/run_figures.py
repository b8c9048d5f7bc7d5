"""Figures of a run, drawn by several processes, and what it writes for TensorBoard."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchid.commands.answer import answer
from torchid.commands.training import body_eigenvalues, known_parameters
from torchid.config import ExperimentConfig, dump_config
from torchid.estimators import ConstrainedEstimate, SgdEstimate
from torchid.identifiability.information import Contributions
from torchid.logs.time_range import log_title
from torchid.parallel import share_between_forks, thread_count
from torchid.parameters import PER_BODY
from torchid.problem import Metrics
from torchid.problem.contact_state import IN_THE_AIR
from torchid.problem.metrics import LOG_SETS
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
from torchid.report.forces import ForceSeries, force_figure, pressure_figure, rows_figure, spectrum_figure
from torchid.report.tables import table_text, verdict_counts_table
from torchid.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from torchid.commands.results import Identification

Figures = dict[str, Callable[[], "Figure"]]
"""What makes figures, by name."""


def run_figures(run: Identification) -> Figures:
    """Those of a run, in the order in which they are to be seen."""
    robot, estimate = run.experiment.robot, run.estimate
    kinds = {body.joint.kind for body in robot.bodies if body.joint is not None}
    figures = Figures() if run.forces is None else force_figures(run.forces, robot)
    if run.traces is not None:
        args = run.traces, robot.dof_names, robot.base_rows, robot.sliding, robot.format
        if "forces" not in figures or run.traces.states != (IN_THE_AIR,):  # else the same once more
            figures["rows"] = partial(rows_figure, *args)
        figures["spectra"] = partial(spectrum_figure, *args)
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
    """Those of forces of a log's first samples, as far as these are measured."""
    figures, args = Figures(), (robot.dof_names, robot.base_rows, robot.sliding, robot.format)
    if series.known:
        figures["forces"] = partial(force_figure, series, *args)
    if series.pressure is not None and np.isfinite(series.pressure[0]).any():
        points = ForceSeries(series.source, series.time, *series.pressure)
        figures["pressure"] = partial(pressure_figure, points, robot.format)
    return figures


def _bits(contributions: Contributions) -> dict[str, list[tuple[str, float]]]:
    """Names and bits, by kind."""
    return {
        "logs": [(log_title(log.name), log.bits) for log in contributions.logs],
        "contact states": [(state.name, state.bits) for state in contributions.states],
        "sensors": [(sensor.name, sensor.bits) for sensor in contributions.sensors],
    }


def draw_figures(run: Identification, folder: Path) -> dict[str, bytes]:
    """Draw the figures of a run to files in a folder, on all cores; PNG of them by name, in their order."""
    figures, form = run_figures(run), run.experiment.config.figures.format
    files = [(folder / f"{name}.{form}", make) for name, make in figures.items()]
    drawn = share_between_forks(files, lambda file: draw_for(*file), thread_count())
    for (path, _), figure in zip(files, drawn, strict=True):
        path.write_bytes(figure.file)
    return {name: figure.png for name, figure in zip(figures, drawn, strict=True)}


def write_events(run: Identification, folder: Path, figures: Mapping[str, bytes]) -> None:
    """Write errors, losses, verdicts, settings and figures of a run; a descent has written its epochs before.

    Args:
        run: a finished one.
        folder: of its files.
        figures: PNG by name.
    """
    from torchid.report.tensorboard import RunEvents  # takes 0.3 s, which runs that write nothing need not

    estimate, robot = run.estimate, run.experiment.robot
    descent = isinstance(estimate, SgdEstimate)
    last = estimate.epochs if isinstance(estimate, SgdEstimate) else 1
    with RunEvents(folder) as events:
        if not descent:  # which has said before what there is to show
            events.write_layout(robot.body_names)
            events.write_solution(estimate, None if run.factors else run.samples / run.seconds["compress"])
        for nominal, phi in ((True, robot.nominal.flatten()), (False, estimate.phi)):
            events.write_errors(last, _errors(run, nominal), nominal=nominal)
            events.write_eigenvalues(last, body_eigenvalues(robot, phi), nominal=nominal)
        known = known_parameters(robot, estimate, estimate.phi)
        if run.mass.determined and np.isfinite(run.mass.standard_error):
            known["total_mass"] = run.mass.value, run.mass.standard_error
        events.write_parameters(last, known)
        events.write_answer(last, _answer_lines(run))
        events.write_fit(last, estimate)
        events.write_identifiability(
            last, estimate, run.contributions.total, table_text(verdict_counts_table(run.by_state, estimate))
        )
        events.write_summary(dump_config(run.experiment.config), figures, last)
        events.write_hyperparameters(hyperparameters(run.experiment.config), _final(run), last)


def _errors(run: Identification, nominal: bool) -> dict[str, Metrics]:
    """Errors by set of logs, of blocks that are left out of the fit, too."""
    found = {name: pair.nominal if nominal else pair.identified for name, pair in run.metrics.items()}
    if run.validation is not None:
        found["left_out"] = run.validation.nominal if nominal else run.validation.identified
    return found


def _answer_lines(run: Identification) -> list[str]:
    """What the terminal says first."""
    said, of = answer(run), run.experiment.robot.format
    errors = [
        f"{group}: {before:.4g} by the {of}, {after:.4g} identified{'' if floor is None else f', {floor:.4g} noise'}"
        for group, before, after, floor in said.errors
    ]
    named = [f"total mass: {said.total_mass}", f"bodies: {said.bodies}"]
    return [said.headline, "", *errors, "", *named, *(f"attention: {one}" for one in said.attention)]


def _final(run: Identification) -> dict[str, float]:
    """Errors of a finished run, and what it says of its optimum."""
    estimate = run.estimate
    final = {
        f"{name}_{group}": value
        for name in reversed(LOG_SETS)  # test logs first: TensorBoard shows the first few
        if name in run.metrics
        for group, value in run.metrics[name].identified.relative.items()
        if value is not None
    }
    price = estimate.relative_increase if isinstance(estimate, ConstrainedEstimate) else 0.0
    return final | {"rank": float(estimate.rank)} | ({} if price is None else {"objective_above_least": price})


def hyperparameters(config: ExperimentConfig) -> dict[str, str | float | bool]:
    """The same keys for every estimator: TensorBoard compares runs by the keys of the first that it finds.

    It shows the first five by name at first: what most runs have in common comes after them.
    """
    estimator, training = config.estimator, config.estimator.training
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
