"""A run folder that appears complete or not at all."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchid.errors import ConfigError


def check_free(output: Path, overwrite: bool) -> None:
    """Make sure, before any work, that a run may be written.

    Raises:
        ConfigError: `output` exists and may not be replaced, or is no place for a folder.
    """
    if output.exists() and not output.is_dir():
        raise ConfigError(output, "output", "a file of this name exists", "a folder that does not exist yet")
    if output.is_dir() and any(output.iterdir()):
        if not overwrite:
            raise ConfigError(output, "output", "not empty", "a new folder, or overwrite=true")
        if not (output / "config.yaml").is_file():
            raise ConfigError(output, "output", "not empty and not a run folder", "a new folder, or a run to overwrite")


def write_json(path: Path, document: object) -> None:
    """Write strict JSON: a number that is not finite is an error, not a NaN in the file."""
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")


@contextmanager
def new_folder(output: Path, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder beside `output` that takes its place when the block ends without an error."""
    check_free(output, overwrite)
    output.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{output.name}-", dir=output.parent))
    temporary.chmod(0o755)
    try:
        yield temporary
        if output.exists():
            retired = Path(tempfile.mkdtemp(prefix=f".{output.name}-old-", dir=output.parent))
            output.rename(retired / "run")
            temporary.rename(output)
            shutil.rmtree(retired)
        else:
            temporary.rename(output)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
