"""Tiles: arrays (..., TILE) of so many samples, flat, and operations on vectors of one sample and of all of a tile.

Operations take views that start at what they are about, so that indices are known not to be negative: only then does
the compiler use the processor's vector instructions.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, TypeVar

import numba
import numpy as np
from numba.core import event

from torchid.kernels import announced
from torchid.parameters import Array

TILE = 64
"""Samples of a tile: all arrays of one stay in the second-level cache, and a call costs little beside its loop."""

Function = TypeVar("Function", bound=Callable[..., object])
Vector = tuple[float, float, float]
Index = np.ndarray

ARRAY, MATRIX, INDEX, FLAGS, TABLE = "float64[::1]", "float64[:,::1]", "int64[::1]", "boolean[::1]", "int64[:,::1]"


class _Announcer(event.Listener):  # type: ignore[misc]
    """Announces that a kernel is compiled, with others that it calls, which Numba says of none that it has kept."""

    def __init__(self) -> None:
        self._depth, self._stack = 0, ExitStack()

    def on_start(self, event: Any) -> None:
        """Before one is compiled."""
        if _is_kernel(event):
            self._depth += 1
            if self._depth == 1:
                self._stack.enter_context(announced())

    def on_end(self, event: Any) -> None:
        """After it, or where it failed."""
        if _is_kernel(event):
            self._depth -= 1
            if not self._depth:
                self._stack.close()


def _is_kernel(event: Any) -> bool:
    """Whether what Numba compiles is of this package, and no function of others."""
    return str(event.data["dispatcher"].py_func.__module__).startswith(f"{__package__}.")


event.register("numba:compile", _Announcer())


def compiled(*arguments: str, sums: bool = False) -> Callable[[Function], Function]:
    """Compile a function: for arguments of given types at once, kept on disk, or where others call it.

    `sums`: terms of its sums may be added in any order, as a sum by vector instructions needs it.
    """
    signature = [f"void({', '.join(arguments)})"] if arguments else []
    fastmath = {"contract", "nsz", "reassoc"} if sums else {"contract", "nsz"}
    options = {"nogil": True, "cache": True, "error_model": "numpy", "fastmath": fastmath}

    def compile_function(function: Function) -> Function:
        return numba.njit(*signature, **options)(function)

    return compile_function


@compiled()
def load(tile: Array, k: int, t: int) -> Vector:
    """Three successive numbers of a sample, from the k-th on."""
    return tile[k * TILE + t], tile[(k + 1) * TILE + t], tile[(k + 2) * TILE + t]


@compiled()
def store(tile: Array, k: int, t: int, v: Vector) -> None:
    """Write what `load` reads."""
    tile[k * TILE + t], tile[(k + 1) * TILE + t], tile[(k + 2) * TILE + t] = v


@compiled()
def dot(a: Vector, b: Vector) -> float:
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled()
def cross(a: Vector, b: Vector) -> Vector:
    """Cross product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled()
def add(a: Vector, b: Vector) -> Vector:
    """Sum."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compiled()
def times(x: float, a: Vector) -> Vector:
    """Product with a number."""
    return x * a[0], x * a[1], x * a[2]


@compiled()
def turn(tile: Array, t: int, v: Vector) -> Vector:
    """The rotation that a tile starts with, by rows, times a vector."""
    return dot(load(tile, 0, t), v), dot(load(tile, 3, t), v), dot(load(tile, 6, t), v)


@compiled()
def turn_back(tile: Array, t: int, v: Vector) -> Vector:
    """Its transpose times a vector."""
    x, y, z = times(v[0], load(tile, 0, t)), times(v[1], load(tile, 3, t)), times(v[2], load(tile, 6, t))
    return add(add(x, y), z)


@compiled()
def accumulate(a: Array, b: Array, out: Array) -> None:
    """Add products of numbers."""
    for t in range(len(out)):
        out[t] += a[t] * b[t]


@compiled()
def subtract(a: Array, b: Array, out: Array) -> None:
    """Subtract products of numbers."""
    for t in range(len(out)):
        out[t] -= a[t] * b[t]


@compiled()
def multiply(factor: float, a: Array, b: Array, out: Array) -> None:
    """Write products of numbers."""
    for t in range(len(out)):
        out[t] = factor * a[t] * b[t]


@compiled()
def scale(factor: float, a: Array, out: Array) -> None:
    """Write multiples of numbers."""
    for t in range(len(out)):
        out[t] = factor * a[t]
