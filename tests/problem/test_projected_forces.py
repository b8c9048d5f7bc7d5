"""The rows of a fit in units of forces."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from repository import DEMO

from torchid.config import load_config
from torchid.fitting.experiment import Experiment, set_up
from torchid.problem import RowBuilder, Samples
from torchid.problem.chunks import chunks_by_state
from torchid.problem.metrics import force_series, null_space_part, projected_forces
from torchid.reading.log_reader import LogReader
from torchid.sensing.projection import null_space


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    noise = "{joint_torque: 0.1, base_force: 0.3, base_moment: 0.05}"
    return set_up(load_config(DEMO / "quadruped.yaml", ["estimator.ridge=0.001", f"sensors.noise={noise}"]))


@pytest.fixture(scope="module")
def builder(experiment: Experiment) -> RowBuilder:
    return experiment.builder(experiment.sensors)


@pytest.fixture(scope="module")
def samples(experiment: Experiment) -> Samples:
    """Of a sway in which each foot lifts once."""
    (log,) = LogReader(experiment).read([DEMO / "sway_test.npz"], None)
    return log.every(5)


def test_they_are_the_forces_inside_the_null_space(
    experiment: Experiment, builder: RowBuilder, samples: Samples
) -> None:
    """Predictions from the rows and from subtree sums, projected orthogonally, agree; the wrench on feet drops out."""
    phi = np.stack([experiment.robot.nominal.flatten(), 1.3 * experiment.robot.nominal.flatten()])
    rows = projected_forces(builder, samples, builder.to_columns(phi))
    measured, predicted = force_series(experiment.evaluation().builder, samples, phi)
    whole = null_space_part(builder, samples, np.concatenate([measured[None], predicted]))
    np.testing.assert_allclose(rows.predicted, whole[1:], atol=1e-10)
    np.testing.assert_allclose(rows.measured, whole[0], atol=1e-10)


def test_their_noise_is_that_of_the_readings_through_the_projection(builder: RowBuilder, samples: Samples) -> None:
    """The square root of the diagonal of P S P, S diagonal as no wrench is measured, less what the filter takes."""
    found, base = projected_forces(builder, samples, builder.to_columns(np.zeros((1, 156)))), builder.tree.base_rows
    for state, index in chunks_by_state(samples):
        kinematics, layout = builder.kinematics(samples[index]), builder.layout(state)
        coupled = [*range(base), *(base + joint for joint in layout.coupled_joints)]
        where = np.arange(len(samples))[index if isinstance(index, slice) else index.numpy()]
        for part, V in builder.null_space_bases(state, kinematics):
            P = V @ V.mT
            std = torch.sqrt((P.square() * layout.row_std.square()).sum(-1) / samples.oversampling)
            chosen = where[part if isinstance(part, slice) else part.numpy()]
            np.testing.assert_allclose(found.noise[np.ix_(chosen, coupled)], std.numpy(), atol=1e-12)


def test_bases_limb_by_limb_span_what_a_decomposition_of_all_rows_does(builder: RowBuilder, samples: Samples) -> None:
    for state, index in chunks_by_state(samples):
        kinematics, layout = builder.kinematics(samples[index]), builder.layout(state)
        assert layout.has_own_limbs
        [(_, V)] = builder.null_space_bases(state, kinematics)
        [(_, expected)] = null_space(builder.contact_rows(layout, kinematics).of_unmeasured())
        np.testing.assert_allclose(V.mT @ V, np.broadcast_to(np.eye(6), (len(V), 6, 6)), atol=1e-14)
        np.testing.assert_allclose(V @ V.mT, expected @ expected.mT, atol=1e-13)
