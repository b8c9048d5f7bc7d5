"""Noise of the motion through the commands: stated or found, in memory or block by block, and what is said of it."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from demo import shortened_demo

from torchid.cli import main
from torchid.config import load_config
from torchid.errors import TorchidWarning
from torchid.fitting.experiment import set_up
from torchid.logs import read_log, write_log
from torchid.problem.motion import MotionNoise
from torchid.reading.log_reader import LogReader


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo with encoders that are noisy by 1 mrad."""
    folder = shortened_demo(tmp_path_factory.mktemp("noisy") / "demo", 800)
    log = read_log(folder / "sway_train.npz")
    noise = 1e-3 * np.random.default_rng(0).normal(size=log.joint_position.shape)
    write_log(replace(log, joint_position=log.joint_position + noise), folder / "noisy.npz")
    return folder


def identified(demo: Path, out: Path, *overrides: str) -> dict[str, Any]:
    """Metrics of a run on the noisy log."""
    more = (f"logs.train=[{demo / 'noisy.npz'}]", *overrides)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        assert main(["identify", "--verbose", str(demo / "quadruped.yaml"), f"output={out}", *more]) == 0
    return dict(json.loads((out / "metrics.json").read_text()))


def test_a_run_says_how_much_was_noise_and_gives_more_to_what_is_small(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = identified(demo, tmp_path / "found")
    said = " ".join(capsys.readouterr().out.split())
    assert f"motion noise up to {100.0 * found['motion_noise']['largest']:.2g} % of the information" in said
    assert 0.01 < found["motion_noise"]["largest"] < 1.0
    assert found["motion_noise"]["combinations"] == found["rank"]
    none = [f"sensors.noise.{name}=0" for name in ("joint_position", "base_orientation")]
    without = identified(demo, tmp_path / "without", *none)
    assert without["motion_noise"]["largest"] < 0.1 * found["motion_noise"]["largest"], "the base's position is left"


@pytest.mark.parametrize("settings", ["{cutoff_hz: 8, sample_rate_hz: 50}", "{cutoff_hz: null}"])
def test_blocks_have_the_noise_of_the_whole_log(demo: Path, tmp_path: Path, settings: str) -> None:
    def noise(*more: str) -> MotionNoise:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TorchidWarning)
            setup = set_up(load_config(demo / "quadruped.yaml", [f"preprocessing={settings}", *more]))
            (samples,) = LogReader(setup, tmp_path).read([demo / "noisy.npz"], None)
        assert samples.motion_noise is not None
        return samples.motion_noise

    whole, blocks = noise(), noise("preprocessing.memory_gb=0.0001")
    assert torch.equal(whole.joints, blocks.joints)
    assert torch.equal(whole.base, blocks.base)
    assert whole.turns_force
    assert blocks.turns_force
    assert float(whole.joints[:, 2, 2].min()) > 0.01, "accelerations have noise"
