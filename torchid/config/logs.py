"""The logs of an experiment file: patterns, parts in time, folds, what must not overlap, and how they are read."""

from __future__ import annotations

import dataclasses
import math
import os
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from torchid.config.settings_files import FileKind, Settings, load
from torchid.errors import ConfigError, LogError, UnknownNameError, about_file, excerpt, warn_about_file
from torchid.logs import Columns, Topics
from torchid.logs.columns import check_columns
from torchid.logs.containers import FACTORS, READABLE, list_bag_files
from torchid.logs.flags import ContactThreshold
from torchid.logs.ros_topics import check_topics
from torchid.logs.time_range import JOINED, JOINED_ACCEPTED, LogFile, LogPart, each_recording, join_files, split_range
from torchid.logs.unitree import JOINT_ORDERS
from torchid.problem.contact_detection import DetectionConfig
from torchid.robot.robot import INERTIA_ACCEPTED, Payload
from torchid.settings import AUTO, STRICT, NotNegativeAutoOrNone, Positive, PositiveOrAuto

SETS = ("train", "test", "validation")
"""Keys of `logs` that list logs."""

_USUAL_FOLDS = 5
"""Folds that a log is cut into where an entry names one and not their number."""

_KEYS = ("file", "files", "from", "to", "fold", "without_fold", "of", "payload")
_ENTRY = "a file name, or a mapping with file (or files) and, if needed, from, to, fold, without_fold, payload"
_FILES = "several files as one log, [motion.csv, {file: plates.csv, shift_s: 0.12}], the first with its stamps"

PAYLOAD_ACCEPTED = "a mapping with link, mass [kg], center_of_mass [x, y, z in m] and inertia, or a list of several"
_PAYLOAD: TypeAdapter[Payload] = TypeAdapter(Payload)
_PAYLOAD_ACCEPTED = {
    "link": "the name of a link of the robot",
    "mass": "a number greater than 0 [kg]",
    "center_of_mass": "[x, y, z] in the link's frame [m]",
    "inertia": INERTIA_ACCEPTED,
}


@dataclass(config=STRICT, frozen=True)
class LogsConfig:
    """Logs of an experiment.

    A name with `*` or `?` is a pattern for all files that match. A range behind a name takes a part of each log:
    `walk.npz[0:30]`, see `TimeRange`. Mappings say the same in words (`entries_spelled_out`).

    Attributes:
        train: logs to fit, or their factors, written by `torchid compress`; factors may be remote: `s3://...`.
        test: logs for tests only.
        validation: held-out logs for early stopping of `sgd`.
        topics: map of the topics of bags.
        columns: map of the columns of foreign tables and arrays.
        payloads: what the robot carried in a recording, by the absolute path of its file.
    """

    train: Annotated[list[Path], Field(min_length=1)]
    test: list[Path] = dataclasses.field(default_factory=list)
    validation: list[Path] = dataclasses.field(default_factory=list)
    topics: Topics | None = None
    columns: Columns | None = None
    payloads: dict[str, Annotated[list[Payload], Field(min_length=1)]] = dataclasses.field(default_factory=dict)

    def payloads_of(self, path: str | Path) -> Sequence[Payload]:
        """What the robot carried in a log."""
        return self.payloads.get(_recording(split_range(path)), ())

    @property
    def compressed(self) -> bool:
        """Whether the logs to fit on are factors."""
        return any(path.suffix == FACTORS for path in self.train)

    @property
    def files(self) -> list[Path]:
        """All files, of parts of logs as well; a bag may be a folder."""
        parts = [split_range(path) for name in SETS for path in getattr(self, name)]
        return list(dict.fromkeys(file.path for part in parts for file in part.files))

    def require_samples(self, command: str) -> None:
        """Refuse factors where samples are needed. Raises ConfigError: names the file."""
        if self.compressed:
            reason = f"{self.train[0]} has factors, but torchid {command} needs samples"
            raise ConfigError.at_field("logs.train", reason, f"logs ({', '.join(READABLE)})")


# ------------------------------------------------------------------------------------------------ entries in words


def entries_spelled_out(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings with the entries of `logs` as names with ranges, where they are mappings.

    Raises:
        ConfigError: keys that do not go together, or a value of the wrong kind.
        UnknownNameError: a key that entries have not.
    """
    logs = settings.get("logs")
    if not isinstance(logs, dict):
        return settings
    spelled: dict[str, Any] = {}
    payloads: dict[str, Any] = {}
    for name, entries in logs.items():
        if name in SETS and isinstance(entries, list):
            numbered = enumerate(entries)
            spelled[name] = [x for number, entry in numbered for x in _names(f"logs.{name}.{number}", entry)]
            for number, entry in enumerate(entries):
                _add_payloads(payloads, f"logs.{name}.{number}", entry)
    if payloads:
        before = logs.get("payloads", {})
        spelled["payloads"] = before | payloads if isinstance(before, dict) else before
    return settings | {"logs": logs | spelled}


def _add_payloads(payloads: dict[str, Any], field: str, entry: object) -> None:
    """Add the payloads of an entry, as settings, by the name of its log."""
    if not isinstance(entry, Mapping) or "payload" not in entry:
        return
    field = f"{field}.payload"
    given = entry["payload"]
    several = given if isinstance(given, list) else [given]
    new = [_payload(field if given is not several else f"{field}.{k}", payload) for k, payload in enumerate(several)]
    file = _file(field, entry)
    if not new:
        raise ConfigError.at_field(field, "an empty list", PAYLOAD_ACCEPTED)
    if payloads.get(file, new) != new:
        raise ConfigError.at_field(field, f"differs from another payload of {file}", "one payload for each recording")
    payloads[file] = new


def _payload(field: str, given: object) -> dict[str, Any]:
    if not isinstance(given, Mapping):
        raise ConfigError.at_field(field, f"found {excerpt(repr(given))}", PAYLOAD_ACCEPTED)
    keys = [x.name for x in dataclasses.fields(Payload)]
    for key in given:
        if key not in keys:
            raise UnknownNameError.at_field(field, str(key), keys)
    try:
        _PAYLOAD.validate_python(dict(given))
    except ValidationError as error:
        first = error.errors()[0]
        key = str(first["loc"][0])
        reason = "missing" if first["type"] == "missing" else f"found {excerpt(repr(given[key]))}"
        raise ConfigError.at_field(f"{field}.{key}", reason, _PAYLOAD_ACCEPTED[key]) from error
    return dict(given)


def _names(field: str, entry: object) -> Iterator[object]:
    """The names, with ranges, of what an entry stands for; anything but a mapping is left to other checks."""
    if not isinstance(entry, Mapping):
        yield entry
        return
    for key in entry:
        if key not in _KEYS:
            raise UnknownNameError.at_field(field, str(key), _KEYS)
    file = _file(field, entry)
    folds = [key for key in ("fold", "without_fold") if key in entry]
    bounds = [key for key in ("from", "to") if key in entry]
    if len(folds) + bool(bounds) > 1 or ("of" in entry and not folds):
        reason = "of without fold" if "of" in entry and not folds else f"{' and '.join([*folds, *bounds])} together"
        accepted = "from and to; or fold; or without_fold; of (number of folds) only with fold or without_fold"
        raise ConfigError.at_field(field, reason, accepted)
    if not folds:
        start, stop = (_bound(f"{field}.{key}", entry.get(key)) for key in ("from", "to"))
        yield f"{file}[{start}:{stop}]" if bounds else file
        return
    number = _count(f"{field}.of", entry.get("of", _USUAL_FOLDS), 2)
    fold = _count(f"{field}.{folds[0]}", entry[folds[0]], 1, number)
    yield from (f"{file}{text}" for text in _fold_ranges(fold, number, folds[0] == "without_fold"))


def _file(field: str, entry: Mapping[str, object]) -> str:
    """The name of the log of a mapping without its range."""
    if "files" in entry:
        if "file" in entry:
            raise ConfigError.at_field(field, "both file and files", "one of the two")
        files = entry["files"]
        if not isinstance(files, list) or len(files) < 2:
            reason = "one file" if isinstance(files, list) and files else f"found {excerpt(repr(files))}"
            raise ConfigError.at_field(f"{field}.files", reason, f"{_FILES}; file for a single one")
        return join_files([_joined(f"{field}.files.{number}", joined) for number, joined in enumerate(files)])
    file = entry.get("file")
    if not isinstance(file, str) or not file:
        reason = "missing" if "file" not in entry else f"found {excerpt(repr(file))}"
        raise ConfigError.at_field(f"{field}.file", reason, _ENTRY)
    return file


def _joined(field: str, entry: object) -> LogFile:
    """One of several files."""
    keys = ("file", "shift_s")
    given = entry if isinstance(entry, Mapping) else {"file": entry}
    for key in given:
        if key not in keys:
            raise UnknownNameError.at_field(field, str(key), keys)
    file = given.get("file")
    shift = given.get("shift_s", 0.0)
    if not isinstance(file, str) or not file or JOINED in file:
        raise ConfigError.at_field(field, f"found {excerpt(repr(entry))}", _FILES)
    if isinstance(shift, bool) or not isinstance(shift, (int, float)) or not math.isfinite(shift):
        raise ConfigError.at_field(f"{field}.shift_s", f"found {excerpt(repr(shift))}", "a time shift [s]")
    return LogFile(Path(file), float(shift))


def _fold_ranges(fold: int, folds: int, without: bool) -> list[str]:
    """Ranges of a fold, from 1, or of what is left without it."""
    start, stop = ("" if x in (0, folds) else f"{100.0 * x / folds:.15g}%" for x in (fold - 1, fold))
    if not without:
        return [f"[{start}:{stop}]"]
    return [*([f"[:{start}]"] if start else []), *([f"[{stop}:]"] if stop else [])]


def _bound(field: str, value: object) -> str:
    """A bound as it stands in a range."""
    if value is None:
        return ""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ConfigError.at_field(field, f"found {excerpt(repr(value))}", "a time [s], or a share such as 80%")
    return str(value)


def _count(field: str, value: object, least: int, most: int | None = None) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < least or (most is not None and value > most):
        accepted = f"a whole number from {least}" + ("" if most is None else f" to {most} (number of folds)")
        raise ConfigError.at_field(field, f"found {excerpt(repr(value))}", accepted)
    return value


# ---------------------------------------------------------------------------------------------- patterns and overlaps


def resolve_logs(logs: LogsConfig) -> LogsConfig:
    """The logs with patterns resolved.

    Raises:
        ConfigError: no file matches, a bad range, or samples with two uses that exclude each other.

    Warns:
        TorchidWarning: test samples that had another use.
    """
    files = {key: _matching(f"logs.{key}", getattr(logs, key)) for key in SETS}
    require_apart(_parts(files), _surely_share)
    return LogsConfig(**files, topics=logs.topics, columns=logs.columns, payloads=_resolved_payloads(logs))


def tests_on_seen_samples(logs: LogsConfig) -> bool:
    """Whether test samples are also fitted or used for early stopping, judged by their ranges."""
    parts = _parts({key: getattr(logs, key) for key in SETS})
    return any(any(_sharing(parts, key, "test", _surely_share)) for key in ("train", "validation"))


def _parts(files: Mapping[str, Sequence[Path]]) -> Parts:
    return {key: [_part(f"logs.{key}", path) for path in files[key]] for key in SETS}


def _surely_share(part: LogPart, other: LogPart) -> bool:
    return part.shares_samples(other) is True


def _resolved_payloads(logs: LogsConfig) -> dict[str, list[Payload]]:
    """Payloads by the absolute path of a recording, patterns resolved."""
    out: dict[str, list[Payload]] = {}
    for name, payloads in logs.payloads.items():
        field = "logs.payloads"
        if not Path(name).is_absolute():
            reason = f"{name} is a relative path"
            accepted = "payload: {...} in an entry of logs.train or logs.test"
            raise ConfigError.at_field(field, reason, accepted)
        for path in _matching(field, [Path(name)]):
            if path.suffix == FACTORS:
                reason = f"{path}: torchid compress has already removed the payload"
                raise ConfigError.at_field(field, reason, "payloads of logs")
            recording = _recording(_part(field, path))
            if out.get(recording, payloads) != payloads:
                raise ConfigError.at_field(field, f"two payloads for {recording}", "one payload for each recording")
            out[recording] = payloads
    return out


def _recording(part: LogPart) -> str:
    """The file that stands for a recording: the first of several."""
    return os.path.abspath(part.files[0].path)


Parts = Mapping[str, Sequence[LogPart]]
"""Parts of logs by their key."""


def require_apart(parts: Parts, share: Callable[[LogPart, LogPart], bool]) -> None:
    """Make sure that no sample has two uses.

    Args:
        parts: of logs.
        share: whether two parts of the same file, or of the same first file of several, share samples.

    Raises:
        ConfigError: samples that are fitted twice, or fitted and used for early stopping.

    Warns:
        TorchidWarning: test samples that had another use.
    """
    for key, use in (("train", "for the fit"), ("validation", "for early stopping")):
        if both := sorted(str(part) for _, part in _sharing(parts, key, "test", share)):
            warn_about_file(f"logs.test: {both[0]} is also used {use}. Its errors are not those of unseen motion.")
    if both := sorted(str(part) for _, part in _sharing(parts, "train", "validation", share)):
        raise ConfigError.at_field("logs.validation", f"{both[0]} is also used for the fit", "logs outside logs.train")
    for key in SETS:
        for part, other in _sharing(parts, key, key, share):
            raise ConfigError.at_field(f"logs.{key}", f"{part} and {other} share samples", "each sample once")


def _sharing(
    parts: Parts, key: str, other: str, share: Callable[[LogPart, LogPart], bool]
) -> Iterator[tuple[LogPart, LogPart]]:
    """Pairs of parts of two lists, or of one, that share samples."""
    by_file = defaultdict[Path, list[tuple[int, LogPart]]](list)
    for number, part in enumerate(parts.get(key, ())):
        by_file[part.files[0].path].append((number, part))
    for number, part in enumerate(parts.get(other, ())):
        for before, candidate in by_file.get(part.files[0].path, ()):
            if (key != other or before < number) and share(candidate, part):
                yield candidate, part


def _part(field: str, path: Path) -> LogPart:
    try:
        return split_range(path)
    except LogError as error:
        raise ConfigError.at_field(field, f"{path}, {error.found}", error.accepted) from error


def _matching(field: str, paths: Sequence[Path]) -> list[Path]:
    """The paths, with every file that matches in place of a name with * or ? in it."""
    out: list[Path] = []
    paths = [recording for path in paths for recording in _each_recording(path)]
    for path in paths:
        part = _part(field, path)
        if part.range is not None and part.file.suffix == FACTORS:
            reason = f"{path} takes a part of factors, which have no samples"
            raise ConfigError.at_field(field, reason, f"whole {FACTORS} files, or parts of logs")
        if part.joins and {"*", "?"} & set("".join(file.path.name for file in part.files)):
            raise ConfigError.at_field(
                field, f"{path} has a pattern", f"file names without patterns, {JOINED_ACCEPTED}"
            )
        if part.joins or not {"*", "?"} & set(part.file.name) or part.file.exists():
            out.append(path)
            continue
        files = _listed(part.file)
        if part.range is not None:
            if named := _listed(path):
                reason = f"{path}: the brackets may be a range or part of the file name {named[0].name}"
                raise ConfigError.at_field(field, reason, "file names without brackets, or each log by its name")
            files = [file.with_name(file.name + part.range.text) for file in files]
        if not files:
            raise ConfigError.at_field(field, f"no file matches {part.file}", "an existing log, or a matching pattern")
        out += files
    again = [path for path in out if out.count(path) > 1]
    if again:
        raise ConfigError.at_field(field, f"{again[0]} is given twice", "each log once")
    return out


def _each_recording(path: Path) -> list[Path]:
    """Paths of the recordings that a name such as `walk.npz[#0:40]` stands for; else the path itself."""
    names = [path.name] if path.exists() else each_recording(path.name)
    return [path] if names == [path.name] else [path.with_name(name) for name in names]


def _listed(pattern: Path) -> Sequence[Path]:
    """All files whose names match a path with * or ? in its last part, in order; brackets stand for themselves."""
    matching = pattern.parent.glob(pattern.name.replace("[", "[[]"))
    return sorted(file for file in matching if file.is_file() or list_bag_files(file))


def _switch(value: object) -> object:
    """All settings at their defaults for true, none for false."""
    return ({} if value else None) if isinstance(value, bool) else value


def _threshold(value: object) -> object:
    """A number is the threshold of both changes."""
    if isinstance(value, str):
        raise ValueError("a force [N], or a mapping with above, below, shortest_s")
    return {"above": value} if isinstance(value, (int, float)) else value


@dataclass(config=STRICT, frozen=True)
class PreprocessingConfig:
    """Filter, gaps and contacts: what happens to logs before the fit.

    Attributes:
        cutoff_hz: of the zero-phase low-pass filter [Hz]; null: no filter; auto: from the motion and its noise.
        sample_rate_hz: rate after resampling [Hz]; null: as recorded; auto: every k-th sample of a filtered log.
        bridge_gaps_s: gaps (NaN) up to this length are interpolated [s]; null: none.
        contact_margin_s: samples closer to a change of contact are left out [s]; null: none; auto: if they make the fit
            worse.
        detect_contacts: true, or settings: flags from joint torques replace recorded contact flags (`DetectionConfig`).
        contact_threshold: force [N], or settings: flags from measured forces replace recorded contact flags.
        zero_in_air: subtract the mean reading in the air from each contact sensor, for each log.
        base_motion: contacts: base motion from standing feet replaces the recorded motion; null: as recorded.
        max_slip: samples whose standing contact moves faster are left out [m/s]; null: none; auto: from velocity noise.
        exclude_rejected: leave out the samples that `torchid check` rejects.
        memory_gb: logs whose arrays need more than an eighth of it are read in parts, with their samples on disk [GB].
    """

    cutoff_hz: PositiveOrAuto = None
    sample_rate_hz: PositiveOrAuto = None
    bridge_gaps_s: Positive | None = None
    contact_margin_s: NotNegativeAutoOrNone = None
    detect_contacts: Annotated[DetectionConfig | None, BeforeValidator(_switch)] = None
    contact_threshold: Annotated[ContactThreshold | None, BeforeValidator(_threshold)] = None
    zero_in_air: bool = False
    base_motion: Literal["contacts"] | None = None
    max_slip: PositiveOrAuto = None
    exclude_rejected: bool = False
    memory_gb: Positive = 2.0

    @property
    def filter_hz(self) -> float | None:
        """The cutoff as a number [Hz], None where there is no filter, or it has not been chosen."""
        return None if isinstance(self.cutoff_hz, str) else self.cutoff_hz

    @property
    def slip_limit(self) -> float | None:
        """The stated speed [m/s] above which a contact slips, None where it follows from the noise."""
        return None if isinstance(self.max_slip, str) else self.max_slip

    @property
    def margin_s(self) -> float | None:
        """Samples that are dropped before and after each change of contact [s], None for none."""
        stated = None if self.contact_margin_s == AUTO else self.contact_margin_s
        margins = [stated, None if self.detect_contacts is None else self.detect_contacts.margin_s]
        return max((margin for margin in margins if margin is not None), default=None)

    @property
    def derived(self) -> tuple[str, ...]:
        """How names of fields of a log begin that are worked out of others, whatever was recorded."""
        flags = () if self.needs_flags else ("contact_active",)
        return flags if self.base_motion is None else (*flags, "base_")

    @property
    def takes_possible_contacts(self) -> bool:
        """Whether detected flags may be those of contacts that may stand: nothing takes it that they keep still."""
        return self.base_motion is None and self.max_slip is None

    @property
    def needs_flags(self) -> bool:
        """Whether nothing but a log says which contact touches when."""
        return self.detect_contacts is None and self.contact_threshold is None


_ORDER = f"a list of names, or a robot: {', '.join(JOINT_ORDERS)}"
MAPS_ACCEPTED = {
    **{f"logs.columns.{kind}_order": _ORDER for kind in ("joint", "contact")},
    **{f"logs.columns.{key}": "a list of names" for key in ("sensor_order", "ignore")},
    "logs.columns.other_times": "a list of entries like time: [{column: stamp, unit: ms}]",
    "logs.columns.plates": "poses by contact: {l_foot: {position: [0.3, 0.2, 0], rpy_deg: [180, 0, 90]}}",
    "logs.columns.*": "the name of a column, a pattern such as {joint}_q, or a mapping with column, unit, scale, ...",
    "logs.topics.joint_states": "the name of a topic, or a mapping with topic and joints",
    "logs.topics.other_joint_states": "a list of entries like joint_states: [/arms/joint_states]",
    "logs.topics.low_state": "a mapping with topic and robot, or joints by number of the motor",
}
"""Accepted for entries of maps, in messages, where their types alone say too little."""

T = TypeVar("T")


@dataclass(config=STRICT, frozen=True)
class _TopicsOfLogs:
    topics: Topics


@dataclass(config=STRICT, frozen=True)
class _TopicsFile:
    logs: _TopicsOfLogs


@dataclass(config=STRICT, frozen=True)
class _ColumnsOfLogs:
    columns: Columns


@dataclass(config=STRICT, frozen=True)
class _ColumnsFile:
    logs: _ColumnsOfLogs


def _kind(settings: type[T], key: str, example: str) -> FileKind[T]:
    """An experiment file of which one key of `logs` counts."""

    def prepare(settings: Settings, _: Settings) -> Settings:
        logs = settings.get("logs")
        return {"logs": {name: x for name, x in logs.items() if name == key} if isinstance(logs, dict) else {}}

    name = "experiment"
    keys = f"logs.{key}"
    example = f"logs.{key}.{example}"
    return FileKind(
        settings=settings, name=name, keys=keys, list_example=example, prepare=prepare, accepted=MAPS_ACCEPTED
    )


_TOPICS = _kind(_TopicsFile, "topics", "joint_states.joints=[l_knee]")
_COLUMNS = _kind(_ColumnsFile, "columns", "joint_order=[l_knee]")


def load_topics(path: str | Path) -> Topics:
    """Read `logs.topics` from an experiment file, whatever its other keys are.

    Raises:
        ConfigError: unreadable file, no `logs.topics`, a value of the wrong kind.
        UnknownNameError: a key that does not exist; the message names the nearest that do.
    """
    topics = load(_TOPICS, Path(path)).logs.topics
    with about_file(path):
        check_topics(topics)
    return topics


def load_columns(path: str | Path) -> Columns:
    """Read `logs.columns` from an experiment file, as `load_topics` does `logs.topics`."""
    columns = load(_COLUMNS, Path(path)).logs.columns
    with about_file(path):
        check_columns(columns)
    return columns
