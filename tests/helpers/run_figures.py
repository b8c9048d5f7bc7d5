"""Figures, pages and event files of a run, which take most of the time of a short one."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, partial
from importlib import import_module
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from torchid.report import figure_style

FIGURES = (
    *("force_figure", "error_figure", "parameter_figure", "identifiability_figure", "contribution_figure"),
    *("spectrum_figure", "inertia_figure"),
    *("pressure_figure", "extra_figure", "ridge_figure", "tree_figure"),
)
OF_A_RUN = (*("forces", "pressure", "spectra", "errors", "parameters", "identifiability", "inertia", "contributions"),)
"""Names of the figures that every run of logs has, in their order."""

PAGE, EVENTS = "write_page", "write_events"
_WHITE = Figure(figsize=(1.0, 1.0))
_figure_bytes = figure_style.figure_bytes
_white_bytes = cache(partial(_figure_bytes, _WHITE))
_MODULES = [import_module(f"torchid.commands.{name}") for name in ("run_folder", "evaluate", "analyze")]
_DRAWN = [
    (module, name, vars(module)[name])
    for module in _MODULES
    for name in (*FIGURES, PAGE, EVENTS)
    if name in vars(module)
]


def draw_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands in this process write one small white figure for all, no page of a run and no events."""
    for module, name, _ in _DRAWN:
        monkeypatch.setattr(module, name, _write_nothing if name == EVENTS else lambda *_, **__: _WHITE)
    monkeypatch.setattr(
        figure_style,
        "figure_bytes",
        lambda figure, form: _white_bytes(form) if figure is _WHITE else _figure_bytes(figure, form),
    )


def _write_nothing(_: object, folder: Path, figures: Mapping[str, bytes]) -> None:
    """An event file without any."""
    del figures
    (folder / "events.out.tfevents.0").touch()


def draw(monkeypatch: pytest.MonkeyPatch, names: tuple[str, ...] = (*FIGURES, PAGE, EVENTS)) -> None:
    """They write what a user gets."""
    for module, name, figure in _DRAWN:
        if name in names:
            monkeypatch.setattr(module, name, figure)
