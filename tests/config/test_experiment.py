"""The experiment file: what is written is what is run, and a slip is named, never swallowed."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import yaml
from experiments import LEAST
from refusals import assert_unknown_key, assert_wrong_value

from torchid.commands.training import descent_settings
from torchid.config import ExperimentConfig, dump_config, load_config
from torchid.config.estimator import ESTIMATORS, EstimatorConfig
from torchid.config.experiment import PreprocessingConfig
from torchid.errors import ConfigError, InputError, TorchidWarning
from torchid.estimators import Conditions, Consistent, LeastSquares, Sgd

ALL: dict[str, Any] = {
    "robot": {"urdf": "models/robot.urdf", "base_link": "pelvis", "fixed_base": True},
    "contacts": [{"frame": "l_sole", "type": "flat"}, {"frame": "r_sole", "type": "line", "line_axis": "x"}],
    "logs": {"train": ["a.npz", "/logs/b.h5"], "test": ["../c.csv"]},
    "preprocessing": {"cutoff_hz": 20, "sample_rate_hz": 200.0, "contact_margin_s": 0.05},
    "sensors": {
        "joint_torques": ["hip", "knee"],
        "contact_wrenches": {"l_sole": ["fx", "mz"], "r_sole": []},
        "ft_sensors": ["l_ankle"],
        "noise": {
            **{"joint_torque": 0.1, "contact_force": 3.0, "contact_moment": 0.3},
            **{"base_force": 1.5, "base_moment": 0.25, "ft_force": 1.0, "ft_moment": 0.1},
        },
        "offsets": {"joint_torque": "all", "contact_force": "log"},
        "scales": {"ft_force": "log"},
        "on_base_lost": "warn",
    },
    "actuators": {"armature": True, "torque_offset": False, "asymmetric_coulomb": True, "sign_width": 0.01},
    "estimator": {"name": "least_squares", "ridge": 1e-5, "rank_tolerance": 1e-7, "friction": False},
    "analysis": {
        "scenarios": {"stand": [["l_sole", "r_sole"]], "step": [["l_sole"], ["r_sole"], []]},
        "candidates": {"joint_torques": ["hip", "knee"], "contacts": "axis", "ft_sensors": ["l_ankle"]},
        "keep": ["knee"],
        "exclude": ["l_sole.fx"],
        "costs": {"joint_torque": 2.0, "l_sole.fz": 0.5},
        "criterion": "stack",
        "compare": {"legs": {"joint_torques": ["hip"], "contact_wrenches": {"l_sole": ["fz"]}}},
        "prior_error": 0.1,
        "seed": 3,
    },
    "output": "runs/all",
    "device": "cuda:1",
    "overwrite": True,
}
DESCENT: dict[str, Any] = {
    "name": "sgd",
    "ridge": 0.01,
    "rank_tolerance": 1e-7,
    "frozen": ["pelvis"],
    "margin": 0.001,
    "consistency": "penalties",
    "penalties": {"eigenvalue": 3.0, "log_det": 0.01, "mass": 4.0, "friction": 5.0},
    "training": {
        "epochs": 7,
        "batch_size": 32,
        "optimizer": {"name": "SGD", "lr": 0.1, "momentum": 0.9, "nesterov": True},
        "schedule": {"name": "MultiStepLR", "milestones": [3, 5]},
        "patience": 2,
        "clip": 3.0,
        "damping": 0.5,
        "seed": 11,
        "evaluate_every": 4,
        "checkpoint_seconds": 1.5,
    },
}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "experiments" / "experiment.yaml"
    path.parent.mkdir()
    return path


def load(file: Path, settings: Any, *overrides: str) -> ExperimentConfig:
    file.write_text(settings if isinstance(settings, str) else yaml.safe_dump(settings))
    return load_config(file, overrides)


def changed(**changes: Any) -> dict[str, Any]:
    return LEAST | changes


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
    assert (config.estimator.name, config.estimator.ridge, config.estimator.friction) == ("least_squares", 0.0, True)
    assert (config.device, config.overwrite) == ("cpu", False)


def test_noise_by_axis_is_read_back_as_it_was(file: Path) -> None:
    config = load(file, LEAST, "sensors.noise.base_force=[60, 50, 3]", "sensors.noise.base_moment=2")
    assert (config.sensors.noise.base_force, config.sensors.noise.base_moment) == ((60.0, 50.0, 3.0), 2.0)
    file.write_text(dump_config(config))
    assert load_config(file) == config


def test_every_key_of_the_file_arrives(file: Path) -> None:
    config = dataclasses.asdict(load(file, ALL))
    assert config["sensors"].pop("set") is None
    (compared,) = config["analysis"]["compare"].values()
    assert compared.pop("set") is None
    assert compared.pop("ft_sensors") == []
    for name in ("contacts", "preprocessing", "sensors", "actuators", "estimator", "analysis", "device", "overwrite"):
        expected = ALL[name]
        if name == "contacts":
            expected = [{"line_axis": "y"} | contact for contact in expected]
        if name == "estimator":
            expected = dataclasses.asdict(EstimatorConfig()) | expected
        if name == "preprocessing":
            expected = dataclasses.asdict(PreprocessingConfig()) | expected
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


@pytest.mark.parametrize("ridge", [0.0, 1e-300, 0.1, 1.0 / 3.0, 12345678.9, 1e22])
def test_numbers_survive_to_the_last_bit(file: Path, ridge: float) -> None:
    config = load(file, changed(estimator={"ridge": ridge}))
    assert load(file, dump_config(config)).estimator.ridge == ridge


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


def test_an_override_changes_its_key_and_no_other(file: Path) -> None:
    before = dataclasses.asdict(load(file, ALL))
    after = dataclasses.asdict(load(file, ALL, "estimator.ridge=0.25", "sensors.noise.contact_force=9", "device=cpu"))
    before["estimator"]["ridge"], before["sensors"]["noise"]["contact_force"], before["device"] = 0.25, 9.0, "cpu"
    assert after == before


def test_a_mapping_given_empty_clears_that_of_the_file_and_any_other_adds_to_it(file: Path) -> None:
    sensors = load(file, ALL, "sensors.offsets={}", "sensors.scales.contact_force=all").sensors
    assert sensors.offsets == {}
    assert {str(channel): extent for channel, extent in sensors.scales.items()} == {
        "ft_force": "log",
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


def test_an_override_may_add_what_the_file_leaves_out(file: Path) -> None:
    config = load(file, LEAST, "preprocessing.cutoff_hz=8", "contacts=[{frame: sole, type: flat}]", "overwrite=true")
    assert config.preprocessing.cutoff_hz == 8.0
    assert config.contacts[0].frame == "sole"
    assert config.overwrite
    assert load(file, ALL, "preprocessing.cutoff_hz=null").preprocessing.cutoff_hz is None


def test_a_set_of_sensors_is_short_for_a_mapping(file: Path) -> None:
    for name in ("full", "contacts", "joints"):
        assert load(file, changed(sensors=name)) == load(file, changed(sensors={"set": name}))
        assert load(file, LEAST, f"sensors={name}") == load(file, LEAST, f"sensors.set={name}")


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
        (changed(robot="robot.urdf"), "robot", "'robot.urdf'"),
        (changed(robot=None), "robot", "None"),
        (changed(robot={"urdf": "r", "fixed_base": "perhaps"}), "robot.fixed_base", "'perhaps'"),
        (changed(logs={"train": "a.npz"}), "logs.train", "a.npz"),
        (changed(contacts={"frame": "a", "type": "flat"}), "contacts", "a mapping"),
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
        (changed(sensors={"set": "full", "on_base_lost": "ignore"}), "sensors.on_base_lost", "'ignore'"),
        (changed(estimator="least_squares"), "estimator", "'least_squares'"),
        (changed(estimator={"ridge": float("nan")}), "estimator.ridge", "nan"),
        (changed(estimator={"ridge": True}), "estimator.ridge", "True"),
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
        ("preprocessing.contact_margin_s=50ms", "contact_margin_s: found '50ms'; accepted: a number"),
        ("actuators.sign_width=wide", "actuators.sign_width: found 'wide'; accepted: a number"),
        ("estimator.training.epochs=2.5", "estimator.training.epochs: found 2.5; accepted: a whole number"),
        ("overwrite=perhaps", "overwrite: found 'perhaps'; accepted: true or false"),
        ("logs.topics={}", "logs.topics.joint_states: missing; accepted: the name of a topic, or a mapping with topic"),
        ("estimator.symmetry={left: l}", "estimator.symmetry.right: missing; accepted: a name"),
        ("contacts=[{frame: a}]", "contacts.0.type: missing; accepted: point, line, flat"),
        ("estimator.symmetry={}", "symmetry.left, estimator.symmetry.right: missing; accepted: estimator.symmetry.l"),
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
    with pytest.raises(ConfigError, match="YAML: not readable: .*duplicate key output"):
        load(file, yaml.safe_dump(LEAST) + "output: again\n")
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="YAML: not readable"):
        load_config(file)


# ----------------------------------------------------------------------------------------------------------- a descent


def descent(**changes: Any) -> dict[str, Any]:
    """The least experiment that descends, with settings of its training."""
    return changed(estimator={"name": "sgd", "training": changes})


def held_out(**estimator: Any) -> dict[str, Any]:
    return changed(estimator=estimator, logs={"train": ["a.npz"], "validation": ["b.npz"]})


def test_a_descent_has_the_documented_defaults(file: Path) -> None:
    estimator = load(file, changed(estimator={"name": "sgd"})).estimator
    assert (estimator.consistency, estimator.margin) == ("log_cholesky", 1e-4)
    assert dataclasses.asdict(estimator.penalties) == {
        **{"eigenvalue": 10.0, "log_det": 0.0, "mass": 10.0, "friction": 10.0}
    }
    assert dataclasses.asdict(estimator.training) == {
        **{"epochs": 200, "batch_size": 256, "patience": None, "clip": 1.0, "damping": 1.0, "seed": 0},
        **{"optimizer": {"name": "Adam"}, "schedule": {"name": "CosineAnnealingLR"}},
        **{"evaluate_every": 10, "checkpoint_seconds": 5.0},
    }


def test_every_key_of_a_descent_arrives_and_reads_back_as_itself(file: Path, tmp_path: Path) -> None:
    config = load(file, held_out(**DESCENT))
    found = dataclasses.asdict(config.estimator)
    assert {key: found[key] for key in DESCENT} == DESCENT
    assert config.logs.validation == [file.parent / "b.npz"]
    elsewhere = tmp_path / "elsewhere.yaml"
    elsewhere.write_text(dump_config(config))
    assert load_config(elsewhere) == config


def test_every_key_of_a_descent_is_that_of_its_estimator(file: Path) -> None:
    settings = descent_settings(load(file, held_out(**DESCENT)))
    training = DESCENT["training"]
    for key in ("ridge", "rank_tolerance", "margin", "consistency"):
        assert getattr(settings, key) == DESCENT[key]
    for key in ("epochs", "patience", "clip", "damping", "optimizer", "schedule"):
        assert getattr(settings, key) == training[key]
    assert vars(settings.penalties) == DESCENT["penalties"]


def test_a_descent_without_a_schedule_keeps_its_rate(file: Path) -> None:
    config = load(file, descent(schedule=None))
    assert config.estimator.training.schedule is None
    assert descent_settings(config).schedule is None
    assert load(file, LEAST, "estimator.name=sgd", "estimator.training.schedule=null") == config


@pytest.mark.parametrize("rate", ["1e-3", "1E-3", "0.001"])
def test_options_of_an_optimizer_may_be_written_as_people_write_them(file: Path, rate: str) -> None:
    text = yaml.safe_dump(LEAST) + f"estimator: {{name: sgd, training: {{optimizer: {{name: Adam, lr: {rate}}}}}}}\n"
    assert descent_settings(load(file, text)).optimizer == {"name": "Adam", "lr": 1e-3}
    config = load(file, descent(optimizer={"name": "Adam", "lr": 1}), f"estimator.training.optimizer.lr={rate}")
    assert descent_settings(config).optimizer == {"name": "Adam", "lr": 1e-3}


@pytest.mark.parametrize(
    ("estimator", "key", "having"),
    [
        ({"name": "least_squares", "margin": 0.1}, "margin", "consistent or sgd"),
        ({"name": "least_squares", "training": {"epochs": 3}}, "training", "sgd"),
        ({"name": "least_squares", "consistency": "penalties"}, "consistency", "sgd"),
        ({"name": "least_squares", "penalties": {"mass": 1.0}}, "penalties", "sgd"),
        ({"name": "least_squares", "total_mass": 50.0}, "total_mass", "consistent"),
        ({"name": "consistent", "consistency": "penalties"}, "consistency", "sgd"),
        ({"name": "consistent", "training": {"seed": 3}}, "training", "sgd"),
        ({"name": "sgd", "prior": "entropic"}, "prior", "consistent"),
        ({"name": "sgd", "certify": True}, "certify", "consistent"),
        ({"name": "sgd", "com_inside": "box"}, "com_inside", "consistent"),
    ],
    ids=lambda value: value["name"] if isinstance(value, dict) else value,
)
def test_a_key_of_another_estimator_is_refused_by_those_that_have_it(
    file: Path, estimator: dict[str, Any], key: str, having: str
) -> None:
    assert_wrong_value(
        lambda: load(file, changed(estimator=estimator)),
        file,
        f"estimator.{key}",
        f"set, which {estimator['name']} has not; accepted: name: {having}, or no such key",
    )


def test_penalties_of_bodies_that_are_possible_anyway_are_refused(file: Path) -> None:
    estimator = {"name": "sgd", "penalties": {"mass": 1.0}}
    found = "set, which consistency: log_cholesky has not; accepted: consistency: penalties"
    assert_wrong_value(lambda: load(file, changed(estimator=estimator)), file, "estimator.penalties", found)
    assert load(file, changed(estimator=estimator | {"consistency": "penalties"})).estimator.penalties.mass == 1.0


@pytest.mark.parametrize(
    ("settings", "place", "found"),
    [
        (descent(epochs=0), "estimator.training.epochs", "0"),
        (descent(epochs=2.5), "estimator.training.epochs", "2.5"),
        (descent(batch_size=True), "estimator.training.batch_size", "True"),
        (descent(batch_size=0), "estimator.training.batch_size", "0"),
        (descent(patience=0), "estimator.training.patience", "0"),
        (descent(seed=-1), "estimator.training.seed", "-1"),
        (descent(seed=False), "estimator.training.seed", "False"),
        (descent(clip=0.0), "estimator.training.clip", "0.0"),
        (descent(damping=float("inf")), "estimator.training.damping", "inf"),
        (descent(evaluate_every=0), "estimator.training.evaluate_every", "0"),
        (descent(checkpoint_seconds=-1), "estimator.training.checkpoint_seconds", "-1"),
        (descent(optimizer="Adam"), "estimator.training.optimizer", "'Adam'"),
        (descent(optimizer={"lr": 0.1}), "estimator.training.optimizer", "a mapping with the name of a class"),
        (descent(optimizer={"name": 3}), "estimator.training.optimizer", "a mapping with the name of a class"),
        (descent(schedule={"T_max": 3}), "estimator.training.schedule", "a mapping with the name of a class"),
        (changed(estimator={"name": "sgd", "consistency": "hope"}), "estimator.consistency", "'hope'"),
        (changed(estimator={"name": "sgd", "margin": 1.0}), "estimator.margin", "1.0"),
        (changed(estimator={"name": "sgd", "penalties": {"mass": -1.0}}), "estimator.penalties.mass", "-1.0"),
        (changed(estimator={"name": "sgd", "penalties": 3.0}), "estimator.penalties", "3.0"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_setting_of_a_descent_of_the_wrong_kind_is_refused_by_its_place(
    file: Path, settings: Any, place: str, found: str
) -> None:
    assert_wrong_value(lambda: load(file, settings), file, place, found)


@pytest.mark.parametrize(
    ("settings", "place", "name", "nearest"),
    [
        (descent(batchsize=3), "estimator.training", "batchsize", "batch_size"),
        (descent(optimiser={"name": "Adam"}), "estimator.training", "optimiser", "optimizer"),
        (changed(estimator={"penalties": {"eigenvalues": 1.0}}), "estimator.penalties", "eigenvalues", "eigenvalue"),
        (changed(logs={"train": ["a"], "validate": ["b"]}), "logs", "validate", "validation"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_an_unknown_key_of_a_descent_is_refused_by_the_nearest(
    file: Path, settings: Any, place: str, name: str, nearest: str
) -> None:
    assert_unknown_key(lambda: load(file, settings), file, place, name, nearest)


def test_patience_needs_logs_to_hold_out(file: Path) -> None:
    found = "set, without logs to hold out; accepted: logs.validation too"
    assert_wrong_value(lambda: load(file, descent(patience=3)), file, "estimator.training.patience", found)
    assert load(file, held_out(name="sgd", training={"patience": 3})).estimator.training.patience == 3


def test_held_out_logs_are_for_a_descent_and_not_those_that_are_fitted_on(file: Path) -> None:
    for name in ("least_squares", "consistent"):
        found = f"set, which {name} has no use for; accepted: estimator.name: sgd"
        assert_wrong_value(lambda name=name: load(file, held_out(name=name)), file, "logs.validation", found)
    both = held_out(name="sgd") | {"logs": {"train": ["a.npz", "b.npz"], "validation": ["b.npz"]}}
    found = f"{file.parent / 'b.npz'} is fitted on as well; accepted: logs the fit does not see"
    assert_wrong_value(lambda: load(file, both), file, "logs.validation", found)
    both["logs"] = {"train": ["a.npz"], "validation": ["b.npz"], "test": ["b.npz"]}
    with pytest.warns(TorchidWarning, match=r"b\.npz is a reason to stop as well"):
        load(file, both)


def test_what_a_file_leaves_out_is_what_the_estimators_leave_out(file: Path) -> None:
    estimator = load(file, LEAST).estimator
    assert estimator.least_squares == LeastSquares()
    assert estimator.consistent(Conditions()) == Consistent()
    assert descent_settings(load(file, LEAST, "estimator.name=sgd")) == Sgd()


@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_setting_of_an_estimator_is_a_key_or_needs_more_than_a_file(file: Path, name: str) -> None:
    """Conditions need a robot, residual modules are code."""
    needs_more = {"conditions", "residual", "residual_lr", "residual_weight"}
    estimator = load(file, LEAST).estimator
    keys = vars(estimator).keys() | vars(estimator.training).keys()
    assert {field.name for field in dataclasses.fields(ESTIMATORS[name])} - keys <= needs_more
