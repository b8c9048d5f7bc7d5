"""How a fit is judged: by blocks of the logs that it has not seen."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from repository import DEMO

import torchid
from torchid.cli import main
from torchid.config import load_config
from torchid.fitting.experiment import Experiment, set_up, with_estimated_noise
from torchid.fitting.left_out import (
    RIDGE,
    RIDGES,
    STRONGER,
)
from torchid.logs import read_log
from torchid.logs.preprocess import preprocess
from torchid.problem import (
    RowBuilder,
    Samples,
    bind_log,
    compress,
    linear_problem,
)
from torchid.problem.compression import (
    FOLDS,
    split_into_folds,
)
from torchid.problem.metrics import WHITENED
from torchid.sensing import Contact, SensorNoise, named_sensors

pytestmark = pytest.mark.usefixtures("events")

FEET = [f"{place}_foot" for place in ("front_left", "front_right", "rear_left", "rear_right")]

# ------------------------------------------------------------------------------------------------------------- folds


@pytest.fixture(scope="module")
def demo() -> tuple[RowBuilder, Samples]:
    robot, contacts = torchid.load_robot(DEMO / "quadruped.urdf"), [Contact(foot, "point") for foot in FEET]
    sensors = named_sensors("joints", robot.n, 4, SensorNoise(0.1, 0.5, 0.05))
    log = bind_log(preprocess(read_log(DEMO / "sway_train.npz"), 8.0), robot, contacts, sensors)
    return RowBuilder(robot, contacts, sensors), log


@pytest.mark.parametrize("lengths", [(1250,), (600, 650), (625, 625), (1000, 125, 125), (105,) * 11])
def test_folds_are_contiguous_blocks_that_hold_every_sample_once(
    demo: tuple[RowBuilder, Samples], lengths: tuple[int, ...]
) -> None:
    builder, log = demo
    starts = np.cumsum([0, *lengths])
    logs = [replace(log[a:b], source=f"{a}") for a, b in zip(starts, starts[1:], strict=False)]
    blocks = split_into_folds(logs, builder)
    assert torch.equal(torch.cat([block.time for block in blocks]), torch.cat([one.time for one in logs]))
    folds = [block.fold for block in blocks]
    assert folds == sorted(folds)
    assert set(folds) == set(range(max(folds) + 1)), "without a gap"
    assert FOLDS - 1 <= len(set(folds)) <= FOLDS
    sizes = [sum(len(block) for block in blocks if block.fold == fold) for fold in set(folds)]
    assert max(sizes) <= 2 * min(sizes)
    if len(lengths) > FOLDS:
        assert len(blocks) == len(logs), "whole logs are left out where there are many"


def test_too_few_independent_samples_are_not_cut(demo: tuple[RowBuilder, Samples]) -> None:
    builder, log = demo
    assert [block.fold for block in split_into_folds([log[:200]], builder)] == [0], (
        "200 samples at 100 Hz, filtered at 8 Hz"
    )


# ------------------------------------------------------------------------------------------------------- whole runs


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("runs") / "demo"
    closest = "estimator={name: least_squares, ridge: auto}"
    assert main(["identify", str(DEMO / "quadruped.yaml"), f"output={output}", closest]) == 0
    return output


def with_own_noise(run: Path) -> Experiment:
    """A run's experiment with the noise that it has estimated."""
    used = json.loads((run / "metrics.json").read_text())["noise"]["used"]
    experiment = set_up(load_config(run / "config.yaml"))
    fields = {key: tuple(x.values()) if isinstance(x, dict) else x for key, x in used.items()}
    return with_estimated_noise(experiment, fields, any_stated=False)


def test_cross_validation_is_what_refitting_by_hand_gives(run: Path, demo: tuple[RowBuilder, Samples]) -> None:
    _, log = demo
    metrics, config = json.loads((run / "metrics.json").read_text()), load_config(run / "config.yaml")
    weighed = with_own_noise(run)
    builder = RowBuilder(weighed.robot, weighed.contacts, weighed.sensors)
    robot, blocks, squares, rows = torchid.load_robot(DEMO / "quadruped.urdf"), split_into_folds([log], builder), 0.0, 0
    for fold in range(FOLDS):
        seen = [block for block in blocks if block.fold != fold]
        phi = config.estimator.least_squares.solve(linear_problem(compress(seen, builder), builder, robot)).phi
        (unseen,) = (block for block in blocks if block.fold == fold)
        left = linear_problem(compress([replace(unseen, motion_noise=None)], builder), builder, robot)
        squares, rows = squares + left.cost(phi), rows + left.rows
    found = metrics["cross_validation"]
    assert found["folds"] == FOLDS
    assert found["identified"][WHITENED] == pytest.approx(np.sqrt(squares / rows), rel=1e-6)
    assert found["nominal"][WHITENED] == pytest.approx(metrics["train_nominal"][WHITENED])
    assert metrics["train"][WHITENED] < found["identified"][WHITENED] < 0.2 * found["nominal"][WHITENED]
    assert (metrics["verdict"], metrics["worse_than_nominal"]) == (None, [])


def test_the_ridge_follows_from_the_residuals_unless_left_out_blocks_ask_for_more(run: Path) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    found = metrics["ridge_selection"]
    least = max(RIDGE * metrics["residual_std"] ** 2, RIDGES[0])
    assert found["tried"] == pytest.approx([least * factor for factor in STRONGER], rel=0.1), "of a fit without a ridge"
    error, spread = np.array(found["mean_square"]), np.array(found["standard_error"])
    assert found["ridge"] == found["tried"][int(np.flatnonzero(error - error.min() <= spread)[0])]
    assert yaml.safe_load((run / "config.yaml").read_text())["estimator"]["ridge"] == found["ridge"]


def test_one_standard_error_takes_the_largest_ridge_that_held_out_blocks_cannot_tell_from_the_best(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a grid finer than its decades, on the demo each of which blocks tell from the best."""
    monkeypatch.setattr("torchid.fitting.experiment.RIDGES", tuple(np.geomspace(0.001, 0.1, 9).tolist()))
    larger = "sensors=full", "estimator={name: least_squares, ridge: one_standard_error}", f"output={tmp_path / 'run'}"
    assert main(["identify", str(DEMO / "quadruped.yaml"), *larger]) == 0
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())["ridge_selection"]
    error, spread = np.array(found["mean_square"]), np.array(found["standard_error"])
    chosen, best = found["tried"].index(found["ridge"]), int(error.argmin())
    assert error[chosen] - error[best] <= spread[chosen]
    assert (error - error[best] > spread)[chosen + 1 :].all()
    assert best < chosen < len(error) - 1, "another one than the best, and than the largest tried"
    assert found["rule"] == "one_standard_error"
    assert yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())["estimator"]["ridge"] == found["ridge"]
