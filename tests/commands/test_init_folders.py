"""A folder of tables, one for each topic or signal, as one log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dialects import save_csv
from initiated import URDF, recorded

from torchid.commands.init import init
from torchid.config import load_config
from torchid.errors import LogError
from torchid.logs import Log, read_log


def test_each_foot_may_have_a_file_of_its_own(tmp_path: Path) -> None:
    log = recorded()
    folder = tmp_path / "walk"
    folder.mkdir()
    joints = {"q": log.joint_position, "qd": log.joint_velocity, "tau": log.joint_torque}
    of_joints = {
        f"{key}_{name}": x for key, of in joints.items() for name, x in zip(log.joint_names, of.T, strict=True)
    }
    save_csv(folder / "joints.csv", {"time": log.time, **of_joints, "q_x": log.time})
    for k, foot in enumerate(log.contact_names):
        forces = {f"force.{axis}": log.contact_wrench_local[:, k, j] for j, axis in enumerate("xyz")}
        save_csv(folder / f"{foot}_wrench.csv", {"time": log.time, **forces})
    save_csv(folder / "camera.csv", {"time": log.time, "width": np.full(len(log.time), 640.0)})
    said = init(URDF, folder, tmp_path / "robot.yaml")
    config = load_config(tmp_path / "robot.yaml")
    name = folder / " + ".join(["joints.csv", *sorted(f"{foot}_wrench.csv" for foot in log.contact_names)])
    read = read_log(name, columns=config.logs.columns)
    assert any("5 files of the folder" in text and "camera.csv" in text for text in said.assumed)
    assert set(read.joint_names) == set(log.joint_names)
    np.testing.assert_array_equal(in_order(read), log.contact_wrench_local[..., :3])


def in_order(read: Log) -> np.ndarray:
    order = [read.contact_names.index(name) for name in recorded().contact_names]
    return read.contact_wrench_local[:, order, :3]


def test_a_folder_without_stamps_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    save_csv(tmp_path / "empty" / "note.csv", {"width": np.ones(3)})
    with pytest.raises(LogError, match="empty: file: a folder with 1 log without stamps or known fields"):
        init(URDF, tmp_path / "empty", tmp_path / "robot.yaml")


def test_arrays_in_files_of_their_own_are_asked_for_as_one_file(tmp_path: Path) -> None:
    (tmp_path / "walk").mkdir()
    for name in ("t", "q"):
        np.save(tmp_path / "walk" / f"{name}.npy", np.arange(9.0))
    with pytest.raises(LogError, match=r"2 arrays in separate files: q.npy, t.npy; accepted: .*numpy.savez\('walk"):
        init(URDF, tmp_path / "walk", tmp_path / "robot.yaml")
    with pytest.raises(LogError, match=r"extension '.npy'; accepted: .*numpy.savez\('q.npz', x=x\)"):
        init(URDF, tmp_path / "walk" / "q.npy", tmp_path / "robot.yaml")
