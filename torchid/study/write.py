"""Write a study's folder: tables, figures, every record, TensorBoard events."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from torchid.report.comparison import Bars, Panel, bar_figure, panel_figure
from torchid.report.figures import save_figure
from torchid.report.metrics import GROUPS, group_name
from torchid.report.tables import table_text
from torchid.report.tensorboard import write_comparison
from torchid.run.folder import write_json
from torchid.study.results import TRUE, Results, figures
from torchid.study.series import Series
from torchid.study.settings import SHOWN
from torchid.study.tables import error_table, findings_table, rank_table, summary_table

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
    """Write everything that a study found.

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
        for group in GROUPS
        for sensors in results.sensors
    }
    steps = ", ".join(f"{step}: {condition}" for step, condition in enumerate(results.conditions))
    texts = {"steps of the charts": steps} | {
        name: "    " + table_text(table).replace("\n", "\n    ") for name, table in tables.items()
    }
    write_comparison(folder / "tensorboard", scalars, texts, drawn)


def study_tables(results: Results) -> dict[str, Table]:
    """Fig. 6 for the condition shown, all conditions in short, the findings, ranks."""
    condition, training = SHOWN
    return {
        **{f"errors, {t}": error_table(results, condition, t) for t in results.trainings},
        "errors as measured": error_table(results, condition, training, "measured"),
        **{f"all conditions, {t}": summary_table(results, t) for t in results.trainings},
        "findings": findings_table(results),
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
    for group in GROUPS:
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
                "measured": _finite(figures(record.measured)),
                "exact": _finite(figures(record.exact)),
            }
            for record in results.records
        ],
        "ranks": [asdict(ranks) for ranks in results.ranks],
    }


def _finite(values: dict[str, float]) -> dict[str, float | None]:
    """With null for what a log cannot give."""
    return {name: value if np.isfinite(value) else None for name, value in values.items()}
