"""Readings with the offsets and scales of their sensors taken out."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchid.logs.spill import Spill
from torchid.parameters import Array
from torchid.problem.extra_columns import dof_column, reading_column
from torchid.problem.extras import Extra
from torchid.problem.samples import Samples
from torchid.regressor.tree import KinematicTree

_ROWS = 2**16  # of a log on the disk that are in memory at a time


def calibrated(samples: Samples, extras: Sequence[Extra], values: Array, tree: KinematicTree) -> Samples:
    """Samples whose readings are the forces they stand for: s y - o for an offset o and a scale s of the reading y.

    Readings without unknowns are shared with `samples`; those that change lie on the disk if `samples` do.

    Args:
        samples: as recorded.
        extras: unknowns; those of actuators do not matter here.
        values: of each, (E,).
        tree: of the robot.

    Raises:
        SpillError: the disk is full.
    """
    known = [(x, value) for x, value in zip(extras, values.tolist(), strict=True) if x.what in ("offset", "scale")]
    if samples.folder is None:
        return replace(samples, **_readings(samples, known, tree))
    spills: defaultdict[str, Spill] = defaultdict(partial(Spill, samples.source, samples.folder))
    for start in range(0, len(samples), _ROWS):
        for name, rows in _readings(samples[start : start + _ROWS], known, tree).items():
            spills[name].append(rows.numpy())
    stored: dict[str, Any] = {name: torch.from_numpy(spill.array()) for name, spill in spills.items()}
    return replace(samples, **stored)


def _readings(samples: Samples, known: Sequence[tuple[Extra, float]], tree: KinematicTree) -> dict[str, Any]:
    """Calibrated copies of the fields of readings that have unknowns."""
    copies: dict[str, Tensor] = {}
    for extra, value in known:
        name = "torque" if extra.contact is None else "wrench"
        recorded: Tensor | None = getattr(samples, name)
        if recorded is None:
            continue
        if name not in copies:
            copies[name] = recorded.clone()
        if extra.contact is None:
            copies[name][:, extra.dof] -= value * dof_column(extra, samples, tree)
        else:
            contact, axis = extra.contact
            copies[name][:, contact, axis] -= value * reading_column(extra, samples, contact, axis)
    return copies
