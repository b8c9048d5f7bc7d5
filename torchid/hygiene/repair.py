"""Condemned samples: which they are, and a log in which nothing is left of them that a filter could smear."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

import numpy as np

from torchid.hygiene.channels import channel_names
from torchid.hygiene.finding import CONDEMNED, Finding
from torchid.logs import Log
from torchid.logs.fields import BoolArray, FloatArray


def condemned(findings: Iterable[Finding], samples: int) -> BoolArray:
    """Which of so many samples some finding condemns, (N,)."""
    mask = np.zeros(samples, bool)
    for finding in findings:
        if finding.severity == CONDEMNED:
            mask |= finding.mask(samples)
    return mask


def repaired(log: Log, findings: Iterable[Finding]) -> Log:
    """The log with condemned values interpolated, and with jumps taken out that are no motion.

    Only the channels that a finding names are touched: the samples are to be left out, but a filter sees them. A flag
    that misses a contact is set. Findings that concern the whole log leave nothing to go by and change nothing.
    """
    local = [finding for finding in findings if finding.severity == CONDEMNED and not finding.whole]
    changed: dict[str, Any] = {}
    for field in dict.fromkeys(field for finding in local for field in _touched(log, finding.field)):
        flat = np.array(getattr(log, field), dtype=np.float64).reshape(len(log), -1)
        bad = np.zeros(flat.shape, dtype=bool)
        for finding in local:
            if finding.field in (field, "time"):
                _mark(finding, channel_names(log, field), flat, bad)
        _interpolate(log.time, flat, bad)
        if field == "base_quat_xyzw":
            flat /= np.linalg.norm(flat, axis=1, keepdims=True)
        changed[field] = flat.reshape(getattr(log, field).shape)
    flags = [span for finding in local if finding.field == "contact_active" for span in finding.spans]
    if flags and log.contact_active is not None:
        changed["contact_active"] = log.contact_active.copy()
        for span in flags:
            changed["contact_active"][span.first : span.last + 1, log.contact_names.index(span.channel)] = True
    return dataclasses.replace(log, **changed) if changed else log


def _mark(finding: Finding, names: tuple[str, ...], flat: FloatArray, bad: BoolArray) -> None:
    """Mark what a finding condemns in the channels (N, c), and take its shifts out of them."""
    for span in finding.spans:
        columns = names.index(span.channel) if span.channel in names else slice(None)
        bad[span.first : span.last + 1, columns] = True
        if span.shift:
            flat[span.last :, columns] -= span.shift


def _touched(log: Log, field: str) -> list[str]:
    """Fields whose values a finding about `field` makes doubtful: all signals, if it is about time."""
    if field == "time":
        return [name for name, array in log.arrays().items() if name != "time" and array.dtype != np.bool_]
    return [] if field == "contact_active" else [field]


def _interpolate(time: FloatArray, flat: FloatArray, bad: BoolArray) -> None:
    """Replace the bad values of each column in place; at the ends they stay at the nearest good one."""
    for column in np.flatnonzero(bad.any(axis=0)):
        good = ~bad[:, column] & np.isfinite(flat[:, column])
        if good.any():
            here = bad[:, column]
            flat[here, column] = np.interp(time[here], time[good], flat[good, column])
