"""Mesh files that a URDF names: where they may lie, and how large they may be."""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath

from lxml import etree

from torchid.guards import MAX_LINE, MAX_MESH, MAX_PARTS, MAX_UNFOLDED, in_mebibytes, read_bytes
from torchid.robot.collada import check_collada
from torchid.text import is_plain, shown

FORMATS = ("stl", "obj", "dae", "ply", "off")
_PART = {"obj": b"usemtl"}


class MeshError(Exception):
    """A mesh file that is missing, lies elsewhere, or cannot be read."""


def mesh_content(urdf: Path, filename: str) -> tuple[str, bytes]:
    """Format and content of a mesh that a URDF names, safe to give to a reader of that format.

    Raises:
        MeshError: one line that names the file.
    """
    path = _mesh_file(urdf, filename)
    kind = path.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise MeshError(f"{shown(filename)}: none of {', '.join(FORMATS)}")
    try:
        content = read_bytes(path, MAX_MESH)
        if kind == "dae":
            check_collada(content, MAX_UNFOLDED)
    except (OSError, ValueError, etree.XMLSyntaxError, RecursionError) as error:
        raise MeshError(f"{shown(filename)}: {type(error).__name__}: {shown(str(error))}") from error
    if kind in _PART and content.lower().count(_PART[kind]) > MAX_PARTS:
        raise MeshError(f"{shown(filename)}: more than {MAX_PARTS} parts")
    if kind == "obj" and max(map(len, content.splitlines()), default=0) > MAX_LINE:
        raise MeshError(f"{shown(filename)}: a line of more than {in_mebibytes(MAX_LINE)}")
    return kind, content


def _mesh_file(urdf: Path, filename: str) -> Path:
    """The file that a URDF's author meant: in its package, or, as `package://NAME/...`, in one beside it.

    The package is the nearest folder above the URDF with a `package.xml`, or else the one above the URDF's own. Links
    in it are followed: workspaces are made of them.
    """
    if not is_plain(filename):
        raise MeshError(f"{shown(filename)}: no name of a file")
    package = _package(urdf)
    scheme, _, rest = filename.rpartition("://")
    if scheme not in ("", "file", "package"):
        raise MeshError(f"{shown(filename)}: neither a file nor in a package")
    candidates = _in_packages(urdf, package, rest) if scheme == "package" else _in_package(urdf, package, rest)
    try:
        found = next((path for path in candidates if path.is_file()), None)
    except OSError as error:
        raise MeshError(f"{shown(filename)}: {error.strerror}") from error
    if found is not None:
        return found
    outside = scheme != "package" and not candidates
    raise MeshError(f"{shown(filename)}: {f'outside {package}' if outside else 'no such file'}")


def _package(urdf: Path) -> Path:
    folders = urdf.absolute().parents
    marked = next((folder for folder in folders if (folder / "package.xml").is_file()), None)
    return marked or (folders[1] if len(folders) > 2 else folders[0])  # and not the root of all files


def _in_package(urdf: Path, package: Path, name: str) -> list[Path]:
    """Places that a path may mean, from the URDF's folder upwards, as far as they are in the package."""
    folders = [folder for folder in urdf.absolute().parents if folder.is_relative_to(package)]
    paths = [Path(os.path.normpath(folder / name)) for folder in folders]
    return [path for path in paths if path.is_relative_to(package)]


def _in_packages(urdf: Path, package: Path, name: str) -> list[Path]:
    """Places that `package://name` may mean: a package above the URDF, one beside its own, or its own renamed."""
    parts = PurePosixPath(name.lstrip("/")).parts
    if not parts or ".." in parts:
        return []
    above = [folder.parent for folder in urdf.absolute().parents if folder.name == parts[0]]
    beside = [] if package.parent == package.parent.parent else [package.parent]
    own = _in_package(urdf, package, str(PurePosixPath(*parts[1:])))
    return [*(folder.joinpath(*parts) for folder in (*above, *beside)), *own]
