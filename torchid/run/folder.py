"""A run folder that appears complete or not at all."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from torchid.errors import ConfigError


@dataclass(frozen=True)
class FolderKind:
    """What a folder that may be overwritten holds: a file that tells its kind, and patterns of the other names.

    `name`: with its article, as in "a run".
    """

    name: str
    mark: str
    others: tuple[str, ...]

    def foreign(self, names: Sequence[str]) -> list[str]:
        """Those of the names that are no part of such a folder."""
        own = (self.mark, *self.others)
        return sorted(name for name in names if not any(fnmatch(name, pattern) for pattern in own))


_FIGURES = ("forces.png", "errors.png", "parameters.png", "identifiability.png", "contributions.png")
_RESULTS = ("parameters.json", "metrics.json", "identified.urdf", *_FIGURES)
EVENTS = "events.out.tfevents*"
RUN = FolderKind("a run", "config.yaml", (*_RESULTS, "hparams", "evaluation", EVENTS))
TRAINING = FolderKind("a training", "config.yaml", ("checkpoint.pt", ".checkpoint.pt", EVENTS))
SIMULATION = FolderKind("a simulation", "simulation.yaml", ("logs", "exact", "nominal.urdf", "stability.json"))
ANALYSIS = FolderKind(
    "an analysis", "analysis.json", ("config.yaml", "base_parameters.txt", "sensors-*.png", "accuracy.png")
)
STUDY = FolderKind("a study", "results.json", ("tables.txt", "rms.png", "forces.png", "projected.png", "tensorboard"))

_LONGEST_NAME = 200  # bytes; file systems take 255, and the temporary folder's name is longer


def check_free(output: Path, overwrite: bool, kind: FolderKind = RUN) -> None:
    """Make sure, before any work, that a folder of a kind may be written.

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
    foreign = kind.foreign(names)
    if names and (foreign or kind.mark not in names):
        what = f"no part of {kind.name}" if foreign else f"not {kind.name} folder"
        found = f"holds {', '.join(foreign[:3])}, {what}" if foreign else f"not empty and {what}"
        raise ConfigError(output, "output", found, f"a new folder, or {kind.name} to overwrite")


def write_json(path: Path, document: object) -> None:
    """Write strict JSON: a number that is not finite is an error, not a NaN in the file."""
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")


@contextmanager
def new_folder(output: Path, overwrite: bool = False, kind: FolderKind = RUN) -> Iterator[Path]:
    """A temporary folder beside `output` that takes its place when the block ends without an error."""
    check_free(output, overwrite, kind)
    made = [folder for folder in (output.parent, *output.parent.parents) if not folder.exists()]
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
        if not output.exists():
            with suppress(OSError):  # another run has put something there meanwhile
                for folder in made:
                    folder.rmdir()
