"""States that honour contacts, and what standing and stepping robots let sensors see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import torch
from contact_states import BOTH, FEET, FLIGHT, LEFT, RIGHT, biped, bipeds
from synthetic import ANYMAL, G1, PANDA, SOLO12, TIAGO, UR5, Array, Oracle, load

from torchid import parameters
from torchid.identifiability.base_parameters import (
    BaseParameters,
    base_parameters,
    random_postures,
    standing_samples,
    standing_states,
    structural_problem,
    structural_rank,
    structural_samples,
    unobservable_parameters,
)
from torchid.problem.contact_state import ContactState
from torchid.regressor import FrameJacobian, motion_from_state
from torchid.sensing import Contact, SensorSet, named_sensors

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
    "slides and a line along turned axes": (TIAGO, False, [Contact("xtion_rgb_optical_frame", "line", "z")]),
    "two contacts on one body": (TIAGO, False, [Contact("base_link", "flat"), Contact("base_footprint", "flat")]),
    "a bolted arm that draws": (PANDA, True, [Contact("panda_hand", "point")]),
    "a bolted arm that holds": (PANDA, True, [Contact("panda_hand", "flat")]),
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


def test_postures_near_a_singular_one_are_left_out() -> None:
    """Of twice as many the better half: as many postures without a choice are worse in half of all cases."""
    robot, contacts = load(SOLO12), [Contact(f"{leg}_FOOT", "point") for leg in ("FL", "FR", "HL", "HR")]

    def regularity(joints: Array) -> Array:
        """The least singular value of the contact Jacobian as a share of the largest: a base pose changes neither."""
        q = torch.from_numpy(np.hstack([np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(joints), 1)), joints]))
        rows = [FrameJacobian(robot, contact.frame)(q)[:, :3, : robot.nv] for contact in contacts]
        values = torch.linalg.svdvals(torch.cat(rows, dim=1)).numpy()
        return np.asarray(values[:, -1] / values[:, 0])

    q, _, _ = standing_states(robot, contacts, (True,) * 4, 200, np.random.default_rng(8))
    others = random_postures(robot, 400, np.random.default_rng(9))
    assert regularity(q[:, 7:].numpy()).min() > np.quantile(regularity(others), 0.4)


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


def test_what_a_contact_cannot_hold_goes_on_moving() -> None:
    robot = load(G1)
    foot = FEET["G1"][1]
    for contact, free in ((Contact(foot, "line", "y"), [4]), (Contact(foot, "point"), [3, 4, 5])):
        states = standing_states(robot, [contact], (True,), 10, np.random.default_rng(2))
        motion = contact_motion(Oracle.of(robot), Contact(foot, "flat"), *(x.numpy() for x in states))
        moving = np.abs(motion).min(axis=0) > 1e-6
        assert np.flatnonzero(moving).tolist() == [*free, *(6 + k for k in free)]


def test_lifted_feet_move() -> None:
    robot, contacts = biped("biped")
    states = [x.numpy() for x in standing_states(robot, contacts, LEFT, 10, np.random.default_rng(3))]
    assert np.abs(contact_motion(Oracle.of(robot), contacts[1], *states)).min(axis=1).max() > 1e-3


def test_a_robot_that_cannot_move_stands_still() -> None:
    robot = load(UR5, fixed_base=True)
    q, v, a = standing_states(robot, [Contact("tool0", "flat")], (True,), 10, np.random.default_rng(4))
    assert not v.any()
    assert float(a.abs().max()) < 1e-12
    assert float(q.std()) > 0.5


def test_joint_torques_of_an_arm_that_cannot_move_tell_nothing() -> None:
    robot = load(UR5, fixed_base=True)
    sensors = named_sensors("joints", robot.n, 1)
    base = base_parameters(structural_problem(robot, [Contact("tool0", "flat")], sensors, [(True,)]))
    assert (base.rank, base.null_space.shape) == (0, (10 + 12 * robot.n, 12 * len(robot.bodies)))


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


def test_postures_are_well_spread() -> None:
    robot, contacts = biped("G1")
    q, _, _ = standing_states(robot, contacts, BOTH, 400, np.random.default_rng(6))
    up = q.new_tensor([0.0, 0.0, 1.0]).expand(len(q), 3)
    x, y, z, w = q[:, 3:7].T
    toward = torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=1)
    assert float(toward.mean(0).norm()) < 0.2, "gravity comes from everywhere"
    assert float((toward @ up.T).abs().mean()) > 0.1
    joints = q[:, 7:]
    assert np.abs(random_postures(robot, 400, np.random.default_rng(6))).max() <= 1.5
    assert float(joints.abs().max()) <= np.pi, "some are turned further until both soles are level"
    assert float(joints.std(0).min()) > 0.7


# ------------------------------------------------------------------------------------------ what standing feet hide


def seen(name: str, sensors: SensorSet | str, states: Sequence[ContactState], friction: bool = False) -> BaseParameters:
    robot, contacts = biped(name)
    if isinstance(sensors, str):
        sensors = named_sensors(sensors, robot.n, len(contacts))
    return base_parameters(structural_problem(robot, contacts, sensors, states, friction))


def feet_of(name: str) -> list[str]:
    robot, contacts = biped(name)
    return [robot.body_names[robot.link(contact.frame)[0]] for contact in contacts]


INERTIA = set(parameters.PARAMETERS[parameters.INERTIA])


def hidden_inertia(name: str, base: BaseParameters) -> list[str]:
    """Feet whose six inertia numbers are part of no sum."""
    lines = dict(line.split(": ") for line in unobservable_parameters(base, biped(name)[0].body_names))
    return [foot for foot in feet_of(name) if set(lines.get(foot, "").split(", ")) >= INERTIA]


@bipeds
def test_no_force_whatsoever_depends_on_the_inertia_of_a_foot_that_stands(name: str) -> None:
    robot, contacts = biped(name)
    states = [x.numpy() for x in standing_states(robot, contacts, LEFT, 20, np.random.default_rng(7))]
    K = Oracle.of(robot).regressor(robot, *states)
    left, right = (robot.link(contact.frame)[0] for contact in contacts)
    assert np.abs(K[:, :, left, parameters.INERTIA]).max() < 1e-12
    assert np.abs(K[:, :, right, parameters.INERTIA]).max() > 1.0


@bipeds
@pytest.mark.parametrize("sensors", ["full", "contacts", "joints", "some", "others"])
def test_so_no_sensor_set_tells_it(name: str, sensors: str) -> None:
    robot, _ = biped(name)
    rng = np.random.default_rng(len(sensors))
    some = SensorSet(rng.random(robot.n) < 0.7, rng.random((2, 6)) < 0.5)
    chosen = some if sensors in ("some", "others") else sensors
    assert hidden_inertia(name, seen(name, chosen, [BOTH])) == feet_of(name)
    assert hidden_inertia(name, seen(name, chosen, [LEFT], friction=True)) == feet_of(name)[:1]


@bipeds
@pytest.mark.parametrize("sensors", ["full", "joints"])
def test_stepping_tells_all_that_flight_does(name: str, sensors: str) -> None:
    robot, _ = biped(name)
    base = seen(name, sensors, [BOTH, LEFT, RIGHT], friction=True)
    assert unobservable_parameters(base, robot.body_names) == []
    assert base.rank == 10 + 9 * robot.n
    assert base.gap > 1e12


@bipeds
@pytest.mark.parametrize(("sensors", "lost"), [("full", 9), ("contacts", 9), ("joints", 14)])
def test_a_foot_that_stands_is_the_ground_of_an_arm(name: str, sensors: str, lost: int) -> None:
    """A free foot would show ten parameters, the first link on it seven.

    To torque sensors the ground shows none, and a link that only turns about an axis fixed in the ground three: two
    first moments and one inertia. A wrench below the foot adds the ground's mass, its first moments along the level
    ground and two products of inertia.
    """
    robot, _ = biped(name)
    free = 10 + 7 * robot.n
    for states, feet in (([BOTH], 2), ([LEFT], 1), ([RIGHT], 1), ([FLIGHT], 0), ([LEFT, RIGHT], 0)):
        base = seen(name, sensors, states)
        assert base.rank == free - feet * lost
        assert base.gap > 1e12


@bipeds
def test_a_level_sole_hides_seven_numbers_and_one_on_a_slope_six(name: str) -> None:
    """Gravity never turns in the frame of the level one: its first moment along gravity has no effect."""
    robot, level = biped(name)
    slope = [replace(contact, normal=(0.1, 0.0, 1.0)) for contact in level]
    sensors = named_sensors("full", robot.n, len(level))
    level_base, slope_base = (
        base_parameters(structural_problem(robot, contacts, sensors, [LEFT], False)) for contacts in (level, slope)
    )
    assert (level_base.rank, slope_base.rank) == (10 + 7 * robot.n - 9, 10 + 7 * robot.n - 8)
    foot = feet_of(name)[0]
    hidden = [
        set(dict(line.split(": ") for line in unobservable_parameters(base, robot.body_names))[foot].split(", "))
        for base in (level_base, slope_base)
    ]
    assert hidden[1] == INERTIA
    assert hidden[0] - INERTIA == {parameters.PARAMETERS[3]}


def test_to_torque_sensors_a_point_that_stands_hides_a_mass_at_that_point() -> None:
    robot = load(SOLO12)
    feet = [Contact(f"{leg}_FOOT", "point") for leg in ("FL", "FR", "HL", "HR")]
    for sensors, lost in (("joints", 1), ("contacts", 0), ("full", 0)):
        for state in ((True,) * 4, (True, False, False, True)):
            problem = structural_problem(robot, feet, named_sensors(sensors, robot.n, 4), [state], friction=False)
            rank, gap = structural_rank(problem)
            assert rank == 10 + 7 * robot.n - lost * sum(state)
            assert gap > 1e12


def test_a_tilted_table_shows_what_a_level_one_hides_of_the_first_link() -> None:
    """Gravity turns an arm about a vertical axis not at all, and one that is askew by its first moments."""
    level = load(PANDA, fixed_base=True)
    ranks = [
        base_parameters(structural_problem(robot, [], named_sensors("joints", robot.n, 0), [()], False)).rank
        for robot in (level, replace(level, base_tilt=(0.03, -0.01)))
    ]
    assert ranks[1] == ranks[0] + 2
