"""The tables of the pages are written by `scripts/results.py`, all of them and no others."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("pinocchio", reason="Pinocchio, extra [oracle]")
pytest.importorskip("mujoco", reason="MuJoCo, extra [sim]")

import results
from repository import ROOT
from script_calls import call

NAMES = [name for page in results.PAGES for name in re.findall(r"^<!-- table: (.*) -->$", page.read_text(), re.M)]


def test_each_table_of_the_pages_has_a_function_and_each_function_a_table() -> None:
    assert set(NAMES) == set(results.tables())


def test_each_table_has_cells() -> None:
    for page in results.PAGES:
        for table in re.findall(r"^<!-- table: .*? -->\n(.*?)^<!-- /table -->$", page.read_text(), re.M | re.S):
            assert table.count("\n| ") > 1, page.name


def test_no_table_of_results_has_figures_that_no_script_writes() -> None:
    text = (ROOT / "docs" / "results.md").read_text()
    text = re.sub(r"^<!-- table: .*?^<!-- /table -->$", "", text, flags=re.M | re.S)
    assert "| question |" in text
    assert not re.findall(r"^\|.*\d.*$", text, re.M)


def test_a_table_is_written_between_its_marks_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = tmp_path / "page.md"
    text = "# A\n\n<!-- table: a -->\n{}<!-- /table -->\n\n<!-- table: b -->\n| b |\n<!-- /table -->\n"
    page.write_text(text.format("| old |\n"))
    monkeypatch.setattr(results, "PAGES", (page,))
    monkeypatch.setattr(results, "ROOT", tmp_path)
    results.write("a", iter([["x", "y"], ["1 %", "2 \\1"]]))
    assert page.read_text() == text.format("| x | y |\n|---|---|\n| 1 % | 2 \\1 |\n")


def test_an_unknown_table_is_refused() -> None:
    status, _, err = call("results", "recording")
    assert status == 2
    assert "recordings" in err
