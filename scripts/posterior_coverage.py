"""Do 95 % credible intervals hold the truth in 95 % of cases? The same motion, with new noise again and again.

    python scripts/posterior_coverage.py                                   # UR5, Solo12 and G1
    python scripts/posterior_coverage.py --repetitions 20 --robots UR5

The robots and motions of `posterior_accuracy.py`, with friction in all joints: no interval holds a friction that is 0.
In each repetition torques have new noise, and 1000 samples give the interval from the 2.5th to the 97.5th percentile of
every combination that the data determine: those along which they are at least ten times as sharp as the prior, singular
vectors of the rows in units of the prior.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from markdown_table import Rows, print_table
from posterior_accuracy import ROBOTS, Synthetic

from torchid.boundary import run_guarded
from torchid.estimators.truncated_gaussian import TruncatedGaussian
from torchid.parameters import Array

_SAMPLES = 1000
_SHARPER = 10.0


def covered(one: Synthetic, repetition: int, prior_error: float) -> Array:
    """Whether the intervals of the combinations that the data determine hold the truth."""
    posterior = one.posterior(repetition)
    conic, free = posterior.conic_problem(prior_error), posterior.free
    sampler = TruncatedGaussian(conic, posterior.owners())
    x = sampler.draw(_SAMPLES, torch.Generator().manual_seed(repetition)).numpy()
    true = ((one.true.flatten() - posterior.nominal) / posterior.scale)[free]
    rows = (posterior.A[:, free] * posterior.scale[free]) @ conic.deviations
    alone = replace(posterior, A=posterior.A[:0], D=posterior.D[:0], b=posterior.b[:0])
    prior = alone.conic_problem(prior_error).root
    _, values, Vt = np.linalg.svd(rows @ np.linalg.inv(prior), full_matrices=False)
    known = Vt[values > _SHARPER] @ prior
    return _inside(x @ known.T, known @ np.linalg.solve(conic.deviations, true))


def _inside(draws: Array, truth: Array) -> Array:
    low, high = np.quantile(draws, (0.025, 0.975), axis=0)
    return (low <= truth) & (truth <= high)


def posterior_table(repetitions: int = 200, robots: Sequence[str] = tuple(ROBOTS), prior_error: float = 0.2) -> Rows:
    """Coverage by robot."""
    yield ["robot", "combinations", "average [%]", "5th percentile of them [%]"]
    for name in robots:
        robot = Synthetic(name, 0, rough=1.0)
        share = 100.0 * np.mean([covered(robot, number, prior_error) for number in range(repetitions)], axis=0)
        yield [name, f"{len(share)}", f"{share.mean():.1f}", f"{np.quantile(share, 0.05):.1f}"]


def main() -> int:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=200)
    parser.add_argument("--robots", nargs="+", choices=list(ROBOTS), default=list(ROBOTS))
    parser.add_argument("--prior-error", type=float, default=0.2)
    options = parser.parse_args()
    return run_guarded("posterior_coverage", lambda: print_table(posterior_table(**vars(options))))


if __name__ == "__main__":
    raise SystemExit(main())
