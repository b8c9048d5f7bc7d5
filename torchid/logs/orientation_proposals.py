"""How the base is turned, by what recordings call its quaternion or its angles, and by their numbers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.logs.column_proposals import is_desired
from torchid.logs.column_samples import Columns
from torchid.logs.units import quantities_with, split_unit

_NAMES = ("roll", "pitch", "yaw")
_ANGLE = re.compile(r"(?<![a-z])(roll|pitch|yaw)(?![a-z])", re.IGNORECASE)
_TRIPLE = re.compile(r"(?<![a-z])(rpy|euler\w*?)(?![a-z])", re.IGNORECASE)
#: Words beside these in names of what turns the base, rather than a joint or a rate.
_OF_BASE = re.compile(
    r"(base|root|trunk|torso|pelvis|body|floating|mocap|odom|odometry|imu|ahrs|euler|rpy|orientation|attitude|angles?|"
    r"state|states|data|pose|world|robot|est|estimated?|meas|measured|link|sensor|rotation|rot|value|x|y|z)"
)
_SPLIT = re.compile(r"[^A-Za-z]+|(?<=[a-z])(?=[A-Z])")
_LARGEST = 6.5  # [rad]: of no angle within a turn


def order_of_quaternion(arrays: Sequence[NDArray[Any]]) -> str:
    """Order of a quaternion's components, as columns or as an array: w is the largest of a base that stands upright."""
    flat = np.concatenate([np.atleast_2d(x).T if x.ndim == 1 else x for x in arrays], axis=1)
    return "xyzw" if np.nansum(np.abs(flat[:, 3])) > np.nansum(np.abs(flat[:, 0])) else "wxyz"


@dataclass(frozen=True)
class Angles:
    """Columns of angles of the base.

    Attributes:
        entry: of a map.
        columns: that it has.
        note: what was guessed.
    """

    entry: dict[str, Any]
    columns: list[str]
    note: str


def find_angles(sample: Columns, names: Sequence[str]) -> Angles | None:
    """Roll, pitch and yaw of the base, as three columns or as an array (N, 3); None where no names say so.

    Args:
        sample: from `read_sample`.
        names: of columns that may be.
    """
    known = {name: x for name in names if (x := sample[name]) is not None and not is_desired(name)}
    arrays = [[name] for name, x in known.items() if _TRIPLE.search(name) and x.shape[1:] == (len(_NAMES),)]
    for columns in (*_triples(list(known)), *arrays):
        stem, unit = split_unit(columns[0])
        of_angle = not unit or "angle" in quantities_with(unit)
        if of_angle and all(_OF_BASE.fullmatch(word) for word in _words(_ANGLE.sub("", _TRIPLE.sub("", stem)))):
            return _angles({name: known[name] for name in columns}, unit)
    return None


def _triples(names: Sequence[str]) -> list[list[str]]:
    """Three columns each that differ in the name of an angle, or in an axis or a number behind `rpy` or `euler`."""
    by_stem: dict[str, dict[str, str]] = {}
    for name in names:
        if (found := _ANGLE.search(name)) is not None:
            by_stem.setdefault(_ANGLE.sub("*", name, count=1), {})[found[1].lower()] = name
    out = [[of[one] for one in _NAMES] for of in by_stem.values() if set(of) == set(_NAMES)]
    behind: dict[str, list[str]] = {}
    for name in names:
        if _TRIPLE.search(name) and (found := re.search(r"[xyz\d](?=\W*$)", split_unit(name)[0])) is not None:
            behind.setdefault(name[: found.start()], []).append(name)
    return out + [sorted(of) for of in behind.values() if len(of) == len(_NAMES) and _in_turn(sorted(of))]


def _in_turn(names: Sequence[str]) -> bool:
    """Whether names of one length differ in characters that follow one another."""
    if len({len(name) for name in names}) > 1:
        return False
    changed = [[(a, b) for a, b in zip(*pair, strict=True) if a != b] for pair in pairwise(names)]
    return all(len(of) == 1 and ord(of[0][1]) == ord(of[0][0]) + 1 for of in changed)


def _words(text: str) -> list[str]:
    return [word.lower() for word in _SPLIT.split(text) if word]


def _angles(values: Mapping[str, NDArray[Any]], unit: str) -> Angles:
    columns = list(values)
    one = len(columns) == 1
    entry: dict[str, Any] = {"column": columns[0]} if one else {"columns": dict(zip(_NAMES, columns, strict=True))}
    note = "angles of the base about the world's x, then y, then z, as in a URDF"
    if unit:
        entry["unit"] = unit
    elif (largest := float(np.nanmax([np.nanmax(np.abs(x), initial=0.0) for x in values.values()]))) > _LARGEST:
        entry["unit"] = "deg"
        note += f"; deg, from values up to {largest:.3g}"
    else:
        note += f"; rad, as none exceeds {_LARGEST}"
    return Angles(entry, columns, note)
