"""URDF and mesh files that nobody should trust."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
from hostile_logs import Cases, mutated, mutations
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
    *("nan", "-inf", "1e400", "1e308", "1e9", "5e-324", "1_0", "１２", "0x10", "1,5", "--1", "", " ", "1 ", ".5"),
    *("1" * 100_000, "1e" + "9" * 1000, "${mass}", "None"),
)  # fmt: skip
#: Names that could do harm elsewhere.
NAMES = (
    *("../../etc/passwd", "C:\\x", " a ", "..", "*", "[red]x[/red]", "%s%n", "{0}", "$HOME", "`x`", "&lt;b&gt;", "世界"),
    *("a&#10;b", "&#27;[2J", "&#0;", "&#xD800;", "x" * 200, "x" * 201, "x" * 10**5),
)  # fmt: skip
_NUMBER_PLACES = ('mass value="1"', 'xyz="0.1 0 0.2"', 'ixx="0.1"', 'axis xyz="0 1 0"', 'damping="0.1"')
_NAME_PLACES = ('"base"', '"hip"', 'parent link="a"', 'mimic joint="knee"', 'type="prismatic"')


def urdfs(folder: Path) -> Cases:
    """URDFs made by hand; numbers and names go round the places where they may stand."""
    path = folder / "machine.urdf"
    for name, content in {**_DOCUMENTS, **_TREES}.items():
        path.write_bytes(_made(content))
        yield name, path
    for number, value in enumerate(NUMBERS):
        for old in (_NUMBER_PLACES[number % 5], _NUMBER_PLACES[(number + 2) % 5]):
            attribute, _, given = old.partition('="')
            words = given.rstrip('"').split()
            path.write_text(VALID.replace(old, f'{attribute}="{" ".join([value, *words[1:]])}"'))
            yield f"{attribute} of {value[:20]}", path
    for number, value in enumerate(NAMES):
        for old in (_NAME_PLACES[number % 5], _NAME_PLACES[(number + 2) % 5]):
            path.write_text(VALID.replace(old, old[: old.index('"')] + f'"{value}"'))
            yield f"{old} as {value[:20]}", path


def damaged(folder: Path, count: int, seed: int) -> Cases:
    """A valid URDF with bytes cut off or changed."""
    return mutations(folder / "machine.urdf", [VALID.encode()], count, np.random.default_rng(seed))


def _made(content: Content) -> bytes:
    made = content() if callable(content) else content
    return made if isinstance(made, bytes) else made.encode()


def _robot(*elements: str) -> str:
    return f'<robot name="m">{"".join(elements)}</robot>'


def tree(links: int, chain: bool, kind: str = "revolute") -> str:
    """A robot of many links, one after the other or side by side."""
    parents = [f"l{k - 1}" if chain else "l0" for k in range(links)]
    joints = (joint(f"j{k}", parents[k], f"l{k}", kind) for k in range(1, links))
    return _robot(*(link(f"l{k}", INERTIAL if not k else "") for k in range(links)), *joints)


def _mimics(count: int, ratio: str, last: str) -> str:
    """Joints that follow one another, the last of them one that is given."""
    masters = [*(f"j{k + 1}" for k in range(count - 1)), last]
    joints = [joint(f"j{k}", f"l{k}", f"l{k + 1}", extra=mimic(masters[k], ratio)) for k in range(count)]
    return _robot(*(link(f"l{k}") for k in range(count + 1)), *joints, link("free"), joint("free", "l0", "free"))


_LAUGHS = "".join(f'<!ENTITY x{k + 1} "{f"&x{k};" * 10}">' for k in range(12))
_WORD = '<!ENTITY x0 "0123456789">'
_DOCUMENTS: dict[str, Content] = {
    "nothing": "",
    "zeros": bytes(10**6),
    "another root": "<sdf/>",
    "a root of 10^5 letters": f"<{'r' * 10**5}/>",
    "NUL": _robot(BASE).replace("base", "ba\0se"),
    "UTF-16": _robot(BASE).encode("utf-16"),
    "an encoding that does not exist": f'<?xml version="1.0" encoding="nothing"?>{_robot(BASE)}',
    "not UTF-8": _robot(BASE).encode().replace(b"base", b"b\xff\xfee"),
    "a compressed bomb": gzip.compress(_robot(BASE).encode() + b" " * 5 * 10**7),
    "20 MB of blanks": lambda: _robot(BASE) + " " * 2 * 10**7,
    "1 MB of elements": lambda: _robot(BASE, "<a/>" * 250_000),
    "1 MB of attributes": lambda: _robot(BASE, "<a ", *(f'a{k}="" ' for k in range(75_000)), "/>"),
    "10^5 tags deep": _robot(BASE, "<a>" * 10**5, "</a>" * 10**5),
    "links in links": _robot(BASE, '<link name="x">' * 200, "</link>" * 200),
    "instructions": f'<?xml-stylesheet href="file:///etc/passwd"?><robot name="m"><?php evil() ?>{BASE}</robot>',
    "an inclusion": '<robot xmlns:xi="http://www.w3.org/2001/XInclude"><xi:include href="/etc/passwd" parse="text"/></robot>',
    "a laugh in the content": f'<!DOCTYPE robot [{_WORD}{_LAUGHS}]><robot name="m">{BASE}&x12;</robot>',
    "a laugh in a name": f'<!DOCTYPE robot [{_WORD}{_LAUGHS}]><robot name="m">{BASE}<link name="&x12;"/></robot>',
    "an entity from a file": f'<!DOCTYPE robot [<!ENTITY a SYSTEM "file:///etc/passwd">]><robot name="m">{BASE}&a;</robot>',
    "an entity from the net": f'<!DOCTYPE robot [<!ENTITY a SYSTEM "http://127.0.0.1:9/x">]><robot name="m">{BASE}&a;</robot>',
    "an entity from a device": f'<!DOCTYPE robot [<!ENTITY a SYSTEM "file:///dev/zero">]><robot name="m">{BASE}&a;</robot>',
    "a document type from elsewhere": f'<!DOCTYPE robot SYSTEM "http://127.0.0.1:9/x.dtd">{_robot(BASE)}',
    "an element twice over": _robot(BASE, BASE),
}
_TREES: dict[str, Content] = {
    "a chain of 10^5 joints": lambda: tree(10**5, True),
    "a star of 20000 welds": lambda: tree(20_000, False, "fixed"),
    "a chain of 301 links": tree(301, True),
    "a chain of 300 welded links": tree(300, True, "fixed"),
    "250 joints that follow one another": _mimics(250, 'multiplier="1"', "free"),
    "250 joints that follow in a circle": _mimics(250, 'multiplier="1"', "j0"),
    "ratios beyond all numbers": _mimics(40, 'multiplier="1e9"', "free"),
    "a loop": _robot(BASE, ARM, HINGE, joint("back", "arm", "base")),
    "two trees": _robot(BASE, ARM, link("c"), link("d"), HINGE, joint("x", "c", "d")),
    "a circle beside the tree": _robot(BASE, ARM, HINGE, link("c"), link("d"), joint("x", "c", "d"), joint("y", "d", "c")),
    "no mass at all": _robot(link("base", inertial(mass="0")), link("arm", ""), HINGE),
    "negative inertias": _robot(link("base", inertial(ixx="-1", iyy="-1", izz="-1")), ARM, HINGE),
    "a mass of 10^-300": _robot(link("base", inertial("1e-300", ixx="1e-300", iyy="1e-300", izz="1e-300")), ARM, HINGE),
    "an axis of 10^-300": _robot(BASE, ARM, joint("elbow", "base", "arm", extra='<axis xyz="1e-300 0 0"/>')),
    "two of everything": VALID.replace("</inertial>", '<mass value="3"/><origin xyz="9 9 9"/></inertial>'),
}  # fmt: skip


# --------------------------------------------------------------------------------------------------------------- meshes


def meshes(folder: Path) -> Cases:
    """URDFs in a package whose meshes are hostile, or lie elsewhere."""
    robots = folder / "package" / "urdf"
    shapes = folder / "package" / "meshes"
    for made in (robots, shapes, folder / "elsewhere"):
        made.mkdir(parents=True, exist_ok=True)
    (folder / "elsewhere" / "x.obj").write_text(_OBJ)
    for name, content in _MESHES.items():
        file = shapes / f"mesh.{name.split()[0].lower()}"
        file.write_bytes(_made(content))
        yield name, _with_mesh(robots, f"package://package/meshes/{file.name}")
        file.unlink()
    (shapes / "mesh.obj").write_text(_OBJ)
    yield "30000 times", _with_mesh(robots, "package://package/meshes/mesh.obj", 30_000)
    for name in (*OUTSIDE, *_NOWHERE):
        yield f"at {name[:60]}", _with_mesh(robots, name.format(folder=folder))


def damaged_meshes(folder: Path, count: int, seed: int) -> Cases:
    """Valid meshes with bytes cut off or changed."""
    rng = np.random.default_rng(seed)
    kinds = list(WHOLE)
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
_PLY = (
    "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
)
_CORNERS = "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"


def _stl(count: int, faces: int, face: bytes = _FACE) -> bytes:
    return bytes(80) + struct.pack("<I", count) + face * faces


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
    uses = [f'<instance_node url="#f{k}"/>' * times for k in range(levels)]
    folds = (f'<node id="f{k + 1}">{use}</node>' for k, use in enumerate(uses))
    return f'<library_nodes><node id="f0"><instance_geometry url="#g"/></node>{"".join(folds)}</library_nodes>'


_DTD = f"<!DOCTYPE COLLADA [{_WORD}{_LAUGHS}]>"
_MESHES: dict[str, Content] = {
    "STL of nothing": b"",
    "STL of 2^32 faces declared": _stl(2**32 - 1, 2),
    "STL of faces that are missing": _stl(100, 50),
    "STL of NaN": _stl(1, 1, struct.pack("<12fH", *[float("nan")] * 12, 0)),
    "STL of 10^38": _stl(1, 1, struct.pack("<12fH", *[3e38] * 12, 0)),
    "STL of words": "solid x\nfacet normal 0 0 1\nouter loop\nvertex a b c\nendloop\nendfacet\nendsolid\n",
    "OBJ of nothing": "",
    "OBJ of material elsewhere": "mtllib ../../../../etc/passwd\nusemtl x\n" + _OBJ,
    "OBJ of 10^4 materials": lambda: "".join(f"usemtl m{k}\nf 1 2 3\n" for k in range(10**4)) + _OBJ,
    "OBJ of corners that are not there": _OBJ + "f 1 2 99999999999999999999\n",
    "OBJ of NaN": _OBJ.replace("1 0 0", "nan nan nan"),
    "OBJ of binary": bytes(range(256)) * 100,
    "OBJ of a line of 2 MB": lambda: "v " + "0 " * 10**6 + "\n",
    "PLY of 10^12 corners declared": _PLY.format(10**12, 1) + _CORNERS,
    "PLY of words": _PLY.format("x", 1) + _CORNERS,
    "PLY of a face of 10^9 corners": _PLY.format(3, 1) + "0 0 0\n1 0 0\n0 1 0\n1000000000 0 1 2\n",
    "OFF of 10^12 corners declared": "OFF\n1000000000000 1 0\n0 0 0\n",
    "DAE of a triangle": _dae(),
    "DAE of entities": _dae(_DTD, shape="&x12;"),
    "DAE of a file elsewhere": _dae('<!DOCTYPE COLLADA [<!ENTITY a SYSTEM "file:///etc/passwd">]>', shape="&a;"),
    "DAE of a type elsewhere": _dae('<!DOCTYPE COLLADA SYSTEM "http://127.0.0.1:9/x.dtd">'),
    "DAE of folded nodes": _dae(nodes=_folded(12, 10), scene='<instance_node url="#f12"/>'),
    "DAE of a chain of nodes": _dae(nodes=_folded(3000, 1), scene='<instance_node url="#f3000"/>'),
    "DAE of a node in itself": _dae(scene='<instance_node url="#n"/>'),
    "DAE of 10^5 uses": _dae(uses=10**5),
    "DAE of 10^5 levels": _dae(scene="<node>" * 10**5 + "</node>" * 10**5),
    "DAE of numbers that are missing": _dae(shape="0 0 0"),
    "DAE of an archive": b"PK\x03\x04" + bytes(1000),
    "GLB of nothing": b"glTF" + struct.pack("<II", 2, 12),
    "SVG of a script": "<svg><script>evil()</script></svg>",
    "PY of code": "open('pwned', 'w')",
}  # fmt: skip
OUTSIDE = (
    *("../../../../../../../../etc/passwd", "../../elsewhere/x.obj", "{folder}/elsewhere/x.obj", "/dev/zero"),
    *("file://{folder}/elsewhere/x.obj", "file:///etc/passwd", "/proc/self/mem", "package:///etc/passwd"),
    *("package://../elsewhere/x.obj", "package://package/../../elsewhere/x.obj", "package://etc/passwd"),
    *("http://127.0.0.1:9/x.obj", "ftp://127.0.0.1/x.stl"),
)  # fmt: skip
"""Places beyond the robot's package, of which one exists and is a fine mesh."""
_NOWHERE = (
    *("package://", "package://package", "data:,x.stl", "", "..", "/", "~/x.stl", "$(touch pwned).stl", "x&#10;y.stl"),
    *("&#27;[2J.stl", "a" * 300 + ".stl", "a/" * 3000 + "x.stl", "\\\\server\\x.stl", "x.stl|ls", "machine.urdf"),
)  # fmt: skip

WHOLE = {
    "stl": _stl(12, 12),
    "obj": _OBJ.encode(),
    "ply": (_PLY.format(3, 1) + _CORNERS).encode(),
    "off": b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
    "dae": _dae().encode(),
}
"""A valid mesh of each kind."""
