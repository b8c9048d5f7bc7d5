"""Do 95 % intervals hold the truth in 95 % of cases? The same motion, recorded with new noise again and again.

    python scripts/interval_coverage.py                     # 100 repetitions, two robots, all situations
    python scripts/interval_coverage.py --quick             # 10 repetitions
    python scripts/interval_coverage.py --robots Go2 --situations "filtered, switches, Coulomb" --json coverage.json

A robot that differs from its URDF follows a prescribed motion, with exact inverse dynamics, or walks in MuJoCo. Its
joint torques have noise of 0.3 N m, and, where the table says so, encoders noise of 1e-3 rad, gyroscope 0.01 rad/s,
accelerometer 0.05 m/s^2. Coverage is that of the base parameters that the fit determines (average, and the worst of
them), of single parameters called identified, and of the total mass. Go2 needs the package example-robot-data.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path

from legged.repetitions import SITUATIONS, Repetitions, Situation, summarize
from legged.robots import ROBOTS, require_available
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from torchid.boundary import run_guarded
from torchid.errors import UnknownNameError

Result = dict[str, float | str]


def measure(robot: str, situation: Situation, options: argparse.Namespace, bars: Progress) -> Result:
    """Coverage of one robot in one situation."""
    repetitions = 10 if options.quick else options.repetitions
    bar = bars.add_task(f"{robot}: {situation.name}", total=repetitions)
    start = time.process_time()
    found = summarize(
        Repetitions(robot, situation, options.seconds, options.seed).run(repetitions, lambda: bars.advance(bar))
    )
    bars.remove_task(bar)
    return {"robot": robot, "situation": situation.name, "seconds": time.process_time() - start, **found}


def table(results: Sequence[Result]) -> Table:
    """One row for each robot and situation."""
    out = Table(title="coverage of 95 % intervals [%]")
    for name in ("robot", "situation"):
        out.add_column(name)
    columns = (
        "average",
        "worst",
        "error / scatter",
        "bias / scatter",
        "number",
        "single",
        "mass",
        "residual",
        "misfit",
    )
    for name in columns:
        out.add_column(name, justify="right")
    for x in results:
        share = {name: f"{100.0 * float(x[name]):.1f}" for name in ("average", "worst", "parameters", "mass", "misfit")}
        out.add_row(
            str(x["robot"]),
            str(x["situation"]),
            share["average"],
            share["worst"],
            f"{x['ratio']:.2f}",
            f"{x['bias']:.2f}",
            f"{x['combinations']}",
            share["parameters"],
            f"{share['mass']} ({x['mass_error']:.3f}, rms {x['mass_off']:.3f})",
            f"{x['residual']:.2f}",
            share["misfit"],
        )
    return out


def run(options: argparse.Namespace) -> None:
    """Repeat, count, print."""
    require_available(options.robots)
    known = {situation.name: situation for situation in SITUATIONS}
    for name in options.situations:
        if name not in known:
            raise UnknownNameError("arguments", "--situations", name, known)
    console, results = Console(width=170), []
    with Progress(console=Console(stderr=True), transient=True) as bars:
        for robot in options.robots:
            for name in options.situations or known:
                results.append(measure(robot, known[name], options, bars))
                if options.json is not None:
                    options.json.write_text(json.dumps(results, indent=1))
    console.print(table(results))


def main() -> int:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="10 repetitions")
    parser.add_argument("--repetitions", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the log")
    parser.add_argument("--seed", type=int, default=17, help="of the noise; the documented figures are those of 17")
    parser.add_argument("--robots", nargs="+", choices=list(ROBOTS), default=["quadruped", "Go2"])
    parser.add_argument("--situations", nargs="+", default=[], help="by name; all if not given")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    return run_guarded("interval_coverage", lambda: run(options))


if __name__ == "__main__":
    raise SystemExit(main())
