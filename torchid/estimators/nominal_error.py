"""How far off the nominal parameters are where the data speak: the width of prior that makes the data likeliest."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from scipy.special import chdtri

from torchid.estimators.posterior import PRIOR_ERROR, Posterior
from torchid.parameters import INERTIAL, PER_BODY, Array
from torchid.problem.chunks import one_thread
from torchid.rounding import RANK_TOLERANCE, is_significant

NARROWEST, WIDEST = 0.01, 10.0
"""Errors of nominal bodies, as shares of them, that are considered."""

_STEPS = 300  # between these: 2.3 % each
_LEVEL = 1e-3  # share of robots whose files are as wrong as the prior says, and that are called otherwise
_MUCH = 1.5  # times the prior's width: less changes ranges little


@dataclass(frozen=True)
class NominalError:
    """By how much nominal bodies are off along what the data determine.

    Attributes:
        value: standard deviation as a share of each body, that makes the data likeliest; as `prior_error` has it.
        prior: that it was compared with.
        evidence: twice the logarithm of how much likelier the data are with `value`.
        combinations: of inertial parameters that the data determine better than a prior of this width does.
    """

    value: float
    prior: float
    evidence: float
    combinations: int

    @property
    def clear(self) -> bool:
        """Whether the data contradict the prior's width beyond chance.

        Source: the likelihood ratio test of one parameter (Wilks 1938).
        """
        return self.evidence > float(chdtri(1, _LEVEL))

    @property
    def prior_is_narrow(self) -> bool:
        """Whether bodies are much further off than the prior says, beyond chance."""
        return self.clear and self.value > _MUCH * self.prior

    def __str__(self) -> str:
        """How far bodies are off, in words."""
        off = f"{100.0 * self.value:.2g} %, {self.value / self.prior:.2g} times what the prior says"
        return f"where the data tell, in {self.combinations} combinations, bodies are off the robot file by {off}"


@one_thread()
def nominal_error(posterior: Posterior, prior_error: float = PRIOR_ERROR) -> NominalError | None:
    """The width of the prior by the data (empirical Bayes); None where these determine no inertial parameters.

    Bodies that data do not determine are taken to be as wrong as those that they do. Friction and extra parameters may
    have any value, as files seldom state them; conditions on the parameters are left out.

    Source: type-II maximum likelihood (MacKay, Neural Computation 4, 1992).

    Args:
        posterior: of a fit.
        prior_error: standard deviation of the nominal parameters, as a share of each body, to compare with.
    """
    inertial = np.zeros(len(posterior.nominal), dtype=bool).reshape(-1, PER_BODY)
    inertial[:, INERTIAL] = True
    inertial = inertial.flatten()[posterior.free]
    prior = replace(posterior, A=posterior.A[:0], D=posterior.D[:0], b=posterior.b[:0]).conic_problem(1.0)
    count = len(inertial)
    units = scipy.linalg.solve_triangular(prior.root[:count, :count], prior.deviations[:count, :count].T, trans=1).T
    columns = posterior.A[:, posterior.free] * posterior.scale[posterior.free]
    nuisance = np.hstack([columns[:, ~inertial], posterior.D * posterior.extra_size])
    rows = np.column_stack([columns @ units[:, inertial], posterior.b - posterior.A @ posterior.nominal])
    rows -= _projected(nuisance, rows)
    U, values, _ = np.linalg.svd(rows[:, :-1], full_matrices=False)
    kept = is_significant(values, RANK_TOLERANCE)
    if not kept.any():
        return None
    found, variance = np.square(U[:, kept].T @ rows[:, -1]), np.square(values[kept])
    widths = np.append(np.geomspace(NARROWEST, WIDEST, _STEPS), prior_error)
    of_data = 1.0 + np.square(widths)[:, None] * variance
    likelihood = -(np.log(of_data) + found / of_data).sum(axis=1)  # twice its logarithm
    best = int(likelihood.argmax())
    return NominalError(
        value=float(widths[best]),
        prior=prior_error,
        evidence=float(likelihood[best] - likelihood[-1]),
        combinations=int((widths[best] ** 2 * variance > 1.0).sum()),
    )


def _projected(columns: Array, rows: Array) -> Array:
    """Of rows (R, c), what columns (R, k) of unknowns take up."""
    U, values, _ = np.linalg.svd(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), full_matrices=False)
    U = U[:, is_significant(values, RANK_TOLERANCE)]
    return np.asarray(U @ (U.T @ rows))
