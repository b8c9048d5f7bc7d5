"""Folders of results: claimed by one run at a time, created whole or not at all, replacing only what torchid wrote."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from torchid.commands.manifest import MANIFEST, FolderContents, FolderKind, inspect_folder, make_manifest, read_manifest
from torchid.errors import ConfigError, current_file, excerpt, join_names
from torchid.staging import CAN_LOCK, NEW, OLD, interrupts_deferred, leftovers, note_written, staging_folder, try_lock

CHECKPOINT, EVENTS = "checkpoint.pt", "events.out.tfevents*"
EVALUATION = FolderKind("an evaluation", replace="--overwrite")
RUN = FolderKind("a run", "evaluation", EVALUATION)
TRAINING = FolderKind("a training", result=False, growing=(CHECKPOINT, f".{CHECKPOINT}", EVENTS))
SIMULATION = FolderKind("a simulation")
ANALYSIS = FolderKind("an analysis")
STUDY = FolderKind("a study")
REPLAY = FolderKind("a replay", replace="--overwrite")
SAMPLES = FolderKind("samples", replace="--overwrite")
COMPRESSED = FolderKind("compressed logs")
EXAMPLES = FolderKind("examples")

_LONGEST_NAME = 200  # bytes; file systems take 255, and the temporary folder's name is longer
_TAKEN = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR)  # by another run
_TRIES = 100
_MOST_NAMES = 50  # in one message


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
        raise ConfigError(output, "output", f"no name for a folder ({error})", "a path to a new folder") from error
    if taken:
        found = "a link" if output.is_symlink() else "a file of this name exists"
        raise ConfigError(output, "output", found, "a folder that does not exist yet")
    if output.name in ("", ".."):
        raise ConfigError(output, "output", "no name for a folder", "a path to a new folder")
    if not (above.is_dir() and os.access(above, os.W_OK | os.X_OK)) or len(os.fsencode(output.name)) > _LONGEST_NAME:
        raise ConfigError(output, "output", f"no folder can be made there, in {above}", "a place that can be written")
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
        found = "a link" if os.path.islink(path) else "exists"
        raise ConfigError(path, field, found, f"a new file, or {option} in place of a file")
    if not os.path.isdir(path.parent):
        raise ConfigError(path, field, f"no folder {path.parent}", "a file in an existing folder")
    for other in inputs:
        one, of = os.path.realpath(path), os.path.realpath(str(other))
        if os.path.lexists(path) and (one == of or one.startswith(of + os.sep)):
            raise ConfigError(path, field, "is or belongs to what is read", "another file")


def refuse_link(folder: Path) -> None:
    """Make sure that a folder in which files are written and removed is none that lies elsewhere.

    Raises:
        ConfigError: it does.
    """
    if folder.is_symlink():
        raise ConfigError(folder, "output", "a link", "a folder, or none")


def refuse_inputs(output: Path, inputs: Iterable[object]) -> None:
    """Make sure that a folder which will be replaced or removed holds neither inputs nor `current_file`.

    Raises:
        ConfigError: it does.
    """
    top = os.path.realpath(output)
    for path in (current_file(), *inputs):
        target = os.path.realpath(str(path))
        if os.path.lexists(str(path)) and target.startswith(top + os.sep):
            found = f"holds {excerpt(os.path.relpath(target, top))}, which is an input"
            raise ConfigError(output, "output", found, "another output, or inputs that lie elsewhere")


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
    try:
        contents, names = inspect_folder(folder, kind), [excerpt(name) for name in sorted(os.listdir(folder))]
    except OSError as error:
        raise ConfigError(output, "output", f"cannot be read ({error})", "a new folder") from error
    if contents is None and (other := read_manifest(folder)):
        accepted = f"a new folder, or {kind.name} to overwrite"
        raise ConfigError(output, "output", f"holds {excerpt(other.kind)}", accepted)
    if contents is None:
        what = f"holds {join_names(names, _MOST_NAMES)}, and no {MANIFEST} that says that torchid wrote {kind.name}"
        accepted = f"a new folder, or {kind.name} to overwrite; one that an older version wrote is for you to remove"
        raise ConfigError(output, "output", what, accepted)
    unsafe = {"which torchid did not write": contents.foreign, "changed since torchid wrote it": contents.changed}
    complaints = [f"{join_names(paths, _MOST_NAMES)}, {what}" for what, paths in unsafe.items() if paths]
    closed = [str(path) for path in contents.folders if not os.access(path, os.W_OK | os.X_OK)]
    complaints += [f"{join_names(closed)}, where nothing can be removed"] if closed and not complaints else []
    if complaints:
        accepted = f"a new folder, or {kind.name} to overwrite; move elsewhere what is yours"
        raise ConfigError(output, "output", f"holds {' and '.join(complaints)}", accepted)
    return contents


def recover_leftovers(output: Path, kind: FolderKind) -> None:
    """Remove what killed processes left of folders that were to become `output`; what one had moved aside comes back.

    Raises:
        OSError: it cannot be moved back.
    """
    for folder in leftovers(output):
        if not os.path.lexists(folder / OLD):
            continue
        if not os.path.lexists(output):
            (folder / OLD).rename(output)
            continue
        if contents := inspect_folder(folder / OLD, kind):
            contents.remove()
        for path, _, _ in os.walk(folder / OLD, topdown=False):  # the process was killed after their manifests went
            with suppress(OSError):
                os.rmdir(path)


def write_json(path: Path, document: object) -> None:
    """Write strict JSON: a number that is not finite is an error, not a NaN in the file."""
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")


@contextmanager
def new_folder(
    output: Path, overwrite: bool = False, kind: FolderKind = RUN, growing: Sequence[str] = ()
) -> Iterator[Path]:
    """A temporary folder beside `output` that takes its place, with a manifest, when the block ends without an error.

    Of several at a time the first takes the place, or, with `overwrite`, the last.

    Args:
        output: the folder to be.
        overwrite: whether one of its kind may be replaced.
        kind: of the folder.
        growing: patterns of files in it that are written on later.

    Raises:
        ConfigError: `output` exists and may not be replaced, from the start or when the block has ended.
    """
    check_free(output, overwrite, kind)
    with _parent_folders(output), ExitStack() as stack:
        with _creation_errors_explained(output):
            folder = stack.enter_context(staging_folder(output))
            (folder / NEW).mkdir()
        yield folder / NEW
        make_manifest(folder / NEW, kind, output.name, growing).write(folder / NEW)
        with interrupts_deferred():
            _put(folder, output, overwrite, kind)
            if kind.result:
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
        found = f"no folder can be made there ({error.strerror})"
        raise ConfigError(output, "output", found, "a place that can be written") from error


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
    raise ConfigError(output, "output", "other runs take the place again and again", "another output")


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
    if not CAN_LOCK:
        yield
        return
    lock, handle = folder.with_name(f".{folder.name}.lock"), -1
    with _parent_folders(folder):
        try:
            with interrupts_deferred():
                handle = _locked(lock, folder)
            yield
        finally:
            with interrupts_deferred():
                if handle >= 0:
                    lock.unlink(missing_ok=True)
                    os.close(handle)


def _locked(lock: Path, folder: Path) -> int:
    """Descriptor of a file that no other process has locked; the system unlocks it when this one ends or is killed."""
    for _ in range(_TRIES):
        with _creation_errors_explained(folder):
            handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o644)
        if try_lock(handle, lock) is not False:  # None, no locks there: one run at a time is then the user's affair
            return handle
        os.close(handle)  # another has it, or has just removed it
    raise ConfigError(folder, "output", "another run is at work there", "another output, or patience")
