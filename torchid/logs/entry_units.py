"""Units, signs and turns of the numbers of an entry."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from torchid.logs.column_entries import KEY, AngleEntry
from torchid.logs.column_map import EntryPart, values_by_name
from torchid.logs.column_matching import Matched
from torchid.logs.log import FloatArray
from torchid.logs.units import IN_DEGREES, TRANSLATION, unit_factor


def names_in_degrees(matched: Matched) -> set[str]:
    """Names whose numbers are in degrees in a file that says so of what turns, "" for numbers without a name.

    All but those of columns of translations.
    """
    columns = matched.columns if matched.by_name and not matched.by_component else ()
    moving = {name for name, column in zip(matched.names, columns, strict=False) if TRANSLATION.search(column)}
    return {*matched.names, ""} - moving


def element_factors(part: EntryPart, names: Sequence[str], in_degrees: Collection[str]) -> FloatArray | None:
    """What the elements of a sample are multiplied by, (n,), (k,) or (n, k); None where that is 1.

    Args:
        part: of a map.
        names: of its elements, in their order.
        in_degrees: those that are in degrees where they turn and have no unit, from `names_in_degrees`.

    Raises:
        ConfigError: a unit of another quantity.
    """
    entry, key = part.entry, f"{KEY}.{part.key}"
    if not entry.unit and not entry.scale and not in_degrees:
        return None
    of_names, of_components = names if part.kind else ("",), part.components or ("",)
    elements = [(name, ".".join(filter(None, (name, axis))), axis) for name in of_names for axis in of_components]
    labels = [label for _, label, _ in elements]
    units = values_by_name(f"{key}.unit", entry.unit, labels)
    scales = values_by_name(f"{key}.scale", entry.scale, labels)
    out = np.ones(len(elements))
    for index, (name, label, axis) in enumerate(elements):
        quantities = part.quantities[axis]
        unit = units.get(label, IN_DEGREES.get(quantities[0], "") if quantities and name in in_degrees else "")
        if unit:
            out[index] = unit_factor(f"{key}.unit", unit, quantities)
        out[index] *= scales.get(label, 1.0)
    shape = ([len(of_names)] if part.kind else []) + ([len(of_components)] if part.components else [])
    return None if (out == 1.0).all() else out.reshape(shape)


def joint_turns(
    part: EntryPart, names: Sequence[str], in_degrees: Collection[str]
) -> tuple[FloatArray, FloatArray] | None:
    """Where the turn of each joint begins, NaN for one that is taken as it is, and how much a turn is, each (n,).

    As in `element_factors`.
    """
    if not isinstance(part.entry, AngleEntry) or not part.entry.turn_from:
        return None
    starts = values_by_name(f"{KEY}.{part.key}.turn_from", part.entry.turn_from, names)
    units = values_by_name(f"{KEY}.{part.key}.unit", part.entry.unit, names)
    of_names = [units.get(name, "deg" if name in in_degrees else "rad") for name in names]
    angle = [unit_factor(f"{KEY}.{part.key}.turn_from", unit, ("angle",)) for unit in of_names]
    return np.array([starts.get(name, np.nan) for name in names]), 2.0 * np.pi / np.array(angle)
