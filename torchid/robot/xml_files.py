"""XML documents that describe robots: read within bounds, with nothing resolved or fetched; made plain URDFs.

Of MJCF, too: a file with all that it includes, and where elements stand in it.
"""

from __future__ import annotations

import copy
import io
from collections.abc import Iterator, Sequence
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


_MOST_FILES = 100  # that MJCF includes
_LONGEST_TAG = 20  # lines
_MULTIPLYING = ("replicate", "attach", "composite", "flexcomp")


class MjcfText:
    """An MJCF file and all that it includes.

    `root` is one tree in which the included elements stand in place of `<include>`.
    """

    def __init__(self, path: Path) -> None:
        """Read the files. Raises UrdfError: one of them is missing, or no well-formed XML, or there are too many."""
        self.path = path
        self._files = dict[Path, etree._Element]()
        self.root = self._expanded(path, "mujoco")

    @property
    def multiplies(self) -> bool:
        """Whether MuJoCo makes bodies that no element of its own stands for."""
        return any(True for _ in self.root.iter(*_MULTIPLYING))

    def where(self, tag: str, name: str, line: int, refers_to: Sequence[str] = ()) -> str:
        """Line of an element, ", line 12 of arm.xml", with the file if it is an included one; "" if it is not found.

        Args:
            tag: of the element.
            name: "" for none.
            line: by MuJoCo, which knows it of the main file alone, or 0.
            refers_to: names in its attributes.
        """
        for file, root in self._files.items():
            for element in root.iter(tag):
                at = element.sourceline or 0  # where the start tag ends, which may go over several lines
                is_near = 0 <= at - line <= _LONGEST_TAG if line else set(refers_to) <= set(element.attrib.values())
                if (element.get("name") or "") == name and is_near and not _is_default(element):
                    return f", line {line or at}" + ("" if file == self.path else f" of {file.name}")
        return f", line {line}" if line else ""

    def names(self, bodies: Sequence[str], joints: Sequence[tuple[int, str]]) -> tuple[list[str], list[str]]:
        """Names of bodies and joints by their numbers, made up where they have none.

        Args:
            bodies: names or "", depth first, the world first.
            joints: number of the body that each moves, and name or "".
        """
        named = list(bodies)
        for number, name in enumerate(bodies):
            named[number] = name or _unused(f"body{number}", {*named, *bodies})
        out = list[str]()
        taken = {name for _, name in joints}
        for body, name in joints:
            out.append(name or _unused(f"{named[body]}_joint", taken))
            taken.add(out[-1])
        return named, out

    def _expanded(self, path: Path, root: str) -> etree._Element:
        if len(self._files) >= _MOST_FILES:
            raise UrdfError(self.path, "<include>", f"more than {_MOST_FILES} files", "fewer")
        if path in self._files:
            raise UrdfError(self.path, "<include>", f"{path.name} is included twice", "every file once")
        self._files[path] = read_xml(path, root).getroot()
        out = copy.deepcopy(self._files[path])
        for include in list(out.iter("include")):
            parent = include.getparent()
            if parent is None:
                continue
            inner = self._expanded(self._included(path, str(include.get("file", ""))), "")
            at = parent.index(include)
            parent[at : at + 1] = list(inner)
        return out

    def _included(self, by: Path, file: str) -> Path:
        """The file that another includes: beside it, or else beside the main one; UrdfError where there is none."""
        included = next((path for path in (by.parent / file, self.path.parent / file) if path.is_file()), None)
        if included is None:
            accepted = f"a file beside {' or '.join(dict.fromkeys((by.name, self.path.name)))}"
            raise UrdfError(by, "<include>", f"'{excerpt(file)}' does not exist", accepted)
        return included


def body_elements(root: etree._Element) -> list[tuple[etree._Element, list[etree._Element]]]:
    """Elements of the bodies of a model, depth first, each with those of its joints; the world is the first.

    That is the order in which MuJoCo numbers them; frames do not count.
    """
    out: list[tuple[etree._Element, list[etree._Element]]] = [(etree.Element("worldbody"), [])]
    for world in root.findall("worldbody"):
        _collect(world, out[0][1], out)
    return out


def _collect(
    element: etree._Element, joints: list[etree._Element], out: list[tuple[etree._Element, list[etree._Element]]]
) -> None:
    bodies = []
    for child in _through_frames(element):
        if child.tag in ("joint", "freejoint"):
            joints.append(child)
        else:
            bodies.append(child)
    for body in bodies:
        out.append((body, []))
        _collect(body, out[-1][1], out)


def _through_frames(element: etree._Element) -> Iterator[etree._Element]:
    """Bodies and joints of an element, those in frames too, in order."""
    for child in element.iterchildren("body", "joint", "freejoint", "frame"):
        if child.tag == "frame":
            yield from _through_frames(child)
        else:
            yield child


def _is_default(element: etree._Element) -> bool:
    return any(above.tag == "default" for above in element.iterancestors())


def _unused(name: str, taken: set[str]) -> str:
    number = 2
    out = name
    while out in taken:
        out = f"{name}_{number}"
        number = number + 1
    return out
