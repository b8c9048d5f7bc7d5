"""The legged robots of the scripts, as parameters of tests."""

from __future__ import annotations

import pytest
from legged.robots import G1, GO2, QUADRUPED

INSTALLED = pytest.mark.skipif(
    not (GO2.available and G1.available), reason="the package example-robot-data is not installed"
)
WALKERS = [
    pytest.param(GO2, id="Go2", marks=INSTALLED),
    pytest.param(G1, id="G1", marks=INSTALLED),
    pytest.param(QUADRUPED, id="quadruped"),
]
