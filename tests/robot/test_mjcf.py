"""MJCF robots mean the same to torchid as to MuJoCo, when read and when written; what is beyond a tree is refused."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("mujoco", reason="MuJoCo is not installed")

import mujoco
from lxml import etree
from mujoco_oracle import INERTIA_ROUNDING, IS_MUJOCO_3
from survey_mjcf import States, difference, mujoco_forces, survey, torchid_forces

from torchid.errors import InputError, TorchidWarning, UrdfError
from torchid.report import FittedJoints, identified_robot, identified_urdf
from torchid.robot import Robot, load_robot
from torchid.robot.mjcf import MjcfModel

FREE = """<mujoco><compiler angle="degree" autolimits="true"/>
<default><joint armature="0.02" damping="0.3" frictionloss="0.1"/>
 <default class="stiff"><joint stiffness="4" springref="20"/></default></default>
<worldbody><body name="scenery"><geom size="1"/></body>
 <body name="box" pos="2 0 0"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
 <body name="trunk" pos="0 0 1" euler="10 20 30"><freejoint name="root"/>
  <inertial pos=".1 0 .02" mass="3" quat="1 2 3 4" diaginertia=".03 .04 .05"/>
  <frame euler="0 30 40" pos="0.1 0 0"><body name="leg" pos="0 .1 0" euler="90 0 10">
   <joint name="yaw" axis="0 1 1" pos=".05 .02 0" ref="15" range="-60 60"/>
   <joint name="pitch" axis="1 0 0" pos="0 0 .3" class="stiff"/>
   <joint name="stretch" type="slide" axis="0 0 1" ref=".1" damping="2"/>
   <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass="1.5"/>
   <body name="weight" pos="0 0 -.1"><geom type="sphere" size=".05" mass=".4"/></body>
   <body name="shank" pos="0 0 -.3" quat="0 1 0 0"><joint name="knee" pos="0 .01 0"/>
    <geom name="ball" type="sphere" size=".02" pos="0 0 .3" mass=".2"/><site name="sole" pos="0 0 .3"/></body>
  </body></frame></body></worldbody></mujoco>"""

BOLTED = """<mujoco><compiler inertiafromgeom="true" settotalmass="7"/>
<worldbody><body name="stand" euler="90 0 0"><geom size=".1"/>
 <body name="arm" pos="0 0 .2"><joint name="shoulder" axis="0 1 0"/><geom type="box" size=".1 .02 .03" pos=".1 0 0"/>
  <body name="left" pos=".2 .05 0"><joint name="left_finger" type="slide" axis="0 1 0" ref="0.01"/>
   <geom size=".02" pos="0 .01 .1"/></body>
  <body name="right" pos=".2 -.05 0"><joint name="right_finger" type="slide" axis="0 -1 0" armature=".1" damping="2"/>
   <geom size=".02"/></body></body></body></worldbody>
<equality><joint joint1="right_finger" joint2="left_finger" polycoef="0.02 0.5 0 0 0"/></equality></mujoco>"""

TENDON_OF_TWO = """<tendon><fixed name="t"><joint joint="left_finger" coef="2"/><joint joint="right_finger" coef="-4"/>
 </fixed></tendon><equality><tendon tendon1="t" polycoef=".03 1 0 0 0"/></equality></mujoco>"""
TIED = re.sub("<equality>.*", TENDON_OF_TWO, BOLTED)


def robot_of(text: str, folder: Path, fixed_base: bool = False) -> Robot:
    path = folder / "robot.xml"
    path.write_text(text)
    return load_robot(path, fixed_base=fixed_base)


@pytest.mark.parametrize(("text", "velocities"), [(FREE, 10), (BOLTED, 2), (TIED, 2)], ids=["free", "bolted", "tied"])
def test_inverse_dynamics_are_those_of_mujoco_and_what_is_written_is_what_is_read(
    text: str, velocities: int, tmp_path: Path
) -> None:
    (tmp_path / "robot.xml").write_text(text)
    found = survey(tmp_path / "robot.xml", tmp_path)
    assert found.robot is not None, found.refusal
    assert found.robot.nv == velocities
    assert found.inverse_dynamics < 1e-13
    assert found.read_again < 1e-13 + INERTIA_ROUNDING
    assert found.written < 1e-13 + INERTIA_ROUNDING


@pytest.mark.parametrize("text", [BOLTED, TIED], ids=["joints", "a tendon"])
def test_joints_follow_each_other_where_mujocos_equality_holds(text: str, tmp_path: Path) -> None:
    robot = robot_of(text.replace('name="right_finger"', 'name="right_finger" ref="-.2"'), tmp_path, fixed_base=True)
    model = MjcfModel(robot.path).model
    data, (matrix, constant) = mujoco.MjData(model), robot.joint_map
    for q in np.random.default_rng(0).uniform(-1.0, 1.0, (5, 2)):
        at = dict(zip((body.name for body in robot.bodies[1:]), matrix @ q + constant, strict=True))
        data.qpos[:] = [at[name] for name in ("arm", "left", "right")]
        mujoco.mj_forward(model, data)
        assert len(data.efc_pos) == 1
        np.testing.assert_allclose(data.efc_pos, 0.0, atol=1e-15)


def test_the_urdf_of_an_mjcf_robot_has_its_dynamics_but_for_armatures_and_springs(tmp_path: Path) -> None:
    robot = robot_of(FREE, tmp_path)
    (tmp_path / "plain.urdf").write_bytes(identified_urdf(robot, robot.nominal))
    plain, states = load_robot(tmp_path / "plain.urdf"), States.random(robot)
    assert plain.joint_names == robot.joint_names
    assert not plain.armature.any()
    one, other = (torchid_forces(plain, x.nominal, np.zeros(4), states) for x in (plain, plain))
    assert difference(one, other) == 0.0
    rigid = torchid_forces(robot, robot.nominal, np.zeros(robot.n), states)
    rigid[:, 6:] -= robot.stiffness * states.q[:, 7:] + robot.spring_torque
    assert difference(one, rigid) < 1e-13


def test_sites_and_geoms_are_frames_and_names_are_those_of_the_file(tmp_path: Path) -> None:
    robot = robot_of(FREE, tmp_path)
    assert robot.joint_names == ("yaw", "pitch", "stretch", "knee")
    assert robot.body_names == ("trunk", "leg/yaw", "leg/pitch", "leg", "shank")
    for frame in ("sole", "ball"):
        body, T = robot.link(frame)
        assert robot.body_names[body] == "shank"
        np.testing.assert_allclose(T[:3, 3], [0.0, -0.0, 0.3], atol=1e-15)


def test_included_files_are_read_and_stand_in_what_is_written(tmp_path: Path) -> None:
    (tmp_path / "part.xml").write_text(
        '<mujoco><worldbody><body name="b"><joint name="j"/><geom size=".1"/></body></worldbody></mujoco>'
    )
    (tmp_path / "scene.xml").write_text('<mujoco><include file="part.xml"/></mujoco>')
    (tmp_path / "out").mkdir()
    found = survey(tmp_path / "scene.xml", tmp_path / "out")
    assert found.written < 1e-13
    assert "<include" not in (tmp_path / "out" / "scene.xml").read_text()


def test_a_file_that_is_missing_is_named_with_the_one_that_includes_it(tmp_path: Path) -> None:
    (tmp_path / "part.xml").write_text('<mujoco><include file="arm.xml"/></mujoco>')
    (tmp_path / "scene.xml").write_text('<mujoco><include file="part.xml"/></mujoco>')
    with pytest.raises(UrdfError, match=r"part\.xml: <include>: 'arm\.xml' does not exist"):
        load_robot(tmp_path / "scene.xml")


BODY = '<mujoco>\n<worldbody>\n<body name="b"{}>{}<geom size=".1"/><site name="s"/></body></worldbody>{}</mujoco>'
HINGE = '<joint name="j"{}/>'
POLYNOMIAL = '<equality>\n<joint joint1="j" polycoef="0 1 2 0 0"/></equality>'
COUPLED = """<worldbody><body><joint name="k"/><geom size=".1"/><body><joint name="l"/><geom size=".1"/></body></body>
 </worldbody><tendon><fixed name="t"><joint joint="j" coef="1"/><joint joint="k" coef="1"/><joint joint="l" coef="1"/>
 </fixed></tendon><equality><tendon tendon1="t"/></equality>"""
TENDON = '<tendon>\n<fixed name="t" stiffness="3"><joint joint="j" coef="1"/></fixed></tendon>'
REFUSED = {
    "ball": (BODY.format("", '\n<joint name="j" type="ball"/>', ""), "<joint> 'j', line 4: type ball"),
    "tendon of three": (
        BODY.format("", HINGE.format(""), COUPLED),
        "<tendon>, line 5: an equality constraint; accepted: one fixed tendon of two joints",
    ),
    "law": (BODY.format("", HINGE.format(""), POLYNOMIAL), "<joint>, line 4: an equality constraint"),
    "tendon": (BODY.format("", HINGE.format(""), TENDON), "<fixed> 't', line 4: a tendon with stiffness"),
    "gravcomp": (BODY.format(' gravcomp="1"', HINGE.format(""), ""), "<body> 'b', line 3: gravcomp 1"),
    "locked": (BODY.format("", HINGE.format(' damping="1e13"'), ""), "<joint> 'j', line 3: damping 1e+13"),
    "fluid": (BODY.format("", HINGE.format(""), '<option\n density="1000"/>'), "<option>, line 4: density 1000"),
    "NaN": (
        BODY.format("", HINGE.format("") + '\n<inertial pos="nan 0 0" mass="1" diaginertia="1 1 1"/>', ""),
        "<inertial>, line 4: a number is not finite",
    ),
    "infinite armature": (
        BODY.format("", HINGE.format(' armature="inf"'), ""),
        "joint 'j', <dynamics>: a number is not finite; accepted: finite numbers",
    ),
    "NaN of a spring": (
        BODY.format("", HINGE.format(' stiffness="1" springref="nan"'), ""),
        "MuJoCo refuses it: Nan, Inf" if IS_MUJOCO_3 else "joint 'j', <dynamics>: a number is not finite; accepted: ",
    ),
    "a ground of gigabytes": (
        BODY.format("", HINGE.format(""), '<asset><hfield name="h" nrow="50000" ncol="50000" size="1 1 1 1"/></asset>'),
        "robot.xml: MJCF: MuJoCo cannot read it (",
    ),
    "attached to itself": (
        BODY.format(
            "",
            HINGE.format("") + '<attach model="m" body="b" prefix="x"/>',
            '<asset><model name="m" file="robot.xml"/></asset>',
        ),
        "robot.xml: MJCF: its reader crashed (SIGSEGV)",
    ),
    "four thousand bodies": (
        BODY.format("", HINGE.format(""), "").replace("</worldbody>", "<body/>" * 4000 + "</worldbody>"),
        "robot.xml: <body>: 4002 bodies; accepted: at most 3000 in a scene",
    ),
    "damped base": (
        BODY.format("", '<joint type="free" damping="1"/>', ""),
        f"<joint>, line 3: damping 1{' 0 0' * (not IS_MUJOCO_3)} of a free",
    ),
    "no joint": (BODY.format("", "", ""), "<joint>: none"),
    "polynomial": (
        BODY.format("", HINGE.format(' damping="1 2"'), ""),
        "attribute 'damping' has too much data" if IS_MUJOCO_3 else "<joint> 'j', line 3: damping 1 2 0",
    ),
    "unknown": (BODY.format("", "<jiont/>", ""), "MJCF: MuJoCo refuses it"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_tree_of_joints_is_refused_by_element_and_line(case: str, tmp_path: Path) -> None:
    text, message = REFUSED[case]
    with pytest.raises(UrdfError, match=re.escape(message)) as caught:
        robot_of(text, tmp_path, fixed_base=case != "damped base")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("angle", ["degree", "radian"])
def test_fitted_springs_with_their_offsets_are_what_is_read_again(angle: str, tmp_path: Path) -> None:
    robot = robot_of(FREE.replace('angle="degree"', f'angle="{angle}"'), tmp_path)
    fitted = FittedJoints(
        stiffness={"knee": 3.0, "stretch": 2.0}, torque_offset={"knee": 0.6, "pitch": 0.2, "yaw": 0.1}
    )
    with pytest.warns(
        TorchidWarning, match="MJCF cannot express the fitted offset or spring of yaw .an offset without a spring"
    ):
        text = identified_robot(robot, robot.nominal, fitted)
    (tmp_path / "identified.xml").write_bytes(text)
    again = load_robot(tmp_path / "identified.xml")
    of = dict(zip(robot.joint_names, range(robot.n), strict=True))
    expected, constant = robot.stiffness.copy(), robot.spring_torque.copy()
    expected[[of["knee"], of["stretch"]]] = 3.0, 2.0
    constant[[of["knee"], of["pitch"]]] += 0.6, 0.2
    np.testing.assert_allclose(again.stiffness, expected, rtol=1e-14)
    np.testing.assert_allclose(again.spring_torque, constant, rtol=0.0, atol=1e-13)


LOOPED = """<mujoco><worldbody><body name="b"><joint name="j"/><geom size=".1"/><site name="s" pos=".1 .2 .3"/></body>
 <body name="c" pos=".3 0 0"><joint name="k"/><geom size=".1"/><site name="t" pos="-.2 .2 .3" euler="0 0 40"/></body>
 </worldbody>
 <equality>{}</equality><actuator>{}</actuator></mujoco>"""


@pytest.mark.parametrize(
    ("equality", "kind", "frames"),
    [
        ('<connect body1="b" body2="c" anchor=".1 .2 .3"/>', "point", ("loop1 of b", "loop1 of c")),
        ('<connect name="pin" site1="s" site2="t"/>', "point", ("pin of b", "pin of c")),
        ('<connect body1="c" anchor="0 .1 0"/>', "point", ("loop1 of c", "loop1 of world")),
        ('<weld body1="b" body2="c"/>', "weld", ("loop1 of b", "loop1 of c")),
        ('<weld body1="b" body2="c" anchor=".1 0 0" relpose=".4 0 0 1 0 0 0"/>', "weld", ("loop1 of b", "loop1 of c")),
    ],
)
def test_loops_close_where_mujoco_closes_them(
    equality: str, kind: str, frames: tuple[str, str], tmp_path: Path
) -> None:
    robot = robot_of(LOOPED.format(equality, ""), tmp_path, True)
    [loop] = robot.loops
    assert (loop.kind, loop.frames) == (kind, frames)
    poses = robot.link_poses(torch.zeros(1, 2, dtype=torch.float64))
    one, other = (poses[frame][0].numpy() for frame in frames)
    np.testing.assert_allclose(one[:3, 3], other[:3, 3], atol=1e-15)
    if kind == "weld":
        np.testing.assert_allclose(one, other, atol=1e-15)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.efc_pos, 0.0, atol=1e-15)


def test_a_robot_without_a_free_joint_must_be_said_to_be_bolted(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="robot.fixed_base: true, or a free joint"):
        robot_of(BOLTED, tmp_path)


def test_of_the_world_nothing_is_written_nor_said(tmp_path: Path) -> None:
    """As of a robot whose first joints are welded, whose links then belong to the world."""
    robot = robot_of(BOLTED, tmp_path, True)
    phi = robot.nominal.copy()
    phi[0, 0] = -1.0
    assert identified_robot(robot, phi, FittedJoints()) == identified_robot(robot, robot.nominal, FittedJoints())


@pytest.mark.parametrize(
    ("option", "gravity"),
    [('<option gravity="0 0 -1.6"/>', "0 0 -1.6"), ('<option><flag gravity="disable"/></option>', "0 0 0")],
)
def test_another_planet_is_warned_of(tmp_path: Path, option: str, gravity: str) -> None:
    with pytest.warns(TorchidWarning, match=f"gravity {gravity}; torchid uses the Earth's"):
        robot_of(BODY.format("", HINGE.format(""), option), tmp_path, True)


def test_what_mujoco_multiplies_is_written_with_what_was_identified_to_the_last_digit_and_the_rest_to_six(
    tmp_path: Path,
) -> None:
    """`<replicate>` has no element for each of its legs: the file is MuJoCo's own, resolved."""
    (tmp_path / "tool.xml").write_text(
        '<mujoco model="tool"><worldbody><body name="probe"><joint name="twist" axis="0 0 1" damping="0.1"/>'
        '<geom type="box" size=".01 .02 .03" mass=".3"/></body></worldbody></mujoco>'
    )
    leg = '<body name="leg" pos=".123456789 0 0"><joint name="hip" axis="0 1 0" armature="0.0123456789"/>'
    leg += '<geom type="capsule" fromto="0 0 0 0 .01 -.3" size=".02" mass="1.5"/></body>'
    text = f"""<mujoco><asset><model name="tool" file="tool.xml"/></asset><worldbody><body name="trunk"><freejoint/>
     <geom type="box" size=".2 .1 .08" mass="6"/><replicate count="3" euler="0 0 2.0943951">{leg}</replicate>
     <frame pos="0 0 .1"><attach model="tool" body="probe" prefix="tool_"/></frame></body></worldbody></mujoco>"""
    robot = robot_of(text, tmp_path)
    assert robot.joint_names == ("hip0", "hip1", "hip2", "tool_twist")
    (tmp_path / "out").mkdir()
    found = survey(tmp_path / "robot.xml", tmp_path / "out")
    assert found.inverse_dynamics < 1e-13
    written = tmp_path / "out" / "robot.xml"
    assert not {"replicate", "attach"} & {str(element.tag) for element in etree.parse(written).iter()}
    assert found.read_again < 1e-13, "identified: every digit"
    assert 1e-9 < found.written < 1e-5, "where bodies are: six digits"


@pytest.mark.parametrize(
    ("actuators", "passive"),
    [
        ('<motor joint="j"/>', ("k",)),
        ('<position jointinparent="k"/>', ("j",)),
        ('<motor site="s"/>', ()),
        ("", ()),
    ],
)
def test_joints_of_robots_with_loops_that_no_actuator_drives_have_no_motor(
    actuators: str, passive: tuple[str, ...], tmp_path: Path
) -> None:
    closed = '<connect site1="s" site2="t"/>'
    assert robot_of(LOOPED.format(closed, actuators), tmp_path, True).passive == passive
    assert robot_of(LOOPED.format("", actuators), tmp_path, True).passive == (), "as before without loops"
    assert load_robot(tmp_path / "robot.xml", fixed_base=True, passive=["j"]).passive == ("j",)


OTHER = '<worldbody><body name="m" mocap="true"/></worldbody><equality>\n<weld body1="m" body2="b"/></equality>'


def test_a_limited_tendon_or_an_inactive_loop_changes_nothing(tmp_path: Path) -> None:
    tendon = TENDON.replace('stiffness="3"', 'limited="true" range="0 1"')
    loop = OTHER.replace("<weld", '<weld active="false"')
    robot = robot_of(BODY.format("", HINGE.format(""), tendon + loop), tmp_path, True)
    states = States.random(robot)
    own = torchid_forces(robot, robot.nominal, robot.armature, states)
    assert difference(own, mujoco_forces(MjcfModel(robot.path), robot, states)) < 1e-13


def test_springs_that_push_or_move_several_joints_are_named(tmp_path: Path) -> None:
    robot = robot_of(BOLTED, tmp_path, True)
    fitted = FittedJoints(stiffness={"shoulder": -1.0, "left_finger": 2.0})
    with pytest.warns(
        TorchidWarning, match="spring of shoulder, left_finger .an offset without a spring, a negative stiffness"
    ):
        assert not fitted.springs(robot, "identified.xml")
