"""Chance for files that are grown by rules: numbers, words and trees, the same for the same seed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")
Grow = Callable[["Chance", Path], Path]

#: Characters that move a cursor, turn a line around, hide, mean something to a shell, to markup or to a formula.
LETTERS = "ab_.-/ :$%{}[]()'\"\\*&?#~^<>|;=,+@!é世🦿\t\n\r\0\x1b\x07\x7f\x85\u200b\u200f\u202e\u2066\ufeff\u2028"
NUMBERS = ("0", "-0.0", "1e309", "-1e309", "nan", "NaN", "inf", "+1.5", ".5", "5.", "1e-320", "0x1F", "1_0", "٣", "1,5", "", " 1 ",
           "1e", "--1", "1" * 400, "0." + "3" * 300, "true", "None", "1/2", "1e5", "-7")  # fmt: skip


class Chance:
    """What happens next."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def __call__(self, share: float) -> bool:
        """Whether something of a probability happens."""
        return bool(self.rng.random() < share)

    def of(self, choices: Sequence[T]) -> T:
        """One of several."""
        return choices[int(self.rng.integers(len(choices)))]

    def below(self, end: int) -> int:
        """A whole number from 0, small ones more often."""
        return int(end ** self.rng.random()) - 1 if end > 1 else 0

    def bytes(self, count: int) -> bytes:
        """Any bytes."""
        return self.rng.integers(0, 256, count, dtype=np.uint8).tobytes()

    def word(self, most: int = 12) -> str:
        """A word of letters that are hard to show."""
        return "".join(self.of(LETTERS) for _ in range(1 + self.below(most)))

    def name(self, usual: Sequence[str]) -> str:
        """A usual name, or now and then another."""
        return self.of(usual) if self(0.9) else self.word()

    def number(self) -> str:
        """A number as text, or what looks like one."""
        return f"{self.rng.standard_normal() * 10.0 ** self.rng.integers(-3, 4):.6g}" if self(0.7) else self.of(NUMBERS)

    def array(self, shape: tuple[int, ...], kind: str) -> np.ndarray:
        """Numbers of a type, now and then with some that are none."""
        values = self.rng.standard_normal(shape) * 10.0 ** self.rng.integers(-2, 6)
        if self(0.05) and values.size:
            values.reshape(-1)[self.below(values.size)] = self.of([np.nan, np.inf, -np.inf, 1e300, -1e31])
        with np.errstate(all="ignore"):
            return values.astype(kind)

    def spliced(self, one: bytes, other: bytes) -> bytes:
        """The beginning of one file with the end of another, or a part of one in the other."""
        a, b = sorted(int(x) for x in self.rng.integers(0, len(one) + 1, 2))
        c, d = sorted(int(x) for x in self.rng.integers(0, len(other) + 1, 2))
        return self.of(
            [one[:a] + other[c:], one[:a] + other[c:d] + one[b:], one[:a] + one[b:], one[:b] + other[c:d] + one[a:]]
        )


def grown(folder: Path, grow: Grow, count: int, seed: int) -> Iterator[tuple[str, Path]]:
    """So many files, each from a seed of its own."""
    for number in range(count):
        path = grow(Chance(seed + number), folder)
        yield f"{path.name!r} {seed + number}"[:120], path
        if path.is_file() and not path.is_symlink():
            path.unlink()


def tree(chance: Chance, depth: int, leaf: Callable[[], Any]) -> Any:
    """Lists and mappings in one another."""
    if depth <= 0 or chance(0.4):
        return leaf()
    if chance(0.5):
        return [tree(chance, depth - 1, leaf) for _ in range(chance.below(5))]
    return {chance.word(6): tree(chance, depth - 1, leaf) for _ in range(chance.below(5))}
