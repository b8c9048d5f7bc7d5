"""Experiments on simulated robots, as a user would run them, and what came of them."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path

import numpy as np
import yaml

from legged.errors import ParameterErrors, parameter_errors
from legged.gait import Reference
from legged.recording import Noise, record
from legged.robots import ROBOTS, Legged, TrueRobot
from legged.simulate import Exact, simulated
from torchid.commands.identify import identify
from torchid.commands.run_folder import Identification
from torchid.config import load_config
from torchid.errors import TorchidError
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
    if legged.kind == "point":
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
            feet = (POINT, BALL_AS_POINT, BALL)
        for one in feet:
            for signal in signals:
                yield from (Case(robot, one, signal, chosen) for chosen in sensors)
