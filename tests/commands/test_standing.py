"""`preprocessing.base_motion: contacts` in the commands: the same results, and refusals in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from demo import DEMO, NO_TERMS
from experiments import changed, load
from legged.robots import GO2
from motions import value
from refusals import refused
from repository import SHARED
from run_folders import document
from walking import MACHINES, recorded, truth

from torchid.cli import main
from torchid.commands.check import check_experiment
from torchid.config import load_config
from torchid.errors import ConfigError, InputError
from torchid.fitting.experiment import set_up
from torchid.logs import Log, write_log
from torchid.problem.contact_detection import DetectionConfig
from torchid.reading.log_reader import LogReader

MACHINE = MACHINES["quadruped"]
FEET = [{"frame": name, "type": "point"} for name in MACHINE.feet]
NO_BASE: dict[str, Any] = {"base_quat_xyzw": None, "base_position_world": None}


@pytest.fixture(scope="module")
def logs() -> tuple[Log, Log]:
    """A walk and another of a quadruped, recorded with the pose of its base."""
    one, other = (recorded(MACHINE, truth(MACHINE, 0, seconds=2.0), seed=seed, noise=0.1) for seed in (0, 1))
    return replace(one, contact_wrench_local=None), replace(other, contact_wrench_local=None)


Written = Callable[..., Path]


@pytest.fixture
def written(tmp_path: Path, logs: tuple[Log, Log]) -> Written:
    """Writes an experiment file with these logs, without what they have of the base's motion."""

    def write(change: Callable[[Log], Log] = lambda log: replace(log, **NO_BASE), **preprocessing: Any) -> Path:
        for name, log in zip(("train", "test"), logs, strict=True):
            write_log(change(log), tmp_path / f"{name}.npz")
        settings = {
            "robot": {"urdf": str(DEMO / "quadruped.urdf")},
            "contacts": FEET,
            "logs": {"train": ["train.npz"], "test": ["test.npz"]},
            "preprocessing": {"cutoff_hz": 15} | preprocessing,
            "sensors": "joints",
            "actuators": NO_TERMS,
            "estimator": {"name": "least_squares", "ridge": 1e-3},
            "output": str(tmp_path / "run"),
        }
        (tmp_path / "walk.yaml").write_text(json.dumps(settings))
        return tmp_path / "walk.yaml"

    return write


def test_a_fit_without_the_pose_of_the_base_predicts_as_well_as_with_it(written: Written, tmp_path: Path) -> None:
    file = written(lambda log: log)
    assert main(["identify", str(file), f"output={tmp_path / 'measured'}"]) == 0
    file = written(base_motion="contacts")
    assert main(["identify", str(file)]) == 0
    measured, derived = (document(tmp_path / name, "metrics")["test"]["nullspace_rms"] for name in ("measured", "run"))
    nominal = document(tmp_path / "run", "metrics")["test_nominal"]["nullspace_rms"]
    assert derived < 1.1 * measured
    assert derived < 0.3 * nominal
    assert main(["evaluate", str(tmp_path / "run"), "--log", str(tmp_path / "test.npz")]) == 0
    again = document(tmp_path / "run" / "evaluation" / "test", "metrics")["test"]["identified"]["nullspace_rms"]
    assert again == pytest.approx(derived, rel=1e-12)


# ---------------------------------------------------------------------------------------------------- detected contacts


NO_FLAGS: dict[str, Any] = {"contact_names": (), "contact_active": None}


def test_a_fit_with_detected_contacts_predicts_far_better_than_the_urdf(written: Written, tmp_path: Path) -> None:
    """A foot here carries a twentieth of the weight for a while, which friction of 15 % of each torque hides."""
    file = written(lambda log: replace(log, **NO_FLAGS), detect_contacts=True)
    assert main(["identify", str(file)]) == 0
    metrics = document(tmp_path / "run", "metrics")
    assert metrics["test"]["nullspace_rms"] < 0.4 * metrics["test_nominal"]["nullspace_rms"]


def test_thresholds_of_detection_are_checked(tmp_path: Path) -> None:
    def refused_detection(detection: object, start: str, contacts: object = None, **robot: Any) -> str:
        settings = changed(
            robot={"urdf": str(DEMO / "quadruped.urdf")} | robot,
            contacts=FEET if contacts is None else contacts,
            preprocessing={"detect_contacts": detection},
        )
        np.savez(tmp_path / "a.npz")
        return refused(lambda: set_up(load(tmp_path / "x.yaml", settings)), start, InputError)

    field = "preprocessing.detect_contacts"
    assert "above touch (0.02)" in refused_detection({"lift": 0.1}, f"{field}.lift: 0.1")
    refused_detection(True, f"{field}: set, but contacts is empty", [])
    refused_detection(True, f"{field}: set, but robot.fixed_base is true", fixed_base=True)
    place = f"{tmp_path / 'x.yaml'}: {field}"
    assert "touch" in refused_detection({"tuch": 0.1}, f"{place}: unknown name 'tuch'")
    refused_detection({"touch": -0.1}, f"{place}.touch: ")
    off = load(tmp_path / "y.yaml", changed(preprocessing={"detect_contacts": False}))
    on = load(tmp_path / "y.yaml", changed(preprocessing={"detect_contacts": True}), f"{field}.lift=0.01")
    assert off.preprocessing.detect_contacts is None
    assert on.preprocessing.detect_contacts == DetectionConfig(lift=0.01)


# ------------------------------------------------------------------------------------------------------------- settings


def test_one_floor_has_one_normal(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz")
    tilted = [*FEET[:3], FEET[3] | {"normal": [0.1, 0, 1]}]
    settings = changed(
        robot={"urdf": str(DEMO / "quadruped.urdf")}, contacts=tilted, preprocessing={"base_motion": "contacts"}
    )
    line = refused(lambda: set_up(load(tmp_path / "x.yaml", settings)), "contacts[3].normal: [0.0995", ConfigError)
    assert "contacts[0] has [0, 0, 1]" in line
    set_up(load(tmp_path / "y.yaml", settings | {"preprocessing": {}}))


# --------------------------------------------------------------------------------------------------------- a real robot


REAL = pytest.mark.skipif(not SHARED.is_dir(), reason="the recorded Go2 (../shared/data) is not here")


def standing_go2(folder: Path, **preprocessing: Any) -> dict[str, Any]:
    """What an experiment on the recording makes of its second half, without an IMU or flags that anybody recorded."""
    if not GO2.available:
        pytest.skip("the package example-robot-data is not installed")
    with np.load(SHARED / "go2_standing" / "log.npz") as raw:
        fields = {"time": raw["time"], "joint_names": raw["joint_names"], "joint_position": raw["joint_position"]}
        fields["joint_torque"] = raw["torque_estimate"]
    fields |= {"contact_names": np.array(GO2.feet), "contact_active": np.ones((len(fields["time"]), 4), dtype=bool)}
    np.savez(folder / "stand.npz", **fields)
    settings = {
        "robot": {"urdf": str(GO2.urdf)},
        "contacts": [{"frame": foot, "type": "point"} for foot in GO2.feet],
        "logs": {"train": ["stand.npz[:50%]"], "test": ["stand.npz[50%:]"]},
        "preprocessing": {"cutoff_hz": 4, "base_motion": "contacts"} | preprocessing,
        "sensors": "joints",
        "estimator": {"name": "consistent", "ridge": 1e-5},
        "output": str(folder / "run"),
    }
    (folder / "stand.yaml").write_text(json.dumps(settings))
    assert main(["identify", str(folder / "stand.yaml")]) == 0
    return document(folder / "run", "metrics")


@REAL
@pytest.mark.slow("a recording of 80 s, fitted with bodies that exist")
def test_a_standing_go2_without_an_imu_is_predicted_better_than_by_its_urdf(tmp_path: Path) -> None:
    metrics = standing_go2(tmp_path)
    assert metrics["test"]["nullspace_rms_relative"] < 0.40
    assert metrics["test_nominal"]["nullspace_rms_relative"] > 0.41


def test_the_checks_reject_a_log_in_which_nothing_stands(written: Written) -> None:
    def in_the_air(log: Log) -> Log:
        return replace(log, **NO_BASE, contact_active=np.zeros_like(value(log.contact_active)))

    checked = check_experiment(written(in_the_air, base_motion="contacts"))[0]
    (finding,) = [one for one in checked.findings if one.name == "does not fit"]
    assert finding.found.startswith("no contact stands in any sample")


def test_samples_near_changes_of_detected_contacts_are_dropped(written: Written) -> None:
    counts = []
    for margin in (0.0, 0.05):
        file = written(lambda log: replace(log, **NO_FLAGS), detect_contacts={"margin_s": margin})
        setup = set_up(load_config(file))
        counts.append(len(LogReader(setup).read(setup.config.logs.train, setup.sensors)[0]))
    assert counts[1] < counts[0] - 50


def refused_settings(folder: Path, contacts: list[dict[str, Any]], **robot: Any) -> str:
    settings = changed(
        robot={"urdf": str(DEMO / "quadruped.urdf")} | robot,
        contacts=contacts,
        preprocessing={"base_motion": "contacts"},
    )
    np.savez(folder / "a.npz")
    return refused(lambda: set_up(load(folder / "x.yaml", settings)), "preprocessing.base_motion: ", ConfigError)


def test_contacts_that_can_never_say_how_the_base_stands_are_refused(tmp_path: Path) -> None:
    assert "the contacts are none; accepted: three point feet" in refused_settings(tmp_path, [])
    assert "the contacts are point front_left_foot, point" in refused_settings(tmp_path, FEET[:2])
    assert "robot.fixed_base is true" in refused_settings(tmp_path, FEET, fixed_base=True)
    set_up(load(tmp_path / "y.yaml", changed(
        robot={"urdf": str(DEMO / "quadruped.urdf")}, contacts=FEET[:3], preprocessing={"base_motion": "contacts"},
    )))  # fmt: skip
