"""Log files of strangers: whatever is in them, they are read or refused in one line, soon and in bounded memory."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hostile import Tally, examined
from hostile_logs import archives, damaged, fields, hdf5, values, write
from hypothesis import given, settings
from hypothesis import strategies as st

from torchid.errors import LogError
from torchid.logs import read_log
from torchid.logs.fields import NAN_ALLOWED
from torchid.logs.limits import MAX_FIELDS, MAX_LETTERS, MAX_NAMES

SUFFIXES = (".npz", ".h5")
COUNTS = [60, pytest.param(600, marks=pytest.mark.slow)]


def read(path: Path) -> None:
    """Read a log; whatever is taken for one has finite numbers, but where NaN means that nothing was measured."""
    log = read_log(path)
    for name, array in log.arrays().items():
        assert not np.isinf(array).any()
        assert name in NAN_ALLOWED or not np.isnan(array).any()


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("count", COUNTS)
def test_damaged_logs_are_read_or_refused_in_one_line(tmp_path: Path, suffix: str, count: int) -> None:
    tally = examined(f"damaged {suffix}", damaged(tmp_path, suffix, count, seed=1), read, tmp_path)
    assert refused(tally) > count / 2


@pytest.mark.parametrize(
    ("suffix", "share"),
    [
        (".npz", 2),
        (".h5", 8),
        pytest.param(".npz", 1, marks=pytest.mark.slow),
        pytest.param(".h5", 1, marks=pytest.mark.slow),
    ],
)
def test_senseless_values_are_read_or_refused_in_one_line(tmp_path: Path, suffix: str, share: int) -> None:
    tally = examined(f"values {suffix}", islice(values(tmp_path, suffix), 0, None, share), read, tmp_path)
    assert refused(tally) > 200 / share


def test_archives_that_lie_are_refused(tmp_path: Path) -> None:
    """None of them is a log: bombs, pickles, headers of any size, entries by strange names."""
    tally = examined("archives", archives(tmp_path), read, tmp_path)
    assert refused(tally) == len(tally.verdicts)


def test_hdf5_files_that_lie_are_refused(tmp_path: Path) -> None:
    """Other types of numbers are none of the lies."""
    tally = examined("HDF5", hdf5(tmp_path), read, tmp_path)
    accepted = [x.name for x in tally.verdicts if x.outcome == "accepted"]
    assert accepted == ["an enumeration", "half precision", "big-endian", "extended precision"]


def test_a_file_that_points_to_another_shows_nothing_of_it(tmp_path: Path) -> None:
    for name, path in hdf5(tmp_path):
        if name in ("a link into another file", "a dataset of another file", "raw numbers in another file"):
            with pytest.raises(LogError, match="joint_torque: cannot be read"):
                read_log(path)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.integers(0, 3 * MAX_FIELDS), st.integers(0, 3 * MAX_LETTERS), st.sampled_from(SUFFIXES))
def test_limits_are_far_beyond_any_log(
    tmp_path_factory: pytest.TempPathFactory, n: int, letters: int, suffix: str
) -> None:
    """As many joints, of names as long: what is read, is read whole."""
    names = [f"{k}".rjust(max(letters, 4), "j") for k in range(n)]
    content = fields() | {name: np.zeros((40, n)) for name in fields() if name.startswith("joint_")}
    path = write(
        tmp_path_factory.getbasetemp() / f"many{suffix}", content | {"joint_names": np.array(names, dtype="U")}
    )
    if letters <= MAX_LETTERS:
        assert read_log(path).joint_names == tuple(names)


def test_a_log_of_too_many_names_is_refused(tmp_path: Path) -> None:
    many = np.array([f"j{k}" for k in range(MAX_NAMES + 1)])
    for suffix in SUFFIXES:
        with pytest.raises(LogError, match="joint_names: cannot be read"):
            read_log(write(tmp_path / f"x{suffix}", fields() | {"joint_names": many}))


def refused(tally: Tally) -> int:
    """How many cases were refused."""
    return sum(x.outcome == "refused" for x in tally.verdicts)
