"""The centre of pressure of predicted and measured forces."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from random_samples import random_samples
from scipy.spatial.transform import Rotation

import torchid
from torchid.parameters import PER_BODY
from torchid.problem import Evaluation, Samples
from torchid.problem.metrics import PRESSURE, centre_of_pressure
from torchid.problem.motion import BaseMotion

ROBOT = torchid.load_robot(Path(torchid.__file__).parent / "demo" / "quadruped.urdf")
FEET = [torchid.Contact(f"{end}_{side}_foot", "point") for end in ("front", "rear") for side in ("left", "right")]
FORCE = [0, 1, 2]  # of the six components of a wrench, those that a point contact exerts
STANDING = (True,) * 4


def test_it_is_the_mean_of_where_forces_act_by_what_each_carries() -> None:
    """Against the definition, in a world that is turned at random."""
    rng = np.random.default_rng(0)
    R = Rotation.random(random_state=0).as_matrix()
    points = np.append(rng.normal(size=(5, 4, 2)), np.full((5, 4, 1), -0.7), axis=2)  # 0.7 m below the base's origin
    forces = rng.normal(size=(5, 4, 3)) + [0.0, 0.0, 6.0]
    share = forces[..., 2:] / forces[..., 2:].sum(1, keepdims=True)
    wrench = np.concatenate([forces.sum(1) @ R.T, np.cross(points, forces).sum(1) @ R.T], axis=1)
    normal, height = torch.from_numpy(np.tile(R[:, 2], (5, 1))), torch.full((5,), 0.7, dtype=torch.float64)
    found = centre_of_pressure(torch.from_numpy(wrench), normal, height)
    np.testing.assert_allclose(found, (share * points).sum(1) @ R.T, rtol=0.0, atol=1e-10)
    moment = wrench[:, 3:] - np.cross(found, wrench[:, :3])
    np.testing.assert_allclose(np.cross(moment, R[:, 2]), 0.0, atol=1e-10)
    assert centre_of_pressure(-torch.from_numpy(wrench), normal, height).isnan().all(), "nothing is carried"
    assert centre_of_pressure(torch.from_numpy(wrench), normal, height, least=1e3).isnan().all()


def at_rest(active: tuple[bool, ...]) -> tuple[Samples, np.ndarray]:
    """Poses in which the feet carry exactly what the file's bodies weigh, and the rotations of the base."""
    samples, (q, v, a) = random_samples(ROBOT, FEET, 6, 1)
    q, still = torch.from_numpy(q), torch.from_numpy(np.zeros_like(v))
    K = torchid.Regressor(ROBOT)(q, still, still)
    J = torch.cat([torchid.FrameJacobian(ROBOT, foot.frame)(q)[:, FORCE] for foot in FEET], dim=1)
    weight = K @ torch.from_numpy(ROBOT.nominal.flatten())
    forces = torch.linalg.lstsq(J[..., :6].mT, weight[:, :6, None], driver="gelsd").solution
    base = BaseMotion.from_coordinates(q, still, torch.from_numpy(np.zeros_like(a)), fixed_base=False)
    motion = {f"joint_{name}": torch.zeros_like(samples.joint_velocity) for name in ("velocity", "acceleration")}
    wrench = torch.zeros_like(samples.wrench)
    wrench[..., FORCE] = forces.view(6, 4, 3)
    flags = torch.tensor(active).expand(6, 4).clone()
    return replace(samples, base=base, wrench=wrench, active=flags, **motion), base.rotation.numpy()


def test_a_trunk_whose_mass_lies_elsewhere_moves_it_by_its_share_of_the_weight() -> None:
    samples, rotation = at_rest(STANDING)
    evaluation, shift = Evaluation(ROBOT, FEET), 0.02
    moved = ROBOT.nominal.copy()
    moved[0, 1] += shift * moved[0, 0]
    exact, off = evaluation.metrics([samples], np.stack([ROBOT.nominal.flatten(), moved.flatten()]))
    assert exact.rms[PRESSURE] == pytest.approx(0.0, abs=1e-10)
    along_ground = np.square(rotation[:, :2, 0]).sum(1)  # of the trunk's x axis
    expected = shift * moved[0, 0] / moved[:, 0].sum() * np.sqrt(along_ground.mean())
    assert off.rms[PRESSURE] == pytest.approx(expected, rel=1e-10)
    assert off.as_dict()["centre_of_pressure_rms"] == off.rms[PRESSURE]


def test_there_is_none_where_nothing_is_carried_or_measured() -> None:
    samples, _ = at_rest(STANDING)
    nominal, without = ROBOT.nominal.reshape(1, -1), Evaluation(ROBOT, FEET)
    assert nominal.shape[1] == PER_BODY * len(ROBOT.bodies)
    for log in (
        replace(samples, active=torch.zeros_like(samples.active)),
        replace(samples, wrench=None),
        replace(samples, wrench=0.05 * samples.wrench),
        replace(samples, base=replace(samples.base, quat_xyzw=None)),
    ):
        (metrics,) = without.metrics([log], nominal)
        assert PRESSURE not in metrics.rms
        assert metrics.as_dict()["centre_of_pressure_rms"] is None
