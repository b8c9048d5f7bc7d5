"""Bytes of Unitree's LowState: where its members lie, and what bytes that are none of it give."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from bags import ROS2, parsed
from low_states import TOPIC
from rosbags import rosbag2

from torchid.errors import InputError
from torchid.logs import read_log
from torchid.logs.bags import BagChannel, make_deserializer
from torchid.logs.unitree import GO, HG


def packed(layout: str, values: dict[str, float]) -> bytes:
    """A little-endian CDR message of members `name:type` or `name:count*type`, 0 where nothing is given."""
    out = bytearray()
    for member in layout.split():
        name, _, code = member.partition(":")
        count, _, kind = code.rpartition("*")
        for k in range(int(count or 1)):
            out += b"\0" * (-len(out) % struct.calcsize(kind))
            out += struct.pack(f"<{kind}", values.get(f"{name}{k}", 0) if count else values.get(name, 0))
    return b"\0\1\0\0" + bytes(out)


def layout(kind: str) -> str:
    """The members of a message, as the IDL files of Unitree's SDK have them."""
    imu = "quat:4*f gyro:3*f acc:3*f rpy:3*f " + ("it:B" if kind == GO else "it:h")
    if kind == GO:
        motor = "mode{0}:B q{0}:f dq{0}:f ddq{0}:f tau{0}:f qr{0}:f dqr{0}:f ddqr{0}:f t{0}:B lost{0}:I res{0}_:2*I"
        motors = " ".join(motor.format(i) for i in range(20))
        battery = "vh:B vl:B st:B soc:B cur:i cyc:H bq:2*B mcu:2*B cell:15*H"
        head, tail = "head:2*B level:B fr:B sn:2*I ver:2*I bw:H", "ff:4*h ffe:4*h tick:I wr:40*B bit:B adc:f"
        return f"{head} {imu} {motors} {battery} {tail} t1:B t2:B pv:f pa:f fan:4*H rsv:I crc:I"
    motor = "mode{0}:B q{0}:f dq{0}:f ddq{0}:f tau{0}:f t{0}_:2*h vol{0}:f sen{0}_:2*I ms{0}:I res{0}_:4*I"
    motors = " ".join(motor.format(i) for i in range(35))
    return f"ver:2*I pr:B machine:B tick:I {imu} {motors} wr:40*B rsv:4*I crc:I"


@pytest.mark.parametrize("kind", [GO, HG])
def test_members_lie_where_the_idl_files_of_the_sdk_have_them(kind: str) -> None:
    rng, count = np.random.default_rng(2), {GO: 20, HG: 35}[kind]
    numbers = {
        f"{name}{i}": float(np.float32(rng.normal())) for name in ("q", "dq", "tau", "t", "lost") for i in range(count)
    }
    numbers = {name: x if name[0] in "qd" or name.startswith("tau") else 3 for name, x in numbers.items()}
    numbers |= {f"{name}{i}": float(np.float32(rng.normal())) for name in ("gyro", "acc") for i in range(3)}
    numbers |= {f"ff{i}": 100 + i for i in range(4)} | {
        "tick": 2**32 - 5,
        "crc": 2**31,
        "pr": 1,
        "machine": 5,
        "it": 77,
    }
    message = make_deserializer(TOPIC, BagChannel(TOPIC, kind, "cdr"))(packed(layout(kind), numbers))
    for i, motor in enumerate(message.motor_state):
        assert (motor.q, motor.dq, motor.tau_est) == tuple(numbers[f"{name}{i}"] for name in ("q", "dq", "tau"))
    for name, found in (("gyro", message.imu_state.gyroscope), ("acc", message.imu_state.accelerometer)):
        np.testing.assert_array_equal(found, [numbers[f"{name}{i}"] for i in range(3)])
    assert (message.tick, message.crc) == (2**32 - 5, 2**31)
    if kind == GO:
        np.testing.assert_array_equal(message.foot_force, [100, 101, 102, 103])
    else:
        assert (message.mode_pr, message.mode_machine) == (1, 5)


def test_messages_of_any_bytes_give_a_log_or_one_line(tmp_path: Path) -> None:
    rng, refusals = np.random.default_rng(4), 0
    size = len(packed(layout(GO), {}))
    for case in range(30):
        path = tmp_path / f"{case}.mcap"
        with rosbag2.Writer(tmp_path / "folder", version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
            connection = writer.add_connection(TOPIC, GO, typestore=ROS2)
            for received in (0, 10**9, 2**62):
                data = rng.integers(0, 256, size - (case % 3 == 2) * 90, dtype=np.uint8).tobytes()
                writer.write(connection, received, b"\0\1\0\0" + data[4:])
        next((tmp_path / "folder").glob("*.mcap")).replace(path)
        shutil.rmtree(tmp_path / "folder")
        stamps = {"stamps": "tick" if case % 2 else None}
        low_state = {"topic": TOPIC, "robot": "go2", "frame": "imu", "above": 3, "forces": True}
        try:
            log = read_log(path, parsed({"low_state": low_state | stamps}))
        except InputError as error:
            refusals += "\n" not in str(error)
        else:
            assert len(log) == 3
    assert refusals > 15
