"""Zeros of the encoders of a bolted arm, joints that it counts the other way, and torques without gravity.

All for every URDF near the given one: masses that are 15 to 20 % off turn gravity, too, but not as another zero does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch

from torchid.errors import InputError, join_names
from torchid.log_checks.deviation import Deviation, DeviationRows, Trial, UnknownColumns, fit_deviation
from torchid.log_checks.findings import REJECTED, SUSPICIOUS, Finding
from torchid.log_checks.lag_and_tilt import fit_tilt
from torchid.log_checks.mistakes import joint_mistakes
from torchid.log_checks.model import (
    TRIAL_SAMPLES,
    NominalModel,
    bind_some_samples,
)
from torchid.log_checks.scales import TIME_SCALE_SAMPLES
from torchid.logs import Log
from torchid.logs.log import FloatArray
from torchid.problem import RowBuilder, Samples
from torchid.problem.predict import force_series

#: Zero that is reported: 3 degrees of a hinge, 3 cm of a slide. Arms are calibrated to tenths of a degree.
MIN_ZERO_DEG, MIN_ZERO_M = 3.0, 0.03
#: Prior standard deviation of zeros [rad or m], and of the share of gravity that torques lack.
_ZERO_PRIOR_STD, _GRAVITY_PRIOR_STD = 0.2, 1.0
#: Times that positions are corrected by what the slope of the forces says, which is exact for small zeros alone.
_CORRECTIONS, _LEAST_CORRECTION = 6, 2e-3
#: Share of gravity that torques lack if a controller has compensated it: all of it by masses of its own.
_ALL_OF_GRAVITY = (0.75, 1.25)
#: What another zero must leave of that which a tilt leaves: of a first joint that is level, both are one.
_BETTER_THAN_A_TILT = 0.8
#: Unexplained forces from which on joints that count the other way are tried, what one of them must leave of them.
_MIN_UNEXPLAINED, _MAX_RESIDUAL_SHARE = 1.0, 0.5
_SMALL = 1e-4


def is_bolted_arm(model: NominalModel) -> bool:
    """Whether the torques of a robot are those of its joints, of gravity and inertia alone."""
    return model.robot.fixed_base and not model.contacts and not model.robot.loops


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


def check_encoders(trial: Trial, moved: list[Finding], unexplained: float) -> list[Finding]:
    """Findings about a bolted arm's torques without gravity, zeros of encoders and joints that are reversed.

    Args:
        trial: of the log.
        moved: findings about lags and tilts, which are returned where nothing here explains the forces better.
        unexplained: what the best URDF near the given one leaves of the forces, in `UNMODELLED_FORCE_SHARE`.
    """
    model = trial.model
    if not is_bolted_arm(model) or trial.log.joint_torque is None:
        return moved
    try:
        samples = bind_some_samples(trial.pieces, model.robot, (), TIME_SCALE_SAMPLES)
        gravity = fit_missing_gravity(samples, model)
        if gravity is not None and gravity.is_clear and _ALL_OF_GRAVITY[0] < gravity.value[0] < _ALL_OF_GRAVITY[1]:
            return [_gravity_finding(gravity)]
        zeros = fit_zeros(samples, model)
        if zeros is not None and (found := list(_zero_findings(zeros, model))):
            tilt = fit_tilt(trial) if any(one.name == "tilt" for one in moved) else None
            if tilt is None or zeros.left < _BETTER_THAN_A_TILT * tilt.left:
                return [*(one for one in moved if one.name != "tilt"), *found]
            names = join_names([name for one in found for name in one.channels])
            also = f"; or the zero of {names}, which explains it as well"
            return [replace(one, advice=one.advice + also) if one.name == "tilt" else one for one in moved]
        mistaken = None if moved else _reversed_joint(trial.pieces, model, unexplained)
    except InputError:  # reported by `check_forces_against_urdf`
        return moved
    return moved if mistaken is None else [mistaken]


def _gravity_finding(found: Deviation) -> Finding:
    share = f"{100.0 * found.value[0]:.0f} +- {100.0 * found.spread[0]:.0f} %"
    text = f"torques lack {share} of gravity: a controller has compensated it? {found.gain}"
    advice = "record torques before gravity is subtracted (not those of external forces, nor commands beside gravity's)"
    return Finding("gravity", REJECTED, "joint_torque", text, f"{advice}, or add what was subtracted")


def _zero_findings(found: Deviation, model: NominalModel) -> Iterator[Finding]:
    robot = model.robot
    slides = np.array([name in robot.sliding for name in robot.joint_names], bool)
    least = np.where(slides, MIN_ZERO_M, np.radians(MIN_ZERO_DEG))
    for joint in np.flatnonzero(found.clear & (np.abs(found.value) > least)):
        name, value, spread = robot.joint_names[joint], float(found.value[joint]), float(found.spread[joint])
        unit, read = ("m" if slides[joint] else "rad"), "much" if value < 0.0 else "little"
        text = f"{name}: positions read {abs(value):.2g} +- {spread:.1g} {unit} too {read}: {found.gain}"
        advice = "check the zero of its encoder, and whether the robot's file counts from the same posture"
        yield Finding("zero", SUSPICIOUS, "joint_position", text, advice, (name,))


def _reversed_joint(pieces: Sequence[Log], model: NominalModel, unexplained: float) -> Finding | None:
    """A finding about the joint without whose mistake forces are explained; None without such a joint."""
    best, least = None, min(_MAX_RESIDUAL_SHARE * unexplained, _MIN_UNEXPLAINED)
    for mistake in joint_mistakes(pieces[0]) if unexplained > _MIN_UNEXPLAINED else ():
        corrected = [mistake.correct(piece) for piece in pieces]
        rows = DeviationRows.of(bind_some_samples(corrected, model.robot, (), TRIAL_SAMPLES), model)
        left = fit_deviation(rows, _nothing, 1.0)
        if left is not None and left.without < least:
            best, least = mistake, left.without
    if best is None:
        return None
    text = f"{best.description}: {unexplained / max(least, 1e-9):.2g} times as much is unexplained otherwise"
    return Finding("unit, sign or frame", REJECTED, best.field, text, best.advice)


def _nothing(builder: RowBuilder, part: Samples, number: int) -> FloatArray:
    """Columns of no unknown."""
    return np.zeros((len(part), builder.tree.n_rows, 1))
