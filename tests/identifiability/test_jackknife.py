"""Standard errors by the scatter between blocks: those of leaving each out; intervals where residuals are no noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from intervals import FEET, NORMAL, STATES
from scipy import signal, stats
from synthetic import SOLO12, Array, Oracle, load, make_log
from true_robots import true_parameters

from torchid.estimators import LeastSquares
from torchid.fitting.fit import LogFitter
from torchid.identifiability import confounding
from torchid.problem import ExtraTerms, RowBuilder, Samples, bind_log, compress_parts, compression
from torchid.problem.compression import compress_in_blocks, split_into_folds
from torchid.sensing import SensorNoise, named_sensors

NOISE = 0.3


def scene(seconds: int, terms: ExtraTerms | None = None) -> tuple[Samples, LogFitter, Array, np.random.Generator]:
    """Exact random samples of a quadruped on its feet, a fitter of joint torques, and the truth."""
    robot, rng = load(SOLO12), np.random.default_rng(4)
    oracle = Oracle.of(robot)
    oracle.perturb(rng, 0.2)
    log = make_log(oracle, [(foot.frame, 3) for foot in FEET], STATES, seconds, rng)
    sensors = named_sensors("joints", robot.n, 4, SensorNoise(NOISE, 1.0, 0.1))
    fitter = LogFitter(robot=robot, builder=RowBuilder(robot, FEET, sensors, terms), estimator=LeastSquares())
    samples = bind_log(log, robot, FEET)
    mixed = samples[torch.from_numpy(rng.permutation(len(samples)))]  # all contact states in every block
    return replace(mixed, time=samples.time), fitter, true_parameters(oracle, robot).ravel(), rng


def noisy(samples: Samples, noise: Array) -> Samples:
    assert samples.torque is not None
    return replace(samples, torque=samples.torque + torch.from_numpy(noise))


@pytest.mark.parametrize("ridge", [0.0, 0.01])
def test_deviations_are_those_of_leaving_each_block_out(monkeypatch: pytest.MonkeyPatch, ridge: float) -> None:
    monkeypatch.setattr(confounding, "_LEVERAGE", 1.0)
    samples, fitter, true, rng = scene(200)
    exact = noisy(samples, NOISE * rng.normal(size=(len(samples), 12)))
    fitter = replace(fitter, estimator=LeastSquares(ridge))
    parts = compress_in_blocks(split_into_folds([exact], fitter.builder), fitter.builder)
    fit = fitter.fit(parts)
    assert fit.jackknife is not None
    keys = list(dict.fromkeys((part.fold, part.block) for part in parts))
    assert len(keys) == fit.jackknife.blocks == 20
    moved = []
    for key in keys:
        rest = [part for part in parts if (part.fold, part.block) != key]
        share = sum(part.factor.rows for part in rest) / fit.estimate.rows
        kept = replace(fitter, estimator=LeastSquares(ridge / share))  # the same weight of the prior
        moved.append(fit.estimate.phi - kept.solve_problem(kept.build_problem(rest)).estimate.phi)
    factor = np.sqrt(19 / 20) * stats.t.ppf(0.975, 19) / NORMAL
    known = fit.estimate.identifiable
    if not ridge:
        np.testing.assert_allclose(
            fit.jackknife.deviations[:, known], factor * np.array(moved)[:, known], rtol=1e-6, atol=1e-9
        )
        assert fit.jackknife.error_along(np.eye(len(true))[0]) == pytest.approx(fit.jackknife.error[0], rel=1e-9)
    else:  # the prior's bias, which is no scatter, moves with the information left
        ratio = fit.jackknife.error[known] / (factor * np.linalg.norm(np.array(moved)[:, known], axis=0))
        assert 0.7 < np.median(ratio) < 1.1
    assert fit.estimate.block_error is not None
    larger = np.maximum(fit.estimate.noise_error, fit.estimate.block_error)
    kept_error = np.zeros_like(larger) if fit.estimate.kept_error is None else fit.estimate.kept_error
    assert bool(np.nanmax(kept_error) > 0.0) == bool(ridge)
    np.testing.assert_array_equal(fit.estimate.standard_error, np.hypot(larger, kept_error))


def test_extra_parameters_scatter_with_the_blocks_of_their_log() -> None:
    samples, fitter, _, rng = scene(200, ExtraTerms(offsets={"joint_torque": "log"}, armature=True))
    exact = noisy(samples, NOISE * rng.normal(size=(len(samples), 12)))
    half = len(exact) // 2
    logs = [replace(exact[:half], source="a"), replace(exact[half:], source="b")]
    parts = compress_in_blocks(split_into_folds(logs, fitter.builder), fitter.builder)
    fit = fitter.fit(parts)
    keys = list(dict.fromkeys((part.source, part.fold, part.block) for part in parts))
    moved = []
    for key in keys:
        rest = [part for part in parts if (part.source, part.fold, part.block) != key]
        left = fitter.solve_problem(fitter.build_problem(rest))
        assert [(x.log, x.extra.label) for x in left.extras] == [(x.log, x.extra.label) for x in fit.extras]
        moved.append([x.value - y.value for x, y in zip(fit.extras, left.extras, strict=True)])
    factor = np.sqrt((len(keys) - 1) / len(keys)) * stats.t.ppf(0.975, len(keys) - 1) / NORMAL
    expected = factor * np.linalg.norm(moved, axis=0)
    ratio = np.array([x.block_error for x in fit.extras]) / expected
    assert len(ratio) == 12 + 24
    assert 0.7 < ratio.min() <= ratio.max() < 1.1, "how offsets moved with a block shrinks by their own share in it"
    assert [x.standard_error for x in fit.extras] == [max(x.noise_error, x.block_error) for x in fit.extras]


@pytest.mark.parametrize("blocks", [20, 5])
def test_intervals_hold_the_truth_where_errors_of_neighbours_are_alike(
    monkeypatch: pytest.MonkeyPatch, blocks: int
) -> None:
    monkeypatch.setattr(compression, "BLOCKS", blocks)
    once, fitter, true, rng = scene(400)
    slow = once[torch.arange(len(once)).repeat_interleave(8)]  # slow motion, and noise that is as slow
    samples = replace(slow, time=torch.arange(len(slow)) * 0.01)
    held, by_noise, lack = [], [], []
    for _ in range(6):
        noise = signal.lfilter([np.sqrt(1 - 0.9**2)], [1.0, -0.9], rng.normal(size=(len(samples), 12)), axis=0)
        folds = split_into_folds([noisy(samples, NOISE * noise)], fitter.builder)
        fit = fitter.fit(compress_in_blocks(folds, fitter.builder))
        known = fit.estimate.verdict == "identified"
        off = np.abs(fit.estimate.phi - true)[known]
        held.append(off <= NORMAL * fit.estimate.standard_error[known])
        by_noise.append(off <= NORMAL * fit.estimate.noise_error[known])
        assert fit.jackknife is not None
        assert fit.jackknife.blocks == blocks
        lack.append(fit.jackknife.lack_of_fit)
    assert np.concatenate(held).mean() > 0.9
    assert np.concatenate(by_noise).mean() < 0.75
    known_lack = [one for one in lack if one is not None]
    assert len(known_lack) == (6 if blocks == 20 else 0), "five blocks do not tell it from noise"
    assert min(known_lack, default=np.inf) > 3.0


def test_folds_are_blocks_and_without_three_blocks_there_is_no_scatter() -> None:
    samples, fitter, _, rng = scene(200)
    exact = noisy(samples, NOISE * rng.normal(size=(len(samples), 12)))
    folds = split_into_folds([exact], fitter.builder)
    whole = fitter.fit(compress_parts(folds, fitter.builder))
    assert whole.jackknife is not None, "folds are blocks"
    assert whole.jackknife.blocks == 5
    cut = fitter.fit(compress_in_blocks(folds, fitter.builder))
    np.testing.assert_allclose(cut.estimate.phi, whole.estimate.phi, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(cut.estimate.noise_error, whole.estimate.noise_error, rtol=1e-6)
    for count, blocks in ((60, 6), (30, 3), (29, None)):
        short = split_into_folds([exact[:count]], fitter.builder)
        found = fitter.fit(compress_in_blocks(short, fitter.builder)).jackknife
        assert (None if found is None else found.blocks) == blocks


def test_noise_alone_is_no_lack_of_fit() -> None:
    samples, fitter, _, rng = scene(400)
    for _ in range(5):
        log = noisy(samples, NOISE * rng.normal(size=(len(samples), 12)))
        fit = fitter.fit(compress_in_blocks(split_into_folds([log], fitter.builder), fitter.builder))
        assert fit.jackknife is not None
        assert 0.8 < (fit.jackknife.lack_of_fit or 0.0) < 1.25
