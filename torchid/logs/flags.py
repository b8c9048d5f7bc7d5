"""Contact flags from thresholds of the contact forces, with hysteresis."""

from __future__ import annotations

import dataclasses

import numpy as np
from pydantic.dataclasses import dataclass

from torchid.errors import LogError, about_file
from torchid.logs.log import FORCE_NORMAL, BoolArray, FloatArray, Log, describe_element, normalize_normals
from torchid.settings import STRICT, NotNegative, Positive

_KEY = "preprocessing.contact_threshold"


@dataclass(config=STRICT, frozen=True)
class ContactThreshold:
    """A contact is active from a force above `above` [N] until a force below `below` [N].

    Without `below` both are the same. Stances and swings shorter than `shortest_s` [s] are none.
    """

    above: Positive
    below: Positive | None = None
    shortest_s: NotNegative = 0.0


def with_flags_by_force(log: Log, settings: ContactThreshold) -> tuple[Log, BoolArray]:
    """The log with flags from its contact forces instead of its own, and a mask of samples with certain flags.

    A contact without a force keeps its recorded flag. Samples (N,) of stances that are too short to count are not
    certain.

    Raises:
        LogError: no force, or no flag either, of a contact; a force that is NaN in some samples; no normal of the
            ground where a contact stands.
    """
    scalar = log.contact_force_normal
    wrench = log.contact_wrench
    if not log.contact_names or (scalar is None and wrench is None):
        accepted = f"contact_wrench_local or {FORCE_NORMAL}, to compare with {_KEY}"
        raise LogError(log.source, "contact_wrench", "missing", accepted)
    force = _force_sizes(log)
    active = np.zeros(force.shape, dtype=bool) if log.contact_active is None else log.contact_active.copy()
    certain = np.ones(len(log), dtype=bool)
    below = settings.above if settings.below is None else settings.below
    shortest = samples_of(settings.shortest_s, log.time)
    for column, name in enumerate(log.contact_names):
        missing = np.isnan(force[:, column])
        if missing.all() and log.contact_active is not None:
            continue
        if missing.any():
            reason = f"nan at {describe_element((int(np.argmax(missing)), column), log.contact_names)}"
            accepted = f"forces to compare with {_KEY}, or preprocessing.bridge_gaps_s to bridge gaps"
            if missing.all():
                reason = f"no force of {name}"
                accepted = f"forces to compare with {_KEY}, or contact_active"
            is_scalar = scalar is not None and (wrench is None or not np.isnan(scalar[:, column]).all())
            raise LogError(log.source, FORCE_NORMAL if is_scalar else log.contact_wrench_field, reason, accepted)
        loaded = hysteresis(force[:, column], settings.above, below)
        active[:, column] = without_short(loaded, shortest)
        certain &= active[:, column] | ~loaded
    normals = log.contact_normal_world
    if normals is not None:
        with about_file(log.source):
            normals = normalize_normals(normals, active, log.contact_names)
    return dataclasses.replace(log, contact_active=active, contact_normal_world=normals), certain


def _force_sizes(log: Log) -> FloatArray:
    """What contacts carry, (N, C) [N]: `contact_force_normal`, or else the size of a wrench's force.

    The size needs no orientation of foot, base or ground. A component that is NaN throughout the log counts as 0, a
    contact of which all are has NaN.
    """
    force = np.full((len(log), len(log.contact_names)), np.nan)
    if log.contact_wrench is not None:
        components = log.contact_wrench[:, :, :3]
        known = np.asarray(~np.isnan(components).all(axis=0))
        sizes = np.linalg.norm(np.where(known, components, 0.0), axis=2)
        force = np.where(known.any(axis=1), sizes, np.nan)
    scalar = log.contact_force_normal
    if scalar is not None:
        force = np.where(~np.isnan(scalar).all(axis=0), scalar, force)
    return np.asarray(force)


def samples_of(seconds: float, time: FloatArray) -> int:
    """A duration [s] in median steps of stamps (N,) [s]."""
    return round(seconds / float(np.median(np.diff(time)))) if len(time) > 1 else 0


def hysteresis(values: FloatArray, on: float, off: float) -> BoolArray:
    """Mask (N,): set from a value above `on` until a value below `off`."""
    state = np.where(values > on, 1, np.where(values < off, 0, -1))
    known = np.flatnonzero(state >= 0)
    if not len(known):
        return np.full(len(values), bool(len(values)) and float(values.mean()) > 0.5 * (on + off))
    last = np.searchsorted(known, np.arange(len(values)), side="right") - 1
    return np.asarray(state[known[np.maximum(last, 0)]] == 1)


def without_short(flags: BoolArray, shortest: int) -> BoolArray:
    """The flags (N,) without runs of fewer samples, the shortest first; runs at the ends stay."""
    out = flags.copy()
    while True:
        ends = np.flatnonzero(out[1:] != out[:-1]) + 1
        lengths = np.diff(ends)
        if not len(lengths) or lengths.min() >= shortest:
            return out
        first = int(lengths.argmin())
        out[ends[first] : ends[first + 1]] ^= True


def runs(flags: BoolArray) -> list[tuple[int, int]]:
    """First samples of the runs of flags (N,) that are set, and those after them."""
    ends = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    return [(int(start), int(stop)) for start, stop in ends.reshape(-1, 2)]


def beside_changes(flags: BoolArray) -> BoolArray:
    """Which samples (N,) are the last before a change of flags (N, C), or the first after it."""
    changed = (flags[1:] != flags[:-1]).any(axis=1)
    return np.asarray(np.append(changed, False) | np.insert(changed, 0, False))
