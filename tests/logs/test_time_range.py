"""Parts of a log in time: the samples of the range, whatever the file, as if nothing else had been recorded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from bags import entries_of, parsed, topics_of, write_bag
from bags import recorded as recorded_bag
from hypothesis import given
from hypothesis import strategies as st
from large import recorded

from torchid.errors import LogError
from torchid.logs import Log, read_log, write_log
from torchid.logs.blocks import open_log_blocks
from torchid.logs.tables import save_table
from torchid.logs.time_range import TimeRange, share_samples, split_range

TIME = np.arange(300) / 100.0 + 5.0  # three seconds from 5 s on


def stamps(text: str, time: np.ndarray = TIME) -> list[float]:
    """The first and last of the chosen stamps, counted from the log's first."""
    return (time[TimeRange.parse(text).select(time)][[0, -1]] - time[0]).round(9).tolist()


def test_seconds_count_from_the_first_stamp_and_the_end_is_left_out() -> None:
    assert stamps("[0:3]") == stamps("[:]") == stamps("[0:]") == stamps("[:3]") == [0.0, 2.99]
    assert stamps("[0.5:1]") == [0.5, 0.99]
    assert stamps("[1:]") == [1.0, 2.99]
    assert stamps("[:1e-1]") == [0.0, 0.09]


def test_negative_seconds_count_from_the_end_of_the_last_sample() -> None:
    assert stamps("[-1:]") == [2.0, 2.99]
    assert stamps("[:-1]") == [0.0, 1.99]
    assert stamps("[-2:-1]") == [1.0, 1.99]


def test_shares_are_of_the_length_of_the_log() -> None:
    assert stamps("[:50%]") == [0.0, 1.49]
    assert stamps("[50%:]") == [1.5, 2.99]
    assert stamps("[0%:100%]") == [0.0, 2.99]


@given(
    st.lists(st.integers(1, 999), min_size=1, max_size=6, unique=True),
    st.sampled_from([0.0, 1.7e9]),
    st.sampled_from([0.001, 1 / 3, 0.1]),
)
def test_ranges_that_meet_lose_no_sample_and_share_none(cuts: list[int], origin: float, step: float) -> None:
    time = origin + step * np.arange(1_000)
    ends = ["", *(repr(step * cut) for cut in sorted(cuts)), ""]
    chosen = [TimeRange.parse(f"[{a}:{b}]").select(time) for a, b in zip(ends, ends[1:], strict=False)]
    assert [part.start for part in chosen] == [0, *sorted(cuts)]
    assert [part.stop for part in chosen] == [*sorted(cuts), 1_000]


@pytest.mark.parametrize("text", ["[0:4]", "[4:]", "[-4:]", "[2:1]", "[1:1]", "[0.001:0.002]", "[3:]", "[:0]", "[:-3]"])
def test_ranges_outside_of_the_log_or_without_a_sample_are_refused_with_its_length(text: str) -> None:
    with pytest.raises(LogError, match="lasts 3 s \\(300 samples\\)") as raised:
        TimeRange.parse(text).select(TIME)
    assert text in str(raised.value)


@pytest.mark.parametrize(
    "text",
    ["[]", "[1]", "[0-30]", "[0:30s]", "[0:1:2]", "[-10%:]", "[:101%]", "[nan:]", "[:inf]", "[a:b]", "[0:1e9999]"],
)
def test_brackets_that_hold_no_range_are_refused_in_one_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(LogError) as raised:
        split_range(tmp_path / f"walk.npz{text}")
    line = str(raised.value)
    assert line.startswith(f"{tmp_path}/walk.npz{text}: time range: '{text}' is no range")
    assert "accepted: [START:END]" in line
    assert "\n" not in line


def test_a_file_with_brackets_in_its_name_is_that_file(tmp_path: Path) -> None:
    path = tmp_path / "walk.npz[0:30]"
    assert split_range(path).file == tmp_path / "walk.npz"
    path.touch()
    assert split_range(path).file == path
    assert split_range(path).range is None
    assert split_range(tmp_path / "walk[1].npz").file.name == "walk[1].npz"


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        ("[:30]", "[30:]", False),
        ("[:30]", "[29.9:]", True),
        ("[:-10]", "[-10:]", False),
        ("[:-10]", "[-11:]", True),
        ("[:80%]", "[80%:]", False),
        ("[:80%]", "[:1]", True),
        ("[:30]", "[-10:]", None),
        ("[:30]", "[80%:]", None),
        ("[0:]", "[-10:]", True),
        ("[:100%]", "[5:6]", True),
    ],
)
def test_ranges_overlap_whatever_the_length_or_that_decides(one: str, other: str, expected: bool | None) -> None:
    a, b = TimeRange.parse(one), TimeRange.parse(other)
    assert share_samples(a, b) is share_samples(b, a) is expected
    assert share_samples(a, None) is share_samples(None, b) is True


def assert_equal(found: Log, expected: Log) -> None:
    assert found.arrays().keys() == expected.arrays().keys()
    for name, x in expected.arrays().items():
        np.testing.assert_array_equal(getattr(found, name), x, err_msg=name)
    assert found.names == expected.names


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".csv", ".parquet"])
def test_a_part_is_the_log_that_would_have_been_recorded_then(tmp_path: Path, suffix: str) -> None:
    np.savez(tmp_path / "raw.npz", **recorded(600))
    log = read_log(tmp_path / "raw.npz")
    write_log(log, whole := tmp_path / f"whole{suffix}")
    rate = round(1.0 / float(np.median(np.diff(log.time))))
    start, stop = 100 / rate, 450 / rate
    part = read_log(named := f"{whole}[{start}:{stop}]")
    assert part.source == named
    assert_equal(part, log.select(slice(100, 450)))
    with open_log_blocks(Path(named), tmp_path) as blocks:
        assert len(blocks) == 350
        assert_equal(blocks.read(slice(0, 350)), part)
        assert_equal(blocks.read(slice(20, 70)), part.select(slice(20, 70)))


def test_a_part_of_a_bag_is_cut_from_it(tmp_path: Path) -> None:
    log = replace(recorded_bag())
    path, topics = write_bag(tmp_path / "walk.mcap", entries_of(log)), parsed(topics_of(log))
    with pytest.warns(match="no stamps"):
        whole = read_log(path, topics)
    cut = float(whole.time[25])
    with pytest.warns(match="no stamps"):
        assert_equal(read_log(f"{path}[{cut!r}:]", topics), whole.select(slice(25, None)))


def test_values_outside_of_a_part_are_not_looked_at(tmp_path: Path) -> None:
    fields = recorded(600)
    fields["joint_position"][500] = np.nan
    np.savez(tmp_path / "log.npz", **fields)
    with pytest.raises(LogError, match="nan at sample 500"):
        read_log(tmp_path / "log.npz")
    assert len(read_log(f"{tmp_path / 'log.npz'}[:50%]")) == 300
    with pytest.raises(LogError, match="nan at sample 200"):
        read_log(f"{tmp_path / 'log.npz'}[50%:]")


def test_a_field_of_another_length_is_refused_in_a_part_too(tmp_path: Path) -> None:
    fields = recorded(600)
    fields["joint_torque"] = fields["joint_torque"][:300]
    np.savez(tmp_path / "log.npz", **fields)
    with pytest.raises(LogError, match="joint_torque: shape \\(300, 12\\); accepted: 600 samples"):
        read_log(f"{tmp_path / 'log.npz'}[:50%]")


@pytest.mark.parametrize("save", [lambda path, x: np.savez(path, **x), save_table], ids=["log.npz", "log.csv"])
def test_recordings_one_after_the_other_are_as_in_files_of_their_own(
    tmp_path: Path, save: Callable[[Path, dict[str, np.ndarray]], None], request: pytest.FixtureRequest
) -> None:
    path, starts = tmp_path / request.node.callspec.id, [0, 40, 65, 125]
    fields = {name: x for name, x in recorded(125).items() if name != "contact_wrench_local"}
    whole = [slice(*ends) for ends in pairwise(starts)]
    anew = np.concatenate([fields["time"][part] - fields["time"][part.start] for part in whole])
    save(path, fields | {"time": anew})
    for number, part in enumerate(whole):
        alone = {name: x[part] if len(x) == 125 else x for name, x in (fields | {"time": anew}).items()}
        np.savez(tmp_path / "alone.npz", **alone)
        name = f"{path}[#{number}]"
        assert_equal(read_log(name), expected := read_log(tmp_path / "alone.npz"))
        with open_log_blocks(Path(name), tmp_path) as blocks:
            assert_equal(blocks.read(slice(0, len(expected))), expected)
    with pytest.raises(LogError, match=r"recording: \[#3\], but the file has 3 recordings; accepted: \[#0\] to"):
        read_log(f"{path}[#3]")
    for name in (str(path), f"{path}[:80%]"):
        with pytest.raises(LogError, match=r"at sample 40, after .* add \[#0\] or \[#0:8\] to the file name"):
            read_log(name)
    one, other = split_range(f"{path}[#1]").range, split_range(f"{path}[#2]").range
    assert (share_samples(one, one), share_samples(one, other), share_samples(one, None)) == (True, False, True)
