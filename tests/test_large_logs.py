"""A log larger than memory is read, preprocessed and bound block by block, with the same result."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time as clock
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from demo import DEMO
from motions import RATE, angles, position
from refusals import refusal
from scipy.spatial.transform import Rotation

from torchid.cli import main
from torchid.config import load_config
from torchid.errors import LogError, TorchidWarning
from torchid.logs import read_log, write_log
from torchid.logs.blocks import open_blocks, size_of
from torchid.logs.plan import plan
from torchid.logs.spill import Spill, SpillError
from torchid.logs.timeline import Timeline
from torchid.problem import Samples
from torchid.run.experiment import set_up

SAMPLES = 15_000  # three blocks and a bit
SMALL = "preprocessing.memory_gb=0.0001"
Fields = dict[str, Any]


def recorded(samples: int = SAMPLES, jitter: float = 0.0, seed: int = 0) -> Fields:
    """A log of the demo quadruped on a smooth path that obeys no dynamics; quaternions jump sign, flags change."""
    rng = np.random.default_rng(seed)
    time = (np.arange(samples) + jitter * rng.uniform(-1.0, 1.0, samples)) / RATE
    quat = Rotation.from_euler("ZYX", angles(time)).as_quat() * rng.choice([-1.0, 1.0], (samples, 1))
    legs = [f"{end}_{side}" for end in ("front", "rear") for side in ("left", "right")]
    joints = [f"{leg}_{joint}" for leg in legs for joint in ("hip", "thigh", "knee")]
    phases = rng.uniform(0.0, 6.0, len(joints))
    active = np.sin(2.0 * time[:, None] + np.arange(4)) > -0.7
    return {
        "time": time,
        "joint_names": np.array(joints),
        "joint_position": 0.4 * np.sin(3.0 * time[:, None] + phases) + 0.1 * np.sin(11.0 * time[:, None] * phases),
        "joint_torque": 5.0 * rng.normal(size=(samples, len(joints))),
        "base_position_world": position(time),
        "base_quat_xyzw": quat,
        "contact_names": np.array([f"{leg}_foot" for leg in legs]),
        "contact_active": active,
        "contact_wrench_local": np.where(active[..., None], 20.0 * rng.normal(size=(samples, 4, 6)), np.nan),
    }


def experiment(folder: Path, fields: Fields, suffix: str = ".npz") -> Path:
    """An experiment file in the folder, whose one log has these fields."""
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / "log.npz", **fields)
    if suffix != ".npz":
        write_log(read_log(folder / "log.npz"), folder / f"log{suffix}")
    text = (DEMO / "quadruped.yaml").read_text().replace("quadruped.urdf", str(DEMO / "quadruped.urdf"))
    logs = "logs: {train: [sway_train.npz], test: [sway_test.npz]}"
    assert logs in text
    (folder / "run.yaml").write_text(text.replace(logs, f"logs: {{train: [log{suffix}]}}"))
    return folder / "run.yaml"


def samples_of(file: Path, *overrides: str, required: bool = True) -> Samples:
    scene = set_up(load_config(file, overrides))
    return scene.read(scene.config.logs.train, required)[0]


def tensors(samples: Samples) -> dict[str, torch.Tensor]:
    both = vars(samples) | {f"base {name}": x for name, x in vars(samples.base).items()}
    return {name: x for name, x in both.items() if isinstance(x, torch.Tensor)}


def assert_same(large: Samples, whole: Samples, tolerance: float) -> None:
    """Every tensor is the same, to a share of its largest value."""
    expected, found = tensors(whole), tensors(large)
    assert found.keys() == expected.keys()
    for name, x in expected.items():
        assert found[name].shape == x.shape, name
        assert torch.equal(found[name].isnan(), x.isnan()), name
        size = float(x.double().nan_to_num().abs().max())
        error = float((found[name].double() - x.double()).nan_to_num().abs().max())
        assert error <= tolerance * size, f"{name}: {error / size:.1e}"
    assert large.source == whole.source
    assert large.oversampling == pytest.approx(whole.oversampling, rel=1e-12)
    assert large.wrench_in_world == whole.wrench_in_world


def is_on_disk(samples: Samples) -> bool:
    """Whether what is mapped where the samples are is a file, which has no name any longer."""
    address = samples.joint_acceleration.data_ptr()
    for line in Path("/proc/self/maps").read_text().splitlines():
        first, last = (int(x, 16) for x in line.split()[0].split("-"))
        if first <= address < last:
            return line.endswith(" (deleted)")
    return False


SETTINGS = {
    "differentiated": ({}, 0.0),
    "filtered": ({"cutoff_hz": 8}, 1e-10),
    "resampled": ({"sample_rate_hz": 137}, 0.0),
    "filtered and resampled": ({"sample_rate_hz": 301.5, "cutoff_hz": 25}, 1e-10),
    "upsampled": ({"sample_rate_hz": 1000}, 0.0),
    "away from contact changes": ({"contact_margin_s": 0.05, "cutoff_hz": 20}, 1e-10),
}


def overrides(settings: dict[str, float], sensors: str = "joints") -> tuple[str, ...]:
    """Of the demo's experiment file."""
    return (f"sensors={sensors}", *(f"preprocessing.{k}={x}" for k, x in ({"cutoff_hz": "null"} | settings).items()))


@pytest.mark.parametrize(("settings", "tolerance"), SETTINGS.values(), ids=SETTINGS.keys())
@pytest.mark.parametrize("jitter", [0.0, 0.3], ids=["uniform", "jittered"])
def test_blocks_give_the_samples_of_the_whole_log(
    tmp_path: Path, settings: dict[str, float], tolerance: float, jitter: float
) -> None:
    file = experiment(tmp_path, recorded(jitter=jitter), ".h5")
    whole, large = samples_of(file, *overrides(settings)), samples_of(file, *overrides(settings), SMALL)
    assert is_on_disk(large)
    assert not is_on_disk(whole)
    assert_same(large, whole, tolerance)


def test_the_neighbourhood_of_a_block_is_as_long_as_the_filter_remembers() -> None:
    for cutoff, rate in ((8.0, 500.0), (0.5, 100.0), (49.0, 100.0), (20.0, 1000.0)):
        time = np.arange(60_000) / rate
        low_pass = plan("x", time, cutoff, None, differentiates=False).low_pass
        assert low_pass is not None
        impulse = np.zeros(60_000)
        impulse[30_000] = 1.0
        response = np.abs(low_pass(impulse[:, None])[:, 0])
        assert response[30_000 + low_pass.settling :].max() < 1e-15 * response.max()
        assert response[30_000 + low_pass.settling // 2 :].max() > 1e-15 * response.max(), "no longer than needed"
