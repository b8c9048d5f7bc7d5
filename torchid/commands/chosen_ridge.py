"""The ridge, where the settings leave it to the training logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from rich.progress import Progress

from torchid import ranks
from torchid.estimators import Conditions
from torchid.fitting.cross_validation import RidgeChoice
from torchid.fitting.experiment import Experiment
from torchid.problem import RowBuilder
from torchid.problem.compressed_log import Block
from torchid.problem.compression import Part


def with_ridge(
    experiment: Experiment,
    parts: Sequence[Part],
    blocks: Sequence[Block],
    builder: RowBuilder,
    conditions: Conditions,
    bars: Progress,
) -> tuple[Experiment, RidgeChoice | None]:
    """The experiment with a ridge that is a number, and how it was chosen, if it was."""
    config = experiment.config
    if not config.estimator.chooses_ridge:
        return experiment, None
    bar = bars.add_task("choosing the ridge", total=None)
    fitter = experiment.fitter(builder, conditions)
    choice = ranks.from_first(partial(experiment.choose_ridge, parts, blocks, fitter, conditions), "ridge")
    bars.update(bar, total=1, completed=1)
    chosen = replace(config, estimator=replace(config.estimator, ridge=choice.ridge))
    return replace(experiment, config=chosen), choice
