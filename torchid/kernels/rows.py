"""Blocks of rows in the inertial and friction parameters, tile by tile: no wrench column leaves the cache.

Wrenches per unit of each inertial parameter are made as in `torchid.regressor.columns`.
"""

from __future__ import annotations

import numpy as np

from torchid.kernels.states import ALPHA, DIRECTION, FORCE, OMEGA, POSITION, SCREW, STATE, VELOCITY, power
from torchid.kernels.tiles import (
    ARRAY,
    INDEX,
    TABLE,
    TILE,
    Index,
    accumulate,
    add,
    compiled,
    cross,
    dot,
    load,
    multiply,
    store,
    times,
    turn,
    turn_back,
)
from torchid.parameters import Array

_INERTIA = 4  # the first parameter that demands no force
_WRENCH = 6 * TILE

# Functions of a body's motion in its own axes, of which all its unit wrenches are made: nothing, the specific force and
# its negative, the angular acceleration, products (yz, zx, xy) of angular velocities, their negatives, the sum and
# the differences of these two, differences of squares (y - z, z - x, x - y), and their negative sums
_F, _LESS_F, _A, _P, _LESS_P, _SUM, _A_P, _P_A, _DIFFER, _INWARD = range(1, 31, 3)
_FUNCTIONS = 31

_FORCES = np.array(
    [
        [_F, _F + 1, _F + 2],
        [_INWARD, _SUM + 2, _P_A + 1],
        [_P_A + 2, _INWARD + 1, _SUM],
        [_SUM + 1, _P_A, _INWARD + 2],
    ]
)
"""Components of the force per unit of the mass and of the first moments: `m a + [alpha]x h + omega x (omega x h)`."""

_MOMENTS = np.array(
    [
        [0, 0, 0],
        [0, _LESS_F + 2, _F + 1],
        [_F + 2, 0, _LESS_F],
        [_LESS_F + 1, _F, 0],
        [_A, _P + 1, _LESS_P + 2],
        [_A_P + 1, _SUM, _DIFFER + 2],
        [_SUM + 2, _DIFFER + 1, _A_P],
        [_LESS_P, _A + 1, _P + 2],
        [_DIFFER, _A_P + 2, _SUM + 1],
        [_P, _LESS_P + 1, _A + 2],
    ]
)
"""The same of the moment, and per unit of the inertias: `h x a + I alpha + omega x (I omega)`."""


@compiled()
def _write_functions(state: Array, out: Array) -> None:
    for t in range(TILE):
        omega, alpha = turn_back(state, t, load(state, OMEGA, t)), turn_back(state, t, load(state, ALPHA, t))
        force = turn_back(state, t, load(state, FORCE, t))
        (x, y, z), product = omega, (omega[1] * omega[2], omega[2] * omega[0], omega[0] * omega[1])
        store(out, _F, t, force)
        store(out, _LESS_F, t, times(-1.0, force))
        store(out, _A, t, alpha)
        store(out, _P, t, product)
        store(out, _LESS_P, t, times(-1.0, product))
        store(out, _SUM, t, add(alpha, product))
        store(out, _A_P, t, add(alpha, times(-1.0, product)))
        store(out, _P_A, t, add(product, times(-1.0, alpha)))
        store(out, _DIFFER, t, (y * y - z * z, z * z - x * x, x * x - y * y))
        store(out, _INWARD, t, (-(y * y) - z * z, -(z * z) - x * x, -(x * x) - y * y))


@compiled()
def _turn_functions(state: Array, functions: Array, chosen: Index, out: Array) -> None:
    """Write a vector with chosen functions as components in the body's axes, in the base's."""
    x = functions[chosen[0] * TILE : (chosen[0] + 1) * TILE]
    y = functions[chosen[1] * TILE : (chosen[1] + 1) * TILE]
    z = functions[chosen[2] * TILE : (chosen[2] + 1) * TILE]
    for t in range(TILE):
        store(out, 0, t, turn(state, t, (x[t], y[t], z[t])))


@compiled()
def _write_wrenches(state: Array, parameters: Index, functions: Array, wrenches: Array) -> None:
    """Write the wrenches at the base origin of a unit of each of some parameters of a body."""
    _write_functions(state, functions)
    for number in range(len(parameters)):
        parameter, out = parameters[number], wrenches[number * _WRENCH : (number + 1) * _WRENCH]
        _turn_functions(state, functions, _MOMENTS[parameter], out[3 * TILE :])
        if parameter < _INERTIA:
            _turn_functions(state, functions, _FORCES[parameter], out)
            for t in range(TILE):
                moment = cross(load(state, POSITION, t), load(out, 0, t))
                store(out, 3, t, add(load(out, 3, t), moment))


@compiled()
def _start_block(
    block: Index,
    W: Array,
    rank: int,
    forces: Array,
    samples: int,
    start: int,
    room: int,
    to: int,
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
                at, own = (k * rank + first + row) * TILE, ((of_base * most + row) * 6 + k) * TILE
                sums[own : own + TILE] = W[at : at + TILE]
        at = offset + (width - 1) * (width + count * room) + width + row * room + to
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
        path_sum = sums[row * _WRENCH : (row + 1) * _WRENCH]
        out = rows[at + row * step : at + row * step + size]
        for t in range(size):
            out[t] = power(wrench, path_sum, t)


@compiled()
def _write_powers_of_moments(
    wrench: Array, sums: Array, count: int, rows: Array, at: int, step: int, size: int
) -> None:
    moment = wrench[3 * TILE :]
    for row in range(count):
        path_sum = sums[row * _WRENCH + 3 * TILE : (row + 1) * _WRENCH]
        out = rows[at + row * step : at + row * step + size]
        for t in range(size):
            out[t] = dot(load(moment, 0, t), load(path_sum, 0, t))


@compiled()
def _write_columns(
    block: Index, column: int, parameters: Index, wrenches: Array, sums: Array, room: int, to: int, rows: Array
) -> None:
    """Write a body's columns: its wrenches times the path sum of each row."""
    count, width, offset = block[1:4]
    size = min(TILE, room - to)
    for number in range(len(parameters)):
        wrench = wrenches[number * _WRENCH : (number + 1) * _WRENCH]
        at = offset + (column + number) * (width + count * room) + width + to
        if parameters[number] < _INERTIA:
            _write_powers(wrench, sums, count, rows, at, room, size)
        else:
            _write_powers_of_moments(wrench, sums, count, rows, at, room, size)


@compiled()
def _write_moved(
    states: Array,
    joints: Array,
    nodes: int,
    start: int,
    room: int,
    to: int,
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
    padded, size = len(joints) // (6 * nodes), min(TILE, room - to)
    for number in range(len(moved)):
        block, node, dof, path_sum, above, column = moved[number]
        first, count, width, offset = blocks[block, :4]
        long, at = width + count * room, node * padded + start
        screw = states[(node * STATE + SCREW) * TILE : (node + 1) * STATE * TILE]
        direction = joints[DIRECTION * nodes * padded + at : DIRECTION * nodes * padded + at + size]
        velocity = joints[VELOCITY * nodes * padded + at : VELOCITY * nodes * padded + at + size]
        for row in range(count):
            at = (dof * rank + first + row) * TILE
            w, at = W[at : at + TILE], (above * most + row) * _WRENCH
            upper, at = sums[at : at + _WRENCH], (path_sum * most + row) * _WRENCH
            _add_screw(ratios[number], w, screw, upper, sums[at : at + _WRENCH])
            at = offset + column * long + width + row * room + to
            multiply(ratios[number], w, direction, rows[at : at + size])
            multiply(ratios[number], w, velocity, rows[at + long : at + long + size])


@compiled()
def _write_bodies(
    states: Array,
    room: int,
    to: int,
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
        parameters, at = kept[first : first + count], path_sum * most * _WRENCH
        if node != known:
            known = node
            _write_wrenches(states[node * STATE * TILE : (node + 1) * STATE * TILE], parameters, functions, wrenches)
        own = sums[at : at + most * _WRENCH]
        _write_columns(blocks[block], column, parameters, wrenches, own, room, to, rows)


@compiled()
def write_span(
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
    begin: int,
    end: int,
    sums: Array,
    rows: Array,
) -> None:
    """As `write_rows`, but of samples from one on, a multiple of `TILE`, with room for these alone.

    `sums`: memory for path sums, see `path_sums`.
    """
    most, room = _most_rows(blocks), end - begin
    functions, wrenches = np.zeros(_FUNCTIONS * TILE), np.zeros(10 * _WRENCH)
    for start in range(begin, end, TILE):
        to, tile = start - begin, start // TILE
        size = min(TILE, room - to)
        own = states[tile * nodes * STATE * TILE : (tile + 1) * nodes * STATE * TILE]
        W = bases[tile * step :]
        for block in range(len(blocks)):
            _start_block(blocks[block], W, rank, forces, samples, start, room, to, size, most, sums, rows)
        _write_moved(own, joints, nodes, start, room, to, W, rank, most, blocks, moved, ratios, sums, rows)
        _write_bodies(own, room, to, most, blocks, bodies, kept, sums, functions, wrenches, rows)


@compiled()
def _most_rows(blocks: Index) -> int:
    most = 0
    for block in range(len(blocks)):
        most = max(most, blocks[block, 1])
    return most


@compiled()
def path_sums(blocks: Index) -> Array:
    """Memory for the path sums of a tile, the first of which are zero."""
    return np.zeros(blocks[0, 7] * _most_rows(blocks) * _WRENCH)


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
        0,
        samples,
        path_sums(blocks),
        rows,
    )
