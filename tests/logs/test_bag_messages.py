"""What messages mean: joints by name, frames of twists, signs of wrenches, contacts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bags
import numpy as np
import pytest
from bags import (
    FLAG,
    IMU,
    JOINT_STATE,
    ODOMETRY,
    STAMPS,
    WRENCH,
    Entry,
    imu,
    joint_state,
    joints_at,
    odometry,
    read_messages,
    refusal,
    vector,
    wrench,
)
from motions import value
from scipy.spatial.transform import Rotation

from torchid.errors import TorchidWarning
from torchid.logs import Log


def test_joints_are_told_by_name_in_whatever_order_they_come(tmp_path: Path) -> None:
    orders = ["abc", "cab", "bca", "abc"]
    entries = [
        ("/joint_states", s, JOINT_STATE, joint_state(s, order, position=[ord(x) + i for x in order]))
        for i, (s, order) in enumerate(zip(map(int, STAMPS), orders, strict=True))
    ]
    log = read_messages(tmp_path / "x.bag", entries)
    assert log.joint_names == ("a", "b", "c")
    np.testing.assert_array_equal(log.joint_position, 97 + np.arange(3) + np.arange(4)[:, None])
    assert log.joint_velocity is None
    assert log.joint_torque is None


def test_messages_of_other_joints_are_left_out_if_the_joints_are_listed(tmp_path: Path) -> None:
    arms = [("/joint_states", s, JOINT_STATE, joint_state(s, "xba", position=[3, 2, 1])) for s in map(int, STAMPS)]
    hand = [("/joint_states", s + 5, JOINT_STATE, joint_state(s + 5, "g", position=[9])) for s in map(int, STAMPS)]
    log = read_messages(tmp_path / "x.mcap", arms + hand, joint_states={"topic": "/joint_states", "joints": ["a", "b"]})
    assert log.joint_names == ("a", "b")
    np.testing.assert_array_equal(log.joint_position, [[1.0, 2.0]] * 4)
    message = refusal(tmp_path / "x.mcap", arms + hand)
    assert (
        "/joint_states: a message without x; accepted: all 3 joints in every message, or joint_states.joints" in message
    )
    message = refusal(tmp_path / "x.mcap", arms + hand, joint_states={"topic": "/joint_states", "joints": ["nope"]})
    assert "x.mcap: logs.topics.joint_states.joints: unknown name 'nope'; accepted: x, b, a, g" in message


def test_joints_get_the_names_that_the_map_gives_them(tmp_path: Path) -> None:
    arms = [("/joint_states", s, JOINT_STATE, joint_state(s, "xba", position=[3, 2, 1])) for s in map(int, STAMPS)]

    def read(**more: Any) -> Log:
        return read_messages(tmp_path / "x.mcap", arms, joint_states={"topic": "/joint_states", **more})

    log = read(names={"x": "l_knee", "b": "a", "a": "b"})
    assert log.joint_names == ("l_knee", "a", "b")
    np.testing.assert_array_equal(log.joint_position, [[3.0, 2.0, 1.0]] * 4)
    chosen = read(names={"x": "l_knee"}, joints=["a", "l_knee"])
    assert chosen.joint_names == ("a", "l_knee")
    np.testing.assert_array_equal(chosen.joint_position, [[1.0, 3.0]] * 4)


@pytest.mark.parametrize(
    ("names", "found"),
    [
        ({"y": "l_knee"}, "logs.topics.joint_states.names: unknown name 'y'; accepted: x, b, a"),
        ({"x": "a"}, "repeated names: a, b, a, ..."),
        ({"x": "k", "b": "k"}, "logs.topics.joint_states.names: two names for 'k'; accepted: each joint of the robot"),
    ],
)
def test_names_that_no_message_has_or_that_joints_share_are_refused(
    tmp_path: Path, names: dict[str, str], found: str
) -> None:
    arms = [("/joint_states", s, JOINT_STATE, joint_state(s, "xba", position=[3, 2, 1])) for s in map(int, STAMPS)]
    assert found in refusal(tmp_path / "x.mcap", arms, joint_states={"topic": "/joint_states", "names": names})


BAD_STATES: list[tuple[list[dict[str, Any]], str]] = [
    ([{"names": "aa", "position": [1, 2]}], "repeated names: a, a, ..."),
    ([{"names": "ab", "position": [1]}], "1 values in 1 messages of 2 names"),
    ([{"names": "ab", "velocity": [1, 2]}], "a message with velocity"),
    ([{"names": "ab"}], "a message with nothing"),
    ([{"names": ""}], "a message with nothing"),
    ([{"names": "a", "position": [1]}, {"names": "a", "position": [1], "effort": [1]}], "position and effort"),
    ([{"names": "a", "position": [1]}, {"names": "ab", "position": [1, 2]}], "a message with 2 joints"),
    ([{"names": ["a\x1b[2J"], "position": [1]}], "cannot be read (ValueError: a name of 5 characters: a\\x1b[2J"),
]


@pytest.mark.parametrize(("states", "found"), BAD_STATES)
def test_joint_states_that_do_not_add_up_are_refused(tmp_path: Path, states: list[dict[str, Any]], found: str) -> None:
    entries: list[Entry] = []
    for s, state in zip(map(int, STAMPS), states, strict=False):
        values = {k: x for k, x in state.items() if k != "names"}
        entries.append(("/joint_states", s, JOINT_STATE, joint_state(s, state["names"], **values)))
    assert found in refusal(tmp_path / "x.mcap", entries)


def test_an_odometrys_twist_is_that_of_the_child_frame(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    world_base = Rotation.from_euler("zyx", [2.1, -0.7, 0.4])
    linear, angular, position = rng.standard_normal((3, 3))
    content = [odometry(s, position, world_base.as_quat(), linear, angular) for s in map(int, STAMPS)]
    entries = joints_at(STAMPS) + [("/odom", int(s), ODOMETRY, x) for s, x in zip(STAMPS, content, strict=True)]
    base = {"topic": "/odom", "frame": "base"}
    child = read_messages(tmp_path / "x.bag", entries, odometry=base)
    world = read_messages(tmp_path / "y.bag", entries, odometry=base | {"twist": "world"})
    pose = read_messages(tmp_path / "z.bag", entries, odometry=base | {"twist": "none"})
    for log, linear_world, angular_base in (
        (child, world_base.apply(linear), angular),
        (world, linear, world_base.inv().apply(angular)),
    ):
        np.testing.assert_allclose(log.base_linear_velocity_world, [linear_world] * 4, rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(log.base_angular_velocity_base, [angular_base] * 4, rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(log.base_position_world, [position] * 4, rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(Rotation.from_quat(log.base_quat_xyzw).as_matrix(), [world_base.as_matrix()] * 4)
    assert pose.base_linear_velocity_world is None
    assert pose.base_angular_velocity_base is None
    content[2]["child_frame_id"] = "wheel"
    entries = joints_at(STAMPS) + [("/odom", int(s), ODOMETRY, x) for s, x in zip(STAMPS, content, strict=True)]
    assert "/odom: child_frame_id 'base', then 'wheel'" in refusal(tmp_path / "x.bag", entries, odometry="/odom")


def test_an_odometry_is_that_of_the_base_link_if_the_map_names_its_frame_and_else_warned_of(tmp_path: Path) -> None:
    """Of a tracking camera, or of the point of the ground below the base, it would pass for the base's own pose."""

    def read(child: str, frame: str | None) -> Log:
        said = [odometry(s, np.zeros(3), [0, 0, 0, 1]) | {"child_frame_id": child} for s in map(int, STAMPS)]
        entries = joints_at(STAMPS) + [("/odom", int(s), ODOMETRY, x) for s, x in zip(STAMPS, said, strict=True)]
        return read_messages(tmp_path / "x.mcap", entries, odometry={"topic": "/odom", "frame": frame})

    meant = r"; set logs\.topics\.odometry\.frame to confirm it$"
    with pytest.warns(TorchidWarning, match=f"/odom: frame 'camera' is taken for the robot's base link{meant}"):
        read("camera", None)
    with pytest.warns(TorchidWarning, match=f"/odom: frame '/camera' is taken for 'pelvis'{meant}"):
        read("/camera", "pelvis")
    for child, frame in (("hip", "hip"), ("/hip", "hip"), ("hip", "/hip"), ("", None), ("", "hip")):
        assert read(child, frame).base_position_world is not None


def test_an_imu_at_rest_reads_g_upwards_in_its_own_frame(tmp_path: Path) -> None:
    def entries(frame: str, **content: Any) -> list[Entry]:
        said = [imu(s, [0.0, 9.81, 0.0], [0.1, 0.2, 0.3], frame) | content for s in map(int, STAMPS)]
        return joints_at(STAMPS) + [("/imu", int(s), IMU, x) for s, x in zip(STAMPS, said, strict=True)]

    log = read_messages(tmp_path / "x.bag", entries("/imu_link"), imu="/imu")
    np.testing.assert_array_equal(log.imu_specific_force, [[0.0, 9.81, 0.0]] * 4)
    np.testing.assert_array_equal(log.imu_angular_velocity, [[0.1, 0.2, 0.3]] * 4)
    assert log.imu_frame == "imu_link"
    assert read_messages(tmp_path / "x.mcap", entries("a"), imu={"topic": "/imu", "frame": "b"}).imu_frame == "b"
    assert "/imu: no header.frame_id" in refusal(tmp_path / "x.mcap", entries(""), imu="/imu")
    for part in ("linear_acceleration", "angular_velocity"):
        unknown = entries("a", **{f"{part}_covariance": np.array([-1.0] + [0.0] * 8)})
        assert f"/imu: no {part}" in refusal(tmp_path / "x.mcap", unknown, imu="/imu")


def test_the_orientation_of_an_imu_is_the_bases_where_it_is_wanted(tmp_path: Path) -> None:
    quats = Rotation.from_rotvec(np.outer([0.1, 0.2, 0.3, 0.4], [0.6, 0.0, 0.8])).as_quat()

    def entries(turns: Any = quats, **content: Any) -> list[Entry]:
        said = [imu(int(s), [0, 0, 9.81], [0, 0, 0], "imu_link") | content for s in STAMPS]
        said = [x | {"orientation": vector(turn, "xyzw")} for x, turn in zip(said, turns, strict=True)]
        return joints_at(STAMPS) + [("/imu", int(s), IMU, x) for s, x in zip(STAMPS, said, strict=True)]

    wanted = {"imu": {"topic": "/imu", "frame": "imu_link", "orientation": True}}
    np.testing.assert_allclose(read_messages(tmp_path / "x.bag", entries(), **wanted).base_quat_xyzw, quats, atol=1e-15)
    assert read_messages(tmp_path / "x.bag", entries(), imu="/imu").base_quat_xyzw is None
    other = Rotation.from_rotvec([0.0, 0.0, 1.0]).as_quat()
    with_odometry = entries() + [("/odom", int(s), ODOMETRY, odometry(int(s), [0, 0, 0], other)) for s in STAMPS]
    pose = {"topic": "/odom", "twist": "none", "frame": "base"}
    both = read_messages(tmp_path / "y.mcap", with_odometry, **wanted, odometry=pose)
    np.testing.assert_allclose(both.base_quat_xyzw, np.tile(other, (4, 1)), atol=1e-15)
    unknown = entries(orientation_covariance=np.array([-1.0] + [0.0] * 8))
    for bad, found in (
        (unknown, "/imu: no orientation (the first of its covariances is -1)"),
        (
            entries(np.zeros((4, 4))),
            "/imu: always the same orientation [0.0, 0.0, 0.0, 0.0]: the driver does not measure it",
        ),
        (entries(quats * [[1.0], [1.0], [2.0], [1.0]]), "/imu: an IMU quaternion has norm 2"),
    ):
        message = refusal(tmp_path / "z.mcap", bad, **wanted)
        assert found in message
        assert "logs.topics.imu.orientation: false" in message


def test_wrenches_are_the_environments_and_the_parents_action_unless_a_sign_says_otherwise(tmp_path: Path) -> None:
    values = np.arange(1.0, 7.0)
    entries = joints_at(STAMPS) + [("/w", s, WRENCH, wrench(s, values, "sole")) for s in map(int, STAMPS)]
    limb = {"topic": "/w", "frame": "sole"}
    topics = {"contact_wrenches": {"sole": {"topic": "/w", "sign": -1}}, "ft_wrenches": {"ft": limb}}
    log = read_messages(tmp_path / "x.bag", entries, **topics, contact_force_threshold=1.0)
    assert log.contact_wrench_local is not None
    assert log.ft_wrench is not None
    np.testing.assert_array_equal(log.contact_wrench_local[:, 0], [-values] * 4)
    np.testing.assert_array_equal(log.ft_wrench[:, 0], [values] * 4)


def test_a_signalling_nan_is_a_value_that_was_not_measured(tmp_path: Path) -> None:
    values = np.arange(1.0, 7.0)
    values[3] = np.array(0x7FF0_0000_0000_0001).view(np.float64)
    entries = joints_at(STAMPS) + [("/w", s, WRENCH, wrench(s, values, "sole")) for s in map(int, STAMPS)]
    topics = {"contact_wrenches": {"sole": {"topic": "/w", "sign": -1}}}
    log = read_messages(tmp_path / "x.bag", entries, **topics, contact_force_threshold=1.0)
    np.testing.assert_array_equal(value(log.contact_wrench_local)[:, 0], [[-1, -2, -3, np.nan, -5, -6]] * 4)


def test_a_limbs_wrench_is_in_the_child_frame_if_the_map_names_it_and_else_warned_of(tmp_path: Path) -> None:
    """Which link the fixed joint carries a bag does not know: the sensor may read along the parent's axes."""
    entries = joints_at(STAMPS) + [("/w", s, WRENCH, wrench(s, np.ones(6), "shin")) for s in map(int, STAMPS)]
    taken = r"/w: frame 'shin' is taken for the child frame of joint 'ft'; set logs\.topics\.ft_wrenches\.ft\.frame to"
    with pytest.warns(TorchidWarning, match=taken) as caught:
        read_messages(tmp_path / "x.mcap", entries, ft_wrenches={"ft": "/w"})
    assert len(caught) == 1
    assert caught[0].filename == bags.__file__, "whoever reads the log is shown, not the reader itself"
    read_messages(tmp_path / "x.mcap", entries, ft_wrenches={"ft": {"topic": "/w", "frame": "shin"}})
    nameless = joints_at(STAMPS) + [("/w", s, WRENCH, wrench(s, np.ones(6))) for s in map(int, STAMPS)]
    read_messages(tmp_path / "x.mcap", nameless, ft_wrenches={"ft": "/w"})


def test_a_contact_touches_while_its_force_was_last_above_the_threshold(tmp_path: Path) -> None:
    forces = {0.0: 0.0, 1.0: 31.0, 2.0: 29.0, 3.0: -50.0, 4.0: 0.0}
    wrenches = [
        ("/w", int(1e9 * s), WRENCH, wrench(int(1e9 * s), [0, 0.6 * f, 0.8 * f, 99, 99, 99], "foot"))
        for s, f in forces.items()
    ]
    states = joints_at(1e9 * np.array([0.0, 0.5, 1.0, 1.9, 2.1, 3.0, 3.9]))
    topics = {"contact_wrenches": {"foot": "/w"}, "contact_force_threshold": 30.0}
    log = read_messages(tmp_path / "x.mcap", states + wrenches, **topics)
    assert log.contact_active is not None
    assert log.contact_active[:, 0].tolist() == [False, False, True, True, False, True, True]


def test_contacts_without_a_wrench_say_themselves_when_they_touch(tmp_path: Path) -> None:
    said = {50.0: False, 101.0: True, 102.5: False}
    switches = [("/touch", int(1e9 * s), FLAG, {"data": x}) for s, x in said.items()]
    wrenches = [("/w", s, WRENCH, wrench(s, np.full(6, 7.0), "c")) for s in map(int, STAMPS)]
    active = {"a": "/touch", "b": True, "c": True}
    topics = {"contact_wrenches": {"c": "/w"}, "contact_active": active}
    with pytest.warns(TorchidWarning, match="/touch: no stamps"):
        log = read_messages(tmp_path / "x.bag", joints_at(STAMPS) + switches + wrenches, **topics)
    assert log.contact_names == ("c", "a", "b")
    assert log.contact_active is not None
    np.testing.assert_array_equal(log.contact_active.T, [[1, 1, 1, 1], [0, 1, 1, 0], [1, 1, 1, 1]])
    assert log.contact_wrench_local is not None
    assert np.isnan(log.contact_wrench_local[:, 1:]).all()
    nan = [("/w", s, WRENCH, wrench(s, np.full(6, np.nan), "c")) for s in map(int, STAMPS)]
    topics = {"contact_wrenches": {"c": "/w"}, "contact_force_threshold": 5.0}
    assert "/w: the force is NaN in message 0" in refusal(tmp_path / "x.bag", joints_at(STAMPS) + nan, **topics)


def test_wrenches_in_a_frame_of_another_name_are_warned_of_unless_that_is_meant(tmp_path: Path) -> None:
    entries = joints_at(STAMPS) + [("/w", s, WRENCH, wrench(s, np.ones(6), "/sensor")) for s in map(int, STAMPS)]
    with pytest.warns(TorchidWarning, match=r"/w: frame '/sensor' is taken for 'sole'; set logs.topics.contact_wr"):
        read_messages(tmp_path / "x.mcap", entries, contact_wrenches={"sole": "/w"}, contact_force_threshold=1.0)
    meant = {"sole": {"topic": "/w", "frame": "sensor"}}
    read_messages(tmp_path / "x.mcap", entries, contact_wrenches=meant, contact_force_threshold=1.0)
    read_messages(tmp_path / "x.mcap", entries, ft_wrenches={"ft": {"topic": "/w", "frame": "/sensor"}})
    with pytest.warns(TorchidWarning, match="/w: frame '/sensor' is taken for 'other'"):
        read_messages(tmp_path / "x.mcap", entries, ft_wrenches={"ft": {"topic": "/w", "frame": "other"}})
