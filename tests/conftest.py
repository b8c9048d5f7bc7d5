"""Robots, and places to run commands in, that several test files use."""

from __future__ import annotations

import gc
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from demo import shortened_demo
from hostile_commands import Commands
from made_once import made_once
from run_figures import EVENTS, draw, draw_nothing
from synthetic import load

import torchid
from torchid.robot import Robot

signal.signal(signal.SIGINT, signal.default_int_handler)  # a run started in the background inherits one that is ignored
sys.dont_write_bytecode = False  # rewriting the assertions of all tests anew takes each worker 8 s
gc.disable()  # until all tests are collected, which leaves 600,000 objects and no garbage


def pytest_collection_finish() -> None:
    """Look for garbage less often than after every 700 new objects, which takes a tenth of all tests' time."""
    gc.set_threshold(20_000, 10, 10)
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def _elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Work in a folder of its own: results without an absolute path go to the working folder."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setenv("PYTHONPATH", str(Path(torchid.__file__).parents[1]), os.pathsep)  # of child processes
        monkeypatch.delenv("PYTHONDONTWRITEBYTECODE", raising=False)  # of these too: they compile torchid once
        monkeypatch.delenv("COLUMNS", raising=False)  # of the terminal that tests are started from
        monkeypatch.chdir(tmp_path_factory.mktemp("work"))
        yield


@pytest.fixture(scope="session", autouse=True)
def _drawing_nothing() -> Iterator[None]:
    """Of the figures of a run a test sees white ones, of events none, unless it asks for `figures` or `events`."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        draw_nothing(monkeypatch)
        yield


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs draw what a user sees."""
    draw(monkeypatch)


@pytest.fixture(scope="module")
def events() -> Iterator[None]:
    """Runs of this file write what TensorBoard shows."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        draw(monkeypatch, (EVENTS,))
        yield


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    """A floating base with a hinge, a slide, a hinge that mimics the slide, and a branch; no axis along x, y or z."""
    inertia = '<inertia ixx="0.3" ixy="0.01" ixz="-0.02" iyy="0.4" iyz="0.03" izz="0.5"/>'
    inertial = f'<inertial><origin xyz="0.1 -0.2 0.3" rpy="0.4 0.5 -0.6"/><mass value="2"/>{inertia}</inertial>'
    origin = '<origin xyz="0.3 0.1 -0.2" rpy="0.3 -0.2 0.1"/>'
    elements = [f'<link name="{name}">{inertial}</link>' for name in ("base", "a", "b", "c", "d")]
    mimic = '<mimic joint="slide" multiplier="-1.5" offset="0.2"/>'
    for name, kind, parent, child, axis, extra in (
        ("hinge", "revolute", "base", "a", "1 2 3", ""),
        ("slide", "prismatic", "a", "b", "-1 1 0.5", ""),
        ("follower", "revolute", "b", "c", "0 1 -1", mimic),
        ("branch", "continuous", "a", "d", "0 -1 0", ""),
    ):
        ends = f'<parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
        elements.append(f'<joint name="{name}" type="{kind}">{origin}{ends}{extra}</joint>')
    path = tmp_path_factory.mktemp("small") / "small.urdf"
    path.write_text(f'<robot name="small">{"".join(elements)}</robot>')
    return load(path)


@pytest.fixture(scope="session")
def biped_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `torchid simulate` writes of the shipped biped, every motion cut to seconds."""
    from forked import forked_simulations
    from simulated import short

    from torchid.commands.simulate import simulate

    with forked_simulations():
        return made_once(tmp_path_factory, "biped", lambda output: simulate(short(output)))


@pytest.fixture(scope="module")
def place() -> Iterator[Path]:
    """A folder with a short demo that anyone may read."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        shortened_demo(Path(name) / "demo", 100)
        yield Path(name)


@pytest.fixture(scope="session")
def server() -> Commands:
    """What runs commands in processes of their own."""
    return Commands()
