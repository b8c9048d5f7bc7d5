"""Entries of a cache: bounded, whole, and taken only as they were written."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchid.errors import TorchidWarning
from torchid.parallel import forks_allowed
from torchid.reading.cache import Cache, content_key


def arrays_of(megabytes: float) -> dict[str, np.ndarray]:
    return {"x": np.arange(125_000 * megabytes)}


def key_of(number: int) -> str:
    return content_key(number)


def test_entries_that_were_not_used_for_longest_go_first(tmp_path: Path) -> None:
    for number in range(3):
        assert Cache(tmp_path, 0.0035).save(key_of(number), {"number": number}, arrays_of(1.0))
        os.utime(tmp_path / key_of(number) / "entry.json", (number, number))
    entry = Cache(tmp_path, 0.0035).load(key_of(0))  # which is then the last that was used
    assert entry is not None
    assert entry.document == {"number": 0}
    assert Cache(tmp_path, 0.0035).save(key_of(3), {}, arrays_of(1.0))
    assert {path.name for path in tmp_path.iterdir()} == {key_of(number) for number in (0, 2, 3)}
    np.testing.assert_array_equal(entry.arrays["x"], arrays_of(1.0)["x"])
    Cache(tmp_path, 0.0015).tidy()
    assert {path.name for path in tmp_path.iterdir()} == {key_of(3)}


def test_an_entry_that_exceeds_the_bound_alone_or_with_those_of_this_run_is_not_written(tmp_path: Path) -> None:
    cache = Cache(tmp_path / "cache", 0.0025)
    assert not cache.save(key_of(0), {}, arrays_of(3.0))
    assert not (tmp_path / "cache").exists()
    assert [cache.save(key_of(number), {}, arrays_of(1.0)) for number in (1, 2, 3)] == [True, True, False]
    assert keys_in_cache(cache) == {key_of(1), key_of(2)}


def keys_in_cache(cache: Cache) -> set[str]:
    return {path.name for path in cache.folder.iterdir()}


def flip(path: Path) -> None:
    """A bit in the middle of a file, whose time does not tell."""
    state, data = path.stat(), bytearray(path.read_bytes())
    data[len(data) // 2] ^= 16
    path.write_bytes(data)
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))


DAMAGE = {
    "a bit of an array": lambda entry: flip(entry / "x.npy"),
    "a bit of the description": lambda entry: flip(entry / "entry.json"),
    "cut off": lambda entry: os.truncate(entry / "x.npy", 100),
    "no array": lambda entry: (entry / "x.npy").unlink(),
    "an empty description": lambda entry: (entry / "entry.json").write_text(""),
    "another's": lambda entry: (entry / "entry.json").write_text('{"entry": 3, "sha256": [1]}'),
    "nested": lambda entry: (entry / "entry.json").write_text("[" * 100_000),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_entry_is_dropped_with_one_line(tmp_path: Path, name: str) -> None:
    assert Cache(tmp_path, 1.0).save(key_of(0), {"a": 1}, arrays_of(0.1))
    DAMAGE[name](tmp_path / key_of(0))
    with pytest.warns(TorchidWarning) as said:
        assert Cache(tmp_path, 1.0).load(key_of(0)) is None
    (line,) = {str(x.message) for x in said}
    assert line.startswith(f"{tmp_path / key_of(0)}: a damaged entry of the cache (")
    assert "\n" not in line
    assert list(tmp_path.iterdir()) == []


def test_an_entry_without_a_description_is_none_and_is_replaced(tmp_path: Path) -> None:
    assert Cache(tmp_path, 1.0).save(key_of(0), {"a": 1}, arrays_of(0.1))
    (tmp_path / key_of(0) / "entry.json").unlink()
    assert Cache(tmp_path, 1.0).load(key_of(0)) is None
    assert Cache(tmp_path, 1.0).save(key_of(0), {"a": 2}, arrays_of(0.1))
    entry = Cache(tmp_path, 1.0).load(key_of(0))
    assert entry is not None
    assert entry.document == {"a": 2}


def test_an_entry_of_another_name_is_not_taken(tmp_path: Path) -> None:
    assert Cache(tmp_path, 1.0).save(key_of(0), {"a": 1}, arrays_of(0.1))
    (tmp_path / key_of(0)).rename(tmp_path / key_of(1))
    with pytest.warns(TorchidWarning, match="of another name"):
        assert Cache(tmp_path, 1.0).load(key_of(1)) is None


def test_a_copied_entry_is_taken_if_its_checksums_are_right(tmp_path: Path) -> None:
    assert Cache(tmp_path / "a", 1.0).save(key_of(0), {"a": 1}, arrays_of(0.1))
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    entry = Cache(tmp_path / "b", 1.0).load(key_of(0))
    assert entry is not None
    assert not entry.arrays["x"].flags.writeable


def test_of_two_that_store_the_same_at_once_both_find_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from torchid.reading import cache as module

    write, others = module._write, [Cache(tmp_path, 1.0)]

    def written(*arguments: Any) -> Any:
        if others:
            assert others.pop().save(key_of(0), {"who": 2}, arrays_of(0.1))
        return write(*arguments)

    monkeypatch.setattr(module, "_write", written)
    cache = Cache(tmp_path, 1.0)
    assert cache.save(key_of(0), {"who": 1}, arrays_of(0.1))
    entry = cache.load(key_of(0))
    assert entry is not None
    assert entry.document == {"who": 2}
    assert keys_in_cache(cache) == {key_of(0)}


def test_what_a_killed_run_left_is_removed_by_the_next(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys; from pathlib import Path; import numpy as np; from torchid.reading import cache; "
        "cache._rename = lambda *_: os.kill(os.getpid(), signal.SIGKILL); "
        "cache.Cache(Path(sys.argv[1]), 1.0).save('0' * 64, {}, {'x': np.zeros(9)})"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "cache")], check=False)
    (left,) = (tmp_path / "cache").iterdir()
    assert left.name.startswith(".")
    cache = Cache(tmp_path / "cache", 1.0)
    assert cache.load("0" * 64) is None
    cache.tidy()
    assert list((tmp_path / "cache").iterdir()) == []


def test_a_young_checksum_is_not_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file may change again within one tick of its time stamp."""
    monkeypatch.setattr("torchid.reading.cache._YOUNG", 2.0)
    cache, found = Cache(tmp_path / "cache", 1.0), set()
    for text in ("a", "b"):
        (tmp_path / "log").write_text(text)
        found.add(cache.checksum(tmp_path / "log", [tmp_path / "log"]))
    cache.write_index()
    assert len(found) == 2
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize("allowed", [forks_allowed, nullcontext], ids=["by a copy", "alone"])
def test_long_files_are_summed_up_while_something_else_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, allowed: Callable[[], AbstractContextManager[None]]
) -> None:
    log, done, content = tmp_path / "log", list[Path](), bytes(range(100))
    log.write_bytes(content)

    def meanwhile() -> None:
        done.append(log)

    with allowed():
        sums = [Cache(tmp_path / "cache", 1.0).checksum(log, [log], meanwhile)]
        assert not done, "a short file is summed up at once"
        monkeypatch.setattr("torchid.reading.cache._LONG", 100)
        monkeypatch.setattr("torchid.reading.cache._YOUNG", -1.0)
        cache = Cache(tmp_path / "cache", 1.0)
        sums += [cache.checksum(log, [log], meanwhile) for _ in range(2)]
        monkeypatch.setattr("torchid.checksums._PART", 30)
        sums.append(Cache(tmp_path / "cache", 1.0).checksum(log, [log]))
    assert sums[:3] == [hashlib.sha256(content).hexdigest()] * 3
    assert done == [log], "the second time nothing is read"
    of_parts = "".join(hashlib.sha256(content[start : start + 30]).hexdigest() for start in range(0, 100, 30))
    assert sums[3] == hashlib.sha256(of_parts.encode()).hexdigest()
