"""Units, signs and turns of the numbers of an entry."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchid.logs.column_entries import KEY, AngleEntry
from torchid.logs.column_map import Part, values_by_name
from torchid.logs.log import FloatArray
from torchid.logs.units import unit_factor


def element_factors(part: Part, names: Sequence[str]) -> FloatArray | None:
    """What the elements of a sample are multiplied by, (n,), (k,) or (n, k); None where that is 1."""
    entry, key = part.entry, f"{KEY}.{part.key}"
    if not entry.unit and not entry.scale:
        return None
    of_names, of_components = names if part.kind else ("",), part.components or ("",)
    elements = [(".".join(filter(None, (name, axis))), axis) for name in of_names for axis in of_components]
    labels = [label for label, _ in elements]
    units = values_by_name(f"{key}.unit", entry.unit, labels)
    scales = values_by_name(f"{key}.scale", entry.scale, labels)
    out = np.ones(len(elements))
    for index, (label, axis) in enumerate(elements):
        if label in units:
            out[index] = unit_factor(f"{key}.unit", units[label], part.quantities[axis])
        out[index] *= scales.get(label, 1.0)
    shape = ([len(of_names)] if part.kind else []) + ([len(of_components)] if part.components else [])
    return None if (out == 1.0).all() else out.reshape(shape)


def joint_turns(part: Part, names: Sequence[str]) -> tuple[FloatArray, FloatArray] | None:
    """Where the turn of each joint begins, NaN for one that is taken as it is, and how much a turn is, each (n,)."""
    if not isinstance(part.entry, AngleEntry) or not part.entry.turn_from:
        return None
    starts = values_by_name(f"{KEY}.{part.key}.turn_from", part.entry.turn_from, names)
    units = values_by_name(f"{KEY}.{part.key}.unit", part.entry.unit, names)
    angle = [unit_factor(f"{KEY}.{part.key}.turn_from", units.get(name, "rad"), ("angle",)) for name in names]
    return np.array([starts.get(name, np.nan) for name in names]), 2.0 * np.pi / np.array(angle)
