"""What imperfect sensors make of an exact log: each imperfection alone does what it says and nothing else."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from motions import value
from scipy.spatial.transform import Rotation
from simulated import LIFTING, SOLES
from synthetic import Array

from torchid.config import SensorImperfectionsConfig
from torchid.config.simulation import BiasConfig, DelayConfig, WhiteNoiseConfig
from torchid.logs import Log, read_log
from torchid.simulation import sensor_log

NONE = SensorImperfectionsConfig()
NOISE = WhiteNoiseConfig(True, 1e-3, 2e-3, 3e-3, 0.4, 5.0, 0.6)
BIAS = BiasConfig(True, 1.5, 20.0, 2.5, 0.03)
EXACT = ("joint_position", "joint_torque", "base_position_world", "base_quat_xyzw", "contact_wrench_local")


def truth(
    samples: int, joints: int = 2, feet: int = 2, rate: float = 1000.0, source: str = "m", **fields: Array
) -> Log:
    """An exact log with all derivatives, of a robot that turns and pushes; `fields` replace the moving ones."""
    t = np.arange(samples) / rate
    each = np.arange(joints)
    quat = Rotation.from_rotvec(np.stack([0.3 * np.sin(t), 0.2 * np.cos(2 * t), t], axis=1)).as_quat(canonical=True)
    zeros, force = np.zeros((samples, 3)), np.zeros((samples, feet, 6))
    force[..., 2] = 300.0 + 200.0 * np.sin(3 * t[:, None] + np.arange(feet))
    force[..., 3] = 10.0 * np.cos(5 * t[:, None])
    arrays: dict[str, Any] = {
        "joint_position": np.sin(t[:, None] + each), "joint_velocity": np.cos(t[:, None] + each),
        "joint_acceleration": -np.sin(t[:, None] + each), "joint_torque": 20.0 * np.cos(2 * t[:, None] + each),
        "base_position_world": np.stack([t, 0.1 * t, 0.7 + 0 * t], axis=1), "base_quat_xyzw": quat,
        "base_linear_velocity_world": zeros, "base_angular_velocity_base": zeros,
        "base_linear_acceleration_world": zeros, "base_angular_acceleration_base": zeros,
        "contact_active": np.ones((samples, feet), bool), "contact_wrench_local": force,
    }  # fmt: skip
    names = tuple(f"j{i}" for i in range(joints))
    return Log(source, t, names, contact_names=tuple(f"f{i}" for i in range(feet)), **arrays | fields)


def error(log: Log, exact: Log, name: str) -> Array:
    return np.asarray(value(getattr(log, name)) - value(getattr(exact, name)))


# ---------------------------------------------------------------------------------------------------- all switched off


def test_perfect_sensors_read_the_truth(biped_folder: Path) -> None:
    for exact in (truth(100), read_log(biped_folder / "exact" / f"{LIFTING}.npz")):
        log = sensor_log(exact, NONE, seed=3)
        for name in EXACT:
            np.testing.assert_array_equal(value(getattr(log, name)), value(getattr(exact, name)), err_msg=name)
        np.testing.assert_array_equal(log.time, exact.time)
        assert (log.joint_names, log.contact_names) == (exact.joint_names, exact.contact_names)


@pytest.mark.parametrize("sensors", [NONE, SensorImperfectionsConfig(NOISE, BIAS, DelayConfig(True))])
def test_no_sensor_reads_velocities_or_accelerations(sensors: SensorImperfectionsConfig) -> None:
    given = set(sensor_log(truth(100), sensors, seed=0).arrays())
    assert given == {"time", "contact_active", *EXACT}


# --------------------------------------------------------------------------------------------------------------- noise


def test_noise_is_white_and_as_strong_as_stated() -> None:
    exact = truth(20000)
    log = sensor_log(exact, SensorImperfectionsConfig(noise=NOISE), seed=0)
    turn = Rotation.from_quat(value(exact.base_quat_xyzw)).inv() * Rotation.from_quat(value(log.base_quat_xyzw))
    wrench = error(log, exact, "contact_wrench_local")
    for found, deviation in (
        (error(log, exact, "joint_position"), NOISE.joint_position),
        (error(log, exact, "base_position_world"), NOISE.base_position),
        (turn.as_rotvec(), NOISE.base_orientation),
        (error(log, exact, "joint_torque"), NOISE.joint_torque),
        (wrench[..., :3].reshape(-1, 6), NOISE.contact_force),
        (wrench[..., 3:].reshape(-1, 6), NOISE.contact_moment),
    ):
        spread = 4.0 / np.sqrt(2 * len(found))  # four standard deviations of an estimated standard deviation
        np.testing.assert_allclose(found.std(axis=0), deviation, rtol=spread)
        assert np.abs(found.mean(axis=0)).max() < 5.0 * deviation / np.sqrt(len(found))
        together = np.corrcoef(np.hstack([found[1:], found[:-1]]).T) - np.eye(2 * found.shape[1])
        assert np.abs(together).max() < 5.0 / np.sqrt(len(found)), "channels or samples go together"


def test_the_same_seed_and_name_give_the_same_noise_and_others_another() -> None:
    sensors = SensorImperfectionsConfig(noise=NOISE)
    first = value(sensor_log(truth(50), sensors, seed=0).joint_torque)
    np.testing.assert_array_equal(first, value(sensor_log(truth(50), sensors, seed=0).joint_torque))
    assert not np.isclose(first, value(sensor_log(truth(50), sensors, seed=1).joint_torque)).any()
    assert not np.isclose(first, value(sensor_log(truth(50, source="n"), sensors, seed=0).joint_torque)).any()


# ---------------------------------------------------------------------------------------------------------- bias, gain


def bias_and_gain(field: str, source: str, seed: int, samples: int = 2) -> tuple[Array, Array]:
    """Offsets and gain errors of all channels, from readings of 0 and 100."""
    size = (samples, 1000) if field == "joint_torque" else (samples, 200, 6)
    values = np.zeros(size)
    values[1::2] = 100.0
    given: dict[str, Any] = {field: values}
    exact = truth(samples, joints=1000, feet=200, source=source, **given)
    found = value(getattr(sensor_log(exact, SensorImperfectionsConfig(bias=BIAS), seed), field))
    offset, slope = found[0], (found[1] - found[0]) / 100.0
    np.testing.assert_allclose(found, offset + slope * values, rtol=0.0, atol=1e-12, err_msg="not constant")
    return offset, slope - 1.0


def test_bias_and_gain_are_as_large_as_stated_and_differ_by_channel() -> None:
    offset, gain = bias_and_gain("joint_torque", "m", 0)
    assert offset.std() == pytest.approx(BIAS.joint_torque, rel=0.1)
    assert gain.std() == pytest.approx(BIAS.gain, rel=0.1)
    force, force_gain = bias_and_gain("contact_wrench_local", "m", 0)
    for part, deviation in ((slice(3), BIAS.contact_force), (slice(3, 6), BIAS.contact_moment)):
        assert force[:, part].std() == pytest.approx(deviation, rel=0.15)
        assert force_gain[:, part].std() == pytest.approx(BIAS.gain, rel=0.15)
    for numbers in (offset, gain, force, force_gain):
        assert len(np.unique(numbers)) == numbers.size
        assert abs(numbers.mean()) < 5.0 * numbers.std() / np.sqrt(numbers.size)


# --------------------------------------------------------------------------------------------------------------- delay


@pytest.mark.parametrize(("rate", "seconds", "samples"), [(1000.0, 0.01, 10), (200.0, 0.01, 2), (1000.0, 0.0, 0)])
def test_late_feet_read_what_was_a_delay_ago_and_nothing_else_is_late(
    rate: float, seconds: float, samples: int
) -> None:
    exact = truth(300, rate=rate)
    log = sensor_log(exact, SensorImperfectionsConfig(delay=DelayConfig(True, seconds)), seed=0)
    late, on_time = value(log.contact_wrench_local), value(exact.contact_wrench_local)
    np.testing.assert_array_equal(late[samples:], on_time[: 300 - samples])
    np.testing.assert_array_equal(late[:samples], np.broadcast_to(on_time[0], (samples, 2, 6)))
    np.testing.assert_array_equal(value(log.joint_torque), value(exact.joint_torque))


# ------------------------------------------------------------------------------------------------------------ contacts


def test_a_contact_is_active_while_the_measured_load_exceeds_the_threshold() -> None:
    wrench = np.zeros((9, 2, 6))
    wrench[:, 0, 2] = [0, 20, 29, 31, 100, 500, 31, 29, 0]
    wrench[:, 1, 0] = [-500, -31, -29, 0, 0, 0, 0, 29, -500]  # a foot whose frame lies on its side
    wrench[:, 1, 5] = 1000.0  # moments do not count
    exact = truth(9, contact_wrench_local=wrench, contact_active=np.zeros((9, 2), bool))
    active = value(sensor_log(exact, NONE, seed=0).contact_active).astype(int)
    assert active[:, 0].tolist() == [0, 0, 0, 1, 1, 1, 1, 0, 0]
    assert active[:, 1].tolist() == [1, 1, 0, 0, 0, 0, 0, 0, 1]
    higher = dataclasses.replace(NONE, contact_threshold=99.0)
    assert value(sensor_log(exact, higher, seed=0).contact_active)[:, 0].astype(int).tolist() == [0] * 4 + [
        1,
        1,
        0,
        0,
        0,
    ]


# ------------------------------------------------------------------------------------- feet that read along the normal


def scalar_foot(samples: int = 200) -> tuple[Log, Log]:
    """An exact log whose first foot reads along the normal, and the same log with wrenches alone."""
    exact = truth(samples)
    force = 250.0 + 150.0 * np.sin(0.1 * np.arange(samples))
    normal = np.stack([force, np.full(samples, np.nan)], axis=1)
    return dataclasses.replace(exact, contact_force_normal=normal), exact


def test_a_foot_that_reads_along_the_normal_reads_nothing_else() -> None:
    exact, _ = scalar_foot()
    log = sensor_log(exact, NONE, seed=3)
    np.testing.assert_array_equal(value(log.contact_force_normal), value(exact.contact_force_normal))
    wrench = value(log.contact_wrench_local)
    assert np.isnan(wrench[:, 0]).all()
    np.testing.assert_array_equal(wrench[:, 1], value(exact.contact_wrench_local)[:, 1])
    alone = dataclasses.replace(exact, contact_force_normal=value(exact.contact_force_normal)[:, [0, 0]])
    log = sensor_log(alone, NONE, seed=3)
    assert log.contact_wrench_local is None
    np.testing.assert_array_equal(value(log.contact_force_normal), value(alone.contact_force_normal))


def test_contact_flags_are_read_off_the_measured_force_whatever_the_exact_log_says(biped_folder: Path) -> None:
    exact = read_log(biped_folder / "exact" / f"{LIFTING}.npz")
    sensors = SensorImperfectionsConfig(noise=dataclasses.replace(NOISE, enabled=True))
    flags = value(sensor_log(exact, sensors, seed=0).contact_active)
    lying = dataclasses.replace(exact, contact_active=~value(exact.contact_active))
    np.testing.assert_array_equal(value(sensor_log(lying, sensors, seed=0).contact_active), flags)
    assert (flags != value(exact.contact_active)).mean() < 0.02
    assert flags.any(axis=0).all()
    assert (~flags).any(axis=0).all()
    assert exact.contact_names == SOLES
