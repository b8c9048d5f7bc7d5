"""Settings of a descent in an experiment file."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from experiments import LEAST, changed, load
from refusals import assert_unknown_key, assert_wrong_value

from torchid.commands.training import descent_settings
from torchid.config import dump_config, load_config
from torchid.config.estimator import ESTIMATORS
from torchid.errors import TorchidWarning
from torchid.estimators import Conditions, Consistent, LeastSquares, Sgd

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
        "finish": False,
        "seed": 11,
        "evaluate_every": 4,
        "checkpoint_seconds": 1.5,
    },
}


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
        **{"epochs": 200, "batch_size": 256, "patience": None, "clip": 1.0, "damping": 1.0, "seed": 0, "finish": True},
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


@pytest.mark.parametrize(
    ("estimator", "key", "having"),
    [
        ({"name": "least_squares", "margin": 0.1}, "margin", "consistent or sgd"),
        ({"name": "least_squares", "training": {"epochs": 3}}, "training", "sgd"),
        ({"name": "least_squares", "consistency": "penalties"}, "consistency", "sgd"),
        ({"name": "least_squares", "penalties": {"mass": 1.0}}, "penalties", "sgd"),
        ({"name": "least_squares", "com_inside": "box"}, "com_inside", "consistent or sgd"),
        ({"name": "least_squares", "prior": "entropic"}, "prior", "consistent or sgd"),
        ({"name": "consistent", "consistency": "penalties"}, "consistency", "sgd"),
        ({"name": "consistent", "training": {"seed": 3}}, "training", "sgd"),
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
        f"not used by {estimator['name']}; accepted: name: {having}, or leave it out",
    )


@pytest.mark.parametrize(
    "setting", [{"prior": "pullback"}, {"com_inside": "box"}, {"symmetry": {"left": "l_", "right": "r_"}}]
)
def test_conditions_are_refused_where_violations_are_only_penalized(file: Path, setting: dict[str, Any]) -> None:
    estimator = {"name": "sgd", "consistency": "penalties"} | setting
    found = "not used with consistency: penalties; accepted: consistency: log_cholesky, or leave it out"
    assert_wrong_value(
        lambda: load(file, changed(estimator=estimator)), file, f"estimator.{next(iter(setting))}", found
    )
    (key, value), taken = next(iter(setting.items())), load(file, changed(estimator={"name": "sgd"} | setting))
    assert getattr(taken.estimator, key) == (value if isinstance(value, str) else taken.estimator.symmetry)


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
    found = "needs held-out logs; accepted: logs.validation"
    assert_wrong_value(lambda: load(file, descent(patience=3)), file, "estimator.training.patience", found)
    assert load(file, held_out(name="sgd", training={"patience": 3})).estimator.training.patience == 3


def test_held_out_logs_are_for_a_descent_and_not_those_that_are_fitted_on(file: Path) -> None:
    for name in ("least_squares", "consistent"):
        found = f"not used by {name}; accepted: estimator.name: sgd"
        assert_wrong_value(lambda name=name: load(file, held_out(name=name)), file, "logs.validation", found)
    both = held_out(name="sgd") | {"logs": {"train": ["a.npz", "b.npz"], "validation": ["b.npz"]}}
    found = f"{file.parent / 'b.npz'} is also used for the fit; accepted: logs outside logs.train"
    assert_wrong_value(lambda: load(file, both), file, "logs.validation", found)
    both["logs"] = {"train": ["a.npz"], "validation": ["b.npz"], "test": ["b.npz"]}
    with pytest.warns(TorchidWarning, match=r"b\.npz is also used for early stopping"):
        load(file, both)


def test_what_a_file_leaves_out_is_what_the_estimators_leave_out(file: Path) -> None:
    estimator = load(file, LEAST).estimator
    assert estimator.least_squares == LeastSquares()
    assert estimator.consistent(Conditions()) == Consistent()
    assert descent_settings(load(file, LEAST, "estimator.name=sgd")) == Sgd()


@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_setting_of_an_estimator_is_a_key_or_needs_more_than_a_file(file: Path, name: str) -> None:
    """Conditions need a robot, residual modules are code."""
    needs_more = {"conditions", "residual_lr", "residual_weight"}
    estimator = load(file, LEAST).estimator
    keys = vars(estimator).keys() | vars(estimator.training).keys()
    assert {field.name for field in dataclasses.fields(ESTIMATORS[name])} - keys <= needs_more
