"""Log files of strangers: whatever is in them, they are read or refused in one line, soon and in bounded memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from demo import shortened_demo
from hostile import examined
from hostile_logs import N, archives, damaged, fields, hdf5, values
from raw_logs import write_arrays
from refusals import refusal

from torchid.errors import LogError
from torchid.guards import MAX_NAMES
from torchid.logs import read_log, write_log
from torchid.logs.blocks import open_log_blocks
from torchid.logs.log import LARGEST, NAN_ALLOWED

SUFFIXES = (".npz", ".h5")


def read(path: Path) -> None:
    """Read a log; whatever is taken for one has numbers of a size, but where NaN means that nothing was measured."""
    log = read_log(path)
    for name, array in log.arrays().items():
        assert array.dtype.kind != "f" or not (np.abs(array) > LARGEST).any()
        assert name in NAN_ALLOWED or not np.isnan(array).any()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_damaged_logs_and_senseless_values_are_read_or_refused_in_one_line(tmp_path: Path, suffix: str) -> None:
    tally = examined(f"damaged {suffix}", damaged(tmp_path, suffix, 60, seed=1), read, tmp_path)
    assert tally.faults == []
    assert tally.share("refused") > 0.5
    tally = examined(f"values {suffix}", values(tmp_path, suffix), read, tmp_path)
    assert tally.faults == []
    assert tally.share("refused") > 0.7


def too_large(name: str, values: np.ndarray) -> np.ndarray:
    """A field with a last element that no sensor gives, and whose square float64 does not hold."""
    changed = values.copy()
    changed[(-1,) * changed.ndim] = 1e160 if name == "time" else -1e160
    return changed


FLOATS = [name for name, values in fields().items() if values.dtype.kind == "f"]
PLACE = rf"-?1e\+160 at sample {N - 1}.*; accepted: numbers of at most 1e\+30"


@pytest.mark.parametrize("name", FLOATS)
def test_a_number_beyond_all_that_is_measured_is_refused_where_it_stands(tmp_path: Path, name: str) -> None:
    for suffix in SUFFIXES:
        path = write_arrays(tmp_path / f"log{suffix}", fields() | {name: too_large(name, fields()[name])})
        with pytest.raises(LogError, match=f"{name}: {PLACE}"):
            read_log(path)
        with pytest.raises(LogError, match=f"{name}: {PLACE}"), open_log_blocks(path, tmp_path) as blocks:
            blocks.read(slice(0, N))


def test_a_number_beyond_all_that_is_measured_is_refused_in_a_table(tmp_path: Path) -> None:
    write_log(read_log(write_arrays(tmp_path / "log.npz", fields())), tmp_path / "log.csv")
    *rows, last = (tmp_path / "log.csv").read_text().splitlines()
    column = rows[0].split(",").index('"joint_torque.knee"')
    cells = [*last.split(",")[:column], "1e160", *last.split(",")[column + 1 :]]
    (tmp_path / "log.csv").write_text("\n".join([*rows, ",".join(cells)]) + "\n")
    with pytest.raises(LogError, match=rf"joint_torque: 1e\+160 at sample {N - 1}, knee"):
        read_log(tmp_path / "log.csv")


@pytest.mark.parametrize("name", ["time", "joint_torque"])
@pytest.mark.parametrize("memory", ["2", "0.00001"], ids=["whole", "block by block"])
def test_no_parameters_are_identified_from_a_number_beyond_all_that_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, memory: str
) -> None:
    folder = shortened_demo(tmp_path / "demo", 60)
    with np.load(folder / "sway_train.npz") as log:
        content = {"contact_wrench_local": np.zeros((60, 4, 6))} | dict(log)
    np.savez(folder / "sway_train.npz", **content | {name: too_large(name, content[name])})
    run = ["identify", str(folder / "quadruped.yaml"), f"output={tmp_path / 'run'}"]
    line = refusal([*run, f"preprocessing.memory_gb={memory}"], tmp_path, capsys)
    assert f"sway_train.npz: {name}: " in line
    assert "1e+160 at sample 59" in line


def test_archives_that_lie_are_refused(tmp_path: Path) -> None:
    """None of them is a log: bombs, pickles, headers of any size, entries by strange names."""
    tally = examined("archives", archives(tmp_path), read, tmp_path)
    assert tally.faults == []
    assert tally.share("refused") == 1.0


def test_hdf5_files_that_lie_are_refused(tmp_path: Path) -> None:
    """Other types of numbers are none of the lies."""
    tally = examined("HDF5", hdf5(tmp_path), read, tmp_path)
    assert tally.faults == []
    assert tally.accepted == ["an enumeration", "half precision", "extended precision"]


def test_a_file_that_points_to_another_shows_nothing_of_it(tmp_path: Path) -> None:
    pointing, seen = {"a link into another file", "a dataset of another file", "raw numbers in another file"}, set()
    for name, path in hdf5(tmp_path):
        if name in pointing:
            seen.add(name)
            with pytest.raises(LogError, match="joint_torque: cannot be read"):
                read_log(path)
    assert seen == pointing


def test_a_log_of_too_many_names_is_refused(tmp_path: Path) -> None:
    many = np.array([f"j{k}" for k in range(MAX_NAMES + 1)])
    for suffix in SUFFIXES:
        with pytest.raises(LogError, match="joint_names: cannot be read"):
            read_log(write_arrays(tmp_path / f"x{suffix}", fields() | {"joint_names": many}))
