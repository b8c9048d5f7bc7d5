"""Fits and checks of logs larger than memory: what is kept on the disk, where, and for how long."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time as clock
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from large import (
    SMALL,
    assert_same,
    experiment,
    file_of,
    is_on_disk,
    overrides,
    recorded,
)
from refusals import refusal

from torchid.cli import main
from torchid.config import load_config
from torchid.estimators import LeastSquares
from torchid.fitting.experiment import set_up
from torchid.logs.blocks import log_bytes, open_log_blocks
from torchid.logs.spill import Spill, SpillError
from torchid.problem import RowBuilder, Samples, compress, linear_problem
from torchid.problem.metrics import calibrate_readings
from torchid.reading.log_reader import LogReader

IDENTIFY = ("estimator.ridge=0.001", "sensors=joints")


def fitted(file: Path, *more: str) -> np.ndarray:
    setup = set_up(load_config(file, (*overrides({"cutoff_hz": 18}), *more)))
    builder = RowBuilder(setup.robot, setup.contacts, setup.sensors)
    logs = LogReader(setup).read(setup.config.logs.train, setup.sensors)
    problem = linear_problem(compress(logs, builder), builder, setup.robot)
    return LeastSquares(1e-3).solve(problem).phi


def test_the_parameters_are_the_same(tmp_path: Path) -> None:
    file = experiment(tmp_path, recorded(5_000), ".h5")
    whole, large = fitted(file), fitted(file, SMALL)
    np.testing.assert_allclose(large, whole, rtol=1e-9, atol=1e-10 * np.abs(whole).max())


def test_logs_that_fit_one_by_one_but_not_together_go_to_the_disk_when_the_limit_is_reached(tmp_path: Path) -> None:
    file = experiment(tmp_path, recorded(3_000), ".h5")
    setup, size = set_up(load_config(file, overrides({}))), log_bytes(tmp_path / "log.h5", 0.0)
    settings = replace(setup.config.preprocessing, memory_gb=10.5e-9 * size)
    reader = LogReader(replace(setup, config=replace(setup.config, preprocessing=settings)))
    files = [tmp_path / "log.h5"] * 12
    logs = [*reader.read(files[:1], setup.sensors), *reader.read(files[1:], None)]
    assert [is_on_disk(samples) for samples in logs] == [False] * 10 + [True] * 2
    assert_same(logs[-1], logs[0], 1e-10)


def recalibrated(file: Path, terms: str, *more: str) -> tuple[Samples, Samples]:
    """A log as it was recorded and with its readings calibrated."""
    setup = set_up(load_config(file, (*overrides({}), "sensors.set=full", f"sensors.offsets={terms}", *more)))
    builder = RowBuilder(setup.robot, setup.contacts, setup.sensors, setup.terms)
    samples = LogReader(setup).read(setup.config.logs.train, None)[0]
    values = np.arange(1.0, 1.0 + len(builder.extras))
    return samples, calibrate_readings(samples, builder.extras, values, builder.tree)


def test_calibrated_readings_of_a_large_log_stay_on_the_disk_and_those_of_a_small_one_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torchid.problem.metrics._ROWS", 700)
    file, both = experiment(tmp_path, recorded(3_000)), "{joint_torque: log, contact_force: all}"
    (raw, whole), (_, large) = (recalibrated(file, both, *more) for more in ((), (SMALL, f"output={tmp_path / 'run'}")))
    assert (file_of(whole.torque), file_of(whole.wrench)) == ("", "")
    assert (file_of(large.torque), file_of(large.wrench)) == (str(tmp_path), str(tmp_path))
    assert_same(large, whole, 0.0)
    for before, after in ((raw.torque, whole.torque), (raw.wrench, whole.wrench)):
        assert before is not None
        assert after is not None
        assert not torch.equal(before.nan_to_num(), after.nan_to_num())


@pytest.mark.parametrize("more", [(), (SMALL,)], ids=["small", "large"])
def test_only_readings_with_unknowns_are_copied(tmp_path: Path, more: tuple[str, ...]) -> None:
    file = experiment(tmp_path, recorded(1_000))
    for terms, kept, changed in (("joint_torque", "wrench", "torque"), ("contact_force", "torque", "wrench")):
        before, after = recalibrated(file, f"{{{terms}: log}}", *more)
        assert getattr(after, kept) is getattr(before, kept)
        assert getattr(after, changed) is not getattr(before, changed)


@pytest.fixture
def made_in(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The folders in which files without a name are made, one entry for each file."""
    folders, make = [], tempfile.TemporaryFile

    def noted(*arguments: Any, **options: Any) -> Any:
        folders.append(str(options["dir"]))
        return make(*arguments, **options)

    monkeypatch.setattr(tempfile, "TemporaryFile", noted)
    return folders


def test_a_table_takes_one_file_for_each_field_however_many_batches_it_is_read_in(
    tmp_path: Path, made_in: list[str]
) -> None:
    experiment(tmp_path, recorded(2_000), ".parquet")
    pq.write_table(pq.read_table(tmp_path / "log.parquet"), tmp_path / "log.parquet", row_group_size=100)
    with open_log_blocks(tmp_path / "log.parquet", tmp_path) as blocks:
        assert len(blocks) == 2_000
        assert len(made_in) == 1 + len(blocks.row_shapes), "time too"


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_an_evaluation_keeps_large_logs_beside_the_run_wherever_that_was_moved_to(
    tmp_path: Path, made_in: list[str]
) -> None:
    file, run = experiment(tmp_path / "setup", recorded(1_000)), tmp_path / "elsewhere" / "run"
    assert main(["identify", str(file), f"output={tmp_path / 'here' / 'run'}", *IDENTIFY, SMALL]) == 0
    assert set(made_in) == {str(tmp_path)}
    made_in.clear()
    run.parent.mkdir()
    (tmp_path / "here" / "run").rename(run)
    shutil.rmtree(tmp_path / "here")
    assert main(["evaluate", str(run), "--log", str(tmp_path / "setup" / "log.npz")]) == 0
    assert set(made_in) == {str(run)}


def test_a_log_that_no_memory_holds_is_not_checked_with_or_without_an_experiment(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = experiment(tmp_path, recorded(300), ".h5")
    with h5py.File(tmp_path / "log.h5", "a") as log:
        early = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        early.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
        early.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
        space = h5py.h5s.create_simple((2**28, 1))
        h5py.h5d.create(log.id, b"joint_velocity", h5py.h5t.NATIVE_DOUBLE, space, early)
    for checked in (tmp_path / "log.h5", file):
        said = main(["check", str(checked)]), capsys.readouterr()
        assert said[0] == 2
        (line,) = said[1].err.splitlines()
        assert "file: arrays of 2.1 GB do not fit in memory; accepted: parts of the log, or" in line


@pytest.fixture
def small_disk() -> Any:
    """No file may grow beyond 200 kB."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_is_one_line_that_says_where_and_what_would_help(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], request: pytest.FixtureRequest
) -> None:
    file = experiment(tmp_path, recorded(4_000), ".h5")
    request.getfixturevalue("small_disk")
    line = refusal(["identify", str(file), SMALL, f"output={tmp_path / 'new' / 'run'}"], tmp_path, capsys)
    assert f"temporary file in {tmp_path}: cannot be written" in line
    assert "preprocessing.memory_gb" in line


def test_rows_that_do_not_fit_are_refused_and_their_file_is_closed(tmp_path: Path, small_disk: None) -> None:
    spill = Spill("x", tmp_path)
    spill.append(np.zeros((100, 100)))
    with pytest.raises(SpillError, match="cannot be written"):
        spill.append(np.zeros((200, 100)))
    assert os.listdir(tmp_path) == []
    with pytest.raises(SpillError, match="no-such-folder"):
        Spill("x", tmp_path / "no-such-folder")


def test_an_array_grows_by_rows_on_the_disk(tmp_path: Path) -> None:
    spill, rows = Spill("x", tmp_path), np.arange(24.0).reshape(6, 2, 2)
    for part in (rows[:1], rows[1:1], rows[1:]):
        spill.append(part)
    np.testing.assert_array_equal(spill.array(), rows)
    for nothing in (np.zeros((0, 3)), np.zeros((5, 0))):
        empty = Spill("x", tmp_path)
        empty.append(nothing)
        assert empty.array().shape == nothing.shape
    assert os.listdir(tmp_path) == []


@pytest.mark.slow("a command in a process of its own")
def test_an_interrupt_leaves_nothing_behind(tmp_path: Path) -> None:
    file = experiment(tmp_path, recorded(20_000), ".h5")
    command = [sys.executable, "-m", "torchid", "identify", str(file), SMALL, f"output={tmp_path / 'run'}"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    descriptors = Path(f"/proc/{process.pid}/fd")
    deadline = clock.monotonic() + 240.0  # of a busy machine
    while not any(str(tmp_path) in target and "deleted" in target for target in links(descriptors)):
        assert clock.monotonic() < deadline
        assert process.poll() is None
        clock.sleep(0.005)
    assert sorted(os.listdir(tmp_path)) == ["log.h5", "log.npz", "run.yaml"], "what is written has no name"
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 1
    assert said.splitlines()[-1] == "torchid: interrupted; nothing was written"
    assert sorted(os.listdir(tmp_path)) == ["log.h5", "log.npz", "run.yaml"]


def links(folder: Path) -> list[str]:
    """Where the links of a folder that changes point to."""
    found = []
    for name in os.listdir(folder):
        try:
            found.append(os.readlink(folder / name))
        except OSError:
            continue
    return found


READ = """
import json, scipy.signal, sys, threading, time, torch
from torchid.config import load_config
from torchid.problem.metrics import calibrate_readings
from torchid.fitting.experiment import set_up
from torchid.reading.log_reader import LogReader
def used():
    lines = open("/proc/self/status").read().splitlines()
    return next(int(line.split()[1]) / 1024.0 for line in lines if line.startswith("RssAnon"))
def watch():
    while True:
        peak.append(used())
        time.sleep(0.01)
torch.set_num_threads(1)
setup = set_up(load_config(sys.argv[1], sys.argv[2:]))
before, peak = used(), []
threading.Thread(target=watch, daemon=True).start()
samples = LogReader(setup).read(setup.config.logs.train, setup.sensors)[0]
size = sum(x.nbytes for part in (samples, samples.base) for x in vars(part).values() if isinstance(x, torch.Tensor))
print(json.dumps({"peak": max(peak) - before, "bytes": size / 2**20}))
"""


@pytest.mark.slow("a log of 40 MB in a process of its own")
def test_memory_is_bounded_by_the_limit_and_not_by_the_log(tmp_path: Path) -> None:
    file = experiment(tmp_path, recorded(60_000), ".h5")
    command = [sys.executable, "-c", READ, str(file), *overrides({"cutoff_hz": 20}), "preprocessing.memory_gb=0.02"]
    found = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
    assert found["bytes"] > 40.0
    assert found["peak"] < 0.75 * found["bytes"], "22 MiB of 41 measured, 25 of 136; read whole: 280 of 136"
