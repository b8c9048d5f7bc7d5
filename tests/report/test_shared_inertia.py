"""Files of robots in which joints that the experiment held still move again: every link there is a body."""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mujoco_oracle import INERTIA_ROUNDING
from urdfs import inertial, joint, link, write

from torchid.report import FittedJoints, identified_urdf
from torchid.report.mjcf_files import mjcf_of_urdf
from torchid.report.robot_files import refused_by_simulators
from torchid.report.urdf_files import SMALLEST
from torchid.robot import Robot, load_robot

NONE = inertial("0", ixx="0", iyy="0", izz="0")
PAD = joint("pad", "left", "left_pad", "fixed", "")


def gripper(folder: Path, finger: str, *more: str) -> Robot:
    """An arm of 1 kg whose two fingers are held still."""
    at = '<origin xyz="{} 0.1 0.2" rpy="0.3 0 0.5"/><axis xyz="0 1 0"/>'
    extra = {side: at.format(x) for side, x in (("left", 0.1), ("right", -0.1))}
    fingers = [link(side, finger) + joint(f"to_{side}", "arm", side, "prismatic", extra[side]) for side in extra]
    elbow = joint("elbow", "base", "arm")
    path = write(
        folder, link("base"), link("arm", inertial(ixx="0.02", iyy="0.02", izz="0.02")), elbow, *fingers, *more
    )
    return load_robot(path, fixed_base=True, weld={"to_left": 0.02, "to_right": 0.0})


def body_parameters(path: Path) -> np.ndarray:
    """Parameters of the bodies of a written file, with its fingers held as they were."""
    return load_robot(path, fixed_base=True, weld={"to_left": 0.02, "to_right": 0.0}).nominal[:, :10]


@pytest.mark.parametrize(
    ("finger", "scale", "more"),
    [
        (NONE, 1.0, ()),
        ("", 0.7, ()),
        (NONE, 1.0, (link("left_pad", inertial("0.1", ixx="1e-4", iyy="1e-4", izz="1e-4")), PAD)),
        (inertial("0.8", ixx="0.01", iyy="0.01", izz="0.01"), 0.3, ()),
        (inertial("0.1", ixx="0.001", iyy="0.001", izz="0.004"), 1.0, ()),
    ],
    ids=[
        "fingers without mass",
        "fingers without inertial",
        "a pad with mass",
        "fingers too heavy",
        "no body's inertia",
    ],
)
@pytest.mark.filterwarnings("ignore:.*(exceeds the sum of the others|at the end of a limb has no inertia)")
def test_every_link_of_a_file_is_a_body_and_their_sum_is_what_was_identified(
    tmp_path: Path, finger: str, scale: float, more: tuple[str, ...]
) -> None:
    robot = gripper(tmp_path, finger, *more)
    phi = robot.nominal * np.array([[1.0], [scale]])
    for name, text in (("x.urdf", identified_urdf(robot, phi)), ("x.xml", mjcf_of_urdf(robot, phi, {}))):
        (tmp_path / name).write_bytes(text)
        model = mujoco.MjModel.from_xml_path(str(tmp_path / name))
        assert model.nv == 3
        assert model.body_inertia[1 if name == "x.urdf" else 2 :].min() > 1e5 * SMALLEST
        atol = 1e-14 + INERTIA_ROUNDING * name.endswith("xml")
        np.testing.assert_allclose(body_parameters(tmp_path / name), phi[:, :10], rtol=1e-12, atol=atol)
    assert refused_by_simulators(robot, phi, FittedJoints()) == ""


@pytest.mark.parametrize("installed", [True, False])
def test_a_file_that_simulators_refuse_is_known_with_mujoco_and_without(
    tmp_path: Path, installed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = gripper(tmp_path, NONE)
    assert refused_by_simulators(robot, robot.nominal, FittedJoints()) == ""
    if not installed:
        monkeypatch.setitem(sys.modules, "mujoco", None)
        monkeypatch.delitem(sys.modules, "torchid.robot.mjcf")
    assert refused_by_simulators(robot, robot.nominal, FittedJoints()) == ""
    point = robot.nominal.copy()
    point[1, 1:10] = 0.0  # a point mass at the axis that moves it
    assert "arm" in refused_by_simulators(robot, point, FittedJoints())
