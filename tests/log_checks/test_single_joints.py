"""Encoders that are dead, and joints that run into their stops."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from faults import CONTACTS, demo_log, demo_robot, of_demo, only
from mistaken import case_of, checked
from motions import value
from synthetic import PANDA, Array, Oracle, load
from walking import MACHINES

from torchid.log_checks import NOTE, SUSPICIOUS
from torchid.log_checks.check import check
from torchid.log_checks.encoders import check_still_velocities, still_joints
from torchid.logs import Log
from torchid.robot import Robot, load_robot


def dead(log: Log, joint: int, noise: float = 0.0) -> Log:
    """The log with a joint's encoder stuck at its first reading, with noise."""
    position = log.joint_position.copy()
    position[:, joint] = position[0, joint] + noise * np.random.default_rng(1).normal(size=len(log))
    return replace(log, joint_position=position)


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_joints_that_never_move_are_told_from_those_that_hardly_do(noise: float) -> None:
    log = demo_log()
    assert still_joints(log) == ()
    stuck = dead(log, 5, noise)
    assert still_joints(stuck) == (log.joint_names[5],)
    slow = stuck.joint_position.copy()
    slow[:, 5] += 2e-3 * np.sin(log.time)
    assert still_joints(replace(stuck, joint_position=slow)) == ()
    assert still_joints(replace(log, joint_position=np.repeat(log.joint_position[:1], len(log), axis=0))) == ()


@pytest.mark.parametrize("machine", ["demo", "biped"])
def test_a_dead_encoder_of_a_leg_is_named_where_its_foot_moves_though_it_stands(machine: str) -> None:
    case = None if machine == "demo" else case_of(MACHINES[machine], "full")
    log = demo_log() if case is None else case.log
    knee = next(i for i, name in enumerate(log.joint_names) if "knee" in name)
    stuck = dead(log, knee, 1e-4)
    found = of_demo(stuck) if case is None else checked(case, stuck)
    finding = only(found, "standing feet", "joint_position")
    assert finding.severity == SUSPICIOUS
    assert f"; {log.joint_names[knee]} of its limb stands still throughout: a dead encoder?" in finding.found
    assert finding.advice.startswith(f"look whether {log.joint_names[knee]} moves")
    assert not [one for one in found.findings if "no usual mistake" in one.found]


def test_a_dead_encoder_of_an_arm_is_named_by_its_torque_beside_forces_that_nothing_else_explains() -> None:
    case = case_of(MACHINES["arm"], "contacts")
    found = checked(case, dead(case.log, 1))
    finding = only(found, "dead encoder", "joint_position")
    assert (finding.severity, finding.channels) == (SUSPICIOUS, (case.log.joint_names[1],))
    assert only(found, "forces").found.endswith("; see dead encoder of joint_position")
    light = only(checked(case, dead(case.log, 0)), "dead encoder", "joint_position")  # a vertical axis: inertia alone
    assert light.severity == NOTE
    assert light.advice.startswith("none if friction or a brake holds it")


def test_velocities_that_move_a_joint_whose_positions_do_not_name_its_encoder() -> None:
    log, rng = demo_log(), np.random.default_rng(0)
    rate = np.gradient(log.joint_position, log.time, axis=0) + 0.02 * rng.normal(size=log.joint_position.shape)
    assert list(check_still_velocities(replace(log, joint_velocity=rate))) == []
    stuck = dead(log, 4)
    [finding] = check_still_velocities(replace(stuck, joint_velocity=rate))
    assert (finding.name, finding.severity, finding.channels) == ("dead encoder", SUSPICIOUS, (log.joint_names[4],))
    travel = re.search(rf"{log.joint_names[4]} ([\d.]+)", finding.found)
    assert travel is not None
    assert float(travel[1]) == pytest.approx(np.ptp(log.joint_position[:, 4]), rel=0.15)
    held = rate.copy()
    held[:, 4] = 0.02 * rng.normal(size=len(log))
    assert list(check_still_velocities(replace(stuck, joint_velocity=held))) == []


@cache
def reaching(folder: Path, joint: str, high: float) -> Robot:
    """The arm with another upper limit of a joint, without its shapes."""
    text = re.sub(r"<(visual|collision).*?</\1>", "", PANDA.read_text(), flags=re.DOTALL)
    name = rf'(<joint[^>]*name="{joint}".*?upper=")[^"]*'
    path = folder / "limited.urdf"
    path.write_text(re.sub(name, lambda m: f"{m[1]}{high}", text, flags=re.DOTALL))
    return load_robot(path, fixed_base=True)


def swung(stiffness: float, stops: bool) -> tuple[Log, float, Array]:
    """An arm unlike its URDF whose second joint is driven beyond 0.25 rad by a PD law, and how hard it pushes."""
    robot, rng, high = load(PANDA, fixed_base=True), np.random.default_rng(0), 0.25
    oracle, time, n = Oracle.of(robot), np.arange(2000) / 200.0, robot.n
    oracle.perturb(rng, 0.15)
    middle = np.array([0.0, 0.0, 0.0, -1.5, 0.0, 1.8, 0.0, *np.zeros(n - 7)])
    phase = 2.0 * np.pi * time[:, None] * rng.uniform(0.2, 0.6, n) + rng.uniform(0.0, 6.0, n)
    driven = middle + rng.uniform(0.3, 0.6, n) * np.sin(phase)
    q = driven.copy()
    if stops:
        q[:, 1] = high - 0.004 * np.logaddexp(0.0, (high - q[:, 1]) / 0.004)  # a stop that gives way a little
    v = np.gradient(q, time, axis=0)
    push = stiffness * (driven - q)[:, 1]
    torque = oracle.forces(q, v, np.gradient(v, time, axis=0)) + 0.5 * np.tanh(v / 0.05)
    torque[:, 1] += push
    noise = rng.normal(size=(2, *q.shape))
    log = Log("arm.npz", time, robot.joint_names, q + 1e-4 * noise[0], joint_torque=torque + 0.1 * noise[1])
    return log, high, push


def test_a_stop_that_a_joint_pushes_against_is_named_with_the_torque(tmp_path: Path) -> None:
    log, high, push = swung(60.0, stops=True)
    robot = reaching(tmp_path, "panda_joint2", high)
    finding = only(check(log, robot, (), 10.0), "stop", "joint_position")
    assert (finding.severity, finding.channels) == (SUSPICIOUS, ("panda_joint2",))
    found = re.match(r"panda_joint2 pushes against its limit of 0.25 rad with ([\d.]+) N m", finding.found)
    assert found is not None
    assert float(found[1]) == pytest.approx(float(np.median(push[push > 1.0])), rel=0.25)
    free, *_ = swung(60.0, stops=False)  # beyond a limit at which no stop is
    assert (free.joint_position[:, 1] > high).mean() > 0.2
    assert not [one for one in check(free, robot, (), 10.0).findings if one.severity != NOTE]


def test_the_demo_reaches_no_stop_and_has_no_dead_encoder() -> None:
    found = check(demo_log(), demo_robot(), CONTACTS, 8.0)
    assert not {one.name for one in found.findings} & {"stop", "dead encoder"}
    assert value(demo_log().joint_torque).any()
