"""What tests of the regressor share."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import settings
from hypothesis import strategies as st
from synthetic import Array
from torch import Tensor

from torchid import parameters
from torchid.regressor import Regressor
from torchid.robot import Robot

base_kinds = pytest.mark.parametrize("fixed_base", [False, True], ids=["floating", "bolted"])
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=15, deadline=None, derandomize=True)


def of_robots(*urdfs: Path) -> pytest.MarkDecorator:
    """A test per robot."""
    return pytest.mark.parametrize("urdf", urdfs, ids=lambda path: path.stem)


def tensors(*arrays: Array) -> tuple[Tensor, ...]:
    """Arrays as tensors."""
    return tuple(map(torch.from_numpy, arrays))


def regressor(robot: Robot, *state: Array) -> Array:
    """K, (B, nv, L, 12)."""
    K = Regressor(robot)(*tensors(*state)).numpy()
    return K.reshape(len(state[0]), robot.nv, len(robot.bodies), parameters.PER_BODY)


def assert_close(found: Array, expected: Array, relative: float = 1e-14) -> None:
    """Equal to a share of the largest number."""
    size = np.abs(expected).max(initial=0.0)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=relative * size)
