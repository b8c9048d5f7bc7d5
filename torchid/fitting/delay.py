"""The delay between recorded joint torques, or those of a command, and the torques that act, by what a fit leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.interpolate import BSpline, make_interp_spline
from torch import Tensor

from torchid.errors import LogError, warn
from torchid.estimators import LeastSquares
from torchid.fitting.fit import LogFitter
from torchid.fitting.left_out import with_terms
from torchid.identifiability.confounding import ExtraEstimate
from torchid.logs.segments import recorded_at_delays, unbroken_segments
from torchid.logs.timeline import spline_degree
from torchid.parallel import share_between_forks, thread_count
from torchid.problem import ExtraTerms, Samples
from torchid.problem.compression import compress_in_blocks, compress_parts
from torchid.problem.extras import SLOPE

EARLIEST, LATEST = -0.02, 0.06
"""Delays that are tried [s]: beyond, the stamps are those of another clock."""

_FEW, _MANY = 1000, 5000  # samples of all logs, evenly spaced, to try delays, and to find the best
_TRIED = np.linspace(EARLIEST, LATEST, 17)  # [s]
_RIDGE = 1e-6  # the residual is smooth in the delay where the data determine some parameters badly
_STEPS, _SETTLED = 8, 1e-2  # Gauss-Newton steps, and standard errors below which one ends them
_QUANTILE = 1.96  # standard errors from the middle to the end of a 95 % interval


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
    few, many = (_torques(logs, fitter, most) for most in (_FEW, _MANY))

    def residual(fitter: LogFitter, logs: Sequence[_Torques], delay: float) -> float:
        problem = fitter.build_problem(compress_parts([log.by(delay) for log in logs], fitter.builder))
        return fitter.estimator.solve(problem.assembly.problem).residual_std

    tried = share_between_forks(_TRIED.tolist(), lambda delay: residual(plain, few, delay), thread_count())
    best, term = _best(many, fitter, terms, float(_TRIED[int(np.argmin(tried))]))
    choice = _choice(best, term, residual(fitter, many, best), residual(fitter, many, 0.0))
    if not choice.confounded_with and _is_at_end(choice.found):
        warn(f"actuators.delay: {choice.found:g} s or beyond; are torques and positions stamped by the same clock?")
    return choice


def _best(logs: Sequence[_Torques], fitter: LogFitter, terms: ExtraTerms, delay: float) -> tuple[float, ExtraEstimate]:
    """The delay that leaves least, by steps from one [s], and the term of a further one in the last fit."""
    fitter = with_terms(fitter, replace(terms, slope=True))
    for _ in range(_STEPS):
        fit = fitter.fit(compress_in_blocks([log.by(delay) for log in logs], fitter.builder))
        term = next(x for x in fit.extras if x.extra.what == SLOPE)
        before, delay = delay, float(np.clip(delay + term.value, EARLIEST, LATEST))
        if not np.isfinite(term.standard_error) or abs(delay - before) <= _SETTLED * term.standard_error:
            break
    return delay, term


def _is_at_end(delay: float) -> bool:
    """Whether no delay beyond was tried, so that its standard error says nothing."""
    return delay in (EARLIEST, LATEST)


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
        chosen = np.flatnonzero(recorded_at_delays(time, (EARLIEST, LATEST)))[::step]
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
        found = f"auto, but none is longer than the {LATEST - EARLIEST:g} s of delays that are tried"
        raise LogError(logs[0].source if logs else "logs", "actuators.delay", found, "a number [s]")
    return out
