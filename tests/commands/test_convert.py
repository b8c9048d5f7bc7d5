"""`torchid convert`, and the same motion in files of every type through a whole identification."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from bags import entries_of, parsed, topics_of, write_bag, write_folder
from demo import shortened_demo
from refusals import refusal

from torchid.cli import main
from torchid.logs import Log, read_log, write_log

TYPES = (".npz", ".h5", ".csv", ".parquet")
BAGS = (".bag", ".mcap", ".db3")


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shortened_demo(tmp_path_factory.mktemp("demo") / "demo", 300)


def logs_as(demo: Path, suffix: str) -> dict[str, Any]:
    """The demo's logs as files of another type, as an experiment file names them."""
    for path in demo.glob(f"*{suffix}"):
        if path.stem in ("train", "test"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    logs = {key: read_log(demo / f"sway_{key}.npz") for key in ("train", "test")}
    for key, log in logs.items():
        if suffix in BAGS:
            write_bag(demo / f"{key}{suffix}", entries_of(log))
        elif suffix == "folder":
            write_folder(demo / f"{key}{suffix}", ".mcap", entries_of(log))
        else:
            write_log(log, demo / f"{key}{suffix}")
    named: dict[str, Any] = {key: [f"{key}{suffix}"] for key in logs}
    return named | ({} if suffix in TYPES else {"topics": topics_of(logs["train"])})


@pytest.mark.filterwarnings("ignore:.*no stamps:torchid.errors.TorchidWarning")  # of std_msgs/Bool
@pytest.mark.parametrize("suffix", [*TYPES[1:], *BAGS, "folder"])
def test_the_same_motion_gives_the_same_log_whatever_the_file(demo: Path, suffix: str) -> None:
    logs = logs_as(demo, suffix)
    topics = parsed(logs["topics"]) if "topics" in logs else None
    again = read_log(demo / logs["train"][0], topics)
    for field, values in read_log(demo / "sway_train.npz").arrays().items():
        np.testing.assert_allclose(again.arrays()[field], values, rtol=0, atol=1e-12)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    rng = np.random.default_rng(2)
    write_log(Log("x", np.arange(5.0), ("a", "b"), rng.standard_normal((5, 2))), tmp_path / "in.npz")
    return tmp_path / "in.npz"


def test_a_log_goes_through_every_type_and_back_unchanged(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = log
    for suffix in (*TYPES[1:], ".hdf5", ".npz"):
        target = log.parent / f"out{suffix}"
        assert main(["convert", str(path), str(target)]) == 0
        assert f"written to    {target}: 5 samples, time, joint_position" in capsys.readouterr().out
        path = target
    np.testing.assert_array_equal(read_log(path).joint_position, read_log(log).joint_position)


@pytest.mark.filterwarnings("ignore:.*no stamps:torchid.errors.TorchidWarning")
def test_a_bag_is_converted_by_the_topics_of_an_experiment_file(demo: Path, tmp_path: Path) -> None:
    short = read_log(demo / "sway_test.npz").select(slice(0, 20))
    bag = write_bag(tmp_path / "x.bag", entries_of(short))
    experiment = tmp_path / "robot.yaml"
    for logs in ({"topics": topics_of(short)}, {"train": ["absent.npz"], "topics": topics_of(short)}):
        experiment.write_text(yaml.safe_dump({"logs": logs, "robot": {"urdf": "absent.urdf"}}))
        target = str(tmp_path / "x.csv")
        assert main(["convert", str(bag), target, "--topics", str(experiment), "--overwrite"]) == 0
        np.testing.assert_array_equal(read_log(target).joint_torque, short.joint_torque)


def test_what_is_there_is_not_overwritten_unless_asked_for(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = log.parent / "out.csv"
    target.write_text("precious")
    message = refusal(["convert", str(log), str(target)], log.parent, capsys)
    assert f"{target}: OUT: exists; accepted: a new file, or --overwrite" in message
    assert main(["convert", str(log), str(target), "--overwrite"]) == 0
    assert len(read_log(target)) == 5
    capsys.readouterr()
    folder = log.parent / "folder.npz"
    folder.mkdir()
    (log.parent / "link.npz").symlink_to("nowhere.npz")
    (log.parent / "self.npz").symlink_to(log)
    for path in (folder, log.parent / "link.npz", log.parent / "self.npz", log):
        refusal(["convert", str(log), str(path), "--overwrite"], log.parent, capsys)


BAD: list[tuple[str, str, list[str], str]] = [
    ("absent.npz", "out.h5", [], "absent.npz: file: no such file"),
    ("in.npz", "out.mat", [], "extension '.mat'; accepted: .npz, .h5, .hdf5, .csv, .parquet"),
    ("in.npz", "out.mcap", [], "extension '.mcap'; accepted: .npz"),
    ("in.npz", "nowhere/out.h5", [], "OUT: the folder "),
    ("in.npz", "out", [], "extension ''"),
    ("x.bag", "out.h5", [], "logs.topics: missing; the bag has /joint_states (sensor_msgs/msg/JointState)"),
    ("x.bag", "out.h5", ["--topics", "absent.yaml"], "absent.yaml: file: cannot be read"),
    ("x.bag", "out.h5", ["--topics", "empty.yaml"], "empty.yaml: logs.topics: missing"),
    ("x.bag", "out.h5", ["--topics", "typo.yaml"], "logs.topics: unknown name 'joint_state'; accepted: joint_states"),
    ("x.bag", "out.h5", ["--topics", "sign.yaml"], "ft_wrenches.a.sign: found 2; accepted: 1 or -1"),
    ("x.bag", "out.h5", ["--topics", "wrong.yaml"], "logs.topics.imu: unknown name '/imu'; accepted: /joint_states"),
    ("x.bag", "out.h5", ["--topics", "list.yaml"], "logs.topics"),
]


@pytest.mark.parametrize(("source", "target", "options", "found"), BAD)
def test_bad_input_exits_2_with_one_line_and_writes_nothing(
    log: Path, capsys: pytest.CaptureFixture[str], source: str, target: str, options: list[str], found: str
) -> None:
    folder = log.parent
    write_bag(folder / "x.bag", entries_of(read_log(log)))
    for name, topics in {
        "typo": {"joint_state": "/joint_states"},
        "sign": {"joint_states": "/joint_states", "ft_wrenches": {"a": {"topic": "/w", "sign": 2}}},
        "wrong": {"joint_states": "/joint_states", "imu": "/imu"},
        "list": ["/joint_states"],
    }.items():
        (folder / f"{name}.yaml").write_text(yaml.safe_dump({"logs": {"topics": topics}}))
    (folder / "empty.yaml").write_text("robot: {urdf: a.urdf}\n")
    paths = [str(folder / x) if x.endswith(".yaml") else x for x in options]
    assert found in refusal(["convert", str(folder / source), str(folder / target), *paths], folder, capsys)
