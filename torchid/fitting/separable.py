"""Settings on which rows depend nonlinearly, by separable least squares: each value with a linear fit of the rest.

Source: Golub and Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares problems", 1973.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np
import torch
from scipy.interpolate import BSpline, make_interp_spline
from scipy.optimize import minimize, minimize_scalar
from torch import Tensor

from torchid.errors import LogError, warn
from torchid.estimators import LeastSquares
from torchid.fitting.fit import LogFitter
from torchid.fitting.left_out import Evidence, with_terms
from torchid.identifiability.confounding import ExtraEstimate
from torchid.logs.segments import recorded_at_delays, unbroken_segments
from torchid.logs.timeline import spline_degree
from torchid.parallel import share_between_forks, thread_count
from torchid.parameters import Array
from torchid.problem import ExtraTerms, Samples, compress_parts
from torchid.problem.compression import compress_in_blocks
from torchid.problem.extras import SLOPE, dof_extra_column

LARGEST_TILT = 0.3
"""Largest tilt about each axis that is tried [rad]: more is another frame than was meant."""

_GAIN = 1e-3  # of the residual, by which a value has to beat none
_WIDTHS = tuple(10.0 ** np.arange(-2.0, 0.25, 0.25))  # [rad/s or m/s]
_STRIBECK = tuple(10.0 ** np.arange(-2.0, 1.25, 0.25))  # [rad/s or m/s]
_STRIBECK_SAMPLES = 5000  # of all logs, evenly spaced
_RIDGE = 1e-6  # the residual is smooth in the setting where the data determine some parameters badly
_STEP = 1e-3  # of the logarithm of the velocity, of differences
_CHANCE = 0.025  # that friction at rest of any joint seems to be beyond Coulomb friction
_QUANTILE = 1.96  # standard errors from the middle to the end of a 95 % interval
_WIDTH_SETTLED, _STRIBECK_SETTLED = 1e-3, 1e-4  # of the logarithm, to base 10
_WIDTH_DIGITS = 4
_TILT_SAMPLES = 2000  # of all logs, evenly spaced
_TILT_SETTLED = 1e-6  # of the residual's square


@dataclass(frozen=True)
class SignWidthChoice:
    """A width, and what fits with others leave.

    Attributes:
        width: [rad/s or m/s]; None for the sign, to which no width is worth preferring.
        tried: (W,) widths, the sign last.
        residual: (W,) standard deviation of the residuals of their fits, over that with the sign [1].
    """

    width: float | None
    tried: tuple[float | None, ...]
    residual: tuple[float, ...]

    def __str__(self) -> str:
        """The width, and what it is for."""
        if self.width is None:
            return "none: Coulomb friction with tanh(velocity / width) predicts left-out blocks no better"
        return f"{self.width:g} rad/s (m/s); the best width leaves {min(self.residual):.3g} of the residual"


def choose_sign_width(read: Callable[[float | None], tuple[float, Array]]) -> SignWidthChoice:
    """The narrowest width [rad/s or m/s] that predicts left-out blocks as well as the one whose fit leaves least.

    A wider one of the same error would make up for friction elsewhere. All other parameters are linear, and fitted anew
    for each width: separable least squares (Golub and Pereyra, 1973).

    Args:
        read: standard deviation of the residuals with a width, None for the sign, and squared errors on blocks that are
            left out of the fit, (G,).
    """
    tried = (None, *_WIDTHS)
    found = dict(zip(tried, share_between_forks(tried, read, thread_count()), strict=True))
    left = {width: residual for width, (residual, _) in found.items()}
    best = min(left, key=lambda width: left[width])
    width = next(one for one in tried if not Evidence.of(found[one][1], found[best][1]).certain)
    if width == best and width is not None:  # no other does as well
        width, left[width] = _best_beside(width, _WIDTHS, lambda one: read(one)[0], _WIDTH_SETTLED)
    chosen = None if width is None else float(f"{width:.{_WIDTH_DIGITS}g}")
    return SignWidthChoice(chosen, tuple(left), tuple(one / left[None] for one in left.values()))


def _best_beside(
    best: float, tried: Sequence[float], left: Callable[[float], float], settled: float
) -> tuple[float, float]:
    """The value between the neighbours of the best one that leaves least, and what it leaves."""
    k = tried.index(best)
    between = np.log10([tried[max(k - 1, 0)], tried[min(k + 1, len(tried) - 1)]])
    found = minimize_scalar(lambda x: left(10.0**x), bounds=between, method="bounded", options={"xatol": settled})
    return 10.0 ** float(found.x), float(found.fun)


@dataclass(frozen=True)
class StribeckChoice:
    """A Stribeck velocity, and what fits with it and without such friction leave.

    Attributes:
        velocity: [rad/s or m/s]; None for no such friction: it is not significant, or the data do not determine it.
        found: the best of those that were tried, which it is otherwise.
        significance: standard errors by which friction at rest is beyond Coulomb friction, of the joint with most.
        required: what it must be, of the largest of so many joints, to be chance in one of 40 cases.
        interval: of 95 % of it, from the standard error of its logarithm; None where no data depend on it.
        inflation: of this standard error by not knowing all other parameters, None likewise.
        confounded_with: names of other parameters that it is confounded with, empty if with none.
        residual, coulomb_residual: standard deviation of whitened residuals with the best and without [1].
    """

    velocity: float | None
    found: float
    significance: float
    required: float
    interval: tuple[float, float] | None
    inflation: float | None
    confounded_with: tuple[str, ...]
    residual: float
    coulomb_residual: float

    def __str__(self) -> str:
        """The velocity with its interval, and what it is for."""
        left = f"residual {self.residual:.4g}, {self.coulomb_residual:.4g} without"
        if not self.significance > self.required:
            return f"none: friction at rest is not significantly beyond Coulomb friction ({left})"
        if self.confounded_with:
            others = ", ".join(self.confounded_with)
            return f"none: any, such as {self.found:.3g} rad/s (m/s), is confounded with {others} ({left})"
        if self.interval is None:
            return f"none: the data do not determine it ({left})"
        span = "{:.3g} to {:.3g}".format(*self.interval)
        if self.velocity is None:
            return f"none: the data do not determine it, 95 %: {span} rad/s (m/s) ({left})"
        return f"{self.velocity:.3g} rad/s (m/s) (95 %: {span}), chosen by the residual: {left}"


def choose_stribeck(
    logs_and_fitter: Callable[[float | None], tuple[Sequence[Samples], LogFitter]], terms: ExtraTerms
) -> StribeckChoice:
    """The Stribeck velocity whose fit of the logs leaves least, one for all joints.

    All other parameters, friction at rest of each joint among them, are linear and fitted anew for each velocity,
    within the conditions of the estimator: separable least squares (Golub and Pereyra, 1973). The standard error is
    that of the logarithm of the velocity as one more unknown, to first order, in a fit with all others (Kaufman, 1975).

    Args:
        logs_and_fitter: bound training logs, preprocessed with a velocity, and a fitter of their rows; None for no such
            friction.
        terms: extra parameters of these.
    """

    def some(velocity: float | None) -> tuple[list[Samples], LogFitter]:
        logs, fitter = logs_and_fitter(velocity)
        step = max(1, sum(map(len, logs)) // _STRIBECK_SAMPLES)
        own: dict[str, Any] = {"folder": None, "motion_noise": None}
        thin = [replace(x.every(step), oversampling=max(1.0, x.oversampling / step), **own) for x in logs]
        estimator = replace(fitter.estimator, ridge=max(fitter.estimator.ridge, _RIDGE))  # type: ignore[type-var]
        return thin, replace(fitter, estimator=estimator)

    def left(velocity: float | None) -> float:
        logs, fitter = some(velocity)
        problem = fitter.build_problem(compress_parts(logs, fitter.builder)).assembly.problem
        return fitter.estimator.solve(problem).residual_std

    first = left(None)  # reads the logs, which forks then have
    tried = dict(zip(_STRIBECK, share_between_forks(_STRIBECK, left, thread_count()), strict=True))
    best, residual = _best_beside(min(tried, key=lambda one: tried[one]), _STRIBECK, left, _STRIBECK_SETTLED)
    unknown = _with_logarithm(some, best, terms)
    term, at_rest = unknown[SLOPE][0], unknown["stribeck"]
    reach = _QUANTILE * term.standard_error
    interval = (best * np.exp(-reach), best * np.exp(reach)) if np.isfinite(reach) else None
    choice = StribeckChoice(
        velocity=float(f"{best:.{_WIDTH_DIGITS}g}"),
        significance=max((one.value / one.standard_error for one in at_rest if one.standard_error > 0.0), default=0.0),
        required=-NormalDist().inv_cdf(_CHANCE / max(len(at_rest), 1)),
        found=best,
        interval=interval,
        inflation=term.inflation if np.isfinite(term.inflation) else None,
        confounded_with=() if term.separable else term.confounded_with or ("other parameters",),
        residual=residual,
        coulomb_residual=first,
    )
    known = interval is not None and interval[0] > _STRIBECK[0] and interval[1] < _STRIBECK[-1]
    return (
        choice if choice.significance > choice.required and term.separable and known else replace(choice, velocity=None)
    )


def _with_logarithm(
    some: Callable[[float], tuple[list[Samples], LogFitter]], velocity: float, terms: ExtraTerms
) -> dict[str, list[ExtraEstimate]]:
    """Friction at rest, and `SLOPE`, how far the logarithm of a Stribeck velocity is off, beside all parameters."""
    (before, low), (logs, fitter), (after, high) = (some(velocity * np.exp(x)) for x in (-_STEP, 0.0, _STEP))
    of, slopes = fitter.builder, [log.joint_velocity.new_zeros(len(log), fitter.robot.n) for log in logs]
    for extra, value in ((x.extra, x.value) for x in fitter.fit(compress_parts(logs, of)).extras):
        if extra.what == "stribeck" and extra.dof is not None:
            for slope, *ends in zip(slopes, before, after, strict=True):
                trees = low.builder.tree, high.builder.tree
                less, more = (dof_extra_column(extra, extra.dof, *one) for one in zip(ends, trees, strict=True))
                slope[:, extra.dof] = value * (more - less) / (2.0 * _STEP)
    fitter = with_terms(fitter, replace(terms, stribeck=velocity, slope=True))
    sloped = [replace(log, slope=slope) for log, slope in zip(logs, slopes, strict=True)]
    found = fitter.fit(compress_in_blocks(sloped, fitter.builder)).extras
    return {what: [x for x in found if x.extra.what == what] for what in ("stribeck", SLOPE)}


@dataclass(frozen=True)
class TiltChoice:
    """A tilt, and what fits with it and with none leave.

    Attributes:
        tilt: about the base's x and y axes [rad]; 0 if none is worth preferring.
        residual, level_residual: standard deviation of whitened residuals with the best tilt and with none [1].
    """

    tilt: tuple[float, float]
    residual: float
    level_residual: float

    def __str__(self) -> str:
        """The tilt, and what it is for."""
        found = f"{self.residual:.3g}, {self.level_residual:.3g} without"
        if not any(self.tilt):
            return f"none: no tilt of the base explains more (residual {found})"
        x, y = np.rad2deg(self.tilt)
        return f"{x:.2f} and {y:.2f} degrees about the base's x and y axes, chosen by the residual: {found}"


def choose_base_tilt(logs: Sequence[Samples], fitter: LogFitter) -> TiltChoice:
    """The tilt whose fit of a sample of the logs leaves least, as `torchid.load_robot` takes it.

    All other parameters are linear, and fitted anew for each tilt: separable least squares (Golub and Pereyra, 1973).

    Args:
        logs: bound training logs, of a robot without a tilt.
        fitter: of their rows.

    Warns:
        TorchidWarning: the best tilt is beyond `LARGEST_TILT`.
    """
    step = max(1, sum(map(len, logs)) // _TILT_SAMPLES)
    logs = [log.every(step) for log in logs]
    estimator = LeastSquares(_RIDGE, rank_tolerance=fitter.estimator.rank_tolerance)

    def left(tilt: Array) -> float:
        tilted = [replace(log, base=log.base.tilted(tilt, len(log))) for log in logs]
        return float(fitter.fit(compress_parts(tilted, fitter.builder), estimator.solve).estimate.residual_std ** 2)

    level = left(np.zeros(2))
    scale = max(level, np.finfo(float).tiny)
    found = minimize(
        lambda tilt: left(tilt) / scale,
        np.zeros(2),
        method="L-BFGS-B",
        jac="3-point",
        bounds=[(-LARGEST_TILT, LARGEST_TILT)] * 2,
        options={"ftol": _TILT_SETTLED},
    )
    gains = found.fun < (1.0 - _GAIN) ** 2
    if gains and np.abs(found.x).max() >= LARGEST_TILT:
        warn(f"robot.base_tilt: {LARGEST_TILT:g} rad or more; is the base's orientation that of another frame?")
    x, y = (float(f"{angle:.4g}") for angle in found.x) if gains else (0.0, 0.0)
    return TiltChoice((x, y), float(np.sqrt(found.fun * level)), float(np.sqrt(level)))


EARLIEST_DELAY, LATEST_DELAY = -0.02, 0.06
"""Delays that are tried [s]: beyond, the stamps are those of another clock."""

_DELAY_TRIAL_SAMPLES = 1000  # of all logs, evenly spaced, to try delays
_DELAY_SAMPLES = 5000  # of all logs, evenly spaced, to find the best
_TRIED_DELAYS = np.linspace(EARLIEST_DELAY, LATEST_DELAY, 17)  # [s]
_DELAY_STEPS = 8  # of Gauss and Newton, at most
_DELAY_SETTLED = 1e-2  # standard errors, the step at which they end


@dataclass(frozen=True)
class DelayChoice:
    """A delay, and what fits with it and with none leave.

    Attributes:
        delay: [s]; 0 where the best does not differ significantly from none, or is confounded with other parameters.
        found: the best [s], which it is otherwise.
        standard_error: of it [s], and interval of 95 % [s]; None where the data do not determine it.
        inflation: of its standard error by not knowing all other parameters, None likewise.
        confounded_with: names of other parameters that it is confounded with, empty if with none.
        residual, undelayed_residual: standard deviation of whitened residuals with the best and with none [1].
    """

    delay: float
    found: float
    standard_error: float | None
    interval: tuple[float, float] | None
    inflation: float | None
    confounded_with: tuple[str, ...]
    residual: float
    undelayed_residual: float

    def __str__(self) -> str:
        """The delay with its standard error, and what it is for."""
        best, left = f"{1e3 * self.found:.3g}", f"residual {self.residual:.4g}, {self.undelayed_residual:.4g} without"
        left += "; an end of what is tried: the best may lie beyond" * _is_at_end(self.found)
        if self.confounded_with:
            return f"none: any, such as {best} ms, is confounded with {', '.join(self.confounded_with)} ({left})"
        if self.standard_error is None or self.interval is None:
            return f"none: the data do not determine it ({left})"
        best = f"{best} ± {1e3 * self.standard_error:.2g} ms"
        if not self.delay:
            return f"none: {best} does not differ significantly from none ({left})"
        low, high = (1e3 * x for x in self.interval)
        return f"{best} of joint torques (95 %: {low:.3g} to {high:.3g} ms), chosen by the residual: {left}"


def choose_delay(logs: Sequence[Samples], fitter: LogFitter, terms: ExtraTerms) -> DelayChoice:
    """The delay whose fit of the logs leaves least: torques that act are those recorded so much earlier.

    Everything else is linear, and fitted anew for each delay: separable least squares (Golub and Pereyra, 1973). From
    the best of some delays, steps are those of Gauss and Newton with the delay as one more unknown (Kaufman, 1975),
    whose standard error is that of the delay. Physical conditions of the estimator hold throughout: a negative armature
    would explain a delay. Torques are splines between samples, so that the delay can be a part of a step.

    Args:
        logs: bound training logs, read without a delay and low-pass filtered: between samples of those that are not,
            noise is smaller, which the fit would prefer.
        fitter: of their rows.
        terms: extra parameters of these.

    Raises:
        LogError: the logs are too short.

    Warns:
        TorchidWarning: the best delay is at an end of those that are tried.
    """
    ridge = max(fitter.estimator.ridge, _RIDGE)
    fitter = replace(fitter, estimator=replace(fitter.estimator, ridge=ridge))  # type: ignore[type-var]
    plain = replace(fitter, estimator=LeastSquares(ridge, rank_tolerance=fitter.estimator.rank_tolerance))
    few, many = (_torques(logs, fitter, most) for most in (_DELAY_TRIAL_SAMPLES, _DELAY_SAMPLES))

    def residual(fitter: LogFitter, logs: Sequence[_Torques], delay: float) -> float:
        problem = fitter.build_problem(compress_parts([log.by(delay) for log in logs], fitter.builder))
        return fitter.estimator.solve(problem.assembly.problem).residual_std

    tried = share_between_forks(_TRIED_DELAYS.tolist(), lambda delay: residual(plain, few, delay), thread_count())
    best, term = _best(many, fitter, terms, float(_TRIED_DELAYS[int(np.argmin(tried))]))
    choice = _choice(best, term, residual(fitter, many, best), residual(fitter, many, 0.0))
    if not choice.confounded_with and _is_at_end(choice.found):
        warn(f"actuators.delay: {choice.found:g} s or beyond; are torques and positions stamped by the same clock?")
    return choice


def _best(logs: Sequence[_Torques], fitter: LogFitter, terms: ExtraTerms, delay: float) -> tuple[float, ExtraEstimate]:
    """The delay that leaves least, by steps from one [s], and the term of a further one in the last fit."""
    fitter = with_terms(fitter, replace(terms, slope=True))
    for _ in range(_DELAY_STEPS):
        fit = fitter.fit(compress_in_blocks([log.by(delay) for log in logs], fitter.builder))
        term = next(x for x in fit.extras if x.extra.what == SLOPE)
        before, delay = delay, float(np.clip(delay + term.value, EARLIEST_DELAY, LATEST_DELAY))
        if not np.isfinite(term.standard_error) or abs(delay - before) <= _DELAY_SETTLED * term.standard_error:
            break
    return delay, term


def _is_at_end(delay: float) -> bool:
    """Whether no delay beyond was tried, so that its standard error says nothing."""
    return delay in (EARLIEST_DELAY, LATEST_DELAY)


def _choice(best: float, term: ExtraEstimate, left: float, undelayed: float) -> DelayChoice:
    """The choice of the best delay, with the term of the last fit."""
    reach = _QUANTILE * term.standard_error
    confounded = () if term.separable else term.confounded_with or ("other parameters",)
    known = bool(np.isfinite(reach))
    return DelayChoice(
        delay=0.0 if confounded or not abs(best) > reach else float(f"{best:.4g}"),
        found=best,
        standard_error=term.standard_error if known else None,
        interval=(best - reach, best + reach) if known else None,
        inflation=term.inflation if np.isfinite(term.inflation) else None,
        confounded_with=confounded,
        residual=left,
        undelayed_residual=undelayed,
    )


@dataclass(frozen=True)
class _Torques:
    """Some samples of a log, whose measured joint torques can be taken from any time around.

    `dofs`: of these torques; `splines`: through them, each for some of the samples.
    """

    samples: Samples
    dofs: Tensor
    splines: list[tuple[Tensor, BSpline]]

    def by(self, delay: float) -> Samples:
        """The samples with torques of a delay [s], whose slope is what a further delay takes off."""
        samples = self.samples
        torque = samples.time.new_zeros(len(samples), 0) if samples.torque is None else samples.torque.clone()
        slope = torch.zeros_like(torque)
        for own, spline in self.splines:
            time = samples.time[own].numpy() - delay
            torque[own[:, None], self.dofs] = torch.from_numpy(spline(time))
            slope[own[:, None], self.dofs] = torch.from_numpy(spline(time, 1))
        return replace(samples, torque=torque, slope=slope)


def _torques(logs: Sequence[Samples], fitter: LogFitter, most: int) -> list[_Torques]:
    """About so many samples of all logs, evenly spaced, with their torques.

    Raises:
        LogError: the logs are too short for the delays that are tried.
    """
    step, out = max(1, sum(map(len, logs)) // most), list[_Torques]()
    dofs = torch.from_numpy(np.flatnonzero(fitter.builder.sensors.torque[: fitter.robot.n]))
    for log in logs:
        time = log.time.numpy()
        chosen = np.flatnonzero(recorded_at_delays(time, (EARLIEST_DELAY, LATEST_DELAY)))[::step]
        if log.torque is None or not len(chosen):
            continue
        oversampling = max(1.0, log.oversampling / step)
        some = replace(log[torch.from_numpy(chosen)], oversampling=oversampling, folder=None, motion_noise=None)
        recorded, splines = log.torque[:, dofs].numpy(), list[tuple[Tensor, BSpline]]()
        for segment in unbroken_segments(time):
            own = np.flatnonzero((chosen >= segment.start) & (chosen < segment.stop))
            if len(own):
                degree = spline_degree(segment.stop - segment.start)
                splines.append((torch.from_numpy(own), make_interp_spline(time[segment], recorded[segment], k=degree)))
        out.append(_Torques(some, dofs, splines))
    if not out:
        found = f"auto, but none is longer than the {LATEST_DELAY - EARLIEST_DELAY:g} s of delays that are tried"
        raise LogError(logs[0].source if logs else "logs", "actuators.delay", found, "a number [s]")
    return out
