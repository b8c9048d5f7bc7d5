"""The experiment file: what is written is what is run, and a slip is named, never swallowed."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import yaml
from experiments import LEAST, changed, load
from refusals import assert_unknown_key, assert_wrong_value

from torchid.config import dump_config, load_config
from torchid.config.estimator import EstimatorConfig
from torchid.config.experiment import ActuatorsConfig
from torchid.config.logs import PreprocessingConfig
from torchid.errors import ConfigError, InputError

ALL: dict[str, Any] = {
    "robot": {"urdf": "models/robot.urdf", "base_link": "pelvis", "fixed_base": True},
    "contacts": [
        {"frame": "l_sole", "type": "flat"},
        {"frame": "r_sole", "type": "line", "line_axis": "x", "radius": 0.3, "normal": [0.0, 0.1, 1.0]},
    ],
    "logs": {"train": ["a.npz", "/logs/b.h5"], "test": ["../c.csv"]},
    "preprocessing": {"cutoff_hz": 20, "sample_rate_hz": 200.0, "contact_margin_s": 0.05, "max_slip": "auto"},
    "sensors": {
        "joint_torques": ["hip", "knee"],
        "contact_wrenches": {"l_sole": ["fx", "mz"], "r_sole": []},
        "ft_sensors": ["l_ankle"],
        "noise": {
            **{"joint_torque": 0.1, "contact_force": 3.0, "contact_moment": 0.3},
            **{"base_force": 1.5, "base_moment": 0.25, "ft_force": 1.0, "ft_moment": 0.1},
            **{"joint_position": 0.001, "joint_velocity": 0.0, "base_orientation": 0.002},
            **{"angular_velocity": 0.01, "specific_force": 0.05},
        },
        "offsets": {"joint_torque": "all", "contact_force": "log"},
        "scales": {"ft_force": "log", "joint_torque": [["hip", "*_hip"], ["knee"]]},
        "on_base_lost": "warn",
    },
    "actuators": {
        "armature": True,
        "torque_offset": False,
        "asymmetric_coulomb": True,
        "stribeck": None,
        "stiffness": False,
        "sign_width": 0.01,
        "delay": -0.002,
        "stiction": True,
    },
    "estimator": {"name": "least_squares", "ridge": 1e-5, "rank_tolerance": 1e-7, "friction": False},
    "analysis": {
        "scenarios": {"stand": [["l_sole", "r_sole"]], "step": [["l_sole"], ["r_sole"], []]},
        "candidates": {
            **{"joint_torques": ["hip", "knee"], "contacts": "axis", "ft_sensors": ["l_ankle"]},
            "normal_forces": ["r_sole"],
        },
        "keep": ["knee"],
        "exclude": ["l_sole.fx"],
        "costs": {"joint_torque": 2.0, "l_sole.fz": 0.5},
        "criterion": "stack",
        "compare": {"legs": {"joint_torques": ["hip"], "contact_wrenches": {"l_sole": ["fz"]}}},
        "seed": 3,
    },
    "figures": {"format": "svg"},
    "output": "runs/all",
    "device": "cuda:1",
    "overwrite": True,
}


# ------------------------------------------------------------------------------------------------------------- values


def test_the_least_experiment_has_four_keys_and_the_documented_defaults(file: Path) -> None:
    config = load(file, LEAST)
    assert config.robot.base_link is None
    assert not config.robot.fixed_base
    assert config.contacts == []
    assert config.logs.test == []
    assert config.preprocessing.cutoff_hz is config.preprocessing.sample_rate_hz is None
    assert config.sensors.set == "full"
    noise = config.sensors.noise
    assert all(x is None for x in dataclasses.asdict(noise).values()), "estimated"
    assert config.sensors.on_base_lost == "error"
    assert (config.estimator.name, config.estimator.ridge, config.estimator.friction) == ("consistent", "auto", True)
    assert (config.device, config.overwrite) == ("cpu", False)


def test_every_key_of_the_file_arrives(file: Path) -> None:
    config = dataclasses.asdict(load(file, ALL))
    assert config["sensors"].pop("set") is None
    (compared,) = config["analysis"]["compare"].values()
    assert compared.pop("set") is None
    assert compared.pop("ft_sensors") == []
    for name in ALL.keys() - {"robot", "logs", "output"}:
        expected = ALL[name]
        if name == "contacts":
            expected = [
                {"line_axis": "y", "radius": "auto", "centre": "auto", "normal": None} | contact for contact in expected
            ]
        if name == "estimator":
            expected = dataclasses.asdict(EstimatorConfig()) | expected
        if name == "preprocessing":
            expected = dataclasses.asdict(PreprocessingConfig()) | expected
        if name == "sensors":
            expected = {"gain_error": 0.02} | expected
        if name == "actuators":
            expected = dataclasses.asdict(ActuatorsConfig()) | expected
        assert config[name] == expected
    assert config["robot"]["base_link"] == "pelvis"
    assert config["robot"]["fixed_base"] is True
    assert config.keys() == ALL.keys()


@pytest.mark.parametrize("settings", [LEAST, ALL], ids=["least", "all"])
def test_what_a_run_writes_down_reads_back_as_itself_anywhere(file: Path, tmp_path: Path, settings: Any) -> None:
    config = load(file, settings)
    elsewhere = tmp_path / "elsewhere.yaml"
    elsewhere.write_text(dump_config(config))
    assert load_config(elsewhere) == config
    assert dump_config(load_config(elsewhere)) == dump_config(config)


@pytest.mark.parametrize("ridge", ["1e-4", "1E-4", "0.0001", "1.0e-04", "'1e-4'"])
def test_numbers_may_be_written_as_people_write_them(file: Path, ridge: str) -> None:
    """YAML 1.1 takes 1e-4, without a dot, for a string."""
    text = yaml.safe_dump(LEAST) + f"estimator: {{ridge: {ridge}}}\n"
    assert load(file, text).estimator.ridge == 1e-4
    assert load(file, LEAST, f"estimator.ridge={ridge}").estimator.ridge == 1e-4


# -------------------------------------------------------------------------------------------------------------- paths


def test_inputs_in_the_file_are_relative_to_it_and_results_to_the_caller(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "caller").mkdir()
    monkeypatch.chdir(tmp_path / "caller")
    monkeypatch.setenv("HOME", "/home/me")
    config = load(file, ALL)
    assert config.robot.urdf == file.parent / "models" / "robot.urdf"
    assert config.logs.train == [file.parent / "a.npz", Path("/logs/b.h5")]
    assert config.logs.test == [tmp_path / "c.csv"]
    assert config.output == tmp_path / "caller" / "runs" / "all", "results go where the work is done"
    assert load(file, changed(output="~/runs")).output == Path("/home/me/runs")
    load(file, ALL)
    assert load_config(Path("../experiments/experiment.yaml")) == config


def test_paths_in_overrides_are_relative_to_the_caller(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    config = load(file, ALL, "output=here", "logs.test=[x.npz, y/z.npz]", "robot.urdf=../r.urdf")
    assert config.output == tmp_path / "here"
    assert config.logs.test == [tmp_path / "x.npz", tmp_path / "y" / "z.npz"]
    assert config.robot.urdf == tmp_path.parent / "r.urdf"
    assert config.logs.train[0] == file.parent / "a.npz"
    assert config.robot.base_link == "pelvis"


# ----------------------------------------------------------------------------------------------- overrides and sensors


def test_a_mapping_given_empty_clears_that_of_the_file_and_any_other_adds_to_it(file: Path) -> None:
    sensors = load(file, ALL, "sensors.offsets={}", "sensors.scales.contact_force=all").sensors
    assert sensors.offsets == {}
    assert {str(channel): extent for channel, extent in sensors.scales.items()} == {
        "ft_force": "log",
        "joint_torque": [["hip", "*_hip"], ["knee"]],
        "contact_force": "all",
    }
    assert sensors.contact_wrenches == {"l_sole": ["fx", "mz"], "r_sole": []}
    assert load(file, ALL, "sensors.contact_wrenches={r_sole: []}").sensors.contact_wrenches["l_sole"] == ["fx", "mz"]


def test_overrides_apply_one_after_the_other(file: Path) -> None:
    """The second does not make the first undone, be it a name that stands for a mapping."""
    sensors = load(file, LEAST | {"sensors": "joints"}, "sensors=full", "sensors.offsets={joint_torque: log}").sensors
    assert sensors.set == "full"
    assert list(map(str, sensors.offsets)) == ["joint_torque"]
    assert load(file, LEAST, "estimator.ridge=2", "estimator.ridge=3").estimator.ridge == 3.0
    again = load(file, ALL, "sensors.offsets={}", "sensors.offsets.ft_force=all").sensors
    assert list(map(str, again.offsets)) == ["ft_force"]


def test_noise_joins_a_named_set_and_a_named_set_keeps_the_noise(file: Path) -> None:
    config = load(file, LEAST, "sensors.noise.joint_torque=2")
    assert (config.sensors.set, config.sensors.noise.joint_torque) == ("full", 2.0)
    config = load(file, ALL, "sensors=contacts")
    assert (config.sensors.set, config.sensors.joint_torques, config.sensors.contact_wrenches) == ("contacts", [], {})
    assert config.sensors.noise.joint_torque == 0.1
    assert config.sensors.on_base_lost == "warn"


@pytest.mark.parametrize(
    ("sensors", "found"),
    [
        ({}, "no sensor"),
        ({"noise": {"joint_torque": 1.0}}, "no sensor"),
        ({"set": "full", "joint_torques": ["hip"]}, "set: full together with sensors by name"),
        ({"joint_torques": ["hip", "knee", "hip"]}, "joint_torques: 'hip' is named twice"),
        ({"contact_wrenches": {"l_sole": ["fz", "fz"]}}, "contact_wrenches.l_sole: 'fz' is named twice"),
        ({"set": "joints", "contact_wrenches": {"sole": ["fx"]}}, "set: joints together with sensors by name"),
    ],
)
def test_sensors_that_contradict_themselves_are_refused(file: Path, sensors: Any, found: str) -> None:
    with pytest.raises(ConfigError, match=found):
        load(file, changed(sensors=sensors))


# ------------------------------------------------------------------------------------------------------------ refusals


@pytest.mark.parametrize(
    ("settings", "place", "name", "nearest"),
    [
        (changed(contact=[]), "key", "contact", "contacts"),
        (changed(sensor="full"), "key", "sensor", "sensors"),
        (changed(robot={"urdf": "r", "baselink": "x"}), "robot", "baselink", "base_link"),
        (changed(logs={"train": ["a"], "tests": []}), "logs", "tests", "test"),
        (changed(preprocessing={"cutof_hz": 3}), "preprocessing", "cutof_hz", "cutoff_hz"),
        (changed(sensors={"joint_torque": ["hip"]}), "sensors", "joint_torque", "joint_torques"),
        (changed(sensors={"set": "full", "noise": {"contact_forces": 1}}), "sensors.noise", "contact_forces",
         "contact_force"),
        (changed(contacts=[{"frame": "a", "type": "flat"}, {"frme": "b"}]), "contacts.1", "frme", "frame"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_an_unknown_key_is_refused_by_its_place_and_the_nearest_that_exists(
    file: Path, settings: Any, place: str, name: str, nearest: str
) -> None:
    assert_unknown_key(lambda: load(file, settings), file, place, name, nearest)


@pytest.mark.parametrize(
    ("settings", "place", "found"),
    [
        (changed(robot=["robot.urdf"]), "robot", "['robot.urdf']"),
        (changed(robot=None), "robot", "None"),
        (changed(robot={"urdf": "r", "fixed_base": "perhaps"}), "robot.fixed_base", "'perhaps'"),
        (changed(logs={"train": "a.npz"}), "logs.train", "a.npz"),
        (changed(contacts={"frame": "a", "type": "flat"}), "contacts", "found {'frame': 'a', 'type': 'flat'}"),
        (changed(contacts=[{"frame": "a", "type": "round"}]), "contacts.0.type", "'round'"),
        (changed(contacts=["a"]), "contacts.0", "'a'"),
        (changed(preprocessing={"cutoff_hz": "fast"}), "preprocessing.cutoff_hz", "'fast'"),
        (changed(preprocessing={"cutoff_hz": -1}), "preprocessing.cutoff_hz", "-1"),
        (changed(preprocessing={"sample_rate_hz": float("inf")}), "preprocessing.sample_rate_hz", "inf"),
        (changed(sensors=3), "sensors", "3"),
        (changed(sensors={"joint_torques": "hip"}), "sensors.joint_torques", "'hip'"),
        (changed(sensors={"contact_wrenches": {"sole": ["fw"]}}), "sensors.contact_wrenches.sole.0", "'fw'"),
        (changed(sensors={"set": "full", "noise": {"joint_torque": 0}}), "sensors.noise.joint_torque", "0"),
        (changed(sensors={"set": "full", "noise": {"base_force": 0}}), "sensors.noise.base_force", "[x, y, z]"),
        (changed(sensors={"set": "full", "noise": {"base_force": [1, 2]}}), "sensors.noise.base_force", "[x, y, z]"),
        (
            changed(sensors={"set": "full", "noise": {"base_moment": [1, 2, -3]}}),
            "sensors.noise.base_moment",
            "greater",
        ),
        (changed(sensors={"set": "full", "noise": {"base_moment": "much"}}), "sensors.noise.base_moment", "'much'"),
        (
            changed(sensors={"set": "full", "noise": {"joint_position": 1e300}}),
            "sensors.noise.joint_position",
            "less than or equal to 1000",
        ),
        (changed(sensors={"set": "full", "on_base_lost": "ignore"}), "sensors.on_base_lost", "'ignore'"),
        (changed(estimator="least_squares"), "estimator", "'least_squares'"),
        (changed(estimator={"ridge": float("nan")}), "estimator.ridge", "nan"),
        (changed(estimator={"ridge": True}), "estimator.ridge", "True"),
        (changed(estimator={"ridge": "one_se"}), "estimator.ridge", "auto, one_standard_error, or a number"),
        (changed(estimator={"rank_tolerance": 1.0}), "estimator.rank_tolerance", "1.0"),
        (changed(device=3), "device", "3"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_value_of_the_wrong_kind_is_refused_by_its_place(file: Path, settings: Any, place: str, found: str) -> None:
    assert_wrong_value(lambda: load(file, settings), file, place, found)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("sensors.offsets=true", "sensors.offsets: found True; accepted: log, all, or a mapping"),
        ("sensors.scales=every", "sensors.scales: found 'every'; accepted: log, all, or a mapping"),
        ("estimator.robust=true", "estimator.robust: found True; accepted: huber, tukey, or a mapping"),
        ("estimator.robust=cauchy", "estimator.robust: found 'cauchy'; accepted: huber, tukey, or a mapping"),
        ("analysis.compare.a=3", "analysis.compare.a: found 3; accepted: full, contacts, joints, or a mapping"),
        ("preprocessing.contact_margin_s=50ms", "contact_margin_s: found '50ms'; accepted: auto, null, or a number"),
        (
            "actuators.sign_width=wide",
            "actuators.sign_width: found 'wide'; accepted: auto, null, or a number",
        ),
        ("actuators.delay=short", "actuators.delay: found 'short'; accepted: auto, null, or a number"),
        ("actuators.delay=true", "actuators.delay: found True; accepted: auto, null, or a number"),
        ("robot.base_tilt=[0.1]", "robot.base_tilt: found [0.1]; accepted: auto, null, or two angles [rad]"),
        ("robot.base_tilt=level", "robot.base_tilt: found 'level'; accepted: auto, null, or two angles [rad]"),
        ("estimator.training.epochs=2.5", "estimator.training.epochs: found 2.5; accepted: a whole number"),
        ("overwrite=perhaps", "overwrite: found 'perhaps'; accepted: true or false"),
        (
            "logs.topics={}",
            "logs.topics: neither joint_states nor low_state; accepted: one of the two, joint_states: the",
        ),
        ("estimator.symmetry={left: l}", "estimator.symmetry.right: missing; accepted: a name"),
        ("contacts=[{frame: a}]", "contacts.0.type: missing; accepted: point, line, flat"),
        (
            "contacts=[{frame: a, type: point, radius: big}]",
            "contacts.0.radius: found 'big'; accepted: auto, or a numb",
        ),
        ("contacts=[{frame: a, type: point, radius: -0.1}]", "contacts.0.radius: found -0.1; accepted: auto, or a n"),
        (
            "contacts=[{frame: a, type: point, normal: [0, 0, 0]}]",
            "contacts.0.normal: found [0, 0, 0]; accepted: three",
        ),
        ("contacts=[{frame: a, type: point, normal: [1, 0]}]", "contacts.0.normal: found [1, 0]; accepted: three num"),
        ("contacts=[{frame: a, type: point, normal: {z: 1}}]", "contacts.0.normal: found {'z': 1}; accepted: three"),
        (
            f"contacts=[{{frame: a, type: point, normal: {[1] * 300}}}]",
            f"contacts.0.normal: found [{'1, ' * 16}1 ... {', 1' * 8}] (900 characters); accepted: three numbers",
        ),
        ("contacts=[{frame: a, type: point, radius: [1, 2]}]", "contacts.0.radius: found [1, 2]; accepted: auto, or a"),
        ("contacts=[{frame: a, type: [point]}]", "contacts.0.type: found ['point']; accepted: 'point', 'line' or"),
        ("contacts=[{frame: a, type: line, line_axis: [x]}]", "contacts.0.line_axis: found ['x']; accepted: 'x', 'y'"),
        ("contacts=[{frame: [a], type: line}]", "contacts.0.frame: found ['a']; accepted: the name of a frame of"),
        ("contacts=[{type: line}]", "contacts.0.frame: missing; accepted: the name of a frame of the robot"),
        (
            "contacts=[[a]]",
            "contacts.0: found ['a']; accepted: a mapping with frame, type, line_axis, radius, centre",
        ),
        (
            "sensors={contact_wrenches: {a: fn}}",
            "sensors.contact_wrenches.a: found 'fn'; accepted: a list of components: [fx, fy, fz], or [fn] for a force",
        ),
        (
            "analysis.compare.b={contact_wrenches: [a]}",
            "analysis.compare.b.contact_wrenches: found ['a']; accepted: a mapping from frames of contacts to compon",
        ),
        ("estimator.symmetry={}", "symmetry.left, estimator.symmetry.right: missing; accepted: estimator.symmetry.l"),
        (
            "preprocessing.exclude_condemned=true",
            "preprocessing: unknown name 'exclude_condemned'; accepted: exclude_rejected",
        ),
        ("memory_gb=4", "key: unknown name 'memory_gb'; accepted: preprocessing.memory_gb"),
        ("seed=4", "key: unknown name 'seed'; accepted: estimator.training.seed, analysis.seed"),
        ("preprocessing.armature=true", "preprocessing: unknown name 'armature'; accepted: actuators.armature"),
    ],
)
def test_a_refusal_says_all_that_is_accepted(file: Path, override: str, message: str) -> None:
    with pytest.raises(InputError) as raised:
        load(file, LEAST, override)
    assert message in str(raised.value)


@pytest.mark.parametrize("key", LEAST)
def test_each_of_the_four_keys_is_needed(file: Path, key: str) -> None:
    with pytest.raises(ConfigError, match=f"{key}: missing"):
        load(file, {name: value for name, value in LEAST.items() if name != key})


@pytest.mark.parametrize("text", ["estimator.ridge", "output", "estimator.ridge=[1", "--ridge 3"])
def test_an_override_that_is_none_is_refused(file: Path, text: str) -> None:
    with pytest.raises(ConfigError, match="command line: .*accepted: key.subkey=value"):
        load(file, LEAST, text)


def test_a_file_that_cannot_be_read_is_named(file: Path) -> None:
    with pytest.raises(ConfigError, match="experiment.yaml: file: cannot be read .*No such file"):
        load_config(file)
    with pytest.raises(ConfigError, match="file: cannot be read"):
        load_config(file.parent)
    with pytest.raises(ConfigError, match="YAML: line .*duplicate key output"):
        load(file, yaml.safe_dump(LEAST) + "output: again\n")
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="YAML: not readable"):
        load_config(file)


def test_noise_by_axis_is_read_back_as_it_was(file: Path) -> None:
    config = load(file, LEAST, "sensors.noise.base_force=[60, 50, 3]", "sensors.noise.base_moment=2")
    assert (config.sensors.noise.base_force, config.sensors.noise.base_moment) == ((60.0, 50.0, 3.0), 2.0)
    file.write_text(dump_config(config))
    assert load_config(file) == config
