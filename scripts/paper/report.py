"""A study's folder: tables, figures, every record, TensorBoard events."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from rich.table import Table
from torch.utils.tensorboard import SummaryWriter

from paper.fits import Series
from paper.results import TRUE, Results, error_figures, examine_claims
from paper.settings import SHOWN
from torchid.commands.folder import write_json
from torchid.parameters import Array
from torchid.problem.metrics import ROW_GROUPS, group_name
from torchid.report.figure_style import IDENTIFIED_COLOR, NOISE_COLOR, NOMINAL_COLOR, STYLE, label_decades, save_figure
from torchid.report.tables import table_text

_COLORS = (NOMINAL_COLOR, IDENTIFIED_COLOR, "#009e73", "#cc79a7", "#e69f00", NOISE_COLOR)  # of Okabe and Ito


@dataclass(frozen=True)
class Panel:
    """One force over time, (N,), and what every parameter vector predicts."""

    name: str
    unit: str
    true: Array
    predicted: Mapping[str, Array]


@dataclass(frozen=True)
class Bars:
    """Errors of one group of rows: median, least and greatest by parameter vector, as shares."""

    name: str
    heights: Mapping[str, tuple[float, float, float]]


@matplotlib.rc_context(STYLE)
def panel_figure(title: str, time: Array, panels: Sequence[Panel]) -> Figure:
    """Forces on the left, errors of the predictions on the right, one row per panel; time in [s]."""
    figure = Figure(figsize=(10.0, 1.9 * len(panels) + 0.9), layout="constrained")
    axes = figure.subplots(len(panels), 2, sharex=True, squeeze=False)
    for (left, right), panel in zip(axes, panels, strict=True):
        left.plot(time, panel.true, color="black", linewidth=2.0, label="true")
        for (name, predicted), color in zip(panel.predicted.items(), _COLORS, strict=False):
            left.plot(time, predicted, color=color, linewidth=1.0, label=name)
            right.plot(time, predicted - panel.true, color=color, linewidth=1.0)
        left.set_title(panel.name, loc="left", fontsize=9)
        right.set_title("error", loc="left", fontsize=9)
        left.set_ylabel(f"[{panel.unit}]")
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    figure.suptitle(title, x=0.01, ha="left")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


@matplotlib.rc_context(STYLE)
def bar_figure(title: str, groups: Sequence[Bars]) -> Figure:
    """Errors as bars on a logarithmic scale, one panel per group of rows; lines from the least to the greatest."""
    figure = Figure(figsize=(2.5 * len(groups) + 0.6, 3.4), layout="constrained")
    axes = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    for axis, group in zip(axes, groups, strict=True):
        position = np.arange(len(group.heights))
        median, least, greatest = 100.0 * np.array(list(group.heights.values())).T
        axis.bar(position, median, 0.7, color=[*_COLORS[: len(position) - 1], "black"])
        axis.errorbar(position, median, yerr=[median - least, greatest - median], fmt="none", ecolor="0.4", capsize=3)
        for x, y, top in zip(position, median, greatest, strict=True):
            axis.annotate(f"{y:.2g}", (x, top), (0, 2), textcoords="offset points", ha="center", fontsize=7)
        axis.set_yscale("log")
        axis.margins(y=0.15)
        label_decades(axis.yaxis)
        axis.set_xticks(position, list(group.heights), rotation=40, ha="right")
        axis.set_title(group.name, loc="left", fontsize=9)
    axes[0].set_ylabel("rms of error / rms of measured [%]")
    figure.suptitle(title, x=0.01, ha="left")
    return figure


_COLUMNS = {
    "joint torque\n[N m]": ("joint_torque", "joint_torque/relative"),
    "base force\n[N]": ("base_force", "base_force/relative"),
    "base force, of\nits variation": (None, "base_force/variation"),
    "base moment\n[N m]": ("base_moment", "base_moment/relative"),
    "projected\n[N, N m]": ("nullspace", "nullspace/relative"),
}


def error_table(results: Results, condition: str, training: str, against: str = "exact") -> Table:
    """Errors on the unseen log, Fig. 6: medians of rms and share of the measured, and that share's range in %."""
    compared = "the truth" if against == "exact" else "what its sensors say"
    title = f"Unseen squat against {compared}; sensors: {condition}; fitted on {training}"
    table = Table(title=title, title_justify="left")
    table.add_column("", no_wrap=True)
    for heading in _COLUMNS:
        table.add_column(heading, justify="right", no_wrap=True)
    for sensors in results.sensors:
        cells = []
        for absolute, relative in _COLUMNS.values():
            lines = []
            if absolute is not None:
                lines.append(f"{results.spread(condition, training, sensors, absolute, against).median:.3g}")
            share = results.spread(condition, training, sensors, relative, against)
            lines.append(f"{100 * share.median:.2g} %")
            if share.greatest > share.least:
                lines.append(f"{100 * share.least:.2g}–{100 * share.greatest:.2g}")
            cells.append("\n".join(lines))
        table.add_row(sensors, *cells, end_section=True)
    return table


def summary_table(results: Results, training: str) -> Table:
    """Median error of every sensor set under every condition, as a share of the measured."""
    title = f"Error [%] of joint torque, base force, base moment, projected force; fitted on {training}"
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for condition in results.conditions:
        table.add_column(condition, justify="right")
    for sensors in results.sensors:
        cells = []
        for condition in results.conditions:
            medians = [results.spread(condition, training, sensors, f"{group}/relative").median for group in ROW_GROUPS]
            cells.append("\n".join(f"{100 * median:.2g}" for median in medians))
        table.add_row(sensors, *cells, end_section=True)
    return table


def claims_table(results: Results) -> Table:
    """Which of the claims of the paper hold, by condition and training logs."""
    table = Table(title="Findings of the paper: (1) full (2) contacts (3) joints", title_justify="left")
    for heading in ("sensors", "fitted on", "", "holds", "median error"):
        table.add_column(heading)
    for condition in results.conditions:
        for training in results.trainings:
            for claim in examine_claims(results, condition, training):
                first = claim.number == 1
                table.add_row(
                    condition if first else "",
                    training if first else "",
                    f"({claim.number})",
                    "yes" if claim.holds else "no",
                    claim.why,
                    end_section=claim.number == 3,
                )
    return table


def rank_table(results: Results) -> Table:
    """Samples and independent combinations per contact state, alone and together, by sensor set."""
    sets = list(dict.fromkeys(ranks.sensors for ranks in results.ranks))
    table = Table(title="Independent combinations of parameters, by contact state", title_justify="left")
    for heading in ("fitted on", "in contact", "samples", *sets):
        table.add_column(heading, justify="left" if heading in ("fitted on", "in contact") else "right")
    for training in results.trainings:
        of = {ranks.sensors: ranks.states for ranks in results.ranks if ranks.training == training}
        for number, state in enumerate(of[sets[0]]):
            ranks_of_state = [str(next((s.rank for s in of[name] if s.name == state.name), 0)) for name in sets]
            last = number == len(of[sets[0]]) - 1
            table.add_row(
                training if number == 0 else "", state.name, str(state.samples), *ranks_of_state, end_section=last
            )
    return table


_FORCES = (
    ("l_hip_flexion", "hip flexion torque", "N m"),
    ("l_knee_flexion", "knee flexion torque", "N m"),
    ("base force z", "base force z", "N"),
    ("base moment x", "base moment x", "N m"),
)
_PROJECTED = (
    ("l_hip_flexion", "projected, at the hip flexion", "N m"),
    ("l_knee_flexion", "projected, at the knee flexion", "N m"),
)
_SHOWN_S = 3.0


def write_study(folder: Path, results: Results, series: Series) -> None:
    """Write all results of a study.

    Args:
        folder: exists; gets `results.json`, `tables.txt`, `rms.png`, `forces.png`, `projected.png`, `tensorboard/`.
        results: errors of every fit.
        series: forces over time.
    """
    tables = study_tables(results)
    drawn = study_figures(results, series)
    (folder / "tables.txt").write_text("\n".join(table_text(table) for table in tables.values()))
    write_json(folder / "results.json", _document(results))
    for name, figure in drawn.items():
        save_figure(figure, folder / f"{name}.png")
    scalars = {
        (sensors, f"{training}/{group}"): [
            results.spread(condition, training, sensors, f"{group}/relative").median for condition in results.conditions
        ]
        for training in results.trainings
        for group in ROW_GROUPS
        for sensors in results.sensors
    }
    steps = ", ".join(f"{step}: {condition}" for step, condition in enumerate(results.conditions))
    texts = {"steps of the charts": steps} | {
        name: "    " + table_text(table).replace("\n", "\n    ") for name, table in tables.items()
    }
    write_comparison(folder / "tensorboard", scalars, texts, drawn)


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


def study_tables(results: Results) -> dict[str, Table]:
    """Fig. 6 for the condition shown, all conditions in short, the findings, ranks."""
    condition, training = SHOWN
    return {
        **{f"errors, {t}": error_table(results, condition, t) for t in results.trainings},
        "errors as measured": error_table(results, condition, training, "measured"),
        **{f"all conditions, {t}": summary_table(results, t) for t in results.trainings},
        "findings": claims_table(results),
        "ranks": rank_table(results),
    }


def study_figures(results: Results, series: Series) -> dict[str, Figure]:
    """Fig. 4, Fig. 5 and Fig. 6 of the paper."""
    condition, training = SHOWN
    part = series.time < _SHOWN_S
    about = f"unseen squat; sensors: {condition}; fitted on {training}"

    def panels(rows: tuple[tuple[str, str, str], ...], projected: bool) -> list[Panel]:
        true = series.projected_true if projected else series.true
        predicted = series.projected if projected else series.predicted
        return [
            Panel(
                name,
                unit,
                true[part, series.row(row)],
                {key: x[part, series.row(row)] for key, x in predicted.items() if key != TRUE},
            )
            for row, name, unit in rows
        ]

    bars = []
    for group in ROW_GROUPS:
        spreads = {s: results.spread(condition, training, s, f"{group}/relative") for s in results.sensors}
        heights = {name: (spread.median, spread.least, spread.greatest) for name, spread in spreads.items()}
        bars.append(Bars(group_name(group), heights))
    return {
        "rms": bar_figure(f"Errors, {about}", bars),
        "forces": panel_figure(f"Forces, {about}", series.time[part], panels(_FORCES, False)),
        "projected": panel_figure(f"Projected forces, {about}", series.time[part], panels(_PROJECTED, True)),
    }


def _document(results: Results) -> dict[str, object]:
    return {
        "records": [
            {
                "condition": record.condition,
                "training": record.training,
                "sensors": record.sensors,
                "noise_draw": record.noise_draw,
                "nominal_draw": record.nominal_draw,
                "measured": _finite(error_figures(record.measured)),
                "exact": _finite(error_figures(record.exact)),
            }
            for record in results.records
        ],
        "ranks": [asdict(ranks) for ranks in results.ranks],
    }


def _finite(values: dict[str, float]) -> dict[str, float | None]:
    """With null for what a log cannot give."""
    return {name: value if np.isfinite(value) else None for name, value in values.items()}
