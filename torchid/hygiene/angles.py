"""Joint positions that can only be degrees, by how far and how fast they go."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from torchid.hygiene.finding import CONDEMNED, SUSPICIOUS, Finding
from torchid.logs import Log
from torchid.robot import Robot
from torchid.text import listed

#: Two turns [rad]: a joint with stops goes nowhere near.
TWO_TURNS = 4.0 * np.pi
#: Speed [rad/s] that half of a robot's joints do not exceed: motors of legs reach 20 to 30.
FAST = 40.0
_ADVICE = "convert joint_position, and velocities and accelerations with it, to radians"
_ENDLESS = ("continuous", "prismatic")


def angles(log: Log, robot: Robot | None) -> Iterator[Finding]:
    """Findings about the unit of `joint_position`."""
    bodies = () if robot is None else robot.bodies
    joints = {body.joint.name: body.joint.kind for body in bodies if body.joint is not None}
    columns = [i for i, name in enumerate(log.joint_names) if joints.get(name) not in _ENDLESS]
    if not columns:
        return
    position = log.joint_position[:, columns]
    moved = np.abs(position).max(axis=0) > 0.0
    far = np.abs(position).max(axis=0) > TWO_TURNS
    names = [log.joint_names[columns[i]] for i in np.flatnonzero(far)]
    if far.any():
        text = f"{listed(names)}: up to {np.abs(position).max():.4g}, more than two turns: degrees?"
        certain = 2 * int(far.sum()) >= int(moved.sum())
        severity = CONDEMNED if certain else SUSPICIOUS
        yield Finding("unit", severity, "joint_position", text, _ADVICE, tuple(names))
    elif len(log) > 2:
        speed = np.percentile(np.abs(np.diff(position, axis=0)) / np.diff(log.time)[:, None], 90.0, axis=0)
        if float(np.median(speed)) > FAST:
            text = f"half of the joints faster than {np.median(speed):.3g} rad/s: degrees, or time in another unit?"
            yield Finding("unit", SUSPICIOUS, "joint_position", text, _ADVICE)
