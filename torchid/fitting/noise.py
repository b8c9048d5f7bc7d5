"""The noise that weights the rows, stated or estimated, and whether a fit leaves more residual than this noise."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.special import chdtri
from torch import Tensor

from torchid import parameters
from torchid.estimators import Estimate, LeastSquares
from torchid.estimators.least_squares import residual_std
from torchid.fitting.fit import LogFitter
from torchid.identifiability.confounding import Jackknife
from torchid.logs.dry_friction import OFTEN, resting_share
from torchid.parallel import one_thread
from torchid.parameters import COULOMB, FRICTION, INERTIAL, PER_BODY, Array
from torchid.problem import LinearProblem, RowBuilder, Samples
from torchid.problem.compression import Block
from torchid.problem.extras import noise_key
from torchid.problem.metrics import Metrics
from torchid.problem.noise import (
    GroupVariances,
    LogOfOtherProcess,
    SampledRows,
    VarianceComponentEstimator,
    fitted_directions,
    noise_of_sensors,
)
from torchid.reprs import short_repr
from torchid.robot import Robot
from torchid.rounding import RANK_TOLERANCE, UNOBSERVABLE_SHARE, is_significant
from torchid.sensing import Contact, SensorNoise, SensorSet

_SETTLED = 0.05  # change of the deviation along any group's directions: weights 10 % off cost 0.2 % of efficiency
_PASSES = 6
_DIGITS = 3
_APART = 2.0  # with half of the true standard deviation, 95 % intervals contain the truth in 67 %


@dataclass(frozen=True)
class GroupNoise:
    """Noise of a joint torque, of other readings, or of base rows along an axis of the levelled base.

    `origin`: "stated", "estimated", "pooled" (estimated together with the other joints, because residuals do not
    separate them), "at most" (an upper bound, because other noise is much larger), "confounded" (residuals determine
    only its sum with other noise) or "assumed" (too few readings). `used`: standard deviation that weighted the rows.
    `residual`: that of the residuals; None if unknown.
    """

    group: str
    unit: str
    origin: str
    used: float
    residual: float | None


@dataclass(frozen=True)
class NoiseSummary:
    """The noise that weighted the rows.

    `groups`: of the sensors. `suggested`: keys of `sensors.noise` with values from the residuals, if these contradict
    the stated ones. `passes`: number of fits to a subset of the samples.
    """

    noise: SensorNoise
    groups: list[GroupNoise]
    suggested: dict[str, Any]
    passes: int

    __repr__ = short_repr

    @property
    def any_stated(self) -> bool:
        """Whether a user has stated any of it."""
        return any(group.origin == "stated" for group in self.groups)

    @property
    def known(self) -> dict[str, Any]:
        """Fields of `noise` that the sensors have a group of, with their values."""
        keys = dict.fromkeys(noise_key(group.group) for group in self.groups)
        return {key: getattr(self.noise, key) for key in keys}


def estimate_noise(
    logs: Sequence[Samples | LogOfOtherProcess],
    fitter: LogFitter,
    stated: Collection[str] = (),
    suggest: bool = True,
) -> NoiseSummary:
    """Estimate the noise of sensors by repeated fits to a subset of the samples, until the noise does not change.

    If unknown scales multiply all forces, residuals do not show the noise, and the initial guess is kept. If only some
    noise is stated, the stated values count as right up to a common factor, because the filter removes noise. Estimated
    values are given in the same proportion::

        summary = torchid.estimate_noise(logs, fitter, stated=["joint_torque"])
        summary.noise  # a SensorNoise, [N m] and [N]

    Source: variance components by iterated minimum norm estimation, see `torchid.problem.noise`.

    Args:
        logs: bound training logs; processes that share the work may each have some of them.
        fitter: of the rows; its sensors have the stated noise, and a guess where none is stated.
        stated: fields of `SensorNoise` that are stated.
        suggest: whether to check stated values too; if False and all noise is stated, nothing is fitted.
    """
    builder = fitter.builder
    guess = fitter.builder.sensors.noise
    stds = noise_of_sensors(builder)
    if not suggest and all(noise_key(name) in stated for name in stds):
        groups = [GroupNoise(name, builder.noise_groups.unit(name), "stated", std, None) for name, std in stds.items()]
        return NoiseSummary(builder.noise_groups.noise(stds, guess), groups, {}, 0)
    rows = SampledRows(logs, builder)
    if not (rows.groups and rows.chunks):
        return NoiseSummary(guess, [], {}, 0)
    tied = [name for name in rows.groups if noise_key(name) in stated]
    variance = np.ones(len(rows.groups))
    columns = None
    passes = 0
    components = GroupVariances.unknown(len(rows.groups))
    homogeneous = False
    estimator = VarianceComponentEstimator(rows, tied)
    while True:
        columns, directions, homogeneous = _fit_rows(rows, variance, columns, fitter)
        passes += 1
        if homogeneous:  # the less force, the smaller the residuals
            break
        if len(tied) == len(rows.groups):
            break
        components = estimator.estimate(variance, columns, directions)
        variance = components.variance
        if components.change < _SETTLED or passes == _PASSES:
            break
    free = components
    if tied and suggest and not homogeneous:
        free = VarianceComponentEstimator(rows).estimate(variance, columns, directions)
    common = variance[rows.groups.index(tied[0])] if tied else 1.0
    used = np.where(
        np.isin(rows.groups, tied), rows.reference_std, _rounded(rows.reference_std * np.sqrt(variance / common))
    )
    kept = {name: x for name, x in builder.noise_groups.values(guess).items() if noise_key(name) in stated}
    groups = _listed(rows, tied, used, free)
    noise = builder.noise_groups.noise(kept | {group.group: group.used for group in groups}, guess)
    return NoiseSummary(noise, groups, _suggested(rows, tied, free), passes)


def mean_noise_square(logs: Sequence[Samples], builder: RowBuilder) -> float:
    """Mean square of pure noise in the rows of a subset of the samples: 1 without task weights."""
    noise = [chunk.sources.square().sum(1) for chunk in SampledRows(logs, builder).chunks]
    return float(sum(x.sum() for x in noise) / max(sum(x.count_nonzero() for x in noise), 1))


def recorded_sensors(
    robot: Robot, contacts: Sequence[Contact], logs: Sequence[Samples], noise: SensorNoise | None = None
) -> SensorSet:
    """All sensors with a value in every sample of every log; `contacts`: the contacts in use."""
    torque = np.ones(robot.n_dofs, dtype=bool)
    wrench = np.ones((len(contacts), 6), dtype=bool)
    for log in logs:
        torque &= log.torque is not None and log.torque.isfinite().all(0).numpy()
        if log.wrench is None:
            wrench[:] = False
        else:
            wrench &= (log.wrench.isfinite() | ~log.active[..., None]).all(0).numpy()
            if log.wrench_in_world:  # components along a frame's axes take whole vectors
                whole = np.repeat(wrench.reshape(-1, 2, 3).all(axis=2), 3, axis=1)
                scalar = np.array([contact.along_normal for contact in contacts], dtype=bool)[:, None]
                wrench = np.where(scalar, wrench, whole)
    return SensorSet(torque, wrench, noise or SensorNoise())


def _fit_rows(
    rows: SampledRows, variance: Array, before: Mapping[str, Tensor] | None, fitter: LogFitter
) -> tuple[Mapping[str, Tensor], Mapping[str, Tensor], bool]:
    """Parameters by log in the builder's columns, where they were free, and whether no forces at all fit best.

    By least squares without regularization.
    """
    estimator = LeastSquares(rank_tolerance=fitter.estimator.rank_tolerance)
    fit = fitter.fit(rows.compress(variance, before), estimator.solve)
    logs = dict.fromkeys(chunk.log for chunk in rows.chunks)
    columns = {log: fit.columns(rows.builder, log).to("cpu", torch.float64) for log in logs}
    directions = {log: fitted_directions(fit.assembly, rows.builder, log) for log in logs}
    return columns, directions, fit.assembly.homogeneous


def _rounded(values: Array) -> Array:
    """To three digits, so that what is printed is what was used."""
    return np.array([float(f"{x:.{_DIGITS}g}") for x in values])


def _listed(rows: SampledRows, tied: Sequence[str], used: Array, free: GroupVariances) -> list[GroupNoise]:
    shown = _rounded(rows.reference_std * np.sqrt(free.variance)).tolist()
    return [
        GroupNoise(
            group=name,
            unit=rows.builder.noise_groups.unit(name),
            origin="stated" if name in tied else _origin(free, index),
            used=float(used[index]),
            residual=shown[index] if free.estimated[index] else None,
        )
        for index, name in enumerate(rows.groups)
    ]


def _origin(components: GroupVariances, index: int) -> str:
    if not components.estimated[index]:
        return "assumed"
    if components.upper_bound[index]:
        return "at most"
    if components.confounded[index]:
        return "confounded"
    return "pooled" if components.pooled[index] else "estimated"


def _suggested(rows: SampledRows, tied: Sequence[str], free: GroupVariances) -> dict[str, Any]:
    """Noise to state instead, if no common factor of at most 1 brings the stated one within a factor of two.

    Values are by the names of joints, or for the three axes, as `sensors.noise` has them.
    """
    shown_std = _rounded(rows.reference_std * np.sqrt(free.variance))
    clear = free.estimated & ~free.upper_bound & ~free.confounded
    known = {name: float(x) for name, x, yes in zip(rows.groups, shown_std, clear, strict=True) if yes}
    stated = dict(zip(rows.groups, rows.reference_std, strict=True))
    ratios = [known[name] / stated[name] for name in tied if name in known]
    if not ratios or (max(ratios) <= _APART and max(ratios) <= _APART**2 * min(ratios)):
        return {}
    groups = rows.builder.noise_groups
    shown = groups.noise(known, rows.builder.sensors.noise)
    keys = dict.fromkeys(map(noise_key, tied))
    whole = [key for key in keys if all(name in known for name in tied if noise_key(name) == key)]
    return groups.settings({key: getattr(shown, key) for key in whole})


_MUCH = 1.5  # times the expected residual; stated noise is seldom known better
_ALIKE = 2.0  # lack of fit; white residuals give 0.8 to 1.3
_EXACT = 1e-6  # fraction of the nominal residual; below, only rounding remains
_NAMED = 3

_UNEXPLAINED = 5.0  # residual in units of the stated noise; recorded logs with honest noise figures stay below 2
_SHARE = 0.5  # fraction of the weighted forces, for estimated noise; recorded logs stay below 0.35
_JOINT_SHARE = 0.4  # of the torque of one joint: a gear of half the ratio leaves 0.5
_SMALL_SHARE = 0.05  # fraction of all joint torques: flexibility, filters and the shape of friction
AT_THE_FLOOR = 1.3
"""Errors up to this multiple of the noise floor may be pure sensor noise."""


@dataclass(frozen=True)
class Misfit:
    """Residual of a fit, compared with the noise.

    Attributes:
        residual: standard deviation of the whitened residuals.
        expected: the same for the stated noise after the filter; None without stated noise.
        lack_of_fit: as in `Jackknife`; None with too few blocks.
        error_growth: median over the identified parameters of the standard error from the scatter between blocks,
            divided by that from noise; None with too few blocks.
        groups: readings and base rows that exceed their noise most.
        friction: friction that was not fitted; None if all was fitted.
        share: residual divided by that of the nominal parameters; None if the latter is 0.
    """

    residual: float
    expected: float | None
    lack_of_fit: float | None
    error_growth: float | None
    groups: tuple[GroupNoise, ...]
    friction: UnfittedFriction | None = None
    share: float | None = None

    @property
    def alike(self) -> bool:
        """Whether residuals are correlated in time more than noise is, and are more than rounding."""
        is_rounding = self.share is not None and self.share < _EXACT
        return self.lack_of_fit is not None and self.lack_of_fit > _ALIKE and not is_rounding

    @property
    def judged(self) -> bool:
        """Whether residuals could have shown that the model is wrong: by stated noise, or from block to block."""
        return self.expected is not None or self.lack_of_fit is not None

    @property
    def explained(self) -> bool:
        """Whether noise can explain the whole residual."""
        return not self._reasons()

    def _reasons(self) -> list[str]:
        """Reasons why noise cannot explain the residual; empty if it can."""
        reasons = []
        if self.expected is not None and self.residual > _MUCH * self.expected:
            reasons.append(f"residuals are {self.residual / self.expected:.2g} times as large as the stated noise")
        if self.alike:
            reasons.append(
                f"residuals are not white (their block variance is {self.lack_of_fit:.2g} times that of noise)"
            )
        return reasons + [str(self.friction)] * (self.friction is not None and self.friction.significant)

    @property
    def in_short(self) -> str:
        """The first reason and the sensor group that shows it most; "" if the model explains the forces."""
        where = f", most in {self.groups[0].group}" if self.groups else ""
        return "".join(f"{reason}{where}" for reason in self._reasons()[:1])

    def __str__(self) -> str:
        """In words, "" where the model explains the forces."""
        reasons = self._reasons()
        if not reasons:
            return ""
        share = self.expected or 1.0
        shown = [
            f"{group.group} {group.residual:.2g} {group.unit} (expected {share * group.used:.2g})"
            for group in self.groups
            if group.residual is not None
        ]
        where = f"; most in {', '.join(shown[:_NAMED])}" if shown else ""
        return f"{' and '.join(reasons)}{where}"


def misfit(
    estimate: Estimate,
    noise: NoiseSummary,
    logs: Sequence[Block],
    jackknife: Jackknife | None,
    friction: UnfittedFriction | None,
) -> Misfit:
    """Compare the residual of a fit with the noise.

    Args:
        estimate: of the training logs.
        noise: that weighted the rows.
        logs: the training logs.
        jackknife: of the estimate over their blocks.
        friction: that was not fitted.
    """
    noise_left = np.average([log.noise_left for log in logs], weights=[len(log) for log in logs])
    stated = any(group.origin == "stated" for group in noise.groups)
    expected = float(np.sqrt(noise_left)) if stated else None
    excess = {group.group: (group.residual or 0.0) / ((expected or 1.0) * group.used) for group in noise.groups}
    beyond = [
        group for group in noise.groups if excess[group.group] > _MUCH and (group.origin == "stated" or not stated)
    ]
    growth = None
    if estimate.block_error is not None and (known := estimate.verdict == "identified").any():
        growth = float(np.median(estimate.block_error[known] / np.maximum(estimate.noise_error[known], 1e-300)))
    return Misfit(
        residual=estimate.residual_std,
        expected=expected,
        lack_of_fit=None if jackknife is None else jackknife.lack_of_fit,
        error_growth=growth,
        groups=tuple(sorted(beyond, key=lambda group: -excess[group.group])),
        friction=friction,
        share=float(np.sqrt(estimate.cost / estimate.nominal_cost)) if estimate.nominal_cost > 0.0 else None,
    )


def beyond_noise(estimate: Estimate) -> str:
    """Message if the residual is very far above the stated noise; "" otherwise."""
    residual = _residual(estimate)
    reason = f"forces differ from any rigid-body model by {residual:.3g} times the stated sensor noise"
    return reason if residual > _UNEXPLAINED else ""


def unexplained_forces(
    estimate: Estimate, problem: LinearProblem, forces: float = 0.0, noise_stated: bool = True
) -> str:
    """Message if a fit does not explain most of the weighted forces, and stated noise does not either; "" otherwise.

    Args:
        estimate: of a fit, possibly far from the optimum.
        problem: that was solved.
        forces: squared norm of the weighted forces, if eliminated offsets and scales have taken some of it.
        noise_stated: whether the user stated noise. Estimated noise is that of most readings: a lift that carries 200 N
            beside wrists of 0.05 N m leaves many times as much.
    """
    forces = max(problem.cost(np.zeros_like(estimate.phi)), forces, np.finfo(float).tiny)
    share = np.sqrt(estimate.cost / forces)
    if share <= _SHARE or (noise_stated and _residual(estimate) <= _MUCH):
        return ""
    return f"the fit does not explain {100.0 * share:.3g} % of the weighted forces"


def _residual(estimate: Estimate) -> float:
    return float(np.sqrt(estimate.cost / max(estimate.rows, 1)))


_CLEAR = 0.5  # least correlation of the URDF's forces with the measured ones for a clear factor


@one_thread()
def force_gain(problem: LinearProblem) -> float | None:
    """The factor of the forces that nominal bodies need which fits best, None if it is not clear.

    Friction is whatever fits. Unlike a total mass it is there for arms as well, and does not depend on the estimator.
    """
    inertial = np.zeros((len(problem.nominal) // PER_BODY, PER_BODY), dtype=bool)
    inertial[:, parameters.INERTIAL] = True
    chosen = inertial.flatten()
    needed = problem.A[:, chosen] @ problem.nominal[chosen]
    free = ~chosen & problem.free
    fixed = ~chosen & ~problem.free
    measured = problem.b - problem.A[:, fixed] @ problem.nominal[fixed]
    U, values, _ = np.linalg.svd(problem.A[:, free] * problem.scale[free], full_matrices=False)
    friction = U[:, is_significant(values)]
    needed, measured = (x - friction @ (friction.T @ x) for x in (needed, measured))
    size = np.linalg.norm(needed) * np.sqrt(measured @ measured + problem.residual)
    if not size > 0.0 or abs(needed @ measured) < _CLEAR * size:
        return None
    return float(needed @ measured / (needed @ needed))


def unexplained_torques(fitted: Metrics, sensors: SensorSet | None = None) -> str:
    """Message if a fit does not explain most of the joint torques; "" otherwise.

    It judges all torques, or the projected rows without contact forces. Known sensor noise is subtracted. With
    `sensors`, only what they measure counts: nothing without torque sensors (friction is then not fitted), and only the
    projected rows without contact sensors.
    """
    groups = ["joint_torque", "nullspace"]
    unread = sensors is not None and sensors.wrench.size > 0 and not sensors.wrench.any()
    if fitted.limbs_in_air or unread:
        groups.remove("joint_torque")
    if sensors is not None and not sensors.torque.any():
        groups.clear()
    noise = AT_THE_FLOOR * (fitted.noise.get("joint_torque") or 0.0)  # as large where projected on orthonormal axes
    beyond = (group for group in groups if (fitted.rms_of(group) or 0.0) > noise)
    share = max((fitted.relative_of(group) or 0.0 for group in beyond), default=0.0)
    return f"the fit does not explain {100.0 * share:.3g} % of the joint torques" if share > _SHARE else ""


def unexplained_joints(fitted: Metrics) -> list[str]:
    """Joints with a large unexplained torque that is neither a small force nor known sensor noise.

    Noise estimated from residuals would take a joint that the model does not explain for a noisy one.
    """
    torques = {
        name: (error, error / share)
        for name, error in fitted.by_joint_rms.items()
        if error is not None and (share := fitted.by_joint_relative.get(name))
    }
    size = np.sqrt(np.mean([measured**2 for _, measured in torques.values()])) if torques else 0.0
    least = max(_SMALL_SHARE * size, AT_THE_FLOOR * (fitted.noise.get("joint_torque") or 0.0))
    return [name for name, (error, measured) in torques.items() if error > max(_JOINT_SHARE * measured, least)]


_LEVEL = 1e-3  # significance level
_FRICTION_RATIO = 2.0  # least ratio to the squares explained by noise, which is not known better
_UNITS = {"prismatic": ("N", "N s/m")}
_ROTARY = ("N m", "N m s/rad")
_NAMED_JOINTS = 2


@dataclass(frozen=True)
class UnfittedFriction:
    """How much of the residual friction would explain that was not fitted.

    Attributes:
        joints: without fitted friction, those with the clearest evidence first.
        values: friction beyond the nominal one, (len(joints), 2), Coulomb and viscous.
        units: of both, by joint.
        ratio: explained squares divided by those expected from noise; about 1 without friction.
        combinations: number of friction parameter combinations that the rows separate from the fitted parameters.
    """

    joints: tuple[str, ...]
    values: Array
    units: tuple[tuple[str, str], ...]
    ratio: float
    combinations: int

    @property
    def significant(self) -> bool:
        """Whether noise would explain as much in less than one of a thousand fits.

        Source: the F test of linear hypotheses, for many degrees of freedom of noise.
        """
        if not self.combinations:
            return False
        return self.ratio > max(_FRICTION_RATIO, float(chdtri(self.combinations, _LEVEL)) / self.combinations)

    def __str__(self) -> str:
        """How much it explains, and the joints with the clearest evidence."""
        shown = [
            f"{joint} {coulomb:.2g} {units[0]} and {viscous:.2g} {units[1]}"
            for joint, (coulomb, viscous), units in zip(self.joints, self.values, self.units, strict=True)
        ]
        named = ", ".join(shown[:_NAMED_JOINTS])
        return f"friction, which is not fitted, explains {self.ratio:.2g} times as much as noise would ({named})"


@one_thread()
def unfitted_friction(problem: LinearProblem, robot: Robot) -> UnfittedFriction | None:
    """Friction in the residuals that a fit kept nominal; None if no row depends on it.

    Joints of frozen bodies are ignored.

    Args:
        problem: of a fit.
        robot: with the joints.
    """
    joints = {body: part.joint for body, part in enumerate(robot.bodies) if part.joint is not None}
    free = problem.free.reshape(-1, PER_BODY)
    A = problem.A.reshape(len(problem.A), -1, PER_BODY)[:, :, FRICTION]
    bodies = [body for body in joints if free[body, INERTIAL].any() and not free[body, FRICTION].any()]
    bodies = [body for body in bodies if A[:, body].any(axis=0).all()]
    if not bodies:
        return None
    columns = A[:, bodies].reshape(len(A), -1)
    size = np.linalg.norm(columns, axis=0)
    U, values, _ = np.linalg.svd(problem.A[:, problem.free] * problem.scale[problem.free], full_matrices=False)
    U = U[:, is_significant(values, RANK_TOLERANCE)]
    rows = np.column_stack([columns / size, problem.b - problem.A @ problem.nominal])
    rows -= U @ (U.T @ rows)
    V, values, Wh = np.linalg.svd(rows[:, :-1], full_matrices=False)
    kept = values > UNOBSERVABLE_SHARE
    explained = V[:, kept].T @ rows[:, -1]
    rank = int(kept.sum())
    remainder = rows[:, -1] - V[:, kept] @ explained
    cost = float(remainder @ remainder) + problem.residual
    noise = problem.oversampling * residual_std(cost, problem.rows, U.shape[1] + rank, problem.oversampling) ** 2
    inverse = Wh[kept].T / values[kept]
    friction = inverse @ explained
    deviation = np.maximum(np.linalg.norm(inverse, axis=1), np.finfo(float).tiny)
    order = np.argsort(-np.square(friction / deviation).reshape(-1, 2).sum(axis=1))
    shown = [joints[bodies[index]] for index in order]
    return UnfittedFriction(
        joints=tuple(joint.name for joint in shown),
        values=(friction / size).reshape(-1, 2)[order],
        units=tuple(_UNITS.get(joint.kind, _ROTARY) for joint in shown),
        ratio=float(explained @ explained) / max(rank * noise, np.finfo(float).tiny),
        combinations=rank,
    )


_MOST_SAMPLES = 50_000  # evenly spaced


def unmeasured_at_rest(logs: Sequence[Samples]) -> float | None:
    """Fraction of the joint torques that count as unmeasured because joints rest; None without any."""
    flags = [log.resting for log in logs if log.resting is not None and log.resting.numel()]
    return float(sum(resting.sum() for resting in flags)) / sum(resting.numel() for resting in flags) if flags else None


def resting_joints(
    problem: LinearProblem, robot: Robot, builder: RowBuilder, logs: Sequence[Samples]
) -> dict[str, float]:
    """Fraction of the time at rest, for joints that rest too often, largest first.

    Considered are joints with measured torque and fitted Coulomb friction with the sign of the velocity: a sticking
    joint has any friction below Coulomb's. If torques at rest count as unmeasured, it is the fraction of these samples.

    Args:
        problem: of the fit.
        robot: with the joints.
        builder: of the rows.
        logs: of the fit.
    """
    count = sum(map(len, logs))
    taken = any(log.resting is not None for log in logs)
    if (builder.tree.sign_width is not None and not taken) or not count or not robot.n:
        return {}
    step = max(1, count // _MOST_SAMPLES)
    thin = [log.every(step) for log in logs]
    flags = [log.resting.cpu().numpy() for log in thin if log.resting is not None]
    if flags:
        share = np.concatenate(flags).mean(axis=0)
    else:
        share = resting_share(np.concatenate([log.joint_velocity.cpu().numpy() for log in thin]))
        directions = [log.joint_velocity if log.direction is None else log.direction for log in thin]
        still = ~np.any([x.cpu().numpy().any(axis=0) for x in directions], axis=0)
        share[still] = 1.0  # by the noise of their velocity
    is_free = problem.free.reshape(-1, PER_BODY)[1:, COULOMB]
    fitted = builder.sensors.torque[: robot.n] & (is_free @ (robot.joint_map[0] != 0.0))
    order = [joint for joint in np.argsort(-share, kind="stable").tolist() if fitted[joint] and share[joint] > OFTEN]
    return {robot.joint_names[joint]: float(share[joint]) for joint in order}
