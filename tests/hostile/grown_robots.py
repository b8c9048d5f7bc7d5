"""Robots, meshes, settings and run folders grown by the rules of their formats, with lies in any place."""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from grown import Chance, tree

from torchid.commands.checkpoint import save_checkpoint

INERTIAL = '<inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>'


def escaped(text: str) -> str:
    """A text as XML writes it, now and then not."""
    for old, new in (("&", "&amp;"), ("<", "&lt;"), ('"', "&quot;")):
        text = text.replace(old, new)
    return "".join(letter if letter >= " " else f"&#{ord(letter)};" if letter in "\t\n\r" else "?" for letter in text)


# ----------------------------------------------------------------------------------------------------------------- URDF


def urdf(chance: Chance, folder: Path) -> Path:
    """A tree of links and joints, of elements that URDFs have, in places where they may have them or not."""
    path, count = folder / "grown.urdf", 1 + chance.below(chance.of([3, 12, 12, 330]))
    names = [f"l{k}" if chance(0.998) else chance.word() for k in range(count)]
    parts = [_element(chance, "link", {"name": name}, _link(chance)) for name in names]
    for k in range(1, count):
        kind = (
            chance.of(["revolute", "continuous", "prismatic", "fixed"])
            if chance(0.998)
            else chance.of(["planar", "floating", chance.word(), ""])
        )
        attributes = {"name": f"j{k}" if chance(0.998) else chance.word(), "type": kind}
        ends = [f'<parent link="{escaped(names[chance.below(k)])}"/>', f'<child link="{escaped(names[k])}"/>']
        inner = [*(end for end in ends if chance(0.999)), *(_joint_part(chance, k) for _ in range(chance.below(4)))]
        parts.append(_element(chance, "joint", attributes, inner))
    for _ in range(chance.below(4)):
        parts.append(_foreign(chance))
    if chance(0.3):
        chance.rng.shuffle(parts)
    root = "robot" if chance(0.98) else chance.of(["sdf", "Robot", "r:robot"])
    spaces = chance.of(["", ' xmlns:xacro="http://ros.org/wiki/xacro"', ' xmlns="http://x.org"' if chance(0.1) else ""])
    text = f'<{root} name="{escaped(chance.name(["m"]))}"{spaces}>{"".join(parts)}</{root}>'
    text = (
        chance.of(
            [
                "",
                "",
                '<?xml version="1.0"?>',
                '<?xml version="1.1" encoding="latin1"?>',
                "<!-- x -->",
                "<!DOCTYPE robot [<!ENTITY a 'b'>]>",
            ]
        )
        + text
    )
    path.write_bytes(text.encode("utf-8", "replace"))
    return path


def _element(chance: Chance, tag: str, attributes: dict[str, str], inner: list[str]) -> str:
    said = " ".join(f'{key}="{escaped(value)}"' for key, value in attributes.items() if chance(0.999))
    return f"<{tag} {said}>{''.join(inner)}</{tag if chance(0.9998) else 'x'}>"


def _numbers(chance: Chance, count: int, usual: str = "") -> str:
    if chance(0.97):
        return usual or " ".join(f"{chance.rng.standard_normal():.3g}" for _ in range(count))
    return " ".join(chance.number() for _ in range(count if chance(0.8) else chance.below(6)))


def _link(chance: Chance) -> list[str]:
    inner = []
    if chance(0.8):
        six = "".join(
            f' {key}="{_numbers(chance, 1, "1" if key[1] == key[2] else "0")}"'
            for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        )
        inner.append(
            f'<inertial><origin xyz="{_numbers(chance, 3)}" rpy="{_numbers(chance, 3)}"/><mass value="{_numbers(chance, 1, "1.5")}"/><inertia{six}/></inertial>'
        )
    for _ in range(chance.below(4)):
        shape = chance.of(['<box size="{}"/>'.format(_numbers(chance, 3, "1 2 3")), '<sphere radius="{}"/>'.format(_numbers(chance, 1, "0.1")), "<cone/>" if chance(0.05) else "<sphere radius='1'/>",
                           '<cylinder radius="{}" length="{}"/>'.format(_numbers(chance, 1, "1"), _numbers(chance, 1, "2")), f'<mesh filename="{escaped(chance.name(["a.stl"]))}" scale="{_numbers(chance, 3, "1 1 1")}"/>'])  # fmt: skip
        tag = chance.of(["visual", "collision"])
        inner.append(f'<{tag}><origin xyz="{_numbers(chance, 3)}"/><geometry>{shape}</geometry></{tag}>')
    return inner


def _joint_part(chance: Chance, k: int) -> str:
    return chance.of([
        lambda: f'<origin xyz="{_numbers(chance, 3)}" rpy="{_numbers(chance, 3)}"/>', lambda: f'<axis xyz="{_numbers(chance, 3)}"/>',
        lambda: f'<limit lower="{_numbers(chance, 1)}" upper="{_numbers(chance, 1)}" effort="1" velocity="1"/>',
        lambda: f'<dynamics damping="{_numbers(chance, 1, "0.1")}" friction="{_numbers(chance, 1, "0.2")}"/>',
        lambda: f'<mimic joint="j{1 + chance.below(k)}" multiplier="{_numbers(chance, 1)}"/>' if chance(0.2) else "<calibration/>",
        lambda: "<![CDATA[x]]>text &lt;" + ("&#27;" if chance(0.02) else ""), lambda: _foreign(chance),
    ])()  # fmt: skip


def _foreign(chance: Chance) -> str:
    depth = chance.of([1, 3, 300 if chance(0.1) else 20])
    tag = chance.of(["gazebo", "xacro:macro", "transmission", "material", "link_", "mujoco"])
    declared = ' xmlns:xacro="x"' if chance(0.9) else ""
    return f"<{tag}{declared}>" * depth + escaped(chance.word()) + f"</{tag}>" * depth


# --------------------------------------------------------------------------------------------------------------- meshes


def mesh(chance: Chance, folder: Path) -> Path:
    """A URDF with meshes, and the meshes beside it."""
    suffix = chance.of(["stl", "obj", "ply", "off", "dae"])
    if chance(0.1):
        suffix = suffix.upper()
    content = {"stl": _stl, "obj": _obj, "ply": _ply, "off": _off, "dae": _dae}[suffix.lower()](chance)
    (folder / f"grown.{suffix}").write_bytes(content if chance(0.9) else chance.spliced(content, content))
    path, many = folder / "grown.urdf", 1 + chance.below(30)
    shape = f'<visual><geometry><mesh filename="grown.{suffix}"/></geometry></visual>'
    path.write_text(f'<robot name="m"><link name="l">{INERTIAL}{shape * many}</link></robot>')
    return path


def _case(chance: Chance, word: str) -> str:
    return chance.of([word, word, word.upper(), word.title()])


def _triple(chance: Chance) -> str:
    return " ".join(f"{chance.rng.standard_normal():.4g}" if chance(0.998) else chance.number() for _ in range(3))


def _stl(chance: Chance) -> bytes:
    count = chance.below(3000)
    if chance(0.4):
        faces = (
            chance.bytes(50 * count) if chance(0.3) else chance.rng.standard_normal((count, 25)).astype("<f2").tobytes()
        )
        return chance.bytes(80) + struct.pack("<I", count if chance(0.9) else chance.below(2**32)) + faces
    lines = [f"{_case(chance, 'solid')} {chance.word()}"]
    for _ in range(count // 9):
        lines += [
            f"facet normal {_triple(chance)}",
            "outer loop",
            *(f"{_case(chance, 'vertex')} {_triple(chance)}" for _ in range(3)),
            "endloop",
            "endfacet",
        ]
        if chance(0.1):
            lines += [_case(chance, "endsolid"), f"solid {chance.word()}"]
    return chance.of(["\n", "\r\n", " ", "\t"]).join(lines).encode("utf-8", "replace")


def _obj(chance: Chance) -> bytes:
    lines = []
    for k in range(chance.below(2000)):
        lines.append(chance.of([f"v {_triple(chance)}", f"v {_triple(chance)} 1 0 0", f"vn {_triple(chance)}", f"vt {_triple(chance)}",
                                f"f {' '.join(str(1 + chance.below(k + 2)) for _ in range(3 + chance.below(4)))}", f"f {k}/1/1 1//1 2/1", f"o {chance.word()}", f"g {chance.word()}",
                                f"{_case(chance, 'usemtl')} {chance.word()}", f"mtllib {chance.word()}.mtl", "s off", f"l 1 {k}", "p 1", f"# {chance.word()}", "\\", chance.word() if chance(0.02) else ""]))  # fmt: skip
    return chance.of(["\n", "\r\n"]).join(lines).encode("utf-8", "replace")


def _ply(chance: Chance) -> bytes:
    form = chance.of(["ascii", "ascii", "binary_little_endian", "binary_big_endian", "evil"])
    n, m = chance.below(200), chance.below(200)
    kinds = chance.of([["float"] * 3, ["double"] * 3, ["uchar", "float", "int"]])
    told = (n if chance(0.95) else chance.below(2**40), m if chance(0.95) else chance.below(2**40))
    head = [f"format {form} 1.0", f"comment {chance.word()}", f"element vertex {told[0]}", *(f"property {kind} {axis}" for kind, axis in zip(kinds, "xyz", strict=True)),
            *(f"property {chance.of(['float', 'uchar', 'list uchar int'])} q{k}" for k in range(chance.below(3))), f"element face {told[1]}", "property list uchar int vertex_indices",
            *([f"element {chance.word()} 3", "property float q"] if chance(0.2) else [])]  # fmt: skip
    data = (
        "\n".join([*(_triple(chance) for _ in range(n)), *(f"3 {chance.below(n + 1)} 0 1" for _ in range(m))]).encode()
        if form == "ascii"
        else chance.bytes(12 * n + 13 * m)
    )
    return ("ply\n" + "\n".join(line.replace("\n", " ") for line in head) + "\nend_header\n").encode(
        "utf-8", "replace"
    ) + data


def _off(chance: Chance) -> bytes:
    n, m = chance.below(300), chance.below(300)
    lines = [_case(chance, "OFF"), f"{n if chance(0.95) else chance.below(2**40)} {m} {chance.below(9)}", *(_triple(chance) for _ in range(n)),
             *(f"{chance.of([3, 3, 3, 4, -1])} {chance.below(n + 1)} 1 2 {chance.word() if chance(0.05) else ''}" for _ in range(m))]  # fmt: skip
    return "\n".join(lines).encode("utf-8", "replace")


def _dae(chance: Chance) -> bytes:
    """A scene of nodes in nodes that use geometries and one another."""
    count, inner = 1 + chance.below(4), []
    for k in range(count):
        numbers = " ".join(
            f"{chance.rng.standard_normal():.3g}" if chance(0.999) else chance.number() for _ in range(9)
        )
        accessor = f'<accessor source="#a{k}" count="{3 if chance(0.95) else chance.below(2**31)}" stride="{3 if chance(0.95) else chance.below(99)}"><param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/></accessor>'
        index = "0 1 2" if chance(0.95) else chance.of(["0 1 99", "", "-1 0 1", "a b c"])
        inner.append(f'<geometry id="g{k}"><mesh><source id="p{k}"><float_array id="a{k}" count="9">{numbers}</float_array><technique_common>{accessor}</technique_common></source>'
                     f'<vertices id="v{k}"><input semantic="POSITION" source="#p{k}"/></vertices><{chance.of(["triangles", "polylist", "lines"])} count="1"><input semantic="VERTEX" source="#v{k}" offset="0"/><vcount>3</vcount><p>{index}</p></triangles></mesh></geometry>')  # fmt: skip
    matrices = "".join(
        chance.of(
            [
                "<matrix>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</matrix>",
                "<scale>1 2 3</scale>",
                "<rotate>0 0 1 90</rotate>",
                "<lookat>0</lookat>",
            ]
        )
        for _ in range(chance.below(4))
    )

    def used() -> str:
        return chance.of(
            [f'<instance_node url="#n{chance.below(6)}"/>', f'<instance_geometry url="#g{chance.below(5)}"/>']
        )

    nodes = "".join(
        f'<node id="n{k}">{matrices}{"".join(used() for _ in range(chance.below(8)))}</node>'
        for k in range(chance.below(6))
    )
    unit = chance.of(
        ['<unit meter="0.001" name="mm"/>', "", '<unit meter="x"/>', '<unit meter="1e300"/>', '<unit name="inch"/>']
    )
    scene = (
        f'<visual_scene id="s"><node id="top">{"<node>" * chance.below(40)}<instance_geometry url="#g0"/></node></visual_scene>'
        if chance(0.3)
        else '<visual_scene id="s"><node><instance_geometry url="#g0"/><instance_node url="#n0"/></node></visual_scene>'
    )
    text = (f'<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>{unit}<up_axis>{chance.of(["Z_UP", "Y_UP", "W_UP"])}</up_axis></asset>'
            f"<library_geometries>{''.join(inner)}</library_geometries><library_nodes>{nodes}</library_nodes><library_visual_scenes>{scene}</library_visual_scenes><scene><instance_visual_scene url='#s'/></scene></COLLADA>")  # fmt: skip
    return text.replace(
        "</triangles>",
        "</triangles>"
        if "<polylist" not in text and "<lines" not in text
        else "</polylist>"
        if "<polylist" in text
        else "</lines>",
    ).encode()


# ------------------------------------------------------------------------------------------------------------- settings

KEYS = ("robot", "urdf", "base_link", "contacts", "frame", "type", "logs", "train", "test", "topics", "joint_states", "preprocessing", "cutoff_hz", "sensors", "noise", "joint_torque",
        "estimator", "name", "ridge", "training", "epochs", "optimizer", "lr", "analysis", "scenarios", "costs", "compare", "output", "device", "overwrite", "offsets", "actuators", "bounds")  # fmt: skip
TAGS = (
    "!!int",
    "!!float",
    "!!bool",
    "!!null",
    "!!str",
    "!!timestamp",
    "!!binary",
    "!!set",
    "!!omap",
    "!!seq",
    "!!map",
    "!",
    "!x",
    "!!python/tuple",
    "!<tag:yaml.org,2002:int>",
    "!!merge",
    "!!value",
)
SCALARS = ("1", "x", "", "''", "'a b'", '"\\x1b[2J"', '"\\u202e"', '"\\L"', "null", "~", "true", "yes", "0o7", "0b_", "0x_", "1:60", "1_", "+.inf", ".nan", "2020-13-45", "2020-01-01", "1e5", "-", "=", "<<", "? x",
           "@a", "`a", "%a", "[x", "{a: ", "*a", "&a", "|", ">-", "|9\n a", "a: b: c", "- - x", "${x}", "\\x", "\x1b", "\x85", "é", "joints", "full", "a.npz", "cpu", "1e400", "99999999999999999999")  # fmt: skip


def _yaml(chance: Chance, depth: int, indent: str) -> str:
    """A node after its key or dash."""
    mark = (f" {chance.of(TAGS)}" if chance(0.06) else "") + (f" &{chance.of('abc')}" if chance(0.04) else "")
    kind = chance.of(["block", "list", "flow", "scalar", "scalar", "alias" if chance(0.05) else "scalar"])
    if depth <= 0 or kind == "scalar":
        return f"{mark} {chance.of(SCALARS) if chance(0.5) else chance.number() if chance(0.5) else chance.of(KEYS)}\n"
    if kind == "alias":
        return f" *{chance.of('abc')}\n"
    if kind == "flow":
        return f"{mark} {json.dumps(tree(chance, depth, lambda: chance.of([1, 0.5, None, True, 'x', chance.word()])), ensure_ascii=chance(0.5))}\n"
    inner = range(1 + chance.below(5))
    if kind == "list":
        return f"{mark}\n" + "".join(f"{indent}-{_yaml(chance, depth - 1, indent + '  ')}" for _ in inner)
    return f"{mark}\n" + "".join(
        f"{indent}{chance.of(KEYS) if chance(0.95) else chance.of(SCALARS)}:{_yaml(chance, depth - 1, indent + '  ')}"
        for _ in inner
    )


def settings(chance: Chance, folder: Path) -> Path:
    """An experiment file of the keys that there are, of any nodes of YAML under them; now and then one that is fine but for one."""
    path = folder / "grown.yaml"
    whole = {"robot": "{urdf: r.urdf}", "logs": "{train: [a.npz]}", "sensors": "full", "output": "runs/x", "estimator": "{name: least_squares, ridge: 0.1}",
             "preprocessing": "{cutoff_hz: 8}", "contacts": "[{frame: sole, type: flat}]", "device": "cpu"}  # fmt: skip
    if chance(0.5):
        lines = [
            f"{key}:{_yaml(chance, 3, '  ') if chance(0.1) else f' {value}' + chr(10)}" for key, value in whole.items()
        ]
    else:
        lines = [f"{chance.of(KEYS)}:{_yaml(chance, 4, '  ')}" for _ in range(1 + chance.below(8))]
    if chance(0.03):
        lines.insert(
            chance.below(len(lines)),
            chance.of(["---\n", "...\n", "%YAML 1.1\n---\n", "%TAG ! x\n", "\t\n", "# \x1b\n", "\ufeff"]),
        )
    path.write_bytes("".join(lines).encode("utf-8", "surrogatepass"))
    return path


def override(chance: Chance) -> str:
    """What may stand on the command line."""
    key = ".".join(chance.of(KEYS) for _ in range(1 + chance.below(4)))
    return (
        (key if chance(0.8) else chance.word())
        + ("=" if chance(0.97) else "")
        + (f"{chance.of(TAGS)} " if chance(0.1) else "")
        + (chance.of(SCALARS) if chance(0.7) else _yaml(chance, 2, " "))
    )


# ----------------------------------------------------------------------------------------------------------------- runs


def parameters(whole: dict[str, Any]) -> Callable[[Chance, Path], Path]:
    """Results of a run with other values anywhere in their tree."""

    def grow(chance: Chance, folder: Path) -> Path:
        path = folder / "grown.json"

        def leaf() -> Any:
            return chance.of([None, True, 1, -1.5, 1e308, 10**400, "x", chance.word(), float("nan"), [], {}])

        def changed(value: Any, share: float) -> Any:
            if chance(share):
                return tree(chance, 3, leaf)
            if isinstance(value, dict):
                return {key if chance(1.0 - share) else chance.word(): changed(x, share) for key, x in value.items()}
            return [changed(x, share) for x in value] if isinstance(value, list) else value

        text = json.dumps(
            changed(whole, chance.of([0.0001, 0.001, 0.02])), ensure_ascii=chance(0.5), indent=chance.of([None, 1])
        )
        path.write_bytes(text.encode(chance.of(["utf-8", "utf-8", "utf-8", "utf-16"]), "surrogatepass"))
        return path

    return grow


def checkpoint(chance: Chance, folder: Path) -> Path:
    """States of any tree, or archives with any instructions of pickles."""
    path = folder / "checkpoint.pt"

    def plain() -> Any:
        return chance.of([1, 1.5, "x", None, torch.zeros(chance.below(5)), chance.word(), (1, 2)])

    def leaf() -> Any:
        return chance.of(
            [
                1,
                1.5,
                "x",
                None,
                torch.zeros(chance.below(5)),
                torch.ones(2, 2, dtype=torch.int32),
                chance.word(),
                b"x",
                (1, 2),
                torch.zeros(3).to_sparse(),
                torch.zeros(1).expand(9),
                torch.empty(2, device="meta"),
            ]
        )

    if chance(0.2):
        save_checkpoint(folder, {"state": tree(chance, 4, plain)})
        return path
    if chance(0.5):
        torch.save(tree(chance, 4, leaf), path)
        if chance(0.5):
            path.write_bytes(chance.spliced(path.read_bytes(), path.read_bytes()))
        return path
    codes = b"".join(chance.of([b"(", b"t", b"}", b"]", b"N", b"K\x05", b"X\x03\x00\x00\x00abc", b"q\x00", b"h\x00", b"ctorch._utils\n_rebuild_tensor_v2\n", b"ccollections\nOrderedDict\n", b"cos\nsystem\n", b"R",
                                b"\x81", b"b", b"Q", b"s", b"u", b"a", b"e", b"0", b"1", b"2", b"\x85", b"\x86", b"\x87", b"G" + bytes(8), b"\x8a\x01\x05", b"P1\n", b"I99\n", b"\x94", b"\x93"]) for _ in range(chance.below(60)))  # fmt: skip
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in (
            ("a/data.pkl", b"\x80\x02" + codes + b"."),
            ("a/version", b"3\n"),
            ("a/byteorder", chance.of([*[b"little"] * 9, b"big", b"x"])),
            ("a/data/0", chance.bytes(64)),
        ):
            if chance(0.95):
                archive.writestr(name, content)
    path.write_bytes(stream.getvalue())
    return path
