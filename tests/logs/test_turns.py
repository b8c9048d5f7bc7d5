"""Angles that jump by a whole turn are refused where something is derived of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from torchid.errors import LogError
from torchid.logs import Log
from torchid.logs.preprocess import preprocess

TIME = np.arange(1000) / 100.0
ANGLE = np.stack([2.8 + np.sin(TIME), 0.3 * np.sin(2.0 * TIME)], axis=1)
SMOOTH = Log("turns.npz", TIME, ("yaw", "pitch"), ANGLE)
WRAPPED = replace(SMOOTH, joint_position=(ANGLE + np.pi) % (2.0 * np.pi) - np.pi)


@pytest.mark.parametrize("cutoff_hz", [None, 5.0], ids=["differentiated", "filtered"])
def test_an_angle_that_jumps_by_a_whole_turn_is_refused_with_its_joint_and_what_to_write(
    cutoff_hz: float | None,
) -> None:
    told = "joint_position: yaw jumps by a whole turn, 4 times, first at 0.35 s; accepted: .*turn_from"
    with pytest.raises(LogError, match=told):
        preprocess(WRAPPED, cutoff_hz)
    preprocess(SMOOTH, cutoff_hz)


def test_positions_with_recorded_derivatives_may_jump_where_nothing_is_derived() -> None:
    rates = np.zeros_like(ANGLE)
    kept = preprocess(replace(WRAPPED, joint_velocity=rates, joint_acceleration=rates)).joint_position
    np.testing.assert_array_equal(kept, WRAPPED.joint_position)


def test_fast_joints_and_positions_in_degrees_are_no_jumps() -> None:
    fast = replace(SMOOTH, joint_position=6.3 * np.arange(1000)[:, None] * [1.0, -1.0])
    assert len(preprocess(fast, 5.0)) > 0
    assert len(preprocess(replace(SMOOTH, joint_position=np.degrees(ANGLE)), 5.0)) > 0
