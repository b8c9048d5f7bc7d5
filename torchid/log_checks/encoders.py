"""Encoders that torques contradict: dead, other signs or zeros; stops, and missing gravity.

All for every URDF near the given one: masses that are 15 to 20 % off turn gravity, too, but not as another zero does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import torch

from torchid.errors import InputError, format_percent, join_names
from torchid.log_checks.findings import NOTE, REJECTED, SUSPICIOUS, Finding, Skipped
from torchid.log_checks.lags import fit_tilt, tilt_columns
from torchid.log_checks.mistakes import joint_mistakes, joints_of_limb
from torchid.log_checks.model import (
    MAX_FRICTION_SHARE,
    MAX_TRIAL_DIFFERENTIATED_SAMPLES,
    TRIAL_SAMPLES,
    UNMODELLED_FORCE_SHARE,
    Declared,
    NominalModel,
    bind_some_samples,
    default_cutoff_hz,
    preprocess_pieces,
)
from torchid.log_checks.scales import (
    COMPARED_SAMPLES,
    CORRELATED_SAMPLES,
    MAX_LEFT,
    TIME_SCALE_SAMPLES,
    Deviation,
    DeviationRows,
    FilteredLog,
    UnknownColumns,
    UnknownEquations,
    fit_deviation,
)
from torchid.logs import Log
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.segments import with_delayed_torques
from torchid.logs.signal_noise import rough_noise
from torchid.problem import RowBuilder, Samples, bind_log
from torchid.problem.metrics import force_series
from torchid.problem.motion import MIN_MOTION
from torchid.robot import Robot
from torchid.robot.urdf import position_limits
from torchid.sensing import Contact

#: Zero that is reported: 3 degrees of a hinge, 3 cm of a slide. Arms are calibrated to tenths of a degree.
MIN_ZERO_DEG, MIN_ZERO_M = 3.0, 0.03
#: The same of a single joint that is to blame for most.
MIN_SINGLE_ZERO_DEG, MIN_SINGLE_ZERO_M = 2.0, 0.02
#: Prior standard deviation of zeros [rad or m].
_ZERO_PRIOR_STD = 0.2
#: Times that positions are corrected by what the slope of the forces says, which is exact for small zeros alone.
_CORRECTIONS, _LEAST_CORRECTION = 6, 2e-3
#: Least unmodelled forces, over those that are presumed: no model is better.
_MIN_UNMODELLED = 0.1
#: Share of what zeros and tilts explain together that the zero of one joint explains, and that a tilt must not.
_MIN_EXPLAINED_SHARE = 0.5
_SMALL = 1e-4


def fit_zeros(samples: Sequence[Samples], model: NominalModel) -> Deviation | None:
    """By how much joints are further than is read, (n,) [rad or m]; None where no torque was measured."""
    total, without, moved = np.zeros(model.robot.n), None, list(samples)
    for _ in range(_CORRECTIONS):
        found = fit_deviation(DeviationRows.of(moved, model), _slopes(model), _ZERO_PRIOR_STD)
        if found is None:
            return None
        without = found.without if without is None else without
        out = replace(found, value=found.value + total, blocks=found.blocks + total, without=without)
        total = out.value
        moved = [replace(x, joint_position=x.joint_position + torch.from_numpy(total)) for x in samples]
        diverges = np.abs(total).max(initial=0.0) > 2.0 * np.pi
        if diverges or np.abs(found.value).max(initial=0.0) < _LEAST_CORRECTION:
            break
    return out


def _slopes(model: NominalModel) -> UnknownColumns:
    """Columns of zeros: what the forces that are required lose for each unit of a joint's position."""

    def columns(builder: RowBuilder, part: Samples, number: int) -> FloatArray:
        phi = model.robot.nominal.flatten()[None]
        level, out = force_series(builder, part, phi)[1][0], []
        for step in _SMALL * torch.eye(model.robot.n, dtype=part.joint_position.dtype):
            moved = replace(part, joint_position=part.joint_position + step)
            out.append((level - force_series(builder, moved, phi)[1][0]) / _SMALL)
        return np.stack(out, axis=2)

    return columns


def zero_findings(found: Deviation, model: NominalModel) -> Iterator[Finding]:
    """Findings about joints of clearly other zeros, by what `fit_zeros` has found."""
    for joint in np.flatnonzero(found.clear & (np.abs(found.value) > _least(model, MIN_ZERO_DEG, MIN_ZERO_M))).tolist():
        yield _finding(joint, found, joint, model)


def check_single_zero(samples: Sequence[Samples], model: NominalModel) -> list[Finding]:
    """A finding about the one joint whose zero explains most of what all zeros and a tilt of the base explain together.

    Unmodelled forces are taken to be as large as what all these leave: in good recordings a fraction of what
    `fit_zeros` presumes, beside which errors of the URDF hide less of a zero.

    Args:
        samples: some of a log in which nothing else is wrong.
        model: the robot.
    """
    rows, n = DeviationRows.of(samples, model), model.robot.n
    if rows is None:
        return []
    zeros, tilts, unit = _slopes(model), tilt_columns(model), np.eye(n + 2)

    def columns(builder: RowBuilder, part: Samples, number: int) -> FloatArray:
        return np.concatenate([zeros(builder, part, number), tilts(builder, part, number)], axis=2)

    presumed = UnknownEquations.of(rows, columns)
    left = presumed.fit(_ZERO_PRIOR_STD).left
    equations = presumed.with_unmodelled(float(np.clip(left, _MIN_UNMODELLED, 1.0)))
    each = [equations.fit(_ZERO_PRIOR_STD, unit[:, [joint]]) for joint in range(n)]
    joint = int(np.argmax([one.explained for one in each]))
    best, together = each[joint], equations.fit(_ZERO_PRIOR_STD).explained
    tilted = equations.fit(_ZERO_PRIOR_STD, unit[:, n:]).explained
    is_alone = (
        best.explained > _MIN_EXPLAINED_SHARE * together and tilted < (1.0 - _MIN_EXPLAINED_SHARE) * best.explained
    )
    is_large = abs(best.value[0]) > _least(model, MIN_SINGLE_ZERO_DEG, MIN_SINGLE_ZERO_M)[joint]
    is_clear = bool((best.certain & best.steady)[0]) and left < MAX_LEFT
    return [_finding(joint, best, 0, model)] if is_alone and is_large and is_clear else []


def _least(model: NominalModel, degrees: float, metres: float) -> FloatArray:
    """Of each joint [rad or m]."""
    slides = np.array([name in model.robot.sliding for name in model.robot.joint_names], bool)
    return np.where(slides, metres, np.radians(degrees))


def _finding(joint: int, found: Deviation, number: int, model: NominalModel) -> Finding:
    """About a joint's zero, the unknown of that number in what was found."""
    name, value, spread = model.robot.joint_names[joint], float(found.value[number]), float(found.spread[number])
    unit, read = ("m" if name in model.robot.sliding else "rad"), "much" if value < 0.0 else "little"
    text = f"{name}: positions read {abs(value):.2g} +- {spread:.1g} {unit} too {read}: {found.gain}"
    advice = "check the zero of its encoder, and whether the robot's file counts from the same posture"
    return Finding("zero", SUSPICIOUS, "joint_position", text, advice, (name,))


#: Time over which positions are averaged, and velocities added up: a tenth of a second resolves motion up to 5 Hz.
_AVERAGED_S = 0.1
#: Largest range of averages of white noise, in their standard deviations, in a thousand of them.
_NOISE_RANGE = 8.0
#: Travel by a joint's velocity over its noise, and over that of its position, from which on it moves.
_MIN_SIGNAL_TO_NOISE, _MIN_TRAVEL_RATIO = 20.0, 10.0
#: Share of what is unexplained, from which on a torque of one joint makes it up: 1.25 times as much is left without.
_MIN_SHARE = 1.0 - 1.25**-2
#: Distance from a limit, over a joint's range, that is at the stop: URDFs have them to a hundredth.
_STOP_SHARE = 0.01
#: Samples at a stop that are needed; torque that is unexplained there, in standard deviations of what is elsewhere, and
#: the share of these samples in which it pushes against the stop.
_MIN_AT_STOP, _MIN_DEVIATIONS, _MIN_PUSHING = 5, 4.0, 0.8
#: What may be unexplained elsewhere, in `UNMODELLED_FORCE_SHARE` of the forces: more, and it is another mistake's.
_MAX_UNEXPLAINED = 1.0


def still_joints(log: Log) -> tuple[str, ...]:
    """Joints whose positions never move beyond their noise, while others do."""
    position = log.joint_position
    if len(log) < 2 or not position.size or np.ptp(position, axis=0).max() <= MIN_MOTION:
        return ()
    count = max(1, round(_AVERAGED_S / float(np.median(np.diff(log.time)))))
    whole = count * (len(log) // count)
    if whole < 2 * count:
        return ()
    averages = position[:whole].reshape(-1, count, position.shape[1]).mean(axis=1)
    noise = rough_noise(position) / np.sqrt(count)
    still = np.ptp(averages, axis=0) <= np.minimum(_NOISE_RANGE * noise, MIN_MOTION)
    return tuple(name for name, rests in zip(log.joint_names, still, strict=True) if rests)


def check_still_velocities(log: Log) -> Iterator[Finding]:
    """A finding about joints whose velocities move them while their positions stand still."""
    names, velocity = still_joints(log), log.joint_velocity
    if not names or velocity is None:
        return
    step = float(np.median(np.diff(log.time)))
    lag = max(1, round(_AVERAGED_S / step))
    travelled = step * np.cumsum(velocity, axis=0)
    moved, read = (x[lag:] - x[:-lag] for x in (travelled, log.joint_position))
    size, still = (np.std(x, axis=0) for x in (moved, read))
    least = np.maximum(_MIN_SIGNAL_TO_NOISE * step * np.sqrt(lag) * rough_noise(velocity), _MIN_TRAVEL_RATIO * still)
    dead = [name for name in names if size[(j := log.joint_names.index(name))] > max(least[j], 1e-9)]
    if dead:
        ranges = [f"{name} {np.ptp(travelled[:, log.joint_names.index(name)]):.2g}" for name in dead]
        text = f"positions stand still while velocities move these joints by (rad, slides: m) {join_names(ranges)}"
        yield _dead_encoder(SUSPICIOUS, dead, text)


def still_in_limb(log: Log, robot: Robot, frame: str) -> list[str]:
    """The joints between the base and a link that stand still in the log."""
    still = still_joints(log)
    return [name for name in joints_of_limb(robot, frame) if name in still]


def check_single_joints(
    log: Log,
    robot: Robot | None,
    contacts: Sequence[Contact],
    cutoff_hz: float | None,
    declared: Declared | None,
    found: Sequence[Finding | Skipped],
) -> Iterator[Finding]:
    """Findings about joints that stand still, or reach their limits, and whose torque the URDF does not explain.

    Args: as `check_forces_against_urdf`, and what it has found; nothing more is said of a log that it rejects.
    """
    if any(isinstance(one, Finding) and one.rejects_all for one in found):
        return
    if robot is None or log.joint_torque is None or set(log.joint_names) != set(robot.joint_names):
        return
    still, stops, model = still_joints(log), _stops(log, robot), NominalModel(robot, contacts, declared or Declared())
    if not (still or stops) or "joint_torque" in model.declared.terms.scales:  # the size of torques is not known
        return
    try:
        moved = with_delayed_torques(log, model.declared.known_delay)
        free = _FreeTorques.of(moved, model, cutoff_hz or default_cutoff_hz(log), stops)
    except InputError:  # reported by `check_forces_against_urdf`
        return
    if free is not None:
        yield from _still_findings(free, robot, still)
        yield from _stop_findings(free, robot, stops)


@dataclass(frozen=True, eq=False)
class _FreeTorques:
    """What a further torque of one joint would have to be, to explain what the best URDF near the given one leaves.

    Attributes:
        error: (N, n) of readings beyond what is explained [N m or N], NaN of joints without readings.
        share: (n,) of what is unexplained that it makes up.
        position: (N, n).
        load: (n,) rms of the torques.
        is_fitted: (N,), samples at no stop, which the URDF is fitted to and `share` is of.
        unexplained: rms of what is left in them, in `UNMODELLED_FORCE_SHARE` of the forces.
    """

    error: FloatArray
    share: FloatArray
    position: FloatArray
    load: FloatArray
    is_fitted: BoolArray
    unexplained: float

    @classmethod
    def of(cls, log: Log, model: NominalModel, cutoff_hz: float, stops: Sequence[_Stop]) -> _FreeTorques | None:
        """By some samples of a log, evenly spread ones and as many at stops."""
        [piece, *_] = preprocess_pieces(log, cutoff_hz, MAX_TRIAL_DIFFERENTIATED_SAMPLES)
        samples = bind_log(piece, model.robot, model.contacts)
        position = samples.joint_position.numpy()
        at_stop = np.zeros(len(position), bool)
        for stop in stops:
            at_stop |= stop.reached(position)
        chosen = [
            where[np.unique(np.linspace(0, len(where) - 1, COMPARED_SAMPLES).astype(int))]
            for where in (np.flatnonzero(~at_stop), np.flatnonzero(at_stop))
            if len(where)
        ]
        index = np.sort(np.concatenate(chosen))
        some = samples[torch.from_numpy(index)]
        rows = DeviationRows.of([some], model)
        if rows is None or at_stop.all():
            return None
        [(W, equations, K, target)] = rows.parts
        fitted, base = ~at_stop[index], rows.builder.tree.base_rows
        A, b = K[fitted].reshape(-1, K.shape[2]), target[fitted].reshape(-1)
        x = np.linalg.solve(A.T @ A + CORRELATED_SAMPLES * np.eye(A.shape[1]), A.T @ b)
        left = target - K @ x
        columns = W[:, base : base + model.robot.n]  # (N, n, r)
        size = np.square(columns).sum(axis=2)
        along = np.einsum("njr,nr->nj", columns, left)
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.where(size > 0.0, -along / size, np.nan)
            made_up = np.where(size > 0.0, np.square(along) / size, 0.0)
        total = float(np.square(left[fitted]).sum())
        share = made_up[fitted].sum(axis=0) / max(total, 1e-300)
        torque = rows.builder.recorded_torque(some)[:, : model.robot.n].numpy()
        load = np.sqrt(np.nanmean(np.square(np.nan_to_num(torque)), axis=0))
        unexplained = float(np.sqrt(total / max(int(equations[fitted].sum()), 1)))
        return cls(error, share, position[index], load, fitted, unexplained)


@dataclass(frozen=True)
class _Stop:
    """A limit [rad or m] of a joint, by number, its side, -1 or 1, and how near it is reached."""

    joint: int
    limit: float
    side: int
    margin: float

    def reached(self, position: FloatArray) -> BoolArray:
        """In which of the positions (N, n), in the robot's order, it is."""
        return np.asarray(self.side * (position[:, self.joint] - self.limit) > -self.margin)


def _stops(log: Log, robot: Robot) -> list[_Stop]:
    """Limits that joints which move reach in a few samples, but not in most."""
    limits = position_limits(robot.path) if robot.format == "URDF" else {}
    order = [log.joint_names.index(name) for name in robot.joint_names]
    position, out = log.joint_position[:, order], list[_Stop]()
    for joint, name in enumerate(robot.joint_names):
        low, high = limits.get(name, (0.0, 0.0))
        for side, limit in ((-1, low), (1, high)) if high > low else ():
            stop = _Stop(joint, limit, side, _STOP_SHARE * (high - low))
            count = int(stop.reached(position).sum())
            if _MIN_AT_STOP <= count < 0.5 * len(log):
                out.append(stop)
    return out


def _still_findings(free: _FreeTorques, robot: Robot, still: Sequence[str]) -> Iterator[Finding]:
    """Joints that stand still with a torque that no joint at rest needs; a note where friction may hold them."""
    rms = np.sqrt(np.nanmean(np.square(free.load))) if free.load.any() else 0.0
    for name in still:
        joint = robot.joint_names.index(name)
        error = float(np.sqrt(np.nanmean(np.square(free.error[free.is_fitted, joint]))))
        if not free.share[joint] > _MIN_SHARE or not error > UNMODELLED_FORCE_SHARE * rms:
            continue
        unit = "N" if name in robot.sliding else "N m"
        text = f"{name} stands still, with {error:.2g} {unit} rms that a joint at rest does not need and that are"
        text += f" {format_percent(float(free.share[joint]))} % of what is unexplained"
        held = error < MAX_FRICTION_SHARE * float(free.load.max())
        yield _dead_encoder(NOTE if held else SUSPICIOUS, [name], text, "friction or a brake" * held)


def _dead_encoder(severity: str, names: Sequence[str], text: str, held_by: str = "") -> Finding:
    advice = f"none if {held_by} holds it; else " * bool(held_by)
    advice += "look whether these joints move, for a dead encoder, and leave the log out"
    return Finding("dead encoder", severity, "joint_position", text, advice, tuple(names))


def _stop_findings(free: _FreeTorques, robot: Robot, stops: Sequence[_Stop]) -> Iterator[Finding]:
    """Joints at limits against which their torque pushes more than it errs elsewhere, where the URDF explains it."""
    for stop in stops if free.unexplained <= _MAX_UNEXPLAINED else ():
        name, reached = robot.joint_names[stop.joint], stop.reached(free.position)
        error = free.error[:, stop.joint]
        usual, here = error[free.is_fitted], stop.side * error[reached]
        usual, here = usual[np.isfinite(usual)], here[np.isfinite(here)]
        if len(here) < _MIN_AT_STOP or not len(usual):
            continue
        spread = float(np.sqrt(np.square(usual).mean()))
        if np.median(here) < _MIN_DEVIATIONS * spread or np.mean(here > 0.0) < _MIN_PUSHING:
            continue
        unit = ("N", "m") if name in robot.sliding else ("N m", "rad")
        text = f"{name} pushes against its limit of {stop.limit:.3g} {unit[1]} with {np.median(here):.2g} {unit[0]}"
        text += f" that the {robot.format} does not explain ({spread:.2g} {unit[0]} rms elsewhere)"
        advice = "leave these samples out: a stop's force is in no model; or record motion within the limits"
        yield Finding("stop", SUSPICIOUS, "joint_position", text, advice, (name,))


#: Prior standard deviation of the share of gravity that torques lack.
_GRAVITY_PRIOR_STD = 1.0
#: Share of gravity that torques lack if a controller has compensated it: all of it by masses of its own.
_ALL_OF_GRAVITY = (0.75, 1.25)
#: What another zero must leave of that which a tilt leaves: of a first joint that is level, both are one.
_BETTER_THAN_A_TILT = 0.8
#: Unexplained forces from which on joints that count the other way are tried, what one of them must leave of them.
_MIN_UNEXPLAINED, _MAX_REVERSED_RESIDUAL_SHARE = 1.0, 0.5


def is_bolted_arm(model: NominalModel) -> bool:
    """Whether the torques of a robot are those of its joints, of gravity and inertia alone."""
    return model.robot.fixed_base and not model.contacts and not model.robot.loops


def fit_missing_gravity(samples: Sequence[Samples], model: NominalModel) -> Deviation | None:
    """Share of gravity's part of the torques that the readings lack, (1,); None where no torque was measured."""

    def columns(builder: RowBuilder, part: Samples, number: int) -> FloatArray:
        phi = model.robot.nominal.flatten()[None]
        still = replace(
            part,
            joint_velocity=torch.zeros_like(part.joint_velocity),
            joint_acceleration=torch.zeros_like(part.joint_acceleration),
        )
        return np.asarray(force_series(builder, still, phi)[1][0])[..., None]

    return fit_deviation(DeviationRows.of(samples, model), columns, _GRAVITY_PRIOR_STD)


def check_encoders(filtered: FilteredLog, moved: list[Finding], unexplained: float) -> list[Finding]:
    """Findings about a bolted arm's torques without gravity, zeros of encoders and joints that are reversed.

    Args:
        filtered: the log.
        moved: findings about lags and tilts, which are returned where nothing here explains the forces better.
        unexplained: what the best URDF near the given one leaves of the forces, in `UNMODELLED_FORCE_SHARE`.
    """
    model = filtered.model
    if not is_bolted_arm(model) or filtered.log.joint_torque is None:
        return moved
    try:
        samples = bind_some_samples(filtered.pieces, model.robot, (), TIME_SCALE_SAMPLES)
        gravity = fit_missing_gravity(samples, model)
        if gravity is not None and gravity.is_clear and _ALL_OF_GRAVITY[0] < gravity.value[0] < _ALL_OF_GRAVITY[1]:
            return [_gravity_finding(gravity)]
        zeros = fit_zeros(samples, model)
        if zeros is not None and (found := list(zero_findings(zeros, model))):
            tilt = fit_tilt(filtered) if any(one.name == "tilt" for one in moved) else None
            if tilt is None or zeros.left < _BETTER_THAN_A_TILT * tilt.left:
                return [*(one for one in moved if one.name != "tilt"), *found]
            names = join_names([name for one in found for name in one.channels])
            also = f"; or the zero of {names}, which explains it as well"
            return [replace(one, advice=one.advice + also) if one.name == "tilt" else one for one in moved]
        mistaken = None if moved else _reversed_joint(filtered.pieces, model, unexplained)
    except InputError:  # reported by `check_forces_against_urdf`
        return moved
    return moved if mistaken is None else [mistaken]


def single_zero_findings(filtered: FilteredLog) -> list[Finding]:
    """A finding about one encoder's zero of a bolted arm's log in which nothing else is wrong."""
    model = filtered.model
    if not is_bolted_arm(model) or filtered.log.joint_torque is None:
        return []
    with suppress(InputError):  # reported by `check_forces_against_urdf`
        return check_single_zero(bind_some_samples(filtered.pieces, model.robot, (), TIME_SCALE_SAMPLES), model)
    return []


def _gravity_finding(found: Deviation) -> Finding:
    share = f"{100.0 * found.value[0]:.0f} +- {100.0 * found.spread[0]:.0f} %"
    text = f"torques lack {share} of gravity: a controller has compensated it? {found.gain}"
    advice = "record torques before gravity is subtracted (not those of external forces, nor commands beside gravity's)"
    return Finding("gravity", REJECTED, "joint_torque", text, f"{advice}, or add what was subtracted")


def _reversed_joint(pieces: Sequence[Log], model: NominalModel, unexplained: float) -> Finding | None:
    """A finding about the joint without whose mistake forces are explained; None without such a joint."""
    best, least = None, min(_MAX_REVERSED_RESIDUAL_SHARE * unexplained, _MIN_UNEXPLAINED)
    for mistake in joint_mistakes(pieces[0]) if unexplained > _MIN_UNEXPLAINED else ():
        corrected = [mistake.correct(piece) for piece in pieces]
        rows = DeviationRows.of(bind_some_samples(corrected, model.robot, (), TRIAL_SAMPLES), model)
        left = fit_deviation(rows, lambda builder, part, _: np.zeros((len(part), builder.tree.n_rows, 1)), 1.0)
        if left is not None and left.without < least:
            best, least = mistake, left.without
    if best is None:
        return None
    text = f"{best.description}: {unexplained / max(least, 1e-9):.2g} times as much is unexplained otherwise"
    return Finding("unit, sign or frame", REJECTED, best.field, text, best.advice)
