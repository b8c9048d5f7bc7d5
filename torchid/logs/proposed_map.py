"""What a map of columns, or of topics, may say of a log, before somebody has looked at it."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

from torchid.logs.column_groups import Family
from torchid.logs.column_map import PLACEHOLDER

_PART = re.compile(r"\[\d*:\d*\]$")  # columns of an array


@dataclass
class MapProposal:
    """What `logs.columns`, or `logs.topics`, may say of a log.

    Attributes:
        columns: the map, as it stands in a file.
        notes: what was guessed, by key.
        left_out: columns that it ignores.
        not_numbers: of these those that are no numbers, but texts or lists of several lengths.
        key: columns or topics.
        fields: of the log, that a map of topics gives.
        lacking: joints of the robot without columns, if most have some.
        partial: by field that is left out for it, joints that have columns of other fields alone.
        like_torques: columns that no field takes, one for each joint, of a log without torques.
    """

    columns: dict[str, Any] = field(default_factory=dict)
    not_numbers: list[str] = field(default_factory=list)
    key: str = "columns"
    fields: set[str] = field(default_factory=set)
    notes: dict[str, str] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    lacking: list[str] = field(default_factory=list)
    partial: dict[str, list[str]] = field(default_factory=dict)
    like_torques: list[Family] = field(default_factory=list)

    def leave_out(self, name: str) -> None:
        """Ignore the columns of an entry instead of reading them, but for those that are a part of an array."""
        entry = self.columns.pop(name)
        texts = entry["columns"].values() if "columns" in entry else [entry["column"]]
        patterns = {PLACEHOLDER.sub("*", text) for text in texts if not _PART.search(text)}
        if ignored := sorted({*self.columns.pop("ignore", []), *patterns}):
            self.columns["ignore"] = ignored
