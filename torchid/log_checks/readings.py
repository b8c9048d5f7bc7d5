"""Time stamps, missing and impossible values; readings that repeat: frozen, saturated, held; robots at rest."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchid.errors import format_count, format_percent, join_names
from torchid.log_checks.findings import (
    EXCLUDE_ADVICE,
    MIN_GAP_STEPS,
    NEIGHBOUR_STEPS,
    NON_SIGNAL_FIELDS,
    NOTE,
    REJECTED,
    SUSPICIOUS,
    ChannelGroup,
    Finding,
    Span,
    channel_groups,
    channel_names,
    channel_unit,
    find_spans,
    finite_median,
    neighbours_of,
)
from torchid.logs import Log
from torchid.logs.dry_friction import OFTEN, resting_share
from torchid.logs.log import CONTACT_READINGS, NAN_ALLOWED, WRENCHES, BoolArray, FloatArray
from torchid.logs.preprocess import lacks_derivatives
from torchid.logs.signal_noise import rough_noise
from torchid.logs.timeline import FEWEST_DIFFERENTIATED, LONGEST_STEP, SHORTEST_STEP
from torchid.problem.motion import MIN_MOTION, MIN_TURN_DEG

# --------------------------------------------------------------------------------------------------------------- values

#: Share of NaN up to which a channel has holes; above it, the channel was not recorded.
MAX_MISSING_SHARE = 0.2
#: Size of a value in any unit; larger ones are uninitialised memory or an overflow.
MAX_MAGNITUDE = 1e12


def check_magnitudes(log: Log) -> Iterator[Finding]:
    """Findings about values larger than any quantity of a robot."""
    for field in log.arrays():
        if field in NON_SIGNAL_FIELDS:
            continue
        values: FloatArray = getattr(log, field)
        flat = values.reshape(len(log), -1)
        with np.errstate(invalid="ignore"):
            bad = np.abs(flat) > MAX_MAGNITUDE
        if not bad.any():
            continue
        names = channel_names(log, field)
        columns = np.flatnonzero(bad.any(axis=0))
        channels = tuple(names[column] for column in columns)
        samples = format_count(int(bad.any(axis=1).sum()), "sample")
        text = f"{join_names(channels)}: larger than {MAX_MAGNITUDE:g} in {samples}"
        rare = bad.any(axis=1).mean() <= MAX_MISSING_SHARE
        spans = tuple(span for column in columns for span in find_spans(bad[:, column], names[column])) if rare else ()
        yield Finding("absurd", REJECTED, field, text, "look for uninitialised memory or an overflow", channels, spans)


def check_missing_values(log: Log) -> Iterator[Finding]:
    """Findings about NaN, in readings of contacts during contact. Motion must be known in all samples, forces not."""
    for field in log.arrays():
        if field not in NON_SIGNAL_FIELDS:
            yield from _missing_findings(log, field)


def _missing_findings(log: Log, field: str) -> Iterator[Finding]:
    array: FloatArray = getattr(log, field)
    names = channel_names(log, field)
    nan = np.isnan(array)
    if field in CONTACT_READINGS and log.contact_active is not None:
        active = log.contact_active.reshape(log.contact_active.shape + (1,) * (array.ndim - 2))
        nan = nan & active
        relevant = np.broadcast_to(active.sum(axis=0), array.shape[1:]).ravel()
    else:
        relevant = np.full(len(names), len(log))
    nan = nan.reshape(len(log), -1)
    counts = nan.sum(axis=0)
    holes: dict[str, tuple[int, float]] = {}
    gone: dict[str, tuple[int, float]] = {}
    for column in np.flatnonzero(counts):
        share = counts[column] / relevant[column]
        (holes if share <= MAX_MISSING_SHARE else gone)[names[column]] = (int(column), share)
    if holes:
        spans: tuple[Span, ...] = tuple(
            span for name, (column, _) in holes.items() for span in find_spans(nan[:, column], name)
        )
        shares = ", ".join(f"{name} {format_percent(share)} %" for name, (_, share) in list(holes.items())[:4])
        text = f"NaN in {format_count(len(holes), 'channel')}, {format_count(len(spans), 'time')}: {shares}"
        if field in NAN_ALLOWED:
            advice = f"{EXCLUDE_ADVICE}; else a filter loses these channels in the whole log"
        else:
            advice = f"{EXCLUDE_ADVICE}: motion must be known in all samples"
        yield Finding("not measured", REJECTED, field, text, advice, tuple(holes), spans)
    if gone:
        entire = all(share == 1.0 for _, share in gone.values())
        extent = "in all samples" if entire else f"in up to {100 * max(share for _, share in gone.values()):.3g} %"
        needed = field not in NAN_ALLOWED
        if needed:
            advice = "record it in all samples, or remove the field if other fields give this motion"
        else:
            advice = "nothing, unless it is listed in sensors" if entire else "remove it from sensors"
        severity = REJECTED if needed else NOTE
        yield Finding("not measured", severity, field, f"{join_names(list(gone))}: NaN {extent}", advice, tuple(gone))


# ---------------------------------------------------------------------------------------------------------- time stamps

#: Median step above which accelerations cannot be derived: robots move at 0.5 to 5 Hz.
MAX_MEDIAN_STEP_S = 0.5
#: Wrong units of stamps, and their number per second.
_TICKS_PER_S = {"ms": 1e3, "us": 1e6, "ns": 1e9}
#: Rms jitter that is reported: 1e-3 of a step at 1 rad/s and 1 kHz is 1e-6 rad.
MIN_JITTER_STEPS = 1e-3
#: Change of a step, in rms deviations, at which motion and stamps are compared, and the samples that this needs.
_MIN_DEVIATION_RMS = 3.0
_MIN_COMPARED_SAMPLES = 10
#: Residual of positions with uniform stamps over that with the recorded stamps, below which the stamps jitter.
_MAX_STAMP_RESIDUAL_SHARE = 0.5


def check_time_stamps(log: Log) -> Iterator[Finding]:
    """Findings about `time`."""
    if len(log) < FEWEST_DIFFERENTIATED and lacks_derivatives(log):
        text = f"{format_count(len(log), 'sample')}: velocities and accelerations cannot be derived"
        advice = f"record {FEWEST_DIFFERENTIATED} samples or more, or give every velocity and acceleration"
        yield Finding("too short", REJECTED, "time", text, advice)
    if len(log) < 3:
        return
    steps = np.diff(log.time)
    median = float(np.median(steps))
    if median > MAX_MEDIAN_STEP_S:
        yield _unit_finding(median)
    long = steps > MIN_GAP_STEPS * median
    short = steps < SHORTEST_STEP * median
    deviation = (steps - median)[~long] / median
    rms = float(np.sqrt(np.mean(np.square(deviation))))
    if rms > MIN_JITTER_STEPS:
        yield _jitter_finding(log, steps / median, rms, float(np.max(np.abs(deviation))), long)
    if long.any():
        yield _gap_finding(steps, median, long)
    if short.any():
        numbers = np.flatnonzero(short)
        first = int(numbers[0])
        text = (
            f"{format_count(len(numbers), 'step')} below {SHORTEST_STEP:g} of the median amplify noise;"
            f" the first, after sample {first}, is {steps[first]:.3g} s"
        )
        spans = tuple(Span(int(i) + 1, int(i) + 1) for i in numbers)
        yield Finding("coincident stamps", REJECTED, "time", text, "drop one sample of each pair", spans=spans)


def _unit_finding(median: float) -> Finding:
    likely = [unit for unit, ticks in _TICKS_PER_S.items() if median / ticks <= MAX_MEDIAN_STEP_S]
    guess = f". In {likely[0]} the rate would be {_TICKS_PER_S[likely[0]] / median:.4g} Hz" if likely else ""
    text = f"the median step is {median:.4g} s{guess}"
    return Finding("unit", REJECTED, "time", text, "convert the stamps to seconds")


def _jitter_finding(log: Log, steps: FloatArray, rms: float, largest: float, long: BoolArray) -> Finding:
    text = f"steps vary by {format_percent(rms)} % (rms) of the median step, at most {format_percent(largest)} %"
    advice = "nothing: the filter (preprocessing.cutoff_hz) resamples to a uniform grid"
    if _is_uniformly_sampled(log, steps, _MIN_DEVIATION_RMS * rms, long):
        text += ". Positions do not show it: the stamps jitter, not the sampling"
        advice = "replace the stamps by uniform ones at the median rate"
    return Finding("jitter", NOTE, "time", text, advice)


def _is_uniformly_sampled(log: Log, steps: FloatArray, deviation: float, long: BoolArray) -> bool:
    """Whether joint positions are smoother by sample number than by time stamp, where steps change by `deviation`."""
    before = steps[:-1]
    after = steps[1:]
    numbers = 1 + np.flatnonzero((np.abs(before - after) > deviation) & ~long[:-1] & ~long[1:])
    if len(numbers) < _MIN_COMPARED_SAMPLES:
        return False
    ahead, behind = (log.joint_position[numbers + k] - log.joint_position[numbers] for k in (1, -1))
    left = steps[numbers - 1, None]
    right = steps[numbers, None]
    by_number = np.abs(ahead + behind)
    by_stamp = np.abs(2.0 * (ahead * left + behind * right) / (left + right))
    return bool(by_number.sum() < _MAX_STAMP_RESIDUAL_SHARE * by_stamp.sum())


def _gap_finding(steps: FloatArray, median: float, long: BoolArray) -> Finding:
    numbers = np.flatnonzero(long)
    longest = int(np.argmax(steps))
    lost = int(np.round(steps[numbers] / median - 1.0).sum())
    missing = f"{format_count(len(numbers), 'gap')}, {format_count(lost, 'sample')} missing"
    text = f"{missing}; the longest gap is {steps[longest]:.4g} s, after sample {longest}"
    if steps[longest] > LONGEST_STEP * median:
        advice = f"split the log after sample {longest}: gaps above {LONGEST_STEP:g} steps are not interpolated"
        return Finding("gap", REJECTED, "time", text, advice)
    advice = (
        f"keep preprocessing.cutoff_hz well below {0.5 / steps[longest]:.3g} Hz: half a period then fits in the gap"
    )
    return Finding("gap", SUSPICIOUS, "time", text, advice, spans=tuple(Span(int(i), int(i) + 1) for i in numbers))


#: Samples at one extreme value from which on it is a limit of the sensor.
MIN_SAMPLES_AT_LIMIT = 5
#: Fields that are zero while a joint rests.
RATE_FIELDS = ("joint_velocity", "joint_acceleration")
#: Fields in which a driver may set small readings to zero.
DEAD_BAND_FIELDS = (*RATE_FIELDS, "joint_torque", "ft_wrench", *CONTACT_READINGS)
#: Fields whose readings change with the loads of a robot that moves.
FORCE_FIELDS = ("joint_torque", "ft_wrench", "imu_specific_force", *CONTACT_READINGS)
#: Logarithm (base 10) of the probability of a run of repeats by chance: none in a million samples.
MAX_LOG10_PROBABILITY = -8.0
#: Typical step in quanta below which repeats are expected: a slow channel on a coarse grid repeats itself.
_MIN_STEP_QUANTA = 4.0
#: Speed next to a run over that on the same side of it; a robot that stops smoothly is slower. Noisy channels are
#: averaged over this number of steps.
_MIN_SPEED_SHARE = 0.5
_AVERAGED_STEPS = 4
#: Median steps beside a run of zeros within which they begin and end at a dead band: 4 standard deviations of noise.
_MAX_STEPS_TO_DEAD_BAND = 6.0
#: Share of repeats above which a channel may be held at a lower rate...
MIN_REPEATED_SHARE = 0.2
#: ... and the share of runs that have the typical length within one sample, if the rate is regular.
_MIN_REGULAR_SHARE = 0.8
#: Share of time in rests, values held longer than this multiple of the mean, of a robot that rests and starts again.
_MAX_REST_SHARE = 0.2
_MIN_REST_HOLDS = 5.0
#: Differences below this share of a channel's largest value are rounding, in double and in single precision.
FLOAT64_ROUNDING_SHARE = 16.0 * float(np.finfo(np.float64).eps)
_FLOAT32_ROUNDING_SHARE = 2.0 * float(np.finfo(np.float32).eps)
#: A channel lies on a grid if this share of its small steps is a whole number of quanta; random steps reach a fifth.
_MIN_GRID_SHARE = 0.95
_MIN_GRID_STEPS = 10
_MAX_GRID_QUANTA = 10.5
_GRID_TOLERANCE_QUANTA = 0.1
#: Quantiles of the step size at which a quantum is looked for.
_SMALL_STEP_QUANTILES = (0.001, 0.005, 0.02)
#: Runs of repeats in one channel above which none is checked: coarse channels repeat all the time.
_MAX_RUNS = 20000


@dataclass(frozen=True, eq=False)
class Runs:
    """Runs of repeats, by their `first` and `last` steps (R,), both included."""

    first: NDArray[np.intp]
    last: NDArray[np.intp]

    @classmethod
    def of_repeats(cls, repeated: BoolArray) -> Runs:
        """Runs of a mask (M - 1,) of steps without change."""
        edges = np.diff(np.concatenate([[False], repeated, [False]]).astype(np.int8))
        return cls(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1)

    def __len__(self) -> int:
        return len(self.first)

    @property
    def lengths(self) -> NDArray[np.intp]:
        """Number of repeats in each run."""
        return self.last - self.first + 1

    def select(self, mask: BoolArray) -> Runs:
        """The runs in a mask (R,)."""
        return Runs(self.first[mask], self.last[mask])

    def mask(self, steps: int) -> BoolArray:
        """Which of `steps` steps the runs cover."""
        edges = np.zeros(steps + 1, np.intp)
        np.add.at(edges, self.first, 1)
        np.add.at(edges, self.last + 1, -1)
        return np.asarray(np.cumsum(edges[:-1]) > 0)


_RunsByChannel = list[tuple[str, Runs]]


def check_repeats(groups: Iterable[ChannelGroup]) -> Iterator[Finding]:
    """Findings about frozen, held, saturated and constant channels."""
    groups = tuple(groups)
    positions = next((group for group in groups if group.field == "joint_position"), None)
    for group in groups:
        steps = np.diff(group.values, axis=0)
        constant = (steps == 0.0).all(axis=0)
        if constant.any():
            yield from _constant_findings(group, constant, _moves(positions))
        if constant.all():
            continue
        rests = _at_rest(group, steps, positions)
        together = ((steps == 0.0) & ~rests)[:, ~constant].all(axis=1) & group.joined
        changing = group.values[:, ~constant]
        if hold := _mean_hold(changing, together):
            yield _held_finding(group, [(name, hold) for name in group.names])
            continue
        runs = _implausible_runs(changing, together)
        if group.field in DEAD_BAND_FIELDS:
            runs = runs.select(~_in_dead_band(changing, runs))
        if len(runs):
            channels = f"all {len(group.names)} channels" if len(group.names) > 1 else group.names[0]
            yield _frozen_finding(group, channels, [(name, runs) for name in group.names], len(runs))
        if len(group.names) > 1:
            repeated = (steps == 0.0) & ~rests & (group.joined & ~runs.mask(len(steps)))[:, None]
            yield from _channel_findings(group, repeated, np.flatnonzero(~constant))


def _at_rest(group: ChannelGroup, steps: FloatArray, positions: ChannelGroup | None) -> BoolArray:
    """Mask (M - 1, c) of the steps of joint velocities or accelerations in which the joint does not move."""
    if positions is None or group.field not in RATE_FIELDS or not np.isin(group.samples, positions.samples).all():
        return np.zeros(steps.shape, bool)
    columns = [positions.names.index(name) for name in group.names]
    position = positions.values[np.searchsorted(positions.samples, group.samples)][:, columns]
    return np.asarray((steps == 0.0) & (group.values[1:] == 0.0) & (np.diff(position, axis=0) == 0.0))


def _channel_findings(group: ChannelGroup, all_repeated: BoolArray, columns: np.ndarray) -> Iterator[Finding]:
    """Findings about single channels, by their steps without change (M - 1, c)."""
    frozen: _RunsByChannel = []
    dead: list[tuple[str, float, float]] = []
    limits: list[tuple[str, Runs, float]] = []
    holds = {column: _mean_hold(group.values[:, [column]], all_repeated[:, column]) for column in columns}
    for column in (column for column in columns if not holds[column]):
        repeated = all_repeated[:, column]
        name = group.names[column]
        values = group.values[:, column]
        runs = _implausible_runs(values[:, None], repeated)
        small = _in_dead_band(values[:, None], runs)
        if group.field in DEAD_BAND_FIELDS and small.any():
            dead.append((name, float(np.abs(values[values != 0.0]).min()), float(np.mean(values == 0.0))))
            runs = runs.select(~small)
        for extreme in (values.min(), values.max()):
            at_limit = Runs.of_repeats(repeated & (values[1:] == extreme))
            if (values[runs.first] == extreme).any() and at_limit.lengths.sum() >= MIN_SAMPLES_AT_LIMIT:
                limits.append((name, at_limit, float(extreme)))
                runs = runs.select(values[runs.first] != extreme)
        if len(runs):
            frozen.append((name, runs))
    if frozen:
        channels = join_names([name for name, _ in frozen])
        count = sum(len(runs) for _, runs in frozen)
        yield _frozen_finding(group, channels, frozen, count)
    if dead:
        texts = [
            f"{name} below {least:.3g} {channel_unit(group.field, name)} ({format_percent(share)} % of samples)"
            for name, least, share in dead
        ]
        advice = "switch the dead band off; or remove a velocity: torchid then derives it"
        names = tuple(name for name, _, _ in dead)
        text = f"small values read 0: {join_names(texts)}"
        yield Finding("dead band", SUSPICIOUS, group.field, text, advice, names)
    if limits:
        yield _saturated_finding(group, limits)
    if any(holds.values()):
        yield _held_finding(group, [(group.names[column], hold) for column, hold in holds.items() if hold])


def _spans(group: ChannelGroup, channel: str, runs: Runs, skip: int = 1) -> Iterator[Span]:
    """Samples that repeat the sample before; with `skip` 0, the first reading too."""
    for first, last in zip(runs.first, runs.last, strict=True):
        yield Span(int(group.samples[first + skip]), int(group.samples[last + 1]), channel)


def _frozen_finding(group: ChannelGroup, channels: str, frozen: _RunsByChannel, count: int) -> Finding:
    spans = tuple(span for name, runs in frozen for span in _spans(group, name, runs))
    longest = max(spans, key=len)
    times = f"{format_count(len(longest), 'sample')} at {longest}"
    if count > 1:
        times = f"{count} times, the longest {times}"
    prefix = f"{group.name}, " if group.name else ""
    text = f"{prefix}{channels}: exactly constant while the robot moves, {times}"
    advice = f"{EXCLUDE_ADVICE}; look for lost messages or a stalled driver"
    return Finding("frozen", REJECTED, group.field, text, advice, tuple(name for name, _ in frozen), spans)


def _saturated_finding(group: ChannelGroup, limits: list[tuple[str, Runs, float]]) -> Finding:
    spans = tuple(span for name, runs, _ in limits for span in _spans(group, name, runs, 0))
    names = tuple(dict.fromkeys(name for name, _, _ in limits))
    shares = [
        (name, extreme, format_percent(float(np.mean(group.values[:, group.names.index(name)] == extreme))))
        for name, _, extreme in limits
    ]
    text = "stays at its limit: " + join_names(
        [f"{name} at {extreme:.4g} {channel_unit(group.field, name)} in {share} %" for name, extreme, share in shares]
    )
    if group.field == "joint_position":  # an end stop, or a limit of inverse kinematics
        advice = "nothing if the joint has a stop there; else widen the limits of the encoder or inverse kinematics"
        return Finding("saturated", SUSPICIOUS, group.field, text, advice, names, spans)
    advice = f"{EXCLUDE_ADVICE}, or raise the sensor's range"
    return Finding("saturated", REJECTED, group.field, text, advice, names, spans)


def _held_finding(group: ChannelGroup, held: list[tuple[str, float]]) -> Finding:
    hold = max(samples for _, samples in held)
    names = tuple(name for name, _ in held)
    prefix = f"{join_names(names)}: " if len(names) < len(group.names) else ""
    text = f"{prefix}new values only every {hold:.3g} samples; mean delay {0.5 * (hold - 1):.2g} samples"
    advice = f"record all at one rate, or set preprocessing.cutoff_hz below {0.25 / hold:.2g} of the sample rate"
    return Finding("held", SUSPICIOUS, group.field, text, advice, names)


def _moves(positions: ChannelGroup | None) -> bool:
    """Whether any joint moves further than one that stands still."""
    return positions is not None and bool((np.ptp(positions.values, axis=0) > MIN_MOTION).any())


def _constant_findings(group: ChannelGroup, constant: BoolArray, moves: bool) -> Iterator[Finding]:
    """Findings about channels (c,) that never change; one for zeros, one for other values."""
    zero = constant & ~group.values[0].astype(bool)
    is_force = group.field in FORCE_FIELDS
    for still, value in ((zero, "0"), (constant & ~zero, "the same value")):
        names = tuple(name for name, here in zip(group.names, still, strict=True) if here)
        if not names or (value == "0" and group.field in WRENCHES):  # moments of a point contact
            continue
        severity = NOTE
        advice = "nothing if the robot does not move there: constant channels add no information"
        if value == "0" and group.field == "joint_torque":
            severity = SUSPICIOUS
            advice = "write NaN if they were not measured: zeros are fitted as measured torques"
        elif value != "0" and is_force and moves:
            severity = SUSPICIOUS
            advice = "write NaN if they were not measured: a sensor's readings change while joints move"
        yield Finding("constant", severity, group.field, f"{join_names(names)}: always {value}", advice, names)


def _mean_hold(values: FloatArray, repeated: BoolArray) -> float:
    """Mean number of samples for which values (M, c) are held, by steps without change (M - 1,); 0 if not held.

    Held values repeat while the robot moves: changes after a repeat have several quanta, unlike those of a slow
    encoder, and few repeats are part of long rests.
    """
    changes = np.flatnonzero(~repeated)
    lengths = np.diff(changes)  # what lies before the first change or behind the last is rest
    if len(changes) < NEIGHBOUR_STEPS or len(lengths) >= (1.0 - MIN_REPEATED_SHARE) * lengths.sum():
        return 0.0
    quanta = np.array([_estimate_resolution(column) for column in values.T])
    after = changes[1:][lengths > 1]
    sizes = np.abs(values[after + 1] - values[after])
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = np.nan_to_num(sizes / quanta, nan=0.0, posinf=np.inf).max(axis=1)
    if np.median(steps) <= _MIN_STEP_QUANTA:
        return 0.0
    typical = int(np.median(lengths))
    if typical > 1 and float(np.mean(np.abs(lengths - typical) <= 1)) >= _MIN_REGULAR_SHARE:
        return typical
    mean = float(lengths.mean())
    return mean if lengths[lengths > _MIN_REST_HOLDS * mean].sum() <= _MAX_REST_SHARE * lengths.sum() else 0.0


def new_poses(log: Log) -> Log:
    """The log at samples with new positions of the joints, or else of the base, if these are held at a lower rate."""
    for group in channel_groups(log, ("joint_position", "base_quat_xyzw")):
        together = (np.diff(group.values, axis=0) == 0.0).all(axis=1) & group.joined
        changing = group.values[:, np.ptp(group.values, axis=0) > 0.0]
        if changing.size and _mean_hold(changing, together):
            return log.select(np.append(group.samples[0], group.samples[1:][~together]))
    return log


def _estimate_resolution(values: FloatArray) -> float:
    """Quantum of a channel (M,); 0 if its steps lie on no grid, inf if it has too few steps."""
    sizes = np.abs(np.diff(values))
    sizes = sizes[sizes > _FLOAT32_ROUNDING_SHARE * np.abs(values).max()]
    if len(sizes) < _MIN_GRID_STEPS:
        return np.inf
    for least in np.quantile(sizes, _SMALL_STEP_QUANTILES):  # fast channels have few steps of one quantum
        quantum = float(np.median(sizes[sizes < 1.5 * least]))
        steps = sizes[sizes < _MAX_GRID_QUANTA * quantum] / quantum
        if (
            len(steps) >= _MIN_GRID_STEPS
            and float(np.mean(np.abs(steps - np.rint(steps)) < _GRID_TOLERANCE_QUANTA)) >= _MIN_GRID_SHARE
        ):
            return quantum
    return 0.0


def _implausible_runs(values: FloatArray, repeated: BoolArray) -> Runs:
    """Runs of steps without change (M - 1,) in all channels (M, c), not explained by chance or rest."""
    runs = Runs.of_repeats(repeated)
    if not 0 < len(runs) <= _MAX_RUNS:
        return runs.select(np.zeros(len(runs), bool))
    sizes = np.abs(np.diff(values, axis=0))
    ends = ((runs.first, -1), (runs.last, 1))
    sides = [neighbours_of(sizes, step, direction, NEIGHBOUR_STEPS) for step, direction in ends]  # (R, k, c)
    typical = finite_median(np.concatenate(sides, axis=1))
    quanta = np.array([_estimate_resolution(column) for column in values.T])
    finest = np.maximum(_smallest_difference(sides, FLOAT64_ROUNDING_SHARE * np.abs(values).max(axis=0)), quanta)
    moving = np.ones(len(runs), bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        probability = np.where(typical > _MIN_STEP_QUANTA * finest, 0.5 * finest / typical, 1.0)  # of one repeat
        log_probability = runs.lengths * np.log10(probability).sum(axis=1)
        for side in sides:
            at_end = np.isnan(side[:, 0]).all(axis=1)
            moving &= at_end | (_relative_speed(side) >= _MIN_SPEED_SHARE)
    return runs.select((log_probability < MAX_LOG10_PROBABILITY) & moving)


def _in_dead_band(values: FloatArray, runs: Runs) -> BoolArray:
    """Which runs (R,) of values (M, c) are zeros that begin and end next to the smallest readings of the channel.

    A signal enters a dead band and leaves it within a step of its edge; a lost sensor reads 0 from any reading on.
    """
    size = np.abs(values)
    steps = np.abs(np.diff(values, axis=0))
    least = np.where(size > 0.0, size, np.inf).min(axis=0)
    inside = (size[runs.first] == 0.0).all(axis=1)
    for neighbour, jump, direction in ((runs.first - 1, runs.first - 1, -1), (runs.last + 2, runs.last + 1, 1)):
        at_end = (neighbour < 0) | (neighbour >= len(size))
        usual = finite_median(neighbours_of(steps, jump, direction, NEIGHBOUR_STEPS))
        reach = least + np.maximum(least, _MAX_STEPS_TO_DEAD_BAND * usual)
        inside &= at_end | (size[np.clip(neighbour, 0, len(size) - 1)] <= reach).all(axis=1)
    return np.asarray(inside)


def _relative_speed(side: FloatArray) -> FloatArray:
    """Speed next to runs over the median on the same side, (R,), by sizes of steps (R, k, c)."""
    usual = finite_median(side)
    noisy = finite_median(np.abs(np.diff(side, axis=1))) > 0.5 * usual
    nearest = np.where(noisy, side[:, :_AVERAGED_STEPS].mean(axis=1), side[:, 0])
    ratio = np.where(usual > 0.0, nearest / usual, np.nan)
    known = np.isfinite(ratio)
    return np.where(known, ratio, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)


def _smallest_difference(sides: list[FloatArray], rounding: FloatArray) -> FloatArray:
    """Smallest difference of values or steps above rounding on both sides of each run, (R, c)."""
    sizes = np.concatenate([*sides, *(np.abs(np.diff(side, axis=1)) for side in sides)], axis=1)
    least = np.where(sizes > rounding, sizes, np.inf).min(axis=1)  # NaN compares false
    return np.where(np.isfinite(least), least, 0.0)


def check_still_base(log: Log) -> Iterator[Finding]:
    """A finding about a base position that never changes although the base turns: it was not measured.

    A base that is held neither turns nor moves; no base always turns exactly about its origin.
    """
    position = log.base_position_world
    quat = log.base_quat_xyzw
    if position is None or quat is None or np.ptp(position, axis=0).any():
        return
    if (turned := _turned_deg(quat)) < MIN_TURN_DEG:
        return
    text = f"the position never changes, but the base turns by {turned:.2g} degrees"
    others = (log.base_linear_velocity_world, log.base_linear_acceleration_world, log.imu_specific_force)
    severity = SUSPICIOUS if all(other is None for other in others) else NOTE  # else nothing is derived from it
    advice = "remove it and give an IMU or the base's velocity, or set preprocessing.base_motion: contacts"
    yield Finding("constant position", severity, "base_position_world", text, advice)


def check_excitation(log: Log) -> Iterator[Finding]:
    """A note about a log in which nothing moves: its forces determine only weights, in one posture.

    This is no mistake: such logs determine offsets, or complete other logs.
    """
    position = log.base_position_world
    quat = log.base_quat_xyzw
    moved = float(np.nanmax(np.ptp(log.joint_position, axis=0), initial=0.0))
    if moved > MIN_MOTION or (position is not None and np.ptp(position, axis=0).max() > MIN_MOTION):
        return
    if quat is not None and _turned_deg(quat) > MIN_TURN_DEG:
        return
    text = f"nothing moves: the largest joint motion is {moved:.2g} rad (or m)"
    advice = "record motion: one posture determines only its gravity load, no inertia and no friction"
    yield Finding("no motion", NOTE, "joint_position", text, advice)


# [s]; samples
_REST_LAG_S = 0.1
_FEWEST_OF_REST = 100


def check_rest(log: Log) -> Iterator[Finding]:
    """A note about joints with a torque that rest while others move: their friction is then below Coulomb friction.

    It compares positions 0.1 s apart; their noise is the part that is not smooth from sample to sample.
    """
    lag = max(1, round(_REST_LAG_S / float(np.median(np.diff(log.time))))) if len(log) > 1 else 1
    if log.joint_torque is None or len(log) < lag + _FEWEST_OF_REST:
        return
    seconds = (log.time[lag:] - log.time[:-lag])[:, None]
    velocity = (log.joint_position[lag:] - log.joint_position[:-lag]) / seconds
    noise = np.sqrt(2.0) * rough_noise(log.joint_position) / float(np.median(seconds))
    share = np.where(np.isfinite(log.joint_torque).any(axis=0), resting_share(velocity, noise), 0.0)
    order = [joint for joint in np.argsort(-share, kind="stable").tolist() if share[joint] > OFTEN]
    if order and np.ptp(log.joint_position, axis=0).max() > MIN_MOTION:
        names = [log.joint_names[joint] for joint in order]
        named = join_names([f"{name} {100.0 * share[joint]:.0f} %" for name, joint in zip(names, order, strict=True)])
        text = f"joints rest much of the time: {named}. At rest, friction has any value up to Coulomb friction"
        advice = "nothing if actuators.stiction is auto or true: it excludes these samples"
        yield Finding("rest", NOTE, "joint_position", text, advice, tuple(names))


def _turned_deg(quat: FloatArray) -> float:
    """The largest turn [degrees] of orientations (N, 4) from the first one."""
    return float(np.degrees(2.0 * np.arccos(np.clip(np.abs(quat @ quat[0]), 0.0, 1.0))).max())
