"""Reading of the XML files that describe robots: bounded in size, nothing resolved or fetched."""

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
        tree = etree.parse(io.BytesIO(content), etree.XMLParser(resolve_entities=False, no_network=True))
    except (etree.XMLSyntaxError, ValueError, LookupError) as error:
        found = excerpt(getattr(error, "msg", None) or str(error), 200)
        raise UrdfError(path, "XML", f"not well-formed: {found}", f"a well-formed {kind}") from error
    tag = str(tree.getroot().tag)
    if root != "" and tag not in ([root] if root else ROOTS):
        raise UrdfError(path, "XML root", f"<{excerpt(tag)}>", f"<{root}>" if root else "<robot>, or <mujoco> of MJCF")
    return tree


def file_kind(path: Path) -> str:
    """What a robot's file is: one of the values of `ROOTS`.

    Raises:
        UrdfError: as `read_xml`.
    """
    return ROOTS[str(read_xml(path).getroot().tag)]


def is_mjcf(path: Path) -> bool:
    """Whether a robot's file is MJCF rather than a URDF.

    Raises:
        UrdfError: as `read_xml`.
    """
    return file_kind(path) == ROOTS["mujoco"]
