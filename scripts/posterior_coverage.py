"""Do 95 % credible intervals hold the truth in 95 % of cases? The same motion, with new noise again and again.

    python scripts/posterior_coverage.py                        # 200 repetitions of UR5, Solo12 and G1
    python scripts/posterior_coverage.py --quick                # 20 repetitions of UR5

The robots and motions of `posterior_accuracy.py`; in each repetition torques have new noise, and 1000 samples give the
interval from the 2.5th to the 97.5th percentile of every combination that the data determine: those singular vectors
of the rows along which they are at least ten times as sharp as the prior. Friction counts by itself where it is one.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from posterior_accuracy import ROBOTS, Synthetic
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from torchid.boundary import run_guarded
from torchid.estimators.elliptical_slice import EllipticalSlice
from torchid.parameters import FRICTION, PER_BODY, Array

_SAMPLES = 1000


def covered(one: Synthetic, repetition: int, prior_error: float) -> tuple[Array, Array]:
    """Whether the intervals of friction that the data determine, and of singular combinations, hold the truth."""
    posterior = one.posterior(repetition)
    conic = posterior.conic_problem(prior_error)
    sampler = EllipticalSlice(conic, posterior.owners())
    x = sampler.draw(_SAMPLES, torch.Generator().manual_seed(repetition)).numpy() @ conic.deviations.T
    free = posterior.free
    true = ((one.true.flatten() - posterior.nominal) / posterior.scale)[free]
    rows = posterior.A[:, free] * posterior.scale[free]
    _, values, Vt = np.linalg.svd(rows, full_matrices=False)
    known = Vt[values > 10.0 / prior_error]
    projector = known.T @ known
    friction = np.flatnonzero(free) % PER_BODY >= FRICTION.start
    single = friction & (np.linalg.norm(np.eye(len(true)) - projector, axis=0) < 0.1)
    return _inside(x[:, single], true[single]), _inside(x @ known.T, known @ true)


def _inside(draws: Array, truth: Array) -> Array:
    low, high = np.quantile(draws, (0.025, 0.975), axis=0)
    return (low <= truth) & (truth <= high)


def run(options: argparse.Namespace) -> None:
    """Repeat, count, print."""
    table = Table(title="coverage of 95 % credible intervals [%]")
    for name in ("robot", "repetitions", "friction", "average", "combinations", "average", "5th percentile"):
        table.add_column(name)
    repetitions = 20 if options.quick else options.repetitions
    console = Console(width=120)
    with Progress(console=Console(stderr=True), transient=True) as bars:
        for name in ["UR5"] if options.quick else options.robots:
            bar, one = bars.add_task(name, total=repetitions), Synthetic(name, options.seed)
            singles, sums = [], []
            for repetition in range(repetitions):
                single, combined = covered(one, repetition, options.prior_error)
                singles.append(single)
                sums.append(combined)
                bars.advance(bar)
            single, combined = 100.0 * np.mean(singles, axis=0), 100.0 * np.mean(sums, axis=0)
            table.add_row(
                name,
                f"{repetitions}",
                f"{len(single)}",
                f"{single.mean():.1f}" if len(single) else "-",
                f"{len(combined)}",
                f"{combined.mean():.1f}",
                f"{np.quantile(combined, 0.05):.1f}",
            )
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
