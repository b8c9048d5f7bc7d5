"""Blocks of rows in the inertial and friction parameters, tile by tile: no wrench column leaves the cache."""

from __future__ import annotations

import numpy as np

from torchid.kernels.states import DIRECTION, SCREW, STATE, VELOCITY, power
from torchid.kernels.tiles import (
    ARRAY,
    INDEX,
    TABLE,
    TILE,
    Index,
    accumulate,
    add,
    compiled,
    dot,
    load,
    multiply,
    store,
    times,
)
from torchid.kernels.wrenches import FUNCTIONS, INERTIA, WRENCH, write_wrenches
from torchid.parameters import Array


@compiled()
def _start_block(
    block: Index,
    W: Array,
    rank: int,
    forces: Array,
    samples: int,
    start: int,
    size: int,
    most: int,
    sums: Array,
    rows: Array,
) -> None:
    """Write the path sum of the base, and the right-hand side."""
    first, count, width, offset, of_base, dof, end = block[:7]
    for row in range(count):
        if of_base:
            for k in range(6):
                at, to = (k * rank + first + row) * TILE, ((of_base * most + row) * 6 + k) * TILE
                sums[to : to + TILE] = W[at : at + TILE]
        at = offset + (width - 1) * (width + count * samples) + width + row * samples + start
        out = rows[at : at + size]
        out[:] = 0.0
        for k in range(dof, end):
            at = (k * rank + first + row) * TILE
            accumulate(W[at : at + TILE], forces[k * samples + start : k * samples + start + size], out)


@compiled()
def _add_screw(ratio: float, w: Array, screw: Array, above: Array, out: Array) -> None:
    """Write a path sum: that of the node above, and a multiple of this node's screw axis."""
    for t in range(TILE):
        x = ratio * w[t]
        store(out, 0, t, add(load(above, 0, t), times(x, load(screw, 0, t))))
        store(out, 3, t, add(load(above, 3, t), times(x, load(screw, 3, t))))


@compiled()
def _write_powers(wrench: Array, sums: Array, count: int, rows: Array, at: int, step: int, size: int) -> None:
    for row in range(count):
        path_sum = sums[row * WRENCH : (row + 1) * WRENCH]
        out = rows[at + row * step : at + row * step + size]
        for t in range(size):
            out[t] = power(wrench, path_sum, t)


@compiled()
def _write_powers_of_moments(
    wrench: Array, sums: Array, count: int, rows: Array, at: int, step: int, size: int
) -> None:
    moment = wrench[3 * TILE :]
    for row in range(count):
        path_sum = sums[row * WRENCH + 3 * TILE : (row + 1) * WRENCH]
        out = rows[at + row * step : at + row * step + size]
        for t in range(size):
            out[t] = dot(load(moment, 0, t), load(path_sum, 0, t))


@compiled()
def _write_columns(
    block: Index, column: int, parameters: Index, wrenches: Array, sums: Array, samples: int, start: int, rows: Array
) -> None:
    """Write a body's columns: its wrenches times the path sum of each row."""
    count, width, offset = block[1:4]
    size = min(TILE, samples - start)
    for number in range(len(parameters)):
        wrench = wrenches[number * WRENCH : (number + 1) * WRENCH]
        at = offset + (column + number) * (width + count * samples) + width + start
        if parameters[number] < INERTIA:
            _write_powers(wrench, sums, count, rows, at, samples, size)
        else:
            _write_powers_of_moments(wrench, sums, count, rows, at, samples, size)


@compiled()
def _write_moved(
    states: Array,
    joints: Array,
    nodes: int,
    samples: int,
    start: int,
    W: Array,
    rank: int,
    most: int,
    blocks: Index,
    moved: Index,
    ratios: Array,
    sums: Array,
    rows: Array,
) -> None:
    """Write the path sums of the nodes that blocks move, and their columns of friction."""
    padded, size = len(joints) // (6 * nodes), min(TILE, samples - start)
    for number in range(len(moved)):
        block, node, dof, path_sum, above, column = moved[number]
        first, count, width, offset = blocks[block, :4]
        long, at = width + count * samples, node * padded + start
        screw = states[(node * STATE + SCREW) * TILE : (node + 1) * STATE * TILE]
        direction = joints[DIRECTION * nodes * padded + at : DIRECTION * nodes * padded + at + size]
        velocity = joints[VELOCITY * nodes * padded + at : VELOCITY * nodes * padded + at + size]
        for row in range(count):
            at = (dof * rank + first + row) * TILE
            w, at = W[at : at + TILE], (above * most + row) * WRENCH
            upper, at = sums[at : at + WRENCH], (path_sum * most + row) * WRENCH
            _add_screw(ratios[number], w, screw, upper, sums[at : at + WRENCH])
            at = offset + column * long + width + row * samples + start
            multiply(ratios[number], w, direction, rows[at : at + size])
            multiply(ratios[number], w, velocity, rows[at + long : at + long + size])


@compiled()
def _write_bodies(
    states: Array,
    samples: int,
    start: int,
    most: int,
    blocks: Index,
    bodies: Index,
    kept: Index,
    sums: Array,
    functions: Array,
    wrenches: Array,
    rows: Array,
) -> None:
    """Write the columns of the bodies' inertial parameters."""
    known = -1
    for number in range(len(bodies)):
        node, block, path_sum, column, first, count = bodies[number]
        parameters, at = kept[first : first + count], path_sum * most * WRENCH
        if node != known:
            known = node
            write_wrenches(states[node * STATE * TILE : (node + 1) * STATE * TILE], parameters, functions, wrenches)
        own = sums[at : at + most * WRENCH]
        _write_columns(blocks[block], column, parameters, wrenches, own, samples, start, rows)


@compiled(ARRAY, ARRAY, "int64", "int64", ARRAY, "int64", "int64", ARRAY, TABLE, TABLE, ARRAY, TABLE, INDEX, ARRAY)
def write_rows(
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
    rows: Array,
) -> None:
    """Write blocks of rows, their right-hand sides included.

    Args:
        states: of `write_states`.
        joints: as there.
        nodes: L.
        samples: B, of which the last tile may be only partly.
        bases: tiles (degrees of freedom, rank, TILE) of W, a `step` apart, which is 0 if one serves for all.
        rank: rows of all blocks at a sample.
        step: see `bases`.
        forces: (degrees of freedom, B), measured.
        blocks: (blocks, 8) each: the first of its rows in W, their number, columns with the right-hand side, where it
            starts in `rows`, path sum of the base, 0 without, first and last degree of freedom of its right-hand side,
            number of path sums of all blocks.
        moved: (nodes that blocks move, 6): block, node, its degree of freedom in W, path sum, that of the node
            above (0 for none), and its first friction column.
        ratios: of their motion.
        bodies: (bodies that blocks depend on, 6), ascending: node, block, path sum, first column, and the first of
            its parameters in `kept` and their number; those with most of a node first.
        kept: numbers of inertial parameters.
        rows: each block (columns, columns + rows B) as in `torchid.problem.rows.BlockRows`, one after the other.
    """
    padded, most = len(joints) // (6 * nodes), 0
    for block in range(len(blocks)):
        most = max(most, blocks[block, 1])
    sums = np.zeros(blocks[0, 7] * most * WRENCH)
    functions, wrenches = np.zeros(FUNCTIONS * TILE), np.zeros(10 * WRENCH)
    for tile in range(padded // TILE):
        start = tile * TILE
        size = min(TILE, samples - start)
        own = states[tile * nodes * STATE * TILE : (tile + 1) * nodes * STATE * TILE]
        W = bases[tile * step :]
        for block in range(len(blocks)):
            _start_block(blocks[block], W, rank, forces, samples, start, size, most, sums, rows)
        _write_moved(own, joints, nodes, samples, start, W, rank, most, blocks, moved, ratios, sums, rows)
        _write_bodies(own, samples, start, most, blocks, bodies, kept, sums, functions, wrenches, rows)
