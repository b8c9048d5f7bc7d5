"""Processes that read logs together: each log once, into files that all of them map."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from demo import shortened_demo
from large import recorded
from shared_work import TORCHRUN, finish

from torchid import ranks
from torchid.commands.cached_reading import _shares

#: What each of two processes does: reads logs of several experiments, and says which of them it has opened.
PROGRAM = """
import hashlib, json, os, sys, warnings
from pathlib import Path
from torchid import ranks
from torchid.commands import reading
from torchid.commands.cached_reading import CachedReader, open_cache
from torchid.config import load_config
from torchid.fitting.experiment import set_up
import torch.distributed as dist

def digest(samples):
    both = {**vars(samples), **{"base " + name: x for name, x in vars(samples.base).items()}}
    data = [x.numpy().tobytes() for name, x in sorted(both.items()) if hasattr(x, "numpy")]
    return hashlib.sha256(b"".join(data)).hexdigest()

opened, read_log = [], reading.read_log
reading.read_log = lambda path, *rest, **named: [opened.append(Path(path).name), read_log(path, *rest, **named)][1]
dist.init_process_group("gloo")
rank, found = dist.get_rank(), []
for file, *more in json.loads(sys.argv[1]):
    opened.clear()
    said = []
    with warnings.catch_warnings(record=True) as said, ranks.share_work():
        warnings.simplefilter("always")
        scene = set_up(load_config(file, [x.replace("RANK", str(rank)) for x in more]))
        cache = open_cache(scene)
        try:
            reader = reading.LogReader(scene) if cache is None else CachedReader(scene, cache)
            logs = reader.read(scene.config.logs.train, scene.sensors)
            error = ""
        except ValueError as failure:
            logs, error = [], str(failure)
    entry = {"opened": list(opened), "logs": [digest(x) for x in logs], "error": error, "cache": cache is not None}
    found.append(entry | {"said": [str(x.message) for x in said], "sources": [x.source for x in logs]})
Path(sys.argv[2], f"{rank}.json").write_text(json.dumps(found))
sys.stdout.flush()
os._exit(0)
"""


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
    runs = {
        "without": [three, out, "preprocessing.cache_gb=0"],
        "first": [three, out],
        "second": [three, out],
        "broken, without": [broken, f"output={folder / 'broken' / 'run'}", "preprocessing.cache_gb=0"],
        "broken": [broken, f"output={folder / 'broken' / 'run'}"],
        "apart": [three, f"output={folder / 'machineRANK' / 'run'}"],
        "parts": [f'logs.train=["{demo}/gaps.npz[:50%]", "{demo}/gaps.npz[50%:]"]', f"output={folder}/parts/run"],
        "little room": [three, f"output={folder / 'little' / 'run'}", "preprocessing.cache_gb=0.001"],
    }
    common = ["logs.test=[]", "preprocessing.cutoff_hz=8"]
    (folder / "program.py").write_text(PROGRAM)
    calls = json.dumps([[file, *common, *more] for more in runs.values()])
    status, _, complained = finish([*TORCHRUN, "2", str(folder / "program.py"), calls, str(folder)])
    assert status == 0, complained
    both = [json.loads((folder / f"{rank}.json").read_text()) for rank in range(2)]
    return {name: [one[number] for one in both] for number, name in enumerate(runs)}


def test_each_log_is_read_by_one_process_and_all_have_it(read: dict[str, list[Any]]) -> None:
    assert sorted(sum((x["opened"] for x in read["first"]), [])) == ["gaps.npz", "sway_test.npz", "sway_train.npz"]
    assert all(x["opened"] for x in read["first"])
    assert [x["opened"] for x in read["second"]] == [[], []]
    assert [len(x["opened"]) for x in read["without"]] == [3, 3]


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
    for one in read["apart"]:
        assert not one["cache"]
        assert len(one["opened"]) == 3


def test_what_the_cache_has_no_room_for_is_read_by_all(read: dict[str, list[Any]]) -> None:
    assert all(one["cache"] for one in read["little room"])
    assert len(set(sum((one["opened"] for one in read["little room"]), []))) == 3


@pytest.mark.parametrize(("sizes", "processes"), [([5, 1, 1, 1, 2], 2), ([3], 3), ([], 2), ([7, 7, 7, 1], 3)])
def test_every_log_has_one_reader_and_the_largest_share_is_small(
    monkeypatch: pytest.MonkeyPatch, sizes: list[int], processes: int
) -> None:
    monkeypatch.setattr(ranks, "_sharing", ranks._Ranks(None, 0, processes))
    shares = _shares(dict(enumerate(sizes)))
    assert len(shares) == processes
    assert sorted(sum(shares, [])) == list(range(len(sizes)))
    bound = sum(sizes) / processes + max(sizes, default=0)
    assert max(sum(sizes[number] for number in share) for share in shares) <= bound
