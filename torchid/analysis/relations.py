"""Base parameters in words: which parameters show only as part of a sum, and which not at all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchid.analysis.base_parameters import BaseParameters
from torchid.parameters import PARAMETERS, PER_BODY


def relations(base: BaseParameters, body_names: Sequence[str]) -> list[str]:
    """One sum per base parameter, such as `m[shank] + m[foot] - 0.31 Ixx[foot]`, coefficients in SI units.

    Args:
        base: in the parameters of bodies.
        body_names: of the L bodies, in order.
    """
    names = [f"{name}[{body}]" for body in body_names for name in PARAMETERS]
    lines = []
    for kept, row in zip(base.kept, base.combination, strict=True):
        others = [place for place in np.flatnonzero(row) if place != kept]
        lines.append("".join([names[kept], *(_term(row[place], names[place]) for place in others)]))
    return lines


def _term(coefficient: float, name: str) -> str:
    size = f"{abs(coefficient):.3g}"
    return f" {'-' if coefficient < 0 else '+'} {name if size == '1' else f'{size} {name}'}"


def unseen(base: BaseParameters, body_names: Sequence[str]) -> list[str]:
    """Free parameters that are part of no sum, one line per body, such as `foot: Ixx, Ixy, Ixz, Iyy, Iyz, Izz`.

    Args:
        base: in the parameters of bodies.
        body_names: of the L bodies, in order.
    """
    lost = (base.free & ~base.combination.any(axis=0)).reshape(-1, PER_BODY)
    return [
        f"{body}: {', '.join(PARAMETERS[place] for place in np.flatnonzero(numbers))}"
        for body, numbers in zip(body_names, lost, strict=True)
        if numbers.any()
    ]
