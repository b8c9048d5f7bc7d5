"""Settings files of any kind: bounded YAML, overrides and mappings into a validated dataclass, errors in one line."""

from __future__ import annotations

import dataclasses
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from difflib import get_close_matches
from fnmatch import fnmatch
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Generic, Literal, TypedDict, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import yaml
from pydantic import TypeAdapter, ValidationError

from torchid.errors import ConfigError, UnknownNameError, about_file, during, excerpt, is_plain
from torchid.guards import MAX_DEPTH, MAX_NODES, MAX_TEXT, MAX_YAML, read_bytes
from torchid.logs import Log
from torchid.logs.containers import READABLE
from torchid.settings import accepted_values

_LOADER: type = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_TAG = "tag:yaml.org,2002:"
_MAX_ALIASES = 100
_FLOAT = re.compile(
    r"[-+]?([0-9][0-9_]*\.[0-9_]*([eE][-+]?[0-9]+)?|[0-9][0-9_]*[eE][-+]?[0-9]+|\.[0-9_]+([eE][-+]?[0-9]+)?"
    r"|\.(inf|Inf|INF))$|\.(nan|NaN|NAN)$"
)
_RESERVED = "%@`"  # characters that YAML keeps for itself
_CANNOT_BEGIN = "cannot start any token"  # what its reader says of them
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
                raise ValueError(f"'*{excerpt(str(event.anchor))}' inside an anchor, or over {_MAX_ALIASES} aliases")
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
        raise ValueError(f"the tag '{excerpt(tag)}' is not supported")


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
        raise ValueError(f"a text of {len(value)} characters (at most {MAX_TEXT})")
    if not is_plain(value.replace("\n", "")):
        raise ValueError(f"'{excerpt(value)}' has a control character")
    if "${" in value:
        raise ValueError(f"'{excerpt(value)}': ${{...}} is not supported")


def explain_syntax(error: yaml.MarkedYAMLError, text: str, wanted: str) -> tuple[str, str]:
    """What a reader of YAML found, by line, and what is accepted in its place; `wanted`: what the text should be."""
    mark = error.problem_mark or error.context_mark
    lines = text.splitlines()
    if mark is None:
        return excerpt(str(error)), wanted
    line = lines[mark.line] if mark.line < len(lines) else ""
    where = f"line {mark.line + 1}"
    shown = excerpt(line.strip())
    if "\t" in line[: len(line) - len(line.lstrip())]:
        return f"{where}: a tab before '{shown}'", "spaces before a key"
    begins = line[mark.column : mark.column + 1]
    if _CANNOT_BEGIN in str(error.problem) and begins in _RESERVED:
        return f"{where}: a value cannot begin with '{excerpt(begins)}', in '{shown}'", "the value in quotes"
    why = f"{error.problem} {error.context}" if error.context else str(error.problem)
    if error.context_mark is not None and error.context_mark.line != mark.line:
        why += f" from line {error.context_mark.line + 1} on"
    reason = f"{where}, column {mark.column + 1}: {why}" + f", in '{shown}'" * bool(shown)
    return reason, wanted + _BRACKETS * ("flow sequence" in why)


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


#: What YAML raises at a value that is not what its tag or its key says.
_NO_YAML = (yaml.YAMLError, ValueError, TypeError, AttributeError, LookupError, ArithmeticError, RecursionError)
_LONGEST = 300  # characters of another package's message that a message of ours repeats
_KEY = re.compile(r"[^.\[\]]+(\.[^.\[\]]+|\[[^.\[\]]+\])*")
_LONGEST_NAME = 255  # bytes, of file systems
_LONGEST_PATH = 4095

T = TypeVar("T")
Settings = dict[str, Any]


def _as_is(settings: Settings, _: Settings) -> Settings:
    return settings


@dataclasses.dataclass(frozen=True)
class FileKind(Generic[T]):
    """One kind of settings file: its dataclass, its paths, and its words in messages.

    Attributes:
        settings: the pydantic dataclass of the whole file. Those inside it may lie in lists, in mappings and in
            `X | None`, but in no other union: a message could not tell which keys are accepted.
        name: of the kind, as in "a YAML experiment file".
        keys: the chief keys, as in "a mapping with robot, logs, ...".
        list_example: an override that gives a list as a whole.
        paths: keys that hold a path, such as `robot.urdf`; `logs.train.*` is every item of the list `logs.train`.
        outputs: keys that hold the path of a result.
        prepare: takes settings and those that will override them, and returns the settings to merge; it is called for
            the file and nothing, then, for each override, for all before and it, and for it and nothing.
        accepted: the accepted values in messages, by key (`*` for a name from the file), where the type alone says
            too little.
    """

    settings: type[T]
    name: str
    keys: str
    list_example: str
    paths: Sequence[str] = ()
    outputs: Sequence[str] = ()
    prepare: Callable[[Settings, Settings], Settings] = _as_is
    accepted: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def accepted_at(self, key: Sequence[str], otherwise: str) -> str:
        """What is accepted at a key."""
        for pattern, accepted in self.accepted.items():
            parts = pattern.split(".")
            if len(parts) == len(key) and all(map(fnmatch, key, parts)):
                return accepted
        return otherwise


def load(kind: FileKind[T], path: Path | None, overrides: Sequence[str] = (), sections: Settings | None = None) -> T:
    """Read and check a settings file, or the same settings without a file.

    Args:
        kind: of the file.
        path: the YAML file; paths of inputs in it are relative to it, those of results to the working directory.
        sections: plain values by key of the file, merged as overrides are, before them.
        overrides: `key.subkey=value`, the value in YAML, one after the other; paths in them are relative to the working
            directory. A mapping adds to what is there, unless it is empty: `key={}` clears it.

    Raises:
        ConfigError: unreadable file, a value of the wrong kind, a missing key.
        UnknownNameError: a key that does not exist; the message names the nearest that do.
    """
    with nullcontext() if path is None else during("reading", path):
        return _load(kind, path, overrides, sections or {})


def _load(kind: FileKind[T], path: Path | None, overrides: Sequence[str], sections: Settings) -> T:
    settings: Settings = {}
    if path is not None:
        in_file = _absolute(_read(kind, path), kind.paths, path.resolve().parent)
        settings = kind.prepare(_absolute(in_file, kind.outputs, Path.cwd()), {})
    for key, value in sections.items():
        try:
            settings = _merged(kind, settings, _from_here(kind, {key: value}))
        except TypeError as error:
            raise ConfigError.at_field(key, f"found {_repr(value)}", f"a value of a YAML {kind.name} file") from error
    for text in overrides:
        with about_file("command line"):
            given = _from_here(kind, _parsed(text))
        try:
            settings = _merged(kind, settings, given)
        except TypeError as error:
            accepted = f"key.subkey=value; a whole list: '{kind.list_example}'"
            raise ConfigError("command line", excerpt(text), "does not match the file", accepted) from error
    try:
        return TypeAdapter(kind.settings).validate_python(settings)
    except ValidationError as error:
        raise _in_one_line(kind, error) from error


def _from_here(kind: FileKind[T], given: Settings) -> Settings:
    """Settings with their paths relative to the working directory."""
    return _absolute(given, (*kind.paths, *kind.outputs), Path.cwd())


def _merged(kind: FileKind[T], settings: Settings, given: Settings) -> Settings:
    return _added(kind.prepare(settings, given), kind.prepare(given, {}))


def _added(settings: Settings, given: Settings) -> Settings:
    """The settings with those that are given; TypeError where these name items of a list."""
    out = dict(settings)
    for key, value in given.items():
        before = out.get(key)
        if isinstance(value, dict) and isinstance(before, list):
            raise TypeError(key)
        adds = isinstance(value, dict) and isinstance(before, dict) and bool(value)
        out[key] = _added(before, value) if adds else value  # type: ignore[arg-type]
    return out


def dump_config(settings: object) -> str:
    """The resolved settings, a dataclass of any kind, as YAML; `load` reads it back."""
    return yaml.safe_dump(TypeAdapter(type(settings)).dump_python(settings, mode="json"), sort_keys=False)


def _read(kind: FileKind[T], path: Path) -> Settings:
    try:
        loaded = text = read_bytes(path, MAX_YAML).decode()
        if not text.lstrip().startswith("<"):  # XML, which a colon in a comment makes a mapping
            check_yaml(text)
            loaded = load_yaml(text)
    except OSError as error:
        raise ConfigError(path, "file", f"cannot be read ({error.strerror})", f"a YAML {kind.name} file") from error
    except yaml.MarkedYAMLError as error:
        raise _no_settings(kind, path, *explain_syntax(error, text, "a YAML mapping")) from error
    except _NO_YAML as error:
        raise _no_settings(kind, path, f"not readable: {_why(error)}", "a YAML mapping") from error
    if not isinstance(loaded, dict):
        reason = "a list" if isinstance(loaded, list) else f"text, {excerpt(text.strip(), 40)}"
        raise _no_settings(kind, path, reason, f"a mapping with {kind.keys}")
    return loaded


def _no_settings(kind: FileKind[T], path: Path, reason: str, accepted: str) -> ConfigError:
    if path.suffix.lower() in READABLE:
        return ConfigError(path, "file", f"a log, not a settings file ({kind.keys})", f"a YAML {kind.name} file")
    return ConfigError(path, "YAML", reason, accepted)


def _why(error: Exception) -> str:
    """The cause of an error in reading YAML, in the words of its reader where these are made for users."""
    if isinstance(error, UnicodeDecodeError):
        return "not a text file"
    spoken = isinstance(error, (yaml.YAMLError, ValueError))
    return excerpt(str(error) if spoken else f"{type(error).__name__}: {error}", _LONGEST)


def _parsed(text: str) -> Settings:
    key, equals, value = text.partition("=")
    if not equals:
        raise ConfigError.at_field(excerpt(text), "not a setting", "key.subkey=value")
    try:
        check_yaml(key)
        check_yaml(value)
        if key.count(".") + key.count("[") > MAX_DEPTH:
            raise ValueError(f"nested more than {MAX_DEPTH} deep")
        if not _KEY.fullmatch(key):
            raise ValueError(f"'{excerpt(key)}' is not a key")
        settings = load_yaml(value)
        for name in reversed(re.split(r"[.\[]", key.replace("]", ""))):
            settings = {name: settings}
        return settings
    except yaml.MarkedYAMLError as error:
        raise ConfigError.at_field(excerpt(text), *explain_syntax(error, value, "key.subkey=value")) from error
    except _NO_YAML as error:
        raise ConfigError.at_field(excerpt(text), _why(error), "key.subkey=value, in YAML") from error


def _absolute(settings: Settings, keys: Sequence[str], folder: Path) -> Settings:
    for key in keys:
        try:
            settings = _absolute_at(settings, key.split("."), folder)
        except (RuntimeError, ValueError) as error:
            raise ConfigError.at_field(key.removesuffix(".*"), str(error), "a path") from error
    return settings


def _absolute_at(value: Any, key: Sequence[str], folder: Path) -> Any:
    """The value with the path at a key made absolute; values of another type are left to the validation."""
    if not key:
        return _absolute_path(value, folder) if isinstance(value, str) else value
    name, *below = key
    if name == "*":
        return [_absolute_at(item, below, folder) for item in value] if isinstance(value, list) else value
    if isinstance(value, Mapping) and name in value:
        return {**value, name: _absolute_at(value[name], below, folder)}
    return value


def _absolute_path(value: str, folder: Path) -> str:
    """Raises ValueError or RuntimeError (the home folder of nobody) where the value names no file."""
    if "://" in value:
        raise ValueError(f"'{excerpt(value)}' is a URL (download it first)")
    path = os.path.normpath(folder / Path(value).expanduser())
    names = [len(os.fsencode(name)) for name in Path(path).parts]
    too_long = max(names) > _LONGEST_NAME or sum(names) + len(names) > _LONGEST_PATH
    if not value.strip() or not Path(path).name or not is_plain(value) or too_long:
        raise ValueError(f"'{excerpt(value)}' is not a file or folder name")
    return path


def _in_one_line(kind: FileKind[T], error: ValidationError) -> ConfigError | UnknownNameError:
    """The first validation error as one line; an unknown key first, the likeliest cause of the others."""
    complaints = sorted(error.errors(), key=lambda e: e["type"] != "unexpected_keyword_argument")
    first = complaints[0]
    key = [str(part) for part in first["loc"] if part != "[key]"]
    field = ".".join(key)
    if first["type"] == "unexpected_keyword_argument":
        keys = _keys_at(kind.settings, key[:-1])
        elsewhere = list(_keys_named(key[-1], kind.settings))
        valid = [*get_close_matches(key[-1], keys, cutoff=0.5), *elsewhere] if elsewhere else keys
        return UnknownNameError.at_field(".".join(key[:-1]) or "key", key[-1], valid)
    missing = [list(map(str, e["loc"])) for e in complaints if e["type"] == "missing"]
    if missing:
        accepted_by_key = {".".join(x): kind.accepted_at(x, _described(_hint_at(kind.settings, x))) for x in missing}
        named = accepted_by_key.values() if len(accepted_by_key) == 1 else map(": ".join, accepted_by_key.items())
        return ConfigError.at_field(", ".join(accepted_by_key), "missing", "; ".join(named))
    if first["type"] == "too_short" and not first["input"]:
        empty = "an empty mapping" if isinstance(first["input"], Mapping) else "an empty list"
        return ConfigError.at_field(field, empty, "at least one item")
    if first["type"] == "dataclass_type":
        accepted = f"a mapping with {', '.join(_keys_at(kind.settings, key))}"
    else:
        accepted = accepted_values(first)
    if first["type"] in ("dataclass_type", "dict_type", "list_type", "string_type"):
        accepted = kind.accepted_at(key, accepted)
    return ConfigError.at_field(field, f"found {_repr(first['input'])}", accepted)


def _repr(value: object) -> str:
    try:
        return excerpt(repr(value))
    except ValueError:  # Python spells no number of more than 4300 digits
        return f"a number of more than {sys.get_int_max_str_digits()} digits"


def _keys_at(settings: Any, key: Sequence[str]) -> list[str]:
    """Names of the keys accepted below a key of a dataclass."""
    return [field.name for field in dataclasses.fields(_hint_at(settings, key))]


def _hint_at(settings: Any, key: Sequence[str]) -> Any:
    """The type at a key of a dataclass, through `list[X]`, `dict[str, X]` and `X | None`."""
    hint = settings
    for part in key:
        hint = _not_none(get_type_hints(hint)[part] if dataclasses.is_dataclass(hint) else get_args(hint)[-1])
    return hint


def _keys_named(name: str, settings: Any, prefix: str = "") -> Iterator[str]:
    """All keys of a name in a dataclass and those inside it, for one that is written in the wrong mapping."""
    for key, hint in get_type_hints(settings).items():
        if key == name:
            yield prefix + key
        if dataclasses.is_dataclass(inner := _not_none(hint)):
            yield from _keys_named(name, inner, f"{prefix}{key}.")


def _described(hint: Any) -> str:
    """What a type accepts, in words."""
    if dataclasses.is_dataclass(hint):
        return f"a mapping with {', '.join(_keys_at(hint, ()))}"
    if get_origin(hint) is Literal:
        return ", ".join(map(str, get_args(hint)))
    plain = {str: "a name", Path: "a path", float: "a number", int: "a whole number", list: "a list", dict: "a mapping"}
    return plain.get(get_origin(hint) or hint, "a value")


def _not_none(hint: Any) -> Any:
    if get_origin(hint) not in (Union, UnionType):
        return hint
    return next(inner for inner in get_args(hint) if inner is not NoneType)


StrPath = str | os.PathLike[str]


class Sections(TypedDict, total=False):
    """The keys of an experiment file, with values as Python has them."""

    robot: StrPath | Mapping[str, object]
    logs: StrPath | Sequence[StrPath | Mapping[str, object]] | Mapping[str, object]
    sensors: str | Mapping[str, object]
    contacts: Sequence[Mapping[str, object]]
    preprocessing: Mapping[str, object]
    actuators: Mapping[str, object]
    estimator: Mapping[str, object]
    analysis: Mapping[str, object]
    figures: Mapping[str, object]
    device: str
    output: StrPath | None
    overwrite: bool


_ACCEPTED = "text, numbers, paths, and lists and mappings of them, as in an experiment file"


def plain_sections(sections: Mapping[str, object]) -> Settings:
    """Values by key as YAML would have given them.

    Raises:
        ConfigError: a value that no settings file can hold; the message names its key.
    """
    return {key: _plain(value, key, 0) for key, value in sections.items()}


def _plain(value: object, field: str, depth: int) -> Any:
    if depth > MAX_DEPTH:
        raise ConfigError.at_field(field, f"nested more than {MAX_DEPTH} deep", _ACCEPTED)
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    if isinstance(value, Mapping):
        return {key: _plain(x, f"{field}.{key}", depth + 1) for key, x in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(x, f"{field}.{number}", depth + 1) for number, x in enumerate(value)]
    if isinstance(value, str):
        try:
            check_text(value)
        except ValueError as error:
            raise ConfigError.at_field(field, str(error), _ACCEPTED) from error
        return str(value)
    if value is None or isinstance(value, (bool, int, float)):
        return value
    accepted = f"{_ACCEPTED}; write a Log to a file with torchid.write_log" if isinstance(value, Log) else _ACCEPTED
    raise ConfigError.at_field(field, f"found {excerpt(' '.join(repr(value).split()))}", accepted)
