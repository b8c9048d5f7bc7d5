"""Contact sensors zeroed by what they read in the air: offsets come off, and what cannot be zeroed is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from motions import value
from refusals import refused

from torchid.errors import LogError, TorchidWarning
from torchid.logs import Log
from torchid.problem.unloaded_sensors import zero_in_air
from torchid.sensing import Contact

FEET = ("l_foot", "r_foot")
CONTACTS = tuple(Contact(foot, "flat") for foot in FEET)
OFFSET = np.array([[3.0, -20.0, 7.5, 0.5, -0.25, 1.0], [-4.0, 1.0, 60.0, 0.0, 2.0, -0.125]])


def stepping(noise: float = 0.0) -> Log:
    """Two feet that lift in turn for 0.5 s, with wrenches that are 0 in the air but for noise."""
    time, rng = np.arange(400) / 100.0, np.random.default_rng(0)
    active = np.stack([np.mod(time, 2.0) < 1.5, np.mod(time + 1.0, 2.0) < 1.5], axis=1)
    wrench = active[..., None] * rng.normal(50.0, 20.0, (400, 2, 6)) + noise * rng.normal(size=(400, 2, 6))
    fields: dict[str, Any] = {"contact_names": FEET, "contact_active": active, "contact_wrench_local": wrench}
    return Log("x", time, ("hip",), np.zeros((400, 1)), **fields)


def zeroed(log: Log, said: str = "subtracted these offsets") -> Log:
    with pytest.warns(TorchidWarning, match=said):
        return zero_in_air(log, CONTACTS)


@pytest.mark.filterwarnings("ignore:.*are 0 or clamped:torchid.errors.TorchidWarning")
def test_constant_offsets_come_off_exactly_and_are_named() -> None:
    log = stepping()
    drifted = replace(log, contact_wrench_local=value(log.contact_wrench_local) + OFFSET)
    found = zeroed(
        drifted, r"l_foot 3, -20, 7.5 N; l_foot 0.5, -0.25, 1 N m; r_foot -4, 1, 60 N; r_foot 0, 2, -0.125 N m"
    )
    np.testing.assert_allclose(value(found.contact_wrench_local), value(log.contact_wrench_local), rtol=0, atol=1e-12)
    scalar = value(drifted.contact_wrench_local)[..., 2]
    found = zeroed(replace(drifted, contact_wrench_local=None, contact_force_normal=scalar), "r_foot 60 N along the n")
    np.testing.assert_allclose(found.contact_force_normal, value(log.contact_wrench_local)[..., 2], rtol=0, atol=1e-12)


def test_a_plates_offset_comes_off_along_the_worlds_axes() -> None:
    """It is constant about the world's origin, as the plate does not move, whatever a foot does."""
    log = stepping(noise=0.1)
    fields: dict[str, Any] = {"contact_wrench_local": None, "moments_about_world_origin": True}
    drifted = replace(log, **fields, contact_wrench_world=value(log.contact_wrench_local) + OFFSET)
    found, exact = zeroed(drifted), zeroed(log)
    np.testing.assert_allclose(found.contact_wrench_world, value(exact.contact_wrench_local), rtol=0, atol=1e-12)
    assert found.contact_wrench_local is None
    assert found.moments_about_world_origin


def test_the_mean_is_of_readings_away_from_contact_alone() -> None:
    log = stepping(noise=0.1)
    wrench, active = value(log.contact_wrench_local).copy(), value(log.contact_active)
    lifted = np.flatnonzero(~active[:, 0])
    wrench[lifted[:4], 0, 2] += 500.0  # until 40 ms after the foot stood: its load comes off late
    wrench[100, 1, 0] = np.nan  # one reading that got lost
    found = value(zeroed(replace(log, contact_wrench_local=wrench)).contact_wrench_local)
    np.testing.assert_allclose(found[20, 0, 2] - wrench[20, 0, 2], 0.0, atol=0.1)
    assert np.isnan(found[100, 1, 0])
    assert np.isnan(found).sum() == 1


def test_a_channel_that_nobody_measures_and_another_contact_are_left_as_they_are() -> None:
    log = stepping(noise=0.1)
    wrench = value(log.contact_wrench_local) + OFFSET
    wrench[:, :, 3:] = np.nan
    with pytest.warns(TorchidWarning, match="l_foot"):
        found = value(zero_in_air(replace(log, contact_wrench_local=wrench), CONTACTS[:1]).contact_wrench_local)
    np.testing.assert_array_equal(found[:, 1], wrench[:, 1])
    assert np.isnan(found[:, 0, 3:]).all()
    assert abs((wrench - found)[0, 0, :3] - OFFSET[0, :3]).max() < 0.1


def test_readings_that_are_masked_in_the_air_are_said_to_show_no_offset() -> None:
    log = stepping()
    found = zeroed(log, "readings of l_foot, r_foot in the air are 0 or clamped")
    np.testing.assert_array_equal(value(found.contact_wrench_local), value(log.contact_wrench_local))


def test_what_cannot_be_zeroed_is_refused() -> None:
    log = stepping(noise=0.1)
    wrench, active = value(log.contact_wrench_local), value(log.contact_active)

    def said(start: str, **fields: Any) -> str:
        return refused(lambda: zero_in_air(replace(log, **fields), CONTACTS), f"x: {start}", LogError)

    silent = np.where(active[..., None], wrench, np.nan)
    line = said("contact_wrench_local: 0 readings of l_foot in the air", contact_wrench_local=silent)
    assert "at least 16 for preprocessing.zero_in_air" in line
    assert "sensors.offsets" in line
    standing = active.copy()
    standing[:, 1] = True
    said("contact_wrench_local: 0 readings of r_foot in the air", contact_active=standing)
    said("contact_wrench_local: 0 readings of l_foot in the air", contact_active=np.ones_like(active))
    line = said(
        "contact_wrench_world: preprocessing.zero_in_air needs wrenches in the sensor's frame",
        contact_wrench_local=None,
        contact_wrench_world=wrench,
    )
    assert "contact_wrench_point_world or logs.columns.plates" in line
    plate = {"contact_wrench_local": None, "contact_wrench_world": silent, "moments_about_world_origin": True}
    said("contact_wrench_world: 0 readings of l_foot in the air", **plate)
    said("contact_wrench_local: missing", contact_wrench_local=None)
