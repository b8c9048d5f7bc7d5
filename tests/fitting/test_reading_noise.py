"""Scales of noisy sensors: a reading with noise is a regressor with noise, whose coefficient comes out too small."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import SOLO12, UR5, Array, Oracle, load, make_log

from torchid import Regressor
from torchid.estimators import LeastSquares
from torchid.fitting.fit import LogFitter
from torchid.logs import Log
from torchid.parameters import FRICTION, perturb_parameters
from torchid.problem import ExtraTerms, RowBuilder, Samples, bind_log
from torchid.problem.compression import compress_in_blocks, compress_parts, merge_factors, split_into_folds
from torchid.problem.noise import SampledRows
from torchid.problem.noise_gram import scale_columns
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, named_sensors

JOINTS = ("wrist_1_joint", "wrist_2_joint", "elbow_joint")
REPETITIONS = 12


def arm_log(robot: Robot, seconds: float) -> tuple[Array, Log]:
    """True scales of `JOINTS`, and what exact sensors of an arm unlike its URDF would have read without them."""
    rng = np.random.default_rng(11)
    true = perturb_parameters(robot.nominal, 0.2, rng)
    true[1:, FRICTION] = rng.uniform((0.1, 0.05), (0.4, 0.2), (len(true) - 1, 2))
    time = np.arange(round(100.0 * seconds)) / 100.0
    w, phase = 2.0 * np.pi * rng.uniform(0.1, 0.8, (5, robot.n)), rng.uniform(0.0, 2.0 * np.pi, (5, robot.n))
    angle = w * time[:, None, None] + phase
    q, v, a = (0.4 * x.sum(axis=1) for x in (np.sin(angle), w * np.cos(angle), -(w**2) * np.sin(angle)))
    with torch.no_grad():
        K = Regressor(robot)(*(torch.from_numpy(x) for x in (q, v, a)))
        torque = (K @ torch.from_numpy(true.flatten())).numpy()
    rates = {"joint_velocity": v, "joint_acceleration": a}
    log = Log("arm", time=time, joint_names=robot.joint_names, joint_position=q, joint_torque=torque, **rates)
    return np.exp(rng.uniform(-0.3, 0.3, len(JOINTS))), log


@pytest.mark.parametrize(("noise", "stated"), [(0.3, 0.3), (0.3, 0.9), (0.003, 0.003)])
def test_scales_of_weak_joints_are_unbiased_and_intervals_hold_them(noise: float, stated: float) -> None:
    """Wrists of 3 N m, 9 and 10 times the noise, came out 7 and 4 % too small, 9 standard deviations."""
    robot = load(UR5, fixed_base=True)
    scales, log = arm_log(robot, 12.0)
    factor = np.ones(robot.n)
    factor[[robot.joint_names.index(joint) for joint in JOINTS]] = scales
    sensors = named_sensors("joints", robot.n, 0, SensorNoise(joint_torque=stated))
    builder = RowBuilder(robot, (), sensors, ExtraTerms(scales={"joint_torque": [[joint] for joint in JOINTS]}))
    fitter = LogFitter(robot=robot, builder=builder, estimator=LeastSquares())
    found, errors = np.zeros((2, REPETITIONS, len(JOINTS)))
    for number in range(REPETITIONS):
        off = noise * np.random.default_rng([number, 4]).normal(size=log.joint_torque.shape)
        samples = bind_log(replace(log, joint_torque=(log.joint_torque + off) / factor), robot, ())
        fit = fitter.fit(compress_in_blocks(split_into_folds([samples], builder), builder))
        values = {x.extra.name: (1.0 + x.value, x.standard_error) for x in fit.extras}
        found[number], errors[number] = np.array([values[joint] for joint in JOINTS]).T
    mean_error = found.std(axis=0, ddof=1) / np.sqrt(REPETITIONS)
    assert (np.abs(found.mean(axis=0) - scales) < 4.0 * mean_error).all()  # of Student's t, 0.1 % beyond
    inside = np.abs(found - scales) < 1.96 * errors
    assert inside.mean() > 0.85  # 95 % of 36, of which fewer are inside once in 100 times
    assert (errors.mean(axis=0) < 3.0 * found.std(axis=0)).all()


def coupled(scales: str | list[list[str]]) -> tuple[Robot, RowBuilder, Samples]:
    """A quadruped whose feet are not measured, so that a row has readings of several joints."""
    robot, feet = load(SOLO12), ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
    states = [[True] * 4, [True, False, False, True]]
    log = make_log(Oracle.of(robot), [(foot, 3) for foot in feet], states, 80, np.random.default_rng(2))
    contacts = tuple(Contact(foot, "point") for foot in feet)
    sensors = named_sensors("joints", robot.n, len(feet), SensorNoise(joint_torque=0.2))
    builder = RowBuilder(robot, contacts, sensors, ExtraTerms(scales={"joint_torque": scales}))
    return robot, builder, bind_log(log, robot, contacts)


def test_noise_of_a_reading_is_its_share_of_the_rows_whatever_basis_they_have() -> None:
    """By readings that are noise alone, and by the generalized force of a unit of each source of noise."""
    _, builder, samples = coupled("all")
    rows = SampledRows([samples], builder)
    grams = [
        merge_factors((part.factor for part in parts), builder).whole_noise_gram().diagonal()[scale_columns(builder)]
        for parts in (compress_parts([samples], builder), rows.compress(np.ones(len(rows.groups))))
    ]
    assert torch.allclose(grams[0], grams[1], rtol=1e-10)
    assert 0.0 < float(grams[0].min()) < float(grams[0].max()) < len(samples)


def test_exact_readings_lose_nothing() -> None:
    robot, builder, samples = coupled([["*HAA"], ["*KFE"]])
    fit = LogFitter(robot=robot, builder=builder, estimator=LeastSquares()).fit(compress_parts([samples], builder))
    assert [x.value for x in fit.extras] == pytest.approx([0.0, 0.0], abs=1e-7)
