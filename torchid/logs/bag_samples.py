"""Some messages of every topic of a bag, for a proposed map of its topics."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchid.errors import TorchidError
from torchid.logs.containers import list_bag_files
from torchid.logs.ros_messages import make_deserializer
from torchid.logs.ros_read import list_channels, open_bag_file

#: Messages of a topic that are looked at, spread over all of the bag.
_MESSAGES = 500


@dataclass
class TopicSample:
    """A topic, and some of its messages where their type is known.

    Attributes:
        type: of the messages.
        messages: in the order of receipt.
        count: how many there are.
    """

    type: str
    messages: list[Any] = field(default_factory=list)
    count: int = 0


def read_bag_sample(path: Path, types: Collection[str]) -> dict[str, TopicSample]:
    """Every topic of a bag, and messages of those that have one of some types.

    Raises:
        LogError: the bag is damaged.
    """
    files = list_bag_files(path)
    channels = list_channels(files)
    raw: dict[str, list[bytes]] = {name: [] for name, channel in channels.items() if channel.type in types}
    counts, steps = dict.fromkeys(channels, 0), dict.fromkeys(channels, 1)
    for file in files:
        with open_bag_file(file) as opened:
            for record in opened.records(raw.keys()):
                name = record.topic
                if counts[name] % steps[name] == 0:
                    raw[name].append(record.data)
                    if len(raw[name]) > 2 * _MESSAGES:
                        raw[name], steps[name] = raw[name][::2], 2 * steps[name]
                counts[name] += 1
    out = {}
    with open_bag_file(files[0]):  # whose errors are those of deserializing, too
        for name, channel in channels.items():
            try:
                make = make_deserializer(name, channel)
                messages = [make(data) for data in raw.get(name, [])]
            except TorchidError:  # a serialization of others, which may be on a topic that nobody needs
                messages = []
            out[name] = TopicSample(channel.type, messages, counts[name])
    return out
