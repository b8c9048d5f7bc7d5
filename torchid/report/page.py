"""One file that shows a run in a browser, without a network: tables, and the figures of its folder."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from torchid import __version__
from torchid.errors import escape
from torchid.logs.time_range import log_title
from torchid.parameters import PARAMETERS
from torchid.report.figures import INTERVAL

FIGURES = {
    "forces": "forces or joint torques over time, measured and predicted",
    "pressure": "centre of pressure over time, measured and predicted",
    "spectra": "errors by frequency, against the noise",
    "errors": "errors before and after by group of forces",
    "parameters": "mass, first moment, inertia and friction of each body",
    "identifiability": "share of the data in each parameter",
    "inertia": "ellipsoids of inertia from two sides",
    "extras": "offsets, scales and terms of actuators",
    "contributions": "information lost without each log, contact state and sensor",
    "ridge": "error on held-out blocks by ridge",
}
"""What the figures of a run show, by name."""

_VERSIONS = ("numpy", "scipy", "torch")


@dataclass(frozen=True)
class RunFiles:
    """What a page shows.

    Attributes:
        name: of the run.
        config: text of `config.yaml`.
        parameters: contents of `parameters.json`.
        metrics: contents of `metrics.json`.
        report: contents of `report.json`.
        figures: of `FIGURES`, as URLs that hold them.
        findings: of the checks of the logs, as `log_check_document` has them; None where none were made.
        not_checked: why.
    """

    name: str
    config: str
    parameters: Mapping[str, Any]
    metrics: Mapping[str, Any]
    report: Mapping[str, Any]
    figures: Mapping[str, str] = field(default_factory=dict)
    findings: Sequence[Mapping[str, Any]] | None = None
    not_checked: str = ""


def versions() -> dict[str, str]:
    """Of torchid, of Python and of the libraries that numbers depend on."""
    out = {"torchid": __version__, "Python": platform.python_version()}
    for name in _VERSIONS:
        try:
            out[name] = version(name)
        except PackageNotFoundError:
            continue
    return out | {"system": platform.platform()}


def page_text(run: RunFiles) -> str:
    """The page of a run. Raises LookupError, TypeError, ValueError: files of a run that torchid has not written."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        finalize=_plain,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["log_title"] = log_title
    environment.filters["number"] = _number
    try:
        return environment.get_template("page.html").render(
            run=run,
            answer=run.report["answer"],
            of=run.report["robot"].get("format", "URDF"),
            labels=FIGURES,
            parameters=PARAMETERS,
            interval=INTERVAL,
        )
    except jinja2.UndefinedError as error:
        raise LookupError(str(error)) from error


def _plain(value: Any) -> Any:
    """A foreign text with control characters as escapes; what is markup already stays."""
    return escape(value, "\n\t") if type(value) is str else value


def _number(value: float | None, digits: int = 4) -> str:
    """A number of a table, a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}g}"
