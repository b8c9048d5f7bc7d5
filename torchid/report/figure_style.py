"""Style of all figures: colours, axes and files."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from torchid.errors import during, escape
from torchid.parallel import share_between_forks, thread_count

# the palette of Okabe and Ito, which the colour-blind tell apart
MEASURED_COLOR, NOMINAL_COLOR, IDENTIFIED_COLOR, NOISE_COLOR = "#111111", "#d55e00", "#0072b2", "#8c8c8c"
"""Of measured forces, of the URDF's and of identified parameters and what they predict, and of noise."""

CATEGORY_COLORS = ("#56b4e9", "#f0e442", "#009e73", "#cc79a7", "#e69f00", NOISE_COLOR, IDENTIFIED_COLOR, NOMINAL_COLOR)
"""Of things that have no order; then again from the first."""

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
#: Up to which power of ten axes have plain numbers, and how far off a power rounding is.
_PLAIN_DECADES, _ROUNDING = 3.0, 1e-9
_FEW_DECADES = 1e3  # span of an axis on which 2 and 5 are labelled, too
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
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
        for text in figure.findobj(Text):
            text.set_text(escape(text.get_text(), "\n"))
        figure.set_dpi(130)
        if form == "png":
            canvas = FigureCanvasAgg(figure)  # `savefig` draws all of it twice, once for the layout
            canvas.print_png(content, pil_kwargs={"compress_level": _COMPRESSION})
        else:
            figure.savefig(content, format=form, metadata={_DATES[form]: None})
    return content.getvalue()


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
        figure, form = make(), path.suffix[1:]
        file = figure_bytes(figure, form)
        return Drawn(file, file if form == "png" else figure_bytes(figure, "png"))


def decade(value: float) -> str:
    """A power of ten as axes show it; what matplotlib writes is a formula, which names forbid (`STYLE`)."""
    exponent = math.log10(value)
    if abs(exponent) <= _PLAIN_DECADES or abs(exponent - round(exponent)) > _ROUNDING:
        return f"{value:g}"
    return "10" + str(round(exponent)).translate(_SUPERSCRIPTS)


def decade_formatter() -> FuncFormatter:
    """Of the ticks of a logarithmic axis."""
    return FuncFormatter(lambda value, _: decade(value))


def label_decades(axis: Axis) -> None:
    """Label 1, 2 and 5 of each power of ten of a logarithmic axis, however little of one it spans."""
    low, high = sorted(axis.get_view_interval())
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < _FEW_DECADES * low else (1.0,)))
    axis.set_major_formatter(decade_formatter())
    axis.set_minor_formatter(NullFormatter())
