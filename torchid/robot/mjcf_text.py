"""The text of an MJCF file with the files that it includes: where an element is, and what the elements are called."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from pathlib import Path

from lxml import etree

from torchid.errors import UrdfError
from torchid.robot.xml_files import read_xml

_MOST_FILES = 100
_LONGEST_TAG = 20  # lines
_MULTIPLYING = ("replicate", "attach", "composite", "flexcomp")


class MjcfText:
    """An MJCF file and all that it includes.

    `root` is one tree in which the included elements stand in place of `<include>`.
    """

    def __init__(self, path: Path) -> None:
        """Read the files.

        Raises:
            UrdfError: one of them is missing, or no well-formed XML, or there are too many.
        """
        self.path, self._files = path, dict[Path, etree._Element]()
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
        out, taken = list[str](), {name for _, name in joints}
        for body, name in joints:
            out.append(name or _unused(f"{named[body]}_joint", taken))
            taken.add(out[-1])
        return named, out

    def _expanded(self, path: Path, root: str) -> etree._Element:
        if len(self._files) >= _MOST_FILES:
            raise UrdfError(self.path, "<include>", f"more than {_MOST_FILES} files", "fewer")
        if path in self._files:
            raise UrdfError(self.path, "<include>", f"{path.name} more than once", "every file once")
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
        """The file that another includes: beside it, or else beside the main one."""
        beside = by.parent / file
        return beside if beside.is_file() else self.path.parent / file


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
    number, out = 2, name
    while out in taken:
        out, number = f"{name}_{number}", number + 1
    return out
