"""Armatures that a simulator's implicit integration of a PD law adds."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import pytest
from synthetic import PANDA, load

from torchid.commands.answer import _implicit, implicit_step
from torchid.logs.columns import Columns, Gains, PdLaw, TorqueEntry

KD = {"hip": 5.0, "knee": 2.0, "wrist": 0.5}


@pytest.mark.parametrize("integrator", ["implicit", "implicitfast"])
def test_mujoco_adds_its_step_times_kd_to_the_inertia(integrator: str) -> None:
    step, kp, kd, inertia = 0.004, 30.0, 5.0, 0.2
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco><option gravity="0 0 0" timestep="{step}" integrator="{integrator}"/>
        <worldbody><body><joint name="a" axis="0 0 1"/>
        <inertial pos="0 0 0" mass="1" diaginertia="{inertia} {inertia} {inertia}"/></body></worldbody>
        <actuator><position joint="a" kp="{kp}" kv="{kd}"/></actuator></mujoco>""")
    data = mujoco.MjData(model)
    data.qvel[0] = 0.3
    for _ in range(5):
        torque, before = kp * (0.7 - data.qpos[0]) - kd * data.qvel[0], data.qvel[0]
        data.ctrl[0] = 0.7
        mujoco.mj_step(model, data)
        acceleration = (data.qvel[0] - before) / step
        assert torque / acceleration - inertia == pytest.approx(step * kd, rel=1e-10)


def test_armatures_that_go_with_gains_are_a_step_of_them() -> None:
    added = {name: 0.005 * gain * (1.0 + 0.1 * k) for k, (name, gain) in enumerate(KD.items())}
    assert implicit_step(KD, added, step=0.02) == pytest.approx(0.005, rel=0.15)
    assert implicit_step(KD | {"neck": 0.0}, added | {"toe": 3.0}, step=0.02) is not None, "others do not count"


def test_rotors_of_one_size_are_none_but_where_the_step_is_that_of_the_samples() -> None:
    rotors, equal = dict.fromkeys(KD, 0.01), dict.fromkeys(KD, 2.0)
    assert implicit_step(KD, rotors, step=0.005) is None
    assert implicit_step(equal, rotors, step=0.002) is None
    assert implicit_step(equal, rotors, step=0.005) == pytest.approx(0.005)
    assert implicit_step(KD, dict.fromkeys(KD, -0.01), step=0.005) is None
    assert implicit_step({}, rotors, step=0.005) is None


def run_with(kd: float | None, armature: float) -> Any:
    robot = load(PANDA, fixed_base=True)
    law = None if kd is None else PdLaw(kd=Gains(value={"*": kd}))
    columns = None if kd is None else Columns(joint_torque=TorqueEntry(pd=law))
    extras = [
        SimpleNamespace(extra=SimpleNamespace(what="armature", name=name, dof=k), value=armature)
        for k, name in enumerate(robot.joint_names)
    ]
    experiment = SimpleNamespace(config=SimpleNamespace(logs=SimpleNamespace(columns=columns)), robot=robot)
    forces = SimpleNamespace(rate=1.0 / 0.005)
    return SimpleNamespace(experiment=experiment, extras=extras, forces=forces)


def test_the_answer_names_the_cause_where_the_gain_is_stated_and_nothing_otherwise() -> None:
    (said,) = _implicit(run_with(2.0, 0.01))
    assert said.startswith("Armatures are 5 ms times the stated kd: they come from a simulator")
    assert not list(_implicit(run_with(2.0, 0.3)))
    assert not list(_implicit(run_with(None, 0.01)))
    law = replace(run_with(2.0, 0.01).experiment.config.logs.columns.joint_torque, pd=PdLaw(kp=Gains(value={"*": 1.0})))
    without = run_with(2.0, 0.01)
    without.experiment.config.logs.columns = SimpleNamespace(joint_torque=law)
    assert not list(_implicit(without))
