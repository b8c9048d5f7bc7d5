"""Robots, finished runs and places to run commands in that test files share; no test may take long."""

from __future__ import annotations

import fcntl
import gc
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import pytest
from demo import DEMO, shortened_demo
from hostile_commands import Commands
from run_figures import EVENTS, draw, draw_nothing
from synthetic import load

import torchid
from torchid import kernels
from torchid.cli import main
from torchid.robot import Robot

signal.signal(signal.SIGINT, signal.default_int_handler)  # a run started in the background inherits one that is ignored
sys.dont_write_bytecode = False  # rewriting the assertions of all tests anew takes each worker 8 s
gc.disable()  # until all tests are collected, which leaves 600,000 objects and no garbage


def pytest_collection_finish() -> None:
    """Look for garbage less often than after every 700 new objects, which takes a tenth of all tests' time."""
    gc.set_threshold(20_000, 10, 10)
    gc.enable()


CALL_SECONDS = 3.0
"""Processor time that a test may take beside other workers, 2 s alone, without its fixtures, unless marked as slow."""
LIMITED = ("api", "defaults", "hostile", "identifiability", "legged", "paper")
"""Folders whose tests are all that fast, or marked; others follow."""
_IMPORTED_MODULES = 30
"""A test that is the first to import so many pays for others too, and is not judged."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    """Fail a test that takes longer, in this process and in those that it has waited for."""
    slow = item.get_closest_marker("slow")
    if slow is not None and not slow.args:
        pytest.fail('slow without a reason; accepted: pytest.mark.slow("why"), or pytest.mark.study', pytrace=False)
    modules = len(sys.modules)
    before = sum(os.times()[:4])
    result = yield
    seconds = sum(os.times()[:4]) - before
    limited = item.path.relative_to(Path(__file__).parent).parts[0] in LIMITED
    judged = slow is None and len(sys.modules) < modules + _IMPORTED_MODULES
    if limited and judged and seconds > CALL_SECONDS:
        pytest.fail(
            f"took {seconds:.1f} s of processor time, more than {CALL_SECONDS:g} s; accepted: fewer samples, a smaller "
            'robot, a fixture that is shared, or pytest.mark.slow("why")',
            pytrace=False,
        )
    return result


@pytest.fixture(scope="module", params=["compiled", "torch"])
def both_ways(request: pytest.FixtureRequest) -> Iterator[None]:
    """Run tests of modules with the compiled kernels, and as where torchid was installed without a compiler."""
    if request.param == "compiled":
        if kernels.compiled() is None:
            pytest.skip(kernels.why_not_compiled())
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, "_load", lambda: (None, "installed without a compiler"))
        yield


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A folder that the first worker that asks for it makes, and all others wait for and read.

    Args:
        factory: of this worker.
        name: of the folder's parent, which holds nothing else.
        make: makes the folder, which is not there yet.
    """
    folders = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folders = folders.parent  # of the run
    folder = folders / name / name
    with (folders / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.parent.exists():
            folder.parent.mkdir()
            make(folder)
    return folder


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


@pytest.fixture(scope="session")
def demo_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of the demo as it ships, with what TensorBoard shows. Nothing may be changed in it."""

    def make(output: Path) -> None:
        with pytest.MonkeyPatch.context() as monkeypatch:
            draw(monkeypatch, (EVENTS,))
            assert main(["identify", str(DEMO / "quadruped.yaml"), f"output={output}", "--quiet"]) == 0

    return made_once(tmp_path_factory, "demo_run", make)


@pytest.fixture(scope="session")
def demo_result() -> torchid.Identification:
    """What that run finds, in memory."""
    return torchid.identify(DEMO / "quadruped.yaml", output=None)


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
