"""Figures and pages of a run, which take most of the time of a short one."""

from __future__ import annotations

from functools import cache
from importlib import import_module

import pytest
from matplotlib.figure import Figure

from torchid.report import figures

FIGURES = (
    "draw_forces",
    "error_figure",
    "parameter_figure",
    "identifiability_figure",
    "contribution_figure",
    "drift_figure",
)
PAGE = "write_page"
_MODULES = [import_module(f"torchid.commands.{name}") for name in ("results", "evaluate", "replay")]
_DRAWN = [
    (module, name, vars(module)[name]) for module in _MODULES for name in (*FIGURES, PAGE) if name in vars(module)
]
_WHITE, _BYTES = Figure(figsize=(1.0, 1.0)), figures.figure_bytes


@cache
def _white(form: str) -> bytes:
    """The content of a white figure's file of a type, which takes 0.03 s to draw."""
    return _BYTES(_WHITE, form)


def draw_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of `torchid identify`, `evaluate` and `replay` in this process write small white figures, and no page."""
    for module, name, _ in _DRAWN:
        monkeypatch.setattr(module, name, lambda *_, **__: _WHITE)
    monkeypatch.setattr(figures, "figure_bytes", lambda x, form: _white(form) if x is _WHITE else _BYTES(x, form))


def draw(monkeypatch: pytest.MonkeyPatch) -> None:
    """They write what a user gets."""
    for module, name, figure in _DRAWN:
        monkeypatch.setattr(module, name, figure)
