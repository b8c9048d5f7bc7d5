"""What `check` says of feet that slip."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stances import stance
from walking import robot_of

from torchid.log_checks.check import check
from torchid.log_checks.findings import SUSPICIOUS

STANCE = stance("quadruped", lifts=((2, 200, 250),), samples=500)
ROBOT, CONTACTS = robot_of(STANCE.machine), STANCE.contacts()


def test_a_dragged_foot_is_found_with_its_samples_and_advice() -> None:
    log = replace(STANCE.measured, contact_active=np.ones_like(STANCE.measured.contact_active))
    (found,) = [x for x in check(log, ROBOT, CONTACTS).findings if x.name == "slip"]
    assert (found.severity, found.channels) == (SUSPICIOUS, (CONTACTS[2].frame,))
    mask = found.mask(len(log))
    assert mask[205:245].mean() > 0.9
    assert not mask[:195].any()
    assert not mask[255:].any()
    assert "preprocessing.max_slip" in found.advice


def test_flags_that_torchid_made_and_feet_that_stand_are_not_blamed() -> None:
    log = replace(STANCE.measured, contact_active=np.ones_like(STANCE.measured.contact_active))
    assert not [x for x in check(log, ROBOT, CONTACTS, derived=("contact_active",)).findings if x.name == "slip"]
    assert not [x for x in check(STANCE.measured, ROBOT, CONTACTS).findings if x.name == "slip"]


@pytest.mark.parametrize("seed", range(3))
def test_long_tails_of_noise_are_no_slip(seed: int) -> None:
    log = STANCE.measured
    noise = 1e-3 * np.random.default_rng(seed).standard_t(3, size=log.joint_position.shape)  # [rad]
    noisy = replace(log, joint_position=log.joint_position + noise)
    assert not [x for x in check(noisy, ROBOT, CONTACTS).findings if x.name == "slip"]
