"""Mesh files that a URDF names: where they may lie, how large they may be, and what a COLLADA file unfolds to."""

from __future__ import annotations

import io
import os
from pathlib import Path, PurePosixPath

from lxml import etree

from torchid.guards import MAX_LINE, MAX_MESH, MAX_PARTS, MAX_UNFOLDED, format_bytes, read_bytes
from torchid.text import excerpt, is_plain

FORMATS = ("stl", "obj", "dae", "ply", "off")
_PART = {"obj": b"usemtl"}
_USE = 2**15  # bytes that each use of a shape counts as, for the time it takes


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
        raise MeshError(f"{excerpt(filename)}: none of {', '.join(FORMATS)}")
    try:
        content = read_bytes(path, MAX_MESH)
        if kind == "dae":
            check_collada(content, MAX_UNFOLDED)
    except (OSError, ValueError, etree.XMLSyntaxError, RecursionError) as error:
        raise MeshError(f"{excerpt(filename)}: {type(error).__name__}: {excerpt(str(error))}") from error
    if kind in _PART and content.lower().count(_PART[kind]) > MAX_PARTS:
        raise MeshError(f"{excerpt(filename)}: more than {MAX_PARTS} parts")
    if kind == "obj" and max(map(len, content.splitlines()), default=0) > MAX_LINE:
        raise MeshError(f"{excerpt(filename)}: a line of more than {format_bytes(MAX_LINE)}")
    return kind, content


def _mesh_file(urdf: Path, filename: str) -> Path:
    """The file that a URDF's author meant: in its package, or, as `package://NAME/...`, in one beside it.

    The package is the nearest folder above the URDF with a `package.xml`, or else the one above the URDF's own. Links
    in it are followed: workspaces are made of them.
    """
    if not is_plain(filename):
        raise MeshError(f"{excerpt(filename)}: no name of a file")
    package = _package(urdf)
    scheme, _, rest = filename.rpartition("://")
    if scheme not in ("", "file", "package"):
        raise MeshError(f"{excerpt(filename)}: neither a file nor in a package")
    candidates = _in_packages(urdf, package, rest) if scheme == "package" else _in_package(urdf, package, rest)
    try:
        found = next((path for path in candidates if path.is_file()), None)
    except OSError as error:
        raise MeshError(f"{excerpt(filename)}: {error.strerror}") from error
    if found is not None:
        return found
    outside = scheme != "package" and not candidates
    raise MeshError(f"{excerpt(filename)}: {f'outside {package}' if outside else 'no such file'}")


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


def check_collada(content: bytes, largest: int) -> None:
    """Refuse a document type, which may declare entities, and shapes that unfold to more than `largest` bytes.

    Raises:
        ValueError, etree.XMLSyntaxError, RecursionError: what was found.
    """
    first = etree.iterparse(io.BytesIO(content), events=("start",), resolve_entities=False, no_network=True)
    _, root = next(first)  # no document type can follow; and none was expanded, for the parser has its limits
    if root.getroottree().docinfo.doctype:
        raise ValueError("a document type, which meshes need not have")
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, huge_tree=True
    )  # large arrays, as pycollada reads
    size = _Unfolded(etree.parse(io.BytesIO(content), parser).getroot()).size()
    if size > largest:
        raise ValueError(f"shapes of {size} bytes, each as often as it is used")


class _Unfolded:
    """How much text the shapes of a document have, each counted as often as nodes use it."""

    def __init__(self, root: etree._Element) -> None:
        self._root = root
        self._shapes = {
            "#" + str(shape.get("id")): sum(map(len, shape.itertext())) for shape in root.iter("{*}geometry")
        }
        self._nodes = {"#" + str(node.get("id")): node for node in root.iter("{*}node")}
        self._sizes: dict[etree._Element, int] = {}

    def size(self) -> int:
        """Of all scenes."""
        return sum(self._of(scene, set()) for scene in self._root.iter("{*}visual_scene"))

    def _of(self, above: etree._Element, open_: set[etree._Element]) -> int:
        if above in open_:
            raise ValueError("a node within itself")
        if above not in self._sizes:
            inner = open_ | {above}
            total = sum(_USE + self._shapes.get(str(x.get("url")), 0) for x in above.findall("{*}instance_geometry"))
            total += sum(self._of(node, inner) for node in above.findall("{*}node"))
            used = [self._nodes.get(str(x.get("url"))) for x in above.findall("{*}instance_node")]
            self._sizes[above] = total + sum(self._of(node, inner) for node in used if node is not None)
        return self._sizes[above]
