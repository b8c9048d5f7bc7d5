"""Parts of compressed logs as documents of JSON and an array of numbers, as files and the cache hold them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from pydantic.dataclasses import dataclass

from torchid.guards import MAX_LETTERS
from torchid.parameters import Array
from torchid.problem import TriangularFactor
from torchid.problem.compression import Part
from torchid.settings import STRICT, NotNegative

Whole = Annotated[int, Field(ge=0, le=2**53)]


@dataclass(config=STRICT, frozen=True)
class PackedPart:
    """A part but for the numbers of its triangles, as documents of JSON have it.

    `state`: a digit for each contact; `triangles`: number of the support, rows, whether packed as a triangle;
    `noise_gram`: numbers of the supports.
    """

    state: str
    samples: Whole
    rows: Whole
    independent_rows: NotNegative
    gated: list[Whole]
    triangles: list[tuple[Whole, Whole, bool]]
    noise_gram: Annotated[list[Whole], Field(alias="surplus")]  # as files of this format call it


class PartPacker:
    """Takes parts apart, one after the other."""

    def __init__(self) -> None:
        self._supports, self._values = dict[tuple[int, ...], int](), list[Array]()

    @property
    def supports(self) -> list[tuple[int, ...]]:
        """Columns of the blocks so far, which triangles name by number."""
        return list(self._supports)

    @property
    def values(self) -> Array:
        """The numbers of all triangles so far."""
        return np.concatenate([np.empty(0), *self._values])

    def pack(self, parts: Sequence[Part]) -> list[dict[str, object]]:
        """The documents of further parts, each as `PackedPart` reads it; their names and folds are not in them."""
        out: list[dict[str, object]] = []
        for part in parts:
            triangles = []
            for support, block in part.factor.blocks.items():
                rows = block.cpu().numpy()
                packed = len(rows) == rows.shape[1] and not np.tril(rows, -1).any()
                self._values.append(rows[np.triu_indices(len(rows))] if packed else rows.ravel())
                triangles.append((self._number(support), len(rows), packed))
            for x in part.factor.noise_gram.values():
                self._values.append(x.cpu().numpy()[np.triu_indices(len(x))])
            out.append(
                {
                    "state": "".join("01"[active] for active in part.state),
                    "samples": part.samples,
                    "rows": part.factor.rows,
                    "independent_rows": part.factor.independent_rows,
                    "gated": sorted(part.gated),
                    "triangles": triangles,
                    "surplus": [self._number(support) for support in part.factor.noise_gram],
                }
            )
        return out

    def _number(self, support: tuple[int, ...]) -> int:
        return self._supports.setdefault(support, len(self._supports))


class PartReader:
    """Parts of a log, read one after the other; ValueError where one cannot be that of a log."""

    def __init__(
        self,
        values: Array,
        supports: Sequence[Sequence[int]],
        columns: int,
        contacts: int,
        extras: int,
        most: float = math.inf,
    ) -> None:
        """Nothing is read yet.

        Args:
            values: numbers of all triangles.
            supports: columns of blocks, that triangles name by number.
            columns: how many the problem has.
            contacts: how many there are.
            extras: how many extra parameters there are.
            most: triangles.
        """
        self._columns, self._contacts, self._extras, self._most = columns, contacts, extras, most
        self._supports = [_support(one, columns) for one in supports]
        self._stream, self._triangles = _Stream(values), 0

    @property
    def numbers_left(self) -> int:
        """Numbers that belong to no part so far."""
        return self._stream.left

    def read(self, source: str, one: PackedPart, unloaded: bool = False) -> Part:
        """The next part, of a log of this name."""
        self._triangles += 1 + len(one.triangles) + len(one.noise_gram)
        if self._triangles > self._most:
            raise ValueError(f"more than {self._most} triangles")
        if len(one.state) != self._contacts or set(one.state) - {"0", "1"}:
            raise ValueError(f"contact state {one.state[:MAX_LETTERS]!r}")
        if max(one.gated, default=-1) >= self._extras or (unloaded and one.samples):
            raise ValueError("readings in the air of a sensor that is none")
        if not one.independent_rows <= one.rows or (one.rows and not one.independent_rows):
            raise ValueError(f"{one.independent_rows:g} independent of {one.rows} rows")
        triangles = {}
        for number, rows, packed in one.triangles:
            support = self._supports[number]
            triangles[support] = self._stream.triangle(len(support) + 1, rows, packed)
        noise_gram = {}
        for number in one.noise_gram:
            width = len(self._supports[number]) + 1
            half = self._stream.triangle(width, width, packed=True)
            noise_gram[self._supports[number]] = half + half.triu(1).T
        if len(triangles) != len(one.triangles) or len(noise_gram) != len(one.noise_gram):
            raise ValueError("the same columns twice")
        factor = TriangularFactor.from_blocks(self._columns, one.rows, one.independent_rows, triangles, noise_gram)
        state = tuple(digit == "1" for digit in one.state)
        return Part(source, state, factor, one.samples, unloaded=unloaded, gated=set(one.gated))


def _support(columns: Sequence[int], count: int) -> tuple[int, ...]:
    if len(set(columns)) != len(columns) or max(columns, default=0) >= count:
        raise ValueError(f"columns that are not among {count}")
    return tuple(columns)


class _Stream:
    """The numbers of all triangles, one after the other."""

    def __init__(self, values: Array) -> None:
        self._values, self._taken = values, 0

    @property
    def left(self) -> int:
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
