"""Section V of the paper, from simulation to figures: which forces have to be measured?

A biped squats and steps in simulation; sensor sets are compared on a squat that no fit has seen, with exact sensors
and under every imperfection.

    python scripts/reproduce_paper.py             # ten minutes on two cores
    python scripts/reproduce_paper.py --quick     # one minute: fewer and shorter motions
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from torchid.config import load_simulation
from torchid.errors import InputError
from torchid.report.tables import print_tables
from torchid.run.folder import STUDY, check_free, new_folder
from torchid.study import Reproduction, Study
from torchid.study.write import study_tables, write_study

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
SENSOR_SETS = ("full", "contacts", "joints", "reduced")


def main() -> int:
    """Run the study, print its tables and write its folder."""
    parser = argparse.ArgumentParser(description="Reproduce section V of Mistry, Schaal, Yamane (2009).")
    parser.add_argument("--quick", action="store_true", help="fewer and shorter motions, fewer draws")
    parser.add_argument("--output", type=Path, default=Path("runs/paper"), help="folder for tables and figures")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier study in that folder")
    options = parser.parse_args()
    try:
        check_free(options.output, options.overwrite, STUDY)
        simulation = load_simulation(CONFIGS / "biped_simulation.yaml")
        study = Study(simulation, {name: CONFIGS / f"biped_{name}.yaml" for name in SENSOR_SETS})
        with new_folder(options.output, options.overwrite, STUDY) as folder:
            results, series = Reproduction(study.quick() if options.quick else study).run(folder)
            write_study(folder, results, series)
    except InputError as error:
        print(f"reproduce_paper: {error}", file=sys.stderr)
        return 2
    print_tables(*study_tables(results).values())
    print(f"written to {options.output}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
