"""Wrench per unit of each inertial parameter of each body, and the columns that remain after regrouping."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import groupby

import numpy as np
import torch
from torch import Tensor

from torchid import parameters
from torchid.parameters import Array
from torchid.regressor.kinematics import BodyStates, cross_product, rotate_vectors
from torchid.regressor.tree import KinematicTree

ALL_INERTIAL = tuple(range(parameters.INERTIAL.stop))
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
    layout, width = reduced_layout(tree), parameters.INERTIAL.stop
    effective = np.zeros((tree.n_nodes, width, width * tree.n_nodes))
    for body in range(tree.n_nodes):
        own = slice(width * body, width * (body + 1))
        effective[body][:, own] = parameters.change_of_frame(tree.T_joint_link[body])
    rows = np.zeros((layout.count, width * tree.n_nodes))
    for body in reversed(range(tree.n_nodes)):
        kept, regrouped = np.zeros((width, width)), np.eye(width)
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
        if kept:
            columns = out[:, layout.starts[bodies.start] : layout.starts[bodies.stop]]
            own = states.slice_bodies(bodies.start, bodies.stop)
            wrench_columns(own, kept, columns.unflatten(1, (-1, len(kept))), is_reused)
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
    inverse = states.rotation.transpose(0, 1)
    omega, alpha, force = (
        rotate_vectors(inverse, x)
        for x in (states.angular_velocity, states.angular_acceleration, states.specific_force)
    )
    inertia_columns = [column for column in columns if column >= parameters.INERTIA.start]
    n_with_force = len(columns) - len(inertia_columns)
    if n_with_force:
        axes = [
            column - parameters.FIRST_MOMENT.start for column in columns[:n_with_force] if column != parameters.MASS
        ]
        unit_forces, unit_moments = _first_moment_wrenches(omega, alpha, force)
        forces = _rotate_to_base(states.rotation, [unit_forces[k] for k in axes])
        moments = _rotate_to_base(states.rotation, [unit_moments[k] for k in axes])
        if parameters.MASS in columns:
            forces = torch.cat([states.specific_force[:, :, None], forces], 2)
            moments = torch.nn.functional.pad(moments, (0, 0, 1, 0))
        out[:3, :, :n_with_force] = forces
        out[3:, :, :n_with_force] = moments + cross_product(states.position[:, :, None], forces)
    if inertia_columns:
        moments_by_axes = _inertia_moments(omega, alpha)
        inertia_moments = [
            moments_by_axes[parameters.INERTIA_AXES[column - parameters.INERTIA.start]] for column in inertia_columns
        ]
        moments = out[3:, :, n_with_force:]
        if is_reused:
            _rotate_to_base(states.rotation, inertia_moments, moments)
        else:
            moments.copy_(_rotate_to_base(states.rotation, inertia_moments))


def _rotate_to_base(rotation: Tensor, vectors: Sequence[Sequence[Tensor]], out: Tensor | None = None) -> Tensor:
    """Rotate c vectors given by components (k, B) into base axes: (3, k, c, B); straight to `out`, if there is one."""
    components = torch.stack([vector[axis] for axis in range(3) for vector in vectors])
    components = components.unflatten(0, (3, len(vectors))).transpose(1, 2)
    return rotate_vectors(rotation.unsqueeze(3), components, out)


def body_wrenches(states: BodyStates, phi: Tensor) -> Tensor:
    """Wrenches that bodies with given parameters demand, without their columns.

    Args:
        states: of the L frames that the parameters are expressed in.
        phi: (M, L, 10), M sets of inertial parameters.

    Returns:
        (6, M, L, B), force [N], then moment about the base origin [N m].

    Source: as `wrench_columns`. In the body frame, forces and moments are linear in 12 functions of the motion.
    """
    inverse = states.rotation.transpose(0, 1)
    omega, alpha, force = (
        rotate_vectors(inverse, x)
        for x in (states.angular_velocity, states.angular_acceleration, states.specific_force)
    )
    products = [omega[i] * omega[j] for i, j in parameters.INERTIA_AXES]
    functions = torch.stack([*force, *alpha, *products], dim=1)  # (L, 12, B)
    coefficients = torch.tensordot(phi, _newton_euler_coefficients().to(phi), dims=([2], [1])).permute(1, 2, 0, 3)
    local = coefficients.flatten(1, 2) @ functions  # (L, 6 M, B)
    local = local.unflatten(1, (6, -1)).permute(1, 2, 0, 3)
    out = torch.empty(local.shape, dtype=local.dtype, device=local.device)
    rotation = states.rotation.unsqueeze(2)
    for vector in (slice(0, 3), slice(3, 6)):
        torch.mul(rotation[:, 0], local[vector][0], out=out[vector])
        for k in (1, 2):
            out[vector].addcmul_(rotation[:, k], local[vector][k])
    x, y, z = states.position
    fx, fy, fz = out[:3]
    for moment, (a, f), (b, g) in zip(out[3:], ((y, fz), (z, fx), (x, fy)), ((z, fy), (x, fz), (y, fx)), strict=True):
        moment.addcmul_(a, f).addcmul_(b, g, value=-1)
    return out


@cache
def _newton_euler_coefficients() -> Tensor:
    """Coefficients (6, 10, 12) of the force and moment, in the body frame, of each unit inertial parameter.

    The functions are the specific force, the angular acceleration, and the products of angular velocities in the
    order of `parameters.INERTIA_AXES`.
    """
    epsilon = np.zeros((3, 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        epsilon[i, j, k], epsilon[i, k, j] = 1.0, -1.0
    a, alpha = np.eye(12)[:3], np.eye(12)[3:6]
    square = np.zeros((3, 3, 12))
    for number, (i, j) in enumerate(parameters.INERTIA_AXES, start=6):
        square[i, j, number] = square[j, i, number] = 1.0
    out = np.zeros((6, parameters.INERTIAL.stop, 12))
    out[:3, parameters.MASS] = a
    # alpha x h + omega x (omega x h), and h x a
    centripetal = square - np.eye(3)[..., None] * np.einsum("iif->f", square)
    out[:3, parameters.FIRST_MOMENT] = np.einsum("ijk,jf->ikf", epsilon, alpha) + centripetal
    out[3:, parameters.FIRST_MOMENT] = np.einsum("ijk,kf->ijf", epsilon, a)
    for number, (i, j) in enumerate(parameters.INERTIA_AXES, start=parameters.INERTIA.start):
        unit = np.zeros((3, 3))
        unit[i, j] = unit[j, i] = 1.0  # I alpha + omega x (I omega)
        out[3:, number] = unit @ alpha + np.einsum("ijk,kl,jlf->if", epsilon, unit, square)
    return torch.from_numpy(out)


def _first_moment_wrenches(
    omega: Tensor, alpha: Tensor, force: Tensor
) -> tuple[list[list[Tensor]], list[list[Tensor]]]:
    """Force ([alpha]x + [omega]x^2) e_k and moment e_k x specific force, for k = x, y, z, in the body frame."""
    x, y, z = omega
    ax, ay, az = alpha
    xy, xz, yz, xx, yy, zz = x * y, x * z, y * z, x * x, y * y, z * z
    forces = [[-yy - zz, az + xy, xz - ay], [xy - az, -xx - zz, yz + ax], [xz + ay, yz - ax, -xx - yy]]
    zero = torch.zeros_like(x)
    fx, fy, fz = force
    moments = [[zero, -fz, fy], [fz, zero, -fx], [-fy, fx, zero]]
    return forces, moments


def _inertia_moments(omega: Tensor, alpha: Tensor) -> dict[tuple[int, int], tuple[Tensor, Tensor, Tensor]]:
    """Moment E alpha + omega x (E omega) per unit of each inertia entry, about and in the body frame, by its axes."""
    x, y, z = omega
    ax, ay, az = alpha
    xy, xz, yz, xx, yy, zz = x * y, x * z, y * z, x * x, y * y, z * z
    return {
        (0, 0): (ax, xz, -xy),
        (0, 1): (ay - xz, ax + yz, xx - yy),
        (0, 2): (az + xy, zz - xx, ax - yz),
        (1, 1): (-yz, ay, xy),
        (1, 2): (yy - zz, az - xy, ay + xz),
        (2, 2): (yz, -xz, az),
    }
