"""The demo's quadruped with torques from motor currents: every type of motor has a constant of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from demo import NO_TERMS
from motions import value
from payloads import load_on
from repository import DEMO
from synthetic import Oracle, load, make_log
from true_robots import true_parameters

from torchid.logs import write_log
from torchid.logs.columns import fits
from torchid.robot import Payload

FEET = [f"{end}_{side}_foot" for end in ("front", "rear") for side in ("left", "right")]
HIPS, KNEES = ["*_hip", "*_thigh"], ["*_knee"]
HIP_SCALE, KNEE_SCALE = 0.9, 1.15
"""Force per reading."""
NOISE = {"joint_torque": 0.1, "base_force": 1.0, "base_moment": 0.1}
"""Stated, as residuals of exact logs say nothing of it."""
STATES = [[True] * 4, [True, False, False, True], [False, True, True, True], [True, True, True, False]]
"""Each foot swings in some: what is at a foot that always stands moves nothing that torques alone could tell."""


def quadruped_files(
    folder: Path,
    scales: Mapping[str, float],
    samples: int = 160,
    states: Sequence[Sequence[bool]] = STATES,
    noise: float = 0.0,
    loads: Mapping[str, Payload] | None = None,
    **settings: Any,
) -> tuple[Path, float]:
    """An experiment file beside exact logs of a robot that is off its URDF, read with scales by pattern; its mass.

    `loads`: what it carries in a log, and in those after it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    robot, rng = load(DEMO / "quadruped.urdf", None, False), np.random.default_rng(8)
    oracle = Oracle.of(robot)
    oracle.perturb(rng, 0.2)
    scale = np.ones(robot.n)
    for pattern, x in scales.items():
        scale[[fits(name, pattern) for name in robot.joint_names]] = x
    mass = float(true_parameters(oracle, robot)[:, 0].sum())
    for name in ("a", "b", "new"):
        if loads and name in loads:
            load_on(oracle, loads[name])
        log = make_log(oracle, [(foot, 3) for foot in FEET], states, samples, rng, f"{name}.npz")
        write_log(
            replace(log, joint_torque=value(log.joint_torque) / scale, contact_wrench_local=None),
            folder / f"{name}.npz",
        )
    experiment = {
        "robot": {"urdf": str(DEMO / "quadruped.urdf")},
        "contacts": [{"frame": foot, "type": "point", "radius": 0.0} for foot in FEET],
        "logs": {"train": ["a.npz", "b.npz"], "test": ["new.npz"]},
        "sensors": {"set": "joints", "noise": NOISE},
        "actuators": NO_TERMS,
        "output": str(folder / "run"),
    } | settings  # fmt: skip
    (folder / "quadruped.yaml").write_text(yaml.safe_dump(experiment))
    return folder / "quadruped.yaml", mass
