"""The cache of samples and factors: results are those without it, and change with whatever they come from."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from demo import shortened_demo
from run_folders import keys_in
from thinned import slow_but
from trainings import trust_new_files

from torchid.cli import main
from torchid.config import load_config
from torchid.config.experiment import ActuatorsConfig
from torchid.config.log_reading import PreprocessingConfig
from torchid.config.robot import ContactConfig, NoiseConfig, RobotConfig
from torchid.errors import TorchidWarning
from torchid.fitting.experiment import set_up, with_noise
from torchid.fitting.noise import NoiseSummary
from torchid.logs.signal_noise import STATED_FIELDS
from torchid.problem.compression import split_into_folds
from torchid.reading.cache import FOLDER, content_key
from torchid.reading.cache_entries import NOT_IN_SAMPLES, content_of_setup, factors_key
from torchid.reading.log_reader import LogReader

NONE = "preprocessing.cache_gb=0"
OFFSETS = ("sensors.set=full", "sensors.offsets={contact_force: log}")
SGD = "estimator={name: sgd, ridge: 0.1, training: {epochs: 2, batch_size: 64}}"
ESTIMATORS = {
    "least squares": ("estimator.ridge=0.01", "preprocessing.cutoff_hz=8"),
    "auto, in blocks": ("estimator.ridge=auto", "preprocessing.cutoff_hz=20", "preprocessing.memory_gb=0.0001"),
    "consistent": ("estimator.name=consistent",),
    "offsets": ("sensors={set: full, offsets: {contact_force: log}}", "preprocessing.contact_margin_s=0.01"),
    "robust": ("estimator.robust=huber", "actuators.armature=true"),
    "descent": (SGD,),
}


@pytest.fixture(autouse=True)
def _new_files(monkeypatch: pytest.MonkeyPatch) -> None:
    trust_new_files(monkeypatch)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Experiment file of the demo, shortened, with all terms stated: logs are read anew to choose them."""
    file = shortened_demo(tmp_path_factory.mktemp("cache") / "demo", 150) / "quadruped.yaml"
    file.write_text(file.read_text() + f"actuators: {ActuatorsConfig.without_terms()}".replace("None", "null"))
    return file


@pytest.fixture(scope="module")
def plain(demo: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Results of a run without a cache."""
    run = tmp_path_factory.mktemp("plain") / "run"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        assert main(["identify", str(demo), f"output={run}", NONE]) == 0
    return results(run)


def results(run: Path) -> dict[str, Any]:
    """All that a run folder says, but for how long it took and the size of the cache."""
    out: dict[str, Any] = {name: (run / name).read_bytes() for name in ("parameters.json", "identified.urdf")}
    config = yaml.safe_load((run / "config.yaml").read_text())
    del config["preprocessing"]["cache_gb"], config["output"], config["overwrite"]
    return out | {"config": config, "metrics": json.loads((run / "metrics.json").read_text()) | {"seconds": None}}


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
@pytest.mark.parametrize("name", slow_but(ESTIMATORS.keys() - {"least squares", "consistent", "robust"}, ESTIMATORS))
def test_a_run_from_the_cache_has_the_results_of_one_without_to_the_last_bit(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    line = ["identify", "--verbose", str(demo), *ESTIMATORS[name]]
    assert main([*line, f"output={tmp_path / 'without'}", NONE]) == 0
    assert not (tmp_path / FOLDER).exists()
    expected = results(tmp_path / "without")
    assert main([*line, f"output={tmp_path / 'first'}"]) == 0
    assert results(tmp_path / "first") == expected
    assert "from cache" not in capsys.readouterr().out
    for opened in (
        "log_reader.read_log",
        "large_log.open_log_blocks",
        "cached_reader.log_bytes",
        "cache.part_checksum",
    ):
        monkeypatch.setattr(f"torchid.reading.{opened}", None)
    monkeypatch.setattr("torchid.commands.prepared_data.compress_in_blocks", None)
    assert main([*line, f"output={tmp_path / 'second'}"]) == 0
    assert results(tmp_path / "second") == expected
    assert "from cache    samples of 2 logs, factors" in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_another_ridge_estimator_and_prior_read_and_compress_nothing(
    demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["identify", str(demo), f"output={tmp_path / 'first'}", "estimator.ridge=1.0"]) == 0
    others = (("estimator.ridge=0.01",), ("estimator.name=consistent", "estimator.prior=entropic"))
    for number, more in enumerate(others):
        assert main(["identify", str(demo), *more, f"output={tmp_path / f'without{number}'}", NONE]) == 0
    monkeypatch.setattr("torchid.reading.log_reader.read_log", None)
    monkeypatch.setattr("torchid.commands.prepared_data.compress_in_blocks", None)
    for number, more in enumerate(others):
        assert main(["identify", str(demo), *more, f"output={tmp_path / f'with{number}'}"]) == 0
        assert results(tmp_path / f"with{number}") == results(tmp_path / f"without{number}")


# ------------------------------------------------------------------------------------------- what an entry depends on

#: A value of every key of preprocessing that is neither its default nor that of the demo.
CHANGED = {
    "cutoff_hz": 7.0,
    "sample_rate_hz": 111.0,
    "bridge_gaps_s": 0.05,
    "contact_margin_s": 0.02,
    "max_slip": 0.5,
    "detect_contacts": True,
    "contact_threshold": 30.0,
    "zero_in_air": True,
    "base_motion": "contacts",
    "exclude_rejected": True,
    "memory_gb": 3.0,
    "cache_gb": 5.0,
}


def content(file: Path, *more: str) -> str:
    return content_key(content_of_setup(set_up(load_config(file, more))))


@pytest.mark.parametrize("name", [one.name for one in fields(PreprocessingConfig)])
def test_every_key_of_preprocessing_that_changes_samples_changes_their_name(demo: Path, name: str) -> None:
    """A new key is of those that do, and has a value here, unless it is named in two places."""
    other = f"preprocessing.{name}={json.dumps(CHANGED[name])}"
    assert NOT_IN_SAMPLES == ("memory_gb", "cache_gb")
    assert (content(demo) != content(demo, other)) == (name not in NOT_IN_SAMPLES)


@pytest.mark.parametrize(
    "other",
    [
        "robot.fixed_base=true",
        "robot.base_link=front_left_hip_link",
        "robot.weld=[front_left_hip]",
        "robot.base_tilt=[0.01, 0.0]",
        "robot.loops=[{frames: [trunk, front_left_foot]}]",
        "robot.passive=[front_left_hip]",
        "contacts.0.type=flat",
        "contacts.0={type: line, line_axis: x}",
        "contacts.0={type: point, radius: 0.02}",
        "contacts.0={type: point, centre: [0, 0, 0.02]}",
        "contacts.0={type: point, normal: [0, 0.1, 1]}",
        "logs.topics.joint_states=/joints",
        "logs.topics.low_state={topic: /lowstate, joints: [front_left_hip]}",
    ],
)
def test_robot_contacts_and_topics_change_the_name_of_samples(demo: Path, tmp_path: Path, other: str) -> None:
    assert len(fields(RobotConfig)) == 8, "urdf and mjcf, base_link, fixed_base, weld, base_tilt, loops, passive"
    assert {x.name for x in fields(ContactConfig)} == {"frame", "type", "line_axis", "radius", "centre", "normal"}
    document = yaml.safe_load(demo.read_text())
    key, _, value = other.partition("=")
    if key.startswith("contacts"):
        new = yaml.safe_load(value)
        document["contacts"][0] |= new if isinstance(new, dict) else {"type": new}
        key = ""
    elif key == "robot.base_link":
        document["contacts"] = document["contacts"][:1]
    shutil.copytree(demo.parent, tmp_path / "demo")
    file = tmp_path / "demo" / "other.yaml"
    file.write_text(yaml.safe_dump(document))
    assert content(file, *([other] if key else [])) != content(demo)


def test_the_urdf_and_the_code_change_the_name_of_samples(
    demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = content(demo)
    shutil.copytree(demo.parent, tmp_path / "demo")
    assert content(tmp_path / "demo" / demo.name) == before, "a copy is the same"
    urdf = tmp_path / "demo" / "quadruped.urdf"
    urdf.write_text(urdf.read_text().replace("</robot>", "<!-- heavier --></robot>"))
    assert content(tmp_path / "demo" / demo.name) != before
    monkeypatch.setattr("torchid.reading.cache._code", lambda: "another")
    assert content(demo) != before


def test_sensors_estimators_and_extra_parameters_leave_the_name_of_samples(demo: Path) -> None:
    more = ("sensors=full", "estimator.ridge=3.0", "actuators.armature=true", "device=cpu", "output=elsewhere")
    assert content(demo) == content(demo, *more)


def test_offsets_of_contacts_need_samples_of_another_name(demo: Path) -> None:
    assert content(demo, *OFFSETS) != content(demo)
    assert content(demo, "sensors.offsets={joint_torque: log}") == content(demo)


def test_noise_sensors_extras_and_folds_change_the_name_of_factors(demo: Path, tmp_path: Path) -> None:
    def key(*more: str) -> str:
        setup = set_up(load_config(demo, (f"output={tmp_path / 'run'}", *more)))
        logs = LogReader(setup).read(setup.config.logs.train, setup.sensors)
        setup = with_noise(setup, NoiseSummary(setup.noise, [], {}, 0))
        builder = setup.builder(setup.sensors)
        return factors_key(setup, builder, ["samples"], split_into_folds(logs, builder))

    same = key()
    assert key("estimator.ridge=3.0", "estimator.friction=false", "preprocessing.memory_gb=3") == same
    values = {x.name: 0.77 for x in fields(NoiseConfig) if not x.name.startswith(("base", "ft"))}
    values |= {"base_force": [1.0, 2.0, 3.0], "base_moment": [1.0, 2.0, 3.0], "ft_force": 0.3, "ft_moment": 0.3}
    assert values.keys() | STATED_FIELDS.keys() == {x.name for x in fields(NoiseConfig)}
    values = {name: x for name, x in values.items() if name not in STATED_FIELDS}  # change samples
    terms = {"armature": True, "torque_offset": True, "asymmetric_coulomb": True, "stiffness": True}
    terms |= {"sign_width": 0.01, "stribeck": 0.1}
    assert terms.keys() | {"delay", "stiction"} == {x.name for x in fields(ActuatorsConfig)}, "both change samples"
    others = [f"sensors.noise.{name}={json.dumps(x)}" for name, x in values.items()]
    others += [f"actuators.{name}={json.dumps(x)}" for name, x in terms.items()]
    others += ["sensors.set=full", "sensors.offsets={joint_torque: log}", "sensors.scales={joint_torque: all}"]
    others += [f"sensors.scales={{joint_torque: [{x}]}}" for x in ('"*_hip", "*_knee"', '["*_hip", "*_knee"]')]
    assert len({same, *map(key, others)}) == 1 + len(others)


def test_stated_noise_of_the_motion_and_joints_at_rest_change_the_name_of_samples(demo: Path, tmp_path: Path) -> None:
    def key(*more: str) -> str:
        return content_key(content_of_setup(set_up(load_config(demo, (f"output={tmp_path / 'run'}", *more)))))

    names = [key(f"sensors.noise.{name}={x}") for name in STATED_FIELDS for x in (0.0, 0.1)]
    names.append(key("actuators.stiction=true"))
    assert len({key(), key("sensors.noise.base_force=1.5"), *names}) == 1 + len(names)


def test_a_log_with_other_content_is_read_whatever_its_size_and_time_say(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(demo.parent, tmp_path / "demo")
    log, file = tmp_path / "demo" / "sway_train.npz", tmp_path / "demo" / demo.name
    assert main(["identify", str(file), f"output={tmp_path / 'before'}"]) == 0
    state = log.stat()
    with np.load(log) as archive:
        arrays = dict(archive)
    arrays["joint_torque"] = arrays["joint_torque"] + 1.0
    np.savez(log, **arrays)
    os.utime(log, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert (log.stat().st_size, log.stat().st_mtime_ns) == (state.st_size, state.st_mtime_ns)
    capsys.readouterr()
    for name, more in (("after", ()), ("without", (NONE,))):
        assert main(["identify", "-v", str(file), f"output={tmp_path / name}", *more]) == 0
    assert "from cache    samples of 1 log\n" in capsys.readouterr().out
    assert results(tmp_path / "after") == results(tmp_path / "without") != results(tmp_path / "before")


# ------------------------------------------------------------------------------------------- damage, bounds, company


def truncate(entry: Path) -> None:
    for path in entry.glob("*.npy"):
        os.truncate(path, path.stat().st_size - 8)


def forge_nan(entry: Path) -> None:
    """Put a NaN into the last number of an array, with checksums as if it had been there from the start."""
    path = next(path for name in ("values", "joint_position") if (path := entry / f"{name}.npy").exists())
    array = np.load(path)
    array[-1] = np.nan
    np.save(path, array)
    document = json.loads(json.loads((entry / "entry.json").read_text())["entry"])
    document["files"][path.stem]["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    text = json.dumps(document)
    (entry / "entry.json").write_text(json.dumps({"sha256": hashlib.sha256(text.encode()).hexdigest(), "entry": text}))


@pytest.mark.filterwarnings("ignore:identified.urdf:torchid.errors.TorchidWarning")
@pytest.mark.parametrize("damage", [truncate, forge_nan])
def test_a_run_with_damaged_entries_says_so_and_has_the_same_results(
    demo: Path,
    plain: dict[str, Any],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    damage: Callable[[Path], None],
) -> None:
    assert main(["identify", str(demo), f"output={tmp_path / 'first'}"]) == 0
    for path in (tmp_path / FOLDER).rglob("entry.json"):
        damage(path.parent)
    (tmp_path / FOLDER / "checksums.json").write_text("{")
    capsys.readouterr()
    assert main(["identify", str(demo), f"output={tmp_path / 'second'}"]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "a damaged entry of the cache" in line]
    assert len(lines) == 3, "two logs and the factors"
    assert results(tmp_path / "second") == plain
    assert main(["identify", "-v", str(demo), f"output={tmp_path / 'third'}"]) == 0
    assert "from cache    samples of 2 logs, factors" in capsys.readouterr().out


@pytest.mark.slow
def test_two_runs_at_once_have_the_results_of_one(demo: Path, tmp_path: Path) -> None:
    line = [sys.executable, "-m", "torchid", "identify", str(demo)]
    running = [
        subprocess.Popen(
            [*line, f"output={tmp_path / name}"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        for name in ("a", "b")
    ]
    assert main([*line[3:], f"output={tmp_path / 'c'}", NONE]) == 0
    for process in running:
        _, complained = process.communicate(timeout=100)
        assert process.returncode == 0, complained
        assert "cache" not in complained
    assert results(tmp_path / "a")["parameters.json"] == results(tmp_path / "b")["parameters.json"]
    assert len(keys_in(tmp_path)) == 3
    assert not [path for path in (tmp_path / FOLDER).iterdir() if path.name.startswith(".")]


@pytest.mark.filterwarnings("ignore:identified.urdf:torchid.errors.TorchidWarning")
@pytest.mark.parametrize("reason", ["a file in its place", "a full disk", "a folder that may not be written"])
def test_where_nothing_can_be_written_a_run_goes_on_without_and_says_so_once(
    demo: Path,
    plain: dict[str, Any],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    reason: str,
) -> None:

    def refused(*_: object, **__: object) -> Any:
        raise OSError(
            13 if "may not" in reason else 28, "Permission denied" if "may not" in reason else "No space left"
        )

    if reason == "a file in its place":
        (tmp_path / FOLDER).write_text("mine")
    elif reason == "a full disk":
        monkeypatch.setattr("numpy.lib.format.write_array_header_1_0", refused)
    else:
        monkeypatch.setattr("torchid.reading.cache.staging_folder", refused)
    assert main(["identify", str(demo), f"output={tmp_path / 'run'}"]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if FOLDER in line]
    assert len(lines) == 1
    assert f"{tmp_path / FOLDER}: cannot be written (" in lines[0]
    assert results(tmp_path / "run") == plain
    if reason != "a file in its place":
        assert not [path for path in (tmp_path / FOLDER).glob("*") if path.is_dir()]
