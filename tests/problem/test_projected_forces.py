"""Joint torques, predicted with the contact forces that explain them best."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from repository import DEMO

from torchid.config import load_config
from torchid.fitting.experiment import Experiment, set_up
from torchid.problem import RowBuilder, Samples
from torchid.problem.chunks import chunks_by_state
from torchid.problem.metrics import force_series, torque_noise_series, torque_series
from torchid.reading.log_reader import LogReader
from torchid.sensing.projection import null_space
from torchid.sensing.sensors import SensorNoise


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


def test_predicted_torques_have_the_contact_forces_of_least_squares(
    experiment: Experiment, builder: RowBuilder, samples: Samples
) -> None:
    """Sample by sample: without a part of the error that any force on the feet would make."""
    phi = np.stack([experiment.robot.nominal.flatten(), 1.3 * experiment.robot.nominal.flatten()])
    _, forces = force_series(builder, samples, phi)
    torque, predicted = torque_series(builder, samples, forces)
    assert samples.torque is not None
    np.testing.assert_array_equal(torque[:, builder.tree.base_rows :], samples.torque)
    components = [list(contact.components) for contact in builder.contacts]
    jacobian = builder.contact_jacobian(samples).numpy()
    for number, active in enumerate(samples.active.tolist()):
        A = np.concatenate([jacobian[number, k, components[k]] for k in range(len(active)) if active[k]]).T
        error = (forces[:, number] - torque[number]).T
        expected = error - A @ np.linalg.lstsq(A, error, rcond=1e-9)[0]
        np.testing.assert_allclose((predicted[:, number] - torque[number]).T, expected, atol=1e-8)


def test_their_noise_is_that_of_the_torques_through_the_projection(builder: RowBuilder, samples: Samples) -> None:
    """The square root of the diagonal of P S P, S that of the torques, less what the filter takes."""
    base = builder.tree.base_rows
    std = np.linspace(0.1, 0.3, builder.tree.n)
    found = torque_noise_series(builder, samples[:60], SensorNoise(joint_torque=std.tolist()))
    S = torch.from_numpy(np.append(np.zeros(base), std))
    for state, index in chunks_by_state(samples[:60]):
        kinematics = builder.kinematics(samples[:60][index])
        coupled = [*range(base), *(base + joint for joint in builder.layout(state).coupled_joints)]
        where = np.arange(60)[index if isinstance(index, slice) else index.numpy()]
        for part, V in builder.null_space_bases(state, kinematics):
            std = S.expand(len(V), -1).clone()
            std[:, coupled] = torch.sqrt(((V @ V.mT).square() * S[coupled].square()).sum(-1))
            chosen = where[part if isinstance(part, slice) else part.numpy()]
            np.testing.assert_allclose(found[chosen], std.numpy() * samples.noise_left**0.5, atol=1e-12)


def test_bases_limb_by_limb_span_what_a_decomposition_of_all_rows_does(builder: RowBuilder, samples: Samples) -> None:
    for state, index in chunks_by_state(samples):
        kinematics, layout = builder.kinematics(samples[index]), builder.layout(state)
        assert layout.has_own_limbs
        [(_, V)] = builder.null_space_bases(state, kinematics)
        [(_, expected)] = null_space(builder.contact_rows(layout, kinematics).of_unmeasured())
        np.testing.assert_allclose(V.mT @ V, np.broadcast_to(np.eye(6), (len(V), 6, 6)), atol=1e-14)
        np.testing.assert_allclose(V @ V.mT, expected @ expected.mT, atol=1e-13)
