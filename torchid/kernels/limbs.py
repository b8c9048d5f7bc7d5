"""Whitened null-space bases of robots that stand on limbs of their own, tile by tile: `torchid.sensing.limbs`' way."""

from __future__ import annotations

import numpy as np

from torchid.kernels.states import POSITION, SCREW, STATE, power
from torchid.kernels.tiles import (
    ARRAY,
    FLAGS,
    INDEX,
    TABLE,
    TILE,
    Index,
    accumulate,
    add,
    compiled,
    cross,
    load,
    scale,
    store,
    subtract,
    turn,
)
from torchid.parameters import Array

BASE = 6
"""Rows of the base in a generalized force, and columns of W."""
_ROW = BASE * TILE


@compiled()
def _write_limb(states: Array, state: Array, wrenches: Array, moved: Index, ratios: Array, k: int, rows: Array) -> None:
    """Write the rows of a limb's contact, (k, 6 + k, TILE): its wrenches at the base origin, their power on joints."""
    for number in range(k):
        row = rows[number * (BASE + k) * TILE : (number + 1) * (BASE + k) * TILE]
        row[:] = 0.0
        wrench = wrenches[6 * number : 6 * (number + 1)]
        for t in range(TILE):
            force = turn(state, t, (wrench[0], wrench[1], wrench[2]))
            moment = turn(state, t, (wrench[3], wrench[4], wrench[5]))
            store(row, 0, t, force)
            store(row, 3, t, add(moment, cross(load(state, POSITION, t), force)))
        for move in range(len(moved)):
            joint, node = moved[move]
            screw = states[(node * STATE + SCREW) * TILE : (node + 1) * STATE * TILE]
            torque, ratio = row[(BASE + joint) * TILE : (BASE + joint + 1) * TILE], ratios[move]
            for t in range(TILE):
                torque[t] += ratio * power(screw, row, t)


@compiled()
def _substitute(rows: Array, k: int) -> None:
    """Write L^-1 B of [B L], with L triangular, to the place of B."""
    width = (BASE + k) * TILE
    for row in range(k - 1, -1, -1):
        at = (BASE + k - 1 - row) * TILE
        for column in range(BASE):
            own = rows[row * width + column * TILE : row * width + (column + 1) * TILE]
            _divide(own, rows[row * width + at : row * width + at + TILE])
            for other in range(row):
                to, by = other * width + column * TILE, other * width + at
                subtract(rows[by : by + TILE], own, rows[to : to + TILE])


@compiled()
def _solve(rows: Array, k: int, dofs: Index, scratch: Array, V: Array, condition: Array) -> None:
    """Write -L^-1 B of a limb [B L] to its joints' rows of V, and the square of its condition, if that is the worst.

    By Householder reflections, one for each joint, the last first.
    """
    width, along = (BASE + k) * TILE, scratch[:TILE]
    size = scratch[TILE : 2 * TILE]
    size[:] = 0.0
    for row in range(k):
        for column in range(BASE, BASE + k):
            at = row * width + column * TILE
            accumulate(rows[at : at + TILE], rows[at : at + TILE], size)
    for done in range(k - 1):
        last = BASE + k - 1 - done
        _reflect(rows[done * width :], width, k - done, last, along, scratch[2 * TILE :])
    _substitute(rows, k)
    along[:] = 0.0
    for row in range(k):
        out = V[(BASE + dofs[k - 1 - row]) * _ROW : (BASE + dofs[k - 1 - row] + 1) * _ROW]
        scale(-1.0, rows[row * width : row * width + _ROW], out)
        for column in range(BASE):
            own = out[column * TILE : (column + 1) * TILE]
            accumulate(own, own, along)
    for t in range(TILE):
        square = along[t] * size[t]
        if not square <= condition[t]:
            condition[t] = square


@compiled()
def _reflect(rows: Array, width: int, count: int, last: int, along: Array, inverse: Array) -> None:
    """Turn so many rows so that those after the first are zero in a column, and do so with all columns before it."""
    v = rows[last * TILE :]
    along[:] = 0.0
    for row in range(count):
        own = v[row * width : row * width + TILE]
        accumulate(own, own, along)
    for t in range(TILE):
        length = np.copysign(np.sqrt(along[t]), v[t])
        v[t] += length
        inverse[t] = 1.0 / (length * v[t])
    for column in range(last):
        others = rows[column * TILE :]
        along[:] = 0.0
        for row in range(count):
            accumulate(v[row * width : row * width + TILE], others[row * width : row * width + TILE], along)
        for t in range(TILE):
            along[t] *= inverse[t]
        for row in range(count):
            subtract(along, v[row * width : row * width + TILE], others[row * width : row * width + TILE])
    for t in range(TILE):
        v[t] = -1.0 / (inverse[t] * v[t])


@compiled()
def _divide(out: Array, by: Array) -> None:
    for t in range(TILE):
        out[t] /= by[t]


@compiled()
def _orthonormalize(V: Array, m: int, least_pivot: float, suspect: Array) -> None:
    """Make the columns of matrices (m, 6, TILE) orthonormal by the modified Gram-Schmidt process; name failures."""
    least, along = np.zeros(_ROW), np.zeros(TILE)
    for row in range(m):
        own = V[row * _ROW : (row + 1) * _ROW]
        accumulate(own, own, least)
    for column in range(BASE):
        v = V[column * TILE :]
        along[:] = 0.0
        for row in range(m):
            accumulate(v[row * _ROW : row * _ROW + TILE], v[row * _ROW : row * _ROW + TILE], along)
        for t in range(TILE):
            suspect[t] |= not along[t] > least_pivot * least[column * TILE + t]
            along[t] = 1.0 / np.sqrt(along[t])
        for row in range(m):
            own = v[row * _ROW : row * _ROW + TILE]
            for t in range(TILE):
                own[t] *= along[t]
        for other in range(column + 1, BASE):
            others = V[other * TILE :]
            along[:] = 0.0
            for row in range(m):
                accumulate(v[row * _ROW : row * _ROW + TILE], others[row * _ROW : row * _ROW + TILE], along)
            for row in range(m):
                subtract(along, v[row * _ROW : row * _ROW + TILE], others[row * _ROW : row * _ROW + TILE])


@compiled()
def _write_base(axes: Array, row_std: Array, V: Array) -> None:
    """Write what the base's motion does to its own rows, along the axes of their noise and in units of it."""
    for row in range(BASE):
        axis, first = row % 3, row - row % 3
        for k in range(3):
            part = axes[(3 * k + axis) * TILE : (3 * k + axis + 1) * TILE]
            at = (row * BASE + first + k) * TILE
            scale(row_std[row], part, V[at : at + TILE])


@compiled()
def _turn_base(axes: Array, row_std: Array, V: Array) -> None:
    """Divide rows of the base by their noise again, and turn them to the base's own axes."""
    for first in (0, 3):
        a, b, c = 1.0 / row_std[first], 1.0 / row_std[first + 1], 1.0 / row_std[first + 2]
        for column in range(BASE):
            x = V[(first * BASE + column) * TILE :]
            y = V[((first + 1) * BASE + column) * TILE :]
            z = V[((first + 2) * BASE + column) * TILE :]
            for t in range(TILE):
                x[t], y[t], z[t] = turn(axes, t, (a * x[t], b * y[t], c * z[t]))


@compiled(ARRAY, ARRAY, "int64", TABLE, ARRAY, INDEX, TABLE, ARRAY, ARRAY, "float64", "float64", ARRAY, FLAGS)
def write_bases(
    states: Array,
    axes: Array,
    nodes: int,
    limbs: Index,
    wrenches: Array,
    dofs: Index,
    moved: Index,
    ratios: Array,
    row_std: Array,
    worst: float,
    least_pivot: float,
    bases: Array,
    suspect: Array,
) -> None:
    """Write W of each sample, as `limb_null_space` gives it where contact forces are unmeasured.

    Args:
        states: of `write_states`.
        axes: (9, P), by rows the matrix whose columns are the axes that noise of the base rows is along, in the base's.
        nodes: L.
        limbs: (limbs, 5): node in contact, joints k, the first in `wrenches` and `dofs`, the first in `moved` and the
            last.
        wrenches: (k of each limb, 6), unmeasured ones, in the axes of the node.
        dofs: (k of each limb), of its joints in W.
        moved: (nodes that move the contacts, 2): the joint's number in its limb, the node.
        ratios: of their motion to the joint's.
        row_std: (m,), noise of the base and of the joints.
        worst: square of the condition of a limb from which on a sample is suspect.
        least_pivot: what must be left of the square of a column.
        bases: tiles (m, 6, TILE), are written.
        suspect: (P,), is written: W of such samples is worthless.
    """
    m, most = len(row_std), 0
    for limb in range(len(limbs)):
        most = max(most, limbs[limb, 1])
    rows, scratch, condition = np.zeros(most * (BASE + most) * TILE), np.zeros(3 * TILE), np.zeros(TILE)
    of_base, samples = np.zeros(9 * TILE), len(suspect)
    for tile in range(samples // TILE):
        own = states[tile * nodes * STATE * TILE : (tile + 1) * nodes * STATE * TILE]
        V = bases[tile * m * _ROW : (tile + 1) * m * _ROW]
        V[:], condition[:] = 0.0, 0.0
        for limb in range(len(limbs)):
            node, k, first, start, end = limbs[limb]
            state = own[node * STATE * TILE : (node + 1) * STATE * TILE]
            own_moved, own_ratios = moved[start:end], ratios[start:end]
            _write_limb(own, state, wrenches[6 * first : 6 * (first + k)], own_moved, own_ratios, k, rows)
            _solve(rows, k, dofs[first : first + k], scratch, V, condition)
        for k in range(9):
            start = k * samples + tile * TILE
            of_base[k * TILE : (k + 1) * TILE] = axes[start : start + TILE]
        _write_base(of_base, row_std, V)
        for row in range(BASE, m):
            scale(row_std[row], V[row * _ROW : (row + 1) * _ROW], V[row * _ROW : (row + 1) * _ROW])
        doubtful = suspect[tile * TILE : (tile + 1) * TILE]
        for t in range(TILE):
            doubtful[t] = not condition[t] < worst  # so written, undefined ones are suspect too
        _orthonormalize(V, m, least_pivot, doubtful)
        _turn_base(of_base, row_std, V)
        for row in range(BASE, m):
            scale(1.0 / row_std[row], V[row * _ROW : (row + 1) * _ROW], V[row * _ROW : (row + 1) * _ROW])
