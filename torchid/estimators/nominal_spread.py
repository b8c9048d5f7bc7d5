"""By how much nominal parameters are off, by the likelihood of what the data determine (empirical Bayes)."""

from __future__ import annotations

import numpy as np

from torchid.parameters import FRICTION, PER_BODY, Array
from torchid.problem import LinearProblem
from torchid.problem.elimination import eliminate_columns
from torchid.rounding import RANK_TOLERANCE, is_significant

NARROWEST, WIDEST = 0.01, 10.0
"""Errors of nominal bodies, as shares of them, that are considered."""

WIDTHS = np.geomspace(NARROWEST, WIDEST, 300)  # 2.3 % each
_LEAST_NOISE = 1e-8  # of rows without any, as a share of the rms of the forces


def nominal_spread(problem: LinearProblem, noise: float) -> Array:
    """Standard deviation of the nominal values of the free parameters, (P',), in units of their scale.

    One for inertial parameters and one for friction, which files seldom state, each with the other group at its best:
    the root of the mean square over all widths, weighted by their likelihood. The likeliest alone may be the narrowest
    by chance where data say little.

    Args:
        problem: of a fit.
        noise: standard deviation of its rows, correlation counted.
    """
    columns = problem.A[:, problem.free] * problem.scale[problem.free]
    target = problem.b - problem.A @ problem.nominal
    place, spread = np.flatnonzero(problem.free) % PER_BODY, np.zeros(columns.shape[1])
    size = max(float(np.linalg.norm(problem.b)), float(np.linalg.norm(columns)))
    if size == 0.0:
        return spread
    noise = max(noise, _LEAST_NOISE * size / max(problem.rows, 1) ** 0.5)
    of_friction = (place >= FRICTION.start) & (place < FRICTION.stop)
    for group in (~of_friction, of_friction):
        whole = np.column_stack([columns[:, ~group], columns[:, group], target])
        rows = eliminate_columns(whole, range(np.count_nonzero(~group))) / noise
        likelihood = likelihood_of_widths(rows, WIDTHS)
        if likelihood is not None:
            weight = np.exp(0.5 * (likelihood - likelihood.max()))
            spread[group] = np.sqrt(weight @ np.square(WIDTHS) / weight.sum())
    return spread


def likelihood_of_widths(rows: Array, widths: Array) -> Array | None:
    """Twice the logarithm of the likelihood of widths (W,), (W,); None where the rows determine nothing.

    Source: type-II maximum likelihood (MacKay, Neural Computation 4, 1992).

    Args:
        rows: (R, c + 1), with noise of unit variance: columns of deviations from the nominal values, and right-hand
            sides that are left at these.
        widths: standard deviations of the deviations.
    """
    U, values, _ = np.linalg.svd(rows[:, :-1], full_matrices=False)
    kept = is_significant(values, RANK_TOLERANCE)
    if not kept.any():
        return None
    found, of_data = np.square(U[:, kept].T @ rows[:, -1]), 1.0 + np.outer(np.square(widths), np.square(values[kept]))
    return np.asarray(-(np.log(of_data) + found / of_data).sum(axis=1))
