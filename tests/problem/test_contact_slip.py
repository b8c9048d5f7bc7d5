"""Feet that stand have no velocity at the ground, whatever the robot does; those that are dragged have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stances import Stance, stance
from synthetic import Array
from walking import robot_of

from torchid.logs import Log
from torchid.logs.preprocess import preprocess
from torchid.problem import bind_log
from torchid.problem.contact_slip import Slip, measure_slip

FIRST, LAST = 60, 110
DRAGGED = ((2, FIRST, LAST),)
"""A foot that is lifted and put down elsewhere: with its flag set it slips."""


def measured(
    s: Stance, log: Log, cutoff_hz: float | None = None, known: bool = True, limit: float | None = None
) -> Slip:
    robot, contacts = robot_of(s.machine), s.contacts()
    ready = preprocess(log, cutoff_hz)
    samples = bind_log(ready, robot, contacts)
    if not known:
        ready = replace(ready, base_linear_velocity_world=None)
    return measure_slip(ready, samples, log, robot, contacts, limit, cutoff_hz)


def dragged(name: str = "quadruped", radius: float = 0.0) -> tuple[Stance, Log]:
    s = stance(name, radius=radius, lifts=DRAGGED)
    return s, replace(s.measured, contact_active=np.ones_like(s.measured.contact_active))


@pytest.mark.parametrize("radius", [0.0, 0.03])
@pytest.mark.parametrize("known", [True, False])
def test_feet_that_stand_or_roll_do_not_move_on_the_ground(radius: float, known: bool) -> None:
    """But for the spline's error: 6e-10 m/s, 4e-6 beside a swing, 1.5e-4 where rolling starts."""
    s = stance("quadruped", radius=radius, lifts=DRAGGED)
    slip = measured(s, s.measured, known=known)
    assert slip.relative is not known
    assert slip.checked
    assert np.nanmax(slip.speed) < (3e-4 if radius else 2e-5)
    assert not slip.slips.any()
    assert np.isnan(slip.speed[80 - 2, 2]), "in the air"
    assert str(slip) == ""


def test_a_foot_that_rolls_moves_if_it_is_taken_for_a_point() -> None:
    s = stance("quadruped", radius=0.03)
    ready = preprocess(s.measured)
    points = s.contacts()
    samples = bind_log(ready, robot_of(s.machine), points)
    plain = [replace(contact, radius=0.0) for contact in points]
    slip = measure_slip(ready, samples, s.measured, robot_of(s.machine), plain)
    assert np.nanmax(slip.speed) > 5e-3


@pytest.mark.parametrize("known", [True, False])
def test_a_foot_that_is_dragged_is_found_with_its_name_and_no_other(known: bool) -> None:
    s, log = dragged()
    slip = measured(s, log, known=known)
    slips, time = slip.slips, preprocess(log).time
    speed = true_speed(s, time)
    fast = speed > 1.05 * slip.limits[2]
    assert fast.sum() > 30
    assert slips[fast, 2].mean() >= 0.95
    assert not slips[speed < 0.95 * slip.limits[2], 2].any()
    assert not np.delete(slips, 2, axis=1).any()
    assert str(slip).startswith(f"{slip.frames[2]} in {slips[:, 2].sum()} samples (up to ")


def true_speed(s: Stance, time: Array) -> Array:
    """Of the dragged foot, by the path that it was given: a quintic in the plane and a bump above it."""
    x = np.clip((time * 100.0 - FIRST) / (LAST - FIRST), 0.0, 1.0)
    rate = 100.0 / (LAST - FIRST)
    along = 30.0 * (x * (1.0 - x)) ** 2
    above = 0.03 * 64.0 * 3.0 * (x * (1.0 - x)) ** 2 * (1.0 - 2.0 * x)
    return np.asarray(rate * np.linalg.norm(np.stack([0.03 * along, -0.02 * along, above], axis=1), axis=1))


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("noise", [1e-4, 1e-3])
def test_noise_of_encoders_and_of_the_base_is_no_slip(known: bool, noise: float) -> None:
    """A share of 1 % at most."""
    rng = np.random.default_rng(4)
    s = stance("quadruped", samples=400)
    log = s.measured
    log = replace(
        log,
        joint_position=log.joint_position + noise * rng.standard_normal(log.joint_position.shape),
        base_position_world=log.base_position_world + noise * rng.standard_normal((len(log), 3)),
    )
    for cutoff in (None, 8.0):
        slip = measured(s, log, cutoff, known)
        assert slip.slips.any(axis=1).mean() <= 0.01


def test_what_a_filter_spreads_over_a_landing_is_no_slip() -> None:
    s = stance("quadruped", lifts=DRAGGED, samples=300)
    for known in (True, False):
        assert not measured(s, s.measured, 10.0, known).slips.any()


def test_of_two_feet_that_move_apart_both_count_and_one_alone_is_not_checked() -> None:
    """By the speed at which they do, but for the spline's error where it begins to change."""
    s, log = dragged()
    active = log.contact_active.copy()
    active[:, [0, 1]] = False
    slip = measured(s, replace(log, contact_active=active), known=False)
    assert slip.slips[:, 2].any()
    np.testing.assert_array_equal(slip.slips[:, 2], slip.slips[:, 3])
    for foot in (2, 3):
        np.testing.assert_allclose(slip.speed[:, foot], true_speed(s, preprocess(log).time), rtol=0.0, atol=1e-4)
    active[:, 3] = False
    assert not measured(s, replace(log, contact_active=active), known=False).checked


def test_a_stated_limit_counts() -> None:
    s, log = dragged()
    assert not measured(s, log, limit=10.0).slips.any()
    assert measured(s, log, limit=1e-12).slips[:, 0].any()
