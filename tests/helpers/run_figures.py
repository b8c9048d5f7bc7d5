"""Figures, pages and event files of a run, which take most of the time of a short one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path

import pytest
from matplotlib.figure import Figure

FIGURES = (
    *("draw_forces", "error_figure", "parameter_figure", "identifiability_figure", "contribution_figure"),
    *("extra_figure", "ridge_figure", "tree_figure", "accuracy_figure"),
)
PAGE, EVENTS = "write_page", "write_events"
_MODULES = [import_module(f"torchid.commands.{name}") for name in ("results", "evaluate", "analyze")]
_DRAWN = [
    (module, name, vars(module)[name])
    for module in _MODULES
    for name in (*FIGURES, PAGE, EVENTS)
    if name in vars(module)
]


def draw_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands in this process write small white figures, no page of a run and no events."""
    for module, name, _ in _DRAWN:
        monkeypatch.setattr(
            module, name, _write_nothing if name == EVENTS else lambda *_, **__: Figure(figsize=(1.0, 1.0))
        )


def _write_nothing(_: object, folder: Path, figures: Callable[[], Mapping[str, bytes]]) -> None:
    """The figures' files, which are written once TensorBoard has them, and an event file without any."""
    figures()
    (folder / "events.out.tfevents.0").touch()


def draw(monkeypatch: pytest.MonkeyPatch, names: tuple[str, ...] = (*FIGURES, PAGE, EVENTS)) -> None:
    """They write what a user gets."""
    for module, name, figure in _DRAWN:
        if name in names:
            monkeypatch.setattr(module, name, figure)
