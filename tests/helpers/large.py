"""Logs that are read in parts, and what tells where their samples are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from demo import DEMO, WITHOUT_TERMS_LINE
from motions import RATE, angles, position
from scipy.spatial.transform import Rotation

from torchid.config import load_config
from torchid.fitting.experiment import set_up
from torchid.logs import read_log, write_log
from torchid.problem import Samples
from torchid.reading.log_reader import LogReader

SAMPLES = 9_000  # two parts and a bit
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
    read = active | (np.arange(4) == 0)  # the first foot's sensor in the air, too
    return {
        "time": time,
        "joint_names": np.array(joints),
        "joint_position": 0.4 * np.sin(3.0 * time[:, None] + phases) + 0.1 * np.sin(11.0 * time[:, None] * phases),
        "joint_torque": 5.0 * rng.normal(size=(samples, len(joints))),
        "base_position_world": position(time),
        "base_quat_xyzw": quat,
        "contact_names": np.array([f"{leg}_foot" for leg in legs]),
        "contact_active": active,
        "contact_wrench_local": np.where(read[..., None], 20.0 * rng.normal(size=(samples, 4, 6)), np.nan),
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
    text = text.replace("joint_torque: 0.1, contact_force: 0.5", "joint_torque: 10.0, contact_force: 20.0")  # as it is
    (folder / "run.yaml").write_text(text.replace(logs, f"logs: {{train: [log{suffix}]}}") + WITHOUT_TERMS_LINE)
    return folder / "run.yaml"


def samples_of(file: Path, *overrides: str, required: bool = True) -> Samples:
    setup = set_up(load_config(file, overrides))
    return LogReader(setup).read(setup.config.logs.train, setup.sensors if required else None)[0]


def tensors(samples: Samples) -> dict[str, torch.Tensor]:
    both = vars(samples) | {f"base {name}": x for name, x in vars(samples.base).items()}
    return {name: x for name, x in both.items() if isinstance(x, torch.Tensor)}


def assert_same(large: Samples, whole: Samples, tolerance: float) -> None:
    """Every tensor is the same, to a share of its largest value; quaternions but for their sign."""
    expected, found = tensors(whole), tensors(large)
    assert found.keys() == expected.keys()
    for name, x in expected.items():
        assert found[name].shape == x.shape, name
        assert torch.equal(found[name].isnan(), x.isnan()), name
        size = float(x.double().nan_to_num().abs().max())
        other = found[name].double()
        if name == "base quat_xyzw":
            other = other * torch.sign((other * x).sum(1, keepdim=True))
        error = float((other - x.double()).nan_to_num().abs().max())
        assert error <= tolerance * size, f"{name}: {error / size:.1e}"
    assert large.source == whole.source
    assert large.oversampling == pytest.approx(whole.oversampling, rel=1e-12)
    assert large.wrench_in_world == whole.wrench_in_world


def is_on_disk(samples: Samples) -> bool:
    """Whether all of the samples is in files; asserts that nothing is if not all is."""
    places = [file_of(x) for x in tensors(samples).values() if x.numel()]
    assert all(places) or not any(places)
    return all(places)


def file_of(x: torch.Tensor | None) -> str:
    """Where the file was made that is mapped where a tensor is and has no name any longer, "" if there is none."""
    assert x is not None
    address = x.data_ptr()
    for line in Path("/proc/self/maps").read_text().splitlines():
        first, last = (int(number, 16) for number in line.split()[0].split("-"))
        if first <= address < last and line.endswith(" (deleted)"):
            return str(Path(line.split(maxsplit=5)[5]).parent)
    return ""


def overrides(settings: dict[str, float], sensors: str = "joints") -> tuple[str, ...]:
    """Of the demo's experiment file."""
    return (f"sensors={sensors}", *(f"preprocessing.{k}={x}" for k, x in ({"cutoff_hz": "null"} | settings).items()))
