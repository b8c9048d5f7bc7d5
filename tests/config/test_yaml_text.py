"""Text that is no YAML is refused in one line that says where, and what to write instead."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from torchid.config import load_config
from torchid.config.settings_files import check_yaml, yaml_lines
from torchid.errors import ConfigError

HEAD = "robot: {urdf: x.urdf}\n"
TEXTS = {
    "logs:\n\ttrain: [a.npz]\n": "YAML: line 3: a tab before 'train: [a.npz]'; accepted: spaces before a key",
    "logs:\n  \ttrain: [a.npz]\n": "YAML: line 3: a tab before 'train: [a.npz]'",
    "logs: {train: [%a.npz]}\n": "line 2: a value cannot begin with '%', in 'logs: {train: [%a.npz]}'",
    "logs: train: [a.npz]\n": "line 2, column 12: mapping values are not allowed in this context, in 'logs: train: [",
    "logs: {train: [a.npz]\noutput: x\n": "did not find expected ',' or '}' while parsing a flow mapping from line 2",
    "logs: {train: [a.npz[0:3]]}\n": 'a YAML mapping; names with brackets take quotes in a list: ["walk.npz[0:30]"]',
    "output: 'x\n": "line 3, column 1: found unexpected end of stream while scanning a quoted scalar from line 2 on",
}


@pytest.mark.parametrize("text", TEXTS)
def test_what_is_no_yaml_is_said_with_its_line(tmp_path: Path, text: str) -> None:
    file = tmp_path / "experiment.yaml"
    file.write_text(HEAD + text)
    with pytest.raises(ConfigError, match=re.escape(TEXTS[text])) as raised:
        load_config(file)
    assert "\\n" not in str(raised.value), "one line of plain text"


@pytest.mark.parametrize("value", ["!!int x", "!!timestamp 2001-01-01", "!!python/name:os.system"])
def test_tags_are_refused(value: str) -> None:
    with pytest.raises(ValueError, match="the tag .* is not supported"):
        check_yaml(f"a: {value}")


VALUES = [
    *(
        "runs/a",
        3,
        None,
        {},
        {"ridge": 0.1, "name": "größe"},
        {"column": "t", "scale": 2.0},
        ["a b", "c"] * 3,
        "x " * 100,
    ),
    *([f"joint {k}" for k in range(40)], {f"key {k}": {"column": f"column {k}"} for k in range(40)}),
]


@pytest.mark.parametrize("value", VALUES, ids=lambda value: str(value)[:12])
def test_a_key_that_is_written_reads_back_and_its_lines_fit_a_screen(value: object) -> None:
    lines = yaml_lines("key", value)
    assert yaml.safe_load("\n".join(lines)) == {"key": value}
    assert isinstance(value, str) or max(map(len, lines)) <= 120
    assert len(lines) == 1 or len(str(value)) > 100, "short ones take one line"


def test_a_column_alone_is_its_name() -> None:
    assert yaml_lines("time", {"column": "t"}) == ["time: t"]
    assert yaml_lines("time", {"column": "t", "unit": "ms"}) == ["time: {column: t, unit: ms}"]
    assert yaml_lines("time", {"unit": "ms"}) == ["time: {unit: ms}"]
