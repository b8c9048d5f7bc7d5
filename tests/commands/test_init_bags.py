"""`torchid init` of bags: topics by type, name, frame and content, the robot of a LowState by the URDF's joints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from bags import (
    FLAG,
    IMU,
    JOINT_STATE,
    WRENCH,
    Entry,
    entries_of,
    imu,
    joint_state,
    vector,
    wrench,
    write_bag,
    write_folder,
)
from dialects import with_velocity
from low_states import FEET, GO2, START, low_states, moving, write_low_states
from repository import DEMO
from scipy.spatial.transform import Rotation
from synthetic import G1, ROBOTS, SOLO12

from torchid.cli import main
from torchid.commands.init import InitReport, init
from torchid.config import load_config
from torchid.errors import ConfigError, LogError, UnknownNameError
from torchid.fitting.experiment import set_up
from torchid.logs import Log, Topics, read_log
from torchid.logs.unitree import HG, JOINT_ORDERS
from torchid.reading.log_reader import LogReader
from torchid.robot import load_robot

URDF = DEMO / "quadruped.urdf"
TALOS = ROBOTS / "talos_data/robots/talos_reduced.urdf"
TOO_SHORT = "motion: 0.078 s is too short for a fit"
GO2_URDF = ROBOTS / "go2_description/urdf/go2.urdf"
COUNTS = np.random.default_rng(2).integers(10, 200, (40, 4))
pytestmark = pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")  # of frames and of times of receipt


def started(urdf: Path, bag: Path) -> tuple[InitReport, dict[str, Any], Log]:
    """What was said, the topics of the new file, and the log that it reads."""
    target = bag.with_suffix(".yaml")
    target.unlink(missing_ok=True)
    said = init(urdf, bag, target)
    config = load_config(target)
    set_up(config)
    return said, yaml.safe_load(target.read_text())["logs"]["topics"], read_log(bag, config.logs.topics)


def test_a_bag_of_every_type_is_read_as_it_was_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = with_velocity(read_log(DEMO / "sway_train.npz").select(slice(0, 300)))
    path = write_bag(tmp_path / "x.mcap", entries_of(log))
    said, topics, again = started(URDF, path)
    assert said.missing == []
    feet = sorted(log.contact_names)
    assert topics == {
        "joint_states": "/joint_states",
        "imu": {"topic": "/imu", "frame": "trunk"},
        "odometry": {"topic": "/odom", "twist": "none"},
        "contact_wrenches": {foot: f"/wrench/{foot}" for foot in feet},
        "contact_active": {foot: f"/touch/{foot}" for foot in feet},
    }
    assert "odometry: 'base' is taken for the base link" in said.assumed
    np.testing.assert_array_equal(again.joint_torque, log.joint_torque)
    order = [again.contact_names.index(name) for name in log.contact_names]
    np.testing.assert_array_equal(np.asarray(again.contact_active)[:, order], log.contact_active)
    text = path.with_suffix(".yaml").read_text()
    assert "  topics:  # content of the topics: docs/logs.md\n    joint_states: /joint_states\n" in text
    assert "    # assumed: 'base' is taken for the base link\n    odometry: {" in text
    (tmp_path / "x.yaml").unlink()
    assert main(["init", str(URDF), str(path), "--output", str(tmp_path / "x.yaml")]) == 0
    assert (
        "found         topics of joint_states, imu, odometry, contact_wrenches, contact_act" in capsys.readouterr().out
    )


def test_a_go2s_state_needs_no_edit(tmp_path: Path) -> None:
    log = moving(GO2)
    said, topics, again = started(GO2_URDF, write_low_states(tmp_path / "x.db3", log, GO2, feet=COUNTS))
    low_state = topics["low_state"]
    assert low_state == {"topic": "/lowstate", "robot": "go2", "frame": "imu", "above": low_state["above"]}
    assert 10 < low_state["above"] < 80
    assert set(again.contact_names) == set(FEET)
    np.testing.assert_array_equal(again.contact_active, low_state["above"] < COUNTS)
    np.testing.assert_array_equal(again.joint_torque, log.joint_torque)
    assert [text for text in said.missing if TOO_SHORT not in text] == []


def test_a_go2s_orientation_lets_its_feet_roll_and_turned_frames_are_refused(tmp_path: Path) -> None:
    log = moving(GO2, 200)
    turns = Rotation.from_rotvec(0.1 * np.sin(np.arange(200)[:, None] / 40.0 + np.arange(3))).as_quat()
    balls = ", ".join(f"{{frame: {foot}, type: point, radius: 0.022}}" for foot in sorted(FEET))
    overrides = ["preprocessing.cutoff_hz=20", f"contacts=[{balls}]"]
    read = []
    for name, quats in (("set", np.roll(turns, 1, axis=1)), ("unset", None)):
        path = tmp_path / f"{name}.mcap"
        started(GO2_URDF, write_low_states(path, log, GO2, feet=np.tile(COUNTS, (5, 1)), turns=quats))
        config = load_config(path.with_suffix(".yaml"), overrides)
        read.append((config, LogReader(set_up(config))))
    config, reader = read[0]
    (samples,) = reader.read(config.logs.train, None)
    assert samples.base.quat_xyzw is not None
    with pytest.raises(LogError, match=r"base_quat_xyzw: missing, but FL_foot \(radius 0.022 m\) needs the"):
        read[1][1].read(read[1][0].logs.train, None)
    turned = ["logs.topics.low_state.frame=radar"]
    with pytest.raises(ConfigError, match=r"low_state\.frame: 'radar' is rotated by 165 deg relative to base"):
        set_up(load_config(tmp_path / "set.yaml", turned))
    set_up(load_config(tmp_path / "set.yaml", [*turned, "logs.topics.low_state.orientation=false"]))


@pytest.mark.parametrize(("robot", "feet"), [("g1", 2), ("a1", 4)])
def test_the_robot_of_a_state_is_that_whose_joints_the_urdf_has(tmp_path: Path, robot: str, feet: int) -> None:
    order = JOINT_ORDERS[robot]
    urdf = G1 if robot == "g1" else ROBOTS / "a1_description/urdf/a1.urdf"
    path = write_low_states(tmp_path / "x.mcap", moving(order.names), order.joints, order.message)
    said, topics, again = started(urdf, path)
    frame = "imu_in_pelvis" if robot == "g1" else "imu_link"
    assert topics == {"low_state": {"topic": "/lowstate", "robot": robot, "frame": frame}}
    assert again.joint_names == order.names
    config = load_config(tmp_path / "x.yaml")
    assert len(config.contacts) == feet
    assert config.preprocessing.detect_contacts
    missing = ["contact_active (which foot touches when): detected from joint torques"]
    assert [text for text in said.missing if TOO_SHORT not in text] == missing


def test_a_state_of_another_robot_is_not_taken(tmp_path: Path) -> None:
    order = JOINT_ORDERS["g1_23dof"]
    path = write_low_states(tmp_path / "x.mcap", moving(order.names), order.joints, HG)
    said = init(GO2_URDF, path, tmp_path / "x.yaml")
    assert any(text.startswith("joint_states: fill in ") for text in said.missing)
    assert "    #   /lowstate (unitree_hg/msg/LowState)" in (tmp_path / "x.yaml").read_text()
    assert "low_state" not in (tmp_path / "x.yaml").read_text()


def test_a_state_at_a_low_rate_is_the_second_choice(tmp_path: Path) -> None:
    entries = list(low_states(moving(GO2), GO2))
    entries += [("/lf/lowstate", *entry[1:]) for entry in entries[::10]]
    _, topics, again = started(GO2_URDF, write_bag(tmp_path / "x.mcap", entries))
    assert topics["low_state"]["topic"] == "/lowstate"
    assert len(again) == 40


def test_folders_parts_and_bags_of_ros_1_are_looked_at_as_well(tmp_path: Path) -> None:
    write_folder(tmp_path / "walk", ".mcap", low_states(moving(GO2), GO2))
    said = init(GO2_URDF, tmp_path / "walk", tmp_path / "a.yaml")
    assert "train: [walk]" in (tmp_path / "a.yaml").read_text()
    assert any(text.startswith("40 samples") for text in said.found)
    log = read_log(DEMO / "sway_train.npz").select(slice(0, 100))
    path = write_bag(tmp_path / "z.bag", entries_of(log))
    said = init(URDF, f"{path}[0:0.5]", tmp_path / "b.yaml")
    assert "train: ['z.bag[0:0.5]']" in (tmp_path / "b.yaml").read_text()
    assert any(text.startswith("50 samples over 0.49 s") for text in said.found)


def legged(names: list[str], more: list[tuple[str, str, Any]], samples: int = 20) -> list[Entry]:
    """Joint states with efforts and others' messages, all with the same stamps; content is of i and the stamp."""
    rng, out = np.random.default_rng(1), list[Entry]()
    for i in range(samples):
        stamp = START + 5_000_000 * i
        joints = {part: rng.standard_normal(len(names)) for part in ("position", "effort")}
        out.append(("/joint_states", stamp, JOINT_STATE, joint_state(stamp, names, **joints)))
        out += [(topic, stamp, kind, content(i, stamp)) for topic, kind, content in more]
    return out


def test_the_orientation_of_an_imu_along_the_base_is_proposed_where_messages_have_it(tmp_path: Path) -> None:
    joints = list(load_robot(G1).joint_names)

    def started_with(name: str, turn: float, frame: str = "imu_in_pelvis") -> tuple[dict[str, Any], Log]:
        def message(i: int, stamp: int) -> dict[str, Any]:
            quat = [0.0, 0.0, np.sin(turn * i), np.cos(turn * i)]
            return imu(stamp, [0, i, 9.8], [0, 0, 1], frame) | {"orientation": vector(quat, "xyzw")}

        _, topics, again = started(G1, write_bag(tmp_path / name, legged(joints, [("/imu", IMU, message)])))
        return topics["imu"], again

    topic, log = started_with("turns.mcap", 0.01)
    assert topic == {"topic": "/imu", "frame": "imu_in_pelvis", "orientation": True}
    assert log.base_quat_xyzw is not None
    assert "orientation" not in started_with("still.mcap", 0.0)[0], "of a driver that does not set it"


def test_an_imu_turned_against_the_base_gives_it_no_orientation(tmp_path: Path) -> None:
    joints, turned = list(load_robot(SOLO12).joint_names), tmp_path / "solo.urdf"
    link = '<link name="imu"/><joint name="m" type="fixed"><parent link="base_link"/><child link="imu"/>'
    turned.write_text(SOLO12.read_text().replace("</robot>", f'{link}<origin rpy="0 0 1.57"/></joint></robot>'))

    def message(i: int, stamp: int) -> dict[str, Any]:
        quat = [0.0, 0.0, np.sin(0.01 * i), np.cos(0.01 * i)]
        return imu(stamp, [0, i, 9.8], [0, 0, 1], "imu") | {"orientation": vector(quat, "xyzw")}

    _, topics, _ = started(turned, write_bag(tmp_path / "x.mcap", legged(joints, [("/imu", IMU, message)])))
    assert topics["imu"] == {"topic": "/imu", "frame": "imu"}
    settings = yaml.safe_load((tmp_path / "x.yaml").read_text())
    settings["logs"]["topics"]["imu"]["orientation"] = True
    (tmp_path / "y.yaml").write_text(yaml.safe_dump(settings))
    with pytest.raises(ConfigError, match=r"imu\.frame: 'imu' is rotated by 90 deg relative to base_link"):
        set_up(load_config(tmp_path / "y.yaml"))
    del settings["logs"]["topics"]["imu"]["frame"]
    (tmp_path / "y.yaml").write_text(yaml.safe_dump(settings))
    with pytest.raises(ConfigError, match=r"logs\.topics\.imu\.frame: missing with orientation: true"):
        set_up(load_config(tmp_path / "y.yaml"))


def test_commands_other_joints_and_imus_of_limbs_are_left_out(tmp_path: Path) -> None:
    joints = list(load_robot(G1).joint_names)
    command = ("/joint_command", JOINT_STATE, lambda _, stamp: joint_state(stamp, joints, position=np.zeros(29)))
    chest = ("/a_chest/imu", IMU, lambda _, stamp: imu(stamp, [9, 9, 9], [0, 0, 0], "imu_in_torso"))
    pelvis = ("/imu", IMU, lambda i, stamp: imu(stamp, [0, i, 9.8], [0, 0, 1], "imu_in_pelvis"))
    path = write_bag(tmp_path / "x.mcap", legged([*joints, "left_thumb"], [command, chest, pelvis]))
    said, topics, again = started(G1, path)
    assert topics["imu"] == {"topic": "/imu", "frame": "imu_in_pelvis"}
    assert topics["joint_states"] == {"topic": "/joint_states", "joints": joints}
    assert again.joint_names == tuple(joints)
    listed = "unused topics, listed in the file: /joint_command (sensor_msgs/msg/JointState): joints "
    assert any(text.startswith(listed) and "/a_chest/imu" in text for text in said.assumed)


def test_joints_that_messages_spell_otherwise_are_named_and_those_that_they_lack_are_welded(tmp_path: Path) -> None:
    """As a driver that has a prefix, but no `_joint`, and no wrists."""
    joints = list(load_robot(G1).joint_names)
    held = [name for name in joints if "wrist" in name]
    spelled = {f"g1/{name.removesuffix('_joint')}": name for name in joints if name not in held}
    for suffix in (".mcap", ".db3", ".bag"):
        path = write_bag(tmp_path / f"x{suffix}", legged([*spelled], []))
        said, topics, again = started(G1, path)
        entry = topics["joint_states"]
        assert entry["names"] == spelled
        assert set(again.joint_names) == set(spelled.values())
        assert load_config(path.with_suffix(".yaml")).robot.weld == dict.fromkeys(held, 0.0)
        assert any(text.startswith("robot.weld: ") for text in said.assumed)
        assert "joint_states: names differ only in a prefix or suffix" in said.assumed
        assert not any("joint_position" in text for text in said.missing)
    other = load_config(path.with_suffix(".yaml"), ["logs.topics.joint_states.names={a: left_kne_joint}"])
    with pytest.raises(
        UnknownNameError, match=r"joint_states\.names: unknown name 'left_kne_joint'; accepted: left_knee_joint"
    ):
        set_up(other)


def test_states_of_a_few_joints_of_something_else_are_not_the_robots(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "x.mcap", legged(["other_left_knee", "other_right_knee"], []))
    said = init(G1, path, tmp_path / "x.yaml")
    assert any(text.startswith("joint_states: fill in a topic below: {topic:") for text in said.missing)
    text = (tmp_path / "x.yaml").read_text()
    assert "    #   /joint_states (sensor_msgs/msg/JointState): joints other_left_knee" in text
    assert "    # joints of the robot: left_hip_pitch_joint, " in text


def test_wrenches_go_to_the_feet_in_their_frames_or_names(tmp_path: Path) -> None:
    joints = list(load_robot(G1).joint_names)
    left = (
        "/ft/sensor_1",
        WRENCH,
        lambda i, stamp: wrench(stamp, [0, 0, 300 * (i % 2), 1, 0, 0], "left_ankle_roll_link"),
    )
    right = (
        "/ft/right_ankle_roll",
        WRENCH,
        lambda i, stamp: wrench(stamp, [0, 0, 200.0, 2, 0, 0], "right_foot_sensor"),
    )
    said, topics, again = started(G1, write_bag(tmp_path / "x.mcap", legged(joints, [left, right])))
    assert topics["contact_wrenches"] == {
        "left_ankle_roll_link": "/ft/sensor_1",
        "right_ankle_roll_link": "/ft/right_ankle_roll",
    }
    weight = 9.81 * float(load_robot(G1).nominal[:, 0].sum())
    assert topics["contact_force_threshold"] == pytest.approx(0.05 * weight, rel=0.05)
    assert any("the messages' frames are taken for the contact frames" in text for text in said.assumed)
    wrenches = np.asarray(again.contact_wrench_local)
    np.testing.assert_array_equal(wrenches[0, :, 3], [1, 2])
    np.testing.assert_array_equal(np.asarray(again.contact_active)[:2], [[False, True], [True, True]])


def test_wrenches_at_fixed_joints_are_sensors_in_limbs(tmp_path: Path) -> None:
    """By the frame of the messages, or by the name of the joint or its link in the topic."""
    joints = list(load_robot(TALOS).joint_names)
    left = ("/left/wrench", WRENCH, lambda i, stamp: wrench(stamp, [0, 0, 1.0, i, 0, 0], "wrist_left_ft_link"))
    right = ("/wrist_right_ft", WRENCH, lambda i, stamp: wrench(stamp, [0, 0, 2.0, i, 0, 0]))
    sole = ("/left_sole_link", WRENCH, lambda i, stamp: wrench(stamp, [0, 0, 400.0 * (i % 2), 0, 0, 0]))
    said, topics, again = started(TALOS, write_bag(tmp_path / "x.mcap", legged(joints, [left, right, sole])))
    assert topics["ft_wrenches"] == {
        "wrist_left_ft_joint": {"topic": "/left/wrench", "frame": "wrist_left_ft_link"},
        "wrist_right_ft_joint": "/wrist_right_ft",
    }
    assert topics["contact_wrenches"] == {"left_sole_link": "/left_sole_link"}
    assert again.ft_names == ("wrist_left_ft_joint", "wrist_right_ft_joint")
    np.testing.assert_array_equal(np.asarray(again.ft_wrench)[:2, :, 2:4], [[[1, 0], [2, 0]], [[1, 1], [2, 1]]])
    sensors = yaml.safe_load((tmp_path / "x.yaml").read_text())["sensors"]
    assert sensors == {"set": "full", "ft_sensors": ["wrist_left_ft_joint", "wrist_right_ft_joint"]}
    assert any(text.startswith("ft_wrenches: what the parent side exerts") for text in said.assumed)


def test_flags_of_some_feet(tmp_path: Path) -> None:
    joints = list(load_robot(GO2_URDF).joint_names)
    flag = ("/contact/FL", FLAG, lambda i, _: {"data": i > 5})
    said, topics, again = started(GO2_URDF, write_bag(tmp_path / "y.mcap", legged(joints, [flag])))
    assert topics["contact_active"] == {"FL_foot": "/contact/FL", "FR_foot": True, "RL_foot": True, "RR_foot": True}
    assert "contact_active: FR_foot, RL_foot, RR_foot always in contact: no topic has flags" in said.assumed
    assert np.asarray(again.contact_active).sum() == 14 + 60


def test_a_bag_without_anything_is_answered_by_what_is_missing(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "x.mcap", [("/chatter", 1, "std_msgs/msg/String", {"data": "hello"})])
    said = init(URDF, path, tmp_path / "x.yaml")
    topics = load_config(tmp_path / "x.yaml").logs.topics
    assert topics is not None
    assert topics.by_role.keys() == {"joint_states"}
    assert load_config(tmp_path / "x.yaml").preprocessing.detect_contacts
    assert any(text.startswith("joint_states: fill in ") for text in said.missing)
    assert "    #   /chatter (std_msgs/msg/String)\n" in path.with_suffix(".yaml").read_text()


@pytest.mark.parametrize("topics", [("/legs/joint_states", "/arms/joint_states"), ("/joint_states", "/joint_states")])
def test_joints_of_several_publishers_are_those_of_one_robot(tmp_path: Path, topics: tuple[str, str]) -> None:
    """Each at its own rate, on topics of their own or on one; none of them is welded."""
    names = load_robot(SOLO12).joint_names
    of = {topics[0] + "0": names[:8][::-1], topics[1] + "1": (*names[8:], "gripper")}
    entries, angle = list[Entry](), np.arange(13)
    for number, (topic, own) in enumerate(of.items()):
        places = angle[: len(own)] + 8 * number
        for k in range(0, 200, 1 + number):
            stamp = START + k * 5_000_000 + number
            values = np.sin(0.02 * k + places)
            joints = joint_state(stamp, own, position=values, velocity=4.0 * np.cos(0.02 * k + places), effort=values)
            entries.append((topic[:-1], stamp, JOINT_STATE, joints))
    said, found, log = started(SOLO12, write_bag(tmp_path / "x.mcap", sorted(entries, key=lambda one: one[1])))
    assert not any("weld" in text for text in said.assumed)
    assert found["joint_states"] == (
        topics[0] if len(set(topics)) > 1 else {"topic": topics[0], "joints": [*names[:8]]}
    )
    assert found["other_joint_states"] == [{"topic": topics[1], "joints": [*names[8:]]}]
    assert set(log.joint_names) == set(names)
    assert log.joint_torque is not None
    assert log.joint_velocity is not None
    place = np.array([7 - k if k < 8 else k for k in map(names.index, log.joint_names)])
    begin = float(np.arcsin(log.joint_position[0, log.joint_names.index(names[7])]))  # of the log, in angle
    np.testing.assert_allclose(log.joint_position, np.sin(begin + 4.0 * log.time[:, None] + place), atol=1e-5)
    np.testing.assert_allclose(log.joint_velocity, 4.0 * np.cos(begin + 4.0 * log.time[:, None] + place), atol=1e-4)
    np.testing.assert_allclose(log.joint_torque, log.joint_position, atol=1e-12)


def test_a_joint_of_two_topics_is_refused(tmp_path: Path) -> None:
    state = [("/a", ["x", "y"]), ("/b", ["y", "z"])]
    stamps = [START + k * 5_000_000 for k in range(20)]
    entries = [(t, s, JOINT_STATE, joint_state(s, own, position=[0.1, 0.2])) for s in stamps for t, own in state]
    given = Topics(joint_states="/a", other_joint_states=["/b"])  # type: ignore[arg-type,list-item]
    with pytest.raises(LogError, match="/b: joint 'y' is in two topics; accepted: logs.topics.other_joint_states.0"):
        read_log(write_bag(tmp_path / "x.mcap", entries), given)
