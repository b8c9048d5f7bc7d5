"""Offsets and scales of sensors and terms of actuators, unknown beside the bodies' parameters: found exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from misread import WIDTH, World, with_actuators, world
from motions import value
from recordings import Miscalibration, in_world
from synthetic import Oracle, make_log, random_states
from true_robots import predicted, worst
from unknowns import Fit, fit
from welded import CONTACTS, SENSORS, STATES

from torchid.logs import Log
from torchid.problem import ExtraTerms, bind_log
from torchid.problem.extras import ACTUATORS, CHANNELS, list_extras
from torchid.problem.metrics import calibrate_readings
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot
from torchid.sensing import Contact, SensorSet, chosen_sensors, named_sensors, with_ft_sensors

EXACT = 1e-7


def sensors_of(robot: Robot, name: str) -> SensorSet:
    """Named sets with two sensors in limbs; with all of them; these alone; and some axes of some sensors."""
    F = len(robot.ft_names)
    torques, wrenches, welds = [], {}, ["thigh_ft", "tail_ft"]
    if name == "mixed":
        torques = [joint for joint in robot.joint_names if joint != "knee"]
        wrenches = {"sole": ("fx", "fz", "my"), "fin": ("fx", "fy", "fz")}
    if name in ("mixed", "limbs"):
        sensors = chosen_sensors(robot.joint_names, CONTACTS, torques, wrenches, ft=F)
    else:
        sensors = named_sensors(name.split("+")[0], robot.n, len(CONTACTS), ft=F)
    return with_ft_sensors(sensors, robot, SENSORS if "limbs" in name else welds)


def fitted(w: World, sensors: SensorSet, terms: ExtraTerms) -> Fit:
    return fit(w.robot, CONTACTS, sensors, terms, [bind_log(log, w.robot, CONTACTS) for log in w.logs])


def assert_recovered(w: World, found: Fit, terms: ExtraTerms) -> None:
    """Every unknown, and every force that the sensors see."""
    true = w.true(found.builder, terms)
    assert set(found.values) == set(true)
    for key, expected in true.items():
        assert found.values[key] == pytest.approx(expected, rel=EXACT, abs=1e-9), key
    assert all(x.separable and np.isfinite(x.standard_error) and not x.confounded_with for x in found.extras)
    state = random_states(np.random.default_rng(99), w.robot.n, 100)
    seen = np.append(np.ones(6, dtype=bool), found.builder.sensors.torque)
    forces, expected = predicted(w.robot, found.estimate.phi, *state), w.oracle.forces(*state)
    assert worst(forces[:, seen], expected[:, seen]) < 1e-9


@pytest.mark.parametrize(
    ("name", "scope"),
    [
        *((name, "log") for name in ("full", "contacts", "joints", "mixed", "limbs")),
        ("full+limbs", "all"),
        ("mixed", "all"),
    ],
)
def test_offsets_of_every_channel_are_found_for_each_log_or_for_all(name: str, scope: str) -> None:
    terms, w = ExtraTerms(offsets=dict.fromkeys(CHANNELS, scope)), world(scope == "log")
    assert_recovered(w, fitted(w, sensors_of(w.robot, name), terms), terms)


SCALED = {
    "plates beside torques": ("full", ("contact_force", "contact_moment")),
    "torques beside plates": ("full", ("joint_torque",)),
    "limbs beside torques and plates": ("full+limbs", ("ft_force", "ft_moment")),
    "moments beside forces": ("limbs", ("ft_moment",)),
    "all but the torques": ("full+limbs", ("contact_force", "contact_moment", "ft_force", "ft_moment")),
}


@pytest.mark.parametrize(
    ("case", "scope"), [(case, "all" if place % 2 else "log") for place, case in enumerate(SCALED)]
)
def test_scales_are_found_beside_offsets_where_some_sensor_is_true_to_scale(case: str, scope: str) -> None:
    name, scaled = SCALED[case]
    terms = ExtraTerms(dict.fromkeys(CHANNELS, "log"), dict.fromkeys(scaled, scope))
    w = world(scope == "log", scaled)
    assert_recovered(w, fitted(w, sensors_of(w.robot, name), terms), terms)


def test_where_no_sensor_is_true_to_scale_none_can_be_told_from_the_masses() -> None:
    """All forces twice as large and a robot twice as heavy would read the same."""
    every = dict.fromkeys(CHANNELS, "all")
    terms, w = ExtraTerms(every, every), world(False, CHANNELS)
    found = fitted(w, sensors_of(w.robot, "full+limbs"), terms)
    assert found.extras
    for x in found.extras:
        assert not x.separable
        assert x.standard_error == np.inf
        assert x.confounded_with


# ------------------------------------------------------------------------------------------------- actuators


def test_a_contact_and_a_limb_sensor_of_one_name_have_unknowns_of_their_own() -> None:
    """As links and joints of a URDF may."""
    robot = world().robot
    contacts = (Contact(SENSORS[0], "flat"),)
    sensors = with_ft_sensors(named_sensors("full", robot.n, 1, ft=len(SENSORS)), robot, SENSORS)
    labels = [
        extra.label for extra in list_extras(robot, contacts, sensors, ExtraTerms(dict.fromkeys(CHANNELS, "log")))
    ]
    assert len(set(labels)) == len(labels) == robot.n + 6 * len(SENSORS) + 6


@pytest.mark.parametrize("kinds", ["asymmetric_coulomb", "stribeck", "stiffness", "all"])
def test_terms_of_actuators_are_found_with_friction_that_turns_over_smoothly(kinds: str) -> None:
    every = tuple(ACTUATORS)
    terms = ExtraTerms(sign_width=WIDTH, **dict.fromkeys(every if kinds == "all" else (kinds,), True))
    w = world()
    logs, true = with_actuators(w, terms)
    found = fit(
        w.robot, CONTACTS, sensors_of(w.robot, "full"), terms, [bind_log(log, w.robot, CONTACTS) for log in logs]
    )
    assert set(found.values) == set(true)
    for key, expected in true.items():
        assert found.values[key] == pytest.approx(expected, rel=EXACT, abs=1e-9), key
    assert found.estimate.residual_std < 1e-9
    without = replace(terms, **dict.fromkeys(every, False))
    plain = fit(w.robot, CONTACTS, sensors_of(w.robot, "full"), without, [bind_log(x, w.robot, CONTACTS) for x in logs])
    assert plain.estimate.residual_std > 1e-3, "the terms must matter"
    sharp = fit(w.robot, CONTACTS, sensors_of(w.robot, "full"), replace(terms, sign_width=None),
                [bind_log(x, w.robot, CONTACTS) for x in logs])  # fmt: skip
    assert sharp.estimate.residual_std > 1e-3, "and so must the width"


# --------------------------------------------------------------------------------- a humanoid on Monday morning


@pytest.mark.parametrize("turned", [lambda _, log: log, in_world], ids=["along the frames", "along the world"])
def test_readings_calibrated_with_the_true_values_are_the_forces(turned: Callable[[Oracle, Log], Log]) -> None:
    w, rng = world(), np.random.default_rng(15)
    contacts = [(contact.frame, contact.components) for contact in CONTACTS]
    log = turned(w.oracle, make_log(w.oracle, contacts, STATES, 20, rng))
    off, terms = Miscalibration.random(log, rng, CHANNELS), ExtraTerms(*2 * (dict.fromkeys(CHANNELS, "log"),))
    offsets = np.append(off.torque, off.ft), off.wrench
    scales = np.append(off.torque_scale, off.ft_scale) - 1.0, off.wrench_scale - 1.0
    extras, values = list_extras(w.robot, CONTACTS, sensors_of(w.robot, "full+limbs"), terms), []
    for extra in extras:
        of_dofs, of_contacts = offsets if extra.what == "offset" else scales
        values.append(of_dofs[extra.dof] if extra.contact is None else of_contacts[extra.contact])
    ideal, read = (bind_log(one, w.robot, CONTACTS) for one in (log, off.read(log)))
    found = calibrate_readings(read, extras, np.array(values), KinematicTree(w.robot))
    np.testing.assert_allclose(value(found.torque), value(ideal.torque), rtol=0.0, atol=1e-11)
    known = np.zeros(value(ideal.wrench).shape, dtype=bool)
    for extra in extras:
        if extra.contact is not None:
            known[:, extra.contact[0], extra.contact[1]] = ideal.active[:, extra.contact[0]]
    assert known.sum() > 100
    np.testing.assert_allclose(value(found.wrench)[known], value(ideal.wrench)[known], rtol=0.0, atol=1e-11)


def test_scales_of_plates_are_those_of_what_they_read_about_a_point_of_the_world() -> None:
    scaled = ("contact_force", "contact_moment")
    terms, w = ExtraTerms(dict.fromkeys(CHANNELS, "log"), dict.fromkeys(scaled, "log")), world(True, scaled, "plates")
    assert_recovered(w, fitted(w, sensors_of(w.robot, "full"), terms), terms)
