"""Text that is no YAML is refused in one line that says where, and what to write instead."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from torchid.config import load_config
from torchid.errors import ConfigError

HEAD = "robot: {urdf: x.urdf}\n"
TEXTS = {
    "logs:\n\ttrain: [a.npz]\n": "YAML: line 3: a tab before 'train: [a.npz]'; accepted: spaces in front of a key",
    "logs:\n  \ttrain: [a.npz]\n": "YAML: line 3: a tab before 'train: [a.npz]'",
    "logs: {train: [%a.npz]}\n": "line 2: '%', which no value begins with, in 'logs: {train: [%a.npz]}'",
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
