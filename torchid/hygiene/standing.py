"""Feet that stand must not move: what of positions, orientation and flags makes them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch

from torchid.hygiene.channels import median_step
from torchid.hygiene.finding import CONDEMNED, Finding, Skipped, spans_of
from torchid.hygiene.mistakes import Mistake, mistakes
from torchid.logs import Log
from torchid.logs.fields import FloatArray
from torchid.logs.quaternion import rotate
from torchid.robot import Robot
from torchid.sensing import Contact

#: Motion of standing feet, in that of the base above them, from which on mistakes are tried; soft soles and feet that
#: roll leave 0.05 to 0.2.
MOVES = 0.3
#: Share of it that a mistake must leave to be the explanation.
BETTER = 1.0 / 3.0
#: Time [s] at either end of a stance that heel and toe take, and the shortest stance that is left to be judged.
_ENDS, _SHORTEST = 0.05, 0.15
#: Samples looked at, and how much the base must move above its feet [rad, and 0.3 m] for anything to be told.
_SAMPLES, _STILL = 1500, 0.01
_LENGTH = 0.3
_FIELDS = ("joint_names", "joint_position", "base_quat_xyzw", "contact_names", "contact_active")
_NAME = "feet that stand"


def standing(log: Log, robot: Robot | None, contacts: Sequence[Contact]) -> Iterator[Finding | Skipped]:
    """Findings about what moves feet whose flag says that they stand."""
    if robot is None or not contacts or robot.fixed_base:
        return
    log = _thinned(log)
    moves = slip(log, robot, contacts)
    if moves is None:
        yield Skipped(_NAME, "no orientation of the base, or no stance above which the base moves")
        return
    if moves < MOVES:
        return
    best, least = None, BETTER * moves
    for mistake in mistakes(log):
        if mistake.field in _FIELDS and (found := _after(mistake, log, robot, contacts)) is not None and found < least:
            best, least = mistake, found
    if best is not None:
        share = (
            f"standing feet move {100 * moves:.3g} % as much as the base above them, {100 * least:.2g} % once corrected"
        )
        yield Finding("unit, sign or frame", CONDEMNED, best.field, f"{best.found}: {share}", best.advice)


def _after(mistake: Mistake, log: Log, robot: Robot, contacts: Sequence[Contact]) -> float | None:
    return slip(mistake.mended(log), robot, contacts)


def _thinned(log: Log) -> Log:
    """Evenly spread samples."""
    every = max(1, len(log) // _SAMPLES)
    return log.select(slice(None, None, every))


def slip(log: Log, robot: Robot, contacts: Sequence[Contact]) -> float | None:
    """How much standing feet move in the world, in how much they move in the base; None where nothing can be told.

    Feet that are flat must not turn, feet that stand together keep what lies between them, and where the base's
    position is known, each stays where it is.
    """
    feet = [c for c in contacts if c.frame in log.contact_names and c.frame in robot.links]
    if log.base_quat_xyzw is None or log.contact_active is None or set(log.joint_names) != set(robot.joint_names):
        return None
    order = [log.joint_names.index(name) for name in robot.joint_names]
    poses = robot.link_poses(torch.from_numpy(log.joint_position[:, order]))
    active = {c.frame: log.contact_active[:, log.contact_names.index(c.frame)] for c in feet}
    moved: list[tuple[float, float, int]] = []
    for i, foot in enumerate(feet):
        T = poses[foot.frame].numpy()
        if foot.kind == "flat":
            for axis in range(3):
                moved += _motion(log, T[:, :3, axis], active[foot.frame], 1.0)
        if log.base_position_world is not None:
            moved += _motion(log, T[:, :3, 3], active[foot.frame], _LENGTH, log.base_position_world)
        for other in feet[i + 1 :]:
            between = T[:, :3, 3] - poses[other.frame].numpy()[:, :3, 3]
            moved += _motion(log, between, active[foot.frame] & active[other.frame], _LENGTH)
    world, base, samples = np.array(moved).reshape(-1, 3).sum(axis=0) if moved else (0.0, 0.0, 0)
    if not samples or base / samples < _STILL**2:
        return None
    return float(np.sqrt(world / base))


def _motion(
    log: Log, vector: FloatArray, active: np.ndarray, unit: float, origin: FloatArray | None = None
) -> list[tuple[float, float, int]]:
    """Squares of what a vector of the base moves by within each stance, in the world and in the base; samples."""
    step = median_step(log)
    ends, shortest = round(_ENDS / step), max(4, round(_SHORTEST / step))
    quat = log.base_quat_xyzw
    out = []
    for span in spans_of(active) if quat is not None else ():
        here = slice(span.first + ends, span.last + 1 - ends)
        if quat is None or here.stop - here.start < shortest:
            continue
        world = rotate(quat[here], vector[here]) + (0.0 if origin is None else origin[here])
        seen, known = (np.square((x - x.mean(axis=0)) / unit).sum() for x in (world, vector[here]))
        out.append((float(seen), float(known), here.stop - here.start))
    return out
