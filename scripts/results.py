"""Write the tables of the pages: each stands between <!-- table: NAME --> and <!-- /table -->.

    python scripts/results.py                              # all tables
    python scripts/results.py simulated_robots intervals   # some of them
    python scripts/results.py recordings --data DATA       # recordings by others: a folder for each

The recordings are not part of the repository. Needs the extra `[oracle]`.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

from benchmark import modules_table, speed_table
from default_accuracy import ridge_table
from interval_coverage import coverage_table
from legged_accuracy import accuracy_table
from markdown_table import Rows, markdown_lines
from posterior_coverage import posterior_table
from recording_accuracy import go2_table, recordings_table, settings_table

from torchid.boundary import run_guarded
from torchid.errors import UnknownNameError

ROOT = Path(__file__).resolve().parents[1]
PAGES = (ROOT / "README.md", ROOT / "docs" / "results.md", ROOT / "docs" / "good_result.md")
_DATA = ROOT.parent / "shared" / "data"
_TABLE = r"(<!-- table: {} -->\n).*?(<!-- /table -->)"


def tables(data: Path = _DATA) -> dict[str, Callable[[], Rows]]:
    """Functions of the tables' cells, by name."""
    recorded = ("anymal_mujoco", "kuka_lwr4", "human_squats")
    return {
        "recordings": partial(recordings_table, data),
        "go2_in_air": partial(go2_table, data),
        **{name: partial(settings_table, data, name) for name in recorded},
        "simulated_robots": accuracy_table,
        "ridge": ridge_table,
        "intervals": coverage_table,
        "posterior": posterior_table,
        "speed": speed_table,
        "modules": modules_table,
    }


def write(name: str, rows: Rows) -> None:
    """Replace a table in the pages that have it."""
    text = "\n".join(markdown_lines(rows)) + "\n"
    for page in PAGES:
        before = page.read_text()
        after = re.sub(_TABLE.format(name), lambda match: match[1] + text + match[2], before, flags=re.DOTALL)
        if after != before:
            page.write_text(after)
            print(f"{name}: {page.relative_to(ROOT)} changed", flush=True)


def run(options: argparse.Namespace) -> None:
    """Make the chosen tables."""
    known = tables(options.data)
    for name in options.tables:
        if name not in known:
            raise UnknownNameError("arguments", "TABLE", name, known)
    for name in options.tables or known:
        write(name, known[name]())


def main() -> int:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="*", metavar="TABLE", help=", ".join(tables()))
    parser.add_argument("--data", type=Path, default=_DATA)
    options = parser.parse_args()
    return run_guarded("results", lambda: run(options))


if __name__ == "__main__":
    raise SystemExit(main())
