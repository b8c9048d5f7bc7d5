"""The same motion recorded again and again: do the intervals of what is identified hold the truth?"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

from legged.errors import structural_base
from legged.gait import Reference
from legged.recording import Noise, record
from legged.robots import ROBOTS, TrueRobot
from legged.simulate import Exact, prescribed, simulated
from torchid.errors import TorchidWarning
from torchid.estimators import LeastSquares
from torchid.estimators.least_squares import IDENTIFIED
from torchid.fitting.fit import Fit, LogFitter
from torchid.fitting.noise import estimate_noise, misfit, unfitted_friction
from torchid.fitting.robust import RobustLoss, fit_robustly
from torchid.identifiability.confounding import ParameterCovariance, total_mass
from torchid.logs.preprocess import preprocess
from torchid.parameters import FRICTION, MASS, PER_BODY, Array
from torchid.problem import ExtraTerms, RowBuilder, Samples, bind_log
from torchid.problem.compression import compress_in_blocks, split_into_folds
from torchid.rounding import UNOBSERVABLE_SHARE
from torchid.sensing import SensorNoise, named_sensors

NORMAL = 1.959964
_SPARSE = 5  # of exact signals every so many samples are fitted: 100 Hz
_RATE = 100.0  # Hz
_OFFSET = 0.5  # N m, standard deviation
_OUTLIERS, _OUTLYING = 0.01, 20.0  # share of the readings, and by how much their noise is larger


@dataclass(frozen=True)
class Situation:
    """How a motion is recorded and what is fitted.

    Attributes:
        name: for tables.
        cutoff: with which positions, orientation and IMU are filtered [Hz]; else exact rates of the same instants are
            recorded.
        motion: noise of positions, orientation and IMU, in usual ones.
        walked: in MuJoCo, with impacts; else feet take their load within a tenth of a second.
        offsets, outliers, robust, friction: unknown torque offsets; one reading in a hundred is far off; Huber's loss;
            whether friction is fitted.
    """

    name: str
    cutoff: float | None = None
    motion: float = 0.0
    walked: bool = False
    offsets: bool = False
    outliers: bool = False
    robust: bool = False
    friction: bool = True


SITUATIONS = (
    Situation("exact motion, torque noise"),
    Situation("exact motion, torque offsets", offsets=True),
    Situation("exact motion, outliers", outliers=True, robust=True),
    Situation("filtered at 20 Hz", 20.0),
    Situation("filtered at 20 Hz, motion noise", 20.0, motion=1.0),
    Situation("walked in MuJoCo, 20 Hz, motion noise", 20.0, motion=1.0, walked=True),
    Situation("walked in MuJoCo, 10 Hz, motion noise", 10.0, motion=1.0, walked=True),
    Situation("friction not in the model, 20 Hz", 20.0, friction=False),
)


def truth(robot: str, situation: Situation, seconds: float) -> tuple[TrueRobot, Exact]:
    """The true robot and what happened to it; point feet."""
    true = TrueRobot.unlike_its_urdf(replace(ROBOTS[robot], radius=0.0))
    if situation.walked:
        return true, simulated(true, Reference(true, seconds, seed=1), seconds)
    exact = _without_friction(robot, seconds)
    velocity, torque = exact.log.joint_velocity, exact.log.joint_torque
    assert velocity is not None
    assert torque is not None
    friction = true.friction[:, 0] * np.sign(velocity) + true.friction[:, 1] * velocity
    return true, replace(exact, log=replace(exact.log, joint_torque=torque + friction))


@cache
def _without_friction(robot: str, seconds: float) -> Exact:
    """A prescribed motion of a robot without friction."""
    true = TrueRobot.unlike_its_urdf(replace(ROBOTS[robot], radius=0.0))
    phi = true.phi.copy()
    phi[:, FRICTION] = 0.0
    true = replace(true, phi=phi)
    return prescribed(true, Reference(true, seconds, seed=1, static=True), seconds)


@dataclass(frozen=True)
class Tally:
    """What the repetitions have found.

    Attributes:
        estimates, errors: of combinations called identified, and their standard errors, (R, K), NaN if not called so.
        truth: (K,).
        mass: total mass and its standard error, (R, 2) [kg]; `true_mass`.
        parameters: whether intervals of single parameters hold the truth, by repetition.
        residual: standard deviation of whitened residuals, (R,).
        misfit: whether torchid says that the model does not explain the forces, (R,).
    """

    truth: Array
    true_mass: float
    estimates: list[Array] = field(default_factory=list)
    errors: list[Array] = field(default_factory=list)
    mass: list[tuple[float, float]] = field(default_factory=list)
    parameters: list[np.ndarray] = field(default_factory=list)
    residual: list[float] = field(default_factory=list)
    misfit: list[bool] = field(default_factory=list)


class Repetitions:
    """Fits of one motion with new noise each time."""

    def __init__(self, robot: str, situation: Situation, seconds: float, seed: int = 17) -> None:
        """Simulate it once; the seed is that of the noise."""
        self.situation, self.seed = situation, seed
        self.true, self.exact = truth(robot, situation, seconds)
        self.contacts = self.true.legged.contacts(rolling=False)
        self.noise = Noise().times(situation.motion, 1.0)
        n, stated = self.true.robot.n, SensorNoise(joint_torque=self.noise.joint_torque)
        sensors = named_sensors("joints", n, len(self.contacts), stated)
        terms = ExtraTerms(armature=True, offsets={"joint_torque": "log"} if situation.offsets else {})
        builder = RowBuilder(self.true.robot, self.contacts, sensors, terms)
        fitter = self._fitter(builder)
        first = self._samples(np.random.default_rng(0))
        self.weights = estimate_noise([first], fitter, ["joint_torque"])  # as identify does
        builder = RowBuilder(self.true.robot, self.contacts, replace(sensors, noise=self.weights.noise), terms)
        self.fitter = self._fitter(builder)

    def _fitter(self, builder: RowBuilder) -> LogFitter:
        friction = self.situation.friction
        return LogFitter(robot=self.true.robot, builder=builder, estimator=LeastSquares(), friction=friction)

    def run(self, count: int, done: Callable[[], object] = lambda: None) -> Tally:
        """So many of them; `done` is called after each."""
        truth = structural_base(self.true.legged).reduce(self.true.phi.flatten())
        tally = Tally(truth, float(self.true.phi[:, MASS].sum()))
        for number in range(count):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", TorchidWarning)
                self._add(tally, self._samples(np.random.default_rng([number, self.seed])))
            done()
        return tally

    def _samples(self, rng: np.random.Generator) -> Samples:
        situation, exact = self.situation, self.exact
        log = exact.log.select(slice(None, None, _SPARSE))
        if situation.cutoff is not None:
            recorded = record(exact, self.true.robot.base_link, self.noise, rng)
            log = preprocess(recorded, situation.cutoff, _RATE)
        else:
            assert log.joint_torque is not None
            deviation = self.noise.joint_torque * rng.normal(size=log.joint_torque.shape)
            if situation.outliers:
                deviation *= np.where(rng.uniform(size=deviation.shape) < _OUTLIERS, _OUTLYING, 1.0)
            if situation.offsets:
                deviation += _OFFSET * np.random.default_rng(23).normal(size=deviation.shape[1])
            log = replace(log, joint_torque=log.joint_torque + deviation)
        return bind_log(log, self.true.robot, self.contacts)

    def _fit(self, samples: Samples) -> Fit:
        logs = split_into_folds([samples], self.fitter.builder)
        if self.situation.robust:
            return fit_robustly(logs, self.fitter, RobustLoss.named("huber")).fit
        return self.fitter.fit(compress_in_blocks(logs, self.fitter.builder))

    def _add(self, tally: Tally, samples: Samples) -> None:
        fit = self._fit(samples)
        base, estimate = structural_base(self.true.legged), fit.estimate
        mass = total_mass(fit.assembly, estimate, block_error=fit.jackknife.mass_error if fit.jackknife else 0.0)
        known = estimate.verdict == IDENTIFIED
        off = np.abs(estimate.phi - self.true.phi.flatten()) / estimate.standard_error
        errors = combination_errors(fit, base.combination)
        if not self.situation.friction:
            errors[base.kept % PER_BODY >= FRICTION.start] = np.nan
        tally.estimates.append(base.reduce(estimate.phi))
        tally.errors.append(errors)
        tally.mass.append((mass.value, mass.standard_error))
        tally.parameters.append(np.where(known, off <= NORMAL, np.nan))
        tally.residual.append(estimate.residual_std)
        friction = unfitted_friction(fit.assembly.problem, self.true.robot)
        tally.misfit.append(not misfit(estimate, self.weights, [samples], fit.jackknife, friction).explained)


def combination_errors(fit: Fit, combinations: Array) -> Array:
    """Standard errors of combinations (K, 12 L) of parameters, the larger of both kinds; NaN if undetermined."""
    problem, estimate = fit.assembly.problem, fit.estimate
    covariance = ParameterCovariance.of(problem, LeastSquares().rank_tolerance)
    along = covariance.scale_sensitivity(combinations)
    size = np.maximum(np.linalg.norm(along, axis=1), np.finfo(float).tiny)
    lost = np.linalg.norm(along @ covariance.null_space, axis=1) > UNOBSERVABLE_SHARE * size
    noise = np.sqrt(problem.oversampling) * estimate.residual_std
    errors = noise * np.linalg.norm(along @ covariance.root, axis=1)
    if fit.jackknife is not None:
        errors = np.maximum(errors, [fit.jackknife.error_along(one) for one in combinations])
    return np.where(lost, np.nan, errors)


def summarize(tally: Tally) -> Mapping[str, float]:
    """Coverage and sizes of intervals; shares are of 1.

    `average`, `worst`: coverage of combinations; `ratio`: median over them of standard error over scatter; `bias`:
    median of their mean error in scatters; `parameters`, `mass`: coverage of single parameters and of the total mass,
    NaN where the fit does not determine it.
    """
    estimates, errors, mass = np.array(tally.estimates), np.array(tally.errors), np.array(tally.mass)
    called = np.isfinite(errors).all(axis=0)
    estimates, errors, off = estimates[:, called], errors[:, called], (estimates - tally.truth)[:, called]
    holds, known = np.abs(off) <= NORMAL * errors, bool(np.isfinite(mass[:, 1]).all())
    scatter = estimates.std(axis=0, ddof=1) if len(estimates) > 1 else np.full(errors.shape[1], np.nan)
    single = np.array(tally.parameters, dtype=float)
    by_parameter = single[:, np.isfinite(single).any(axis=0)]
    return {
        "repetitions": len(errors),
        "combinations": int(called.sum()),
        "average": float(holds.mean()),
        "worst": float(holds.mean(axis=0).min()),
        "ratio": float(np.median(errors.mean(axis=0) / scatter)),
        "bias": float(np.median(np.abs(off.mean(axis=0)) / scatter)),
        "parameters": float(np.nanmean(by_parameter)) if by_parameter.size else float("nan"),
        "mass": float(np.mean(np.abs(mass[:, 0] - tally.true_mass) <= NORMAL * mass[:, 1])) if known else float("nan"),
        "mass_error": float(mass[:, 1].mean()),
        "mass_off": float(np.sqrt(np.mean((mass[:, 0] - tally.true_mass) ** 2))),
        "residual": float(np.mean(tally.residual)),
        "misfit": float(np.mean(tally.misfit)),
    }
