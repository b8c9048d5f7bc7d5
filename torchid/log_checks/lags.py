"""Lags, clocks at another rate, offsets of torques, tilts of gravity, and turned contact sensors.

A lag between two of them is one's as well as the other's; what both have to agree with tells. So each is taken to be
the late one in turn, beside all URDFs near the given one, and the one that leaves least of the forces is named.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.special import stdtr

from torchid.errors import InputError
from torchid.log_checks.findings import NOTE, SUSPICIOUS, Finding
from torchid.log_checks.model import (
    Declared,
    NominalModel,
    bind_some_samples,
    some_samples,
)
from torchid.log_checks.scales import (
    COMPARED_SAMPLES,
    MIN_STANDARD_DEVIATIONS,
    MIN_UNEXPLAINED_RATIO,
    TIME_BLOCKS,
    Deviation,
    DeviationRows,
    FilteredLog,
    UnknownColumns,
    UnknownEquations,
    fit_deviation,
)
from torchid.logs import Log
from torchid.logs.log import SHAPES, WRENCHES, FloatArray
from torchid.logs.segments import with_delayed, with_delayed_torques
from torchid.problem import RowBuilder, Samples
from torchid.problem.metrics import force_series
from torchid.regressor.kinematics import GRAVITY_WORLD
from torchid.sensing import Contact

#: Lag that is reported: filters of sensors are late by 10 ms.
MIN_LAG_S = 0.025
#: Lag of filters, beyond which a smaller one is reported, too, where it is certain.
_FILTER_LAG_S = 0.01
#: Prior standard deviation of a lag, and of its change over the log [s].
_LAG_PRIOR_STD_S = 0.2
#: Times that readings are shifted by what their slope says, which is exact for small lags alone.
_SHIFTS, _LEAST_SHIFT_S = 8, 2e-3
#: Lag up to which the slopes alone tell who is not late.
_SMALL_LAG_S = 0.05
#: Share of logs whose clocks agree in which a lag that changes is found.
_LEVEL = 0.01
_SMALL_S, _TINY = 1e-4, 1e-12
_ALL = slice(None)
_OF_BASE, _OF_JOINTS = ("base_", "imu_"), ("joint_position", "joint_velocity", "joint_acceleration")
TORQUES = "torques are"
_TORQUE, _BASE = "joint torques", "the base"  # as sources, beside names of contacts


@dataclass(frozen=True)
class Clock:
    """Readings that may be late together.

    Attributes:
        what, than: they, and what they are compared with, in a sentence.
        field: of a finding about them, with its channels.
        sources: those of `_Sources` that a lag of them moves; of `sign` -1, all that it does not.
        moved: channels of the fields of a filtered log.
    """

    what: str
    than: str
    field: str
    sources: frozenset[str]
    moved: Mapping[str, slice]
    channels: tuple[str, ...] = ()
    sign: float = 1.0


@dataclass(frozen=True, eq=False)
class Lag:
    """By how much a clock's readings are late: (1,) [s], or (2,), in the middle of the log and its change over the log.

    `scatter`: standard deviation of the change by how lags in blocks of time follow a line [s].
    """

    clock: Clock
    found: Deviation
    scatter: float = 0.0

    @property
    def seconds(self) -> float:
        """In the middle of the log."""
        return float(self.found.value[0])

    @property
    def largest(self) -> float:
        """Of its size and its change."""
        return float(np.abs(self.found.value).max())

    @property
    def changes(self) -> bool:
        """Whether it is one that does."""
        return len(self.found.value) > 1

    @property
    def is_clear(self) -> bool:
        """Whether it is certain, and no filter's."""
        spread = float(self.found.spread[-1])
        if self.changes:
            change = abs(float(self.found.value[1]))
            chance = 2.0 * stdtr(TIME_BLOCKS - 2, -change / max(self.scatter, _TINY))
            is_certain = change > max(_FILTER_LAG_S, MIN_STANDARD_DEVIATIONS * spread) and chance < _LEVEL
            return bool(self.found.improves and is_certain)
        least = min(MIN_LAG_S, _FILTER_LAG_S + MIN_STANDARD_DEVIATIONS * spread)
        return self.found.is_clear and abs(self.seconds) > least

    def text(self, duration: float) -> str:
        """What is late, by how much, in a log of a duration [s]."""
        clock, spread = self.clock, 1e3 * max(float(self.found.spread[-1]), self.scatter)
        if not self.changes:
            size, when = _late(self.seconds)
            return f"{clock.what} {size} +- {spread:.2g} ms {when} than {clock.than}"
        change = float(self.found.value[1])
        first, last = (" ms ".join(_late(self.seconds + share * change)) for share in (-0.5, 0.5))
        rate = 100.0 * change / duration
        text = f"{clock.what} {first} than {clock.than} at the start and {last} at the end (+- {spread:.2g} ms)"
        return f"{text}: a clock that is {abs(rate):.2g} % {'fast' if rate > 0.0 else 'slow'}"


def _late(seconds: float) -> tuple[str, str]:
    return f"{1e3 * abs(seconds):.3g}", "later" if seconds > 0.0 else "earlier"


@dataclass(frozen=True, eq=False)
class Lags:
    """Clear lags, that which explains the forces best first, and what is unexplained without any (see `Deviation`)."""

    clear: Sequence[Lag]
    without: float

    def findings(self, declared: Declared, log: Log) -> Iterator[Finding]:
        """A finding about the best, with others that explain the forces as well."""
        if not self.clear:
            return
        best, *others = self.clear
        duration = float(log.time[-1] - log.time[0])
        text, clock = best.text(duration), best.clock
        for other in others:
            if other.found.left < MIN_UNEXPLAINED_RATIO * best.found.left:
                text += f"; or {other.text(duration)}, which explains as much"
        name, advice = "delay", "check their stamps and filters; shift_s delays files of a log"
        if best.changes:
            name, advice = "clock", "stamp all sensors by one clock, or multiply the time of these by what makes up"
        elif clock.field == "joint_torque":
            delay = declared.known_delay - best.seconds
            advice = f"check their stamps and filters, or set actuators.delay: {delay:.2g}"
        yield Finding(name, SUSPICIOUS, clock.field, f"{text}: {best.found.gain}", advice, clock.channels)


def fit_lags(filtered: FilteredLog, derived: tuple[str, ...] = ()) -> Lags | None:
    """Lags of torques, contact forces, and the motions of base and joints; None where no force was measured.

    Args:
        filtered: the log.
        derived: how names of fields begin that were not recorded.

    Raises:
        InputError: the log cannot be filtered, or does not match the robot.
    """
    rows = filtered.rows
    if rows is None:
        return None
    trial = _Trial(filtered, _clocks(filtered, derived))
    equations, first = trial.equations(filtered.pieces, rows), list[Lag]()
    for clock in trial.clocks:
        constant, changing = (equations.fit(_LAG_PRIOR_STD_S, trial.combined(clock, count)) for count in (1, 2))
        better = constant.left > MIN_UNEXPLAINED_RATIO * changing.left
        first.append(Lag(clock, changing if better else constant))
    late = [lag for lag in sorted(first, key=lambda lag: lag.found.left) if lag.largest > _FILTER_LAG_S]
    if late and late[0].largest < _SMALL_LAG_S:
        late = [lag for lag in late if lag.found.left < MIN_UNEXPLAINED_RATIO * late[0].found.left]
    best = [trial.refined(lag, rows) for lag in late]
    clear = sorted((lag for lag in best if lag.is_clear), key=lambda lag: lag.found.left)
    return Lags(clear, equations.unexplained_without)


def without_lag(filtered: FilteredLog) -> FilteredLog:
    """The log with joint torques as late as the motion, where these are clearly the ones that are not.

    Raises:
        InputError: as `fit_lags`.
    """
    lags = fit_lags(filtered)
    if lags is None or not lags.clear or lags.clear[0].clock.what != TORQUES or lags.clear[0].changes:
        return filtered
    return replace(filtered, log=with_delayed_torques(filtered.log, -lags.clear[0].seconds))


def _clocks(filtered: FilteredLog, derived: tuple[str, ...]) -> list[Clock]:
    """What may be late. The joints' motion needs a third clock beside theirs and that of the forces."""
    log, of_wrench = filtered.log, filtered.log.contact_wrench_field
    contacts: Sequence[Contact] = filtered.model.contacts if log.contact_wrench is not None else ()
    of_base = [name for name in log.arrays() if name.startswith(_OF_BASE)]
    has_base = of_base and not filtered.model.robot.fixed_base and not "base_".startswith(derived)
    wrenches = frozenset(contact.frame for contact in contacts)
    torques = frozenset([_TORQUE] if log.joint_torque is not None else [])
    everything, motion, rest = torques | wrenches | {_BASE}, "the motion", "all else"
    out = [Clock(TORQUES, motion, "joint_torque", torques, {"joint_torque": _ALL})] if torques else []
    for place, contact in enumerate(contacts):
        name, own = contact.frame, dict.fromkeys(WRENCHES, slice(place, place + 1))
        out.append(Clock(f"forces of {name} are", motion, of_wrench, frozenset([name]), own, (name,)))
    of_all = dict.fromkeys(WRENCHES, _ALL)
    if len(contacts) > 1:
        out.append(Clock("contact forces are", motion, of_wrench, wrenches, of_all))
    if torques and wrenches:
        both = {"joint_torque": _ALL, **of_all}
        out.append(Clock("torques and contact forces are", motion, "all", torques | wrenches, both))
    if has_base:
        of_motion = dict.fromkeys((name for name in SHAPES if name.startswith(_OF_BASE)), _ALL)
        out.append(Clock("the base's motion is", rest, of_base[0], frozenset([_BASE]), of_motion))
        of_joints = dict.fromkeys(_OF_JOINTS, _ALL)
        out.append(Clock("the joints' motion is", rest, "joint_position", everything, of_joints, sign=-1.0))
    return out


@dataclass(frozen=True, eq=False)
class _Trial:
    """Lags of clocks in a log, one clock at a time."""

    filtered: FilteredLog
    clocks: Sequence[Clock]

    @property
    def sources(self) -> list[str]:
        """Of forces that change with a lag, each with two columns: of a constant lag, and of one that changes."""
        return sorted(frozenset[str]().union(*(clock.sources for clock in self.clocks)))

    def combined(self, clock: Clock, count: int) -> FloatArray:
        """How a clock's columns, one or two, are made up of those of the sources."""
        chosen = clock.sign * np.array([float(source in clock.sources) for source in self.sources])
        return np.asarray(np.kron(np.eye(2)[:, :count], chosen[:, None]), float)

    def equations(self, pieces: Sequence[Log], rows: DeviationRows) -> UnknownEquations:
        """Of the lags of all sources in pieces of the filtered log, whose rows these are."""
        model, forces = self.filtered.model, _Sources.of(pieces, self.filtered.model)

        def columns(builder: RowBuilder, part: Samples, number: int) -> FloatArray:
            constant = np.stack([forces.rate(source, builder, part, number, model) for source in self.sources], axis=2)
            return np.concatenate([constant, constant * self._elapsed(part.time.numpy())[:, None, None]], axis=2)

        return UnknownEquations.of(rows, columns)

    def _elapsed(self, time: FloatArray) -> FloatArray:
        """Times (N,), from -0.5 at the start of the log to 0.5 at its end."""
        first, last = self.filtered.log.time[[0, -1]]
        return np.asarray((time - first) / max(last - first, _TINY) - 0.5)

    def refined(self, first: Lag, rows: DeviationRows) -> Lag:
        """A clock's lag by readings that are shifted; a constant one where it is not certain that it changes."""
        lag = self._shifted(first, len(first.found.value), rows)
        return self._shifted(first, 1, rows) if lag.changes and not lag.is_clear else lag

    def _shifted(self, first: Lag, count: int, rows: DeviationRows) -> Lag:
        clock, total, pieces, model = first.clock, np.zeros(count), self.filtered.pieces, self.filtered.model
        for _ in range(_SHIFTS):
            equations = self.equations(pieces, rows)
            found = equations.fit(_LAG_PRIOR_STD_S, self.combined(clock, count))
            by_block = equations.fit(_LAG_PRIOR_STD_S, self.combined(clock, 1)).blocks[:, 0]
            out = replace(found, value=found.value + total, blocks=found.blocks + total, without=first.found.without)
            total = out.value
            ends = total[0] + np.array([-0.5, 0.5]) * total[1:].sum()
            if np.abs(found.value).max() < _LEAST_SHIFT_S or np.abs(ends).max() > 2.0 * _LAG_PRIOR_STD_S:
                break
            pieces = [self._moved(piece, clock, total) for piece in self.filtered.pieces]
            moved = DeviationRows.of(bind_some_samples(pieces, model.robot, model.contacts, COMPARED_SAMPLES), model)
            if moved is None:
                break
            rows = moved
        return Lag(clock, out, _scatter(by_block))

    def _moved(self, piece: Log, clock: Clock, lag: FloatArray) -> Log:
        """A piece of the filtered log with a clock's readings earlier by a lag, (1,) or (2,)."""
        changing = lag[1:].sum() * self._elapsed(piece.time)
        return with_delayed(piece, -(lag[0] + changing), clock.moved)


def _scatter(blocks: FloatArray) -> float:
    """Standard deviation of the change over a log that blocks of time (TIME_BLOCKS,) have, by a line through them."""
    at = (np.arange(TIME_BLOCKS) + 0.5) / TIME_BLOCKS - 0.5
    left = blocks - blocks.mean() - at * (at @ blocks) / (at @ at)
    return float(np.sqrt(left @ left / ((TIME_BLOCKS - 2) * (at @ at))))


@dataclass(frozen=True, eq=False)
class _Sources:
    """Samples by which forces change where a source of readings is late.

    Attributes:
        slopes: with slopes of torques and wrenches in their place.
        later: with the base where it is `_SMALL_S` later.
    """

    slopes: Sequence[Samples]
    later: Sequence[Samples]

    @classmethod
    def of(cls, pieces: Sequence[Log], model: NominalModel) -> _Sources:
        """Of pieces of a filtered log."""
        slopes = [replace(one, **_slopes(one, ("joint_torque", *WRENCHES))) for one in pieces]
        later = [_with_base_later(one) for one in pieces]
        return cls(*(bind_some_samples(x, model.robot, model.contacts, COMPARED_SAMPLES) for x in (slopes, later)))

    @torch.no_grad()
    def rate(self, source: str, builder: RowBuilder, part: Samples, number: int, model: NominalModel) -> FloatArray:
        """Forces that are required beyond those that act, (N, n_rows), for each second that a source is late."""
        if source == _BASE:
            phi = model.robot.nominal.flatten()[None]
            (acting, required), (later, needed) = (force_series(builder, x, phi) for x in (part, self.later[number]))
            return np.asarray((required[0] - needed[0] - np.nan_to_num(acting - later)) / _SMALL_S)
        slopes = self.slopes[number]
        if source == _TORQUE:
            torque, base = np.zeros((len(part), builder.tree.n_rows)), builder.tree.base_rows
            torque[:, base : base + model.robot.n] = builder.recorded_torque(slopes)[:, : model.robot.n].numpy()
            return np.nan_to_num(torque)
        if slopes.wrench is None:
            return np.zeros((len(part), builder.tree.n_rows))
        place = [contact.frame for contact in model.contacts].index(source)
        rates = replace(part, wrench=torch.nan_to_num(slopes.wrench * part.active[..., None]))
        kinematics, J = builder.kinematics(part), builder.contact_jacobian(part)[:, place]
        return np.asarray(
            torch.einsum("nwv,nw->nv", J, builder.recorded_wrench(replace(kinematics, samples=rates), place)).numpy()
        )


def _slopes(log: Log, names: Sequence[str]) -> dict[str, Any]:
    """By time, of the fields that a log has."""
    arrays = log.arrays()
    return {name: np.gradient(arrays[name], log.time, axis=0) for name in names if name in arrays}


def _with_base_later(log: Log) -> Log:
    arrays, names = log.arrays(), [name for name in log.arrays() if name.startswith(_OF_BASE)]
    later: dict[str, Any] = {name: arrays[name] + _SMALL_S * slope for name, slope in _slopes(log, names).items()}
    if (quat := later.get("base_quat_xyzw")) is not None:
        later["base_quat_xyzw"] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    return replace(log, **later)


#: Tilt that is reported: a table is level to 2 degrees.
MIN_TILT_DEG = 6.0
#: Gain of a contact's sensor relative to the others, and turn of its axes, that are reported.
_MIN_SENSOR_GAIN, _MIN_TURN_DEG = 0.15, 10.0
#: Offset of a torque, over the rms of all torques, that is reported: those of good sensors are 0.08 of it.
_MIN_OFFSET_SHARE = 0.1
#: Prior standard deviations of the tilt [rad], and of gains and turns of contact sensors; of offsets, over the rms of
#: all torques.
_TILT_PRIOR_STD_RAD, _SENSOR_PRIOR_STD, _OFFSET_PRIOR_SHARE = 0.3, 0.5, 0.5
_SMALL_ANGLE = 1e-4


def check_lag_and_tilt(filtered: FilteredLog, derived: tuple[str, ...] = ()) -> tuple[list[Finding], float]:
    """Findings about readings that lag or lead, a vertical that gravity is not along, and single contact sensors.

    The number is what the best URDF near the given one leaves unexplained without any of these, in
    `UNMODELLED_FORCE_SHARE` of the forces; infinite where nothing could be compared.

    Args:
        filtered: the log.
        derived: how names of fields begin that were not recorded.
    """
    log, model = filtered.log, filtered.model
    try:
        lags = fit_lags(filtered, derived)
        tilt = fit_tilt(filtered) if not "base_quat_xyzw".startswith(derived) else None
        sensors = fit_contact_sensors(filtered)
    except InputError:  # reported by `check_forces_against_urdf`
        return [], np.inf
    unexplained = min((x.without for x in (lags, tilt) if x is not None), default=np.inf)
    moved = [*(() if lags is None else lags.findings(model.declared, log)), *_tilt_findings(tilt, model)]
    return moved or list(_contact_sensor_findings(sensors, log, model)), unexplained


def check_tilt(samples: Sequence[Samples], model: NominalModel) -> Iterator[Finding]:
    """A finding about a vertical that gravity is not along, in filtered logs of a robot."""
    yield from _tilt_findings(_tilt_of(DeviationRows.of(some_samples(samples, COMPARED_SAMPLES), model), model), model)


def check_torque_offsets(filtered: FilteredLog) -> Iterator[Finding]:
    """Findings about single joints whose torque reads too much by a constant, for logs that nothing else is wrong with.

    Args: as `check_lag_and_tilt`.
    """
    with suppress(InputError):  # reported by `check_forces_against_urdf`
        yield from _offset_findings(fit_torque_offsets(filtered), filtered.log, filtered.model)


def _tilt_findings(tilt: Deviation | None, model: NominalModel) -> Iterator[Finding]:
    if tilt is not None and np.linalg.norm(tilt.value) > np.radians(MIN_TILT_DEG) and tilt.is_clear:
        robot, (x, y) = model.robot, np.degrees(tilt.value)
        of = "the base's own" if robot.fixed_base else "the world's"
        text = f"gravity is {np.hypot(x, y):.2g} degrees from down ({x:.2g} and {y:.2g} about {of} x and y axes)"
        field = "base" if robot.fixed_base else "base_quat_xyzw"
        advice = "check the mounting of the base" if robot.fixed_base else "check that the world's z axis points up"
        severity, advice = SUSPICIOUS, f"{advice}, or set robot.base_tilt: auto"
        if model.declared.finds_tilt:
            severity, advice = NOTE, "nothing: robot.base_tilt: auto finds it"
        yield Finding("tilt", severity, field, f"{text}: {tilt.gain}", advice)


def _offset_findings(found: Deviation | None, log: Log, model: NominalModel) -> Iterator[Finding]:
    if found is None:
        return
    robot = model.robot
    for joint in np.flatnonzero(found.clear & (np.abs(found.value) > _MIN_OFFSET_SHARE * _torque_rms(log))):
        name, offset, std = robot.joint_names[joint], found.value[joint], found.spread[joint]
        unit = "N" if name in robot.sliding else "N m"
        text = f"{name}: torques read {abs(offset):.3g} +- {std:.2g} {unit} too {'much' if offset > 0.0 else 'little'}"
        advice = "check the zero of the sensor, or set sensors.offsets: {joint_torque: log}"
        yield Finding("offset", SUSPICIOUS, "joint_torque", f"{text}: {found.gain}", advice, (name,))


def _contact_sensor_findings(found: Deviation | None, log: Log, model: NominalModel) -> Iterator[Finding]:
    """Findings about single contact sensors; what all have in common is a payload, or the robot's masses."""
    if found is None:
        return
    value, spread, clear = (x.reshape(-1, 4) for x in (found.value, found.spread, found.clear))
    common = value[np.argmin(np.abs(value[:, 0])), 0]
    for contact, (gain, *turn), std, is_clear in zip(model.contacts, value, spread[:, 0], clear, strict=True):
        size = float(np.linalg.norm(turn))
        angle = float(np.degrees(np.arctan2(size, 1.0 + gain)))
        if is_clear[1:].any() and angle > _MIN_TURN_DEG:
            axis = ", ".join(f"{x:.2g}" for x in np.round(np.array(turn) / size, 2))
            name, problem = "frame", f"turned by {angle:.2g} degrees about ({axis})"
            advice = "check how the sensor is mounted, and the frame that its readings are given in"
        elif is_clear[0] and abs(gain - common) > _MIN_SENSOR_GAIN:
            name, problem = ("scale", "") if gain > -1.0 else ("sign", "reversed; ")
            problem += f"times {1.0 + gain:.3g} +- {std:.2g}"
            advice = "check the sensor's sign, gain and unit, and whether these readings are another foot's"
        else:
            continue
        text = f"{contact.frame}: forces fit the {model.robot.format} best {problem}: {found.gain}"
        yield Finding(name, SUSPICIOUS, log.contact_wrench_field, text, advice, (contact.frame,))


def fit_contact_sensors(filtered: FilteredLog) -> Deviation | None:
    """By how much each contact's wrench is more than is read, and turned, (4 C,): a share, and three angles' sines.

    The axes are those of the readings. A turn about an axis across the forces takes the share cos - 1 beside it. None
    where no wrench was measured.

    Raises:
        InputError: as `fit_lags`.
    """
    contacts = filtered.model.contacts
    if filtered.log.contact_wrench is None or not contacts:
        return None

    @torch.no_grad()
    def columns(builder: RowBuilder, part: Samples, number: int) -> FloatArray:
        if part.wrench is None:
            return np.zeros((len(part), builder.tree.n_rows, 4 * len(contacts)))
        kinematics, J = builder.kinematics(part), builder.contact_jacobian(part)
        read = torch.nan_to_num(part.wrench * part.active[..., None])
        force_and_moment, axes = read.reshape(*read.shape[:2], 2, 3), torch.eye(3, dtype=read.dtype)
        turned = [torch.cross(axis.expand_as(force_and_moment), force_and_moment, dim=-1) for axis in axes]
        changes = [replace(part, wrench=x.reshape(read.shape)) for x in (read, *turned)]
        chunks = [replace(kinematics, samples=change) for change in changes]
        wrenches = [(k, builder.recorded_wrench(chunk, k)) for k in range(len(contacts)) for chunk in chunks]
        return np.stack([torch.einsum("nwv,nw->nv", J[:, k], w).numpy() for k, w in wrenches], axis=2)

    return fit_deviation(filtered.rows, columns, _SENSOR_PRIOR_STD)


def fit_torque_offsets(filtered: FilteredLog) -> Deviation | None:
    """By how much each joint's torque is less than is read, (n,) [N m or N]; None where no torque was measured.

    Raises:
        InputError: as `fit_lags`.
    """
    log, robot = filtered.log, filtered.model.robot
    if log.joint_torque is None:
        return None

    def columns(builder: RowBuilder, part: Samples, number: int) -> FloatArray:
        constant = np.zeros((builder.tree.n_rows, robot.n))
        constant[builder.tree.base_rows + np.arange(robot.n), np.arange(robot.n)] = -1.0
        return np.broadcast_to(constant, (len(part), *constant.shape))

    return fit_deviation(filtered.rows, columns, _OFFSET_PRIOR_SHARE * _torque_rms(log) or 1.0, offsets=robot.n)


def _torque_rms(log: Log) -> float:
    """Of all joints' torques [N m or N]; 0 where none was measured."""
    torque = np.zeros(0) if log.joint_torque is None else log.joint_torque
    return float(np.sqrt(np.nanmean(np.square(torque)))) if np.isfinite(torque).any() else 0.0


def fit_tilt(filtered: FilteredLog) -> Deviation | None:
    """By how much gravity is turned about x and y from where the log says it is, (2,) [rad].

    The axes are the world's, of a fixed base its own. None where no force was measured, or an IMU felt gravity.

    Raises:
        InputError: as `fit_lags`.
    """
    if filtered.log.imu_specific_force is not None and not filtered.model.robot.fixed_base:
        return None
    return _tilt_of(filtered.rows, filtered.model)


def _tilt_of(rows: DeviationRows | None, model: NominalModel) -> Deviation | None:
    return fit_deviation(rows, tilt_columns(model), _TILT_PRIOR_STD_RAD)


def tilt_columns(model: NominalModel) -> UnknownColumns:
    """Columns of tilts about x and y: what the forces that are required lose for each unit of an angle."""

    def columns(builder: RowBuilder, part: Samples, number: int) -> FloatArray:
        phi = model.robot.nominal.flatten()[None]
        level = force_series(builder, part, phi)[1][0]
        turned = [force_series(builder, _turned(part, axis), phi)[1][0] for axis in range(2)]
        return np.stack([level - one for one in turned], axis=2) / _SMALL_ANGLE

    return columns


def _turned(samples: Samples, axis: int) -> Samples:
    """Samples in which gravity is turned by a small angle about an axis of the world, or of a fixed base."""
    base, angle = samples.base, _SMALL_ANGLE * np.eye(3)[axis]
    if base.specific_force is None or base.rotation is None:
        return replace(samples, base=base.tilted(-angle[:2], len(samples)))
    change = base.specific_force.new_tensor(np.cross(angle, GRAVITY_WORLD))
    return replace(samples, base=replace(base, specific_force=base.specific_force - change @ base.rotation))
