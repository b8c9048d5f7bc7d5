"""Lags, offsets of torques, tilts of gravity, contact sensors turned or off, for all URDFs near the given one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
import torch

from torchid.errors import InputError
from torchid.log_checks.deviation import (
    COMPARED_SAMPLES,
    Deviation,
    DeviationRows,
    FilteredLog,
    UnknownColumns,
    fit_deviation,
)
from torchid.log_checks.findings import NOTE, SUSPICIOUS, Finding
from torchid.log_checks.lags import fit_lags
from torchid.log_checks.model import (
    NominalModel,
    some_samples,
)
from torchid.logs import Log
from torchid.logs.log import FloatArray
from torchid.problem import RowBuilder, Samples
from torchid.problem.predict import force_series
from torchid.regressor.kinematics import GRAVITY_WORLD

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
        wrenches = [(k, builder.recorded_wrench(x, k, kinematics)) for k in range(len(contacts)) for x in changes]
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
