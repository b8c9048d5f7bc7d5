"""What a URDF must be: every refusal is one line that names the file and the element."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from urdfs import ARM, BASE, HINGE, INERTIA, INERTIAL, TREE, inertial, joint, link, mimic, refusal, table, write

from torchid.errors import TorchidWarning, UnknownNameError, UrdfError
from torchid.report.urdf_files import identified_urdf
from torchid.robot import load_robot

WRONG_NAMES = {
    "link without a name": ((BASE, f"<link>{INERTIAL}</link>"), "link number 2: no name"),
    "link with an empty name": ((link(""),), "link number 1: no name"),
    "joint without a name": (
        (BASE, ARM, HINGE.replace('name="elbow"', "")),
        "joint number 1: no name",
    ),
    "two links of one name": ((BASE, BASE), "link 'base': defined more than once"),
    "two joints of one name": (
        (BASE, ARM, link("hand"), HINGE, joint("elbow", "arm", "hand")),
        "joint 'elbow': defined more than once",
    ),
    "no link at all": ((), "link: none found"),
}

WRONG_TREES = {
    "a floating joint": ((BASE, ARM, joint("elbow", "base", "arm", "floating")), "joint 'elbow': type 'floating'"),
    "a planar joint": ((BASE, ARM, joint("elbow", "base", "arm", "planar")), "joint 'elbow': type 'planar'"),
    "a misspelt joint type": ((BASE, ARM, joint("elbow", "base", "arm", "Revolute")), "joint 'elbow': type 'Revolute'"),
    "a joint without a type": ((BASE, ARM, HINGE.replace('type="revolute"', "")), "joint 'elbow': no type"),
    "a joint without a parent": (
        (BASE, ARM, HINGE.replace('<parent link="base"/>', "")),
        "joint 'elbow': no <parent> link",
    ),
    "a child that names no link": (
        (BASE, ARM, HINGE.replace('<child link="arm"/>', "<child/>")),
        "joint 'elbow': no <child> link",
    ),
    "a link with two parents": (
        (BASE, ARM, link("bar"), HINGE, joint("b", "base", "bar"), joint("close", "bar", "arm")),
        "link 'arm': two joints have this child, one is 'close'",
    ),
    "a link that is its own parent": ((BASE, ARM, joint("elbow", "arm", "arm")), "link 'arm': part of a loop"),
    "a cycle beside the tree": (
        (*TREE, link("x"), link("y"), joint("xy", "x", "y"), joint("yx", "y", "x")),
        "link 'x': part of a loop",
    ),
    "a cycle without any root": (
        (BASE, ARM, HINGE, joint("back", "arm", "base")),
        "link 'base': part of a loop",
    ),
    "two roots": ((BASE, ARM), "tree: several root links: base, arm"),
    "a mimic joint that follows itself": (
        (BASE, ARM, joint("elbow", "base", "arm", extra=mimic("elbow"))),
        "joint 'elbow', <mimic>: mimic joints form a loop",
    ),
    "mimic joints that follow one another": (
        (
            *(BASE, ARM, link("hand"), link("tip")),
            joint("a", "base", "arm", extra=mimic("b")),
            joint("b", "arm", "hand", extra=mimic("c")),
            joint("c", "hand", "tip", extra=mimic("b")),
        ),
        "<mimic>: mimic joints form a loop",
    ),
}

WRONG_INERTIALS = {
    "an inertial without mass": (f"<inertial>{INERTIA}</inertial>", "no <mass value=...>"),
    "a mass without value": (f"<inertial><mass/>{INERTIA}</inertial>", "no <mass value=...>"),
    "an inertial without inertia": ('<inertial><mass value="1"/></inertial>', "no ixx, ixy, ixz, iyy, iyz, izz"),
    "an inertia without ixy": (INERTIAL.replace('ixy="0"', ""), "no ixy"),
    "a negative mass": (inertial(mass="-1"), "mass -1 kg"),
    "a mass that is NaN": (inertial(mass="nan"), "not finite"),
    "an infinite mass": (inertial(mass="inf"), "not finite"),
    "an inertia that is NaN": (inertial(iyz="nan"), "not finite"),
    "a centre of mass that is NaN": (inertial(origin='<origin xyz="0 nan 0"/>'), "not finite"),
    "an inertia frame turned by NaN": (inertial(origin='<origin rpy="0 nan 0"/>'), "not finite"),
}

WRONG_JOINTS = {
    "an axis of length zero": ('<axis xyz="0 0 0"/>', "<axis>"),
    "an axis that is NaN": ('<axis xyz="0 nan 1"/>', "<axis>"),
    "an infinite axis": ('<axis xyz="0 inf 1"/>', "<axis>"),
    "an axis of two numbers": ('<axis xyz="0 1"/>', "<axis xyz>"),
    "an axis left to xacro": ('<axis xyz="0 ${y} 1"/>', "<axis xyz>"),
    "a mimic tag without a master": ('<axis xyz="0 0 1"/><mimic/>', "<mimic>"),
    "an origin that is NaN": ('<origin xyz="nan 0 0"/><axis xyz="0 0 1"/>', "<origin>"),
    "an origin turned by infinity": ('<origin rpy="0 0 inf"/><axis xyz="0 0 1"/>', "<origin>"),
    "a damping that is NaN": ('<axis xyz="0 0 1"/><dynamics damping="nan"/>', "<dynamics>"),
    "an infinite friction": ('<axis xyz="0 0 1"/><dynamics friction="inf"/>', "<dynamics>"),
}

UNREADABLE_NUMBERS = {
    "a word for a mass": ((link("base", inertial(mass="heavy")), ARM, HINGE), "link 'base', <mass value>: 'heavy'"),
    "a word for an inertia": ((link("base", inertial(ixx="big")), ARM, HINGE), "link 'base', <inertia ixx>: 'big'"),
    "a word for an axis": (
        (BASE, ARM, joint("elbow", "base", "arm", extra='<axis xyz="0 0 up"/>')),
        "joint 'elbow', <axis xyz>: '0 0 up'",
    ),
    "a word for a ratio": (
        (*TREE, link("hand"), joint("w", "arm", "hand", extra=mimic("elbow", 'multiplier="two"'))),
        "joint 'w', <mimic multiplier>: 'two'",
    ),
    "a word for a damping": (
        (BASE, ARM, joint("elbow", "base", "arm", extra='<dynamics damping="some"/>')),
        "joint 'elbow', <dynamics damping>: 'some'",
    ),
    "an origin of two numbers": (
        (BASE, ARM, joint("elbow", "base", "arm", extra='<origin xyz="0 1"/>')),
        "joint 'elbow', <origin xyz>: '0 1'; accepted: 3 decimal numbers",
    ),
    "a decimal comma": ((link("base", inertial(mass="1,5")), ARM, HINGE), "link 'base', <mass value>: '1,5'"),
}


@table(WRONG_NAMES | WRONG_TREES)
def test_a_tree_that_is_none_is_refused_by_the_name_of_its_element(case: tuple, tmp_path: Path) -> None:
    elements, expected = case
    assert expected in refusal(write(tmp_path, *elements))


@table(WRONG_INERTIALS)
def test_an_inertial_that_is_incomplete_or_impossible_is_refused_by_the_name_of_its_link(
    case: tuple, tmp_path: Path
) -> None:
    element, expected = case
    message = refusal(write(tmp_path, BASE, link("arm", element), HINGE))
    assert "link 'arm', <inertial>" in message
    assert expected in message


@table(WRONG_JOINTS)
def test_a_joint_with_an_impossible_number_is_refused_by_its_name(case: tuple, tmp_path: Path) -> None:
    extra, expected = case
    message = refusal(write(tmp_path, BASE, ARM, joint("elbow", "base", "arm", extra=extra)))
    assert f"joint 'elbow', {expected}" in message


@table(UNREADABLE_NUMBERS)
def test_a_number_that_cannot_be_read_is_refused_by_its_place(case: tuple, tmp_path: Path) -> None:
    elements, expected = case
    assert expected in refusal(write(tmp_path, *elements))


@pytest.mark.parametrize(
    ("elements", "field", "near"),
    [
        ((BASE, ARM, joint("elbow", "bass", "arm")), "joint 'elbow', <parent>: unknown name 'bass'", "base"),
        ((BASE, ARM, joint("elbow", "base", "alarm")), "joint 'elbow', <child>: unknown name 'alarm'", "arm"),
        (
            (*TREE, link("hand"), joint("wrist", "arm", "hand", extra=mimic("elbwo"))),
            "joint 'wrist', <mimic>: unknown name 'elbwo'",
            "elbow",
        ),
    ],
    ids=["parent", "child", "mimic"],
)
def test_a_reference_to_nothing_names_the_nearest_names(
    elements: tuple[str, ...], field: str, near: str, tmp_path: Path
) -> None:
    message = refusal(write(tmp_path, *elements), UnknownNameError)
    assert field in message
    assert message.rpartition("accepted: ")[2].startswith(near)


def test_a_base_link_that_does_not_exist_names_the_nearest_links(tmp_path: Path) -> None:
    message = refusal(write(tmp_path, *TREE), UnknownNameError, base_link="bsae")
    assert "robot.base_link: unknown name 'bsae'" in message
    assert message.endswith("accepted: base")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "no xml",
        "<robot><link name='a'>",
        "<robot><link name='a'/></robot><robot/>",
        "<robot><link name=a/></robot>",
    ],
    ids=["empty", "text", "open tag", "two roots", "no quotes"],
)
def test_malformed_xml_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "machine.urdf"
    path.write_text(text)
    assert "XML: not well-formed" in refusal(path)


def test_a_file_of_another_format_is_refused_by_its_root(tmp_path: Path) -> None:
    path = tmp_path / "machine.sdf"
    path.write_text('<sdf version="1.9"/>')
    assert "XML root: <sdf>; accepted: <robot>" in refusal(path)


def test_a_file_that_cannot_be_opened_is_refused(tmp_path: Path) -> None:
    assert "file: no such file" in refusal(tmp_path / "missing.urdf")
    assert "file: cannot be read (a folder)" in refusal(tmp_path)
    with pytest.raises(TypeError, match="^path: found dict; accepted: the path of a URDF or MJCF file$"):
        load_robot({"robot": "arm"})  # type: ignore[arg-type]


def test_entities_bring_nothing_from_other_files(tmp_path: Path) -> None:
    other = tmp_path / "other.xml"
    other.write_text(ARM + HINGE)
    path = tmp_path / "machine.urdf"
    path.write_text(f'<!DOCTYPE robot [<!ENTITY more SYSTEM "{other.as_uri()}">]><robot name="m">{BASE}&more;</robot>')
    assert set(load_robot(path).links) == {"base"}


def test_entities_that_multiply_are_never_expanded(tmp_path: Path) -> None:
    levels = "".join(f'<!ENTITY x{k + 1} "{f"&x{k};" * 10}">' for k in range(12))
    path = tmp_path / "machine.urdf"
    for content in ("&x12;", '<link name="&x12;"/>'):  # 1e13 characters if expanded
        path.write_text(f'<!DOCTYPE robot [<!ENTITY x0 "0123456789">{levels}]><robot name="m">{BASE}{content}</robot>')
        assert "XML: not well-formed" in refusal(path)


def test_a_robot_without_any_mass_is_refused_with_a_guess_that_is_taken(tmp_path: Path) -> None:
    text = refusal(write(tmp_path, link("base", ""), link("arm", ""), HINGE))
    assert "no link has mass" in text
    guess = text[text.index("<inertial><mass") :]
    assert load_robot(write(tmp_path, link("base", guess), link("arm", guess), HINGE)).nominal[:, 0].tolist() == [1, 1]


XACRO = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'


@pytest.mark.parametrize("declared", [XACRO, ""], ids=["declared", "undeclared"])
@pytest.mark.parametrize(
    "element",
    ['<xacro:include filename="leg.xacro"/>', "<xacro:leg/>", f"<link name='x'><xacro:box/>{INERTIAL}</link>"],
)
def test_xacro_that_is_not_expanded_is_refused(tmp_path: Path, element: str, declared: str) -> None:
    path = write(tmp_path, BASE, ARM, element, HINGE)
    path.write_text(path.read_text().replace("<robot ", f"<robot {declared} "))
    assert "xacro is not expanded (line 1); accepted: the output of `xacro" in refusal(path)


def floating(world: str) -> tuple[str, ...]:
    return (world, *TREE, joint("root", "world", "base", "floating", ""))


@pytest.mark.parametrize(
    "world", [link("world", ""), link("world", inertial("0", **dict.fromkeys(("ixx", "iyy", "izz"), "0")))]
)
def test_a_root_without_mass_below_a_floating_joint_is_the_world(tmp_path: Path, world: str) -> None:
    robot = load_robot(write(tmp_path, *floating(world)))
    assert (robot.base_link, robot.joint_names, tuple(robot.links)) == ("base", ("elbow",), ("base", "arm"))
    assert b'type="floating"' in identified_urdf(robot, robot.nominal)  # simulators take it for the free joint


@pytest.mark.parametrize(
    "elements",
    [
        floating(link("world")),
        (*floating(link("world", "")), link("camera"), joint("mount", "world", "camera", "fixed")),
    ],
    ids=["a root with mass", "a root with another joint"],
)
def test_any_other_floating_joint_is_refused(tmp_path: Path, elements: tuple[str, ...]) -> None:
    assert "joint 'root': type 'floating'" in refusal(write(tmp_path, *elements))


def test_a_stated_mass_is_spread_over_a_robot_without_any(tmp_path: Path) -> None:
    hip, knee, sole = (f'<origin xyz="{place}"/><axis xyz="0 0 1"/>' for place in ("0 0 0.4", "0.2 0 0.4", "0 0 9"))
    path = write(
        tmp_path,
        *(link(name, "") for name in ("base", "arm", "hand", "tool")),
        joint("hip", "base", "arm", extra=hip),
        joint("knee", "arm", "hand", extra=knee),
        joint("weld", "hand", "tool", "fixed", sole),
    )
    with pytest.warns(TorchidWarning, match="no link has mass; 3 links share 6 kg equally"):
        robot = load_robot(path, total_mass=6.0)
    np.testing.assert_allclose(robot.nominal[:, 0], 2.0, rtol=1e-15)
    np.testing.assert_allclose(robot.nominal[:, 1:4] / 2.0, [[0, 0, 0.2], [0.1, 0, 0.2], [0, 0, 4.5]], atol=1e-15)
    radius = (2.0 / 1000.0 / (4.0 / 3.0 * np.pi)) ** (1.0 / 3.0)
    assert robot.nominal[0, 9] == pytest.approx(0.4 * 2.0 * radius**2)
    refused(lambda: load_robot(path, total_mass=-1.0), f"{path}: total_mass: ", UrdfError)
    assert load_robot(write(tmp_path, *TREE), total_mass=50.0).nominal[:, 0].sum() < 3.0, (
        "a file with masses keeps them"
    )
