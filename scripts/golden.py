"""Have the results of varied experiments changed? Run them before and after a change of the code, and compare.

    python scripts/golden.py run --output before                  # --data for logs that others recorded
    python scripts/golden.py run --output after --only demo person
    python scripts/golden.py compare before after                         # the largest changes; exit status 1 if any
    python scripts/golden.py compare before after --within 1e-9       # of the largest number of the same list

Each folder has the `parameters.json` and `metrics.json` of each experiment. Experiments on data that is not there are
left out. Logs of the biped are simulated once, beside the results, which takes a minute. Needs the extras `[sim]`
and `[oracle]`.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import torchid
from torchid.boundary import run_guarded
from torchid.errors import InputError
from torchid.report.mjcf_files import mjcf_of_urdf
from torchid.robot import load_robot

CONFIGS, DEMO = Path(__file__).parents[1] / "configs", Path(torchid.__file__).parent / "demo"
_DEMO = str(DEMO / "quadruped.yaml")
_DESCENT = ("estimator.name=sgd", "estimator.training.epochs=4", "estimator.ridge=0.1")
_OFFSETS = ("sensors.set=full", "sensors.offsets={contact_force: all, joint_torque: log}")
DATA = {"person": "human_squats", "arm": "kuka_lwr4", "go2_in_air": "go2_in_air"}
"""Configurations of logs that others recorded, by experiment."""
_GO2 = "cmeel.prefix/share/example-robot-data/robots/go2_description/urdf/go2.urdf"  # of the extra `[oracle]`

RESULTS = ("parameters.json", "metrics.json")
_TIMES = ("seconds", "version", "files", "log", "source")  # keys of what may differ between two runs


def experiments(folder: Path, data: Path | None) -> dict[str, list[str]]:
    """Arguments of `torchid identify`, by name; `folder`: for robots and logs that are made for them."""
    out = {
        "demo": [_DEMO],
        "demo_full_with_offsets": [_DEMO, *_OFFSETS, "estimator.name=least_squares"],
        "demo_robust": [_DEMO, "estimator.robust=huber"],
        "demo_descent": [_DEMO, *_DESCENT],
        "demo_of_two_processes": [_DEMO, *_DESCENT],
        "demo_mjcf": [_DEMO, "robot.urdf=null", f"robot.mjcf={folder / 'quadruped.xml'}"],
    }
    for sensors in ("full", "reduced", "contacts", "joints"):
        logs = f"logs.train=[{folder}/biped/logs/s*.npz]", f"logs.test=[{folder}/biped/logs/unseen_1.5hz.npz]"
        robot = f"robot.urdf={folder}/biped/nominal.urdf"
        out[f"biped_{sensors}"] = [str(CONFIGS / f"biped_{sensors}.yaml"), robot, *logs]
    for name, key in DATA.items():
        if data is not None and (data / key).is_dir():
            out[name] = [str(CONFIGS / f"{key}.yaml")]
    if "go2_in_air" in out:
        out["go2_in_air"].append(f"robot.urdf={Path(sysconfig.get_path('purelib')) / _GO2}")
    return out


def run(options: argparse.Namespace) -> None:
    """Identify, and keep the results."""
    work = options.output / "work"
    work.mkdir(parents=True, exist_ok=True)
    robot = load_robot(DEMO / "quadruped.urdf")
    (work / "quadruped.xml").write_bytes(mjcf_of_urdf(robot, robot.nominal, {}))
    chosen = experiments(work.resolve(), options.data)
    if unknown := set(options.only or ()) - set(chosen):
        raise InputError("arguments", "--only", f"{sorted(unknown)}", ", ".join(chosen))
    if any(name.startswith("biped") for name in options.only or chosen) and not (work / "biped" / "logs").is_dir():
        _torchid(["simulate", str(CONFIGS / "biped_simulation.yaml"), f"output={work.resolve() / 'biped'}"])
    for name in options.only or chosen:
        output = work / name
        processes = 2 if name.endswith("two_processes") else 1
        _torchid(["identify", *chosen[name], f"output={output.resolve()}", "overwrite=true"], processes)
        (options.output / name).mkdir(exist_ok=True)
        for file in RESULTS:
            shutil.copy(output / file, options.output / name / file)
        print(name, flush=True)


def _torchid(arguments: list[str], processes: int = 1) -> None:
    """A command in a process of its own, or in several, whose output is shown if it fails."""
    start = ["-m", "torch.distributed.run", f"--nproc-per-node={processes}"] if processes > 1 else []
    command = [sys.executable, *start, "-m", "torchid", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    if done.returncode:
        raise InputError("torchid", " ".join(arguments[:2]), done.stderr.strip()[-500:], "a run without an error")


def compare(options: argparse.Namespace) -> bool:
    """Print the largest change of each experiment, in its list of numbers; whether all are within the bound."""
    alike = True
    for folder in sorted(path for path in options.before.iterdir() if (path / RESULTS[0]).is_file()):
        if not (options.after / folder.name).is_dir():
            continue
        changes = [
            (size, f"{file}: {where}")
            for file in RESULTS
            for where, size in differences(
                *(json.loads((root / folder.name / file).read_text()) for root in (options.before, options.after))
            )
        ]
        worst, where = max(changes, default=(0.0, "none"))
        print(f"{folder.name:24s} {worst:8.2g}  {where}")
        alike = alike and worst <= options.within
    return alike


def differences(before: Any, after: Any, where: str = "") -> Iterator[tuple[str, float]]:
    """Where two documents differ, and by how much of the largest number of the same list; infinity for all else."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in before.keys() | after.keys():
            if key not in _TIMES:
                yield from differences(before.get(key), after.get(key), f"{where}.{key}".lstrip("."))
    elif _is_numeric(before) and _is_numeric(after) and np.shape(before) == np.shape(after):
        a, b = np.asarray(before, dtype=float), np.asarray(after, dtype=float)
        if not np.array_equal(a, b, equal_nan=True):
            size = float(np.abs(a - b).max() / max(np.abs(a).max(), np.abs(b).max()))
            yield where, size if np.isfinite(size) else float("inf")
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for number, (one, other) in enumerate(zip(before, after, strict=True)):
            yield from differences(one, other, f"{where}[{number}]")
    elif before != after and not (isinstance(before, str) and isinstance(after, str) and _is_same_file(before, after)):
        yield where, float("inf")


def _is_same_file(before: str, after: str) -> bool:
    """Whether two texts are paths of one file in two trees."""
    return "/" in before and Path(before).name == Path(after).name


def _is_numeric(x: Any) -> bool:
    """Whether it is a number, or a list of numbers."""
    return all(
        isinstance(one, int | float) and not isinstance(one, bool) for one in (x if isinstance(x, list) else [x])
    )


def main() -> int:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    runner, comparer = commands.add_parser("run"), commands.add_parser("compare")
    runner.add_argument("--output", type=Path, required=True)
    runner.add_argument("--data", type=Path, help="folder with human_squats, kuka_lwr4 and go2_in_air")
    runner.add_argument("--only", nargs="+", help="experiments by name")
    comparer.add_argument("before", type=Path)
    comparer.add_argument("after", type=Path)
    comparer.add_argument("--within", type=float, default=0.0, help="relative change that is allowed")
    options = parser.parse_args()
    if options.command == "compare":
        return 0 if compare(options) else 1
    return run_guarded("golden", lambda: run(options))


if __name__ == "__main__":
    raise SystemExit(main())
