"""What of measured forces no URDF near the given one explains: equations with a prior on what a URDF may be off by.

With phi = phi_0 + delta the rows are K delta + (terms) = 0, delta normal with the deviations that CAD models have. The
terms are columns: the URDF's forces, each torque, a shift of the wrenches. What of them K cannot take on, at the price
of delta, is what a mistake is told by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from torchid import parameters
from torchid.hygiene.model import NOTHING
from torchid.logs.fields import BoolArray, FloatArray
from torchid.problem import RowBuilder, Samples
from torchid.problem.chunks import by_state
from torchid.problem.linear import parameter_scale
from torchid.problem.threads import one_thread
from torchid.regressor.motion import GRAVITY_WORLD
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet

#: What a URDF may be off by, in units of `parameter_scale`: 0.1 is a mass, and an inertia, 15 to 20 % off.
OFF = 0.1
#: Friction that a URDF lacks, in the joint's rms torque.
FRICTION = 0.2
#: What no parameters explain (flexibility, filters, shape of friction), as a share of the rms of each kind of force.
UNMODELLED = 0.05
#: Samples after one another that say the same: of 240 out of ten seconds, what friction and flexibility leave of them.
ALIKE = 10.0
#: Blocks of time that must agree.
BLOCKS = 6
_TINY = 1e-9


@dataclass(frozen=True, eq=False)
class Terms:
    """Whitened equations of some samples, by blocks of time.

    Attributes:
        inside: (BLOCKS, P, P), products of the columns K, each times what its parameter may be off by.
        across: (BLOCKS, P, k), of these with the terms.
        terms: (BLOCKS, k, k), of the terms.
        rows: equations.
    """

    inside: FloatArray
    across: FloatArray
    terms: FloatArray
    rows: int

    def unexplained(self, block: int | None = None) -> FloatArray:
        """Products (k, k) of what is left of the terms, over all blocks or in one."""
        chosen = slice(None) if block is None else slice(block, block + 1)
        H, C, G = (part[chosen].sum(axis=0) for part in (self.inside, self.across, self.terms))
        H = H + ALIKE * np.eye(len(H))
        return np.asarray(G - C.T @ np.linalg.solve(H, C))


def known_sensors(samples: Sequence[Samples], robot: Robot, contacts: Sequence[Contact]) -> SensorSet:
    """The forces that are known throughout, with what no parameters explain of each kind as their noise."""
    torque = np.zeros(robot.dofs, bool)
    wrench = np.zeros((len(contacts), 6), bool)
    size = 0.0
    if all(part.torque is not None for part in samples):
        values = np.concatenate([part.torque.numpy() for part in samples if part.torque is not None])[:, : robot.n]
        torque[: robot.n] = np.isfinite(values).all(axis=0) & (np.abs(values) > NOTHING).any(axis=0)
        size = float(np.sqrt(np.square(values[:, torque[: robot.n]]).mean())) if torque.any() else 0.0
    if contacts and all(part.wrench is not None for part in samples):
        for k, contact in enumerate(contacts):
            known = [
                part.wrench[:, k][part.active[:, k]].numpy()[:, list(contact.components)]
                for part in samples
                if part.wrench is not None
            ]
            wrench[k, list(contact.components)] = np.isfinite(np.concatenate(known)).all()
    weight = -GRAVITY_WORLD[2] * float(robot.nominal[:, parameters.MASS].sum())
    moment = size or 0.1 * weight
    noise = SensorNoise(*(max(UNMODELLED * x, _TINY) for x in (moment, 0.5 * weight, moment)))
    return SensorSet(torque, wrench, noise)


def friction_scale(samples: Sequence[Samples], robot: Robot) -> FloatArray:
    """Coulomb [N m] and viscous [N m s/rad] friction that joints without a word in the URDF have, (n, 2)."""
    out = np.full((robot.n, 2), _TINY)
    if all(part.torque is not None for part in samples):
        torque = np.concatenate([part.torque[:, : robot.n].numpy() for part in samples if part.torque is not None])
        velocity = np.concatenate([part.joint_velocity.numpy() for part in samples])
        size = FRICTION * np.sqrt(np.square(np.nan_to_num(torque)).mean(axis=0))
        speed = np.sqrt(np.square(velocity).mean(axis=0))
        out = np.stack([size, size / np.maximum(speed, 1e-3)], axis=1)
    return np.maximum(out, _TINY)


def prior_columns(builder: RowBuilder, robot: Robot, samples: Sequence[Samples]) -> FloatArray:
    """Matrix (columns, P) from deviations of size 1 to the builder's columns."""
    scale = OFF * parameter_scale(robot.nominal)
    scale[:, parameters.FRICTION] = 0.0
    friction = friction_scale(samples, robot)
    for body, found in enumerate(robot.bodies):
        if found.joint is not None and found.joint.name in robot.joint_names:
            scale[body, parameters.FRICTION] = friction[robot.joint_names.index(found.joint.name)]
    massless = [body.massless for body in robot.bodies]
    scale[massless, parameters.INERTIAL] = 0.0
    kept = scale.flatten() > 0.0
    return np.asarray((builder.columns.from_parameters() * scale.flatten())[:, kept])


@torch.no_grad()
def rows_of(builder: RowBuilder, samples: Samples) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Whitened rows (N, nv, columns + 1), the bases W (N, nv, nv) that they stand in, and which rows are equations."""
    nv = builder.tree.base_rows + len(builder.columns.joint_rows)
    rows, W = np.zeros((len(samples), nv, builder.width + 1)), np.zeros((len(samples), nv, nv))
    with one_thread():
        for state, index in by_state(samples):
            where = index if isinstance(index, slice) else index.numpy()
            found = builder.rows_by_sample(samples[index], state)
            rows[where], W[where] = (x.numpy() for x in found)
    return rows, W, np.asarray(np.abs(W).any(axis=1))


def gathered(K: FloatArray, terms: FloatArray, equations: BoolArray) -> Terms:
    """Products by blocks of samples (N, nv, P) and (N, nv, k)."""
    inside, across, own = [], [], []
    for part in np.array_split(np.arange(len(K)), BLOCKS):
        A, Y = K[part].reshape(-1, K.shape[2]), terms[part].reshape(-1, terms.shape[2])
        inside.append(A.T @ A)
        across.append(A.T @ Y)
        own.append(Y.T @ Y)
    return Terms(np.array(inside), np.array(across), np.array(own), int(equations.sum()))
