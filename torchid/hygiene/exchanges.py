"""Orders in which the columns of a log may stand instead of the one that its names say."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

#: Parts of names that tell the sides, and the ends, of a robot apart.
_SIDES = ("left right", "Left Right", "LEFT RIGHT", "l r", "L R", "FL FR", "RL RR", "HL HR", "LF RF", "LH RH")
_ENDS = ("front rear", "front hind", "front back", "fore hind", "Front Rear", "FL RL", "FR RR", "LF LH", "RF RH")
_PARTS = re.compile(r"([A-Za-z0-9]+)")
#: Joints of a chain up to which single neighbours are tried.
_SHORT = 12


def exchanges(names: Sequence[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Other names that the columns may truly have, with what was mixed up: sides, ends, or the alphabet."""
    seen = {tuple(names)}
    for what, pairs in (("left and right", _SIDES), ("front and rear", _ENDS)):
        other = _exchanged(names, pairs)
        if other is not None and other not in seen:
            seen.add(other)
            yield what, other
    for what, other in (("alphabetical order and this", tuple(sorted(names))), ("the order", tuple(names[::-1]))):
        if other not in seen and len(names) > 1:
            seen.add(other)
            yield what, other


def neighbours(names: Sequence[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Names with two that follow each other in a short chain exchanged."""
    for i in range(len(names) - 1 if len(names) <= _SHORT else 0):
        yield f"{names[i]} and {names[i + 1]}", (*names[:i], names[i + 1], names[i], *names[i + 2 :])


def _exchanged(names: Sequence[str], pairs: Sequence[str]) -> tuple[str, ...] | None:
    """Every name with its part exchanged for the other; None unless these are the same names again."""
    for some in (pairs, *([pair] for pair in pairs)):  # all together, or where two share a part, each alone
        other = {one: two for pair in some for one, two in (pair.split(), pair.split()[::-1])}
        found = tuple("".join(other.get(part, part) for part in _PARTS.split(name)) for name in names)
        if sorted(found) == sorted(names) and found != tuple(names):
            return found
    return _by_first_letter(names) if pairs is _SIDES else None


def _by_first_letter(names: Sequence[str]) -> tuple[str, ...] | None:
    """As in LAnkle and RAnkle, or lfoot and rfoot."""
    swap = {"L": "R", "R": "L", "l": "r", "r": "l"}
    found = tuple(
        other if name[:1] in swap and (other := swap[name[0]] + name[1:]) in names else name for name in names
    )
    return found if found != tuple(names) else None
