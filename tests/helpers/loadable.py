"""Whether simulators take a written URDF as it is."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pinocchio as pin
import pytest


def assert_loads(path: Path, mass: float, meshes: int | None = None) -> mujoco.MjModel:
    """Both programs take the file as it is and find this mass [kg]; MuJoCo welds the root to the world."""
    pinocchio = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
    assert sum(one.mass for one in pinocchio.inertias) == pytest.approx(mass, rel=1e-12)
    model = mujoco.MjModel.from_xml_path(str(path))
    moving = sum(one.mass for one in pinocchio.inertias[2:])
    assert model.body_mass.sum() == pytest.approx(moving, rel=1e-12)
    if meshes is not None:
        assert model.nmesh == meshes
    return model
