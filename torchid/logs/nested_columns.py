"""Columns inside columns of Parquet files: `state.q` of a structure, `q[0]`, `q[1]`, ... of a column of lists.

pyarrow is passed in by `torchid.logs.tables`, the only module that imports it.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Iterator
from typing import Any

import numpy as np

from torchid.errors import LogError
from torchid.guards import MAX_LIST

_OF_NUMBERS = re.compile(r"\.(list|bag|array)\.(element|item|array_element|array)$")


class NestedColumns:
    """Single columns of numbers that a Parquet file has.

    Attributes:
        types: by name of the column, in the order of the file; that of the lists for lists of different lengths.
    """

    def __init__(self, pa: Any, file: Any) -> None:
        """Of an opened `pyarrow.parquet.ParquetFile`."""
        self._pa, self._lengths = pa, _list_lengths(file.metadata)
        self._lists = dict[str, int]()  # numbers in each row, by name of a column of lists
        self._list_of = dict[str, str]()  # by name of a column of numbers
        pairs = [pair for field in file.schema_arrow for pair in self._leaves(field)]
        self.names = [name for name, _ in pairs]
        self.types = dict(pairs)

    def _leaves(self, field: Any, outer: str = "") -> Iterator[tuple[str, Any]]:
        name = f"{outer}{field.name}"
        if self._pa.types.is_struct(field.type):
            for inner in field.type:
                yield from self._leaves(inner, f"{name}.")
        elif length := self._length(name, field.type):
            self._lists[name] = length
            for number in range(length):
                self._list_of[f"{name}[{number}]"] = name
                yield f"{name}[{number}]", field.type.value_type
        else:
            yield name, field.type

    def _length(self, name: str, type_: Any) -> int:
        """How many numbers each row of a column of lists has; 0 for other columns, and for lists of one."""
        types = self._pa.types
        is_fixed = types.is_fixed_size_list(type_)
        if not is_fixed and not types.is_list(type_) and not types.is_large_list(type_):
            return 0
        length = type_.list_size if is_fixed else self._lengths.get(name, 0)
        return length if 1 < length <= MAX_LIST and types.is_primitive(type_.value_type) else 0

    def in_file(self, names: Collection[str]) -> list[str]:
        """The columns of the file that some columns are in."""
        return list(dict.fromkeys(self._list_of.get(name, name) for name in names))

    def flat(self, batch: Any) -> Any:
        """A batch with the columns inside of others in the place of these; LogError for lists of several lengths."""
        types = self._pa.types
        if not any(types.is_nested(field.type) for field in batch.schema):
            return batch
        table = self._pa.Table.from_batches([batch])
        while any(types.is_struct(field.type) for field in table.schema):
            table = table.flatten()
        out = dict[str, Any]()
        for name, column in zip(table.column_names, table.columns, strict=True):
            if name in self._lists:
                numbers = self._numbers(name, column.combine_chunks())
                out |= {f"{name}[{k}]": self._pa.array(np.ascontiguousarray(x)) for k, x in enumerate(numbers.T)}
            else:
                out[name] = column
        return self._pa.table(out).combine_chunks().to_batches()[0]

    def _numbers(self, name: str, lists: Any) -> Any:
        """Numbers (N, k) of a column of lists, NaN where there is no list."""
        length = self._lists[name]
        is_fixed = self._pa.types.is_fixed_size_list(lists.type)
        of_lists = np.full(0, length) if is_fixed else np.asarray(lists.value_lengths().drop_null())
        if (others := of_lists[of_lists != length]).size:
            found = f"lists of {length} and of {others[0]} numbers"
            raise LogError.at_field(f"column '{name}'", found, "lists of one length")
        numbers = lists.flatten().to_numpy(zero_copy_only=False).reshape(-1, length)
        if not lists.null_count:
            return numbers
        out = np.full((len(lists), length), np.nan)
        out[np.asarray(lists.is_valid())] = numbers
        return out


def _list_lengths(metadata: Any) -> dict[str, int]:
    """Numbers in each row of columns of lists, by what a file declares: of those with as many in all rows."""
    counts = defaultdict[str, int](int)
    for group in map(metadata.row_group, range(metadata.num_row_groups)):
        for chunk in map(group.column, range(group.num_columns)):
            counts[chunk.path_in_schema] += chunk.num_values
    rows = metadata.num_rows
    return {_OF_NUMBERS.sub("", name): n // rows for name, n in counts.items() if rows and n % rows == 0}
