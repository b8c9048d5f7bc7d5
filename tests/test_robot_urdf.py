"""What a URDF must be: every refusal is one line that names the file and the element; oddities are named warnings."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from synthetic import ROBOTS, joint_map

from torchid.errors import (
    InputError,
    MasslessBodyWarning,
    TorchidWarning,
    UnknownNameError,
    UnphysicalInertiaWarning,
    UrdfError,
)
from torchid.robot import Robot, load_robot

INERTIA = '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/>'
INERTIAL = f'<inertial><mass value="1"/>{INERTIA}</inertial>'
BASE, ARM = f'<link name="base">{INERTIAL}</link>', f'<link name="arm">{INERTIAL}</link>'
ENDS = '<parent link="base"/><child link="arm"/>'
HINGE = f'<joint name="elbow" type="revolute">{ENDS}<axis xyz="0 0 1"/></joint>'


def link(name: str, inertial: str = INERTIAL) -> str:
    """A link element."""
    return f'<link name="{name}">{inertial}</link>'


def joint(name: str, parent: str, child: str, kind: str = "revolute", extra: str = '<axis xyz="0 0 1"/>') -> str:
    """A joint element."""
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{extra}</joint>'


def write(folder: Path, *elements: str) -> Path:
    """A URDF of some elements."""
    path = folder / "machine.urdf"
    path.write_text(f'<?xml version="1.0"?><robot name="machine">{"".join(elements)}</robot>')
    return path


def inertial(mass: str = "1", origin: str = "", **numbers: str) -> str:
    """An inertial element; inertia numbers that are not given are 0.1 on the diagonal, else 0."""
    values = {"ixx": "0.1", "ixy": "0", "ixz": "0", "iyy": "0.1", "iyz": "0", "izz": "0.1"} | numbers
    attributes = " ".join(f'{name}="{value}"' for name, value in values.items())
    return f'<inertial>{origin}<mass value="{mass}"/><inertia {attributes}/></inertial>'


def mimic(master: str, extra: str = "") -> str:
    """Content of a joint that follows another."""
    return f'<axis xyz="0 0 1"/><mimic joint="{master}" {extra}/>'


TREE = (BASE, ARM, HINGE)

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
        "link 'arm': child of joint 'close'",
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
        "joint 'elbow', <mimic>: a chain that closes on itself",
    ),
    "mimic joints that follow one another": (
        (
            *(BASE, ARM, link("hand"), link("tip")),
            joint("a", "base", "arm", extra=mimic("b")),
            joint("b", "arm", "hand", extra=mimic("c")),
            joint("c", "hand", "tip", extra=mimic("b")),
        ),
        "<mimic>: a chain that closes on itself",
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
    "a word for a mass": (link("base", inertial(mass="heavy")), ARM, HINGE),
    "a word for an inertia": (link("base", inertial(ixx="big")), ARM, HINGE),
    "a word for an axis": (BASE, ARM, joint("elbow", "base", "arm", extra='<axis xyz="0 0 up"/>')),
    "a word for a ratio": (*TREE, link("hand"), joint("w", "arm", "hand", extra=mimic("elbow", 'multiplier="two"'))),
    "a word for a damping": (BASE, ARM, joint("elbow", "base", "arm", extra='<dynamics damping="some"/>')),
    "an origin of two numbers": (BASE, ARM, joint("elbow", "base", "arm", extra='<origin xyz="0 1"/>')),
    "a decimal comma": (link("base", inertial(mass="1,5")), ARM, HINGE),
}


def table(cases: dict) -> pytest.MarkDecorator:
    """A test per entry."""
    return pytest.mark.parametrize("case", cases.values(), ids=cases.keys())


def refusal(path: Path, kind: type[InputError] = UrdfError, base_link: str | None = None) -> str:
    """The one line that loading fails with."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        warnings.simplefilter("ignore", RuntimeWarning)  # yourdfpy turns angles into matrices before anyone can look
        with pytest.raises(InputError) as caught:
            load_robot(path, base_link)
    assert type(caught.value) is kind
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    assert "; accepted: " in message
    return message


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


@pytest.mark.parametrize("attribute", ["multiplier", "offset"])
def test_a_mimic_joint_with_a_ratio_that_is_no_number_is_refused(attribute: str, tmp_path: Path) -> None:
    follower = joint("wrist", "arm", "hand", extra=mimic("elbow", f'{attribute}="nan"'))
    assert "joint 'wrist', <mimic>" in refusal(write(tmp_path, *TREE, link("hand"), follower))


@table(UNREADABLE_NUMBERS)
def test_a_number_that_cannot_be_read_is_refused(case: tuple, tmp_path: Path) -> None:
    refusal(write(tmp_path, *case))


def test_an_origin_that_is_not_finite_is_refused_at_a_fixed_joint_too(tmp_path: Path) -> None:
    weld = joint("weld", "base", "arm", "fixed", '<origin xyz="0 0 nan"/>')
    assert "joint 'weld', <origin>" in refusal(write(tmp_path, BASE, ARM, weld))


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


def test_a_link_that_does_not_exist_names_the_nearest_links(tmp_path: Path) -> None:
    robot = load_robot(write(tmp_path, *TREE))
    with pytest.raises(UnknownNameError, match=r"machine.urdf: contacts\[0\]: unknown name 'amr'; accepted: arm$"):
        robot.link("amr", "contacts[0]")


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
    assert "file: a folder" in refusal(tmp_path)


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


def test_a_robot_without_any_mass_is_refused(tmp_path: Path) -> None:
    assert "no link has mass" in refusal(write(tmp_path, link("base", ""), link("arm", ""), HINGE))


def test_what_carries_no_kinematics_is_not_read(tmp_path: Path) -> None:
    broken = '<visual><geometry><mesh filename="package://nowhere/x.dae" scale="a b"/></geometry></visual>'
    elements = (link("base", broken + INERTIAL), ARM, HINGE, '<transmission name="t"/>', "<gazebo>&lt;</gazebo>")
    robot = load_robot(write(tmp_path, *elements, '<material name="m"><color rgba="red"/></material>', "<!-- a -->"))
    assert robot.joint_names == ("elbow",)


def warned(path: Path) -> tuple[Robot, list[warnings.WarningMessage]]:
    """The robot with what it warns of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        return load_robot(path), caught


@pytest.mark.parametrize(
    ("element", "expected"),
    [
        (inertial(ixx="0.3"), "largest principal inertia 0.3 exceeds the sum of the others, 0.2"),
        (inertial(izz="-0.1"), "principal inertias -0.1, 0.1, 0.1 kg m^2 are not all positive"),
        (inertial(ixy="0.2"), "are not all positive"),
        (inertial(mass="0"), "mass 0 kg with an inertia that is not 0"),
    ],
    ids=["triangle", "negative", "indefinite", "mass 0"],
)
def test_an_inertia_of_no_body_is_warned_of_by_link_and_kept_as_written(
    element: str, expected: str, tmp_path: Path
) -> None:
    path = write(tmp_path, BASE, link("arm", element), HINGE)
    robot, caught = warned(path)
    assert [w.category for w in caught] == [UnphysicalInertiaWarning]
    message = str(caught[0].message)
    assert message.startswith(f"{path}: link 'arm': ")
    assert expected in message
    assert "\n" not in message
    assert robot.massless == ()
    numbers = re.search(r'ixx="(\S+)" ixy="(\S+)"', element)
    assert numbers is not None
    np.testing.assert_array_equal(robot.nominal[1, [4, 5]], [float(x) for x in numbers.groups()])


def test_a_thin_plate_or_a_point_mass_is_no_reason_to_warn(tmp_path: Path) -> None:
    plate = link("base", inertial(ixx="0.05", iyy="0.05", izz="0.1"))
    point = link("arm", inertial(ixx="0", iyy="0", izz="0"))
    assert warned(write(tmp_path, plate, point, HINGE))[1] == []


@pytest.mark.parametrize("element", ["", inertial(mass="0", ixx="0", iyy="0", izz="0")], ids=["no inertial", "zeros"])
def test_a_limb_that_ends_in_a_massless_body_is_warned_of(element: str, tmp_path: Path) -> None:
    path = write(tmp_path, BASE, link("arm", element), HINGE)
    robot, caught = warned(path)
    assert [w.category for w in caught] == [MasslessBodyWarning]
    assert str(caught[0].message).startswith(f"{path}: link 'arm': no inertia at the end of a limb")
    assert robot.massless == ("arm",)


def test_massless_bodies_between_others_are_listed_without_a_warning(tmp_path: Path) -> None:
    path = write(tmp_path, BASE, link("cross", ""), ARM, joint("x", "base", "cross"), joint("y", "cross", "arm"))
    robot, caught = warned(path)
    assert caught == []
    assert robot.massless == ("cross",)
    assert [body.massless for body in robot.bodies] == [False, True, False]


def test_a_massless_link_welded_to_a_body_with_mass_is_no_massless_body(tmp_path: Path) -> None:
    frame = joint("weld", "arm", "tip", "fixed", '<origin xyz="0 0 1"/>')
    robot, caught = warned(write(tmp_path, *TREE, link("tip", ""), frame))
    assert caught == []
    assert robot.massless == ()
    assert robot.bodies[1].links == ("arm", "tip")


def test_axis_and_numbers_left_out_have_the_values_the_urdf_specification_gives(tmp_path: Path) -> None:
    follower = joint("wrist", "arm", "hand", "prismatic", '<mimic joint="elbow"/>')
    robot = load_robot(write(tmp_path, BASE, ARM, joint("elbow", "base", "arm", extra=""), link("hand"), follower))
    elbow, wrist = (body.joint for body in robot.bodies[1:])
    assert elbow is not None
    assert wrist is not None
    np.testing.assert_array_equal(elbow.axis, [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(elbow.T_parent_joint, np.eye(4))
    assert (elbow.damping, elbow.friction) == (0.0, 0.0)
    assert wrist.mimic is not None
    assert (wrist.mimic.master, wrist.mimic.multiplier, wrist.mimic.offset) == ("elbow", 1.0, 0.0)


def test_joint_friction_of_the_urdf_is_nominal(tmp_path: Path) -> None:
    rub = joint("elbow", "base", "arm", extra='<axis xyz="0 0 1"/><dynamics damping="0.25" friction="1.5"/>')
    robot = load_robot(write(tmp_path, BASE, ARM, rub))
    np.testing.assert_array_equal(robot.nominal[1, 10:], [1.5, 0.25])
    elbow = robot.bodies[1].joint
    assert elbow is not None
    assert (elbow.friction, elbow.damping) == (1.5, 0.25)


REAL = sorted(ROBOTS.rglob("*.urdf"))
REFUSED = {
    "ur3.urdf": (UrdfError, "link: none found"),
    "alex_psyonic_hands.urdf": (UnknownNameError, "joint 'Left_index_q2', <mimic>: unknown name 'index_q1'"),
}


def test_there_are_69_real_robots() -> None:
    assert len(REAL) == 69


@pytest.mark.parametrize("path", REAL, ids=lambda path: path.name)
def test_a_real_robot_is_read_whole_or_refused_for_its_true_fault(path: Path) -> None:
    if path.name in REFUSED:
        kind, expected = REFUSED[path.name]
        assert expected in refusal(path, kind)
        return
    robot, caught = warned(path)
    assert {w.category for w in caught} <= {UnphysicalInertiaWarning, MasslessBodyWarning}
    moving = joint_map(path, robot.joint_names)
    assert set(moving) == {body.joint.name for body in robot.bodies if body.joint is not None}
    independent = [name for name, (row, _) in moving.items() if name in robot.joint_names and row.sum() == 1.0]
    assert sorted(independent) == sorted(robot.joint_names)
    assert sorted(robot.links) == sorted(link for body in robot.bodies for link in body.links)
    assert np.isfinite(robot.nominal).all()
