"""Do 95 % credible intervals hold the truth in 95 % of cases? The same motion, with new noise again and again.

    python scripts/posterior_coverage.py                        # 200 repetitions of UR5, Solo12 and G1
    python scripts/posterior_coverage.py --quick                # 20 repetitions of UR5

The robots and motions of `posterior_accuracy.py`, with friction in all joints: no interval holds a friction that is 0.
In each repetition torques have new noise, and 1000 samples give the interval from the 2.5th to the 97.5th percentile of
every combination that the data determine: those along which they are at least ten times as sharp as the prior, singular
vectors of the rows in units of the prior.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import torch
from posterior_accuracy import ROBOTS, Synthetic
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

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


def run(options: argparse.Namespace) -> None:
    """Repeat, count, print."""
    table = Table(title="coverage of 95 % credible intervals [%]")
    for name in ("robot", "repetitions", "combinations", "average", "5th percentile of them"):
        table.add_column(name)
    repetitions = 20 if options.quick else options.repetitions
    console = Console(width=120)
    with Progress(console=Console(stderr=True), transient=True) as bars:
        for name in ["UR5"] if options.quick else options.robots:
            bar, one = bars.add_task(name, total=repetitions), Synthetic(name, options.seed, rough=1.0)
            found = []
            for repetition in range(repetitions):
                found.append(covered(one, repetition, options.prior_error))
                bars.advance(bar)
            share = 100.0 * np.mean(found, axis=0)
            texts = f"{len(share)}", f"{share.mean():.1f}", f"{np.quantile(share, 0.05):.1f}"
            table.add_row(name, f"{repetitions}", *texts)
    console.print(table)


def main() -> int:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="20 repetitions of UR5")
    parser.add_argument("--repetitions", type=int, default=200)
    parser.add_argument("--robots", nargs="+", choices=list(ROBOTS), default=list(ROBOTS))
    parser.add_argument("--prior-error", type=float, default=0.2)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    return run_guarded("posterior_coverage", lambda: run(options))


if __name__ == "__main__":
    raise SystemExit(main())
