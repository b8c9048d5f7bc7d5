"""Figures of a run: what they show, and copies of this process that draw them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from torchid.config import ExperimentConfig
from torchid.copies import in_copies
from torchid.estimators import Estimate
from torchid.fitting.cross_validation import RidgeChoice
from torchid.identifiability.confounding import ExtraEstimate
from torchid.identifiability.contributions import Contributions
from torchid.logs.time_range import log_title
from torchid.problem.chunks import thread_count
from torchid.report.figure_style import Drawn, draw_for
from torchid.report.figures import contribution_figure, error_figure, identifiability_figure, ridge_figure
from torchid.report.forces import ForceSeries, force_figure
from torchid.report.parameter_figures import extra_figure, parameter_figure
from torchid.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from torchid.commands.results import Identification

Figures = dict[str, Callable[[], "Figure"]]
"""What makes figures, by name."""


def fit_figures(
    robot: Robot, estimate: Estimate, extras: Sequence[ExtraEstimate], ridge: RidgeChoice | None
) -> Figures:
    """Those that a fit alone gives, in the order in which they are to be seen."""
    kinds = {body.joint.kind for body in robot.bodies if body.joint is not None}
    figures: Figures = {
        "parameters": partial(parameter_figure, robot.body_names, robot.nominal, estimate, kinds, robot.format),
        "identifiability": partial(identifiability_figure, robot.body_names, estimate),
    }
    if extras:
        figures["extras"] = partial(extra_figure, extras)
    if ridge is not None:
        figures["ridge"] = partial(ridge_figure, ridge, robot.format)
    return figures


def all_figures(run: Identification) -> Figures:
    """Those of a run, in the order in which they are to be seen."""
    robot, figures = run.experiment.robot, Figures()
    if run.forces is not None:
        figures["forces"] = partial(draw_forces, run.forces, robot)
    figures["errors"] = partial(error_figure, run.metrics, robot.format)
    of_fit = fit_figures(robot, run.estimate, run.extras, run.ridge)
    figures |= {name: of_fit.pop(name) for name in ("parameters", "identifiability")}
    figures["contributions"] = partial(contribution_figure, _bits(run.contributions))
    return figures | of_fit


def draw_forces(series: ForceSeries, robot: Robot) -> Figure:
    """The figure of forces of a log's first samples."""
    return force_figure(series, robot.dof_names, robot.base_rows, robot.sliding, robot.format)


def _bits(contributions: Contributions) -> dict[str, list[tuple[str, float]]]:
    """Names and bits, by kind."""
    return {
        "logs": [(log_title(log.name), log.bits) for log in contributions.logs],
        "contact states": [(state.name, state.bits) for state in contributions.states],
        "sensors": [(sensor.name, sensor.bits) for sensor in contributions.sensors],
    }


@dataclass(frozen=True)
class Drawing:
    """Figures that are being drawn: their `names`, and what waits for them."""

    names: tuple[str, ...] = ()
    wait: Callable[[], Sequence[Drawn]] = tuple


@contextmanager
def drawing(figures: Figures, config: ExperimentConfig, spared: int = 0) -> Iterator[Drawing]:
    """Copies of this process that draw figures of the run of an experiment within the block.

    Args:
        figures: to draw.
        config: of the experiment, with an output.
        spared: cores that are left to what this process does meanwhile.
    """
    folder, form = config.output or Path(), config.figures.format
    files = [(folder / f"{name}.{form}", make) for name, make in figures.items()]
    with in_copies(files, lambda file: draw_for(*file), max(thread_count() - spared, 1)) as drawn:
        yield Drawing(tuple(figures), drawn)


def write_figures(folder: Path, form: str, order: Iterable[str], drawn: Iterable[Drawing]) -> Mapping[str, bytes]:
    """Write figures to files of a type once they are drawn; PNG by name, in an order of names."""
    done = {name: figure for one in drawn for name, figure in zip(one.names, one.wait(), strict=True)}
    for name, figure in done.items():
        (folder / f"{name}.{form}").write_bytes(figure.file)
    return {name: done[name].png for name in order}
