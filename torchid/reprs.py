"""Short representations (`repr`) of objects, in at most ten lines."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import wrap

from torchid.errors import join_names

REPR_LINES = 10
_WIDTH = 110
_UNBROKEN = "\N{NO-BREAK SPACE}"
_TEXT = 60  # characters of one value


def decimal(value: float) -> str:
    """A number with three decimals, or with three significant digits if it is small, such as grams in kg."""
    return f"{value:.3g}" if 0.0 < abs(value) < 0.1 else f"{value:.3f}"


def short_repr(thing: object) -> str:
    """The class with its `_headline()`, if it has one, and its fields: numbers, names, shapes.

    `__repr__ = short_repr` in the body of a class; a dataclass keeps it. What is None or empty is left out.
    """
    name = type(thing).__name__
    headline = getattr(thing, "_headline", None)
    if headline is None:
        lines = wrap(f"{name}({', '.join(_fields(thing, ''))})", _WIDTH, subsequent_indent="  ")
    else:
        title = f"{name}: {headline()}"
        lines = wrap(title, _WIDTH, subsequent_indent="  ")
        lines += wrap(", ".join(_fields(thing, title)), _WIDTH, initial_indent="  ", subsequent_indent="  ")
    lines = [line.replace(_UNBROKEN, " ") for line in lines]
    return "\n".join(lines if len(lines) <= REPR_LINES else [*lines[: REPR_LINES - 1], "  ..."])


def _fields(thing: object, title: str) -> Iterator[str]:
    """Fields of a dataclass as text, without texts that are in the title."""
    if not dataclasses.is_dataclass(thing):
        return
    for field in dataclasses.fields(thing):
        value = getattr(thing, field.name, None)
        if isinstance(value, str) and value in title:
            continue
        if field.repr and not field.name.startswith("_") and (text := _brief(value)):
            yield f"{field.name} {text}".replace(" ", _UNBROKEN)


def _brief(value: object) -> str:
    """A value in a few words, "" for empty ones."""
    if (shape := getattr(value, "shape", None)) is not None and hasattr(value, "dtype"):  # of NumPy or torch
        return str(tuple(shape))
    if value is None or (isinstance(value, (str, Sequence, Mapping, frozenset)) and not len(value)):
        return ""
    if isinstance(value, (bool, int, float)):
        return f"{value:.6g}" if isinstance(value, float) else str(value)
    if isinstance(value, (str, Path)):
        return Path(value).name if isinstance(value, Path) else value[:_TEXT]
    if isinstance(value, Mapping):
        return f"[{join_names([str(key) for key in value])}]"
    if isinstance(value, (Sequence, frozenset)):
        return _brief_items(list(value))
    return type(value).__name__


def _brief_items(items: list[object]) -> str:
    if all(isinstance(x, (str, bool, int, float)) for x in items):
        return f"[{join_names([_brief(x) for x in items])}]"
    return f"{len(items)} x {type(items[0]).__name__}"
