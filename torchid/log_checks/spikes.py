"""Spikes and lasting steps: jumps that neither motion nor contact explains."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchid.errors import format_count, join_names, warn
from torchid.log_checks.findings import (
    EXCLUDE_ADVICE,
    NEIGHBOUR_STEPS,
    NOTE,
    REJECTED,
    SUSPICIOUS,
    ChannelGroup,
    Finding,
    Span,
    channel_groups,
    channel_unit,
    finite_median,
    median_step,
    neighbours_of,
    widen_mask,
)
from torchid.logs import Log
from torchid.logs.log import CONTACT_READINGS, BoolArray, FloatArray
from torchid.logs.preprocess import near_contact_changes
from torchid.logs.time_range import log_title
from torchid.rounding import STD_PER_MAD

POSITION_FIELDS = ("joint_position", "base_quat_xyzw", "base_position_world")
#: Fields whose lasting steps are reported; those of velocities and accelerations are caused by impacts and commands.
_FORCE_FIELDS = ("joint_torque", *CONTACT_READINGS, "ft_wrench")
#: Ends of the names of fields in which impacts appear as spikes.
_ACCELERATION_SUFFIXES = ("acceleration", "acceleration_world", "acceleration_base", "specific_force")
#: Spike over the channel's range (1st to 99th percentile; of a force or moment, the largest range of its components):
#: smaller spikes do not change a fit.
MIN_SPIKE_RANGE_SHARE = 0.1
#: The same of a lasting step: smaller steps are not a reset of the sensor.
MIN_STEP_RANGE_SHARE = 0.3
#: Jump of a position [rad, m, or of a quaternion's component]: 0.03 degrees, 0.5 mm.
MIN_POSITION_JUMP = 5e-4
#: Lasting step of a position: smaller ones are within the error of its calibration.
MIN_POSITION_STEP = 0.01
#: Share of a log that is excluded where a position has another zero on one side of a step.
MAX_SHORT_SIDE_SHARE = 0.1
#: Time around a change of contact in which forces and velocities may jump: duration of impacts.
_IMPACT_S = 0.1
#: Percentiles of a force before and after a step; if the sensor was reset, all move by this share of the step.
_LEVEL_PERCENTILES = (10.0, 50.0, 90.0)
_MIN_LEVEL_SHIFT_SHARE = 0.5
#: Samples around a reversal of a joint in which its torque may jump; the joint is slower there than this share of its
#: median speed.
_REVERSAL_SAMPLES = 5
_MAX_REVERSAL_SPEED_SHARE = 0.2
#: Distance of a step from a whole number of turns that counts as a wrapped angle.
_WRAP_TOLERANCE_TURNS = 0.01


@dataclass(frozen=True)
class Jump:
    """An excursion of samples `first` to `last` by about `size`, or a lasting step between these two.

    `spreads`: size over the local noise.
    """

    first: int
    last: int
    size: float
    spreads: float
    lasting: bool


#: Channels and their jumps, by sample numbers of the log.
_Jumps = list[tuple[str, Jump]]


def check_jumps(log: Log, groups: Iterable[ChannelGroup]) -> Iterator[Finding]:
    """Findings about jumps in all channels."""
    candidates = [(group, [_channel_jumps(group, column) for column in range(len(group.names))]) for group in groups]
    impact_s = max(_IMPACT_S, MAX_SPIKE_SAMPLES * median_step(log))
    impacts = near_contact_changes(log, log.time, impact_s) | _near_load_changes(log, candidates)
    jumps: dict[str, _Jumps] = {}
    for group, by_column in candidates:
        in_field = jumps.setdefault(group.field, [])
        for column, name in enumerate(group.names):
            for jump in _unexplained(log, group, column, by_column[column], impacts):
                first, last = (int(group.samples[i]) for i in (jump.first, jump.last))
                in_field.append((name, dataclasses.replace(jump, first=first, last=last)))
    for field, in_field in jumps.items():
        spikes = [(name, jump) for name, jump in in_field if not jump.lasting]
        steps = [(name, jump) for name, jump in in_field if jump.lasting]
        if spikes and field.endswith(_ACCELERATION_SUFFIXES):
            yield _finding("spike", SUSPICIOUS, field, spikes, "nothing if there was an impact")
        elif spikes:
            yield _finding("spike", REJECTED, field, spikes, f"{EXCLUDE_ADVICE}; look for a loose connector")
        if field in POSITION_FIELDS:
            yield from _position_steps(field, steps, len(log))
        elif steps and field in _FORCE_FIELDS:
            advice = "if the sensor was reset there, split the log: each part then has its own offset"
            yield _finding("step", SUSPICIOUS, field, steps, advice)


def warn_of_steps(log: Log) -> None:
    """Warn about steps of joint positions: a filter turns them into accelerations, which bias masses.

    Warns:
        TorchidWarning: an encoder's zero changes at a step, or an angle is wrapped.
    """
    for jump in check_jumps(log, channel_groups(log, ("joint_position",))):
        if jump.severity == REJECTED and jump.name != "spike":
            warn(f"{log_title(log.source)}: joint_position, {jump.name}: {jump.found}; {jump.advice}")


def _channel_jumps(group: ChannelGroup, column: int) -> list[Jump]:
    """All jumps of a channel, by numbers of the group's samples."""
    values = group.values[:, column]
    longest = MAX_SPIKE_SAMPLES
    if group.field in POSITION_FIELDS:
        longest = max(longest, int(MAX_SHORT_SIDE_SHARE * len(values)))
    return find_jumps(values, group.elapsed, group.piece, longest)


def _near_load_changes(log: Log, candidates: Iterable[tuple[ChannelGroup, list[list[Jump]]]]) -> BoolArray:
    """Samples near a jump of a force without a reset of its sensor, (N,): a landing or lift-off."""
    where = np.zeros(len(log), bool)
    for group, by_column in candidates:
        if group.field not in _FORCE_FIELDS:
            continue
        for column, jumps in enumerate(by_column):
            values = group.values[:, column]
            extent = np.ptp(np.percentile(values, (1.0, 99.0)))
            steps = [jump for jump in jumps if jump.lasting and abs(jump.size) > MIN_STEP_RANGE_SHARE * extent]
            where[[group.samples[jump.first] for jump in steps if not _is_reset(values, jump)]] = True
    return widen_mask(where, round(max(_IMPACT_S / median_step(log), MAX_SPIKE_SAMPLES)))


def _unexplained(log: Log, group: ChannelGroup, column: int, jumps: list[Jump], impacts: BoolArray) -> list[Jump]:
    """Jumps of a channel that neither motion nor contact explains."""
    values = group.values[:, column]
    if group.field in POSITION_FIELDS:
        return [jump for jump in jumps if abs(jump.size) > MIN_POSITION_JUMP]
    if not jumps:
        return jumps
    explained = impacts[group.samples] | group.field.endswith(_ACCELERATION_SUFFIXES)
    if group.field == "joint_torque":
        explained = (
            explained
            | _near_reversals(log.joint_position[:, log.joint_names.index(group.names[column])])[group.samples]
        )
    component = values[:, None] if not group.name else group.values[:, column // 3 * 3 : column // 3 * 3 + 3]
    low, high = np.percentile(component, (1.0, 99.0), axis=0)
    extent = float((high - low).max())
    return [
        jump
        for jump in jumps
        if abs(jump.size) > (MIN_STEP_RANGE_SHARE if jump.lasting else MIN_SPIKE_RANGE_SHARE) * extent
        and not (jump.lasting and group.field in _FORCE_FIELDS and not _is_reset(values, jump))
        and ((abs(jump.size) > extent and not jump.lasting) or not explained[jump.first : jump.last + 1].any())
    ]


def _near_reversals(position: FloatArray) -> BoolArray:
    """Samples near a reversal of a joint, (N,)."""
    speed = np.abs(np.gradient(position))
    smooth = np.convolve(speed, np.ones(_REVERSAL_SAMPLES) / _REVERSAL_SAMPLES, mode="same")
    return widen_mask(smooth <= _MAX_REVERSAL_SPEED_SHARE * np.median(smooth), _REVERSAL_SAMPLES)


def _is_reset(values: FloatArray, jump: Jump) -> bool:
    """Whether all levels of a channel shift at a lasting step."""
    before, after = (
        np.percentile(side, _LEVEL_PERCENTILES) for side in (values[: jump.first + 1], values[jump.last :])
    )
    return bool(((after - before) * np.sign(jump.size) > _MIN_LEVEL_SHIFT_SHARE * abs(jump.size)).all())


def _position_steps(field: str, steps: _Jumps, samples: int) -> Iterator[Finding]:
    """Findings about steps of positions: the zero changes there; the shorter side is rejected if it is short."""
    kinds: dict[str, _Jumps] = {}
    for name, jump in steps:
        largest = max(abs(step.size) for _, step in steps if step.first == jump.first)
        kinds.setdefault(_step_kind(field, jump, largest, samples), []).append((name, jump))
    for kind, jumps in kinds.items():
        if kind == "wrapped":
            spans = tuple(_span(name, jump, 2.0 * np.pi * _turns(jump)) for name, jump in jumps)
            advice = "unwrap the angle"
            if field == "joint_position":
                advice += ", or set logs.columns.joint_position.turn_from to the start of its turn, such as -180 [deg]"
            yield _finding("wrapped angle", REJECTED, field, jumps, advice, spans)
        elif kind == "displacement":
            spans = tuple(_span(name, jump, jump.size) for name, jump in jumps)
            advice = f"{EXCLUDE_ADVICE}: only the motion of the base matters, not its position"
            yield _finding("step", REJECTED, field, jumps, advice, spans)
        elif kind == "harmless":
            advice = "nothing at this size; look for a marker or an encoder that slipped"
            yield _finding("step", NOTE, field, jumps, advice)
        elif kind == "short":
            spans = tuple(_shorter_side(jump, name, samples) for name, jump in jumps)
            advice = "exclude the shorter side (preprocessing.exclude_rejected: true): its zero differs"
            yield _finding("step", REJECTED, field, jumps, advice, spans)
        else:
            advice = "split the log there, and find out which part has the right zero"
            yield dataclasses.replace(_finding("step", REJECTED, field, jumps, advice), everywhere=True)


def _step_kind(field: str, jump: Jump, largest: float, samples: int) -> str:
    """The kind of a step; `largest` is the size of the largest step of all channels at the same samples."""
    turns = jump.size / (2.0 * np.pi)
    if field == "joint_position" and _turns(jump) and abs(turns - _turns(jump)) < _WRAP_TOLERANCE_TURNS:
        return "wrapped"
    if largest < MIN_POSITION_STEP:
        return "harmless"
    if field == "base_position_world":
        return "displacement"
    return "short" if min(jump.first + 1, samples - jump.last) <= MAX_SHORT_SIDE_SHARE * samples else "whole"


def _turns(jump: Jump) -> int:
    return round(jump.size / (2.0 * np.pi))


def _shorter_side(jump: Jump, channel: str, samples: int) -> Span:
    if jump.first + 1 < samples - jump.last:
        return Span(0, jump.first, channel)
    return Span(jump.last, samples - 1, channel)


def _finding(
    name: str, severity: str, field: str, jumps: _Jumps, advice: str, spans: tuple[Span, ...] | None = None
) -> Finding:
    channels = tuple(dict.fromkeys(channel for channel, _ in jumps))
    channel, clearest = max(jumps, key=lambda pair: pair[1].spreads)
    at = _span("", clearest)
    size = abs(clearest.size)
    unit = channel_unit(field, channel)
    if field == "base_quat_xyzw":
        size = np.degrees(2.0 * size)
        unit = "deg"
    text = f"{channel} jumps by {size:.3g} {unit} at sample {at}, {clearest.spreads:.3g} times the local noise"
    if len(jumps) > 1:
        count = len({(jump.first, jump.last) for _, jump in jumps})
        text = f"{format_count(count, 'jump')} in {join_names(channels)}. The clearest: {text}"
    if spans is None:
        spans = tuple(_span(channel, jump) for channel, jump in jumps)
    return Finding(name, severity, field, text, advice, channels, spans)


def _span(channel: str, jump: Jump, shift: float = 0.0) -> Span:
    return Span(jump.first, jump.last, channel, shift)


# ------------------------------------------------------------------------------------------------- jumps of one channel

#: Jump over the local noise: heavy-tailed (Laplacian) noise exceeds it once in 10^7 samples.
MIN_JUMP_SPREADS = 12.0
#: Steps per block of the noise estimate.
SPREAD_BLOCK_STEPS = 128
#: Longest excursion that counts as a spike.
MAX_SPIKE_SAMPLES = 5
#: Sum of both jumps of an excursion over the larger one: of a spike, and of a longer one, in which the robot moves.
_MAX_SPIKE_RESIDUAL_SHARE = 0.3
_MAX_LATE_RESIDUAL_SHARE = 0.5
#: Threshold of the second jump of an excursion over `MIN_JUMP_SPREADS`.
_RETURN_THRESHOLD_SHARE = 0.5
#: Differences below this share of the channel's range are rounding.
_ROUNDING_SHARE = 1e-9
#: Jumps of one channel that are examined.
_MAX_JUMPS = 5000


def find_jumps(
    values: FloatArray, elapsed: FloatArray, piece: NDArray[np.intp], longest: int = MAX_SPIKE_SAMPLES
) -> list[Jump]:
    """Excursions of at most `longest` samples, and lasting steps.

    Args:
        values: (M,).
        elapsed: (M,) time in median steps.
        piece: (M,) number of the run without a gap that each sample belongs to; steps between runs are ignored.
        longest: samples of the longest excursion.
    """
    kept = np.flatnonzero(np.append(True, np.diff(values) != 0.0))  # repeated values count as one sample
    if len(kept) < NEIGHBOUR_STEPS:
        return []
    values = values[kept]
    steps = np.diff(elapsed[kept])
    joined = np.diff(piece[kept]) == 0
    d = np.where(joined, np.diff(values), 0.0)
    second = np.diff(d)
    spread = _block_spread(second, SPREAD_BLOCK_STEPS)
    touched = np.zeros(len(d), bool)
    large = np.abs(second) > MIN_JUMP_SPREADS / 2.0 * spread
    touched[:-1] |= large
    touched[1:] |= large
    candidates = np.flatnonzero(touched & joined)
    around = np.maximum(spread[np.maximum(candidates - 1, 0)], spread[np.minimum(candidates, len(spread) - 1)])
    excess, noise = _excess(d, steps, candidates)
    noise = np.maximum.reduce([noise, around / np.sqrt(3.0), np.full(len(candidates), _quantum(d, values))])
    bad = np.flatnonzero(np.abs(excess) > _RETURN_THRESHOLD_SHARE * MIN_JUMP_SPREADS * noise)[:_MAX_JUMPS]
    single = [
        Jump(int(kept[i + 1]) - 1, int(kept[i + 1]), float(e), float(abs(e) / s), lasting=True)
        for i, e, s in zip(candidates[bad], excess[bad], noise[bad], strict=True)
    ]
    near = [
        jump
        for jump in _pair_steps(single, MAX_SPIKE_SAMPLES, _MAX_SPIKE_RESIDUAL_SHARE)
        if jump.spreads > MIN_JUMP_SPREADS
    ]
    return list(_pair_steps(near, longest, _MAX_LATE_RESIDUAL_SHARE))


def _block_spread(differences: FloatArray, block: int) -> FloatArray:
    """Robust standard deviation (M,) of differences (M,) by blocks: from the median absolute value of each block."""
    block = min(block, len(differences))
    whole = len(differences) // block
    blocks = np.abs(differences[: whole * block]).reshape(whole, block)
    medians = STD_PER_MAD * np.partition(blocks, block // 2, axis=1)[:, block // 2]
    remainder = len(differences) - whole * block
    return np.append(np.repeat(medians, block), np.full(remainder, medians[-1]))


def _quantum(d: FloatArray, values: FloatArray) -> float:
    """The smallest step above rounding."""
    sizes = np.abs(d)
    sizes = sizes[sizes > _ROUNDING_SHARE * np.ptp(values)]
    return float(sizes.min()) if len(sizes) else 0.0


def _excess(d: FloatArray, steps: FloatArray, at: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
    """Distance of steps from the range extrapolated from their neighbours, and the neighbours' spread, (S,) each."""
    bounds = []
    spreads = []
    away = np.arange(1.0, NEIGHBOUR_STEPS + 1.0)
    pairs = np.triu_indices(NEIGHBOUR_STEPS, 1)
    for direction in (-1, 1):
        neighbours = neighbours_of(d, at, direction, NEIGHBOUR_STEPS)
        slope = finite_median((neighbours[:, pairs[1]] - neighbours[:, pairs[0]]) / (away[pairs[1]] - away[pairs[0]]))
        level = finite_median(neighbours - slope[:, None] * away)
        spreads.append(STD_PER_MAD * finite_median(np.abs(neighbours - level[:, None] - slope[:, None] * away)))
        bounds += [level, level + slope * away.mean()]
    hull = np.stack([*bounds, *(bound * steps[at] for bound in bounds)])
    return d[at] - np.clip(d[at], hull.min(axis=0), hull.max(axis=0)), np.max(spreads, axis=0)


def _pair_steps(jumps: list[Jump], longest: int, max_residual: float) -> Iterator[Jump]:
    """The jumps, steps that cancel within `longest` samples to a share `max_residual` joined to one excursion."""
    start = 0
    while start < len(jumps):
        jump = jumps[start]
        end = start
        least = max_residual
        net = jump.size
        largest = abs(jump.size)
        for number in range(start + 1, len(jumps)) if jump.lasting else ():
            second = jumps[number]
            if second.last - jump.last > longest:
                break
            if second.lasting:
                net = net + second.size
                largest = max(largest, abs(second.size))
                if abs(net) < least * largest:
                    end = number
                    least = abs(net) / largest if longest <= MAX_SPIKE_SAMPLES else 0.0
        if end == start:
            yield jump
        else:
            steps = [step for step in jumps[start : end + 1] if step.lasting]
            size = max(abs(step.size) for step in steps)
            spreads = max(abs(step.spreads) for step in steps)
            yield Jump(jump.last, jumps[end].first, size, spreads, lasting=False)
            yield from (spike for spike in jumps[start : end + 1] if not spike.lasting)
        start = end + 1
