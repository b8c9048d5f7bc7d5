"""`torchid init` of episodes that lie side by side in a file of arrays: stacked along an axis, or a group for each."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from synthetic import ROBOTS, UR5

from torchid.commands.init import init
from torchid.config import load_config
from torchid.errors import InputError
from torchid.logs import Log, read, read_log
from torchid.logs.read import files_of_recordings_kept

GO2 = ROBOTS / "go2_description/urdf/go2.urdf"
EPISODES, SAMPLES, STEP = 5, 600, 0.01
TIME = STEP * np.arange(SAMPLES)
PHASE = np.random.default_rng(0).uniform(0.0, 6.0, (EPISODES, 1, 6))
TURN = np.arange(2.0, 8.0) * TIME[:, None] + PHASE  # (episodes, samples, joints)
Q, DQ = 0.4 * np.sin(TURN), 0.4 * np.arange(2.0, 8.0) * np.cos(TURN)
TAU = np.random.default_rng(1).normal(size=Q.shape)
LENGTHS = np.array([SAMPLES, 550, 500, SAMPLES, 400])
pytestmark = pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")  # of URDFs


def logs_of(file: Path) -> list[Log]:
    """The recordings that init names, in their order."""
    target = file.with_suffix(".yaml")
    init(UR5, file, target)
    files = load_config(target).logs
    assert files is not None
    with files_of_recordings_kept():
        return [read_log(path, columns=files.columns) for path in (*files.train, *files.test)]


def assert_recorded(logs: list[Log], lengths: np.ndarray) -> None:
    assert [len(log) for log in logs] == lengths.tolist()
    for number, (log, length) in enumerate(zip(logs, lengths, strict=True)):
        np.testing.assert_allclose(log.time, TIME[:length], atol=1e-12)
        assert log.joint_velocity is not None
        assert log.joint_torque is not None
        for found, recorded in ((log.joint_position, Q), (log.joint_velocity, DQ), (log.joint_torque, TAU)):
            np.testing.assert_array_equal(found, recorded[number, :length])


@pytest.mark.parametrize("stamps", ["each", "one clock", "step"])
@pytest.mark.parametrize("axis", [0, 1])
def test_an_axis_of_episodes_is_told_from_that_of_samples(tmp_path: Path, axis: int, stamps: str) -> None:
    stacked = {"dof_pos": Q, "dof_vel": DQ, "torques": TAU}
    arrays = {name: np.moveaxis(x, 0, axis) for name, x in stacked.items()} | {"success": np.ones(EPISODES)}
    each = np.moveaxis(np.tile(TIME, (EPISODES, 1)), 0, axis)
    arrays |= {"each": {"t": each}, "one clock": {"t": TIME}, "step": {"dt": np.array(STEP)}}[stamps]
    np.savez(tmp_path / "x.npz", **arrays)
    assert_recorded(logs_of(tmp_path / "x.npz"), np.full(EPISODES, SAMPLES))


def test_what_fills_up_stacked_episodes_is_cut_off(tmp_path: Path) -> None:
    filled = np.arange(SAMPLES) < LENGTHS[:, None]
    arrays = {"q": Q * filled[..., None], "qd": DQ * filled[..., None], "tau": TAU * filled[..., None]}
    np.savez(tmp_path / "x.npz", t=TIME * filled, episode_lengths=LENGTHS, **arrays)
    assert_recorded(logs_of(tmp_path / "x.npz"), LENGTHS)


def test_a_group_with_another_number_of_joints_is_named(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as file:
        for number in range(EPISODES):
            file[f"demo_{number}/q"] = Q[number]
            file[f"demo_{number}/t"], file[f"demo_{number}/tau"] = TIME, TAU[number]
    init(UR5, tmp_path / "x.h5", tmp_path / "x.yaml")
    with h5py.File(tmp_path / "x.h5", "a") as file:
        del file["demo_3/tau"]
        file["demo_3/tau"] = TAU[3, :, :5]
    columns = load_config(tmp_path / "x.yaml").logs.columns  # type: ignore[union-attr]
    with pytest.raises(InputError, match=r"'demo_3/tau': shape \(600, 5\), but 'demo_0/tau' has \(600, 6\)"):
        read_log(tmp_path / "x.h5[#0]", columns=columns)


@pytest.mark.parametrize("stamped", [True, False])
def test_groups_of_episodes_are_recordings_in_the_order_of_their_numbers(tmp_path: Path, stamped: bool) -> None:
    """More datasets than a log has, of fewer kinds; the tenth comes behind the ninth."""
    path, count = tmp_path / "x.hdf5", 45 if stamped else 15
    with h5py.File(path, "w") as file:
        for number in range(count):
            rows = slice(LENGTHS[number % EPISODES])
            arrays = {"qpos": Q, "qvel": DQ, "effort": TAU}
            group = {f"obs/{name}": x[number % EPISODES, rows] for name, x in arrays.items()}
            group |= {"obs/stamp": TIME[rows]} if stamped else {}
            for name, x in (group | {"action": np.zeros(1), "reward": np.zeros(1)}).items():
                file[f"data/demo_{number}/{name}"] = x
        if not stamped:
            file["dt"] = STEP
    logs = logs_of(path)
    for first in range(0, count, EPISODES):
        assert_recorded(logs[first : first + EPISODES], LENGTHS)


def test_groups_of_limbs_are_no_episodes(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as file:
        for number in range(2):
            file[f"arm_{number}/q"], file[f"arm_{number}/t"] = Q[number], TIME
    said = init(UR5, tmp_path / "x.h5", tmp_path / "x.yaml")
    assert "episodes" not in (tmp_path / "x.yaml").read_text(), said


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ("{axis: 0, lengths: n}", "lengths"),
        ("{groups: demo}", "one \\* for the number"),
        ("{groups: 'demo_*'}", r"no groups 'demo_\*'"),
    ],
)
def test_episodes_that_a_file_does_not_have_are_refused(tmp_path: Path, entry: str, said: str) -> None:
    np.savez(tmp_path / "x.npz", q=Q, qd=DQ, tau=TAU, t=TIME)
    init(UR5, tmp_path / "x.npz", tmp_path / "x.yaml")
    text = (tmp_path / "x.yaml").read_text().replace("episodes: {axis: 0}", f"episodes: {entry}")
    assert entry in text
    (tmp_path / "y.yaml").write_text(text)
    with pytest.raises(InputError, match=said):
        read_log(tmp_path / "x.npz", columns=load_config(tmp_path / "y.yaml").logs.columns)  # type: ignore[union-attr]


def test_a_file_of_recordings_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.savez(tmp_path / "x.npz", q=Q, qd=DQ, tau=TAU, t=TIME)
    reads, original = list[object](), read._read_raw
    monkeypatch.setattr(read, "_read_raw", lambda *how: reads.append(how) or original(*how))
    assert_recorded(logs_of(tmp_path / "x.npz"), np.full(EPISODES, SAMPLES))
    assert len(reads) == 2, "by init, and for all five"
    columns = load_config(tmp_path / "x.yaml").logs.columns  # type: ignore[union-attr]
    with files_of_recordings_kept():
        first = read_log(tmp_path / "x.npz[#0]", columns=columns)
        np.savez(tmp_path / "x.npz", q=2.0 * Q, qd=DQ, tau=TAU, t=TIME)
        again = read_log(tmp_path / "x.npz[#0]", columns=columns)
    np.testing.assert_array_equal(again.joint_position, 2.0 * first.joint_position, "of a file that has changed")
