"""What an experiment declares of its sensors is no mistake of a log, and hides none."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest
from faults import CONTACTS, CUTOFF, demo_log, demo_robot, found, only
from mistaken import MISTAKES, case_of
from motions import value
from repository import CONFIGS, SHARED
from synthetic import ROBOTS
from walking import MACHINES, robot_of

from torchid.commands.check import check_experiment
from torchid.log_checks import NOTE, Checked
from torchid.log_checks.check import check
from torchid.log_checks.equations import Declared
from torchid.logs import Log
from torchid.logs.segments import with_delayed_torques
from torchid.problem import ExtraTerms
from torchid.sensing import SensorNoise

GROUP = ["panda_joint2", "panda_joint3", "panda_joint4"]
EIGHTHS = dict.fromkeys(GROUP, 0.125)
SCALES = Declared(terms=ExtraTerms(scales={"joint_torque": "all"}))
GROUPED = Declared(terms=ExtraTerms(scales={"joint_torque": [GROUP]}))
OFFSETS = Declared(terms=ExtraTerms(offsets={"joint_torque": "log"}))
CONTACT_SCALES = Declared(terms=ExtraTerms(scales={"contact_force": "all"}))


def arm(log: Log, declared: Declared | None = None) -> Checked:
    """What is said of a log of the arm that swings."""
    return check(log, robot_of(MACHINES["arm"]), (), 10.0, declared=declared)


def arm_log(factors: Mapping[str, float] | float = 1.0, offsets: Mapping[str, float] | None = None) -> Log:
    """The arm's log with torques times factors, and offsets [N m], of all joints or by name."""
    log = case_of(MACHINES["arm"], "contacts").log
    named = dict.fromkeys(log.joint_names, factors) if isinstance(factors, float) else factors
    scale = [named.get(name, 1.0) for name in log.joint_names]
    offset = [(offsets or {}).get(name, 0.0) for name in log.joint_names]
    return replace(log, joint_torque=value(log.joint_torque) * scale + offset)


def late(seconds: float) -> Log:
    """The arm's log with torques that were recorded so much before they act."""
    return with_delayed_torques(arm_log(), -seconds)


def alarms(checked: Checked) -> list[tuple[str, str]]:
    """Findings that are more than notes."""
    return [(one.name, one.field) for one in checked.findings if one.severity != NOTE]


@pytest.mark.parametrize(
    ("log", "declared"),
    [
        (lambda: arm_log(0.125), SCALES),
        (lambda: arm_log(EIGHTHS), GROUPED),
        (lambda: arm_log(1.0, {"panda_joint2": 6.0}), OFFSETS),
        (lambda: late(0.06), Declared(delay=0.06)),
        (lambda: late(0.06), Declared(delay="auto")),
    ],
    ids=["scales", "scale of a group", "offset", "delay", "unknown delay"],
)
def test_what_is_declared_is_no_mistake(log: Callable[[], Log], declared: Declared) -> None:
    assert alarms(arm(log()))
    assert alarms(arm(log(), declared)) == []


def test_a_scale_that_is_declared_of_other_joints_leaves_the_finding() -> None:
    others = Declared(terms=ExtraTerms(scales={"joint_torque": [["panda_joint6", "panda_joint7"]]}))
    assert {"panda_joint2", "panda_joint4"} <= set(only(arm(arm_log(EIGHTHS), others), "scale").channels)


@pytest.mark.parametrize("name", ["joints swapped", "torques reversed", "time x 2"])
def test_a_mistake_beside_an_unknown_scale_is_named(name: str) -> None:
    (mistake,) = (one for one in MISTAKES if one.name == name)
    case = replace(case_of(MACHINES["arm"], "contacts"), log=arm_log(0.125))
    assert mistake.named(arm(value(mistake.make(case)), SCALES))


def test_a_foot_with_another_gain_is_no_mistake_if_its_scale_is_declared() -> None:
    log = demo_log()
    wrench = value(log.contact_wrench_local).copy()
    wrench[:, 1] *= 0.5
    halved = replace(log, contact_wrench_local=wrench)
    assert found(check(halved, demo_robot(), CONTACTS, CUTOFF), "scale")
    assert alarms(check(halved, demo_robot(), CONTACTS, CUTOFF, declared=CONTACT_SCALES)) == []


def test_forces_within_the_stated_noise_do_not_contradict_the_model() -> None:
    """Torques that switch as no friction of a model does."""
    log = arm_log()
    torque = value(log.joint_torque)
    size = 0.5 * float(np.abs(torque).max())
    log = replace(log, joint_torque=torque + size * np.sign(np.sin(17.0 * log.time))[:, None])
    assert alarms(arm(log)) == [("forces", "all")]
    stated = SensorNoise.of_known({"joint_torque": size})
    assert alarms(arm(log, Declared(noise=stated))) == []


@pytest.mark.skipif(not SHARED.is_dir(), reason=f"recorded logs are not in {SHARED}")
def test_a_recorded_robot_whose_friction_no_model_has_is_judged_by_the_stated_noise() -> None:
    urdf = f"robot.urdf={ROBOTS / 'go2_description' / 'urdf' / 'go2.urdf'}"
    assert [alarms(one) for one in check_experiment(CONFIGS / "go2_in_air.yaml", [urdf])] == [[], []]
