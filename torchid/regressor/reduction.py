"""Which parameter columns the fast path computes, and how all parameters follow from them.

In a frame whose z axis is the joint's, a revolute joint cannot tell m, mcz and Ixx + Iyy of its body from parameters of
the parent, a prismatic joint none of the inertia: these columns are regrouped into the parent, leaf to root, and never
computed. What stays is 10 columns for a floating base, 7 per revolute and 4 per prismatic joint.

Source: Gautier and Khalil, "Direct calculation of minimum set of inertial parameters of serial robots", T-RA 1990.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby

import numpy as np

from torchid import parameters
from torchid.parameters import Array
from torchid.regressor.columns import ALL_INERTIAL
from torchid.regressor.tree import KinematicTree

_REVOLUTE_KEPT = (1, 2, 4, 5, 6, 8, 9)  # mcx, mcy, Ixx, Ixy, Ixz, Iyz, Izz
_PRISMATIC_KEPT = (0, 1, 2, 3)  # m, mcx, mcy, mcz
_IXX, _IYY = 4, 7


@dataclass(frozen=True)
class ColumnLayout:
    """Columns of each body, bodies in depth-first order: `kept[body]` in the order of `torchid.parameters`."""

    kept: tuple[tuple[int, ...], ...]

    @cached_property
    def starts(self) -> list[int]:
        """First column of every body, then the total."""
        return [0, *np.cumsum([len(k) for k in self.kept]).tolist()]

    def runs(self, bodies: range | None = None) -> Iterator[tuple[tuple[int, ...], range]]:
        """Runs of consecutive bodies that keep the same columns, of all bodies or some: the columns, the bodies."""
        for kept, run in groupby(range(len(self.kept)) if bodies is None else bodies, key=lambda body: self.kept[body]):
            members = list(run)
            yield kept, range(members[0], members[-1] + 1)

    @property
    def count(self) -> int:
        """Number of columns."""
        return self.starts[-1]


def full_layout(tree: KinematicTree) -> ColumnLayout:
    """All ten inertial columns of every body."""
    return ColumnLayout((ALL_INERTIAL,) * tree.bodies)


def reduced_layout(tree: KinematicTree) -> ColumnLayout:
    """The columns that are left after regrouping; a fixed base has none."""
    kept = {
        "base": ALL_INERTIAL if tree.base_rows else (),
        "revolute": _REVOLUTE_KEPT,
        "prismatic": _PRISMATIC_KEPT,
        "welded": ALL_INERTIAL,  # the sensor sees what no joint does
        "massless": (),
    }
    return ColumnLayout(tuple(kept[kind] for kind in tree.kinds))


def reduction_matrix(tree: KinematicTree) -> Array:
    """B, (columns of `reduced_layout`, 10 L) for L bodies, with `K = K_reduced @ B` for the inertial columns of K."""
    layout, width = reduced_layout(tree), parameters.INERTIAL.stop
    effective = np.zeros((tree.bodies, width, width * tree.bodies))
    for body in range(tree.bodies):
        own = slice(width * body, width * (body + 1))
        effective[body][:, own] = parameters.change_of_frame(tree.T_joint_link[body])
    rows = np.zeros((layout.count, width * tree.bodies))
    for body in reversed(range(tree.bodies)):
        kept, gone = np.zeros((width, width)), np.eye(width)
        for column in layout.kept[body]:
            kept[column, column] = 1.0
        gone -= kept
        if tree.kinds[body] == "revolute":
            kept[_IXX, _IYY] = -1.0
            gone[_IXX, _IYY] = 1.0
        rows[layout.starts[body] : layout.starts[body + 1]] = (kept @ effective[body])[list(layout.kept[body])]
        if body > 0:
            X = parameters.change_of_frame(tree.T_parent_joint[body])
            effective[tree.parents[body]] += X @ gone @ effective[body]
    own_columns = rows.reshape(layout.count, tree.bodies, width)[:, tree.node_of]
    return np.asarray(own_columns.reshape(layout.count, -1))
