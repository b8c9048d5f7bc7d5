"""The figure of what was identified of every body, beside the URDF's."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchid import parameters
from torchid.estimators import Estimate
from torchid.estimators.least_squares import FIXED, IDENTIFIED
from torchid.parameters import INERTIAL, PARAMETERS, PER_BODY, Array
from torchid.report import palette
from torchid.report.figures import STYLE

INTERVAL = 1.96
"""Standard errors on either side of a 95 % interval."""

_IMPOSSIBLE = "x "  # before the name of a body
_SINGLE = {"m": "mass [kg]", "fc": "Coulomb friction", "fv": "viscous friction"}
_UNITS = {"revolute": {"fc": "N m", "fv": "N m s/rad"}, "prismatic": {"fc": "N", "fv": "N s/m"}}
_DERIVED: dict[str, Callable[[Array], Array]] = {
    "first moment, length [kg m]": lambda phi: np.linalg.norm(phi[:, parameters.FIRST_MOMENT], axis=1),
    "inertia about origin, trace [kg m²]": lambda phi: np.trace(parameters.inertia_matrix(phi), axis1=1, axis2=2),
}


@matplotlib.rc_context(STYLE)
def parameter_figure(
    body_names: Sequence[str],
    nominal: Array,
    estimate: Estimate,
    kinds: Collection[str] = ("revolute", "prismatic"),
    of: str = "URDF",
) -> Figure:
    """Mass, first moment, inertia and friction of every body with a free parameter.

    Filled points are identified and have their 95 % intervals; hollow ones are known only in sums with others, or
    mostly the URDF's. Negative values, and names of bodies that cannot exist, have a cross.

    Args:
        body_names: of all bodies.
        nominal: (L, 12), the URDF's parameters.
        estimate: the fit.
        kinds: of the robot's joints, which friction has the unit of.
        of: what the nominal parameters are from.
    """
    verdict = estimate.verdict.reshape(-1, PER_BODY)
    shown = np.flatnonzero((verdict != FIXED).any(axis=1))
    before, after, errors = (x.reshape(-1, PER_BODY)[shown] for x in (nominal, estimate.phi, estimate.standard_error))
    known = (verdict[shown] == IDENTIFIED) & np.isfinite(errors)
    single = [name for name in _SINGLE if (verdict[shown][:, PARAMETERS.index(name)] != FIXED).any()]
    titles = [_title("m", kinds), *_DERIVED, *(_title(name, kinds) for name in single if name != "m")]
    figure = Figure(figsize=(1.9 + 2.3 * len(titles), 0.24 * len(shown) + 1.7), layout="constrained")
    axes = dict(zip(titles, figure.subplots(1, len(titles), sharey=True, squeeze=False)[0], strict=True))
    for name in single:
        k = PARAMETERS.index(name)
        free = verdict[shown][:, k] != FIXED
        bars = np.where(known[:, k], INTERVAL * errors[:, k], np.nan)
        urdf, identified = (np.where(free, x[:, k], np.nan) for x in (before, after))
        _draw(axes[_title(name, kinds)], urdf, identified, known[:, k], bars)
    for title, quantity in _DERIVED.items():
        _draw(axes[title], quantity(before), quantity(after), known[:, INERTIAL].all(axis=1), None)
    for title, axis in axes.items():
        axis.set_xlabel(title)
        axis.axvline(0.0, color="0.7", linewidth=0.8, zorder=0)
    impossible = (after[:, parameters.MASS] <= 0.0) & before[:, INERTIAL].any(axis=1)
    impossible |= parameters.consistency_margin(after) < parameters.POSSIBLE_MARGIN
    names = [(_IMPOSSIBLE if bad else "") + body_names[int(k)] for k, bad in zip(shown, impossible, strict=True)]
    first = axes[titles[0]]
    first.set_yticks(range(len(shown)), names, fontsize=7)
    first.set_ylim(len(shown) - 0.4, -0.6)
    figure.legend(handles=_legend(first, of, bool(impossible.any())), loc="outside upper right", ncols=4)
    return figure


def _title(name: str, kinds: Collection[str]) -> str:
    units = [by_name[name] for kind, by_name in _UNITS.items() if kind in kinds and name in by_name]
    return f"{_SINGLE[name]} [{' or '.join(units)}]" if units else _SINGLE[name]


def _draw(axis: Axes, before: Array, after: Array, known: np.ndarray, bars: Array | None) -> None:
    """The URDF's values and the identified, some with error bars, one row for each body."""
    rows = np.arange(len(before))
    axis.plot(before, rows - 0.16, "D", markerfacecolor="none", color=palette.NOMINAL, markersize=4.5)
    if bars is not None:
        axis.errorbar(after, rows + 0.16, xerr=bars, fmt="none", ecolor=palette.IDENTIFIED, elinewidth=1.1, capsize=2)
    for chosen, face in ((known, palette.IDENTIFIED), (~known, "white")):
        real = chosen & (after >= 0.0)
        axis.plot(
            after[real], rows[real] + 0.16, "o", markerfacecolor=face, color=palette.IDENTIFIED, markersize=5, zorder=3
        )
    negative = after < 0.0
    axis.plot(after[negative], rows[negative] + 0.16, "X", color=palette.MEASURED, markersize=6, zorder=3)


def _legend(axis: Axes, of: str, impossible: bool) -> list[matplotlib.artist.Artist]:
    """Handles with labels, drawn outside of what is seen."""
    kinds = [("D", palette.NOMINAL, "none", of), ("o", palette.IDENTIFIED, palette.IDENTIFIED, "identified, 95 %")]
    kinds.append(("o", palette.IDENTIFIED, "white", f"known in sums, or the {of}'s"))
    if impossible:
        kinds.append(("X", palette.MEASURED, palette.MEASURED, "cannot exist"))
    return [
        axis.plot([], [], mark, color=color, markerfacecolor=face, label=label)[0] for mark, color, face, label in kinds
    ]
