"""Scalar sensors of contacts in checks: their own field, and wrenches that are one in disguise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from faults import CONTACTS, CUTOFF, FEET, changed, demo_log, demo_robot, of_demo, only
from motions import value
from numpy.typing import NDArray

from torchid.log_checks import SUSPICIOUS
from torchid.log_checks.check import check
from torchid.log_checks.contacts import check_scalar_wrenches
from torchid.logs import Log
from torchid.logs.log import WRENCHES

(FIELD,) = (name for name in WRENCHES if getattr(demo_log(), name) is not None)


def alone(log: Log, component: int, feet: tuple[int, ...], other: float = 0.0) -> Log:
    """The log with one component of some feet's wrenches, and another number in place of the rest."""

    def keep(wrench: NDArray[np.float64]) -> None:
        for foot in feet:
            wrench[:, foot, np.arange(6) != component] = other

    return changed(log, FIELD, keep)


def scalar(log: Log) -> Log:
    """The log with the forces along the normal in place of wrenches."""
    return replace(log, **{FIELD: None}, contact_force_normal=value(log.contact_wrench)[..., 2].copy())


@pytest.mark.parametrize(("component", "name"), [(2, "fz"), pytest.param(0, "fx", marks=pytest.mark.study)])
def test_a_wrench_with_one_component_is_taken_for_a_scalar_sensor_by_name(component: int, name: str) -> None:
    finding = only(of_demo(alone(demo_log(), component, (0, 2))), "scalar sensor")
    assert (finding.field, finding.severity) == (FIELD, SUSPICIOUS)
    for foot in (0, 2):
        assert f"{demo_log().contact_names[foot]}: only {name} is ever nonzero" in finding.found
    assert finding.channels == tuple(demo_log().contact_names[foot] for foot in (0, 2))
    assert "contact_force_normal" in finding.advice
    assert "sensors.contact_wrenches: {FRAME: [fn]}" in finding.advice


def test_what_it_reads_in_the_air_makes_no_difference() -> None:
    log = alone(demo_log(), 2, (1,))

    def unloaded(wrench: NDArray[np.float64]) -> None:
        wrench[~value(log.contact_active)[:, 1], 1] = 3.0

    assert [*check_scalar_wrenches(changed(log, FIELD, unloaded))]


def test_other_wrenches_are_not() -> None:
    log = demo_log()
    moment = changed(alone(log, 2, (0,)), FIELD, lambda x: x[:, 0, 4].fill(0.1))
    silent = changed(log, FIELD, lambda x: x[:, 0].fill(0.0))
    absent = replace(log, contact_active=value(log.contact_active) & [False, True, True, True])
    for one in (log, moment, silent, alone(log, 2, (0,), np.nan), alone(log, 4, (0,)), alone(absent, 2, (0,))):
        assert not [*check_scalar_wrenches(one)]


def test_a_good_log_with_scalar_sensors_is_usable_and_its_faults_are_named() -> None:
    log = scalar(demo_log())
    clean = of_demo(log)
    assert clean.usable
    assert not [one for one in clean.findings if one.field == "contact_force_normal"]
    contacts = [replace(contact, along_normal=True) for contact in CONTACTS]
    assert check(log, demo_robot(), contacts, CUTOFF).findings == clean.findings
    both = replace(scalar(demo_log()), **{FIELD: 40.0 * getattr(demo_log(), FIELD)})
    expected = [(one.name, one.field, one.found) for one in of_demo(both).findings]
    assert [
        (one.name, one.field, one.found) for one in check(both, demo_robot(), contacts, CUTOFF).findings
    ] == expected
    assert expected
    foot = log.contact_names.index(FEET[3])
    touching = np.flatnonzero(value(log.contact_active)[:, foot])

    def gap(force: NDArray[np.float64]) -> None:
        force[touching[40:45], foot] = np.nan

    def spike(force: NDArray[np.float64]) -> None:
        """While another foot is in the air and not read."""
        force[~value(log.contact_active)] = np.nan
        lifted = np.flatnonzero(value(log.contact_active)[:, foot] & ~value(log.contact_active)[:, foot - 1])
        force[lifted[len(lifted) // 4], foot] += 5000.0

    for change, name in ((gap, "not measured"), (spike, "spike")):
        finding = only(of_demo(changed(log, "contact_force_normal", change)), name, "contact_force_normal")
        assert finding.channels == (FEET[3],)
