"""The text of a settings file: bounds on what YAML may unfold to, where it is no YAML, and how values are written."""

from __future__ import annotations

import re
from typing import Any

import yaml

from torchid.errors import excerpt, is_plain
from torchid.guards import MAX_DEPTH, MAX_NODES, MAX_TEXT, MAX_YAML

_LOADER: type = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_TAG, _MAX_ALIASES = "tag:yaml.org,2002:", 100
_FLOAT = re.compile(
    r"[-+]?([0-9][0-9_]*\.[0-9_]*([eE][-+]?[0-9]+)?|[0-9][0-9_]*[eE][-+]?[0-9]+|\.[0-9_]+([eE][-+]?[0-9]+)?"
    r"|\.(inf|Inf|INF))$|\.(nan|NaN|NAN)$"
)
#: Characters that YAML keeps for itself, and what its reader says of them.
_RESERVED, _CANNOT_BEGIN = "%@`", "cannot start any token"
_WIDTH = 114  # of a line that is written, without its indent
_BRACKETS = '; names with brackets take quotes in a list: ["walk.npz[0:30]"]'


def check_yaml(text: str) -> None:
    """Refuse YAML that unfolds beyond bounds, tags, control characters, and interpolations `${...}`.

    Raises:
        ValueError, yaml.YAMLError: what was found.
    """
    if len(text) > MAX_YAML:
        raise ValueError(f"more than {MAX_YAML} bytes")
    entries = aliases = 0
    anchored: list[bool] = []  # of the collections that are open
    for event in yaml.parse(text, Loader=_LOADER):
        if isinstance(event, yaml.AliasEvent):
            aliases += 1
            if any(anchored) or aliases > _MAX_ALIASES:
                raise ValueError(f"'*{excerpt(str(event.anchor))}' within what has a name, or {_MAX_ALIASES} aliases")
        elif isinstance(event, yaml.CollectionStartEvent):
            anchored.append(event.anchor is not None)
            if len(anchored) > MAX_DEPTH:
                raise ValueError(f"nested more than {MAX_DEPTH} deep")
        elif isinstance(event, yaml.CollectionEndEvent):
            anchored.pop()
        _check_node(event)
        entries += isinstance(event, yaml.NodeEvent)
        if entries > MAX_NODES:
            raise ValueError(f"more than {MAX_NODES} entries")


def _check_node(event: yaml.Event) -> None:
    if isinstance(event, yaml.ScalarEvent):
        check_text(event.value)
    tag = getattr(event, "tag", None)
    if tag not in (None, "!"):
        raise ValueError(f"the tag '{excerpt(tag)}', which settings have no use for")


class _SettingsLoader(_LOADER):  # type: ignore[misc]
    """YAML with the numbers of version 1.2 (1e-3), without dates, and each key once in a mapping."""

    yaml_implicit_resolvers = {  # noqa: RUF012
        first: [(tag, pattern) for tag, pattern in found if tag not in (f"{_TAG}timestamp", f"{_TAG}float")]
        for first, found in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = set()
        for key_node, _ in node.value:
            key = (key_node.tag, key_node.value) if isinstance(key_node, yaml.ScalarNode) else key_node
            if key in keys:
                problem = f"found duplicate key {excerpt(str(key_node.value))}"
                raise yaml.constructor.ConstructorError(None, None, problem, key_node.start_mark)
            keys.add(key)
        return super().construct_mapping(node, deep)


_SettingsLoader.add_implicit_resolver(f"{_TAG}float", _FLOAT, list("-+0123456789."))


def load_yaml(text: str) -> Any:
    """The value of a YAML text, whose bounds `check_yaml` has checked. Raises yaml.YAMLError, ValueError, TypeError."""
    return yaml.load(text, Loader=_SettingsLoader)


def check_text(value: str) -> None:
    """Refuse a text that no setting can be: too long, with control characters, or with an interpolation.

    Raises:
        ValueError: what was found.
    """
    if len(value) > MAX_TEXT:
        raise ValueError(f"a text of {len(value)} characters, more than {MAX_TEXT}")
    if not is_plain(value.replace("\n", "")):
        raise ValueError(f"'{excerpt(value)}', with a control character")
    if "${" in value:
        raise ValueError(f"'{excerpt(value)}', but ${{...}} stands for nothing here")


def explain_syntax(error: yaml.MarkedYAMLError, text: str, wanted: str) -> tuple[str, str]:
    """What a reader of YAML found, by line, and what is accepted in its place; `wanted`: what the text should be."""
    mark, lines = error.problem_mark or error.context_mark, text.splitlines()
    if mark is None:
        return excerpt(str(error)), wanted
    line, where = lines[mark.line] if mark.line < len(lines) else "", f"line {mark.line + 1}"
    shown = excerpt(line.strip())
    if "\t" in line[: len(line) - len(line.lstrip())]:
        return f"{where}: a tab before '{shown}'", "spaces in front of a key"
    begins = line[mark.column : mark.column + 1]
    if _CANNOT_BEGIN in str(error.problem) and begins in _RESERVED:
        return f"{where}: '{excerpt(begins)}', which no value begins with, in '{shown}'", "such a value in quotes"
    why = f"{error.problem} {error.context}" if error.context else str(error.problem)
    if error.context_mark is not None and error.context_mark.line != mark.line:
        why += f" from line {error.context_mark.line + 1} on"
    found = f"{where}, column {mark.column + 1}: {why}" + f", in '{shown}'" * bool(shown)
    return found, wanted + _BRACKETS * ("flow sequence" in why)


def inline_yaml(value: object) -> str:
    """A value on one line, as YAML."""
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**6, allow_unicode=True)
    return text.removesuffix("\n").removesuffix("\n...")


def yaml_lines(key: str, value: object) -> list[str]:
    """A key with its value, short ones on one line; a column alone is its name."""
    if isinstance(value, dict) and set(value) == {"column"}:
        value = value["column"]
    line = f"{key}: {inline_yaml(value)}"
    if len(line) <= _WIDTH or not isinstance(value, (dict, list)):
        return [line]
    block = yaml.safe_dump({key: value}, default_flow_style=None, sort_keys=False, width=_WIDTH, allow_unicode=True)
    return block.splitlines()
