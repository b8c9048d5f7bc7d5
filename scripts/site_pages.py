"""Pages of the site that other files hold: README and the like, every key, every message, every public name.

A hook of MkDocs (`mkdocs.yml`): `mkdocs serve` shows the site, `mkdocs build` writes it to `site/`.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import typing
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from torchid.config import ExperimentConfig

_ROOT = Path(__file__).resolve().parents[1]
_PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
_FLOWCHART = re.compile(r"^```mermaid\nflowchart TD\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)\s#]+)(#[^)]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made here."""
    made = {page: _relinked((_ROOT / name).read_text(), "") for name, page in _PAGES.items()}
    made |= {"keys.md": keys_page(), "messages.md": messages_page(), "reference.md": reference_page()}
    for name, text in made.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Let links to files that are no pages be text, and those to README and the like lead to their pages."""
    return _FLOWCHART.sub(_in_words, _relinked(markdown, "docs/"))


def _in_words(chart: re.Match[str]) -> str:
    """A flowchart as lines of text: whoever draws it in a browser asks another site for the program that does."""
    labels: dict[str, str] = {}
    leads: dict[str, list[str]] = {}
    for source, target in re.findall(r"^ +(.+?) --> (.+)$", chart.group(1), re.MULTILINE):
        names = []
        for node in (source, target):
            name, label = re.findall(r"^(\w+)(?:\[[/\"]*(.*?)[/\"]*\])?$", node)[0]
            labels[name] = label or labels.get(name, name)
            names.append(name)
        leads.setdefault(names[0], []).append(names[1])
    lines = [f"{labels[name]}\n    → {', '.join(others)}" for name, others in leads.items()]
    return "\n".join(["```text", *lines, "```"])


def _relinked(markdown: str, folder: str) -> str:
    def replaced(match: re.Match[str]) -> str:
        text, target, anchor = match.group(1), match.group(2), match.group(3) or ""
        if re.match(r"[a-z]+:", target):
            return match.group(0)
        path = (_ROOT / folder / target).resolve()
        if not path.is_relative_to(_ROOT):
            return match.group(0)
        name = path.relative_to(_ROOT).as_posix()
        if name in _PAGES:
            return f"[{text}]({_PAGES[name]}{anchor})"
        if name.startswith("docs/"):
            return f"[{text}]({name.removeprefix('docs/')}{anchor})"
        return text if "/" in name else match.group(0)

    return re.sub(r"(!\[[^\]]*\]\()docs/", r"\1", _LINK.sub(replaced, markdown))


# ------------------------------------------------------------------------------------------------------------ keys


def keys_page() -> str:
    """Every key of the experiment file, with what it accepts, its default and what it means."""
    parts = [
        "# Every key of the experiment file",
        "Defaults are those of a file without the key; required keys have none.",
    ]
    first: dict[Any, str] = {}  # block of keys: where it is described
    for prefix, block in _blocks(ExperimentConfig, ""):
        first.setdefault(block, prefix.removesuffix("."))
    for block, key in first.items():
        parts += [
            f"## {key or 'The file'} {{ #{_anchor(key)} }}",
            inspect.cleandoc(_described(block)),
            _table(block, key, first),
        ]
    return "\n\n".join(parts) + "\n"


def _blocks(block: Any, prefix: str, above: tuple[Any, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Blocks of keys by the key that holds them, each before those inside."""
    yield prefix, block
    hints = typing.get_type_hints(block)
    for field in dataclasses.fields(block):
        for inner in _inside(hints[field.name]):
            if inner not in above:
                yield from _blocks(inner, f"{prefix}{field.name}.", (*above, block))


def _inside(hint: Any) -> list[Any]:
    """Blocks of keys in a type."""
    if dataclasses.is_dataclass(hint):
        return [hint]
    return [block for part in typing.get_args(hint) for block in _inside(part)]


def _anchor(key: str) -> str:
    return key.replace(".", "-") or "file"


def _described(block: Any) -> str:
    """The docstring of a block, its attributes as a list."""
    text = inspect.getdoc(block) or ""
    return re.sub(r"^    (\w+): ", r"- `\1`: ", text.replace("Attributes:\n", "\n"), flags=re.MULTILINE)


def _table(block: Any, key: str, first: Mapping[Any, str]) -> str:
    """The keys of a block at some key, with a column of units if any is a number."""
    hints = typing.get_type_hints(block)
    rows = [
        (f"`{field.name}`", _accepted(hints[field.name], first), _default(field), _unit(f"{key}.{field.name}", hints))
        for field in dataclasses.fields(block)
    ]
    width = 4 if any(row[3] for row in rows) else 3
    lines = [("key", "accepts", "default", "unit"), ("---",) * 4, *rows]
    return "\n".join(f"| {' | '.join(line[:width])} |" for line in lines)


_SUFFIXES = {"_hz": "Hz", "_s": "s", "_seconds": "s", "_gb": "GB", "_deg": "deg"}
_FRICTION = "N m or N; N m s/rad or N s/m"
_UNITS = {
    "robot.weld": "rad or m",
    "robot.base_tilt": "rad",
    "robot.loops.max_gap": "m",
    "robot.loops.max_angle": "rad",
    "actuators.delay": "s",
    "logs.columns.joint_torque.current.torque_constant": "N m/A",
    "sensors.noise.joint_torque": "N m or N",
    **dict.fromkeys((f"sensors.noise.{x}_force" for x in ("contact", "base", "ft")), "N"),
    **dict.fromkeys((f"sensors.noise.{x}_moment" for x in ("contact", "base", "ft")), "N m"),
    "sensors.noise.joint_position": "rad or m",
    "sensors.noise.joint_velocity": "rad/s or m/s",
    "sensors.noise.base_orientation": "rad",
    "sensors.noise.angular_velocity": "rad/s",
    "sensors.noise.specific_force": "m/s²",
    "contacts.radius": "m",
    "preprocessing.max_slip": "m/s",
    **dict.fromkeys((f"preprocessing.detect_contacts.{x}" for x in ("touch", "lift", "light")), "robot's weight"),
    **dict.fromkeys((f"preprocessing.contact_threshold.{x}" for x in ("above", "below")), "N"),
    "actuators.sign_width": "rad/s or m/s",
    "actuators.stribeck": "rad/s or m/s",
    "estimator.bounds": f"kg, kg m, kg m²; {_FRICTION}",
    "estimator.robust.tuning": "standard deviations",
    **dict.fromkeys((f"estimator.total_mass.{x}" for x in ("value", "std")), "kg"),
    **dict.fromkeys((f"estimator.training.{x}" for x in ("epochs", "patience", "evaluate_every")), "epochs"),
    "estimator.training.batch_size": "samples",
    "analysis.costs": "cost of a channel",
    "logs.topics.contact_force_threshold": "N",
    "logs.topics.low_state.above": "counts",
    "logs.columns.time.step": "that of `unit`",
    "logs.columns.joint_position.turn_from": "that of `unit`",
    "logs.columns.joint_torque.pd.kp.value": "N m/rad or N/m, N m s/rad or N s/m",
    "logs.columns.contact_active.above": "that of `unit`",
    "logs.columns.plates.position": "m",
    "logs.payloads.mass": "kg",
    "logs.payloads.center_of_mass": "m",
    "logs.payloads.inertia": "kg m²",
}
"""Of keys with numbers by their path; those of `_SUFFIXES` say it themselves, all others are plain numbers."""


def _unit(key: str, hints: Mapping[str, Any]) -> str:
    """The unit of a key at a path; "1" for plain numbers and counts, nothing for what is no number."""
    name = key.rpartition(".")[2]
    known = _UNITS.get(key) or next((unit for end, unit in _SUFFIXES.items() if name.endswith(end)), "")
    return known or ("1" if _has_numbers(hints[name]) else "")


def _has_numbers(hint: Any) -> bool:
    return hint in (int, float) or any(_has_numbers(part) for part in typing.get_args(hint))


_PLAIN = {bool: "`true`, `false`", int: "integer", float: "number", str: "text", Path: "path", type(None): "`null`"}


def _accepted(hint: Any, first: Mapping[Any, str]) -> str:
    """A type in words."""
    if hint in first:
        return f"[block of keys](#{_anchor(first[hint])})"
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        return ", ".join(f"`{part}`" for part in parts)
    names = [_accepted(part, first) for part in parts if part is not ...]
    if origin is list:
        return f"list: {names[0]}"
    if origin is tuple:
        return f"list of {len(names)}: {names[0]}"
    if origin is dict:
        return f"mapping: {names[1]}"
    return " or ".join(dict.fromkeys(names)) if names else _PLAIN.get(hint, "anything")


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is not dataclasses.MISSING:
        return f"`{_yaml(field.default)}`"
    if field.default_factory is dataclasses.MISSING:
        return "required"
    made = field.default_factory()
    return "" if dataclasses.is_dataclass(made) else f"`{made}`"


def _yaml(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


# ------------------------------------------------------------------------------------------------------------ messages

_PACKAGE = _ROOT / "torchid"
_SEVERITIES = {"REJECTED": "rejected", "SUSPICIOUS": "suspicious", "NOTE": "note"}
_ERROR_CLASSES = ("LogError", "UrdfError", "ConfigError", "SensorError", "InputError", "ImplausibleFitError")
_MOST_ALTERNATIVES = 6
_FEWEST_WORDS = 4


def messages_page() -> str:
    """Every finding of `torchid check`, remark of `torchid identify` and error, read from the source of the package."""
    findings = dict.fromkeys(row for path in sorted((_PACKAGE / "log_checks").glob("*.py")) for row in _findings(path))
    remarks = dict.fromkeys(_remarks(_PACKAGE / "commands" / "answer.py"))
    errors = dict.fromkeys(row for path in sorted(_PACKAGE.rglob("*.py")) for row in _errors(path))
    tables = (
        ("Findings of `torchid check`", ("name", "severity", "torchid says", "what to do"), sorted(findings)),
        ("Remarks of `torchid identify`", ("torchid says",), [(remark,) for remark in remarks]),
        ("Errors", ("what is wrong", "what is accepted"), sorted(errors)),
    )
    parts = ["# Every message", '"…" stands for a name or a number. An error begins with the file and the field.']
    for title, columns, rows in tables:
        lines = [columns, ("---",) * len(columns), *rows]
        parts += [f"## {title}", "\n".join(f"| {' | '.join(map(_cell, line))} |" for line in lines)]
    return "\n\n".join(parts) + "\n"


def _cell(text: str) -> str:
    return re.sub(r"([|<>*_\[\]])", r"\\\1", text)


def _findings(path: Path) -> Iterator[tuple[str, str, str, str]]:
    """Name, severity, text and advice of each finding that a module makes."""
    for function in (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)):
        above = function.lineno
        for call in _calls(function, ("Finding",)):
            if len(call.args) >= 5:
                name, severity, _, found, advice = call.args[:5]
                said = [_alternatives(part, function, above, call.lineno) for part in (name, found, advice)]
                label = _SEVERITIES.get(ast.unparse(severity), "by size")
                yield said[0], label, said[1], said[2]
            above = call.lineno


def _remarks(path: Path) -> Iterator[str]:
    """Sentences of a module in its order."""
    tree = ast.parse(path.read_text())
    described = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    parts = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in ast.walk(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant | ast.JoinedStr) and id(node) not in described:
            text = _texts(node, {})[0] if isinstance(node, ast.JoinedStr) or id(node) not in parts else ""
            if _words(text) >= _FEWEST_WORDS and text[0] not in " ,;":
                yield text


def _errors(path: Path) -> Iterator[tuple[str, str]]:
    """What errors of a module say is wrong and is accepted."""
    for function in (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)):
        for call in _calls(function, _ERROR_CLASSES):
            if len(call.args) >= 3:
                wrong, accepted = (_alternatives(x, function, function.lineno, call.lineno) for x in call.args[-2:])
                if _words(wrong) + _words(accepted) >= _FEWEST_WORDS:
                    yield wrong, accepted


def _words(text: str) -> int:
    return sum(any(letter.isalpha() for letter in word) for word in text.split())


@cache
def _constants() -> dict[str, list[ast.expr]]:
    """Texts that modules of the log checks give a name."""
    trees = (ast.parse(path.read_text()) for path in (_PACKAGE / "log_checks").glob("*.py"))
    assigned = (node for tree in trees for node in tree.body if isinstance(node, ast.Assign))
    return {node.targets[0].id: [node.value] for node in assigned if isinstance(node.targets[0], ast.Name)}


def _calls(function: ast.FunctionDef, names: Sequence[str]) -> list[ast.Call]:
    """Calls of classes, or of their `at_field`, in a function from top to bottom."""
    calls = [node for node in ast.walk(function) if isinstance(node, ast.Call)]
    named = [call for call in calls if ast.unparse(call.func).removesuffix(".at_field") in names]
    return sorted(named, key=lambda call: call.lineno)


def _alternatives(node: ast.expr, function: ast.FunctionDef, above: int, line: int) -> str:
    """The texts that an argument of a call at a line may be; of names those assigned since the call `above`."""
    assigned: dict[str, list[tuple[int, ast.expr]]] = {}
    for statement in ast.walk(function):
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name) and statement.lineno < line:
            assigned.setdefault(statement.targets[0].id, []).append((statement.lineno, statement.value))
    known = dict(_constants())
    for name, values in assigned.items():
        recent = [value for number, value in values if number > above]
        known[name] = recent or [max(values, key=lambda value: value[0])[1]]
    return "; or: ".join(dict.fromkeys(_texts(node, known)))


def _texts(node: ast.expr, known: Mapping[str, list[ast.expr]]) -> list[str]:
    """What an expression may be as text; "…" for what only a run knows."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return [" ".join(node.value.split("\n"))]
    if isinstance(node, ast.JoinedStr):
        texts = [""]
        for part in node.values:
            inner = part.value if isinstance(part, ast.FormattedValue) else part
            texts = [text + more for text in texts for more in _texts(inner, known)]
        return texts[:_MOST_ALTERNATIVES]
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return [x + y for x in _texts(node.left, known) for y in _texts(node.right, known)][:_MOST_ALTERNATIVES]
    if isinstance(node, ast.IfExp):
        return _texts(node.body, known) + _texts(node.orelse, known)
    if isinstance(node, ast.Name) and node.id in known:
        others = {name: values for name, values in known.items() if name != node.id}
        return [text for value in known[node.id] for text in _texts(value, others)][:_MOST_ALTERNATIVES]
    return ["URDF" if re.fullmatch(r"(\w+\.)*(robot\.format|form|nominal_label)", ast.unparse(node)) else "…"]


# ------------------------------------------------------------------------------------------------------- public names


def reference_page() -> str:
    """The public names of `torchid`, by the module that they are from."""
    parts = [
        "# Reference",
        "The names that `import torchid` has. Arrays have the shapes and units that their descriptions give.",
    ]
    for node in ast.parse((_ROOT / "torchid" / "__init__.pyi").read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module:
            parts.append(f"## torchid.{node.module}")
            parts += [f"::: torchid.{node.module}.{name.name}" for name in node.names]
    return "\n\n".join(parts) + "\n"
