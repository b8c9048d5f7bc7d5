"""`torchid check` and `torchid convert`, the commands that need logs alone."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import numpy as np

from torchid.commands.folder import check_free_file
from torchid.config import load_analysis
from torchid.config.logs import LogsConfig, PreprocessingConfig, load_columns, load_topics
from torchid.config.robot import ContactConfig
from torchid.errors import ConfigError, LogError, about_file, current_file, format_count
from torchid.fitting.experiment import resolve_contacts, set_up_robot
from torchid.log_checks import Checked
from torchid.log_checks.check import check
from torchid.logs import Columns, Log, Topics, read_log, write_log
from torchid.logs.blocks import has_blocks, open_log_blocks
from torchid.logs.containers import LogKind, atomic_output, existing_log_kind, new_log_kind
from torchid.logs.read import files_of_recordings_kept
from torchid.logs.time_range import log_title, split_range
from torchid.reading.log_reader import apply_contact_settings, memory_needed, recorded_log, setup_of_log
from torchid.report.figure_style import save_figure
from torchid.report.log_checks import log_check_document, log_check_figure
from torchid.report.tables import progress_bars
from torchid.robot import CollisionShapes, load_robot

EXPERIMENTS = (".yaml", ".yml")
FIGURES = (".png", ".pdf", ".svg")
_FEW_LOGS = 8
_WRENCH = (slice(0, 3), slice(3, 6))
MOST_CHECKED = 100_000
"""Samples of a log that are checked at once for the reason of a bad fit."""


@dataclass(frozen=True)
class LogSegment:
    """Successive samples of a log, with a name that says which, and how many the log has."""

    log: Log
    name: str
    of: int


class CheckedLogs(list[Checked]):
    """Logs with the results of their checks."""

    @property
    def usable(self) -> bool:
        """Whether every log has enough usable samples for a fit."""
        return all(log.usable for log in self)

    def to_dict(self) -> dict[str, Any]:
        """Output of `torchid check --json`."""
        return log_check_document(self)

    def __repr__(self) -> str:
        usable = sum(log.usable for log in self)
        lines = [repr(log).splitlines()[0] for log in self]
        more = [f"... and {len(self) - _FEW_LOGS} more"] if len(self) > _FEW_LOGS else []
        return "\n".join([f"{format_count(len(self), 'log')} checked, {usable} usable", *lines[:_FEW_LOGS], *more])


def check_files(
    path: str | Path,
    overrides: Sequence[str] = (),
    urdf: str | Path | None = None,
    base_link: str | None = None,
    fixed_base: bool = False,
    topics: str | Path | None = None,
    columns: str | Path | None = None,
) -> list[Checked]:
    """Check the logs of an experiment file, or one log; see `check_experiment` and `check_log`.

    Raises:
        ConfigError: options of the one with the other.
    """
    options = {"--urdf": urdf, "--base-link": base_link, "--fixed-base": fixed_base}
    options |= {"--topics": topics, "--columns": columns}
    given = [name for name, value in options.items() if value]
    if Path(path).suffix.lower() in EXPERIMENTS:
        if given:
            raise ConfigError("command line", given[0], "not used with an experiment file", "overrides, robot.urdf=...")
        return check_experiment(path, overrides)
    if overrides:
        reason = f"{overrides[0]} is not used with a log"
        raise ConfigError("command line", "overrides", reason, f"an experiment file ({', '.join(EXPERIMENTS)})")
    if urdf is None and (base_link or fixed_base):
        raise ConfigError("command line", given[0], "needs a robot", "--urdf too")
    return [check_log(path, urdf, base_link, fixed_base, topics, columns)]


def check_experiment(
    path: str | Path | None, overrides: Sequence[str] = (), sections: Mapping[str, object] | None = None
) -> list[Checked]:
    """Check all logs of an experiment, see `load_config`, against its robot and contacts.

    Raises:
        InputError: whatever in the file does not fit the robot, or a log that cannot be read.
    """
    config = load_analysis(path, overrides, sections, "check")
    with about_file(path or current_file()):
        if config.logs is None:
            raise ConfigError.at_field("logs", "missing", "logs to check")
        setup = set_up_robot(config)
        required = None if config.sensors.empty else setup.sensors_of(config.sensors)
    files = [*config.logs.train, *config.logs.validation, *config.logs.test]
    checked = []
    with progress_bars() as bars, files_of_recordings_kept():
        for file in bars.track(files, description="checking"):
            settings = config.preprocessing
            setup_of_file = setup_of_log(setup, file)
            _require_memory(file, settings)
            log, _ = apply_contact_settings(recorded_log(file, config.logs, settings), setup_of_file)
            found = check(
                log,
                setup_of_file.robot,
                setup.contacts,
                settings.filter_hz,
                settings.derived,
                setup.declared,
                required,
            )
            checked.append(replace(found, rolling=setup.rolling))
    return checked


def check_log(
    path: str | Path,
    urdf: str | Path | None = None,
    base_link: str | None = None,
    fixed_base: bool = False,
    topics: str | Path | None = None,
    columns: str | Path | None = None,
) -> Checked:
    """Check one log, by itself or against a robot.

    Args:
        path: the log.
        urdf: the robot; None: what needs it is skipped.
        base_link: as in an experiment file.
        fixed_base: likewise.
        topics: experiment file whose `logs.topics` says what the topics of a bag hold.
        columns: experiment file whose `logs.columns` says what foreign columns or arrays hold.

    Raises:
        InputError: the log or the URDF cannot be read, or the log is larger than an experiment's may be by default.
    """
    _require_memory(Path(path), PreprocessingConfig())
    of_topics, of_columns = _maps(topics, columns)
    log = read_log(path, of_topics, allow_gaps=True, columns=of_columns)
    if urdf is None:
        return check(log)
    robot = load_robot(urdf, base_link, fixed_base, log.ft_names)
    with about_file(log.source):
        for name in log.contact_names:
            robot.link(name, "contact_names")
    shapes = CollisionShapes(robot)
    settings = [_contact(log, index, shapes) for index in range(len(log.contact_names))]
    if log.base_quat_xyzw is None and not fixed_base:  # which way the ground's normal points is not known
        settings = [replace(contact, radius=0.0) for contact in settings]
    contacts, rolling = resolve_contacts(settings, robot)
    return replace(check(log, robot, contacts), rolling=rolling)


def segments_to_check(path: Path, logs: LogsConfig, settings: PreprocessingConfig) -> Iterator[LogSegment]:
    """One of the logs of an experiment in equal segments of at most `MOST_CHECKED` samples, the middle first.

    Raises:
        LogError: it cannot be read, or is larger than what may be in memory at once.
    """
    _require_memory(path, settings)
    yield from recorded_segments(path, logs, settings)


def recorded_segments(
    path: Path, logs: LogsConfig, settings: PreprocessingConfig, allow_gaps: bool = True
) -> Iterator[LogSegment]:
    """As `segments_to_check`, of a log of any size."""
    is_whole = settings.bridge_gaps_s is not None or not has_blocks(path, logs.columns)
    if is_whole or existing_log_kind(path) is LogKind.TABLE:
        log = recorded_log(path, logs, settings)
        for segment in _segments(len(log)):
            yield LogSegment(log.select(segment), _segment_name(path, segment, len(log)), len(log))
        return
    with open_log_blocks(path, Path(gettempdir()), logs.columns, settings.needs_flags) as blocks:
        for segment in _segments(len(blocks)):
            with about_file(path):
                log = blocks.read(segment, allow_gaps)
            yield LogSegment(log, _segment_name(path, segment, len(blocks)), len(blocks))


def _segments(samples: int) -> list[slice]:
    ends = np.linspace(0, samples, -(-samples // MOST_CHECKED) + 1).round().astype(int).tolist()
    segments = [slice(*pair) for pair in pairwise(ends)]
    return sorted(segments, key=lambda segment: abs(segment.start + segment.stop - samples))


def _segment_name(path: Path, segment: slice, samples: int) -> str:
    name = log_title(path)
    if segment.stop - segment.start == samples:
        return name
    return f"{name} (samples {segment.start} to {segment.stop - 1} of {samples}, counted from {segment.start})"


def _require_memory(path: Path, settings: PreprocessingConfig) -> None:
    """Refuse a log that is larger than what may be in memory at once."""
    size = memory_needed(path, settings.memory_gb)
    if size > settings.memory_gb:
        accepted = f"parts of the log, or an experiment file with preprocessing.memory_gb above {size:.2g}"
        raise LogError(path, "file", f"arrays of {size:.2g} GB do not fit in memory", accepted)


def _contact(log: Log, index: int, shapes: CollisionShapes) -> ContactConfig:
    """A contact of a log without an experiment file.

    A point if it is a ball, if it has forces without any moment or, where neither is known, if there are more than two:
    robots with many legs seldom have soles.
    """
    wrench = log.contact_wrench
    name = log.contact_names[index]
    force, moment = (False, False) if wrench is None else (np.nan_to_num(wrench[:, index, k]).any() for k in _WRENCH)
    many = len(log.contact_names) > 2
    is_point = shapes.about(name) is not None or (not moment and (force or many))
    return ContactConfig(name, "point" if is_point else "flat")


def check_outputs(
    document: str | None, figure: str | None, overwrite: bool = False, inputs: Sequence[str | None] = ()
) -> None:
    """Make sure, before any work, that files can be written there.

    Args:
        document: name of the .json file.
        figure: name of the figure.
        overwrite: whether files there may be replaced.
        inputs: files that are read.

    Raises:
        ConfigError: another extension, something in the way, or no folder to write to.
    """
    for option, name, accepted in (("--json", document, (".json",)), ("--figure", figure, FIGURES)):
        if name is None:
            continue
        path = Path(name)
        if path.suffix.lower() not in accepted:
            raise ConfigError("command line", option, f"'{name}'", f"a file name that ends in {', '.join(accepted)}")
        check_free_file(path, option, overwrite, [x for x in inputs if x is not None])


def write_check_outputs(checked: Sequence[Checked], document: str | None, figure: str | None) -> None:
    """Write all findings as JSON and an overview as a figure, each complete or not at all."""
    if document is not None:
        with atomic_output(Path(document)) as new:
            new.write_text(json.dumps(log_check_document(checked), indent=1, allow_nan=False) + "\n")
    if figure is not None:
        with atomic_output(Path(figure)) as new:
            save_figure(log_check_figure(checked), new, Path(figure).suffix[1:].lower())


def _maps(topics: str | Path | None, columns: str | Path | None) -> tuple[Topics | None, Columns | None]:
    """The maps in experiment files."""
    return None if topics is None else load_topics(topics), None if columns is None else load_columns(columns)


def convert(
    source: str | Path,
    target: str | Path,
    topics: str | Path | None = None,
    overwrite: bool = False,
    columns: str | Path | None = None,
) -> Log:
    """Read a log and write it as a file of another type, which appears complete or not at all.

    Args:
        source: any log that can be read.
        target: .npz, .h5, .hdf5, .csv or .parquet.
        topics: experiment file whose `logs.topics` says what the topics of a bag hold.
        columns: experiment file whose `logs.columns` says what foreign columns or arrays hold.
        overwrite: whether `target` may be replaced; what is read never is, as a log may hold more than is written.

    Returns:
        The log, in canonical frames and orders: another quaternion order or frame of the source is not kept.

    Raises:
        InputError: whatever does not fit; nothing has been written then.
    """
    path = Path(target)
    new_log_kind(path)
    files = (file.path for file in split_range(source).files)
    inputs = (*files, *(mapping for mapping in (topics, columns) if mapping is not None))
    check_free_file(path, "OUT", overwrite, inputs)
    of_topics, of_columns = _maps(topics, columns)
    with progress_bars() as bars:
        reading = bars.add_task("reading", total=None)

        def show(share: float) -> None:
            bars.update(reading, completed=round(100 * share), total=100)

        log = read_log(source, of_topics, show, columns=of_columns)
        bars.update(reading, completed=100, total=100)
        bars.add_task("writing", total=None)
        write_log(log, path)
    return log
