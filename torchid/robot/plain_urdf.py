"""A URDF that other programs read, of the document of an MJCF robot."""

from __future__ import annotations

from lxml import etree

from torchid.errors import UrdfError
from torchid.robot.xml_files import OWN


def plain_urdf(root: etree._Element) -> None:
    """Make a URDF of a document that may have attributes of torchid's own, whose armatures, springs and loops it loses.

    A joint about an anchor off its link's origin gets a link without mass, to which that one is welded.
    """
    names = {element.get("name") for element in root.iter("link", "joint")}
    for joint in root.findall("joint"):
        child = joint.find("child")
        offset = None if child is None else child.attrib.pop(f"{OWN}xyz", None)
        if child is not None and offset is not None:
            name, link = f"{joint.get('name')}_anchor", str(child.get("link"))
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
