"""Expected beside measured accuracy of sensor sets: a table and a figure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter
from rich.table import Table
from rich.text import Text

from torchid.report.expected import ExpectedErrors
from torchid.report.figures import STYLE
from torchid.report.metrics import GROUPS, Metrics, group_name

_MODEL, _EXPECTED, _MEASURED = ("o", "tab:blue"), ("s", "0.6"), ("D", "black")


@dataclass(frozen=True)
class SetAccuracy:
    """Of a fit with one sensor set: errors that were expected, and those measured on unseen logs, if there are any."""

    channels: int
    rank: int
    expected: ExpectedErrors
    measured: Metrics | None

    def as_dict(self) -> dict[str, object]:
        """Rms by group of rows."""
        return {
            "channels": self.channels,
            "rank": self.rank,
            "expected_model_error": self.expected.model,
            "expected_sensor_noise": self.expected.sensors,
            "expected": self.expected.total,
            "measured": None if self.measured is None else self.measured.rms,
        }


def accuracy_table(sets: Mapping[str, SetAccuracy]) -> Table:
    """Expected and measured rms error by group of rows."""
    title = "Accuracy of sensor sets, rms error: expected of the model, with noise added, measured"
    table = Table(title=title, title_justify="left")
    table.add_column("sensors", overflow="fold")
    table.add_column("channels", justify="right")
    table.add_column("rank", justify="right")
    table.add_column("", no_wrap=True)
    for label in GROUPS.values():
        table.add_column(Text(label.replace(" [", "\n[")), justify="right")
    for name, found in sets.items():
        first: list[Text | str] = [Text(name), str(found.channels), str(found.rank)]
        for label, errors in (
            ("expected", found.expected.model),
            ("with noise", found.expected.total),
            ("measured", {} if found.measured is None else found.measured.rms),
        ):
            table.add_row(*first, label, *(_figure(errors.get(group)) for group in GROUPS))
            first = ["", "", ""]
        table.add_section()
    return table


def _figure(x: float | None) -> str:
    return "-" if x is None else f"{x:.3g}"


@matplotlib.rc_context(STYLE)
def accuracy_figure(sets: Mapping[str, SetAccuracy]) -> Figure:
    """One panel per group of rows, with the sensor sets side by side on a logarithmic scale."""
    figure = Figure(figsize=(2.6 * len(GROUPS) + 0.6, 3.8), layout="constrained")
    axes = figure.subplots(1, len(GROUPS))
    place = np.arange(len(sets))
    for axis, (group, label) in zip(axes, GROUPS.items(), strict=True):
        measured = [None if found.measured is None else found.measured.rms[group] for found in sets.values()]
        for shift, name, (marker, color), heights in (
            (-0.15, "expected model error", _MODEL, [found.expected.model[group] for found in sets.values()]),
            (0.0, "expected, with noise added", _EXPECTED, [found.expected.total[group] for found in sets.values()]),
            (0.15, "measured on the test logs", _MEASURED, measured),
        ):
            known = [np.nan if height is None else height for height in heights]
            axis.plot(place + shift, known, marker, color=color, markersize=7, label=name)
        axis.set_yscale("log")
        axis.yaxis.set_major_formatter(LogFormatter())  # the default writes formulas, which names forbid, see STYLE
        axis.yaxis.set_minor_formatter(LogFormatter(labelOnlyBase=False))
        axis.margins(x=0.3 / max(len(sets) - 1, 1), y=0.15)
        axis.set_xticks(place, list(sets), rotation=40, ha="right")
        axis.set_title(group_name(group), loc="left", fontsize=9)
        axis.set_ylabel(f"rms error {label[label.index('[') :]}")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return figure
