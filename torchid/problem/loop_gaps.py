"""How far the frames of closed loops are apart in a log, which says whether they are the right ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from torchid.errors import LogError
from torchid.parameters import Array
from torchid.regressor.loops import LoopClosures
from torchid.robot import Loop, Robot
from torchid.robot.loops import LOOPS_FIELD

FOLLOW = "; joints of loops follow from others in logs that fit into preprocessing.memory_gb"
"""What helps where a log lacks joints of a robot with loops."""

_CHUNK = 4096  # samples


@dataclass(frozen=True)
class LoopGap:
    """Distance [m] and angle [rad] of a loop's frames over a log, rms and largest; the angle of a point is 0."""

    loop: Loop
    rms: float
    largest: float
    rms_angle: float
    largest_angle: float

    @property
    def is_open(self) -> bool:
        """Whether the frames are farther apart than the loop accepts."""
        return self.rms > self.loop.max_gap or self.rms_angle > self.loop.max_angle

    @property
    def accepted(self) -> str:
        """Up to which distance they count as together."""
        bound = f"rms up to {1e3 * self.loop.max_gap:.3g} mm"
        return bound if self.loop.kind != "weld" else f"{bound} and {np.degrees(self.loop.max_angle):.3g} deg"

    def __str__(self) -> str:
        text = f"rms {1e3 * self.rms:.3g} mm, at most {1e3 * self.largest:.3g} mm"
        if self.loop.kind != "weld":
            return text
        return f"{text}; rms {np.degrees(self.rms_angle):.3g} deg, at most {np.degrees(self.largest_angle):.3g} deg"


def loop_gaps(robot: Robot, joint_position: torch.Tensor) -> list[LoopGap]:
    """The gap of each loop of a robot at joint positions (N, n) [rad or m]."""
    if not robot.loops or not len(joint_position):
        return []
    closures, parts = LoopClosures(robot), list[Array]()
    for start in range(0, len(joint_position), _CHUNK):
        gaps = closures.gaps(joint_position[start : start + _CHUNK].double())
        parts.append(np.array([[x.numpy() for x in gap] for gap in gaps]))
    sizes = np.concatenate(parts, axis=2)  # (loops, 2, N)
    rms, largest = np.sqrt(np.square(sizes).mean(axis=2)), sizes.max(axis=2)
    return [
        LoopGap(loop, float(r[0]), float(x[0]), float(r[1]), float(x[1]))
        for loop, r, x in zip(robot.loops, rms, largest, strict=True)
    ]


def require_closed_loops(source: str, joint_position: torch.Tensor, robot: Robot) -> None:
    """Refuse a log in which the frames of a loop are apart.

    Args:
        source: its file.
        joint_position: (N, n) [rad or m].
        robot: with its loops.

    Raises:
        LogError: names the loop, how far it is open and what is accepted.
    """
    for number, gap in enumerate(loop_gaps(robot, joint_position)):
        if gap.is_open:
            accepted = f"{gap.accepted} (its max_gap, max_angle): frames that coincide, and encoders without an offset"
            found = f"{gap.loop.label} apart by {gap}"
            raise LogError(source, f"{LOOPS_FIELD}[{number}]", found, accepted)
