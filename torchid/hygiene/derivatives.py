"""Velocities and accelerations that a log gives beside positions: unit, sign, frame and delay."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from torchid.hygiene.channels import channel_names
from torchid.hygiene.finding import CONDEMNED, SUSPICIOUS, Finding, Skipped
from torchid.hygiene.rates import Comparison, compare
from torchid.logs import Log
from torchid.logs.fields import BoolArray
from torchid.logs.preprocess import CHAINS
from torchid.logs.quaternion import rotate, rotate_back
from torchid.regressor.motion import GRAVITY_WORLD
from torchid.text import listed

#: A delay [samples] worth a word: half a sample comes from integrators and central differences.
DELAYED = 1.5
#: How far the ratio of a derivative to what it should be may be from 1. Filters in a driver take a tenth.
RATIO = 0.15
#: Correlation below which a derivative does not follow.
FOLLOWS = 0.9
#: Misfit above which other frames and orders are tried, and the share of it that one must leave to be the right one.
WRONG, BETTER = 0.15, 0.3
#: Ratios that have a name, and by which share they may be missed.
ANGLES = {-1.0: "the sign is reversed", 180.0 / np.pi: "it is in degrees", np.pi / 180.0: "{base} is in degrees"}
LENGTHS = {-1.0: "the sign is reversed", 1e3: "it is in mm", 1e-3: "{base} is in mm"}
_CLOSE = 0.15
#: Ratio of every derivative where time is in minutes: 5 % from that of degrees.
MINUTES = 1.0 / 60.0
_TINY = 1e-300
_NAME = "velocities and accelerations against positions"


def derivatives(log: Log) -> Iterator[Finding | Skipped]:
    """Findings about the derivatives that the log gives."""
    if not any(getattr(log, name) is not None for chain in CHAINS for name in chain[1:]):
        yield Skipped(_NAME, "the log gives neither velocities nor accelerations")
    for chain in CHAINS:
        given = [(order, name) for order, name in enumerate(chain) if getattr(log, name) is not None]
        for (low, base), (high, name) in zip(given, given[1:], strict=False):
            found = compare(log.time, getattr(log, base), getattr(log, name), high - low)
            if found is None:
                yield Skipped(_NAME, f"{name}: the log is too short")
            else:
                wrong = list(_frame(log, name, base, high - low, found))
                yield from wrong or judged(found, name, base, channel_names(log, name))


def judged(found: Comparison, name: str, base: str, channels: tuple[str, ...]) -> Iterator[Finding]:
    """Findings about one derivative, given with the names of its channels."""
    follows = np.abs(found.correlation) >= FOLLOWS  # so written, NaN does not follow
    lost = ~follows & np.isfinite(found.correlation)
    meanings = {**(LENGTHS if name.startswith("base_linear") else ANGLES), MINUTES: "time is in minutes"}
    away = np.array([np.abs(found.ratio / ratio - 1.0) for ratio in meanings])  # (meanings, c)
    named = follows & (away.min(axis=0) < _CLOSE)
    for number, meaning in enumerate(meanings.values()):
        here = named & (away.argmin(axis=0) == number)
        if here.any():
            text = f"{found.ratio[here][0]:.4g} times the derivative of {base}: {meaning.format(base=base)}"
            yield _finding("unit or sign", CONDEMNED, name, channels, here, text, "convert it, or leave the field out")
    off = follows & ~named & (np.abs(found.ratio - 1.0) > RATIO)
    if off.any():
        worst = int(np.argmax(np.abs(np.log(np.where(off, np.abs(found.ratio), 1.0) + _TINY))))
        text = f"{found.ratio[worst]:.3g} times the derivative of {base} ({channels[worst]})"
        yield _finding("ratio", SUSPICIOUS, name, channels, off, text, "leave the field out: it is derived then")
    late = follows & (np.abs(found.delay) >= DELAYED)
    if late.any():
        typical = float(np.median(found.delay[late]))
        text = f"{'lags' if typical > 0 else 'leads'} the derivative of {base} by {abs(typical):.3g} samples"
        yield _finding("delay", SUSPICIOUS, name, channels, late, text, "leave the field out: it is derived then")
    if lost.any():
        text = f"does not follow {base}: correlation {np.nanmin(np.abs(found.correlation)):.2f} with its derivative"
        cause = "the order of its joints" if name.startswith("joint") else "its frame"
        advice = f"leave the field out: it is derived then; or look for {cause}"
        yield _finding("derivative", SUSPICIOUS, name, channels, lost, text, advice)


def _frame(log: Log, name: str, base: str, order: int, found: Comparison) -> Iterator[Finding]:
    """Whether a vector of the base is given in another frame than its name says, or contains gravity."""
    if name == "base_linear_acceleration_world" and abs(abs(found.excess[2] / GRAVITY_WORLD[2]) - 1.0) < _CLOSE:
        text = f"{found.excess[2]:+.2f} m/s^2 along z on average beyond the derivative of {base}: it contains gravity"
        advice = "give d/dt of the velocity, or name it imu_specific_force"
        yield Finding("gravity", CONDEMNED, name, text, advice, ("z",))
    if not name.startswith("base_linear") or log.base_quat_xyzw is None or found.misfit < WRONG:
        return
    for turn, actual in ((rotate, "base"), (rotate_back, "world")):
        turned = compare(log.time, getattr(log, base), turn(log.base_quat_xyzw, getattr(log, name)), order)
        if turned is not None and turned.misfit < BETTER * found.misfit:
            text = f"follows {base} if it is in the {actual} frame, not in the one that its name says"
            yield Finding("frame", CONDEMNED, name, text, f"call it {name.replace('world', actual)}")


def _finding(
    name: str, severity: str, field: str, channels: tuple[str, ...], where: BoolArray, text: str, advice: str
) -> Finding:
    chosen = tuple(channel for channel, here in zip(channels, where, strict=True) if here)
    return Finding(name, severity, field, f"{listed(list(chosen))}: {text}", advice, chosen)
