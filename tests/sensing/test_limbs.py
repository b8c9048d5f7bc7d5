"""Bases that are worked out limb by limb are those of the decomposition of all limbs together."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchid.sensing.limbs import BASE, limb_null_space
from torchid.sensing.projection import whitened_null_space

SAMPLES = 40
FEET = {"point feet": (3, 3, 3, 3), "flat feet": (6, 6), "one of each": (6, 3), "a foot alone": (3,)}


def random_limbs(sizes: tuple[int, ...], measured: int) -> tuple[list[Tensor], list[Tensor], Tensor, Tensor]:
    """Rows of limbs and where their joints are, rows of all limbs together, and measured rows, (k, m, B)."""
    rng = torch.Generator().manual_seed(sum(sizes) + measured)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, SAMPLES, generator=rng, dtype=torch.float64)

    limbs = [normal(k, BASE + k) for k in sizes]
    places = list(torch.randperm(sum(sizes), generator=rng).split(sizes))
    A, start = torch.zeros(sum(sizes), BASE + sum(sizes), SAMPLES, dtype=torch.float64), 0
    for limb, place in zip(limbs, places, strict=True):
        limb[:, BASE:] += 4.0 * torch.eye(len(limb), dtype=torch.float64)[..., None]
        A[start : start + len(limb), :BASE] = limb[:, :BASE]
        A[start : start + len(limb), BASE + place] = limb[:, BASE:]
        start += len(limb)
    return limbs, places, A, normal(measured, A.shape[1])


def noise(m: int, measured: int) -> tuple[Tensor, Tensor]:
    return torch.linspace(0.5, 2.0, m, dtype=torch.float64), torch.linspace(1.0, 3.0, measured, dtype=torch.float64)


@pytest.mark.parametrize("with_axes", [False, True])
@pytest.mark.parametrize("measured", [0, 4])
@pytest.mark.parametrize("feet", FEET)
def test_they_span_the_same_space_under_the_same_noise(feet: str, measured: int, with_axes: bool) -> None:
    limbs, places, A, J_m = random_limbs(FEET[feet], measured)
    row_std, wrench_std = noise(A.shape[1], measured)
    rng = torch.Generator().manual_seed(5)
    turned = torch.linalg.qr(torch.randn(SAMPLES, 3, 3, generator=rng, dtype=torch.float64)).Q
    axes = turned if with_axes else None
    W, suspect = limb_null_space(limbs, places, row_std, J_m, wrench_std, axes)
    assert not suspect.any()
    assert not W[3:6, :3].any(), "no moment of the base in the first three"
    W = W.permute(2, 0, 1)
    batch_first = [x.permute(2, 0, 1) for x in (A, J_m)]
    ((_, expected),) = whitened_null_space(batch_first[0], row_std, batch_first[1], wrench_std, axes)
    torch.testing.assert_close(W @ W.mT, expected @ expected.mT, rtol=0.0, atol=1e-13)
    assert (batch_first[0] @ W).abs().max() < 1e-13


def test_a_straight_leg_is_left_to_the_general_way() -> None:
    limbs, places, A, J_m = random_limbs((3, 3), 0)
    limbs[1][:, BASE + 2, 7] = limbs[1][:, BASE + 1, 7]  # two joints with one effect
    limbs[0][:, BASE:, 9] = 0.0
    limbs[0][:, BASE + 1, 11] = limbs[0][:, BASE, 11] + 1e-7
    row_std, wrench_std = noise(A.shape[1], 0)
    W, suspect = limb_null_space(limbs, places, row_std, J_m, wrench_std)
    assert torch.nonzero(suspect)[:, 0].tolist() == [7, 9, 11]
    assert W[..., ~suspect].isfinite().all()


def test_noise_stays_white_to_rounding_where_a_leg_is_nearly_straight() -> None:
    """A Cholesky factor of the covariance squares its condition: 1e-12 here."""
    limbs, places, A, J_m = random_limbs((3, 3, 3), 0)
    for limb in limbs:
        limb[:, BASE + 2] = limb[:, BASE + 1] + 0.05 * limb[:, BASE + 2]
    row_std, wrench_std = noise(A.shape[1], 0)
    W, suspect = limb_null_space(limbs, places, row_std, J_m, wrench_std)
    white = (row_std[:, None, None] * W)[..., ~suspect].permute(2, 0, 1)
    assert (~suspect).sum() > SAMPLES // 2
    identity = torch.eye(6, dtype=W.dtype).expand(len(white), 6, 6)
    torch.testing.assert_close(white.mT @ white, identity, rtol=0.0, atol=3e-14)
