"""The site builds without a warning, with every key of the experiment file and every public name."""

from __future__ import annotations

import html
import io
import re
import warnings
from contextlib import redirect_stderr
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest
from pages import browser_programs, opened

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


def test_the_page_of_messages_has_findings_remarks_and_errors_as_they_are_said(site: Path) -> None:
    findings, remarks, errors = re.split(r"<h2", (site / "messages" / "index.html").read_text())[1:4]
    assert findings.count("<tr>") > 70
    assert remarks.count("<tr>") > 30
    assert errors.count("<tr>") > 300
    rows = {re.sub(r"<[^>]+>", " ", row).split()[0] for row in findings.split("<tr>")[2:]}
    assert {"offset", "delay", "frozen", "weight"} <= rows


@pytest.mark.slow("every page, wide and narrow, in light and dark colours")
@pytest.mark.skipif(browser_programs() is None, reason="Chromium or its driver is not installed")
def test_pages_fit_wide_and_narrow_windows_in_light_and_dark_colours(site: Path, tmp_path: Path) -> None:
    handler = partial(SimpleHTTPRequestHandler, directory=str(site))
    pages = [page.parent.relative_to(site).as_posix() for page in site.rglob("index.html")]
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, opened(site / "index.html", tmp_path) as driver:
        Thread(target=server.serve_forever, daemon=True).start()
        driver.get_log("browser")  # of the page as a file, whose search asks for a server
        for width, scheme in ((1280, "light"), (400, "dark")):
            size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
            driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
            features = [{"name": "prefers-color-scheme", "value": scheme}]
            driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
            for page in pages:
                driver.get(f"http://127.0.0.1:{server.server_port}/{page}/")
                shown = driver.execute_script(
                    "return [document.documentElement.scrollWidth, document.body.dataset.mdColorScheme]"
                )
                assert shown == [min(width, shown[0]), {"light": "default", "dark": "slate"}[scheme]], page
        assert [entry for entry in driver.get_log("browser") if entry["level"] == "SEVERE"] == []
        server.shutdown()


def test_public_names_are_described(site: Path) -> None:
    text = text_of(site / "reference" / "index.html")
    for name in ("identify", "LeastSquares", "Robot", "read_log", "RowBuilder"):
        assert name in text
