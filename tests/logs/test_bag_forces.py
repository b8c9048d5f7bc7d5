"""Scalar sensors of contacts in bags: numbers, arrays of numbers, and wrenches of which one component is read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from bags import (
    FLAG,
    PLAIN_WRENCH,
    STAMPS,
    WRENCH,
    Entry,
    entries_of,
    joints_at,
    parsed,
    read_messages,
    recorded,
    refusal,
    topics_of,
    vector,
    wrench,
    write_bag,
)
from motions import value
from synthetic import Array

from torchid.cli import main
from torchid.config.logs import load_topics
from torchid.errors import ConfigError, LogError
from torchid.logs import Log, read_log

pytestmark = pytest.mark.filterwarnings("ignore:.*no stamps:torchid.errors.TorchidWarning")  # std_msgs have none
FEET = ("FL", "FR", "RL")
FORCES = np.array([[10.0, 40.0, -3.0], [11.0, 41.0, -2.0], [12.0, 42.0, 0.0], [13.0, 43.0, 500.0]])


def numbers(kind: str, values: Array = FORCES, topic: str = "/foot_forces") -> list[Entry]:
    """Joint states, and messages with a number or array for each stamp."""
    return joints_at(STAMPS) + [
        (topic, int(stamp), f"std_msgs/msg/{kind}", {"data": x}) for stamp, x in zip(STAMPS, values, strict=True)
    ]


def force_of(path: Path, entries: list[Entry], **force: Any) -> Array:
    """What the one contact reads by these messages, (N,)."""
    log = read_messages(path, entries, contact_force_normal={"FL": force}, contact_active={"FL": True})
    return value(log.contact_force_normal)[:, 0]


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_a_log_with_forces_along_the_normal_comes_back_from_every_type_of_bag(tmp_path: Path, suffix: str) -> None:
    rng = np.random.default_rng(1)
    whole = recorded()
    scalar = replace(whole, contact_wrench_local=None, contact_force_normal=rng.normal(size=(len(whole), 2)))
    both = replace(whole, contact_force_normal=np.stack([rng.normal(size=len(whole)), np.full(len(whole), np.nan)], 1))
    for log in (scalar, both):
        topics = topics_of(log)
        path = tmp_path / f"x{suffix}"
        path.unlink(missing_ok=True)
        again = read_log(write_bag(path, entries_of(log)), parsed(topics))
        assert again.names == log.names
        assert again.arrays().keys() == log.arrays().keys()
        for name in ("contact_force_normal", "contact_active"):
            np.testing.assert_array_equal(again.arrays()[name], log.arrays()[name])
        (tmp_path / "robot.yaml").write_text(yaml.safe_dump({"logs": {"topics": topics}}))
        target = tmp_path / f"out{suffix}.npz"
        arguments = ["convert", str(path), str(target), "--topics", str(tmp_path / "robot.yaml"), "--overwrite"]
        assert main(arguments) == 0
        np.testing.assert_array_equal(read_log(target).contact_force_normal, log.contact_force_normal)


@pytest.mark.parametrize("kind", ["Float32MultiArray", "Float64MultiArray", "Int16MultiArray", "Int32MultiArray"])
def test_each_contact_is_a_place_in_an_array(tmp_path: Path, kind: str) -> None:
    dtype = kind.removesuffix("MultiArray").lower()
    entries = numbers(kind, FORCES.astype(dtype))
    topics = {foot: {"topic": "/foot_forces", "index": index} for index, foot in enumerate(FEET)}
    log = read_messages(tmp_path / "x.mcap", entries, contact_force_normal=topics, contact_force_threshold=11.5)
    assert log.contact_names == FEET
    np.testing.assert_array_equal(log.contact_force_normal, FORCES)
    assert value(log.contact_active).astype(int).T.tolist() == [[0, 0, 1, 1], [1, 1, 1, 1], [0, 0, 0, 1]]
    assert log.contact_wrench is None


def test_a_wrench_of_which_one_component_is_read_is_such_a_force(tmp_path: Path) -> None:
    values = np.arange(1.0, 7.0)
    stamped = [("/w", s, WRENCH, wrench(s, values, "pad")) for s in map(int, STAMPS)]
    plain = [
        ("/p", s, PLAIN_WRENCH, {"force": vector([4, 5, 6]), "torque": vector([0, 0, 0])}) for s in map(int, STAMPS)
    ]
    entries = joints_at(STAMPS) + stamped + plain
    assert force_of(tmp_path / "x.mcap", entries, topic="/w").tolist() == [3.0] * 4
    assert force_of(tmp_path / "x.mcap", entries, topic="/w", component="fx").tolist() == [1.0] * 4
    assert force_of(tmp_path / "x.mcap", entries, topic="/p", component="fy", sign=-1).tolist() == [-5.0] * 4


def test_contacts_of_every_kind_stand_beside_each_other(tmp_path: Path) -> None:
    """A wrench, a scalar, both on one foot, and a switch; forces say when a foot without a flag touches."""
    whole = [("/w", s, WRENCH, wrench(s, np.full(6, 7.0), "")) for s in map(int, STAMPS)]
    switch = [("/touch", int(1e9 * s), FLAG, {"data": x}) for s, x in ((50, False), (101, True))]
    log: Log = read_messages(
        tmp_path / "x.bag",
        numbers("Float64", FORCES[:, 0]) + whole + switch,
        contact_wrenches={"a": "/w", "b": "/w"},
        contact_force_normal={"b": "/foot_forces", "c": {"topic": "/foot_forces", "sign": -1}, "d": "/foot_forces"},
        contact_active={"d": "/touch", "e": True},
        contact_force_threshold=9.0,
        rate_topic="contact_force_normal.c",
    )
    assert log.contact_names == ("a", "b", "c", "d", "e")
    nan, up = np.full(4, np.nan), FORCES[:, 0]
    np.testing.assert_array_equal(value(log.contact_force_normal).T, [nan, up, -up, up, nan])
    assert np.isfinite(value(log.contact_wrench_local)).all(axis=(0, 2)).tolist() == [True, True, False, False, False]
    assert value(log.contact_active).astype(int).T.tolist() == [[1] * 4, [1] * 4, [0] * 4, [0, 1, 1, 1], [1] * 4]


@pytest.mark.parametrize(
    ("kind", "force", "message"),
    [
        ("Float32MultiArray", {}, "index: missing, but /foot_forces has std_msgs/msg/Float32MultiArray; "
         "accepted: the index of this contact's number, from 0 on"),
        ("Float32MultiArray", {"index": 3}, "an array of 3 numbers has no index 3; accepted: an index from 0 to 2"),
        ("Float32MultiArray", {"index": 0, "component": "fz"}, "FL.component: 'fz', but /foot_forces has"),
        ("Float32", {"index": 0}, "logs.topics.contact_force_normal.FL.index: 0, but /foot_forces has std"),
        ("Float32", {"component": "fx"}, "contact_force_normal.FL.component: 'fx', but /foot_forces has"),
        ("Bool", {}, "logs.topics.contact_force_normal.FL: /foot_forces has messages of std_msgs/msg/Bool; accepted: "
         "std_msgs/msg/Float32 or std_msgs/msg/Float64 or std_msgs/msg/Float32MultiArray"),
    ],
)  # fmt: skip
def test_what_is_no_force_is_refused_by_name(tmp_path: Path, kind: str, force: dict[str, Any], message: str) -> None:
    values = (
        FORCES.astype(np.float32) if kind.endswith("Array") else FORCES[:, 0] if kind != "Bool" else FORCES[:, 0] > 11.0
    )
    topics = {"FL": {"topic": "/foot_forces", **force}}
    found = refusal(
        tmp_path / "x.mcap", numbers(kind, values), contact_force_normal=topics, contact_active={"FL": True}
    )
    assert message in found


def test_a_contact_needs_something_that_says_when_it_touches(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="contact_force_threshold: missing: no contact flags for FL;"):
        read_messages(
            tmp_path / "x.mcap", numbers("Float32", FORCES[:, 0]), contact_force_normal={"FL": "/foot_forces"}
        )
    broken = FORCES[:, 0].copy()
    broken[2] = np.nan
    with pytest.raises(LogError, match="/foot_forces: the force is NaN in message 2"):
        read_messages(
            tmp_path / "x.mcap",
            numbers("Float64", broken),
            contact_force_normal={"FL": "/foot_forces"},
            contact_force_threshold=3.0,
        )


@pytest.mark.parametrize(
    ("force", "message"),
    [
        ({"topic": "/f", "index": -1}, "logs.topics.contact_force_normal.FL.index: found -1; accepted: "),
        ({"topic": "/f", "index": 1.0}, "logs.topics.contact_force_normal.FL.index: found 1.0; accepted: "),
        ({"topic": "/f", "component": "mz"}, "logs.topics.contact_force_normal.FL.component: found 'mz'; accepted: "),
        ({"topic": "/f", "sign": 2}, "logs.topics.contact_force_normal.FL.sign: found 2; accepted: 1 or -1"),
        ({"topic": "/f", "axis": "z"}, "logs.topics.contact_force_normal.FL: unknown name 'axis'; accepted: "),
        (3, "logs.topics.contact_force_normal.FL: found 3; accepted: a mapping with topic, index, component, sign"),
    ],
)
def test_a_map_that_is_none_is_refused_by_name(tmp_path: Path, force: Any, message: str) -> None:
    topics = {"joint_states": "/j", "contact_force_normal": {"FL": force}, "contact_active": {"FL": True}}
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump({"logs": {"topics": topics}}))
    with pytest.raises(ValueError, match="robot.yaml: ") as refused:
        load_topics(tmp_path / "robot.yaml")
    assert message in str(refused.value)
