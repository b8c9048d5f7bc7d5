"""Folders of results: created whole or not at all; a manifest lists what torchid wrote, and nothing else is removed."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from torchid.errors import ConfigError, current_file, excerpt, join_names
from torchid.staging import NEW, OLD, interrupts_deferred, leftovers, lock, note_written, staging_folder, take_over

MANIFEST = "manifest.json"
CHECKPOINT = "checkpoint.pt"
EVENTS = "events.out.tfevents*"
EVALUATIONS = "evaluation"
"""The folder in that of a run which holds its evaluations."""


@dataclass(frozen=True)
class FolderKind:
    """What a folder that torchid writes holds.

    Attributes:
        name: with its article, as in "a run".
        replace: what lets its command replace one that exists: a key of the experiment file, or an option.
        growing: patterns of names of files in it that are written after its manifest.
    """

    name: str
    replace: str = "overwrite=true"
    growing: tuple[str, ...] = ()


EVALUATION = FolderKind("an evaluation", "--overwrite")
RUN = FolderKind("a run")
TRAINING = FolderKind("a training", growing=(CHECKPOINT, f".{CHECKPOINT}", EVENTS))
SIMULATION = FolderKind("a simulation")
ANALYSIS = FolderKind("an analysis")
STUDY = FolderKind("a study")
REPLAY = FolderKind("a replay", "--overwrite")
SAMPLES = FolderKind("samples", "--overwrite")
COMPRESSED = FolderKind("compressed logs")
EXAMPLES = FolderKind("examples")

_LONGEST_NAME = 200  # bytes; file systems take 255, and the temporary folder's name is longer
_TAKEN = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR)  # by another run
_TRIES = 100
_MOST_NAMES = 50  # in one message
_MAX_MANIFEST_BYTES = 2**24  # that of 100 000 files
_PLACE = "a folder with write permission"


# ------------------------------------------------------------------------------------------------------- what is there


def file_checksum(*paths: Path) -> str:
    """SHA-256 of a file, or of several one after the other."""
    digest = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            while block := file.read(2**20):
                digest.update(block)
    return digest.hexdigest()


@dataclass(frozen=True)
class Manifest:
    """Kind and name of a folder, and the SHA-256 of each file in it, by its path in the folder."""

    kind: str
    folder: str
    files: dict[str, str]

    def write(self, folder: Path) -> None:
        """Write it into its folder. Raises OSError: it cannot be written."""
        files = {name: {"sha256": checksum} for name, checksum in self.files.items()}
        text = json.dumps({"torchid": self.kind, "folder": self.folder, "files": files}, indent=1)
        new = folder / f".{MANIFEST}"
        new.write_text(text + "\n")
        new.replace(folder / MANIFEST)


def read_manifest(folder: Path) -> Manifest | None:
    """The manifest of a folder, None if it has none of torchid's."""
    path = folder / MANIFEST
    try:
        state = os.lstat(path)
        if not stat.S_ISREG(state.st_mode) or state.st_size > _MAX_MANIFEST_BYTES:
            return None
        document: Any = json.loads(path.read_bytes())
        files = {str(name): str(entry["sha256"]) for name, entry in document["files"].items()}
        return Manifest(str(document["torchid"]), str(document["folder"]), files)
    except (OSError, ValueError, TypeError, LookupError, AttributeError, RecursionError):  # anything may be in it
        return None


@dataclass
class FolderContents:
    """What is in a folder.

    Attributes:
        files: as torchid wrote them, the manifest last.
        folders: that hold them, the innermost first.
        foreign: names of all others.
        changed: names of files that torchid wrote and somebody changed since.
    """

    files: list[Path] = field(default_factory=list)
    folders: list[Path] = field(default_factory=list)
    foreign: list[str] = field(default_factory=list)
    changed: list[str] = field(default_factory=list)

    def remove(self) -> None:
        """Remove torchid's files, and the folders that are empty then; what the system refuses to remove stays."""
        for path in self.files:
            with suppress(OSError):
                path.unlink()
        for path in self.folders:
            with suppress(OSError):
                path.rmdir()


def inspect_folder(folder: Path, kind: FolderKind) -> FolderContents | None:
    """What in a folder torchid wrote and what it did not, links among it; None if torchid wrote none of this kind."""
    manifest = read_manifest(folder)
    if manifest is None or manifest.kind != kind.name:
        return None
    contents = FolderContents()
    _inspect(folder, "", manifest, kind, contents)
    return contents


def _inspect(top: Path, above: str, manifest: Manifest, kind: FolderKind, contents: FolderContents) -> None:
    """Add what is in a folder at a path relative to the top, and the folder."""
    for path in sorted((top / above).iterdir()):
        name = f"{above}/{path.name}" if above else path.name
        for _ in take_over(path):  # what a killed process left
            pass
        if not os.path.lexists(path) or name == MANIFEST:
            continue
        mode = os.lstat(path).st_mode
        inner = read_manifest(path) if kind == RUN and above == EVALUATIONS and stat.S_ISDIR(mode) else None
        if inner is not None and (inner.kind, inner.folder) == (EVALUATION.name, path.name):
            inside = inspect_folder(path, EVALUATION) or FolderContents()
            contents.files += inside.files
            contents.folders += inside.folders
            contents.foreign += [f"{name}/{x}" for x in inside.foreign]
            contents.changed += [f"{name}/{x}" for x in inside.changed]
        elif stat.S_ISDIR(mode):
            is_listed = any(file.startswith(f"{name}/") for file in manifest.files)
            if is_listed or (kind == RUN and name == EVALUATIONS):
                _inspect(top, name, manifest, kind, contents)
            else:
                contents.foreign.append(excerpt(f"{name}/"))
        elif stat.S_ISREG(mode) and name in manifest.files:
            is_unchanged = file_checksum(path) == manifest.files[name]
            contents.files.append(path) if is_unchanged else contents.changed.append(excerpt(name))
        elif stat.S_ISREG(mode) and any(fnmatchcase(name, pattern) for pattern in (f".{MANIFEST}", *kind.growing)):
            contents.files.append(path)
        else:
            contents.foreign.append(excerpt(name))
    contents.files += [] if above else [top / MANIFEST]
    contents.folders.append(top / above)


# ------------------------------------------------------------------------------------------------ what may be written


def check_free(output: Path, overwrite: bool, kind: FolderKind = RUN, inputs: Iterable[object] = ()) -> None:
    """Make sure, before any work, that a folder of a kind may be written; leftovers of killed processes go first.

    Args:
        output: the folder.
        overwrite: whether one of its kind may be replaced.
        kind: what it will be.
        inputs: files and folders that the command reads.

    Raises:
        ConfigError: `output` exists and may not be replaced, or is no place for a folder.
    """
    try:
        recover_leftovers(output, kind)
        names = os.listdir(output) if output.is_dir() else []
        above = next(path for path in output.absolute().parents if path.exists())
        taken = output.is_symlink() or (output.exists() and not output.is_dir())
    except (OSError, ValueError) as error:
        raise ConfigError(output, "output", f"not a folder name ({error})", "a path to a new folder") from error
    if taken:
        reason = "a link" if output.is_symlink() else "a file of this name exists"
        raise ConfigError(output, "output", reason, "a folder that does not exist yet")
    if output.name in ("", ".."):
        raise ConfigError(output, "output", "not a folder name", "a path to a new folder")
    if not (above.is_dir() and os.access(above, os.W_OK | os.X_OK)) or len(os.fsencode(output.name)) > _LONGEST_NAME:
        raise ConfigError(output, "output", f"cannot create a folder in {above}", _PLACE)
    if names and not overwrite:
        raise ConfigError(output, "output", "not empty", f"a new folder, or {kind.replace}")
    if names:
        refuse_inputs(output, inputs)
        require_replaceable(output, kind)


def check_free_file(
    path: Path, field: str, overwrite: bool, inputs: Iterable[object], option: str = "--overwrite"
) -> None:
    """Make sure, before any work, that a file may be written.

    Args:
        path: of the file.
        field: of the command line, or argument, that names it.
        overwrite: whether a file there may be replaced.
        inputs: files and folders that the command reads.
        option: what sets `overwrite`.

    Raises:
        ConfigError: it exists and may not be replaced, or there is no folder for it.
    """
    if os.path.lexists(path) and not (overwrite and os.path.isfile(path) and not os.path.islink(path)):
        reason = "a link" if os.path.islink(path) else "exists"
        raise ConfigError(path, field, reason, f"a new file, or {option} to replace a file")
    if not os.path.isdir(path.parent):
        raise ConfigError(path, field, f"the folder {path.parent} does not exist", "a file in an existing folder")
    target = os.path.realpath(path)
    for other in inputs:
        read = os.path.realpath(str(other))
        if os.path.lexists(path) and (target == read or target.startswith(read + os.sep)):
            raise ConfigError(path, field, "this is an input, or in an input folder", "another file")


def refuse_link(folder: Path) -> None:
    """Refuse a link as a folder in which files are written and removed. Raises ConfigError: it is one."""
    if folder.is_symlink():
        raise ConfigError(folder, "output", "a link", "a folder that is not a link")


def refuse_inputs(output: Path, inputs: Iterable[object]) -> None:
    """Make sure that a folder which will be replaced or removed holds neither inputs nor `current_file`.

    Raises:
        ConfigError: it does.
    """
    top = os.path.realpath(output)
    for path in (current_file(), *inputs):
        target = os.path.realpath(str(path))
        if os.path.lexists(str(path)) and target.startswith(top + os.sep):
            reason = f"contains the input {excerpt(os.path.relpath(target, top))}"
            raise ConfigError(output, "output", reason, "another output, or inputs in another folder")


def require_replaceable(folder: Path, kind: FolderKind, output: Path | None = None) -> FolderContents:
    """Contents of a folder in which torchid wrote every file.

    Args:
        folder: to be replaced or removed.
        kind: that it should be of.
        output: its name in messages, if another.

    Raises:
        ConfigError: something in it is not torchid's, or has changed since.
    """
    output = output or folder
    accepted = f"a new folder, or {kind.name} to overwrite"
    try:
        contents = inspect_folder(folder, kind)
        names = [excerpt(name) for name in sorted(os.listdir(folder))]
    except OSError as error:
        raise ConfigError(output, "output", f"cannot be read ({error})", "a new folder") from error
    if contents is None and (other := read_manifest(folder)):
        raise ConfigError(output, "output", f"contains {excerpt(other.kind)}", accepted)
    if contents is None:
        reason = f"contains {join_names(names, _MOST_NAMES)}, but no {MANIFEST} of {kind.name}"
        raise ConfigError(output, "output", reason, accepted)
    unsafe = {"not written by torchid": contents.foreign, "changed since torchid wrote it": contents.changed}
    complaints = [f"{join_names(paths, _MOST_NAMES)} ({what})" for what, paths in unsafe.items() if paths]
    closed = [str(path) for path in contents.folders if not os.access(path, os.W_OK | os.X_OK)]
    complaints += [f"{join_names(closed)} (no write permission)"] if closed and not complaints else []
    if complaints:
        reason = f"contains {' and '.join(complaints)}"
        raise ConfigError(output, "output", reason, f"{accepted}; move your own files first")
    return contents


# ------------------------------------------------------------------------------------------------------------- writing


def write_json(path: Path, document: object) -> None:
    """Write strict JSON: a number that is not finite is an error, not a NaN in the file."""
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")


def recover_leftovers(output: Path, kind: FolderKind) -> None:
    """Remove what killed processes left of folders that were to become `output`; what one had moved aside comes back.

    Raises:
        OSError: it cannot be moved back.
    """
    for folder in leftovers(output):
        old = folder / OLD
        if os.path.lexists(old) and not os.path.lexists(output):
            old.rename(output)
        elif os.path.lexists(old):
            contents = inspect_folder(old, kind)
            if contents is not None:
                contents.remove()
            for path, _, _ in os.walk(old, topdown=False):  # the process was killed after their manifests went
                with suppress(OSError):
                    os.rmdir(path)


@contextmanager
def new_folder(output: Path, overwrite: bool = False, kind: FolderKind = RUN) -> Iterator[Path]:
    """A temporary folder beside `output` that takes its place, with a manifest, when the block ends without an error.

    Of several at a time the first takes the place, or, with `overwrite`, the last.

    Args:
        output: the folder to be.
        overwrite: whether one of its kind may be replaced.
        kind: of the folder.

    Raises:
        ConfigError: `output` exists and may not be replaced, from the start or when the block has ended.
    """
    check_free(output, overwrite, kind)
    with _parent_folders(output), ExitStack() as stack:
        with _creation_errors_explained(output):
            folder = stack.enter_context(staging_folder(output))
            (folder / NEW).mkdir()
        yield folder / NEW
        files = {
            path.relative_to(folder / NEW).as_posix(): file_checksum(path)
            for path in sorted((folder / NEW).rglob("*"))
            if path.is_file()
        }
        Manifest(kind.name, output.name, files).write(folder / NEW)
        with interrupts_deferred():
            _put(folder, output, overwrite, kind)
            if kind != TRAINING:
                note_written(output)


@contextmanager
def _parent_folders(output: Path) -> Iterator[None]:
    """The folders above `output`, which go with the block if they came with it and it leaves nothing in them."""
    made = [folder for folder in (output.parent, *output.parent.parents) if not folder.exists()]
    try:
        with interrupts_deferred(), _creation_errors_explained(output):
            output.parent.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        with interrupts_deferred(), suppress(OSError):  # a run is in it, this one or another
            for folder in made:
                folder.rmdir()


@contextmanager
def _creation_errors_explained(output: Path) -> Iterator[None]:
    """Turn an OSError into a ConfigError: nothing can be created beside `output`."""
    try:
        yield
    except OSError as error:
        raise ConfigError(output, "output", f"cannot create a folder there ({error.strerror})", _PLACE) from error


def _put(folder: Path, output: Path, overwrite: bool, kind: FolderKind) -> None:
    """Rename the new folder in a staging folder; what stood there, perhaps another run that ended meanwhile, goes."""
    for _ in range(_TRIES):
        if _renamed(folder / NEW, output):
            return
        check_free(output, overwrite, kind)
        try:
            output.rename(folder / OLD)
        except FileNotFoundError:  # taken away by another that replaces it
            continue
        except OSError as error:
            raise ConfigError(output, "output", f"cannot be replaced ({error.strerror})", "a new folder") from error
        try:
            contents = require_replaceable(folder / OLD, kind, output)  # moved aside, it cannot change any more
            done = _renamed(folder / NEW, output)
        except BaseException:
            with suppress(OSError):
                (folder / OLD).rename(output)
            raise
        contents.remove()
        if done:
            return
    raise ConfigError(output, "output", "other runs keep writing there", "another output")


def _renamed(folder: Path, name: Path) -> bool:
    """Whether the name was free, or that of an empty folder."""
    try:
        folder.rename(name)
    except OSError as error:
        if error.errno in _TAKEN:
            return False
        raise
    return True


@contextmanager
def claim_folder(folder: Path) -> Iterator[None]:
    """Keep other processes that claim it from a folder that need not be there yet, until the block or this one ends.

    Raises:
        ConfigError: another process is at work there.
    """
    path = folder.with_name(f".{folder.name}.lock")
    with _parent_folders(folder):
        with interrupts_deferred(), _creation_errors_explained(folder):
            try:
                handle = lock(path, os.O_RDWR | os.O_CREAT)
            except (BlockingIOError, FileNotFoundError) as error:
                accepted = "another output, or wait until it ends"
                raise ConfigError(folder, "output", "another run is writing there", accepted) from error
        try:
            yield
        finally:
            with interrupts_deferred():
                path.unlink(missing_ok=True)
                os.close(handle)
