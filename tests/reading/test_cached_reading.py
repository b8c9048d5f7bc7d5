"""Samples from the cache: those of the logs, with all that was said when these were read."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from demo import shortened_demo
from large import experiment, overrides, recorded, tensors
from run_folders import keys_in
from trainings import trust_new_files

from torchid.cli import main
from torchid.config import load_config
from torchid.errors import TorchidWarning
from torchid.fitting.experiment import set_up
from torchid.problem import Samples
from torchid.reading.cached_reader import CachedReader, open_cache
from torchid.reading.log_reader import LogReader

NONE = "preprocessing.cache_gb=0"


@pytest.fixture(autouse=True)
def _new_files(monkeypatch: pytest.MonkeyPatch) -> None:
    trust_new_files(monkeypatch)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Experiment file of the demo, shortened."""
    return shortened_demo(tmp_path_factory.mktemp("cache") / "demo", 300) / "quadruped.yaml"


def read_with(kind: type[LogReader], file: Path, *more: str) -> Samples:
    """Samples of the training log."""
    setup = set_up(load_config(file, more))
    cache = open_cache(setup)
    assert cache is not None
    reader = CachedReader(setup, cache) if kind is CachedReader else kind(setup)
    (samples,) = reader.read(setup.config.logs.train, setup.sensors)
    return samples


def test_samples_without_readings_in_the_air_are_not_taken_where_offsets_of_contacts_are_fitted(
    demo: Path, tmp_path: Path
) -> None:
    output, offsets = f"output={tmp_path / 'run'}", ("sensors.set=full", "sensors.offsets={contact_force: log}")
    assert read_with(CachedReader, demo, output).wrench is not None
    expected, found = (read_with(reader, demo, output, *offsets) for reader in (LogReader, CachedReader))
    for name, there in tensors(expected).items():
        assert torch.equal(tensors(found)[name].nan_to_num(), there.nan_to_num()), name


def read_twice(file: Path, *more: str) -> list[tuple[list[str], dict[str, int], int]]:
    """What is said, what is excluded and how many samples there are, when logs are read without a cache, then twice."""
    out = []
    for cached in (False, True, True):
        setup = set_up(load_config(file, more))
        cache = open_cache(setup)
        assert cache is not None
        reader = CachedReader(setup, cache) if cached else LogReader(setup)
        with pytest.warns(TorchidWarning) as said:
            logs = reader.read(setup.config.logs.train, setup.sensors)
        out.append(([str(x.message) for x in said], dict(reader.excluded), sum(map(len, logs))))
    return out


def test_warnings_are_repeated_word_for_word_and_excluded_samples_counted(tmp_path: Path) -> None:
    fields = recorded(2_000)
    fields["contact_wrench_local"][500:700, 1, 2] = np.nan
    fields["contact_active"][:, 1] = True
    file = experiment(tmp_path / "a", fields)
    shutil.copytree(tmp_path / "a", tmp_path / "other place")
    shutil.move(tmp_path / "other place" / "log.npz", tmp_path / "other place" / "walk.npz")
    (tmp_path / "other place" / "run.yaml").write_text(file.read_text().replace("log.npz", "walk.npz"))
    settings = (*overrides({"cutoff_hz": 20.0}), f"output={tmp_path / 'run'}")
    without, first, second = read_twice(file, *settings)
    assert first == second == without
    assert "NaN in part of" in without[0][0]
    *_, moved = read_twice(tmp_path / "other place" / "run.yaml", *settings)
    assert moved[0] == [x.replace("a/log.npz", "other place/walk.npz") for x in without[0]]
    assert len(keys_in(tmp_path)) == 1


def test_excluded_samples_are_said_and_counted_again(demo: Path, tmp_path: Path) -> None:
    shutil.copytree(demo.parent, tmp_path / "demo")
    log = tmp_path / "demo" / "sway_train.npz"
    with np.load(log) as archive:
        arrays = dict(archive)
    arrays["joint_torque"][100:103, 2] += 1e4
    np.savez(log, **arrays)
    more = (f"output={tmp_path / 'run'}", "preprocessing.exclude_rejected=true")
    without, first, second = read_twice(tmp_path / "demo" / demo.name, *more)
    assert first == second == without
    assert without[1][str(log)] > 0


def test_a_sensor_that_was_not_recorded_is_missed_as_without_a_cache(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fields = recorded(1_000)
    del fields["contact_wrench_local"]
    file = experiment(tmp_path, fields)
    setup = set_up(load_config(file, (*overrides({}), f"output={tmp_path / 'run'}")))
    cache = open_cache(setup)
    assert cache is not None
    CachedReader(setup, cache).read(setup.config.logs.train, setup.sensors)
    assert keys_in(tmp_path)
    complaints = []
    for more in ((), (NONE,)):
        assert main(["identify", str(file), *overrides({}, "full"), f"output={tmp_path / 'run'}", *more]) == 2
        complaints.append(capsys.readouterr().err)
    assert "contact_wrench: missing" in complaints[0]
    assert complaints[0] == complaints[1]


def test_entries_with_something_else_in_them_are_dropped(demo: Path, tmp_path: Path) -> None:
    """As another program could write them, with all checksums."""
    setup = set_up(load_config(demo, (f"output={tmp_path / 'run'}",)))
    cache = open_cache(setup)
    assert cache is not None
    CachedReader(setup, cache).read(setup.config.logs.train, setup.sensors)
    (key,) = keys_in(tmp_path)
    for document, arrays in (({}, {}), ({"axes": {"time": [0]}}, {"time": np.zeros((2, 2))}), ({"axes": 3}, {})):
        shutil.rmtree(cache.folder / key)
        assert cache.save(key, document, arrays)
        with pytest.warns(TorchidWarning, match="a damaged entry"):
            (log,) = CachedReader(setup, cache).read(setup.config.logs.train, setup.sensors)
        assert len(log) == 250
