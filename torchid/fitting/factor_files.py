"""Files of compressed logs: factors by contact state and block, read and refused where they are not of one fit."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, field, replace
from dataclasses import dataclass as plain_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter
from pydantic.dataclasses import dataclass

from torchid import __version__
from torchid.errors import ConfigError, LogError, about_file, during, excerpt
from torchid.fitting.checked_settings import require_comparable
from torchid.fitting.experiment import Experiment, with_noise, with_radius
from torchid.fitting.factor_documents import (
    NOISE,
    PackedPart,
    PartPacker,
    PartReader,
    RowModel,
    Value,
    Whole,
    require_same_noise,
    require_same_rows,
)
from torchid.fitting.noise import GroupNoise, NoiseSummary
from torchid.guards import MAX_ARRAYS, MAX_DESCRIPTION, MAX_LETTERS, MAX_TRIANGLES, check_unpacked_size
from torchid.identifiability.base_parameters import StateReport, merge_state_reports
from torchid.logs.containers import FACTORS, Container, open_npz, reader_errors_explained
from torchid.parameters import Array
from torchid.problem import RowBuilder
from torchid.problem.chunk_dynamics import block_spans
from torchid.problem.compression import FOLDS, CompressedLog, piece_spans
from torchid.problem.extras import ACTUATORS, NoiseGroups, in_words, noise_key
from torchid.reprs import short_repr
from torchid.robot.payloads import Payload
from torchid.settings import AUTO, STRICT, NotNegative, Number
from torchid.staging import atomic_file

FORMAT = 3
"""Version of the format, a whole number that grows whenever a reader of an older version would be wrong."""

_ACCEPTED = f"a whole {FACTORS} file, as torchid compress writes it"
_GEOMETRY = ("T_parent_joint", "T_joint_link", "joint_map", "joint_constant", "contact_node", "T_node_contact")
_EXTRAS = ("sensors.offsets", "sensors.scales", "actuators")
_LARGEST = 1e30  # of a number: squares stay within the range of float64
_Text = Annotated[str, Field(max_length=10 * MAX_LETTERS)]
_Origin = Literal["estimated", "pooled", "at most", "confounded", "assumed"]


@plain_dataclass(frozen=True)
class FactorFile:
    """A compressed log with what its rows were formed with, and where it comes from.

    Attributes:
        log: factors of the log.
        model: what the rows were formed with.
        name: of the log's file; `sha256`: its checksum, "" if it is not known.
        duration: of the log [s].
        excluded: rejected samples that were left out.
        states: contact states of the log.
        version: of torchid that compressed it.
        payloads: what the robot carried, of which the rows are free; as settings.
        noise_origins: of `model.noise` by group, as `GroupNoise` has them; "stated" of groups that are not in it.
    """

    log: CompressedLog
    model: RowModel
    name: str = ""
    sha256: str = ""
    duration: float = 0.0
    excluded: int = 0
    states: list[StateReport] = field(default_factory=list)
    version: str = __version__
    payloads: list[dict[str, Any]] = field(default_factory=list)
    noise_origins: dict[str, str] = field(default_factory=dict)

    __repr__ = short_repr


@dataclass(config=STRICT, frozen=True)
class _State:
    name: _Text
    samples: Whole
    rows: Whole
    base_rank: Whole | None
    base_singular_value: NotNegative | None
    base_full_share: NotNegative | None
    base_rank_shares: dict[int, NotNegative]
    mean_rows: NotNegative | None = None


@dataclass(config=STRICT, frozen=True)
class _Unloaded:
    start: Whole
    stop: Whole
    parts: list[PackedPart]


@dataclass(config=STRICT, frozen=True)
class _Description:
    format: int
    torchid: _Text
    log: _Text
    sha256: Annotated[str, Field(pattern=r"^([0-9a-f]{64})?$")]
    samples: Annotated[int, Field(ge=1, le=2**53)]
    oversampling: Annotated[Number, Field(ge=1.0)]
    noise_left: Annotated[Number, Field(gt=0.0, le=1.0)]
    duration_s: NotNegative
    excluded: Whole
    blocks: Annotated[int, Field(ge=1, le=FOLDS)]
    settings: dict[str, Value]
    noise: dict[str, Annotated[Number, Field(gt=0.0)]]
    pieces: list[PackedPart]
    by_state: list[PackedPart]
    unloaded: list[_Unloaded]
    supports: list[list[Whole]]
    states: list[_State]
    payloads: list[Payload] = field(default_factory=list)
    noise_origins: dict[str, _Origin] = field(default_factory=dict)


_DESCRIPTION: TypeAdapter[_Description] = TypeAdapter(_Description)


def write_factors(path: str | Path, factors: FactorFile) -> None:
    """Write a compressed log, whole or not at all.

    From Python::

        model = torchid.RowModel.of(robot, builder, {"cutoff_hz": 8.0})
        torchid.write_factors("walk.factor", torchid.FactorFile(torchid.compress_log(log, builder), model))

    Args:
        path: ends in .factor.
        factors: what to write.

    Raises:
        LogError: another extension, or the file cannot be written.
    """
    path = Path(path)
    _require_suffix(path)
    description, values = _packed(factors)
    arrays: dict[str, Any] = dict(factors.model.geometry)
    arrays["description"] = np.frombuffer(json.dumps(description, allow_nan=False).encode(), np.uint8)
    arrays["values"] = values
    try:
        with atomic_file(path, result=False) as new, during("writing", path), new.open("xb") as stream:
            np.savez(stream, **arrays)
    except OSError as error:
        raise LogError(path, "file", f"cannot be written ({error})", "a path in a writable folder") from error


def read_factors(path: str | Path) -> FactorFile:
    """Read a compressed log; its name in a fit is that of the file.

    From Python::

        logs = [torchid.read_factors(path).log for path in sorted(Path("factors").glob("*.factor"))]
        blocks = torchid.fold_compressed(logs, builder)

    Whether its rows are those of a builder, `require_same_rows` and `require_same_noise` say.

    Args:
        path: of the file.

    Raises:
        LogError: no such file, one of another format, or a damaged one.
    """
    path = Path(path)
    _require_suffix(path)
    if not os.path.isfile(path):
        found = "no such file" if not os.path.lexists(path) else "no regular file"
        raise LogError(path, "file", found, _ACCEPTED)
    with about_file(path), reader_errors_explained("file", _ACCEPTED), open_npz(path) as container:
        sizes = container.declared_bytes()
        check_unpacked_size(path, sum(sizes.values()), path)
        if sum(sizes.values()) > MAX_ARRAYS or sizes.get("description", 0) > MAX_DESCRIPTION:
            raise ValueError("more bytes than a compressed log has")
        return _read(path, container)


def _require_suffix(path: Path) -> None:
    if path.suffix != FACTORS:
        raise LogError(path, "file", f"extension '{path.suffix}'", FACTORS)


# ------------------------------------------------------------------------------------------------------------- writing


def _packed(factors: FactorFile) -> tuple[dict[str, object], Array]:
    """The description, and the numbers of all triangles."""
    log, packer = factors.log, PartPacker()
    description = {
        "format": FORMAT,
        "torchid": factors.version,
        "log": factors.name,
        "sha256": factors.sha256,
        "samples": log.samples,
        "oversampling": log.oversampling,
        "noise_left": log.noise_left,
        "duration_s": factors.duration,
        "excluded": factors.excluded,
        "blocks": log.blocks,
        "settings": factors.model.settings,
        "noise": factors.model.noise,
        "pieces": packer.pack(log.pieces),
        "by_state": packer.pack(log.by_state),
        "unloaded": [{"start": a, "stop": b, "parts": packer.pack(parts)} for (a, b), parts in log.unloaded.items()],
        "supports": packer.supports,
        "states": [asdict(state) for state in factors.states],
    }
    if factors.payloads:  # a file of a robot without stays what it was
        description["payloads"] = factors.payloads
    if factors.noise_origins:
        description["noise_origins"] = factors.noise_origins
    return description, packer.values


# ------------------------------------------------------------------------------------------------------------- reading


def _read(path: Path, container: Container) -> FactorFile:
    """The content of an open file; any exception where it is damaged."""
    text = _array(container, "description", np.uint8, 1).tobytes()
    document = json.loads(text)
    found = document.get("format") if isinstance(document, dict) else None
    if found != FORMAT:
        version = "none" if found is None else f"{excerpt(str(found))}, of another version of torchid"
        raise LogError.at_field("format", version, f"{FORMAT}, as torchid {__version__} writes it")
    description = _DESCRIPTION.validate_json(text)
    require_comparable([*description.noise.values()])
    geometry = {name: _array(container, name, np.float64) for name in _GEOMETRY}
    log = _log(str(path), description, _array(container, "values", np.float64, 1))
    return FactorFile(
        log,
        RowModel(description.settings, dict(description.noise), geometry),
        description.log,
        description.sha256,
        description.duration_s,
        description.excluded,
        [StateReport(**vars(state)) for state in description.states],
        description.torchid,
        [asdict(payload) for payload in description.payloads],
        dict(description.noise_origins),
    )


def _array(container: Container, name: str, dtype: type, dimensions: int | None = None) -> NDArray[Any]:
    array = container.load(name)
    if array.dtype != dtype or dimensions not in (None, array.ndim):
        raise ValueError(f"{name} is no array of {dtype.__name__}")
    if array.dtype == np.float64 and not (np.abs(array) <= _LARGEST).all():
        raise ValueError(f"{name} has a number that is not finite")
    return array


def _log(source: str, description: _Description, values: Array) -> CompressedLog:
    """The compressed log; ValueError if it cannot be one."""
    samples, blocks = description.samples, description.blocks
    parts = PartReader(values, description.supports, *_sizes(description.settings), MAX_TRIANGLES)
    pieces, by_state = (
        [parts.read(source, one) for one in same] for same in (description.pieces, description.by_state)
    )
    unloaded = {
        (x.start, x.stop): [parts.read(source, one, unloaded=True) for one in x.parts] for x in description.unloaded
    }
    spans = {span for count in range(1, blocks + 1) for span in block_spans(samples, count)}
    if not set(unloaded) <= spans or len(unloaded) != len(description.unloaded):
        raise ValueError("readings in the air of what is no block of the log")
    if [part.samples for part in pieces] != [stop - start for start, stop in piece_spans(samples, blocks)]:
        raise ValueError("pieces of other samples than those of the log")
    if sum(part.samples for part in by_state) != samples or len({part.state for part in by_state}) != len(by_state):
        raise ValueError("contact states of other samples than those of the log")
    if parts.numbers_left:
        raise ValueError("more numbers than are described")
    noise = description.oversampling, description.noise_left
    return CompressedLog(source, samples, *noise, blocks, pieces, by_state, unloaded)


def _sizes(settings: Mapping[str, Value]) -> tuple[int, int, int]:
    """Numbers of columns, contacts and extra parameters; ValueError without them."""
    columns, contacts = settings.get("columns"), settings.get("contacts")
    if not isinstance(columns, int) or columns < 1 or not isinstance(contacts, list):
        raise ValueError("neither columns nor contacts")
    labels = (settings.get(key) for key in _EXTRAS)
    return columns, len(contacts), sum(len(x) for x in labels if isinstance(x, list))


_THE_EXPERIMENT = "the experiment file"
_APART = (
    "detect_contacts",
    "contact_threshold",
    "zero_in_air",
    "base_motion",
    "max_slip",
    "exclude_rejected",
    "memory_gb",
)
"""Keys of preprocessing that do not change what a row is."""


def row_model(experiment: Experiment, builder: RowBuilder) -> RowModel:
    """What the rows of an experiment are formed with."""
    settings = vars(experiment.config.preprocessing)
    model = RowModel.of(experiment.robot, builder, {name: x for name, x in settings.items() if name not in _APART})
    actuators = experiment.config.actuators
    known: dict[str, Value] = {
        "actuators.delay": actuators.known_delay,
        "actuators.stiction": actuators.known["stiction"],
    }
    added: dict[str, Value] = {name: x for name, x in known.items() if x}  # a factor without stays what it was
    return replace(model, settings=model.settings | added) if added else model


@plain_dataclass(frozen=True)
class Fleet:
    """Compressed training logs of one fit, that belong together.

    Attributes:
        experiment: with the noise that they were weighted with.
        files: the logs.
        noise: that they were weighted with.
        states: their contact states.
    """

    experiment: Experiment
    files: list[FactorFile]
    noise: NoiseSummary
    states: list[StateReport]


def read_fleet(experiment: Experiment, on_read: Callable[[Path], None] | None = None) -> Fleet:
    """Read the compressed training logs of an experiment.

    Args:
        experiment: whose training logs are files of factors.
        on_read: called after each file.

    Raises:
        LogError: a file that is damaged, or does not belong to the experiment or to the others.
        ConfigError: the experiment states other noise.
    """
    paths = experiment.config.logs.train
    files: list[FactorFile] = []
    for path in paths:
        one = read_factors(path)
        if not files:
            with about_file(path), reader_errors_explained("settings", _ACCEPTED):
                experiment = with_choices_of(one.model, experiment)
            model = row_model(experiment, experiment.builder(experiment.sensors))
        require_same_rows(path, one.model, model, _THE_EXPERIMENT)
        files.append(one)
        require_same_noise(path, one.model, files[0].model, paths[0])
        if on_read is not None:
            on_read(path)
    _require_different_logs(paths, files)
    _require_stated_noise(experiment, files[0].model, paths[0])
    used, origins, groups = files[0].model.noise, files[0].noise_origins, NoiseGroups.of(experiment.robot)
    noise = groups.noise(groups.values(experiment.noise) | used, experiment.noise)
    listed = [GroupNoise(name, groups.unit(name), origins.get(name, "stated"), x, None) for name, x in used.items()]
    summary = NoiseSummary(noise, listed, {}, 0)
    return Fleet(with_noise(experiment, summary), files, summary, merge_state_reports(one.states for one in files))


def with_choices_of(model: RowModel, experiment: Experiment) -> Experiment:
    """The experiment with what `torchid compress` has chosen where it leaves that to the logs."""
    settings, config = model.settings, experiment.config
    labels = settings.get("actuators")
    kinds = {label.partition(" of ")[0] for label in labels} if isinstance(labels, list) else set[str]()
    found: dict[str, Any] = {name: in_words(name) in kinds for name in ACTUATORS if name != "stribeck"}
    found |= {name: settings.get(f"actuators.{name}") for name in ("sign_width", "delay", "stiction", "stribeck")}
    known = config.actuators.known
    chosen = {name: x or known[name] for name, x in found.items() if vars(config.actuators)[name] == AUTO}
    read: dict[str, Any] = {
        name: settings.get(f"preprocessing.{name}")
        for name in ("cutoff_hz", "contact_margin_s")
        if getattr(config.preprocessing, name) == AUTO
    }
    config = replace(
        config,
        actuators=replace(config.actuators, **chosen),
        preprocessing=replace(config.preprocessing, **read),
    )
    robot = experiment.robot
    if config.robot.base_tilt == AUTO:
        angles = _numbers(settings.get("robot.base_tilt", "0.0, 0.0"))
        tilt = (angles[0], angles[1])
        config = replace(config, robot=replace(config.robot, base_tilt=tilt))
        robot = replace(robot, base_tilt=tilt)
    return _with_radius_of(settings.get("contacts"), replace(experiment, config=config, robot=robot))


def _with_radius_of(contacts: Value, experiment: Experiment) -> Experiment:
    """The experiment with the radius of feet that the logs have chosen, if they have: another than the robot's file."""
    is_open = {contact.frame for contact in experiment.contacts if contact.frame in experiment.open_radii}
    texts = [text.partition(" (point, radius ") for text in contacts] if isinstance(contacts, list) else []
    radii = {_numbers(text)[0] for frame, _, text in texts if frame in is_open and text}
    stated = {contact.radius for contact in experiment.contacts if contact.frame in is_open}
    return with_radius(experiment, *radii) if len(radii) == 1 and radii != stated else experiment


def _numbers(text: Value) -> list[float]:
    """Numbers in a text, in their order."""
    return [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?(?:e-?\d+)?", str(text))]


def _require_different_logs(paths: Sequence[Path], files: Sequence[FactorFile]) -> None:
    seen: dict[str, Path] = {}
    for path, one in zip(paths, files, strict=True):
        if one.sha256 and one.sha256 in seen:
            found = f"of the same log as {seen[one.sha256]} ({excerpt(one.name)})"
            raise LogError(path, "sha256", found, "factors of every log once")
        seen[one.sha256] = path


def _require_stated_noise(experiment: Experiment, model: RowModel, path: Path) -> None:
    """Refuse an experiment that states other noise than factors were weighted with."""
    used, stated = model.noise, NoiseGroups.of(experiment.robot).values(experiment.noise)
    for name, value in used.items():
        if noise_key(name) in experiment.config.sensors.noise.forces and abs(value - stated[name]) > 1e-9 * value:
            found = f"{stated[name]:g}, but {value:g} in {path}"
            accepted = f"{value:g}, or no such key, or the logs compressed with another"
            raise ConfigError.at_field(f"{NOISE}.{name}", found, accepted)
