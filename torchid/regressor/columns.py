"""Wrench per unit of each inertial parameter of each body, and the columns that remain after regrouping."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby

import numpy as np
import torch
from torch import Tensor

from torchid import parameters
from torchid.parameters import Array
from torchid.regressor.kinematics import BodyStates, cross_product, rotate_vectors
from torchid.regressor.tree import KinematicTree

_Vector = Sequence[Tensor]
ALL_INERTIAL = tuple(range(parameters.INERTIAL.stop))
_REVOLUTE_KEPT = (1, 2, 4, 5, 6, 8, 9)  # mcx, mcy, Ixx, Ixy, Ixz, Iyz, Izz
_PRISMATIC_KEPT = (0, 1, 2, 3)  # m, mcx, mcy, mcz
_IXX = 4
_IYY = 7
_TOGETHER = 2**15  # bodies times samples per step, so that results stay in the second-level cache


@dataclass(frozen=True)
class ColumnLayout:
    """Columns of each body, bodies in depth-first order: `kept[body]` in the order of `torchid.parameters`.

    `starts`: first column of every body, then the total.
    """

    kept: tuple[tuple[int, ...], ...]
    starts: list[int] = field(init=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "starts", [0, *np.cumsum([len(k) for k in self.kept]).tolist()])

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
    return ColumnLayout((ALL_INERTIAL,) * tree.n_nodes)


def reduced_layout(tree: KinematicTree) -> ColumnLayout:
    """The columns that remain after regrouping into the parents' (Gautier 1990); a fixed base has none."""
    kept = {
        "base": ALL_INERTIAL if tree.base_rows else (),
        "revolute": _REVOLUTE_KEPT,
        "prismatic": _PRISMATIC_KEPT,
        "welded": ALL_INERTIAL,  # the sensor measures all six components of the wrench
        "massless": (),
    }
    return ColumnLayout(tuple(kept[kind] for kind in tree.kinds))


def reduction_matrix(tree: KinematicTree) -> Array:
    """B, (columns of `reduced_layout`, 10 L) for L bodies, with `K = K_reduced @ B` for the inertial columns of K."""
    layout = reduced_layout(tree)
    width = parameters.INERTIAL.stop
    effective = np.zeros((tree.n_nodes, width, width * tree.n_nodes))
    for body in range(tree.n_nodes):
        of_body = slice(width * body, width * (body + 1))
        effective[body][:, of_body] = parameters.change_of_frame(tree.T_joint_link[body])
    rows = np.zeros((layout.count, width * tree.n_nodes))
    for body in reversed(range(tree.n_nodes)):
        kept = np.zeros((width, width))
        regrouped = np.eye(width)
        for column in layout.kept[body]:
            kept[column, column] = 1.0
        regrouped -= kept
        if tree.kinds[body] == "revolute":
            kept[_IXX, _IYY] = -1.0
            regrouped[_IXX, _IYY] = 1.0
        rows[layout.starts[body] : layout.starts[body + 1]] = (kept @ effective[body])[list(layout.kept[body])]
        if body > 0:
            X = parameters.change_of_frame(tree.T_parent_joint[body])
            effective[tree.parents[body]] += X @ regrouped @ effective[body]
    own_columns = rows.reshape(layout.count, tree.n_nodes, width)[:, tree.node_of]
    return np.asarray(own_columns.reshape(layout.count, -1))


def all_columns(tree: KinematicTree) -> tuple[list[tuple[int, ...]], Array, None]:
    """Columns of K's nodes, (12,) each or (), the frames of their parameters, (L, 4, 4), and no regrouping."""
    columns: list[tuple[int, ...]] = [()] * tree.n_nodes
    for body, node in enumerate(tree.node_of):
        columns[node] = tuple(range(parameters.PER_BODY * body, parameters.PER_BODY * (body + 1)))
    return columns, tree.T_joint_link, None


def regrouped_columns(tree: KinematicTree) -> tuple[list[tuple[int, ...]], Array, Tensor]:
    """The same of `reduced_layout` with the joints' friction, -1 for parameters without a column, and the regrouping.

    The latter, (columns, 12 L), makes parameters of these columns from those of all.
    """
    per_body = parameters.PER_BODY
    inertial = parameters.INERTIAL.stop
    kept_by_node = reduced_layout(tree).kept
    regrouped = np.zeros((sum(map(len, kept_by_node)), len(tree.node_of), per_body))
    regrouped[..., :inertial] = reduction_matrix(tree).reshape(len(regrouped), -1, inertial)
    of_all = np.eye(per_body * len(tree.node_of))
    columns = list[tuple[int, ...]]()
    rows = list[Array]()
    taken = 0
    for node, kept in enumerate(kept_by_node):
        moves = tree.kinds[node] in ("revolute", "prismatic")
        numbers = [*kept, *range(inertial, per_body)] if moves else list(kept)
        start = sum(map(len, rows))
        at = {column: start + place for place, column in enumerate(numbers)}
        columns.append(tuple(at.get(column, -1) for column in range(per_body)) if at else ())
        friction = per_body * tree.body_of[node] + inertial
        rows += [
            regrouped[taken : taken + len(kept)].reshape(len(kept), len(of_all)),
            of_all[friction : friction + 2 * moves],
        ]
        taken += len(kept)
    frames = np.tile(np.eye(4), (tree.n_nodes, 1, 1))
    return columns, frames, torch.from_numpy(np.concatenate(rows))


def all_wrench_columns(states: BodyStates, layout: ColumnLayout, out: Tensor | None = None) -> Tensor:
    """Wrench columns (6, columns, B) of all bodies.

    Args:
        states: of the frames that `layout`'s parameters are expressed in.
        layout: which columns to compute.
        out: a buffer of the result's shape to write to, unchanged since an earlier call with the same layout, or zero.
    """
    is_reused = out is not None
    if out is None:
        out = states.position.new_zeros(6, layout.count, states.position.shape[-1])
    for kept, bodies in layout.runs():
        together = len(bodies)
        if is_reused:
            together = -(-together // -(-together * out.shape[-1] // _TOGETHER))
        for start in range(bodies.start, bodies.stop, together) if kept else ():
            end = min(start + together, bodies.stop)
            columns = out[:, layout.starts[start] : layout.starts[end]].unflatten(1, (-1, len(kept)))
            wrench_columns(states.slice_bodies(start, end), kept, columns, is_reused)
    return out


def wrench_columns(states: BodyStates, columns: tuple[int, ...], out: Tensor, is_reused: bool = False) -> None:
    """Write the wrenches of some inertial parameters of all given bodies.

    Args:
        states: of the frames the parameters are expressed in, k of them.
        columns: indices in the order of `torchid.parameters`, ascending, below 10.
        out: (6, k, len(columns), B), zero in the force rows of inertia columns; receives force [N], then moment about
            the base origin [N m], per unit of the parameter.
        is_reused: whether `out` is a buffer that no gradient flows through; it is then written straight to, which
            saves a copy, but which `torch.compile` and `torch.func.vmap` do not take.

    Source: the Newton-Euler equations of a body about its frame's origin, sorted by parameter.
    """
    forces_of, moments_of = _unit_wrenches(states, columns)
    n_with_force = len(forces_of)
    rotation = states.rotation
    if not is_reused:
        local = torch.stack([vector[axis] for axis in range(3) for vector in (*moments_of, *forces_of)])
        local = local.unflatten(0, (3, -1)).transpose(1, 2)  # (3, k, vectors, B)
        moments = local[:, :, : len(columns)]
        forces = local[:, :, len(columns) :]
        forces = rotate_vectors(rotation.unsqueeze(3), forces)
        out[:3, :, :n_with_force] = forces
        out[3:] = rotate_vectors(rotation.unsqueeze(3), moments)
        out[3:, :, :n_with_force] += cross_product(states.position.unsqueeze(2), forces)
        return
    for column, moment in enumerate(moments_of):  # to stack them takes as long as to turn them
        rotate_vectors(rotation, moment, out[3:, :, column])
    for column, force in enumerate(forces_of):
        rotate_vectors(rotation, force, out[:3, :, column])
    (x, y, z), (fx, fy, fz) = states.position.unsqueeze(2).unbind(), out[:3, :, :n_with_force].unbind()
    for row, (a, f), (b, g) in ((3, (y, fz), (z, fy)), (4, (z, fx), (x, fz)), (5, (x, fy), (y, fx))):
        out[row, :, :n_with_force].addcmul_(a, f).addcmul_(b, g, value=-1)


def _unit_wrenches(states: BodyStates, columns: Sequence[int]) -> tuple[list[_Vector], list[_Vector]]:
    """Forces and moments, in each body's frame, of a unit of each of some inertial parameters; inertias have no force.

    `m a + [alpha]x h + omega x (omega x h)` and `h x a + I alpha + omega x (I omega)`: all but a few entries are up to
    sign what the products of angular velocities are, or the angular acceleration more or less than these.
    """
    inverse = states.rotation.transpose(0, 1)
    omega, alpha, force = (
        rotate_vectors(inverse, x)
        for x in (states.angular_velocity, states.angular_acceleration, states.specific_force)
    )
    cyclic = torch.cat([omega, omega[:2]])
    squares = cyclic * cyclic
    products = cyclic[1:4] * cyclic[2:]  # yz, zx, xy
    yz, xz, xy = products.unbind()
    less_yz, less_xz, less_xy = products.neg().unbind()
    ax, ay, az = alpha.unbind()
    plus_x, plus_y, plus_z = (alpha + products).unbind()
    minus_x, minus_y, minus_z = (alpha - products).unbind()
    differ_x, differ_y, differ_z = (squares[1:4] - squares[2:]).unbind()
    forces: list[_Vector] = []
    moments: list[_Vector] = []
    if columns[0] < parameters.INERTIA.start:
        reversed_x, reversed_y, reversed_z = (products - alpha).unbind()
        inward_x, inward_y, inward_z = (squares[1:4] + squares[2:]).neg_().unbind()
        fx, fy, fz = force.unbind()
        less_fx, less_fy, less_fz = force.neg().unbind()
        zero = torch.zeros_like(fx)
        of_forces = [
            ((fx, fy, fz), (zero, zero, zero)),
            ((inward_x, plus_z, reversed_y), (zero, less_fz, fy)),
            ((reversed_z, inward_y, plus_x), (fz, zero, less_fx)),
            ((plus_y, reversed_x, inward_z), (less_fy, fx, zero)),
        ]
        chosen = [of_forces[column] for column in columns if column < parameters.INERTIA.start]
        forces = [x for x, _ in chosen]
        moments = [x for _, x in chosen]
    of_inertias = {
        (0, 0): (ax, xz, less_xy),
        (0, 1): (minus_y, plus_x, differ_z),
        (0, 2): (plus_z, differ_y, minus_x),
        (1, 1): (less_yz, ay, xy),
        (1, 2): (differ_x, minus_z, plus_y),
        (2, 2): (yz, less_xz, az),
    }
    inertias = [column - parameters.INERTIA.start for column in columns if column >= parameters.INERTIA.start]
    return forces, moments + [of_inertias[parameters.INERTIA_AXES[k]] for k in inertias]
