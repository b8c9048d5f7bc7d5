"""Checks of one field of a log: each returns the field in its canonical type or raises a one-line `LogError`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError
from torchid.guards import MAX_LETTERS
from torchid.logs.fields import SHAPES, BoolArray, FloatArray, Shape
from torchid.text import is_plain, shown
from torchid.wrenches import COMPONENTS

#: How far a quaternion's norm may be from 1 before it is refused rather than renormalised.
QUATERNION_TOLERANCE = 1e-3
#: How far the norm of a quaternion that was normalised may be from 1.
ROUNDING = 4.0 * np.finfo(np.float64).eps
#: Size of a number in any unit, beyond all that anyone measures: products of several stay what float64 can hold.
LARGEST = 1e30


def check_shape(source: str, name: str, array: NDArray[Any], letters: Shape, sizes: Mapping[str, int]) -> None:
    """Raise LogError unless `array` has the shape `letters`, whose known sizes are `sizes`."""
    expected = [sizes.get(letter, letter) if isinstance(letter, str) else letter for letter in letters]
    fits = array.ndim == len(expected) and all(
        isinstance(want, str) or want == have for want, have in zip(expected, array.shape, strict=True)
    )
    if not fits:
        named, sized = (f"({', '.join(map(str, shape))})" for shape in (letters, expected))
        accepted = named if named == sized else f"{named} = {sized}"
        raise LogError(source, name, f"shape {array.shape}", f"shape {accepted}")


def as_real(source: str, name: str, array: NDArray[Any]) -> FloatArray:
    """The array as float64 (itself where it is already), LogError unless it holds real numbers."""
    if array.dtype.kind not in "fiu":
        raise LogError(source, name, f"values of type {array.dtype}", "real numbers")
    with np.errstate(over="ignore"):  # a longdouble too large becomes inf, which check_finite reports
        return np.asarray(array, dtype=np.float64)


def place(index: tuple[int, ...], labels: tuple[str, ...]) -> str:
    """An element's place in words: its sample and, where it has any, its channel.

    Args:
        index: sample number, column, wrench component; as many as the field has axes.
        labels: names of the columns, empty where they have none.
    """
    words = f"sample {index[0]}"
    if len(index) > 1:
        words += f", {labels[index[1]] if labels else f'component {index[1]}'}"
    return words + (f" {COMPONENTS[index[2]]}" if len(index) > 2 else "")


def check_finite(
    source: str, name: str, values: FloatArray, *, allow_nan: bool = False, labels: tuple[str, ...] = ()
) -> None:
    """Raise LogError at the first value beyond `LARGEST`, infinite or, unless `allow_nan`, NaN."""
    bad = (values > LARGEST) | (values < -LARGEST)
    if not allow_nan:
        bad |= np.isnan(values)
    if bad.any():
        index = tuple(int(i) for i in np.unravel_index(np.argmax(bad), bad.shape))
        accepted = f"numbers of at most {LARGEST:g}" if np.isfinite(values[index]) else "finite numbers"
        accepted += ", or NaN where nothing was measured" if allow_nan else ""
        raise LogError(source, name, f"{values[index]} at {place(index, labels)}", accepted)


def check_time(source: str, time: FloatArray) -> None:
    """Raise LogError unless `time` (N,) [s] has samples, is finite and increases strictly."""
    if not len(time):
        raise LogError(source, "time", "no samples", "at least one sample")
    check_finite(source, "time", time)
    still = time[1:] <= time[:-1]
    if still.any():
        i = int(np.argmax(still))
        found = f"{time[i + 1]} at sample {i + 1}, after {time[i]} at sample {i}"
        raise LogError(source, "time", found, "strictly increasing seconds")


def unit_quaternion(source: str, name: str, quat: FloatArray, allow_nan: bool = False) -> FloatArray:
    """The quaternions (N, 4) with a norm of exactly one, LogError at the first whose norm is not one.

    With `allow_nan`, one that is NaN in part is NaN as a whole.
    """
    check_finite(source, name, quat, allow_nan=allow_nan)
    with np.errstate(over="ignore"):  # to a norm that is refused
        norm = np.linalg.norm(quat, axis=1)
    bad = ~((np.abs(norm - 1.0) <= QUATERNION_TOLERANCE) | np.isnan(norm))
    if bad.any():
        i = int(np.argmax(bad))
        found = f"norm {norm[i]:.6g} at sample {i}"
        raise LogError(source, name, found, f"unit quaternions, to {QUATERNION_TOLERANCE:g}")
    norm[np.abs(norm - 1.0) <= ROUNDING] = 1.0  # what was normalised before stays as it is, to the last bit
    return np.asarray(quat / norm[:, None], dtype=np.float64)


def as_names(source: str, name: str, array: NDArray[Any]) -> tuple[str, ...]:
    """The names in a one-dimensional array of strings or UTF-8 bytes, LogError on anything else or a duplicate."""
    check_shape(source, name, array, SHAPES[name] or (1,), {})
    if array.size and array.dtype.kind not in "US":
        raise LogError(source, name, f"values of type {array.dtype}", "strings")
    try:
        names = tuple(item.decode() if isinstance(item, bytes) else str(item) for item in array.tolist())
    except UnicodeDecodeError as error:
        raise LogError(source, name, f"bytes that are no text ({error})", "UTF-8 strings") from error
    seen: set[str] = set()
    for i, item in enumerate(names):
        if len(item) > MAX_LETTERS or not is_plain(item):
            accepted = f"printable names of at most {MAX_LETTERS} characters"
            raise LogError(source, name, f"'{shown(item)}' at {i}", accepted)
        if not item or item in seen:
            found = f"'{item}' again at {i}" if item else f"an empty name at {i}"
            raise LogError(source, name, found, "names that are all different")
        seen.add(item)
    return names


def as_frame(source: str, name: str, array: NDArray[Any]) -> str:
    """The one name in an array of strings or UTF-8 bytes of any shape, LogError on anything else."""
    if array.size != 1:
        raise LogError(source, name, f"{array.size} values", "one name")
    return as_names(source, name, array.reshape(1))[0]


def as_flags(source: str, name: str, array: NDArray[Any], labels: tuple[str, ...]) -> BoolArray:
    """The array as booleans, LogError unless it holds booleans or the numbers 0 and 1."""
    if array.dtype.kind == "b":
        return np.asarray(array, dtype=np.bool_)
    values = as_real(source, name, array)
    bad = (values != 0.0) & (values != 1.0)
    if bad.any():
        index = tuple(int(i) for i in np.unravel_index(np.argmax(bad), bad.shape))
        raise LogError(source, name, f"{values[index]:g} at {place(index, labels)}", "true and false, or 1 and 0")
    return np.asarray(values, dtype=np.bool_)
