"""TensorBoard event files of a run (the only module that imports TensorBoard)."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure
from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from torchid.estimators import ConstrainedEstimate, Epoch, Estimate
from torchid.fitting.cross_validation import RidgeChoice
from torchid.identifiability.information import InformationGain
from torchid.problem import Metrics
from torchid.problem.metrics import ERROR_GROUPS, SETS

_RGBA = 4  # colour space in Summary.Image
_URDF = "_URDF"  # ends the names of charts of the URDF's parameters
_CHARTED = (*SETS, "left_out")
_TERMS = ("total", "data", "prior", "eigenvalue", "log_det", "mass", "friction", "residual")


class RunEvents:
    """Event files of one run: charts by step, train and test logs on one chart, figures and settings.

    Steps of a descent are its epochs, after step 0, the URDF's parameters. A batch fit has step 1 alone. Of what is not
    worked out by epoch, the URDF's parameters have charts of their own: TensorBoard would smooth a curve of two points
    into one that shows neither.
    """

    def __init__(self, folder: Path, bodies: Sequence[str], descent: bool, since: int | None = None) -> None:
        """Open a new event file.

        Args:
            folder: where it goes.
            bodies: names of the bodies.
            descent: whether steps are epochs.
            since: first step of earlier event files in the folder that is overwritten.
        """
        self._writer, self._descent = SummaryWriter(str(folder), purge_step=since), descent
        groups = {  # the same of all runs, which TensorBoard shows on one chart
            group: ["Multiline", [f"relative_error_{name}{kind}/{group}" for name in _CHARTED for kind in ("", _URDF)]]
            for group in ERROR_GROUPS
        }
        loss = {
            "train and held out": ["Multiline", ["loss/data", "loss_held_out/data"]],
            "terms": ["Multiline", [f"loss/{term}" for term in _TERMS]],
        }
        least = {"smallest eigenvalue": ["Multiline", [f"eigenvalue/{re.escape(name)}$" for name in bodies]]}
        layout = {"errors, share of measured": groups, "bodies": least}
        self._writer.add_custom_scalars(layout | ({"loss by epoch": loss} if descent else {}))

    def __enter__(self) -> RunEvents:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def flush(self) -> None:
        """Write buffered events."""
        self._writer.flush()

    def write_errors(
        self,
        step: int,
        sets: Mapping[str, Metrics],
        groups: Sequence[str] = tuple(ERROR_GROUPS),
        *,
        nominal: bool = False,
        by_epoch: bool = True,
    ) -> None:
        """Errors by group of rows of one parameter vector, `nominal` or identified, on sets of logs.

        `by_epoch`: whether a descent works them out on its way.
        """
        kind = _URDF if nominal and not by_epoch else self._kind(nominal)
        for name, metrics in sets.items():
            for group in groups:
                if metrics.relative.get(group) is not None:
                    self._writer.add_scalar(f"relative_error_{name}{kind}/{group}", metrics.relative[group], step)
                if metrics.rms.get(group) is not None:
                    self._writer.add_scalar(f"rms_error_{name}{kind}/{group}", metrics.rms[group], step)

    def _kind(self, nominal: bool) -> str:
        """What the name of a chart ends with: the URDF's parameters are the first step of a descent."""
        return _URDF if nominal and not self._descent else ""

    def write_ridges(self, choice: RidgeChoice) -> None:
        """Errors on held-out folds by ridge: in these charts, steps are the decades of ridges, -3 for 0.001."""
        tried = zip(choice.tried, choice.mean_square, choice.standard_error, strict=True)
        for ridge, mean, error in tried:
            decade = round(math.log10(ridge))
            self._writer.add_scalar("ridge/held_out_mean_square", mean, decade)
            self._writer.add_scalar("ridge/held_out_standard_error", error, decade)

    def write_verdict(self, step: int, text: str) -> None:
        """Whether the identified parameters predict held-out blocks and test logs better than the URDF's."""
        self._writer.add_text("verdict", text, step)

    def write_eigenvalues(self, step: int, least: Mapping[str, float], *, nominal: bool = False) -> None:
        """Smallest eigenvalue of the scaled pseudo-inertia by body; negative: no such body exists."""
        for body, value in least.items():
            self._writer.add_scalar(f"eigenvalue{self._kind(nominal)}/{body}", value, step)

    def write_epoch(self, epoch: Epoch) -> None:
        """Losses and rates of an epoch of a descent."""
        scalars = {f"loss/{name}": value for name, value in epoch.losses.items()}
        if epoch.held_out is not None:
            scalars["loss_held_out/data"] = epoch.held_out
        scalars |= {f"share_of_force/{name}": value for name, value in epoch.shares.items()}
        if epoch.closed_form:  # 0 for a perfect fit of data without noise
            scalars["closed_form/objective_above_least"] = epoch.objective / epoch.closed_form - 1.0
        scalars["closed_form/distance"] = epoch.distance
        scalars["descent/learning_rate"] = epoch.learning_rate
        scalars["descent/samples_per_second"] = epoch.samples_per_second
        for tag, value in scalars.items():
            self._writer.add_scalar(tag, value, epoch.number)

    def write_solution(self, estimate: Estimate, samples_per_second: float | None) -> None:
        """Losses of a batch fit, in the charts of a descent.

        Args:
            estimate: the fit.
            samples_per_second: of the stream through the logs, None without one.
        """
        rows = max(estimate.rows, 1)
        self._writer.add_scalar(f"loss{_URDF}/data", estimate.nominal_cost / rows, 1)
        self._writer.add_scalar("loss/data", estimate.cost / rows, 1)
        if samples_per_second is not None:
            self._writer.add_scalar("descent/samples_per_second", samples_per_second, 1)
        if isinstance(estimate, ConstrainedEstimate):
            self._writer.add_scalar("loss/prior", estimate.objective - estimate.cost / rows, 1)
            self._writer.add_scalar("closed_form/distance", estimate.distance, 1)
            if estimate.relative_increase is not None:
                self._writer.add_scalar("closed_form/objective_above_least", estimate.relative_increase, 1)

    def write_fit(self, step: int, estimate: Estimate) -> None:
        """Statistics of the problem."""
        scalars = {"residual_std": estimate.residual_std, "rank": estimate.rank}
        if estimate.rank:
            scalars["condition_number"] = estimate.condition_number
        for name, value in scalars.items():
            self._writer.add_scalar(f"fit/{name}", value, step)

    def write_identifiability(self, step: int, estimate: Estimate, gain: InformationGain, table: str) -> None:
        """Verdicts, information and singular values; in the chart of the latter, steps are their numbers.

        Args:
            step: of all other charts.
            estimate: the fit.
            gain: information gained from all data.
            table: of the verdicts by contact state.
        """
        scalars = {f"verdicts/{verdict}": float(count) for verdict, count in estimate.verdict_counts().items()}
        scalars |= {"identifiability/bits": gain.bits, "identifiability/combinations": gain.determined}
        for tag, value in scalars.items():
            self._writer.add_scalar(tag, value, step)
        self._writer.add_text("verdicts", _preformatted(table), step)
        for index, value in enumerate(estimate.singular_values):
            self._writer.add_scalar("identifiability/singular_value", value, index)

    def write_summary(
        self,
        settings: str,
        hyperparameters: Mapping[str, str | float | bool],
        final: Mapping[str, float],
        figures: Mapping[str, bytes],
        step: int,
    ) -> None:
        """Settings, final metrics and figures of a finished run.

        Args:
            settings: resolved configuration, YAML.
            hyperparameters: for the HParams tab.
            final: metrics beside them.
            figures: PNG by tag.
            step: of the figures.
        """
        self._writer.add_text("config", _preformatted(settings))
        for tag, png in figures.items():
            width, height = struct.unpack(">II", png[16:24])
            image = Summary.Image(encoded_image_string=png, width=width, height=height, colorspace=_RGBA)
            self._writer.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)
        named = {f"final/{name}": value for name, value in final.items()}
        for summary in hparams(dict(hyperparameters), named):  # add_hparams would write a run of its own
            self._writer.file_writer.add_summary(summary)
        for tag, value in named.items():
            self._writer.add_scalar(tag, value, step)


def _preformatted(text: str) -> str:
    """The text as a preformatted block of Markdown."""
    return "    " + text.replace("\n", "\n    ")


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
