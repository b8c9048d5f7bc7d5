"""Whoever uses torchid without experiment files gets what `torchid identify` writes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from demo import shortened_demo
from shared_work import differences

import torchid
from torchid.cli import main
from torchid.errors import LogError
from torchid.parameters import PARAMETERS

FEET = ("front_left_foot", "front_right_foot", "rear_left_foot", "rear_right_foot")
OFFSETS = {"joint_torque": "log"}
STATED = ("joint_torque", "contact_force", "contact_moment")


def test_noise_ridge_outliers_and_cross_validation_are_those_of_the_command(tmp_path: Path) -> None:
    folder = shortened_demo(tmp_path / "demo", 400)
    settings = [
        "sensors.set=full",
        "estimator.robust=huber",
        "estimator.ridge=auto",
        "sensors.offsets={joint_torque: log}",
    ]
    assert main(["identify", str(folder / "quadruped.yaml"), *settings, f"output={tmp_path / 'run'}"]) == 0
    written = json.loads((tmp_path / "run" / "metrics.json").read_text())
    bodies = json.loads((tmp_path / "run" / "parameters.json").read_text())["bodies"]

    robot = torchid.load_robot(folder / "quadruped.urdf")
    contacts = [torchid.Contact(foot, "point") for foot in FEET]
    logs = [torchid.bind_log(torchid.preprocess(torchid.read_log(folder / "sway_train.npz"), 8.0), robot, contacts)]
    stated = torchid.SensorNoise(joint_torque=0.1, contact_force=0.5, contact_moment=0.05)

    def fitter(noise: torchid.SensorNoise, ridge: float) -> torchid.LogFitter:
        sensors = torchid.named_sensors("full", robot.n, len(contacts), noise)
        builder = torchid.RowBuilder(robot, contacts, sensors, torchid.ExtraTerms(offsets=OFFSETS))
        return torchid.LogFitter(robot=robot, builder=builder, estimator=torchid.LeastSquares(ridge))

    found = torchid.estimate_noise(logs, fitter(stated, 0.0), STATED)
    assert [(one.group, one.used) for one in found.groups] == [
        (one["group"], one["used"]) for one in written["noise"]["groups"]
    ]
    loss, unregularized = torchid.RobustLoss.named("huber"), fitter(found.noise, 0.0)
    blocks = torchid.split_into_folds(logs, unregularized.builder)
    parts = torchid.compress_in_blocks(blocks, unregularized.builder)
    estimators = [torchid.LeastSquares(ridge) for ridge in written["ridge_selection"]["tried"]]
    choice = torchid.choose_ridge(parts, blocks, unregularized, estimators)
    assert choice.ridge == written["ridge_selection"]["ridge"]
    assert list(choice.mean_square) == written["ridge_selection"]["mean_square"]

    regularized = fitter(found.noise, choice.ridge)
    robust = torchid.fit_robustly(blocks, regularized, loss)
    assert robust.summary.mean_weight == written["robust"]["mean_weight"]
    phi = [[body["identified"][name] for name in PARAMETERS] for body in bodies]
    np.testing.assert_array_equal(robust.fit.estimate.phi, np.ravel(phi))
    compressed = {"first": regularized.fit(parts)}, {"first": regularized.fit(parts), "parts": parts}
    for known in compressed:
        again = torchid.fit_robustly(blocks, regularized, loss, **known)  # type: ignore[arg-type]
        np.testing.assert_array_equal(again.fit.estimate.phi, robust.fit.estimate.phi)


def test_cross_validation_predicts_blocks_that_a_fit_has_not_seen(tmp_path: Path) -> None:
    folder = shortened_demo(tmp_path / "demo", 400)
    assert main(["identify", str(folder / "quadruped.yaml"), f"output={tmp_path / 'run'}"]) == 0
    written = json.loads((tmp_path / "run" / "metrics.json").read_text())

    robot = torchid.load_robot(folder / "quadruped.urdf")
    contacts = [torchid.Contact(foot, "point") for foot in FEET]
    logs = [torchid.bind_log(torchid.preprocess(torchid.read_log(folder / "sway_train.npz"), 8.0), robot, contacts)]

    def fitter_with(noise: torchid.SensorNoise) -> torchid.LogFitter:
        sensors = torchid.named_sensors("joints", robot.n, len(contacts), noise)
        builder = torchid.RowBuilder(robot, contacts, sensors)
        return torchid.LogFitter(robot=robot, builder=builder, estimator=torchid.LeastSquares(1e-3))

    stated = torchid.SensorNoise(joint_torque=0.1, contact_force=0.5, contact_moment=0.05)
    fitter = fitter_with(torchid.estimate_noise(logs, fitter_with(stated), STATED).noise)
    found = torchid.cross_validate(logs, fitter)
    assert found.folds == written["cross_validation"]["folds"]
    for name in ("identified", "nominal"):  # a run's folds are sums of blocks, which round otherwise
        of_run = dict(differences(getattr(found, name).as_dict(), written["cross_validation"][name]))
        assert max(of_run.values()) < 1e-9, of_run

    fit = fitter.fit(torchid.compress_in_blocks(logs, fitter.builder))
    compared = torchid.calibrations(fit, robot, fitter.builder)
    assert compared.identified.calibrate(logs) == logs, "without offsets, readings are what they are"
    np.testing.assert_array_equal(compared.nominal.phi, robot.nominal.ravel())
    with pytest.raises(LogError, match="too few training samples to leave blocks out"):
        torchid.cross_validate([logs[0][:30]], fitter)
