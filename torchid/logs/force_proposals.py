"""What forces at feet say of themselves: whose axes they have, and above which reading a foot touches."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from torchid.rounding import STD_PER_MAD

FORCE = re.compile(r"force|(?<![a-z])f\{axis", re.IGNORECASE)
MOMENT = re.compile(r"moment|torque|(?<![a-z])[mt]\{axis", re.IGNORECASE)
"""In patterns of columns."""

_UPRIGHT = 0.96  # of the size of forces along z, of feet that walk
_AIR = 0.1  # of the way from the lowest to the highest reading: of a foot in the air
_SHARES = (0.05, 0.2)  # of that way, a threshold of contact: least and most
LEAST_GRAVITY = 0.25  # share of the power of an accelerometer's readings that their mean has
_STATES = 4  # at most, such as unknown, made and lost
_NOISE = 4.0  # standard deviations of readings in the air that it is above them


def point_along_z(forces: Any) -> bool:
    """Whether forces (N, ..., 3), or as many columns, point along z: in the world, as those of several small feet."""
    vectors = np.reshape(np.asarray(forces, dtype=float), (len(forces), -1, 3))
    with np.errstate(all="ignore"):
        upright = np.nansum(vectors[..., 2]) / np.nansum(np.linalg.norm(vectors, axis=2))
    return bool(abs(upright) > _UPRIGHT)


def gravity_share(readings: Any) -> float:
    """The share of the power of accelerations (N, 3) that their mean has: most of it where gravity is in them."""
    vectors = np.reshape(np.asarray(readings, dtype=float), (len(readings), -1))
    with np.errstate(all="ignore"):
        constant, size = np.nanmean(vectors, axis=0), np.nanmean(np.square(vectors), axis=0)
        return float(np.square(constant).sum() / size.sum())


def are_states(values: Any) -> bool:
    """Whether numbers are those of a few states, counted from 1: of which of them a foot touches nobody knows."""
    found = np.unique(np.asarray(values, dtype=float))
    return 2 <= len(found) <= _STATES and bool((found == np.arange(1, len(found) + 1)).all())


def threshold(readings: Any) -> float:
    """A reading above which a contact is probably active, in two digits.

    As low as the readings in the air allow: a foot that is taken to be in the air while it carries some weight
    falsifies the fit, one that is taken to stand in the air costs samples only.

    Args:
        readings: (N, C) of the sensors of C contacts, or all of them.
    """
    values = np.asarray(readings, dtype=float)
    if not np.isfinite(values).any():
        return 0.0
    low, high = np.percentile(values[np.isfinite(values)], (2, 98))
    least, most = (low + share * (high - low) for share in _SHARES)
    above = [least]
    for one in values.reshape(len(values), -1).T if values.ndim > 1 else [values]:
        air = one[one < low + _AIR * (high - low)]
        if len(air):  # its median, as a foot that lands or lifts off passes through
            middle = np.median(air)
            above.append(float(middle + _NOISE * STD_PER_MAD * np.median(np.abs(air - middle))))
    return float(f"{min(max(above), most):.2g}")
