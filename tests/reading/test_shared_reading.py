"""Processes that read logs together: each log once, into files that all of them map."""

from __future__ import annotations

import errno
import hashlib
import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.distributed as dist  # noqa: TID251
from demo import shortened_demo
from large import SMALL, experiment, recorded, tensors
from shared_work import finish_forked

from torchid import checksums, distributed
from torchid.config import load_config
from torchid.fitting.experiment import set_up
from torchid.problem import Samples
from torchid.reading import cache as caches
from torchid.reading import cached_reader, large_log, log_reader
from torchid.reading.cache import FOLDER
from torchid.reading.cached_reader import CachedReader, _shares, open_cache
from torchid.reading.log_reader import LogReader


def digest(samples: Samples) -> str:
    both = {**vars(samples), **{f"base {name}": x for name, x in vars(samples.base).items()}}
    data = [x.numpy().tobytes() for name, x in sorted(both.items()) if hasattr(x, "numpy")]
    return hashlib.sha256(b"".join(data)).hexdigest()


def read_all(calls: Sequence[Sequence[str]], folder: Path) -> int:
    """What each of two processes does: reads logs of several experiments, and writes which of them it has opened."""
    opened: list[str] = []
    bound: list[int] = []
    summed: list[list[Any]] = []
    read_log, bind, sum_up = log_reader.read_log, large_log.LargeLog._bound, checksums.part_checksum

    def open_and_read(path: Path, *rest: Any, **named: Any) -> Any:
        opened.append(Path(path).name)
        return read_log(path, *rest, **named)

    def note_and_bind(log: Any, cover: Any, block: Any) -> Any:
        bound.append(block.piece.start)
        return bind(log, cover, block)

    def note_and_sum_up(part: checksums.FilePart) -> str:
        summed.append([part.path.name, part.start])
        return sum_up(part)

    log_reader.read_log, large_log.LargeLog._bound = open_and_read, note_and_bind  # type: ignore[method-assign]
    cached_reader.part_checksum, checksums._PART, caches._YOUNG = note_and_sum_up, 100_000, -1.0
    dist.init_process_group("gloo")
    rank, found = dist.get_rank(), []
    for file, *more in calls:
        opened.clear()
        bound.clear()
        summed.clear()
        log_reader._WHOLE_GB, large_log.BLOCK_GB = (0.0, 1e-4) if "in blocks" in more else (0.04, 0.01)
        overrides = [x.replace("RANK", str(rank)) for x in more if x != "in blocks"]
        with warnings.catch_warnings(record=True) as said, distributed.share_work():
            warnings.simplefilter("always")
            setup = set_up(load_config(Path(file), overrides))
            cache, logs, error = open_cache(setup), [], ""
            try:
                reader = LogReader(setup) if cache is None else CachedReader(setup, cache)
                logs = reader.read(setup.config.logs.train, setup.sensors)
            except ValueError as failure:
                error = str(failure)
        entry = {"opened": list(opened), "logs": [digest(x) for x in logs], "error": error, "cache": cache is not None}
        entry |= {
            "summed": list(summed),
            "blocks": sorted(bound),
            "said": [str(x.message) for x in said],
            "sources": [x.source for x in logs],
        }
        found.append(entry)
    (folder / f"{rank}.json").write_text(json.dumps(found))
    return 0


@pytest.fixture(scope="module")
def read(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    """What two processes have done with each experiment, by its name."""
    folder = tmp_path_factory.mktemp("together")
    demo = shortened_demo(folder / "demo", 300)
    fields = recorded(1_500)
    fields["contact_wrench_local"][500:700, 1, 2], fields["contact_active"][:, 1] = np.nan, True
    np.savez(demo / "gaps.npz", **fields)
    np.savez(demo / "short.npz", **(fields | {"time": fields["time"][::-1]}))
    file, out = str(demo / "quadruped.yaml"), f"output={folder / 'run'}"
    three = "logs.train=[sway_train.npz, sway_test.npz, gaps.npz]".replace("[", f"[{demo}/").replace(", ", f", {demo}/")
    broken = f"logs.train=[{demo}/gaps.npz, {demo}/short.npz, {demo}/sway_train.npz]"
    fields = recorded(9_000)
    fields["contact_wrench_local"][6_500:6_700, 1, 2], fields["contact_active"][:, 1] = np.nan, True
    np.savez(demo / "long.npz", **fields)
    fields["joint_position"][8_500, 3] = np.nan
    np.savez(demo / "nan.npz", **fields)
    long, nan = f"logs.train=[{demo}/long.npz, {demo}/sway_train.npz]", f"logs.train=[{demo}/nan.npz]"
    fewer = ["preprocessing.contact_margin_s=0.02", "preprocessing.sample_rate_hz=150"]
    slip = "preprocessing.max_slip=4"
    runs = {
        "without": [three, out, "preprocessing.cache_gb=0"],
        "first": [three, out],
        "second": [three, out],
        "broken, without": [broken, f"output={folder / 'broken' / 'run'}", "preprocessing.cache_gb=0"],
        "broken": [broken, f"output={folder / 'broken' / 'run'}"],
        "apart": [three, f"output={folder / 'machineRANK' / 'run'}"],
        "parts": [f'logs.train=["{demo}/gaps.npz[:50%]", "{demo}/gaps.npz[50%:]"]', f"output={folder}/parts/run"],
        "blocks, without": ["in blocks", long, out, "preprocessing.cache_gb=0"],
        "blocks": ["in blocks", long, f"output={folder / 'blocks' / 'run'}"],
        "blocks again": ["in blocks", long, f"output={folder / 'blocks' / 'run'}"],
        "fewer, without": ["in blocks", long, *fewer, out, "preprocessing.cache_gb=0"],
        "fewer": ["in blocks", long, *fewer, f"output={folder / 'fewer' / 'run'}"],
        "slipping, without": ["in blocks", long, slip, out, "preprocessing.cache_gb=0"],
        "slipping": ["in blocks", long, slip, f"output={folder / 'slipping' / 'run'}"],
        "on the disk, without": [long, SMALL, out, "preprocessing.cache_gb=0"],
        "on the disk": ["in blocks", long, SMALL, f"output={folder / 'disk' / 'run'}"],
        "broken blocks, without": ["in blocks", nan, out, "preprocessing.cache_gb=0"],
        "broken blocks": ["in blocks", nan, f"output={folder / 'nan' / 'run'}"],
        "no room": [
            "in blocks",
            long,
            f"output={folder / 'less' / 'run'}",
            "preprocessing.cache_gb=0.0026",
        ],
        "little room": [three, f"output={folder / 'little' / 'run'}", "preprocessing.cache_gb=0.001"],
    }
    common = ["logs.test=[]", "preprocessing.cutoff_hz=8"]
    calls = [[file, *common, *more] for more in runs.values()]
    status, _, complained = finish_forked(2, lambda: read_all(calls, folder))
    assert status == 0, complained
    both = [json.loads((folder / f"{rank}.json").read_text()) for rank in range(2)]
    return {name: [one[number] for one in both] for number, name in enumerate(runs)}


def test_each_log_is_read_by_one_process_and_all_have_it(read: dict[str, list[Any]]) -> None:
    assert sorted(sum((x["opened"] for x in read["first"]), [])) == ["gaps.npz", "sway_test.npz", "sway_train.npz"]
    assert all(x["opened"] for x in read["first"])
    assert [x["opened"] for x in read["second"]] == [[], []]
    assert [len(x["opened"]) for x in read["without"]] == [3, 3]


@pytest.mark.parametrize("name", ["first", "parts", "blocks"])
def test_each_part_of_a_file_is_summed_up_once(read: dict[str, list[Any]], name: str) -> None:
    summed = [[tuple(part) for part in one["summed"]] for one in read[name]]
    assert all(summed)
    assert len({*summed[0], *summed[1]}) == len(summed[0]) + len(summed[1])
    assert [x["summed"] for x in read["second"]] == [[], []], "the index knows them"


@pytest.mark.parametrize("name", ["first", "second", "apart", "little room"])
def test_samples_and_warnings_are_those_without_a_cache(read: dict[str, list[Any]], name: str) -> None:
    expected = read["without"][0]
    assert len(expected["logs"]) == 3
    assert any("NaN in part of" in line for line in expected["said"])
    for one in read[name]:
        assert (one["logs"], one["said"], one["error"]) == (expected["logs"], expected["said"], "")
        assert one["sources"] == expected["sources"]


def test_parts_of_one_log_are_shared_like_logs(read: dict[str, list[Any]]) -> None:
    parts = ["gaps.npz[50%:]", "gaps.npz[:50%]"]
    assert sorted(sum((x["opened"] for x in read["parts"]), [])) == parts
    assert all(len(x["opened"]) == 1 for x in read["parts"])
    assert read["parts"][0]["logs"] == read["parts"][1]["logs"]


def test_a_log_that_cannot_be_read_fails_as_without_a_cache(read: dict[str, list[Any]]) -> None:
    expected = read["broken, without"][0]
    assert "time" in expected["error"]
    for one in read["broken"]:
        assert one["cache"]
        assert (one["error"], one["said"]) == (expected["error"], expected["said"])


def test_processes_without_a_common_folder_read_all_logs(read: dict[str, list[Any]]) -> None:
    assert len(read["apart"]) == 2
    for one in read["apart"]:
        assert not one["cache"]
        assert len(one["opened"]) == 3


def test_what_the_cache_has_no_room_for_is_read_by_all(read: dict[str, list[Any]]) -> None:
    assert all(one["cache"] for one in read["little room"])
    assert len(set(sum((one["opened"] for one in read["little room"]), []))) == 3


@pytest.mark.parametrize("name", ["blocks", "fewer", "slipping", "on the disk"])
def test_blocks_of_a_large_log_are_shared_and_its_samples_are_those_of_one_process(
    read: dict[str, list[Any]], name: str
) -> None:
    expected = read[f"{name}, without"][0]
    assert any("NaN in part of" in line for line in expected["said"])
    assert any("samples dropped, in which" in line for line in expected["said"]) == (name == "slipping")
    for one in read[name]:
        assert (one["logs"], one["said"], one["error"]) == (expected["logs"], expected["said"], "")
        assert len(one["blocks"]) >= 1
    assert sorted(sum((one["blocks"] for one in read[name]), [])) == expected["blocks"]


def test_a_large_log_is_not_read_again(read: dict[str, list[Any]]) -> None:
    assert [one["blocks"] for one in read["blocks again"]] == [[], []]
    assert [one["logs"] for one in read["blocks again"]] == [one["logs"] for one in read["blocks"]]


def test_an_error_in_the_blocks_of_one_process_is_said_by_all_as_by_one(read: dict[str, list[Any]]) -> None:
    expected = read["broken blocks, without"][0]
    assert "8500" in expected["error"]
    assert [(one["error"], one["said"]) for one in read["broken blocks"]] == [(expected["error"], expected["said"])] * 2


def test_a_large_log_without_room_in_the_cache_is_read_by_all(read: dict[str, list[Any]]) -> None:
    expected = read["blocks, without"][0]
    assert len(read["no room"]) == 2
    for one in read["no room"]:
        assert (one["logs"], one["said"]) == (expected["logs"], expected["said"])
        assert set(one["blocks"]) == set(expected["blocks"])


@pytest.fixture
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The experiment of a log that one process reads in three blocks."""
    monkeypatch.setattr("torchid.reading.log_reader._WHOLE_GB", 0.0)
    monkeypatch.setattr("torchid.reading.large_log.BLOCK_GB", 1e-4)
    fields = recorded(9_000)
    fields["contact_wrench_local"][500:700, 1, 2], fields["contact_active"][:, 1] = np.nan, True
    return experiment(tmp_path, fields)


def read_by(file: Path, cached: bool, *more: str) -> tuple[dict[str, torch.Tensor], list[str]]:
    """All tensors of a log's samples, read with or without a cache, and what was said."""
    setup = set_up(load_config(file, [f"output={file.parent / 'run'}", *more]))
    cache = open_cache(setup)
    assert cache is not None
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        reader = CachedReader(setup, cache) if cached else LogReader(setup)
        (samples,) = reader.read(setup.config.logs.train, setup.sensors)
    return tensors(samples), [str(one.message) for one in said]


def test_one_process_writes_the_blocks_of_a_large_log_to_the_cache_as_it_reads_them(
    alone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected, said = read_by(alone, False)
    monkeypatch.setattr(CachedReader, "_read", None)  # never has all of the log in memory
    found, repeated = read_by(alone, True)
    assert any("NaN in part of" in line for line in said)
    assert repeated == said
    assert found.keys() == expected.keys()
    for name, x in expected.items():
        assert found[name].numpy().tobytes() == x.numpy().tobytes(), name


@pytest.mark.parametrize("more", ["preprocessing.cache_gb=0.005", "preprocessing.cache_gb=1"])
def test_blocks_that_the_cache_does_not_take_are_read_into_memory(
    alone: Path, monkeypatch: pytest.MonkeyPatch, more: str
) -> None:
    expected, said = read_by(alone, False)
    if more.endswith("=1"):
        monkeypatch.setattr("torchid.reading.shared_log.file_checksum", full_disk)
    found, repeated = read_by(alone, True, more)
    assert repeated == said
    assert all(torch.equal(found[name].nan_to_num(), x.nan_to_num()) for name, x in expected.items())
    assert not [path for path in (alone.parent / FOLDER).iterdir() if path.name.endswith(".torchid")]


def full_disk(_: Path) -> str:
    raise OSError(errno.ENOSPC, "no room")


@pytest.mark.parametrize(("sizes", "processes"), [([5, 1, 1, 1, 2], 2), ([3], 3), ([], 2), ([7, 7, 7, 1], 3)])
def test_every_log_has_one_reader_and_the_largest_share_is_small(
    monkeypatch: pytest.MonkeyPatch, sizes: list[int], processes: int
) -> None:
    monkeypatch.setattr(distributed, "_sharing", distributed._Group(None, 0, processes))
    shares = _shares(dict(enumerate(sizes)))
    assert len(shares) == processes
    assert sorted(sum(shares, [])) == list(range(len(sizes)))
    bound = sum(sizes) / processes + max(sizes, default=0)
    assert max(sum(sizes[number] for number in share) for share in shares) <= bound
