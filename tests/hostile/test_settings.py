"""Experiment files and overrides of strangers: read or refused in one line, with nothing run and nothing looked up."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from hostile import examined, judged
from hostile_settings import BASE, damaged, documents, overrides, places_in, wrong_values
from hypothesis import given, settings
from hypothesis import strategies as st

from torchid.config import load_analysis, load_config
from torchid.config.yaml_text import check_yaml
from torchid.errors import ConfigError, excerpt, is_plain
from torchid.guards import MAX_DEPTH, MAX_NODES

COUNTS = [30, pytest.param(1000, marks=pytest.mark.slow)]


def test_files_made_to_harm_are_refused(tmp_path: Path) -> None:
    """But for one with a mark of its encoding at the start."""
    tally = examined("settings", documents(tmp_path), load_config, tmp_path)
    assert tally.faults == []
    assert [x.name for x in tally.verdicts if x.outcome == "accepted"] == ["a byte order mark"]


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("load", [load_config, load_analysis])
def test_anything_anywhere_in_a_file_is_read_or_refused(
    tmp_path: Path, count: int, load: Callable[[Path], Any]
) -> None:
    tally = examined(f"settings for {load.__name__}", wrong_values(tmp_path, count, seed=2), load, tmp_path)
    assert tally.faults == []
    assert 0.8 < tally.share("refused") < 1.0


@pytest.mark.parametrize("count", COUNTS)
def test_damaged_files_are_read_or_refused(tmp_path: Path, count: int) -> None:
    tally = examined("damaged settings", damaged(tmp_path, count, seed=3), load_config, tmp_path)
    assert tally.faults == []
    assert tally.share("refused") > 0.8


@pytest.mark.parametrize("count", COUNTS)
def test_any_override_is_read_or_refused(tmp_path: Path, count: int) -> None:
    file = tmp_path / "experiment.yaml"
    file.write_text(yaml.safe_dump(BASE))
    tally = examined("overrides", overrides(count, seed=4), lambda given: load_config(file, given), tmp_path)
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
    with pytest.raises(ConfigError, match="stands for nothing here"):
        load_config(file, ["output=${oc.env:SECRET}"])


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    import os

    os.mkfifo(tmp_path / "pipe")
    verdict = judged("a pipe", lambda: load_config(tmp_path / "pipe"), tmp_path)
    assert verdict.outcome == "refused"
    assert not verdict.faults


scalars = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.binary(max_size=4)
keys = st.text(max_size=4) | st.integers() | st.sampled_from(["name", "frame", "m", "set", "noise"])
anything = st.recursive(scalars, lambda x: st.lists(x, max_size=3) | st.dictionaries(keys, x, max_size=3), max_leaves=6)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.sampled_from(list(places_in(BASE))), anything)
def test_any_tree_of_values_in_any_place_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, place: tuple[Any, ...], value: Any
) -> None:
    tree: Any = copy.deepcopy(BASE)
    at = tree
    for key in place[:-1]:
        at = at[key]
    at[place[-1]] = value
    folder = tmp_path_factory.getbasetemp() / "trees"
    folder.mkdir(exist_ok=True)
    (folder / "experiment.yaml").write_text(
        yaml.safe_dump(tree, allow_unicode=True), encoding="utf-8", errors="surrogatepass"
    )
    verdict = judged(str(place), lambda: load_config(folder / "experiment.yaml"), folder)
    assert not verdict.faults


def test_aliases_are_for_sharing_and_not_for_multiplying() -> None:
    check_yaml("a: &noise {joint_torque: 1}\nb: *noise\nc: {<<: *noise, x: 2}\n")
    check_yaml("a: &a [" + "x, " * 40 + "]\n" + "".join(f"b{k}: *a\n" for k in range(50)))
    with pytest.raises(ValueError, match=f"more than {MAX_NODES} entries, aliases unfolded"):
        check_yaml("a: &a [" + "x, " * 100 + "]\n" + "".join(f"b{k}: *a\n" for k in range(60)))
    check_yaml("a: " + "[" * (MAX_DEPTH - 1) + "]" * (MAX_DEPTH - 1))
    with pytest.raises(ValueError, match="nested more than"):
        check_yaml("a: " + "[" * MAX_DEPTH + "]" * MAX_DEPTH)


def test_what_is_shown_of_a_text_is_one_short_line() -> None:
    assert excerpt("größe, 関節 [red]") == "größe, 関節 [red]"
    assert excerpt("a\nb\x1b[2J\u2028\u202e\x7f") == r"a\nb\x1b[2J\u2028\u202e\x7f"
    long = excerpt("a" * 10_000 + "z")
    assert len(long) < 130
    assert long.endswith("z (10001 characters)")
    assert is_plain("l_knee/joint 1")
    assert not any(is_plain(letter) for letter in "\0\n\r\t\x1b\x85\u2029\u202e\ud800")
