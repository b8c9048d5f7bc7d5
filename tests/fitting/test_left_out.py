"""Terms that are there are adopted, others are not; a band that the model does not predict is left."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import UR5

import torchid
from torchid.fitting.fit import LogFitter
from torchid.fitting.left_out import (
    TERMS,
    Evidence,
    Reading,
    block_edges,
    choose_terms,
    compress_reading,
    gain_deviations,
    thinned,
    widest,
)
from torchid.parameters import FRICTION
from torchid.problem import ExtraTerms, Samples, bind_log
from torchid.problem.compression import compress_parts

NOISE, STEP = 0.3, 0.01  # N m, s
WIDE = ExtraTerms(armature=True, torque_offset=True, asymmetric_coulomb=True, stiffness=True, slope=True)
ARM = torchid.load_robot(UR5, fixed_base=True)


def recorded(
    seed: int,
    rotor: float = 0.0,
    spring: float = 0.0,
    offset: float = 0.0,
    late: float = 0.0,
    ringing: float = 0.0,
    encoder: float = 2e-5,
    gains: float = 0.0,
    reach: float = 1.0,
) -> torchid.Log:
    """The log of an arm whose bodies are up to 20 % off its URDF; `ringing` at 30 Hz is in no model [rad/s^2].

    `gains`: standard deviation of those of the torque sensors. `reach`: of the motion.
    """
    rng, t = np.random.default_rng(seed), np.arange(3000) * STEP
    pace, phase, size = (rng.uniform(*ends, (3, ARM.n)) for ends in ((1.0, 7.0), (0.0, 6.0), (0.1, 0.35)))

    def motion(time: np.ndarray) -> tuple[np.ndarray, ...]:
        turns = pace * time[:, None, None] + phase
        return tuple((size * pace**k * np.sin(turns + k * np.pi / 2.0)).sum(axis=1) for k in range(3))

    phi = ARM.nominal * rng.uniform(0.8, 1.2, (len(ARM.bodies), 1))
    phi[1:, FRICTION] = rng.uniform(0.2, 1.0, (ARM.n, 2))
    size *= reach
    q, v, a = motion(t - late)
    torque = torchid.Regressor(ARM)(*map(torch.from_numpy, (q, v, a))).numpy() @ phi.flatten()
    torque += rotor * a + spring * q + offset + NOISE * rng.normal(size=q.shape)
    torque *= 1.0 + gains * rng.normal(size=ARM.n)
    shaken = ringing * np.sin(2.0 * np.pi * 30.0 * t)[:, None] / (2.0 * np.pi * 30.0) ** 2
    seen = motion(t)[0] + shaken + encoder * rng.normal(size=q.shape)
    return torchid.Log("arm.npz", t, ARM.joint_names, seen, joint_torque=torque)


def fitter_of(terms: ExtraTerms, ridge: float = 0.1) -> LogFitter:
    sensors = torchid.named_sensors("joints", ARM.n, 0, torchid.SensorNoise(NOISE))
    builder = torchid.RowBuilder(ARM, [], sensors, terms)
    return LogFitter(robot=ARM, builder=builder, estimator=torchid.LeastSquares(ridge))


def bound(log: torchid.Log, cutoff_hz: float = 15.0) -> Samples:
    return bind_log(torchid.preprocess(log, cutoff_hz=cutoff_hz), ARM, [])


def reading(log: torchid.Log, cutoff_hz: float = 15.0, gain: float = 0.0) -> Reading:
    some, terms = thinned([bound(log, cutoff_hz)]), WIDE
    terms = replace(terms, scales={"joint_torque": "all"}) if gain else terms
    return compress_reading(some, block_edges([bound(log)]), fitter_of(terms), gain)


@pytest.mark.parametrize("seed", range(3))
def test_terms_of_actuators_are_adopted_where_they_are_and_not_where_they_are_not(seed: int) -> None:
    there = {"rotor": ("armature", 0.3), "offset": ("torque_offset", 2.0), "spring": ("stiffness", 8.0)}
    for key, (name, value) in there.items():
        assert [*choose_terms(reading(recorded(seed, **{key: value})), TERMS).adopted] == [name]
    assert {*choose_terms(reading(recorded(seed, rotor=0.3, late=0.02)), TERMS).adopted} == {"armature", "delay"}
    nothing = choose_terms(reading(recorded(seed)), TERMS)
    assert not nothing.adopted
    assert {*nothing.rejected} == {*TERMS}
    assert str(nothing).startswith("none")


def test_a_band_with_ringing_is_left_and_one_without_it_is_not() -> None:
    for ringing, expected in ((30.0, 1), (0.0, 0)):
        log = recorded(1, ringing=ringing, encoder=1e-7)  # whose noise is none of its accelerations at 40 Hz
        assert widest([reading(log, 40.0), reading(log, 10.0)], ()) == expected


def test_blocks_that_differ_by_chance_are_no_evidence() -> None:
    same = np.random.default_rng(0).uniform(1.0, 2.0, 20)
    assert not Evidence.of(same, same).certain
    assert Evidence.of(same, same[::-1]).significance == pytest.approx(0.0, abs=1e-9)
    assert Evidence.of(1.2 * same, same).adopted
    assert not Evidence.of(1.01 * same, same).adopted, "certain, but a trifle"


def test_errors_of_gains_move_parameters_as_a_fit_of_other_readings_says() -> None:
    log, fitter = replace(bound(recorded(2)), motion_noise=None), fitter_of(ExtraTerms())
    found = gain_deviations([log], fitter, ExtraTerms(), 0.01)
    assert found.shape == (ARM.n, ARM.nominal.size)
    assert log.torque is not None
    before = fitter.fit(compress_parts([log], fitter.builder)).estimate.phi
    for joint in (1, 4):
        gained = log.torque.clone()
        gained[:, joint] *= 1.01
        after = fitter.fit(compress_parts([replace(log, torque=gained)], fitter.builder)).estimate.phi
        np.testing.assert_allclose(found[joint], after - before, atol=1e-8 * np.abs(after - before).max(), rtol=1e-6)
    assert not len(gain_deviations([log], fitter, ExtraTerms(scales={"joint_torque": "all"}), 0.01))


def test_a_term_that_errors_of_gains_explain_is_not_adopted() -> None:
    """Torques of the weight change with the position as those of a spring do, and are 5 % off here."""
    log = recorded(3, gains=0.05, reach=0.3)
    assert choose_terms(reading(log), TERMS).adopted
    assert not choose_terms(reading(log, gain=0.05), TERMS).adopted
    there = recorded(3, rotor=0.3, gains=0.05)
    assert set(choose_terms(reading(there, gain=0.05), TERMS).adopted) == {"armature"}
    hidden = recorded(6, rotor=0.05, gains=0.05, reach=0.3)  # by these errors
    assert set(choose_terms(reading(hidden, gain=0.05), TERMS).adopted) == {"armature"}
