"""What a finished run writes for TensorBoard."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchid.commands.answer import answer
from torchid.commands.training import body_eigenvalues, known_parameters
from torchid.config import ExperimentConfig, dump_config
from torchid.estimators import ConstrainedEstimate, SgdEstimate
from torchid.problem import Metrics
from torchid.problem.metrics import LOG_SETS
from torchid.report.tables import table_text, verdict_counts_table

if TYPE_CHECKING:
    from torchid.commands.results import Identification


def write_events(run: Identification, folder: Path, figures: Callable[[], Mapping[str, bytes]]) -> None:
    """Write errors, losses, verdicts, settings and figures of a run; a descent has written its epochs before.

    Args:
        run: a finished one.
        folder: of its files.
        figures: gives PNG by name, once they are drawn.
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
        events.write_parameters(last, known_parameters(robot, estimate, estimate.phi) | _total_mass(run))
        if run.ridge is not None:
            events.write_ridges(run.ridge)
        events.write_answer(last, _answer_lines(run))
        events.write_fit(last, estimate)
        events.write_identifiability(
            last, estimate, run.contributions.total, table_text(verdict_counts_table(run.by_state, estimate))
        )
        events.write_summary(dump_config(run.experiment.config), figures(), last)
        events.write_hyperparameters(hyperparameters(run.experiment.config), _final(run), last)


def _total_mass(run: Identification) -> dict[str, tuple[float, float]]:
    known = run.mass.determined and np.isfinite(run.mass.standard_error)
    return {"total_mass": (run.mass.value, run.mass.standard_error)} if known else {}


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
