"""What the sensors make of a motion: noise, bias and gain, delay; and which feet seem to stand."""

from __future__ import annotations

import zlib

import numpy as np
from scipy.spatial.transform import Rotation

from torchid.config import SensorImperfectionsConfig
from torchid.errors import InputError
from torchid.logs import Log
from torchid.logs.log import BoolArray
from torchid.parameters import Array
from torchid.simulation.simulation import require_field


def sensor_log(truth: Log, sensors: SensorImperfectionsConfig, seed: int, name: str | None = None) -> Log:
    """The log that a robot with imperfect sensors would have written.

    Positions, torques and wrenches only: velocities and accelerations are for the preprocessing to derive. A contact
    is active while the measured force, along its mean over the log, exceeds the threshold.

    Args:
        truth: exact log, of a `Recording`.
        sensors: which imperfections, and how large.
        seed: of the noise, together with `name`; biases and gains depend on the seed alone.
        name: of the motion, by default the log's source; becomes the source.

    Raises:
        InputError: a delay of no sample, or of all.
    """
    name = name or truth.source
    torque, wrench = require_field(truth, "joint_torque"), require_field(truth, "contact_wrench_local")
    if sensors.delay.enabled:
        step = float(np.median(np.diff(truth.time)))
        late = round(sensors.delay.feet_s / step)
        if late >= len(truth) or (late == 0 and sensors.delay.feet_s > 0.0):
            accepted = f"0, or from one sample, {step:g} s, to less than the log, {len(truth) * step:g} s"
            raise InputError(name, "sensors.delay.feet_s", f"{sensors.delay.feet_s:g}", accepted)
        wrench = wrench[np.maximum(np.arange(len(truth)) - late, 0)]  # the first reading is held
    if sensors.bias.enabled:
        torque, wrench = _biased(torque, wrench, sensors, np.random.default_rng([seed, 0]))
    position, base, turn = (
        require_field(truth, f) for f in ("joint_position", "base_position_world", "base_quat_xyzw")
    )
    if sensors.noise.enabled:
        rng, noise = np.random.default_rng([seed, 1, zlib.crc32(name.encode())]), sensors.noise

        def noisy(values: Array, deviation: float | Array) -> Array:
            return values + deviation * rng.normal(size=values.shape)

        position, base = noisy(position, noise.joint_position), noisy(base, noise.base_position)
        turns = Rotation.from_rotvec(noise.base_orientation * rng.normal(size=(len(truth), 3)))
        turn = (Rotation.from_quat(turn) * turns).as_quat()
        torque = noisy(torque, noise.joint_torque)
        wrench = noisy(wrench, np.repeat([noise.contact_force, noise.contact_moment], 3))
    return Log(
        name,
        time=truth.time,
        joint_names=truth.joint_names,
        joint_position=position,
        joint_torque=torque,
        base_position_world=base,
        base_quat_xyzw=turn,
        contact_names=truth.contact_names,
        contact_active=_loaded(wrench, sensors.contact_threshold),
        contact_wrench_local=wrench,
    )


def _biased(
    torque: Array, wrench: Array, sensors: SensorImperfectionsConfig, rng: np.random.Generator
) -> tuple[Array, Array]:
    levels = sensors.bias
    offset = np.repeat([levels.contact_force, levels.contact_moment], 3)
    return (
        torque * (1.0 + levels.gain * rng.normal(size=torque.shape[1]))
        + levels.joint_torque * rng.normal(size=torque.shape[1]),
        wrench * (1.0 + levels.gain * rng.normal(size=wrench.shape[1:])) + offset * rng.normal(size=wrench.shape[1:]),
    )


def _loaded(wrench: Array, threshold: float) -> BoolArray:
    """Which feet stand, (N, F): force along its mean direction above the threshold."""
    force = wrench[..., :3]
    mean = force.mean(axis=0)
    direction = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    return np.einsum("nfi,fi->nf", force, direction) > threshold
