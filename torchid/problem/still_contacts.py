"""Contacts that keep still: a foot that carries next to nothing may stand all the same."""

from __future__ import annotations

import numpy as np

from torchid.logs.flags import runs
from torchid.logs.log import BoolArray, FloatArray

LEAST_LIMIT = 0.01
"""Speed [m/s] below which a contact always counts as still: what soft ground and filters leave of a stance."""

_TOGETHER = 1 << 16  # samples whose speeds are worked out at once
_MEDIANS = 2.0  # of the speed of contacts that surely stand, which is noise


def keep_still(
    velocity: FloatArray, in_world: bool, standing: BoolArray, possible: BoolArray, shortest: int
) -> BoolArray:
    """Which contacts that may stand move no faster than those that surely do, for some samples at least, (N, C).

    Args:
        velocity: of the contacts (N, C, 3) [m/s], from `contact_velocities`.
        in_world: whether that is in the world, as the log has the velocity of its base; else speeds are those against
            the median of the other contacts that surely stand.
        standing: those that surely stand, (N, C).
        possible: those that may stand, (N, C).
        shortest: samples in a row.
    """
    speed = np.empty(standing.shape)
    for start in range(0, len(speed), _TOGETHER):
        part = slice(start, start + _TOGETHER)
        seen = velocity[part] if in_world else _against_standing(velocity[part], standing[part])
        speed[part] = np.linalg.norm(seen, axis=2)
    noise = speed[standing & np.isfinite(speed)]
    limit = max(LEAST_LIMIT, _MEDIANS * float(np.median(noise))) if len(noise) else LEAST_LIMIT
    with np.errstate(invalid="ignore"):
        still = (speed < limit) & possible
    return np.stack([_lasting(one, shortest) for one in still.T], axis=1)


def _lasting(flags: BoolArray, shortest: int) -> BoolArray:
    """The flags (N,) without runs of fewer true ones."""
    out = np.zeros_like(flags)
    for start, stop in runs(flags):
        out[start:stop] = stop - start >= shortest
    return out


def _against_standing(velocity: FloatArray, standing: BoolArray) -> FloatArray:
    """Velocities (N, C, 3) against the median of the other contacts that stand; NaN where none does."""
    out = np.full_like(velocity, np.nan)
    for contact in range(velocity.shape[1]):
        others = np.where(standing[:, :, None], velocity, np.nan)
        others[:, contact] = np.nan
        some = np.isfinite(others[:, :, 0]).any(axis=1)
        out[some, contact] = velocity[some, contact] - np.nanmedian(others[some], axis=1)
    return out
