"""Mistakes with a size, such as an offset or a lag: their columns in the force equations, and their findings.

A kind is one row of `kinds`: unknowns with their columns, estimated together with small changes of the URDF. All kinds
use the same equations and one rule; the finding names the kind that explains the forces best.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from torchid.errors import join_names
from torchid.log_checks.equations import (
    FACTOR_TOLERANCE_RATIO,
    MIN_UNEXPLAINED_RATIO,
    Estimate,
    Explanation,
    FilteredLog,
    ForceEquations,
    Kind,
    NominalModel,
    bind_some_samples,
    equations_of,
    explain,
    some_samples,
)
from torchid.log_checks.findings import NOTE, REJECTED, SUSPICIOUS, Finding
from torchid.log_checks.mistakes import possible_mistakes
from torchid.logs import Log
from torchid.logs.log import SHAPES, WRENCHES, BoolArray, FloatArray
from torchid.logs.segments import with_delayed
from torchid.logs.units import advise_units, units_of_ratio
from torchid.parameters import MASS, mass_com_inertia
from torchid.problem import Samples
from torchid.regressor.kinematics import GRAVITY_WORLD
from torchid.robot import Robot
from torchid.robot.urdf import position_limits

#: Kinds that leave as much as the best one, up to this ratio: the one with the fewest unknowns is named.
_ALIKE_RATIO = 1.1
#: Unexplained forces below which kinds leave as much: half a percent of the forces.
_MIN_LEFT = 0.1
#: Gain of a torque or a contact's sensor that is reported; of all torques where nothing says what the robot weighs.
MIN_GAIN_RATIO = 1.15
MIN_COMMON_GAIN_RATIO = 1.3
#: Size of the torques that the URDF needs over that of the readings, from which on they are compared with the former.
_MIN_SHORTFALL = 3.0
#: Factor of a torque up to which its readings are corrected before it is told from 0.
_MAX_SMALL_GAIN = 0.1
#: Lag up to which a log is corrected by it, and share of its shortest piece.
_MAX_LAG_S = 0.5
_MAX_LAG_SHARE = 0.25
#: Prior of the factor of all wrenches: of kN to N.
_MAX_UNIT_RATIO = 1e3
#: Offset of a torque over the rms of all torques: those of good sensors are 0.08 of it.
MIN_OFFSET_SHARE = 0.1
#: Zero of a hinge [rad] or slide [m], tilt of gravity and turn of a sensor [rad], shift of the point of wrenches [m].
MIN_ZERO = 0.05
MIN_TILT = 0.1
MIN_TURN = 0.17
MIN_SHIFT_M = 0.03
#: Lag that is reported: filters of sensors are late by 10 ms.
MIN_LAG_S = 0.025
#: Change of a lag over the log that is reported.
MIN_LAG_CHANGE_S = 0.01
#: Distance from a limit, over a joint's range, that is at the stop: URDFs have them to a hundredth.
_STOP_MARGIN_SHARE = 0.01
#: Compared samples at a stop that are needed.
_MIN_AT_STOP = 5
#: Share of gravity that torques lack if a controller has compensated it, by masses of its own.
ALL_OF_GRAVITY = (0.75, 1.25)
#: How far the share of a change that explains the forces best may be from 1.
_SHARE_TOLERANCE = 0.3
#: What the best URDF near the given one leaves of the forces, in `UNMODELLED_FORCE_SHARE` of these, from which on usual
#: mistakes are tried. Robots that walk and arms 15 % unlike their URDF, with friction and noise, leave 0.1 to 0.4,
#: mistakes 0.6 to 70.
MIN_UNEXPLAINED = 0.5
#: Fields that change no motion.
READINGS = ("joint_torque", *WRENCHES)
_SMALL = 1e-4
_OF_BASE = ("base_", "imu_")
_OF_JOINTS = ("joint_position", "joint_velocity", "joint_acceleration")


def best_explanation(filtered: FilteredLog, derived: tuple[str, ...] = ()) -> Explanation | None:
    """The kind of mistake that explains the forces best, if its correction helps much.

    The finding also names kinds that explain as much.

    Args:
        filtered: the log.
        derived: prefixes of fields that torchid computed.

    Raises:
        InputError: the log cannot be filtered, or does not match the robot.
    """
    equations = filtered.equations
    if equations is None:
        return None
    trials = [explain(equations, kind) for kind in kinds(filtered, equations, derived)]
    explanations = [trial for trial in trials if trial is not None]
    least = min((explanation.left for explanation in explanations), default=0.0)
    alike = [explanation for explanation in explanations if explanation.left <= max(_ALIKE_RATIO * least, _MIN_LEFT)]
    if not alike:
        return None
    best = min(alike, key=lambda explanation: (explanation.count, explanation.left))
    others = [
        other.findings[0].found
        for other in explanations
        if other.left < MIN_UNEXPLAINED_RATIO * best.left
        and other.count <= best.count
        and other.findings[0].field not in {finding.field for finding in best.findings}
    ]
    first, *more = best.findings
    also = "".join(f". As likely: {text}" for text in others)
    ratio = equations.unexplained / max(best.left, 1e-9)
    found_text = f"{first.found}{also}; correcting this makes unexplained forces {ratio:.2g} times smaller"
    return replace(best, findings=[replace(first, found=found_text), *more])


# ------------------------------------------------------------------------------------------------------- table of kinds


def kinds(filtered: FilteredLog, equations: ForceEquations, derived: tuple[str, ...]) -> Iterator[Kind]:
    """All kinds of mistakes that forces can show."""
    log = filtered.log
    model = filtered.model
    torque = log.joint_torque
    measured = torque is not None and np.isfinite(torque).any()
    if measured:
        yield from _torque_kinds(log, equations)
    if log.contact_wrench is not None and model.contacts:
        yield from _contact_kinds(log, equations)
    if (usual := _readings_kind(filtered, equations)) is not None:
        yield usual
    if measured and model.is_bolted_arm:
        yield _gravity_kind(equations)
        yield _zero_kind(equations)
    if measured and (stops := _stop_kind(log, equations)) is not None:
        yield stops
    has_gravity_sensor = log.imu_specific_force is not None and not model.robot.fixed_base
    if not has_gravity_sensor and not "base_quat_xyzw".startswith(derived or ("-",)):
        yield tilt_kind(equations)
    yield from _lag_kinds(filtered, equations, derived)


def _torque_kinds(log: Log, equations: ForceEquations) -> Iterator[Kind]:
    """Factors, exchanges, and offsets of joint torques."""
    robot = equations.model.robot
    readings = equations.builder.recorded_torque(equations.samples)[:, : robot.n].numpy()
    known = np.flatnonzero((equations.builder.sensors.torque & ~robot.is_passive)[: robot.n])
    unit = np.zeros((equations.builder.tree.n_rows, len(known)))
    unit[equations.builder.tree.base_rows + known, np.arange(len(known))] = 1.0
    names = [robot.joint_names[joint] for joint in known]
    gains = unit * readings[:, None, known]
    rms = float(np.sqrt(np.square(readings[:, known]).mean())) if len(known) else 1.0
    scaled = [_has_declared_scale(equations, int(joint)) for joint in known]
    weighed = bool(equations.builder.sensors.wrench[:, :3].all()) and len(equations.model.contacts) > 0
    ratio = MIN_GAIN_RATIO if weighed and not robot.fixed_base else MIN_COMMON_GAIN_RATIO

    def all_alike(_: Sequence[int], estimate: Estimate) -> list[Finding]:
        return [_common_gain(1.0 + float(estimate.value[0]), float(estimate.spread[0]), robot)]

    common = gains.sum(axis=2, keepdims=True)
    is_large = _is_reverse if any(scaled) else lambda x: _beyond(x, ratio)
    shortfall = equations.torque_ratio()
    weighted = equations
    if shortfall > _MIN_SHORTFALL:  # else errors of the URDF count as small beside readings that are too small
        model = replace(equations.model, torque_ratio=shortfall)
        weighted = ForceEquations.of(equations.samples, model) or equations
    yield Kind(common, max(2.0, shortfall), is_large, all_alike, bounded=True, equations=weighted)
    if len(known) > 1:

        def single(which: Sequence[int], estimate: Estimate) -> list[Finding]:
            return _single_gains([names[k] for k in which], 1.0 + estimate.value, estimate.spread, robot)

        def rescaled(x: FloatArray) -> tuple[ForceEquations, FloatArray] | None:
            """Readings that are far too large count for little: others, of the right size, count for more."""
            torque = equations.samples.torque
            if torque is None or np.abs(1.0 + x).min() > _MAX_SMALL_GAIN:
                return None
            factor = np.ones(torque.shape[1])
            factor[known] = 1.0 + x
            noise = np.abs(factor[: robot.n]) * equations.model.reading_noise
            samples = replace(equations.samples, torque=torque * torch.from_numpy(factor))
            at = ForceEquations.of(samples, replace(equations.model, reading_noise=noise))
            return None if at is None else (at, gains)

        yield Kind(gains, 10.0, lambda x: _beyond(x, MIN_GAIN_RATIO), single, rescaled, bounded=True)
        pairs = list(itertools.combinations(range(len(known)), 2))
        first, second = np.array(pairs).T
        change = (unit[:, first] - unit[:, second]) * (readings[:, known[second]] - readings[:, known[first]])[:, None]

        def exchanged(which: Sequence[int], _: Estimate) -> list[Finding]:
            pair = tuple(names[k] for k in pairs[which[0]])
            text = f"{join_names(pair)} exchanged"
            advice = "give torques in the order of joint_names"
            return [Finding("unit, sign or frame", REJECTED, "joint_torque", text, advice, pair)]

        yield Kind(change, 1.0, _is_whole, exchanged, single=True, constants=False)
    units = ["N" if name in robot.sliding else "N m" for name in names]
    constant = np.broadcast_to(-unit, gains.shape)
    prior = 0.5 * rms
    least = MIN_OFFSET_SHARE * rms
    advice = "check the zero of the sensor, or set sensors.offsets: {joint_torque: log}"

    def offsets(which: Sequence[int], estimate: Estimate) -> list[Finding]:
        out = []
        for k, x, std in zip(which, estimate.value, estimate.spread, strict=True):
            text = (
                f"{names[k]}: torques read {abs(x):.3g} +- {std:.2g} {units[k]} too {'much' if x > 0.0 else 'little'}"
            )
            out.append(Finding("offset", SUSPICIOUS, "joint_torque", text, advice, (names[k],)))
        return out

    yield Kind(constant, prior, lambda x: np.abs(x) > least, offsets, constants=False)


def _readings_kind(filtered: FilteredLog, equations: ForceEquations) -> Kind | None:
    """Usual mistakes of torques and wrenches only; the column of each is the whole change by its correction."""
    model = filtered.model
    possible = possible_mistakes(filtered.log, filtered.model.robot)
    mistakes = [mistake for mistake in possible if mistake.field in READINGS]
    if not mistakes or equations.unexplained < MIN_UNEXPLAINED:
        return None
    acting = _acting(equations, equations.samples)
    columns = []
    for mistake in mistakes:
        corrected = [mistake.correct(piece) for piece in filtered.pieces]
        samples = bind_some_samples(corrected, model.robot, model.contacts)
        columns.append(_acting(equations, samples) - acting)

    def findings(which: Sequence[int], _: Estimate) -> list[Finding]:
        mistake = mistakes[which[0]]
        return [Finding("unit, sign or frame", REJECTED, mistake.field, mistake.description, mistake.advice)]

    return Kind(np.stack(columns, axis=2), 1.0, _is_whole, findings, single=True)


def _has_declared_scale(equations: ForceEquations, joint: int) -> bool:
    return any(extra.what == "scale" and joint in extra.dofs for extra in equations.builder.extras)


def _is_reverse(x: FloatArray) -> BoolArray:
    """Which gains less 1 are those of reversed readings."""
    return np.asarray((1.0 + x < -1.0 / FACTOR_TOLERANCE_RATIO) & (1.0 + x > -FACTOR_TOLERANCE_RATIO))


def _is_whole(x: FloatArray) -> BoolArray:
    """Which shares (k,) of a change are about 1."""
    return np.asarray(np.abs(x - 1.0) < _SHARE_TOLERANCE)


def _beyond(x: FloatArray, ratio: float) -> BoolArray:
    """Which gains less 1 are larger than a ratio, or smaller than its inverse."""
    return np.asarray((x > ratio - 1.0) | (x < 1.0 / ratio - 1.0))


def _common_gain(gain: float, spread: float, robot: Robot) -> Finding:
    text = f"all torques: the {robot.format} fits best with a factor of {gain:.3g} +- {spread:.2g}"
    if _is_reverse(np.array(gain - 1.0)):
        advice = "reverse them. An upside-down base looks the same: give base_quat to exclude it"
        return Finding("unit, sign or frame", REJECTED, "joint_torque", f"all reversed: {text}", advice)
    scales = "set sensors.scales: {joint_torque: all}"
    if units := units_of_ratio(1.0 / gain, ("torque",)) if gain > 0.0 else ():
        advice = f"{advise_units({'joint_torque': units})}, or multiply by {gain:.4g}; for motor currents {scales}"
        return Finding("unit, sign or frame", REJECTED, "joint_torque", f"in {' or '.join(units)}: {text}", advice)
    advice = f"check units, gear ratios, torque constants, contact forces and the {robot.format}'s masses, or {scales}"
    return Finding("scale", SUSPICIOUS, "joint_torque", text, advice)


def _single_gains(names: Sequence[str], gain: FloatArray, spread: FloatArray, robot: Robot) -> list[Finding]:
    units = dict[str, tuple[str, str]]()
    for name, x in zip(names, gain, strict=True):
        expected = "N" if name in robot.sliding else "N m"
        near = [
            k for k, f in (("m", 1e-3), ("k", 1e3)) if abs(np.log(max(x / f, 1e-9))) < np.log(FACTOR_TOLERANCE_RATIO)
        ]
        units |= {name: (near[0] + expected, expected)} if near else {}
    of_unknown_scale = [
        name for name, x in zip(names, gain, strict=True) if name not in units and not _is_reverse(np.array(x - 1.0))
    ]
    out = []
    for name, x, std in zip(names, gain, spread, strict=True):
        text = f"the {robot.format} fits best with a factor of {x:.3g} +- {std:.2g}"
        if _is_reverse(np.array(x - 1.0)):
            hangs = ", or set robot.base_tilt if the base is not upright" if robot.fixed_base else ""
            kind = "sign"
            severity = REJECTED
            text = f"reversed; {text}"
            advice = f"reverse these torques{hangs}"
        elif name in units:
            given, expected = units[name]
            kind = "unit"
            severity = REJECTED
            text = f"in {given}; {text}"
            advice = f"give {'forces' if expected == 'N' else 'torques'} in {expected}"
        else:
            advice = f"check gear ratio, torque constant, unit, and the {robot.format}'s friction and inertias there,"
            advice += f" or set sensors.scales: {{joint_torque: [[{', '.join(of_unknown_scale)}]]}}"
            kind = "scale"
            severity = SUSPICIOUS
        out.append(Finding(kind, severity, "joint_torque", f"{name}: {text}", advice, (name,)))
    return out


def _contact_kinds(log: Log, equations: ForceEquations) -> Iterator[Kind]:
    """Gain and turn of each contact's sensor, a factor of all of them, and the point that their moments are about."""
    columns, shifts = _contact_columns(equations)
    robot = equations.model.robot
    field = log.contact_wrench_field
    if "contact_force" not in equations.model.declared.terms.scales:
        everything = columns[..., ::4].sum(axis=2, keepdims=True)
        yield Kind(
            everything,
            _MAX_UNIT_RATIO,
            lambda x: _beyond(x, 2.0),
            lambda _, estimate: _common_wrench(estimate, robot, field),
        )
        frames = [contact.frame for contact in equations.model.contacts]
        least = np.array([MIN_GAIN_RATIO - 1.0, *3 * [np.sin(MIN_TURN)]])
        yield Kind(
            columns,
            0.5,
            lambda x: np.abs(x) > np.resize(least, len(x)),
            lambda which, estimate: _single_wrenches([frames[k // 4] for k in which[::4]], estimate, robot, field),
            together=4,
        )
    if equations.builder.sensors.wrench.all():
        yield Kind(
            shifts,
            0.3,
            lambda x: np.abs(x) > MIN_SHIFT_M,
            lambda _, estimate: [_point(estimate.value, log, robot)],
            together=3,
        )


@torch.no_grad()
def _contact_columns(equations: ForceEquations) -> tuple[FloatArray, FloatArray]:
    """Columns of each contact's gain and turn about three axes, 4 C, and of shifts of the point along three axes.

    A turn about an axis across the forces takes the share cos - 1 beside it.
    """
    samples = equations.samples
    builder = equations.builder
    contacts = equations.model.contacts
    if samples.wrench is None:
        shape = equations.W.shape[:2]
        return np.zeros((*shape, 4 * len(contacts))), np.zeros((*shape, 3))
    kinematics = builder.kinematics(samples)
    J = builder.contact_jacobian(samples)
    read = torch.nan_to_num(samples.wrench * samples.active[..., None])
    halves = read.reshape(*read.shape[:2], 2, 3)
    axes = torch.eye(3, dtype=read.dtype)
    turned = [torch.cross(axis.expand_as(halves), halves, dim=-1).reshape(read.shape) for axis in axes]
    columns = []
    shifts = torch.zeros(len(samples), builder.tree.n_rows, 3, dtype=read.dtype)
    for k in range(len(contacts)):
        chunks = [replace(kinematics, samples=replace(samples, wrench=x)) for x in (read, *turned)]
        wrenches = [builder.recorded_wrench(chunk, k) for chunk in chunks]
        columns += [torch.einsum("nwv,nw->nv", J[:, k], wrench) for wrench in wrenches]
        force = wrenches[0][:, :3]
        for number, axis in enumerate(axes):
            moment = torch.cross(axis.expand_as(force), force, dim=-1)
            shifts[..., number] += torch.einsum("niv,ni->nv", J[:, k, 3:], moment)
    return torch.stack(columns, dim=2).numpy(), shifts.numpy()


def _common_wrench(estimate: Estimate, robot: Robot, field: str) -> list[Finding]:
    gain = 1.0 + float(estimate.value[0])
    text = f"all wrenches: the {robot.format} fits best with a factor of {gain:.3g} +- {estimate.spread[0]:.2g}"
    if _is_reverse(np.array(gain - 1.0)):
        advice = "reverse the wrenches: give what the ground exerts on the robot"
        return [Finding("unit, sign or frame", REJECTED, field, f"all reversed: {text}", advice)]
    units = units_of_ratio(1.0 / gain, ("force",)) if gain > 0.0 else ()
    advice = f"convert forces to N and moments to N m: multiply by {gain:.4g}"
    named = f"in {' or '.join(units)}: {text}"
    return [Finding("unit, sign or frame", REJECTED, field, named, advice)] if units else []


def _single_wrenches(frames: Sequence[str], estimate: Estimate, robot: Robot, field: str) -> list[Finding]:
    out = []
    for name, (x, *turn), std in zip(frames, estimate.value.reshape(-1, 4), estimate.spread[::4], strict=True):
        size = float(np.linalg.norm(turn))
        gain = 1.0 + float(x)
        angle = float(np.arctan2(size, gain))
        fits = f"{name}: the {robot.format} fits best"
        if gain > 0.0 and angle > MIN_TURN:
            axis = ", ".join(f"{y:.2g}" for y in np.round(np.array(turn) / size, 2))
            kind = "frame"
            text = f"{fits} if forces are turned by {np.degrees(angle):.2g} degrees about ({axis})"
            advice = "check the sensor's mounting and the frame of its readings"
        else:
            kind = "scale" if gain > 0.0 else "sign"
            text = f"{fits} with a factor of {gain:.3g} +- {std:.2g} on its forces"
            advice = "check the sensor's sign, gain and unit, and whether the readings belong to another foot"
        out.append(Finding(kind, SUSPICIOUS, field, text, advice, (name,)))
    return out


def _point(shift: FloatArray, log: Log, robot: Robot) -> Finding:
    at = ", ".join(f"{1e3 * x:.0f}" for x in shift)
    text = f"the {robot.format} fits best with moments about a point at {at} mm in the contact frames"
    advice = "give moments about the contact frame's origin, or name the sensor's own frame as the contact"
    if log.moments_about_world_origin:
        advice = "check the reference points of moments, the positions of force plates, and the base's position"
    severity = SUSPICIOUS
    if _is_centre_of_base(log, robot, float(np.linalg.norm(shift))):
        severity = NOTE
        advice = f"nothing if the base's centre of mass may have this error; else {advice}"
    return Finding("point", severity, log.contact_wrench_field, text, advice)


def _is_centre_of_base(log: Log, robot: Robot, shift: float) -> bool:
    """Whether a wrong centre of mass of the base explains the point of wrenches that act only on the base (a drone).

    Both change weight and inertia alike; the error of a centre of mass is below the body's radius of gyration.
    """
    mass, _, inertia = mass_com_inertia(robot.nominal[0])
    if mass <= 0.0 or any(robot.link(frame)[0] for frame in log.contact_names):
        return False
    gyration = np.sqrt(0.5 * np.trace(inertia) / mass)
    return bool(shift * robot.nominal[:, MASS].sum() / mass < gyration)


def _gravity_kind(equations: ForceEquations) -> Kind:
    """Share of the gravity torques that is missing in the readings."""
    samples = equations.samples
    zero = torch.zeros_like(samples.joint_velocity)
    still = replace(samples, joint_velocity=zero, joint_acceleration=zero)

    def findings(_: Sequence[int], estimate: Estimate) -> list[Finding]:
        percent = f"{100.0 * estimate.value[0]:.0f} +- {100.0 * estimate.spread[0]:.0f} %"
        text = f"torques lack {percent} of gravity. Did a controller subtract it?"
        advice = "record torques before gravity is subtracted, or add what was subtracted"
        return [Finding("gravity", REJECTED, "joint_torque", text, advice)]

    low, high = ALL_OF_GRAVITY
    columns = equations.required_of(still)[..., None]
    return Kind(columns, 1.0, lambda x: (x > low) & (x < high), findings)


def _stop_kind(log: Log, equations: ForceEquations) -> Kind | None:
    """Forces of joints against limits that they reach at times; None if they reach none."""
    robot = equations.model.robot
    samples = equations.samples
    limits = position_limits(robot.path) if robot.format == "URDF" else {}
    columns = list[FloatArray]()
    pushed = list[tuple[str, float]]()
    for joint, name in enumerate(robot.joint_names):
        low, high = limits.get(name, (0.0, 0.0))
        for side, limit in ((-1.0, low), (1.0, high)) if high > low else ():
            beyond = side * (samples.joint_position[:, joint].numpy() - limit)
            reached = beyond > -_STOP_MARGIN_SHARE * (high - low)
            if _MIN_AT_STOP <= reached.sum() < 0.5 * len(reached):
                column = np.zeros(equations.W.shape[:2])
                column[reached, equations.builder.tree.base_rows + joint] = -side
                columns.append(column)
                pushed.append((name, limit))

    def findings(which: Sequence[int], estimate: Estimate) -> list[Finding]:
        advice = "exclude these samples, or record motion within the limits: the model has no joint stops"
        out = []
        for number, x, std in zip(which, estimate.value, estimate.spread, strict=True):
            name, limit = pushed[number]
            force, length = ("N", "m") if name in robot.sliding else ("N m", "rad")
            text = f"{name} pushes against its limit of {limit:.3g} {length} with {x:.2g} +- {std:.1g} {force}"
            out.append(Finding("stop", SUSPICIOUS, "joint_position", text, advice, (name,)))
        return out

    rms = np.sqrt(np.nanmean(np.square(np.asarray(log.joint_torque))))
    return Kind(np.stack(columns, axis=2), rms, lambda x: x > 0.0, findings, steady=False) if columns else None


def _zero_columns(equations: ForceEquations) -> FloatArray:
    """Decrease of the required forces per unit of each joint's position."""
    samples = equations.samples
    level = equations.required
    out = []
    for step in _SMALL * torch.eye(equations.model.robot.n, dtype=samples.joint_position.dtype):
        moved = replace(samples, joint_position=samples.joint_position + step)
        out.append((level - equations.required_of(moved)) / _SMALL)
    return np.stack(out, axis=2)


def _zero_kind(equations: ForceEquations) -> Kind:
    """Error of the joints' zeros: true positions less the readings [rad or m]."""
    samples = equations.samples
    robot = equations.model.robot

    def moved(x: FloatArray) -> tuple[ForceEquations, FloatArray] | None:
        if np.abs(x).max() > 2.0 * np.pi:
            return None
        at = replace(samples, joint_position=samples.joint_position + torch.from_numpy(x))
        other = ForceEquations.of(at, equations.model)
        return None if other is None else (other, _zero_columns(other))

    def findings(which: Sequence[int], estimate: Estimate) -> list[Finding]:
        advice = "check the encoder's zero, and whether the robot's file has its zero at the same posture"
        out = []
        for joint, x, std in zip(which, estimate.value, estimate.spread, strict=True):
            name = robot.joint_names[joint]
            unit = "m" if name in robot.sliding else "rad"
            text = f"{name}: positions read {abs(x):.2g} +- {std:.1g} {unit} too {'much' if x < 0.0 else 'little'}"
            out.append(Finding("zero", SUSPICIOUS, "joint_position", text, advice, (name,)))
        return out

    return Kind(_zero_columns(equations), 0.2, lambda x: np.abs(x) > MIN_ZERO, findings, moved)


def tilt_kind(equations: ForceEquations) -> Kind:
    """Rotation of gravity about x and y of the world, or of a fixed base, against the log."""
    samples = equations.samples
    model = equations.model
    level = equations.required
    columns = np.stack([level - equations.required_of(_turned(samples, axis)) for axis in range(2)], axis=2) / _SMALL
    fixed = model.robot.fixed_base
    robot = model.robot

    def findings(_: Sequence[int], estimate: Estimate) -> list[Finding]:
        x, y = np.degrees(estimate.value)
        axes = "the base's own" if fixed else "the world's"
        text = f"gravity is {np.hypot(x, y):.2g} degrees from down ({x:.2g} and {y:.2g} about {axes} x and y axes)"
        advice = "check the mounting of the base" if fixed else "check that the world's z axis points up"
        severity = SUSPICIOUS
        advice = f"{advice}, or set robot.base_tilt: auto"
        if model.declared.finds_tilt:
            severity = NOTE
            advice = "nothing: robot.base_tilt: auto finds it"
        return [Finding("tilt", severity, "base" if robot.fixed_base else "base_quat_xyzw", text, advice)]

    return Kind(columns, 0.3, lambda x: np.abs(x) > MIN_TILT, findings, together=2)


def check_tilt(samples: Sequence[Samples], model: NominalModel) -> Sequence[Finding]:
    """A finding about a tilted vertical in filtered logs of a robot."""
    equations = ForceEquations.of(some_samples(samples), model)
    explanation = None if equations is None else explain(equations, tilt_kind(equations))
    return () if explanation is None else explanation.findings


def _turned(samples: Samples, axis: int) -> Samples:
    """Samples in which gravity is turned by a small angle about an axis of the world, or of a fixed base."""
    base = samples.base
    angle = _SMALL * np.eye(3)[axis]
    if base.specific_force is None or base.rotation is None:
        return replace(samples, base=base.tilted(-angle[:2], len(samples)))
    change = base.specific_force.new_tensor(np.cross(angle, GRAVITY_WORLD))
    return replace(samples, base=replace(base, specific_force=base.specific_force - change @ base.rotation))


# ----------------------------------------------------------------------------------------------------------------- lags


@dataclass(frozen=True)
class _Clock:
    """Readings that may be late together.

    The text is `what`, later or earlier, `than`; `field` and `channels` are those of the finding; `moved`: channels of
    the fields of a log.
    """

    what: str
    than: str
    field: str
    moved: Mapping[str, slice]
    channels: tuple[str, ...] = ()


def _clocks(filtered: FilteredLog, derived: tuple[str, ...]) -> Iterator[_Clock]:
    """Readings that may be late. A lag of the joints' motion needs a third clock besides joints and forces."""
    log = filtered.log
    every = slice(None)
    has_wrench = log.contact_wrench is not None and len(filtered.model.contacts) > 0
    of_base = [name for name in log.arrays() if name.startswith(_OF_BASE)]
    has_base = of_base and not filtered.model.robot.fixed_base and not "base_".startswith(derived or ("-",))
    wrenches = dict.fromkeys(WRENCHES, every)
    if log.joint_torque is not None:
        yield _Clock("torques are", "the motion", "joint_torque", {"joint_torque": every})
    if has_wrench:
        for place, contact in enumerate(filtered.model.contacts):
            single = dict.fromkeys(WRENCHES, slice(place, place + 1))
            name = contact.frame
            yield _Clock(f"forces of {name} are", "the motion", log.contact_wrench_field, single, (name,))
        if len(filtered.model.contacts) > 1:
            yield _Clock("contact forces are", "the motion", log.contact_wrench_field, wrenches)
        if log.joint_torque is not None:
            both = {"joint_torque": every, **wrenches}
            yield _Clock("torques and contact forces are", "the motion", "all", both)
    if has_base:
        motion = dict.fromkeys((name for name in SHAPES if name.startswith(_OF_BASE)), every)
        yield _Clock("the base's motion is", "all else", of_base[0], motion)
        yield _Clock("the joints' motion is", "all else", "joint_position", dict.fromkeys(_OF_JOINTS, every))


def _lag_kinds(filtered: FilteredLog, equations: ForceEquations, derived: tuple[str, ...]) -> Iterator[Kind]:
    """Lags [s] of torques, contact forces, base motion and joint motion: constant, or changing over the log."""
    model = filtered.model
    time = filtered.log.time
    duration = float(np.ptp(time))
    middle = 0.5 * float(time[0] + time[-1])

    def changing(stamps: FloatArray) -> FloatArray:
        """A lag that changes by 1 s from the start of the log to its end, and is 0 in its middle."""
        return np.asarray((stamps - middle) / duration)

    def columns(pieces: Sequence[Log], at: ForceEquations, clock: _Clock, count: int) -> FloatArray:
        """Decrease of the unbalanced forces where a clock's readings are a little later."""
        samples = bind_some_samples([_earlier(piece, clock.moved) for piece in pieces], model.robot, model.contacts)
        lag = (_excess(at, at.samples) - _excess(at, samples))[..., None] / _SMALL
        return lag if count == 1 else np.concatenate([lag, lag * changing(samples.time.numpy())[:, None, None]], axis=2)

    for clock in _clocks(filtered, derived):

        def moved(x: FloatArray, clock: _Clock = clock) -> tuple[ForceEquations, FloatArray] | None:
            shortest = min(float(np.ptp(piece.time)) for piece in filtered.pieces)
            if np.abs(x).max() > min(_MAX_LAG_S, _MAX_LAG_SHARE * shortest):
                return None
            slope = x[1] if len(x) > 1 else 0.0
            pieces = [
                with_delayed(piece, -(x[0] + slope * changing(piece.time)), clock.moved) for piece in filtered.pieces
            ]
            at = equations_of(pieces, model)
            return None if at is None else (at, columns(pieces, at, clock, len(x)))

        def late(_: Sequence[int], estimate: Estimate, clock: _Clock = clock) -> list[Finding]:
            seconds = float(estimate.value[0])
            spread = 1e3 * float(estimate.spread[0])
            text = f"{clock.what} {1e3 * abs(seconds):.3g} +- {spread:.2g} ms {'later' if seconds > 0.0 else 'earlier'}"
            advice = "check their stamps and filters; shift_s corrects a late file"
            if clock.field == "joint_torque":
                delay = model.declared.known_delay - seconds
                advice = f"check their stamps and filters, or set actuators.delay: {delay:.2g}"
            return [Finding("delay", SUSPICIOUS, clock.field, f"{text} than {clock.than}", advice, clock.channels)]

        def fast(_: Sequence[int], estimate: Estimate, clock: _Clock = clock) -> list[Finding]:
            start = 1e3 * (estimate.value[0] - 0.5 * estimate.value[1])
            end = 1e3 * (estimate.value[0] + 0.5 * estimate.value[1])
            rate = 100.0 * float(estimate.value[1]) / duration
            speed = "fast" if rate > 0.0 else "slow"
            text = (
                f"{clock.what} {start:.3g} ms later than {clock.than} at the start and {end:.3g} ms at the end"
                f" (+- {1e3 * estimate.spread[1]:.2g} ms). Their clock is {abs(rate):.2g} % {speed}"
            )
            advice = "stamp all sensors with one clock, or scale the time of these to match"
            return [Finding("clock", SUSPICIOUS, clock.field, text, advice, clock.channels)]

        both = columns(filtered.pieces, equations, clock, 2)
        yield Kind(both[..., :1], 0.2, lambda x: np.abs(x) > MIN_LAG_S, late, moved)
        yield Kind(both, 0.2, _is_changing_lag, fast, moved, together=2, steady=False)


def _is_changing_lag(x: FloatArray) -> BoolArray:
    """Whether the change of a lag, the second of (2,) lags, is large enough to report."""
    return np.asarray((np.arange(len(x)) == 1) & (np.abs(x) > MIN_LAG_CHANGE_S))


def _earlier(log: Log, moved: Mapping[str, slice]) -> Log:
    """The log with some channels a little later, by their slopes."""
    arrays = log.arrays()
    out = dict[str, Any]()
    for name in (name for name in moved if name in arrays):
        out[name] = arrays[name].copy()
        out[name][:, moved[name]] += _SMALL * np.gradient(arrays[name], log.time, axis=0)[:, moved[name]]
    if (quat := out.get("base_quat_xyzw")) is not None:
        out["base_quat_xyzw"] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    return replace(log, **out)


def _excess(equations: ForceEquations, samples: Samples) -> FloatArray:
    """Forces (N, n_rows) that are required beyond those that act, where these were measured."""
    return equations.required_of(samples) - _acting(equations, samples)


@torch.no_grad()
def _acting(equations: ForceEquations, samples: Samples) -> FloatArray:
    """Generalized forces (N, n_rows) that act by what was measured."""
    builder = equations.builder
    contacts = equations.model.contacts
    base = builder.tree.base_rows
    n = equations.model.robot.n
    out = np.zeros((len(samples), builder.tree.n_rows))
    if samples.torque is not None:
        out[:, base : base + n] = np.nan_to_num(builder.recorded_torque(samples)[:, :n].numpy())
    if samples.wrench is not None and contacts:
        read = replace(samples, wrench=torch.nan_to_num(samples.wrench * samples.active[..., None]))
        kinematics = builder.kinematics(read)
        J = builder.contact_jacobian(read)
        for k in range(len(contacts)):
            wrench = builder.recorded_wrench(kinematics, k)
            out += torch.einsum("nwv,nw->nv", J[:, k], wrench).numpy()
    return out
