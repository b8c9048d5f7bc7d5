"""Findings of the log checks as a table, a JSON document, and a figure of all channels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from rich.table import Table
from rich.text import Text

from torchid.errors import excerpt, join_names
from torchid.log_checks import CONDEMNED, NOTE, SUSPICIOUS, Checked, Finding, Span
from torchid.log_checks.findings import channel_names, channel_unit
from torchid.logs import Log
from torchid.logs.log import FloatArray
from torchid.report.figures import STYLE

COLORS = {CONDEMNED: "tab:red", SUSPICIOUS: "tab:orange", NOTE: "tab:blue"}
_ROW, _HEAD, _WIDTH = 0.16, 1.0, 10.0  # inches
_LETTERS, _LONGEST = 130, 600  # of size 9 in a line, and in a title
_POINTS = 2000
_NARROW = 1.0 / 600.0  # of the width: a single sample of a long log stays visible
_RANGE = (0.5, 99.5)  # percentiles that fill a row


@matplotlib.rc_context(STYLE | {"axes.grid": False})
def log_check_figure(logs: Sequence[Checked]) -> Figure:
    """One panel per log, one row per channel, each with its range beside it; findings are marked in their color."""
    rows = [len(_rows(one.log)) for one in logs]
    heights = [_ROW * (count + _title(one).count("\n")) + _HEAD for count, one in zip(rows, logs, strict=True)]
    figure = Figure(figsize=(_WIDTH, sum(heights)), layout="constrained")
    panels = figure.subplots(len(logs), 1, squeeze=False, gridspec_kw={"height_ratios": heights})[:, 0]
    for axes, one in zip(panels, logs, strict=True):
        _panel(axes, one)
    marked = {finding.severity for one in logs for finding in _marked(one)}
    marks = [Patch(color=color, alpha=0.6, label=name) for name, color in COLORS.items() if name in marked]
    if marks:
        panels[0].legend(handles=marks, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(marks))
    return figure


def _title(checked: Checked) -> str:
    """Name and verdict, wrapped here: matplotlib takes a text that it wraps for a formula, whatever it is told."""
    return fill(excerpt(f"{Path(checked.log.source).name}: {checked.verdict}", _LONGEST), _LETTERS)


def _marked(checked: Checked) -> list[Finding]:
    """Findings that concern some samples, and more than a note."""
    return [finding for finding in checked.findings if finding.severity != NOTE and finding.spans]


def _rows(log: Log) -> dict[tuple[str, str], FloatArray]:
    """Channels in rows, by field and name; those that hold nothing are left out."""
    rows = {}
    for field in log.arrays():
        if field == "time":
            continue
        flat = np.asarray(getattr(log, field), dtype=np.float64).reshape(len(log), -1)
        for name, values in zip(channel_names(log, field), flat.T, strict=True):
            if np.isfinite(values).any() and np.nanmax(np.abs(values)) > 0.0:
                rows[field, name] = values
    return rows


def _panel(axes: Axes, checked: Checked) -> None:
    log, rows = checked.log, _rows(checked.log)
    time = log.time - log.time[0]
    places = {channel: -row for row, channel in enumerate(rows)}
    every = slice(None, None, max(1, len(time) // _POINTS))
    lines = [
        np.column_stack([time[every], _scaled(values)[every] + index])
        for (values, index) in zip(rows.values(), places.values(), strict=True)
    ]
    axes.add_collection(LineCollection(lines, colors="0.35", linewidths=0.6))
    for finding in _marked(checked):
        for span in finding.spans:
            inside = [
                index
                for (field, name), index in places.items()
                if finding.field in (field, "time") and span.channel in ("", name)
            ]
            _mark(axes, float(time[span.first]), float(time[span.last]), inside, time[-1], finding.severity)
    axes.set(xlim=(time[0], max(time[-1], 1e-9)), ylim=(-len(rows) + 0.4, 0.6), xlabel="time [s]")
    axes.set_yticks(list(places.values()), [f"{field} {name}" for field, name in places], fontsize=6)
    axes.tick_params(axis="y", length=0)
    beside = axes.secondary_yaxis("right")
    beside.set_yticks(list(places.values()), [_range_text(*channel, rows[channel]) for channel in places], fontsize=6)
    beside.tick_params(axis="y", length=0)
    beside.set_ylabel(f"range that fills a row: {_RANGE[0]:g} % to {_RANGE[1]:g} % of the values")
    axes.set_title(_title(checked), loc="left", fontsize=9)


def _mark(axes: Axes, start: float, end: float, places: Sequence[int], lasts: float, severity: str) -> None:
    width = max(end - start, _NARROW * lasts)
    middle = 0.5 * (start + end)
    for index in places:
        axes.broken_barh(
            [(middle - 0.5 * width, width)], (index - 0.5, 1.0), color=COLORS[severity], alpha=0.6, linewidth=0
        )


def _range_text(field: str, name: str, values: FloatArray) -> str:
    """What a row spans, with its unit."""
    low, high = (f"{x:.3g}" for x in np.nanpercentile(values, _RANGE))
    return f"{low} to {high} {channel_unit(field, name)}".rstrip()


def _scaled(values: FloatArray) -> FloatArray:
    """The values in a row of height 0.8, those beyond its range at the edge."""
    low, high = np.nanpercentile(values, _RANGE)
    return np.clip((values - low) / max(high - low, 1e-300), 0.0, 1.0) * 0.8 - 0.4


_SPANS = 3


def log_heading(checked: Checked) -> str:
    """Name, length and duration of a log."""
    log = checked.log
    lasts = log.time[-1] - log.time[0]
    return f"{Path(log.source).name}: {len(log)} samples, {lasts:.4g} s"


def finding_table(findings: Sequence[Finding]) -> Table:
    """Findings about one log, the gravest first."""
    table = Table(show_lines=True, expand=True)
    table.add_column("", no_wrap=True)
    table.add_column("samples", overflow="fold", max_width=12)
    table.add_column("found", overflow="fold", ratio=8)
    table.add_column("what to do", overflow="fold", ratio=5)
    for finding, *others in _alike(findings):
        found = f"{finding.field}, {finding.name}: {finding.found}"
        if others:
            found += f"; likewise {join_names([other.field for other in others])}"
        table.add_row(finding.severity, Text(_places(finding)), Text(found), Text(finding.advice))
    return table


def _alike(findings: Sequence[Finding]) -> list[list[Finding]]:
    """Findings, those together that say the same of several fields at the same samples."""
    rows: dict[object, list[Finding]] = {}
    for finding in findings:
        same = (finding.name, finding.severity, finding.advice, _ranges(finding) or finding)
        rows.setdefault(same, []).append(finding)
    return list(rows.values())


def _ranges(finding: Finding) -> tuple[tuple[int, int], ...]:
    """First and last samples of its spans in ascending order; empty if it concerns all."""
    return tuple(sorted({(span.first, span.last) for span in finding.spans}))


def skipped_checks_text(checked: Checked) -> str:
    """Checks that could not be made, and why; empty if there are none."""
    reasons: dict[str, list[str]] = {}
    for skip in checked.skipped:
        reasons.setdefault(skip.name, []).append(skip.reason)
    return "; ".join(f"{name} ({', '.join(why)})" for name, why in reasons.items())


def _places(finding: Finding) -> str:
    spans = [str(Span(first, last)) for first, last in _ranges(finding)]
    if not spans:
        return "all"
    some = ", ".join(spans[:_SPANS]) + (f" and {len(spans) - _SPANS} more" if len(spans) > _SPANS else "")
    return f"all; seen at {some}" if finding.whole else some


def log_check_document(checked: Sequence[Checked]) -> dict[str, Any]:
    """Everything that was found, for JSON."""
    return {"logs": [_log_entry(one) for one in checked]}


def _log_entry(checked: Checked) -> dict[str, Any]:
    log = checked.log
    return {
        "source": str(log.source),
        "samples": len(log),
        "seconds": float(log.time[-1] - log.time[0]),
        "usable": checked.usable,
        "verdict": checked.verdict,
        "condemned_samples": int(checked.condemned.sum()),
        "findings": [_finding_entry(finding, log.time) for finding in checked.findings],
        "not_checked": [{"name": skip.name, "reason": skip.reason} for skip in checked.skipped],
    }


def _finding_entry(finding: Finding, time: FloatArray) -> dict[str, Any]:
    return {
        "name": finding.name,
        "severity": finding.severity,
        "field": finding.field,
        "channels": list(finding.channels),
        "whole_log": finding.whole,
        "spans": [_span_entry(span, time) for span in finding.spans],
        "found": finding.found,
        "what_to_do": finding.advice,
    }


def _span_entry(span: Span, time: FloatArray) -> dict[str, Any]:
    return {
        "first": span.first,
        "last": span.last,
        "count": len(span),
        "start_s": float(time[span.first]),
        "end_s": float(time[span.last]),
        "channel": span.channel or None,
    }
