"""The site builds without a warning, with every key of the experiment file and every public name."""

from __future__ import annotations

import html
import io
import re
import warnings
from contextlib import redirect_stderr
from pathlib import Path

import pytest

import torchid

ROOT = Path(torchid.__file__).resolve().parents[1]
KEYS = ("estimator.ridge", "preprocessing.cutoff_hz", "logs.columns.joint_torque.pd", "sensors.noise.joint_torque")

pytest.importorskip("material", reason="MkDocs is not installed")
site_pages = pytest.importorskip("site_pages")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as monkeypatch, warnings.catch_warnings(), redirect_stderr(said):
        monkeypatch.chdir(ROOT)
        monkeypatch.setenv("NO_MKDOCS_2_WARNING", "1")
        warnings.simplefilter("ignore")  # of Python, about libraries of MkDocs
        mkdocs = pytest.importorskip("mkdocs.__main__")
        mkdocs.cli(["build", "--strict", "--site-dir", str(folder)], standalone_mode=False)
    assert "WARNING" not in said.getvalue()
    return folder


def text_of(page: Path) -> str:
    return html.unescape(re.sub(r"<[^>]+>", " ", page.read_text()))


def test_every_page_of_the_documentation_is_there(site: Path) -> None:
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")}
    assert {path.parent.name for path in site.glob("*/index.html")} >= pages | {"keys", "reference", "contributing"}
    assert "Two commands" in text_of(site / "index.html")


def test_no_page_asks_anybody_for_anything(site: Path) -> None:
    for page in site.rglob("*.html"):
        assert not re.findall(
            r"<(?:script|link|img)[^>]*(?:src|href)=\"?(?:https?:)?//(?!localhost)[^>]*>", page.read_text()
        )
    chart = text_of(site / "architecture" / "index.html")
    assert "logs: read, filter, differentiate, resample\n    → proposals, problem, log_checks" in chart
    assert 'class="mermaid"' not in (site / "architecture" / "index.html").read_text()


def test_links_lead_to_pages_and_sections_that_there_are(site: Path) -> None:
    """Those within the site; strict MkDocs looks at pages alone, not at what the hook makes of them."""
    pages = {page.parent: page.read_text() for page in site.rglob("index.html")}
    sections = {folder: set(re.findall(r" id=\"?([^\" >]+)", text)) for folder, text in pages.items()}
    for folder, text in pages.items():
        for link in re.findall(r"<a [^>]*href=\"([^\"]+)\"", text):
            place, _, section = html.unescape(link).partition("#")
            if re.match(r"[a-z]+:", place):
                continue
            target = (folder / place).resolve()
            assert target.exists(), f"{folder.name}: {link}"
            assert not section or target.is_file() or section in sections[target], f"{folder.name}: {link}"


@pytest.mark.parametrize("key", KEYS)
def test_keys_have_what_they_accept_and_their_defaults(site: Path, key: str) -> None:
    block, _, name = key.rpartition(".")
    page = (site / "keys" / "index.html").read_text()
    section = page[page.index(f'id="{block.replace(".", "-")}"') :]
    row = re.search(rf"<tr>\s*<td><code>{name}</code></td>\s*<td>(.+?)</td>\s*<td>(.*?)</td>", section)
    assert row is not None
    default = re.sub(r"<[^>]+>", "", row.group(2))
    assert default == {"ridge": "auto"}.get(name, "null")


def test_public_names_are_described(site: Path) -> None:
    text = text_of(site / "reference" / "index.html")
    for name in ("identify", "LeastSquares", "Robot", "read_log", "RowBuilder"):
        assert name in text
