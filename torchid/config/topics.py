"""The topic map of an experiment file, read without the rest of the file."""

from __future__ import annotations

from pathlib import Path

from pydantic.dataclasses import dataclass

from torchid.config.reading import FileKind, Settings, load
from torchid.config.types import STRICT
from torchid.logs.ros.topics import Topics, check_topics


@dataclass(config=STRICT, frozen=True)
class _Logs:
    topics: Topics


@dataclass(config=STRICT, frozen=True)
class _TopicsFile:
    logs: _Logs


def _topics_alone(settings: Settings, _: Settings) -> Settings:
    """The settings without all that is not `logs.topics`."""
    logs = settings.get("logs")
    return {"logs": {key: x for key, x in logs.items() if key == "topics"} if isinstance(logs, dict) else {}}


JOINTS_ACCEPTED = "the name of a topic, or a mapping with topic and joints"
"""What a message says of the one topic that every bag needs."""

_KIND = FileKind(
    settings=_TopicsFile,
    name="experiment",
    keys="logs.topics",
    list_example="logs.topics.joint_states.joints=[l_knee]",
    prepare=_topics_alone,
    accepted={"logs.topics.joint_states": JOINTS_ACCEPTED},
)


def load_topics(path: str | Path) -> Topics:
    """Read what the topics of a bag hold from an experiment file, whatever else it says or leaves out.

    Raises:
        ConfigError: unreadable file, no `logs.topics`, a value of the wrong kind.
        UnknownNameError: a key that does not exist; the message names the nearest that do.
    """
    topics = load(_KIND, Path(path)).logs.topics
    check_topics(path, topics)
    return topics
