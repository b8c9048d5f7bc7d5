"""Rotor inertia that was not fitted is told from what else goes with accelerations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import UR5

import torchid
from torchid.fitting.armature import RotorInertia, UnfittedArmature, unfitted_armature
from torchid.fitting.delay import UnfittedDelay
from torchid.fitting.misfit import Misfit
from torchid.parameters import FRICTION
from torchid.problem import ExtraTerms, bind_log

ARMATURE, NOISE, SPRING = 0.3, 0.3, 3.0  # kg m^2, N m, N m/rad


def left_over(seed: int, rotor: float = 0.0, spring: float = 0.0, **terms: bool) -> UnfittedArmature | None:
    """What a fit with some terms leaves of the torques of an arm whose bodies are up to 20 % off its URDF."""
    arm, rng = torchid.load_robot(UR5, fixed_base=True), np.random.default_rng(seed)
    t = np.arange(1500) / 100.0
    pace, phase, size = (rng.uniform(*ends, (3, arm.n)) for ends in ((1.0, 7.0), (0.0, 6.0), (0.1, 0.35)))
    q, v, a = (
        (size * pace**k * np.sin(pace * t[:, None, None] + phase + k * np.pi / 2.0)).sum(axis=1) for k in range(3)
    )
    phi = arm.nominal * rng.uniform(0.8, 1.2, (len(arm.bodies), 1))
    phi[1:, FRICTION] = rng.uniform(0.2, 1.0, (arm.n, 2))
    torque = torchid.Regressor(arm)(*map(torch.from_numpy, (q, v, a))).numpy() @ phi.flatten()
    torque += rotor * a + spring * q + NOISE * rng.normal(size=q.shape)
    recorded = torchid.Log("arm.npz", t, arm.joint_names, q + 2e-5 * rng.normal(size=q.shape), joint_torque=torque)
    log = bind_log(torchid.preprocess(recorded, cutoff_hz=15.0), arm, [])
    sensors, extras = torchid.named_sensors("joints", arm.n, 0, torchid.SensorNoise(NOISE)), ExtraTerms(**terms)
    builder = torchid.RowBuilder(arm, [], sensors, extras)
    fitter = torchid.LogFitter(robot=arm, builder=builder, estimator=torchid.LeastSquares(ridge=1e-3))
    return unfitted_armature([log], fitter, extras)


@pytest.mark.parametrize("seed", range(3))
def test_rotors_show_and_their_absence_or_springs_do_not(seed: int) -> None:
    found = left_over(seed, ARMATURE)
    assert found is not None
    assert {x.joint for x in found.found} >= {"elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"}
    assert max(abs(x.value - ARMATURE) / x.standard_error for x in found.found) < 4.0
    for nothing in (left_over(seed), left_over(seed, spring=SPRING)):
        assert nothing is not None
        assert not nothing.significant
    assert left_over(seed, ARMATURE, armature=True) is None, "it was fitted"


def test_torques_that_are_late_and_forces_without_noise_show_no_rotors() -> None:
    rotors = UnfittedArmature((RotorInertia("knee", 0.3, 0.01, "kg m^2"), RotorInertia("slide", 2.0, 0.2, "kg")))
    shown = Misfit(1.0, 1.0, None, None, (), armature=rotors)
    assert not shown.explained
    assert str(shown) == (
        "torques go with accelerations as rotors would make them (knee 0.3 ± 0.01 kg m^2, slide 2 ± 0.2 kg;"
        " actuators.armature: true)"
    )
    assert "rotors" not in str(replace(shown, delay=UnfittedDelay(5e-3, 1e-3)))
    assert replace(shown, share=1e-8).explained
