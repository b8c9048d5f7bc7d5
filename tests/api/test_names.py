"""What `torchid` shows, and what type checkers see of it."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
import venv
from importlib import import_module
from pathlib import Path

import pytest
import torch
from repository import ROOT

import torchid

LARGE = ("torch", "numpy", "scipy", "matplotlib", "rich", "pydantic", "tensorboard", "trimesh")
STUB = ROOT / "torchid" / "__init__.pyi"
SCRIPT = """
import torchid

result = torchid.identify("experiment.yaml", output=None, logs=["walk.npz"], robot={"urdf": "go2.urdf"})
reveal_type(result["l_knee"].mass)
reveal_type(result["l_knee"].standard_error.mass)
reveal_type(result["l_knee"].verdict.mass)
reveal_type(torchid.evaluate(result, "walk.npz").metrics["walk"].identified.rms)
reveal_type(torchid.check("walk.npz").usable)
reveal_type(torchid.check(torchid.read_log("walk.npz")).usable)
reveal_type(torchid.analyze(robot="go2.urdf").scenarios)
torchid.identify("experiment.yaml", robto="go2.urdf")
torchid.identify("experiment.yaml", device=3)
torchid.no_such_name
"""
REVEALED = ["float", "float", "str", "dict[str, float | None]", "bool", "bool"]
REVEALED += ["tuple[torchid.commands.analyze.ScenarioAnalysis, ...]"]


def test_dir_shows_public_names_only() -> None:
    shown = dir(torchid)
    assert shown == sorted(set(shown))
    assert set(shown) == {*torchid.__all__}
    packages = {path.stem for path in (ROOT / "torchid").iterdir()}
    assert not set(shown) & (packages - {"check"}), "no submodules"
    assert not {"lazy_loader", "annotations", "attach_stub"} & set(shown)
    import_module("torchid.robot")  # which puts the submodule into the package
    assert dir(torchid) == shown


def test_no_module_gives_a_constant_two_values() -> None:
    """As of two modules that became one, where the later value counts for both."""
    for path in (ROOT / "torchid").rglob("*.py"):
        assigned = [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.Assign)]
        targets = (name for node in assigned for target in node.targets for name in ast.walk(target))
        names = [name.id for name in targets if isinstance(name, ast.Name)]
        assert sorted(names) == sorted(set(names)), path


def test_the_stub_names_exactly_what_there_is() -> None:
    tree = ast.parse(STUB.read_text())
    imported = {alias.name for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    (listed,) = (node.value for node in tree.body if isinstance(node, ast.Assign))
    names = ast.literal_eval(listed)
    assert sorted(names) == sorted(imported) == sorted(torchid.__all__)
    for name in names:
        assert getattr(torchid, name).__doc__ or name.isupper(), name


def assert_types_are_seen(folder: Path, python: str, whole: bool, **environment: str) -> None:
    """Make sure that mypy sees the types of the package that an interpreter finds, and refuses what is wrong.

    Without the types of large libraries, unless the `whole` is to be seen.
    """
    (folder / "script.py").write_text(SCRIPT)
    skipped = "" if whole else "".join(f"[mypy-{name}.*]\nfollow_imports = skip\n" for name in LARGE)
    (folder / "mypy.ini").write_text(f"[mypy]\n{skipped}")
    arguments = ["--python-executable", python, "--cache-dir", str(folder / "cache"), "--follow-imports", "silent"]
    ran = subprocess.run(
        [sys.executable, "-m", "mypy", *arguments, "script.py"],
        cwd=folder,
        env={key: value for key, value in os.environ.items() if key not in ("MYPYPATH", "PYTHONPATH")} | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    revealed = [line.split('"')[1].replace("builtins.", "") for line in ran.stdout.splitlines() if "Revealed" in line]
    assert revealed == REVEALED, ran.stdout
    errors = [line.partition("error: ")[2] for line in ran.stdout.splitlines() if "error: " in line]
    assert [error.rpartition("[")[2] for error in errors] == ["call-arg]", "arg-type]", "attr-defined]"], ran.stdout


@pytest.mark.slow("mypy in a process of its own")
def test_mypy_sees_the_types_of_this_tree(tmp_path: Path) -> None:
    assert_types_are_seen(tmp_path, sys.executable, whole=False, MYPYPATH=str(ROOT))


@pytest.mark.study
@pytest.mark.parametrize("editable", [False, True], ids=["installed", "editable"])
def test_mypy_sees_the_types_of_an_installed_package(tmp_path: Path, editable: bool) -> None:
    """Installed without its dependencies, which are those of the running interpreter."""
    pytest.importorskip("setuptools", minversion="77")
    venv.create(tmp_path / "venv", symlinks=True)
    python, source = tmp_path / "venv" / "bin" / "python", tmp_path / "source"
    shutil.copytree(ROOT / "torchid", source / "torchid", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    (site,) = (tmp_path / "venv").glob("lib/python*/site-packages")
    (site / "others.pth").write_text(f"{Path(torch.__file__).parents[1]}\n")
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--no-deps", "--no-build-isolation", "-q"]
    without = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    subprocess.run([*pip, "--ignore-installed", *(["-e"] if editable else []), str(source)], check=True, env=without)
    assert_types_are_seen(tmp_path, str(python), whole=True)
