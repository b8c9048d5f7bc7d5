"""States that honour contacts, and what standing and stepping robots let sensors see."""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin
import pytest
import torch
from repository import CONFIGS
from synthetic import ANYMAL, G1, PANDA, SOLO12, TIAGO, Array, Oracle, load

from torchid import parameters
from torchid.identifiability.base_parameters import (
    base_parameters,
    standing_samples,
    standing_states,
    structural_problem,
    structural_samples,
)
from torchid.regressor import motion_from_state
from torchid.robot import Robot
from torchid.sensing import Contact, named_sensors

BIPED = CONFIGS / "biped.urdf"

BOTH, LEFT, RIGHT, FLIGHT = (True, True), (True, False), (False, True), (False, False)
FEET = {
    "biped": (BIPED, "l_sole", "r_sole"),
    "G1": (G1, "left_ankle_roll_link", "right_ankle_roll_link"),
}
bipeds = pytest.mark.parametrize("name", FEET)


@cache
def biped(name: str) -> tuple[Robot, tuple[Contact, ...]]:
    urdf, *feet = FEET[name]
    return load(urdf), tuple(Contact(foot, "flat") for foot in feet)


# --------------------------------------------------------------------------------------------------------- standing


def contact_motion(oracle: Oracle, contact: Contact, q: Array, v: Array, a: Array) -> Array:
    """Velocity and acceleration, along the contact frame's axes, of what the contact holds, (B, 2 k)."""
    model, data, rows = oracle.model, oracle.data, []
    frame = model.getFrameId(contact.frame, pin.FrameType.BODY)
    for state in zip(q, v, a, strict=True):
        pin.forwardKinematics(model, data, *oracle._state(*state))
        velocity = pin.getFrameVelocity(model, data, frame, pin.LOCAL).vector
        acceleration = pin.getFrameClassicalAcceleration(model, data, frame, pin.LOCAL).vector
        rows.append(np.concatenate([x[list(contact.components)] for x in (velocity, acceleration)]))
    return np.array(rows)


STANDING = {
    "flat feet": (G1, False, [Contact(foot, "flat") for foot in FEET["G1"][1:]]),
    "a line and a point": (G1, False, [Contact(FEET["G1"][1], "line", "x"), Contact(FEET["G1"][2], "point")]),
    "point feet": (SOLO12, False, [Contact(f"{leg}_FOOT", "point") for leg in ("FL", "FR", "HL", "HR")]),
    "two contacts on one body": (TIAGO, False, [Contact("base_link", "flat"), Contact("base_footprint", "flat")]),
    "a bolted arm that draws": (PANDA, True, [Contact("panda_hand", "point")]),
    "a point on a mimic finger": (PANDA, False, [Contact("panda_rightfinger", "point")]),
}


@pytest.mark.parametrize("case", STANDING)
def test_active_contacts_neither_move_nor_accelerate_and_the_robot_does(case: str) -> None:
    urdf, fixed_base, contacts = STANDING[case]
    robot = load(urdf, fixed_base=fixed_base)
    state = (True,) * len(contacts)
    q, v, a = (x.numpy() for x in standing_states(robot, contacts, state, 20, np.random.default_rng(1)))
    for contact in contacts:
        motion = contact_motion(Oracle.of(robot), contact, q, v, a)
        assert motion.shape == (20, 2 * len(contact.components))
        assert np.abs(motion).max() < 1e-10
    assert np.linalg.norm(v, axis=1).min() > 0.1
    assert np.linalg.norm(a, axis=1).min() > 0.1
    assert np.abs(a).max() < 1e3


ASKEW = (0.2, -0.4, 0.9)
ROLLING = {
    "balls": (ANYMAL, False, [Contact(f"{leg}_FOOT", "point", radius=0.05, normal=ASKEW) for leg in ("LF", "RH")]),
    "a rocker and a point": (
        G1,
        False,
        [Contact(FEET["G1"][1], "line", "x", 0.3, ASKEW), Contact(FEET["G1"][2], "point")],
    ),
    "a bolted arm on a ball": (PANDA, True, [Contact("panda_hand", "point", radius=0.1, normal=ASKEW)]),
}


@pytest.mark.parametrize("case", ROLLING)
def test_the_material_point_on_the_ground_neither_moves_nor_begins_to(case: str) -> None:
    """Its velocity over a step of the motion, taken where contact is after the step: the arm turns with the ground."""
    urdf, fixed_base, contacts = ROLLING[case]
    robot = load(urdf, fixed_base=fixed_base)
    states = standing_states(robot, contacts, (True,) * len(contacts), 20, np.random.default_rng(1))
    oracle, step = Oracle.of(robot), 1e-4
    for contact in contacts:
        frame = oracle.model.getFrameId(contact.frame, pin.FrameType.BODY)
        for state in zip(*(x.numpy() for x in states), strict=True):
            q, v, a = oracle._state(*state)
            slips, centres, turns = [], [], []
            for dt in (-step, 0.0, step):
                at, velocity = pin.integrate(oracle.model, q, dt * v + 0.5 * dt * dt * a), v + dt * a
                pin.forwardKinematics(oracle.model, oracle.data, at, velocity)
                pin.updateFramePlacements(oracle.model, oracle.data)
                twist = pin.getFrameVelocity(oracle.model, oracle.data, frame, pin.LOCAL_WORLD_ALIGNED)
                normal = np.array(contact.normal)
                if contact.kind == "line":
                    axis = oracle.data.oMf[frame].rotation[:, "xyz".index(contact.line_axis)]
                    normal = normal - axis * (axis @ normal)
                    normal /= np.linalg.norm(normal)
                    turns.append(np.cross(axis, twist.angular))
                slips.append(twist.linear - np.cross(twist.angular, contact.radius * normal))
                centres.append(twist.linear)
            assert np.abs(slips[1]).max() < 1e-10
            assert np.abs(slips[2] - slips[0]).max() / (2.0 * step) < 1e-5
            assert not contact.radius or np.abs(centres[1]).max() > 1e-6
            assert not turns or (np.abs(turns[1]).max() < 1e-10 and np.abs(turns[2] - turns[0]).max() < 2e-9)


def test_samples_are_the_states_and_reproducible() -> None:
    robot, contacts = biped("G1")
    samples = standing_samples(robot, contacts, LEFT, 30, np.random.default_rng(5))
    q, v, a = standing_states(robot, contacts, LEFT, 30, np.random.default_rng(5))
    expected, found = motion_from_state(q, v, a, robot.n), samples.motion()
    for name, value in vars(expected).items():
        torch.testing.assert_close(getattr(found, name), value, rtol=0, atol=1e-12)
    assert samples.active.tolist() == [list(LEFT)] * 30
    assert len(samples[:7].time) == 7
    first, again = (structural_samples(robot, contacts, [BOTH, LEFT], 5, seed=3) for _ in range(2))
    assert [len(x) for x in first] == [5, 5]
    assert all(torch.equal(x.joint_velocity, y.joint_velocity) for x, y in zip(first, again, strict=True))


# ------------------------------------------------------------------------------------------ what standing feet hide


@bipeds
def test_no_force_whatsoever_depends_on_the_inertia_of_a_foot_that_stands(name: str) -> None:
    robot, contacts = biped(name)
    states = [x.numpy() for x in standing_states(robot, contacts, LEFT, 20, np.random.default_rng(7))]
    K = Oracle.of(robot).regressor(robot, *states)
    left, right = (robot.link(contact.frame)[0] for contact in contacts)
    assert np.abs(K[:, :, left, parameters.INERTIA]).max() < 1e-12
    assert np.abs(K[:, :, right, parameters.INERTIA]).max() > 1.0


@pytest.mark.slow("ranks of eight structural problems")
def test_a_foot_that_stands_is_the_ground_of_an_arm() -> None:
    """A free foot would show ten parameters, the first link on it seven.

    To torque sensors the ground shows none, and a link that only turns about an axis fixed in the ground three: two
    first moments and one inertia. A wrench below the foot adds the ground's mass, its first moments along the level
    ground and two products of inertia.
    """
    robot, contacts = biped("biped")
    for sensor_set, lost in (("full", 9), ("joints", 14)):
        sensors = named_sensors(sensor_set, robot.n, len(contacts))
        for states, standing in (([BOTH], 2), ([LEFT], 1), ([FLIGHT], 0), ([LEFT, RIGHT], 0)):
            base = base_parameters(structural_problem(robot, contacts, sensors, states, friction=False))
            assert base.rank == 10 + 7 * robot.n - standing * lost, (sensor_set, states)
            assert base.gap > 1e12
