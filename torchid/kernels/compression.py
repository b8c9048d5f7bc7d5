"""Gram matrices of blocks of rows that stay in a processor's caches: written for some tiles, multiplied, forgotten."""

from __future__ import annotations

from torchid.kernels.gram import add_gram, mirror
from torchid.kernels.rows import path_sums, write_span
from torchid.kernels.tiles import ARRAY, INDEX, TABLE, TILE, Index, compiled
from torchid.parameters import Array

SPAN = 4 * TILE
"""Samples whose rows are multiplied at once: they fill a few MB for a humanoid, and memory is not waited for."""


@compiled(
    *(ARRAY, ARRAY, "int64", "int64", ARRAY, "int64", "int64", ARRAY, TABLE, TABLE, ARRAY, TABLE, INDEX),
    *(TABLE, INDEX, ARRAY, ARRAY, ARRAY, ARRAY),
)
def write_grams(
    states: Array,
    joints: Array,
    nodes: int,
    samples: int,
    bases: Array,
    rank: int,
    step: int,
    forces: Array,
    blocks: Index,
    moved: Index,
    ratios: Array,
    bodies: Index,
    kept: Index,
    levels: Index,
    lower: Index,
    combination: Array,
    rows: Array,
    squares: Array,
    grams: Array,
) -> None:
    """Write what `write_gram` makes of the rows of each block that `write_rows` writes.

    Args:
        states: as of `write_rows`.
        joints: likewise.
        nodes: likewise.
        samples: likewise.
        bases: likewise.
        rank: likewise.
        step: likewise.
        forces: likewise.
        blocks: likewise, but where they start in `rows` is for as many samples as a span has.
        moved: likewise.
        ratios: likewise.
        bodies: likewise.
        kept: likewise.
        levels: (blocks, 4) each: its first column in `lower`, their number, where its combination starts, and where its
            Gram matrix.
        lower: columns of each block that are replaced.
        combination: (columns replaced, columns) of each block, by what.
        rows: memory for those of a span.
        squares: as `lower`, are written.
        grams: (columns, columns) of each block, are written.
    """
    sums = path_sums(blocks)
    squares[:], grams[:] = 0.0, 0.0
    for begin in range(0, samples, SPAN):
        end = min(begin + SPAN, samples)
        write_span(
            states,
            joints,
            nodes,
            samples,
            bases,
            rank,
            step,
            forces,
            blocks,
            moved,
            ratios,
            bodies,
            kept,
            begin,
            end,
            sums,
            rows,
        )
        for block in range(len(blocks)):
            count, n, offset = blocks[block, 1:4]
            first, k, at, to = levels[block]
            long = n + count * (end - begin)
            columns = rows[offset : offset + n * long].reshape((n, long))
            own = combination[at : at + k * n].reshape((k, n))
            gram = grams[to : to + n * n].reshape((n, n))
            add_gram(columns, n, lower[first : first + k], own, squares[first : first + k], gram)
    for block in range(len(blocks)):
        n, to = blocks[block, 2], levels[block, 3]
        mirror(grams[to : to + n * n].reshape((n, n)))
