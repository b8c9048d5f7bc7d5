"""Spikes and lasting steps: jumps that neither the robot's motion nor a contact explains."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchid.errors import format_count, join_names
from torchid.log_checks.findings import (
    CONDEMNED,
    NORMAL,
    NOTE,
    SUSPICIOUS,
    ChannelGroup,
    Finding,
    Span,
    block_spread,
    finite_median,
    median_step,
    neighbours_of,
    widen_mask,
)
from torchid.logs import Log
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.preprocess import near_contact_changes

POSES = ("joint_position", "base_quat_xyzw", "base_position_world")
#: Fields whose lasting steps are reported; those of velocities and accelerations come from impacts and commands.
_STEPPING = ("joint_torque", "contact_wrench_local", "contact_wrench_world", "ft_wrench")
#: Ends of the names of fields in which impacts show as spikes.
_RINGING = ("acceleration", "acceleration_world", "acceleration_base", "specific_force")
#: Share of a channel's range, between its 1st and 99th percentile (of a force or moment: that of its component with the
#: largest), below which a spike changes no fit...
RELEVANT = 0.1
#: ... and a lasting step is no reset of a sensor.
RESET = 0.3
#: Jump of a position [rad, m, or of a quaternion's component] that is not reported: 0.03 degrees, 0.5 mm.
NEGLIGIBLE = 5e-4
#: A lasting step of a position that is within the error of its calibration.
HARMLESS = 0.01
#: Share of a log that may be given up where a position has another zero before or after a step.
SHORT_SIDE = 0.1
#: Time around a change of contact [s] in which forces and velocities may jump: impacts ring that long.
_IMPACT = 0.1
#: Percentiles of a force before and after a step, and the share of the step by which all of them move if the sensor was
#: reset there.
_LEVELS, _MOVED = (10.0, 50.0, 90.0), 0.5
#: Samples around a reversal of a joint in which its torque may jump, and the share of its usual speed below which it
#: counts as about to reverse.
_REVERSAL, _SLOW = 5, 0.2
#: How far a step may be from a whole number of turns, in turns, to count as a wrapped angle.
_WRAPPED = 0.01


@dataclass(frozen=True)
class Jump:
    """An excursion of samples `first` to `last` by about `size`, or a lasting step between these two.

    `spreads`: how many local spreads the size is.
    """

    first: int
    last: int
    size: float
    spreads: float
    lasting: bool


#: Jumps by channel, in numbers of samples of the log.
_Jumps = list[tuple[str, Jump]]


def check_jumps(log: Log, groups: Iterable[ChannelGroup]) -> Iterator[Finding]:
    """Findings about jumps in all channels."""
    given = [(group, [_raw(group, column) for column in range(len(group.names))]) for group in groups]
    impacts = _contact_changes(log) | _load_changes(log, given)
    by_field: dict[str, tuple[str, _Jumps]] = {}
    for group, by_column in given:
        _, found = by_field.setdefault(group.field, (group.unit, []))
        for column, name in enumerate(group.names):
            for jump in _unexplained(log, group, column, by_column[column], impacts):
                first, last = (int(group.samples[i]) for i in (jump.first, jump.last))
                found.append((name, dataclasses.replace(jump, first=first, last=last)))
    for field, (unit, found) in by_field.items():
        lasting = [(name, jump) for name, jump in found if jump.lasting]
        yield from _spikes(field, unit, [(name, jump) for name, jump in found if not jump.lasting])
        if field in POSES:
            yield from _position_steps(field, unit, lasting, len(log))
        elif lasting and field in _STEPPING:
            advice = "if the sensor was reset there, split the log: each part has its own offset"
            yield _finding("step", SUSPICIOUS, field, unit, lasting, advice)


def _spikes(field: str, unit: str, found: _Jumps) -> Iterator[Finding]:
    if found and field.endswith(_RINGING):
        yield _finding("spike", SUSPICIOUS, field, unit, found, "none if something hit something there")
    elif found:
        yield _finding("spike", CONDEMNED, field, unit, found, "leave these samples out; look for a loose contact")


def _finding(
    name: str, severity: str, field: str, unit: str, found: _Jumps, advice: str, spans: tuple[Span, ...] | None = None
) -> Finding:
    channels = tuple(dict.fromkeys(channel for channel, _ in found))
    channel, clearest = max(found, key=lambda pair: pair[1].spreads)
    where = f"from {clearest.first} to {clearest.last}" if clearest.lasting else f"at {_span('', clearest)}"
    size = abs(clearest.size)
    if field == "base_quat_xyzw":
        size, unit = np.degrees(2.0 * size), "deg"
    elif "," in unit:
        unit = "N" if channel.split()[-1].startswith("f") else "N m"
    text = f"{channel} by {size:.3g} {unit} {where}, {clearest.spreads:.3g} times the noise around it"
    if len(found) > 1:
        count = len({(jump.first, jump.last) for _, jump in found})
        text = f"{format_count(count, 'jump')} in {join_names(channels)}; the clearest: {text}"
    if spans is None:
        spans = tuple(_span(channel, jump) for channel, jump in found)
    return Finding(name, severity, field, text, advice, channels, spans)


def _span(channel: str, jump: Jump, shift: float = 0.0) -> Span:
    return Span(jump.first, jump.last, channel, shift)


def _raw(group: ChannelGroup, column: int) -> list[Jump]:
    """All jumps of a channel, in numbers of the group's samples."""
    values = group.values[:, column]
    longest = max(LONGEST_SPIKE, int(SHORT_SIDE * len(values))) if group.field in POSES else LONGEST_SPIKE
    return find_jumps(values, group.elapsed, group.piece, longest)


def _unexplained(log: Log, group: ChannelGroup, column: int, found: list[Jump], impacts: BoolArray) -> list[Jump]:
    """The jumps of a channel that neither motion nor contact explains."""
    values = group.values[:, column]
    if group.field in POSES:
        return [jump for jump in found if abs(jump.size) > NEGLIGIBLE]
    if not found:
        return found
    excused = impacts[group.samples] | group.field.endswith(_RINGING)
    if group.field == "joint_torque":
        excused = excused | _reversals(log.joint_position[:, log.joint_names.index(group.names[column])])[group.samples]
    like = values[:, None] if not group.name else group.values[:, column // 3 * 3 : column // 3 * 3 + 3]
    low, high = np.percentile(like, (1.0, 99.0), axis=0)
    span = float((high - low).max())
    return [
        jump
        for jump in found
        if abs(jump.size) > (RESET if jump.lasting else RELEVANT) * span
        and not (jump.lasting and group.field in _STEPPING and not _reset(values, jump))
        and (abs(jump.size) > span or not excused[jump.first : jump.last + 1].any())
    ]


def _reset(values: FloatArray, jump: Jump) -> bool:
    """Whether a channel reads differently after a lasting step than before, all in all."""
    before, after = (np.percentile(side, _LEVELS) for side in (values[: jump.first + 1], values[jump.last :]))
    return bool(((after - before) * np.sign(jump.size) > _MOVED * abs(jump.size)).all())


def _load_changes(log: Log, given: Iterable[tuple[ChannelGroup, list[list[Jump]]]]) -> BoolArray:
    """Samples close to where a force jumps and its sensor was not reset, (N,): something landed or lifted off."""
    where = np.zeros(len(log), bool)
    for group, by_column in given:
        if group.field not in _STEPPING:
            continue
        for column, found in enumerate(by_column):
            values = group.values[:, column]
            span = np.ptp(np.percentile(values, (1.0, 99.0)))
            steps = [jump for jump in found if jump.lasting and abs(jump.size) > RESET * span]
            where[[group.samples[jump.first] for jump in steps if not _reset(values, jump)]] = True
    return widen_mask(where, round(max(_IMPACT / median_step(log), LONGEST_SPIKE)))


def _contact_changes(log: Log) -> BoolArray:
    """Samples close to a change of any contact, (N,)."""
    return near_contact_changes(log, log.time, max(_IMPACT, LONGEST_SPIKE * median_step(log)))


def _reversals(position: FloatArray) -> BoolArray:
    """Samples close to where a joint is about to reverse, (N,)."""
    speed = np.abs(np.gradient(position))
    smooth = np.convolve(speed, np.ones(_REVERSAL) / _REVERSAL, mode="same")
    return widen_mask(smooth <= _SLOW * np.median(smooth), _REVERSAL)


def _position_steps(field: str, unit: str, lasting: _Jumps, samples: int) -> Iterator[Finding]:
    """Positions have another zero after a step: the shorter side is lost, or the whole log if neither is short."""
    kinds: dict[str, _Jumps] = {}
    for name, jump in lasting:
        together = max(abs(other.size) for _, other in lasting if other.first == jump.first)
        kinds.setdefault(_kind(field, jump, together, samples), []).append((name, jump))
    for kind, found in kinds.items():
        if kind == "wrapped":
            spans = tuple(_span(name, jump, 2.0 * np.pi * _turns(jump)) for name, jump in found)
            advice = "unwrap the angle: a turn is no motion"
            yield _finding("wrapped angle", CONDEMNED, field, unit, found, advice, spans)
        elif kind == "place":
            spans = tuple(_span(name, jump, jump.size) for name, jump in found)
            advice = "leave these samples out; where the robot is does not matter, only how it moves"
            yield _finding("step", CONDEMNED, field, unit, found, advice, spans)
        elif kind == "harmless":
            advice = "none at this size; look for a marker or an encoder that slipped"
            yield _finding("step", NOTE, field, unit, found, advice)
        elif kind == "short":
            spans = tuple(_shorter_side(jump, name, samples) for name, jump in found)
            advice = "leave out the shorter side, whose zero is another one"
            yield _finding("step", CONDEMNED, field, unit, found, advice, spans)
        else:
            advice = "split the log there and find out which part has the right zero"
            yield dataclasses.replace(_finding("step", CONDEMNED, field, unit, found, advice), everywhere=True)


def _kind(field: str, jump: Jump, together: float, samples: int) -> str:
    """The kind of a step; `together` is the size of the largest of all channels at the same samples."""
    turns = jump.size / (2.0 * np.pi)
    if field == "joint_position" and _turns(jump) and abs(turns - _turns(jump)) < _WRAPPED:
        return "wrapped"
    if together < HARMLESS:
        return "harmless"
    if field == "base_position_world":
        return "place"
    return "short" if min(jump.first + 1, samples - jump.last) <= SHORT_SIDE * samples else "whole"


def _turns(jump: Jump) -> int:
    return round(jump.size / (2.0 * np.pi))


def _shorter_side(jump: Jump, channel: str, samples: int) -> Span:
    if jump.first + 1 < samples - jump.last:
        return Span(0, jump.first, channel)
    return Span(jump.last, samples - 1, channel)


# ------------------------------------------------------------------------------------------------- jumps of one channel

#: Spreads that a step must exceed. Laplacian noise, whose tails are heavy, does so once in 10^7 samples.
THRESHOLD = 12.0
SIDE = 10
BLOCK = 128
#: Longest run of samples off the track that counts as a spike.
LONGEST_SPIKE = 5
#: Share of a jump that may be left when what jumped has come back, at once or after having moved on.
_LEFT, _LEFT_LATER = 0.3, 0.5
#: Share of the threshold that is enough for the way back.
_PARTNER = 0.5
#: Share of the channel's range below which differences count as rounding.
_ROUNDING = 1e-9
#: Jumps of one channel that are reported at most.
_MOST = 5000


def find_jumps(
    values: FloatArray, elapsed: FloatArray, piece: NDArray[np.intp], longest: int = LONGEST_SPIKE
) -> list[Jump]:
    """Excursions of at most `longest` samples, and lasting steps.

    Args:
        values: (M,).
        elapsed: (M,) time in median steps.
        piece: (M,) of successive samples that each belongs to; between pieces nothing is compared.
        longest: samples after which nothing is taken to have come back.
    """
    kept = np.flatnonzero(np.append(True, np.diff(values) != 0.0))  # what rests or is held counts as one sample
    if len(kept) < SIDE:
        return []
    values, steps, joined = values[kept], np.diff(elapsed[kept]), np.diff(piece[kept]) == 0
    d = np.where(joined, np.diff(values), 0.0)
    second = np.diff(d)
    spread = block_spread(second, BLOCK)
    touched, large = np.zeros(len(d), bool), np.abs(second) > THRESHOLD / 2.0 * spread
    touched[:-1] |= large
    touched[1:] |= large
    suspects = np.flatnonzero(touched & joined)
    around = np.maximum(spread[np.maximum(suspects - 1, 0)], spread[np.minimum(suspects, len(spread) - 1)])
    excess, least = _excess(d, steps, suspects)
    least = np.maximum.reduce([least, around / np.sqrt(3.0), np.full(len(suspects), _quantum(d, values))])
    bad = np.flatnonzero(np.abs(excess) > _PARTNER * THRESHOLD * least)[:_MOST]
    single = [
        Jump(int(kept[i + 1]) - 1, int(kept[i + 1]), float(e), float(abs(e) / s), lasting=True)
        for i, e, s in zip(suspects[bad], excess[bad], least[bad], strict=True)
    ]
    near = [jump for jump in _paired(single, LONGEST_SPIKE, _LEFT) if jump.spreads > THRESHOLD]
    return list(_paired(near, longest, _LEFT_LATER))


def _quantum(d: FloatArray, values: FloatArray) -> float:
    """The smallest step that is no rounding."""
    sizes = np.abs(d)
    sizes = sizes[sizes > _ROUNDING * np.ptp(values)]
    return float(sizes.min()) if len(sizes) else 0.0


def _excess(d: FloatArray, steps: FloatArray, at: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
    """How far steps leave what their neighbours span, and the spread of the neighbours, (S,) each."""
    spanned, spreads = [], []
    away = np.arange(1.0, SIDE + 1.0)
    pairs = np.triu_indices(SIDE, 1)
    for direction in (-1, 1):
        neighbours = neighbours_of(d, at, direction, SIDE)
        slope = finite_median((neighbours[:, pairs[1]] - neighbours[:, pairs[0]]) / (away[pairs[1]] - away[pairs[0]]))
        level = finite_median(neighbours - slope[:, None] * away)
        spreads.append(NORMAL * finite_median(np.abs(neighbours - level[:, None] - slope[:, None] * away)))
        spanned += [level, level + slope * away.mean()]
    hull = np.stack([*spanned, *(one * steps[at] for one in spanned)])
    return d[at] - np.clip(d[at], hull.min(axis=0), hull.max(axis=0)), np.max(spreads, axis=0)


def _paired(found: list[Jump], longest: int, left: float) -> Iterator[Jump]:
    """Lasting steps that cancel within `longest` samples, but for a share `left`, as one excursion."""
    start = 0
    while start < len(found):
        jump, end, least = found[start], start, left
        net, largest = jump.size, abs(jump.size)
        for following in range(start + 1, len(found)) if jump.lasting else ():
            other = found[following]
            if other.last - jump.last > longest:
                break
            if other.lasting:
                net, largest = net + other.size, max(largest, abs(other.size))
                if abs(net) < least * largest:
                    end, least = following, abs(net) / largest if longest <= LONGEST_SPIKE else 0.0
        if end == start:
            yield jump
        else:
            inside = [each for each in found[start : end + 1] if each.lasting]
            size, spreads = (max(abs(getattr(each, name)) for each in inside) for name in ("size", "spreads"))
            yield Jump(jump.last, found[end].first, size, spreads, lasting=False)
            yield from (each for each in found[start : end + 1] if not each.lasting)
        start = end + 1
