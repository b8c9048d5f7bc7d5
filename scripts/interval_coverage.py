"""Do 95 % intervals hold the truth in 95 % of cases? The same motion, recorded with new noise again and again.

    python scripts/interval_coverage.py                     # two robots, all situations
    python scripts/interval_coverage.py --repetitions 10 --robots Go2 --situations "torque noise"

A robot that differs from its URDF follows a prescribed motion, with exact inverse dynamics, or walks in MuJoCo. Its
joint torques have noise of 0.3 N m, and, where the table says so, encoders noise of 1e-3 rad, gyroscope 0.01 rad/s,
accelerometer 0.05 m/s^2. Coverage is that of the base parameters that the fit determines (average / worst of them), and
of the total mass. Go2 needs the package example-robot-data.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from legged.repetitions import SITUATIONS, Repetitions, summarize
from legged.robots import ROBOTS, require_available
from markdown_table import Rows, print_table

from torchid.boundary import run_guarded
from torchid.errors import UnknownNameError

_SECONDS = 20.0  # of the log
_KNOWN = {situation.name: situation for situation in SITUATIONS}


def coverage_table(
    repetitions: int = 30, robots: Sequence[str] = ("quadruped", "Go2"), situations: Sequence[str] = tuple(_KNOWN)
) -> Rows:
    """Coverage of combinations and of the total mass by situation and robot."""
    heads = [f"{robot}: {what} [%]" for robot in robots for what in ("average / worst", "total mass")]
    yield ["recording", *heads]
    for name in situations:
        cells = []
        for robot in robots:
            shares = summarize(Repetitions(robot, _KNOWN[name], _SECONDS).run(repetitions))
            average, worst, mass = (100.0 * shares[key] for key in ("average", "worst", "mass"))
            cells += [f"{average:.1f} / {worst:.0f}", f"{mass:.0f}"]
        yield [name, *cells]


def run(options: argparse.Namespace) -> None:
    """Repeat, count, print."""
    require_available(options.robots)
    for name in options.situations:
        if name not in _KNOWN:
            raise UnknownNameError("arguments", "--situations", name, _KNOWN)
    print_table(coverage_table(options.repetitions, options.robots, options.situations))


def main() -> int:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=30)
    parser.add_argument("--robots", nargs="+", choices=list(ROBOTS), default=["quadruped", "Go2"])
    parser.add_argument("--situations", nargs="+", default=list(_KNOWN), help="by name")
    options = parser.parse_args()
    return run_guarded("interval_coverage", lambda: run(options))


if __name__ == "__main__":
    raise SystemExit(main())
