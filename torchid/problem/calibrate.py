"""Readings with the offsets and scales of their sensors taken out."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from torchid.logs.spill import Spill
from torchid.parameters import Array
from torchid.problem.extra_columns import dof_column, reading_column
from torchid.problem.extras import Extra
from torchid.problem.samples import Samples
from torchid.regressor.tree import KinematicTree

_IN_MEMORY, _ROWS = 2**30, 2**16  # bytes of a copy; rows that are copied at a time


def calibrated(samples: Samples, extras: Sequence[Extra], values: Array, tree: KinematicTree) -> Samples:
    """Samples whose readings are the forces they stand for: s y - o for an offset o and a scale s of the reading y.

    Args:
        samples: as recorded.
        extras: unknowns; those of actuators do not matter here.
        values: of each, (E,).
        tree: of the robot.
    """
    torque, wrench = (None if x is None else _copied(x, samples.source) for x in (samples.torque, samples.wrench))
    for extra, value in zip(extras, values.tolist(), strict=True):
        if extra.what not in ("offset", "scale"):
            continue
        if extra.dof is not None and torque is not None:
            torque[:, extra.dof] -= value * dof_column(extra, samples, tree)
        elif extra.contact is not None and wrench is not None:
            contact, axis = extra.contact
            wrench[:, contact, axis] -= value * reading_column(extra, samples, contact, axis)
    return replace(samples, torque=torque, wrench=wrench)


def _copied(x: Tensor, source: str) -> Tensor:
    """A copy, on the disk if it is large: so are the samples of a log larger than memory."""
    if x.nbytes <= _IN_MEMORY:
        return x.clone()
    spill = Spill(source, Path(tempfile.gettempdir()))
    for rows in x.split(_ROWS):
        spill.append(rows.numpy())
    return torch.from_numpy(spill.array())
