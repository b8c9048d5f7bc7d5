"""One file that shows a run in a browser, without a network: template, figures and the library that draws them."""

from __future__ import annotations

import base64
import gzip
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torchid import __version__
from torchid.errors import InputError, escape, how_to_install
from torchid.logs.time_range import log_title
from torchid.parameters import PARAMETERS
from torchid.problem.contact_state import IN_THE_AIR
from torchid.report.page_figures import (
    contribution_bars,
    ellipsoid_scene,
    force_panels,
    parameter_bars,
    spectrum_panels,
    state_color,
)
from torchid.report.parameter_figures import INTERVAL

_TEMPLATE = "page.html"
_LEVEL = 5  # 1 % larger than with 9, in half of the time
_DRAWN = ("m", "fc", "fv")
_VERSIONS = ("numpy", "scipy", "torch", "plotly")


@dataclass(frozen=True)
class RunFiles:
    """What a page shows.

    Attributes:
        name: of the run.
        config: text of `config.yaml`.
        parameters: contents of `parameters.json`.
        metrics: contents of `metrics.json`.
        report: contents of `report.json`.
        findings: of the checks of the logs, as `log_check_document` has them; None where none were made.
        not_checked: why.
    """

    name: str
    config: str
    parameters: Mapping[str, Any]
    metrics: Mapping[str, Any]
    report: Mapping[str, Any]
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


def require_page() -> None:
    """Refuse to make a page without its libraries. Raises InputError: they are not installed."""
    if find_spec("plotly") is None or find_spec("jinja2") is None:
        raise InputError("", "report", "plotly or jinja2 is not installed", how_to_install("report"))


def page_text(run: RunFiles) -> str:
    """The page of a run.

    Raises:
        InputError: the libraries of a page are not installed.
        LookupError, TypeError, ValueError: files of a run that torchid has not written.
    """
    require_page()
    import jinja2

    of = run.report["robot"].get("format", "URDF")
    scene, impossible = ellipsoid_scene(
        run.parameters["bodies"], run.report["bodies"]["poses"], run.report["bodies"]["parents"], of
    )
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        finalize=_plain,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "sort_keys": False, "separators": (",", ":")}
    environment.filters["log_title"] = log_title
    environment.filters["number"] = _number
    forces = run.report["forces"]
    return environment.get_template(_TEMPLATE).render(
        run=run,
        answer=run.report["answer"],
        of=of,
        forces=forces,
        states=_named_states(forces),
        figures={name: figure for name, figure in _figures(run, scene, of).items() if figure is not None},
        impossible=impossible,
        parameters=PARAMETERS,
        interval=INTERVAL,
        library=_library(),
    )


def _figures(run: RunFiles, scene: Mapping[str, Any] | None, of: str) -> dict[str, Mapping[str, Any] | None]:
    """All figures by their place in the template, None for those that this run has not."""
    forces, metrics = run.report["forces"], run.metrics
    units = run.parameters["units"]
    out: dict[str, Mapping[str, Any] | None] = {}
    if forces is not None:
        for kind in ("recorded", "projected"):
            out[kind] = force_panels(forces, kind, of) if forces[kind] else None
        if forces["recorded"] and forces["states"]["names"] == [IN_THE_AIR]:
            out["projected"] = None  # the same once more
        out["spectra"] = spectrum_panels(forces["projected"], of)
    out |= {f"parameter_{name}": parameter_bars(run.parameters["bodies"], name, units[name], of) for name in _DRAWN}
    out["ellipsoids"] = scene
    added = metrics["identifiability"]
    out |= {"logs": contribution_bars(added["logs"], True), "sensors": contribution_bars(added["sensors"])}
    return out | {"states": contribution_bars(metrics["contact_states"])}


def _named_states(forces: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Contact states of the log that is shown, with their colours, where there are several."""
    if forces is None or len(forces["states"]["names"]) < 2:
        return []
    states = forces["states"]
    return [(name, state_color(states, number)) for number, name in enumerate(states["names"])]


@cache
def _library() -> str:
    """Plotly's library, compressed, in base64."""
    spec = find_spec("plotly")
    if spec is None or spec.origin is None:
        raise InputError("", "report", "plotly is not installed", how_to_install("report"))
    code = (Path(spec.origin).parent / "package_data" / "plotly.min.js").read_bytes()
    return base64.b64encode(gzip.compress(code, _LEVEL, mtime=0)).decode()


def _plain(value: Any) -> Any:
    """A foreign text with control characters as escapes; what is markup already stays."""
    return escape(value, "\n\t") if type(value) is str else value


def _number(value: float | None, digits: int = 4) -> str:
    """A number of a table, a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}g}"
