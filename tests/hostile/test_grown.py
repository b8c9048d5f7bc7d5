"""Files of every kind that is read, grown by the rules of their formats: read or refused, soon and in one line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import grown_bags
import grown_logs
import grown_robots
import numpy as np
import pytest
from demo import shortened_demo
from grown import LETTERS, Chance, Grow, grown
from hostile import Tally, examined
from repository import DEMO

from torchid.cli import main
from torchid.commands.checkpoint import load_checkpoint
from torchid.config import load_analysis, load_config, load_simulation
from torchid.config.log_reading import load_columns, load_topics
from torchid.errors import InputError, is_plain
from torchid.logs import Topics, read_log
from torchid.parameters import PARAMETERS
from torchid.report.parameter_files import read_parameters, read_shared_extras
from torchid.robot import body_extents, load_robot

TOPICS = Topics(joint_states="/joint_states")
COUNTS = [12, pytest.param(220, marks=pytest.mark.slow)]


def read(path: Path) -> None:
    """Read a log of any kind."""
    read_log(path, TOPICS if path.suffix in (".bag", ".mcap", ".db3") else None)


def read_settings(path: Path) -> None:
    """As every kind of file that settings may stand in, refused if it is none of them."""
    refused: list[InputError] = []
    loads: tuple[Callable[[Path], object], ...] = (
        load_topics,
        load_columns,
        load_simulation,
        load_analysis,
        load_config,
    )
    for load in loads:
        try:
            load(path)
        except InputError as error:
            refused.append(error)
        else:
            return
    assert all(is_plain(str(error)) for error in refused)
    raise refused[-1]


def read_results(path: Path) -> None:
    """What `evaluate` reads of a run."""
    assert np.isfinite(read_parameters(path, load_robot(DEMO / "quadruped.urdf"))).all()
    assert np.isfinite(list(read_shared_extras(path).values())).all()


def results() -> Grow:
    """Of the quadruped of the demo, as its URDF says."""
    robot = load_robot(DEMO / "quadruped.urdf")
    named = [dict(zip(PARAMETERS, map(float, phi), strict=True)) for phi in robot.nominal]
    bodies = [{"name": name, "identified": phi} for name, phi in zip(robot.body_names, named, strict=True)]
    return grown_robots.parameters({"bodies": bodies, "extras": [{"label": "x", "value": 1.0, "log": None}]})


KINDS: dict[str, tuple[Callable[[], Grow], Callable[[Path], object]]] = {
    "npz": (lambda: grown_logs.npz, read),
    "hdf5": (lambda: grown_logs.hdf5, read),
    "csv": (lambda: grown_logs.table_csv, read),
    "parquet": (lambda: grown_logs.parquet, read),
    "mcap": (lambda: grown_bags.mcap, read),
    "bag": (lambda: grown_bags.bag, read),
    "database": (lambda: grown_bags.database, read),
    "urdf": (lambda: grown_robots.urdf, lambda path: body_extents(load_robot(path))),
    "mesh": (lambda: grown_robots.mesh, lambda path: body_extents(load_robot(path))),
    "settings": (lambda: grown_robots.settings, read_settings),
    "parameters": (results, read_results),
    "checkpoint": (lambda: grown_robots.checkpoint, lambda path: load_checkpoint(path.parent)),
}


def tally_of(kind: str, folder: Path, count: int, seed: int) -> Tally:
    """What became of so many files of a kind."""
    grow, call = KINDS[kind]
    return examined(f"grown {kind}", grown(folder, grow(), count, seed), call, folder)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", COUNTS)
def test_grown_files_are_read_or_refused_in_one_line(tmp_path: Path, kind: str, count: int) -> None:
    tally = tally_of(kind, tmp_path, count, seed=1000)
    assert tally.faults == []
    assert count < 100 or tally.share("accepted") > 0.02


@pytest.mark.parametrize("count", COUNTS)
def test_grown_overrides_are_taken_or_refused_in_one_line(tmp_path: Path, count: int) -> None:
    shortened_demo(tmp_path / "demo", 60)
    cases = ((f"{seed}", grown_robots.override(Chance(seed))) for seed in range(2000, 2000 + 2 * count))
    file = tmp_path / "demo" / "quadruped.yaml"
    tally = examined("grown overrides", cases, lambda text: load_config(file, [text]), tmp_path)
    assert tally.faults == []


def named_files(folder: Path, count: int) -> Iterator[tuple[str, list[str]]]:
    """Commands on a log whose name is hard to show, in a terminal, a figure or a document."""
    content = {"time": np.arange(30.0), "joint_position": np.random.default_rng(0).standard_normal((30, 40))}
    content["joint_names"] = np.array([f"j{k}" for k in range(40)])
    for seed in range(3000, 3000 + count):
        chance = Chance(seed)
        name = "".join(chance.of(LETTERS.replace("/", "").replace("\0", "")) for _ in range(1 + chance.below(20)))
        outputs = chance.of(
            [["--figure", str(folder / "out" / f"{name}.svg")], ["--json", str(folder / "out" / f"{name}.json")], []]
        )
        np.savez(folder / f"{name}.npz", **content)
        yield f"{seed} {name!r}", ["check", "--overwrite", *outputs, "--", str(folder / f"{name}.npz")]
        (folder / f"{name}.npz").unlink()


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
@pytest.mark.parametrize("count", [6, pytest.param(100, marks=pytest.mark.slow)])
def test_a_log_of_any_name_is_checked_and_drawn(tmp_path: Path, count: int) -> None:
    """Exit status 1 says that the log is not fit, which is no fault unless there is a line about it."""
    (tmp_path / "out").mkdir()

    def check(arguments: list[str]) -> int:
        status = main(arguments)
        return 0 if status == 1 else status

    tally = examined("named logs", named_files(tmp_path, count), check, tmp_path, [tmp_path / "out"])
    assert [fault for fault in tally.faults if not fault.endswith("missing from font(s) DejaVu Sans.")] == []
    assert tally.share("accepted") == 1.0
    assert len(list((tmp_path / "out").iterdir())) > count // 3
