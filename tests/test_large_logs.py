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
from torchid.errors import InputError, LogError, TorchidWarning
from torchid.estimators import LeastSquares
from torchid.logs import read_log, write_log
from torchid.logs.blocks import open_blocks, size_of
from torchid.logs.plan import plan
from torchid.logs.spill import Spill, SpillError
from torchid.problem import RowBuilder, Samples, compress, linear_problem
from torchid.problem.calibrate import calibrated
from torchid.run.experiment import set_up
from torchid.run.reading import LogReader

SAMPLES = 14_000  # three blocks and a bit
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
    return LogReader(scene).read(scene.config.logs.train, scene.sensors if required else None)[0]


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


@pytest.mark.parametrize("suffix", [".npz", ".csv", ".parquet", ".h5"])
def test_files_of_all_kinds_stream(tmp_path: Path, suffix: str) -> None:
    file = experiment(tmp_path, recorded(9_000), suffix)
    whole, large = (samples_of(file, *overrides({"cutoff_hz": 20}, "full"), *more, required=False)
                    for more in ((), (SMALL,)))  # fmt: skip
    assert is_on_disk(large)
    assert_same(large, whole, 1e-10)


@pytest.mark.parametrize("save", [np.savez_compressed, np.savez], ids=["compressed", "plain"])
def test_packed_and_transposed_arrays_are_unpacked_on_the_way(tmp_path: Path, save: Callable[..., None]) -> None:
    file, fields = experiment(tmp_path, recorded(6_000)), recorded(6_000)
    save(tmp_path / "log.npz", **fields | {"joint_torque": np.asfortranarray(fields["joint_torque"])})
    whole, large = samples_of(file, *overrides({})), samples_of(file, *overrides({}), SMALL)
    assert is_on_disk(large)
    assert_same(large, whole, 0.0)


def test_what_is_given_and_need_not_be_derived_is_carried_as_it_is(tmp_path: Path) -> None:
    """Also velocities in the base frame, and a bolted base."""
    file, fields = experiment(tmp_path, recorded(9_000)), recorded(9_000)
    whole = samples_of(file, *overrides({}))
    fields |= {"joint_velocity": fields["joint_position"], "joint_acceleration": fields["joint_position"]}
    del fields["base_position_world"], fields["base_quat_xyzw"], fields["contact_wrench_local"]
    np.savez(tmp_path / "log.npz", **fields)
    whole, large = (samples_of(file, "robot.fixed_base=true", *overrides({}), *x) for x in ((), (SMALL,)))
    assert len(whole) == 9_000
    assert_same(large, whole, 0.0)
    fields = recorded(9_000) | {"base_linear_acceleration_base": np.random.default_rng(0).normal(size=(9_000, 3))}
    np.savez(tmp_path / "log.npz", **fields)
    whole, large = (samples_of(file, *overrides({"cutoff_hz": 30}), *x) for x in ((), (SMALL,)))
    assert_same(large, whole, 1e-10)


def test_a_channel_with_gaps_anywhere_is_nan_everywhere_and_the_warning_is_that_of_the_whole_log(
    tmp_path: Path,
) -> None:
    fields = recorded()
    fields["joint_torque"][:, 0] = np.nan
    fields["joint_torque"][9_000:9_100, 1] = np.nan
    fields["joint_torque"][[17, 13_900], 2] = np.nan
    down = np.flatnonzero(fields["contact_active"][:, 3])
    fields["contact_wrench_local"][down[-5:], 3, 2] = np.nan
    fields["contact_wrench_local"][:, 1, 3:] = np.nan
    file = experiment(tmp_path, fields)
    found, said = [], []
    for more in ((), (SMALL,)):
        with pytest.warns(TorchidWarning, match="NaN throughout") as caught:
            found.append(samples_of(file, *overrides({"cutoff_hz": 20}), *more, required=False))
        said.append([str(warning.message) for warning in caught])
    assert said[0] == said[1]
    assert len(said[0]) == 2
    assert_same(found[1], found[0], 1e-10)
    torque = found[1].torque
    assert torque is not None
    assert torque[:, :3].isnan().all()
    assert not torque[:, 3:].isnan().any()


def spoil(name: str, index: Any, value: float) -> Callable[[Fields], None]:
    def change(fields: Fields) -> None:
        fields[name][index] = value

    return change


def shorten(name: str) -> Callable[[Fields], None]:
    def change(fields: Fields) -> None:
        fields[name] = fields[name][:-3]

    return change


BAD = {
    "a position that is no number": spoil("joint_position", (12_001, 4), np.nan),
    "an infinite torque": spoil("joint_torque", (5_000, 0), np.inf),
    "a torque that was not measured": spoil("joint_torque", (13_000, 7), np.nan),
    "a quaternion of another norm": spoil("base_quat_xyzw", 7_777, 0.4),
    "a step back in time": spoil("time", 10_000, 3.0),
    "a gap in time": spoil("time", slice(10_000, None), np.arange(4_000) / RATE + 99.0),  # type: ignore[arg-type]
    "a field that is too short": shorten("joint_torque"),
    "a field of no log": lambda fields: fields.update(joint_torqe=fields["joint_torque"]),
    "no positions": lambda fields: fields.pop("joint_position"),
    "a joint twice": spoil("joint_names", 1, "front_left_hip"),  # type: ignore[arg-type]
    "an unknown joint": spoil("joint_names", 1, "tail"),  # type: ignore[arg-type]
    "text for numbers": lambda fields: fields.update(joint_torque=np.full((SAMPLES, 12), "x")),
    "a contact of no robot": spoil("contact_names", 0, "nose"),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("change", BAD.values(), ids=BAD.keys())
def test_a_bad_large_log_is_refused_in_the_words_for_a_small_one(
    tmp_path: Path, change: Callable[[Fields], None]
) -> None:
    file, fields = experiment(tmp_path, recorded(100)), recorded()
    change(fields)
    np.savez(tmp_path / "log.npz", **fields)
    said = []
    for more in ((), (SMALL,)):
        with pytest.raises(InputError) as caught:
            samples_of(file, *overrides({}), *more)
        said.append(str(caught.value))
        assert sorted(os.listdir(tmp_path)) == ["log.npz", "run.yaml"]
    assert said[1].replace("near it", "in all") == said[0]


def test_the_size_of_a_log_is_known_before_it_is_read(tmp_path: Path) -> None:
    fields = recorded(2_000)
    numbers = sum(x[:1].size for x in fields.values() if len(x) == 2_000)
    experiment(tmp_path, fields, ".csv")
    write_log(read_log(tmp_path / "log.npz"), tmp_path / "log.parquet")
    assert size_of(tmp_path / "log.parquet", 0.0) == 8 * 2_000 * numbers
    assert size_of(tmp_path / "log.csv", 0.0) == pytest.approx(8 * 2_000 * numbers, rel=1e-3)
    most = size_of(tmp_path / "log.csv", 1e9)
    assert 8 * 2_000 * numbers <= most == 4 * (tmp_path / "log.csv").stat().st_size, "a small file is not counted"
    stored = size_of(tmp_path / "log.npz", 0.0)
    assert stored == pytest.approx(sum(x.nbytes for x in fields.values()), abs=4_000)
    with pytest.raises(LogError, match="no such file"):
        size_of(tmp_path / "other.npz", 0.0)


def test_signs_of_quaternions_go_on_across_blocks_that_overlap_touch_or_start_anew(tmp_path: Path) -> None:
    experiment(tmp_path, recorded(1_000))
    whole = read_log(tmp_path / "log.npz").base_quat_xyzw
    assert whole is not None
    with open_blocks(tmp_path / "log.npz", tmp_path) as blocks:
        for first, last in ((0, 2), (0, 400), (380, 700), (700, 701), (701, 1_000)):
            np.testing.assert_array_equal(blocks.read(slice(first, last)).base_quat_xyzw, whole[first:last])


# -------------------------------------------------------------------------------------------------------- whole runs


IDENTIFY = ("estimator.ridge=0.001", "sensors=joints")


def fitted(file: Path, *more: str) -> np.ndarray:
    scene = set_up(load_config(file, (*overrides({"cutoff_hz": 20}), *more)))
    builder = RowBuilder(scene.robot, scene.contacts, scene.sensors)
    logs = LogReader(scene).read(scene.config.logs.train, scene.sensors)
    problem = linear_problem(compress(logs, builder), builder, scene.robot)
    return LeastSquares(1e-3).solve(problem).phi


def test_the_parameters_are_the_same(tmp_path: Path) -> None:
    file = experiment(tmp_path, recorded(9_000), ".h5")
    whole, large = fitted(file), fitted(file, SMALL)
    np.testing.assert_allclose(large, whole, rtol=1e-9, atol=1e-10 * np.abs(whole).max())


def test_logs_that_fit_one_by_one_but_not_together_go_to_the_disk_when_the_limit_is_reached(tmp_path: Path) -> None:
    file = experiment(tmp_path, recorded(3_000), ".h5")
    scene, size = set_up(load_config(file, overrides({}))), size_of(tmp_path / "log.h5", 0.0)
    settings = replace(scene.config.preprocessing, memory_gb=2.5e-9 * size)
    reader = LogReader(replace(scene, config=replace(scene.config, preprocessing=settings)))
    files = [tmp_path / "log.h5"] * 3
    logs = [*reader.read(files[:1], scene.sensors), *reader.read(files[1:], None)]
    assert [is_on_disk(samples) for samples in logs] == [False, False, True]
    for samples in logs[1:]:
        assert_same(samples, logs[0], 1e-10)


def test_calibrated_readings_of_a_large_log_stay_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = experiment(tmp_path, recorded(3_000))
    scene = set_up(load_config(file, (*overrides({}), "sensors.offsets={joint_torque: log}")))
    builder = RowBuilder(scene.robot, scene.contacts, scene.sensors, scene.terms)
    samples = LogReader(scene).read(scene.config.logs.train, scene.sensors)[0]
    values = np.arange(1.0, 1.0 + len(builder.extras))
    small = calibrated(samples, builder.extras, values, builder.tree)
    monkeypatch.setattr("torchid.problem.calibrate._IN_MEMORY", 0)
    monkeypatch.setattr("torchid.problem.calibrate._ROWS", 700)
    large = calibrated(samples, builder.extras, values, builder.tree)
    assert samples.torque is not None
    assert small.torque is not None
    assert not torch.equal(small.torque, samples.torque)
    assert_same(large, small, 0.0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_a_run_gives_the_same_parameters_and_leaves_nothing_beside_its_folder(tmp_path: Path) -> None:
    file, found = experiment(tmp_path, recorded(), ".h5"), []
    for name, more in (("whole", ()), ("large", (SMALL,))):
        assert main(["identify", str(file), f"output={tmp_path / name}", *IDENTIFY, *more]) == 0
        bodies = json.loads((tmp_path / name / "parameters.json").read_text())["bodies"]
        found.append(np.array([list(body["identified"].values()) for body in bodies]))
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9, atol=1e-9 * np.abs(found[0]).max())
    assert sorted(os.listdir(tmp_path)) == ["large", "log.h5", "log.npz", "run.yaml", "whole"]


def test_samples_that_are_condemned_are_not_left_out_of_a_log_that_is_never_seen_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = experiment(tmp_path, recorded(2_000))
    line = refusal(["identify", str(file), SMALL, "preprocessing.exclude_condemned=true"], tmp_path, capsys)
    assert "preprocessing.exclude_condemned" in line
    assert "memory_gb" in line


@pytest.fixture
def small_disk() -> Any:
    """No file may grow beyond 200 kB."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_is_one_line_that_says_where_and_what_would_help(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], request: pytest.FixtureRequest
) -> None:
    file = experiment(tmp_path, recorded(9_000), ".h5")
    request.getfixturevalue("small_disk")
    line = refusal(["identify", str(file), SMALL, f"output={tmp_path / 'new' / 'run'}"], tmp_path, capsys)
    assert f"temporary file in {tmp_path}: cannot be written" in line
    assert "preprocessing.memory_gb" in line


def test_rows_that_do_not_fit_are_refused_and_their_file_is_closed(tmp_path: Path, small_disk: None) -> None:
    spill = Spill("x", tmp_path)
    spill.append(np.zeros((100, 100)))
    with pytest.raises(SpillError, match="cannot be written"):
        spill.append(np.zeros((200, 100)))
    assert os.listdir(tmp_path) == []
    with pytest.raises(SpillError, match="no-such-folder"):
        Spill("x", tmp_path / "no-such-folder")


def test_an_array_grows_by_rows_on_the_disk(tmp_path: Path) -> None:
    spill, rows = Spill("x", tmp_path), np.arange(24.0).reshape(6, 2, 2)
    for part in (rows[:1], rows[1:1], rows[1:]):
        spill.append(part)
    np.testing.assert_array_equal(spill.array(), rows)
    for nothing in (np.zeros((0, 3)), np.zeros((5, 0))):
        empty = Spill("x", tmp_path)
        empty.append(nothing)
        assert empty.array().shape == nothing.shape
    assert os.listdir(tmp_path) == []


def test_an_interrupt_leaves_nothing_behind(tmp_path: Path) -> None:
    file = experiment(tmp_path, recorded(40_000), ".h5")
    command = [sys.executable, "-m", "torchid", "identify", str(file), SMALL]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    descriptors = Path(f"/proc/{process.pid}/fd")
    deadline = clock.monotonic() + 60.0
    while not any(str(tmp_path) in target and "deleted" in target for target in links(descriptors)):
        assert clock.monotonic() < deadline
        assert process.poll() is None
        clock.sleep(0.005)
    assert sorted(os.listdir(tmp_path)) == ["log.h5", "log.npz", "run.yaml"], "what is written has no name"
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 1
    assert said.splitlines()[-1] == "torchid: interrupted; nothing was written"
    assert sorted(os.listdir(tmp_path)) == ["log.h5", "log.npz", "run.yaml"]


def links(folder: Path) -> list[str]:
    """Where the links of a folder that changes point to."""
    found = []
    for name in os.listdir(folder):
        try:
            found.append(os.readlink(folder / name))
        except OSError:
            continue
    return found


READ = """
import json, sys, threading, time, torch
from torchid.config import load_config
from torchid.problem.calibrate import calibrated
from torchid.run.experiment import set_up
from torchid.run.reading import LogReader
def used():
    lines = open("/proc/self/status").read().splitlines()
    return next(int(line.split()[1]) / 1024.0 for line in lines if line.startswith("RssAnon"))
def watch():
    while True:
        peak.append(used())
        time.sleep(0.01)
torch.set_num_threads(1)
scene = set_up(load_config(sys.argv[1], sys.argv[2:]))
before, peak = used(), []
threading.Thread(target=watch, daemon=True).start()
samples = LogReader(scene).read(scene.config.logs.train, scene.sensors)[0]
size = sum(x.nbytes for part in (samples, samples.base) for x in vars(part).values() if isinstance(x, torch.Tensor))
print(json.dumps({"peak": max(peak) - before, "bytes": size / 2**20}))
"""


def test_memory_is_bounded_by_the_limit_and_not_by_the_log(tmp_path: Path) -> None:
    file = experiment(tmp_path, recorded(60_000), ".h5")
    command = [sys.executable, "-c", READ, str(file), *overrides({"cutoff_hz": 20}), "preprocessing.memory_gb=0.02"]
    found = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
    assert found["bytes"] > 40.0
    assert found["peak"] < 0.75 * found["bytes"], "22 MiB of 41 measured, 25 of 136; read whole: 280 of 136"
