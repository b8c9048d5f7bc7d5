"""Wrenches of a tile at the base origin per unit of each inertial parameter: `torchid.regressor.columns`' way."""

from __future__ import annotations

import numpy as np

from torchid.kernels.states import ALPHA, FORCE, OMEGA, POSITION
from torchid.kernels.tiles import TILE, Index, add, compiled, cross, load, store, times, turn, turn_back
from torchid.parameters import Array

INERTIA = 4  # the first parameter that demands no force
WRENCH = 6 * TILE

# Functions of a body's motion in its own axes, of which all its unit wrenches are made: nothing, the specific force and
# its negative, the angular acceleration, products (yz, zx, xy) of angular velocities, their negatives, the sum and
# the differences of these two, differences of squares (y - z, z - x, x - y), and their negative sums
_F, _LESS_F, _A, _P, _LESS_P, _SUM, _A_P, _P_A, _DIFFER, _INWARD = range(1, 31, 3)
FUNCTIONS = 31

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
def write_wrenches(state: Array, parameters: Index, functions: Array, wrenches: Array) -> None:
    """Write the wrenches at the base origin of a unit of each of some parameters of a body."""
    _write_functions(state, functions)
    for number in range(len(parameters)):
        parameter, out = parameters[number], wrenches[number * WRENCH : (number + 1) * WRENCH]
        _turn_functions(state, functions, _MOMENTS[parameter], out[3 * TILE :])
        if parameter < INERTIA:
            _turn_functions(state, functions, _FORCES[parameter], out)
            for t in range(TILE):
                moment = cross(load(state, POSITION, t), load(out, 0, t))
                store(out, 3, t, add(load(out, 3, t), moment))
