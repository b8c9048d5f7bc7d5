"""The posterior of a fit: its file, its names, its module."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from demo import DEMO
from synthetic import UR5, Oracle, load

import torchid
from torchid.errors import InputError
from torchid.estimators import violations
from torchid.fitting.posterior import POSTERIOR, posterior_arrays, read_posterior, write_posterior

ESTIMATOR: dict[str, Any] = {
    "name": "consistent",
    "ridge": 1e-3,
    "bounds": {"front_left_shank_link": {"m": [0.2, 0.4]}},
    "symmetry": {"left": "left_", "right": "right_"},
    "total_mass": 21.4,
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> torchid.Identification:
    output = tmp_path_factory.mktemp("posterior") / "run"
    return torchid.identify(DEMO / "quadruped.yaml", estimator=ESTIMATOR, actuators={"armature": True}, output=output)


def folder(run: torchid.Identification) -> Path:
    assert run.experiment.config.output is not None
    return run.experiment.config.output


def test_samples_of_a_run_are_inside_all_its_conditions(run: torchid.Identification) -> None:
    samples = torchid.PosteriorSampler(folder(run)).sample(300, torch.Generator().manual_seed(0))
    scale = run.posterior.posterior.scale.reshape(-1, 12)
    conditions = run.experiment.conditions()
    assert conditions.mirrors
    for phi in samples.phi.numpy():
        assert not violations(phi, scale, conditions)
    np.testing.assert_allclose(samples.mass.sum(1), 21.4, rtol=1e-9)
    armature = samples.of_joints("armature")
    assert set(armature) == set(run.experiment.robot.joint_names)
    assert all(float(x.min()) > 0.0 for x in armature.values())


def test_file_and_memory_give_the_same_samples(run: torchid.Identification) -> None:
    one, other = (
        torchid.PosteriorSampler(of).sample(50, torch.Generator().manual_seed(3))
        for of in (folder(run) / POSTERIOR, run.posterior)
    )
    torch.testing.assert_close(one.phi, other.phi, rtol=0.0, atol=0.0)
    torch.testing.assert_close(one.extras, other.extras, rtol=0.0, atol=0.0)
    assert one.extra_names == tuple(f"armature of {name}" for name in run.experiment.robot.joint_names)


def test_centre_and_inertia_of_samples_are_those_of_their_parameters(run: torchid.Identification) -> None:
    samples = torchid.PosteriorSampler(run.posterior).sample(3)
    for number, sets in enumerate(samples.phi.numpy()):
        for body, phi in enumerate(sets):
            mass, com, inertia = torchid.parameters.mass_com_inertia(phi)
            np.testing.assert_allclose(samples.mass[number, body], mass)
            np.testing.assert_allclose(samples.center_of_mass[number, body], com)
            np.testing.assert_allclose(samples.inertia[number, body], inertia, rtol=1e-9, atol=1e-12)


def test_samples_are_as_wide_as_standard_errors_where_the_data_speak(run: torchid.Identification) -> None:
    estimate = run.estimate
    samples = torchid.PosteriorSampler(run.posterior).sample(2000, torch.Generator().manual_seed(0))
    viscous = np.arange(23, estimate.phi.size, 12)  # the prior has no say in them
    known = viscous[estimate.verdict[viscous] == "identified"]
    assert len(known) == 12
    deviation = samples.phi.flatten(1).numpy().std(axis=0)
    ratio = deviation[known] / estimate.standard_error[known]
    assert 0.4 < np.median(ratio) < 1.3  # mirror images share what both legs say of them


def test_friction_that_is_many_times_the_usual_stays_where_the_data_have_it(tmp_path: Path) -> None:
    robot, rng = load(UR5, fixed_base=True), np.random.default_rng(0)
    oracle, time = Oracle.of(robot), np.arange(1500) / 100.0
    phase = 2.0 * np.pi * time[:, None] * rng.uniform(0.2, 0.5, robot.n) + rng.uniform(0.0, 6.0, robot.n)
    rate = np.gradient(phase, time, axis=0)
    q, v, a = 0.8 * np.sin(phase), 0.8 * rate * np.cos(phase), -0.8 * rate**2 * np.sin(phase)
    torque = oracle.frictionless_forces(q, v, a) + 40.0 * np.sign(v) + 15.0 * v + rng.normal(size=q.shape)
    log = {"joint_position": q, "joint_velocity": v, "joint_acceleration": a, "joint_torque": torque}
    np.savez(tmp_path / "log.npz", time=time, joint_names=np.array(robot.joint_names), **log)
    run = torchid.identify(
        robot={"urdf": UR5, "fixed_base": True}, sensors="joints", logs={"train": [tmp_path / "log.npz"]}, output=None
    )
    friction = torchid.PosteriorSampler(run.posterior).sample(1000, torch.Generator().manual_seed(0)).coulomb_friction
    mean, error = friction[:, 1:].mean(0).numpy(), run.estimate.standard_error.reshape(-1, 12)[1:, 10]
    assert np.abs(mean - 40.0).max() < 4.0 * error.max()


def test_a_sampler_of_less_than_float64_says_so(run: torchid.Identification) -> None:
    sampler = torchid.PosteriorSampler(run.posterior).float()
    with pytest.raises(ValueError, match="accepted: float64"):
        sampler.sample(2)
    with pytest.raises(ValueError, match="count: found 0"):
        torchid.PosteriorSampler(run.posterior).sample(0)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"format": np.array(99)}, "another version"),
        ({"A": np.zeros((3, 5))}, "A is no array"),
        ({"b": np.array([np.nan])}, "not finite"),
        ({"scale": np.zeros(156)}, "not positive"),
        ({"mirror_bodies": np.array([[0, 99]])}, "no posterior"),
        ({"nominal": None}, "nominal"),
    ],
)
def test_a_damaged_file_ends_in_one_line(
    run: torchid.Identification, tmp_path: Path, change: dict[str, Any], complaint: str
) -> None:
    arrays = posterior_arrays(run.posterior) | change
    file = tmp_path / POSTERIOR
    np.savez(file, **{name: x for name, x in arrays.items() if x is not None})
    with pytest.raises(InputError, match=complaint) as caught:
        read_posterior(file)
    assert "\n" not in str(caught.value)


def test_what_is_written_is_read_again(run: torchid.Identification, tmp_path: Path) -> None:
    file = tmp_path / POSTERIOR
    write_posterior(file, run.posterior)
    again = posterior_arrays(read_posterior(file))
    for name, array in posterior_arrays(run.posterior).items():
        np.testing.assert_array_equal(again[name], array)


def test_a_truncated_file_ends_in_one_line(run: torchid.Identification, tmp_path: Path) -> None:
    file = tmp_path / POSTERIOR
    file.write_bytes((folder(run) / POSTERIOR).read_bytes()[:1000])
    with pytest.raises(InputError, match=POSTERIOR):
        read_posterior(file)
