"""A look at a COLLADA file before it is read: entities and nodes in nodes may make a few kilobytes into gigabytes."""

from __future__ import annotations

import io

from lxml import etree

_USE = 2**15  # bytes that each use of a shape counts as, for the time it takes


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
