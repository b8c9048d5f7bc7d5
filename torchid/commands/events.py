"""What a finished run writes for TensorBoard."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from torchid.commands.training import body_eigenvalues
from torchid.config import ExperimentConfig, dump_config
from torchid.estimators import ConstrainedEstimate, SgdEstimate
from torchid.problem.metrics import SETS, WHITENED, describe_worse
from torchid.report.tables import table_text, verdict_counts_table

if TYPE_CHECKING:
    from torchid.commands.results import Identification


def write_events(run: Identification, folder: Path, figures: Mapping[str, bytes]) -> None:
    """Write errors, losses, verdicts, settings and figures of a run; a descent has written its epochs before.

    Args:
        run: a finished one.
        folder: of its files.
        figures: PNG by name.
    """
    from torchid.report.tensorboard import RunEvents  # takes 0.3 s, which runs that write nothing need not

    estimate, robot, config = run.estimate, run.experiment.robot, run.experiment.config
    epochs = estimate.epochs if isinstance(estimate, SgdEstimate) else None
    last = 1 if epochs is None else epochs
    with RunEvents(folder, robot.body_names, epochs is not None) as events:
        if epochs is None:
            for nominal, phi in ((True, robot.nominal.flatten()), (False, estimate.phi)):
                events.write_errors(
                    last,
                    {name: pair.nominal if nominal else pair.identified for name, pair in run.metrics.items()},
                    nominal=nominal,
                )
                events.write_eigenvalues(last, body_eigenvalues(robot, phi), nominal=nominal)
            events.write_solution(estimate, None if run.factors else run.samples / run.seconds["compress"])
        else:  # what was not worked out by epoch
            for nominal, which in ((True, 0), (False, 1)):
                found = {name: pair[which] for name, pair in run.metrics.items()}
                events.write_errors(last, found, (WHITENED,), nominal=nominal, by_epoch=False)
        if run.validation is not None:
            events.write_errors(last, {"left_out": run.validation.nominal}, nominal=True, by_epoch=False)
            events.write_errors(last, {"left_out": run.validation.identified}, by_epoch=False)
        if run.ridge is not None:
            events.write_ridges(run.ridge)
        events.write_verdict(last, describe_worse(run.worse) or "nowhere worse than the URDF's parameters")
        events.write_fit(last, estimate)
        events.write_identifiability(
            last, estimate, run.contributions.total, table_text(verdict_counts_table(run.by_state, estimate))
        )
        final = {
            f"{name}_{group}": value
            for name in reversed(SETS)  # test logs first: TensorBoard shows the first few
            if name in run.metrics
            for group, value in run.metrics[name].identified.relative.items()
            if value is not None
        }
        price = estimate.relative_increase if isinstance(estimate, ConstrainedEstimate) else 0.0
        final |= {"rank": float(estimate.rank)} | ({} if price is None else {"objective_above_least": price})
        events.write_summary(dump_config(config), _hyperparameters(config), final, figures, last)


def _hyperparameters(config: ExperimentConfig) -> dict[str, str | float | bool]:
    """The same keys for every estimator: TensorBoard compares runs by the keys of the first that it finds.

    It shows the first five by name at first: those of a descent, which most runs have not, come after them.
    """
    estimator, training = config.estimator, config.estimator.training
    descent = estimator.name == "sgd"
    return {
        "sensors": config.sensors.set or "by name",
        "estimator": estimator.name,
        "ridge": estimator.numeric_ridge,
        "friction": estimator.friction,
        "cutoff_hz": config.preprocessing.filter_hz or 0.0,
        "margin": 0.0 if estimator.name == "least_squares" else estimator.margin,
        "prior": estimator.prior,
        "consistency": estimator.consistency if descent else estimator.name,
        "training.optimizer": training.optimizer["name"] if descent else "none",
        "training.lr": float(training.optimizer.get("lr", 0.0)) if descent else 0.0,
        "training.schedule": (training.schedule or {}).get("name", "none") if descent else "none",
        "training.batch_size": training.batch_size if descent else 0,
        "training.epochs": training.epochs if descent else 0,
        "training.seed": training.seed if descent else 0,
    }
