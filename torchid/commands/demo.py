"""`torchid demo`: the examples that ship with torchid, fitted where they lie or copied to be edited."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from torchid.commands.folder import EXAMPLES, new_folder
from torchid.commands.identify import identify
from torchid.commands.run_folder import Identification
from torchid.config import load_config
from torchid.errors import ConfigError, about_file

_PACKAGE = Path(__file__).parents[1]
EXPERIMENT = _PACKAGE / "demo" / "quadruped.yaml"
"""The experiment file that the demo fits."""

_EXAMPLES = ("demo/*", "examples/biped*")
"""What ships; `examples` is a link to `configs` of the repository, of which some files fit recordings that do not."""


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


def copy_examples(folder: Path) -> dict[Path, str]:
    """Copy the settings files that ship with torchid, with their robots and logs, to a new folder.

    Returns:
        The settings files, sorted by name, and the first line of each, which says what it is.

    Raises:
        ConfigError: something of that name exists, or no folder can be made there.
    """
    if os.path.lexists(folder):
        raise ConfigError(folder, "--copy", "exists", "a folder that does not exist yet")
    with new_folder(folder, kind=EXAMPLES) as copies:
        for file in (file for pattern in _EXAMPLES for file in _PACKAGE.glob(pattern)):
            shutil.copyfile(file, copies / file.name)
    return {file: file.read_text().partition("\n")[0].lstrip("# ") for file in sorted(folder.glob("*.yaml"))}
