"""Mesh files: which one a URDF names, and its corners, read by trimesh (only here) in a process with limits."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from torchid.errors import InputError, excerpt, is_plain
from torchid.guards import MAX_NUMBER, MAX_POINTS
from torchid.reader import open_apart

MESH_FORMATS = ("stl", "obj", "dae", "ply", "off")
_SAMPLE_POINTS = 20_000  # points whose convex hull is computed first
_MAX_HULL_SHARE = 0.1  # largest share of hull vertices among all points at which a mesh is replaced by its hull


class MeshError(Exception):
    """A mesh file that is missing, outside the package, or cannot be read."""


class Meshes:
    """The meshes that a URDF names, each read once."""

    def __init__(self, urdf: Path) -> None:
        """Start without any mesh; `urdf` is the file that names them."""
        self.urdf = urdf
        self._read: dict[str, NDArray[np.float64] | MeshError] = {}
        self._points_left = MAX_POINTS

    def vertices(self, filename: str) -> NDArray[np.float64]:
        """The corners of a mesh, or of its convex hull where these are few, (N, 3) [m].

        Raises:
            MeshError: the mesh cannot be read, or all shapes together have too many points.
        """
        if filename not in self._read:
            try:
                self._read[filename] = _vertices(self.urdf, filename)
            except MeshError as error:
                self._read[filename] = error
        vertices = self._read[filename]
        if isinstance(vertices, MeshError):
            raise vertices
        self._points_left -= len(vertices)
        if self._points_left < 0:
            raise MeshError(f"{excerpt(filename)}: all shapes together have more than {MAX_POINTS} points")
        return vertices


def _vertices(urdf: Path, filename: str) -> NDArray[np.float64]:
    path = mesh_path(urdf, filename)
    if _format(path) not in MESH_FORMATS:
        raise MeshError(f"{excerpt(filename)}: unknown format; known are {', '.join(MESH_FORMATS)}")
    try:
        with open_apart(_open_mesh, path) as mesh:
            vertices: NDArray[np.float64] = mesh.call("vertices")
    except InputError as error:
        raise MeshError(f"{excerpt(filename)}: {error.found}") from error
    except Exception as error:  # noqa: B902 - readers of different formats raise different errors
        raise MeshError(f"{excerpt(filename)}: {type(error).__name__}: {excerpt(str(error))}") from error
    if vertices.shape[1:] != (3,) or not len(vertices):
        raise MeshError(f"{excerpt(filename)}: no vertices")
    if not np.isfinite(vertices).all() or np.abs(vertices).max() > MAX_NUMBER:
        raise MeshError(f"{excerpt(filename)}: vertices are not finite, or beyond {MAX_NUMBER:g}")
    return vertices


def _format(path: Path) -> str:
    return path.suffix.lower().removeprefix(".")


@contextmanager
def _open_mesh(path: Path) -> Iterator[_Mesh]:
    yield _Mesh(path)


class _Mesh:
    """A mesh in the process that reads it."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def vertices(self) -> NDArray[np.float64]:
        """Vertices (N, 3) [m], in the unit that the file states, if any; other files that it names are not read."""
        import trimesh

        content = io.BytesIO(self._path.read_bytes())
        with np.errstate(all="ignore"):
            mesh = trimesh.load(content, _format(self._path), force="mesh", process=False, skip_materials=True)
            units = getattr(mesh, "units", None)
            unit = trimesh.units.unit_conversion(units, "meters") if units else 1.0
            vertices = np.asarray(getattr(mesh, "vertices", ()), dtype=np.float64)
            return _hull_vertices(vertices * unit)


def _hull_vertices(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vertices of a mesh's convex hull, (K, 3), if they are much fewer than all its points; else all."""
    try:
        for sample in (points[:: max(1, len(points) // _SAMPLE_POINTS)], points):
            hull = ConvexHull(sample).vertices
            if len(hull) > _MAX_HULL_SHARE * len(sample):
                return points
    except (QhullError, ValueError):  # flat, fewer than four, or not finite, which is refused later
        return points
    return np.asarray(points[hull])


def mesh_path(urdf: Path, filename: str) -> Path:
    """The mesh file that a URDF refers to: in its package or, as `package://NAME/...`, in one beside it.

    The package is the nearest folder above the URDF with a `package.xml`, or else the parent of the URDF's folder.
    Symbolic links in it are followed: workspaces use them.

    Raises:
        MeshError: there is none.
    """
    if not is_plain(filename):
        raise MeshError(f"{excerpt(filename)}: not a file name")
    package = _package_folder(urdf)
    scheme, _, name = filename.rpartition("://")
    if scheme not in ("", "file", "package"):
        raise MeshError(f"{excerpt(filename)}: unknown kind of address")
    candidates = (
        _paths_of_package_url(urdf, package, name) if scheme == "package" else _paths_in_package(urdf, package, name)
    )
    try:
        file = next((path for path in candidates if path.is_file()), None)
    except OSError as error:
        raise MeshError(f"{excerpt(filename)}: {error.strerror}") from error
    if file is not None:
        return file
    outside = scheme != "package" and not candidates
    raise MeshError(f"{excerpt(filename)}: {f'outside {package}' if outside else 'no such file'}")


def _package_folder(urdf: Path) -> Path:
    folders = urdf.absolute().parents
    marked = next((folder for folder in folders if (folder / "package.xml").is_file()), None)
    return marked or (folders[1] if len(folders) > 2 else folders[0])  # never the root of the file system


def _paths_in_package(urdf: Path, package: Path, name: str) -> list[Path]:
    """Candidates for a relative path: in the URDF's folder and those above it, inside the package."""
    folders = [folder for folder in urdf.absolute().parents if folder.is_relative_to(package)]
    paths = [Path(os.path.normpath(folder / name)) for folder in folders]
    return [path for path in paths if path.is_relative_to(package)]


def _paths_of_package_url(urdf: Path, package: Path, name: str) -> list[Path]:
    """Candidates for `package://name`: a package above the URDF, one beside its own, or its own renamed."""
    parts = PurePosixPath(name.lstrip("/")).parts
    if not parts or ".." in parts:
        return []
    above = [folder.parent for folder in urdf.absolute().parents if folder.name == parts[0]]
    beside = [] if package.parent == package.parent.parent else [package.parent]
    inside = _paths_in_package(urdf, package, str(PurePosixPath(*parts[1:])))
    return [*(folder.joinpath(*parts) for folder in (*above, *beside)), *inside]
