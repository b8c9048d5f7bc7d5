"""Offsets and scales of sensors and terms of actuators, for the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from rich.table import Table
from rich.text import Text

from torchid.analysis.calibration import ExtraEstimate

_COLUMNS, _ROWS = 4, 30


def extra_table(found: Sequence[ExtraEstimate]) -> Table:
    """Values with standard errors, a row for each unknown, a column for each log; all of them are in a run's files."""
    title = "Offsets, scales and actuators, with standard errors; ?: not told from other unknowns"
    table = Table(title=title, title_justify="left")
    logs = sorted(dict.fromkeys(x.log for x in found), key=bool)  # what holds for all logs comes first
    labels = list(dict.fromkeys(x.extra.label for x in found))
    by_place = {(x.extra.label, x.log): x for x in found}
    table.add_column("", overflow="fold")
    table.add_column("unit", no_wrap=True)
    shown = logs[:_COLUMNS]
    for log in shown:
        table.add_column(Text(Path(log).name or "all logs"), justify="right", overflow="fold")
    for label in labels[:_ROWS]:
        unit = next(x.extra.unit for x in found if x.extra.label == label)
        cells = (by_place.get((label, log)) for log in shown)
        table.add_row(Text(label), unit, *("" if x is None else _cell(x) for x in cells))
    hidden = {"row": len(labels) - _ROWS, "log": len(logs) - _COLUMNS}
    rest = " and ".join(f"{count} {what}{'s' * (count > 1)}" for what, count in hidden.items() if count > 0)
    if rest:
        table.add_row(f"and {rest} more: parameters.json")
    return table


def _cell(found: ExtraEstimate) -> str:
    mark = "" if found.told_apart else " ?"
    if not math.isfinite(found.standard_error):
        return f"{found.value:.4g}{mark}"
    size = float(f"{found.standard_error:.1e}")  # rounded first: 0.0998 is 0.10, with as many decimals
    digits = max(0, 1 - math.floor(math.log10(size))) if size > 0.0 else 6
    return f"{found.value:.{digits}f} ± {size:.{digits}f}{mark}"
