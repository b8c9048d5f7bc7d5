"""What the checks of a log found, as a table and as a document."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from torchid.hygiene import Checked, Finding, Span
from torchid.logs.fields import FloatArray
from torchid.text import listed

_SPANS = 3


def heading(checked: Checked) -> str:
    """Name, length and duration of a log."""
    log = checked.log
    lasts = log.time[-1] - log.time[0]
    return f"{Path(log.source).name}: {len(log)} samples, {lasts:.4g} s"


def hygiene_table(findings: Sequence[Finding]) -> Table:
    """Findings about one log, the gravest first."""
    table = Table(show_lines=True, expand=True)
    table.add_column("", no_wrap=True)
    table.add_column("samples", overflow="fold", max_width=12)
    table.add_column("found", overflow="fold", ratio=8)
    table.add_column("what to do", overflow="fold", ratio=5)
    for finding, *others in _alike(findings):
        found = f"{finding.field}, {finding.name}: {finding.found}"
        if others:
            found += f"; likewise {listed([other.field for other in others])}"
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


def not_checked(checked: Checked) -> str:
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


def hygiene_document(checked: Sequence[Checked]) -> dict[str, Any]:
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
