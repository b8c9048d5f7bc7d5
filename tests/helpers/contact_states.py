"""Bipeds and their contact states."""

from __future__ import annotations

from functools import cache

import pytest
from repository import CONFIGS
from synthetic import G1, load

from torchid.robot import Robot
from torchid.sensing import Contact

BIPED = CONFIGS / "biped.urdf"

BOTH, LEFT, RIGHT, FLIGHT = (True, True), (True, False), (False, True), (False, False)


FEET = {
    "biped": (BIPED, "l_sole", "r_sole"),
    "G1": (G1, "left_ankle_roll_link", "right_ankle_roll_link"),
}


bipeds = pytest.mark.parametrize("name", FEET)


@cache
def biped(name: str) -> tuple[Robot, tuple[Contact, ...]]:
    urdf, *feet = FEET[name]
    return load(urdf), tuple(Contact(foot, "flat") for foot in feet)
