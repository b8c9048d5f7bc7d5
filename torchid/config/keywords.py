"""Sections of an experiment file as Python has them: mappings, lists, paths and numbers of any library."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import numpy as np

from torchid.config.reading import Settings
from torchid.config.yaml_text import check_text
from torchid.errors import ConfigError, excerpt
from torchid.guards import MAX_DEPTH
from torchid.logs import Log

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
    accepted = f"{_ACCEPTED}; torchid.write_log makes a file of a Log" if isinstance(value, Log) else _ACCEPTED
    raise ConfigError.at_field(field, f"found {excerpt(' '.join(repr(value).split()))}", accepted)
