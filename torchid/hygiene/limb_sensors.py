"""Force/torque sensors in limbs while nothing beyond them touches: there they read what hangs on them, and no more."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from torchid.errors import InputError
from torchid.hygiene.finding import CONDEMNED, NOTE, SUSPICIOUS, Finding, Skipped
from torchid.hygiene.model import COMPARED, bound, filtered, usual_cutoff
from torchid.hygiene.neighbours import NORMAL
from torchid.hygiene.touching import UNLOADED
from torchid.hygiene.weight import GRAVITY, WRONG
from torchid.logs import Log
from torchid.logs.fields import FloatArray
from torchid.problem import RowBuilder
from torchid.problem.predict import force_series
from torchid.robot import Robot
from torchid.sensing import Contact, named_sensors

#: Samples in the air that it takes.
_FEW = 20
#: Correlation from which on the weight beyond a sensor is told from its offset: the limb must turn against gravity.
_CLEAR = 0.9
_NAME = "limb sensors in the air"


def limb_sensors(
    log: Log, robot: Robot | None, contacts: Sequence[Contact], cutoff_hz: float | None
) -> Iterator[Finding | Skipped]:
    """Findings about the forces that limb sensors read in the air; `cutoff_hz` as in `forces`."""
    if robot is None or log.ft_wrench is None:
        return
    try:
        parts = bound(filtered(log, cutoff_hz or usual_cutoff(log)), robot, contacts, 4 * COMPARED)
    except InputError:  # said by `forces`
        return
    builder = RowBuilder(robot, contacts, named_sensors("joints", robot.n, len(contacts), ft=len(robot.ft_names)))
    series = [force_series(builder, part, robot.nominal.flatten()[None]) for part in parts]
    active = np.concatenate([part.active.numpy() for part in parts])
    for number, name in enumerate(robot.ft_names):
        if name not in log.ft_names:
            continue
        force = slice(robot.base_rows + robot.n + 6 * number, robot.base_rows + robot.n + 6 * number + 3)
        read, carried = (np.concatenate([s[i][..., force].reshape(-1, 3) for s in series]) for i in (0, 1))
        beyond = _contacts_beyond(robot, contacts, name)
        air = ~active[:, beyond].any(axis=1) & np.isfinite(read).all(axis=1)
        if not beyond and not robot.fixed_base and not contacts:
            yield Skipped(_NAME, "no contacts, of which one might be beyond a sensor")
        elif air.sum() < _FEW:
            yield Skipped(_NAME, f"{name}: no readings throughout while nothing beyond it touches")
        else:
            yield from _judged(name, read[air], carried[air], robot)


def _contacts_beyond(robot: Robot, contacts: Sequence[Contact], name: str) -> list[int]:
    """Numbers of the contacts on bodies that hang on a sensor."""

    def hangs(body: int) -> bool:
        joint = robot.bodies[body].joint
        return joint is not None and (joint.name == name or hangs(robot.bodies[body].parent))

    return [number for number, contact in enumerate(contacts) if hangs(robot.links[contact.frame][0])]


def _judged(name: str, read: FloatArray, carried: FloatArray, robot: Robot) -> Iterator[Finding]:
    """Findings about forces (M, 3) that a sensor reads where the URDF's bodies need `carried`, (M, 3)."""
    weight = float(np.linalg.norm(carried.mean(axis=0)))
    varying, moving = carried - carried.mean(axis=0), read - read.mean(axis=0)
    product = float((varying * moving).sum())
    clear = abs(product) > _CLEAR * np.linalg.norm(varying) * np.linalg.norm(moving)
    share = product / float(np.square(varying).sum()) if clear else 1.0
    told = f"{name}: in the air it reads {share:.3g} times what hangs on it by the URDF ({weight:.3g} N)"
    if share < 0.0:
        advice = "reverse it: the wrench that the parent side exerts on the child side"
        yield Finding("sign", CONDEMNED, "ft_wrench", told, advice, (name,))
        return
    if abs(share - 1.0) > WRONG:
        advice = "look at the sensor's unit and gain, and at what is mounted beyond it"
        yield Finding("weight", SUSPICIOUS, "ft_wrench", told, advice, (name,))
    left = read - share * carried
    offset = np.median(left, axis=0)
    size, spread = float(np.linalg.norm(offset)), NORMAL * float(np.median(np.linalg.norm(left - offset, axis=1)))
    known = UNLOADED * GRAVITY * float(robot.nominal[:, 0].sum()) + (0.0 if clear else WRONG * weight)
    if size > max(known, spread):
        text = f"{name}: reads a steady {size:.3g} N in the air beside the {weight:.3g} N that hang on it by the URDF"
        mixed = "" if clear else "; a load of that weight would look the same"
        advice = f"identify it, sensors.offsets: {{ft_force: log}}, or subtract it{mixed}"
        yield Finding("offset", NOTE, "ft_wrench", text, advice, (name,))
