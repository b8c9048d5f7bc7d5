"""Samples of the cache that are mapped to its files."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
import torch
from demo import shortened_demo
from large import tensors

from torchid.commands.cache import FOLDER
from torchid.commands.cached_reading import open_reader
from torchid.config import load_config
from torchid.fitting.experiment import set_up


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_a_pass_over_mapped_samples_lets_go_of_their_pages_and_finds_the_same_numbers_again(
    tmp_path: Path,
) -> None:
    demo = shortened_demo(tmp_path / "demo", 300) / "quadruped.yaml"
    config = load_config(demo, [f"output={tmp_path / 'run'}"])
    scene, done = set_up(config), []
    reader = open_reader(scene)
    [log] = reader.read(config.logs.train, scene.sensors)
    before = {name: x.clone() for name, x in tensors(log).items()}
    assert mapped_kilobytes(tmp_path / FOLDER) > 0
    progress = reader.progress(done.append)
    for _ in range(7):
        progress(3)
    assert mapped_kilobytes(tmp_path / FOLDER) > 0
    progress(3)
    assert mapped_kilobytes(tmp_path / FOLDER) == 0
    assert done == [3] * 8
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
    config = load_config(demo, [f"output={tmp_path / 'run'}"])
    scene = set_up(config)
    reader = open_reader(scene)
    [log] = reader.read(config.logs.train, scene.sensors)
    near, far = torch.arange(0, len(log), 2), torch.arange(0, len(log), 30)
    expected = {name: x[far].nan_to_num() for name, x in tensors(log).items()}
    assert log[near].pages is log.pages
    reader.let_go()
    for chosen in (log[far], log.every(30)):
        assert mapped_kilobytes(tmp_path / FOLDER) == 0
        assert chosen.pages is None
        for name, x in tensors(chosen).items():
            assert torch.equal(x.nan_to_num(), expected[name]), name


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_mapped_samples_that_are_sent_to_another_process_are_in_its_memory(tmp_path: Path) -> None:
    demo = shortened_demo(tmp_path / "demo", 300) / "quadruped.yaml"
    config = load_config(demo, [f"output={tmp_path / 'run'}"])
    scene = set_up(config)
    [log] = open_reader(scene).read(config.logs.train, scene.sensors)
    there = pickle.loads(pickle.dumps(log))  # noqa: S301 - what was just written
    there.pages.let_go()
    for name, x in tensors(there).items():
        assert torch.equal(x.nan_to_num(), tensors(log)[name].nan_to_num()), name
