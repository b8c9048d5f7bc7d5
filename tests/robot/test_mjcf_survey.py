"""Models that MuJoCo makes of the URDFs of the package example-robot-data, against MuJoCo."""

from __future__ import annotations

import pytest
from synthetic import ROBOTS

pytest.importorskip("mujoco", reason="MuJoCo, extra [sim]")

from mujoco_oracle import INERTIA_ROUNDING
from survey_mjcf import survey_all


@pytest.mark.skipif(not ROBOTS.is_dir(), reason="the package example-robot-data is not installed")
@pytest.mark.parametrize("every", [22, pytest.param(1, marks=pytest.mark.every_robot)])
def test_models_of_robots_have_the_dynamics_of_mujoco_as_they_are_read_and_written(every: int) -> None:
    """Of all that MuJoCo saves: it refuses bodies without mass, and inertias that no body has."""
    compared = [found for found in survey_all(sorted(ROBOTS.rglob("*.urdf"))[::every]) if found.robot is not None]
    for found in compared:
        assert max(found.inverse_dynamics, found.read_again, found.written) < 1e-12 + INERTIA_ROUNDING, found.name
    assert len(compared) >= 40 // every
