"""Simulated legged robots unlike their URDFs: how far is what `torchid identify` finds from the truth?

    python scripts/legged_accuracy.py                               # Go2 with ball and point feet, G1 with flat ones
    python scripts/legged_accuracy.py --seconds 8 --seeds 0 --robots Go2 --sensors full
    python scripts/legged_accuracy.py estimator.ridge=auto          # settings of the experiment file

MuJoCo simulates a robot with other masses, centres of mass and inertias than its URDF's, with friction and armature in
its joints, which sways, crawls and trots. Signals are exact (positions, rates and forces of one instant), sampled
(exact positions, torques, forces and IMU at 500 Hz, rates derived by the preprocessing), or noisy (encoders 1e-3 rad,
gyroscope 0.01 rad/s, accelerometer 0.05 m/s^2, torques 0.3 N m). Errors of base parameters are given as shares of the
URDF's errors, their median over all combinations; errors of joint torques are those on a second log that no fit has
seen. Each is the largest of some robots. Needs MuJoCo and the package example-robot-data (extra `[oracle]`).
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

from legged.accuracy import FEET, SENSORS, SIGNALS, Case, Outcome, Simulated, examine
from legged.robots import ROBOTS, require_available
from markdown_table import Rows, print_table

from torchid.boundary import run_guarded


def accuracy_table(
    robots: Sequence[str] = ("Go2", "G1"),
    signals: Sequence[str] = ("exact", "noisy"),
    sensors: str = "joints",
    seeds: Sequence[int] = (0, 1, 2),
    seconds: float = 20.0,
    overrides: Sequence[str] = (),
) -> Rows:
    """Errors by robot and feet, for each kind of signals."""
    quantities = ("base parameters", "joint torques", "total mass [g]")
    yield ["robot", *(f"{signal}: {quantity}" for signal in signals for quantity in quantities)]
    with tempfile.TemporaryDirectory() as folder:

        @cache
        def simulation(robot: str, rolling: bool, seed: int) -> Simulated:
            legged = ROBOTS[robot] if rolling else replace(ROBOTS[robot], radius=0.0)
            place = Path(folder, f"{robot} {rolling} {seed}")
            place.mkdir()
            return Simulated(legged, seconds, seed, place)

        for robot in robots:
            for feet in FEET[ROBOTS[robot].kind]:
                cells = []
                for signal in signals:
                    case = Case(robot, feet, signal, sensors)
                    cells += _cells([examine(case, simulation(robot, feet.rolling, x), overrides) for x in seeds])
                yield [f"{robot}, {feet.name}", *cells]


def _cells(outcomes: Sequence[Outcome]) -> list[str]:
    """The largest errors."""
    parameters = max(x.errors.median for x in outcomes)
    torques = max(x.torque_error / x.urdf_torque_error for x in outcomes)
    mass = max(abs(x.errors.mass - x.true_mass) for x in outcomes)
    return [f"{x:.2g}" for x in (parameters, torques, 1e3 * mass)]


def run(options: argparse.Namespace) -> None:
    """Simulate, identify, print."""
    require_available(options.robots)
    print_table(accuracy_table(**vars(options)))


def main() -> int:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("overrides", nargs="*", help="key.subkey=value of the experiment file")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the training log")
    parser.add_argument("--robots", nargs="+", choices=list(ROBOTS), default=["Go2", "G1"])
    parser.add_argument("--signals", nargs="+", choices=SIGNALS, default=["exact", "noisy"])
    parser.add_argument("--sensors", choices=[*SENSORS, "contacts"], default="joints")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    options = parser.parse_intermixed_args()
    return run_guarded("legged_accuracy", lambda: run(options))


if __name__ == "__main__":
    raise SystemExit(main())
