"""Find the columns, or arrays, of a file that a map of columns names."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from torchid.errors import ConfigError, LogError, excerpt, join_names
from torchid.logs.column_entries import KEY, TimeEntry, as_in_file
from torchid.logs.column_map import AXES, PLACEHOLDER, Columns, EntryPart, fits, letters_of, list_parts
from torchid.logs.columns import KINDS
from torchid.logs.log import CONTACT_READINGS, IMU_FIELDS, WRENCHES, UnknownFieldError
from torchid.logs.name_matching import name_unknown

_LISTED = 8


@dataclass(frozen=True)
class Matched:
    """The columns of one entry of a map.

    Attributes:
        part: what they make up.
        labels: names of joints (contacts, sensors) in the order of the columns, or of those of an array; None for one
            that is left out. Empty without names.
        columns: in the order of names, then of components; a single one is an array of what is not split.
        by_name: whether every name has a column of its own.
        by_component: whether every component has.
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

    def has_all_names(self, width: tuple[int, ...]) -> bool:
        """Whether all that an array with so many columns (k,) lacks are the last numbers of an order, without names."""
        return not self.by_name and len(width) == 1 and not any(self.labels[width[0] :]) and width[0] < len(self.labels)


@dataclass(frozen=True)
class Matching:
    """Columns of a file by the entries of a map.

    Attributes:
        matched: by key of the map.
        names: of joints, contacts and sensors, by field, in the order of the log.
        others: columns with names of the log format.
    """

    matched: Mapping[str, Matched]
    names: Mapping[str, tuple[str, ...]]
    others: tuple[str, ...]


def match_columns(
    columns: Columns,
    given: Sequence[str],
    is_native: Callable[[str], bool],
    named: Mapping[str, tuple[str, ...]] | None = None,
) -> Matching | None:
    """Find the columns of a map; None for a file that has none of them and names of the log format alone.

    Args:
        columns: the map.
        given: columns or arrays of the file.
        is_native: whether a column has a name of the log format.
        named: names that the file itself states, by field.

    Raises:
        ConfigError: a map that does not fit itself.
        LogError: columns that are missing, have two entries or none; all unknown ones are named at once.
    """
    search = _Search(columns, given, named or {})
    if search.parts and not search.finds_any and all(map(is_native, given)):
        return None
    matched = {key: search.match(part) for key, part in search.parts.items()}
    _require_once(matched)
    taken = {column for one in matched.values() for column in one.columns} | search.left_out
    others = [text for text in given if text not in taken]
    unknown = [x for x in others if not is_native(x) and not any(fits(x, one) for one in columns.ignore)]
    if unknown:
        raise LogError.at_field(
            KEY, f"no entry for {name_unknown(unknown)}", f"an entry for each column, or its name in {KEY}.ignore"
        )
    native = tuple(text for text in others if is_native(text) and not _is_ignored(columns, text))
    return Matching(matched, _common_names(columns, matched, named or {}), native)


def _is_ignored(columns: Columns, text: str) -> bool:
    """Whether a column with a name of the log format is to be left out: by a pattern that says more than `*`."""
    return any(letters_of(one) and fits(text, one) for one in columns.ignore)


class _Search:
    """The columns of a file, and which entries of a map they fit.

    Attributes:
        parts: entries of the map, by key.
        left_out: columns of numbers that are no joint of the robot.
    """

    def __init__(self, columns: Columns, given: Sequence[str], named: Mapping[str, tuple[str, ...]]) -> None:
        self._columns, self._given, self._named = columns, given, named
        self._known = set(given)
        self.parts, self.left_out = list_parts(columns), set[str]()
        fixed = {key: self._fixed(part) for key, part in self.parts.items()}
        self._fixed_by_key = {key: one for key, one in fixed.items() if one is not None}
        free = {key: part for key, part in self.parts.items() if key not in self._fixed_by_key}
        self._free = {key: _regex(part, part.entry.column or "") for key, part in free.items()}
        self._found = self._assign()

    @property
    def finds_any(self) -> bool:
        """Whether any column of the map is there."""
        fixed = (column for one in self._fixed_by_key.values() for column in one.columns)
        return any(self._found.values()) or any(column in self._known for column in fixed)

    def match(self, part: EntryPart) -> Matched:
        """The columns of an entry; LogError where some are missing."""
        one = self._fixed_by_key.get(part.key) or self._named_by_columns(part)
        missing = [column for column in one.columns if column not in self._known]
        if missing:
            self._require_numbers(part, missing[0])
            self._require_lists(part, missing[0])
            more = f" (nor {len(missing) - 1} more)" if len(missing) > 1 else ""
            unused = self._unused() or self._given
            raise UnknownFieldError.at_field(f"{KEY}.{part.key}", missing[0], unused, f"no such column{more}")
        return one

    def _require_numbers(self, part: EntryPart, missing: str) -> None:
        """Refuse an entry whose columns are all there but numbered from another first one."""
        first = 1 - min(part.entry.first_index, 1)
        if "{index" not in (part.entry.column or "") or first == part.entry.first_index:
            return
        shifted = self._fixed(replace(part, entry=replace(part.entry, first_index=first)))
        if shifted is not None and all(column in self._known for column in shifted.columns):
            found = f"'{missing}', no such column, with first_index: {part.entry.first_index}"
            raise LogError.at_field(f"{KEY}.{part.key}", found, f"first_index: {first}, by the numbers of the columns")

    def _require_lists(self, part: EntryPart, missing: str) -> None:
        """Refuse an element, such as `q[0]`, of a column that is there and has no lists of one length."""
        name, bracket, _ = missing.rpartition("[")
        if bracket and name in self._known:
            found = f"'{missing}' of the column '{name}', which has no lists, or lists of several lengths"
            raise LogError.at_field(f"{KEY}.{part.key}", found, "an element of lists of one length")

    def _unused(self) -> list[str]:
        taken = {column for one in self._fixed_by_key.values() for column in one.columns}
        return [text for text in self._given if text not in taken]

    # ------------------------------------------------------------------- entries whose names the map or the file states

    def _fixed(self, part: EntryPart) -> Matched | None:
        """The columns of an entry whose names are stated; None for names that columns alone have."""
        entry, holders = part.entry, [name for name, _ in PLACEHOLDER.findall(part.entry.column or "")]
        if entry.columns:
            return self._listed(part)
        text = entry.column or ""
        if not part.kind:
            return _without_names(part, text, holders)
        order = self._columns.order_of(entry, part.kind)
        if order is None and part.kind in holders:
            return None
        if order is None:
            order = list(self._named.get(part.names_field, ())) or self._no_order(part)
        by_name = bool({part.kind, "index"} & set(holders))
        numbered = list(enumerate(order, entry.first_index))
        columns = []
        for number, name in numbered if by_name else numbered[:1]:
            of_name = _spelled(part, text, number, self._stem(part, name) if part.kind in holders and name else "")
            if name is None and by_name:
                self.left_out.update(of_name if part.kind not in holders else ())
            else:
                columns += of_name
        return Matched(part, tuple(x for x in order if x or not by_name), tuple(columns), by_name, _splits(part, text))

    def _no_order(self, part: EntryPart) -> list[str | None]:
        field = f"{KEY}.{part.key}.order"
        accepted = f"names of the {part.kind}s in the order of '{part.entry.column}', or {KEY}.{part.kind}_order"
        raise ConfigError.at_field(field, "missing", accepted)

    def _listed(self, part: EntryPart) -> Matched:
        """The columns of an entry that names each."""
        entry = part.entry
        if not part.kind:
            return Matched(part, (), tuple(entry.columns[x] for x in part.components), False, True)
        columns: list[str] = []
        splits = {_splits(part, text) for text in entry.columns.values()}
        for number, (name, text) in enumerate(entry.columns.items(), entry.first_index):
            columns += _spelled(part, text, number, name)
        if len(splits) > 1:
            found = "patterns of components beside other names"
            raise ConfigError.at_field(f"{KEY}.{part.key}.columns", found, "{axis} in all or in none")
        return Matched(part, tuple(entry.columns), tuple(columns), True, splits.pop())

    def _stem(self, part: EntryPart, name: str) -> str:
        """What a file calls a joint or contact."""
        before, after = self._name_parts(part)
        if not name.startswith(before) or not name.endswith(after) or len(name) <= len(before) + len(after):
            found = f"'{self._columns.name_of(part.kind)}', which '{excerpt(name)}' is no example of"
            raise ConfigError.at_field(f"{KEY}.{part.kind}_name", found, f"a pattern of all names of {part.kind}s")
        return name[len(before) : len(name) - len(after)]

    def _name_parts(self, part: EntryPart) -> tuple[str, str]:
        before, _, after = self._columns.name_of(part.kind).partition(f"{{{part.kind}}}")
        return before, after

    # ------------------------------------------------------------------------ entries whose names columns alone have

    def _assign(self) -> dict[str, list[tuple[str, str]]]:
        """Columns, with the name in each, of every entry whose names columns alone have."""
        fixed = {column for one in self._fixed_by_key.values() for column in one.columns} | self.left_out
        found = defaultdict[str, list[tuple[str, str]]](list)
        for text in self._given:
            named = {key: match["name"] for key, regex in self._free.items() if (match := regex.fullmatch(text))}
            if text in fixed or not named:
                continue
            letters = {key: letters_of(self.parts[key].entry.column or "") for key in named}
            most = max(letters.values())
            if any(letters_of(one) > most and fits(text, one) for one in self._columns.ignore):
                continue
            if text == "time" and not most:  # stamps of the file, beside {joint}
                continue
            best = [key for key in named if letters[key] == most]
            if len(best) > 1:
                both = f"the patterns of {KEY}.{best[0]} and {KEY}.{best[1]}"
                raise LogError.at_field(f"column '{text}'", f"fits {both}", "one that has more letters than the other")
            found[best[0]].append((text, named[best[0]]))
        return found

    def _named_by_columns(self, part: EntryPart) -> Matched:
        """An entry whose names are those in its columns, in their order."""
        text = part.entry.column or ""
        stems = dict.fromkeys(stem for _, stem in self._found[part.key])
        if not stems:
            found = f"no column that fits '{excerpt(text)}'"
            raise LogError.at_field(f"{KEY}.{part.key}", found, join_names(self._unused() or self._given, _LISTED))
        columns = [column for stem in stems for column in _spelled(part, text, 0, stem)]
        before, after = self._name_parts(part)
        labels = tuple(f"{before}{stem}{after}" for stem in stems)
        return Matched(part, labels, tuple(columns), True, _splits(part, text))


def _without_names(part: EntryPart, text: str, holders: Sequence[str]) -> Matched:
    """An entry of a field without names, in which `{index}` is that of a component."""
    if "index" not in holders:
        return Matched(part, (), tuple(_spelled(part, text, 0, "")), False, _splits(part, text))
    numbers = range(part.entry.first_index, part.entry.first_index + max(len(part.components), 1))
    return Matched(part, (), tuple(_filled(text, {}, number) for number in numbers), False, bool(part.components))


def _splits(part: EntryPart, text: str) -> bool:
    """Whether a pattern has a column for each component."""
    return bool(part.components) and any(name in AXES for name, _ in PLACEHOLDER.findall(text))


def _spelled(part: EntryPart, text: str, number: int, stem: str) -> list[str]:
    """The columns of a pattern for one name."""
    axes = part.components if _splits(part, text) else ("",)
    return [
        _filled(text, {part.kind: stem, "axis": axis, "AXIS": axis.upper(), "component": str(k)}, number)
        for k, axis in enumerate(axes)
    ]


def _filled(text: str, values: Mapping[str, str], number: int) -> str:
    def value(found: re.Match[str]) -> str:
        name, width = found.groups()
        return f"{number:{width or ''}d}" if name == "index" else values[name]

    return PLACEHOLDER.sub(value, text)


def _regex(part: EntryPart, text: str) -> re.Pattern[str]:
    """Columns that fit a pattern of an entry; the group `name` has the name."""
    out, end = "", 0
    axes = "|".join(part.components)
    groups = {part.kind: "(?P<name>.+)", "index": r"\d+", "component": r"\d"}
    groups |= {"axis": f"(?:{axes})", "AXIS": f"(?:{axes.upper()})"}
    for found in PLACEHOLDER.finditer(text):
        out += re.escape(text[end : found.start()]) + groups[found[1]]
        end = found.end()
    return re.compile(out + re.escape(text[end:]))


# ----------------------------------------------------------------------------------------------- several files, one map


def columns_of_file(columns: Columns, given: Sequence[str]) -> Columns:
    """The map for a file with some columns or arrays: with one of `other_times` if that of `time` is not there."""
    others = [entry for entry in columns.other_times if entry.column in given]
    if not others or (columns.time is not None and columns.time.column in given):
        return columns
    return replace(columns, time=TimeEntry(**vars(others[0])))


def columns_by_file(columns: Columns, given: Sequence[Sequence[str]], files: Sequence[str]) -> list[Columns | None]:
    """The map without the entries that are for others of several files, for each.

    Entries without columns are for the file with the field that they belong to. Of columns that several files have, a
    name says before `::` of which file they are: `torques.csv::{joint}`. An entry may have
    joints, contacts or sensors in each of several files.

    Args:
        columns: the map.
        given: columns or arrays of each file.
        files: their names.

    Raises:
        LogError: an entry of which no file has a column.
    """
    of_files = [as_in_file(columns, file, files) for file in files]
    maps = [columns_of_file(own, of_file) for own, of_file in zip(of_files, given, strict=True)]
    found = [_entries_in(own, of_file) for own, of_file in zip(maps, given, strict=True)]
    for name in columns.fields:
        if not any(name in of_file for of_file in found):
            none = f"no column of it in {join_names(files, _LISTED)}"
            raise LogError.at_field(f"{KEY}.{name}", none, "columns that one of the files has")
    without: list[dict[str, Any]] = [
        dict.fromkeys({*columns.fields, "imu_frame"} - of_file) | ({} if WRENCHES[1] in of_file else {"plates": {}})
        for of_file in found
    ]
    return [replace(own, **lacking) for own, lacking in zip(maps, without, strict=True)]


def _entries_in(columns: Columns, given: Sequence[str]) -> set[str]:
    """Entries of a map of which a file has a column, and those without columns that belong to one of its fields.

    Stamps by their step belong to every file without a column of stamps.
    """
    patterns = [
        (part.key.partition(".")[0], letters_of(text), _regex(part, text))
        for part in list_parts(columns).values()
        for text in (part.entry.column, *part.entry.columns.values())
        if text
    ]
    out = set[str]()
    for text in given:
        of_fields = [(field, letters) for field, letters, regex in patterns if regex.fullmatch(text)]
        ignored = [letters_of(one) for one in columns.ignore if fits(text, one)]
        most = max((*ignored, *(letters for _, letters in of_fields)), default=0)
        out |= {field for field, letters in of_fields if letters == most}
    has = {*out, *(text.partition(".")[0] for text in given)}
    without = {name: _beside(columns, name) for name in (*columns.fields, "imu_frame")}
    named = {field for field, *_ in patterns}
    if columns.time is not None and columns.time.step is not None and "time" not in has:
        out.add("time")
    return out | {name for name, beside in without.items() if name not in named and has & set(beside)}


def _beside(columns: Columns, name: str) -> Sequence[str]:
    """Fields to one of which an entry without columns belongs."""
    if name == "contact_active" and (columns.contact_active is None or columns.contact_active.above is None):
        return ("joint_position",)  # contacts that always touch, which any file could have
    beside = {"contact_active": CONTACT_READINGS, "joint_torque": ("joint_velocity",), "imu_frame": IMU_FIELDS}
    return beside.get(name, ())


# ------------------------------------------------------------------------------------------------- checks of a matching


def _require_once(matched: Mapping[str, Matched]) -> None:
    """Refuse a column with two entries."""
    owners: dict[str, str] = {}
    for key, one in matched.items():
        for column in one.columns:
            if column in owners:
                found = f"column '{excerpt(column)}', which {KEY}.{owners[column]} has already"
                raise LogError.at_field(f"{KEY}.{key}", found, "every column once")
            owners[column] = key


def _common_names(
    columns: Columns, matched: Mapping[str, Matched], named: Mapping[str, tuple[str, ...]]
) -> dict[str, tuple[str, ...]]:
    """Names of joints, contacts and sensors: those that the file states, else of the first entry, of torques last."""
    listed = [(f"{KEY}.{key}", one.part.names_field, one.names) for key, one in matched.items() if one.part.kind]
    if columns.contact_active is not None and columns.contact_active.always:
        listed.append((f"{KEY}.contact_active.always", "contact_names", tuple(columns.contact_active.always)))
    names, torque = dict(named), f"{KEY}.joint_torque"
    for key, field, of_part in sorted(listed, key=lambda one: one[0].startswith(torque)):
        common = names.setdefault(field, of_part)
        again = [name for name in of_part if of_part.count(name) > 1]
        lacking = set() if key.startswith(torque) else set(common) - set(of_part)  # a torque may be unmeasured
        differing = again or sorted(lacking | set(of_part) - set(common))
        if differing:
            where = "twice" if again else "missing here" if differing[0] in common else "missing in other fields"
            found = f"{KINDS[field]} '{excerpt(differing[0])}' {where}"
            raise LogError.at_field(key, found, f"the same {KINDS[field]}s in all fields, each once")
    return names
