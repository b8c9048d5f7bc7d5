"""`torchid demo`: the examples that ship with torchid, fitted where they lie or copied to be edited."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from torchid.commands.folder import EXAMPLES, new_folder
from torchid.commands.identify import identify
from torchid.commands.results import Identification
from torchid.config import load_config
from torchid.errors import ConfigError, about_file

EXPERIMENT = Path(__file__).parents[1] / "demo" / "quadruped.yaml"
"""The experiment file that the demo fits."""


def run_demo(overrides: Sequence[str] = (), output: str | None = None) -> Identification:
    """Identify the demo's quadruped; nothing is written where torchid is installed.

    Args:
        overrides: `key.subkey=value`, as of `torchid identify`.
        output: the run folder, relative to the working folder; that of the experiment file without it.

    Raises:
        InputError: as `identify`.
    """
    config = load_config(EXPERIMENT, overrides, {"output": output} if output is not None else None)
    with about_file(EXPERIMENT):
        return identify(config)


def copy_examples(folder: Path) -> list[Path]:
    """Copy the experiment files that ship with torchid, with their robots and logs, to a new folder.

    Returns:
        The files, sorted by name.

    Raises:
        ConfigError: something of that name exists, or no folder can be made there.
    """
    if os.path.lexists(folder):
        raise ConfigError(folder, "--copy", "exists", "a folder that does not exist yet")
    with new_folder(folder, kind=EXAMPLES) as copies:
        for file in EXPERIMENT.parent.iterdir():
            shutil.copyfile(file, copies / file.name)
        names = sorted(file.name for file in copies.iterdir())
    return [folder / name for name in names]
