"""Wrenches in words: a force along an axis, a moment about one, or both."""

from __future__ import annotations

import numpy as np

from torchid.parameters import Array

_ZERO = 1e-5  # of a unit vector
_UNSEEN = 5e-3  # [m], less than what is printed


def simplest_basis(space: Array) -> list[Array]:
    """Wrenches (6,) that span a space (6, m), with as many zeros as elimination gives; pure moments come last.

    Elimination pivots on the largest force component left, and on a moment component only if no force is left.
    """
    rows = np.array(space.T)
    done = 0
    for block in (slice(0, 3), slice(3, 6)):
        while done < len(rows):
            left = np.abs(rows[done:, block])
            row, column = divmod(int(np.argmax(left)), 3)
            if left[row, column] < _ZERO:
                break
            rows[[done, done + row]] = rows[[done + row, done]]
            rows[done] /= rows[done, block.start + column]
            others = np.arange(len(rows)) != done
            rows[others] -= np.outer(rows[others, block.start + column], rows[done])
            done += 1
    return list(rows[:done])


def wrench_words(wrench: Array) -> str:
    """A wrench (6,) at the base origin along the base frame's axes, up to scale and sign.

    "moment about (0.71, 0, 0.71)"; "force along (0, 0, 1)", if its line does not pass through the base origin "through
    (0, 0.1, 0)" [m]; and "with 0.2 m of pitch" [m = N m per N] if a moment about the same line comes with it.
    """
    wrench = wrench / np.linalg.norm(wrench)
    force, moment = wrench[:3], wrench[3:]
    size = float(np.linalg.norm(force))
    if size < _ZERO:
        return f"moment about {_vector(_signed(moment))}"
    through, pitch = np.cross(force, moment) / size**2, float(force @ moment) / size**2
    text = f"force along {_vector(_signed(force))}"
    if np.linalg.norm(through) > _UNSEEN:
        text += f" through {_vector(through)}"
    return text if abs(pitch) < _UNSEEN else f"{text} with {pitch:.2g} m of pitch"


def _signed(direction: Array) -> Array:
    """Of unit length, the largest component positive."""
    direction = direction / np.linalg.norm(direction)
    return direction * np.sign(direction[np.argmax(np.abs(direction).round(6))])


def _vector(x: Array) -> str:
    return f"({', '.join(f'{value:.2f}'.rstrip('0').rstrip('.') for value in np.round(x, 2) + 0.0)})"
