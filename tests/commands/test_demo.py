"""`torchid demo`: what ships with the package, run from where nothing can be written and copied to be edited."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from refusals import refusal
from repository import CONFIGS, DEMO, ROOT

from torchid.cli import main
from torchid.config import inputs_of, load_analysis, load_config, load_simulation

WITHOUT_EXTRAS = """
import sys

extras = ["h5py", "pyarrow", "rosbags", "mcap", "lz4", "zstandard", "plotly", "clarabel", "mujoco"]
sys.modules.update(dict.fromkeys(extras))
from torchid.cli import main

sys.exit(main(["demo", "estimator.ridge=0.1"]))
"""
SETS = ("full", "contacts", "joints", "reduced", "analysis")


def test_the_demo_runs_without_extras_from_a_package_that_cannot_be_written(tmp_path: Path) -> None:
    """Of a copy of the package, in a process that sees no other and none of what the extras bring."""
    site, work = tmp_path / "site", tmp_path / "work"
    shutil.copytree(ROOT / "torchid", site / "torchid")
    work.mkdir()
    before = sorted(site.rglob("*"))
    for path in (site, *before):
        path.chmod(0o555 if path.is_dir() else 0o444)
    try:
        command = [sys.executable, "-c", WITHOUT_EXTRAS]
        environment = os.environ | {"PYTHONPATH": str(site), "PYTHONDONTWRITEBYTECODE": "1"}
        run = subprocess.run(command, cwd=work, env=environment, capture_output=True, text=True, check=True)
    finally:
        for path in (site, *before):
            path.chmod(0o755 if path.is_dir() else 0o644)
    assert sorted(site.rglob("*")) == before
    assert run.stdout.startswith("Much better than the URDF on unseen motion (sway_test.npz)")
    lines = run.stdout.splitlines()
    assert len(lines) <= 20, "a screen"
    (start,) = (number for number, line in enumerate(lines) if line.startswith("written to"))
    written, experiment = lines[start], " ".join(lines[start + 1 :])
    assert written.split() == ["written", "to", str(work / "runs" / "quadruped")]
    assert str(site / "torchid" / "demo" / "quadruped.yaml") in experiment
    assert (work / "runs" / "quadruped" / "identified.urdf").exists()


def test_a_folder_that_is_there_is_replaced_only_on_request(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    line = refusal(["demo", "--output", str(tmp_path / "mine")], tmp_path, capsys)
    assert line.endswith("mine: output: not empty; accepted: a new folder, or overwrite=true")


def test_copied_examples_find_their_robots_and_logs_and_replace_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["demo", "--copy", "examples"]) == 0
    printed = capsys.readouterr().out
    for file in (*DEMO.iterdir(), *CONFIGS.glob("biped*")):
        copy = Path("examples") / file.name
        assert copy.read_bytes() == file.read_bytes()
        assert (file.suffix != ".yaml") or f"{copy}\n    {file.read_text()[2:].splitlines()[0]}\n" in printed
    assert not Path("runs").exists(), "nothing is fitted"
    assert all(path.exists() for path in inputs_of(load_config("examples/quadruped.yaml")))
    simulation = load_simulation("examples/biped_simulation.yaml")
    assert simulation.robot.urdf.exists()
    runs = [load_analysis(f"examples/biped_{name}.yaml", ["logs=null", "analysis.compare={}"]) for name in SETS]
    assert {run.robot.urdf for run in runs} == {simulation.output / "nominal.urdf"}
    assert "--copy: exists" in refusal(["demo", "--copy", "examples"], tmp_path, capsys)
    assert "--copy FOLDER alone" in refusal(["demo", "--copy", "more", "estimator.ridge=1"], tmp_path, capsys)
