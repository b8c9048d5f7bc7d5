"""Maps of topics and columns in an experiment file, read for themselves: `torchid check` and `convert` need no more."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from pydantic.dataclasses import dataclass

from torchid.config.reading import FileKind, Settings, load
from torchid.errors import about_file
from torchid.logs import Columns, Topics
from torchid.logs.column_map import check_columns
from torchid.logs.ros_topics import check_topics
from torchid.logs.unitree import JOINT_ORDERS
from torchid.settings import STRICT

_ORDER = f"a list of names, or a robot: {', '.join(JOINT_ORDERS)}"
MAPS_ACCEPTED = {
    **{f"logs.columns.{kind}_order": _ORDER for kind in ("joint", "contact")},
    **{f"logs.columns.{key}": "a list of names" for key in ("sensor_order", "ignore")},
    "logs.columns.other_times": "a list of entries like time: [{column: stamp, unit: ms}]",
    "logs.columns.plates": "poses by contact: {l_foot: {position: [0.3, 0.2, 0], rpy_deg: [180, 0, 90]}}",
    "logs.columns.*": "the name of a column, a pattern such as {joint}_q, or a mapping with column, unit, scale, ...",
    "logs.topics.joint_states": "the name of a topic, or a mapping with topic and joints",
    "logs.topics.other_joint_states": "a list of entries like joint_states: [/arms/joint_states]",
    "logs.topics.low_state": "a mapping with topic and robot, or joints by number of the motor",
}
"""Accepted for entries of maps, in messages, where their types alone say too little."""

T = TypeVar("T")


@dataclass(config=STRICT, frozen=True)
class _TopicsOfLogs:
    topics: Topics


@dataclass(config=STRICT, frozen=True)
class _TopicsFile:
    logs: _TopicsOfLogs


@dataclass(config=STRICT, frozen=True)
class _ColumnsOfLogs:
    columns: Columns


@dataclass(config=STRICT, frozen=True)
class _ColumnsFile:
    logs: _ColumnsOfLogs


def _kind(settings: type[T], key: str, example: str) -> FileKind[T]:
    """An experiment file of which one key of `logs` counts."""

    def prepare(settings: Settings, _: Settings) -> Settings:
        logs = settings.get("logs")
        return {"logs": {name: x for name, x in logs.items() if name == key} if isinstance(logs, dict) else {}}

    name, keys, example = "experiment", f"logs.{key}", f"logs.{key}.{example}"
    return FileKind(
        settings=settings, name=name, keys=keys, list_example=example, prepare=prepare, accepted=MAPS_ACCEPTED
    )


_TOPICS = _kind(_TopicsFile, "topics", "joint_states.joints=[l_knee]")
_COLUMNS = _kind(_ColumnsFile, "columns", "joint_order=[l_knee]")


def load_topics(path: str | Path) -> Topics:
    """Read `logs.topics` from an experiment file, whatever its other keys are.

    Raises:
        ConfigError: unreadable file, no `logs.topics`, a value of the wrong kind.
        UnknownNameError: a key that does not exist; the message names the nearest that do.
    """
    topics = load(_TOPICS, Path(path)).logs.topics
    with about_file(path):
        check_topics(topics)
    return topics


def load_columns(path: str | Path) -> Columns:
    """Read `logs.columns` from an experiment file, as `load_topics` does `logs.topics`."""
    columns = load(_COLUMNS, Path(path)).logs.columns
    with about_file(path):
        check_columns(columns)
    return columns
