"""Small tables that are read by a map of columns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from dialects import save_csv

from torchid.logs import Columns, Log, read_log

TIME = [0.0, 0.1, 0.2]
PLAIN: dict[str, Any] = {"time": TIME, "q_0": [1.0, 2.0, 3.0], "q_1": [4.0, 5.0, 6.0]}
ORDER = "joint_order: [hip, knee]\n"
POSITION = ORDER + 'joint_position: "q_{index}"\n'


def mapped(folder: Path, text: str, **columns: Any) -> Log:
    """A table of three samples read by a map; columns that are None are left out, `__` stands for a dot."""
    table = PLAIN | {name.replace("__", "."): x for name, x in columns.items()}
    path = save_csv(folder / "x.csv", {name: x for name, x in table.items() if x is not None})
    return read_log(path, columns=Columns(**yaml.safe_load(text)))
