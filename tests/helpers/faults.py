"""Faults planted in logs, and what the checks say of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from demo import DEMO
from motions import position, slope, uniform, velocity
from numpy.typing import NDArray

from torchid.log_checks import Checked, Finding
from torchid.log_checks.check import check
from torchid.logs import Log, read_log
from torchid.robot import Robot, load_robot
from torchid.sensing import Contact

FEET = tuple(f"{end}_{side}_foot" for end in ("front", "rear") for side in ("left", "right"))
CONTACTS = tuple(Contact(foot, "point") for foot in FEET)
CUTOFF = 8.0
HERE = 650  # a sample in the middle of the demo's log


@cache
def demo_log() -> Log:
    """The demo's training log, 1300 samples at 100 Hz of a quadruped that lifts each foot twice."""
    return read_log(DEMO / "sway_train.npz")


@cache
def demo_robot() -> Robot:
    """Its robot."""
    return load_robot(DEMO / "quadruped.urdf")


def changed(log: Log, field: str, change: Callable[[NDArray[Any]], None]) -> Log:
    """The log with one array changed in place."""
    array = getattr(log, field).copy()
    change(array)
    fields: dict[str, Any] = {field: array}
    return replace(log, **fields)


def scaled(log: Log, field: str, factor: float) -> Log:
    """The log with one array times a factor."""
    fields: dict[str, Any] = {field: factor * getattr(log, field)}
    return replace(log, **fields)


def moving(samples: int = 2000, noise: float = 1e-4, **fields: Any) -> Log:
    """Three joints on a known path at 500 Hz, read with some noise."""
    time = uniform(samples / 500.0)
    read = position(time) + noise * np.random.default_rng(0).normal(size=(samples, 3))
    return Log("moving.npz", time, ("a", "b", "c"), read, **fields)


def with_rates(log: Log) -> Log:
    """`moving` with the true velocities and accelerations."""
    return replace(log, joint_velocity=velocity(log.time), joint_acceleration=slope(velocity, log.time))


def of_demo(log: Log) -> Checked:
    """What is said of a version of the demo's log, with its robot."""
    return check(log, demo_robot(), CONTACTS, CUTOFF)


def found(checked: Checked, name: str, field: str | None = None) -> list[Finding]:
    """Findings of one name."""
    return [one for one in checked.findings if one.name == name and field in (None, one.field)]


def only(checked: Checked, name: str, field: str | None = None) -> Finding:
    """The one finding of a name."""
    (finding,) = found(checked, name, field)
    return finding


def places(finding: Finding) -> set[tuple[int, int]]:
    """First and last sample of all spans."""
    return {(span.first, span.last) for span in finding.spans}
