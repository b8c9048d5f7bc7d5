"""What dry friction goes with at the stamps of a preprocessed log: directions of joints, and where they rest."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from torchid.logs.log import BoolArray, FloatArray, Log
from torchid.logs.low_pass import LowPass, import_signal
from torchid.logs.sign_filter import mean_dry, mean_stribeck, noisy_width
from torchid.logs.timeline import Timeline

#: Values that are filtered together: few, so that copies of a long log are small; many, so that a short one needs few
#: calls.
_VALUES_TOGETHER = 2**14
_ROUNDING = 1e-9  # share of a weight


def channels_together(count: int) -> int:
    """How many channels of so many samples are filtered by one call."""
    return max(1, _VALUES_TOGETHER // max(count, 1))


def dry_friction(log: Log, smoothed: Mapping[str, FloatArray], timeline: Timeline) -> dict[str, Any]:
    """`joint_direction` and, with a Stribeck velocity, `joint_stribeck`, (K, n), none where nothing is filtered.

    The filter smears its torque as all others; velocities with reversals that it would take off are filtered less.
    Where joints at rest are to be found, `joint_rests` too.

    Args:
        log: the log.
        smoothed: its joint positions and, if it has them, velocities.
        timeline: with the width of the sign (`noisy_width`), and the velocities of joints at rest.
    """
    out = dict[str, Any]()
    if log.joint_rests is not None:
        out["joint_rests"] = timeline.widen_flags(log.joint_rests)
    if log.joint_direction is not None:
        given = {"joint_direction": log.joint_direction, "joint_stribeck": log.joint_stribeck}
        return out | {key: timeline.evaluate(timeline.smooth(x), (0,))[0] for key, x in given.items() if x is not None}
    if timeline.low_pass is None and timeline.rest_speed is None:
        return out
    name = "joint_position" if log.joint_velocity is None else "joint_velocity"
    known, wider = smoothed[name], timeline.sign_low_pass
    if wider is not None:
        known = replace(timeline, low_pass=wider).smooth(getattr(log, name))
    if timeline.rest_speed is not None and log.joint_rests is None:
        out["joint_rests"] = _rests(known, name == "joint_position", timeline.rest_speed, timeline)
    low_pass = timeline.low_pass
    return out if low_pass is None else out | _directions(known, name == "joint_position", timeline, low_pass)


def _directions(known: FloatArray, are_positions: bool, timeline: Timeline, low_pass: LowPass) -> dict[str, FloatArray]:
    """Both directions by joint positions, or else velocities, (M, n), behind their filter."""
    steps, means = np.diff(timeline.grid), dict[str, Callable[..., FloatArray]](joint_direction=mean_dry)
    if timeline.stribeck is not None:
        means["joint_stribeck"] = partial(mean_stribeck, stribeck=timeline.stribeck)
    out = {key: np.empty((len(timeline.output_stamps), known.shape[1])) for key in means}
    together = channels_together(len(known))
    for start in range(0, known.shape[1], together):
        columns = slice(start, start + together)
        width, x = noisy_width(timeline, columns), known[:, columns]
        halfway = np.diff(x, axis=0) / steps[:, None] if are_positions else 0.5 * (x[1:] + x[:-1])
        halfway = np.concatenate([halfway[:1], halfway, halfway[-1:]])
        for key, mean in means.items():
            out[key][:, columns] = timeline.evaluate(low_pass(mean(halfway, width=width)), (0,))[0]
    return out


def _rests(known: FloatArray, are_positions: bool, speed: FloatArray, timeline: Timeline) -> BoolArray:
    """Which joints, (K, n), are no faster than `speed` (n,) at a stamp, or in too much of what a filter mixes there.

    What holds a joint at rest is unknown, up to Coulomb friction either way. Of that the filter leaves the weight of
    the samples at rest at most; as much as a pause weighs that ends its reach before the stamp counts as nothing.
    """
    if are_positions:
        slow = np.abs(np.diff(known, axis=0)) <= speed * np.diff(timeline.grid)[:, None]
        rests = np.concatenate([slow[:1], slow]) | np.concatenate([slow, slow[-1:]])
    else:
        rests = np.abs(known) <= speed
    low_pass = timeline.low_pass
    if low_pass is None:
        return timeline.widen_flags(rests, of_grid=True)
    weights = np.abs(low_pass.impulse_response)
    steps = np.arange(len(weights)) - len(weights) // 2
    accepted = weights[steps * float(np.median(np.diff(timeline.grid))) > timeline.reach].sum()
    out = np.empty((len(timeline.output_stamps), rests.shape[1]), dtype=bool)
    together = channels_together(len(rests))
    for start in range(0, rests.shape[1], together):
        own = slice(start, start + together)
        at_rest = import_signal().fftconvolve(rests[:, own].astype(float), weights[:, None], mode="full", axes=0)
        (share,) = timeline.evaluate(at_rest[len(weights) // 2 :][: len(rests)], (0,))
        out[:, own] = share > (1.0 + _ROUNDING) * accepted
    return out


def dry_friction_by_setting(
    log: Log, timeline: Timeline
) -> Callable[[float | None, float | None], dict[str, FloatArray]]:
    """`joint_direction` and `joint_stribeck` of the preprocessed log by `sign_width` and `stribeck` of `preprocess`."""
    name = "joint_position" if log.joint_velocity is None else "joint_velocity"
    signs = timeline if timeline.sign_low_pass is None else replace(timeline, low_pass=timeline.sign_low_pass)
    smoothed = {name: signs.smooth(getattr(log, name))}
    own = replace(timeline, sign_low_pass=None)
    return lambda width, stribeck: dry_friction(log, smoothed, replace(own, sign_width=width, stribeck=stribeck))
