"""The page of a run: what is in it, and what no name of a robot or log can put in."""

from __future__ import annotations

import base64
import html
import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import run_figures
import yaml
from demo import shortened_demo
from pages import browser_programs, opened, resize

from torchid.boundary import run_guarded
from torchid.cli import main
from torchid.commands.run_folder import DATA, PAGE, _read, report
from torchid.errors import InputError
from torchid.report.page import FIGURES, page_text

HOSTILE = """<script>window.hacked=1</script><img src=x onerror="window.hacked=1">&'\""""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder, of a robot with a body whose name is HTML, without its page: runs of tests write none."""
    folder = shortened_demo(tmp_path_factory.mktemp("page") / "demo", 300)
    urdf = folder / "quadruped.urdf"
    urdf.write_text(urdf.read_text().replace("rear_left_hip_link", html.escape(HOSTILE)))
    assert main(["identify", str(folder / "quadruped.yaml"), f"output={folder / 'run'}"]) == 0
    return folder / "run"


@pytest.fixture(scope="module")
def page(run: Path) -> str:
    return report(run).read_text()


def copied(run: Path, folder: Path) -> Path:
    return Path(shutil.copytree(run, folder / run.name))


def test_it_has_every_figure_of_the_run_with_a_text_for_those_who_do_not_see_it(run: Path, page: str) -> None:
    images = re.findall(r'<img src="data:image/png;base64,([^"]+)" alt="([^"]+)">', page)
    assert {label: base64.b64decode(data) for data, label in images} == {
        FIGURES[path.stem]: path.read_bytes() for path in run.glob("*.png")
    }
    assert {FIGURES[name] for name in run_figures.OF_A_RUN} <= {label for _, label in images}


def test_the_verdict_is_that_of_the_terminal(run: Path, page: str) -> None:
    said = json.loads((run / DATA).read_text())["answer"]
    assert said["headline"] in html.unescape(page)
    assert said["headline"].startswith(("Much better", "Better"))
    metrics = json.loads((run / "metrics.json").read_text())
    groups = {group: values for group, *values in said["errors"]}
    expected = [metrics[f"test{suffix}"]["joint_torque_rms"] for suffix in ("_nominal", "")]
    assert groups["joint torque [N m]"][:2] == expected


def test_names_are_text_and_never_markup(run: Path, page: str) -> None:
    assert "<script>window" not in page
    assert "<img src=x" not in page
    assert html.escape(HOSTILE).replace("&#x27;", "&#39;").replace("&quot;", "&#34;") in page
    control = replace(_read(run), name="run\x1b[31m\u202e")
    assert "\x1b" not in page_text(control)
    assert r"run\x1b[31m\u202e" in page_text(control)


def test_it_lists_what_the_checks_find_and_settings_and_versions(run: Path, page: str) -> None:
    assert "sway_train.npz: usable" in page
    assert "estimator:" in page
    assert json.loads((run / DATA).read_text())["versions"]["torchid"] in page


def test_a_page_that_somebody_has_edited_stays(run: Path, tmp_path: Path) -> None:
    folder = copied(run, tmp_path)
    (folder / PAGE).write_text("mine")
    with pytest.raises(InputError, match=r"report\.html: changed since torchid wrote it"):
        report(folder)
    assert (folder / PAGE).read_text() == "mine"


def test_logs_that_have_gone_are_said_to_be_unchecked(run: Path, tmp_path: Path) -> None:
    folder = copied(run, tmp_path)
    settings = yaml.safe_load((folder / "config.yaml").read_text())
    settings["logs"]["train"] = [str(tmp_path / "gone.npz")]
    (folder / "config.yaml").write_text(yaml.safe_dump(settings))
    assert "The logs could not be checked" in report(folder).read_text()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (DATA, None, r"report\.json: missing"),
        (DATA, "{", r"report\.json: not readable as JSON"),
        (DATA, "{}", r"metrics\.json, report\.json: not usable for the page"),
        ("parameters.json", "[]", r"parameters\.json, .*: not usable for the page"),
        ("manifest.json", "{}", "RUN: not a run of torchid"),
    ],
)
def test_a_damaged_run_is_refused_in_one_line(
    run: Path, tmp_path: Path, name: str, text: str | None, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = copied(run, tmp_path)
    (folder / name).unlink() if text is None else (folder / name).write_text(text)
    assert run_guarded("torchid", lambda: report(folder) and None) == 2
    said = capsys.readouterr().err
    assert re.search(message, said)
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize(("form", "shown"), [("svg", True), ("pdf", False)])
def test_a_run_writes_its_page_with_figures_that_a_browser_shows(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str, shown: bool
) -> None:
    run_figures.draw(monkeypatch, (run_figures.PAGE,))
    settings = [str(run.parent / "quadruped.yaml"), f"output={tmp_path / 'new'}", f"figures.format={form}"]
    assert main(["identify", "-q", *settings]) == 0
    written = (tmp_path / "new" / PAGE).read_text()
    assert f"To list the findings of the log checks here, run torchid report {tmp_path / 'new'}." in written
    assert ("data:image/svg+xml;base64," in written) is shown
    assert ("PDF figures are separate files" in written) is not shown


MEGABYTE = 1_000_000


def test_it_is_one_file_of_less_than_5_megabytes_that_asks_nobody_for_more(page: str) -> None:
    own = re.sub(r"data:image/png;base64,[^\"]*", "data:,", page)
    assert len(page.encode()) < 5 * MEGABYTE
    assert not re.search(r"https?:|//[a-z]+\.", own.replace("window.hacked", ""))
    links = re.findall(r"<[a-z][^>]*\s(?:href|src)=[\"']?([^\"'> ]+)", own)
    assert links
    assert all(link.startswith(("#", "data:,")) for link in links)
    assert "default-src 'none'" in own


@pytest.fixture(scope="module")
def browser(run: Path, page: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """It has opened the page."""
    assert page
    with opened(run / PAGE, tmp_path_factory.mktemp("profile")) as driver:
        yield driver


def brightness(color: str) -> float:
    """Of a computed style, 0 to 1."""
    return float(np.mean([int(x) for x in re.findall(r"\d+", color)[:3]])) / 255.0


@pytest.mark.slow("starts a browser")
@pytest.mark.skipif(browser_programs() is None, reason="neither Chromium nor Chrome with chromedriver is installed")
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 400])
def test_a_browser_shows_all_figures_within_its_width(browser: Any, page: str, width: int, scheme: str) -> None:
    resize(browser, width)
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    browser.refresh()
    assert not browser.get_log("browser")
    loaded = "return [...document.images].filter(image => image.complete && image.naturalWidth > 0).length"
    assert browser.execute_script(loaded) == page.count("<img ")
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    assert browser.execute_script("return window.hacked ?? null") is None
    style = "const style = getComputedStyle(document.querySelector({!r})); return style.{}"
    paper = brightness(browser.execute_script(style.format("body", "backgroundColor")))
    assert (paper < 0.2) == (scheme == "dark")
    for name in ("p", "th", "td", "a", "dt", "summary"):
        assert abs(brightness(browser.execute_script(style.format(name, "color"))) - paper) > 0.4, name
