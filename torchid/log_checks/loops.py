"""Closed loops of a robot: how far their frames are apart in a log."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from torchid.errors import LogError
from torchid.log_checks.findings import CONDEMNED, NOTE, Finding
from torchid.logs import Log
from torchid.problem.closed_loops import loop_gaps, with_loop_joints
from torchid.robot import Robot


def completed(log: Log, robot: Robot | None) -> tuple[Log, list[Finding]]:
    """The log with joints of loops that follow from the others, see `with_loop_joints`; or the log, and why not."""
    try:
        return with_loop_joints(log, robot), []
    except LogError as error:
        finding = Finding("open loop", CONDEMNED, "joint_position", error.found, f"give {error.accepted}")
        return log, [finding]


def check_loops(log: Log, robot: Robot | None) -> Iterator[Finding]:
    """A finding for each loop, at the joint positions of the log; none where it lacks joints of the robot."""
    if robot is None or not robot.loops or not set(robot.joint_names) <= set(log.joint_names):
        return
    order = [log.joint_names.index(name) for name in robot.joint_names]
    for gap in loop_gaps(robot, torch.from_numpy(log.joint_position[:, order])):
        if gap.is_open:
            advice = f"look for other frames, zeros of encoders or signs; accepted is {gap.accepted}"
            text = f"{gap.loop.label} are apart by {gap}"
            yield Finding("open loop", CONDEMNED, "joint_position", text, advice, gap.loop.frames)
        else:
            text = f"{gap.loop.label} are together up to {gap}"
            yield Finding("closed loop", NOTE, "joint_position", text, f"nothing: accepted is {gap.accepted}")
