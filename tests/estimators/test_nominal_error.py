"""How far bodies are off their file where data speak, and the width of prior that follows from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from physical import random_bodies

from torchid.estimators import Conditions
from torchid.estimators.posterior import Posterior, nominal_error
from torchid.fitting.posterior import FittedPosterior

BODIES, COMBINATIONS = 8, 30
INERTIAL = np.tile(np.arange(12) < 10, BODIES)


def posterior_of_robot(seed: int, width: float, friction: float = 3.0) -> Posterior:
    """Bodies that are off by a width of the pull-back prior; data tell of 30 combinations of their 96 parameters."""
    rng = np.random.default_rng(seed)
    nominal = random_bodies(rng, BODIES).flatten()
    size = nominal.reshape(-1, 12)[:, :1] * 0.1 ** np.array([0, 1, 1, 1, 2, 2, 2, 2, 2, 2])
    scale = np.hstack([size, np.ones((BODIES, 2))]).flatten()
    A = rng.normal(size=(COMBINATIONS, 12 * BODIES)) / scale
    same = (nominal, scale, np.ones(12 * BODIES, dtype=bool), Conditions(), np.zeros(0), np.zeros(0))
    bare = Posterior(A, np.zeros((COMBINATIONS, 0)), np.zeros(COMBINATIONS), *same)
    prior = replace(bare, A=A[:0], D=bare.D[:0], b=bare.b[:0]).conic_problem(1.0)
    unit = np.linalg.solve(prior.root, rng.normal(size=12 * BODIES))
    off = width * (prior.deviations @ unit)
    off[~INERTIAL] = friction * rng.normal(size=(~INERTIAL).sum())
    true = nominal + scale * off
    noise = 0.01
    return replace(bare, A=A / noise, b=A @ true / noise + rng.normal(size=COMBINATIONS))


@pytest.mark.parametrize("width", [0.05, 0.2, 0.6])
def test_error_of_the_file_is_found_whatever_the_friction(width: float) -> None:
    found = [nominal_error(posterior_of_robot(seed, width)) for seed in range(6)]
    values = np.array([one.value for one in found if one is not None])
    assert len(values) == 6
    # 14 combinations are left once those of 16 frictions are gone: each value is sure to 1 / sqrt(28)
    assert np.exp(np.log(values).mean()) == pytest.approx(width, rel=0.2)
    assert {one.prior_is_narrow for one in found if one is not None} == {width > 0.3}


def test_prior_of_the_right_width_is_seldom_called_narrow() -> None:
    found = [nominal_error(posterior_of_robot(seed, 0.2)) for seed in range(100, 160)]
    assert sum(one.clear for one in found if one is not None) <= 1  # one in a thousand


def test_auto_takes_the_width_by_the_data_only_where_they_contradict_the_default() -> None:
    names = tuple(f"body{number}" for number in range(BODIES))

    def fitted(width: float) -> FittedPosterior:
        posterior = posterior_of_robot(3, width)
        return FittedPosterior(posterior=posterior, body_names=names, joint_names=names, extra_names=(), extra_units=())

    wide = fitted(0.6)
    assert wide.nominal_error is not None
    assert wide.prior_error("auto") == wide.nominal_error.value > 0.4
    assert wide.prior_error(0.3) == 0.3
    assert fitted(0.2).prior_error("auto") == 0.2
