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
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr
from dataclasses import asdict, dataclass, replace
from io import StringIO
from pathlib import Path

import numpy as np
import yaml
from legged.errors import ParameterErrors, parameter_errors
from legged.gait import Reference
from legged.recording import Noise, record
from legged.robots import ROBOTS, Legged, TrueRobot, can_roll
from legged.simulate import Exact, simulated
from rich.console import Console
from rich.table import Table

from torchid.boundary import run_guarded
from torchid.commands.identify import identify
from torchid.commands.results import Identification
from torchid.config import load_config
from torchid.errors import InputError, TorchidError
from torchid.logs import Log, write_log

SIGNALS = ("exact", "sampled", "noisy")
SENSORS = ("joints", "full")
GROUPS = ("joint_torque", "base_force", "base_moment")
CUTOFF = 20.0
NO_NOISE = Noise().times(0.0, 0.0)


@dataclass(frozen=True)
class Feet:
    """How feet touch the ground in the simulation, and what torchid takes them for."""

    name: str
    rolling: bool
    assumed_rolling: bool


BALL_AS_POINT, BALL, POINT, FLAT = (
    Feet("ball feet, as points", True, False),
    Feet("ball feet", True, True),
    Feet("point feet", False, False),
    Feet("flat feet", True, True),
)


@dataclass(frozen=True)
class Case:
    """One experiment."""

    robot: str
    feet: Feet
    signals: str
    sensors: str


@dataclass(frozen=True)
class Outcome:
    """What came of it.

    `forces`: rms errors on the unseen log by group of rows, of the URDF and of the identified parameters; `refused`:
    the message, where torchid refuses the fit.
    """

    robot: str
    feet: str
    signals: str
    sensors: str
    true_mass: float
    urdf_mass: float
    errors: ParameterErrors | None = None
    mass_error: float | None = None
    identified: int = 0
    residual: float | None = None
    forces: dict[str, tuple[float | None, float | None]] | None = None
    verdict: str | None = None
    seconds: float = 0.0
    refused: str | None = None


class Simulated:
    """Training and unseen logs of a robot, exact, and their files."""

    def __init__(self, legged: Legged, seconds: float, seed: int, folder: Path) -> None:
        """Simulate both.

        Raises:
            ValueError: the robot falls.
        """
        self.legged, self.folder = legged, folder
        self.true = TrueRobot.unlike_its_urdf(legged, seed)
        self.exact = {
            name: self._simulate(name, length, 2 * seed + number)
            for number, (name, length) in enumerate({"train": seconds, "test": 0.4 * seconds}.items())
        }

    def _simulate(self, name: str, seconds: float, seed: int) -> Exact:
        return simulated(self.true, Reference(self.true, seconds, seed), seconds, name)

    def files(self, signals: str) -> dict[str, Path]:
        """Logs of some signals, written once."""
        paths = {
            name: self.folder / f"{self.legged.name}_{self.legged.radius}_{signals}_{name}.npz" for name in self.exact
        }
        for number, (name, path) in enumerate(paths.items()):
            if not path.exists():
                write_log(self._log(name, signals, number), path)
        return paths

    def _log(self, name: str, signals: str, number: int) -> Log:
        exact, base = self.exact[name], self.true.robot.base_link
        if signals == "exact":
            return exact.log
        noise = Noise() if signals == "noisy" else NO_NOISE
        return record(exact, base, noise, np.random.default_rng([number, 11]))


def experiment(case: Case, one: Simulated, contacts: list[dict[str, object]]) -> dict[str, object]:
    """The experiment file of a case."""
    files = one.files(case.signals)
    return {
        "robot": {"urdf": str(one.legged.urdf)},
        "contacts": contacts,
        "logs": {"train": [str(files["train"])], "test": [str(files["test"])]},
        "preprocessing": {} if case.signals == "exact" else {"cutoff_hz": CUTOFF, "sample_rate_hz": 100},
        "sensors": case.sensors,
        "actuators": {"armature": case.sensors != "contacts"},
        "output": str(one.folder / "run"),
    }


def contact_entries(case: Case, legged: Legged) -> list[dict[str, object]]:
    """`contacts` of the experiment file."""
    entries: list[dict[str, object]] = [{"frame": foot, "type": legged.kind} for foot in legged.feet]
    if legged.kind == "point" and can_roll():
        entries = [entry | {"radius": legged.radius if case.feet.assumed_rolling else 0.0} for entry in entries]
    return entries


def examine(case: Case, one: Simulated, overrides: Sequence[str]) -> Outcome:
    """Identify and compare with the truth."""
    true, path = one.true, one.folder / "experiment.yaml"
    path.write_text(yaml.safe_dump(experiment(case, one, contact_entries(case, one.legged))))
    masses = float(true.phi[:, 0].sum()), float(true.robot.nominal[:, 0].sum())
    outcome = Outcome(case.robot, case.feet.name, case.signals, case.sensors, *masses)
    start = time.process_time()
    try:
        with warnings.catch_warnings(), redirect_stderr(StringIO()):
            warnings.simplefilter("ignore")
            run = identify(load_config(path, [*overrides, "overwrite=true"]))
    except TorchidError as error:
        return replace(outcome, refused=str(error))
    return replace(_filled(outcome, true, run), seconds=time.process_time() - start)


def _filled(outcome: Outcome, true: TrueRobot, run: Identification) -> Outcome:
    pair = run.metrics["test"]
    return replace(
        outcome,
        errors=parameter_errors(true, run.phi),
        mass_error=run.mass.standard_error,
        identified=run.estimate.rank,
        residual=run.estimate.residual_std,
        forces={group: (pair.nominal.rms.get(group), pair.identified.rms.get(group)) for group in GROUPS},
        verdict="; ".join(f"{x}" for x in run.worse) or None,
    )


def cases(robots: Sequence[str], signals: Sequence[str], sensors: Sequence[str]) -> Iterator[Case]:
    """All combinations that there are."""
    for robot in robots:
        feet: tuple[Feet, ...] = (FLAT,)
        if ROBOTS[robot].kind == "point":
            feet = (POINT, BALL_AS_POINT, *((BALL,) if can_roll() else ()))
        for one in feet:
            for signal in signals:
                yield from (Case(robot, one, signal, chosen) for chosen in sensors)


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
    for name in options.robots:
        if not ROBOTS[name].available:
            found = f"{name}, whose URDF is not there ({ROBOTS[name].urdf})"
            raise InputError("arguments", "--robots", found, "the package example-robot-data installed")
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
