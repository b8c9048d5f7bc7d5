"""XML documents that describe robots: read within bounds, with nothing resolved or fetched; made plain URDFs."""

from __future__ import annotations

import io
from pathlib import Path

from lxml import etree

from torchid.errors import UrdfError, excerpt
from torchid.guards import MAX_URDF, format_bytes, read_bytes

ROOTS = {"robot": "URDF", "mujoco": "MJCF"}
"""What a file with such a root is."""


OWN = "{torchid}"
"""Namespace of attributes, in the documents of MJCF robots, of what a URDF cannot say."""

MJCF_WORLD = "world"
"""Name that MuJoCo gives the body to which all others are bolted that do not move freely."""


def read_xml(path: Path, root: str | None = None) -> etree._ElementTree:
    """The XML tree of a robot's file; entities stay unresolved and nothing is fetched.

    Prefixes that no xmlns declares, as in the `drake:acceleration` of many URDFs, are taken for parts of names, as the
    parsers of ROS and MuJoCo do, which know no namespaces.

    Args:
        path: the file.
        root: tag that its root must have, "" for any, as of a part that MJCF includes; None: one of `ROOTS`.

    Raises:
        UrdfError: the file is missing or is not well-formed XML with such a root.
    """
    kind = ROOTS.get(root or "", "URDF")
    try:  # read first: given a path, libxml2 would decompress files without bounds
        content = read_bytes(path, MAX_URDF)
    except FileNotFoundError as error:
        raise UrdfError(path, "file", "no such file", f"a readable {kind} file") from error
    except OSError as error:
        raise UrdfError(path, "file", f"cannot be read ({error.strerror})", f"a readable {kind} file") from error
    except ValueError as error:
        accepted = f"a {kind} of at most {format_bytes(MAX_URDF)}"
        raise UrdfError(path, "file", f"cannot be read ({error})", accepted) from error
    try:
        tree = _parse(content)
    except (etree.XMLSyntaxError, ValueError, LookupError) as error:
        reason = excerpt(getattr(error, "msg", None) or str(error), 200)
        raise UrdfError(path, "XML", f"not well-formed: {reason}", f"a well-formed {kind}") from error
    tag = str(tree.getroot().tag)
    if root != "" and tag not in ([root] if root else ROOTS):
        raise UrdfError(path, "XML root", f"<{excerpt(tag)}>", f"<{root}>" if root else "<robot>, or <mujoco> of MJCF")
    return tree


def _parse(content: bytes) -> etree._ElementTree:
    parser = etree.XMLParser(resolve_entities=False, no_network=True)
    try:
        return etree.parse(io.BytesIO(content), parser)
    except etree.XMLSyntaxError:
        if any(error.type != etree.ErrorTypes.NS_ERR_UNDEFINED_NAMESPACE for error in parser.error_log):
            raise
    return etree.parse(io.BytesIO(content), etree.XMLParser(resolve_entities=False, no_network=True, recover=True))


def drop_prefixed(root: etree._Element) -> None:
    """Drop elements and attributes below a root whose names have a prefix that nothing declares."""
    for element in list(root.iter(etree.Element)):
        for name in [name for name in element.attrib if _is_prefixed(str(name))]:
            del element.attrib[name]
        for child in [child for child in element if _is_prefixed(str(child.tag))]:
            element.remove(child)


def _is_prefixed(name: str) -> bool:
    return ":" in name and not name.startswith("{")


def file_kind(path: Path) -> str:
    """What a robot's file is: one of the values of `ROOTS`. Raises UrdfError: as `read_xml`."""
    return ROOTS[str(read_xml(path).getroot().tag)]


def is_mjcf(path: Path) -> bool:
    """Whether a robot's file is MJCF rather than a URDF. Raises UrdfError: as `read_xml`."""
    return file_kind(path) == ROOTS["mujoco"]


def plain_urdf(root: etree._Element) -> None:
    """Make a URDF of a document that may have attributes of torchid's own, whose armatures, springs and loops it loses.

    A joint about an anchor off its link's origin gets a link without mass, to which that one is welded.
    """
    names = {element.get("name") for element in root.iter("link", "joint")}
    for joint in root.findall("joint"):
        child = joint.find("child")
        offset = None if child is None else child.attrib.pop(f"{OWN}xyz", None)
        if child is not None and offset is not None:
            name = f"{joint.get('name')}_anchor"
            link = str(child.get("link"))
            if name in names:
                raise UrdfError("", f"joint '{joint.get('name')}'", f"a link or joint '{name}'", "another name")
            child.set("link", name)
            root.append(etree.Element("link", name=name))
            weld = etree.SubElement(root, "joint", name=f"{name}_fixed", type="fixed")
            etree.SubElement(weld, "origin", xyz=str(offset), rpy="0 0 0")
            etree.SubElement(weld, "parent", link=name)
            etree.SubElement(weld, "child", link=link)
        for dynamics in joint.findall("dynamics"):
            for key in [key for key in dynamics.attrib if str(key).startswith(OWN)]:
                del dynamics.attrib[key]
    for loop in root.findall(f"{OWN}loop"):
        root.remove(loop)
    etree.cleanup_namespaces(root)
