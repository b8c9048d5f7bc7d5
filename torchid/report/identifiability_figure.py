"""What the data say of every parameter, as a picture."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from torchid.estimators import Estimate
from torchid.estimators.result import FIXED
from torchid.parameters import PARAMETERS, PER_BODY
from torchid.report.figures import STYLE
from torchid.report.tables import MARKS, legend_of_marks


@matplotlib.rc_context(STYLE | {"axes.grid": False})
def identifiability_figure(body_names: Sequence[str], estimate: Estimate) -> Figure:
    """Share of the data in every parameter, with the mark of its verdict, and the singular values of the problem."""
    verdicts = estimate.verdict.reshape(-1, PER_BODY)
    shown = np.flatnonzero((verdicts != FIXED).any(axis=1))
    share = estimate.data_share.reshape(-1, PER_BODY)[shown]
    figure = Figure(figsize=(11.0, 0.24 * len(shown) + 1.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.9, 1.0])
    image = left.imshow(share, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for row, body in enumerate(shown):
        for column, verdict in enumerate(verdicts[body]):
            color = "white" if share[row, column] > 0.6 else "black"
            left.text(column, row, MARKS[verdict], ha="center", va="center", fontsize=8, color=color)
    left.set_xticks(range(PER_BODY), PARAMETERS, fontsize=7)
    left.set_yticks(range(len(shown)), [body_names[int(body)] for body in shown], fontsize=7)
    left.set_title(legend_of_marks(), loc="left", fontsize=8)
    figure.colorbar(image, ax=left, label="share of the data", pad=0.01)
    values = estimate.singular_values
    right.semilogy(np.arange(1, len(values) + 1), values, ".", color="tab:blue", markersize=4)
    right.yaxis.set_major_formatter(LogFormatter())  # the default writes formulas, which names forbid, see STYLE
    right.axvline(estimate.rank + 0.5, color="0.5", linewidth=0.8)
    right.set_title(f"singular values, rank {estimate.rank}", loc="left", fontsize=8)
    right.set_xlabel("number")
    right.set_ylabel("singular value [standard deviations per scale]")
    right.grid(visible=True)
    return figure
