"""The fields of a log from foreign columns or arrays: units, signs, orders, and what is computed from them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError
from torchid.logs.arrays import fields_of_records, parse_names, with_parts
from torchid.logs.column_entries import FRACTIONS, KEY, ColumnEntry, Gains, PdLaw, TimeEntry
from torchid.logs.column_map import PLACEHOLDER, Columns, check_columns, list_parts, values_by_name, values_of_all
from torchid.logs.column_matching import Matched, columns_of_file, match_columns
from torchid.logs.columns import TEXT_COLUMN, TableLayout, is_column, parse_header
from torchid.logs.entry_values import EntryValues, Take, entry_values
from torchid.logs.force_plates import PlatePoses
from torchid.logs.log import FORCE_NORMAL, NAME_FIELDS, POINTS, SHAPES, VARIANTS, WRENCHES, FloatArray
from torchid.logs.quaternion import quaternion_of_rpy
from torchid.logs.units import unit_factor

_PD, _CURRENT = "joint_torque.pd", "joint_torque.current"


@dataclass(frozen=True)
class MappedFields:
    """The fields of a file whose columns or arrays a map describes.

    Attributes:
        names: of joints, contacts and sensors, by field.
        columns: the map.
        native: columns of each field that has its name in the log format; arrays have one.
    """

    names: Mapping[str, tuple[str, ...]]
    columns: Columns
    native: Mapping[str, tuple[str, ...]]
    _values: Mapping[str, EntryValues]
    _layout: TableLayout | None = field(default=None)

    @property
    def fields(self) -> tuple[str, ...]:
        """Fields with samples."""
        own = (name for name in self.native if name not in (*NAME_FIELDS, TEXT_COLUMN))
        of_plates = (POINTS,) if self.columns.plates else ()
        return tuple(dict.fromkeys((*self.columns.fields, *own, *of_plates)))

    @property
    def given(self) -> tuple[str, ...]:
        """All fields, of text too."""
        text = (TEXT_COLUMN,) if self.columns.imu_frame is not None or TEXT_COLUMN in self.native else ()
        return (*self.fields, *dict.fromkeys(("joint_names", *self.names)), *text)

    @property
    def sources(self) -> tuple[str, ...]:
        """All columns that are read, each once."""
        every = [x for name in self.fields for x in self.sources_of(name)]
        return tuple(dict.fromkeys((*every, *self.native.get(TEXT_COLUMN, ()))))

    @property
    def flags(self) -> tuple[str, ...]:
        """Columns of a table that may hold true and false."""
        of_numbers = self._threshold is not None or "contact_active" not in self.fields
        return () if of_numbers else self._own("contact_active")

    @property
    def step(self) -> float | None:
        """Between stamps that no column has [s]."""
        entry = self.columns.time
        if entry is None or entry.step is None:
            return None
        units = values_by_name(f"{KEY}.time.unit", entry.unit, [""])
        return float(entry.step) * unit_factor(f"{KEY}.time.unit", units.get("", "s"), ("time",))

    def stamps(self, start: int, count: int) -> FloatArray:
        """Stamps [s] of so many samples, of which some are before, by the step between them."""
        return np.asarray(np.arange(start, start + count) * (self.step or 1.0))

    def sources_of(self, name: str) -> tuple[str, ...]:
        """The columns that a field comes from."""
        return (*self._own(name), *(x for other in self._needed(name) for x in self.sources_of(other)))

    def constant_sources(self, name: str) -> tuple[str, ...]:
        """The columns of a field that may hold one number for each joint instead of samples: arrays of gains."""
        gains = (one.of for key, one in self._values.items() if isinstance(one.of.part.entry, Gains) and name in key)
        return tuple(column for of in gains for column in of.columns if not of.by_name)

    def _own(self, name: str) -> tuple[str, ...]:
        if name in self.native:
            return self.native[name]
        of_field = (one for key, one in self._values.items() if key == name or key.startswith(f"{name}."))
        return tuple(column for one in of_field for column in one.of.columns)

    def _needed(self, name: str) -> tuple[str, ...]:
        """Other fields that a field is computed from."""
        if name == "time" and self.step is not None:
            return self._counted
        if name == "joint_torque" and (law := self._law) is not None:
            return ("joint_position",) * (law.kp is not None) + ("joint_velocity",) * (law.kd is not None)
        if name == "contact_active" and name not in self.native and not self._own(name):
            return ("time",) if self._threshold is None else self._forces
        return ("time",) if name == POINTS and not self._own(name) else ()

    @property
    def _counted(self) -> tuple[str, ...]:
        """The field whose samples have stamps by their step: the joints' positions, or any with columns of samples."""
        sampled = [x for x in self.fields if x != "time" and self._own(x) and not self.constant_sources(x)]
        return tuple(sampled[:1]) if "joint_position" not in sampled and sampled else ("joint_position",)

    @property
    def _forces(self) -> tuple[str, ...]:
        """The field of contact forces, if there is one."""
        return tuple(name for name in (FORCE_NORMAL, *WRENCHES) if name in self.fields)[:1]

    @property
    def _threshold(self) -> float | None:
        """Above which a contact is active."""
        return None if self.columns.contact_active is None else self.columns.contact_active.above

    @property
    def _law(self) -> PdLaw | None:
        torque = self.columns.joint_torque
        return None if torque is None else torque.pd

    def other_times(self, given: Sequence[str]) -> dict[str, ColumnEntry]:
        """Entries of stamps beside those of `time`, of those that a file has, by their array."""
        if "time" not in self.fields or self.step is not None:
            return {}
        others = {entry.column: entry for entry in self.columns.other_times if entry.column}
        return {name: entry for name, entry in others.items() if name in given and name not in self._own("time")}

    def text(self, take: Take) -> dict[str, NDArray[Any]]:
        """Names, and the IMU's frame."""
        out: dict[str, NDArray[Any]] = {name: np.array(of, dtype=np.str_) for name, of in self.names.items()}
        out.setdefault("joint_names", np.array([], dtype=np.str_))
        if self.columns.imu_frame is not None:
            out[TEXT_COLUMN] = np.array(self.columns.imu_frame)
        elif TEXT_COLUMN in self.native:
            out[TEXT_COLUMN] = take(TEXT_COLUMN)
        return out

    def read(self, take: Take) -> dict[str, NDArray[Any]]:
        """All fields; `take` is called once for each column."""
        uses = Counter(x for name in self.fields for x in self.sources_of(name))
        held: dict[str, NDArray[Any]] = {}

        def once(column: str) -> NDArray[Any]:
            if column not in held:
                held[column] = take(column)
            uses[column] -= 1
            return held[column] if uses[column] else held.pop(column)

        return self.text(take) | {name: self.value(name, once) for name in self.fields}

    def value(self, name: str, take: Take) -> NDArray[Any]:
        """A field (N, ...). Raises LogError: columns that do not fit it."""
        if name in self.native:
            if self._layout is None:
                return take(name)
            flat = [take(column) for column in self.native[name]]
            return self._layout.field(name, flat)
        if self.columns.plates and name in (POINTS, WRENCHES[1]):
            return self._of_plates(name, take)
        return self._mapped(name, take)

    def _mapped(self, name: str, take: Take) -> NDArray[Any]:
        if name in self._values:
            out = self._values[name].read(take)
            for more in (x for part in FRACTIONS if (x := self._values.get(f"{name}.{part}")) is not None):
                out = out + more.read(take)
            return _flagged(out, self._threshold) if name == "contact_active" else out
        if name == "joint_torque":
            return self._torque(take)
        if name == "time":
            return self.stamps(0, [len(take(source)) for source in self.sources_of(name)][0])
        if f"{name}.rpy" in self._values:
            return quaternion_of_rpy(self._values[f"{name}.rpy"].read(take), name.removeprefix("base_quat_"))
        return self._active(take) if name == "contact_active" else self._wrench(name, take)

    def _torque(self, take: Take) -> FloatArray:
        """What currents or a PD law give, (N, n) [N m or N]."""
        if _CURRENT in self._values:
            return self._values[_CURRENT].read(take) * self._torque_per_current()
        terms: list[FloatArray] = []
        for gain, desired, measured in (("kp", "position", "joint_position"), ("kd", "velocity", "joint_velocity")):
            gains = self._gains(gain, take)
            if gains is not None:
                own, key = self.value(measured, take), f"{_PD}.{desired}"
                terms.append(gains * (self._values[key].read(take) - own if key in self._values else -own))
        if f"{_PD}.feed_forward" in self._values:
            terms.append(self._values[f"{_PD}.feed_forward"].read(take))
        return np.asarray(sum(terms[1:], terms[0]))

    def check(self) -> MappedFields:
        """The fields themselves; InputError for one that is there twice, or computed from others that are not there."""
        for name in self.columns.fields:
            if name in self.native:
                found, accepted = f"beside '{self.native[name][0]}'", f"one of the two, the other in {KEY}.ignore"
                raise LogError.at_field(f"{KEY}.{name}", found, accepted)
            for other in self._needed(name):
                if other not in self.fields:
                    of_law = {"joint_position": ".pd.kp", "joint_velocity": ".pd.kd"} if name == "joint_torque" else {}
                    gain = of_law.get(other, "")
                    raise LogError.at_field(f"{KEY}.{name}{gain}", f"given without {other}", f"{other} in the log too")
        if self.columns.imu_frame is not None and TEXT_COLUMN in self.native:
            found, accepted = f"beside '{TEXT_COLUMN}' of the file", f"one of the two, the other in {KEY}.ignore"
            raise LogError.at_field(f"{KEY}.imu_frame", found, accepted)
        if self._threshold is not None and not (self._own("contact_active") or self._forces):
            raise LogError.at_field(
                f"{KEY}.contact_active.above", "set, without a force", "a column, or contact forces"
            )
        self._check_stated()
        return self

    def _check_stated(self) -> None:
        """Make sure that numbers by name are there of all joints and contacts."""
        for name in ("kp", "kd"):
            if (gains := getattr(self._law, name, None)) is not None and gains.value:
                self._stated_gains(name, gains)
        if _CURRENT in self._values:
            self._torque_per_current()
        if self.columns.plates:
            self._poses()

    def _torque_per_current(self) -> FloatArray:
        """Torques or forces of joints for the currents of their motors, (n,) [N m/A or N/A]."""
        entry, joints = self.columns.joint_torque, self.names["joint_names"]
        factors = np.ones(len(joints))
        for name, what in (("torque_constant", "torque constant"), ("gear_ratio", "gear ratio")):
            given = getattr(getattr(entry, "current", None), name)
            factors *= values_of_all(f"{KEY}.{_CURRENT}.{name}", what, given, "joint", joints)
        return factors

    def _gains(self, name: str, take: Take) -> FloatArray | None:
        gains: Gains | None = getattr(self._law, name, None)
        if gains is None:
            return None
        return self._stated_gains(name, gains) if gains.value else self._values[f"{_PD}.{name}"].read(take)

    def _stated_gains(self, name: str, gains: Gains) -> FloatArray:
        key, joints = f"{KEY}.{_PD}.{name}", self.names["joint_names"]
        return np.array([values_of_all(key, "gain", gains.value, "joint", joints)])

    def _active(self, take: Take) -> NDArray[Any]:
        """Flags (N, C) of contacts that always touch, or whose force says whether they do."""
        if self._threshold is None:
            return np.ones((self._length(take), len(self.names["contact_names"])), dtype=np.bool_)
        force = self.value(self._forces[0], take)
        with np.errstate(over="ignore"):  # infinite is above any threshold
            return _flagged(force if force.ndim == 2 else np.linalg.norm(force[..., :3], axis=2), self._threshold)

    def _length(self, take: Take) -> int:
        return len(take(self.sources_of("time")[0]))

    def _of_plates(self, name: str, take: Take) -> FloatArray:
        """Wrenches, or points that their moments are about, of plates whose poses the map states, in the world."""
        poses, contacts = self._poses(), len(self.names["contact_names"])
        if name != POINTS:
            return poses.wrenches(self._mapped(name, take))
        known = any(self._own(name))
        return poses.points(self._mapped(name, take) if known else np.zeros((self._length(take), contacts, 3)))

    def _poses(self) -> PlatePoses:
        contacts = self.names["contact_names"]
        return PlatePoses.of(values_of_all(f"{KEY}.plates", "plate", self.columns.plates, "contact", contacts))

    def _wrench(self, name: str, take: Take) -> FloatArray:
        """Forces with moments, or with NaN for these, (N, C, 6)."""
        force = self._values[f"{name}.force"].read(take)
        moment = self._values.get(f"{name}.moment")
        return np.concatenate([force, np.full_like(force, np.nan) if moment is None else moment.read(take)], axis=2)


def _flagged(values: FloatArray, above: float | None) -> FloatArray:
    """1 where a number is above a threshold, 0 where it is not; NaN stays, for whoever checks flags."""
    return values if above is None else np.where(np.isnan(values), np.nan, values > above)


def map_table(columns: Columns, header: Sequence[str], in_degrees: bool = False) -> MappedFields | None:
    """The fields of a table, in which what turns may be in degrees unless it has a unit; None where no map is needed.

    Raises:
        InputError: a map that does not fit the columns, or itself.
    """
    check_columns(columns)
    if columns.episodes is not None:
        raise LogError.at_field(f"{KEY}.episodes", "given for a table", "arrays: stamps of a table begin anew")
    columns = columns_of_file(columns, header)
    matching = match_columns(columns, header, is_column)
    if matching is None:
        return None
    layout = parse_header(matching.others, matching.names)
    values = entry_values(matching.matched, layout.names, in_degrees)
    return MappedFields(layout.names, columns, layout.columns, values, layout).check()


def map_arrays(columns: Columns, given: Sequence[str], load: Take) -> MappedFields | None:
    """The fields of a file of arrays; None for one that needs no map.

    Args:
        columns: the map.
        given: names of the arrays.
        load: reads one; called for those that hold names.

    Raises:
        InputError: a map that does not fit the arrays, or itself.
    """
    check_columns(columns)
    if columns.rows_of is not None:
        raise LogError.at_field(
            f"{KEY}.rows_of", "given for arrays", "a table: rows are those of CSV, Parquet, JSON lines"
        )
    columns = columns_of_file(columns, given)
    entries = [part.entry for part in list_parts(columns).values()]
    texts = [text for entry in entries for text in (entry.column, *entry.columns.values()) if text]
    given = with_parts(given, [name for text in texts for name in _named_fields(text, given, load)])
    named = {name: parse_names(name, load(name)) for name in NAME_FIELDS if name in given}
    others = {entry.column for entry in columns.other_times} - {columns.time.column if columns.time else None}
    given = [name for name in given if name not in others]
    matching = match_columns(columns, given, lambda name: name in SHAPES or name in VARIANTS, named)
    if matching is None:
        return None
    native = {name: (name,) for name in matching.others}
    values = entry_values(matching.matched, matching.names)
    return MappedFields(matching.names, columns, native, values).check()


def read_stamps(entry: ColumnEntry, load: Take) -> FloatArray:
    """Stamps (N,) [s] of an entry of `other_times`; LogError for an array that holds none."""
    (part,) = list_parts(Columns(time=TimeEntry(**vars(entry)))).values()
    matched = Matched(part, (), (entry.column or "",), False, False)
    return entry_values({part.key: matched}, {})[part.key].read(load)


def _named_fields(text: str, given: Sequence[str], load: Take) -> list[str]:
    """The fields of records that a pattern of their names means; a name that is no such pattern itself."""
    root = text.partition("['")[0]
    if root == text or root not in given or not PLACEHOLDER.search(text):
        return [text]
    regex = re.compile(".+".join(re.escape(part) for part in PLACEHOLDER.sub("\0", text).split("\0")))
    return [name for name, _ in fields_of_records(root, load(root)) if regex.fullmatch(name)]
