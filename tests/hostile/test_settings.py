"""Experiment files and overrides of strangers: read or refused in one line, with nothing run and nothing looked up."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from hostile import examined, judged
from hostile_settings import BASE, damaged, documents, overrides, wrong_values

from torchid.config import load_analysis, load_config
from torchid.config.settings_files import check_yaml
from torchid.errors import ConfigError
from torchid.guards import MAX_DEPTH, MAX_NODES


def test_files_made_to_harm_are_refused(tmp_path: Path) -> None:
    """But for one with a mark of its encoding at the start."""
    tally = examined("settings", documents(tmp_path), load_config, tmp_path)
    assert tally.faults == []
    assert tally.accepted == ["a byte order mark"]


@pytest.mark.parametrize("load", [load_config, load_analysis])
def test_anything_anywhere_in_a_file_or_an_override_is_read_or_refused(
    tmp_path: Path, load: Callable[..., Any]
) -> None:
    tally = examined("settings", wrong_values(tmp_path, 80, seed=2), load, tmp_path)
    assert tally.faults == []
    assert 0.8 < tally.share("refused") < 1.0
    tally = examined("damaged settings", damaged(tmp_path, 30, seed=3), load, tmp_path)
    assert tally.faults == []
    assert tally.share("refused") > 0.8
    file = tmp_path / "experiment.yaml"
    file.write_text(yaml.safe_dump(BASE))
    tally = examined("overrides", overrides(30, seed=4), lambda given: load(file, given), tmp_path)
    assert tally.faults == []
    assert tally.share("refused") > 0.8


def test_no_setting_shows_what_stands_in_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SECRET", "hunter2")
    file = tmp_path / "experiment.yaml"
    file.write_text(yaml.safe_dump(BASE | {"output": "${oc.env:SECRET}"}))
    with pytest.raises(ConfigError) as caught:
        load_config(file)
    assert "hunter2" not in str(caught.value)
    file.write_text(yaml.safe_dump(BASE))
    with pytest.raises(ConfigError, match=r"\$\{\.\.\.\} is not supported"):
        load_config(file, ["output=${oc.env:SECRET}"])


def test_aliases_are_for_sharing_and_not_for_multiplying() -> None:
    check_yaml("a: &noise {joint_torque: 1}\nb: *noise\nc: {<<: *noise, x: 2}\n")
    with pytest.raises(ValueError, match="inside an anchor, or over 100 aliases"):
        check_yaml("a: &a [x]\nb: &b [*a, *a]\n")
    with pytest.raises(ValueError, match="inside an anchor, or over 100 aliases"):
        check_yaml("a: &a [x]\n" + "".join(f"b{k}: *a\n" for k in range(101)))
    with pytest.raises(ValueError, match=f"more than {MAX_NODES} entries"):
        check_yaml("[" + "x, " * MAX_NODES + "]")
    check_yaml("a: " + "[" * (MAX_DEPTH - 1) + "]" * (MAX_DEPTH - 1))
    with pytest.raises(ValueError, match="nested more than"):
        check_yaml("a: " + "[" * MAX_DEPTH + "]" * MAX_DEPTH)


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    import os

    os.mkfifo(tmp_path / "pipe")
    verdict = judged("a pipe", lambda: load_config(tmp_path / "pipe"), tmp_path)
    assert verdict.outcome == "refused"
    assert not verdict.faults
