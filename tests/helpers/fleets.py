"""Robots with several logs each, fitted from these and from their factors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from demo import NO_TERMS, shortened_demo
from motions import value
from walking import MACHINES, recorded, truth

from torchid.commands.compress import Compression, compress
from torchid.commands.identify import identify
from torchid.commands.run_folder import Identification
from torchid.config import load_config
from torchid.logs import write_log

WALKS = ("left.npz", "right.npz", "long.npz")
SECONDS = (2.5, 2.0, 3.5)


def walks(folder: Path, machine: str, seconds: Sequence[float] = SECONDS, **settings: Any) -> Path:
    """An experiment file in a folder, of a machine that is unlike its URDF, with logs of different lengths.

    Every log of a robot with feet has offsets of its own in the readings of its soles.
    """
    one, rng = MACHINES[machine], np.random.default_rng(5)
    folder.mkdir(parents=True, exist_ok=True)
    for number, (name, length) in enumerate(zip(WALKS, seconds, strict=False)):
        log = recorded(one, truth(one, 3 + number, seconds=length), "full", number)
        if one.feet:
            offsets = rng.uniform(-1.0, 1.0, (len(one.feet), 6)) * [9.0, 9.0, 30.0, 2.0, 2.0, 2.0]
            log = replace(log, contact_wrench_local=value(log.contact_wrench_local) + offsets)
        write_log(replace(log, source=name), folder / name)
    experiment: dict[str, Any] = {
        "robot": {"urdf": str(one.urdf), "fixed_base": one.bolted},
        "contacts": [{"frame": foot, "type": one.kind} for foot in one.feet],
        "logs": {"train": list(WALKS[: len(seconds)])},
        "preprocessing": {"cutoff_hz": 10.0},
        "sensors": {"set": "full"},
        "actuators": NO_TERMS,
        "estimator": {"name": "least_squares", "ridge": 1e-3},
        "output": str(folder / "run"),
    }
    (folder / "experiment.yaml").write_text(yaml.safe_dump(experiment | settings))
    return folder / "experiment.yaml"


def compressed(file: Path, output: Path, *overrides: str) -> Compression:
    return compress(load_config(file, overrides), output)


def fitted(file: Path, name: str, *overrides: str) -> Identification:
    return identify(load_config(file, [f"output={file.parent / name}", *overrides]))


def fitted_twice(file: Path, *overrides: str) -> tuple[Identification, Identification]:
    """From the logs, and from their factors."""
    compressed(file, file.parent / "factors", *overrides)
    names = [Path(name).stem for name in yaml.safe_load(file.read_text())["logs"]["train"]]
    files = [str(file.parent / "factors" / f"{name}.factor") for name in names]
    return fitted(file, "of_logs", *overrides), fitted(file, "of_factors", *overrides, f"logs.train={files}")


def demo_fleet(folder: Path) -> Path:
    """The folder, with the demo cut short: logs.yaml, and experiment.yaml with the factors of both of its logs."""
    shortened_demo(folder, 200)
    settings = yaml.safe_load((folder / "quadruped.yaml").read_text())
    settings["sensors"]["noise"] |= {"base_force": 0.3, "base_moment": 0.1}
    settings |= {"output": str(folder / "run"), "estimator": {"ridge": 0.1}}
    settings["logs"] = {"train": ["sway_train.npz", "sway_test.npz"]}
    (folder / "logs.yaml").write_text(yaml.safe_dump(settings))
    compressed(folder / "logs.yaml", folder / "factors")
    settings["logs"] = {"train": ["factors/*.factor"]}
    (folder / "experiment.yaml").write_text(yaml.safe_dump(settings))
    return folder
