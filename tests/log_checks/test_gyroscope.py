"""Gyroscopes without an orientation beside them, compared with how the base turns above the feet that stand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from mistaken import CUTOFF, Case, case_of
from motions import value
from walking import MACHINES, robot_of

from torchid.log_checks import REJECTED, SUSPICIOUS, Finding, Skipped
from torchid.log_checks.standing_feet import check_gyroscope
from torchid.logs import Log

Array = np.ndarray
WALKERS = ("quadruped", "biped")


def findings(case: Case, log: Log) -> list[Finding | Skipped]:
    """What the check says."""
    log = replace(log, base_quat_xyzw=None)
    return list(check_gyroscope(log, robot_of(case.machine), case.machine.contacts, CUTOFF))


def misread(case: Case, change: Callable[[Array], Array]) -> Log:
    """The log with other angular velocities."""
    return replace(case.log, imu_angular_velocity=change(value(case.log.imu_angular_velocity)))


@pytest.mark.parametrize("walker", WALKERS)
def test_a_gyroscope_reads_how_the_base_turns_above_the_feet_that_stand(walker: str) -> None:
    case = case_of(MACHINES[walker], "joints")
    assert findings(case, case.log) == []
    assert findings(case, misread(case, lambda omega: omega + [0.004, -0.003, 0.002])) == []


@pytest.mark.parametrize("walker", WALKERS)
@pytest.mark.parametrize(
    ("change", "severity", "name", "words"),
    [
        (np.degrees, REJECTED, "unit", "in deg/s"),
        (lambda omega: -omega, REJECTED, "sign", "reversed"),
        (lambda omega: omega[:, [1, 0, 2]] * [1.0, -1.0, 1.0], REJECTED, "frame", "along other axes"),
        (lambda omega: omega * [1.0, -1.0, -1.0], REJECTED, "frame", "along other axes"),
        (lambda omega: omega + [0.3, 0.0, 0.0], SUSPICIOUS, "offset", r"without a steady (0.3"),
        (lambda omega: 2.0 * omega, SUSPICIOUS, "ratio", "times 0.5"),
        (lambda omega: omega[::-1], SUSPICIOUS, "standing feet", "no usual mistake explains it"),
    ],
    ids=["degrees", "reversed", "a quarter turn", "upside down", "offset", "twice", "of another time"],
)
def test_a_gyroscope_that_contradicts_the_feet_is_named_with_the_reason(
    walker: str, change: Callable[[Array], Array], severity: str, name: str, words: str
) -> None:
    case = case_of(MACHINES[walker], "joints")
    (finding,) = findings(case, misread(case, change))
    assert isinstance(finding, Finding)
    assert (finding.severity, finding.name, finding.field) == (severity, name, "imu_angular_velocity")
    assert words in finding.found


def test_without_two_feet_that_stand_the_check_says_that_it_was_not_made() -> None:
    case = case_of(MACHINES["quadruped"], "joints")
    flags = value(case.log.contact_active).copy()
    flags[:, 1:] = False
    (skipped,) = findings(case, replace(case.log, contact_active=flags))
    assert isinstance(skipped, Skipped)
    assert "no two feet" in skipped.reason
