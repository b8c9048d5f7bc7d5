"""Joints of closed loops without an encoder: their motion is what the constraints make of that of the others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("mujoco", reason="MuJoCo is not installed")

from closed_loops import MODELS, LoopWorld, loop_world
from synthetic import Array

from torchid.errors import LogError
from torchid.logs import Log
from torchid.logs.preprocess import preprocess
from torchid.problem import bind_log
from torchid.problem.log_joints import with_loop_joints
from torchid.regressor.loops import LoopClosures
from torchid.robot import load_robot

FOUR_BAR = """<mujoco><worldbody><body name="frame"><inertial pos="0 0 0" mass="5" diaginertia=".1 .1 .1"/>
<body name="crank"><joint name="crank" axis="0 1 0"/><inertial pos="0 0 .1" mass="1" diaginertia=".01 .01 .01"/>
<body name="coupler" pos="0 0 .2"><joint name="coupler" axis="0 1 0"/>
<inertial pos=".2 0 0" mass="1" diaginertia=".01 .01 .01"/><site name="pin" pos=".4 0 0"/></body></body>
<body name="rocker" pos=".4 0 0"><joint name="rocker" axis="0 1 0"/>
<inertial pos="0 0 .1" mass="1" diaginertia=".01 .01 .01"/><site name="top" pos="0 0 .2"/></body></body></worldbody>
<equality><connect site1="pin" site2="top"/></equality><actuator><motor joint="crank"/></actuator></mujoco>"""

robots = pytest.mark.parametrize("name", MODELS)


def without(log: Log, joints: tuple[str, ...]) -> Log:
    """The log as it is without columns for some joints."""
    kept = [k for k, name in enumerate(log.joint_names) if name not in joints]
    fields = ("joint_position", "joint_velocity", "joint_acceleration", "joint_torque")
    arrays = {name: getattr(log, name)[:, kept] for name in fields if getattr(log, name) is not None}
    return replace(log, joint_names=tuple(log.joint_names[k] for k in kept), **arrays)


def in_order(log: Log, name: str, joints: tuple[str, ...]) -> Array:
    return getattr(log, name)[:, [log.joint_names.index(joint) for joint in joints]]


def smooth(w: LoopWorld, count: int = 2000) -> Log:
    """A log of motors that swing."""
    time, rng = 0.002 * np.arange(count), np.random.default_rng(0)
    motors = tuple(name for name in w.robot.joint_names if name not in w.robot.passive)
    size = np.where(np.isin(motors, w.robot.sliding), 0.03, 0.3)  # m or rad
    swings = [np.sin(2.0 * np.pi * rng.uniform(0.3, 1.0) * time + rng.uniform(0.0, 6.0)) for _ in motors]
    return Log("swing.npz", time, motors, size * np.stack(swings, axis=1))


@robots
def test_positions_and_velocities_are_those_that_the_log_had(name: str) -> None:
    w = loop_world(name)
    found = with_loop_joints(without(w.log, w.robot.passive), w.robot)
    for field in ("joint_position", "joint_velocity"):
        one, other = (in_order(log, field, w.robot.joint_names) for log in (found, w.log))
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-9)
    assert np.isnan(in_order(found, "joint_torque", w.robot.passive)).all()
    samples = bind_log(found, w.robot, w.contacts)
    assert samples.torque is not None
    assert torch.isfinite(samples.torque).all()


@robots
def test_velocities_and_accelerations_are_derivatives_of_positions(name: str) -> None:
    w = loop_world(name)
    moved = preprocess(smooth(w), None)
    found = with_loop_joints(moved, w.robot)
    step, inner = found.time[1] - found.time[0], slice(2, -2)
    q, v, a = (getattr(found, f"joint_{field}") for field in ("position", "velocity", "acceleration"))
    np.testing.assert_allclose(v[inner], np.gradient(q, step, axis=0)[inner], atol=2e-4 * np.abs(v).max())
    np.testing.assert_allclose(a[inner], np.gradient(v, step, axis=0)[inner], atol=2e-3 * np.abs(a).max())


@robots
def test_the_drift_of_the_constraints_is_the_derivative_of_their_jacobian(name: str) -> None:
    w = loop_world(name)
    closures = LoopClosures(w.robot)
    q, v = (torch.from_numpy(x[:50]) for x in (w.log.joint_position, w.log.joint_velocity))
    ahead, behind = (closures.jacobian(q + sign * 1e-6 * v) for sign in (1.0, -1.0))
    expected = ((ahead - behind) / 2e-6 @ v[..., None])[..., 0]
    np.testing.assert_allclose(closures.drift(q, v), expected, atol=1e-8)


def test_samples_that_are_not_finite_stay_so() -> None:
    w = loop_world("four-bar leg")
    log = smooth(w, 100)
    log.joint_position[7, 0] = np.nan
    found = with_loop_joints(log, w.robot)
    assert np.isnan(found.joint_position).any(axis=1).tolist() == [k == 7 for k in range(100)]


def test_a_log_with_all_joints_and_a_robot_without_loops_stay_as_they_are() -> None:
    w = loop_world("four-bar leg")
    assert with_loop_joints(w.log, w.robot) is w.log
    short = without(w.log, w.robot.passive)
    assert with_loop_joints(short, None) is short
    assert with_loop_joints(short, replace(w.robot, loops=())) is short


def test_joints_that_loops_do_not_determine_are_named() -> None:
    w = loop_world("four-bar leg")
    short = without(w.log, ("knee", "coupler", "crank"))
    with pytest.raises(LogError, match="loops of four-bar leg.xml do not determine missing joints knee, crank, coup"):
        with_loop_joints(short, w.robot)
    with pytest.raises(
        LogError, match="missing joints of four-bar leg.xml: abduction; .*a joint of a loop may be missing"
    ):
        bind_log(with_loop_joints(without(w.log, ("abduction",)), w.robot), w.robot, w.contacts)


def test_a_log_of_no_joint_of_a_single_loop_is_refused_by_what_is_not_determined(tmp_path: Path) -> None:
    (tmp_path / "fourbar.xml").write_text(FOUR_BAR)
    robot = load_robot(tmp_path / "fourbar.xml", fixed_base=True)
    log = Log("log.npz", np.arange(5.0), (), np.empty((5, 0)))
    with pytest.raises(LogError, match="crank, coupler, rocker"):
        with_loop_joints(log, robot)


def test_loops_that_do_not_close_are_refused_with_how_far_they_are_open() -> None:
    w = loop_world("four-bar leg")
    loop = replace(w.robot.loops[0], frames=(w.robot.loops[0].frames[0], "trunk"))
    with pytest.raises(
        LogError, match=r"pin of coupler and trunk are apart by \d+ mm rms, \d+ mm at most at every pos"
    ):
        with_loop_joints(without(w.log, ("coupler",)), replace(w.robot, loops=(loop,)))
