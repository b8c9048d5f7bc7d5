"""The posterior of a fit: its file, its names, its module."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from demo import DEMO

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


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"format": np.array(99)}, "another version"),
        ({"A": np.zeros((3, 5))}, "A is not a number array"),
        ({"b": np.array([np.nan])}, "not finite"),
        ({"scale": np.zeros(156)}, "not positive"),
        ({"mirror_bodies": np.array([[0, 99]])}, "not a posterior"),
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
