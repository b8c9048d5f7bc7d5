"""Style of all figures: colours, axes and files."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from torchid.errors import during, escape
from torchid.parallel import share_between_forks, thread_count

# the palette of Okabe and Ito, which the colour-blind tell apart
MEASURED_COLOR = "#111111"  # of measured forces
NOMINAL_COLOR = "#d55e00"  # of the URDF's parameters, and what they predict
IDENTIFIED_COLOR = "#0072b2"  # of identified parameters, and what they predict
NOISE_COLOR = "#8c8c8c"

CATEGORY_COLORS = ("#56b4e9", "#f0e442", "#009e73", "#cc79a7", "#e69f00", NOISE_COLOR, IDENTIFIED_COLOR, NOMINAL_COLOR)
"""Of things that have no order; then again from the first."""

WIDTH = 12.0
"""Of figures [inches]: one width for all, so that a page shows all letters in one size."""

STYLE: dict[Any, Any] = {
    "font.size": 9,
    "text.parse_math": False,  # names may hold dollar signs
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.alpha": 0.3,
    "axes.titley": 1.0,  # looked for above the ticks, it takes an eighth of the time
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "pdf.fonttype": 42,  # letters that editors keep and journals accept
    "svg.hashsalt": "torchid",  # the same figure is the same file
}
_PLAIN_DECADES = 3.0  # power of ten up to which axes have plain numbers
_ROUNDING = 1e-9  # of a power of ten
_FEW_DECADES = 1e3  # span of an axis on which 2 and 5 are labelled, too
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_LEFT = 0.8  # inches beside the panels of `draw_panels`, for numbers and a unit
_RIGHT = 0.1
_ACROSS = 0.6  # inches between columns
_HEADLINE = 0.08  # inches above a title
#: 5 % larger than with the usual 6, in two thirds of the time.
_COMPRESSION = 3
#: Dates in files, without which the same run writes the same files.
_DATES = {"pdf": "CreationDate", "svg": "Date"}


def save_figure(figure: Figure, path: Path, kind: str | None = None) -> None:
    """Write a figure to a file, see `figure_bytes`."""
    with during("drawing", path):
        path.write_bytes(figure_bytes(figure, (kind or path.suffix[1:]).lower()))


def figure_bytes(figure: Figure, form: str) -> bytes:
    """A figure as the content of a file of type "png", "pdf" or "svg", with control characters in its texts escaped.

    The style is that of the figure: matplotlib creates tick labels only now, and they may contain dollar signs.
    """
    content = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        for text in _texts(figure):
            text.set_text(escape(text.get_text(), "\n"))
        figure.set_dpi(130)
        if form == "png":
            canvas = FigureCanvasAgg(figure)  # `savefig` draws all of it twice, once for the layout
            canvas.print_png(content, pil_kwargs={"compress_level": _COMPRESSION})
        else:
            figure.savefig(content, format=form, metadata={_DATES[form]: None})
    return content.getvalue()


def _texts(figure: Figure) -> Iterator[Text]:
    """The texts of a figure but those of ticks, which `findobj` would create one by one: see `label_ticks`."""
    legends = [*figure.legends, *(legend for axes in figure.axes if (legend := axes.get_legend()) is not None)]
    for legend in legends:
        yield from legend.get_texts()
    yield from figure.texts
    for axes in figure.axes:
        children = (*axes.get_children(), axes.xaxis.label, axes.yaxis.label)
        yield from (child for child in children if isinstance(child, Text))


def label_ticks(axis: Axis, positions: Sequence[float] | np.ndarray, names: Sequence[str], **style: Any) -> None:
    """Name places of an axis, control characters as escapes."""
    axis.set_ticks(positions, [escape(name, "\n") for name in names], **style)


def save_figures(figures: Mapping[str, Figure], folder: Path, form: str) -> None:
    """Write figures by name, in the format of that extension."""

    def save(name: str) -> None:
        save_figure(figures[name], folder / f"{name}.{form}")

    share_between_forks(list(figures), save, thread_count())


@dataclass(frozen=True)
class Drawn:
    """A figure as the content of its file, and as PNG."""

    file: bytes
    png: bytes


def draw_for(path: Path, make: Callable[[], Figure]) -> Drawn:
    """A figure that a function makes, for a file of a type by its extension."""
    with during("drawing", path):
        figure = make()
        form = path.suffix[1:]
        file = figure_bytes(figure, form)
        return Drawn(file, file if form == "png" else figure_bytes(figure, "png"))


def draw_panels(
    rows: int,
    columns: int,
    size: tuple[float, float],
    *,
    top: float = 0.6,
    bottom: float,
    down: float,
    **options: Any,
) -> tuple[Figure, np.ndarray]:
    """A figure with panels whose ticks are numbers, at fixed places: constrained layout takes as long as drawing.

    Args:
        rows: of panels.
        columns: likewise.
        size: width and height [inches].
        top: room above the panels [inches].
        bottom: room below them.
        down: room between rows.
        options: of `Figure.subplots`.
    """
    width, height = size
    panel_width = (width - _LEFT - _RIGHT - _ACROSS * (columns - 1)) / columns
    panel_height = (height - top - bottom - down * (rows - 1)) / rows
    edges = {"left": _LEFT / width, "right": 1.0 - _RIGHT / width, "bottom": bottom / height, "top": 1.0 - top / height}
    between = {"wspace": _ACROSS / panel_width, "hspace": down / panel_height}
    figure = Figure(figsize=size)
    return figure, figure.subplots(rows, columns, squeeze=False, gridspec_kw=edges | between, **options)


def set_headline(figure: Figure, text: str) -> None:
    """Write the title of a figure of `draw_panels` into its upper left corner."""
    figure.suptitle(text, x=0.01, y=1.0 - _HEADLINE / figure.get_figheight(), ha="left")


def decade(value: float) -> str:
    """A power of ten as axes show it; what matplotlib writes is a formula, which names forbid (`STYLE`)."""
    exponent = math.log10(value)
    if abs(exponent) <= _PLAIN_DECADES or abs(exponent - round(exponent)) > _ROUNDING:
        return f"{value:g}"
    return "10" + str(round(exponent)).translate(_SUPERSCRIPTS)


def label_decades(axis: Axis) -> None:
    """Label powers of ten of a logarithmic axis, and 2 and 5 times these where it spans few of them."""
    low, high = sorted(axis.get_view_interval())
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < _FEW_DECADES * low else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: decade(value)))
    axis.set_minor_locator(NullLocator())
