"""Figures and pages of a run, which take most of the time of a short one."""

from __future__ import annotations

from importlib import import_module

import pytest
from matplotlib.figure import Figure

FIGURES = ("draw_forces", "error_figure", "parameter_figure", "identifiability_figure", "contribution_figure")
PAGE = "write_page"
_MODULES = [import_module(f"torchid.commands.{name}") for name in ("results", "run_figures", "evaluate")]
_DRAWN = [
    (module, name, vars(module)[name]) for module in _MODULES for name in (*FIGURES, PAGE) if name in vars(module)
]


def draw_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of `torchid identify` and `evaluate` in this process write small white figures, and no page."""
    for module, name, _ in _DRAWN:
        monkeypatch.setattr(module, name, lambda *_, **__: Figure(figsize=(1.0, 1.0)))


def draw(monkeypatch: pytest.MonkeyPatch) -> None:
    """They write what a user gets."""
    for module, name, figure in _DRAWN:
        monkeypatch.setattr(module, name, figure)
