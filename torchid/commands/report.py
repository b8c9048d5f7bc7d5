"""`torchid report`: the page of a run, from the files in its folder; and what a run leaves there for it."""

from __future__ import annotations

import json
from base64 import b64encode
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchid.commands.answer import answer
from torchid.commands.check import check_experiment
from torchid.commands.folder import RUN, file_checksum, read_manifest, refuse_link
from torchid.errors import ConfigError, InputError, during, excerpt
from torchid.guards import MAX_JSON, MAX_YAML, read_bytes
from torchid.report.log_checks import log_check_document
from torchid.report.page import FIGURES, RunFiles, page_text, versions
from torchid.staging import atomic_file

if TYPE_CHECKING:
    from torchid.commands.results import Identification

PAGE, DATA = "report.html", "report.json"
_JSON = ("parameters.json", "metrics.json", DATA)

_WRITTEN = "a folder that this version of torchid identify wrote"


def report_document(run: Identification) -> dict[str, Any]:
    """What `report.json` holds: what the page of a run shows and no other file of its folder has."""
    robot = run.experiment.robot
    return {
        "answer": asdict(answer(run)),
        "robot": {"name": robot.path.name, "base": robot.base_link, "joints": robot.n, "format": robot.format},
        "versions": versions(),
    }


def write_page(folder: Path, output: Path) -> None:
    """Write the page of a run that is being written.

    Args:
        folder: with its files.
        output: that the folder will be.
    """
    asked = f"torchid report {output} checks the logs and lists here what it finds."
    (folder / PAGE).write_text(page_text(replace(_read(folder), name=output.name, not_checked=asked)))


def report(run: str | Path) -> Path:
    """Make the page of a finished run anew, with the findings of the checks of its logs; the path of the page.

    Raises:
        InputError: the folder is no run, or its page has been edited.
    """
    folder = Path(run)
    refuse_link(folder)
    manifest = read_manifest(folder)
    if manifest is None or manifest.kind != RUN.name:
        raise ConfigError(folder, "RUN", "no run of torchid", _WRITTEN)
    page, written = folder / PAGE, manifest.files.get(PAGE)
    there = page.exists() or page.is_symlink()
    if there and (page.is_symlink() or not page.is_file() or written is None or file_checksum(page) != written):
        raise ConfigError(folder, PAGE, "changed since torchid wrote it", f"a run without {PAGE}: move it elsewhere")
    files = _with_findings(_read(folder), folder)
    with during("writing", folder), atomic_file(page) as new:
        new.write_text(_made(files, folder))
    replace(manifest, files=manifest.files | {PAGE: file_checksum(page)}).write(folder)
    return page


def _made(files: RunFiles, folder: Path) -> str:
    """The page of files that somebody may have changed. Raises InputError: they are not what a page needs."""
    try:
        return page_text(files)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        found = f"not what a page needs ({excerpt(str(error))})"
        raise InputError(folder, ", ".join(_JSON), found, _WRITTEN) from error


def _read(folder: Path) -> RunFiles:
    """The files of a run that its page shows. Raises InputError: one is missing or cannot be read."""
    parameters, metrics, data = (_document(folder, name) for name in _JSON)
    return RunFiles(
        name=folder.resolve().name,
        config=_text(folder, "config.yaml", MAX_YAML),
        parameters=parameters,
        metrics=metrics,
        report=data,
        figures=_figures(folder),
    )


def _figures(folder: Path) -> dict[str, str]:
    """The figures of a run that a browser shows, as URLs that hold them."""
    out = {}
    for suffix, kind in ((".svg", "image/svg+xml"), (".png", "image/png")):
        for path in (folder / f"{name}{suffix}" for name in FIGURES):
            if path.is_file():
                with during("reading", path):
                    out[path.stem] = f"data:{kind};base64,{b64encode(read_bytes(path, MAX_JSON)).decode()}"
    return out


def _document(folder: Path, name: str) -> dict[str, Any]:
    text = _text(folder, name, MAX_JSON)
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(folder, name, f"not readable as JSON ({excerpt(str(error))})", _WRITTEN) from error
    return document if isinstance(document, dict) else {}


def _text(folder: Path, name: str, most: int) -> str:
    if not (folder / name).exists():
        raise InputError(folder, name, "missing", _WRITTEN)
    try:
        return read_bytes(folder / name, most).decode()
    except (OSError, ValueError) as error:
        raise InputError(folder, name, f"not readable ({excerpt(str(error))})", _WRITTEN) from error


def _with_findings(files: RunFiles, folder: Path) -> RunFiles:
    """With what the checks of the logs find, or why they cannot be made."""
    try:
        checked = check_experiment(folder / "config.yaml")
    except InputError as error:
        return replace(files, not_checked=f"The logs could not be checked: {error}")
    return replace(files, findings=log_check_document(checked)["logs"])
