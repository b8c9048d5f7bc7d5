"""Errors of `torchid init` and `torchid identify` on recordings by others, by default and with one setting changed.

    python scripts/recordings.py DATA                          # all recordings of a folder, and the tables of the pages
    python scripts/recordings.py DATA --only anymal_mujoco     # one of them

DATA has a folder for each of `RECORDINGS`, with its robot and logs. Every run fits one log, or its first four fifths,
and predicts another one. The tables stand in `docs/results.md` and `docs/good_result.md`.
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path

from torchid.boundary import run_guarded
from torchid.cli import main as torchid
from torchid.errors import TorchidError

_GROUPS = {"joint_torque": "joint torque", "base_force": "base force", "base_moment": "base moment"}
_FEET = ("LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT")
_NO_TERMS = "actuators={armature: false, torque_offset: false, asymmetric_coulomb: false, stiffness: false, "
_NO_TERMS += "sign_width: null, delay: null, stiction: false}"
_GAINS = "sensors={set: joints, scales: {joint_torque: all}}"


def _balls(ball: str) -> str:
    return f"contacts=[{', '.join(f'{{frame: {foot}, type: point, {ball}}}' for foot in _FEET)}]"


@dataclass(frozen=True)
class Recording:
    """A robot, the log that is fitted and the one that is predicted, and settings to try one by one."""

    robot: str
    fitted: str
    predicted: str
    settings: Mapping[str, Sequence[str]] = field(default_factory=dict)


RECORDINGS = {
    "anymal_mujoco": Recording(
        "anymal.urdf",
        "walk.csv",
        "other.csv",
        {
            "feet as points": [_balls("radius: 0")],
            "ball where the URDF draws it": [_balls("radius: 0.031, centre: [0, 0, 0.023]")],
            "no margin at touch-down": ["preprocessing.contact_margin_s=0"],
            "stiction: false": ["actuators.stiction=false"],
            "gains fitted, mass stated": [
                "sensors={set: joints, scales: {joint_torque: all}}",
                "estimator.total_mass=33.55",
            ],
            "cutoff 5 Hz": ["preprocessing.cutoff_hz=5"],
            "cutoff 40 Hz": ["preprocessing.cutoff_hz=40"],
            "ridge 1e-6": ["estimator.ridge=1e-6"],
            "ridge 1": ["estimator.ridge=1"],
        },
    ),
    "go2_in_air": Recording("go2.urdf", "log.npz", "log.npz[80%:]"),
    "kuka_lwr4": Recording(
        "kuka_lwr4.urdf",
        "run1.npz",
        "run2.npz",
        {
            "base_tilt: auto": ["robot.base_tilt=auto"],
            "no terms of actuators": [_NO_TERMS],
            "cutoff 20 Hz": ["preprocessing.cutoff_hz=20"],
            "ridge 1e-6": ["estimator.ridge=1e-6"],
        },
    ),
    "human_squats": Recording(
        "human.urdf",
        "squats1.npz",
        "squatsAsym1.npz",
        {
            "cutoff 6 Hz": ["preprocessing.cutoff_hz=6"],
            "cutoff 20 Hz": ["preprocessing.cutoff_hz=20"],
            "ridge 1e-4": ["estimator.ridge=1e-4"],
            "mass stated": ["estimator.total_mass=60.03"],
        },
    ),
}


@dataclass(frozen=True)
class Outcome:
    """Errors as shares of what was measured, by group, and the total mass of the fit [kg]."""

    nominal: Mapping[str, float]
    identified: Mapping[str, float]
    mass: float


def outcome(recording: Recording, folder: Path, overrides: Sequence[str]) -> Outcome:
    """Fit the experiment file of a folder with other settings, and predict the other log."""
    run = folder / "run"
    shutil.rmtree(run, ignore_errors=True)
    _call("identify", str(folder / "robot.yaml"), f"output={run}", *overrides, "--quiet")
    _call("evaluate", str(run), "--log", str(folder / recording.predicted), "--quiet")
    (metrics,) = (run / "evaluation").glob("*/metrics.json")
    (log,) = json.loads(metrics.read_text()).values()
    nominal, identified = (
        {group: share for group in _GROUPS if (share := log[name].get(f"{group}_rms_relative")) is not None}
        for name in ("nominal", "identified")
    )
    bodies = json.loads((run / "parameters.json").read_text())["bodies"]
    return Outcome(nominal, identified, sum(body["identified"]["m"] for body in bodies))


def _call(*arguments: str) -> None:
    with redirect_stdout(io.StringIO()):
        status = torchid(list(arguments))
    if status:
        raise TorchidError(f"torchid {' '.join(arguments)}: exit status {status}")


def study(name: str, data: Path) -> None:
    """Print the table of a recording."""
    recording = RECORDINGS[name]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / name
        shutil.copytree(data / name, folder)
        _call(
            "init",
            str(folder / recording.robot),
            str(folder / recording.fitted),
            "--output",
            str(folder / "robot.yaml"),
        )
        default = outcome(recording, folder, ())
        print(f"\n{name}\n| setting | {' | '.join(_GROUPS[group] for group in default.nominal)} | total mass [kg] |")
        print("|---" * (len(default.nominal) + 2) + "|")
        print(_row("URDF", default.nominal, None))
        print(_row("default", default.identified, default.mass), flush=True)
        for setting, overrides in recording.settings.items():
            changed = outcome(recording, folder, overrides)
            print(_row(setting, changed.identified, changed.mass), flush=True)


def run(options: argparse.Namespace) -> None:
    """Print the tables of the chosen recordings."""
    for name in options.only:
        study(name, options.data)


def _row(name: str, shares: Mapping[str, float], mass: float | None) -> str:
    cells = [f"{100.0 * share:.3g} %" for share in shares.values()]
    return f"| {name} | {' | '.join(cells)} | {'' if mass is None else f'{mass:.2f}'} |"


def main() -> int:
    """Read the arguments and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--only", nargs="+", choices=list(RECORDINGS), default=list(RECORDINGS))
    options = parser.parse_args()
    return run_guarded("recordings", lambda: run(options))


if __name__ == "__main__":
    raise SystemExit(main())
