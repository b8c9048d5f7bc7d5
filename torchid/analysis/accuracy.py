"""How far off a fit is expected to be, before anything unseen is measured."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from torchid.parameters import Array
from torchid.problem import LinearProblem
from torchid.problem.threads import one_thread


@one_thread()
def error_directions(
    problem: LinearProblem, ridge: float, noise_variance: float, prior_error: float, rank_tolerance: float = 1e-10
) -> Array:
    """Independent errors of least squares with a ridge, (M, P): their outer products sum up to the error's covariance.

    Along each right singular vector of the scaled problem, with singular value s and r = ridge * rows, the noise of the
    rows enters by s / (s^2 + r) and the error of the nominal parameters stays by r / (s^2 + r); along directions that
    no row sees it stays in full. This is exact for white noise and independent nominal errors of one size.

    Args:
        problem: of the training logs.
        ridge: of the fit.
        noise_variance: of the whitened rows, as if they were independent.
        prior_error: standard deviation of the nominal parameters, as a share of `problem.scale`.
        rank_tolerance: of the fit.
    """
    scale = problem.scale[problem.free]
    _, values, Vh = scipy.linalg.svd(problem.A[:, problem.free] * scale, lapack_driver="gesvd")  # see `base_parameters`
    values = np.pad(values, (0, len(scale) - len(values)))
    values[values <= rank_tolerance * values.max(initial=0.0)] = 0.0
    pull = ridge * problem.rows
    with np.errstate(invalid="ignore", divide="ignore"):
        through = np.where(values > 0.0, values / (values**2 + pull), 0.0)
        kept = np.where(values > 0.0, pull / (values**2 + pull), 1.0)
    length = np.hypot(np.sqrt(noise_variance) * through, prior_error * kept)
    directions = np.zeros((len(scale), len(problem.free)))
    directions[:, problem.free] = length[:, None] * Vh * scale
    return directions
