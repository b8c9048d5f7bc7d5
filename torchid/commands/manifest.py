"""Manifests of folders: which files torchid wrote, so that replacing removes no others."""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any

from torchid.errors import excerpt
from torchid.staging import atomic_file, is_leftover, remove_leftover

MANIFEST = "manifest.json"

_BLOCK = 2**20  # bytes of a file that are read at a time
_LARGEST = 2**24  # bytes of a manifest: those of 100 000 files


def file_checksum(*paths: Path) -> str:
    """SHA-256 of a file, or of several one after the other."""
    digest = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            while block := file.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()


@dataclass(frozen=True)
class FolderKind:
    """What a folder that torchid writes holds.

    Attributes:
        name: with its article, as in "a run".
        inner_folder: name of a folder in it that holds folders of another kind, with manifests of their own.
        inner_kind: their kind.
        result: whether it is what a command answers with, not a state on the way there.
        replace: what lets its command replace one that exists: a key of the experiment file, or an option.
        growing: patterns of names of files in it that may be written on after its manifest.
    """

    name: str
    inner_folder: str = ""
    inner_kind: FolderKind | None = None
    result: bool = True
    replace: str = "overwrite=true"
    growing: tuple[str, ...] = ()


@dataclass(frozen=True)
class Manifest:
    """The manifest of a folder.

    Attributes:
        kind: name of the kind of folder.
        folder: its name.
        files: size [bytes] and SHA-256 of each file, by its path in the folder, with slashes.
        growing: patterns of names of files that were still being written, which have no checksum, if its kind has such.
    """

    kind: str
    folder: str
    files: dict[str, tuple[int, str]]
    growing: tuple[str, ...] = ()

    @cached_property
    def folders(self) -> set[str]:
        """Folders that hold its files."""
        return {"/".join(name.split("/")[:k]) for name in self.files for k in range(1, name.count("/") + 1)}

    def write(self, folder: Path) -> None:
        """Write it into its folder, whole or not at all. Raises OSError: it cannot be written."""
        files = {name: {"size": size, "sha256": checksum} for name, (size, checksum) in self.files.items()}
        document = {"torchid": self.kind, "folder": self.folder, "files": files, "growing": self.growing}
        with atomic_file(folder / MANIFEST, result=False) as new:
            new.write_text(json.dumps(document, indent=1) + "\n")


@dataclass
class FolderContents:
    """What is in a folder.

    Attributes:
        own: files as torchid wrote them, the manifest last.
        folders: folders that hold them, the innermost first.
        foreign: names of all others.
        changed: names of files that torchid wrote and somebody changed since.
        leftovers: what killed processes left of files they did not finish.
    """

    own: list[Path] = field(default_factory=list)
    folders: list[Path] = field(default_factory=list)
    foreign: list[str] = field(default_factory=list)
    changed: list[str] = field(default_factory=list)
    leftovers: list[Path] = field(default_factory=list)

    def remove(self) -> None:
        """Remove the own files, and the folders that are empty then; what the system refuses to remove stays."""
        for path in self.leftovers:
            remove_leftover(path)
        for path in self.own:
            with suppress(OSError):
                path.unlink()
        for path in self.folders:
            with suppress(OSError):
                path.rmdir()


def make_manifest(folder: Path, kind: FolderKind, name: str, growing: Sequence[str] = ()) -> Manifest:
    """The manifest of a folder that holds nothing but torchid's files.

    Args:
        folder: the folder.
        kind: of it.
        name: that it has or will have.
        growing: patterns of files in it that are written on.
    """
    files = {
        path.relative_to(folder).as_posix(): (path.stat().st_size, file_checksum(path))
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path != folder / MANIFEST
    }
    return Manifest(kind.name, name, files, tuple(growing))


def read_manifest(folder: Path) -> Manifest | None:
    """The manifest of a folder, None if it has none of torchid's."""
    path = folder / MANIFEST
    try:
        state = os.lstat(path)
        if not stat.S_ISREG(state.st_mode) or state.st_size > _LARGEST:
            return None
        document: Any = json.loads(path.read_bytes())
        return Manifest(
            str(document["torchid"]),
            str(document["folder"]),
            {str(name): (int(x["size"]), str(x["sha256"])) for name, x in document["files"].items()},
            tuple(map(str, document["growing"])),
        )
    except (
        OSError,
        ValueError,
        TypeError,
        LookupError,
        AttributeError,
        ArithmeticError,
        RecursionError,
    ):  # anything may be in it
        return None


def inspect_folder(folder: Path, kind: FolderKind, name: str | None = None) -> FolderContents | None:
    """What in a folder torchid wrote and what it did not; no link is followed.

    Args:
        folder: the folder, not a link.
        kind: of folder that it should be.
        name: that it should have had from the start; None: any.

    Returns:
        None: no folder of this kind that torchid wrote.
    """
    manifest = read_manifest(folder)
    if manifest is None or manifest.kind != kind.name or name not in (None, manifest.folder):
        return None
    contents = FolderContents()
    _look(folder, "", manifest, kind, contents)
    contents.own.append(folder / MANIFEST)
    contents.folders.append(folder)
    return contents


def _look(top: Path, relative: str, manifest: Manifest, kind: FolderKind, contents: FolderContents) -> None:
    """Add what is in the folder at a path relative to the top."""
    for name, path in [(name, top / relative / name) for name in sorted(os.listdir(top / relative))]:
        inner = f"{relative}/{name}" if relative else name
        mode = os.lstat(path).st_mode
        if stat.S_ISDIR(mode):
            _look_into(top, inner, manifest, kind, contents)
        elif inner in manifest.files and stat.S_ISREG(mode):
            same = _is(path, *manifest.files[inner])
            contents.own.append(path) if same else contents.changed.append(excerpt(inner))
        elif stat.S_ISREG(mode) and not relative and _grows(name, manifest.growing) and _grows(name, kind.growing):
            contents.own.append(path)
        elif inner != MANIFEST:
            contents.foreign.append(excerpt(inner))


def _grows(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def _look_into(top: Path, relative: str, manifest: Manifest, kind: FolderKind, contents: FolderContents) -> None:
    path, above = top / relative, relative.rpartition("/")[0]
    if is_leftover(path):
        contents.leftovers.append(path)
    elif kind.inner_kind is not None and above == kind.inner_folder:
        inside = inspect_folder(path, kind.inner_kind, path.name)
        if inside is None:
            contents.foreign.append(excerpt(f"{relative}/"))
            return
        contents.own += inside.own
        contents.folders += inside.folders
        contents.leftovers += inside.leftovers
        contents.foreign += [f"{relative}/{name}" for name in inside.foreign]
        contents.changed += [f"{relative}/{name}" for name in inside.changed]
    elif relative in manifest.folders or relative == kind.inner_folder:
        _look(top, relative, manifest, kind, contents)
        contents.folders.append(path)
    else:
        contents.foreign.append(excerpt(f"{relative}/"))


def _is(path: Path, size: int, checksum: str) -> bool:
    """Whether a file still is what was written."""
    return path.stat().st_size == size and file_checksum(path) == checksum
