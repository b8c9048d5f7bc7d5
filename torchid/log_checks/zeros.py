"""Encoders of a bolted arm that count from another zero, for all URDFs near the given one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch

from torchid.log_checks.deviation import (
    MAX_LEFT,
    Deviation,
    DeviationRows,
    UnknownColumns,
    UnknownEquations,
    fit_deviation,
)
from torchid.log_checks.findings import SUSPICIOUS, Finding
from torchid.log_checks.lag_and_tilt import tilt_columns
from torchid.log_checks.model import NominalModel
from torchid.logs.log import FloatArray
from torchid.problem import RowBuilder, Samples
from torchid.problem.predict import force_series

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
