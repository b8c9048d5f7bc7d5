"""Time stamps: unit, jitter, gaps and stamps that nearly coincide."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from torchid.hygiene.channels import LONG_STEP
from torchid.hygiene.finding import CONDEMNED, NOTE, SUSPICIOUS, Finding, Span
from torchid.logs import Log
from torchid.logs.fields import BoolArray, FloatArray
from torchid.logs.plan import FEWEST_DIFFERENTIATED, LONGEST_STEP, SHORTEST_STEP
from torchid.logs.preprocess import differentiates
from torchid.text import counted

#: A median step [s] above which no acceleration can be seen: robots move at 0.5 to 5 Hz.
SLOWEST_STEP = 0.5
#: Units that stamps are mistaken in, by how many there are in a second.
_TICKS = {"ms": 1e3, "us": 1e6, "ns": 1e9}
#: Jitter, in median steps, below which nobody needs to hear of it: 1e-3 of a step at 1 rad/s and 1 kHz is 1e-6 rad.
WORTH_A_NOTE = 1e-3
#: Deviations of a step, in rms deviations, by which samples are chosen to ask whether the motion follows the stamps.
_STRONG = 3.0
#: Share of the misfit against the stamps below which positions that were taken as uniform in time fit better.
_BETTER = 0.5


def stamps(log: Log) -> Iterator[Finding]:
    """Findings about `time`."""
    if len(log) < FEWEST_DIFFERENTIATED and differentiates(log):
        text = f"{counted(len(log), 'sample')}: velocities and accelerations cannot be derived"
        advice = f"record {FEWEST_DIFFERENTIATED} samples or more, or give every velocity and acceleration"
        yield Finding("too short", CONDEMNED, "time", text, advice)
    if len(log) < 3:
        return
    steps = np.diff(log.time)
    median = float(np.median(steps))
    if median > SLOWEST_STEP:
        yield _slow(median)
    long, short = steps > LONG_STEP * median, steps < SHORTEST_STEP * median
    deviation = (steps - median)[~long] / median
    rms = float(np.sqrt(np.mean(np.square(deviation))))
    if rms > WORTH_A_NOTE:
        yield _jitter(log, steps / median, rms, float(np.max(np.abs(deviation))), long)
    if long.any():
        yield _gaps(steps, median, long)
    if short.any():
        where = np.flatnonzero(short)
        first = int(where[0])
        below = f"{counted(len(where), 'step')} below {SHORTEST_STEP:g} of the median"
        text = f"{below}, the first of {steps[first]:.3g} s after sample {first}: noise is multiplied there"
        spans = tuple(Span(int(i) + 1, int(i) + 1) for i in where)
        yield Finding("coincident stamps", CONDEMNED, "time", text, "drop one sample of each pair", spans=spans)


def _slow(median: float) -> Finding:
    likely = [unit for unit, ticks in _TICKS.items() if median / ticks <= SLOWEST_STEP]
    guess = f"; are these {likely[0]}? Then {_TICKS[likely[0]] / median:.4g} Hz" if likely else ""
    return Finding("unit", CONDEMNED, "time", f"median step {median:.4g} s{guess}", "convert the stamps to seconds")


def _jitter(log: Log, steps: FloatArray, rms: float, largest: float, long: BoolArray) -> Finding:
    found = f"rms {100 * rms:.2g} % of the median step, at most {100 * largest:.2g} %"
    advice = "none: a filter (preprocessing.cutoff_hz) interpolates to a uniform grid"
    if _motion_ignores(log, steps, _STRONG * rms, long):
        found += "; the positions do not follow: the stamps jitter, not the sampling"
        advice = "replace the stamps by uniform ones, at the median rate"
    return Finding("jitter", NOTE, "time", found, advice)


def _motion_ignores(log: Log, steps: FloatArray, strong: float, long: BoolArray) -> bool:
    """Whether joint positions are smoother in the sample number than in the time stamps, where stamps are off most."""
    before, after = steps[:-1], steps[1:]
    where = 1 + np.flatnonzero((np.abs(before - after) > strong) & ~long[:-1] & ~long[1:])
    if len(where) < 10:  # too few to tell
        return False
    ahead, behind = (log.joint_position[where + k] - log.joint_position[where] for k in (1, -1))
    left, right = steps[where - 1, None], steps[where, None]
    by_number = np.abs(ahead + behind)
    by_stamp = np.abs(2.0 * (ahead * left + behind * right) / (left + right))
    return bool(by_number.sum() < _BETTER * by_stamp.sum())


def _gaps(steps: FloatArray, median: float, long: BoolArray) -> Finding:
    where, longest = np.flatnonzero(long), int(np.argmax(steps))
    lost = int(np.round(steps[where] / median - 1.0).sum())
    missing = f"{counted(len(where), 'gap')}, {counted(lost, 'sample')} missing"
    found = f"{missing}; longest {steps[longest]:.4g} s after sample {longest}"
    if steps[longest] > LONGEST_STEP * median:
        advice = f"split the log after sample {longest}: no spline is drawn across more than {LONGEST_STEP:g} steps"
        return Finding("gap", CONDEMNED, "time", found, advice)
    advice = f"keep preprocessing.cutoff_hz well below {0.5 / steps[longest]:.3g}: half a period fits in the gap then"
    return Finding("gap", SUSPICIOUS, "time", found, advice, spans=tuple(Span(int(i), int(i) + 1) for i in where))
