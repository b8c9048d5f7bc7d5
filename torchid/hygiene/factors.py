"""Findings about scales: time that runs too fast, single torques of another size, wrenches about another point."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from torchid.errors import InputError
from torchid.hygiene.finding import CONDEMNED, SUSPICIOUS, Finding
from torchid.hygiene.scales import Gains, Stretch, gains, motion_cutoff, stretch
from torchid.logs import Log
from torchid.logs.fields import WRENCHES, BoolArray, FloatArray
from torchid.problem import Samples
from torchid.robot import Robot
from torchid.sensing import Contact
from torchid.text import listed

#: Factor of time from which on no error of inertias is to blame: its square is 2.25. Blocks must agree on `SAME` of it.
STRETCHED = 1.5
#: How much more of the forces recorded time leaves unexplained than the mended one.
WORSE = 1.5
#: Units of time, by what turns them to seconds.
UNITS = {60.0: "minutes", 1e-3: "ms", 1e3: "ks", 3600.0: "hours"}
_UNIT_WITHIN = 0.1
#: Factor of a torque against those of the other joints, and shift of a point [m], from which on they are worth a word:
#: what gears and calibrations are off by is less.
GAIN, POINT = 1.15, 0.03
#: How many standard deviations, errors of the URDF among them, they must be off.
CERTAIN = 4.0
#: Share of it that every block of time must find.
SAME = 0.5
#: Factors with a standard deviation below this are what others are compared with, if there are so many.
_KNOWN, _ENOUGH = 0.1, 3


def time_fit(log: Log, robot: Robot, contacts: Sequence[Contact]) -> Stretch | None:
    """What time is worth by the forces; None where nothing moves, or the log is too short."""
    cutoff = motion_cutoff(log)
    try:
        return None if cutoff is None else stretch(log, robot, contacts, cutoff)
    except InputError:
        return None


def time_finding(found: Stretch | None) -> Finding | None:
    """That time is in another unit, if gravity and inertia only make up the forces in that unit.

    Noise in positions makes accelerations that no force answers to, which looks like time that is too short: so inertia
    must matter at the mended time.
    """
    if found is None:
        return None
    factor, log_factor = found.factor, np.log(found.factor)
    agree = np.log(found.blocks) * np.sign(log_factor) > SAME * abs(log_factor)
    other = min(found.recorded, found.still)
    if abs(log_factor) < np.log(STRETCHED) or not agree.all() or other < WORSE * found.mended:
        return None
    unit = next((name for size, name in UNITS.items() if abs(factor / size - 1.0) < _UNIT_WITHIN), None)
    text = f"in {unit}: " if unit else ""
    text += f"gravity and inertia make up the measured forces if time is multiplied by {factor:.3g}"
    advice = "give seconds; look at the sample rate that the stamps were made from"
    return Finding("unit", CONDEMNED, "time", text, advice)


def factor_findings(
    log: Log, samples: Sequence[Samples], robot: Robot, contacts: Sequence[Contact]
) -> Iterator[Finding]:
    """Findings about torques of another size and wrenches about another point."""
    found = gains(samples, robot, contacts)
    if found is None:
        return
    yield from _gains(found, robot)
    m = len(found.joints)
    off = _sure(found.point, found.spread[m:], found.blocks[:, m:]) & (np.abs(found.point) > POINT)
    if off.any():
        field = WRENCHES[0] if log.contact_wrench_world is None else WRENCHES[1]
        where = ", ".join(f"{1e3 * x:.0f}" for x in found.point)
        text = f"forces and moments fit the URDF about a point that lies {where} mm from the contact frames' origins"
        advice = "give moments about the contact frame's origin, or name the sensor's own frame as the contact"
        yield Finding("point", SUSPICIOUS, field, text, advice)


def _gains(found: Gains, robot: Robot) -> Iterator[Finding]:
    m = len(found.joints)
    spread = found.spread[:m]
    known = spread < _KNOWN
    usual = float(np.median(found.gain[known])) if known.sum() >= _ENOUGH else 1.0
    relative, blocks = found.gain / usual, found.blocks[:, :m] / usual
    large = (relative > GAIN) | (relative < 1.0 / GAIN)
    off = large & _sure(relative - 1.0, spread / usual, blocks - 1.0)
    if off.any():
        names = [robot.joint_names[joint] for joint in found.joints[off]]
        factors = listed([f"{gain:.3g} +- {sd:.2g}" for gain, sd in zip(relative[off], spread[off], strict=True)])
        text = f"{listed(names)}: factors that fit the URDF best, against the other joints: {factors}"
        advice = "look at gear ratios, torque constants and units; at friction and inertias of the URDF there"
        yield Finding("scale", SUSPICIOUS, "joint_torque", text, advice, tuple(names))


def _sure(value: FloatArray, spread: FloatArray, blocks: FloatArray) -> BoolArray:
    """Which values (k,) are not 0, by their standard deviations (k,) and by blocks (BLOCKS, k)."""
    return np.asarray((np.abs(value) > CERTAIN * spread) & (blocks * np.sign(value) > SAME * np.abs(value)).all(axis=0))
