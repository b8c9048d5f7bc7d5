"""Section V of the paper, from simulation to figures: which forces have to be measured?

A biped squats and steps in simulation; sensor sets are compared on a squat that no fit has seen, with exact sensors
and under every imperfection.

    python scripts/reproduce_paper.py             # eight minutes on two cores
    python scripts/reproduce_paper.py --quick     # one minute: fewer and shorter motions
    torchrun --standalone --nproc-per-node 2 scripts/reproduce_paper.py      # draws shared, the same results
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from paper.report import study_tables, write_study
from paper.settings import Study
from paper.study import Reproduction

from torchid import distributed
from torchid.boundary import run_distributed, run_guarded
from torchid.commands.folder import STUDY, check_free, new_folder
from torchid.config import load_simulation
from torchid.errors import about_file
from torchid.report.tables import print_tables

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
SIMULATION = CONFIGS / "biped_simulation.yaml"
SENSOR_SETS = ("full", "contacts", "joints", "reduced")


def main() -> int:
    """Run the study in this process, or in all that torchrun has started; the first prints and writes."""
    return run_distributed("reproduce_paper", run)


def run() -> int:
    """Run the study, print its tables and write its folder."""
    parser = argparse.ArgumentParser(description="Reproduce section V of Mistry, Schaal, Yamane (2009).")
    parser.add_argument("--quick", action="store_true", help="fewer and shorter motions, fewer draws")
    parser.add_argument("--output", type=Path, default=Path("runs/paper"), help="folder for tables and figures")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier study in that folder")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an unexpected error")
    options = parser.parse_args()
    return run_guarded("reproduce_paper", lambda: reproduce(options), options.debug)


def reproduce(options: argparse.Namespace) -> None:
    """Run the study with the options of the command line."""
    experiments = {name: CONFIGS / f"biped_{name}.yaml" for name in SENSOR_SETS}
    with distributed.share_work(), about_file(SIMULATION):
        distributed.from_first(partial(check_free, options.output, options.overwrite, STUDY), "output")
        study = Study(load_simulation(SIMULATION), experiments)
        results, series = Reproduction(study.quick() if options.quick else study).run()

        def write() -> None:
            with new_folder(options.output, options.overwrite, STUDY) as folder:
                write_study(folder, results, series)

        distributed.from_first(write, "study folder")
    print_tables(*study_tables(results).values())
    print(f"written to {options.output}")


if __name__ == "__main__":
    raise SystemExit(main())
