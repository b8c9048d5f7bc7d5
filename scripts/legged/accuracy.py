"""Experiments on simulated robots, as a user would run them, and what came of them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import numpy as np
import yaml

from legged.errors import ParameterErrors, parameter_errors
from legged.gait import Reference
from legged.recording import Noise, record
from legged.robots import Legged, TrueRobot
from legged.simulate import Exact, simulated
from torchid.commands.identify import identify
from torchid.config import load_config
from torchid.logs import Log, write_log

SIGNALS = ("exact", "sampled", "noisy")
SENSORS = ("joints", "full")
GROUPS = ("joint_torque", "base_force", "base_moment")
CUTOFF = 20.0
NO_NOISE = Noise().times(0.0, 0.0)


@dataclass(frozen=True)
class Feet:
    """How feet touch the ground in the simulation, and the radius [m] that the experiment file states for them."""

    name: str
    rolling: bool
    radius: float | str | None = None


FEET = {
    "point": (
        Feet("point feet", False, 0.0),
        Feet("ball feet", True),
        Feet("ball feet, `radius: auto`", True, "auto"),
        Feet("ball feet, `radius: 0`", True, 0.0),
    ),
    "flat": (Feet("flat feet", True),),
}
"""Feet to try, by the kind of a robot's contacts."""


@dataclass(frozen=True)
class Case:
    """One experiment."""

    robot: str
    feet: Feet
    signals: str
    sensors: str


@dataclass(frozen=True)
class Outcome:
    """What came of it: total mass [kg], rms errors of joint torques on the unseen log [N m]."""

    errors: ParameterErrors
    true_mass: float
    torque_error: float
    urdf_torque_error: float


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
    radius = legged.radius if case.feet.radius is None else case.feet.radius
    stated = {"radius": radius} if legged.kind == "point" else {}
    return [{"frame": foot, "type": legged.kind, **stated} for foot in legged.feet]


def examine(case: Case, one: Simulated, overrides: Sequence[str]) -> Outcome:
    """Identify and compare with the truth."""
    true, path = one.true, one.folder / "experiment.yaml"
    path.write_text(yaml.safe_dump(experiment(case, one, contact_entries(case, one.legged))))
    with warnings.catch_warnings(), redirect_stderr(StringIO()):
        warnings.simplefilter("ignore")
        run = identify(load_config(path, [*overrides, "overwrite=true"]))
    test = run.metrics["test"]
    return Outcome(
        parameter_errors(true, run.phi),
        float(true.phi[:, 0].sum()),
        test.identified.rms["joint_torque"] or 0.0,
        test.nominal.rms["joint_torque"] or 0.0,
    )
