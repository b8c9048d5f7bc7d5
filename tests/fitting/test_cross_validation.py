"""How a fit is judged: by blocks of the logs that it has not seen."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from repository import DEMO
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import torchid
from torchid.cli import main
from torchid.config import load_config
from torchid.fitting.cross_validation import (
    RIDGES,
    STRONGER,
    RidgeChoice,
    Scorer,
    TrainingScore,
    calibrations_without_folds,
)
from torchid.fitting.experiment import Experiment, set_up, with_estimated_noise
from torchid.fitting.left_out import RIDGE
from torchid.logs import read_log
from torchid.logs.preprocess import preprocess
from torchid.problem import (
    Metrics,
    RowBuilder,
    Samples,
    bind_log,
    compress,
    compress_parts,
    linear_problem,
)
from torchid.problem.chunks import chunks_by_state, map_chunks
from torchid.problem.compression import (
    FOLDS,
    compress_in_blocks,
    compress_in_folds,
    cut_into_blocks,
    merge_blocks_of_folds,
    merge_folds,
    merge_states,
    split_into_folds,
)
from torchid.problem.metrics import ROW_GROUPS, WHITENED, Evaluation, ForceSums, describe_worse, worse_than_nominal
from torchid.report.figures import ridge_figure
from torchid.sensing import Contact, SensorNoise, named_sensors

pytestmark = pytest.mark.usefixtures("events")

FEET = [f"{place}_foot" for place in ("front_left", "front_right", "rear_left", "rear_right")]
UNPHYSICAL = "ignore:identified.urdf:torchid.errors.TorchidWarning"

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


def test_parts_of_folds_together_are_those_of_the_logs(demo: tuple[RowBuilder, Samples]) -> None:
    builder, log = demo
    parts = compress_parts(split_into_folds([log], builder), builder)
    whole = merge_folds(parts, builder)
    by_state = {part.state: part for part in compress_parts([log], builder)}
    assert {part.state for part in whole} == set(by_state)
    for part in whole:
        R, expected = (x.factor.triangle() for x in (part, by_state[part.state]))
        assert (part.samples, part.factor.rows) == (by_state[part.state].samples, by_state[part.state].factor.rows)
        assert torch.allclose(R.T @ R, expected.T @ expected, rtol=0.0, atol=1e-12 * float(expected.norm() ** 2))
    assert [part.fold for part in merge_states(parts, builder)] == list(range(FOLDS))
    folds = split_into_folds([log], builder)
    cut = {part.key: part for part in compress_parts(cut_into_blocks(folds, builder), builder)}
    blocks = compress_in_blocks(folds, builder)
    assert {part.key for part in blocks} == set(cut)
    assert len({(part.fold, part.block) for part in blocks}) > FOLDS, "rows of several blocks are made at once"
    for part in blocks:
        R, expected = (x.factor.triangle() for x in (part, cut[part.key]))
        assert (part.samples, part.factor.rows) == (cut[part.key].samples, cut[part.key].factor.rows)
        assert part.factor.independent_rows == pytest.approx(cut[part.key].factor.independent_rows)
        assert torch.allclose(R.T @ R, expected.T @ expected, rtol=0.0, atol=1e-12 * float(expected.norm() ** 2))
    of_blocks = {part.key: part for part in merge_blocks_of_folds(blocks, builder)}
    without_blocks = compress_in_folds(folds, builder)
    assert {part.key for part in without_blocks} == set(of_blocks)
    for part in without_blocks:
        expected = of_blocks[part.key]
        for one, other in (
            (
                part.factor.triangle().T @ part.factor.triangle(),
                expected.factor.triangle().T @ expected.factor.triangle(),
            ),
            (part.factor.whole_noise_gram(), expected.factor.whole_noise_gram()),
        ):
            assert other.any()
            assert torch.allclose(one, other, rtol=0.0, atol=1e-12 * float(expected.factor.triangle().norm() ** 2))


def test_small_chunks_of_folds_are_joined_and_each_keeps_its_parameters(demo: tuple[RowBuilder, Samples]) -> None:
    builder, log = demo
    robot, states = torchid.load_robot(DEMO / "quadruped.urdf"), [state for state, _ in chunks_by_state(log)]
    folds = split_into_folds([log], builder)
    loaded = [replace(fold, unloaded=None) for fold in folds]
    (made,) = map_chunks(loaded, builder, list, threads=1)
    assert sorted(state for _, state in made) == sorted(states), "one chunk for all folds"
    assert sum(len(samples) for samples, _ in made) == len(log)
    strangers = [replace(fold, source=f"{fold.fold}") for fold in loaded]
    for others in (strangers, folds):  # other logs, and readings in the air, of which each fold has equations
        assert len(map_chunks(others, builder, list, threads=1)[0]) == sum(len(list(chunks_by_state(x))) for x in folds)
    evaluation, nominal = Evaluation(robot, builder.contacts), robot.nominal.flatten()
    phi = {fold: np.stack([nominal, (1.0 + 0.1 * fold) * nominal]) for fold in range(FOLDS)}
    together = evaluation.force_sums(folds, phi)
    apart = [ForceSums.total(same) for same in zip(*(evaluation.force_sums([x], phi) for x in folds), strict=True)]
    for one, other in zip(together, apart, strict=True):
        assert np.allclose(one.rows.squares, other.rows.squares, rtol=1e-13)
        assert np.array_equal(one.rows.count, other.rows.count)
        assert np.allclose(one.projected.squares, other.projected.squares, rtol=1e-13)
    assert not np.allclose(together[1].rows.squares, together[2].rows.squares, rtol=0.01)


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


def test_of_long_training_logs_every_kth_sample_is_scored(
    run: Path, demo: tuple[RowBuilder, Samples], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, log = demo
    experiment = with_own_noise(run)
    builder, evaluation = experiment.builder(experiment.sensors), experiment.evaluation()
    fitter, blocks = experiment.fitter(builder, experiment.conditions()), split_into_folds([log], builder)
    fit = fitter.fit(compress_in_blocks(blocks, builder))
    compared, without = experiment.calibrations(fit, builder), calibrations_without_folds(fit, fitter)
    parts = merge_states(fit.parts, builder)

    def score(most: int) -> TrainingScore:
        done: list[int] = []
        scorer = Scorer(evaluation, builder, most)
        found = scorer.score_training(blocks, parts, compared, without, done.append)
        assert sum(done) == found.samples == scorer.scored(blocks)[1] <= most
        return found

    whole, thinned = score(len(log)), score(len(log) // 3)
    assert (whole.samples, thinned.samples) == (len(log), sum(len(block[::4]) for block in blocks))
    assert Scorer(evaluation, builder).scored(blocks) == (1, len(log)), "short logs are scored whole"
    assert whole.metrics.identified.as_dict() == json.loads((run / "metrics.json").read_text())["train"]

    monkeypatch.setattr("torchid.fitting.cross_validation.ENOUGH_SCORED", len(log) // 3)
    alike, independent = score(len(log)), [replace(block, oversampling=1.0) for block in blocks]
    assert alike.samples == sum(len(block[::3]) for block in blocks), "fewer than independent ones are left out"
    assert Scorer(evaluation, builder).scored(independent) == (1, len(log)), "of a log without filter all"
    monkeypatch.setattr("torchid.fitting.cross_validation.ENOUGH_SCORED", 1)
    step = Scorer(evaluation, builder).scored(blocks)[0]
    assert step == int(log.oversampling) == 6, "the filter's band is left"

    def metrics(of: TrainingScore) -> list[Metrics]:
        assert of.cross_validation is not None
        return [*of.metrics, of.cross_validation.identified, of.cross_validation.nominal]

    for few, off in (thinned, 0.02), (alike, 0.003):
        for every, some in zip(metrics(whole), metrics(few), strict=True):
            assert some.rms[WHITENED] == every.rms[WHITENED], "of all samples"
            for group in ROW_GROUPS:
                assert some.rms[group] != every.rms[group]
                assert some.rms[group] == pytest.approx(every.rms[group], rel=off), group


@pytest.mark.parametrize(
    ("lengths", "most", "step"), [((10, 10), 20, 1), ((10, 10), 19, 2), ((7, 7), 7, 3), ((5, 1, 1), 2, 5), ((), 3, 1)]
)
def test_the_step_between_scored_samples_is_the_least_that_keeps_to_the_limit(
    run: Path, demo: tuple[RowBuilder, Samples], lengths: tuple[int, ...], most: int, step: int
) -> None:
    builder, log = demo
    scorer = Scorer(set_up(load_config(run / "config.yaml")).evaluation(), builder, most)
    logs = [log[:length] for length in lengths]
    assert scorer.scored(logs) == (step, sum(len(one[::step]) for one in logs))


def test_the_number_of_scored_samples_is_stated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Scorer.__init__, "__defaults__", (500,))
    settings = ["estimator.ridge=0.001", f"output={tmp_path / 'run'}"]
    assert main(["identify", "--verbose", str(DEMO / "quadruped.yaml"), *settings]) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    evaluated = metrics["evaluated_samples"]
    assert 400 < evaluated["train"] <= 500 < metrics["samples"]
    assert evaluated["test"] > 500, "unseen logs are evaluated whole"
    stated = f"errors of forces of {evaluated['train']} of {metrics['samples']} samples"
    assert stated in capsys.readouterr().out


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


def test_tensorboard_and_a_figure_have_the_error_of_every_ridge(run: Path) -> None:
    found = json.loads((run / "metrics.json").read_text())["ridge_selection"]
    events = EventAccumulator(str(run))
    events.Reload()
    steps = [round(float(np.log10(ridge))) for ridge in found["tried"]]
    for tag, values in (("mean_square", found["mean_square"]), ("standard_error", found["standard_error"])):
        curve = {one.step: one.value for one in events.Scalars(f"ridge/held_out_{tag}")}
        assert curve == pytest.approx(dict(zip(steps, values, strict=True)), rel=1e-6)
    assert any(re.fullmatch(r"figure_\d+_ridge", tag) for tag in events.Tags()["images"])
    assert (run / "ridge.png").is_file()


def test_the_figure_marks_the_chosen_ridge_and_those_as_good_as_the_best() -> None:
    tried = (0.0, 0.001, 0.01, 0.1, 1.0)
    choice = RidgeChoice(0.1, tried, (2.2, 2.0, 2.1, 2.3, 3.0), (0.1, 0.0, 0.2, 0.3, 0.4), "one_standard_error")
    axes = ridge_figure(choice).axes[0]
    curve, least, chosen = axes.get_lines()
    np.testing.assert_array_equal(curve.get_xdata(), tried[1:])
    np.testing.assert_array_equal(curve.get_ydata(), choice.mean_square[1:])
    assert np.ravel(least.get_ydata())[0] == 2.0
    assert (float(np.ravel(chosen.get_xdata())[0]), float(np.ravel(chosen.get_ydata())[0])) == (0.1, 2.3)
    (shaded,) = [patch for patch in axes.patches if patch.get_zorder() == 0]
    x = shaded.get_window_extent().transformed(axes.transData.inverted())
    assert 1e-4 < x.x0 < 1e-3
    assert 0.1 < x.x1 < 1.0
    assert axes.get_xscale() == "log"
    (legend,) = axes.figure.legends
    assert "chosen, the largest of these: 0.1, 2.3" in [text.get_text() for text in legend.get_texts()]
    assert "[" in axes.get_xlabel()
    assert "[" in axes.get_ylabel()


def test_evaluate_and_tensorboard_have_the_whitened_projected_residual(run: Path) -> None:
    assert main(["evaluate", str(run), "--log", str(DEMO / "sway_test.npz")]) == 0
    metrics = json.loads((run / "metrics.json").read_text())
    found = json.loads((run / "evaluation" / "sway_test" / "metrics.json").read_text())["sway_test"]
    assert found["identified"][WHITENED] == pytest.approx(metrics["test"][WHITENED])
    assert found["nominal"][WHITENED] == pytest.approx(metrics["test_nominal"][WHITENED])
    events = EventAccumulator(str(run))
    events.Reload()
    scalars = [x for of in ("_nominal", "") for x in events.Scalars(f"error_rms_left_out{of}/{WHITENED}")]
    cross = json.loads((run / "metrics.json").read_text())["cross_validation"]
    assert [x.value for x in scalars] == pytest.approx([cross[x][WHITENED] for x in ("nominal", "identified")])
    assert "answer/text_summary" in events.Tags()["tensors"]


# ---------------------------------------------------------------------------------------------------------- the verdict


def metrics_of(rms: float, measured: float, group: str = "base_force") -> Metrics:
    values: dict[str, float | None] = dict.fromkeys([*ROW_GROUPS, WHITENED])
    return Metrics({**values, group: rms}, {**values, group: rms / measured if rms else 0.0}, {}, {}, None)


@pytest.mark.parametrize(
    ("nominal", "identified", "worse"),
    [
        (1.0, 1.2, True),
        (1.0, 1.04, False),
        (1.0, 0.5, False),
        (0.0, 1e-9, False),
        (1e-12, 1e-10, False),
        (0.0, 1, True),
    ],
)
def test_worse_is_clearly_larger_and_no_rounding(nominal: float, identified: float, worse: bool) -> None:
    found = worse_than_nominal({"test": (metrics_of(nominal, 100.0), metrics_of(identified, 100.0))})
    assert bool(found) is worse
    assert (describe_worse(found, "URDF") is None) is not worse


def test_a_sensor_in_a_limb_that_the_urdf_predicts_better_counts() -> None:
    nominal, identified = (
        replace(metrics_of(1.0, 100.0), limb_rms={"ft_force": x}, limb_relative={"ft_force": x / 118.0})
        for x in (9.0, 87.7)
    )
    (found,) = worse_than_nominal({"test logs": (nominal, identified)})
    assert (found.group, str(found)) == ("ft_force", "force in limbs 87.7 against 9 N")


def test_what_was_not_measured_is_not_judged() -> None:
    nothing = Metrics(dict.fromkeys(ROW_GROUPS), dict.fromkeys(ROW_GROUPS), {}, {}, None)
    assert worse_than_nominal({"test": (nothing, nothing)}) == []
