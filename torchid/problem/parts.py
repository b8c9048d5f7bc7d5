"""Parts of a compressed log: the rows of a contact state, a fold and a block, and what several are together."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

from torchid.parallel import one_thread
from torchid.problem.contact_state import ContactState
from torchid.problem.linear import TriangularFactor
from torchid.problem.rows import RowBuilder
from torchid.reprs import short_repr

PartKey = tuple[str, ContactState, int, int, bool]  # source, state, fold, block, unloaded


@dataclass
class Part:
    """Compressed rows of one log (named by `source`) in one contact state, one fold and one block of it.

    Equations of unloaded contact sensors are in parts of their own, `unloaded`, which count no samples. `masked`:
    indices of extras that are offsets without such an equation, because their readings in the air are masked.
    """

    source: str
    state: ContactState
    factor: TriangularFactor
    samples: int
    fold: int = 0
    block: int = 0
    unloaded: bool = False
    masked: set[int] = field(default_factory=set)

    __repr__ = short_repr

    @property
    def key(self) -> PartKey:
        """Which rows it has."""
        return self.source, self.state, self.fold, self.block, self.unloaded


@one_thread()
def merge_parts(of_workers: Iterable[list[Part]]) -> list[Part]:
    """The parts of all workers, those of one log, contact state and fold merged, on the CPU."""
    total: dict[PartKey, list[Part]] = {}
    for part in chain.from_iterable(of_workers):
        part.factor = part.factor.to_cpu()
        total.setdefault(part.key, []).append(part)
    for first, *others in total.values():
        first.samples += sum(part.samples for part in others)
        first.masked = first.masked.union(*(part.masked for part in others))
        first.factor.merge(*(part.factor for part in others))
    return [first for first, *_ in total.values()]


@one_thread()
def merge_factors(factors: Iterable[TriangularFactor], builder: RowBuilder) -> TriangularFactor:
    """One factor of the rows of several."""
    out = TriangularFactor(builder.width)
    out.merge(*factors)
    return out


def merge_states(parts: Sequence[Part], builder: RowBuilder) -> list[Part]:
    """Parts with the contact states of each log and fold merged; offset equations of unloaded sensors stay apart."""
    return merge_by_key(parts, [(part.source, part.fold, part.unloaded) for part in parts], builder)


def merge_folds(parts: Sequence[Part], builder: RowBuilder) -> list[Part]:
    """Parts with the folds of each log and contact state merged; offset equations of unloaded sensors stay apart."""
    return merge_by_key(parts, [(part.source, part.state, part.unloaded) for part in parts], builder)


def merge_blocks_of_folds(parts: Sequence[Part], builder: RowBuilder) -> list[Part]:
    """Parts with the blocks of each log, contact state and fold merged."""
    if not any(part.block for part in parts):
        return list(parts)
    keys = [(part.source, part.state, part.fold, part.unloaded) for part in parts]
    return [replace(part, block=0) for part in merge_by_key(parts, keys, builder)]


@one_thread()
def merge_by_key(parts: Sequence[Part], keys: Sequence[tuple[object, ...]], builder: RowBuilder) -> list[Part]:
    """One part for each key, with whatever else of the first; the factors of the parts stay as they are."""
    alike: dict[tuple[object, ...], list[Part]] = {}
    for part, key in zip(parts, keys, strict=True):
        alike.setdefault(key, []).append(part)
    out = []
    for own in alike.values():
        factor, masked = merge_factors((part.factor for part in own), builder), set().union(*(x.masked for x in own))
        out.append(replace(own[0], factor=factor, samples=sum(part.samples for part in own), masked=masked))
    return out
