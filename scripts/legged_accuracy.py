"""Simulated legged robots unlike their URDFs: how far is what `torchid identify` finds from the truth?

    python scripts/legged_accuracy.py                                   # Go2 with ball feet, G1 with flat ones
    python scripts/legged_accuracy.py --quick --robots Go2 --sensors joints
    python scripts/legged_accuracy.py estimator.ridge=auto              # settings of the experiment file
    python scripts/legged_accuracy.py --json accuracy.json

MuJoCo simulates a robot with other masses, centres of mass and inertias than its URDF's, with friction and armature in
its joints, which sways, crawls and trots. Signals are exact (positions, rates and forces of one instant), sampled
(exact positions, torques, forces and IMU at 500 Hz, rates derived by the preprocessing), or noisy (encoders 1e-3 rad,
gyroscope 0.01 rad/s, accelerometer 0.05 m/s^2, torques 0.3 N m). Errors of base parameters are given as shares of the
URDF's errors, their median over all combinations, those of forces for a second log that no fit has seen. Needs MuJoCo
and the package example-robot-data (extra `[oracle]`).
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from legged.accuracy import GROUPS, SENSORS, SIGNALS, Outcome, Simulated, cases, examine
from legged.robots import ROBOTS, require_available
from rich.console import Console
from rich.table import Table

from torchid.boundary import run_guarded


def table(outcomes: Sequence[Outcome]) -> Table:
    """One row for each experiment."""
    title = (
        "errors of base parameters as shares of the URDF's (medians), and of forces on an unseen log, URDF > identified"
    )
    out = Table(title=title)
    for name in ("robot", "feet", "signals", "sensors"):
        out.add_column(name)
    columns = (
        "all",
        "inertial",
        "friction",
        "worse",
        "mass [kg]",
        "joints [N m]",
        "force [N]",
        "moment [N m]",
        "rank",
        "s",
    )
    for name in columns:
        out.add_column(name, justify="right")
    for x in outcomes:
        head = (x.robot, x.feet, x.signals, x.sensors)
        if x.errors is None or x.forces is None:
            out.add_row(*head, f"refused: {x.refused}"[:60])
            continue
        e = x.errors
        forces = [" > ".join("-" if one is None else f"{one:.3g}" for one in x.forces[group]) for group in GROUPS]
        mass = f"{e.mass:.3f} ± {x.mass_error:.3f} ({x.true_mass:.3f}, URDF {x.urdf_mass:.3f})"
        shares = (f"{e.median:.2g}", f"{e.inertial:.2g}", f"{e.friction:.2g}", f"{100.0 * e.worse:.0f} %")
        out.add_row(*head, *shares, mass, *forces, str(x.identified), f"{x.seconds:.0f}")
    return out


def run(options: argparse.Namespace) -> None:
    """Simulate, identify, print."""
    seconds = 8.0 if options.quick else options.seconds
    require_available(options.robots)
    outcomes = []
    with tempfile.TemporaryDirectory() as folder:
        there: dict[tuple[str, bool], Simulated] = {}
        for case in cases(options.robots, options.signals, options.sensors):
            key = case.robot, case.feet.rolling
            if key not in there:
                legged = ROBOTS[case.robot]
                legged = legged if case.feet.rolling else replace(legged, radius=0.0)
                there[key] = Simulated(legged, seconds, options.seed, Path(folder))
            outcomes.append(examine(case, there[key], options.overrides))
    Console(width=200).print(table(outcomes))
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(x) for x in outcomes], indent=1))


def main() -> int:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("overrides", nargs="*", help="key.subkey=value of the experiment file")
    parser.add_argument("--quick", action="store_true", help="logs of 8 s")
    parser.add_argument("--seconds", type=float, default=30.0, help="length of the training log")
    parser.add_argument("--robots", nargs="+", choices=list(ROBOTS), default=["Go2", "G1"])
    parser.add_argument("--signals", nargs="+", choices=SIGNALS, default=list(SIGNALS))
    parser.add_argument("--sensors", nargs="+", choices=[*SENSORS, "contacts"], default=list(SENSORS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_intermixed_args()
    return run_guarded("legged_accuracy", lambda: run(options))


if __name__ == "__main__":
    raise SystemExit(main())
