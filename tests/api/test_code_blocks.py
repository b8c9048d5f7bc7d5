"""What the pages show works: settings are taken, Python runs, commands parse, scripts and targets are there."""

from __future__ import annotations

import dataclasses
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from demo import shortened_demo
from repository import CONFIGS, ROOT
from synthetic import Oracle, load, make_log

import torchid
from torchid.cli import _options
from torchid.config import load_analysis, load_simulation
from torchid.logs import write_log

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
ELSEWHERE = {"python.md", "recipes.md"}  # whose Python other tests run


def blocks(language: str) -> list[Any]:
    """Pages and code, to be parameters of a test."""
    return [
        pytest.param(page.name, found, id=f"{page.name}-{number}")
        for page in PAGES
        for number, found in enumerate(re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.S | re.M))
    ]


# -------------------------------------------------------------------------------------------------------------- YAML


def documents(text: str) -> list[dict[str, Any]]:
    """A block as files: a key that comes twice shows two ways of saying something; "..." is more of the same."""
    whole = re.sub(r",?\s*\.\.\.", "", text)
    out: list[dict[str, Any]] = [{}]
    for part in re.split(r"^(?=[a-z_]+:)", whole, flags=re.MULTILINE):
        found = yaml.safe_load(part) or {}
        out[-1:] = [out[-1], found] if out[-1].keys() & found.keys() else [out[-1] | found]
    return out


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
@pytest.mark.parametrize(("page", "text"), blocks("yaml"))
def test_settings_of_the_pages_are_taken_as_they_stand(page: str, text: str, tmp_path: Path) -> None:
    (tmp_path / "walk_1.npz").touch()
    for settings in documents(text):
        file = tmp_path / "robot.yaml"
        if "motions" in settings:
            file.write_text(yaml.safe_dump(settings))
            assert dataclasses.asdict(load_simulation(file))["motions"][0]["name"] == "squat"
            continue
        least = {"robot": "robot.urdf", "logs": ["walk_1.npz"], "output": "runs/robot"}
        file.write_text(yaml.safe_dump(least | settings))
        config = load_analysis(file)
        assert all(hasattr(config, key) for key in settings), page


# ------------------------------------------------------------------------------------------------------------ Python


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The biped as robot.urdf, its left sole welded by l_ankle_ft; a log; the demo."""
    folder = tmp_path_factory.mktemp("documented")
    (folder / "torchid").symlink_to(ROOT / "torchid")
    text = (CONFIGS / "biped.urdf").read_text().replace("l_sole_weld", "l_ankle_ft")
    (folder / "robot.urdf").write_text(text)
    robot = load(folder / "robot.urdf", ft_joints=["l_ankle_ft"])
    states = [[True, True], [True, False], [False, True]]
    rng = np.random.default_rng(0)
    log = make_log(Oracle.of(robot), [("l_sole", 6), ("r_sole", 6)], states, 240, rng)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(log.time), 1))  # which a filter leaves
    write_log(dataclasses.replace(log, base_quat_xyzw=still), folder / "walk.npz")
    feet = [{"frame": frame, "type": "flat"} for frame in ("l_sole", "r_sole")]
    write_log(log, folder / "turning.npz")
    least = {"robot": "robot.urdf", "contacts": feet, "logs": ["turning.npz"], "sensors": "full"}
    (folder / "robot.yaml").write_text(yaml.safe_dump(least | {"estimator": {"ridge": 0.01}}))
    return folder


def beside(folder: Path, page: str) -> dict[str, Any]:
    """What the pages speak of before they show it: a robot, its state, a fit."""
    welds = ["l_ankle_ft"] if page == "contacts.md" else []
    robot = torchid.load_robot(folder / "robot.urdf", ft_joints=welds)
    said: dict[str, Any] = {"torchid": torchid, "robot": robot}
    said["contacts"] = contacts = [torchid.Contact("l_sole", "flat"), torchid.Contact("r_sole", "flat")]
    sensors = torchid.named_sensors("full", robot.n, 2, ft=len(welds))
    said["builder"] = builder = torchid.RowBuilder(robot, contacts, sensors)
    said["log"] = samples = torchid.bind_log(torchid.read_log(folder / "walk.npz"), robot, contacts)
    said["train"], said["samples"], said["logs"] = [samples], samples, [samples]
    said["problem"] = torchid.linear_problem(torchid.compress([samples], builder), builder, robot)
    said["problem_of_a_log"], said["nominal"] = said["problem"], robot.nominal.flatten()
    q, v, a = (torch.zeros(3, size, dtype=torch.float64) for size in (robot.n + 7, robot.n + 6, robot.n + 6))
    q[:, 6] = 1.0
    said |= {"q": q, "v": v, "a": a, "phi": said["nominal"]}
    said["K"] = torchid.Regressor(robot)(q, v, a)
    said["active"] = torch.ones(3, 1, dtype=torch.bool)
    said |= {"torque": torch.zeros(3, robot.n, dtype=q.dtype), "wrench": torch.zeros(3, 6, dtype=q.dtype)}
    said["network"] = _Nothing(robot.nv)
    said["fitter"] = torchid.LogFitter(robot=robot, builder=builder, estimator=torchid.LeastSquares(0.01))
    said["paths"] = ["walk.factor"]
    if page == "simulation.md":
        (folder / "runs" / "robot").mkdir(parents=True)
        (folder / "runs" / "robot" / "identified.urdf").write_bytes((folder / "robot.urdf").read_bytes())
        file = shortened_demo(folder / "short", 600) / "quadruped.yaml"
        torchid.identify(file, output=folder / "runs" / "g1", estimator={"name": "consistent", "ridge": 0.001})
    return said


class _Nothing(torch.nn.Module):
    """A residual that begins with no force."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(1, size, dtype=torch.float64)
        torch.nn.init.zeros_(self.layer.weight)
        torch.nn.init.zeros_(self.layer.bias)

    def forward(self, q: torch.Tensor, v: torch.Tensor, a: torch.Tensor) -> torch.Tensor:
        return self.layer(v[:, :1])


@pytest.mark.slow("fits and descents of the pages, as they show them")
@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
@pytest.mark.parametrize("page", sorted({x.values[0] for x in blocks("python")} - ELSEWHERE))
def test_python_of_the_pages_runs(page: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Block after block, as a reader copies them."""
    if page == "simulation.md":
        pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    monkeypatch.chdir(folder)
    monkeypatch.setattr(torchid, "Sgd", _two_epochs)
    for name, text in {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "0", "RANK": "0", "WORLD_SIZE": "1"}.items():
        monkeypatch.setenv(name, text)  # as torchrun sets them for one process
    said = beside(folder, page)
    for block in (x.values[1] for x in blocks("python") if x.values[0] == page):
        exec(compile(str(block), page, "exec"), said)
    if page == "simulation.md":
        robot, model = said["robot"], said["model"]
        assert model.nv == robot.nv
        assert model.body_mass.sum() == pytest.approx(robot.nominal[:, 0].sum(), rel=1e-3), (
            "with its trunk; soles weigh 34 g"
        )
    if torch.distributed.is_initialized():  # noqa: TID251
        torch.distributed.destroy_process_group()  # noqa: TID251


def _two_epochs(**settings: Any) -> Any:
    """A descent that ends before a reader would."""
    from torchid.estimators import Sgd

    return Sgd(**settings | {"epochs": 2})


def test_no_python_hides_in_a_block_that_no_test_runs() -> None:
    for page in PAGES:
        text = re.sub(r"^ *```.*?^ *```", "", page.read_text(), flags=re.S | re.M)
        assert not re.findall(r"^    (?:import|from) \w+|^    .*\btorchid\.\w+\(", text, re.MULTILINE), page.name


# ------------------------------------------------------------------------------------------------------------- shell


def commands() -> list[Any]:
    """Commands of indented blocks, without remarks; lines that end with a backslash go on."""
    out = []
    for page in PAGES:
        text = re.sub(r"^```.*?^```", "", page.read_text().replace("\\\n", " "), flags=re.S | re.M)
        for line in re.findall(r"^    ((?:torchid|torchrun|python|make) .*)$", text, re.MULTILINE):
            out.append(pytest.param(shlex.split(line, comments=True), id=f"{page.name}: {line.split('#')[0].strip()}"))
    return out


@pytest.mark.parametrize("words", commands())
def test_commands_of_the_pages_are_ones(words: list[str]) -> None:
    if words[0] == "torchrun":
        words = words[words.index("torchid") :]
    if words[0] == "torchid" and words[1] != "--print-completion":
        given = [word.split("|")[0].strip("[]") for word in words[1:] if word not in ("[--output", "[--overwrite]")]
        assert _options([x for x in given if x != "FILE"]).name == words[1]
    elif words[0] == "python":
        assert words[1] == "-m" or (ROOT / words[1]).is_file()
    elif words[0] == "make":
        targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
        assert {word for word in words[1:] if "=" not in word} <= targets


def test_commands_within_sentences_have_the_options_that_they_name(capsys: pytest.CaptureFixture[str]) -> None:
    for page in PAGES:
        for text in re.findall(r"`torchid ([a-z]+[^`]*)`", page.read_text()):
            name, options = text.split()[0], re.findall(r"(?<![\w-])--[a-z-]+", text)
            with pytest.raises(SystemExit) as ended:
                _options([name, "--help"])
            assert ended.value.code == 0, f"{page.name}: {text}"
            known = set(re.findall(r"--[a-z-]+", capsys.readouterr().out))
            assert set(options) <= known, f"{page.name}: {text}"
