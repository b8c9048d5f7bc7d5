"""White noise in the recorded motion: its size, and what a filter and derivatives make of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import comb

import numpy as np

from torchid.errors import join_names, warn_about_file
from torchid.logs.log import FloatArray, Log, SignalNoise, column_labels
from torchid.logs.quaternion import make_sign_continuous
from torchid.logs.timeline import JITTER, SPLINE_OVERLAP, Timeline, spline_derivatives
from torchid.rounding import MAD_PER_STD

STATED_FIELDS = {
    "joint_position": ("joint_position",),
    "joint_velocity": ("joint_velocity",),
    "base_orientation": ("base_quat_xyzw",),
    "angular_velocity": ("imu_angular_velocity", "base_angular_velocity_base"),
    "specific_force": ("imu_specific_force", "base_linear_acceleration_world"),
}
"""Fields of a log by the keys under which their noise can be stated [rad or m, rad/s or m/s, rad, rad/s, m/s^2]."""

MOTION_FIELDS = (
    "joint_position",
    "joint_velocity",
    "joint_acceleration",
    "base_quat_xyzw",
    "base_position_world",
    "base_linear_velocity_world",
    "base_linear_acceleration_world",
    "base_angular_velocity_base",
    "base_angular_acceleration_base",
    "imu_specific_force",
    "imu_angular_velocity",
    "imu_angular_acceleration",
)
MOST_SAMPLES = 5000
"""From the start of a log, that its noise is estimated from."""

_FEWEST = 100
_ORDERS = (7, 9)  # of the differences that show noise: smooth motion vanishes in them
_WHITE = 0.7  # least ratio of the estimates by both orders: less, and what is there is motion or was filtered
_LEAST = 1e-12  # share of a channel's largest value: less is rounding
_LARGEST = 0.02  # [rad, m] noise of joint positions; beyond, successive samples are postures, not motion
# nobody's readings: what looks like noise in them is as often motion, such as the trembling of contacts
_DERIVED = ("joint_acceleration", "base_angular_acceleration_base", "imu_angular_acceleration")
_ORIENTATION = "base_quat_xyzw"


def signal_noise(log: Log, timeline: Timeline | None, stated: Mapping[str, float] | None = None) -> SignalNoise:
    """The noise of a log's motion, as stated, or as the high frequencies of its start show.

    None is found where samples do not follow a path, such as postures one after the other.

    Args:
        log: as recorded.
        timeline: that it is preprocessed to; None where nothing is filtered, derived or resampled.
        stated: standard deviations by `STATED_FIELDS`' keys, 0 for none.
    """
    known = {name: value for key, value in (stated or {}).items() for name in STATED_FIELDS[key]}
    start = log.select(slice(0, MOST_SAMPLES))
    std = dict[str, FloatArray]()
    for name in MOTION_FIELDS:
        values: FloatArray | None = getattr(start, name)
        if values is None or not values.size and name != "joint_position":
            continue
        std[name] = np.full(_width(name, values), known[name]) if name in known else _estimate(name, start.time, values)
    if (std["joint_position"] > _LARGEST).any() and "joint_position" not in known:  # no path: samples of their own
        std = {name: np.full_like(x, known.get(name, 0.0)) for name, x in std.items()}
    noise = SignalNoise(std)
    if timeline is None or not noise.found:
        return noise
    return SignalNoise(std, noise_of_derivatives(float(np.median(np.diff(log.time))), timeline))


def _width(name: str, values: FloatArray) -> int:
    return 3 if name == _ORIENTATION else values.shape[1]


def _estimate(name: str, time: FloatArray, values: FloatArray) -> FloatArray:
    """Standard deviation of the noise in a field (N, c), by channel."""
    if name in _DERIVED or len(time) < _FEWEST or not values.size:
        return np.zeros(_width(name, values))
    if name != _ORIENTATION:
        return _rounded(white_noise(time, values))
    components = white_noise(time, make_sign_continuous(values))  # half angles, of three axes in four components
    return _rounded(np.full(3, np.sqrt(4.0 / 3.0 * np.square(components).sum())))


def _rounded(values: FloatArray) -> FloatArray:
    """To three digits, so that the last bits of a log make no difference."""
    return np.array([float(f"{x:.3g}") for x in values])


def white_noise(time: FloatArray, values: FloatArray) -> FloatArray:
    """Standard deviation of white noise in smooth channels (N, c), (c,), at stamps (N,) [s]; 0 if what is there is not.

    Differences of a high order leave of smooth motion less and less, of white noise always the same. Those across gaps
    (NaN) are left out; too few of them show nothing.
    """
    return np.array([_white_noise(time, channel) for channel in values.T])


def _white_noise(time: FloatArray, channel: FloatArray) -> float:
    """As `white_noise` of a channel (N,), between its gaps."""
    edges = np.flatnonzero(np.diff(np.isfinite(channel), prepend=False, append=False))
    runs = [slice(start, stop) for start, stop in edges.reshape(-1, 2) if stop - start > max(_ORDERS)]
    if sum(run.stop - run.start for run in runs) < _FEWEST:
        return 0.0
    parts = [_evenly(time[run], channel[run, None]) for run in runs]
    lower, higher = (_without_outliers(np.concatenate([_differences(x, order) for x in parts])) for order in _ORDERS)
    is_white = higher > _WHITE * lower and higher > _LEAST * np.nanmax(np.abs(channel))
    return lower if is_white else 0.0


def _evenly(time: FloatArray, values: FloatArray) -> FloatArray:
    """Channels (N, c) at even steps, between which differences are not motion."""
    steps = np.diff(time)
    if np.ptp(steps) <= JITTER * float(np.median(steps)):
        return values
    return spline_derivatives(time, values, np.linspace(time[0], time[-1], len(time)), (0,))[0]


def rough_noise(values: FloatArray) -> FloatArray:
    """Standard deviation of whatever is not smooth from sample to sample in even channels (N, c), (c,)."""
    return np.asarray(_differences(values, _ORDERS[0]).std(axis=0))


def _differences(values: FloatArray, order: int) -> FloatArray:
    """Of even channels (N, c), of white noise as large as the noise."""
    return np.asarray(np.diff(values, n=order, axis=0) / np.sqrt(comb(2 * order, order)))


def _without_outliers(differences: FloatArray) -> float:
    """Standard deviation of differences of a channel, without the few that are large."""
    off = np.abs(differences - np.median(differences))
    return float(np.minimum(np.median(off) / MAD_PER_STD, differences.std()))


def noise_of_derivatives(step: float, timeline: Timeline) -> FloatArray:
    """Covariance of what becomes of unit white noise, recorded every so many seconds, and of its derivatives."""
    around = SPLINE_OVERLAP
    if timeline.low_pass is not None:
        around += timeline.low_pass.settling + timeline.low_pass.padding
    impulse = np.zeros((2 * around + 1, 1))
    impulse[around] = 1.0
    time = step * np.arange(len(impulse), dtype=np.float64)
    passed = impulse if timeline.low_pass is None else timeline.low_pass(impulse)
    responses = np.hstack(spline_derivatives(time, passed, time, (0, 1, 2)))
    return np.asarray(responses.T @ responses)


_MUCH = 0.1  # share of an acceleration's variance
_STILL = 3.0  # rms of positions over that of their noise, up to which a joint does not move
_LITTLE = 0.03  # share at the cutoff that is proposed
_NAMED = 4
#: Accelerations, and what each is derived from, with the number of derivatives.
_DERIVATIVES = {
    "joint_acceleration": (("joint_velocity", 1), ("joint_position", 2)),
    "imu_angular_acceleration": (("imu_angular_velocity", 1),),
    "base_angular_acceleration_base": (("base_angular_velocity_base", 1), (_ORIENTATION, 2)),
    "base_linear_acceleration_world": (("base_linear_velocity_world", 1), ("base_position_world", 2)),
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
        TorchidWarning: one, with a lower cutoff that would do, or that no joint moves.
    """
    noisy = sorted(_noise_shares(log, preprocessed, noise), key=lambda item: -item[1])
    if not noisy:
        return
    if _stands_still(log, noise):
        warn_about_file(
            "no joint moves by more than its position noise: the log determines weights, but no friction, and "
            "inertia only if the base moves"
        )
        return
    names = [f"{name} ({100.0 * share:.0f} %)" for name, share, _ in noisy]
    reason = f"these accelerations are largely noise: {join_names(names, _NAMED)}"
    cutoff = timeline.cutoff_hz
    if cutoff is None:
        advice = "set preprocessing.cutoff_hz (a low-pass filter)"
    else:
        shares = np.array([share for _, share, _ in noisy])
        powers = np.array([2 * order + 1 for *_, order in noisy])  # of the cutoff, with which the noise goes
        ratios = _LITTLE / (1.0 - _LITTLE) * np.maximum(1.0 - shares, 1e-3) / shares
        lower = cutoff * float(np.median(ratios ** (1.0 / powers)))  # as channels may hardly move
        advice = f"set cutoff_hz: {lower:.2g} if the motion is that slow, or record faster motion"
    warn_about_file(f"{reason}. Inertias are uncertain; {advice}")


def _stands_still(log: Log, noise: SignalNoise) -> bool:
    """Whether no joint moves by more than its positions' noise."""
    std = noise.std.get("joint_position")
    if std is None or log.joint_position is None or not log.joint_names:
        return False
    return bool((np.nanstd(log.joint_position, axis=0) < _STILL * std).all())


def _noise_shares(log: Log, preprocessed: Log, noise: SignalNoise) -> Iterator[tuple[str, float, int]]:
    """Channels of accelerations with much noise: its share of the variance, and the number of derivatives."""
    for name, sources in _DERIVATIVES.items():
        derived: FloatArray | None = getattr(preprocessed, name)
        unused = name.startswith("base_") and log.imu_specific_force is not None
        if getattr(log, name) is not None or derived is None or unused:
            continue
        source, order = next(((field, order) for field, order in sources if getattr(log, field) is not None), ("", 0))
        if source not in noise.std:
            continue
        variance = np.square(noise.std[source]) * noise.derivatives[order, order]
        motion = np.array([channel.var() for channel in derived.T])  # one by one: temporaries stay small
        share = np.divide(variance, motion, out=np.zeros_like(variance), where=variance > 0.0)
        labels = column_labels(source, log.names) or tuple(f"{source} {axis}" for axis in _AXES)
        yield from ((labels[column], min(float(share[column]), 1.0), order) for column in np.flatnonzero(share > _MUCH))
