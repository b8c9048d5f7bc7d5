"""Folders of simulated robots: `robot.urdf`, `log.csv`, `other.csv` as a user has them, and the truth."""

from __future__ import annotations

import json
import time
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from defaults.held import Excitation
from defaults.held import prescribed as prescribed_held
from defaults.held import simulated as simulated_held
from defaults.models import Model
from defaults.robots import CASES, Case, Held
from defaults.sensors import Drawn, record, write_table
from defaults.truth import state_friction, write_given, write_true
from defaults.walking import true_robot, walked
from torchid.errors import InputError
from torchid.logs import Log
from torchid.parameters import Array
from torchid.robot import load_robot

_SHARE = 0.2  # by which bodies are off
_TRUTH_HZ = 500.0
_TRIALS = 6
_FIELDS = (
    "time",
    "joint_position",
    "joint_velocity",
    "joint_acceleration",
    "base_position_world",
    "base_quat_xyzw",
    "base_linear_velocity_world",
    "base_angular_velocity_base",
    "base_linear_acceleration_world",
    "base_angular_acceleration_base",
    "contact_wrench_world",
)


def make(name: str, seed: int, output: Path, cases: Mapping[str, Case] = CASES) -> dict[str, object]:
    """Write the folder of a robot; the same seed writes the same. Returns the truth.

    Raises:
        InputError: its URDF is not installed.
    """
    began, case, folder = time.perf_counter(), cases[name], output / name
    if isinstance(case.urdf, Path) and not case.urdf.is_file():
        raise InputError("arguments", "--robots", f"{name}, no {case.urdf}", "the package example-robot-data installed")
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    given = write_given(case.urdf, folder)
    masses = write_true(given, rng, _SHARE, case.payload)
    draw = int(rng.integers(2**31))
    logs, friction, armature = (_held if isinstance(case.moves, Held) else _on_feet)(case, folder, draw)
    state_friction(folder / "true.urdf", logs[0].joint_names, friction)
    joints, floating = logs[0].joint_names, not isinstance(case.moves, Held)
    model = Model.of(folder / "true.urdf", joints, floating)
    states = model.configuration(np.asarray(logs[0].joint_position)[:: len(logs[0]) // 20])
    drawn = Drawn.of(case.flaws, logs[0], model.inertias(states) + armature, rng)
    imu = (case.imu, load_robot(given).links[case.imu][1]) if floating else None
    for log, file in zip(logs, ("log", "other"), strict=True):
        write_table(folder / f"{file}.csv", record(log, case.flaws, drawn, case.rate, imu, rng))
    _write_unseen(folder, logs[1], drawn)
    truth: dict[str, object] = {
        "robot": name,
        "seed": seed,
        "held": not floating,
        "edit": list(case.edit),
        "feet": list(logs[0].contact_names),
        "ball": _ball(case),
        "simulator": "inverse dynamics" if case.integrator is None else f"MuJoCo, {case.integrator}",
        "total_mass": sum(masses.values()),
        "link_masses": masses,
        "joints": list(joints),
        "coulomb": friction[:, 0].tolist(),
        "viscous": friction[:, 1].tolist(),
        "armature": armature.tolist(),
        "gain": drawn.gain.tolist(),
        "offset": drawn.offset.tolist(),
        "delay": drawn.delay,
        "ringing": case.flaws.ringing,
        "ringing_hz": drawn.mode[0].tolist(),
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1))
    return truth | {"seconds": time.perf_counter() - began}


def _ball(case: Case) -> dict[str, object] | None:
    """Radius and centre of the balls that point feet are, in their frames."""
    moves = case.moves
    if isinstance(moves, Held) or moves.kind != "point":
        return None
    return {"radius": moves.radius, "centre": list(moves.points[0])}


def _held(case: Case, folder: Path, seed: int) -> tuple[list[Log], Array, Array]:
    """Both logs, friction (n, 2) and armature (n,)."""
    moves, rng = case.moves, np.random.default_rng(seed)
    assert isinstance(moves, Held)
    robot = load_robot(folder / "robot.urdf", fixed_base=True)
    joints = [name for name in robot.joint_names if "finger" not in name.lower()]
    model = Model.of(folder / "true.urdf", joints, False)
    lower, upper = model.limits()
    efforts = model.model.effortLimit[model.index]
    strength = np.minimum(1.0, efforts / np.median(efforts))
    friction = strength[:, None] * np.stack([rng.uniform(*limits, len(joints)) for limits in moves.friction], axis=1)
    armature = strength * rng.uniform(*moves.armature, len(joints))
    centre = 0.5 * (lower + upper)
    for k, name in enumerate(joints):
        stated = [angle for end, angle in moves.posture.items() if name.endswith(end)]
        centre[k] = stated[0] if stated else centre[k]
    room = np.minimum(upper - centre, centre - lower)
    logs = []
    for seconds, faster in zip(case.seconds, (1.0, moves.faster), strict=True):
        hz = moves.hz[0], moves.hz[1] * faster
        motion = Excitation(rng, centre, np.minimum(moves.reach * room, moves.widest), hz)
        if case.integrator is None:
            logs.append(prescribed_held(model, motion, seconds, friction, armature))
        else:
            true = folder / "true.urdf"
            logs.append(simulated_held(model, true, motion, seconds, friction, armature, case.integrator))
    return logs, friction, armature


def _on_feet(case: Case, folder: Path, seed: int) -> tuple[list[Log], Array, Array]:
    """Both logs, friction (n, 2) and armature (n,), of the first of some motions in which the robot does not fall.

    Raises:
        ValueError: it falls in all of them.
    """
    assert not isinstance(case.moves, Held)
    true = true_robot(case.moves, folder / "true.urdf", seed, case.integrator, case.floor)
    logs = []
    for k, seconds in enumerate(case.seconds):
        for trial in range(_TRIALS):
            try:
                logs.append(walked(true, seconds, seed + 2 * trial + k, unseen=bool(k)))
                break
            except ValueError:
                if trial == _TRIALS - 1:
                    raise
    return logs, true.friction, true.armature


def _write_unseen(folder: Path, log: Log, drawn: Drawn) -> None:
    """The unseen log as it truly is, torques as sensors without noise read them."""
    step = float(log.time[1] - log.time[0])
    keep = slice(None, None, round(1.0 / (_TRUTH_HZ * step)))
    arrays = {name: getattr(log, name)[keep] for name in _FIELDS if getattr(log, name) is not None}
    arrays["joint_torque"] = drawn.readings(np.asarray(log.joint_torque))[keep]
    small = {name: value if name == "time" else value.astype(np.float32) for name, value in arrays.items()}
    np.savez_compressed(folder / "other_truth.npz", **small)
