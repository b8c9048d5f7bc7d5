"""The page of a run: what is in it, and what no name of a robot or log can put in."""

from __future__ import annotations

import html
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import run_figures
import yaml
from demo import shortened_demo
from pages import browser_programs, figures_of, opened

from torchid.boundary import run_guarded
from torchid.cli import main
from torchid.commands.report import DATA, PAGE, _read, report
from torchid.errors import InputError
from torchid.report import page as page_module
from torchid.report.page import page_text
from torchid.report.page_figures import contribution_bars

MEGABYTE = 1_000_000
FIGURES = {"recorded", "projected", "spectra", "parameter_m", "ellipsoids", "logs", "sensors", "states"}
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


def test_it_has_every_figure_as_strict_json_with_a_place_for_it(page: str) -> None:
    figures = figures_of(page)
    assert figures.keys() >= FIGURES
    assert {*re.findall(r'data-figure="(\w+)"', page)} == figures.keys()
    for figure in figures.values():
        assert figure["data"]
        assert figure["layout"]["height"] > 0


def test_it_is_one_file_of_less_than_5_megabytes_that_asks_nobody_for_more(page: str) -> None:
    own = re.sub(r'<script type="text/plain" id="library">.*?</script>', "", page, flags=re.DOTALL)
    assert len(page.encode()) < 5 * MEGABYTE
    assert not re.search(r"https?:|//[a-z]+\.", own.replace("window.hacked", ""))
    links = re.findall(r"<[a-z][^>]*\s(?:href|src)=[\"']?([^\"'> ]+)", own)
    assert links
    assert all(link.startswith(("#", "data:,")) for link in links)
    assert "default-src 'none'" in own


def test_every_axis_has_its_unit(page: str) -> None:
    figures = figures_of(page)
    assert "ellipsoids" in figures
    assert len(figures) > 5
    for name, figure in figures.items():
        layout = figure["layout"]
        axes = [layout["scene"][f"{k}axis"] for k in "xyz"] if name == "ellipsoids" else [layout["xaxis"]]
        titles = [axis["title"]["text"] for axis in axes] + [note["text"] for note in layout["annotations"]]
        assert all("[" in title for title in titles if not title.startswith("error"))


def test_parameters_that_are_not_identified_have_no_interval(run: Path, page: str) -> None:
    bodies = json.loads((run / "parameters.json").read_text())["bodies"]
    drawn = 0
    for name, figure in figures_of(page).items():
        for trace in figure["data"][1:] if name.startswith("parameter_") else ():
            known = [row for row, value in enumerate(trace["x"]) if value is not None]
            assert known
            assert ("error_x" in trace) is (trace["name"] == "identified, 95 %")
            if "error_x" in trace:
                of, drawn = name.removeprefix("parameter_"), drawn + len(known)
                free = [x for x in bodies if x["verdict"][of] != "fixed"]
                assert known == [row for row, x in enumerate(free) if x["verdict"][of] == "identified"]
    assert drawn > 5


def test_the_verdict_is_that_of_the_terminal(run: Path, page: str) -> None:
    said = json.loads((run / DATA).read_text())["answer"]
    assert said["headline"] in html.unescape(page)
    assert said["headline"].startswith(("Much better", "Better"))
    metrics = json.loads((run / "metrics.json").read_text())
    groups = {group: values for group, *values in said["errors"]}
    expected = [metrics[f"test{suffix}"]["joint_torque_rms"] for suffix in ("_nominal", "")]
    assert groups["joint torque [N m]"][:2] == expected


def test_the_largest_contributions_are_drawn_with_whole_names_and_the_others_counted() -> None:
    name = "left_front_" * 5 + "hip_joint"
    figure = contribution_bars([{"name": f"{name}{number}", "bits": float(number)} for number in range(27)])
    assert figure is not None
    labels = figure["layout"]["yaxis"]["ticktext"]
    assert labels == [f"{name}{number}" for number in range(26, 6, -1)]
    assert "7 more that add less" in figure["layout"]["xaxis"]["title"]["text"]


def test_names_are_text_and_never_markup(run: Path, page: str) -> None:
    assert "<script>window" not in page
    assert "<img" not in page
    assert html.escape(HOSTILE).replace("&#x27;", "&#39;").replace("&quot;", "&#34;") in page
    labels = figures_of(page)["parameter_m"]["layout"]["yaxis"]["ticktext"]
    assert not any(re.search(r"<(?!br>)", label) for label in labels)  # Plotly reads some tags
    control = replace(_read(run), name="run\x1b[31m\u202e")
    assert "\x1b" not in page_text(control)
    assert r"run\x1b[31m\u202e" in page_text(control)


def test_impossible_bodies_are_named_and_not_drawn(run: Path) -> None:
    files = _read(run)
    changed: dict[str, Any] = json.loads(json.dumps(files.parameters))
    changed["bodies"][0]["identified"]["m"] = -1.0
    text = page_text(replace(files, parameters=changed))
    (sentence,) = re.findall(r"<p>Not drawn.*?</p>", text, re.DOTALL)
    assert changed["bodies"][0]["name"] in sentence
    before, after = (figures_of(x)["ellipsoids"]["data"] for x in (page_text(files), text))
    assert len({*after[1]["hovertext"]}) == len({*before[1]["hovertext"]}) - 1


def test_it_lists_what_the_checks_find_and_settings_and_versions(run: Path, page: str) -> None:
    assert "sway_train.npz: usable" in page
    assert "estimator:" in page
    assert json.loads((run / DATA).read_text())["versions"]["torchid"] in page


def test_a_page_made_anew_lets_the_run_be_replaced(run: Path, tmp_path: Path) -> None:
    folder = copied(run, tmp_path)
    report(folder)
    again = [str(run.parent / "quadruped.yaml"), f"output={folder}", "overwrite=true"]
    assert main(["identify", *again]) == 0


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
        (DATA, "{}", r"metrics\.json, report\.json: not what a page needs"),
        ("parameters.json", "[]", r"parameters\.json, .*: not what a page needs"),
        ("manifest.json", "{}", "RUN: no run of torchid"),
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


def test_a_run_writes_its_page_or_says_why_not(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = str(run.parent / "quadruped.yaml")
    run_figures.draw(monkeypatch, (run_figures.PAGE,))
    assert main(["identify", "-q", settings, f"output={tmp_path / 'with'}"]) == 0
    written = (tmp_path / "with" / PAGE).read_text()
    assert figures_of(written).keys() >= FIGURES
    assert f"torchid report {tmp_path / 'with'} checks the logs" in written
    monkeypatch.setattr(page_module, "find_spec", lambda name: None)
    capsys.readouterr()
    assert main(["identify", "-q", settings, f"output={tmp_path / 'without'}"]) == 0
    assert re.search(r"no report\.html is written: .*pip install '\.\[report\]'", capsys.readouterr().err)
    assert not (tmp_path / "without" / PAGE).exists()
    with pytest.raises(InputError, match=r"\[report\]"):
        report(tmp_path / "without")


@pytest.mark.skipif(browser_programs() is None, reason="neither Chromium nor Chrome with chromedriver is installed")
@pytest.mark.parametrize("width", [390, 1280])
def test_a_browser_draws_all_figures_without_an_error(page: str, run: Path, tmp_path: Path, width: int) -> None:
    pytest.importorskip("selenium")
    with opened(run / PAGE, tmp_path / "profile", width) as browser:
        errors = [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
        assert not errors
        assert browser.execute_script("return document.documentElement.dataset.drawn") == "all"
        drawn = browser.execute_script(
            "return [...document.querySelectorAll('.js-plotly-plot')].filter(x => x.offsetHeight > 50 && "
            "x.querySelector('.trace, .scatterlayer path, .barlayer path, canvas')).map(x => x.dataset.figure)"
        )
        assert {*drawn} == figures_of(page).keys()
        assert browser.execute_script("return document.documentElement.scrollWidth") <= width
        assert browser.execute_script("return window.hacked ?? null") is None
        turned = (
            "const gl = document.querySelector('[data-figure=ellipsoids]'); return !!gl._fullLayout.scene._scene.glplot"
        )
        assert browser.execute_script(turned)
