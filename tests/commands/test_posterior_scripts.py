"""Posteriors of synthetic robots: samples against long chains, and credible intervals over repeated noise."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from posterior_accuracy import Synthetic, differences, long_run
from posterior_coverage import covered

from torchid.estimators.truncated_gaussian import TruncatedGaussian


@pytest.mark.slow
def test_samples_of_an_arm_have_the_moments_of_long_chains() -> None:
    posterior = Synthetic("UR5", 0).posterior(0)
    sampler = TruncatedGaussian(posterior.conic_problem(0.2), posterior.owners())
    draws = sampler.draw(40_000, torch.Generator().manual_seed(0)).numpy()
    found = differences(draws, long_run(posterior, 0.2, 300, 200))
    assert {name: largest < 0.05 for name, (largest, _) in found.items()} == dict.fromkeys(found, True)


def coverage(robot: str, repetitions: int) -> float:
    one = Synthetic(robot, 0, rough=1.0)
    return float(np.mean([covered(one, number, 0.2).mean() for number in range(repetitions)]))


def test_credible_intervals_hold_the_truth_where_the_data_speak() -> None:
    """Of 8 times 6 combinations, a share that chance alone moves by 3 %."""
    assert coverage("Solo12", 8) > 0.85
