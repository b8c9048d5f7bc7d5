"""Force plates: wrenches along their axes and about points of the world, not of the robot."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.logs.log import FLAGS, POINTS, SHAPES, WRENCHES, check_finite, check_shape, to_float64

_FIELD = WRENCHES[1]


def about_world_origin(raw: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The fields of a file with moments about the world's origin, m + p x f, where it has the points p of these.

    A centre of pressure is a point p; only the vertical component of m, the free moment, is then not 0. Moments about a
    point that does not move are linear in what a plate measures: they can be interpolated and filtered, which a centre
    of pressure cannot, and no motion is needed for them.

    Nothing acts without a force: where this is exactly 0, or the contact is not active, a point may be NaN and a moment
    of NaN is then 0. Elsewhere a moment about an unknown point is not known, NaN.

    Args:
        raw: arrays by field; afterwards the points are the world's origin.

    Raises:
        LogError: points or wrenches of another shape, or points that are infinite.
    """
    if POINTS not in raw or _FIELD not in raw:
        return raw
    check_shape("time", raw["time"], SHAPES["time"], {})
    samples = {"N": len(raw["time"])}
    check_shape(_FIELD, raw[_FIELD], SHAPES[_FIELD], samples)
    check_shape(POINTS, raw[POINTS], SHAPES[POINTS], samples | {"C": raw[_FIELD].shape[1]})
    wrench, points = to_float64(_FIELD, raw[_FIELD]), to_float64(POINTS, raw[POINTS])
    if not points.any():
        return raw
    force, moment = wrench[..., :3], wrench[..., 3:]
    idle = (force == 0.0).all(axis=2)
    unknown = ~np.isfinite(points).all(axis=2)
    check_finite(POINTS, np.where(idle[..., None], 0.0, points), allow_nan=True)
    with np.errstate(invalid="ignore", over="ignore"):  # infinite forces are refused with the log
        arms = np.where((idle | ~points.any(axis=2))[..., None], 0.0, np.cross(points, force))
    moved = moment + arms
    if FLAGS in raw and raw[FLAGS].shape == idle.shape:
        idle = idle | (raw[FLAGS] == 0)
    moved[(idle & unknown)[..., None] & np.isnan(moved)] = 0.0
    return raw | {_FIELD: np.concatenate([force, moved], axis=2), POINTS: np.zeros_like(points)}
