"""The demo biped: what ships is what its description writes, and its halves mirror each other."""

from __future__ import annotations

import numpy as np
import pytest
from mujoco_oracle import INERTIA_ROUNDING
from paper.biped import biped_urdf
from scipy.spatial.transform import Rotation
from simulated import BIPED
from synthetic import load

from torchid import parameters
from torchid.robot import Robot
from torchid.simulation.plant import Plant


@pytest.fixture(scope="module")
def biped() -> Robot:
    return load(BIPED)


def test_the_urdf_that_ships_is_the_one_the_description_writes() -> None:
    assert BIPED.read_bytes() == biped_urdf()


def test_mujocos_bodies_are_torchids(biped: Robot) -> None:
    """The sum over bodies hides a swap: body by body, from MuJoCo's principal axes."""
    model = Plant(BIPED, (), 1000.0).model
    for body, phi in zip(biped.bodies, biped.nominal, strict=True):
        index = model.body(body.name).id
        R = Rotation.from_quat(model.body_iquat[index], scalar_first=True).as_matrix()
        com = model.body_ipos[index]
        inertia = R @ np.diag(model.body_inertia[index]) @ R.T
        expected = parameters.inertial_vector(float(model.body_mass[index]), com, inertia)
        np.testing.assert_allclose(
            phi[:10], expected, rtol=0.0, atol=(1e-14 + INERTIA_ROUNDING) * np.abs(expected).max()
        )
