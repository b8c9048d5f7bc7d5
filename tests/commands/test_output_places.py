"""Where results go, and what the documents and the lock say of what is installed."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest
import yaml
from demo import DEMO
from repository import ROOT

import torchid
from torchid.config import load_analysis, load_simulation
from torchid.staging import interrupts_deferred, termination_as_interrupt


def test_results_of_what_ships_go_to_the_working_folder_and_nothing_into_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for file in (DEMO / "quadruped.yaml", *(ROOT / "configs").glob("*.yaml")):
        if "motions" in yaml.safe_load(file.read_text()):
            output = load_simulation(file).output
        else:
            output = load_analysis(file, ["logs=null", "analysis.compare={}"]).output
        assert output.parent == tmp_path / "runs", file


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("ignored", [False, True])
def test_calls_to_end_are_interrupts_even_in_the_background(number: signal.Signals, ignored: bool) -> None:
    """A shell starts commands in the background with SIGINT ignored; SIGHUP that `nohup` ignores stays ignored."""
    before = signal.getsignal(signal.SIGINT)
    inherited = signal.signal(number, signal.SIG_DFL)  # whoever started the tests may have it ignored
    if ignored:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with pytest.raises(KeyboardInterrupt), termination_as_interrupt():
            signal.raise_signal(number)
        done = []
        with pytest.raises(KeyboardInterrupt), termination_as_interrupt(), interrupts_deferred():  # noqa: PT012
            signal.raise_signal(number)
            done.append("all of it")
        assert done
        if ignored:
            with interrupts_deferred():
                signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
        signal.signal(number, inherited)
    earlier = signal.signal(number, signal.SIG_IGN)
    try:
        with termination_as_interrupt():
            signal.raise_signal(number)
    finally:
        signal.signal(number, earlier)


# ------------------------------------------------------------------------------------------------------------ the name


def test_nobody_is_told_to_install_the_torchid_of_somebody_else() -> None:
    """That name on PyPI is another package."""
    files = [
        path for folder in ("torchid", "scripts", "docs", "configs", "tests") for path in (ROOT / folder).rglob("*")
    ]
    files += [ROOT / name for name in ("README.md", "Makefile", "pyproject.toml", "constraints.txt")]
    wrong = re.compile(r"pip3? install (?:-\S+ )*['\"]?torchid\b(?!/)|\btorchid\[[a-z]")
    for path in files:
        if path.suffix in (".py", ".md", ".yaml", ".toml", ".txt", "") and path.is_file() and path != Path(__file__):
            assert not wrong.search(path.read_text()), path
    assert wrong.search("pip install 'torchid[oracle]'")
    assert wrong.search("pip install torchid")


def test_the_lock_has_a_version_within_bounds_of_every_package_that_is_needed() -> None:
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    text = (ROOT / "pyproject.toml").read_text().partition("dependencies = [")[2].partition("[project.scripts]")[0]
    needed = [Requirement(x) for x in re.findall(r'"([a-z][^"]*[=<>\]][^"]*)"', text)]
    lock = [Requirement(x) for x in (ROOT / "constraints.txt").read_text().splitlines() if x and x[0] != "#"]
    versions = {canonicalize_name(x.name): next(iter(x.specifier)).version for x in lock}
    assert len(needed) > 15
    for one in needed:
        if one.name != "torchid-robotics":
            assert one.specifier.contains(versions[canonicalize_name(one.name)]), one
    assert torchid.__version__
