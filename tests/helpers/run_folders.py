"""Folders of results, and what else may lie in them."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.commands.folder import (
    EVALUATION,
    new_folder,
)

Add = Callable[[Path], None]


def write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def a_run(output: Path, text: str = "old") -> Path:
    """A folder as a run leaves it, with an evaluation."""
    with new_folder(output, overwrite=True) as folder:
        write(folder, {"config.yaml": text, "metrics.json": text, "hparams/events": text})
    with new_folder(output / "evaluation" / "log", True, EVALUATION) as folder:
        write(folder, {"metrics.json": text})
    return output


def everything(folder: Path) -> dict[str, tuple[bytes, str]]:
    """All files and folders, with what is in them or where they point to."""
    return {
        str(path.relative_to(folder)): (
            path.read_bytes() if path.is_file() and not path.is_symlink() else b"",
            os.readlink(path) if path.is_symlink() else "",
        )
        for path in folder.rglob("*")
    }


def names_in(folder: Path) -> list[str]:
    """What is in a folder."""
    return sorted(path.name for path in folder.iterdir())


def document(run: Path, name: str) -> dict[str, Any]:
    """One of the JSON files of a run: parameters, metrics, report."""
    return dict(json.loads((run / f"{name}.json").read_text()))


def identified(run: Path) -> NDArray[np.float64]:
    """Parameters (L, 12) that a run has found."""
    bodies = document(run, "parameters")["bodies"]
    return np.array([[*body["identified"].values()] for body in bodies])
