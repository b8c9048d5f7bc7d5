"""A run folder that appears complete or not at all."""

from __future__ import annotations

import errno
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
from torchid.interrupts import interrupt_held_back, note_written


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


_FIGURES = ("forces.png", "errors.png", "parameters.png", "identifiability.png", "contributions.png", "extras.png")
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
_TAKEN = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR)  # by another run
_TRIES = 100


def check_free(output: Path, overwrite: bool, kind: FolderKind = RUN) -> None:
    """Make sure, before any work, that a folder of a kind may be written.

    Raises:
        ConfigError: `output` exists and may not be replaced, or is no place for a folder.
    """
    try:
        names = [path.name for path in output.iterdir()] if output.is_dir() else []
        above = next(path for path in output.absolute().parents if path.exists())
        taken = output.is_symlink() or (output.exists() and not output.is_dir())
    except (OSError, ValueError) as error:
        raise ConfigError(output, "output", f"no name for a folder ({error})", "a path to a new folder") from error
    if taken:
        found = "a link" if output.is_symlink() else "a file of this name exists"
        raise ConfigError(output, "output", found, "a folder that does not exist yet")
    if output.name in ("", ".."):
        raise ConfigError(output, "output", "no name for a folder", "a path to a new folder")
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
    """A temporary folder beside `output` that takes its place when the block ends without an error.

    Of several at a time the first takes the place, or, with `overwrite`, the last.

    Raises:
        ConfigError: `output` exists and may not be replaced, from the start or when the block has ended.
    """
    check_free(output, overwrite, kind)
    temporary: Path | None = None
    with parents_of(output):
        try:
            with interrupt_held_back():
                temporary = _temporary(output)
            yield temporary
            with interrupt_held_back():
                _put(temporary, output, overwrite, kind)
                note_written(output)
        finally:
            with interrupt_held_back():
                if temporary is not None:
                    shutil.rmtree(temporary, ignore_errors=True)


def remove_folder(folder: Path) -> None:
    """Remove a folder, which keeps its name no longer than it is whole."""
    if not folder.exists():
        return
    with interrupt_held_back():
        retired = _temporary(folder)
        try:
            folder.rename(retired / "old")
        finally:
            shutil.rmtree(retired, ignore_errors=True)


@contextmanager
def parents_of(output: Path) -> Iterator[None]:
    """The folders above `output`, which go with the block if they came with it and it leaves nothing in them."""
    made = [folder for folder in (output.parent, *output.parent.parents) if not folder.exists()]
    try:
        with interrupt_held_back(), creating(output):
            output.parent.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        with interrupt_held_back(), suppress(OSError):  # a run is in it, this one or another
            for folder in made:
                folder.rmdir()


@contextmanager
def creating(output: Path) -> Iterator[None]:
    """Say in one line that something cannot be made beside `output`."""
    try:
        yield
    except OSError as error:
        found = f"no folder can be made there ({error.strerror})"
        raise ConfigError(output, "output", found, "a place that can be written") from error


def _temporary(output: Path) -> Path:
    """A new folder beside `output` whose name nobody takes for a run's."""
    with creating(output):
        temporary = Path(tempfile.mkdtemp(prefix=f".{output.name}-", dir=output.parent))
    temporary.chmod(0o755)
    return temporary


def _put(temporary: Path, output: Path, overwrite: bool, kind: FolderKind) -> None:
    """Rename the temporary folder; what stood there, perhaps another run that ended meanwhile, is replaced whole."""
    retired: list[Path] = []
    try:
        for _ in range(_TRIES):
            if _renamed(temporary, output):
                return
            check_free(output, overwrite, kind)
            with suppress(FileNotFoundError):  # taken away by another that replaces it
                retired.append(_temporary(output))
                output.rename(retired[-1] / "run")
        raise ConfigError(output, "output", "other runs take the place again and again", "another output")
    except BaseException:
        for aside in reversed(retired):
            with suppress(OSError):
                (aside / "run").rename(output)
        raise
    finally:
        for aside in retired:
            shutil.rmtree(aside, ignore_errors=True)


def _renamed(folder: Path, name: Path) -> bool:
    """Whether the name was free, or that of an empty folder."""
    try:
        folder.rename(name)
    except OSError as error:
        if error.errno in _TAKEN:
            return False
        raise
    return True
