"""The SQLite files of ROS 2 (.db3)."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path

from torchid.guards import MAX_RECORD, MAX_TOPICS, Budget
from torchid.logs.ros.storage import Channel, Record


class SqliteFile:
    """A .db3 file: tables of topics and messages, read without trusting what else a database can hold."""

    def __init__(self, path: Path) -> None:
        """Open the file, which may be on a read-only disk."""
        self._connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
        self._connection.execute("PRAGMA trusted_schema = OFF")
        self._connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_RECORD)
        self._size = path.stat().st_size
        for table in ("topics", "messages"):
            self._check_plain(table)

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def _check_plain(self, table: str) -> None:
        """Refuse what only looks like a table: a view or a computed column could go on forever."""
        query = "SELECT type, sql FROM sqlite_master WHERE name = ?"
        found = self._connection.execute(query, (table,)).fetchone()
        if found is None or found[0] != "table" or not str(found[1]).upper().startswith("CREATE TABLE"):
            raise ValueError(f"no table '{table}'")
        columns = self._connection.execute(f"PRAGMA table_xinfo({table})").fetchall()
        if any(hidden for *_, hidden in columns):
            raise ValueError(f"table '{table}' has computed columns")

    def channels(self) -> list[Channel]:
        """All topics."""
        rows = self._connection.execute("SELECT name, type, serialization_format FROM topics").fetchmany(MAX_TOPICS + 1)
        if len(rows) > MAX_TOPICS:
            raise ValueError(f"more than {MAX_TOPICS} topics")
        return [Channel(str(name), str(kind), str(encoding)) for name, kind, encoding in rows]

    def records(self, topics: Collection[str]) -> Iterator[Record]:
        """The messages of some topics."""
        names = dict(self._connection.execute("SELECT id, name FROM topics").fetchmany(MAX_TOPICS))
        budget = Budget(self._size)
        (total,) = self._connection.execute("SELECT count(*) FROM messages").fetchone()
        rows = self._connection.execute("SELECT topic_id, timestamp, data FROM messages")
        for i, (topic, received, data) in enumerate(rows):
            budget.record()
            if names.get(topic) not in topics:
                continue
            budget.message()
            if not (isinstance(received, int) and isinstance(data, bytes) and len(data) <= MAX_RECORD):
                raise ValueError(f"message {i} has no time or no data")
            yield Record(names[topic], received, data, i / total)
