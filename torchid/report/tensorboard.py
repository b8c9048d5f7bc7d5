"""TensorBoard event files of a run."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from torchid.estimators import Epoch, Estimate
from torchid.problem import Metrics
from torchid.problem.metrics import ERROR_GROUPS, LOG_SETS, ROW_GROUPS
from torchid.report.figures import INTERVAL

_RGBA = 4  # colour space in Summary.Image
_BY_EPOCH = "training_"  # begins those of curves
_CHARTED = ("test", "left_out", "train")
_TERMS = ("total", "data", "prior", "eigenvalue", "log_det", "mass", "friction", "residual")
_BOUNDS = ("_lower", "_upper")  # ends the names of charts of the ends of intervals


class RunEvents:
    """Event files of one run: results, curves of a descent, figures and settings.

    Results of all estimators are lines from the nominal parameters, step 0, to the identified ones, the last step. A
    descent also has curves over its epochs; their names begin with "training". Tags sort by what should be seen first:
    errors.
    """

    def __init__(self, folder: Path, since: int | None = None) -> None:
        """Open a new event file; `since`: first step of earlier event files in the folder that is overwritten."""
        self._writer = SummaryWriter(str(folder), purge_step=since)

    def write_layout(self, bodies: Sequence[str], by_epoch: Sequence[str] | None = None) -> None:
        """Say what *Custom scalars* shows, once for a run.

        Args:
            bodies: names of the bodies; none where losses are all that is written.
            by_epoch: of a descent, names of the parameters whose intervals are drawn.
        """
        layout: dict[str, dict[str, list[str | list[str]]]] = {}
        if bodies:
            tags = [f"error_relative_{name}" for name in _CHARTED]
            layout["errors, share of measured"] = _charts(tags, ERROR_GROUPS)
        if bodies and by_epoch is not None:
            tags = [f"{_BY_EPOCH}error_relative_{name}" for name in LOG_SETS]
            layout["errors by epoch, share of measured"] = _charts(tags, ROW_GROUPS)
        if by_epoch is not None:
            losses = [f"loss{suffix}/data$" for suffix in ("", "_held_out", "_unseen")]
            terms = [f"loss/{term}" for term in _TERMS]
            layout["loss by epoch"] = {"train, held out, unseen": ["Multiline", losses], "terms": ["Multiline", terms]}
        if bodies:
            least = [f"smallest_eigenvalue/{re.escape(name)}$" for name in bodies]
            layout["bodies"] = {"smallest eigenvalue": ["Multiline", least]}
        if by_epoch:
            tag = f"{_BY_EPOCH}parameter"
            layout["parameters by epoch, 95 % intervals"] = {
                name: ["Margin", [f"{tag}{kind}/{name}" for kind in ("", *_BOUNDS)]] for name in by_epoch
            }
        self._writer.add_custom_scalars(layout)

    def __enter__(self) -> RunEvents:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def flush(self) -> None:
        """Write buffered events."""
        self._writer.flush()

    def write_errors(self, step: int, sets: Mapping[str, Metrics], *, by_epoch: bool = False) -> None:
        """Errors by group of rows of one parameter vector on sets of logs."""
        for name, metrics in sets.items():
            for kind, values in (("relative", metrics.relative), ("rms", metrics.rms)):
                chart = f"{_BY_EPOCH * by_epoch}error_{kind}_{name}"
                self._add(step, {f"{chart}/{group}": values.get(group) for group in ERROR_GROUPS})

    def write_parameters(self, step: int, values: Mapping[str, tuple[float, float]], *, by_epoch: bool = False) -> None:
        """Parameters by name, given with their standard errors; by epoch with the ends of their 95 % intervals, too."""
        tag = f"{_BY_EPOCH * by_epoch}parameter"
        for kind, sign in zip(("", *_BOUNDS), (0.0, -1.0, 1.0), strict=True):
            if not kind or by_epoch:
                ends = {name: value + sign * INTERVAL * error for name, (value, error) in values.items()}
                self._add(step, {f"{tag}{kind}/{name}": end for name, end in ends.items()})

    def write_answer(self, step: int, lines: Sequence[str]) -> None:
        """What the run says first, line by line."""
        self._writer.add_text("answer", _preformatted("\n".join(lines)), step)

    def write_eigenvalues(self, step: int, least: Mapping[str, float], *, by_epoch: bool = False) -> None:
        """Smallest eigenvalue of the scaled pseudo-inertia by body; negative: the body is not physically consistent."""
        tag = f"{_BY_EPOCH * by_epoch}smallest_eigenvalue"
        self._add(step, {f"{tag}/{body}": value for body, value in least.items()})

    def write_epoch(self, epoch: Epoch, unseen: float | None = None) -> None:
        """Losses and rates of an epoch of a descent.

        Args:
            epoch: of the descent.
            unseen: mean squared whitened residual on logs that neither train nor decide, if it was worked out.
        """
        least = epoch.closed_form  # 0 for a perfect fit of data without noise
        scalars = {
            "loss_held_out/data": epoch.held_out,
            "loss_unseen/data": unseen,
            "optimum/objective_above_least": epoch.objective / least - 1.0 if least else None,
            "optimum/distance": epoch.distance,
            "training/learning_rate": epoch.learning_rate,
            "training/samples_per_second": epoch.samples_per_second,
        }
        scalars |= {f"loss/{name}": value for name, value in epoch.losses.items()}
        self._add(epoch.number, scalars | {f"share_of_force/{name}": value for name, value in epoch.shares.items()})

    def write_solution(self, estimate: Estimate) -> None:
        """Loss of a batch fit, in the chart of a descent."""
        for step, cost in enumerate((estimate.nominal_cost, estimate.cost)):
            self._add(step, {"loss/data": cost / max(estimate.rows, 1)})

    def write_identifiability(self, step: int, estimate: Estimate, table: str) -> None:
        """Verdicts and singular values; in the chart of the latter, steps are their numbers.

        Args:
            step: of all other charts.
            estimate: the fit.
            table: of the verdicts by contact state.
        """
        self._writer.add_text("verdicts", _preformatted(table), step)
        for index, value in enumerate(estimate.singular_values):
            self._writer.add_scalar("identifiability/singular_value", value, index)

    def write_summary(self, settings: str, figures: Mapping[str, bytes], step: int) -> None:
        """Settings, YAML, and figures of a finished run, PNG by name, in the order in which they are to be seen."""
        self._writer.add_text("config", _preformatted(settings))
        for number, (name, png) in enumerate(figures.items(), 1):
            width, height = struct.unpack(">II", png[16:24])
            image = Summary.Image(encoded_image_string=png, width=width, height=height, colorspace=_RGBA)
            value = Summary.Value(tag=f"figure_{number}_{name}", image=image)
            self._writer.file_writer.add_summary(Summary(value=[value]), step)

    def write_hyperparameters(self, settings: Mapping[str, str | float | bool], tags: Sequence[str]) -> None:
        """Settings, a row for each run in the tab *HParams*, beside the last values of charts with these tags."""
        for summary in hparams(dict(settings), dict.fromkeys(tags, 0.0)):  # add_hparams would write a run of its own
            self._writer.file_writer.add_summary(summary)

    def _add(self, step: int, scalars: Mapping[str, float | None]) -> None:
        """Add a point to the chart of each tag; None: there is none."""
        for tag, value in scalars.items():
            if value is not None:
                self._writer.add_scalar(tag, value, step)


def _charts(tags: Sequence[str], groups: Iterable[str]) -> dict[str, list[str | list[str]]]:
    """A chart of all of these for each group of rows."""
    return {group: ["Multiline", [f"{tag}/{group}" for tag in tags]] for group in groups}


def _preformatted(text: str) -> str:
    """The text as a preformatted block of Markdown."""
    return "    " + text.replace("\n", "\n    ")
