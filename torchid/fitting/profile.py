"""Settings on which rows depend nonlinearly: each value with a linear fit of all others, and the best.

Source: Golub and Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares problems", 1973.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np
import torch
from scipy.interpolate import BSpline, make_interp_spline
from scipy.optimize import minimize, minimize_scalar

from torchid.errors import InputError, LogError, warn
from torchid.estimators import LeastSquares
from torchid.fitting.fit import Fit, LogFitter
from torchid.fitting.left_out import Evidence, Reading, thinned, widest, with_terms
from torchid.identifiability.confounding import ExtraEstimate
from torchid.logs.segments import recorded_at_delays, unbroken_segments
from torchid.logs.timeline import spline_degree
from torchid.parallel import share_between_forks, thread_count
from torchid.parameters import Array
from torchid.problem import ExtraTerms, Samples, compress_parts
from torchid.problem.compression import compress_in_blocks
from torchid.problem.extras import SLOPE, dof_extra_column

EARLIEST_DELAY = -0.02
LATEST_DELAY = 0.06
"""Search range of delays [s]; beyond, the stamps come from another clock."""

LARGEST_TILT = 0.3
"""Search range of the tilt about each axis [rad]; more means another frame."""

_DELAYS = np.linspace(EARLIEST_DELAY, LATEST_DELAY, 17)  # [s]
_WIDTHS = tuple(10.0 ** np.arange(-2.0, 0.25, 0.25))  # [rad/s or m/s]
_VELOCITIES = tuple(10.0 ** np.arange(-2.0, 1.25, 0.25))  # [rad/s or m/s], of Stribeck friction
_RADII = (0.0, 0.015, 0.03, 0.045)  # [m] of balls about the frames of feet
_FIRST_WIDTHS = (0.01, 0.1)  # [rad/s or m/s]; if neither predicts better than the sign, the search stops

# of all logs, evenly spaced
_DELAY_TRIAL_SAMPLES = 1000
_TILT_SAMPLES = 2000
_SAMPLES = 5000
_WIDTH_GAIN = 0.05  # least decrease of the squared error for a width
_TILT_GAIN = 1e-3  # least relative decrease of the residual for a tilt
_RIDGE = 1e-6  # makes the residual a smooth function of the setting
# of Gauss and Newton; in standard errors
_MAX_STEPS = 8
_SETTLED_STEP = 1e-2
# of the residual's square; of the logarithm to base 10
_TILT_SETTLED = 1e-6
_WIDTH_SETTLED = 1e-3
_LOG_VELOCITY_STEP = 1e-3  # of differences
_AT_REST_CHANCE = 0.025  # probability of apparent static friction by chance
_AT_END = "the end of the search range"
_QUANTILE = 1.96  # standard errors from the middle to the end of a 95 % interval


@dataclass(frozen=True)
class Profile:
    """A setting chosen by the logs, with the residuals of fits with other values.

    Attributes:
        value: the chosen value: a number, a flag or two angles; None or 0 for none.
        text: the value with its reason, in words.
        tried: tried values; the first means none.
        error: residual (or error on left-out blocks) of these fits, divided by that of none.
        best: the value of least error. `value` differs from it if the gain may be chance.
        share: error with `best` divided by that with none.
        interval: 95 % interval around `best`; None if the data do not determine it, or left-out blocks decide.
    """

    value: Any
    text: str
    tried: tuple[Any, ...]
    error: tuple[float, ...] = ()
    best: Any = None
    share: float | None = None
    interval: tuple[float, float] | None = None
    inflation: float | None = None
    confounded_with: tuple[str, ...] = ()

    def __str__(self) -> str:
        return self.text


# ----------------------------------------------------------------------------------- by the residual of all samples


def choose_delay(logs: Sequence[Samples], fitter: LogFitter, terms: ExtraTerms) -> Profile:
    """Choose the delay [s] whose fit leaves the least residual; recorded torques act this much later.

    The estimator's conditions hold throughout, because a negative armature would look like a delay. Torques are splines
    between samples, so the delay can be a fraction of a step.

    Args:
        logs: bound training logs, read without a delay and low-pass filtered. (Without a filter, noise is smaller
            between samples, which would bias the choice.)
        fitter: of the rows.
        terms: extra parameters of the rows.

    Raises:
        LogError: the logs are too short.

    Warns:
        TorchidWarning: the best delay is at an end of the search range.
    """
    fitter = _with_ridge(fitter)
    plain = replace(fitter, estimator=fitter.least_squares)
    sloped = with_terms(fitter, replace(terms, slope=True))
    trial, torques = (_torques(logs, fitter, count) for count in (_DELAY_TRIAL_SAMPLES, _SAMPLES))

    def delayed(splines: Sequence[_Torques], delay: float) -> list[Samples]:
        return [log.by(delay) for log in splines]

    error = share_between_forks(_DELAYS.tolist(), lambda x: _residual(delayed(trial, x), plain), thread_count())
    start = float(_DELAYS[int(np.argmin(error))])
    bounds = (EARLIEST_DELAY, LATEST_DELAY)
    best, _, term = _gauss_newton(lambda delay: (delayed(torques, delay), sloped), start, bounds)
    with_none = _residual(delayed(torques, 0.0), fitter)
    share = _residual(delayed(torques, best), fitter) / max(with_none, 1e-300)
    reach = _QUANTILE * term.standard_error
    profile = _profile(
        term,
        best=best,
        interval=(best - reach, best + reach),
        share=share,
        none=0.0,
        rejected="not significantly different from 0" if not abs(best) > reach else "",
        in_units=lambda delay: f"{1e3 * delay:.3g} ms",
        tried=(0.0, *_DELAYS.tolist()),
        error=(error[int(np.abs(_DELAYS).argmin())], *error),
    )
    if best in bounds:
        if not profile.confounded_with:
            warn(f"actuators.delay: {best:g} s, {_AT_END}. Check that torques and positions are stamped by one clock")
        return replace(profile, text=f"{profile}; {_AT_END}")
    return profile


def choose_stribeck(
    logs_and_fitter: Callable[[float | None], tuple[Sequence[Samples], LogFitter]], terms: ExtraTerms
) -> Profile:
    """Choose the Stribeck velocity [rad/s or m/s] with the least residual, one for all joints.

    The static friction of each joint is fitted too. None if it is not significant, or the data do not determine the
    velocity.

    Args:
        logs_and_fitter: bound training logs, preprocessed with a velocity (None for no Stribeck friction), and a
            fitter.
        terms: extra parameters of the rows.
    """

    def thin(velocity: float | None) -> tuple[list[Samples], LogFitter]:
        logs, fitter = logs_and_fitter(velocity)
        return thinned(logs, _SAMPLES), _with_ridge(fitter)

    with_none = _residual(*thin(None))  # reads the logs, which forks then have
    residuals = share_between_forks(_VELOCITIES, lambda velocity: _residual(*thin(velocity)), thread_count())
    first = int(np.argmin(residuals))
    neighbours = _VELOCITIES[max(first - 1, 0)], _VELOCITIES[min(first + 1, len(_VELOCITIES) - 1)]
    low, high = np.log(neighbours)
    log_best, fit, term = _gauss_newton(
        lambda x: _with_slope_of_velocity(thin, float(np.exp(x)), terms), math.log(_VELOCITIES[first]), (low, high)
    )
    best = math.exp(log_best)
    reach = _QUANTILE * term.standard_error
    low = best * np.exp(-reach)
    high = best * np.exp(reach)
    at_rest = [x for x in fit.extras if x.extra.what == "stribeck"]
    significance = max((x.value / x.standard_error for x in at_rest if x.standard_error > 0.0), default=0.0)
    required = -NormalDist().inv_cdf(_AT_REST_CHANCE / max(len(at_rest), 1))
    return _profile(
        term,
        best=best,
        interval=(low, high),
        share=fit.estimate.residual_std / max(with_none, 1e-300),
        none=None,
        needless=""
        if significance > required
        else "friction at rest is not significantly larger than Coulomb friction",
        rejected="" if low > _VELOCITIES[0] and high < _VELOCITIES[-1] else "the data do not determine it",
        in_units=lambda velocity: f"{velocity:.3g} rad/s (m/s)",
        tried=(None, *_VELOCITIES),
        error=(with_none, *residuals),
    )


def choose_base_tilt(logs: Sequence[Samples], fitter: LogFitter) -> Profile:
    """Choose the tilt about the base's x and y axes [rad] with the least residual (see `torchid.load_robot`).

    Args:
        logs: bound training logs of a robot without a tilt.
        fitter: of the rows.

    Warns:
        TorchidWarning: the best tilt is at the end of the search range, `LARGEST_TILT`.
    """
    step = max(1, sum(map(len, logs)) // _TILT_SAMPLES)
    logs = [log.every(step) for log in logs]
    estimator = LeastSquares(_RIDGE, rank_tolerance=fitter.estimator.rank_tolerance)

    def squared_residual(tilt: Array) -> float:
        tilted = [replace(log, base=log.base.tilted(tilt, len(log))) for log in logs]
        return float(fitter.fit(compress_parts(tilted, fitter.builder), estimator.solve).estimate.residual_std ** 2)

    level = max(squared_residual(np.zeros(2)), np.finfo(float).tiny)
    searched = minimize(
        lambda tilt: squared_residual(tilt) / level,
        np.zeros(2),
        method="L-BFGS-B",
        jac="3-point",
        bounds=[(-LARGEST_TILT, LARGEST_TILT)] * 2,
        options={"ftol": _TILT_SETTLED},
    )
    share = math.sqrt(searched.fun)
    is_better = share < 1.0 - _TILT_GAIN
    if is_better and np.abs(searched.x).max() >= LARGEST_TILT:
        warn(f"robot.base_tilt: {LARGEST_TILT:g} rad, {_AT_END}. Is the base's orientation that of another frame?")
    x, y = np.rad2deg(searched.x)
    text = f"none: no tilt explains the forces better (best: {_ratio(share)})"
    if is_better:
        text = f"{x:.2f} and {y:.2f} degrees about the base's x and y axes; {_ratio(share)}"
    return Profile(
        value=(float(f"{searched.x[0]:.4g}"), float(f"{searched.x[1]:.4g}")) if is_better else (0.0, 0.0),
        text=text,
        tried=((0.0, 0.0), tuple(searched.x.tolist())),
        error=(1.0, share),
        best=tuple(searched.x.tolist()),
        share=share,
    )


def _ratio(share: float) -> str:
    return f"residual {share:.3g} times that without"


def _with_ridge(fitter: LogFitter) -> LogFitter:
    ridge = max(fitter.estimator.ridge, _RIDGE)
    return replace(fitter, estimator=replace(fitter.estimator, ridge=ridge))  # type: ignore[type-var]


def _residual(logs: Sequence[Samples], fitter: LogFitter) -> float:
    """Standard deviation of the whitened residuals of a fit."""
    problem = fitter.build_problem(compress_parts(logs, fitter.builder)).assembly.problem
    return fitter.estimator.solve(problem).residual_std


def _gauss_newton(
    rows_at: Callable[[float], tuple[list[Samples], LogFitter]], start: float, bounds: tuple[float, float]
) -> tuple[float, Fit, ExtraEstimate]:
    """The value of least residual, by steps with the setting as one more unknown, and the last fit with its term.

    Source: Kaufman, "A variable projection method for solving separable nonlinear least squares problems", 1975. The
    term's standard error is that of the setting, to first order.

    Args:
        rows_at: at a value, samples whose `slope` is the change of the torques with the setting, and a fitter.
        start: of the search.
        bounds: of the search.
    """
    value = start
    for _ in range(_MAX_STEPS):
        logs, fitter = rows_at(value)
        fit = fitter.fit(compress_in_blocks(logs, fitter.builder))
        term = next(x for x in fit.extras if x.extra.what == SLOPE)
        before = value
        value = float(np.clip(value + term.value, *bounds))
        if not np.isfinite(term.standard_error) or abs(value - before) <= _SETTLED_STEP * term.standard_error:
            break
    return value, fit, term


def _profile(
    term: ExtraEstimate,
    *,
    best: float,
    interval: tuple[float, float],
    share: float,
    none: float | None,
    rejected: str,
    in_units: Callable[[float], str],
    tried: tuple[float | None, ...],
    error: Sequence[float],
    needless: str = "",
) -> Profile:
    """The profile of a best value; `needless`, `rejected`: reason why it is not used, or ""."""
    confounded = () if term.separable else term.confounded_with or ("other parameters",)
    known = bool(np.isfinite(term.standard_error))
    span = "95 %: {} to {}".format(*map(in_units, interval)) if known else ""
    if confounded:
        rejected = f"every value, such as {in_units(best)}, is confounded with {', '.join(confounded)}"
    elif not known:
        rejected = "the data do not determine it"
    elif rejected:
        rejected = f"{in_units(best)} ({span}): {rejected}"
    value: float | None = float(f"{best:.4g}")
    text = f"{in_units(best)} ({span}); {_ratio(share)}"
    if needless or rejected:
        value = none
        text = f"none: {needless or rejected} (best: {_ratio(share)})"
    return Profile(
        value=value,
        text=text,
        tried=tried,
        error=tuple(x / max(error[0], 1e-300) for x in error),
        best=best,
        share=share,
        interval=interval if known else None,
        inflation=term.inflation if np.isfinite(term.inflation) else None,
        confounded_with=confounded,
    )


def _with_slope_of_velocity(
    thin: Callable[[float | None], tuple[list[Samples], LogFitter]], velocity: float, terms: ExtraTerms
) -> tuple[list[Samples], LogFitter]:
    """Samples at a Stribeck velocity with `slope` the derivative of friction by its logarithm, and a fitter."""
    (before, low), (logs, fitter), (after, high) = (
        thin(velocity * math.exp(x)) for x in (-_LOG_VELOCITY_STEP, 0.0, _LOG_VELOCITY_STEP)
    )
    slopes = [log.joint_velocity.new_zeros(len(log), fitter.robot.n) for log in logs]
    for term in fitter.fit(compress_parts(logs, fitter.builder)).extras:
        if term.extra.what == "stribeck" and term.extra.dof is not None:
            for slope, earlier, later in zip(slopes, before, after, strict=True):
                less = dof_extra_column(term.extra, term.extra.dof, earlier, low.builder.tree)
                more = dof_extra_column(term.extra, term.extra.dof, later, high.builder.tree)
                slope[:, term.extra.dof] = term.value * (more - less) / (2.0 * _LOG_VELOCITY_STEP)
    sloped = with_terms(fitter, replace(terms, stribeck=velocity, slope=True))
    return [replace(log, slope=slope) for log, slope in zip(logs, slopes, strict=True)], sloped


@dataclass(frozen=True)
class _Torques:
    """Samples of a log with splines through their joint torques (`dofs`), to evaluate them at other times."""

    samples: Samples
    dofs: torch.Tensor
    splines: list[tuple[torch.Tensor, BSpline]]

    def by(self, delay: float) -> Samples:
        """Samples with torques of a delay [s]; their slope is the change by a further delay."""
        samples = self.samples
        torque = samples.time.new_zeros(len(samples), 0) if samples.torque is None else samples.torque.clone()
        slope = torch.zeros_like(torque)
        for at, spline in self.splines:
            time = samples.time[at].numpy() - delay
            torque[at[:, None], self.dofs] = torch.from_numpy(spline(time))
            slope[at[:, None], self.dofs] = torch.from_numpy(spline(time, 1))
        return replace(samples, torque=torque, slope=slope)


def _torques(logs: Sequence[Samples], fitter: LogFitter, most: int) -> list[_Torques]:
    """About this many evenly spaced samples of all logs, with splines of their torques.

    Raises:
        LogError: the logs are shorter than the search range.
    """
    step = max(1, sum(map(len, logs)) // most)
    out = list[_Torques]()
    dofs = torch.from_numpy(np.flatnonzero(fitter.builder.sensors.torque[: fitter.robot.n]))
    for log in logs:
        time = log.time.numpy()
        chosen = np.flatnonzero(recorded_at_delays(time, (EARLIEST_DELAY, LATEST_DELAY)))[::step]
        if log.torque is None or not len(chosen):
            continue
        oversampling = max(1.0, log.oversampling / step)
        samples = replace(log[torch.from_numpy(chosen)], oversampling=oversampling, folder=None, motion_noise=None)
        recorded = log.torque[:, dofs].numpy()
        splines = list[tuple[torch.Tensor, BSpline]]()
        for segment in unbroken_segments(time):
            at = np.flatnonzero((chosen >= segment.start) & (chosen < segment.stop))
            if len(at):
                degree = spline_degree(segment.stop - segment.start)
                splines.append((torch.from_numpy(at), make_interp_spline(time[segment], recorded[segment], k=degree)))
        out.append(_Torques(samples, dofs, splines))
    if not out:
        reason = f"auto, but no log is longer than the {LATEST_DELAY - EARLIEST_DELAY:g} s of the search range"
        raise LogError(logs[0].source if logs else "logs", "actuators.delay", reason, "a number [s], or longer logs")
    return out


# --------------------------------------------------------------------------------------------------- by left-out blocks


def choose_sign_width(read: Callable[[float | None], Reading], kinds: Sequence[str]) -> Profile:
    """Choose the narrowest width [rad/s or m/s] that predicts left-out blocks as well as the width of least residual.

    A wider one with the same error could hide friction errors elsewhere. None if no width predicts better than the
    sign.

    Args:
        read: reads the logs with a width, None for the sign.
        kinds: of the fitted extra parameters.
    """
    none = "none: tanh(velocity / width) does not predict left-out blocks better than the sign"
    sign = read(None).left_out(kinds)
    gains = [Evidence.of(sign, read(width).left_out(kinds)) for width in _FIRST_WIDTHS]
    if not any(evidence.certain and evidence.gain > _WIDTH_GAIN for evidence in gains):
        return Profile(None, none, (None,), (1.0,))

    def errors(width: float | None) -> tuple[float, Array]:
        reading = read(width)
        return math.sqrt(reading.noise_variance), reading.left_out(kinds)

    tried = (None, *_WIDTHS)
    errors_of = dict(zip(tried, share_between_forks(tried, errors, thread_count()), strict=True))
    residual = {width: std for width, (std, _) in errors_of.items()}
    best = min(residual, key=lambda width: residual[width])
    width = next(x for x in tried if not Evidence.of(errors_of[x][1], errors_of[best][1]).certain)
    if width == best and width is not None:  # the best is the only candidate
        place = _WIDTHS.index(width)
        bounds = np.log10([_WIDTHS[max(place - 1, 0)], _WIDTHS[min(place + 1, len(_WIDTHS) - 1)]])
        options = {"xatol": _WIDTH_SETTLED}
        searched = minimize_scalar(lambda x: errors(10.0**x)[0], bounds=bounds, method="bounded", options=options)
        best = width = 10.0 ** float(searched.x)
        residual[width] = float(searched.fun)
    share = min(residual.values()) / residual[None]
    text = none if width is None else f"{width:.4g} rad/s (m/s); best {_ratio(share)}"
    return Profile(
        value=None if width is None else float(f"{width:.4g}"),
        text=text,
        tried=tuple(residual),
        error=tuple(x / residual[None] for x in residual.values()),
        best=best,
        share=share,
    )


def choose_radius(read: Callable[[float | None], Reading], kinds: Sequence[str]) -> Profile:
    """Choose the radius [m] of balls about the foot frames that predicts left-out blocks best.

    The optimum is that of a parabola. None if the shapes of the robot's file predict as well, or if the logs do not
    contain the direction of the ground.

    Args:
        read: reads the logs with a radius, None for the shapes of the file.
        kinds: of the fitted extra parameters.
    """
    text = "of the robot's file: balls about the foot frames do not predict left-out blocks better"
    in_file = read(None).left_out(kinds)
    try:
        gains = [Evidence.of(in_file, read(radius).left_out(kinds)).gain for radius in _RADII]
    except InputError:
        return Profile(None, text, (None,))
    curvature, slope, _ = np.polyfit(_RADII, np.negative(gains), 2)
    best = float(f"{-0.5 * slope / curvature:.3g}") if curvature > 0.0 else 0.0
    evidence = Evidence(0.0, 0.0, 0)
    if _RADII[0] < best < _RADII[-1]:
        evidence = Evidence.of(in_file, read(best).left_out(kinds))
    if evidence.adopted:
        text = f"balls of {1e3 * best:.3g} mm about the foot frames (error on left-out blocks {evidence})"
    return Profile(
        value=best if evidence.adopted else None,
        text=text,
        tried=(None, *_RADII),
        error=(1.0, *np.exp(-0.5 * np.array(gains)).tolist()),
        best=best,
        share=math.exp(-0.5 * evidence.gain),
    )


_LEAST_LEFT = 0.3  # of the rows, that a setting may leave


def choose_data(read: Mapping[Any, Callable[[], Reading]], kinds: Sequence[str]) -> Profile:
    """Choose the first of several settings, which leave out more and more data, that predicts as well as the others.

    Args:
        read: reads the logs, by value of the setting.
        kinds: of the fitted extra parameters.

    Raises:
        InputError: the first setting leaves no data.
    """
    readings: list[Reading] = []
    for number, read_one in enumerate(read.values()):
        try:
            reading = read_one()
        except InputError:  # nothing is left
            if not number:
                raise
            break
        if readings and reading.rows.sum() < _LEAST_LEFT * readings[0].rows.sum():
            break
        readings.append(reading)
    tried = tuple(read)
    value = tried[widest(readings, kinds)]
    reason = "a fit to all samples predicts left-out blocks worse"
    if value == tried[0]:
        reason = "a fit without these samples does not predict left-out blocks better"
    if value is None or isinstance(value, bool):
        name = {None: "none", False: "counted", True: "left out"}[value]
    else:
        name = f"{value:g} s"
    return Profile(value, f"{name}: {reason}", tried)
