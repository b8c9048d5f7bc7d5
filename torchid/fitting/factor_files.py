"""Files of compressed logs: what they hold, factors by contact state and block, and refusal of those of another fit."""

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
import torch
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter
from pydantic.dataclasses import dataclass

from torchid import __version__
from torchid.errors import ConfigError, LogError, about_file, during, excerpt, join_names
from torchid.fitting.experiment import Experiment, require_comparable, with_noise, with_radius
from torchid.fitting.noise import GroupNoise, NoiseSummary
from torchid.guards import MAX_ARRAYS, MAX_DESCRIPTION, MAX_LETTERS, check_unpacked_size
from torchid.identifiability.base_parameters import StateReport, merge_state_reports
from torchid.logs.containers import FACTORS, Container, open_npz, reader_errors_explained
from torchid.parameters import Array
from torchid.problem import RowBuilder, TriangularFactor
from torchid.problem.compression import FOLDS, CompressedLog, Part, block_spans, piece_spans
from torchid.problem.extras import ACTUATORS, NoiseGroups, in_words, noise_key
from torchid.problem.noise import noise_of_sensors
from torchid.reprs import short_repr
from torchid.robot import Robot
from torchid.robot.robot import Payload
from torchid.robot.tree import BodyJoint
from torchid.rounding import KINEMATIC_TOLERANCE
from torchid.sensing import Contact
from torchid.sensing.sensors import measured_components
from torchid.settings import AUTO, STRICT, NotNegative, Number
from torchid.staging import atomic_file

Value = bool | int | float | str | list[str] | None

NOISE = "sensors.noise"
"""Key of an experiment file under which noise is stated."""


@plain_dataclass(frozen=True)
class RowModel:
    """Robot, contacts, sensors, extra parameters and preprocessing that made the rows.

    Attributes:
        settings: by key of the experiment file; names of the robot's parts under "robot.urdf", and the number of
            columns.
        noise: standard deviations of the sensors by group [N m, N].
        geometry: constants of the kinematic tree and poses of contacts, in the units of the URDF.
    """

    settings: dict[str, Value]
    noise: dict[str, float]
    geometry: dict[str, Array]

    __repr__ = short_repr

    @classmethod
    def of(cls, robot: Robot, builder: RowBuilder, preprocessing: Mapping[str, float | None]) -> RowModel:
        """The row model of a builder.

        It excludes nominal inertial parameters, fitted friction and all estimator settings: these belong to a fit, and
        robots of one type may differ in them.

        Args:
            robot: the robot.
            builder: of the rows.
            preprocessing: settings that change the samples.
        """
        tree = builder.tree
        extras = builder.extras
        labels = {
            kind: [f"{x.label}, {'by log' if x.per_log else 'of all logs'}" for x in extras if x.what == kind]
            for kind in ("offset", "scale")
        }
        settings: dict[str, Value] = {
            "robot.base_link": robot.base_link,
            "robot.fixed_base": robot.fixed_base,
            "robot.urdf": [f"{body.name} ({_joint_text(body.joint)})" for body in robot.bodies],
            "contacts": [_contact_text(contact) for contact in builder.contacts],
            "sensors": _channels(robot, builder),
            "sensors.offsets": labels["offset"],
            "sensors.scales": labels["scale"],
            "actuators": [x.label for x in extras if x.what not in labels],
            "actuators.sign_width": tree.sign_width,
            "columns": builder.width,
        }
        if robot.welded:  # only then, to keep older files valid
            settings["robot.weld"] = [f"{name} at {position!r}" for name, position in robot.welded.items()]
        if robot.loops:
            settings["robot.loops"] = [f"{loop.kind} of {loop.label}" for loop in robot.loops]
        if robot.passive:
            settings["robot.passive"] = list(robot.passive)
        if tree.stribeck is not None:
            settings["actuators.stribeck"] = tree.stribeck
        if any(robot.base_tilt):
            settings["robot.base_tilt"] = ", ".join(map(repr, robot.base_tilt))
        for name in ("armature", "stiffness", "spring_torque"):
            if (stated := getattr(robot, name)).any():  # of an MJCF robot, subtracted from the right-hand side
                settings[f"robot.mjcf {name}"] = [repr(float(x)) for x in stated]
        settings |= {f"preprocessing.{name}": value for name, value in preprocessing.items()}
        geometry = {
            "T_parent_joint": tree.T_parent_joint,
            "T_joint_link": tree.T_joint_link,
            "joint_map": tree.joint_map.cpu().numpy(),
            "joint_constant": tree.joint_constant.cpu().numpy(),
            "contact_node": np.array([node for node, _ in builder.frames], dtype=float),
            "T_node_contact": np.array([pose for _, pose in builder.frames]).reshape(-1, 4, 4),
        }
        if robot.loops:
            poses = [tree.frame(robot, frame)[1] for loop in robot.loops for frame in loop.frames]
            geometry["T_node_loop"] = np.array(poses)
        return cls(settings, noise_of_sensors(builder), geometry)


def require_same_rows(path: object, actual: RowModel, expected: RowModel, reference: str) -> None:
    """Raise LogError if factors were made with other settings than expected; noise is not compared.

    Args:
        path: of the factors, for the message.
        actual: model of the factors.
        expected: model to compare with.
        reference: origin of the expected model, for the message.

    Raises:
        LogError: names the setting, its value and the accepted value.
    """
    for key in (*expected.settings, *(key for key in actual.settings if key not in expected.settings)):
        value = actual.settings.get(key)
        other = expected.settings.get(key)
        if value != other:
            raise LogError(path, key, *_texts(value, other, reference))
    if actual.noise.keys() != expected.noise.keys():
        raise LogError(path, NOISE, join_names(list(actual.noise)) or "none", join_names(list(expected.noise)))
    for name, array in expected.geometry.items():
        array_found = actual.geometry[name]
        if array_found.shape != array.shape or not np.allclose(array_found, array, rtol=0.0, atol=KINEMATIC_TOLERANCE):
            raise LogError(
                path, "robot.urdf", _where(name, array_found, array, expected), f"the kinematics of {reference}"
            )


def require_same_noise(path: object, actual: RowModel, expected: RowModel, reference: object) -> None:
    """Raise LogError if factors were weighted with other noise than expected; the message names the noise."""
    for group, value in expected.noise.items():
        if not np.isclose(actual.noise[group], value, rtol=KINEMATIC_TOLERANCE, atol=0.0):
            accepted = f"{value:g}, as in {reference}; state all of sensors.noise and compress again"
            raise LogError(path, f"{NOISE}.{group}", f"{actual.noise[group]:g}", accepted)


def _contact_text(contact: Contact) -> str:
    kind = f"line along {contact.line_axis}" if contact.kind == "line" else contact.kind
    if contact.radius:  # only then, to keep older files valid
        kind += f", radius {contact.radius!r} m, normal {', '.join(map(repr, contact.normal))}"
    if any(contact.centre):
        kind += f", centre {', '.join(map(repr, contact.centre))} m"
    if contact.along_normal:
        kind += f", read along {', '.join(map(repr, contact.normal))}"
    return f"{contact.frame} ({kind})"


def _joint_text(joint: BodyJoint | None) -> str:
    return "base" if joint is None else f"{joint.kind} {joint.name}"


def _channels(robot: Robot, builder: RowBuilder) -> list[str]:
    """Measured channels by name."""
    measured = measured_components(builder.contacts, builder.sensors)
    names = [robot.dof_names[dof] for dof in np.flatnonzero(builder.sensors.torque)]
    return names + [
        f"{builder.contacts[i].frame} {builder.contacts[i].component_name(k)}" for i, k in np.argwhere(measured)
    ]


def _texts(actual: Value, expected: Value, reference: str) -> tuple[str, str]:
    """What was found and what is accepted, in words."""
    if not (isinstance(actual, list) and isinstance(expected, list)):
        return _text(actual), f"{_text(expected)}, as in {reference}"
    missing, more = ([x for x in a if x not in b] for a, b in ((expected, actual), (actual, expected)))
    texts = [f"{what} {join_names(names)}" for what, names in (("lacks", missing), ("has also", more)) if names]
    return " and ".join(texts) or "another order", f"{join_names(expected) or 'none'}, as in {reference}"


def _text(value: Value) -> str:
    if isinstance(value, list):
        return join_names(value) or "none"
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _where(name: str, actual: Array, expected: Array, model: RowModel) -> str:
    """Which part of a robot differs, and by how much."""
    if actual.shape != expected.shape:
        return f"{name} of shape {actual.shape}"
    apart = np.abs(actual - expected).reshape(len(expected), -1).max(axis=1)
    worst = int(apart.argmax())
    if "contact" in name:
        contacts = model.settings["contacts"]
        return f"contact {contacts[worst] if isinstance(contacts, list) else worst} differs by {apart[worst]:.2g}"
    bodies = model.settings["robot.urdf"]
    known = isinstance(bodies, list) and len(bodies) == len(expected)
    part = f"{bodies[worst]}" if isinstance(bodies, list) and known else f"frame {worst}"
    return f"{name} of {part} differs by {apart[worst]:.2g}"


Whole = Annotated[int, Field(ge=0, le=2**53)]


@dataclass(config=STRICT, frozen=True)
class _Part:
    """A part without its numbers: `blocks` are numbers of supports and of rows, `noise_gram` of supports."""

    state: Annotated[str, Field(pattern="^[01]*$")]
    samples: Whole
    rows: Whole
    independent_rows: NotNegative
    masked: list[Whole]
    blocks: list[tuple[Whole, Whole]]
    noise_gram: list[Whole]


def _pack(parts: Sequence[Part], supports: dict[tuple[int, ...], int], values: list[Array]) -> list[dict[str, object]]:
    """The documents of some parts, as `_Part` has them; adds to the columns that they name, and to all numbers."""
    out: list[dict[str, object]] = []
    for part in parts:
        blocks = part.factor.blocks
        noise_gram = part.factor.noise_gram
        numbers = [supports.setdefault(support, len(supports)) for support in (*blocks, *noise_gram)]
        for block in (*blocks.values(), *noise_gram.values()):
            rows = block.cpu().numpy()
            values.append(rows[np.triu_indices(len(rows))] if len(rows) == rows.shape[1] else rows.ravel())
        out.append(
            {
                "state": "".join("01"[active] for active in part.state),
                "samples": part.samples,
                "rows": part.factor.rows,
                "independent_rows": part.factor.independent_rows,
                "masked": sorted(part.masked),
                "blocks": [(number, len(block)) for number, block in zip(numbers, blocks.values(), strict=False)],
                "noise_gram": numbers[len(blocks) :],
            }
        )
    return out


class _PartReader:
    """Reads the parts of a log in order; ValueError if a part does not fit the log."""

    def __init__(self, source: str, description: _Description, values: Array) -> None:
        settings = description.settings
        columns = settings.get("columns")
        contacts = settings.get("contacts")
        if not isinstance(columns, int) or columns < 1 or not isinstance(contacts, list):
            raise ValueError("no columns or contacts")
        self._source = source
        self._values = values
        self._taken = 0
        self._columns = columns
        self._contacts = len(contacts)
        self._supports = [tuple(support) for support in description.supports]
        if any(len(set(x)) != len(x) or max(x, default=0) >= columns for x in self._supports):
            raise ValueError(f"a column number of {columns} or more")

    def read(self, part: _Part, unloaded: bool = False) -> Part:
        """The next part."""
        if len(part.state) != self._contacts or (unloaded and part.samples):
            raise ValueError("a part with other contacts or samples than the log")
        if not part.independent_rows <= part.rows or (part.rows and not part.independent_rows):
            raise ValueError(f"{part.independent_rows:g} independent rows, but {part.rows} rows")
        blocks = {self._supports[number]: self._block(number, rows) for number, rows in part.blocks}
        halves = {self._supports[n]: self._block(n, len(self._supports[n]) + 1) for n in part.noise_gram}
        if len(blocks) != len(part.blocks) or len(halves) != len(part.noise_gram):
            raise ValueError("duplicate columns")
        noise_gram = {support: half + half.triu(1).T for support, half in halves.items()}
        factor = TriangularFactor(self._columns, part.rows, part.independent_rows, blocks, noise_gram)
        state = tuple(digit == "1" for digit in part.state)
        return Part(self._source, state, factor, part.samples, unloaded=unloaded, masked=set(part.masked))

    def _block(self, number: int, rows: int) -> torch.Tensor:
        """The next triangle, or fewer rows than a triangle, in some columns and the right-hand side."""
        width = len(self._supports[number]) + 1
        size = width * (width + 1) // 2 if rows == width else rows * width
        if rows > width or size > len(self._values) - self._taken:
            raise ValueError("fewer numbers than described")
        values = self._values[self._taken : self._taken + size]
        self._taken += size
        if rows < width:
            return torch.from_numpy(values.reshape(rows, width).copy())
        triangle = np.zeros((width, width))
        triangle[np.triu_indices(width)] = values
        return torch.from_numpy(triangle)

    def require_all_read(self) -> None:
        """Raise ValueError if there are more numbers than described."""
        if self._taken < len(self._values):
            raise ValueError("more numbers than described")


FORMAT = 4
"""Version of the format; it increases if older readers would misread a file."""

_ACCEPTED = f"a complete {FACTORS} file from torchid compress"
_GEOMETRY = ("T_parent_joint", "T_joint_link", "joint_map", "joint_constant", "contact_node", "T_node_contact")
_LARGEST = 1e30  # of a number: squares stay within the range of float64
_Text = Annotated[str, Field(max_length=10 * MAX_LETTERS)]
_Origin = Literal["estimated", "pooled", "at most", "confounded", "assumed"]


@plain_dataclass(frozen=True)
class FactorFile:
    """A compressed log with the model of its rows and its origin.

    Attributes:
        log: factors of the log.
        model: settings that made the rows.
        name: of the log's file.
        sha256: checksum of the log's file, "" if unknown.
        duration: of the log [s].
        excluded: number of rejected samples.
        states: contact states of the log.
        version: of torchid that compressed the log.
        payloads: known payloads, subtracted from the rows; as settings.
        noise_origins: origin of `model.noise` by group, as in `GroupNoise`; "stated" for missing groups.
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
    pieces: list[_Part]
    by_state: list[_Part]
    unloaded: list[tuple[Whole, Whole, list[_Part]]]
    supports: list[list[Whole]]
    states: list[_State]
    payloads: list[Payload]
    noise_origins: dict[str, _Origin]


_DESCRIPTION: TypeAdapter[_Description] = TypeAdapter(_Description)


def write_factors(path: str | Path, factors: FactorFile) -> None:
    """Write a compressed log, completely or not at all.

    For example::

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
        with atomic_file(path) as new, during("writing", path), new.open("xb") as stream:
            np.savez(stream, **arrays)
    except OSError as error:
        raise LogError(path, "file", f"cannot be written ({error})", "a path in a writable folder") from error


def read_factors(path: str | Path) -> FactorFile:
    """Read a compressed log.

    For example::

        logs = [torchid.read_factors(path).log for path in sorted(Path("factors").glob("*.factor"))]
        blocks = torchid.fold_compressed(logs, builder)

    Check with `require_same_rows` and `require_same_noise` whether the rows fit a builder.

    Args:
        path: of the file; it also names the log in a fit.

    Raises:
        LogError: the file does not exist, has another format, or is damaged.
    """
    path = Path(path)
    _require_suffix(path)
    if not os.path.isfile(path):
        reason = "no such file" if not os.path.lexists(path) else "not a regular file"
        raise LogError(path, "file", reason, _ACCEPTED)
    with about_file(path), reader_errors_explained("file", _ACCEPTED), open_npz(path) as container:
        sizes = container.declared_bytes()
        check_unpacked_size(path, sum(sizes.values()), path)
        if sum(sizes.values()) > MAX_ARRAYS or sizes.get("description", 0) > MAX_DESCRIPTION:
            raise ValueError("too large for a compressed log")
        return _read(path, container)


def _require_suffix(path: Path) -> None:
    if path.suffix != FACTORS:
        raise LogError(path, "file", f"extension '{path.suffix}'", FACTORS)


# ------------------------------------------------------------------------------------------------------------- writing


def _packed(factors: FactorFile) -> tuple[dict[str, object], Array]:
    """The description, and the numbers of all triangles."""
    log = factors.log
    supports = dict[tuple[int, ...], int]()
    values = list[Array]()
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
        "pieces": _pack(log.pieces, supports, values),
        "by_state": _pack(log.by_state, supports, values),
        "unloaded": [(*span, _pack(parts, supports, values)) for span, parts in log.unloaded.items()],
        "supports": list(supports),
        "states": [asdict(state) for state in factors.states],
        "payloads": factors.payloads,
        "noise_origins": factors.noise_origins,
    }
    return description, np.concatenate([np.empty(0), *values])


# ------------------------------------------------------------------------------------------------------------- reading


def _read(path: Path, container: Container) -> FactorFile:
    """The content of an open file; any exception where it is damaged."""
    text = _array(container, "description", np.uint8, 1).tobytes()
    document = json.loads(text)
    form = document.get("format") if isinstance(document, dict) else None
    if form != FORMAT:
        version = "none" if form is None else f"{excerpt(str(form))}, of another version of torchid"
        raise LogError.at_field("format", version, f"{FORMAT} (torchid {__version__}); compress the log again")
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
        raise ValueError(f"{name} is not an array of {dtype.__name__}")
    if array.dtype == np.float64 and not (np.abs(array) <= _LARGEST).all():
        raise ValueError(f"{name} has a number that is not finite")
    return array


def _log(source: str, description: _Description, values: Array) -> CompressedLog:
    """The compressed log; ValueError if it cannot be one."""
    samples = description.samples
    blocks = description.blocks
    parts = _PartReader(source, description, values)
    pieces = [parts.read(piece) for piece in description.pieces]
    by_state = [parts.read(piece) for piece in description.by_state]
    unloaded = {
        (start, stop): [parts.read(x, unloaded=True) for x in parts_in_air]
        for start, stop, parts_in_air in description.unloaded
    }
    parts.require_all_read()
    if not set(unloaded) <= {span for count in range(1, blocks + 1) for span in block_spans(samples, count)}:
        raise ValueError("contact readings in the air outside the blocks of the log")
    if [part.samples for part in pieces] != [stop - start for start, stop in piece_spans(samples, blocks)]:
        raise ValueError("pieces with other samples than the log")
    if sum(part.samples for part in by_state) != samples or len({part.state for part in by_state}) != len(by_state):
        raise ValueError("contact states with other samples than the log")
    noise = description.oversampling, description.noise_left
    return CompressedLog(source, samples, *noise, blocks, pieces, by_state, unloaded)


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
"""Keys of preprocessing that do not change the meaning of a row."""


def row_model(experiment: Experiment, builder: RowBuilder) -> RowModel:
    """What the rows of an experiment are formed with."""
    settings = vars(experiment.config.preprocessing)
    model = RowModel.of(experiment.robot, builder, {name: x for name, x in settings.items() if name not in _APART})
    actuators = experiment.config.actuators
    known: dict[str, Value] = {
        "actuators.delay": actuators.known_delay,
        "actuators.stiction": actuators.known["stiction"],
    }
    added: dict[str, Value] = {name: x for name, x in known.items() if x}  # only then, to keep older files valid
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
        experiment: its training logs are .factor files.
        on_read: called after each file.

    Raises:
        LogError: a file is damaged, or does not fit the experiment or the other files.
        ConfigError: the experiment states other noise.
    """
    paths = experiment.config.logs.train
    files: list[FactorFile] = []
    for path in paths:
        file = read_factors(path)
        if not files:
            with about_file(path), reader_errors_explained("settings", _ACCEPTED):
                experiment = with_choices_of(file.model, experiment)
            model = row_model(experiment, experiment.builder(experiment.sensors))
        require_same_rows(path, file.model, model, _THE_EXPERIMENT)
        files.append(file)
        require_same_noise(path, file.model, files[0].model, paths[0])
        if on_read is not None:
            on_read(path)
    _require_different_logs(paths, files)
    _require_stated_noise(experiment, files[0].model, paths[0])
    used = files[0].model.noise
    origins = files[0].noise_origins
    groups = NoiseGroups.of(experiment.robot)
    noise = groups.noise(groups.values(experiment.noise) | used, experiment.noise)
    listed = [GroupNoise(name, groups.unit(name), origins.get(name, "stated"), x, None) for name, x in used.items()]
    summary = NoiseSummary(noise, listed, {}, 0)
    return Fleet(with_noise(experiment, summary), files, summary, merge_state_reports(file.states for file in files))


def with_choices_of(model: RowModel, experiment: Experiment) -> Experiment:
    """Take over the choices of `torchid compress` where the experiment leaves them to the logs."""
    settings = model.settings
    config = experiment.config
    labels = settings.get("actuators")
    kinds = {label.partition(" of ")[0] for label in labels} if isinstance(labels, list) else set[str]()
    choices: dict[str, Any] = {name: in_words(name) in kinds for name in ACTUATORS}
    choices |= {name: settings.get(f"actuators.{name}") for name in ("sign_width", "delay", "stiction", "stribeck")}
    known = config.actuators.known
    chosen = {name: x or known[name] for name, x in choices.items() if vars(config.actuators)[name] == AUTO}
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
    for path, file in zip(paths, files, strict=True):
        if file.sha256 and file.sha256 in seen:
            reason = f"same log as {seen[file.sha256]} ({excerpt(file.name)})"
            raise LogError(path, "sha256", reason, "each log once")
        seen[file.sha256] = path


def _require_stated_noise(experiment: Experiment, model: RowModel, path: Path) -> None:
    """Raise ConfigError if an experiment states other noise than the factors were weighted with."""
    stated = NoiseGroups.of(experiment.robot).values(experiment.noise)
    for name, value in model.noise.items():
        if noise_key(name) in experiment.config.sensors.noise.forces and abs(value - stated[name]) > 1e-9 * value:
            reason = f"{stated[name]:g}, but {value:g} in {path}"
            accepted = f"{value:g}, or remove this key, or compress the logs again"
            raise ConfigError.at_field(f"{NOISE}.{name}", reason, accepted)
