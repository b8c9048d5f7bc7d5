"""`torchid demo`: what ships with the package, run from where nothing can be written and copied to be edited."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import refusal
from repository import CONFIGS, DEMO, ROOT
from scipy.spatial.transform import Rotation
from script_calls import script

import torchid
from torchid.cli import main
from torchid.config import inputs_of, load_analysis, load_config, load_simulation

WITHOUT_EXTRAS = """
import sys

extras = ["h5py", "pyarrow", "rosbags", "mcap", "lz4", "zstandard", "mujoco"]
sys.modules.update(dict.fromkeys(extras))
from torchid.cli import main

sys.exit(main(["demo", "estimator.ridge=0.1"]))
"""
SETS = ("full", "contacts", "joints", "reduced", "analysis")


@pytest.mark.slow("a process of its own, which compiles the package")
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


@pytest.mark.parametrize("name", ["sway_train", "sway_test"])
def test_every_foot_pushes_within_its_friction_cone_in_all_samples(name: str) -> None:
    """As recorded: with up to four standard deviations of the noise of the force that counts."""
    maker, robot = script("make_demo"), torchid.load_robot(DEMO / "quadruped.urdf")
    log = torchid.read_log(DEMO / f"{name}.npz")
    orientation = Rotation.from_quat(log.base_quat_xyzw)
    q = torch.from_numpy(np.hstack([log.base_position_world, log.base_quat_xyzw, log.joint_position]))
    assert log.joint_names == robot.joint_names
    for k, foot in enumerate(log.contact_names):
        J = torchid.FrameJacobian(robot, foot)(q)[:, :3, :3].numpy()  # its transpose turns to the base's axes
        force = orientation.apply(np.einsum("bij,bi->bj", J, log.contact_wrench_local[:, k, :3]))
        normal, along = force[:, 2], np.hypot(*force[:, :2].T)
        noise = maker.FORCE_NOISE * np.hypot(1.0, maker.GROUND_FRICTION)
        assert np.all(along - maker.GROUND_FRICTION * normal < 4.0 * noise)
        assert np.all(normal > -4.0 * maker.FORCE_NOISE)
        assert not force[~log.contact_active[:, k]].any()
        assert np.median(normal) > 40.0


def test_a_motion_in_which_a_foot_would_pull_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    maker = script("make_demo")
    monkeypatch.setattr(maker, "FOLDER", tmp_path)
    monkeypatch.setattr(maker, "LEAN_M", np.zeros(3))
    with pytest.raises(ValueError, match=r": .* N on the ground, .* N along it"):
        maker.main()
    assert not list(tmp_path.glob("*.npz"))
