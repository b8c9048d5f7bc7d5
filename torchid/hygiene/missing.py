"""Samples of a channel that were not measured, or cannot have been."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from torchid.hygiene.channels import NO_SIGNALS, channel_names
from torchid.hygiene.finding import CONDEMNED, NOTE, Finding, Span, spans_of
from torchid.logs import Log
from torchid.logs.fields import NAN_ALLOWED, WRENCHES, FloatArray
from torchid.text import counted, listed

#: Share of NaN above which a channel counts as one that was not recorded, and not as one with holes.
MOSTLY_THERE = 0.2
#: Size in any unit that nothing on a robot has: what is larger is no number but rubbish.
ABSURD = 1e12


def absurd(log: Log) -> Iterator[Finding]:
    """Findings about values that nothing can have."""
    for field in log.arrays():
        if field in NO_SIGNALS:
            continue
        values: FloatArray = getattr(log, field)
        flat = values.reshape(len(log), -1)
        with np.errstate(invalid="ignore"):
            bad = np.abs(flat) > ABSURD
        if not bad.any():
            continue
        names = channel_names(log, field)
        columns = np.flatnonzero(bad.any(axis=0))
        channels = tuple(names[column] for column in columns)
        text = f"{listed(channels)}: beyond {ABSURD:g}, in {counted(int(bad.any(axis=1).sum()), 'sample')}"
        rare = bad.any(axis=1).mean() <= MOSTLY_THERE
        spans = tuple(span for column in columns for span in spans_of(bad[:, column], names[column])) if rare else ()
        yield Finding("absurd", CONDEMNED, field, text, "look for uninitialised memory or an overflow", channels, spans)


def missing(log: Log) -> Iterator[Finding]:
    """Findings about NaN; of a contact, while it is active. Motion has to be known throughout, a force has not."""
    for field in log.arrays():
        if field not in NO_SIGNALS:
            yield from _missing(log, field)


def _missing(log: Log, field: str) -> Iterator[Finding]:
    array: FloatArray = getattr(log, field)
    names = channel_names(log, field)
    nan = np.isnan(array)
    if field in WRENCHES and log.contact_active is not None:
        nan = nan & log.contact_active[..., None]
        relevant = np.repeat(log.contact_active.sum(axis=0), array.shape[2])
    else:
        relevant = np.full(len(names), len(log))
    nan = nan.reshape(len(log), -1)
    counts = nan.sum(axis=0)
    holes: dict[str, tuple[int, float]] = {}
    gone: dict[str, tuple[int, float]] = {}
    for column in np.flatnonzero(counts):
        share = counts[column] / relevant[column]
        (holes if share <= MOSTLY_THERE else gone)[names[column]] = (int(column), share)
    if holes:
        spans: tuple[Span, ...] = tuple(
            span for name, (column, _) in holes.items() for span in spans_of(nan[:, column], name)
        )
        shares = ", ".join(f"{name} {100 * share:.2g} %" for name, (_, share) in list(holes.items())[:4])
        text = f"NaN in {counted(len(holes), 'channel')}, {counted(len(spans), 'time')}: {shares}"
        if field in NAN_ALLOWED:
            advice = "leave these samples out; a filter would lose the channels throughout"
        else:
            advice = "leave these samples out (exclude_condemned): motion must be known throughout"
        yield Finding("not measured", CONDEMNED, field, text, advice, tuple(holes), spans)
    if gone:
        entire = all(share == 1.0 for _, share in gone.values())
        how = "throughout" if entire else f"in {100 * max(share for _, share in gone.values()):.3g} % at most"
        needed = field not in NAN_ALLOWED
        if needed:
            advice = "record it throughout, or leave the field out if something else gives this motion"
        else:
            advice = "none, as long as it is not among the sensors" if entire else "leave it out of the sensors"
        severity = CONDEMNED if needed else NOTE
        yield Finding("not measured", severity, field, f"{listed(list(gone))}: NaN {how}", advice, tuple(gone))
