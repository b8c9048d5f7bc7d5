"""MJCF robots that a simulator's user holds by a mocap body, or that hang on scenery: a contact nobody measured."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("mujoco", reason="MuJoCo is not installed")

import mujoco

import torchid
from torchid.errors import TorchidWarning
from torchid.robot import load_robot

ARM = """<mujoco><option timestep="1e-3"/><default><joint damping=".3" armature=".05"/></default><worldbody>
 <body name="target" mocap="true" pos=".3 .2 .6"/><body name="table" pos="0 0 .2"><site name="peg"/></body>
 <body name="one" pos="0 0 .8"><joint name="a" axis="0 0 1"/><joint name="rail" type="slide" damping="1e11"/>
  <geom type="capsule" fromto="0 0 0 .2 0 .1" size=".03"/>
  <body name="two" pos=".2 0 .1"><joint name="b" axis="0 1 0"/><joint name="e" axis="0 0 1"/>
  <geom type="box" size=".1 .03 .02" pos=".1 0 0"/>
   <body name="three" pos=".2 0 0"><joint name="c" axis="0 1 0"/><joint name="f" axis="1 0 0"/>
   <geom type="box" size=".08 .01 .02" pos=".08 0 0"/>
    <body name="four" pos=".16 .02 0"><joint name="d" axis="1 0 0"/><joint name="g" axis="0 1 0"/>
    <geom type="box" size=".03 .01 .05" pos=".03 0 0"/>
     <site name="grip" pos=".06 0 .01"/></body></body></body></body></worldbody>
 <equality>
{}</equality></mujoco>"""
ATTACHMENTS = {
    '<weld body1="target" body2="four"/>': ("<weld>, line 13", "loop1 of four", "flat"),
    '<weld name="held" body1="four" body2="target"/>': ("<weld> 'held', line 13", "held of four", "flat"),
    '<connect body1="four" body2="target" anchor=".06 0 .01"/>': ("<connect>, line 13", "loop1 of four", "point"),
    '<connect name="peg" site1="grip" site2="peg"/>': ("<connect> 'peg', line 13", "peg of four", "point"),
}


@pytest.mark.parametrize("attachment", ATTACHMENTS)
def test_what_holds_the_robot_drops_out_as_a_contact_that_is_not_measured(attachment: str, tmp_path: Path) -> None:
    """Random torques against it, in MuJoCo: the arm's equations without the attachment's force, within rounding."""
    where, frame, kind = ATTACHMENTS[attachment]
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format(attachment))
    contact = f"contacts: [{{frame: {frame}, type: {kind}}}]"
    with pytest.warns(TorchidWarning, match=f"{re.escape(where)}: attaches the robot to .*{re.escape(contact)}"):
        robot = load_robot(path, fixed_base=True)
    assert not robot.loops
    assert not robot.passive
    model = mujoco.MjModel.from_xml_path(str(path))
    data, rng, states = mujoco.MjData(model), np.random.default_rng(0), []
    for _ in range(50):
        data.qpos[:], data.qvel[:] = rng.uniform(-1.0, 1.0, robot.n), rng.normal(size=robot.n)
        data.qvel[1] *= 1e-10  # of the rail
        data.qfrc_applied[:] = rng.normal(size=robot.n)
        data.mocap_pos[0] = rng.normal(size=3)
        mujoco.mj_forward(model, data)
        states.append([data.qpos.copy(), data.qvel.copy(), data.qacc.copy(), data.qfrc_applied.copy()])
    q, v, a, applied = (torch.tensor(np.array(x)) for x in zip(*states, strict=True))
    rigid = torch.tensor(robot.nominal.flatten())
    needed = torchid.Regressor(robot)(q, v, a) @ rigid + torch.tensor(robot.armature) * a
    rows = 3 if kind == "point" else 6
    J, active = torchid.FrameJacobian(robot, frame)(q)[:, :rows], torch.ones(50, rows, dtype=torch.bool)
    project = torchid.Projection([True] * robot.n, [False] * rows, base_rows=0)
    groups = project(J, active, needed[..., None], applied, torch.zeros(50, rows, dtype=torch.float64))
    size = (needed - applied).abs().max()
    missed = [float((x.K[..., 0] - x.f).abs().max()) for x in groups if x.f.numel()]
    assert size > 1.0, "the attachment's force"
    assert len(missed) == 1, "rows are left in all samples"
    assert missed[0] < 1e-12 * size
