"""Read the fields of a log from named columns or arrays with a map: names, orders, units, formulas.

Columns with torchid's own names (`joint_position.l_knee`) need no entry in the map.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import ConfigError, LogError, excerpt, join_names
from torchid.logs.arrays import fields_of_records, parse_names, with_parts
from torchid.logs.columns import (
    AXES,
    COLUMN_FIELDS,
    FRACTIONS,
    KEY,
    KINDS,
    MOST_LISTED,
    PLACEHOLDER,
    AngleEntry,
    ColumnEntry,
    Columns,
    EntryPart,
    Gains,
    TimeEntry,
    check_columns,
    fits,
    letters_of,
    list_parts,
    native_part,
    unknown_columns,
    values_by_name,
    values_of_all,
)
from torchid.logs.log import (
    FLAG_ACCEPTED,
    FLAG_WORDS,
    FORCE_NORMAL,
    NAME_FIELDS,
    POINTS,
    SHAPES,
    TEXT_FIELD,
    VARIANTS,
    WRENCHES,
    FloatArray,
    UnknownFieldError,
)
from torchid.logs.quaternion import quaternion_of_rpy
from torchid.logs.units import IN_DEGREES, unit_factor

Take = Callable[[str], NDArray[Any]]
"""The values (N, ...) of a column or an array."""

_PD = "joint_torque.pd"
_CURRENT = "joint_torque.current"
_UNIT = re.compile(r"\[.*\]$|\(.*\)$")


# ------------------------------------------------------------------------------------------------ columns of an entry


@dataclass(frozen=True)
class Matched:
    """The columns of one entry of a map.

    Attributes:
        part: the entry.
        labels: names of joints (contacts, sensors) in the order of the columns, or of an array's columns; None for an
            unused column. Empty without names.
        columns: in the order of names, then of components; a single array if these are not split.
        by_name: whether every name has its own column.
        by_component: whether every component has its own column.
    """

    part: EntryPart
    labels: tuple[str | None, ...]
    columns: tuple[str, ...]
    by_name: bool
    by_component: bool

    @property
    def names(self) -> tuple[str, ...]:
        """The labels that are names."""
        return tuple(label for label in self.labels if label is not None)


class _Search:
    """The columns of a file, and the entries of a map that they fit.

    Attributes:
        left_out: numbered columns without a joint of the robot.
        finds_any: whether the file has any column of the entries.
    """

    def __init__(
        self,
        columns: Columns,
        parts: Mapping[str, EntryPart],
        given: Sequence[str],
        named: Mapping[str, tuple[str, ...]],
    ) -> None:
        self._columns = columns
        self._given = given
        self._named = named
        self._known = set(given)
        self.left_out = set[str]()
        stated = {key: self._by_stated_names(part) for key, part in parts.items()}
        self._stated = {key: matched for key, matched in stated.items() if matched is not None}
        self._free = {key: part for key, part in parts.items() if key not in self._stated}
        self._found = self._assign()
        listed = (column for matched in self._stated.values() for column in matched.columns)
        self.finds_any = any(self._found.values()) or not set(given).isdisjoint(listed)

    def match(self, part: EntryPart) -> Matched:
        """The columns of an entry; LogError if some are missing."""
        matched = self._stated.get(part.key) or self._by_names_in_columns(part)
        missing = [column for column in matched.columns if column not in self._known]
        if missing:
            more = f" ({len(missing) - 1} more are missing)" if len(missing) > 1 else ""
            raise UnknownFieldError.at_field(part.where, missing[0], self._unused(), f"no such column{more}")
        return matched

    def _unused(self) -> list[str]:
        taken = {column for matched in self._stated.values() for column in matched.columns}
        return [text for text in self._given if text not in taken] or list(self._given)

    def _by_stated_names(self, part: EntryPart) -> Matched | None:
        """The columns of an entry with names stated by the map or the file; None if only its columns state names."""
        entry = part.entry
        text = entry.column or ""
        holders = {name for name, _ in PLACEHOLDER.findall(text)}
        if entry.columns:
            return self._by_listed_columns(part)
        if not part.kind and "index" in holders:
            numbers = range(entry.first_index, entry.first_index + max(len(part.components), 1))
            return Matched(part, (), tuple(_fill(text, {}, k) for k in numbers), False, bool(part.components))
        if not part.kind:
            return Matched(part, (), _spell(part, text, 0, ""), False, _splits(part, text))
        order = None if part.is_native else entry.order or getattr(self._columns, f"{part.kind}_order")
        if order is None and part.kind in holders:
            return None
        if order is None:
            order = list(self._named.get(part.names_field, ()))
        if not order:
            accepted = f"names of the {part.kind}s in the order of '{text}', or {KEY}.{part.kind}_order"
            raise ConfigError.at_field(f"{part.where}.order", "missing", accepted)
        if not holders & {part.kind, "index"}:
            return Matched(part, tuple(order), _spell(part, text, 0, ""), False, _splits(part, text))
        return self._by_order(part, order, part.kind in holders)

    def _by_order(self, part: EntryPart, order: Sequence[str | None], has_names: bool) -> Matched:
        """The columns of a pattern for each name of an order, by the name or its number."""
        text = part.entry.column or ""
        columns: list[str] = []
        for number, name in enumerate(order, part.entry.first_index):
            if name is not None:
                columns += _spell(part, text, number, self._stem(part, name) if has_names else "")
            elif not has_names:
                self.left_out.update(_spell(part, text, number, ""))
        return Matched(part, tuple(x for x in order if x), tuple(columns), True, _splits(part, text))

    def _by_listed_columns(self, part: EntryPart) -> Matched:
        """The columns of an entry that names each."""
        entry = part.entry
        if not part.kind:
            return Matched(part, (), tuple(entry.columns[x] for x in part.components), False, True)
        splits = {_splits(part, text) for text in entry.columns.values()}
        if len(splits) > 1:
            reason = "only some columns have {axis}"
            raise ConfigError.at_field(f"{part.where}.columns", reason, "{axis} in all or in none")
        listed = enumerate(entry.columns.items(), entry.first_index)
        columns = tuple(column for k, (name, text) in listed for column in _spell(part, text, k, name))
        return Matched(part, tuple(entry.columns), columns, True, splits.pop())

    def _around_name(self, part: EntryPart) -> tuple[str, str]:
        """The parts of the URDF's names before and after the file's names."""
        pattern = "" if part.is_native else self._columns.name_of(part.kind)
        before, _, after = pattern.partition(f"{{{part.kind}}}")
        return before, after

    def _stem(self, part: EntryPart, name: str) -> str:
        """The file's name of a joint or contact."""
        before, after = self._around_name(part)
        if not name.startswith(before) or not name.endswith(after) or len(name) <= len(before) + len(after):
            reason = f"'{excerpt(name)}' does not fit the pattern '{self._columns.name_of(part.kind)}'"
            raise ConfigError.at_field(f"{KEY}.{part.kind}_name", reason, f"a pattern that fits all {part.kind} names")
        return name[len(before) : len(name) - len(after)]

    def _assign(self) -> dict[str, list[str]]:
        """The names in columns, by entry without stated names; the pattern with the most letters gets a column."""
        stated = {column for matched in self._stated.values() for column in matched.columns} | self.left_out
        regexes = {key: column_pattern(part, part.entry.column or "") for key, part in self._free.items()}
        out = defaultdict[str, list[str]](list)
        for text in self._given:
            names = {key: match["name"] for key, regex in regexes.items() if (match := regex.fullmatch(text))}
            if text in stated or not names:
                continue
            letters = {key: letters_of(self._free[key].entry.column or "") for key in names}
            most = max(letters.values())
            is_ignored = any(letters_of(pattern) > most and fits(text, pattern) for pattern in self._columns.ignore)
            if is_ignored or (text == "time" and not most):  # stamps of the file, beside {joint}
                continue
            best = [key for key in names if letters[key] == most]
            if len(best) > 1:
                both = f"the patterns of {KEY}.{best[0]} and {KEY}.{best[1]}"
                raise LogError.at_field(f"column '{text}'", f"fits {both}", "patterns of which only one fits")
            out[best[0]].append(names[best[0]])
        return out

    def _by_names_in_columns(self, part: EntryPart) -> Matched:
        """An entry with the names in its columns, in the order of these."""
        text = part.entry.column or ""
        stems = dict.fromkeys(self._found[part.key])
        if not stems:
            reason = f"no column fits '{excerpt(text)}'"
            raise LogError.at_field(part.where, reason, join_names(self._unused(), MOST_LISTED))
        columns = tuple(column for stem in stems for column in _spell(part, text, 0, stem))
        before, after = self._around_name(part)
        labels = tuple(f"{before}{stem}{after}" for stem in stems)
        return Matched(part, labels, columns, True, _splits(part, text))


def _splits(part: EntryPart, text: str) -> bool:
    """Whether a pattern has a column for each component."""
    return bool(part.components) and any(name in AXES for name, _ in PLACEHOLDER.findall(text))


def _spell(part: EntryPart, text: str, number: int, stem: str) -> tuple[str, ...]:
    """The columns of a pattern for one name."""
    axes = part.components if _splits(part, text) else ("",)
    values = [{part.kind: stem, "axis": axis, "AXIS": axis.upper(), "component": str(k)} for k, axis in enumerate(axes)]
    return tuple(_fill(text, of_axis, number) for of_axis in values)


def _fill(text: str, values: Mapping[str, str], number: int) -> str:
    return PLACEHOLDER.sub(lambda x: f"{number:{x[2] or ''}d}" if x[1] == "index" else values[x[1]], text)


def column_pattern(part: EntryPart, text: str) -> re.Pattern[str]:
    """Columns that fit a pattern of an entry; the group `name` has the name."""
    axes = "|".join(part.components)
    groups = {part.kind: "(?P<name>.+)", "index": r"\d+", "component": r"\d"}
    groups |= {"axis": f"(?:{axes})", "AXIS": f"(?:{axes.upper()})"}
    literals = map(re.escape, PLACEHOLDER.sub("\0", text).split("\0"))
    holders = (groups[name] for name, _ in PLACEHOLDER.findall(text))
    return re.compile("".join(x for pair in zip(literals, [*holders, ""], strict=True) for x in pair))


_NATIVE = {field: column_pattern(native_part(field), native_part(field).entry.column or "") for field in COLUMN_FIELDS}


def native_field(column: str) -> str:
    """The field of a column with a name of the log format; "" for other names, and for a name with a unit."""
    field = column.partition(".")[0]
    is_native = field in _NATIVE and _NATIVE[field].fullmatch(column) and not _UNIT.search(column)
    return field if is_native else ""


# ------------------------------------------------------------------------------------------------ numbers of an entry


class EntryReader:
    """Reads the numbers of an entry from its columns: order, units, signs and turns."""

    def __init__(self, matched: Matched, names: Sequence[str]) -> None:
        """Take the names in the order of the log; ConfigError for a unit of another quantity."""
        self.matched = matched
        part = matched.part
        places = {label: place for place, label in enumerate(matched.labels)}
        order = [places.get(name, -1) for name in names]
        self._order = None if order == list(range(len(matched.labels))) else order
        self._factors = _element_factors(part, names)
        self._turns = _joint_turns(part, names) if isinstance(part.entry, AngleEntry) else None

    def read(self, take: Take) -> FloatArray:
        """The numbers (N, ...), or (1, ...) for constant gains; a joint without a column is NaN.

        Raises:
            LogError: a column has another shape, or no numbers.
        """
        matched = self.matched
        part = self.matched.part
        arrays = [self._numbers(column, take(column)) for column in matched.columns]
        for column, array in zip(matched.columns, arrays, strict=True):
            if len(array) != len(arrays[0]):
                accepted = f"{len(arrays[0])}, as in '{matched.columns[0]}'"
                raise LogError.at_field(f"'{column}'", f"{len(array)} samples", accepted)
        if not matched.by_name and not matched.by_component:
            out = arrays[0]
        else:
            out = np.stack(arrays, axis=1 if part.components and not matched.by_component else -1)
            if matched.by_name and matched.by_component:
                out = out.reshape(len(out), len(matched.labels), len(part.components))
        if self._order is not None:
            out = out[:, self._order]
            out[:, np.less(self._order, 0)] = np.nan
        if self._turns is not None:
            start, turn = self._turns
            out = np.where(np.isfinite(start), start + np.mod(out - np.nan_to_num(start), turn), out)
        out = out if self._factors is None else np.asarray(out * self._factors)
        axes = getattr(part.entry, "axes", None)
        if axes is None:
            return out
        whole = np.zeros((*out.shape[:-1], 3))
        whole[..., ["xyz".index(axis) for axis in axes]] = out
        return whole

    def _numbers(self, column: str, array: NDArray[Any]) -> FloatArray:
        matched = self.matched
        part = self.matched.part
        if array.dtype.kind == "U" and part.key == "contact_active":
            array = _flags_of_words(column, array)
        if array.dtype.kind not in "fiub":
            reason = f"values of type {array.dtype}"
            if array.dtype.kind == "U" and array.ndim == 1 and len(array):
                reason = f"'{excerpt(str(array[0]))}'"
            raise LogError.at_field(f"'{column}'", reason, "real numbers")
        names = (len(matched.labels),) if part.kind and not matched.by_name else ()
        shape = (*names, *([len(part.components)] if part.components and not matched.by_component else []))
        if isinstance(part.entry, Gains) and array.shape == shape:
            array = array[None]  # the same at all samples
        if shape[:1] == (1,) and array.ndim == len(shape) and array.shape[1:] == shape[1:]:
            array = array[:, None]  # of one name, without an axis for it
        if array.ndim == len(shape) + 2 and array.shape[1] == 1:  # one row of each sample, as of Matlab's tables
            array = array[:, 0]
        if array.ndim == 0:
            raise LogError.at_field(f"'{column}'", "a single value", "a row for each sample")
        width = array.shape[1] if names and array.ndim > 1 else 0
        unnamed = 0 < width < len(matched.labels) and not any(matched.labels[width:])  # null at the end of an order
        if array.shape[1:] != shape and not (unnamed and array.shape[2:] == shape[1:]):
            of_names = f", one per name of its order ({matched.labels[0]}, ...)" if matched.labels and shape else ""
            turned = f"; '{column}.T' if its columns are the samples" if array.shape[:1] == shape else ""
            accepted = f"{_n_by(shape)}{of_names}{turned}"
            raise LogError.at_field(f"'{column}'", f"shape {_n_by(array.shape[1:])}", accepted)
        return np.asarray(array, dtype=np.float64)


def _n_by(shape: tuple[int, ...]) -> str:
    return f"({', '.join(map(str, ('N', *shape)))})"


def _flags_of_words(column: str, array: NDArray[Any]) -> FloatArray:
    """Contact flags from words: 1, 0, or NaN for empty cells; LogError for unknown words."""
    words, codes = np.unique(array, return_inverse=True)
    numbers = []
    for word in words.tolist():
        text = word.strip().lower()
        try:
            numbers.append(float(FLAG_WORDS.get(text, text or "nan")))
        except ValueError as error:
            raise LogError.at_field(f"column '{column}'", f"'{excerpt(word)}'", FLAG_ACCEPTED) from error
    return np.asarray(np.array(numbers)[codes])


def _element_labels(part: EntryPart, names: Sequence[str]) -> list[tuple[str, str]]:
    """Labels of the elements of a sample for patterns of units (`l_foot.fx`), and their components."""
    of_names = names if part.kind else ("",)
    return [(".".join(filter(None, (name, axis))), axis) for name in of_names for axis in part.components or ("",)]


def _element_factors(part: EntryPart, names: Sequence[str]) -> FloatArray | None:
    """Factors of the elements of a sample, (n,), (k,) or (n, k); None if all are 1."""
    entry = part.entry
    if not entry.unit and not entry.scale:
        return None
    elements = _element_labels(part, names)
    labels = [label for label, _ in elements]
    units = values_by_name(f"{part.where}.unit", entry.unit, labels)
    scales = values_by_name(f"{part.where}.scale", entry.scale, labels)
    out = np.array([scales.get(label, 1.0) for label in labels])
    for index, (label, axis) in enumerate(elements):
        if label in units:
            out[index] *= unit_factor(f"{part.where}.unit", units[label], part.quantities[axis])
    shape = ([len(names)] if part.kind else []) + ([len(part.components)] if part.components else [])
    return None if (out == 1.0).all() else out.reshape(shape)


def _joint_turns(part: EntryPart, names: Sequence[str]) -> tuple[FloatArray, FloatArray] | None:
    """Start of each joint's turn, NaN for joints without one, and the size of a turn, each (n,)."""
    given = getattr(part.entry, "turn_from", {})
    if not given:
        return None
    key = f"{part.where}.turn_from"
    starts = values_by_name(key, given, names)
    units = values_by_name(f"{part.where}.unit", part.entry.unit, names)
    radians = [unit_factor(key, units.get(x, "rad"), ("angle",)) if x in starts else 1.0 for x in names]
    return np.array([starts.get(name, np.nan) for name in names]), 2.0 * np.pi / np.array(radians)


# --------------------------------------------------------------------------------------------------- fields of a file


@dataclass(frozen=True)
class FileFields:
    """The fields of a file, by a map of its columns or arrays.

    Attributes:
        names: of joints, contacts and sensors, by field.
        columns: the map.
        readers: readers of the entries, by key.
        native: arrays with names of the log format.
        frame_column: the column or array with the name of the IMU's frame, "" for none.
    """

    names: Mapping[str, tuple[str, ...]]
    columns: Columns
    readers: Mapping[str, EntryReader]
    native: tuple[str, ...]
    frame_column: str

    @property
    def fields(self) -> tuple[str, ...]:
        """Fields with samples."""
        tabular = (key for key, reader in self.readers.items() if reader.matched.part.is_native)
        of_plates = (POINTS,) if self.columns.plates else ()
        return tuple(dict.fromkeys((*self.columns.fields, *tabular, *self.native, *of_plates)))

    @property
    def given(self) -> tuple[str, ...]:
        """All fields, including text."""
        frame = (TEXT_FIELD,) if self.columns.imu_frame is not None or self.frame_column else ()
        return (*self.fields, *self.names, *frame)

    @property
    def sources(self) -> tuple[str, ...]:
        """All columns that are read, each once."""
        every = [source for name in self.fields for source in self.sources_of(name)]
        return tuple(dict.fromkeys([*every, *([self.frame_column] if self.frame_column else [])]))

    @property
    def step(self) -> float | None:
        """Constant step between samples [s]; None if a column has the stamps."""
        entry = self.columns.time
        if entry is None or entry.step is None:
            return None
        units = values_by_name(f"{KEY}.time.unit", entry.unit, [""])
        return float(entry.step) * unit_factor(f"{KEY}.time.unit", units.get("", "s"), ("time",))

    def stamps(self, start: int, count: int) -> FloatArray:
        """Stamps [s] of `count` samples from number `start` on, by the constant step."""
        return np.asarray(np.arange(start, start + count) * (self.step or 1.0))

    def sources_of(self, name: str) -> tuple[str, ...]:
        """The columns of a field and of the fields that it is computed from."""
        return (*self._own(name), *(source for other in self._needed(name) for source in self.sources_of(other)))

    def constant_sources(self, name: str) -> tuple[str, ...]:
        """The columns of a field with possibly one number per joint instead of samples: arrays of gains."""
        matched = (reader.matched for key, reader in self.readers.items() if name in key)
        gains = (x for x in matched if isinstance(x.part.entry, Gains) and not x.by_name)
        return tuple(column for of_gain in gains for column in of_gain.columns)

    def _own(self, name: str) -> tuple[str, ...]:
        if name in self.native:
            return (name,)
        readers = (reader for key, reader in self.readers.items() if key == name or key.startswith(f"{name}."))
        return tuple(column for reader in readers for column in reader.matched.columns)

    def _needed(self, name: str) -> tuple[str, ...]:
        """Other fields that a field is computed from."""
        law = getattr(self.columns.joint_torque, "pd", None)
        if name == "time" and self.step is not None:
            sampled = [x for x in self.fields if x != "time" and self._own(x) and not self.constant_sources(x)]
            return ("joint_position",) if "joint_position" in sampled or not sampled else (sampled[0],)
        if name == "joint_torque" and law is not None:
            return ("joint_position",) * (law.kp is not None) + ("joint_velocity",) * (law.kd is not None)
        if name == "contact_active" and not self._own(name):
            return ("time",) if self._threshold is None else self._forces
        return ("time",) if name == POINTS and not self._own(name) else ()

    @property
    def _forces(self) -> tuple[str, ...]:
        """The field of contact forces, if there is one."""
        return tuple(name for name in (FORCE_NORMAL, *WRENCHES) if name in self.fields)[:1]

    @property
    def _threshold(self) -> float | None:
        """The number above which a contact is active."""
        return None if self.columns.contact_active is None else self.columns.contact_active.above

    def other_times(self, given: Collection[str]) -> dict[str, ColumnEntry]:
        """Entries of other stamps than `time` that a file has, by their array."""
        if "time" not in self.fields or self.step is not None:
            return {}
        others = {entry.column: entry for entry in self.columns.other_times if entry.column}
        return {name: entry for name, entry in others.items() if name in given and name not in self._own("time")}

    def text(self, take: Take) -> dict[str, NDArray[Any]]:
        """Names, and the IMU's frame."""
        out: dict[str, NDArray[Any]] = {name: np.array(names, dtype=np.str_) for name, names in self.names.items()}
        if self.columns.imu_frame is not None:
            out[TEXT_FIELD] = np.array(self.columns.imu_frame)
        elif self.frame_column:
            out[TEXT_FIELD] = take(self.frame_column)
        return out

    def read(self, take: Take) -> dict[str, NDArray[Any]]:
        """All fields; `take` is called once for each column."""
        uses = Counter(source for name in self.fields for source in self.sources_of(name))
        held: dict[str, NDArray[Any]] = {}

        def once(column: str) -> NDArray[Any]:
            if column not in held:
                held[column] = take(column)
            uses[column] -= 1
            return held[column] if uses[column] else held.pop(column)

        return self.text(take) | {name: self.value(name, once) for name in self.fields}

    def value(self, name: str, take: Take) -> NDArray[Any]:
        """A field (N, ...). Raises LogError: its columns do not fit the field."""
        if name in self.native:
            return take(name)
        if self.columns.plates and name in (POINTS, WRENCHES[1]):
            return self._of_plates(name, take)
        return self._computed(name, take)

    def _computed(self, name: str, take: Take) -> NDArray[Any]:
        if name in self.readers:
            out = self.readers[name].read(take)
            for fraction in FRACTIONS:
                if f"{name}.{fraction}" in self.readers:
                    out = out + self.readers[f"{name}.{fraction}"].read(take)
            return _above(out, self._threshold) if name == "contact_active" else out
        if name == "joint_torque":
            return self._torque(take)
        if name == "time":
            return self.stamps(0, len(take(self.sources_of(name)[0])))
        if name == "contact_active":
            return self._active(take)
        if f"{name}.rpy" in self.readers:
            return quaternion_of_rpy(self.readers[f"{name}.rpy"].read(take), name.removeprefix("base_quat_"))
        force = self.readers[f"{name}.force"].read(take)
        moment = self.readers[f"{name}.moment"].read(take) if f"{name}.moment" in self.readers else force * np.nan
        return np.concatenate([force, moment], axis=2)

    def _torque(self, take: Take) -> FloatArray:
        """Torques (N, n) [N m or N] from motor currents or a PD law."""
        if _CURRENT in self.readers:
            return self.readers[_CURRENT].read(take) * self._torque_per_current()
        terms: list[FloatArray] = []
        for gain, desired, measured in (("kp", "position", "joint_position"), ("kd", "velocity", "joint_velocity")):
            gains = self._gains(gain, take)
            if gains is not None:
                actual = self.value(measured, take)
                key = f"{_PD}.{desired}"
                terms.append(gains * (self.readers[key].read(take) - actual if key in self.readers else -actual))
        if f"{_PD}.feed_forward" in self.readers:
            terms.append(self.readers[f"{_PD}.feed_forward"].read(take))
        return np.asarray(sum(terms[1:], terms[0]))

    def _torque_per_current(self) -> FloatArray:
        """Torques or forces of joints for the currents of their motors, (n,) [N m/A or N/A]."""
        entry = getattr(self.columns.joint_torque, "current", None)
        joints = self.names["joint_names"]
        factors = np.ones(len(joints))
        for name, what in (("torque_constant", "torque constant"), ("gear_ratio", "gear ratio")):
            factors *= values_of_all(f"{KEY}.{_CURRENT}.{name}", what, getattr(entry, name), "joint", joints)
        return factors

    def _gains(self, name: str, take: Take | None) -> FloatArray | None:
        """Stated gains (1, n), or gains from the file (N, n); None without gains, or if `take` is None."""
        gains: Gains | None = getattr(getattr(self.columns.joint_torque, "pd", None), name, None)
        if gains is not None and gains.value:
            key = f"{KEY}.{_PD}.{name}"
            joints = self.names["joint_names"]
            return np.array([values_of_all(key, "gain", gains.value, "joint", joints)])
        return None if gains is None or take is None else self.readers[f"{_PD}.{name}"].read(take)

    def _active(self, take: Take) -> NDArray[Any]:
        """Flags (N, C) of contacts that are always active, or from their forces."""
        if self._threshold is None:
            return np.ones((self._length(take), len(self.names["contact_names"])), dtype=np.bool_)
        force = self.value(self._forces[0], take)
        with np.errstate(over="ignore"):  # infinite is above any threshold
            return _above(force if force.ndim == 2 else np.linalg.norm(force[..., :3], axis=2), self._threshold)

    def _length(self, take: Take) -> int:
        return len(take(self.sources_of("time")[0]))

    def _plate_poses(self) -> tuple[NDArray[Any], FloatArray]:
        """Rotation to the world (C, 3, 3) and origin (C, 3) [m] of each contact's force plate."""
        from scipy.spatial.transform import Rotation

        contacts = self.names["contact_names"]
        plates = values_of_all(f"{KEY}.plates", "plate", self.columns.plates, "contact", contacts)
        rpy = np.array([plate.rpy_deg for plate in plates]).reshape(-1, 3)
        origin = np.array([plate.position for plate in plates]).reshape(-1, 3)
        return Rotation.from_euler("xyz", rpy, degrees=True).as_matrix(), origin

    def _of_plates(self, name: str, take: Take) -> FloatArray:
        """Wrenches of force plates, or the reference points of their moments, in the world."""
        rotation, origin = self._plate_poses()
        if name == POINTS:
            is_read = bool(self._own(name))
            points = self._computed(name, take) if is_read else np.zeros((self._length(take), len(origin), 3))
            return np.asarray(np.einsum("cij,ncj->nci", rotation, points) + origin)
        wrench = self._computed(name, take)
        vectors = wrench.reshape(*wrench.shape[:2], 2, 3)
        return np.asarray(np.einsum("cij,nckj->ncki", rotation, vectors).reshape(wrench.shape))

    def check(self) -> FileFields:
        """The fields themselves; InputError if a field needs another that is missing, or a value that is not given."""
        for name in self.columns.fields:
            for other in self._needed(name):
                if other not in self.fields:
                    gain = {"joint_position": ".pd.kp", "joint_velocity": ".pd.kd"}.get(other, "")
                    gain = gain if name == "joint_torque" else ""
                    raise LogError.at_field(f"{KEY}.{name}{gain}", f"given without {other}", f"a log with {other}")
        if self._threshold is not None and not self._own("contact_active") and not self._forces:
            accepted = "a column for contact_active, or contact forces in the log"
            raise LogError.at_field(f"{KEY}.contact_active.above", "nothing to compare with it", accepted)
        for gain in ("kp", "kd"):
            self._gains(gain, None)
        if _CURRENT in self.readers:
            self._torque_per_current()
        if self.columns.plates:
            self._plate_poses()
        return self


def _above(values: FloatArray, threshold: float | None) -> FloatArray:
    """1 where a number is above a threshold, else 0; NaN stays NaN for the check of flags."""
    return values if threshold is None else np.where(np.isnan(values), np.nan, values > threshold)


def match_table(columns: Columns | None, header: Sequence[str], in_degrees: bool = False) -> FileFields:
    """The fields of a table by a map of its columns; `in_degrees`: its header says that all angles are in degrees.

    Raises:
        InputError: the map does not fit the columns, or is inconsistent.
    """
    if columns is not None and columns.episodes is not None:
        accepted = "no such key: in a table each episode starts where stamps begin again"
        raise LogError.at_field(f"{KEY}.episodes", "given for a table", accepted)
    fields = _match(columns, header, {"joint_names": ()}, True)
    for reader in fields.readers.values() if in_degrees else ():
        part = reader.matched.part
        names = fields.names.get(reader.matched.part.names_field, ())
        turning = [
            label for label, axis in _element_labels(part, names) if IN_DEGREES.keys() & set(part.quantities[axis])
        ]
        units = values_by_name(f"{part.where}.unit", part.entry.unit, turning)
        if without := [label for label in turning if label not in units]:
            reason = f"missing for {without[0] or part.key}, in a file with inDegrees=yes"
            raise LogError.at_field(f"{part.where}.unit", reason, "deg, deg/s or rad; m for slides")
    return fields


def match_arrays(columns: Columns | None, given: Sequence[str], load: Take) -> FileFields:
    """The fields of a file of arrays.

    Args:
        columns: the map; None without one.
        given: names of the arrays.
        load: reads an array; called for arrays of names or records.

    Raises:
        InputError: the map does not fit the arrays, or is inconsistent.
    """
    if columns is not None and columns.rows_of is not None:
        raise LogError.at_field(f"{KEY}.rows_of", "given for arrays", "a table (CSV, Parquet, JSON lines)")
    if columns is not None:
        patterns = [text for part in list_parts(columns).values() for text in part.patterns]
        given = with_parts(given, [name for text in patterns for name in _named_fields(text, given, load)])
        times = {entry.column for entry in columns.other_times} - {columns.time.column if columns.time else None}
        own_time = columns_of_file(columns, given).time
        given = [name for name in given if name not in times or (own_time is not None and name == own_time.column)]
    named = {name: parse_names(name, load(name)) for name in NAME_FIELDS if name in given}
    return _match(columns, given, named, False)


def _match(
    columns: Columns | None, given: Sequence[str], named: Mapping[str, tuple[str, ...]], is_table: bool
) -> FileFields:
    """The fields of a file with the columns or arrays `given`; `named`: names that the file states."""
    has_map = columns is not None
    columns = Columns() if columns is None else columns
    check_columns(columns)
    columns = columns_of_file(columns, given)
    parts = list_parts(columns)
    native = {text: native_field(text) if is_table else text for text in given}
    native = {text: field for text, field in native.items() if field in (*SHAPES, *VARIANTS)}
    search = _Search(columns, parts, given, named if not is_table else {})
    if parts and not search.finds_any and len(native) == len(given):  # a map of other files
        parts = {}
        columns = Columns()
    matched = {key: search.match(part) for key, part in parts.items()}
    taken = search.left_out if parts else set()
    taken = taken | {column for match in matched.values() for column in match.columns}
    others = [text for text in given if text not in taken]
    if unknown := [x for x in others if x not in native and not any(fits(x, pattern) for pattern in columns.ignore)]:
        raise unknown_columns(unknown, has_map)
    native_columns = {x: native[x] for x in others if x in native and not _is_ignored(columns, x)}
    for text, field in native_columns.items():
        if field in columns.fields or (field == TEXT_FIELD and columns.imu_frame is not None):
            raise LogError.at_field(
                f"{KEY}.{field}", f"given twice, also as '{text}'", f"one of them, the other in {KEY}.ignore"
            )
    if is_table:
        of_format = {field: native_part(field) for field in COLUMN_FIELDS if field in native_columns.values()}
        of_format.pop(TEXT_FIELD, None)
        search = _Search(Columns(), of_format, list(native_columns), {})
        matched |= {key: search.match(part) for key, part in of_format.items()}
    _require_once(matched)
    names = _common_names(columns, matched, named)
    names = names if parts or not is_table else {"joint_names": (), **names}
    readers = {key: EntryReader(match, names.get(match.part.names_field, ())) for key, match in matched.items()}
    arrays = () if is_table else tuple(x for x in native_columns if x not in (*NAME_FIELDS, TEXT_FIELD))
    if has_map and parts:
        names = {"joint_names": (), **names}
    return FileFields(names, columns, readers, arrays, TEXT_FIELD if TEXT_FIELD in native_columns else "").check()


def _is_ignored(columns: Columns, text: str) -> bool:
    """Whether a pattern other than `*` ignores a column with a name of the log format."""
    return any(letters_of(pattern) and fits(text, pattern) for pattern in columns.ignore)


def read_stamps(entry: ColumnEntry, load: Take) -> FloatArray:
    """Stamps (N,) [s] of an entry of `other_times`; LogError for an array without stamps."""
    (part,) = list_parts(Columns(time=TimeEntry(**vars(entry)))).values()
    return EntryReader(Matched(part, (), (entry.column or "",), False, False), ()).read(load)


def _named_fields(text: str, given: Collection[str], load: Take) -> list[str]:
    """The fields of records that fit a pattern; the text itself if it is no such pattern."""
    root = text.partition("['")[0]
    if root == text or root not in given or not PLACEHOLDER.search(text):
        return [text]
    regex = re.compile(".+".join(map(re.escape, PLACEHOLDER.sub("\0", text).split("\0"))))
    return [name for name, _ in fields_of_records(root, load(root)) if regex.fullmatch(name)]


def _require_once(matched: Mapping[str, Matched]) -> None:
    """Refuse a column with two entries."""
    owners: dict[str, str] = {}
    for key, match in matched.items():
        for column in match.columns:
            if column in owners:
                reason = f"column '{excerpt(column)}' is already in {KEY}.{owners[column]}"
                raise LogError.at_field(match.part.where, reason, "every column once")
            owners[column] = key


def _common_names(
    columns: Columns, matched: Mapping[str, Matched], named: Mapping[str, tuple[str, ...]]
) -> dict[str, tuple[str, ...]]:
    """Names of joints, contacts and sensors: stated by the file, else those of the first entry; torques come last."""
    listed = [(match.part.where, match.part.names_field, match.names) for match in matched.values() if match.part.kind]
    if columns.contact_active is not None and columns.contact_active.always:
        listed.append((f"{KEY}.contact_active.always", "contact_names", tuple(columns.contact_active.always)))
    names = {field: of_file for field, of_file in named.items() if of_file}
    for key, field, of_part in sorted(listed, key=lambda item: "joint_torque" in item[0]):
        common = names.setdefault(field, of_part)
        is_set = len(set(of_part)) == len(of_part)
        again = [] if is_set else [name for name in of_part if of_part.count(name) > 1]
        lacking = set() if "joint_torque" in key else set(common) - set(of_part)  # a torque may be unmeasured
        differing = again or sorted(lacking | set(of_part) - set(common))
        if differing:
            where = "twice" if again else "missing here" if differing[0] in common else "missing in other fields"
            reason = f"{KINDS[field]} '{excerpt(differing[0])}' {where}"
            raise LogError.at_field(key, reason, f"the same {KINDS[field]}s in all fields, each once")
    return {**{field: of_file for field, of_file in named.items()}, **names}


def columns_of_file(columns: Columns, given: Sequence[str]) -> Columns:
    """The map for a file: if the column of `time` is missing, an entry of `other_times` replaces it."""
    others = [entry for entry in columns.other_times if entry.column in given]
    if not others or (columns.time is not None and columns.time.column in given):
        return columns
    return replace(columns, time=TimeEntry(**vars(others[0])))
