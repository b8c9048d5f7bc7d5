"""The equations that every fit is made of, in two ways: by the public modules, and by the fast path that fits take.

A good place to start reading. The public modules spell the paper's equations out: `Regressor` gives K and
`FrameJacobian` J_C, with `K phi = S^T tau + J_C^T lambda`; `Projection` multiplies both sides by V_x^T, which removes
the forces that are not measured, and whitens the noise of the others. `RowBuilder` makes the same equations from the
same kernels, but never forms K. Null-space bases are unique up to a rotation, so that A and b of `A phi = b` differ,
but neither A^T A nor A^T b, which are all that a least-squares fit depends on.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from random_samples import NOISE, random_samples, sensor_set
from synthetic import Array

import torchid
from torchid.identifiability.base_parameters import merge_state_reports, state_reports
from torchid.problem import RowBuilder, compress
from torchid.problem.chunks import chunks_by_state

ROBOT = torchid.load_robot(Path(torchid.__file__).parent / "demo" / "quadruped.urdf")
FEET = [torchid.Contact(f"{end}_{side}_foot", "point") for end in ("front", "rear") for side in ("left", "right")]
FORCE = [0, 1, 2]  # of the six components of a wrench, those that a point contact exerts


SENSOR_SETS = {name: sensor_set(name, ROBOT, FEET) for name in ("full", "contacts", "joints", "mixed")}
SAMPLES, STATE = random_samples(ROBOT, FEET, 60, 0)


RESTING = torch.from_numpy(np.random.default_rng(3).random((len(SAMPLES), ROBOT.n)) < 0.3)
"""Joints whose torque counts as unmeasured, others in each sample."""


def by_public_modules(sensors: torchid.SensorSet) -> tuple[Array, Array]:
    """A and b of all samples, from K, J_C and their projection."""
    samples, (q, v, a) = SAMPLES, map(torch.from_numpy, STATE)
    K = torchid.Regressor(ROBOT)(q, v, a)  # (B, n_rows, 12 L)
    J_C = torch.cat([torchid.FrameJacobian(ROBOT, foot.frame)(q)[:, FORCE] for foot in FEET], dim=1)
    project = torchid.Projection(
        sensors.torque,
        sensors.wrench[:, FORCE].flatten(),
        torque_noise=NOISE.joint_torque,
        wrench_noise=NOISE.contact_force,
        base_noise=torch.from_numpy(NOISE.base_std),
    )
    active = samples.active.repeat_interleave(len(FORCE), dim=1)
    groups = project(J_C, active, K, samples.torque, samples.wrench[..., FORCE].flatten(1))
    assert len({tuple(group.active.tolist()) for group in groups}) > 10, "many contact states"
    return (
        torch.cat([group.K.flatten(0, 1) for group in groups]).numpy(),
        torch.cat([group.f.flatten() for group in groups]).numpy(),
    )


def by_row_builder(sensors: torchid.SensorSet) -> tuple[Array, Array]:
    """The same of the fast path, its columns expanded to the bodies' parameters."""
    builder = RowBuilder(ROBOT, FEET, sensors)
    rows = torch.cat([builder.rows_by_sample(SAMPLES[index], state)[0] for state, index in chunks_by_state(SAMPLES)])
    rows = rows.flatten(0, 1).numpy()
    return rows[:, :-1] @ builder.columns.parameter_map, rows[:, -1]


@pytest.mark.parametrize("name", SENSOR_SETS)
def test_both_ways_give_the_same_equations_up_to_a_rotation(name: str) -> None:
    (A, b), (A_fast, b_fast) = (way(SENSOR_SETS[name]) for way in (by_public_modules, by_row_builder))
    size = np.linalg.norm(A, axis=0) + 1e-3 * np.linalg.norm(A)
    np.testing.assert_allclose(
        A_fast.T @ A_fast / np.outer(size, size), A.T @ A / np.outer(size, size), rtol=0.0, atol=1e-14
    )
    np.testing.assert_allclose(A_fast.T @ b_fast / size, A.T @ b / size, rtol=0.0, atol=1e-14 * np.linalg.norm(b))
    assert np.linalg.norm(b_fast) == pytest.approx(np.linalg.norm(b), rel=1e-13)


@pytest.mark.parametrize("name", SENSOR_SETS)
def test_a_torque_is_unmeasured_where_its_joint_rests(name: str) -> None:
    sensors = SENSOR_SETS[name]
    builder = RowBuilder(ROBOT, FEET, sensors)
    factor, gram, equations = compress([replace(SAMPLES, resting=RESTING)], builder), 0.0, 0
    for number, (resting, active) in enumerate(zip(RESTING.numpy(), SAMPLES.active.tolist(), strict=True)):
        own = RowBuilder(ROBOT, FEET, replace(sensors, torque=sensors.torque & ~resting))  # a sensor set of its own
        rows, W = own.rows_by_sample(SAMPLES[number : number + 1], tuple(active))
        gram, equations = gram + (rows[0].T @ rows[0]).numpy(), equations + int(W.any(1).sum())
    R = factor.triangle().numpy()
    size = np.linalg.norm(R, axis=0) + 1e-3 * np.linalg.norm(R)
    np.testing.assert_allclose(R.T @ R / np.outer(size, size), gram / np.outer(size, size), rtol=0.0, atol=1e-14)
    reports = state_reports([replace(SAMPLES, resting=RESTING)], builder)
    assert sum(one.samples * (one.mean_rows or 0.0) for one in reports) == pytest.approx(equations, rel=1e-14)
    assert {one.mean_rows for one in state_reports([SAMPLES], builder)} == {None}
    third = len(SAMPLES) // 3
    parts = [replace(SAMPLES, resting=RESTING)[part] for part in (slice(0, third), slice(third, None))]
    merged = {one.name: one for one in merge_state_reports(state_reports([part], builder) for part in parts)}
    assert len(merged) == len(reports)
    for one in reports:
        same = merged[one.name]
        assert (same.samples, same.rows, same.base_rank) == (one.samples, one.rows, one.base_rank)
        assert same.mean_rows == pytest.approx(one.mean_rows, rel=1e-14)
        assert same.base_rank_shares == pytest.approx(one.base_rank_shares, rel=1e-14)
    assert factor.rows == equations
    assert (equations < compress([SAMPLES], builder).rows) == sensors.torque.any()
