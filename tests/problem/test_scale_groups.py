"""Sensors that share a scale: motors of one type, left and right, all components of one force sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from misread import World, world
from recordings import Miscalibration, in_world
from synthetic import make_log, random_states
from true_robots import predicted, worst
from unknowns import Fit, fit
from welded import CONTACTS, SENSORS, STATES

from torchid.estimators import Consistent, LeastSquares
from torchid.logs import Log
from torchid.problem import ExtraTerms, bind_log
from torchid.problem.extras import CHANNELS, list_extras
from torchid.sensing import SensorSet, named_sensors, with_ft_sensors

EXACT = 1e-7
SCALES = {"joint_torque": (0.9, 0.9, 1.15), "contact_force": (0.8, 1.0, 0.8), "ft_moment": (1.0, 1.2, 1.2, 1.0)}
"""By joint (hip, knee, shoulder), contact (sole, thigh, fin) and sensor (mount, thigh, ankle, tail)."""
GROUPS = {
    "joint_torque": [["hip", "kn?e"], ["should*"]],
    "contact_force": [["*in", "sole"]],
    "ft_moment": [["thigh_ft", "ankle_ft"]],
}
VALUES = {
    "scale of hip,kn?e": -0.1,
    "scale of should*": 0.15,
    "scale of *in,sole force": -0.2,
    "scale of limb sensor thigh_ft,ankle_ft moment": 0.2,
}


def misread(log: Log) -> Miscalibration:
    """Sensors with the scales, and without offsets."""
    n, C, F = len(log.joint_names), len(log.contact_names), len(log.ft_names)
    wrench, ft = np.ones((C, 6)), np.ones((F, 6))
    wrench[:, :3] = np.array(SCALES["contact_force"])[:, None]
    ft[:, 3:] = np.array(SCALES["ft_moment"])[:, None]
    return Miscalibration(np.zeros(n), np.array(SCALES["joint_torque"]), np.zeros((C, 6)), wrench, np.zeros((F, 6)), ft)


def logs_of(w: World, axes: str = "local", offsets: bool = False) -> tuple[list[Log], list[Miscalibration]]:
    """What such sensors record, with offsets by log if told."""
    rng, contacts = np.random.default_rng(3), [(contact.frame, len(contact.components)) for contact in CONTACTS]
    logs, sensors = [], []
    for name in ("a.npz", "b.npz"):
        log = make_log(w.oracle, contacts, STATES, 120, rng, name)
        log = in_world(w.oracle, log) if axes == "world" else log
        found = misread(log)
        if offsets:
            off = Miscalibration.random(log, rng)
            found = replace(found, torque=off.torque, wrench=off.wrench, ft=off.ft)
        logs.append(found.read(log))
        sensors.append(found)
    return logs, sensors


def fitted(w: World, logs: list[Log], terms: ExtraTerms, estimator: LeastSquares | Consistent | None = None) -> Fit:
    bound = [bind_log(log, w.robot, CONTACTS) for log in logs]
    return fit(w.robot, CONTACTS, sensors_of(w), terms, bound, estimator)


def sensors_of(w: World) -> SensorSet:
    return with_ft_sensors(named_sensors("full", w.robot.n, len(CONTACTS), ft=len(SENSORS)), w.robot, SENSORS)


@pytest.mark.parametrize(("axes", "offsets"), [("local", False), ("world", False), ("local", True), ("world", True)])
def test_one_scale_is_found_for_each_group_and_the_robot_with_them(axes: str, offsets: bool) -> None:
    w = world()
    terms = ExtraTerms(dict.fromkeys(CHANNELS, "log") if offsets else {}, GROUPS)
    logs, sensors = logs_of(w, axes, offsets)
    found = fitted(w, logs, terms)
    scales = {label: x for (log, label), x in found.values.items() if label.startswith("scale")}
    assert scales == pytest.approx(VALUES, rel=EXACT)
    for log, own in zip(logs, sensors, strict=True):
        for joint, offset in zip(w.robot.joint_names, own.torque, strict=True):
            assert not offsets or found.values[log.source, f"offset of {joint}"] == pytest.approx(offset, rel=EXACT)
    assert all(x.separable and np.isfinite(x.standard_error) for x in found.extras)
    state = random_states(np.random.default_rng(99), w.robot.n, 100)
    assert worst(predicted(w.robot, found.estimate.phi, *state), w.oracle.forces(*state)) < 1e-9


def test_only_measured_members_of_a_group_count() -> None:
    w = world()
    sensors = sensors_of(w)
    without = replace(sensors, torque=sensors.torque & (np.arange(len(sensors.torque)) != 1))
    extras = list_extras(w.robot, CONTACTS, without, ExtraTerms(scales={"joint_torque": [["*"], ["knee"]]}))
    assert [x.dofs for x in extras] == [(0, 2)]
