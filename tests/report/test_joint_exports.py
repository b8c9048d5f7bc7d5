"""Joints for simulators have the friction and inertia that the equations have, and none is there that nobody drives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from synthetic import random_states

from torchid import Regressor, parameters
from torchid.report import FittedJoints
from torchid.report.robot_files import isaaclab_text, joint_parameters, parameters_export
from torchid.robot import Robot


def test_joints_have_the_friction_of_those_that_mimic_them(small: Robot) -> None:
    """Torques at the independent joints are those of the regressor, the follower's friction in the slide's."""
    rng, phi = np.random.default_rng(0), np.zeros_like(small.nominal)
    phi[1:, parameters.FRICTION] = rng.uniform(0.1, 1.0, (len(phi) - 1, 2))
    q, v, a = random_states(rng, small.n, 20)
    rows = (Regressor(small)(*map(torch.tensor, (q, v, a))).numpy() @ phi.flatten())[:, small.base_rows :]
    of_joints = zip(joint_parameters(small, phi, FittedJoints()), v[:, small.base_rows :].T, strict=True)
    torque = [joint.coulomb * np.sign(speed) + joint.viscous * speed for joint, speed in of_joints]
    np.testing.assert_allclose(np.column_stack(torque), rows, rtol=0.0, atol=1e-14)


def test_a_joint_that_mimics_another_is_no_actuator(small: Robot) -> None:
    joints = joint_parameters(small, small.nominal, FittedJoints({"slide": 0.3}))
    assert [joint.name for joint in joints] == ["hinge", "slide", "branch"]
    assert [joint.kind for joint in joints] == ["revolute", "prismatic", "revolute"]
    assert "follower" not in isaaclab_text(joints, "a run")
    document = parameters_export(small, small.nominal, joints)["joints"]
    assert document["slide"]["armature"] == pytest.approx(0.3)
    assert set(document) == {"hinge", "slide", "branch"}


def test_isaac_lab_keeps_what_was_not_identified(small: Robot) -> None:
    """It takes 0 for a joint that a mapping of an actuator does not name, and the asset's value without a mapping."""
    phi = np.zeros_like(small.nominal)
    phi[1, parameters.VISCOUS] = 0.2
    joints = joint_parameters(small, phi, FittedJoints({"slide": 0.0, "branch": 0.3}))
    given: dict[str, Any] = {}
    exec(
        isaaclab_text(joints, "a run").replace("from isaaclab.actuators import", "ImplicitActuatorCfg = dict #"), given
    )
    actuators = [x for name, x in given.items() if name.startswith("IDENTIFIED_ACTUATORS")]
    assert [x["joint_names_expr"] for x in actuators] == [["hinge"], ["slide", "branch"]]
    assert [{k: x for k, x in one.items() if isinstance(x, dict)} for one in actuators] == [
        {"viscous_friction": {"hinge": 0.2}},
        {"armature": {"slide": 0.0, "branch": 0.3}},
    ]
    document = parameters_export(small, phi, joints)["joints"]
    assert [x["armature"] for x in document.values()] == [None, 0.0, 0.3]
