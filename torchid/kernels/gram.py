"""Gram matrices of many rows by column, panel by panel: what is worked on stays in the second-level cache.

Of blocks of rows that are written for some tiles, multiplied and forgotten (`write_grams`), or of rows that are there.
Libraries for products of matrices are made for square ones: for a hundred columns and thousands of rows they take
1.4 to 1.7 times as long, for ten columns 1.9 to 2.7 times.
"""

from __future__ import annotations

import numpy as np

from torchid.kernels.rows import path_sums, write_span
from torchid.kernels.tiles import ARRAY, INDEX, MATRIX, TABLE, TILE, Index, Vector, compiled
from torchid.parameters import Array

SPAN = 4 * TILE
"""Samples whose rows are multiplied at once: they fill a few MB for a humanoid, and memory is not waited for."""
_PANEL = 384  # rows: of two hundred columns they fill half of a second-level cache
_LEFT, _RIGHT = 6, 2  # columns that are multiplied with each other at a time: their products stay in registers


@compiled(sums=True)
def _add_multiple(total: Vector, x: float, a: Vector) -> Vector:
    return total[0] + x * a[0], total[1] + x * a[1], total[2] + x * a[2]


@compiled(sums=True)
def _add_products(columns: Array, start: int, end: int, i: int, j: int, gram: Array) -> None:
    """Add the products of six columns with two; columns beyond the last are the last, whose products are left out."""
    last = len(gram) - 1
    a, b, c = columns[i, start:end], columns[min(i + 1, last), start:end], columns[min(i + 2, last), start:end]
    d, e = columns[min(i + 3, last), start:end], columns[min(i + 4, last), start:end]
    f = columns[min(i + 5, last), start:end]
    y, z = columns[j, start:end], columns[min(j + 1, last), start:end]
    first = second = third = fourth = (0.0, 0.0, 0.0)
    for t in range(len(a)):
        upper, lower = (a[t], b[t], c[t]), (d[t], e[t], f[t])
        first, second = _add_multiple(first, y[t], upper), _add_multiple(second, y[t], lower)
        third, fourth = _add_multiple(third, z[t], upper), _add_multiple(fourth, z[t], lower)
    for k in range(min(_LEFT, last + 1 - i)):
        gram[i + k, j] += first[k] if k < 3 else second[k - 3]
        if j < last:
            gram[i + k, j + 1] += third[k] if k < 3 else fourth[k - 3]


@compiled(sums=True)
def _square(x: Array) -> float:
    total = 0.0
    for t in range(len(x)):
        total += x[t] * x[t]
    return total


@compiled()
def _combine(columns: Array, start: int, end: int, combination: Array, out: Array) -> None:
    """Write combinations of all columns, (k, panel), four columns at a time."""
    n = len(columns)
    out[:] = 0.0
    for row in range(len(out)):
        own, factors = out[row, : end - start], np.zeros(n + 3)
        factors[:n] = combination[row]
        for i in range(0, n, 4):
            a, b = columns[i, start:end], columns[min(i + 1, n - 1), start:end]
            c, d = columns[min(i + 2, n - 1), start:end], columns[min(i + 3, n - 1), start:end]
            p, q, r, s = factors[i], factors[i + 1], factors[i + 2], factors[i + 3]
            for t in range(len(own)):
                own[t] += p * a[t] + q * b[t] + r * c[t] + s * d[t]


@compiled()
def add_gram(columns: Array, first: int, lower: Index, combination: Array, squares: Array, gram: Array) -> None:
    """As `write_gram`, but add, and to the lower half of the matrix alone."""
    n, end = columns.shape
    made = np.empty((len(lower), _PANEL))
    for start in range(first, end, _PANEL):
        stop = min(start + _PANEL, end)
        _combine(columns, start, stop, combination, made)
        for row in range(len(lower)):
            own = columns[lower[row], start:stop]
            squares[row] += _square(own)
            own[:] = made[row, : stop - start]
        for i in range(0, n, _LEFT):
            for j in range(0, min(i + _LEFT, n), _RIGHT):
                _add_products(columns, start, stop, i, j, gram)


@compiled()
def mirror(gram: Array) -> None:
    """Make a matrix symmetric that has its lower half."""
    for i in range(len(gram)):
        gram[:i, i] = gram[i, :i]


@compiled(MATRIX, "int64", INDEX, MATRIX, ARRAY, MATRIX)
def write_gram(columns: Array, first: int, lower: Index, combination: Array, squares: Array, gram: Array) -> None:
    """Replace some columns by combinations of all, and write the Gram matrix of what they are then.

    Args:
        columns: (n, first + M), the rows by column; those before the first are left alone.
        first: number of these.
        lower: (k,), columns that are replaced.
        combination: (k, n), by what.
        squares: (k,), are written: sums of squares of what these columns were.
        gram: (n, n), is written.
    """
    squares[:], gram[:] = 0.0, 0.0
    add_gram(columns, first, lower, combination, squares, gram)
    mirror(gram)


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
