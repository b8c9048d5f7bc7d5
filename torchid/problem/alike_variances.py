"""Variances of sources of noise that are alike, such as motors of one make: as far apart as residuals show them to be.

Logarithms of such variances are taken as normal about a common mean, neither of which is known: where residuals
determine each, it keeps its own, and where they do not, it has that of all. How far they are apart is estimated too
(restricted maximum likelihood of a normal random effect; Breslow and Clayton, "Approximate Inference in Generalized
Linear Mixed Models", 1993; of variances: Smyth, "Linear Models and Empirical Bayes Methods", 2004).
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.optimize

from torchid.parameters import Array
from torchid.rounding import RANK_TOLERANCE

_LEAST, _MOST = 1e-4, 1e3  # variance of the logarithms: deviations are 0.5 % apart, or anything
_POINTS = 41
_HELD = 1e-6  # share of the information on other variances that is added to it: some may have none


def information_about(index: np.ndarray, information: Array, score: Array) -> tuple[Array, Array]:
    """Information (k, k) and score (k,) on the logarithms of some variances, while others are estimated too.

    Args:
        index: (k,), of these variances.
        information: Fisher information on the logarithms of all, (U, U).
        score: derivative of the likelihood by them, (U,).
    """
    others = np.setdiff1d(np.arange(len(score)), index)
    known = information[np.ix_(others, others)]
    known = known + np.diag(_HELD * np.diag(known) + np.finfo(float).tiny)
    across = scipy.linalg.solve(known, information[np.ix_(others, index)], assume_a="pos").T
    own = information[np.ix_(index, index)] - across @ information[np.ix_(others, index)]
    return own, score[index] - across @ score[others]


def prior_precision(logarithms: Array, information: Array, score: Array) -> Array:
    """Precision (k, k) of the deviations of logarithms of variances from their common mean, which is free.

    Args:
        logarithms: (k,), of the present variances.
        information: on them, (k, k).
        score: likewise, (k,).
    """
    count = len(logarithms)
    values, Q = np.linalg.eigh(information)
    kept = values > RANK_TOLERANCE * max(values[-1], np.finfo(float).tiny)
    values, Q = values[kept], Q[:, kept]
    root = np.sqrt(values)
    y, mean = Q.T @ (information @ logarithms + score) / root, root * Q.sum(0)

    def deviance(log_spread: float) -> float:
        variance = 1.0 + np.exp(log_spread) * values
        weight = mean @ (mean / variance)
        off = y - mean * (mean @ (y / variance) / weight)
        return float(np.log(variance).sum() + np.log(weight) + off @ (off / variance))

    grid = np.linspace(np.log(_LEAST), np.log(_MOST), _POINTS)
    best = int(np.argmin([deviance(x) for x in grid])) if len(values) > 1 else 0
    low, high = grid[max(best - 1, 0)], grid[min(best + 1, _POINTS - 1)]
    spread = scipy.optimize.minimize_scalar(deviance, bounds=(low, high), method="bounded").x if best else grid[0]
    return (np.eye(count) - 1.0 / count) / float(np.exp(spread))
