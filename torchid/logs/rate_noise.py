"""How much of a derived acceleration is noise of what it was derived from."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from torchid.errors import join_names, warn_about_file
from torchid.logs.log import FloatArray, Log, column_labels
from torchid.logs.signal_noise import SignalNoise
from torchid.logs.timeline import Timeline

_MUCH = 0.1  # share of an acceleration's variance
_LITTLE = 0.03  # share at the cutoff that is proposed
_NAMED = 4
#: Accelerations, and what each is derived from, with the number of derivatives.
_DERIVED = {
    "joint_acceleration": (("joint_velocity", 1), ("joint_position", 2)),
    "imu_angular_acceleration": (("imu_angular_velocity", 1),),
    "base_angular_acceleration_base": (("base_angular_velocity_base", 1),),
}
_AXES = ("x", "y", "z")


def warn_of_noisy_accelerations(log: Log, preprocessed: Log, timeline: Timeline, noise: SignalNoise) -> None:
    """Name accelerations that are noise to a large part, of which a fit learns little.

    Args:
        log: as recorded.
        preprocessed: the same with its accelerations.
        timeline: that was used.
        noise: of the log.

    Warns:
        TorchidWarning: one, with a lower cutoff that would do.
    """
    noisy = sorted(_noise_shares(log, preprocessed, noise), key=lambda one: -one[1])
    if not noisy:
        return
    names = [f"{name} ({100.0 * share:.0f} %)" for name, share, _ in noisy]
    found = f"accelerations of {join_names(names, _NAMED)} are that much noise of the signals they are derived from"
    cutoff = timeline.cutoff_hz
    if cutoff is None:
        advice = "a low-pass filter, preprocessing.cutoff_hz"
    else:
        lower = cutoff * float(np.median([_slower(share, order) for _, share, order in noisy]))  # some hardly move
        advice = f"a cutoff of {lower:.2g} Hz, if the motion is that slow, or faster motion"
    warn_about_file(f"{found}: parameters that rest on them are uncertain; accepted: {advice}")


def _slower(share: float, order: int) -> float:
    """Factor of the cutoff that leaves little noise: its power goes with the cutoff to the power 2 order + 1."""
    ratio = _LITTLE / (1.0 - _LITTLE) * max(1.0 - share, 1e-3) / share
    return float(ratio ** (1.0 / (2 * order + 1)))


def _noise_shares(log: Log, preprocessed: Log, noise: SignalNoise) -> Iterator[tuple[str, float, int]]:
    """Channels of accelerations with much noise: its share of the variance, and the number of derivatives."""
    for name, sources in _DERIVED.items():
        derived: FloatArray | None = getattr(preprocessed, name)
        if getattr(log, name) is not None or derived is None:
            continue
        source, order = next(((field, order) for field, order in sources if getattr(log, field) is not None), ("", 0))
        if source not in noise.std:
            continue
        variance = np.square(noise.std[source]) * noise.derivatives[order, order]
        motion = np.array([channel.var() for channel in derived.T])  # one by one: temporaries stay small
        share = np.divide(variance, motion, out=np.zeros_like(variance), where=variance > 0.0)
        labels = column_labels(source, log.names) or tuple(f"{source} {axis}" for axis in _AXES)
        yield from ((labels[column], min(float(share[column]), 1.0), order) for column in np.flatnonzero(share > _MUCH))
