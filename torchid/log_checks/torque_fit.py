"""Factors of joint torques that fit the URDF best: by the null space of the contacts, single rows, and friction."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls

from torchid.errors import join_names
from torchid.log_checks.findings import REJECTED, SUSPICIOUS, Finding, Skipped
from torchid.logs.log import BoolArray, FloatArray
from torchid.problem import RowBuilder, Samples
from torchid.problem.motion_noise import MIN_MOTION
from torchid.problem.predict import null_space_part
from torchid.robot import Robot

#: Independent part of a torque in the projected forces, over the residual, from which on its gain is determined.
MIN_SIGNAL_RATIO = 1.0
#: The same in a joint's row, where contact wrenches are known or there are none: a correlation of 0.9.
MIN_ROW_SIGNAL_RATIO = 2.0
#: Gain that no model error explains: missing friction makes up a factor of several, a gear ratio 50 to 160.
MAX_GAIN_RATIO = 10.0
#: What dry friction may carry of the largest load where a joint stands still.
MAX_FRICTION_SHARE = 0.2
#: Factors of single torques in another unit, and the tolerance of such a factor (see `MAX_GAIN_RATIO`).
TORQUE_UNIT_FACTORS = {1e-3: "in mN m", 1e3: "in kN m"}
_UNIT_TOLERANCE_RATIO = 3.0
#: How far the factor of a reversed torque may be from -1: others are no mistake of sign.
_SIGN_TOLERANCE_RATIO = 3.0
#: Smaller singular values, over the largest, are raised to this share: the data do not determine such combinations.
_MIN_SINGULAR_VALUE_SHARE, _TINY = 1e-12, 1e-100


def _implausible_gains(gain: FloatArray, determined: BoolArray) -> BoolArray:
    """Which determined gains (m,) no model error explains."""
    return determined & ((gain < 0.0) | (np.abs(np.log(np.maximum(np.abs(gain), _TINY))) > np.log(MAX_GAIN_RATIO)))


@dataclass(frozen=True, eq=False)
class TorqueFit:
    """Factors of joint torques that fit the URDF best.

    Attributes:
        joints: numbers of the m joints whose torque was measured.
        gain: (m,) factor that each measured torque should be multiplied by.
        determined: (m,) bool, whether the data determine the gain.
        by_friction: (m,) bool, whether friction alone does, and only the gain's sign: it always resists the motion.
        scale: (m,) factor of torques that have an unknown one by the experiment; all else here is of torques with it.
        size: norm of the model's torques, in the null space of the contacts.
        misfit: norm of the difference between measured and model torques, over that.
        misfit_corrected: as `misfit`, with torques multiplied by their gain where that is determined and implausible.
    """

    joints: np.ndarray
    gain: FloatArray
    determined: BoolArray
    by_friction: BoolArray
    scale: FloatArray
    size: float
    misfit: float
    misfit_corrected: float

    @property
    def implausible(self) -> BoolArray:
        """Joints (m,) whose torque is reversed or off by more than `MAX_GAIN_RATIO`."""
        return _implausible_gains(self.gain, self.determined)

    @property
    def driving(self) -> BoolArray:
        """Joints (m,) whose friction would drive them."""
        return self.implausible & self.by_friction


def held_by_friction(samples: Sequence[Samples], torque: FloatArray) -> BoolArray:
    """Which joints (n,) stand still under a load that dry friction may carry: their torque (N, n) may be anything."""
    position = np.concatenate([part.joint_position.numpy() for part in samples])
    load = np.sqrt(np.square(np.nan_to_num(torque)).mean(axis=0))
    return np.asarray((np.ptp(position, axis=0) < MIN_MOTION) & (load < MAX_FRICTION_SHARE * load.max(initial=0.0)))


def fit_projected(
    builder: RowBuilder,
    samples: Sequence[Samples],
    required: FloatArray,
    torque: FloatArray,
    joints: np.ndarray,
    alike: Sequence[Sequence[int]],
) -> TorqueFit:
    """Gains by least squares in the null space of the contacts, where contact forces vanish.

    `alike`: joints that share an unknown scale.
    """
    base = builder.tree.base_rows
    passive = [row for row in builder.motors.passive if row not in joints]
    rows = [*range(base), *(base + joints), *(base + row for row in passive)]
    vectors = np.zeros((1 + len(joints), *required.shape))
    vectors[0] = required
    for index, joint in enumerate(joints):
        vectors[1 + index, :, base + joint] = torque[:, joint]
    ends = np.cumsum([len(part) for part in samples])[:-1]
    parts = np.split(vectors, ends, axis=1)
    projected = np.concatenate([null_space_part(builder, s, v) for s, v in zip(samples, parts, strict=True)], axis=1)
    projected = projected[..., rows].reshape(1 + len(joints), -1)
    y, A = projected[0], projected[1:].T
    scale = _fit_scales(y, A, [np.isin(joints, group) for group in alike])
    A = A * scale
    norms = np.linalg.norm(A, axis=0)
    norms[norms == 0.0] = 1.0
    U, values, Vh = np.linalg.svd(A / norms, full_matrices=False)
    inverse = Vh.T / np.maximum(values, max(_MIN_SINGULAR_VALUE_SHARE * values.max(initial=0.0), _TINY))
    gain = inverse @ (U.T @ y) / norms
    independent = norms / np.sqrt(np.square(inverse).sum(axis=1))  # norm of each column orthogonal to all others
    determined = independent * np.abs(gain) > MIN_SIGNAL_RATIO * np.linalg.norm(y - A @ gain)
    corrected = np.where(_implausible_gains(gain, determined), gain, 1.0)
    size = max(float(np.linalg.norm(y)), _TINY)
    misfits = (float(np.linalg.norm(y - A @ factor)) / size for factor in (np.ones(len(joints)), corrected))
    return TorqueFit(joints, gain, determined, np.zeros(len(joints), bool), scale, size, *misfits)


def _fit_scales(y: FloatArray, A: FloatArray, groups: Sequence[BoolArray]) -> FloatArray:
    """Factors (m,) of the columns of A (M, m) whose sum is nearest to y, positive, one for each group (m,), else 1."""
    scale = np.ones(A.shape[1])
    if groups:
        free = np.array(groups, float)
        best, _ = nnls(A @ free.T, y - A[:, ~np.any(groups, axis=0)].sum(axis=1))
        scale[np.any(groups, axis=0)] = (best @ free)[np.any(groups, axis=0)]
    return np.where(scale > 0.0, scale, 1.0)


def fit_single_rows(fit: TorqueFit, required: FloatArray, torque: FloatArray, velocity: FloatArray) -> TorqueFit:
    """The fit, with undetermined gains taken from the row of each joint, less the contribution of the contacts.

    Where that says nothing either, as bodies beyond are light, friction may be most of the torque and tell its sign.
    """
    gain, determined, by_friction = fit.gain.copy(), fit.determined.copy(), fit.by_friction.copy()
    for index in np.flatnonzero(~determined):
        y, x = required[:, fit.joints[index]], torque[:, fit.joints[index]]
        gain[index] = y @ x / (x @ x)
        residual = np.linalg.norm(y - gain[index] * x)
        determined[index] = abs(gain[index]) * np.linalg.norm(x) > MIN_ROW_SIGNAL_RATIO * residual
        if not determined[index] and (sign := _sign_of_friction(y, x, velocity[:, fit.joints[index]])):
            gain[index], determined[index], by_friction[index] = sign, True, True
    return replace(fit, gain=gain, determined=determined, by_friction=by_friction)


def _sign_of_friction(required: FloatArray, torque: FloatArray, velocity: FloatArray) -> float:
    """1.0 where friction is most of a torque (N,), -1.0 where that would give energy, 0.0 where it is not most of it.

    Beside it stand what the bodies require (N,), times any factor, and an offset.
    """
    terms = np.stack([np.sign(velocity), velocity, required, np.ones_like(torque)], axis=1)
    size = np.linalg.norm(terms, axis=0)
    x, *_ = np.linalg.lstsq(terms / np.where(size > 0.0, size, 1.0), torque, rcond=None)
    parts = terms / np.where(size > 0.0, size, 1.0) * x
    friction, left = parts[:, :2].sum(axis=1), torque - parts.sum(axis=1)
    others = np.linalg.norm(parts[:, 2:].sum(axis=1)) + np.linalg.norm(left)
    clear = np.linalg.norm(friction) > MIN_ROW_SIGNAL_RATIO * others
    return float(np.sign(friction @ velocity)) if clear else 0.0


def torque_findings(robot: Robot, fit: TorqueFit) -> Iterator[Finding | Skipped]:
    """Findings about single torques: sign, unit and scale."""

    def finding(name: str, severity: str, where: BoolArray, problem: str, advice: str) -> Finding:
        joints = tuple(robot.joint_names[joint] for joint in fit.joints[where])
        gains = join_names([f"{gain:.3g}" for gain in fit.gain[where]])
        text = f"{join_names(joints)}: {problem}factors that fit the {robot.format} best: {gains}"
        return Finding(name, severity, "joint_torque", text, advice, joints)

    is_reversed = fit.implausible & (fit.gain < -1.0 / _SIGN_TOLERANCE_RATIO) & (fit.gain > -_SIGN_TOLERANCE_RATIO)
    by_bodies = is_reversed & ~fit.driving
    if by_bodies.any():
        hangs = "; or robot.base_tilt, if the base is not upright" if robot.fixed_base else ""
        yield finding("sign", REJECTED, by_bodies, "reversed; ", f"reverse these torques{hangs}")
    if fit.driving.any():
        joints = tuple(robot.joint_names[joint] for joint in fit.joints[fit.driving])
        text = f"{join_names(joints)}: reversed: most of it is friction, which would drive the joint"
        advice = "reverse these torques; or positions and velocities, if these are"
        yield Finding("sign", REJECTED, "joint_torque", text, advice, joints)
    scaled = fit.implausible & ~is_reversed
    for factor, unit in TORQUE_UNIT_FACTORS.items():
        low, high = factor / _UNIT_TOLERANCE_RATIO, factor * _UNIT_TOLERANCE_RATIO
        in_unit = fit.implausible & (fit.gain > low) & (fit.gain < high)
        if in_unit.any():
            yield finding("unit", REJECTED, in_unit, f"{unit}; ", f"multiply by {factor:g}")
            scaled = scaled & ~in_unit
    if scaled.any():
        yield finding("scale", SUSPICIOUS, scaled, "", "check gear ratios, torque constants and units")
    if not fit.determined.all():
        names = join_names([robot.joint_names[joint] for joint in fit.joints[~fit.determined]])
        yield Skipped("sign of torques", f"too little in this motion but friction and noise: {names}")
