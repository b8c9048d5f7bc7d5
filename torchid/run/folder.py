"""A run folder that appears complete or not at all."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchid.errors import ConfigError

_FILES = ("config.yaml", "parameters.json", "metrics.json", "identified.urdf")
_OWN = {*_FILES, "forces.png", "errors.png", "parameters.png", "hparams", "evaluation"}
_LONGEST_NAME = 200  # bytes; file systems take 255, and the temporary folder's name is longer


def check_free(output: Path, overwrite: bool) -> None:
    """Make sure, before any work, that a run may be written.

    Raises:
        ConfigError: `output` exists and may not be replaced, or is no place for a folder.
    """
    try:
        names = [path.name for path in output.iterdir()] if output.is_dir() else []
        above = next(path for path in output.absolute().parents if path.exists())
        taken = output.exists() and not output.is_dir()
    except (OSError, ValueError) as error:
        raise ConfigError(output, "output", f"no name for a folder ({error})", "a path to a new folder") from error
    if taken:
        raise ConfigError(output, "output", "a file of this name exists", "a folder that does not exist yet")
    if not (above.is_dir() and os.access(above, os.W_OK | os.X_OK)) or len(os.fsencode(output.name)) > _LONGEST_NAME:
        raise ConfigError(output, "output", f"no folder can be made there, in {above}", "a place that can be written")
    if names and not overwrite:
        raise ConfigError(output, "output", "not empty", "a new folder, or overwrite=true")
    foreign = sorted(name for name in names if name not in _OWN and not name.startswith("events.out.tfevents"))
    if names and (foreign or "config.yaml" not in names):
        found = f"holds {', '.join(foreign[:3])}, no part of a run" if foreign else "not empty and not a run folder"
        raise ConfigError(output, "output", found, "a new folder, or a run to overwrite")


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
            try:
                temporary.rename(output)
            except BaseException:
                (retired / "run").rename(output)
                raise
            finally:
                shutil.rmtree(retired, ignore_errors=True)
        else:
            temporary.rename(output)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
