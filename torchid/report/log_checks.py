"""Results of the log checks as a figure of all channels, a table, and a JSON document."""

from __future__ import annotations

from collections.abc import Sequence
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
from torchid.log_checks import NOTE, REJECTED, SUSPICIOUS, Checked, Finding, Span
from torchid.log_checks.findings import channel_names, channel_unit
from torchid.logs import Log
from torchid.logs.log import FloatArray
from torchid.logs.time_range import log_title
from torchid.report.figure_style import IDENTIFIED_COLOR, NOMINAL_COLOR, STYLE, WIDTH, label_ticks

COLORS = {REJECTED: NOMINAL_COLOR, SUSPICIOUS: "#e69f00", NOTE: IDENTIFIED_COLOR}
_ROW = 0.16  # inches
_HEAD = 1.0  # inches of a panel's title
_LINE_LETTERS = 130  # of a title, at font size 9
_TITLE_LETTERS = 600
#: Points of a curve.
_MAX_POINTS = 2000
#: Width of a mark over that of the panel: a single sample of a long log stays visible.
_MIN_MARK_SHARE = 1.0 / 600.0
#: Percentiles of a channel that fill its row.
_RANGE = (0.5, 99.5)
#: Spans that a cell of the table lists.
_MAX_SPANS = 3


@matplotlib.rc_context(STYLE | {"axes.grid": False})
def log_check_figure(logs: Sequence[Checked]) -> Figure:
    """One panel per log and one row per channel, with its range; findings are marked by the color of their severity."""
    lines = [len(_channels(checked.log)) + _title(checked).count("\n") for checked in logs]
    heights = [_ROW * count + _HEAD for count in lines]
    figure = Figure(figsize=(WIDTH, sum(heights)), layout="constrained")
    panels = figure.subplots(len(logs), 1, squeeze=False, gridspec_kw={"height_ratios": heights})[:, 0]
    for axes, checked in zip(panels, logs, strict=True):
        _draw_panel(axes, checked)
    marked = {finding.severity for checked in logs for finding in _marked_findings(checked)}
    marks = [Patch(color=color, alpha=0.6, label=name) for name, color in COLORS.items() if name in marked]
    if marks:
        panels[0].legend(handles=marks, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(marks))
    return figure


def _title(checked: Checked) -> str:
    """Name and verdict, wrapped here: matplotlib parses texts that it wraps as formulas, whatever its settings."""
    return fill(excerpt(f"{log_title(checked.log.source)}: {checked.verdict}", _TITLE_LETTERS), _LINE_LETTERS)


def _marked_findings(checked: Checked) -> list[Finding]:
    """Rejected and suspicious findings about some samples."""
    return [finding for finding in checked.findings if finding.severity != NOTE and finding.spans]


def _channels(log: Log) -> dict[tuple[str, str], FloatArray]:
    """Channels by field and name, without those that are 0 or NaN throughout."""
    channels = {}
    for field in log.arrays():
        if field == "time":
            continue
        flat = np.asarray(getattr(log, field), dtype=np.float64).reshape(len(log), -1)
        for name, values in zip(channel_names(log, field), flat.T, strict=True):
            if np.isfinite(values).any() and np.nanmax(np.abs(values)) > 0.0:
                channels[field, name] = values
    return channels


def _draw_panel(axes: Axes, checked: Checked) -> None:
    channels = _channels(checked.log)
    heights = [-row for row in range(len(channels))]
    time = checked.log.time - checked.log.time[0]
    step = slice(None, None, max(1, len(time) // _MAX_POINTS))
    lines = [
        np.column_stack([time[step], _scale_to_row(values)[step] + height])
        for values, height in zip(channels.values(), heights, strict=True)
    ]
    axes.add_collection(LineCollection(lines, colors="0.35", linewidths=0.6))
    for finding in _marked_findings(checked):
        style: dict[str, Any] = {"color": COLORS[finding.severity], "alpha": 0.6, "linewidth": 0}
        for span in finding.spans:
            start = float(time[span.first])
            end = float(time[span.last])
            width = max(end - start, _MIN_MARK_SHARE * time[-1])
            for (field, name), height in zip(channels, heights, strict=True):
                if finding.field in (field, "time") and span.channel in ("", name):
                    axes.broken_barh([(0.5 * (start + end) - 0.5 * width, width)], (height - 0.5, 1.0), **style)
    axes.set(xlim=(time[0], max(time[-1], 1e-9)), ylim=(-len(channels) + 0.4, 0.6), xlabel="time [s]")
    label_ticks(axes.yaxis, heights, [f"{field} {name}" for field, name in channels], fontsize=7)
    axes.tick_params(axis="y", length=0)
    ranges = axes.secondary_yaxis("right")
    ranges.set_yticks(heights, [_range_text(*channel, values) for channel, values in channels.items()], fontsize=7)
    ranges.tick_params(axis="y", length=0)
    ranges.set_ylabel(f"range of each row: {_RANGE[0]:g} % to {_RANGE[1]:g} % quantile")
    axes.set_title(_title(checked), loc="left", fontsize=9)


def _scale_to_row(values: FloatArray) -> FloatArray:
    """The values in a row of height 0.8, clipped to its range."""
    low, high = np.nanpercentile(values, _RANGE)
    return np.clip((values - low) / max(high - low, 1e-300), 0.0, 1.0) * 0.8 - 0.4


def _range_text(field: str, name: str, values: FloatArray) -> str:
    """Range of a row with its unit."""
    low, high = (f"{x:.3g}" for x in np.nanpercentile(values, _RANGE))
    return f"{low} to {high} {channel_unit(field, name)}".rstrip()


def log_heading(checked: Checked) -> str:
    """Name, length and duration of a log."""
    log = checked.log
    return f"{log_title(log.source)}: {len(log)} samples, {log.time[-1] - log.time[0]:.4g} s"


def finding_table(findings: Sequence[Finding]) -> Table:
    """Findings about one log, in the given order."""
    table = Table(show_lines=True, expand=True)
    table.add_column("", no_wrap=True)
    table.add_column("samples", overflow="fold", max_width=12)
    table.add_column("found", overflow="fold", ratio=8)
    table.add_column("what to do", overflow="fold", ratio=5)
    for finding, *others in group_alike(findings):
        text = f"{finding.field} ({finding.name}): {finding.found}"
        if others:
            text += f"; also {join_names([other.field for other in others])}"
        table.add_row(finding.severity, Text(_samples_text(finding)), Text(text), Text(finding.advice))
    return table


def group_alike(findings: Sequence[Finding]) -> list[list[Finding]]:
    """Findings in groups of the same kind and samples in several fields."""
    rows: dict[object, list[Finding]] = {}
    for finding in findings:
        same = (finding.name, finding.severity, finding.advice, _ranges(finding) or finding)
        rows.setdefault(same, []).append(finding)
    return list(rows.values())


def _ranges(finding: Finding) -> tuple[tuple[int, int], ...]:
    """First and last samples of the spans in ascending order; empty for the whole log."""
    return tuple(sorted({(span.first, span.last) for span in finding.spans}))


def _samples_text(finding: Finding) -> str:
    spans = [str(Span(first, last)) for first, last in _ranges(finding)]
    if not spans:
        return "all"
    more = f" and {len(spans) - _MAX_SPANS} more" if len(spans) > _MAX_SPANS else ""
    text = ", ".join(spans[:_MAX_SPANS]) + more
    return f"all; shown at {text}" if finding.whole else text


def skipped_checks_text(checked: Checked) -> str:
    """Checks that could not be made, with the reasons; empty if there are none."""
    reasons: dict[str, list[str]] = {}
    for skip in checked.skipped:
        reasons.setdefault(skip.name, []).append(skip.reason)
    return "; ".join(f"{name} ({', '.join(texts)})" for name, texts in reasons.items())


def log_check_document(checked: Sequence[Checked]) -> dict[str, Any]:
    """Results of all checks, for JSON."""
    return {"logs": [_log_entry(log) for log in checked]}


def _log_entry(checked: Checked) -> dict[str, Any]:
    log = checked.log
    return {
        "source": str(log.source),
        "samples": len(log),
        "seconds": float(log.time[-1] - log.time[0]),
        "usable": checked.usable,
        "verdict": checked.verdict,
        "rejected_samples": int(checked.rejected.sum()),
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
