"""URDF and mesh files that nobody should trust."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
from hostile_logs import Cases, mutated, mutations
from lxml import etree
from urdfs import ARM, BASE, HINGE, INERTIAL, inertial, joint, link, mimic

Content = str | bytes | Callable[[], str | bytes]
VALID = (
    '<robot name="machine">'
    + link("base", f'{INERTIAL}<visual><geometry><box size="1 1 1"/></geometry></visual>')
    + "".join(link(name, inertial(origin='<origin xyz="0.1 0 0.2" rpy="0.1 0 0"/>')) for name in ("a", "b", "c"))
    + joint("hip", "base", "a", extra='<origin xyz="0 0 1" rpy="0 1 0"/><axis xyz="0 0 1"/>')
    + joint("knee", "a", "b", extra='<axis xyz="0 1 0"/><dynamics damping="0.1" friction="0.2"/>')
    + joint("toe", "b", "c", "prismatic", mimic("knee", 'multiplier="2" offset="0.1"'))
    + "</robot>"
)

#: Numbers as attributes may spell them, and what only looks like one.
NUMBERS = (
    *("nan", "NaN", "inf", "-inf", "infinity", "1e400", "-1e400", "1e308", "-1e308", "1e30", "1e9", "1e-400", "5e-324", "-0.0"),
    *("1_0", "1_000.0", "１２", "٣", "𝟙", "0x10", "0x1p4", "1e", "e5", "1,5", "1.2.3", "--1", "+-1", "", " ", ".", "1 ", "+1", ".5", "5."),
    *("1" * 1000, "1" * 100_000, "0." + "0" * 100_000 + "1", "1e" + "9" * 1000, "1" + "0" * 400, "${mass}", "$(arg m)", "a", "None", "True"),
)  # fmt: skip
#: Names that could do harm elsewhere.
NAMES = (
    *("a/b", "../../etc/passwd", "/etc/passwd", "a\\b", "C:\\x", "a b", " a ", "a.b", "..", ".", "-x", "~", "*", "?", "[red]x[/red]"),
    *("%s%n", "{0}", "$HOME", "${a}", "a$\\frac{$", "`x`", "a;b", "a'b", "&quot;", "&lt;b&gt;", "&amp;", "𝔘", "é" * 60, "世界", "‮a"),
    *("a&#10;b", "a&#13;b", "a&#9;b", "&#27;[2J", "&#127;", "&#133;", "&#8232;", "&#0;", "&#xD800;", "x" * 200, "x" * 201, "x" * 10**5, "ab" * 90),
)  # fmt: skip


def urdfs(folder: Path) -> Cases:
    """URDFs made by hand."""
    path = folder / "machine.urdf"
    for name, content in {**_DOCUMENTS, **_TREES}.items():
        path.write_bytes(_made(content))
        yield name, path
    for value in NUMBERS:
        for old in (
            'mass value="1"',
            'xyz="0.1 0 0.2"',
            'ixx="0.1"',
            'axis xyz="0 1 0"',
            'damping="0.1"',
            'multiplier="2"',
        ):
            attribute, _, number = old.partition('="')
            words = number.rstrip('"').split()
            path.write_text(VALID.replace(old, f'{attribute}="{" ".join([value, *words[1:]])}"'))
            yield f"{attribute} of {value[:20]}", path
    for value in NAMES:
        for old in ('"base"', '"hip"', 'link name="c"', 'parent link="a"', 'mimic joint="knee"', 'type="prismatic"'):
            path.write_text(VALID.replace(old, old[: old.index('"')] + f'"{value}"'))
            yield f"{old} as {value[:20]}", path


def shuffled(folder: Path, count: int, seed: int) -> Cases:
    """A valid URDF of which elements and attributes went missing, or stand somewhere else as well."""
    rng, path = np.random.default_rng(seed), folder / "machine.urdf"
    for number in range(count):
        root = etree.fromstring(VALID)
        for _ in range(int(rng.integers(1, 4))):
            kind = _reshape(root, rng)
        path.write_bytes(etree.tostring(root))
        yield f"{kind} {number}", path


def damaged(folder: Path, count: int, seed: int) -> Cases:
    """A valid URDF with bytes cut off or changed."""
    return mutations(folder / "machine.urdf", [VALID.encode()], count, np.random.default_rng(seed))


def _reshape(root: etree._Element, rng: np.random.Generator) -> str:
    elements = list(root.iter())[1:]
    one, other = (elements[rng.integers(len(elements))] for _ in range(2))
    kind = ("remove", "repeat", "move", "strip", "rename", "wrap")[rng.integers(6)]
    above = one.getparent()
    if kind == "remove":
        above.remove(one)
    elif kind == "repeat":
        above.append(etree.fromstring(etree.tostring(one)))
    elif kind == "move" and one not in other.iterancestors() and one is not other:
        other.append(one)
    elif kind == "strip" and one.attrib:
        del one.attrib[list(one.attrib)[rng.integers(len(one.attrib))]]
    elif kind == "rename":
        one.tag = ("link", "joint", "inertial", "origin", "mimic", "axis")[rng.integers(6)]
    elif kind == "wrap":
        one.text = "text" * 10
    return kind


def _made(content: Content) -> bytes:
    made = content() if callable(content) else content
    return made if isinstance(made, bytes) else made.encode()


def _nested(tag: str, depth: int) -> str:
    return _robot(BASE, f"<{tag}>" * depth, f"</{tag}>" * depth)


def _robot(*elements: str) -> str:
    return f'<robot name="m">{"".join(elements)}</robot>'


def tree(links: int, chain: bool, kind: str = "revolute") -> str:
    """A robot of many links, one after the other or side by side."""
    parents = [f"l{k - 1}" if chain else "l0" for k in range(links)]
    joints = (joint(f"j{k}", parents[k], f"l{k}", kind) for k in range(1, links))
    return _robot(*(link(f"l{k}", INERTIAL if not k else "") for k in range(links)), *joints)


def _mimics(count: int, multiplier: str, last: str) -> str:
    """Joints that follow one another."""
    joints = [
        joint(f"j{k}", f"l{k}", f"l{k + 1}", extra=mimic(f"j{k + 1}" if k + 1 < count else last, multiplier))
        for k in range(count)
    ]
    return _robot(*(link(f"l{k}") for k in range(count + 1)), *joints)


_LAUGHS = "".join(f'<!ENTITY x{k + 1} "{f"&x{k};" * 10}">' for k in range(12))
_WORD = '<!ENTITY x0 "0123456789">'
_DOCUMENTS: dict[str, Content] = {
    "nothing": "",
    "a text": "robot",
    "zeros": bytes(10**6),
    "an executable": b"\x7fELF" + bytes(range(256)) * 10,
    "another root": "<sdf/>",
    "a root of 10^5 letters": f"<{'r' * 10**5}/>",
    "a root in a name space": '<x:robot xmlns:x="http://example.com/x"/>',
    "no element": "<robot/>",
    "NUL": _robot(BASE).replace("base", "ba\0se"),
    "UTF-16": _robot(BASE).encode("utf-16"),
    "an encoding that does not exist": f'<?xml version="1.0" encoding="nothing"?>{_robot(BASE)}',
    "an encoding that it is not in": f'<?xml version="1.0" encoding="utf-16"?>{_robot(BASE)}',
    "UTF-7": f'<?xml version="1.0" encoding="utf-7"?>{_robot(BASE)}',
    "not UTF-8": _robot(BASE).encode().replace(b"base", b"b\xff\xfee"),
    "a compressed file": gzip.compress(_robot(BASE).encode()),
    "a compressed bomb": gzip.compress(_robot(BASE).encode() + b" " * 5 * 10**7),
    "20 MB of blanks": lambda: _robot(BASE) + " " * 2 * 10**7,
    "8 MB of elements": lambda: _robot(BASE, "<a/>" * 2_000_000),
    "8 MB of attributes": lambda: _robot(BASE, "<a ", *(f'a{k}="" ' for k in range(600_000)), "/>"),
    "8 MB of comments": lambda: _robot(BASE, "<!-- -->" * 1_000_000),
    "a text of 8 MB": lambda: _robot(BASE, "<a>", "x" * 8_000_000, "</a>"),
    "an attribute of 8 MB": lambda: _robot(BASE, '<a x="', "x" * 8_000_000, '"/>'),
    "10^5 tags deep": _nested("a", 10**5),
    "255 tags deep": _nested("a", 250),
    "10^5 open tags": "<robot>" + "<link>" * 10**5,
    "links in links": _robot(BASE, '<link name="x">' * 200, "</link>" * 200),
    "instructions": f'<?xml-stylesheet href="file:///etc/passwd"?><robot name="m"><?php evil() ?>{BASE}</robot>',
    "an inclusion": '<robot xmlns:xi="http://www.w3.org/2001/XInclude"><xi:include href="/etc/passwd" parse="text"/></robot>',
    "a laugh in the content": f'<!DOCTYPE robot [{_WORD}{_LAUGHS}]><robot name="m">{BASE}&x12;</robot>',
    "a laugh in a name": f'<!DOCTYPE robot [{_WORD}{_LAUGHS}]><robot name="m">{BASE}<link name="&x12;"/></robot>',
    "a laugh in a default": f'<!DOCTYPE robot [{_WORD}{_LAUGHS}<!ATTLIST link name CDATA "&x12;">]><robot name="m"><link/></robot>',
    "a quadratic laugh": f'<!DOCTYPE robot [<!ENTITY a "{"a" * 10**5}">]><robot name="m">{BASE}<link name="{"&a;" * 10**4}"/></robot>',
    "an entity in itself": f'<!DOCTYPE robot [<!ENTITY a "&b;"><!ENTITY b "&a;">]><robot name="&a;">{BASE}</robot>',
    "an entity from a file": f'<!DOCTYPE robot [<!ENTITY a SYSTEM "file:///etc/passwd">]><robot name="m">{BASE}&a;</robot>',
    "an entity from a file, in a name": f'<!DOCTYPE robot [<!ENTITY a SYSTEM "file:///etc/passwd">]><robot name="&a;">{BASE}</robot>',
    "an entity from the net": f'<!DOCTYPE robot [<!ENTITY a SYSTEM "http://127.0.0.1:9/x">]><robot name="m">{BASE}&a;</robot>',
    "an entity from a device": f'<!DOCTYPE robot [<!ENTITY a SYSTEM "file:///dev/zero">]><robot name="m">{BASE}&a;</robot>',
    "entities from elsewhere": '<!DOCTYPE robot [<!ENTITY % a SYSTEM "file:///etc/passwd"> %a;]><robot name="m"/>',
    "a document type from elsewhere": f'<!DOCTYPE robot SYSTEM "http://127.0.0.1:9/x.dtd">{_robot(BASE)}',
    "an element twice over": _robot(BASE, BASE),
}
_TREES: dict[str, Content] = {
    "a chain of 10^5 joints": lambda: tree(10**5, True),
    "a star of 10^5 joints": lambda: tree(10**5, False),
    "10^5 links": lambda: _robot(*(link(f"l{k}", "") for k in range(10**5))),
    "a chain of 20000 joints": lambda: tree(20_000, True),
    "a star of 20000 welds": lambda: tree(20_000, False, "fixed"),
    "a chain of 301 links": tree(301, True),
    "a chain of 300 links": tree(300, True),
    "a chain of 300 welded links": tree(300, True, "fixed"),
    "a star of 300 links": tree(300, False),
    "250 joints that follow one another": _mimics(250, 'multiplier="1"', "free").replace(
        "</robot>", joint("free", "l0", "free") + link("free") + "</robot>"
    ),
    "250 joints that follow in a circle": _mimics(250, 'multiplier="1"', "j0"),
    "ratios beyond all numbers": _mimics(40, 'multiplier="1e9"', "free").replace(
        "</robot>", joint("free", "l0", "free") + link("free") + "</robot>"
    ),
    "a joint that follows itself": _robot(BASE, ARM, joint("elbow", "base", "arm", extra=mimic("elbow"))),
    "a loop": _robot(BASE, ARM, HINGE, joint("back", "arm", "base")),
    "a loop of one": _robot(BASE, ARM, joint("elbow", "arm", "arm")),
    "two trees": _robot(BASE, ARM, link("c"), link("d"), HINGE, joint("x", "c", "d")),
    "a circle beside the tree": _robot(BASE, ARM, HINGE, link("c"), link("d"), joint("x", "c", "d"), joint("y", "d", "c")),
    "a negative mass": _robot(link("base", inertial(mass="-1"))),
    "no mass at all": _robot(link("base", inertial(mass="0")), link("arm", ""), HINGE),
    "negative inertias": _robot(link("base", inertial(ixx="-1", iyy="-1", izz="-1")), ARM, HINGE),
    "inertias of 10^9": _robot(link("base", inertial("1e9", ixx="1e9", iyy="1e9", izz="1e9")), ARM, HINGE),
    "a mass of 10^-300": _robot(link("base", inertial("1e-300", ixx="1e-300", iyy="1e-300", izz="1e-300")), ARM, HINGE),
    "an axis of 10^-300": _robot(BASE, ARM, joint("elbow", "base", "arm", extra='<axis xyz="1e-300 0 0"/>')),
    "origins of 10^9": tree(200, True).replace("<axis", '<origin xyz="1e9 1e9 1e9" rpy="1e9 1e9 1e9"/><axis'),
    "two of everything": VALID.replace("</inertial>", '<mass value="3"/><origin xyz="9 9 9"/></inertial>'),
}  # fmt: skip


# --------------------------------------------------------------------------------------------------------------- meshes


def meshes(folder: Path) -> Cases:
    """URDFs in a package whose meshes are hostile, or lie elsewhere."""
    robots, shapes = folder / "package" / "urdf", folder / "package" / "meshes"
    for made in (robots, shapes, folder / "elsewhere"):
        made.mkdir(parents=True, exist_ok=True)
    (folder / "elsewhere" / "x.obj").write_text(_OBJ)
    for name, content in _MESHES.items():
        file = shapes / f"mesh.{name.split()[0].lower()}"
        file.write_bytes(_made(content))
        yield name, _with_mesh(robots, f"package://package/meshes/{file.name}")
        file.unlink()
    for count in (300, 30_000):
        (shapes / "mesh.obj").write_text(_OBJ)
        yield f"{count} times", _with_mesh(robots, "package://package/meshes/mesh.obj", count)
    for name in _PLACES:
        yield f"at {name[:60]}", _with_mesh(robots, name.format(folder=folder))


def damaged_meshes(folder: Path, count: int, seed: int) -> Cases:
    """Valid meshes with bytes cut off or changed."""
    rng, kinds = np.random.default_rng(seed), list(WHOLE)
    for number in range(count):
        suffix = kinds[number % len(kinds)]
        kind, content = mutated(WHOLE[suffix], rng)
        (folder / f"mesh.{suffix}").write_bytes(content)
        yield f"{suffix} {kind} {number}", _with_mesh(folder, f"mesh.{suffix}")
        (folder / f"mesh.{suffix}").unlink()


def _with_mesh(folder: Path, name: str, count: int = 1) -> Path:
    path = folder / "machine.urdf"
    shape = f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'
    path.write_text(_robot(link("base", INERTIAL + shape * count)))
    return path


_OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
_FACE = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)
_STL = (
    "solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid\n"
)
_PLY_HEAD = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
_PLY = _PLY_HEAD + "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
_PLY_DATA = "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"


def _stl(count: int, faces: int) -> bytes:
    return bytes(80) + struct.pack("<I", count) + _FACE * faces


def _dae(before: str = "", shape: str = "0 0 0 1 0 0 0 1 0", nodes: str = "", scene: str = "", uses: int = 1) -> str:
    axes = "".join(f'<param name="{axis}" type="float"/>' for axis in "XYZ")
    accessor = f'<technique_common><accessor source="#a" count="3" stride="3">{axes}</accessor></technique_common>'
    mesh = (
        f'<mesh><source id="p"><float_array id="a" count="9">{shape}</float_array>{accessor}</source>'
        '<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>'
        '<triangles count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles></mesh>'
    )
    used = '<instance_geometry url="#g"/>' * uses
    return (
        f'<?xml version="1.0"?>{before}<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">'
        "<asset><up_axis>Z_UP</up_axis></asset>"
        f'<library_geometries><geometry id="g">{mesh}</geometry></library_geometries>{nodes}'
        f'<library_visual_scenes><visual_scene id="s"><node id="n">{scene or used}</node></visual_scene>'
        '</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>'
    )


def _folded(levels: int, times: int) -> str:
    """Nodes of a COLLADA file that use one another."""
    last = '<node id="f0"><instance_geometry url="#g"/></node>'
    uses = ('<instance_node url="#f%d"/>' % k * times for k in range(levels))
    rest = (f'<node id="f{k + 1}">{use}</node>' for k, use in enumerate(uses))
    return f"<library_nodes>{last}{''.join(rest)}</library_nodes>"


_DTD = f"<!DOCTYPE COLLADA [{_WORD}{_LAUGHS}]>"
_MESHES: dict[str, Content] = {
    "STL of nothing": b"",
    "STL of 2^32 faces declared": _stl(2**32 - 1, 2),
    "STL of no faces": _stl(0, 0),
    "STL of faces that are missing": _stl(100, 50),
    "STL of faces left over": _stl(1, 50),
    "STL of a header alone": bytes(80),
    "STL of NaN": bytes(80) + struct.pack("<I", 1) + struct.pack("<12fH", *[float("nan")] * 12, 0),
    "STL of infinity": bytes(80) + struct.pack("<I", 1) + struct.pack("<12fH", *[float("inf")] * 12, 0),
    "STL of 10^38": bytes(80) + struct.pack("<I", 1) + struct.pack("<12fH", *[3e38] * 12, 0),
    "STL of text": _STL,
    "STL of 10^5 solids": _STL.replace("endsolid", "endsolid x") * 10**4,
    "STL of words": _STL.replace("1 0 0", "a b c"),
    "STL of an open loop": _STL[:60],
    "STL of 30 MB": lambda: _stl(600_000, 600_000),
    "STL of 40 MB": lambda: _stl(800_000, 800_000),
    "OBJ of nothing": "",
    "OBJ of a tetrahedron": _OBJ,
    "OBJ of material elsewhere": "mtllib ../../../../etc/passwd\nusemtl x\n" + _OBJ,
    "OBJ of material at an absolute place": "mtllib /etc/passwd\nusemtl root\n" + _OBJ,
    "OBJ of 10^5 materials": lambda: "".join(f"usemtl m{k}\nf 1 2 3\n" for k in range(10**5)) + _OBJ,
    "OBJ of 900 materials": _OBJ + "".join(f"usemtl m{k}\nf 1 2 3\n" for k in range(900)),
    "OBJ of 10^5 groups": lambda: _OBJ + "".join(f"g m{k}\nf 1 2 3\n" for k in range(10**5)),
    "OBJ of 10^5 objects": lambda: _OBJ + "".join(f"o m{k}\nf 1 2 3\n" for k in range(10**5)),
    "OBJ of corners beyond all": _OBJ + "f 1 2 99999999999999999999\n",
    "OBJ of corners that are not there": _OBJ + "f 1 2 99\n",
    "OBJ of corners counted backwards": _OBJ + "f -1 -2 -99\n",
    "OBJ of a face of 10^5 corners": _OBJ + "f" + " 1 2 3" * 33_000 + "\n",
    "OBJ of NaN": _OBJ.replace("1 0 0", "nan nan nan"),
    "OBJ of 10^400": _OBJ.replace("1 0 0", "1e400 0 0"),
    "OBJ of words": _OBJ.replace("1 0 0", "a b c"),
    "OBJ of binary": bytes(range(256)) * 100,
    "OBJ of a line of 10 MB": lambda: "v " + "0 " * 5 * 10**6 + "\n",
    "OBJ of 10^6 corners": lambda: "v 0.1 0.2 0.3\n" * 10**6 + "f 1 2 3\n",
    "PLY of 10^12 corners declared": _PLY.format(10**12, 1) + _PLY_DATA,
    "PLY of 10^9 faces declared": _PLY.format(3, 10**9) + _PLY_DATA,
    "PLY of -1 corners": _PLY.format(-1, 1) + _PLY_DATA,
    "PLY of words": _PLY.format("x", 1) + _PLY_DATA,
    "PLY of a triangle": _PLY.format(3, 1) + _PLY_DATA,
    "PLY of a header alone": _PLY.format(3, 1),
    "PLY of a face of 10^9 corners": _PLY.format(3, 1) + "0 0 0\n1 0 0\n0 1 0\n1000000000 0 1 2\n",
    "PLY of 10^12 binary corners": _PLY.format(10**12, 1).replace("ascii", "binary_little_endian") + "\0" * 100,
    "PLY of 10^5 properties": _PLY_HEAD.format(1) + "".join(f"property float p{k}\n" for k in range(10**5)) + "end_header\n0",
    "PLY of an unknown type": _PLY.format(3, 1).replace("float x", "evil x") + _PLY_DATA,
    "OFF of 10^12 corners declared": "OFF\n1000000000000 1 0\n0 0 0\n",
    "OFF of a triangle": "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
    "OFF of a face of 10^9 corners": "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n1000000000 0 1 2\n",
    "DAE of a triangle": _dae(),
    "DAE of entities": _dae(_DTD, shape="&x12;"),
    "DAE of entities in an attribute": _dae(_DTD).replace('id="g"', 'id="&x12;"'),
    "DAE of a few entities": _dae(f"<!DOCTYPE COLLADA [{_WORD}]>", shape="0 0 &x0; 1 0 0 0 1 0"),
    "DAE of a file elsewhere": _dae('<!DOCTYPE COLLADA [<!ENTITY a SYSTEM "file:///etc/passwd">]>', shape="&a;"),
    "DAE of a device": _dae('<!DOCTYPE COLLADA [<!ENTITY a SYSTEM "file:///dev/zero">]>', shape="&a;"),
    "DAE of a type elsewhere": _dae('<!DOCTYPE COLLADA SYSTEM "http://127.0.0.1:9/x.dtd">'),
    "DAE of UTF-16 entities": _dae(_DTD, shape="&x12;").replace("<?xml version=\"1.0\"?>", "").encode("utf-16"),
    "DAE of folded nodes": _dae(nodes=_folded(12, 10), scene='<instance_node url="#f12"/>'),
    "DAE of a few folded nodes": _dae(nodes=_folded(2, 5), scene='<instance_node url="#f2"/>'),
    "DAE of a chain of nodes": _dae(nodes=_folded(3000, 1), scene='<instance_node url="#f3000"/>'),
    "DAE of a node in itself": _dae(scene='<instance_node url="#n"/>'),
    "DAE of 10^5 uses": _dae(uses=10**5),
    "DAE of 2000 uses": _dae(uses=2000),
    "DAE of 10^5 levels": _dae(scene="<node>" * 10**5 + "</node>" * 10**5),
    "DAE of 200 levels": _dae(scene="<node>" * 200 + "</node>" * 200),
    "DAE of numbers that are none": _dae(shape="a b c d e f g h i"),
    "DAE of NaN": _dae(shape="nan " * 9),
    "DAE of numbers that are missing": _dae(shape="0 0 0"),
    "DAE of a texture elsewhere": _dae().replace(
        "<library_geometries>",
        '<library_images><image id="i"><init_from>/etc/passwd</init_from></image></library_images><library_geometries>',
    ),
    "DAE of no XML": "hello",
    "DAE of an archive": b"PK\x03\x04" + bytes(1000),
    "GLB of nothing": b"glTF" + struct.pack("<II", 2, 12),
    "ZIP of nothing": b"PK\x05\x06" + bytes(18),
    "XAML of nothing": "<a/>",
    "SVG of a script": '<svg><script>evil()</script></svg>',
    "URDF of meshes": VALID,
    "PY of code": "open('pwned', 'w')",
}  # fmt: skip
_PLACES = (
    *("../../../../../../../../etc/passwd", "../../elsewhere/x.obj", "{folder}/elsewhere/x.obj", "file://{folder}/elsewhere/x.obj"),
    *("/etc/passwd", "file:///etc/passwd", "/dev/zero", "/dev/stdin", "file:///dev/random", "/proc/self/mem", "package:///etc/passwd"),
    *("package://../elsewhere/x.obj", "package://package/../../elsewhere/x.obj", "package://package/../../../etc/passwd", "package://.."),
    *("package://", "package:///", "package://.", "package://package", "package://etc/passwd", "package://%2e%2e/elsewhere/x.obj"),
    *("model://package/meshes/x.obj", "http://127.0.0.1:9/x.obj", "https://127.0.0.1:9/x.stl", "ftp://127.0.0.1/x.stl", "data:,x.stl"),
    *("", " ", ".", "..", "/", "~/x.stl", "$HOME/x.stl", "$(touch pwned).stl", "`x`.stl", "x&#10;y.stl", "&#27;[2J.stl", "a" * 300 + ".stl"),
    *("a/" * 3000 + "x.stl", "\\\\server\\x.stl", "C:\\x.stl", "x.stl|ls", "meshes", "machine.urdf", "://://x.stl", "file://package://x.stl"),
)  # fmt: skip


def _cube() -> dict[str, bytes]:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    lines = "".join(f"v {x} {y} {z}\n" for x, y, z in corners)
    return {
        "stl": _stl(12, 12),
        "obj": (lines + "f 1 2 3\nf 2 3 4\nf 5 6 7\n").encode(),
        "ply": (_PLY.format(3, 1) + _PLY_DATA).encode(),
        "off": b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
        "dae": _dae().encode(),
    }


WHOLE = _cube()
