"""The equations that every fit is made of, in two ways: by the public modules, and by the fast path that fits take.

A good place to start reading. The public modules spell the paper's equations out: `Regressor` gives K and
`FrameJacobian` J_C, with `K phi = S^T tau + J_C^T lambda`; `Projection` multiplies both sides by V_x^T, which removes
the forces that are not measured, and whitens the noise of the others. `RowBuilder` makes the same equations from the
same kernels, but never forms K. Null-space bases are unique up to a rotation, so that A and b of `A phi = b` differ,
but neither A^T A nor A^T b, which are all that a least-squares fit depends on.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic import Array, random_states

import torchid
from torchid.problem import RowBuilder, Samples
from torchid.problem.base_motion import BaseMotion
from torchid.problem.chunks import chunks_by_state

ROBOT = torchid.load_robot(Path(torchid.__file__).parent / "demo" / "quadruped.urdf")
FEET = [torchid.Contact(f"{end}_{side}_foot", "point") for end in ("front", "rear") for side in ("left", "right")]
FORCE = [0, 1, 2]  # of the six components of a wrench, those that a point contact exerts
NOISE = torchid.SensorNoise(joint_torque=0.3, contact_force=1.5, base_force=0.7, base_moment=0.05)


def random_samples(count: int = 60) -> tuple[Samples, tuple[torch.Tensor, ...]]:
    """Unrelated motion, torques, contact forces and contact states, and the generalized coordinates (q, v, a)."""
    rng = np.random.default_rng(0)
    q, v, a = map(torch.from_numpy, random_states(rng, ROBOT.n, count))
    wrench = np.zeros((count, len(FEET), 6))
    wrench[..., FORCE] = 20.0 * rng.normal(size=(count, len(FEET), 3))
    samples = Samples(
        source="random",
        time=0.01 * torch.arange(count, dtype=torch.float64),
        joint_position=q[:, 7:],
        joint_velocity=v[:, 6:],
        joint_acceleration=a[:, 6:],
        base=BaseMotion.from_coordinates(q, v, a),
        torque=torch.from_numpy(20.0 * rng.normal(size=(count, ROBOT.n))),
        wrench=torch.from_numpy(wrench),
        wrench_in_world=False,
        active=torch.from_numpy(rng.integers(0, 2, (count, len(FEET))).astype(bool)),
    )
    return samples, (q, v, a)


def some_sensors() -> torchid.SensorSet:
    """Every other joint torque, all of one foot's force, and the vertical force of another."""
    sensors = torchid.named_sensors("joints", ROBOT.n, len(FEET), NOISE)
    sensors.torque[1::2] = False
    sensors.wrench[0], sensors.wrench[1, 2] = True, True
    return sensors


SENSOR_SETS = {
    **{name: torchid.named_sensors(name, ROBOT.n, len(FEET), NOISE) for name in ("full", "contacts", "joints")},
    "some of each": some_sensors(),
}


def by_public_modules(sensors: torchid.SensorSet) -> tuple[Array, Array]:
    """A and b of all samples, from K, J_C and their projection."""
    samples, (q, v, a) = random_samples()
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
    samples, _ = random_samples()
    builder = RowBuilder(ROBOT, FEET, sensors)
    rows = torch.cat([builder.rows_by_sample(samples[index], state)[0] for state, index in chunks_by_state(samples)])
    rows = rows.flatten(0, 1).numpy()
    return rows[:, :-1] @ builder.columns.parameter_map(), rows[:, -1]


@pytest.mark.parametrize("name", SENSOR_SETS)
def test_both_ways_give_the_same_equations_up_to_a_rotation(name: str) -> None:
    (A, b), (A_fast, b_fast) = (way(SENSOR_SETS[name]) for way in (by_public_modules, by_row_builder))
    size = np.linalg.norm(A, axis=0) + 1e-3 * np.linalg.norm(A)
    np.testing.assert_allclose(A_fast.T @ A_fast / np.outer(size, size), A.T @ A / np.outer(size, size), atol=1e-13)
    np.testing.assert_allclose(A_fast.T @ b_fast / size, A.T @ b / size, rtol=0.0, atol=1e-13 * np.linalg.norm(b))
    assert np.linalg.norm(b_fast) == pytest.approx(np.linalg.norm(b), rel=1e-13)
