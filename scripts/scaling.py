"""Time and memory of a fit against samples, processes and bodies, beside per-sample pipelines: one figure.

    python scripts/scaling.py [--samples 10000 100000 1000000] [--ranks 1 2 4] [--output docs/scaling.png]

Needs what `scripts/benchmark.py` needs. From the arrays of a log to parameters, `joints` sensors, least squares, one
thread for each process. Processes are started by torchrun; each measures a whole fit, all of them the same.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from benchmark import CASES, Bench, Case, PerSample, medians, robots_folder
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from torchid.distributed import join_launched, leave_launched, share_work
from torchid.report.figure_style import save_figure

CASTERS = tuple(f"caster_{end}_{side}_2_link" for end in ("front", "back") for side in ("left", "right"))
ROBOTS = (
    Case("Bolt", "bolt_description/robots/bolt.urdf", ("FL_FOOT", "FR_FOOT"), "point"),
    *CASES,
    Case("Talos", "talos_data/robots/talos_reduced.urdf", ("left_sole_link", "right_sole_link"), "flat"),
    Case("Centauro", "centauro_description/urdf/centauro.urdf", tuple(f"wheel_{k}" for k in range(1, 5)), "point"),
    Case("TIAGo dual", "tiago_description/robots/tiago_dual.urdf", CASTERS, "point"),
)


def measure_bodies(case: Case, repeats: int) -> dict[str, float]:
    """Bodies, and median microseconds per sample of each pipeline."""
    bench = Bench.of(case, 16384)
    few = bench.samples[torch.arange(0, len(bench.samples), 32)]
    peer = PerSample(robots_folder() / case.urdf, bench.robot, case)
    pipelines: dict[str, tuple[Callable[[], object], int]] = {
        "per sample, lstsq": (lambda: peer.by_stack(few), len(few)),
        "per sample, Gram": (lambda: peer.by_gram(few), len(few)),
        "torchid": (bench.fit, len(bench.samples)),
    }
    return {"bodies": float(len(bench.robot.bodies))} | medians(pipelines, repeats)


def measure_rank(count: int) -> None:
    """Print seconds and MiB that a fit of Solo12 takes in this process beyond the arrays."""
    bench = Bench.of(CASES[0], 4096)
    bench.fit()
    bench = Bench.of(CASES[0], count)
    launched = join_launched()
    with share_work():
        before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
        bench.fit()
        seconds = time.perf_counter() - start
    added = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    if os.environ.get("RANK", "0") == "0":
        print(seconds, added / 1024.0)
    if launched:
        leave_launched(0)


def measure_ranks(count: int, ranks: int) -> tuple[float, float]:
    """Seconds and MiB of the first of some processes."""
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(ranks)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*launch, __file__, "--measure", str(count)], env=environment, capture_output=True, text=True, check=True
    )
    seconds, added = map(float, done.stdout.split()[-2:])
    return seconds, added


def draw(
    by_ranks: dict[int, list[tuple[float, float]]], counts: Sequence[int], by_bodies: Sequence[dict[str, float]]
) -> Figure:
    """Seconds and memory against samples, microseconds per sample against bodies."""
    figure = Figure(figsize=(11.0, 3.8), layout="constrained")
    seconds, memory, bodies = figure.subplots(1, 3)
    for ranks, measured in by_ranks.items():
        label = "1 process" if ranks == 1 else f"{ranks} processes"
        seconds.loglog(counts, [x for x, _ in measured], "o-", label=f"torchid, {label}")
        memory.semilogx(counts, [x for _, x in measured], "o-", label=f"torchid, {label}")
    [solo] = (x for case, x in zip(ROBOTS, by_bodies, strict=True) if case is CASES[0])
    for name, style in (("per sample, lstsq", "--"), ("per sample, Gram", ":")):
        extrapolated = [1e-6 * solo[name] * count for count in counts]
        seconds.loglog(counts, extrapolated, style, color="0.5", label=f"{name}, extrapolated")
    ordered = sorted(by_bodies, key=lambda x: x["bodies"])
    for name, style in (("torchid", "o-"), ("per sample, Gram", "^--"), ("per sample, lstsq", "s--")):
        bodies.semilogy([x["bodies"] for x in ordered], [x[name] for x in ordered], style, label=name)
    label_axes(seconds, "samples of Solo12", "time of a fit [s]")
    label_axes(memory, "samples of Solo12", "memory beyond the arrays [MiB]")
    label_axes(bodies, "bodies", "time per sample, one thread [µs]")
    seconds.set_ylim(top=30.0 * seconds.get_ylim()[1])  # room for the legend
    memory.set_ylim(0.0, 1.4 * memory.get_ylim()[1])
    for axis in (seconds.xaxis, seconds.yaxis, memory.xaxis, bodies.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    return figure


def label_axes(axes: Axes, x: str, y: str) -> None:
    """Name both axes and show the legend."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, nargs="+", default=[10_000, 100_000, 1_000_000])
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--output", type=Path, default=Path("docs/scaling.png"))
    parser.add_argument("--measure", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.measure:
        measure_rank(options.measure)
        return
    by_ranks = {ranks: [measure_ranks(count, ranks) for count in options.samples] for ranks in options.ranks}
    for ranks, measured in by_ranks.items():
        print(f"{ranks} ranks:", "; ".join(f"{x:.2f} s, {y:.0f} MiB" for x, y in measured))
    by_bodies = [measure_bodies(case, options.repeats) for case in ROBOTS]
    for case, measured_bodies in zip(ROBOTS, by_bodies, strict=True):
        print(case.name, measured_bodies)
    save_figure(draw(by_ranks, options.samples, by_bodies), options.output)


if __name__ == "__main__":
    main()
