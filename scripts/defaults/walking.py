"""Legged robots on the ground: in MuJoCo with joints that stick, or along a motion with forces that hold it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from legged.gait import Reference
from legged.robots import Legged, TrueRobot, with_dry_friction
from legged.simulate import prescribed, simulated

from torchid.logs import Log

_LIVELIER = 1.25  # the unseen motion's sway over that of the log
_SWIFTER = 0.85  # and how long its swings take


def true_robot(legged: Legged, urdf: Path, seed: int, integrator: str | None, time_constant: float) -> TrueRobot:
    """The robot of the true URDF; friction and armature are drawn; with `integrator` in MuJoCo's own terms."""
    true = TrueRobot.unlike_its_urdf(replace(legged, urdf=urdf), seed, share=0.0)
    return true if integrator is None else with_dry_friction(true, integrator, time_constant)


def walked(true: TrueRobot, seconds: float, seed: int, unseen: bool) -> Log:
    """What happens in one log; an unseen one has other steps, faster, and sways more.

    Raises:
        ValueError: the robot falls, or its feet are out of reach.
    """
    if unseen:
        legged = true.legged
        other = replace(legged, sway=_LIVELIER * legged.sway, swing=_SWIFTER * legged.swing, hop=legged.hop)
        true = replace(true, legged=other)
    reference = Reference(true, seconds, seed, static=not true.dry)
    exact = simulated(true, reference, seconds) if true.dry else prescribed(true, reference, seconds)
    return exact.log
