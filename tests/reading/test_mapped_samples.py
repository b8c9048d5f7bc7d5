"""Samples of logs larger than memory, which are mapped to temporary files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from demo import shortened_demo
from large import SMALL, tensors
from repository import DEMO

from torchid.config import load_config
from torchid.fitting.experiment import set_up
from torchid.logs import read_log
from torchid.logs.preprocess import preprocess
from torchid.problem import Samples, bind_log
from torchid.problem.chunks import map_chunks
from torchid.problem.contact_state import ContactState
from torchid.reading.log_reader import LogReader


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_a_pass_over_mapped_samples_lets_go_of_their_pages_and_finds_the_same_numbers_again(
    tmp_path: Path,
) -> None:
    demo = shortened_demo(tmp_path / "demo", 300) / "quadruped.yaml"
    config = load_config(demo, [f"output={tmp_path / 'run'}", SMALL])
    setup = set_up(config)
    [log] = LogReader(setup).read(config.logs.train, setup.sensors)
    before = {name: x.clone() for name, x in tensors(log).items()}
    assert mapped_kilobytes(tmp_path) > 0
    builder, seen = setup.builder(setup.sensors), []

    def look(chunks: Iterator[tuple[Samples, ContactState]]) -> None:
        for samples, _ in chunks:
            seen.append((mapped_kilobytes(tmp_path), samples.joint_position.sum()))  # reads a page

    in_one_state = replace(log, active=torch.ones_like(log.active))  # whose chunks are not copied
    map_chunks([in_one_state], builder, look, chunk=-(-len(log) // 6), threads=1)
    assert [kilobytes > 0 for kilobytes, _ in seen] == [True, True, True, True, False, True]
    for name, x in tensors(log).items():
        assert torch.equal(x.nan_to_num(), before[name].nan_to_num()), name


def mapped_kilobytes(folder: Path) -> int:
    """What of files in a folder is in this process's memory [kB]."""
    total, inside = 0, False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        if line.startswith("Rss:") and inside:
            total += int(line.split()[1])
        elif not line.split()[0].endswith(":"):
            inside = str(folder) in line
    return total


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_samples_far_apart_are_taken_from_files_without_their_pages_staying_in_memory(tmp_path: Path) -> None:
    demo = shortened_demo(tmp_path / "demo", 300) / "quadruped.yaml"
    config = load_config(demo, [f"output={tmp_path / 'run'}", SMALL])
    setup = set_up(config)
    [log] = LogReader(setup).read(config.logs.train, setup.sensors)
    near, far = torch.arange(0, len(log), 2), torch.arange(0, len(log), 30)
    expected = {name: x[far].nan_to_num() for name, x in tensors(log).items()}
    assert log[near].pages is log.pages
    log.pages.release()
    for chosen in (log[far], log.every(30)):
        assert mapped_kilobytes(tmp_path) == 0
        assert chosen.pages is None
        for name, x in tensors(chosen).items():
            assert torch.equal(x.nan_to_num(), expected[name]), name


def test_tensors_share_the_arrays_of_a_log_but_for_read_only_ones() -> None:
    """Columns of a table may be read-only, which torch warns of where tensors share them."""
    setup = set_up(load_config(DEMO / "quadruped.yaml"))
    log = preprocess(read_log(DEMO / "sway_train.npz"))
    fixed = replace(log, time=log.time.copy())
    fixed.time.setflags(write=False)
    shared, copied = (bind_log(x, setup.robot, setup.contacts) for x in (log, fixed))
    assert np.shares_memory(shared.time.numpy(), log.time)
    assert not np.shares_memory(copied.time.numpy(), fixed.time)
    assert np.array_equal(copied.time.numpy(), fixed.time)
