"""Penalties: nothing for bodies that can exist, and for the others what their definition says."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from physical import least_eigenvalues, pseudo, random_bodies
from synthetic import Array
from torch import Tensor

from torchid.estimators import PenaltyWeights
from torchid.estimators.sgd import LEAST_LOGARITHM as LEAST
from torchid.estimators.sgd import penalties
from torchid.problem.linear import parameter_scale

seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=25, deadline=None, derandomize=True)
ALL = PenaltyWeights(eigenvalue=2.0, log_det=0.3, mass=5.0, friction=7.0)
NONE = {"eigenvalue": 0.0, "log_det": 0.0, "mass": 0.0, "friction": 0.0}
SQUARES = ("eigenvalue", "mass", "friction")
MARGIN = 1e-3


def scaled_bodies(rng: np.random.Generator, count: int = 3) -> Array:
    """Possible bodies in units of their scale, (L, 12)."""
    bodies = random_bodies(rng, count)
    return bodies / parameter_scale(bodies)


def broken(rng: np.random.Generator) -> Array:
    """Bodies of any kind, most of them impossible: masses, eigenvalues and friction of both signs."""
    bodies = scaled_bodies(rng)
    return bodies + 10.0 ** rng.uniform(-1.5, 0.5) * rng.normal(size=bodies.shape)


def terms(scaled: Array, weights: PenaltyWeights = ALL, margin: float = MARGIN) -> dict[str, float]:
    """Of all bodies."""
    found = penalties(torch.from_numpy(scaled), torch.arange(len(scaled)), margin, weights)
    return {name: float(x) for name, x in found.items()}


def written_out(scaled: Array, margin: float) -> dict[str, float]:
    """The same in numpy, by definition."""
    values = np.concatenate([np.linalg.eigvalsh(pseudo(body)) for body in scaled]) - margin
    inside = np.maximum(values, LEAST)
    return {
        "eigenvalue": ALL.eigenvalue * float(np.sum(np.minimum(values, 0.0) ** 2)),
        "log_det": -ALL.log_det * float(np.sum(np.log(inside) + (values - inside) / LEAST)),
        "mass": ALL.mass * float(np.sum(np.minimum(scaled[:, 0], 0.0) ** 2)),
        "friction": ALL.friction * float(np.sum(np.minimum(scaled[:, 10:], 0.0) ** 2)),
    }


@few
@given(seed=seeds)
def test_possible_bodies_with_positive_friction_cost_nothing(seed: int) -> None:
    scaled = scaled_bodies(np.random.default_rng(seed))
    margin = 0.5 * least_eigenvalues(scaled, np.ones_like(scaled)).min()
    assert margin > 0.0
    assert terms(scaled, PenaltyWeights(), margin) == {name: 0.0 for name in SQUARES}


@few
@given(seed=seeds, margin=st.sampled_from([0.0, 1e-3, 0.3]))
def test_penalties_are_what_their_definition_says(seed: int, margin: float) -> None:
    rng = np.random.default_rng(seed)
    for scaled in (scaled_bodies(rng), broken(rng)):
        assert terms(scaled, ALL, margin) == pytest.approx(written_out(scaled, margin), rel=1e-10, abs=1e-12)


def test_only_friction_is_asked_of_bodies_whose_inertia_is_not_to_be_possible() -> None:
    scaled = scaled_bodies(np.random.default_rng(0))
    scaled[1] = [-1.0, *[0.5] * 9, -0.1, 0.2]
    found = penalties(torch.from_numpy(scaled), torch.tensor([0, 2]), MARGIN, PenaltyWeights(1.0, 0.0, 1.0, 3.0))
    assert {name: float(x) for name, x in found.items()} == pytest.approx(
        {"eigenvalue": 0.0, "mass": 0.0, "friction": 0.03}
    )


@pytest.mark.parametrize("name", NONE)
def test_terms_of_weight_zero_are_left_out(name: str) -> None:
    scaled = broken(np.random.default_rng(1))
    assert terms(scaled, PenaltyWeights(**NONE)) == {}
    alone = terms(scaled, PenaltyWeights(**NONE | {name: 2.0}))
    assert list(alone) == [name]
    assert alone[name] == pytest.approx(2.0 / getattr(ALL, name) * terms(scaled)[name], rel=1e-12)
    assert set(terms(scaled, PenaltyWeights())) == {"eigenvalue", "mass", "friction"}, "no barrier unless asked for"


@pytest.mark.parametrize("name", NONE)
@pytest.mark.parametrize("seed", range(3))
def test_gradients_are_those_of_finite_differences(name: str, seed: int) -> None:
    scaled = torch.from_numpy(broken(np.random.default_rng(seed)) - 0.3 * (np.arange(12) >= 10)).requires_grad_()
    weights = PenaltyWeights(**NONE | {name: 0.5})
    bodies = torch.arange(3)
    assert torch.autograd.gradcheck(
        lambda x: penalties(x, bodies, MARGIN, weights)[name], (scaled,), rtol=1e-6, atol=1e-6
    )


@few
@given(seed=seeds)
def test_squares_bend_no_more_than_their_curvature_says(seed: int) -> None:
    """A descent's step length rests on it."""
    scaled = torch.from_numpy(broken(np.random.default_rng(seed))[:1])
    weights = PenaltyWeights(eigenvalue=2.0, mass=0.1, friction=0.1)

    def total(x: Tensor) -> Tensor:
        return torch.stack(list(penalties(x[None], torch.tensor([0]), MARGIN, weights).values())).sum()

    H = torch.autograd.functional.hessian(total, scaled[0])
    assert float(torch.linalg.eigvalsh(H)[-1]) <= weights.curvature * (1.0 + 1e-9)


@pytest.mark.parametrize("name", [field.name for field in fields(PenaltyWeights)])
@pytest.mark.parametrize("weight", [-1.0, np.nan, np.inf])
def test_a_weight_that_is_none_is_refused(name: str, weight: float) -> None:
    with pytest.raises(
        ValueError, match=rf"{name}: found {weight}; accepted: (a finite number|greater than or equal to 0)"
    ):
        PenaltyWeights(**{name: weight})
