"""TensorBoard event files of a run (the only module that imports TensorBoard)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure
from torch.utils.tensorboard import SummaryWriter

from torchid.estimators import Estimate
from torchid.report.metrics import GROUPS, Metrics

_NOMINAL_STEP, _IDENTIFIED_STEP = 0, 1


def write_events(
    folder: Path,
    sets: Mapping[str, tuple[Metrics, Metrics]],
    estimate: Estimate,
    settings: str,
    hyperparameters: Mapping[str, str | float | bool],
    figures: Mapping[str, Figure],
) -> None:
    """Write scalars, figures and settings.

    Errors are charts of two steps, 0 for the URDF's parameters and 1 for the identified ones, train and test on one
    chart per group of rows.

    Args:
        folder: where the event files go.
        sets: nominal and identified metrics by set name ("train", "test").
        estimate: the fit.
        settings: resolved configuration, YAML.
        hyperparameters: for the HParams tab.
        figures: by tag.
    """
    with SummaryWriter(str(folder)) as writer:
        layout = {
            "errors, share of measured (step 0: URDF, step 1: identified)": {
                group: ["Multiline", [f"relative_error_{name}/{group}" for name in sets]] for group in GROUPS
            }
        }
        writer.add_custom_scalars(layout)
        for name, pair in sets.items():
            for step, metrics in zip((_NOMINAL_STEP, _IDENTIFIED_STEP), pair, strict=True):
                for group in GROUPS:
                    if metrics.relative[group] is not None:
                        writer.add_scalar(f"relative_error_{name}/{group}", metrics.relative[group], step)
                    if metrics.rms[group] is not None:
                        writer.add_scalar(f"rms_error_{name}/{group}", metrics.rms[group], step)
        writer.add_scalar("fit/residual_std", estimate.residual_std, _IDENTIFIED_STEP)
        writer.add_scalar("fit/rank", estimate.rank, _IDENTIFIED_STEP)
        if estimate.rank:
            writer.add_scalar("fit/condition_number", estimate.condition_number, _IDENTIFIED_STEP)
        writer.add_text("config", "    " + settings.replace("\n", "\n    "))
        for tag, figure in figures.items():
            writer.add_figure(tag, figure, close=False)
        final = {
            f"final/{name}_{group}": value
            for name, (_, identified) in sets.items()
            for group, value in identified.relative.items()
            if value is not None
        }
        writer.add_hparams(dict(hyperparameters), final or {"final/rank": estimate.rank}, run_name="hparams")


def write_comparison(
    folder: Path,
    scalars: Mapping[tuple[str, str], Sequence[float]],
    texts: Mapping[str, str],
    figures: Mapping[str, Figure],
) -> None:
    """Write charts that compare runs.

    Args:
        folder: where the event files go, those of every run in a folder of its own.
        scalars: values of steps 0, 1, ... by run and tag.
        texts: Markdown by tag.
        figures: by tag.
    """
    for run in dict.fromkeys(run for run, _ in scalars):
        with SummaryWriter(str(folder / run)) as writer:
            for (of, tag), values in scalars.items():
                for step, value in enumerate(values if of == run else ()):
                    writer.add_scalar(tag, value, step)
    with SummaryWriter(str(folder)) as writer:
        for tag, text in texts.items():
            writer.add_text(tag, text)
        for tag, figure in figures.items():
            writer.add_figure(tag, figure, close=False)
