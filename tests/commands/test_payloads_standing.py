"""Payloads of logs whose base moves by the feet that stand, read by one process and by two that share the work."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from demo import DEMO, WITHOUT_TERMS
from large import SMALL
from motions import value
from payloads import load_on
from run_folders import identified
from shared_work import run_all
from synthetic import Oracle
from walking import MACHINES, recorded, robot_of, truth

from torchid.logs import Log, write_log
from torchid.robot import Payload

MACHINE = MACHINES["quadruped"]
BAG = Payload("trunk", 5.0, (0.05, 0.02, 0.1), (0.02, 0.003, -0.002, 0.03, 0.001, 0.025))
ONE = (
    WITHOUT_TERMS,
    "logs.test=[]",
)
RUNS = {
    "without a load": ("walk.yaml", ONE),
    "with a load": ("loaded.yaml", ONE),
    "with one that is not stated": ("not_stated.yaml", ONE),
    "in blocks": ("loaded.yaml", (*ONE, SMALL)),
}


def carrying(log: Log, seconds: float) -> Log:
    """The same walk with a load, which feet that stand and joints carry."""
    happened, oracle = truth(MACHINE, 0, seconds=seconds), Oracle.of(robot_of(MACHINE))
    before = oracle.frictionless_forces(happened.q, happened.v, happened.a)
    load_on(oracle, BAG)
    added = oracle.frictionless_forces(happened.q, happened.v, happened.a) - before
    stands = happened.share > 0.0
    J = np.stack([oracle.jacobian(happened.q, foot)[:, :3] for foot in MACHINE.feet], axis=1) * stands[..., None, None]
    J = J.reshape(len(J), -1, J.shape[-1])
    forces = np.linalg.pinv(J[:, :, :6].transpose(0, 2, 1)) @ added[:, :6, None]
    more = added[:, 6:] - (J[:, :, 6:].transpose(0, 2, 1) @ forces)[..., 0]
    return replace(log, joint_torque=value(log.joint_torque) + more)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """Folders of the runs by the number of processes."""
    folder, seconds = tmp_path_factory.mktemp("payloads"), 2.0
    log = recorded(MACHINE, truth(MACHINE, 0, seconds=seconds), seed=0, noise=0.0)
    log = replace(log, contact_wrench_local=None, base_quat_xyzw=None, base_position_world=None)
    write_log(log, folder / "walk.npz")
    write_log(carrying(log, seconds), folder / "bag.npz")
    stated = {"file": "bag.npz", "payload": json.loads(json.dumps(asdict(BAG)))}  # type: ignore[call-overload]
    for name, entry in (("walk", "walk.npz"), ("loaded", stated), ("not_stated", "bag.npz")):
        settings: dict[str, Any] = {
            "robot": {"urdf": str(DEMO / "quadruped.urdf")},
            "contacts": [{"frame": foot, "type": "point"} for foot in MACHINE.feet],
            "logs": {"train": [entry]},
            "preprocessing": {"cutoff_hz": 15, "base_motion": "contacts"},
            "sensors": {"set": "joints", "noise": {"joint_torque": 0.1}},
            "estimator": {"name": "least_squares", "ridge": 1e-3},
        }
        (folder / f"{name}.yaml").write_text(json.dumps(settings))
    runs = [(name, folder / file, more) for name, (file, more) in RUNS.items()]
    run_all(1, folder / "1", runs)
    run_all(2, folder / "2", runs[-1:])
    return {processes: folder / str(processes) for processes in (1, 2)}


def test_what_is_identified_is_the_robot_without_its_load(folders: dict[int, Path]) -> None:
    """To a filter's error of the load's forces, which are filtered by themselves."""
    truthful, stated, not_stated = (identified(folders[1] / name) for name in list(RUNS)[:3])
    assert np.abs(stated - truthful).max() < 0.02 * np.abs(not_stated - truthful).max()


def test_blocks_find_what_the_whole_log_gives(folders: dict[int, Path]) -> None:
    for folder in folders.values():
        np.testing.assert_allclose(
            identified(folder / "in blocks"), identified(folders[1] / "with a load"), rtol=0.0, atol=1e-8
        )
