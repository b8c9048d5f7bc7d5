"""The numbers of an entry of a map from its columns: their order, units, signs and turns."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError
from torchid.logs.column_entries import KEY, AngleEntry, ColumnEntry, Gains, VectorEntry
from torchid.logs.column_map import EntryPart, values_by_name
from torchid.logs.column_matching import Matched
from torchid.logs.log import FloatArray
from torchid.logs.units import IN_DEGREES, TRANSLATION, unit_factor

Take = Callable[[str], NDArray[Any]]
"""The values (N, ...) of a column or an array."""


@dataclass(frozen=True)
class EntryValues:
    """How the numbers of an entry come from its columns.

    Attributes:
        of: the columns.
        order: which names of these, in the order of the log, -1 for one without a column; None for all as they are.
        factors: of a sample's elements, units and signs; None for 1.
        turns: in the unit of the columns where the turn of each joint begins that its angle is counted in, and how much
            a turn is, each (n,); None for angles as they are.
    """

    of: Matched
    order: list[int] | None
    factors: FloatArray | None
    turns: tuple[FloatArray, FloatArray] | None

    def read(self, take: Take) -> FloatArray:
        """The numbers (N, ...), or of gains that hold throughout (1, ...).

        Raises:
            LogError: a column of another shape or of no numbers.
        """
        arrays = [self._numbers(column, take(column)) for column in self.of.columns]
        lengths = [len(array) for array in arrays]
        if len(set(lengths)) > 1:
            other = next(index for index, length in enumerate(lengths) if length != lengths[0])
            found, accepted = f"{lengths[other]} samples", f"{lengths[0]}, as '{self.of.columns[0]}' has"
            raise LogError.at_field(f"'{self.of.columns[other]}'", found, accepted)
        if not self.of.by_name and not self.of.by_component:
            out = arrays[0]
        else:
            inner = self.of.by_name and bool(self.of.part.components) and not self.of.by_component
            out = np.stack(arrays, axis=1 if inner else -1)
            if self.of.by_name and self.of.by_component:
                out = out.reshape(len(out), len(self.of.labels), len(self.of.part.components))
        if self.order is not None:
            out = out[:, self.order]
            out[:, np.less(self.order, 0)] = np.nan
        if self.turns is not None:
            start, turn = self.turns
            out = np.where(np.isfinite(start), start + np.mod(out - np.nan_to_num(start), turn), out)
        out = out if self.factors is None else np.asarray(out * self.factors)
        return _with_zeros(out, self.of.part.entry)

    def _numbers(self, column: str, array: NDArray[Any]) -> FloatArray:
        if array.dtype.kind not in "fiub":
            raise LogError.at_field(f"'{column}'", f"values of type {array.dtype}", "real numbers")
        shape = self._shape()
        if isinstance(self.of.part.entry, Gains) and array.shape == shape:
            array = array[None]  # the same at all samples
        if shape[:1] == (1,) and array.ndim == len(shape) and array.shape[1:] == shape[1:]:
            array = array[:, None]  # of one name, without an axis for it
        if array.ndim == len(shape) + 2 and array.shape[1] == 1:  # one row of each sample, as of Matlab's tables
            array = array[:, 0]
        if array.ndim == 0:
            raise LogError.at_field(f"'{column}'", "a single value", "a row for each sample")
        if array.shape[1:] != shape and (array.shape[2:] != shape[1:] or not self.of.has_all_names(array.shape[1:2])):
            names = f", one for each name of its order ({self.of.labels[0]}, ...)" if self.of.labels and shape else ""
            turned = f"; '{column}.T' if its columns are the samples" if array.shape[:1] == shape else ""
            raise LogError.at_field(f"'{column}'", f"shape {_n_by(array.shape[1:])}", f"{_n_by(shape)}{names}{turned}")
        return np.asarray(array, dtype=np.float64)

    def _shape(self) -> tuple[int, ...]:
        """What a column has of each sample."""
        names = (len(self.of.labels),) if self.of.part.kind and not self.of.by_name else ()
        components = (len(self.of.part.components),) if self.of.part.components and not self.of.by_component else ()
        return names + components


def entry_values(
    matched: Mapping[str, Matched], names: Mapping[str, tuple[str, ...]], in_degrees: bool = False
) -> dict[str, EntryValues]:
    """How the numbers of all entries come from their columns, with names by field in the order of the log.

    A joint without a torque is NaN there.
    """
    out = {}
    for key, one in matched.items():
        common = names.get(one.part.names_field, ())
        order = [one.labels.index(name) if name in one.labels else -1 for name in common]
        kept = None if order == list(range(len(one.labels))) else order
        turning = _names_in_degrees(one) if in_degrees else set[str]()
        factors, turns = _element_factors(one.part, common, turning), _joint_turns(one.part, common, turning)
        out[key] = EntryValues(one, kept, factors, turns)
    return out


def _with_zeros(out: FloatArray, entry: ColumnEntry) -> FloatArray:
    """Vectors (N, C, 3) of what an entry has of them, (N, C, k)."""
    if not isinstance(entry, VectorEntry) or entry.axes is None:
        return out
    whole = np.zeros((*out.shape[:-1], 3))
    whole[..., ["xyz".index(axis) for axis in entry.axes]] = out
    return whole


def _n_by(shape: tuple[int, ...]) -> str:
    return f"({', '.join(map(str, ('N', *shape)))})"


def _names_in_degrees(matched: Matched) -> set[str]:
    """Names whose numbers are in degrees in a file that says so of what turns, "" for numbers without a name.

    All but those of columns of translations.
    """
    columns = matched.columns if matched.by_name and not matched.by_component else ()
    moving = {name for name, column in zip(matched.names, columns, strict=False) if TRANSLATION.search(column)}
    return {*matched.names, ""} - moving


def _element_factors(part: EntryPart, names: Sequence[str], in_degrees: Collection[str]) -> FloatArray | None:
    """What the elements of a sample are multiplied by, (n,), (k,) or (n, k); None where that is 1.

    Args:
        part: of a map.
        names: of its elements, in their order.
        in_degrees: those that are in degrees where they turn and have no unit, from `_names_in_degrees`.

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


def _joint_turns(
    part: EntryPart, names: Sequence[str], in_degrees: Collection[str]
) -> tuple[FloatArray, FloatArray] | None:
    """Where the turn of each joint begins, NaN for one that is taken as it is, and how much a turn is, each (n,).

    As in `_element_factors`.
    """
    if not isinstance(part.entry, AngleEntry) or not part.entry.turn_from:
        return None
    starts = values_by_name(f"{KEY}.{part.key}.turn_from", part.entry.turn_from, names)
    units = values_by_name(f"{KEY}.{part.key}.unit", part.entry.unit, names)
    of_names = {name: units.get(name, "deg" if name in in_degrees else "rad") for name in names}
    angle = [unit_factor(f"{KEY}.{part.key}.turn_from", of_names[x], ("angle",)) if x in starts else 1.0 for x in names]
    return np.array([starts.get(name, np.nan) for name in names]), 2.0 * np.pi / np.array(angle)
