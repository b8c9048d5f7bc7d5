"""Files of compressed logs: factors by contact state and block, with whatever says which of them belong together."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, field
from dataclasses import dataclass as plain_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter
from pydantic.dataclasses import dataclass

from torchid import __version__
from torchid.errors import LogError, about_file, during, excerpt
from torchid.fitting.packed_parts import PackedPart, PartPacker, PartReader, Whole
from torchid.fitting.row_model import RowModel, Value
from torchid.guards import MAX_ARRAYS, MAX_DESCRIPTION, MAX_LETTERS, MAX_TRIANGLES, check_unpacked_size
from torchid.identifiability.base_parameters import StateReport
from torchid.logs.containers import FACTORS, Container, open_npz, reader_errors_explained
from torchid.logs.remote import RemoteFile, is_url, local_copy
from torchid.parameters import Array
from torchid.problem.compressed_log import CompressedLog, piece_spans
from torchid.problem.compression import FOLDS, block_spans
from torchid.reprs import short_repr
from torchid.robot.payloads import Payload
from torchid.settings import STRICT, NotNegative, Number
from torchid.staging import atomic_file

FORMAT = 2
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
        path: of a file here, or the URL of one that fsspec reaches.

    Raises:
        LogError: no such file, one of another format, or a damaged one.
    """
    path = RemoteFile.at(str(path)) if is_url(str(path)) else Path(path)
    _require_suffix(path)
    with local_copy(path, _ACCEPTED, MAX_ARRAYS) as file:
        return _read_file(path, file)


def _read_file(path: Path, file: Path) -> FactorFile:
    """The content of a file here, called `path` in messages."""
    if not os.path.isfile(file):
        found = "no such file" if not os.path.lexists(file) else "no regular file"
        raise LogError(path, "file", found, _ACCEPTED)
    with about_file(path), reader_errors_explained("file", _ACCEPTED), open_npz(file) as container:
        sizes = container.declared_bytes()
        check_unpacked_size(path, sum(sizes.values()), file)
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
    return CompressedLog(source, samples, description.oversampling, blocks, pieces, by_state, unloaded)


def _sizes(settings: Mapping[str, Value]) -> tuple[int, int, int]:
    """Numbers of columns, contacts and extra parameters; ValueError without them."""
    columns, contacts = settings.get("columns"), settings.get("contacts")
    if not isinstance(columns, int) or columns < 1 or not isinstance(contacts, list):
        raise ValueError("neither columns nor contacts")
    labels = (settings.get(key) for key in _EXTRAS)
    return columns, len(contacts), sum(len(x) for x in labels if isinstance(x, list))
