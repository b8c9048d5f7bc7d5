"""Readings with the offsets and scales of their sensors taken out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torchid.parameters import Array
from torchid.problem.extra_columns import dof_column, reading_column
from torchid.problem.extras import Extra
from torchid.problem.samples import Samples
from torchid.regressor.tree import KinematicTree


def calibrated(samples: Samples, extras: Sequence[Extra], values: Array, tree: KinematicTree) -> Samples:
    """Samples whose readings are the forces they stand for: s y - o for an offset o and a scale s of the reading y.

    Args:
        samples: as recorded.
        extras: unknowns; those of actuators do not matter here.
        values: of each, (E,).
        tree: of the robot.
    """
    torque = None if samples.torque is None else samples.torque.clone()
    wrench = None if samples.wrench is None else samples.wrench.clone()
    for extra, value in zip(extras, values.tolist(), strict=True):
        if extra.what not in ("offset", "scale"):
            continue
        if extra.dof is not None and torque is not None:
            torque[:, extra.dof] -= value * dof_column(extra, samples, tree)
        elif extra.contact is not None and wrench is not None:
            contact, axis = extra.contact
            wrench[:, contact, axis] -= value * reading_column(extra, samples, contact, axis)
    return replace(samples, torque=torque, wrench=wrench)
