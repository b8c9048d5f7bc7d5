"""Experiment files and overrides that nobody should trust."""

from __future__ import annotations

import base64
import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from hostile_logs import Cases, mutations

BASE: dict[str, Any] = {
    "robot": {"urdf": "robot.urdf", "base_link": "base", "fixed_base": False},
    "contacts": [{"frame": "l_sole", "type": "flat", "line_axis": "y"}, {"frame": "r_sole", "type": "point"}],
    "logs": {"train": ["a.npz", "b.npz"], "test": ["c.npz"], "validation": []},
    "preprocessing": {"cutoff_hz": 8.0, "sample_rate_hz": 200},
    "sensors": {
        "joint_torques": ["hip"],
        "contact_wrenches": {"l_sole": ["fx", "fz"]},
        "noise": {"joint_torque": 0.1, "contact_force": 0.5},
        "on_base_lost": "error",
    },
    "estimator": {
        "name": "sgd",
        "ridge": 0.001,
        "frozen": ["base"],
        "bounds": None,
        "symmetry": None,
        "consistency": "penalties",
        "penalties": {"mass": 1.0},
        "training": {"epochs": 3, "optimizer": {"name": "Adam", "lr": 0.05}, "schedule": None, "seed": 1},
    },
    "analysis": {"scenarios": {"stand": [["l_sole"]]}, "costs": {"hip": 2.0}, "compare": {"x": "full"}},
    "output": "runs/x",
    "device": "cpu",
    "overwrite": False,
}

#: Values of every kind that YAML can spell, as it spells them.
VALUES = (
    *("null", "''", "-1", ".nan", "1e400", "1e308", "0x" + "f" * 4000, "9" * 4900, "1:" * 100 + "1", "１２", "[]", "[[]]"),
    *("[1, a, {}]", "{1: 2}", "{null: 1}", "{[a]: 1}", "{'': 1}", "{a.b: 1}", "{'a[0]': 1}", "2020-01-01", "'???'"),
    *("'/etc/passwd'", "'/dev/zero'", "'~nobody_here/x'", "'..'", "'/'", "'https://example.com/x'", "'file:///etc/passwd'"),
    *("'$HOME'", "'$(touch pwned)'", "'%s%n'", "'{0}'", "'${oc.env:HOME}'", "'${output}'", "'${'", "'\\${x}'"),
    *(r'"a\nb"', r'"a\0b"', r'"\e[2Jx"', r'"\u202Ex"', r'"\uD800"', r'"\x85"', "'" + "a/" * 2400 + "'", "'[red]x[/red]'"),
    *("'[a-'", "'**'", "' a '", "'-x'", "!!binary AAAA", "!!set {a, b}", "!!omap [a: 1]", "!!float x", "!local x"),
    *("!!python/object/apply:os.system ['touch pwned']", "!!python/name:os.system", "&a [*a]", "*nothing", "{<<: [1]}"),
    *("|\n  a\n  b", "[", "{", "'", '"'),
)  # fmt: skip


def documents(folder: Path) -> Cases:
    """Whole files made by hand."""
    for name, content in DOCUMENTS.items():
        path = folder / "experiment.yaml"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        yield name, path


def wrong_values(folder: Path, count: int, seed: int) -> Cases:
    """Something unfit in a random place of a valid file, as often as asked."""
    rng, places = np.random.default_rng(seed), list(places_in(BASE))
    for number in range(count):
        place, value = places[rng.integers(len(places))], VALUES[number % len(VALUES)]
        path = folder / "experiment.yaml"
        path.write_text(_with(place, value))
        yield f"{'.'.join(map(str, place))}: {value[:40]}", path


def damaged(folder: Path, count: int, seed: int) -> Cases:
    """A valid file cut off, with bits flipped, or with bytes replaced."""
    whole = yaml.safe_dump(BASE, sort_keys=False).encode()
    return mutations(folder / "experiment.yaml", [whole], count, np.random.default_rng(seed))


def overrides(count: int, seed: int) -> Iterator[tuple[str, list[str]]]:
    """What may stand after the file on the command line."""
    yield from ((text[:40], [text]) for text in OVERRIDES)
    rng, places = np.random.default_rng(seed), list(places_in(BASE))
    for number in range(count):
        place, value = places[rng.integers(len(places))], VALUES[number % len(VALUES)]
        key = ".".join(map(str, place)) if rng.random() < 0.7 else "".join(f"[{part}]" for part in place)
        yield f"{key}={value[:40]}", [f"{key}={value}"]


def places_in(value: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Keys and indices that lead to every value inside mappings and sequences."""
    if place:
        yield place
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, (list, tuple)) else ()
    for key, item in items:
        yield from places_in(item, (*place, key))


def _with(place: tuple[str | int, ...], value: str) -> str:
    """The valid file with a text in one place."""
    settings = copy.deepcopy(BASE)
    at: Any = settings
    for key in place[:-1]:
        at = at[key]
    at[place[-1]] = "HERE"
    return yaml.safe_dump(settings, sort_keys=False, default_flow_style=None, width=10**6).replace("HERE", value)


def _laughs(one: str, of: str, levels: int = 30, times: int = 10) -> str:
    """Aliases of aliases."""
    lines = [f"a0: &a0 {one}"]
    lines += [f"a{k + 1}: &a{k + 1} {of.format(', '.join([f'*a{k}'] * times))}" for k in range(levels)]
    return "\n".join(lines)


_PLAIN = yaml.safe_dump(BASE, sort_keys=False)
_ECHO = "\n".join(["x0: aaaaaaaaaa", *(f"x{k + 1}: '{'${x' + str(k) + '}'}{'${x' + str(k) + '}'}'" for k in range(60))])
DOCUMENTS: dict[str, str | bytes] = {
    "nothing": "",
    "null": "null",
    "a list": "[a, b]",
    "a text of ten megabytes": "a" * 10**7,
    "NUL": b"output: a\0b\n",
    "zeros": bytes(10**6),
    "not UTF-8": b"output: \xff\xfe\n",
    "UTF-16": _PLAIN.encode("utf-16"),
    "a byte order mark": b"\xef\xbb\xbf" + _PLAIN.encode(),
    "a cut letter": _PLAIN.encode() + b"# \xc3",
    "tabs": _PLAIN.replace("  ", "\t"),
    "two documents": f"{_PLAIN}---\n{_PLAIN}",
    "a directive for tags": f"%TAG ! tag:yaml.org,2002:python/object/apply:\n---\n{_PLAIN}x: !os.system [a]\n",
    "a key twice": f"{_PLAIN}output: b\n",
    "a key deep down twice": "robot: {urdf: a, urdf: b}",
    "keys that are numbers": "1: 2\n3: 4\n",
    "keys that are mappings": "{a: b}: 1\n",
    "a key of 100000 letters": "a" * 100_000 + ": 1\n",
    "a key with an escape": '"\\e[2J": 1\n',
    "100000 keys": "\n".join(f"k{k}: 1" for k in range(100_000)),
    "4000 keys": "\n".join(f"k{k}: 1" for k in range(4_000)),
    "4900 numbers": _PLAIN + "x: [" + "1, " * 4900 + "]",
    "100000 brackets": "a: " + "[" * 100_000 + "]" * 100_000,
    "100000 braces": "a: " + "{a: " * 100_000 + "}" * 100_000,
    "100000 anchors": "a: " + "&a " * 100_000,
    "a staircase": "\n".join(f"{' ' * k}a:" for k in range(1400)),
    "lists that laugh": _laughs("x", "[{}]"),
    "merges that laugh": _laughs("{x: 1}", "{{<<: [{}]}}", 100, 2),
    "texts that echo": _ECHO,
    "an echo in a circle": "output: '${device}'\ndevice: '${output}'\n",
    "an echo of the world": _PLAIN.replace("runs/x", "${oc.env:HOME}"),
    "an echo in brackets": "output: '" + "${a" * 500 + "}" * 500 + "'",
    "a list in itself": "a: &a [*a]",
    "a key that is itself": "&a {*a : 1}",
    "a tag that runs": "output: !!python/object/apply:os.system ['touch pwned']",
    "a tag that runs, in a key": "!!python/object/apply:os.system ['touch pwned']: 1",
    "a tag that makes": "robot: !!python/object:torchid.config.robot.RobotConfig {urdf: a}",
    "binary": f"output: !!binary {base64.b64encode(bytes(3000)).decode()}",
    "a word for a mapping": "robot: x\nlogs: y\nsensors: 3\noutput: z\n",
    "a mapping for everything": "\n".join(f"{key}: {{a: 1}}" for key in BASE),
}
OVERRIDES = (
    *("=", "=1", "a", "", ".=1", "a..b=1", "[0]=1", "a[=1", "a[0=1", "a[-1]=1", "contacts[99999999999]=1", "contacts[x].frame=1"),
    *("logs.train.5=a", "output[0]=1", "output.a=1", "robot=1", "robot.urdf.x=1", "a." * 50_000 + "a=1", "a" * 10**6 + "=1"),
    *("output=" + "a" * 10**6, "output=" + "[" * 10**5, "output=${oc.env:HOME}", "${output}=1", "output=${a", "output=$HOME"),
    *("output=!!python/object/apply:os.system ['touch pwned']", "output=&a [*a]", "output='a", "output=\n", "out\nput=a"),
    *("output=\0", "\0=1", "\x1b[2J=1", "\udcff=a", "--output=a=b", "output=", "output=~nobody_here/x", "output=..", "output=/"),
    *("output=/dev/null", "sensors=[]", "sensors.noise.joint_torque=x", "sensors.set.a=1", "estimator={name: [1]}"),
)  # fmt: skip
