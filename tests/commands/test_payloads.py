"""A load that is known in one log and absent from another tells scales of all torques from the robot's masses."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from currents import HIP_SCALE, HIPS, KNEE_SCALE, KNEES, NOISE, quadruped_files
from refusals import refusal
from repository import DEMO
from run_folders import document, identified

from torchid.cli import main
from torchid.commands.check import check_experiment
from torchid.config import dump_config, load_config
from torchid.fitting.factor_files import read_factors
from torchid.robot import Payload

SCALES = dict.fromkeys(HIPS, HIP_SCALE) | dict.fromkeys(KNEES, KNEE_SCALE)
SENSORS = {"set": "joints", "noise": NOISE, "scales": {"joint_torque": [HIPS, KNEES]}}
BAG = Payload("trunk", 9.0, (0.05, 0.02, 0.1), (0.02, 0.003, -0.002, 0.03, 0.001, 0.025))
EXACT = {"name": "least_squares", "ridge": 0}
GIVEN = json.loads(json.dumps(asdict(BAG)))  # type: ignore[call-overload]
RECORDED = {"train": ["a.npz", {"file": "b.npz", "payload": GIVEN}], "test": [{"file": "new.npz", "payload": [GIVEN]}]}

pytestmark = pytest.mark.filterwarnings("ignore:identified.urdf")


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """An experiment of a robot with a bag on it in the second log and that of tests, and its mass without [kg]."""
    folder = tmp_path_factory.mktemp("bag")
    return quadruped_files(folder, SCALES, loads={"b": BAG}, sensors=SENSORS, logs=RECORDED, estimator=EXACT)


def fitted(file: Path, run: Path, *more: str) -> tuple[dict[str, Any], list[float]]:
    """What a run says, and the scales that it finds."""
    assert main(["identify", str(file), f"output={run}", *more]) == 0
    return document(run, "metrics"), [1.0 + x["value"] for x in document(run, "parameters")["extras"]]


def test_a_known_load_in_one_log_gives_scales_and_masses(world: tuple[Path, float], tmp_path: Path) -> None:
    file, mass = world
    metrics, scales = fitted(file, tmp_path / "run")
    assert scales == pytest.approx([HIP_SCALE, KNEE_SCALE], abs=1e-8)
    assert metrics["total_mass"] == pytest.approx(mass, abs=1e-7)
    assert metrics["confounded"] == []
    loaded = load_config(tmp_path / "run" / "config.yaml")
    assert dump_config(loaded) == (tmp_path / "run" / "config.yaml").read_text()
    assert metrics["test"]["joint_torque_rms"] < 1e-9 < 1e-2 < metrics["test_nominal"]["joint_torque_rms"]


@pytest.mark.slow("three fits of the same logs")
def test_all_ways_to_read_agree(world: tuple[Path, float], tmp_path: Path) -> None:
    """Block by block, from files of factors, and in an evaluation."""
    file, _ = world
    for name, more in (("whole", ()), ("disk", ("preprocessing.memory_gb=1e-5",))):
        fitted(file, tmp_path / name, *more)
    factors = tmp_path / "factors"
    assert main(["compress", str(file), "--output", str(factors)]) == 0
    assert read_factors(factors / "a.factor").payloads == []
    assert Payload(**read_factors(factors / "b.factor").payloads[0]) == BAG
    settings = yaml.safe_load(file.read_text())
    settings["logs"] = {"train": [str(factors / "*.factor")], "test": RECORDED["test"]}
    fleet = file.with_name("fleet.yaml")
    fleet.write_text(yaml.safe_dump(settings))
    fitted(fleet, tmp_path / "fleet")
    for name in ("disk", "fleet"):
        np.testing.assert_allclose(identified(tmp_path / name), identified(tmp_path / "whole"), atol=1e-8)
    assert main(["evaluate", str(tmp_path / "whole"), "--log", str(file.parent / "new.npz")]) == 0
    found = json.loads((tmp_path / "whole/evaluation/new/metrics.json").read_text())["new"]
    assert found["identified"]["joint_torque_rms"] < 1e-9


@pytest.mark.parametrize(
    ("payload", "message"),
    [
        ({"mass": -1}, "logs.train.1.payload.mass: found -1; accepted: a number greater than 0 [kg]"),
        ({"mas": 1}, "logs.train.1.payload: unknown name 'mas'; accepted: mass"),
        ({"center_of_mass": [0.1, 0.2]}, "logs.train.1.payload.center_of_mass: found [0.1, 0.2]; accepted: [x, y, z]"),
        ({"link": "trnk"}, "payload.link of {b}: unknown name 'trnk'; accepted: trunk"),
        (
            {"inertia": [1, 0, 0, 0.1, 0, 0.1]},
            "payload.inertia of {b}: [1.0, 0.0, 0.0, 0.1, 0.0, 0.1] is not physically consistent; accepted",
        ),
        (None, "logs.train.1.payload: found 3; accepted: a mapping with link, mass [kg], center_of_mass"),
    ],
)
def test_a_payload_that_cannot_be_is_refused_in_one_line(
    world: tuple[Path, float],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    payload: dict[str, Any] | None,
    message: str,
) -> None:
    file, _ = world
    entry = {"file": "b.npz", "payload": 3 if payload is None else GIVEN | payload}
    bad = file.with_name("bad.yaml")
    bad.write_text(yaml.safe_dump(yaml.safe_load(file.read_text()) | {"logs": {"train": ["a.npz", entry]}}))
    found = refusal(["identify", str(bad), f"output={tmp_path / 'run'}"], file.parent, capsys)
    assert message.replace("{b}", str(file.parent / "b.npz")) in found
    assert found.startswith(f"torchid: {bad}: ")


@pytest.mark.slow("three checks of the demo")
def test_check_takes_the_robot_with_its_load(tmp_path: Path) -> None:
    """The demo's log of a robot whose URDF lacks 6 kg of the trunk: with these as a payload nothing is new."""
    urdf = (DEMO / "quadruped.urdf").read_text()
    assert urdf.count('<mass value="11.0"/>') == 1
    (tmp_path / "light.urdf").write_text(urdf.replace('<mass value="11.0"/>', '<mass value="5.0"/>'))
    part = {"link": "trunk", "mass": 6.0, "center_of_mass": [0.01, 0.0, 0.02]}
    found = []
    for name, payload in (("quadruped", {}), ("light", {"payload": part}), ("light", {})):
        settings = yaml.safe_load((DEMO / "quadruped.yaml").read_text())
        folder = DEMO if name == "quadruped" else tmp_path
        settings["robot"]["urdf"] = str(folder / f"{name}.urdf")
        settings["logs"] = {"train": [{"file": str(DEMO / "sway_train.npz")} | payload]}
        (tmp_path / "check.yaml").write_text(yaml.safe_dump(settings))
        (checked,) = check_experiment(tmp_path / "check.yaml")
        found.append([(one.field, one.severity, one.found) for one in checked.findings])
    as_it_is, with_payload, without = found
    assert with_payload == as_it_is
    assert without != as_it_is
