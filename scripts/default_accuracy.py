"""Robots whose truth is known: how good is what `torchid init` and `torchid identify` find without an edit?

    python scripts/default_accuracy.py make --seed 1 --output robots            # all robots; or --robots panda go2_walk
    python scripts/default_accuracy.py judge robots                             # defaults
    python scripts/default_accuracy.py judge robots -- estimator.ridge=0.1      # other settings

`make` writes a folder for each robot: `robot.urdf`, whose bodies are some 20 % off the true ones (`true.urdf`),
`log.csv` and `other.csv`, another motion, with the flaws of real logs, and `truth.json`. `judge` fits `log.csv` and
compares with the truth: forces along the unseen motion as sensors without noise read them, up to 20 Hz; joint torques
of the rigid bodies in random states, by limb; masses. Needs the extra `[oracle]`.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from defaults.judging import judge, print_results
from defaults.making import make
from defaults.robots import CASES
from markdown_table import Rows

from torchid.boundary import run_guarded
from torchid.errors import InputError


def ridge_table(name: str = "panda", seed: int = 1) -> Rows:
    """Errors of an arm by ridge: torques of the unseen motion, and masses of its links."""
    yield ["`estimator.ridge`", "torque error", "masses of links / true ones"]
    with tempfile.TemporaryDirectory() as folder:
        make(name, seed, Path(folder))
        for ridge in ("1e-6", "1e-3", "0.1", "1", "auto"):
            score = judge(Path(folder, name), [f"estimator.ridge={ridge}"], Path(folder)).score
            if score is not None:
                masses = [identified for identified, _ in score.masses.values()]
                yield [ridge, f"{100.0 * score.torque:.1f} %", f"{min(masses):.2f} to {max(masses):.2f}"]


def run(options: argparse.Namespace) -> None:
    """Make or judge."""
    if options.command == "make":
        for name in options.robots or CASES:
            truth = make(name, options.seed, options.output)
            print(f"{name}: {truth['total_mass']:.2f} kg, {truth['simulator']}, {truth['seconds']:.0f} s", flush=True)
        return
    folders = [options.folder / name for name in CASES if (options.folder / name / "truth.json").is_file()]
    folders = [one for one in folders if not options.robots or one.name in options.robots]
    if not folders:
        raise InputError("arguments", "folder", f"no robot in {options.folder}", "a folder that make has written")
    work = options.work or options.folder
    print_results((judge(folder, options.overrides, work) for folder in folders), options.json)


def main() -> int:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    maker = commands.add_parser("make")
    maker.add_argument("--seed", type=int, default=1)
    maker.add_argument("--output", type=Path, required=True)
    maker.add_argument("--robots", nargs="+", choices=list(CASES))
    judger = commands.add_parser("judge")
    judger.add_argument("folder", type=Path)
    judger.add_argument("overrides", nargs="*", help="behind --: key=value of the experiment file")
    judger.add_argument("--robots", nargs="+", choices=list(CASES))
    judger.add_argument("--json", type=Path, help="results as JSON")
    judger.add_argument("--work", type=Path, help="where runs are written, by default beside the robots")
    options = parser.parse_args()
    return run_guarded("default_accuracy", lambda: run(options))


if __name__ == "__main__":
    raise SystemExit(main())
