"""The delay between recorded joint torques, or those of a command, and the torques that act, by what a fit leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.polynomial import chebyshev
from scipy.interpolate import BSpline, make_interp_spline
from torch import Tensor

from torchid.errors import LogError, warn
from torchid.estimators import LeastSquares
from torchid.fitting.fit import Fit, LogFitter
from torchid.identifiability.confounding import ExtraEstimate
from torchid.logs.segments import recorded_at_delays, unbroken_segments
from torchid.logs.timeline import spline_degree
from torchid.parallel import in_forks, share_between_forks, thread_count
from torchid.parameters import Array
from torchid.problem import ExtraTerms, RowBuilder, Samples
from torchid.problem.compression import compress_in_blocks, compress_parts
from torchid.problem.extras import DELAY
from torchid.problem.linear import TriangularFactor
from torchid.problem.parts import Part, merge_blocks_of_folds, merge_states

EARLIEST, LATEST = -0.02, 0.06
"""Delays that are tried [s]: beyond, the stamps are those of another clock."""

_FEW, _MANY = 1000, 5000  # samples of all logs, evenly spaced, to try delays, and to find the best
_TRIED, _AROUND, _PASSES = 17, 0.005, 4  # delays that are tried; [s] to both sides of the best of them; looks there
_WIDE, _NARROW = 24, 16  # delays whose torques make up those of all between: 80 ms to 1e-6 up to 50 Hz, 20 ms to 100 Hz
_SAME = 1e-5  # [s]: scales of torques are those of torques that are as near as this
_RIDGE = 1e-6  # the residual is smooth in the delay where the data determine some parameters badly
_STEPS, _SETTLED = 8, 1e-2  # Gauss-Newton steps, and standard errors below which one ends them
_SHRINKING = 0.8  # ratio of two steps below which their series is trusted to go on
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

    Everything else is linear, and fitted anew for each delay: separable least squares (Golub and Pereyra, 1973). The
    logs are compressed with the torques of several delays, of which those of any between are a combination, so that
    no sample is looked at again; steps are those of Gauss and Newton with the delay as one more unknown (Kaufman,
    1975), whose standard error is that of the delay. Physical conditions of the estimator hold throughout: a negative
    armature would explain a delay. Torques are splines between samples, so that the delay can be a part of a step.

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
    choice = _search(logs, fitter, terms)
    if not choice.confounded_with and _is_at_end(choice.found):
        warn(f"actuators.delay: {choice.found:g} s or beyond; are torques and positions stamped by the same clock?")
    return choice


def _search(logs: Sequence[Samples], fitter: LogFitter, terms: ExtraTerms) -> DelayChoice:
    ridge = max(fitter.estimator.ridge, _RIDGE)
    fitter = replace(fitter, estimator=replace(fitter.estimator, ridge=ridge))  # type: ignore[type-var]
    plain = replace(fitter, estimator=LeastSquares(ridge, rank_tolerance=fitter.estimator.rank_tolerance))
    wide = _Delays(_torques(logs, fitter, _FEW), plain, terms, (EARLIEST, LATEST), 0.0, _WIDE)
    tried = np.linspace(EARLIEST, LATEST, _TRIED)
    best = float(tried[int(np.argmin(share_between_forks(tried.tolist(), wide.residual, thread_count())))])
    many = _torques(logs, fitter, _MANY)
    for _ in range(_PASSES):
        ends = max(EARLIEST, min(best, 0.0) - _AROUND), min(LATEST, max(best, 0.0) + _AROUND)
        near = _Delays(many, fitter, terms, ends, best, _NARROW, in_blocks=True)
        before, best = best, near.best(best)
        is_scaled = any(extra.what == "scale" for extra in fitter.builder.extras)
        if (best not in ends or _is_at_end(best)) and not (is_scaled and abs(best - before) > _SAME):
            break
    with in_forks([best, 0.0], near.residual, max(thread_count() - 1, 1)) as residuals:
        term = near.term(near.fit_in_blocks(best))
        left, without = residuals()
    return _choice(best, term, left, without)


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


class _Delays:
    """Logs compressed with torques of several delays, and fits with those of any between."""

    def __init__(
        self,
        logs: Sequence[_Torques],
        fitter: LogFitter,
        terms: ExtraTerms,
        ends: tuple[float, float],
        recorded: float,
        count: int,
        in_blocks: bool = False,
    ) -> None:
        """Compress.

        Args:
            logs: with their torques.
            fitter: of their rows.
            terms: extra parameters of these.
            ends: of the delays [s].
            recorded: delay of what counts as the torques that were read, which scales of sensors go with [s].
            count: of the torques.
            in_blocks: with factors for each of some blocks.
        """
        of, self.ends, self.recorded = fitter.builder, ends, recorded
        self.rows, self.plain, self.with_delay = (
            replace(fitter, builder=RowBuilder(fitter.robot, of.contacts, of.sensors, own).to(of.device))
            for own in (replace(terms, delays=count), terms, replace(terms, delay=True))
        )
        nodes = chebyshev.chebpts1(count)
        self.by_node = np.linalg.inv(chebyshev.chebvander(nodes, count - 1))  # polynomials of values at the nodes
        delays = 0.5 * (ends[0] + ends[1]) + 0.5 * (ends[1] - ends[0]) * nodes
        samples = [log.by(recorded, delays) for log in logs]
        compress = compress_in_blocks if in_blocks else compress_parts
        self.parts = compress(samples, self.rows.builder)
        self.together = merge_states(merge_blocks_of_folds(self.parts, self.rows.builder), self.rows.builder)

    def residual(self, delay: float) -> float:
        """Standard deviation of whitened residuals of the fit with torques of a delay [s]."""
        problem = self.plain.build_problem([self._of(part, delay, False) for part in self.together])
        return self.plain.estimator.solve(problem.assembly.problem).residual_std

    def fit(self, delay: float) -> Fit:
        """With torques of a delay [s], and a further, unknown one, to first order."""
        fitter = self.with_delay
        return fitter.solve_problem(fitter.build_problem([self._of(part, delay, True) for part in self.together]))

    def fit_in_blocks(self, delay: float) -> Fit:
        """The same with standard errors by the scatter between blocks."""
        return self.with_delay.fit([self._of(part, delay, True) for part in self.parts])

    def best(self, delay: float) -> float:
        """The delay that leaves least, between the ends, by steps from one [s].

        Two that shrink begin a geometric series, to whose end the third goes (Aitken).
        """
        before = 0.0
        for _ in range(_STEPS):
            term = self.term(self.fit(delay))
            found = float(np.clip(delay + term.value, *self.ends))  # exactly an end where it is one: it is compared
            delay, step = found, found - delay
            if not np.isfinite(term.standard_error) or abs(step) <= _SETTLED * term.standard_error:
                break
            ratio = step / before if before else 0.0
            if 0.0 < ratio < _SHRINKING:
                delay, step = float(np.clip(delay + step * ratio / (1.0 - ratio), *self.ends)), 0.0
            before = step
        return delay

    @staticmethod
    def term(fit: Fit) -> ExtraEstimate:
        """The further delay of a fit with an unknown one."""
        return next(x for x in fit.extras if x.extra.what == DELAY)

    def _weights(self, delay: float, order: int) -> Array:
        """Of the torques at the nodes in that of a delay [s], (count,), or in its derivative by the delay."""
        half = 0.5 * (self.ends[1] - self.ends[0])
        polynomials = chebyshev.chebder(self.by_node, order, axis=0) if order else self.by_node
        return np.asarray(chebyshev.chebval((delay - self.ends[0]) / half - 1.0, polynomials) / half**order)

    def _of(self, part: Part, delay: float, unknown: bool) -> Part:
        """The part of a fit with torques of a delay."""
        width = self.plain.builder.width
        values = torch.from_numpy(self._weights(delay, 0) - self._weights(self.recorded, 0))
        slopes = torch.from_numpy(self._weights(delay, 1))
        factor = TriangularFactor(width + unknown)
        factor.rows, factor.independent_rows = part.factor.rows, part.factor.independent_rows
        for support, block in part.factor.blocks.items():
            rows = block.cpu().double()
            own = [k for k, column in enumerate(support) if column < width]
            delayed = [k for k, column in enumerate(support) if column >= width]
            nodes = [support[k] - width for k in delayed]
            right = rows[:, -1] + rows[:, delayed] @ values[nodes]
            columns, kept = [rows[:, own]], tuple(support[k] for k in own)
            if (
                unknown and nodes
            ):  # torques of a delay d are those of d0, less (d - d0) times their rate: the column is the rate
                columns.append(-(rows[:, delayed] @ slopes[nodes])[:, None])
                kept = (*kept, width)
            factor.absorb(kept, torch.cat([*columns, right[:, None]], dim=1))
        return replace(part, factor=factor)


@dataclass(frozen=True)
class _Torques:
    """Some samples of a log, whose measured joint torques can be taken from any time around.

    `dofs`: of these torques; `splines`: through them, each for some of the samples.
    """

    samples: Samples
    dofs: Tensor
    splines: list[tuple[Tensor, BSpline]]

    def by(self, recorded: float, delays: Array) -> Samples:
        """The samples with torques of a delay [s] in place of the recorded, and those of several, (D,)."""
        samples = self.samples
        torque = samples.time.new_zeros(len(samples), 0) if samples.torque is None else samples.torque.clone()
        delayed = samples.time.new_zeros(len(samples), len(delays), torque.shape[1])
        for own, spline in self.splines:
            time = samples.time[own].numpy()
            torque[own[:, None], self.dofs] = torch.from_numpy(spline(time - recorded))
            earlier = torch.from_numpy(spline(time[:, None] - delays))  # (samples, D, dofs)
            delayed[own[:, None, None], torch.arange(len(delays))[:, None], self.dofs] = earlier
        return replace(samples, torque=torque, delayed_torque=delayed)


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
