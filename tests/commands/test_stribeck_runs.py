"""Friction that drops with speed through the commands: found beside a delay, and in all that comes after it."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import yaml
from delays import arm
from motions import value
from stribeck import AT_REST, COULOMB, recorded

from torchid.cli import main
from torchid.config import load_config

VELOCITY, DELAY = 0.2, 0.0062  # [rad/s, s]
pytestmark = pytest.mark.filterwarnings("ignore:identified.urdf")


def _experiment(folder: Path, **settings: object) -> Path:
    robot, _ = arm()
    for name, noise in (("train", 0.05), ("new", 0.0)):
        log = recorded(VELOCITY, noise, seed=3, delay=DELAY)
        fields = {"joint_position": value(log.joint_position), "joint_torque": value(log.joint_torque)}
        np.savez(folder / f"{name}.npz", time=log.time, joint_names=list(robot.joint_names), **fields)
    experiment = {
        "robot": {"urdf": str(robot.path), "fixed_base": True},
        "logs": {"train": ["train.npz"]},
        "sensors": {"set": "joints", "noise": {"joint_torque": 0.05}},
        "preprocessing": {"cutoff_hz": 15},
        "actuators": {"delay": "auto", "stribeck": "auto"},
        "estimator": {"ridge": 1e-7},
        "output": str(folder / "run"),
    }
    (folder / "experiment.yaml").write_text(yaml.safe_dump(experiment | settings))
    return folder / "experiment.yaml"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An experiment, and its run."""
    out = tmp_path_factory.mktemp("stribeck")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert main(["identify", str(_experiment(out))]) == 0
    return out


def _rms(run: Path, new: Path) -> float:
    assert main(["evaluate", str(run), "--log", str(new)]) == 0
    (written,) = (run / "evaluation").rglob("metrics.json")
    return float(json.loads(written.read_text())["new"]["identified"]["joint_torque_rms"])


def test_a_run_finds_it_beside_a_delay_and_an_evaluation_predicts_with_it(folder: Path) -> None:
    run = folder / "run"
    metrics = json.loads((run / "metrics.json").read_text())
    choice = metrics["stribeck_selection"]
    assert choice["interval"][0] < VELOCITY < choice["interval"][1]
    assert choice["value"] == pytest.approx(VELOCITY, rel=0.1)
    assert metrics["delay_selection"]["value"] == pytest.approx(DELAY, abs=2e-4)
    assert load_config(run / "config.yaml").actuators.stribeck == choice["value"]
    extras = json.loads((run / "parameters.json").read_text())["extras"]
    assert [x["value"] for x in extras if x["what"] == "stribeck"] == pytest.approx(AT_REST, rel=0.1)

    without = folder / "without"
    assert (
        main(
            [
                "identify",
                str(folder / "experiment.yaml"),
                "actuators.stribeck=null",
                "actuators.stiction=false",
                f"output={without}",
            ]
        )
        == 0
    )
    assert _rms(run, folder / "new.npz") < 0.3 * _rms(without, folder / "new.npz")


def _found(run: Path) -> dict[str, float]:
    actuators = load_config(run / "config.yaml").actuators
    return {"delay": float(actuators.delay or 0.0), "stribeck": float(actuators.stribeck or 0.0)}


def test_simulators_files_have_it_or_say_that_they_lack_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, out = str(folder / "run"), folder / "export"
    for form, lacks in (("urdf", True), ("mjcf", True), ("isaaclab", False), ("json", False)):
        capsys.readouterr()
        assert main(["export", run, "--format", form, "--output", f"{out}.{form}"]) == 0
        said = " ".join(capsys.readouterr().err.split())
        assert ("Stribeck friction of " in said) == lacks
        assert ("N m (N) at rest. Use --format isaaclab or json." in said) == lacks
    joints = json.loads(Path(f"{out}.json").read_text())["joints"]
    assert [x["stribeck"] for x in joints.values()] == pytest.approx(AT_REST, rel=0.1)
    assert {x["stribeck_velocity"] for x in joints.values()} == {_found(folder / "run")["stribeck"]}
    scope: dict[str, object] = {"ImplicitActuatorCfg": dict}
    text = Path(f"{out}.isaaclab").read_text().replace("from isaaclab.actuators import ImplicitActuatorCfg", "")
    exec(text, scope)  # what it says of friction
    actuators = scope["IDENTIFIED_ACTUATORS"]
    assert isinstance(actuators, dict)
    assert list(actuators["friction"].values()) == pytest.approx(COULOMB + AT_REST, rel=0.1)
    assert list(actuators["dynamic_friction"].values()) == pytest.approx(COULOMB, rel=0.1)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["actuators.stribeck=-0.1"], "actuators.stribeck: found -0.1; accepted:"),
        (["actuators.stribeck=0"], "actuators.stribeck: found 0; accepted:"),
        (["actuators.stribeck=fast"], "actuators.stribeck: found 'fast'; accepted: auto, null, or a number"),
        (["actuators.stribeck=true"], "actuators.stribeck: found True; accepted: auto, null, or a number"),
        (["estimator.friction=false"], "actuators.stribeck: needs fitted Coulomb friction, but estimator"),
    ],
)
def test_mistakes_are_answered_in_a_line(
    settings: list[str], said: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["identify", str(folder / "experiment.yaml"), f"output={folder / 'x'}", *settings]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert said in line


def test_samples_have_friction_at_rest_of_at_least_coulomb_friction(folder: Path) -> None:
    assert main(["sample", str(folder / "run"), "--count", "200", "--output", str(folder / "samples.npz")]) == 0
    with np.load(folder / "samples.npz") as samples:
        named = dict(zip(samples["names"].tolist(), samples["samples"].T, strict=True))
    at_rest = np.array([x for name, x in named.items() if name.startswith("Stribeck friction of ")])
    assert at_rest.shape == (2, 200)
    assert at_rest.min() >= 0.0
    np.testing.assert_allclose(at_rest.mean(axis=1), AT_REST, rtol=0.15)
