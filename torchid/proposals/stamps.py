"""Which columns or arrays of a file are its stamps, and which of several are those of what else it holds."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import excerpt
from torchid.logs.alignment import own_stamps
from torchid.logs.name_matching import propose_field
from torchid.proposals.column_groups import Family
from torchid.proposals.file_samples import FileSample, counts, increases, side_by_side

_SECONDS = r"secs?|seconds"
_FRACTIONS = {
    "nanoseconds": r"nano_?secs?|nsecs?|nano_?seconds|nanos|ns",
    "microseconds": r"micro_?secs?|usecs?|micro_?seconds|micros|us",
}


def split_stamps(columns: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Columns of whole seconds, with key and column of the rest beside them: `stamp.sec` and `stamp.nanosec`."""
    before = r"(.*?)(?:(?<![A-Za-z])|(?<=[a-z])(?=[A-Z]))"
    seconds, *rest = (
        {found[1]: x for x in columns if (found := re.fullmatch(f"{before}(?i:{words})", x))}
        for words in (_SECONDS, *_FRACTIONS.values())
    )
    pairs = ((key, of) for key, of in zip(_FRACTIONS, rest, strict=True))
    return {seconds[stem]: (key, column) for key, of in pairs for stem, column in of.items() if stem in seconds}


def first_of_stamps(families: Sequence[Family], sample: FileSample, notes: dict[str, str]) -> list[Family]:
    """The first of stamps of several limbs, with a note where others differ; else the families as they are."""
    columns = [column for one in families for column in one.columns]
    values = side_by_side(sample, columns) if len(columns) > 1 else np.empty(0)
    if values.ndim != 2:
        return list(families)
    if apart := float(np.ptp(values, axis=1).max()):
        notes["time"] = f"of '{excerpt(columns[0])}', from which others differ by up to {apart:.2g}"
    return [Family(columns[0], columns[:1], ("",), (), ("",))]


def stamps_first(
    families: Sequence[Family],
    sample: FileSample,
    position: Mapping[str, Any],
    fractions: Mapping[str, object],
    fastest: bool,
) -> list[Family]:
    """Families of stamps, those that increase first, numbers of samples last, of others those beside positions.

    Args:
        families: of one column each.
        sample: of the file.
        position: entry of the positions of joints, empty where there is none.
        fractions: seconds that have a rest beside them.
        fastest: whether those with most samples come first, as others are interpolated.
    """
    beside = next(iter(position.get("columns", {}).values()), "") or position.get("column", "joint_position")

    def rank(family: Family) -> tuple[bool, bool, int, int]:
        first = family.columns[0]
        values = sample[first]
        forwards = first in fractions or increases(values)
        many = 0 if values is None or not fastest else values.size
        return not forwards, counts(values), -many, -len(os.path.commonprefix([first, beside]))

    return sorted(families, key=rank)


def has_stamps_of(family: Family, known: Collection[str], clocks: Sequence[Collection[str]]) -> bool:
    """Whether stamps are those of any columns in use; of a file where all have the same they are.

    Args:
        family: of stamps.
        known: columns in use.
        clocks: arrays with each of several stamps.
    """
    return not clocks or any(family.columns[0] in of and any(name in of for name in known) for of in clocks)


def arrays_by_stamps(sample: FileSample) -> list[set[str]]:
    """Names of arrays with each of several stamps that a file has, these among them; none where all have the same.

    Stamps are others where there are more or fewer of them, or where they lie in another group and differ.
    """
    stamps = dict[str, NDArray[Any]]()
    for name, x in sample.items():
        is_stamps = x is not None and x.dtype.kind in "fiu" and propose_field(name) == "time" and increases(x)
        if x is not None and is_stamps and all(_are_others(name, x, other, y) for other, y in stamps.items()):
            stamps[name] = x
    out = {name: {name} for name in stamps}
    for name, x in sample.items() if len(stamps) > 1 else ():
        if name not in stamps:
            out[own_stamps(x if x is not None and x.ndim else None, name, stamps)].add(name)
    return list(out.values()) if len(out) > 1 else []


def _are_others(name: str, stamps: NDArray[Any], of: str, others: NDArray[Any]) -> bool:
    if len(stamps) != len(others):
        return True
    return os.path.dirname(name) != os.path.dirname(of) and not np.array_equal(stamps, others)
