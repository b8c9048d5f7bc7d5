"""Errors of `torchid init` and `torchid identify` on recordings by others, by default and with one setting changed.

`python scripts/results.py recordings` writes them into the pages. Each run fits one log and predicts another one.
"""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from legged.robots import GO2
from markdown_table import Rows

from torchid.cli import main as torchid
from torchid.errors import TorchidError

CONFIGS = Path(__file__).parents[1] / "configs"
_GROUPS = {"joint_torque": "joint torque", "base_force": "base force", "base_moment": "base moment"}
_FEET = ("LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT")
_NO_TERMS = "actuators={armature: false, torque_offset: false, asymmetric_coulomb: false, stiffness: false, "
_NO_TERMS += "sign_width: null, delay: null, stiction: false}"
_GAINS = ("sensors={set: joints, scales: {joint_torque: all}}", "estimator.total_mass=33.55")


def _balls(ball: str) -> str:
    return f"contacts=[{', '.join(f'{{frame: {foot}, type: point, {ball}}}' for foot in _FEET)}]"


@dataclass(frozen=True)
class Recording:
    """A robot, the log that is fitted and the one that is predicted, and settings to try one by one."""

    title: str
    robot: str | Path
    fitted: str
    predicted: str
    settings: Mapping[str, Sequence[str]] = field(default_factory=dict)


RECORDINGS = {
    "anymal_mujoco": Recording(
        "ANYmal, simulated by others (MuJoCo, noisy sensors, steps), another motion",
        "anymal.urdf",
        "walk.csv",
        "other.csv",
        {
            "feet as points (`radius: 0`)": [_balls("radius: 0")],
            "ball where the URDF draws it, 23 mm too high": [_balls("radius: 0.031, centre: [0, 0, 0.023]")],
            "no margin at touch-down (`contact_margin_s: 0`)": ["preprocessing.contact_margin_s=0"],
            "`actuators.stiction: false`": ["actuators.stiction=false"],
            "gains fitted (`sensors.scales`), total mass stated": _GAINS,
            "cutoff 5 Hz": ["preprocessing.cutoff_hz=5"],
            "cutoff 40 Hz": ["preprocessing.cutoff_hz=40"],
            "ridge 1e-6": ["estimator.ridge=1e-6"],
            "ridge 1": ["estimator.ridge=1"],
        },
    ),
    "go2_in_air": Recording(
        "Go2 in the air, second half, up to three times as fast", GO2.urdf, "log.npz[0:12]", "log.npz[12:]"
    ),
    "kuka_lwr4": Recording(
        "KUKA arm, second run",
        "kuka_lwr4.urdf",
        "run1.npz",
        "run2.npz",
        {
            "`robot.base_tilt: auto`": ["robot.base_tilt=auto"],
            "no terms of actuators": [_NO_TERMS],
            "cutoff 20 Hz": ["preprocessing.cutoff_hz=20"],
            "ridge 1e-6": ["estimator.ridge=1e-6"],
        },
    ),
    "human_squats": Recording(
        "person on force plates, another motion",
        "human.urdf",
        "squats1.npz",
        "squatsAsym1.npz",
        {
            "cutoff 6 Hz": ["preprocessing.cutoff_hz=6"],
            "cutoff 20 Hz": ["preprocessing.cutoff_hz=20"],
            "ridge 1e-4": ["estimator.ridge=1e-4"],
            "mass stated from a scale": ["estimator.total_mass=60.03"],
            "cutoff 6 Hz, ridge 1e-4, `estimator.friction: false`": [
                "preprocessing.cutoff_hz=6",
                "estimator.ridge=1e-4",
                "estimator.friction=false",
            ],
        },
    ),
}
_GO2_SETTINGS = {
    "`configs/go2_in_air.yaml`": (),
    "without `delay`": ("actuators.delay=null",),
    "without `sign_width`": ("actuators.sign_width=null",),
    "without `armature`": ("actuators.armature=false",),
}


@dataclass(frozen=True)
class Outcome:
    """Metrics of the predicted log and total mass [kg] by model, and settings of the run."""

    log: Mapping[str, Mapping[str, Any]]
    config: Mapping[str, Any]
    mass: Mapping[str, float]

    def errors(self, model: str) -> dict[str, str]:
        """Errors of the groups that are measured, as shares of what was measured."""
        shares = {group: self.log[model].get(f"{group}_rms_relative") for group in _GROUPS}
        return {group: f"{100.0 * share:.3g} %" for group, share in shares.items() if share is not None}


@cache
def outcome(data: Path, name: str, *overrides: str, is_tuned: bool = False) -> Outcome:
    """Fit with the file that `init` writes, or with the one in `configs/`, and predict the other log."""
    recording = RECORDINGS[name]
    robot, fitted, predicted = (str(data / name / x) for x in (recording.robot, recording.fitted, recording.predicted))
    with tempfile.TemporaryDirectory() as folder:
        experiment, run = f"{folder}/robot.yaml", f"{folder}/run"
        if is_tuned:
            experiment = str(CONFIGS / f"{name}.yaml")
            overrides = (f"robot.urdf={robot}", f"logs.train=['{fitted}']", f"logs.test=['{predicted}']", *overrides)
        else:
            _call("init", robot, fitted, "--output", experiment)
        _call("identify", experiment, f"output={run}", *overrides, "--quiet")
        _call("evaluate", run, "--log", predicted, "--quiet")
        (file,) = Path(run, "evaluation").glob("*/metrics.json")
        (log,) = json.loads(file.read_text()).values()
        bodies = json.loads(Path(run, "parameters.json").read_text())["bodies"]
        config = yaml.safe_load(Path(run, "config.yaml").read_text())
    mass = {model: sum(body[model]["m"] for body in bodies) for model in ("nominal", "identified")}
    return Outcome(log, config, mass)


def _call(*arguments: str) -> None:
    with redirect_stdout(io.StringIO()):
        status = torchid(list(arguments))
    if status:
        raise TorchidError(f"torchid {' '.join(arguments)}: exit status {status}")


def settings_table(data: Path, name: str) -> Rows:
    """Errors of a recording with each of its settings."""
    default = outcome(data, name)
    yield ["setting", *(_GROUPS[group] for group in default.errors("nominal")), "total mass [kg]"]
    yield _row("URDF", default, "nominal")
    chosen = f"cutoff {default.config['preprocessing']['cutoff_hz']:.2g} Hz, "
    chosen += f"ridge {default.config['estimator']['ridge']:.2g}"
    yield _row(f"**default** ({chosen})", default)
    for setting, overrides in RECORDINGS[name].settings.items():
        yield _row(setting, outcome(data, name, *overrides))


def _row(setting: str, fit: Outcome, model: str = "identified") -> list[str]:
    return [setting, *fit.errors(model).values(), f"{fit.mass[model]:.2f}"]


def recordings_table(data: Path) -> Rows:
    """Errors of all recordings by default."""
    yield ["recording", "error of", "URDF", "torchid"]
    for name, recording in RECORDINGS.items():
        default = outcome(data, name)
        for group, share in default.errors("nominal").items():
            yield [recording.title, _GROUPS[group], share, default.errors("identified")[group]]


def go2_table(data: Path) -> Rows:
    """Errors of the torques of Go2 in the air [N m], with and without terms of its configuration."""

    def runs(settings: Sequence[str]) -> list[Outcome]:
        return [
            outcome(data, "go2_in_air", f"preprocessing.cutoff_hz={hz}", *settings, is_tuned=True) for hz in (10, 20)
        ]

    yield ["model", "10 Hz [N m]", "20 Hz [N m]"]
    yield ["URDF", *(f"{x.log['nominal']['nullspace_rms']:.3f}" for x in runs(()))]
    for name, settings in _GO2_SETTINGS.items():
        yield [name, *(f"{x.log['identified']['nullspace_rms']:.3f}" for x in runs(settings))]
