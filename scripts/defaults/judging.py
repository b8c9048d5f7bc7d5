"""Runs of torchid on the logs of simulated robots, and what they are worth."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from defaults.scoring import Score, Terms, Truth, median_mass_error

_SECONDS = 1200
_ENVIRONMENT = {"COLUMNS": "100", "NO_COLOR": "1", "OMP_NUM_THREADS": "1"}


@dataclass
class Result:
    """What came of a robot.

    Attributes:
        status: of `identify`, with no edit.
        edited: whether the robot's edit was stated, as no edit ended in an error.
        headline: the first line of the answer, or the last one of the error.
        least: errors of the true robot itself on the unseen motion, joints' torques, as `score.torque`.
        terms: settings that the fit has.
        own: errors of joint torques on the unseen log by `torchid evaluate`, of the URDF and identified [N m].
    """

    robot: str
    status: int
    edited: bool
    headline: str
    seconds: float
    truth: Mapping[str, Any]
    score: Score | None = None
    least: float | None = None
    terms: str = ""
    mass: tuple[float | None, float | None] | None = None
    own: tuple[float | None, float | None] | None = None

    def failures(self) -> list[str]:
        """What the defaults are not to do."""
        if self.score is None:
            return ["refused"]
        score, out = self.score, []
        out += [f"limb {x} {ratio:.2f}" for x, ratio in score.limbs.items() if ratio > 1.0]
        out += [f"masses {score.mass:.2f}"] * (score.mass > 0.8)
        out += [f"{score.heaviest[1]} {score.heaviest[0]:.2f} x its mass"] * (score.heaviest[0] > 1.5)
        worse = [name for name, ratio in score.joints.items() if ratio > 1.0]
        if worse and self.headline.startswith(("Better", "Much better")):
            out.append(f"'better' with {len(worse)} worse joint{'s' * (len(worse) > 1)}")
        mass, deviation = self.mass or (None, None)
        if mass is not None and deviation is not None and not self.truth["held"]:
            out += ["mass beyond 2 s.e."] * (abs(mass - self.truth["total_mass"]) > 2.0 * deviation)
        return out

    def as_dict(self) -> dict[str, Any]:
        """As JSON has it."""
        return vars(self) | {"score": None if self.score is None else self.score.as_dict(), "failures": self.failures()}


def judge(folder: Path, overrides: Sequence[str], work: Path) -> Result:
    """`init` and `identify` as a user calls them, and what is true."""
    experiment, began = _initiated(folder, work), time.perf_counter()
    truth, edited = Truth(folder), False
    done = _identified(experiment, overrides)
    status = done.returncode
    if status and truth.known["edit"]:
        edited, done = True, _identified(experiment, [*truth.known["edit"], *overrides])
    seconds = time.perf_counter() - began
    lines = (done.stderr if done.returncode else done.stdout).strip().splitlines()
    headline = " ".join(_first_sentence(lines) if done.returncode == 0 else lines[-1:])
    result = Result(folder.name, status, edited, headline, seconds, truth.known, least=truth.best_known().torque)
    if done.returncode:
        return result
    run = work / "runs" / folder.name
    config = yaml.safe_load((run / "config.yaml").read_text())
    parameters, metrics = (json.loads((run / f"{name}.json").read_text()) for name in ("parameters", "metrics"))
    result.score = truth.score(run / "identified.urdf", _terms(parameters, config))
    result.terms = describe_terms(config)
    result.mass = metrics["total_mass"], metrics["total_mass_standard_error"]
    result.own = _evaluated(run, folder)
    return result


def _initiated(folder: Path, work: Path) -> Path:
    """The experiment file that `init` writes anew."""
    work.mkdir(parents=True, exist_ok=True)
    experiment = work / f"{folder.name}.yaml"
    experiment.unlink(missing_ok=True)
    done = _torchid("init", folder / "robot.urdf", folder / "log.csv", "--output", experiment)
    if done.returncode:
        raise RuntimeError(f"{folder.name}: init: {done.stderr}")
    return experiment


def _identified(experiment: Path, overrides: Sequence[str]) -> subprocess.CompletedProcess[str]:
    run = experiment.parent / "runs" / experiment.stem
    shutil.rmtree(run, ignore_errors=True)
    return _torchid("identify", experiment, f"output={run}", *overrides)


def _evaluated(run: Path, folder: Path) -> tuple[float | None, float | None]:
    done = _torchid("evaluate", run, "--log", folder / "other.csv")
    if done.returncode:
        return None, None
    file = next((run / "evaluation").glob("*/metrics.json"))
    errors = next(iter(json.loads(file.read_text()).values()))
    return errors["nominal"]["joint_torque_rms"], errors["identified"]["joint_torque_rms"]


def _torchid(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "torchid", *map(str, arguments)]
    environment = os.environ | _ENVIRONMENT
    return subprocess.run(command, capture_output=True, text=True, timeout=_SECONDS, env=environment, check=False)


def _first_sentence(lines: Sequence[str]) -> list[str]:
    """Lines of the answer before its table."""
    end = next((k for k, line in enumerate(lines) if line.startswith("rms error")), 1)
    return [line.strip() for line in lines[:end]]


def _terms(parameters: Mapping[str, Any], config: Mapping[str, Any]) -> Terms:
    width, stribeck = (config["actuators"].get(key) for key in ("sign_width", "stribeck"))
    return Terms(parameters["extras"], *(x if isinstance(x, float) else None for x in (width, stribeck)))


def describe_terms(config: Mapping[str, Any]) -> str:
    """Settings of a fit that say what it has: cutoff, ridge, terms, radii."""
    out = [f"{config['preprocessing']['cutoff_hz']} Hz", f"ridge {config['estimator']['ridge']}"]
    for key, value in config["actuators"].items():
        if value not in (None, False, [], {}):
            out.append(key if value is True else f"{key} {value:.3g}" if isinstance(value, float) else f"{key} {value}")
    out += [f"offsets {config['sensors']['offsets']}"] * bool(config["sensors"].get("offsets"))
    radii = {one.get("radius") for one in config["contacts"]} - {None}
    out += ["radius " + "/".join(f"{x:.3g}" if isinstance(x, float) else str(x) for x in radii)] * bool(radii)
    margin = config["preprocessing"].get("contact_margin_s")
    return ", ".join([*out, *[f"margin {margin} s"] * bool(margin)])


def print_results(results: Iterable[Result], file: Path | None) -> None:
    """A block of 80 columns for each robot, at once; and all as JSON."""
    every = []
    titles = ("", "torque", "base force", "worst", "median", "links x true", "total mass")
    print("{:12}{:>13}{:>13}{:>7}{:>7}{:>13}{:>17}".format(*titles))
    units = ("robot", "id/URDF [%]", "id/URDF [%]", "limb", "mass", "least, most", "(true) [kg]")
    print("{:12}{:>13}{:>13}{:>7}{:>7}{:>13}{:>17}".format(*units))
    for result in results:
        every.append(result)
        print(_block(result), flush=True)
        if file is not None:
            file.write_text(json.dumps([one.as_dict() for one in every], indent=1))
    failing = sum(bool(one.failures()) for one in every)
    print(f"{failing} of {len(every)} robots with failures")
    if scores := [one.score for one in every if one.score is not None]:
        pooled = median_mass_error(scores)
        print(f"masses of all links of robots that were fitted: median error {pooled:.2f} x the URDF's")


def _short(x: float | None, decimals: int = 3) -> str:
    return "-" if x is None else f"{x:.{decimals}f}"


def _block(result: Result) -> str:
    score, known = result.score, result.truth
    lines = []
    if score is None:
        lines.append(f"{result.robot:12} refused")
    else:
        torque = f"{100 * score.torque:.1f}/{100 * score.urdf_torque:.1f}"
        force = "-" if score.force is None else f"{100 * score.force:.1f}/{100 * (score.urdf_force or 0):.1f}"
        links = f"{score.lightest[0]:.2f}, {score.heaviest[0]:.2f}"
        mass = "-"
        if result.mass is not None and not known["held"]:
            mass = "{}±{}({})".format(*(_short(x, 2) for x in (*result.mass, known["total_mass"])))
        limb = max(score.limbs.values())
        lines.append(f"{result.robot:12}{torque:>13}{force:>13}{limb:>7.2f}{score.mass:>7.2f}{links:>13} {mass:>17}")
    said = [f"exit {result.status}{', with its edit' * result.edited}, {result.seconds:.0f} s: {result.headline}"]
    said += [result.terms] * bool(result.terms)
    said.append(f"the true robot leaves {100 * (result.least or 0.0):.1f} % of the torques")
    if result.own is not None:
        said.append("other.csv by evaluate, identified and URDF: {1} and {0} N m".format(*map(_short, result.own)))
    said += ["FAILS: " + ", ".join(result.failures())] * bool(result.failures())
    for text in said:
        lines += [f"    {part}" for part in textwrap.wrap(text, 76, subsequent_indent="  ")]
    return "\n".join(lines)
