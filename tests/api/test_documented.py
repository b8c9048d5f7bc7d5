"""The page about Python says what happens, and links between pages lead somewhere."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest
import torch
from repository import ROOT


def run_page(name: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> tuple[dict[str, Any], int]:
    """Run a page's Python block by block in a folder with the demo; its names, and how many blocks print."""
    (folder / "torchid").symlink_to(ROOT / "torchid")
    page = (ROOT / "docs" / name).read_text()
    said: dict[str, Any] = {}
    printed = 0
    for code, after in re.findall(r"```python\n(.*?)```\n(.*?)(?=```python|\Z)", page, re.DOTALL):
        with torch.compiler.set_stance("force_eager"):  # to compile takes 20 s
            exec(code, said)
        out = capsys.readouterr().out
        shown = re.match(r"\n((?:    .*\n)+)", after)
        assert out == (dedent(shown[1]) if shown else ""), code
        printed += bool(shown)
    return said, printed


@pytest.mark.slow("all that the page shows, as it shows it")
@pytest.mark.filterwarnings("ignore:identified.urdf:torchid.errors.TorchidWarning")
@pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")  # by what torch.compile imports
def test_the_page_about_python_runs_and_prints_what_it_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    said, printed = run_page("python.md", tmp_path, capsys)
    assert printed == 1
    assert said["knee"].name == "front_left_shank_link"
    written = {"identified.urdf", "runs", "checkpoint.pt", "loop.pt", "model.pt"}
    assert {path.name for path in tmp_path.iterdir()} == {"torchid", *written}
    assert {path.name for path in (tmp_path / "runs").iterdir()} == {"from_python", "loop", "curves"}


@pytest.mark.slow("all that the page shows, as it shows it")
@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_the_recipes_print_what_they_show(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    monkeypatch.chdir(tmp_path)
    assert run_page("recipes.md", tmp_path, capsys)[1] == 6


@pytest.mark.parametrize("package", ["commands", "log_checks", "logs", "problem"])
def test_the_list_of_modules_of_a_large_package_names_what_there_is_once(package: str) -> None:
    folder = ROOT / "torchid" / package
    said = ast.get_docstring(ast.parse((folder / "__init__.py").read_text())) or ""
    named = re.findall(r"`(\w+)`", "".join(re.findall(r"^- .*(?:\n  .*)*", said, re.MULTILINE)))
    modules = {path.stem for path in folder.glob("*.py")}
    assert set(named) <= modules
    assert len(named) == len(set(named)) > len(modules) / 2


PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").glob("*.md")]


def anchors(page: Path) -> set[str]:
    """What links to headings of a page are called, as GitHub makes them."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)\s]+)\)", page.read_text())
    for link in (link for link in links if not link.startswith("http")):
        file, _, anchor = link.partition("#")
        target = (page.parent / file) if file else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_the_readme_and_the_site_stay_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 90
    assert sum(len(page.read_text().split()) for page in PAGES if page.name != "CHANGELOG.md") <= 22_000
