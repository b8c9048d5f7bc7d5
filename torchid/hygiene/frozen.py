"""Findings about sensors that repeat themselves: frozen, saturated, held at a lower rate, or constant.

A velocity or an acceleration of exactly zero while its joint's position repeats as well is a joint at rest, or at a
stop.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from torchid.hygiene.channels import Group
from torchid.hygiene.finding import CONDEMNED, NOTE, SUSPICIOUS, Finding, Span
from torchid.hygiene.repeats import Runs, held_for, implausible, in_dead_band
from torchid.logs.fields import WRENCHES, BoolArray, FloatArray
from torchid.text import counted, listed

#: Samples at the very same extreme value from which on it is a limit and no coincidence.
AT_LIMIT = 5
#: Fields that are zero while a joint rests.
RATES = ("joint_velocity", "joint_acceleration")
#: Fields in which a driver may set small readings to zero.
DEAD_BANDS = (*RATES, "joint_torque", "ft_wrench", *WRENCHES)

_Stuck = list[tuple[str, Runs]]


def frozen(groups: Iterable[Group]) -> Iterator[Finding]:
    """Findings about frozen, held, saturated and constant channels."""
    given = tuple(groups)
    positions = next((group for group in given if group.field == "joint_position"), None)
    for group in given:
        steps = np.diff(group.values, axis=0)
        constant = (steps == 0.0).all(axis=0)
        if constant.any():
            yield from _constant(group, constant)
        if constant.all():
            continue
        rests = _at_rest(group, steps, positions)
        together = ((steps == 0.0) & ~rests)[:, ~constant].all(axis=1) & group.joined
        if every := held_for(group.values[:, ~constant], together):
            yield _held(group, [(name, every) for name in group.names])
            continue
        moving = group.values[:, ~constant]
        runs = implausible(moving, together)
        if group.field in DEAD_BANDS:
            runs = runs.where(~in_dead_band(moving, runs))
        if len(runs):
            what = f"all {len(group.names)} channels" if len(group.names) > 1 else group.names[0]
            yield _frozen(group, what, [(name, runs) for name in group.names], len(runs))
        if len(group.names) > 1:
            repeated = (steps == 0.0) & ~rests & (group.joined & ~runs.mask(len(steps)))[:, None]
            yield from _by_channel(group, repeated, np.flatnonzero(~constant))


def _at_rest(group: Group, steps: FloatArray, positions: Group | None) -> BoolArray:
    """Which steps (M - 1, c) of joint velocities or accelerations are those of a joint that does not move."""
    if positions is None or group.field not in RATES or not np.isin(group.samples, positions.samples).all():
        return np.zeros(steps.shape, bool)
    columns = [positions.names.index(name) for name in group.names]
    position = positions.values[np.searchsorted(positions.samples, group.samples)][:, columns]
    return np.asarray((steps == 0.0) & (group.values[1:] == 0.0) & (np.diff(position, axis=0) == 0.0))


def _by_channel(group: Group, all_repeated: BoolArray, columns: np.ndarray) -> Iterator[Finding]:
    """Channels that repeat by themselves, of steps (M - 1, c)."""
    stuck: _Stuck = []
    dead: list[tuple[str, float, float]] = []
    limits: list[tuple[str, Runs, float]] = []
    every = {column: held_for(group.values[:, [column]], all_repeated[:, column]) for column in columns}
    for column in (column for column in columns if not every[column]):
        repeated = all_repeated[:, column]
        name, values = group.names[column], group.values[:, column]
        runs = implausible(values[:, None], repeated)
        zeros = values[runs.first] == 0.0
        quiet = in_dead_band(values[:, None], runs)
        if group.field in DEAD_BANDS and quiet.any() and 2 * quiet.sum() >= zeros.sum():
            dead.append((name, float(np.abs(values[values != 0.0]).min()), 100.0 * float(np.mean(values == 0.0))))
            runs = runs.where(~zeros)
        for extreme in (values.min(), values.max()):
            at_limit = Runs.of(repeated & (values[1:] == extreme))
            if (values[runs.first] == extreme).any() and at_limit.lengths.sum() >= AT_LIMIT:
                limits.append((name, at_limit, float(extreme)))
                runs = runs.where(values[runs.first] != extreme)
        if len(runs):
            stuck.append((name, runs))
    if stuck:
        yield _frozen(group, listed([name for name, _ in stuck]), stuck, sum(len(runs) for _, runs in stuck))
    if dead:
        each = [f"{name} below {least:.3g} {group.unit} ({share:.2g} % of it)" for name, least, share in dead]
        advice = "switch the dead band off; a velocity may be left out, and is derived then"
        names = tuple(name for name, _, _ in dead)
        yield Finding("dead band", SUSPICIOUS, group.field, f"reads 0: {listed(each)}", advice, names)
    if limits:
        yield _saturated(group, limits)
    if any(every.values()):
        yield _held(group, [(group.names[column], each) for column, each in every.items() if each])


def _spans(group: Group, channel: str, runs: Runs, skip: int = 1) -> Iterator[Span]:
    """Samples that repeat the one before; with it for a `skip` of 0."""
    for first, last in zip(runs.first, runs.last, strict=True):
        yield Span(int(group.samples[first + skip]), int(group.samples[last + 1]), channel)


def _frozen(group: Group, what: str, stuck: _Stuck, count: int) -> Finding:
    spans = tuple(span for name, runs in stuck for span in _spans(group, name, runs))
    longest = max(spans, key=len)
    times = f"{counted(len(longest), 'sample')} at {longest}"
    if count > 1:
        times = f"{count} times, the longest {times}"
    whose = f"{group.name}, " if group.name else ""
    text = f"{whose}{what}: repeated to the last bit amid motion, {times}"
    advice = "leave these samples out; look for lost messages or a stalled driver"
    return Finding("frozen", CONDEMNED, group.field, text, advice, tuple(name for name, _ in stuck), spans)


def _saturated(group: Group, limits: list[tuple[str, Runs, float]]) -> Finding:
    spans = tuple(span for name, runs, _ in limits for span in _spans(group, name, runs, 0))
    names = tuple(dict.fromkeys(name for name, _, _ in limits))
    shares = [(name, extreme, 100.0 * np.mean(group.values == extreme, axis=0)) for name, _, extreme in limits]
    text = "stays at an extreme value: " + listed(
        [f"{name} at {at:.4g} {group.unit} in {share[group.names.index(name)]:.2g} %" for name, at, share in shares]
    )
    if group.field == "joint_position":  # on a stop, or on the bound of an inverse kinematics: it may be right there
        advice = "none if these are the joints' stops; else widen the bounds of the encoder or inverse kinematics"
        return Finding("saturated", SUSPICIOUS, group.field, text, advice, names, spans)
    advice = "leave these samples out, or raise the sensor's range"
    return Finding("saturated", CONDEMNED, group.field, text, advice, names, spans)


def _held(group: Group, held: list[tuple[str, float]]) -> Finding:
    every = max(each for _, each in held)
    names = tuple(name for name, _ in held)
    whose = f"{listed(names)}: " if len(names) < len(group.names) else ""
    text = (
        f"{whose}new values only every {every:.3g} samples, repeated in between: "
        f"{0.5 * (every - 1):.2g} samples late on average"
    )
    advice = f"record at one rate, or set preprocessing.cutoff_hz below {0.25 / every:.2g} of the sample rate"
    return Finding("held", SUSPICIOUS, group.field, text, advice, names)


def _constant(group: Group, constant: BoolArray) -> Iterator[Finding]:
    names = tuple(name for name, still in zip(group.names, constant, strict=True) if still)
    zero = not group.values[0][constant].any()
    if zero and group.field in WRENCHES:  # what a point contact cannot exert
        return
    text = f"{listed(names)}: {'0' if zero else 'one value'} throughout"
    if zero and group.field == "joint_torque":
        advice = "write NaN if they were not measured: zeros are fitted as measured torques"
        yield Finding("constant", SUSPICIOUS, group.field, text, advice, names)
    else:
        yield Finding("constant", NOTE, group.field, text, "none if that is so: what does not move adds nothing", names)
