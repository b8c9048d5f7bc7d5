"""Unitree's LowState in bags: motors by number, the IMU, foot sensors, and stamps by the robot's own clock."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import IMU, Entry, imu, parsed
from bags import write_bag as write
from low_states import FEET, GO2, START, TOPIC, low_states, moving, write_low_states
from motions import value
from refusals import refused
from scipy.spatial.transform import Rotation
from synthetic import G1, ROBOTS, Array

from torchid.errors import TorchidWarning
from torchid.logs import Log, read_log
from torchid.logs.flags import ContactThreshold, with_flags_by_force
from torchid.logs.unitree import GO, HG, JOINT_ORDERS
from torchid.robot import load_robot

G1_JOINTS = JOINT_ORDERS["g1"].names


def read(path: Path, **low_state: Any) -> Log:
    return read_log(path, parsed({"low_state": {"topic": TOPIC, **low_state}}))


def of(
    path: Path, log: Log, robot: str = "go2", kind: str = GO, options: dict[str, Any] | None = None, **key: Any
) -> Log:
    """A log by messages of it, with the motors of a robot."""
    order = JOINT_ORDERS[robot].joints
    return read(write_low_states(path, log, order, kind, **(options or {})), **({"robot": robot} | key))


@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
@pytest.mark.parametrize(("robot", "kind"), [("go2", GO), ("g1", HG), ("h1", GO), ("g1_23dof", HG)])
def test_numbers_come_back_bit_for_bit_whatever_the_order_of_the_joints(
    tmp_path: Path, suffix: str, robot: str, kind: str
) -> None:
    names = JOINT_ORDERS[robot].names
    shuffled = np.random.default_rng(3).permutation(len(names))
    log = moving([names[i] for i in shuffled])
    again = of(tmp_path / f"x{suffix}", log, robot, kind, frame="imu")
    assert again.joint_names == names
    order = [log.joint_names.index(name) for name in names]
    for field in ("joint_position", "joint_velocity", "joint_torque"):
        np.testing.assert_array_equal(getattr(again, field), value(getattr(log, field))[:, order])
    np.testing.assert_array_equal(again.imu_specific_force, log.imu_specific_force)
    np.testing.assert_array_equal(again.imu_angular_velocity, log.imu_angular_velocity)
    assert again.imu_frame == "imu"
    np.testing.assert_array_equal(again.time, log.time)
    assert again.contact_names == ()


def test_the_imu_and_the_feet_are_read_where_the_map_says_so_alone(tmp_path: Path) -> None:
    again = of(tmp_path / "x.mcap", moving(GO2), options={"feet": np.full((40, 4), 60)})
    assert set(again.arrays()) == {"time", "joint_position", "joint_velocity", "joint_torque"}


def test_the_quaternion_of_the_imu_is_the_bases_orientation_where_it_is_set(tmp_path: Path) -> None:
    """A driver that does not set it, to all zeros or to no rotation, says nothing of the base."""
    log, rng = moving(GO2), np.random.default_rng(5)
    turns = Rotation.from_rotvec(np.cumsum(0.02 * rng.standard_normal((len(log), 3)), axis=0)).as_quat()
    wxyz = np.roll(turns, 1, axis=1) * rng.choice([-1.0, 1.0], (len(log), 1))

    def read_with(quats: Array, **key: Any) -> Log:
        return of(tmp_path / "x.mcap", log, options={"turns": quats}, **{"frame": "imu"} | key)

    again = read_with(wxyz)
    turned = Rotation.from_quat(value(again.base_quat_xyzw)) * Rotation.from_quat(turns).inv()
    assert turned.magnitude().max() < 1e-6, "float32"
    assert (np.diff(value(again.base_quat_xyzw), axis=0) ** 2).sum(axis=1).max() < 0.1, "no flips"
    assert read_with(wxyz, orientation=False).base_quat_xyzw is None
    assert read_with(wxyz, frame=None).base_quat_xyzw is None
    for constant in ([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]):
        assert read_with(np.tile(constant, (len(log), 1))).base_quat_xyzw is None
    wxyz[7] = 0.0
    message = refused(lambda: read_with(wxyz), f"{tmp_path / 'x.mcap'}: {TOPIC}: an IMU quaternion has norm 0")
    assert message.endswith("accepted: unit quaternions, or logs.topics.low_state.orientation: false")


def test_joints_may_be_listed_by_number_in_place_of_a_robot(tmp_path: Path) -> None:
    log, order = moving(("a", "b")), [None, "b", None, "a"]
    again = read(write_low_states(tmp_path / "x.db3", log, order), joints=order)
    assert again.joint_names == ("b", "a")
    np.testing.assert_array_equal(again.joint_position, log.joint_position[:, [1, 0]])


@pytest.mark.parametrize(
    ("robot", "urdf"),
    [("go2", "go2_description/urdf/go2.urdf"), ("a1", "a1_description/urdf/a1.urdf"),
     ("go1", "go1_description/urdf/go1.urdf"), ("g1", G1)],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_names_of_joints_and_feet_are_those_of_the_urdfs(robot: str, urdf: Any) -> None:
    loaded = load_robot(ROBOTS / urdf)
    assert set(JOINT_ORDERS[robot].names) == set(loaded.joint_names)
    assert set(JOINT_ORDERS[robot].feet) <= set(loaded.links)


# ------------------------------------------------------------------------------------------------------------- feet

COUNTS = np.array([[0, 40, 21, 22], [23, 40, 21, 22], [23, 5, 300, 22], [9, 9, 9, 9]])


def test_feet_are_by_number_those_of_the_robot_or_as_named(tmp_path: Path) -> None:
    log = moving(GO2, 4)
    again = of(tmp_path / "x.mcap", log, options={"feet": COUNTS}, above=22, forces=True)
    assert again.contact_names == FEET == tuple(f"{leg}_foot" for leg in ("FR", "FL", "RR", "RL"))
    np.testing.assert_array_equal(again.contact_force_normal, COUNTS)
    np.testing.assert_array_equal(again.contact_active, COUNTS > 22)
    path = tmp_path / "x.mcap"
    flags = read(path, robot="go2", above=22, feet=[None, "b", "a"])
    assert flags.contact_names == ("b", "a")
    np.testing.assert_array_equal(flags.contact_active, COUNTS[:, 1:3] > 22)
    assert flags.contact_force_normal is None


def test_flags_of_others_stand_beside_counts_that_are_forces(tmp_path: Path) -> None:
    path = write_low_states(tmp_path / "x.mcap", moving(GO2, 4), GO2, feet=COUNTS)
    topics: dict[str, Any] = {"low_state": {"topic": TOPIC, "robot": "go2", "forces": True}}
    log = read_log(path, parsed(topics | {"contact_active": dict.fromkeys(FEET, True)}))
    assert log.contact_names == FEET
    assert log.contact_active is not None
    assert log.contact_active.all()
    np.testing.assert_array_equal(log.contact_force_normal, COUNTS)
    message = refused(
        lambda: read_log(path, parsed(topics)), f"{path}: logs.topics.low_state.above: missing: no contact flags for"
    )
    assert "no contact flags for FR_foot" in message
    bare = read_log(path, parsed(topics | {"contact_force_threshold": 3.0}), needs_flags=False)
    flags = value(with_flags_by_force(bare, ContactThreshold(22, 10))[0].contact_active)
    assert flags.astype(int).T.tolist() == [[0, 1, 1, 0], [1, 1, 0, 0], [1, 1, 1, 0], [0, 0, 0, 0]]


# ------------------------------------------------------------------------------------------------------------ stamps


def test_stamps_are_the_robots_milliseconds_however_late_messages_come(tmp_path: Path) -> None:
    log = moving(GO2, 200)
    late = np.random.default_rng(0).integers(0, 5_000_000, 200)
    again = of(tmp_path / "x.mcap", log, options={"late": late})
    np.testing.assert_array_equal(again.time, log.time)
    np.testing.assert_array_equal(again.joint_position, log.joint_position)
    with pytest.warns(TorchidWarning, match="no stamps in the messages; the log uses times of receipt"):
        uneven = read(tmp_path / "x.mcap", robot="go2", stamps="receipt")
    assert np.abs(np.diff(uneven.time) - 0.002).max() > 5e-4


def test_a_counter_that_starts_again_from_0_goes_on(tmp_path: Path) -> None:
    log = moving(GO2)
    ticks = 2**32 - 31 + np.round(1e3 * log.time).astype(np.int64)
    again = of(tmp_path / "x.db3", log, options={"ticks": ticks})
    np.testing.assert_array_equal(again.time, log.time)
    np.testing.assert_array_equal(again.joint_torque, log.joint_torque)


@pytest.mark.parametrize("tick", [0, 1])
def test_without_ticks_the_times_of_receipt_count_with_a_warning(tmp_path: Path, tick: int) -> None:
    log = moving(GO2, 4)
    with pytest.warns(TorchidWarning, match=f"{TOPIC}: no stamps in the messages"):
        again = of(tmp_path / "x.mcap", log, options={"ticks": np.full(4, tick)})
    np.testing.assert_array_equal(again.time, log.time)


def test_ticks_that_are_no_milliseconds_are_refused_unless_meant(tmp_path: Path) -> None:
    log = moving(GO2, 1000)
    counted = {"ticks": 1000 + np.arange(1000)}  # of messages, each 2 ms
    message = refused(
        lambda: of(tmp_path / "x.mcap", log, options=counted), f"{tmp_path}/x.mcap: {TOPIC}: ticks advance"
    )
    assert "advance by 0.999 s, but messages arrive over 1.998 s; the largest difference is 0.499" in message
    assert "accepted: ticks of 1 ms, or logs.topics.low_state.stamps: receipt (or tick, to use them)" in message
    slow = read(tmp_path / "x.mcap", robot="go2", stamps="tick")  # of a simulation at half the speed
    np.testing.assert_allclose(slow.time, log.time / 2, atol=1e-12)


def test_a_tick_that_comes_twice_counts_once_or_is_refused(tmp_path: Path) -> None:
    log = moving(GO2, 4)
    entries = list(low_states(log, GO2))
    entries.insert(2, entries[1])
    with pytest.warns(TorchidWarning, match="1 duplicate messages are ignored"):
        assert len(read(write(tmp_path / "x.mcap", entries), robot="go2")) == 4
    ticks = {"ticks": np.array([1000, 1002, 1002, 1006])}
    message = refused(
        lambda: of(tmp_path / "y.mcap", log, options=ticks), f"{tmp_path}/y.mcap: {TOPIC}: different messages"
    )
    assert "different stamps, or logs.topics.low_state.stamps: receipt" in message


def test_other_topics_are_aligned_by_the_usual_lateness_of_messages(tmp_path: Path) -> None:
    log = moving(GO2, 50)
    stamps = START + np.round(log.time * 1e9).astype(np.int64)
    others: list[Entry] = [
        ("/imu", int(stamp), IMU, imu(int(stamp), force, turn))
        for stamp, force, turn in zip(
            stamps, value(log.imu_specific_force), value(log.imu_angular_velocity), strict=True
        )
    ]
    path = write(tmp_path / "x.mcap", [*low_states(log, GO2), *others])
    again = read_log(path, parsed({"low_state": {"topic": TOPIC, "robot": "go2"}, "imu": "/imu"}))
    np.testing.assert_array_equal(again.imu_specific_force, log.imu_specific_force)
    assert again.imu_frame == "imu_link"
    by_imu = read_log(path, parsed({"low_state": {"topic": TOPIC, "robot": "go2"}, "imu": "/imu", "rate_topic": "imu"}))
    np.testing.assert_array_equal(by_imu.joint_position, log.joint_position)


# ---------------------------------------------------------------------------------------------------------- refusals


def test_a_state_of_another_robot_is_refused_with_the_nearest(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    cases: list[tuple[str, str, str]] = [
        ("g1", "go2", "logs.topics.low_state.robot: 'go2' sends unitree_go/msg/LowState, but /lowstate "
         "has unitree_hg/msg/LowState; accepted: g1, g1_23dof"),
    ]  # fmt: skip
    for sent, stated, message in cases:
        order = JOINT_ORDERS[sent]
        write_low_states(path, moving(order.names), order.joints, order.message)
        assert refused(lambda: read(path, robot=stated), f"{path}: ").removeprefix(f"{path}: ") == message  # noqa: B023


def test_ankles_by_their_parallel_motors_are_refused(tmp_path: Path) -> None:
    options = {"mode_pr": 1, "mode_machine": 5}
    message = refused(
        lambda: of(tmp_path / "x.mcap", moving(G1_JOINTS), "g1", HG, options), f"{tmp_path}/x.mcap: {TOPIC}: m"
    )
    assert "mode_pr 1: ankles and waist by parallel motors (A, B), not by joint; accepted: messages w" in message


MAPS: list[tuple[dict[str, Any], str]] = [
    (
        {},
        "logs.topics.low_state: neither robot nor joints; accepted: one of the two: robot (go2, b2, a1, go1, g1, g",
    ),
    ({"robot": "go2", "joints": ["a"]}, "logs.topics.low_state: robot and joints together; accepted: one of the two"),
    ({"robot": "g2"}, "logs.topics.low_state.robot: unknown name 'g2'; accepted: go2, g1, b2"),
    ({"joints": ["a", "a"]}, "logs.topics.low_state.joints: 'a' twice; accepted: every name once; null for an unused"),
    ({"joints": [None]}, "logs.topics.low_state.joints: no name; accepted: every name once"),
    ({"joints": [*map(str, range(21))]}, "low_state.joints: 21 names, but unitree_go/msg/LowState has 20 motors"),
    (
        {"robot": "go2", "feet": ["a"]},
        "low_state.feet: given, but above and forces are missing; accepted: above (the",
    ),
    ({"robot": "g1", "above": 5}, "low_state.robot: 'g1' sends unitree_hg/msg/LowState without foot sensors, but "),
    ({"robot": "h1", "above": 5}, "low_state.feet: missing, but foot sensors are read; accepted: contacts by"),
    ({"robot": "go2", "above": 5, "feet": ["a", "a"]}, "low_state.feet: 'a' twice; accepted: every name once"),
]


@pytest.mark.parametrize(("low_state", "message"), MAPS)
def test_maps_that_do_not_fit_themselves_are_refused(tmp_path: Path, low_state: dict[str, Any], message: str) -> None:
    path = write_low_states(tmp_path / "x.mcap", moving(GO2, 4), GO2)
    assert message in refused(lambda: read(path, **low_state), f"{path}: logs.topics.low_state")


def test_topics_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    path = write_low_states(tmp_path / "x.mcap", moving(GO2, 4), GO2, feet=COUNTS)
    low_state = {"topic": TOPIC, "robot": "go2", "frame": "imu", "above": 20, "forces": True}
    for more, message in (
        (
            {"joint_states": "/j"},
            "logs.topics: joint_states and low_state; accepted: one of the two, joint_states: the",
        ),
        ({"imu": "/imu"}, "logs.topics.imu: set together with logs.topics.low_state.frame; accepted: one IMU"),
        (
            {"contact_force_normal": {"FL_foot": "/f"}},
            "contact_force_normal.FL_foot: set together with logs.topics.low_stat",
        ),
        ({"rate_topic": "joint_states"}, "logs.topics.rate_topic: unknown name 'joint_states'; accepted: low_state"),
    ):
        given = parsed({"low_state": low_state, **more})
        assert message in refused(lambda: read_log(path, given), f"{path}: logs.topics")  # noqa: B023
    humanoid = write_low_states(tmp_path / "y.mcap", moving(G1_JOINTS, 4), G1_JOINTS, HG)
    message = refused(
        lambda: read(humanoid, joints=G1_JOINTS, above=3, feet=["a"]), f"{humanoid}: logs.topics.low_state.above: "
    )
    assert "set, but unitree_hg/msg/LowState has no foot sensors; accepted: no above" in message
    message = refused(lambda: read_log(path, parsed({"joint_states": TOPIC})), f"{path}: logs.topics.joint_states: ")
    assert (
        "/lowstate has messages of unitree_go/msg/LowState; accepted: sensor_msgs/msg/JointState, or logs.topics.low_"
        in message
    )


def test_messages_that_are_received_in_another_order_are_sorted_by_their_ticks(tmp_path: Path) -> None:
    log = moving(GO2, 4)
    entries = list(low_states(log, GO2))
    swapped = [
        (topic, START + 2_000_000 * i, kind, content)
        for i, (topic, _, kind, content) in enumerate([entries[k] for k in (0, 2, 1, 3)])
    ]
    again = read(write(tmp_path / "x.mcap", swapped), robot="go2")
    np.testing.assert_array_equal(again.joint_position, log.joint_position)
