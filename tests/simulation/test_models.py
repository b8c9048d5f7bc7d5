"""MuJoCo's models of robots' files: with the inertia of bodies, not of links, and refused in a line that helps."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from mujoco_oracle import mujoco_forces
from synthetic import ROBOTS, ROMEO, load, random_states

from torchid import Regressor
from torchid.errors import UrdfError
from torchid.robot.tree import weld_positions
from torchid.robot.urdf import read_urdf
from torchid.simulation.plant import JointConstraints, compile_model

LINKWISE_REFUSED = (
    "go1_description/urdf/go1.urdf",
    "b1_description/urdf/b1.urdf",
    "allegro_hand_description/urdf/allegro_left_hand.urdf",
)


def linkwise(urdf: Path) -> mujoco.MjSpec:
    """Every link as MuJoCo reads it, without shapes."""
    root = ElementTree.parse(urdf).getroot()
    for link in root.findall("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    spec.compiler.fusestatic = spec.compiler.balanceinertia = False
    return spec


def compiled(urdf: Path) -> mujoco.MjModel:
    """Bolted, with its mimic joints."""
    return compile_model(urdf, (), 1000.0, floating=False, constraints=JointConstraints.of(urdf, read_urdf(urdf)[1]))


@pytest.mark.parametrize("urdf", [ROBOTS / name for name in LINKWISE_REFUSED], ids=lambda urdf: urdf.stem)
def test_links_that_cannot_exist_by_themselves_count_with_what_they_are_welded_to(urdf: Path) -> None:
    with pytest.raises(ValueError, match="inertia"):
        linkwise(urdf).compile()
    robot, model = load(urdf, None, True), compiled(urdf)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    q, v, a = random_states(np.random.default_rng(0), robot.n, 5, fixed_base=True)
    expected = mujoco_forces(model, robot, q, v, a)
    found = Regressor(robot)(*map(torch.from_numpy, (q, v, a))) @ torch.from_numpy(robot.nominal.flatten())
    np.testing.assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max())


def test_a_link_that_moves_without_mass_is_named_with_what_helps() -> None:
    line = r"romeo.urdf: link 'LFinger11Link': moves, but has no mass .*robot.weld: {LHand: 0}"
    with pytest.raises(UrdfError, match=line):
        compiled(ROMEO)
    joints = read_urdf(ROMEO)[1]
    hands = weld_positions(ROMEO, joints, {"LHand": 0.0, "RHand": 0.0})
    assert compile_model(
        ROMEO, (), 1000.0, floating=False, constraints=JointConstraints.of(ROMEO, joints, held=hands)
    ).nv
