"""Encoders of a bolted arm that count from another zero or the other way, and torques that lack gravity."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from faults import only
from mistaken import case_of, checked
from motions import value
from thinned import each_once
from walking import MACHINES, robot_of

from torchid.log_checks import REJECTED, SUSPICIOUS
from torchid.log_checks.encoders import fit_zeros
from torchid.log_checks.model import NominalModel, bind_some_samples, preprocess_pieces
from torchid.logs import Log
from torchid.regressor import Regressor

ARM = MACHINES["arm"]
CASE = case_of(ARM, "contacts")


def moved(joint: int, by: float) -> Log:
    position = CASE.log.joint_position.copy()
    position[:, joint] += by
    return replace(CASE.log, joint_position=position)


@pytest.mark.parametrize(
    ("joint", "by"),
    # 0.07 rad of the elbow are as well explained by other masses
    [case for case in each_once([1, 3], [0.2, -0.4, 0.07]) if case.values != (3, 0.07)],
)
def test_an_encoder_that_counts_from_another_zero_is_named_with_its_offset(joint: int, by: float) -> None:
    """Beside masses 15 % off, friction and lag."""
    finding = only(checked(CASE, moved(joint, by)), "zero", "joint_position")
    assert (finding.severity, finding.channels) == (SUSPICIOUS, (CASE.log.joint_names[joint],))
    found = re.search(r"read ([\d.]+) \+- ([\d.]+) rad too (much|little)", finding.found)
    assert found is not None
    assert float(found[1]) == pytest.approx(abs(by), abs=max(3.0 * float(found[2]), 0.02))
    assert found[3] == ("much" if by > 0.0 else "little")


def test_zeros_of_exact_forces_come_back_however_far_they_are() -> None:
    robot, happened = robot_of(ARM), CASE.happened
    motion = (torch.from_numpy(x) for x in (happened.q, happened.v, happened.a))
    torque = (Regressor(robot)(*motion) @ torch.from_numpy(robot.nominal.flatten())).numpy()
    true = replace(
        CASE.log,
        joint_position=happened.q,
        joint_velocity=happened.v,
        joint_acceleration=happened.a,
        joint_torque=torque,
    )
    (log,) = preprocess_pieces(true, 40.0)
    position = log.joint_position - np.array([0.0, 0.6, 0.0, -0.5, *np.zeros(robot.n - 4)])
    samples = bind_some_samples([replace(log, joint_position=position)], robot, (), 240)
    found = value(fit_zeros(samples, NominalModel(robot, ())))
    np.testing.assert_allclose(found.value[[1, 3]], [0.6, -0.5], rtol=0.0, atol=2e-2)


@pytest.mark.parametrize(("joint", "degrees"), each_once([1, 3], [180, 90, -90]))
def test_an_encoder_that_counts_from_another_right_angle_is_named_with_what_to_add(joint: int, degrees: int) -> None:
    found = checked(CASE, moved(joint, -np.radians(degrees)))
    named = {one.name for one in found.findings if CASE.log.joint_names[joint] in one.found}
    assert named & {"unit, sign or frame", "zero"}, [str(one) for one in found.findings]
    if "zero" not in named:
        finding = only(found, "unit, sign or frame", "joint_position")
        assert (finding.severity, finding.advice) == (REJECTED, f"add {degrees} degrees to its positions")


@pytest.mark.parametrize(("joint", "with_torque"), each_once([0, 3], [False, True]))
def test_a_joint_that_is_counted_the_other_way_is_named_and_whether_its_torque_is_too(
    joint: int, with_torque: bool
) -> None:
    """Not joint 1 with its torque: a Panda whose joint 2 is half a turn further moves and weighs nearly the same."""
    sign = np.where(np.arange(len(CASE.log.joint_names)) == joint, -1.0, 1.0)
    torque = value(CASE.log.joint_torque) * (sign if with_torque else 1.0)
    log = replace(CASE.log, joint_position=CASE.log.joint_position * sign, joint_torque=torque)
    finding = only(checked(CASE, log), "unit, sign or frame", "joint_position")
    assert finding.severity == REJECTED
    name = CASE.log.joint_names[joint]
    assert finding.found.startswith(f"{name} reversed{', with its torque' if with_torque else ''}:")
    assert f"{{{name}: -1}}" in finding.advice


def test_torques_that_a_controller_has_freed_of_gravity_are_named() -> None:
    robot = robot_of(ARM)
    q = torch.from_numpy(CASE.log.joint_position)
    gravity = (Regressor(robot)(q, 0.0 * q, 0.0 * q) @ torch.from_numpy(robot.nominal.flatten())).numpy()
    finding = only(
        checked(CASE, replace(CASE.log, joint_torque=value(CASE.log.joint_torque) - gravity)), "gravity", "joint_torque"
    )
    assert finding.severity == REJECTED
    share = re.match(r"torques lack (\d+) \+- (\d+) % of gravity", finding.found)
    assert share is not None
    assert float(share[1]) == pytest.approx(100.0, abs=max(3.0 * float(share[2]), 5.0))
