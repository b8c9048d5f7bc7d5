"""Files of compressed logs: factors by contact state and block, with whatever says which of them belong together."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, field
from dataclasses import dataclass as plain_dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, TypeAdapter
from pydantic.dataclasses import dataclass

from torchid import __version__
from torchid.errors import LogError, about_file, during, excerpt
from torchid.fitting.row_model import RowModel, Value
from torchid.guards import MAX_ARRAYS, MAX_DESCRIPTION, MAX_LETTERS, MAX_TRIANGLES, check_unpacked_size
from torchid.identifiability.base_parameters import StateReport
from torchid.logs.containers import FACTORS, Container, open_npz, reader_errors_explained
from torchid.parameters import Array
from torchid.problem import TriangularFactor
from torchid.problem.compressed_log import CompressedLog, Span, piece_spans
from torchid.problem.compression import FOLDS, Part, block_spans
from torchid.settings import NotNegative, Number
from torchid.staging import atomic_file

FORMAT = 1
"""Version of the format, a whole number that grows whenever a reader of an older version would be wrong."""

_ACCEPTED = f"a whole {FACTORS} file, as torchid compress writes it"
_GEOMETRY = ("T_parent_joint", "T_joint_link", "joint_map", "joint_constant", "contact_node", "T_node_contact")
_EXTRAS = ("sensors.offsets", "sensors.scales", "actuators")
_LARGEST = 1e30  # of a number: squares stay within the range of float64
_STRICT = ConfigDict(extra="forbid")
_Whole = Annotated[int, Field(ge=0, le=2**53)]
_Text = Annotated[str, Field(max_length=10 * MAX_LETTERS)]


@plain_dataclass(frozen=True)
class FactorFile:
    """A compressed log with what its rows were formed with, and where it comes from.

    Attributes:
        log: factors of the log.
        model: what the rows were formed with.
        name: of the log's file; `sha256`: its checksum, "" if it is not known.
        duration: of the log [s].
        excluded: condemned samples that were left out.
        states: contact states of the log.
        version: of torchid that compressed it.
    """

    log: CompressedLog
    model: RowModel
    name: str = ""
    sha256: str = ""
    duration: float = 0.0
    excluded: int = 0
    states: list[StateReport] = field(default_factory=list)
    version: str = __version__


@dataclass(config=_STRICT, frozen=True)
class _State:
    name: _Text
    samples: _Whole
    rows: _Whole
    base_rank: _Whole | None
    base_singular_value: NotNegative | None
    base_full_share: NotNegative | None
    base_rank_shares: dict[int, NotNegative]


@dataclass(config=_STRICT, frozen=True)
class _Part:
    """`state`: a digit for each contact; `triangles`: number of the support, rows, whether packed as a triangle."""

    state: str
    start: _Whole
    stop: _Whole
    unloaded: bool
    samples: _Whole
    rows: _Whole
    independent_rows: NotNegative
    gated: list[_Whole]
    triangles: list[tuple[_Whole, _Whole, bool]]


@dataclass(config=_STRICT, frozen=True)
class _Description:
    format: int
    torchid: _Text
    log: _Text
    sha256: Annotated[str, Field(pattern=r"^([0-9a-f]{64})?$")]
    samples: Annotated[int, Field(ge=1, le=2**53)]
    oversampling: Annotated[Number, Field(ge=1.0)]
    duration_s: NotNegative
    excluded: _Whole
    blocks: Annotated[int, Field(ge=1, le=FOLDS)]
    settings: dict[str, Value]
    noise: dict[str, Annotated[Number, Field(gt=0.0)]]
    supports: list[list[_Whole]]
    parts: list[_Part]
    states: list[_State]


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
        check_unpacked_size(path, sum(sizes.values()))
        if sum(sizes.values()) > MAX_ARRAYS or sizes.get("description", 0) > MAX_DESCRIPTION:
            raise ValueError("more bytes than a compressed log has")
        return _read(path, container)


def _require_suffix(path: Path) -> None:
    if path.suffix != FACTORS:
        raise LogError(path, "file", f"extension '{path.suffix}'", FACTORS)


# ------------------------------------------------------------------------------------------------------------- writing


def _packed(factors: FactorFile) -> tuple[dict[str, object], Array]:
    """The description, and the numbers of all triangles."""
    log, supports = factors.log, dict[tuple[int, ...], int]()
    values: list[Array] = []
    parts = []
    for (start, stop), same in log.parts.items():
        for part in same:
            triangles = []
            for support, block in part.factor.blocks.items():
                rows = block.cpu().numpy()
                packed = len(rows) == rows.shape[1] and not np.tril(rows, -1).any()
                values.append(rows[np.triu_indices(len(rows))] if packed else rows.ravel())
                triangles.append((supports.setdefault(support, len(supports)), len(rows), packed))
            parts.append(
                {
                    "state": "".join("01"[active] for active in part.state),
                    "start": start,
                    "stop": stop,
                    "unloaded": part.unloaded,
                    "samples": part.samples,
                    "rows": part.factor.rows,
                    "independent_rows": part.factor.independent_rows,
                    "gated": sorted(part.gated),
                    "triangles": triangles,
                }
            )
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
        "supports": list(supports),
        "parts": parts,
        "states": [asdict(state) for state in factors.states],
    }
    return description, np.concatenate([np.empty(0), *values])


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
    if sum(len(part.triangles) for part in description.parts) > MAX_TRIANGLES:
        raise ValueError(f"more than {MAX_TRIANGLES} triangles")
    geometry = {name: _array(container, name, np.float64) for name in _GEOMETRY}
    parts = _parts(str(path), description, _array(container, "values", np.float64, 1))
    log = CompressedLog(str(path), description.samples, description.oversampling, description.blocks, parts)
    return FactorFile(
        log,
        RowModel(description.settings, dict(description.noise), geometry),
        description.log,
        description.sha256,
        description.duration_s,
        description.excluded,
        [StateReport(**vars(state)) for state in description.states],
        description.torchid,
    )


def _array(container: Container, name: str, dtype: type, dimensions: int | None = None) -> NDArray[Any]:
    array = container.load(name)
    if array.dtype != dtype or dimensions not in (None, array.ndim):
        raise ValueError(f"{name} is no array of {dtype.__name__}")
    if array.dtype == np.float64 and not (np.abs(array) <= _LARGEST).all():
        raise ValueError(f"{name} has a number that is not finite")
    return array


def _parts(source: str, description: _Description, values: Array) -> dict[Span, list[Part]]:
    """The parts by span; ValueError if they cannot be those of a log."""
    pieces = set(piece_spans(description.samples, description.blocks))
    blocks = {span for count in range(1, description.blocks + 1) for span in block_spans(description.samples, count)}
    columns = description.settings.get("columns")
    if not isinstance(columns, int) or columns < 1:
        raise ValueError("no number of columns")
    supports, stream = [_support(one, columns) for one in description.supports], _Stream(values)
    out: dict[Span, list[Part]] = {}
    seen = set[tuple[object, ...]]()
    for one in description.parts:
        span = (one.start, one.stop)
        key = (*span, one.state, one.unloaded)
        if key in seen or span not in (blocks if one.unloaded else pieces):
            raise ValueError(f"samples {one.start} to {one.stop} are no block of the log, or one given twice")
        seen.add(key)
        out.setdefault(span, []).append(_part(source, one, columns, description.settings, supports, stream))
    if sum(one.samples for one in description.parts) != description.samples or stream.left:
        raise ValueError("factors of other samples than those of the log")
    return out


def _part(
    source: str,
    one: _Part,
    columns: int,
    settings: Mapping[str, Value],
    supports: Sequence[tuple[int, ...]],
    stream: _Stream,
) -> Part:
    contacts, extras = settings.get("contacts"), 0
    for key in _EXTRAS:
        labels = settings.get(key)
        extras += len(labels) if isinstance(labels, list) else 0
    if not isinstance(contacts, list) or len(one.state) != len(contacts) or set(one.state) - {"0", "1"}:
        raise ValueError(f"contact state {one.state[:MAX_LETTERS]!r}")
    if max(one.gated, default=-1) >= extras or (one.unloaded and one.samples):
        raise ValueError("readings in the air of a sensor that is none")
    if not one.independent_rows <= one.rows or (one.rows and not one.independent_rows):
        raise ValueError(f"{one.independent_rows:g} independent of {one.rows} rows")
    triangles = {supports[k]: stream.triangle(len(supports[k]) + 1, rows, packed) for k, rows, packed in one.triangles}
    if len(triangles) != len(one.triangles):
        raise ValueError("the same columns twice")
    factor = TriangularFactor.from_blocks(columns, one.rows, one.independent_rows, triangles)
    state = tuple(digit == "1" for digit in one.state)
    return Part(source, state, factor, one.samples, unloaded=one.unloaded, gated=set(one.gated))


def _support(columns: list[int], count: int) -> tuple[int, ...]:
    if len(set(columns)) != len(columns) or max(columns, default=0) >= count:
        raise ValueError(f"columns that are not among {count}")
    return tuple(columns)


class _Stream:
    """The numbers of all triangles, one after the other."""

    def __init__(self, values: Array) -> None:
        self._values, self._taken = values, 0

    @property
    def left(self) -> int:
        """How many are left."""
        return len(self._values) - self._taken

    def triangle(self, width: int, rows: int, packed: bool) -> torch.Tensor:
        """The next triangle, or rows too few to make one, (rows, width); ValueError if there are not enough."""
        if rows > width or (packed and rows != width):
            raise ValueError(f"{rows} rows of {width} numbers")
        size = width * (width + 1) // 2 if packed else rows * width
        if size > self.left:
            raise ValueError("fewer numbers than are described")
        values = self._values[self._taken : self._taken + size]
        self._taken += size
        if not packed:
            return torch.from_numpy(values.reshape(rows, width).copy())
        triangle = np.zeros((width, width))
        triangle[np.triu_indices(width)] = values
        return torch.from_numpy(triangle)
