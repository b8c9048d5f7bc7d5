"""The simulation file: what is written is what is simulated, and a slip is named, never swallowed."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from refusals import assert_unknown_key, assert_wrong_value

from torchid.config import SimulationConfig, dump_config, load_simulation
from torchid.errors import ConfigError

WAVE = {"what": "com_z", "hz": 0.5, "amplitude": 0.08}
LEAST: dict[str, Any] = {
    "robot": {"urdf": "robot.urdf"}, "feet": [{"frame": "sole"}], "motions": [{"name": "stand", "duration_s": 2.0}],
    "output": "out",
}  # fmt: skip
ALL: dict[str, Any] = {
    "robot": {"urdf": "models/robot.urdf"},
    "feet": [
        {"frame": "l_sole", "points": [[0.1, 0.05, 0.0], [-0.1, 0.0, 0.0]], "sensor": "fn"},
        {"frame": "r_sole", "points": [], "sensor": "wrench"},
    ],
    "motions": [
        {
            "name": "squat_0.5hz",
            "duration_s": 30.4,
            "waves": [WAVE | {"phase": 0.25}],
            "steps": {"hz": 0.2, "order": ["r_sole"], "height_m": 0.04, "swing_s": 1.2, "transfer_s": 0.3},
        },
        {"name": "stand", "duration_s": 1.0, "waves": [], "steps": None},
    ],
    "output": "runs/all",
    "posture": {"knee": 1.1, "hip": -0.55},
    "friction": {"enabled": True, "coulomb": 2.0, "viscous": 0.1},
    "sensors": {
        "noise": {
            "enabled": True, "joint_position": 1e-3, "base_position": 2e-3, "base_orientation": 3e-3,
            "joint_torque": 4.0, "contact_force": 5.5, "contact_moment": 0.6,
        },
        "bias": {"enabled": True, "joint_torque": 7.0, "contact_force": 8.0, "contact_moment": 9.0, "gain": 0.1},
        "delay": {"enabled": True, "feet_s": 0.02},
        "contact_threshold": 12.0,
    },
    "nominal": {"error": 0.1, "seed": 4},
    "bounds": {"height_m": 0.3, "slip_m": 0.02, "zmp_m": -0.01},
    "physics_hz": 2000.0,
    "control_hz": 400.0,
    "seed": 7,
    "overwrite": True,
}  # fmt: skip


def load(file: Path, settings: Any, *overrides: str) -> SimulationConfig:
    file.write_text(settings if isinstance(settings, str) else yaml.safe_dump(settings))
    return load_simulation(file, overrides)


def changed(**changes: Any) -> dict[str, Any]:
    return LEAST | changes


def motion(**changes: Any) -> dict[str, Any]:
    return changed(motions=[{"name": "m", "duration_s": 1.0} | changes])


def test_the_least_simulation_has_four_keys_and_perfect_sensors(file: Path) -> None:
    config = load(file, LEAST)
    assert config.feet[0].points == []
    assert config.posture == {}
    assert config.motions[0].waves == []
    assert config.motions[0].steps is None
    assert not any(part.enabled for part in (config.sensors.noise, config.sensors.bias, config.sensors.delay))
    assert not config.friction.enabled
    assert (config.physics_hz, config.control_hz, config.seed, config.overwrite) == (1000.0, 500.0, 0, False)


def test_every_key_of_the_file_arrives(file: Path) -> None:
    config = dataclasses.asdict(load(file, ALL))
    assert config.keys() == ALL.keys()
    for name in ALL.keys() - {"robot", "output"}:
        assert config[name] == ALL[name], name


@pytest.mark.parametrize("settings", [LEAST, ALL], ids=["least", "all"])
def test_what_a_simulation_writes_down_reads_back_as_itself_anywhere(file: Path, tmp_path: Path, settings: Any) -> None:
    config = load(file, settings)
    elsewhere = tmp_path / "elsewhere.yaml"
    elsewhere.write_text(dump_config(config))
    assert load_simulation(elsewhere) == config


@pytest.mark.parametrize(
    ("physics", "control"), [(1000, 300), (1000, 2000), (1000, 999), (1000, 1001), (1000, 400.1), (1000, 1e13)]
)
def test_a_controller_between_two_physics_steps_is_refused(file: Path, physics: float, control: float) -> None:
    message = f"control_hz: {control:g}; accepted: 1000 / a whole number"
    with pytest.raises(ConfigError, match=re.escape(message)):
        load(file, changed(physics_hz=physics, control_hz=control))


def test_motions_of_one_name_are_refused(file: Path) -> None:
    one, other = ({"name": name, "duration_s": 1.0} for name in "ab")
    with pytest.raises(ConfigError, match="motions: several named 'b'; accepted: different names"):
        load(file, changed(motions=[one, other, other]))


@pytest.mark.parametrize(
    ("settings", "place", "name", "nearest"),
    [
        (changed(motion=[]), "key", "motion", "motions"),
        (changed(robot={"urdf": "r", "base_link": "x"}), "robot", "base_link", "urdf"),
        (changed(feet=[{"frame": "a", "point": []}]), "feet.0", "point", "points"),
        (motion(wave=[]), "motions.0", "wave", "waves"),
        (motion(waves=[WAVE, WAVE | {"phse": 1}]), "motions.0.waves.1", "phse", "phase"),
        (motion(steps={"hz": 1, "order": ["a"], "swing": 1}), "motions.0.steps", "swing", "swing_s"),
        (changed(sensors={"noises": {}}), "sensors", "noises", "noise"),
        (changed(sensors={"noise": {"contact_forces": 1}}), "sensors.noise", "contact_forces", "contact_force"),
        (changed(sensors={"bias": {"gian": 1}}), "sensors.bias", "gian", "gain"),
        (changed(sensors={"delay": {"foot_s": 1}}), "sensors.delay", "foot_s", "feet_s"),
        (changed(friction={"coulombs": 1}), "friction", "coulombs", "coulomb"),
        (changed(nominal={"eror": 1}), "nominal", "eror", "error"),
        (changed(bounds={"slip": 1}), "bounds", "slip", "slip_m"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_an_unknown_key_is_refused_by_its_place_and_the_nearest_that_exists(
    file: Path, settings: Any, place: str, name: str, nearest: str
) -> None:
    assert_unknown_key(lambda: load(file, settings), file, place, name, nearest)


@pytest.mark.parametrize(
    ("settings", "place", "found"),
    [
        (changed(robot="robot.urdf"), "robot", "'robot.urdf'"),
        (changed(feet=[]), "feet", "an empty list"),
        (changed(feet=["sole"]), "feet.0", "'sole'"),
        (changed(feet=[{"frame": "a", "points": [[0, 0, "up"]]}]), "feet.0.points.0.2", "'up'"),
        (changed(motions=[]), "motions", "an empty list"),
        (changed(motions={"name": "m"}), "motions", "found {'name': 'm'}"),
        (motion(duration_s=0), "motions.0.duration_s", "0"),
        (motion(waves=[WAVE | {"hz": -1}]), "motions.0.waves.0.hz", "-1"),
        (motion(waves=[WAVE | {"amplitude": float("nan")}]), "motions.0.waves.0.amplitude", "nan"),
        (motion(steps={"hz": 1, "order": []}), "motions.0.steps.order", "an empty list"),
        (motion(steps={"hz": 1, "order": ["a"], "height_m": 0}), "motions.0.steps.height_m", "0"),
        (changed(posture={"knee": "bent"}), "posture.knee", "'bent'"),
        (changed(friction={"coulomb": -1}), "friction.coulomb", "-1"),
        (changed(friction=True), "friction", "True"),
        (changed(sensors={"noise": {"joint_torque": -1}}), "sensors.noise.joint_torque", "-1"),
        (changed(sensors={"noise": {"enabled": "perhaps"}}), "sensors.noise.enabled", "'perhaps'"),
        (changed(sensors={"contact_threshold": 0}), "sensors.contact_threshold", "0"),
        (changed(sensors={"delay": {"feet_s": -0.1}}), "sensors.delay.feet_s", "-0.1"),
        (changed(nominal={"error": 1.0}), "nominal.error", "1.0"),
        (changed(nominal={"seed": -1}), "nominal.seed", "-1"),
        (changed(bounds={"zmp_m": float("-inf")}), "bounds.zmp_m", "-inf"),
        (changed(seed=0.5), "seed", "0.5"),
        (changed(physics_hz=0), "physics_hz", "0"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_value_of_the_wrong_kind_is_refused_by_its_place(file: Path, settings: Any, place: str, found: str) -> None:
    assert_wrong_value(lambda: load(file, settings), file, place, found)


def test_a_file_that_is_no_simulation_is_named(file: Path) -> None:
    with pytest.raises(ConfigError, match="experiment.yaml: file: cannot be read .*accepted: a YAML simulation file"):
        load_simulation(file)
    with pytest.raises(ConfigError, match="accepted: a mapping with robot, feet, motions, output"):
        load(file, "- a\n- b\n")
    with pytest.raises(ConfigError, match="YAML: text, <robot .* characters\\); accepted: a mapping with robot"):
        load(file, f"<robot name='arm'>{'<link/>' * 9}</robot>")
    with pytest.raises(ConfigError, match=r"'feet=\[{frame: l_sole}, {frame: r_sole}\]'"):
        load(file, LEAST, "feet[0].frame=l_sole")


@pytest.mark.parametrize("name", ["", ".hidden", "a/b", "../a", "a b", "a\n", "-a", "x" * 101])
def test_a_motion_whose_name_is_no_file_name_is_refused(file: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="motions.0.name: "):
        load(file, motion(name=name))
