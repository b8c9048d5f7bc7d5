"""Bags of ROS messages: every type of file gives the same log, and topics that do not fit are named."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import (
    JOINT_STATE,
    ROS1,
    ROS2,
    STAMPS,
    Entry,
    entries_of,
    filled,
    joints_at,
    parsed,
    read_messages,
    recorded,
    refusal,
    topics_of,
    write_bag,
    write_folder,
)

from torchid.errors import ConfigError, LogError, TorchidWarning, UnknownNameError
from torchid.logs import read_log


@pytest.mark.parametrize("name", ["x.bag", "x.mcap", "x.db3", "mcap", "db3"])
def test_a_bag_holds_what_its_messages_say_to_the_bit(tmp_path: Path, name: str) -> None:
    log = recorded()
    if "." in name:
        path = write_bag(tmp_path / name, entries_of(log))
    else:
        write_folder(path := tmp_path / "walk.2", f".{name}", entries_of(log))
    shares: list[float] = []
    with pytest.warns(TorchidWarning, match="/touch/l_sole, /touch/r_sole: no stamps") as caught:
        again = read_log(path, parsed(topics_of(log)), shares.append)
    assert len(caught) == 1
    assert Path(caught[0].filename) == Path(__file__)
    np.testing.assert_allclose(again.time, log.time, rtol=0, atol=1e-12)
    assert again.arrays().keys() == log.arrays().keys()
    for field, values in log.arrays().items():
        if field != "time":
            np.testing.assert_allclose(again.arrays()[field], values, rtol=0, atol=2e-16 * (field == "base_quat_xyzw"))
    assert (again.names, again.imu_frame) == (log.names, log.imu_frame)
    assert shares
    assert all(0.0 <= share <= 1.0 for share in shares)


def test_files_of_one_folder_are_one_recording(tmp_path: Path) -> None:
    log, folder = recorded(), tmp_path / "walk"
    entries, folder_b = entries_of(log), tmp_path / "other"
    write_folder(folder, ".mcap", entries[: len(entries) // 2])
    write_folder(folder_b, ".mcap", entries[len(entries) // 2 :]).replace(folder / "part_1.mcap")
    with pytest.warns(TorchidWarning, match="no stamps"):
        again = read_log(folder, parsed(topics_of(log)))
    np.testing.assert_array_equal(again.joint_position, log.joint_position)


# ------------------------------------------------------------------------------------------------------------ topics


def test_a_map_of_topics_is_built_without_the_readers_of_bags() -> None:
    script = """
import sys, torchid
heavy = {"torch", "numpy", "pydantic", "rosbags", "mcap", "zstandard"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
topics = torchid.Topics(joint_states="/joint_states", odometry={"topic": "/odom", "frame": "pelvis"})
assert topics.by_role["odometry"].frame == "pelvis"
assert torchid.Topics is torchid.logs.Topics
assert not {"rosbags", "mcap", "zstandard"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-W", "error", "-c", script], check=True)


def test_a_bag_without_a_topic_map_says_what_it_has(tmp_path: Path) -> None:
    log = recorded(3)
    for suffix in (".bag", ".mcap", ".db3"):
        path = write_bag(tmp_path / f"x{suffix}", entries_of(log))
        with pytest.raises(LogError) as caught:
            read_log(path)
        message = str(caught.value)
        assert "logs.topics: missing; the bag has /joint_states (sensor_msgs/msg/JointState), /odom (nav_m" in message
        assert "/touch/r_sole (std_msgs/msg/Bool)" in message


def test_topics_that_are_not_there_or_carry_something_else_are_named(tmp_path: Path) -> None:
    entries = entries_of(recorded(3))
    path = tmp_path / "x.mcap"
    message = refusal(path, entries, joint_states="/joint_state")
    assert "logs.topics.joint_states: unknown name '/joint_state'; accepted: /joint_states" in message
    with pytest.raises(UnknownNameError):
        read_log(path, parsed({"joint_states": "/joint_states", "ft_wrenches": {"a": "/nowhere"}}))
    message = refusal(path, entries, imu="/odom")
    assert "logs.topics.imu: /odom has messages of nav_msgs/msg/Odometry; accepted: sensor_msgs/msg/Imu" in message
    message = refusal(path, entries, rate_topic="imu")
    assert "logs.topics.rate_topic: unknown name 'imu'; accepted: joint_states" in message
    with pytest.raises(ConfigError, match=r"contact_force_threshold: missing: no contact flags for l_sole"):
        read_messages(path, entries, contact_wrenches={"l_sole": "/wrench/l_sole"})
    with pytest.raises(ConfigError, match=r"contact_active.l_sole: needs either topic or always"):
        read_messages(path, entries, contact_active={"l_sole": {}})


@pytest.mark.parametrize(
    ("absent", "found"),
    [
        (("rosbags", "mcap", "zstandard"), "rosbags and mcap and zstandard are not installed"),
        (("rosbags", "zstandard"), "rosbags and zstandard are not installed"),
        (("mcap",), "mcap is not installed"),
    ],
)
@pytest.mark.parametrize("suffix", [".bag", ".db3"])
def test_every_package_that_is_missing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, absent: tuple[str, ...], found: str, suffix: str
) -> None:
    path = write_bag(tmp_path / f"x{suffix}", joints_at(STAMPS))
    for name in [*sys.modules, *absent]:
        if name.partition(".")[0] in absent:
            monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "torchid.logs.bags", raising=False)
    with pytest.raises(LogError, match=f"a bag, but {found}; accepted: "):
        read_log(path, parsed({"joint_states": "/joint_states"}))


# ------------------------------------------------------------------------------------------------- kinds of recording


@pytest.mark.parametrize("compression", ["BZ2", "LZ4"])
def test_compressed_bags_of_ros_1_read_as_others_do(tmp_path: Path, compression: str) -> None:
    from rosbags.rosbag1 import Writer

    writer = Writer(tmp_path / "x.bag")
    writer.set_compression(Writer.CompressionFormat[compression])
    with writer:
        connection = writer.add_connection("/joint_states", JOINT_STATE, typestore=ROS1)
        for _, stamp, kind, content in joints_at(STAMPS, position=np.arange(4.0)):
            writer.write(connection, stamp, ROS1.serialize_ros1(filled(ROS1, kind, content), kind))
    log = read_log(tmp_path / "x.bag", parsed({"joint_states": "/joint_states"}))
    np.testing.assert_array_equal(log.joint_position[:, 0], np.arange(4.0))


def mcap_bytes(entries: list[Entry], encoding: str = "cdr", **options: Any) -> bytes:
    """An MCAP file by the format's own writer, of ROS 2 or, serialized as `ros1`, of ROS 1."""
    from mcap.writer import Writer

    store = ROS1 if encoding == "ros1" else ROS2
    serialize = store.serialize_ros1 if encoding == "ros1" else store.serialize_cdr
    stream = io.BytesIO()
    writer = Writer(stream, **options)
    writer.start("", "")
    channels: dict[str, int] = {}
    for topic, received, kind, content in entries:
        if topic not in channels:
            name = kind.replace("/msg/", "/") if encoding == "ros1" else kind
            channels[topic] = writer.register_channel(topic, encoding, writer.register_schema(name, "ros2msg", b""))
        data = bytes(serialize(filled(store, kind, content), kind))
        writer.add_message(channels[topic], received, data, received)
    writer.finish()
    return stream.getvalue()


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_mcap_files_of_any_compression_read_alike_with_and_without_an_index(
    tmp_path: Path, encoding: str, compression: str
) -> None:
    from mcap.writer import CompressionType, IndexType

    path, entries = tmp_path / "x.mcap", joints_at(STAMPS, position=np.arange(4.0))
    kind = CompressionType[compression]
    bare: dict[str, Any] = {"index_types": IndexType.NONE, "repeat_channels": False, "repeat_schemas": False}
    for options in ({}, bare, {"use_chunking": False}, {"chunk_size": 1, "enable_crcs": False}):
        path.write_bytes(mcap_bytes(entries, encoding, compression=kind, **options))
        log = read_log(path, parsed({"joint_states": "/joint_states"}))
        np.testing.assert_array_equal(log.joint_position[:, 0], np.arange(4.0))
    path.write_bytes(mcap_bytes(entries, "json"))
    with pytest.raises(LogError, match="/joint_states: messages serialized as 'json'; accepted: cdr"):
        read_log(path, parsed({"joint_states": "/joint_states"}))
